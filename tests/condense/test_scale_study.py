"""Coefficients over the size of load cases, and static paths of reduced models."""

import jax.numpy as jnp
import numpy as np
import pytest
from condense.conftest import basis_of, cases_of
from truths.hidden_membrane import hidden_membrane

from snrmjax.condense.load_set import LoadSet
from snrmjax.condense.scale_study import load_scale_study, plateau_of
from snrmjax.condense.static_response import static_displacement
from snrmjax.model.potential import polynomial_potential


def solver(truth, digits=None):
    return lambda force: cases_of(truth, LoadSet(force, ()), digits=digits)


def test_the_plateau_ends_where_round_off_begins_and_has_the_known_coefficients():
    truth = hidden_membrane(2, 2)
    scales = (1e-4, 1e-3, 0.03, 0.1, 0.3, 1.0, 2.0)
    study = load_scale_study(basis_of(truth), solver(truth, 7), 20.0, scales=scales)
    known = truth.coefficients()
    leading = [k for k, is_leading in enumerate(study.leading) if is_leading]
    assert all(len(study.monomials[k]) == 4 for k in leading)  # no quadratic force is there
    expected = np.array([known[study.monomials[k]] for k in leading])
    off = np.max(np.abs(study.coefficient[:, leading] / expected - 1), axis=1)
    low, high = study.plateau
    inside = (study.scale >= low) & (study.scale <= high)
    assert np.all(off[inside] < 0.02)
    assert off[0] > 1.0  # seven digits show nothing of a nonlinear force of 1e-10
    assert low > scales[1]
    assert study.holds_default == (low < 1.0 < high)
    assert study.holds_default
    assert study.decades == pytest.approx(np.log10(high / low))
    assert study.to_xarray().coefficient.shape == (7, len(study.monomials))


def test_a_scale_whose_cases_fail_has_no_numbers_and_ends_the_plateau():
    truth = hidden_membrane(1, 1)
    solve, basis = solver(truth), basis_of(truth)

    def failing(force):
        cases = solve(force)
        good = np.abs(force[:, 0]) < 5.0 * basis.frequency[0] ** 2 / basis.largest[0]
        return type(cases)(cases.force, cases.modal_displacement, np.asarray(good))

    study = load_scale_study(basis, failing, 1.0, scales=(0.5, 1.0, 2.0, 8.0))
    np.testing.assert_array_equal(np.isfinite(study.misfit), [True, True, True, False])
    assert study.plateau == (0.5, 2.0)
    with pytest.raises(ValueError, match="positive and ascending"):
        load_scale_study(basis, solve, 1.0, scales=(1.0, 0.5))


def test_the_longest_plateau_is_the_widest_in_ratio():
    values = np.array([1.0, 1.01, 5.0, 3.0, 3.01, 3.03])[:, None]
    assert plateau_of(np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), values) == (1.0, 2.0)
    assert plateau_of(np.array([1.0, 2.0]), np.array([[1.0], [2.0]])) is None
    assert plateau_of(np.array([1.0, 2.0]), np.array([[np.nan], [2.0]])) is None


def test_a_static_path_ends_where_it_snaps_through():
    # f = q − 3q² + q³·2.2: turning points where 6.6 q² − 6 q + 1 = 0, the first at q = 0.2198.
    potential = polynomial_potential({"111": -1.0, "1111": 0.55}, 1)
    turn = (6 - np.sqrt(36 - 26.4)) / 13.2
    limit = turn - 3 * turn**2 + 2.2 * turn**3
    beyond = limit * np.linspace(1.05, 4.0, 30)[:, None]
    forces = jnp.array([[0.5 * limit], [0.99 * limit], [1.05 * limit], [-1.0], *beyond])
    result = np.asarray(static_displacement(jnp.array([1.0]), potential, forces))[:, 0]
    assert np.all(np.isnan(result[[2, *range(4, 34)]]))  # though there is another branch
    held = result - 3 * result**2 + 2.2 * result**3
    np.testing.assert_allclose(held[[0, 1, 3]], np.asarray(forces)[[0, 1, 3], 0], rtol=1e-9)
    assert result[1] < turn
