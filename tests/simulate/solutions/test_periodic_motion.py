"""Single motions and their derivatives: exact ones, central differences, jit and vmap."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from snrmjax.model.effects import make_effect
from snrmjax.model.modes import linear_modes
from snrmjax.model.potential import polynomial_potential
from snrmjax.model.structures import structure
from snrmjax.simulate.solutions.forced_response import forced_response
from snrmjax.simulate.solutions.periodic_motion import (
    periodic_motion,
)

CONDITIONS = ("frequency", "velocity", "fold", "peak", "phase_resonance")
FORCE = 0.12


def one_mode(potential=None, effects=(), ratio=0.02):
    modes = linear_modes([2.0], [ratio], [[1.0]], [1.5])
    return structure(modes, polynomial_potential(potential or {}, 1), effects=effects)


def oscillator(*more):
    """Hardening, softening and drag."""
    drag = make_effect("quadratic_damping", {"coefficient": 0.002})
    return one_mode({"111": 0.05, "1111": 0.3}, (drag, *more))


def with_slider():
    """The same with a slider that slips, so weak that the response hardly changes."""
    settings = {"stiffness": 0.005, "slip_displacement": 0.1}
    return oscillator(make_effect("jenkins_slider", settings))


def numbers(model):
    """What the derivatives are taken by, each relative to its own value."""
    return (
        *(model.potential.coefficient, model.modes.natural_frequency),
        *(model.modes.damping_ratio, model.modes.mode_shape, model.modes.participation),
    )


def changed(model, shifts):
    """The model with every number of `numbers` times 1 + its shift."""
    parts, begin = [], 0
    for values in numbers(model):
        shift = shifts[begin : begin + values.size].reshape(values.shape)
        parts.append(values * (1 + shift))
        begin += values.size
    return eqx.tree_at(numbers, model, tuple(parts))


def by_differences(function, at, step):
    """Jacobian by central differences of fourth order."""
    columns = []
    for unit in np.eye(len(at)):
        values = [np.asarray(function(jnp.asarray(at + k * step * unit))) for k in (-2, -1, 1, 2)]
        columns.append((values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * step))
    return np.stack(columns, axis=-1)


@pytest.fixture(scope="module")
def curve():
    return forced_response(oscillator(), [FORCE], 1.5, 3.5, harmonic_order=5, stability=False)[0]


def start_and_value(curve, condition):
    """A start a little off, and the value that the condition takes, if any."""
    k = curve.at_events(condition)[0] if condition not in CONDITIONS[:2] else 20
    coefficients, frequency = curve.point(k)
    value = None
    if condition == "frequency":
        value = 1.001 * frequency
    elif condition == "velocity":
        value = 1.01 * np.abs(curve.velocity[k, 1, 0])
    return (1.001 * coefficients, 1.0001 * frequency), value


# The others by all numbers on request: by some of them they stand in `simulate/test_gradients.py`,
# and peaks below.
@pytest.mark.parametrize(
    "condition",
    [
        pytest.param(c, marks=() if c in ("velocity", "fold") else pytest.mark.long)
        for c in CONDITIONS
    ],
)
def test_conditions_are_met_and_differentiated(condition, curve):
    model = with_slider() if condition == "fold" else oscillator()
    start, value = start_and_value(curve, condition)
    n = sum(values.size for values in numbers(model))

    @jax.jit
    def motion(shifts):
        """All numbers of the model, the force and the value are shifted."""
        given = None if value is None else value * (1 + shifts[n + 1])
        return periodic_motion(
            changed(model, shifts[:n]),
            FORCE * (1 + shifts[n]),
            start,
            condition=condition,
            value=given,
        )

    def quantities(shifts):
        found = motion(shifts)
        return jnp.stack([found.frequency, found.amplitude, found.coefficients[2, 0]])

    @jax.jit
    def slopes(shifts):
        return jax.jacfwd(quantities)(shifts), jax.jacrev(quantities)(shifts)

    zero = np.zeros(n + 2)
    found, (forward, reverse) = motion(zero), slopes(zero)
    assert bool(found.converged)
    if condition == "frequency":
        assert float(found.frequency) == pytest.approx(value, rel=1e-14)
    elif condition == "velocity":
        assert float(found.amplitude) == pytest.approx(value, rel=1e-12)
    else:
        (k,) = curve.at_events(condition)[:1]
        # The curve's own event: located with tangents off by 1e-6; the slider moves it.
        tolerance = 1e-2 if condition == "fold" else 1e-6
        assert float(found.frequency) == pytest.approx(curve.frequency[k], rel=tolerance)
    if condition == "phase_resonance":
        assert np.angle(found.velocity[1, 0]) == pytest.approx(0.0, abs=1e-12)
    forward, reverse = np.asarray(forward), np.asarray(reverse)
    scale = np.abs(forward).max(axis=1, keepdims=True)
    np.testing.assert_allclose(reverse / scale, forward / scale, rtol=0, atol=1e-11)
    slope = by_differences(quantities, zero, 1e-4)
    # Fourth order in 1e-4, and Newton's rounding 1e-13 over it. The force of the slider is
    # piecewise linear in the samples: where one of 256 changes side its slope jumps by 1e-6.
    np.testing.assert_allclose(forward / scale, slope / scale, rtol=0, atol=1e-6)
    assert np.linalg.matrix_rank(forward) >= (2 if value is not None else 1)


@pytest.mark.long
def test_gradients_of_the_flat_beam(flat_curve):
    """Peak amplitude and both folds by all 55 coefficients, 4 frequencies and 4 dampings."""
    model, curve = flat_curve
    events = [("peak", 0), ("fold", 0), ("fold", 1)]
    starts = [curve.point(curve.at_events(kind)[k]) for kind, k in events]

    def quantities(shifts):
        pad = jnp.zeros(sum(v.size for v in numbers(model)) - 63)
        now = changed(model, jnp.concatenate([shifts, pad]))
        found = [
            periodic_motion(now, curve.force, start, condition=kind)
            for start, (kind, _) in zip(starts, events, strict=True)
        ]
        return jnp.stack([found[0].amplitude, found[1].frequency, found[2].frequency])

    compiled = jax.jit(quantities)
    gradient = np.asarray(jax.jit(jax.jacrev(quantities))(jnp.zeros(63)))
    slope = by_differences(compiled, np.zeros(63), 3e-3)
    fraction = np.abs(gradient) / np.abs(gradient).max(axis=1, keepdims=True)
    # Fourth order in 3e-3 for logarithmic derivatives of order one: 1e-7; Newton's rounding
    # 1e-13/3e-3 is 3e-5 of the smallest that are compared relative to themselves.
    seen = fraction > 1e-6
    assert np.sum(seen, axis=1).tolist() == [20, 22, 11]
    assert np.max(np.abs(slope / gradient - 1)[seen]) < 1e-6
    largest = np.abs(gradient).max(axis=1, keepdims=True)
    np.testing.assert_allclose(slope / largest, gradient / largest, rtol=0, atol=1e-9)


def test_the_peak_of_a_sliding_structure_is_its_largest_response():
    settings = {"stiffness": 0.8, "slip_displacement": 0.3}
    model = oscillator(make_effect("jenkins_slider", settings))
    curve = forced_response(model, [FORCE], 1.5, 3.5, harmonic_order=5, stability=False)[0]
    (k,) = curve.at_events("peak")
    coefficients, frequency = curve.point(k)
    largest = int(np.argmax(np.abs(curve.velocity[:, 1, 0])))
    start = curve.point(largest - 1)
    found = periodic_motion(model, FORCE, start, condition="peak")
    assert bool(found.converged)
    step = 2e-3
    near = [
        float(
            periodic_motion(
                model, FORCE, (coefficients, frequency), value=frequency * (1 + k * step)
            ).amplitude
        )
        for k in (-1, 0, 1)
    ]
    # The parabola through three frequencies around it; its error is of third order in their step.
    slope, second = (near[2] - near[0]) / 2, near[2] - 2 * near[1] + near[0]
    vertex = frequency * (1 - step * slope / second)
    assert float(found.frequency) == pytest.approx(vertex, rel=step**2 * 10)
    assert float(found.amplitude) == pytest.approx(
        near[1] - slope**2 / second / 2, rel=step**3 * 10
    )


# ----------------------------------------------------------------------------------- exact ones


def linear(parameters):
    """|V₁| of a linear mode at resonance, and its resonance frequency."""
    omega, ratio, force = parameters
    modes = linear_modes([2.0], [0.02], [[1.0]], [1.5])
    modes = eqx.tree_at(
        lambda m: (m.natural_frequency, m.damping_ratio), modes, (omega[None], ratio[None])
    )
    start = jnp.zeros((3, 1)).at[2, 0].set(1.0), 2.0
    found = periodic_motion(structure(modes), force, start, condition="phase_resonance")
    return jnp.stack([found.amplitude, found.frequency])


def test_first_and_second_derivatives_of_a_linear_resonance_are_exact():
    at = jnp.array([2.1, 0.03, 0.4])
    omega, ratio, force = np.asarray(at)
    peak = force * 1.5 / (2 * ratio * omega)
    np.testing.assert_allclose(linear(at), [peak, omega], rtol=1e-12)
    gradient = jax.jit(jax.jacrev(linear))(at)
    wanted = peak * np.array([-1 / omega, -1 / ratio, 1 / force])
    np.testing.assert_allclose(gradient[0], wanted, rtol=1e-10)
    np.testing.assert_allclose(gradient[1], [1, 0, 0], rtol=0, atol=1e-10)
    inverse = 1 / np.asarray(at) * [-1, -1, 1]
    wanted = peak * (np.outer(inverse, inverse) + np.diag([1, 1, 0] * inverse**2))
    wanted[2, 2] = 0.0
    hessian = jax.jit(jax.jacfwd(jax.jacrev(linear)))(at)
    np.testing.assert_allclose(hessian[0], wanted, rtol=0, atol=1e-8 * np.abs(wanted).max())
    np.testing.assert_allclose(hessian[1], 0.0, atol=1e-8)


@pytest.mark.long
def test_second_derivatives_of_a_fold_against_differences(curve):
    start, _ = start_and_value(curve, "fold")

    @jax.jit
    def frequency(at):
        model = eqx.tree_at(
            lambda m: m.potential.coefficient, one_mode({"111": 1.0, "1111": 1.0}), at[:2]
        )
        return periodic_motion(model, at[2], start, condition="fold").frequency

    at = jnp.array([0.05, 0.3, FORCE])
    gradient, hessian = jax.jit(jax.grad(frequency)), jax.jit(jax.hessian(frequency))
    assert np.isfinite(float(frequency(at)))
    slope = by_differences(gradient, np.asarray(at), 1e-4)
    exact = np.asarray(hessian(at))
    np.testing.assert_allclose(exact, slope, rtol=0, atol=1e-7 * np.abs(exact).max())
    np.testing.assert_allclose(exact, exact.T, rtol=0, atol=1e-9 * np.abs(exact).max())


# ------------------------------------------------------------------------- many, and given heights


def test_vmap_agrees_with_one_by_one_and_traces_once(curve):
    model = oscillator()
    start, _ = start_and_value(curve, "peak")
    traces = []

    @jax.jit
    def peaks(forces):
        traces.append(1)

        def one(force):
            return periodic_motion(model, force, start, condition="peak").amplitude

        return jax.vmap(jax.value_and_grad(one))(forces)

    forces = FORCE * np.array([0.9, 1.0, 1.02])
    amplitude, slope = peaks(forces)
    again, slope_again = peaks(forces[[1, 1, 1]])  # other numbers, the same program
    assert len(traces) == 1
    for k in range(3):
        assert float(again[k]) == pytest.approx(float(amplitude[1]), rel=1e-11)
        assert float(slope_again[k]) == pytest.approx(float(slope[1]), rel=1e-9)
    for k, force in enumerate(forces):  # without jit, one by one
        alone = periodic_motion(model, float(force), start, condition="peak")
        assert float(amplitude[k]) == pytest.approx(float(alone.amplitude), rel=1e-11)
    chord = (amplitude[2] - amplitude[0]) / (forces[2] - forces[0])
    assert min(slope) < chord < max(slope)


# --------------------------------------------------------------------------------- failing well


def test_a_motion_that_is_not_there_is_nan():
    model = oscillator()
    far = (np.full((11, 1), 0.3), 2.0)
    # No motion is that fast under so small a force: |V₁| ≤ P/(2ζω) = 2.3 m/s.
    found = periodic_motion(model, FORCE, far, condition="velocity", value=30.0)
    assert not bool(found.converged)
    for value in (found.frequency, found.coefficients, found.velocity, found.amplitude):
        assert np.all(np.isnan(value))
    slope = jax.grad(
        lambda f: periodic_motion(model, f, far, condition="velocity", value=30.0).frequency
    )(FORCE)
    assert np.isnan(slope)  # a zero would make an optimiser stop
    broken = eqx.tree_at(lambda m: m.potential.coefficient, model, jnp.array([jnp.nan, 1.0]))
    found = periodic_motion(broken, FORCE, far, condition="velocity", value=0.1)
    assert not bool(found.converged)
    assert np.isnan(found.frequency)
    near = periodic_motion(model, FORCE, far, condition="velocity", value=0.1)
    assert bool(near.converged)


def test_wrong_conditions_are_refused():
    model, start = one_mode(), (np.zeros((3, 1)), 2.0)
    with pytest.raises(ValueError, match="`condition` must be one of"):
        periodic_motion(model, 1.0, start, condition="bottom")
    with pytest.raises(ValueError, match=r'`condition="fold"` takes no `value`'):
        periodic_motion(model, 1.0, start, condition="fold", value=2.0)
    with pytest.raises(ValueError, match=r'`condition="velocity"` needs a `value`'):
        periodic_motion(model, 1.0, start, condition="velocity")
