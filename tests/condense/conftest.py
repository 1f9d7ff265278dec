"""Load cases of the structure with a hidden membrane, whose condensed potential is known."""

import numpy as np
import pytest
from truths.hidden_membrane import hidden_membrane

import snrmjax as sj


def basis_of(truth, numbers=None):
    numbers = numbers or tuple(range(1, len(truth.frequency) + 1))
    return sj.condense.ReductionBasis(truth.frequency, truth.shapes, truth.filter, numbers)


def cases_of(truth, loads, *, digits=None):
    rows = [truth.solved(force, digits=digits) for force in np.asarray(loads.force)]
    q, u, energy = (np.array(part) for part in zip(*rows, strict=True))
    converged = np.ones(len(q), dtype=bool)
    return sj.condense.StaticCases(loads.force, q, converged, energy, u, loads.names)


@pytest.fixture(scope="session")
def curved():
    """Truth, basis and load cases of three modes with quadratic and cubic force."""
    truth = hidden_membrane(3, 2, curved=30.0)
    basis = basis_of(truth, (1, 3, 5))
    return truth, basis, cases_of(truth, sj.condense.modal_loads(basis, 4.0))
