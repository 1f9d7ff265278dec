"""Sets of load cases: which modes, which signs, how large."""

import numpy as np
import pytest
from condense.conftest import basis_of, cases_of
from truths.hidden_membrane import hidden_membrane

import snrmjax as sj
from snrmjax.condense.load_set import LoadSet


def test_singles_pairs_and_triples_with_all_signs_at_the_wanted_displacement():
    basis = basis_of(hidden_membrane(4), (1, 3, 5, 7))
    loads = sj.condense.modal_loads(basis, 0.3)
    force = np.asarray(loads.force)
    assert len(force) == 4 * 2 + 6 * 4 + 4 * 8  # C(4, k) 2^k
    assert len({tuple(row) for row in np.sign(force)}) == len(force)
    assert loads.names[:2] == ("+1", "-1")
    assert "+1 -3 +7" in loads.names
    linear = force / np.asarray(basis.frequency) ** 2
    moved = np.abs(linear[:, :, None] * np.asarray(basis.shapes).T).max(axis=2)  # m, of each mode
    count = np.count_nonzero(force, axis=1)
    np.testing.assert_allclose(moved * (count[:, None]), 0.3 * (force != 0), rtol=1e-12)


def test_rotations_are_no_displacements():
    shapes = np.array([[0.5], [40.0]])
    moving = np.array([True, False])
    basis = sj.condense.ReductionBasis(np.array([3.0]), shapes, np.ones((1, 2)), (1,), moving)
    loads = sj.condense.modal_loads(basis, 0.1, levels=(0.5,))
    np.testing.assert_allclose(loads.force[:, 0], [0.9, -0.9])  # 0.5 · 9 · 0.1/0.5


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"displacement": 0.0}, "`displacement` must be positive"),
        ({"displacement": [1.0, 2.0]}, "one for each of the 3 modes"),
        ({"displacement": np.nan}, "`displacement` must be positive"),
        ({"most_modes": 0}, "`most_modes` must be at least 1"),
        ({"levels": ()}, "`levels` must be positive"),
        ({"levels": (1.0, -1.0)}, "`levels` must be positive"),
        ({"degree": 1}, "from 2 to 7"),
    ],
)
def test_loads_that_make_no_sense_are_refused(settings, words):
    settings = {"displacement": 1.0} | settings
    with pytest.raises(ValueError, match=words):
        sj.condense.modal_loads(
            basis_of(hidden_membrane()), settings.pop("displacement"), **settings
        )


@pytest.mark.parametrize("curved", [0.0, 30.0])
def test_the_wanted_nonlinear_ratio_is_reached(curved):
    truth = hidden_membrane(3, 2, curved=curved)
    basis = basis_of(truth)

    def solve(force):
        return cases_of(truth, LoadSet(force, ()))

    size = sj.condense.displacement_for_ratio(basis, solve, ratio=0.1, start=1e-3)
    alone = sj.condense.modal_loads(basis, size, most_modes=1, levels=(1.0,))
    cases = cases_of(truth, alone)
    linear = np.asarray(basis.frequency) * cases.modal_displacement  # energy: ½ |linear|²
    rest = np.asarray(alone.force) / np.asarray(basis.frequency) - linear
    ratio = np.linalg.norm(rest, axis=1) / np.linalg.norm(linear, axis=1)
    # Rows are +1, -1, +3, …; found to 15 % in the logarithm.
    np.testing.assert_allclose(ratio.reshape(3, 2).max(axis=1), 0.1, rtol=0.17)


def test_a_linear_structure_and_one_that_never_converges_have_no_such_load():
    truth = hidden_membrane(2, 0)
    basis = basis_of(truth)

    def solve(force):
        return cases_of(truth, LoadSet(force, ()))

    with pytest.raises(ValueError, match="no load along mode"):
        sj.condense.displacement_for_ratio(basis, solve, start=1.0)

    def fail(force):
        nothing = np.full(force.shape, np.nan)
        return sj.condense.StaticCases(force, nothing, np.zeros(len(force), dtype=bool))

    with pytest.raises(ValueError, match="state the load scale"):
        sj.condense.displacement_for_ratio(basis, fail, start=1.0)
    with pytest.raises(ValueError, match="`ratio` must lie"):
        sj.condense.displacement_for_ratio(basis, fail, ratio=2.0, start=1.0)
