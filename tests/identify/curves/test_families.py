"""Curve families: values, exact limits, derivatives, and starts that reproduce their own kind."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from snrmjax.identify.curves.families import (
    FAMILIES,
    PowerLaw,
    Spline,
)
from snrmjax.identify.curves.family_base import Scattered, packed

AMPLITUDE = np.linspace(0.05, 1.3, 40)


def member(kind, size=None, argument="displacement"):
    """A member of a family near a smooth curve."""
    family = FAMILIES[kind]
    values = 3.0 + 0.7 * AMPLITUDE**2 + 0.1 * np.sin(2 * AMPLITUDE)
    size = family.orders[-1] if size is None else size
    return family.starts(size, Scattered(argument, AMPLITUDE, values, np.ones(40)))[0]


@pytest.mark.parametrize(
    ("kind", "argument"),
    [(kind, ("displacement", "velocity")[k % 2]) for k, kind in enumerate(FAMILIES)],
)
def test_programs_have_the_values_and_derivatives_of_the_host(kind, argument):
    curve = member(kind, argument=argument)
    general, n = packed(curve), curve.parameters.shape[0]
    at = np.array([0.02, 0.3, 1.1, 1.5])  # beyond the data too
    other = np.full(4, 7.0)
    pair = (at, other) if argument == "displacement" else (other, at)
    np.testing.assert_array_equal(general.amplitude(*pair), at)
    np.testing.assert_array_equal(curve.amplitude(*pair), at)

    def of(parameters, at):
        return eqx.tree_at(lambda f: f.parameters, general, parameters)(at)

    @jax.jit
    def all_of(parameters, at):
        along = jax.jvp(lambda at: jax.jacfwd(of)(parameters, at), (at,), (jnp.ones(4),))
        back = jax.vjp(lambda p: of(p, at), parameters)[1](jnp.ones(4))[0]
        return of(parameters, at), *along, back

    value, slopes, mixed, back = map(np.asarray, all_of(general.parameters, jnp.asarray(at)))
    assert np.all(slopes[:, n:] == 0)  # padding parameters have no effect
    host = curve.linearised(at)
    unit = 1e-9 * np.abs(host.by_parameters).max()
    np.testing.assert_allclose(value, host.value, rtol=1e-12)
    np.testing.assert_allclose(slopes[:, :n], host.by_parameters, rtol=1e-9, atol=unit)
    np.testing.assert_allclose(back[:n], host.by_parameters.sum(axis=0), rtol=1e-9, atol=unit)
    ends = [curve.linearised(at + sign * 1e-5) for sign in (1, -1)]
    difference = (ends[0].value - ends[1].value) / 2e-5
    np.testing.assert_allclose(host.by_amplitude, difference, rtol=1e-6, atol=1e-7)
    difference = (ends[0].by_parameters - ends[1].by_parameters) / 2e-5
    np.testing.assert_allclose(mixed[:, :n], difference, rtol=1e-5, atol=1e-6)
    assert general(jnp.zeros(())) == pytest.approx(
        curve.linearised(np.zeros(1)).value[0], rel=1e-12
    )


@pytest.mark.parametrize("kind", FAMILIES)
def test_every_parameter_has_a_name_and_the_limit_at_zero_is_exact(kind):
    curve = member(kind)
    names = [c.name for c in curve.coefficients()]
    assert len(set(names)) == len(names) == curve.parameters.shape[0]
    at_zero = float(curve(jnp.zeros(())))
    slope = jax.grad(lambda a: curve(a))(1e-9)
    if kind == "viscous_coulomb":
        assert abs(at_zero) == np.inf  # equivalent damping of dry friction is infinite
    else:
        assert at_zero == pytest.approx(float(curve.parameters[0]), rel=1e-12)
        assert np.isfinite(float(slope))


def test_the_spline_is_the_natural_cubic_spline_of_the_square():
    knots = np.array([0.0, 0.1, 0.35, 0.7, 1.0])
    values = np.array([2.0, 2.4, 1.7, 3.1, 2.2])
    start = Spline.starts(5, Scattered("velocity", AMPLITUDE, np.ones(40), np.ones(40)))[0]
    at, unit = 1.3 * np.sqrt(knots), jnp.asarray(1.3)
    curve = Spline.through(knots, values, unit, "velocity")
    np.testing.assert_allclose(curve(jnp.asarray(at)), values, rtol=1e-12)
    assert start.knots[0] == 0.0
    truth = CubicSpline(knots, values, bc_type="natural")
    inside = np.linspace(0, 1, 57)
    np.testing.assert_allclose(curve(1.3 * np.sqrt(inside)), truth(inside), rtol=1e-11)
    # Beyond the last knot it is linear in the squared amplitude.
    beyond = float(curve(jnp.asarray(1.3 * np.sqrt(1.4))))
    assert beyond == pytest.approx(values[-1] + 0.4 * float(truth(1.0, 1)), rel=1e-11)


@pytest.mark.parametrize(
    ("kind", "size", "truth"),
    [
        ("polynomial", 2, lambda a: 5 - 2 * a**2 + 0.3 * a**4),
        ("constant", 0, lambda a: 4.0 + 0 * a),
        ("viscous_quadratic", 1, lambda a: 1.2 + 0.4 * a),
        ("viscous_coulomb", 1, lambda a: 1.2 + 0.02 / a),
    ],
)
def test_a_start_reproduces_its_own_family(kind, size, truth):
    curve = FAMILIES[kind].starts(
        size, Scattered("velocity", AMPLITUDE, truth(AMPLITUDE), np.ones(40))
    )[0]
    np.testing.assert_allclose(curve(AMPLITUDE), truth(AMPLITUDE), rtol=1e-11)


def test_a_power_law_starts_at_each_exponent_tried():
    starts = PowerLaw.starts(1, Scattered("velocity", AMPLITUDE, 1 + AMPLITUDE**2, np.ones(40)))
    np.testing.assert_allclose([float(s.exponent) for s in starts], PowerLaw.tried, rtol=1e-12)
    best = starts[PowerLaw.tried.index(2.0)]
    np.testing.assert_allclose(best(AMPLITUDE), 1 + AMPLITUDE**2, rtol=1e-12)


def test_scaling_amplitude_and_value_scales_the_curve():
    for kind in FAMILIES:
        family = FAMILIES[kind]
        values = 3.0 + 0.7 * AMPLITUDE
        size = family.orders[0]
        one = family.starts(size, Scattered("velocity", AMPLITUDE, values, np.ones(40)))[0]
        other = family.starts(
            size, Scattered("velocity", 1e-3 * AMPLITUDE, 50 * values, np.ones(40))
        )[0]
        np.testing.assert_allclose(other(1e-3 * AMPLITUDE), 50 * one(AMPLITUDE), rtol=1e-10)
