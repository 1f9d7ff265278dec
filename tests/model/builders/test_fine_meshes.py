"""Lowest modes of fine meshes, whose stiffness spans many powers of ten: the beam's own formula."""

import numpy as np
import pytest
import scipy.sparse

import snrmjax as sj

BENDING, MASS, LENGTH = 656.3, 1.529, 0.7  # N m², kg/m, m


def frequency(root):
    return root**2 / LENGTH**2 * np.sqrt(BENDING / MASS)


@pytest.mark.parametrize("n_elements", [60, 400])
@pytest.mark.parametrize(
    ("supports", "root"), [(("clamped", "free"), 1.8751040687), (("free", "free"), 4.7300407449)]
)
@pytest.mark.parametrize("sparse", [False, True])
def test_the_lowest_modes_keep_their_digits(n_elements, supports, root, sparse):
    mass, _, stiffness, points = sj.model.beam(BENDING, MASS, LENGTH, n_elements, supports=supports)
    if sparse:
        mass, stiffness = scipy.sparse.csc_matrix(mass), scipy.sparse.csc_matrix(stiffness)
    modes = sj.model.from_matrices(
        *(mass, None, stiffness, points),
        force=f"w{n_elements}",
        n_modes=4,
        residuals=False,
        sensors=[f"w{n_elements}"],
    ).modes
    assert modes.natural_frequency[0] == pytest.approx(frequency(root), rel=2e-6)
    assert modes.rigid_body_participation.size == (2 if supports[0] == "free" else 0)


def test_all_modes_of_a_fine_beam_are_flexible():
    model = sj.model.from_matrices(*sj.model.beam(BENDING, MASS, LENGTH, 120), force="w120")
    assert model.modes.rigid_body_participation.size == 0
    assert model.modes.natural_frequency[0] == pytest.approx(frequency(1.8751040687), rel=1e-5)
