"""One potential out of static load cases: the known one, and the warnings about bad cases."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from condense.conftest import basis_of, cases_of
from truths.hidden_membrane import hidden_membrane

import snrmjax as sj
from snrmjax.condense.potential_fit import fit_system, leave_out, monomials_of


def changed(cases, rows, factor, column=slice(None)):
    """The cases with some rows of displacements multiplied."""
    q = np.array(cases.modal_displacement)
    q[rows, column] *= factor
    return dataclasses.replace(cases, modal_displacement=q, energy=None, displacement=None)


def kinds(condensation):
    return [one.kind for one in condensation.warnings]


def test_the_condensed_potential_of_a_hidden_membrane_is_recovered(curved):
    truth, basis, cases = curved
    result = sj.condense.reduced_model(basis, cases)
    known = truth.coefficients()
    assert set(result.potential.monomials) == set(known)
    # Round-off of the load cases is 1e-16 of the linear force, terms are 1e-5 of it and more.
    expected = [known[m] for m in result.potential.monomials]
    np.testing.assert_allclose(result.potential.coefficient, expected, rtol=1e-7)
    assert np.all(result.potential.coefficient_std < 1e-6 * np.abs(expected))
    assert result.quality.misfit < 1e-12
    assert result.quality.cross_validated < 1e-12
    np.testing.assert_allclose(result.quality.linear_stiffness_ratio, 1.0, rtol=1e-9)
    assert np.max(np.abs(result.quality.energy_error)) < 1e-12
    assert result.warnings == ()


@pytest.mark.long
def test_degree_five_finds_no_terms_that_are_not_there(curved):
    truth, basis, _ = curved
    cases = cases_of(truth, sj.condense.modal_loads(basis, 4.0, degree=5))
    result = sj.condense.reduced_model(basis, cases, degree=5)
    known = truth.coefficients()
    force = np.abs(result.potential.force(cases.modal_displacement)).max()
    for monomial, value in zip(
        result.potential.monomials, result.potential.coefficient, strict=True
    ):
        if len(monomial) <= 4:
            assert float(value) == pytest.approx(known[monomial], rel=1e-5)
    highest = [len(m) > 4 for m in result.potential.monomials]
    extra = dataclasses.replace(
        result.potential,
        coefficient=jnp.where(jnp.array(highest), result.potential.coefficient, 0.0),
    )
    assert np.abs(extra.force(cases.modal_displacement)).max() < 1e-8 * force


def test_a_reduced_structure_holds_the_static_forces(curved):
    _, basis, cases = curved
    result = sj.condense.reduced_model(basis, cases)
    sensors = {"first": basis.shapes[0], "mean": basis.shapes.mean(axis=0)}
    model = result.structure(0.01, sensors=sensors, participation=[1.0, 2.0, 3.0], name="beam")
    assert model.modes.sensors == ("first", "mean")
    np.testing.assert_allclose(model.modes.natural_frequency, basis.frequency)
    q = cases.modal_displacement
    held = q * model.linear_terms().stiffness + model.memoryless_force(q, jnp.zeros_like(q))
    np.testing.assert_allclose(held, cases.force, atol=1e-10 * np.abs(cases.force).max())
    np.testing.assert_allclose(result.force(q), held, rtol=1e-12)


def test_coefficients_scale_with_displacement_exactly_in_value_and_slope(curved):
    # q → s q with f and ω as they were is f = (ω² + …): with ω² divided by s too, c → c s^-(d-1).
    _, basis, cases = curved

    @jax.jit
    def fitted(scale):
        moved = dataclasses.replace(cases, modal_displacement=cases.modal_displacement * scale)
        stiff = dataclasses.replace(basis, frequency=basis.frequency / jnp.sqrt(scale))
        return sj.condense.fit_potential(stiff, moved).coefficient

    monomials = monomials_of(3, 3)
    degree = np.array([len(m) - 1.0 for m in monomials])
    value, slope = jax.jvp(fitted, (1.0,), (1.0,))
    np.testing.assert_allclose(slope, -degree * value, rtol=1e-6)
    np.testing.assert_allclose(jax.jacrev(fitted)(1.0), slope, rtol=1e-8)


def test_leaving_out_in_closed_form_is_fitting_without(curved):
    _, basis, cases = curved
    random = np.random.default_rng(1)
    cases = changed(cases, slice(None), 1 + 1e-4 * random.normal(size=cases.force.shape))
    monomials = monomials_of(3, 3)
    system = fit_system(basis, cases, monomials)
    fast = leave_out(system)
    design, target = np.asarray(system.design), np.asarray(system.target)
    values = []
    for k in range(len(target)):
        keep = np.arange(len(target)) != k
        x = np.linalg.lstsq(
            design[keep].reshape(-1, len(monomials)), target[keep].reshape(-1), rcond=None
        )[0]
        values.append(x)
        np.testing.assert_allclose(target[k] - design[k] @ x, fast.cross_validated[k], atol=1e-9)
    n = len(values)
    spread = np.sqrt((n - 1) * np.var(values, axis=0))
    np.testing.assert_allclose(fast.std, spread, rtol=1e-6)


@pytest.mark.parametrize(
    ("rows", "factor", "column", "reason"),
    [
        ([4], -1.0, slice(None), "sign"),
        ([7], 1000.0, slice(None), "wrong unit"),
        ([3, 20], 1.1, 1, ""),
    ],
)
def test_the_inconsistent_cases_are_named(curved, rows, factor, column, reason):
    _, basis, cases = curved
    result = sj.condense.reduced_model(basis, changed(cases, rows, factor, column))
    (fact,) = [one for one in result.warnings if one.kind == "inconsistent_case"]
    assert fact["cases"] == tuple(rows)
    assert all(cases.names[row] in fact["names"] for row in rows)
    assert fact["against_force"] is (reason == "sign")
    assert (fact["times"] is not None) is (reason == "wrong unit")


def test_too_small_loads_too_short_a_polynomial_and_too_large_loads_are_told_apart(curved):
    truth, basis, cases = curved
    loads = sj.condense.modal_loads(basis, 0.001)
    rounded = sj.condense.reduced_model(basis, cases_of(truth, loads, digits=6))
    assert kinds(rounded) == ["too_small"]
    nothing = sj.condense.modal_loads(basis, 1e-13)
    assert kinds(sj.condense.reduced_model(basis, cases_of(truth, nothing))) == ["too_small"]
    short = sj.condense.reduced_model(basis, cases, degree=2)
    assert "too_large" in kinds(short)
    assert next(w for w in short.warnings if w.kind == "too_large")["longer"]


def test_beyond_a_snap_through_the_regime_is_said_to_be_another():
    # ω²q − 3aq² + 2.2 q³: softens to a negative stiffness around q = a/2.2, hardens beyond.
    q = np.linspace(-0.3, 1.2, 12)[:, None]
    a, stiffness = 1.0, 1.2
    cases = sj.condense.StaticCases(
        stiffness * q - 3 * a * q**2 + 2.2 * q**3, q, np.ones(12, dtype=bool)
    )
    basis = sj.condense.ReductionBasis(np.sqrt([stiffness]), np.eye(1), np.eye(1), (1,))
    result = sj.condense.reduced_model(basis, cases)
    assert kinds(result) == ["other_regime"]
    within = stiffness - 6 * a * q[:, 0] + 6.6 * q[:, 0] ** 2 < 0
    assert result.warnings[0]["cases"] == tuple(np.flatnonzero(within))


def test_cases_without_solution_repeated_ones_and_wrong_energy_or_frequency_are_said(curved):
    _, basis, cases = curved
    lost = np.ones(len(cases.force), dtype=bool)
    lost[[2, 9]] = False
    q = np.where(lost[:, None], cases.modal_displacement, np.nan)
    partial = dataclasses.replace(cases, converged=lost, modal_displacement=q)
    result = sj.condense.reduced_model(basis, partial)
    assert kinds(result) == ["not_converged"]
    assert result.warnings[0]["cases"] == (2, 9)
    full = sj.condense.reduced_model(basis, cases)
    np.testing.assert_allclose(result.potential.coefficient, full.potential.coefficient, rtol=1e-6)
    twice = jax.tree.map(lambda rows: jnp.concatenate([rows, rows[:1]]), cases)
    twice = dataclasses.replace(twice, names=())
    assert kinds(sj.condense.reduced_model(basis, twice)) == ["repeated_case"]
    energy = np.array(cases.energy)
    energy[5] *= 1.1
    off = sj.condense.reduced_model(basis, dataclasses.replace(cases, energy=energy))
    assert kinds(off) == ["energy"]
    assert off.warnings[0]["cases"] == (5,)
    stiffer = dataclasses.replace(basis, frequency=np.asarray(basis.frequency) * [1, 1.05, 1])
    bare = dataclasses.replace(cases, energy=None)
    wrong = sj.condense.reduced_model(stiffer, bare)
    assert "linear_part" in kinds(wrong)
    # 1/1.05² = 0.907
    assert wrong.quality.linear_stiffness_ratio[1] == pytest.approx(1 / 1.05**2, rel=1e-6)


def test_what_cannot_be_fitted_is_refused(curved):
    _, basis, cases = curved
    few = jax.tree.map(lambda rows: rows[:6], dataclasses.replace(cases, names=()))
    with pytest.raises(ValueError, match="6 usable load cases give 18 equations for 25"):
        sj.condense.reduced_model(basis, few)
    # Each mode alone, of a structure that does not couple them.
    loads = sj.condense.modal_loads(basis, 4.0, most_modes=1, levels=(0.4, 0.6, 0.8, 1.0)).force
    q = np.asarray(loads) / np.asarray(basis.frequency) ** 2
    single = sj.condense.StaticCases(loads, q, np.ones(len(q), dtype=bool))
    with pytest.raises(ValueError, match=r"do not determine .* separately: .*123"):
        sj.condense.reduced_model(basis, single)
    still = dataclasses.replace(cases, force=np.asarray(cases.force) * [1, 0, 1])
    with pytest.raises(ValueError, match="force of mode 3 is zero"):
        sj.condense.reduced_model(basis, still)
    with pytest.raises(ValueError, match="3 modes, but the basis has 2"):
        sj.condense.reduced_model(basis_of(hidden_membrane(2)), cases)
    none = dataclasses.replace(cases, converged=np.zeros(len(cases.force), dtype=bool))
    with pytest.raises(ValueError, match="none of the 26 load cases"):
        sj.condense.reduced_model(basis, none)
    with pytest.raises(ValueError, match="from 2 to 7"):
        sj.condense.reduced_model(basis, cases, degree=8)
