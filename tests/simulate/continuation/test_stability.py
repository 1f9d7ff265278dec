"""Floquet multipliers against exact ones, Mathieu's equation and integrated period maps."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import mathieu_a, mathieu_b

from snrmjax.model.attachment import between
from snrmjax.model.builders.matrices import chain, from_matrices
from snrmjax.model.effects import make_effect
from snrmjax.model.modes import linear_modes
from snrmjax.model.potential import polynomial_potential
from snrmjax.model.structures import structure
from snrmjax.simulate.continuation.stability import (
    Stability,
    floquet_multipliers,
    stability_of,
)
from snrmjax.simulate.solutions.forced_response import forced_response, solve_at_frequency


def one_mode(omega, ratio=0.0, potential=None, effects=()):
    modes = linear_modes([omega], [ratio], [[1.0]], [1.0])
    return structure(modes, polynomial_potential(potential or {}, 1), effects=effects)


def cosine(amplitude, order=1):
    """Coefficients of q = A cos τ, one point for every amplitude."""
    x = np.zeros((len(amplitude), 2 * order + 1, 1))
    x[:, 1, 0] = amplitude
    return jnp.asarray(x)


def test_linear_modes_have_their_decay_as_multipliers(distance_between):
    w, zeta = np.array([2.0, 5.0]), np.array([0.03, 0.2])
    model = structure(linear_modes(w, zeta, [[1.0, 1.0]], [1.0, 1.0]))
    frequency = np.array([0.2, 1.7, 3.0, 40.0])
    root = -zeta * w + 1j * w * np.sqrt(1 - zeta**2)
    found = floquet_multipliers(model, jnp.zeros((4, 3, 2)), frequency)
    exact = np.exp(np.concatenate([root, root.conj()]) * (2 * np.pi / frequency)[:, None])
    for one, other in zip(found, exact, strict=True):
        # Constant matrices: each step is exact, and rounding of 25 cycles of the faster mode is
        # left.
        assert distance_between(one, other) < 1e-12
    assert np.all(stability_of(found) == Stability.STABLE)


def test_undamped_growth_and_decay_are_distinguished():
    frequency, at_rest = np.array([2.0]), jnp.zeros((1, 3, 1))
    for slope, stable in ((1e-4, True), (-1e-4, False)):
        # f = slope·q̇ as the linear part of a van der Pol effect is none: use the motion itself.
        effect = make_effect("van_der_pol_damping", {"coefficient": slope})
        model = one_mode(2.0, effects=(effect,))
        found = floquet_multipliers(model, cosine([1.0]), frequency)
        assert stability_of(found)[0] == stable
    saddle = floquet_multipliers(one_mode(1.0, potential={"11": -1.0}), at_rest, frequency)
    # q̈ = q: multipliers e^{±T}, T = π.
    np.testing.assert_allclose(sorted(np.abs(saddle[0])), np.exp([-np.pi, np.pi]), rtol=1e-12)
    assert stability_of(saddle)[0] == Stability.UNSTABLE


def test_points_that_are_not_finite_have_no_multipliers():
    found = floquet_multipliers(
        one_mode(2.0, 0.1), cosine([1.0, np.nan, 1.0]), np.array([1.0, 1.0, np.inf])
    )
    assert np.isfinite(found).all(axis=1).tolist() == [True, False, False]
    assert stability_of(found).tolist() == [
        *(Stability.STABLE, Stability.NOT_COMPUTED, Stability.NOT_COMPUTED)
    ]
    assert floquet_multipliers(one_mode(2.0), cosine([]), np.zeros(0)).shape == (0, 2)


def test_mathieu_equation_changes_stability_at_its_characteristic_values():
    # q = A cos τ in ω²q + q³·4c gives δ'' + (ω² + 6cA²(1 + cos 2τ))/Ω² δ = 0: Mathieu's equation
    # y'' + (a − 2p cos 2τ) y = 0 with a = (ω² + 6cA²)/Ω², p = −3cA²/Ω².
    frequency, quartic = 1.3, 0.25
    parameter = np.array([0.1, 0.4, 0.9])
    amplitude = frequency * np.sqrt(parameter / (3 * quartic))
    for order in (1, 2):
        # Even in p up to an exchange of a and b for odd orders.
        for characteristic in (mathieu_a(order, parameter), mathieu_b(order, parameter)):
            for k, value in enumerate(characteristic):
                squared = (value - 2 * parameter[k]) * frequency**2
                if squared <= 0:
                    continue
                model = one_mode(np.sqrt(squared), potential={"1111": quartic})
                found = floquet_multipliers(
                    model, cosine(amplitude[k : k + 1]), np.array([frequency])
                )[0]
                # A solution of period π or 2π: both multipliers are 1, and their trace is 2 with
                # the square of their common error (a double eigenvalue splits by a square root).
                assert complex(found.sum()) == pytest.approx(2.0, abs=1e-6)
                assert complex(found.prod()) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(
    ("shift", "stable"), [(-0.05, True), (0.5, False), (1.05, True)], ids=["below", "in", "above"]
)
def test_mathieu_tongue_of_first_order_is_unstable_inside(shift, stable):
    frequency, quartic, parameter = 1.3, 0.25, 0.2
    low, high = sorted([mathieu_a(1, parameter), mathieu_b(1, parameter)])
    squared = (low + shift * (high - low) - 2 * parameter) * frequency**2
    # A damping of 1e-4 makes neutral motions decay without closing the tongue.
    model = one_mode(np.sqrt(squared), ratio=1e-4, potential={"1111": quartic})
    amplitude = frequency * np.sqrt(parameter / (3 * quartic))
    found = floquet_multipliers(model, cosine([amplitude]), np.array([frequency]))
    assert stability_of(found)[0] == stable


def test_product_of_multipliers_is_the_mean_damping():
    # Liouville: det = exp(−∮ 2ζω + ∂f/∂q̇ dt), whatever the stiffness.
    w, zeta, frequency, amplitude = 2.0, 0.05, 1.7, 0.8
    cases = {
        "van_der_pol_damping": lambda c: c * amplitude**2 / 2,
        "cubic_damping": lambda c: 3 * c * (frequency * amplitude) ** 2 / 2,
        "quadratic_damping": lambda c: 2 * c * frequency * amplitude * 2 / np.pi,
    }
    for kind, mean in cases.items():
        # With all three, two of them at strength zero: one structure, compiled once.
        effects = [make_effect(k, {"coefficient": 0.3 if k == kind else 0.0}) for k in cases]
        model = one_mode(w, zeta, {"1111": 0.2}, tuple(effects))
        found = floquet_multipliers(model, cosine([amplitude]), np.array([frequency]))
        wanted = np.exp(-(2 * zeta * w + mean(0.3)) * 2 * np.pi / frequency)
        # Fourth order in 2π/256, and second order at the corners of |q̇|: (2π/256)²/6.
        tolerance = 1e-4 if kind == "quadratic_damping" else 1e-6
        assert complex(found[0].prod()) == pytest.approx(wanted, rel=tolerance), kind


@pytest.mark.parametrize(
    ("effect", "power", "steps"),
    [((), 4, (8, 16, 32)), (("cubic_damping",), 6, (8, 16))],
    ids=["kicked", "magnus"],
)
def test_multipliers_converge_with_their_power_of_the_step(effect, power, steps, distance_between):
    frequency, amplitude = np.array([0.03]), cosine([1.2])
    effects = tuple(make_effect(kind, {"coefficient": 0.01}) for kind in effect)
    model = one_mode(1.3, 0.01, {"1111": 0.25}, effects)
    exact = floquet_multipliers(model, amplitude, frequency, steps_per_cycle=100)[0]
    errors = [
        distance_between(
            floquet_multipliers(model, amplitude, frequency, steps_per_cycle=n)[0], exact
        )
        for n in steps
    ]
    # Steps come in segments of 32: their numbers double to 10 %.
    for first, second in itertools.pairwise(errors):
        assert 0.8 * power < np.log2(first / second) < 1.2 * power


def test_both_methods_give_the_same_multipliers(distance_between):
    """A force of strength zero selects the general method, which has another order."""
    potential = {"1111": -0.6, "112": 0.2, "1122": 10.0, "2222": 3.0}
    modes = linear_modes([2.0, 9.0], [0.02, 0.01], [[1.0, 1.0]], [1.0, 0.3])
    nothing = make_effect("cubic_damping", {"coefficient": 0.0})
    x = np.zeros((3, 7, 2))
    x[:, 0] = [-0.05, 0.02]
    x[:, 1] = np.outer([0.2, 0.6, 1.6], [1.0, 0.1])
    x[:, 4] = 0.05
    frequency = np.array([1.6, 2.1, 2.4])
    found, other = (
        floquet_multipliers(
            structure(modes, polynomial_potential(potential, 2), effects=e), x, frequency
        )
        for e in ((), (nothing,))
    )
    assert np.abs(found).max() > 1.05  # one of them is unstable
    for one, two in zip(found, other, strict=True):
        assert distance_between(one, two) < 1e-6 * max(np.abs(one).max(), 1.0)


@pytest.mark.parametrize("coupled", [True, False])
def test_many_modes_have_the_multipliers_of_the_general_method(coupled, distance_between):
    """Eight masses: matrices are multiplied whole, not term by term."""
    dampers = [0.05, *[0.0] * 7, 0.02] if coupled else 0.0
    matrices = chain([1.0] * 8, [1.0] * 9, dampers)
    spring = make_effect("cubic_stiffness", {"coefficient": 0.3}, at=between("x4", "x3"))
    nothing = make_effect("cubic_damping", {"coefficient": 0.0}, at="x1")
    motion = np.zeros((2, 3, 8))
    motion[:, 1] = np.outer([1.0, 2.0], np.sin(np.pi * np.arange(1, 9) / 9))
    found = []
    for effects in ((spring,), (spring, nothing)):
        model = from_matrices(*matrices, force="x1", effects=effects)
        modal = motion @ np.linalg.inv(np.asarray(model.modes.mode_shape)).T
        found.append(floquet_multipliers(model, modal, np.array([0.8, 0.7])))
    assert (model.modes.damping_coupling is not None) == coupled
    for one, other in zip(*found, strict=True):
        assert distance_between(one, other) < 1e-6


@pytest.mark.parametrize("heaviest", [0.2, 30.0], ids=["light", "overdamped"])
def test_multipliers_with_coupled_damping_are_those_of_the_integrated_equations(
    heaviest, distance_between
):
    """Three masses with cubic springs; a damper that lets all modes oscillate, or overdamps one."""
    mass, damping, stiffness, names = chain(
        [1.0, 2.0, 0.5], [1.0, 2.0, 1.0, 0.0], [0.02, 0.0, heaviest, 0.0]
    )
    springs = [
        make_effect("cubic_stiffness", {"coefficient": 0.8}, at="x1"),
        make_effect("cubic_stiffness", {"coefficient": 0.5}, at=between("x3", "x2")),
    ]
    model = from_matrices(mass, damping, stiffness, names, force="x1", effects=springs)
    assert model.modes.damping_coupling is not None
    x = np.zeros((5, 3))  # of the points: mean, first and third harmonic
    x[0], x[1], x[2], x[3] = [0.1, 0.0, 0.2], [1.5, 0.4, -0.3], [0.2, -0.5, 0.1], [0.1, 0.2, 0.0]
    omega, shapes = 0.9, np.asarray(model.modes.mode_shape)
    modal = np.linalg.solve(shapes, x.T).T
    found = floquet_multipliers(model, modal[None], np.array([omega]))[0]

    def rate(t, y):
        waves = [1.0, *(f(k * omega * t) for k in (1, 2) for f in (np.cos, np.sin))]
        one, _, three = waves @ x
        apart = three - (waves @ x)[1]
        relative = np.array([0.0, -1.0, 1.0])
        tangent = stiffness + 2.4 * one**2 * np.diag([1.0, 0.0, 0.0])
        tangent = tangent + 1.5 * apart**2 * np.outer(relative, relative)
        q, v = np.split(y.reshape(6, 6), 2)
        return np.concatenate([v, np.linalg.solve(mass, -tangent @ q - damping @ v)]).ravel()

    period = (0.0, 2 * np.pi / omega)
    ways = {"method": "Radau" if heaviest > 1 else "DOP853", "rtol": 1e-10, "atol": 1e-12}
    map_ = solve_ivp(rate, period, np.eye(6).ravel(), **ways).y[:, -1].reshape(6, 6)
    assert distance_between(found, np.linalg.eigvals(map_)) < 1e-6


# ------------------------------------------------------------------- against maps of the motion


@pytest.mark.parametrize("which", [pytest.param("flat", marks=pytest.mark.long), "curved"])
def test_multipliers_along_a_response_are_those_of_the_integrated_map(
    which, request, time_domain, state_of, distance_between
):
    if which == "flat":
        model, curve = request.getfixturevalue("flat_curve")
    else:
        model, (_, curve) = request.getfixturevalue("curved_curves")
    kinds = [np.flatnonzero(curve.is_stable), np.flatnonzero(curve.is_unstable)]
    assert all(len(kind) >= 16 for kind in kinds)
    for k in np.concatenate([kind[:: len(kind) // 5] for kind in kinds]):
        if curve.event[k] in ("fold", "period_doubling"):  # there one is on the circle
            continue
        truth = time_domain(model, curve.force, curve.frequency[k]).multipliers(
            state_of(curve.coefficients[k], curve.frequency[k])
        )
        # With nine harmonics 7e-5 (flat) and 3e-3 (curved) of the motion are truncated.
        tolerance = 1e-3 if which == "flat" else 2e-2
        distance = distance_between(curve.multipliers[k], truth)
        assert distance < tolerance * max(np.abs(truth).max(), 1.0), k
        assert curve.is_stable[k] == (np.abs(truth).max() < 1), k


def test_light_damping_is_not_lost(time_domain, state_of, distance_between):
    """ζ = 1e-5: multipliers 6e-5 inside the unit circle, over 14 cycles of the second mode."""
    w = np.array([2.0, 23.0])
    modes = linear_modes(w, [1e-5, 1e-5], [[1.0, 1.0]], [1.0, 0.3])
    model = structure(modes, polynomial_potential({"1111": 0.05, "1122": 10.0}, 2))
    (curve,) = forced_response(model, [0.01], 1.6, 1.95, harmonic_order=5)
    period = 2 * np.pi / curve.frequency
    # Liouville: their product is e^{−ΣcT}, c = 2ζω, whatever the stiffness.
    product = np.prod(curve.multipliers, axis=1)
    np.testing.assert_allclose(product, np.exp(-2e-5 * w.sum() * period), rtol=1e-11)
    # Both pairs are complex here, the faster one within 1e-4 of the circle.
    radius = np.abs(curve.multipliers)
    assert np.all(curve.is_stable)
    assert np.all(1 - radius > 1e-5)
    k = len(curve.frequency) // 2
    truth = time_domain(model, 0.01, curve.frequency[k]).multipliers(
        state_of(curve.coefficients[k], curve.frequency[k])
    )
    assert distance_between(curve.multipliers[k], truth) < 1e-6  # the map's slope by differences


# ------------------------------------------------------------------------------------- sliders

W, ZETA, STUCK, SLIP, LOAD, CUBIC = 2.0, 0.02, 1.5, 0.2, 0.5, 0.4


def with_slider(cubic):
    effect = make_effect("jenkins_slider", {"stiffness": STUCK, "slip_displacement": SLIP})
    return one_mode(W, ZETA, {"1111": cubic / 4} if cubic else {}, (effect,))


def marched(states, omega, cubic):
    """(q, q̇, z) a period later: integrated from each slip or stop to the next one."""

    def slope(t, y, direction):
        q, v, z = y
        force = LOAD * np.cos(omega * t) - 2 * ZETA * W * v - W**2 * q - cubic * q**3 + STUCK * z
        return [v, force, v if direction else 0.0]

    def event(function, direction):
        function.terminal, function.direction = True, direction
        return function

    slips = [
        event(lambda t, y, d: y[0] - y[2] - SLIP, 1),
        event(lambda t, y, d: y[0] - y[2] + SLIP, -1),
    ]
    stops = [event(lambda t, y, d: y[1], 0)]
    time, y, direction = 0.0, np.array(states), 0
    if abs(y[0] - y[2]) >= SLIP:  # slipping from the start
        direction = 1 if y[0] > y[2] else -1
        y[2] = y[0] - direction * SLIP
        direction *= direction * y[1] > 0
    end = 2 * np.pi / omega
    while time < end:
        events = stops if direction else slips
        solved = solve_ivp(
            *(slope, (time, end), y),
            method="DOP853",
            rtol=1e-12,
            atol=1e-13,
            events=events,
            args=(direction,),
        )
        time, y = solved.t[-1], solved.y[:, -1]
        if solved.status == 1:
            direction = 0 if direction else (1 if solved.t_events[0].size else -1)
    return y


@pytest.mark.parametrize(("omega", "cubic"), [(1.5, CUBIC), (1.75, CUBIC), (2.1, CUBIC), (2.0, 0)])
def test_multipliers_with_a_slider_are_those_of_its_exact_march(
    omega, cubic, state_of, distance_between
):
    model = with_slider(cubic)
    guess = jnp.zeros((1, 43, 1)).at[0, 1, 0].set(0.3)
    found, converged = solve_at_frequency(model, jnp.array([LOAD]), jnp.array([omega]), guess)
    assert bool(converged[0])
    start = state_of(np.asarray(found)[0], omega)
    y = np.append(start, start[0] - SLIP)  # a guess: slipping with rising motion
    for _ in range(6):  # shooting, with the map's slope by differences
        end = marched(y, omega, cubic)
        steps = 1e-6 * np.diag([1.0, 1.0, 1.0])
        ends = [(marched(y + d, omega, cubic) - marched(y - d, omega, cubic)) / 2e-6 for d in steps]
        tangent = np.array(ends).T
        y = y + np.linalg.solve(np.eye(3) - tangent, end - y)
    np.testing.assert_allclose(marched(y, omega, cubic), y, atol=1e-9)
    assert np.ptp([abs(y[0]), 0.0]) > 0.5 * SLIP
    # The balance's motion is the march's: sampled 336 times a period, with 21 harmonics.
    np.testing.assert_allclose(start, y[:2], rtol=0, atol=2e-3)
    multipliers = np.linalg.eigvals(tangent)
    ours = floquet_multipliers(model, found, np.array([omega]))[0]
    # Slip events are located between 512 samples by lines and parabolas, to (2π/512)²/8 of a
    # phase, across which the stiffness over ω² changes by 0.4, four times a period; the balance's
    # motion with 21 harmonics begins them later by as much again.
    assert distance_between(np.append(ours, 0.0), multipliers) < 2e-4
    # Far from those of a structure whose slider is stuck forever.
    viscous = np.exp(-2 * ZETA * W * 2 * np.pi / omega)
    assert abs(np.prod(ours).real - viscous) > 0.05


def test_intervals_between_events_agree_with_small_steps(distance_between):
    """A damping of strength zero selects the general method; without it the structure is linear."""
    effects = [
        make_effect("jenkins_slider", {"stiffness": 2.0, "slip_displacement": 0.2}, at="x1"),
        make_effect(
            "jenkins_slider", {"stiffness": 1.0, "slip_displacement": 0.1}, at=between("x3", "x2")
        ),
        make_effect("one_sided_stop", {"stiffness": 5.0, "gap": 0.5}, at="x3"),
    ]
    nothing = make_effect("cubic_damping", {"coefficient": 0.0}, at="x1")
    matrices = chain([1.0, 2.0, 0.5], [1.0, 2.0, 1.0, 0.0], [0.02, 0.0, 0.05, 0.0])
    motion = np.zeros((2, 5, 3))  # of the points
    motion[:, 1] = np.outer([0.7, 1.5], [1.0, 0.3, -0.8])
    motion[:, 4] = [0.05, 0.1, 0.02]
    found = []
    for some in (effects, [*effects, nothing]):
        model = from_matrices(*matrices, force="x1", effects=some)
        modal = motion @ np.linalg.inv(np.asarray(model.modes.mode_shape)).T
        ways = {"steps_per_cycle": 12}
        found.append(floquet_multipliers(model, modal, np.array([0.9, 0.7]), **ways))
    assert np.abs(found[0]).max() > 0.3
    for one, other in zip(*found, strict=True):
        assert distance_between(one, other) < 1e-9
