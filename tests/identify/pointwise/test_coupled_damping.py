"""Damping that couples modes and forces with phases, against matrices solved by NumPy alone."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

import snrmjax as sj
from snrmjax.identify.calibrate.inverse_force import inverse_force
from snrmjax.identify.pointwise.snrm import linear_mode, sensed_mode, snrm_velocity
from snrmjax.model.modes import linear_response

MASS = np.diag([1.0, 1.5, 0.8])
STIFFNESS = np.array([[300.0, -120.0, 0.0], [-120.0, 330.0, -90.0], [0.0, -90.0, 240.0]])
DAMPING = np.array([[0.5, -0.35, 0.1], [-0.35, 0.7, 0.2], [0.1, 0.2, 0.4]])
NONE = np.diag([0.2, 0.3, 0.16])  # in proportion to the masses: couples nothing
POINTS = ("a", "b", "c")
# The linear solutions are exact to rounding, which conditioning by 1/2ζ of some 1e2 magnifies.
EXACT = 1e-10


class Case(NamedTuple):
    """A damping matrix, newtons at the points per newton, and the sensors."""

    damping: np.ndarray
    force: dict
    sensors: tuple[str, ...]
    unbalance: float | None = None


CASES = {
    "coupled": Case(DAMPING, {"a": 1.0}, ("a",)),
    "phases": Case(NONE, {"a": 1.0, "b": 0.9 * np.exp(1.1j)}, ("a",)),
    "both": Case(DAMPING, {"a": 1.0, "c": 0.8 * np.exp(-2.0j)}, ("b",)),
    "behind the force": Case(DAMPING, {"a": -1.0, "b": 0.5j}, ("a", "b", "c")),
    "an unbalance": Case(DAMPING, {"a": 1.0, "b": 1.0j}, ("a", "c"), unbalance=0.02),
}


def structure_of(case: Case, **more) -> sj.model.Structure:
    return sj.model.from_matrices(
        *(MASS, case.damping, STIFFNESS, POINTS),
        force=case.force,
        sensors=case.sensors,
        unbalance=case.unbalance,
        **more,
    )


def pole_of(damping: np.ndarray) -> complex:
    """The eigenvalue of the first mode, of q̈ = −M⁻¹(K q + C q̇)."""
    inverse = np.linalg.inv(MASS)
    state = np.block([[np.zeros((3, 3)), np.eye(3)], [-inverse @ STIFFNESS, -inverse @ damping]])
    values = np.linalg.eigvals(state)
    return min(values[values.imag > 0], key=abs)


def solved(case: Case, omega: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Velocities (state, sensor) by direct solution at every frequency."""
    load = np.array([case.force.get(point, 0.0) for point in POINTS], dtype=complex)
    dynamic = (
        STIFFNESS - omega[:, None, None] ** 2 * MASS + 1j * omega[:, None, None] * case.damping
    )
    moved = np.linalg.solve(dynamic, np.broadcast_to(load, (len(omega), 3))[..., None])[..., 0]
    at = [POINTS.index(name) for name in case.sensors]
    return 1j * omega[:, None] * moved[:, at] * force[:, None]


def states_of(case: Case) -> sj.measure.SteadyStates:
    """Three levels about the first resonance, the frequency of which is among them."""
    pole = pole_of(case.damping)
    around = 1 + np.linspace(-1.5, 1.5, 15) * -pole.real / abs(pole)
    omega = np.tile(abs(pole) * around, 3)
    level = np.repeat([1, 2, 3], 15)
    force = np.array([0.5, 1.0, 2.0])[level - 1]
    if case.unbalance is not None:
        force = case.unbalance * omega**2
    return sj.measure.steady_states(
        level, omega, force, solved(case, omega, force), sensors=case.sensors
    )


@pytest.mark.parametrize("name", CASES)
def test_linear_modes_have_the_eigenvalue_and_the_whole_response(name):
    case = CASES[name]
    modes, pole = structure_of(case).modes, pole_of(case.damping)
    natural, ratio = linear_mode(modes)
    assert float(natural) == pytest.approx(abs(pole), rel=EXACT)
    assert float(ratio) == pytest.approx(-pole.real / abs(pole), rel=EXACT)
    omega = np.linspace(0.6, 1.6, 21) * abs(pole)
    velocity = snrm_velocity(modes, natural, ratio, jnp.asarray(omega), jnp.ones(21))
    exact = solved(case, omega, np.ones(21))
    np.testing.assert_allclose(velocity, exact, rtol=0, atol=EXACT * np.abs(exact).max())
    whole = linear_response(modes, jnp.asarray(omega), jnp.ones(21))
    np.testing.assert_allclose(whole, exact, rtol=0, atol=EXACT * np.abs(exact).max())


@pytest.mark.parametrize("name", CASES)
def test_every_state_has_the_eigenvalue(name):
    """Of a linear structure at every frequency, the one of resonance included."""
    case, pole = CASES[name], pole_of(CASES[name].damping)
    data = states_of(case)
    points = sj.identify.identify_points(data, structure_of(case).modes)
    assert bool(np.all(np.asarray(points.usable)))
    # κ is taken within 2e-6 of the eigenvalue's frequency where a state lies on it.
    np.testing.assert_allclose(points.natural_frequency, abs(pole), rtol=1e-8)
    np.testing.assert_allclose(points.damping_ratio, -pole.real / abs(pole), rtol=1e-5)
    r = case.sensors.index(points.sensor)
    np.testing.assert_allclose(points.velocity, np.asarray(data.velocity)[:, r], rtol=1e-9)
    assert np.asarray(points.filter_residual).max() < 1e-7


@pytest.mark.parametrize("name", ["both", "behind the force"])
def test_a_joint_fit_has_the_eigenvalue_and_predicts_the_response(name):
    case, pole = CASES[name], pole_of(CASES[name].damping)
    model = structure_of(case)
    fit = sj.fit_jointly(states_of(case), model)
    assert fit.converged
    assert not [note for note in fit.notes if "correlated" in note.kind or "moved" in note.kind]
    motion, curves = fit.motion(), fit.unknowns
    natural = np.sqrt(curves.squared_frequency(motion.amplitude(curves.squared_frequency)))
    np.testing.assert_allclose(natural, abs(pole), rtol=1e-5)
    delta = curves.modal_damping(motion.amplitude(curves.modal_damping))
    np.testing.assert_allclose(delta, -2 * pole.real, rtol=3e-3)  # what priors of levels leave
    (curve,) = sj.identify.fitted_response(fit, 1.5)
    r = fit.data.sensor
    exact = solved(case, curve.frequency, np.full(len(curve.frequency), 1.5))[:, r]
    near = np.abs(exact) > 0.3 * np.abs(exact).max()
    # The damping above, and no more.
    np.testing.assert_allclose(curve.velocity[near], exact[near], rtol=5e-3)
    further = sj.identify.predicted_resonance(fit, 1.5)
    top = solved(case, np.array([abs(pole)]), np.array([1.5]))[0, r]
    assert further.velocity[0] < abs(top) < further.velocity[-1]
    assert further.velocity[2] == pytest.approx(abs(top), rel=0.02)  # the median of 4000 draws


def test_points_without_a_joint_fit_predict_the_response_too():
    case = CASES["both"]
    model, pole = structure_of(case), pole_of(case.damping)
    backbone = sj.identify_backbone(states_of(case), model).backbone
    (curve,) = sj.identify.predict_response(backbone, model.modes, 1.5)
    exact = solved(case, curve.frequency, np.full(len(curve.frequency), 1.5))[:, 0]
    near = np.abs(exact) > 0.3 * np.abs(exact).max()
    np.testing.assert_allclose(curve.velocity[near], exact[near], rtol=5e-3)
    (tip,) = sj.identify.resonances(backbone, model.modes, 1.5)
    assert tip.frequency == pytest.approx(abs(pole), rel=1e-5)


@pytest.mark.parametrize("name", ["phases", "both"])
def test_the_force_of_a_measured_motion_is_the_measured_one(name):
    case = CASES[name]
    result = inverse_force(structure_of(case), states_of(case), harmonic_order=1)
    np.testing.assert_allclose(result.force, np.repeat([0.5, 1.0, 2.0], 15), rtol=1e-7)


def test_a_describing_function_at_the_sensor_is_zero():
    """Of a linear structure, so that its modes are the eigenvalue's."""
    case, pole = CASES["both"], pole_of(CASES["both"].damping)
    result = sj.methods.arslan_ozguven(states_of(case), structure_of(case).modes)
    table = result.to_pandas()
    np.testing.assert_allclose(table["frequency_hz"], abs(pole) / (2 * np.pi), rtol=1e-9)
    np.testing.assert_allclose(table["damping_ratio"], -pole.real / abs(pole), rtol=1e-7)


def test_advice_of_a_force_against_the_sensor_is_near_resonance():
    """A phase counts from that in which the mode is driven, at 180° here."""
    case, pole = CASES["behind the force"], pole_of(CASES["behind the force"].damping)
    fit = sj.fit_jointly(states_of(case), structure_of(case))
    advised = sj.identify.next_measurements(fit, 2)
    assert len(advised) == 2
    for one in advised:  # 70° are 2.7 half bandwidths
        assert abs(one.frequency / abs(pole) - 1) < 3 * -pole.real / abs(pole)


def test_a_check_has_nothing_against_such_states():
    case = CASES["both"]
    assert not sj.doctor.check_test(states_of(case), structure_of(case)).findings


def test_what_a_nonlinear_spring_adds_is_right_to_first_order_in_the_coupling():
    """A cubic spring k q³ on the mode shifts ω̃² by 3ka²/4 there, whatever couples it."""
    case = CASES["coupled"]
    linear = structure_of(case).modes
    omega = np.array([1.1, 1.2]) * abs(pole_of(case.damping))
    added = 0.3 * omega**2
    # The elimination as the module states it, with N = added, by blocks of full matrices.
    natural, shape = np.asarray(linear.natural_frequency), np.asarray(linear.mode_shape)
    own = np.diag(2 * np.asarray(linear.damping_ratio) * natural)
    modal_damping = own + np.asarray(linear.damping_coupling)
    for w, n in zip(omega, added, strict=True):
        dynamic = np.diag(natural**2 - w**2) + 1j * w * modal_damping
        dynamic[0, 0] += n
        modal = np.linalg.solve(dynamic, np.asarray(linear.participation))
        data = sj.measure.steady_states(
            [1], [w], [1.0], [1j * w * (shape @ modal)[0]], sensors=("a",)
        )
        point = sj.identify.identify_points(data, linear)
        sensed = sensed_mode(linear, jnp.array([w]))
        assert abs(complex(sensed.seen[0, 0]) - 1) > 1e-4  # there is a coupling to leave out
        expected = float(linear_mode(linear)[0]) ** 2 + n
        assert float(point.natural_frequency[0]) ** 2 == pytest.approx(expected, rel=1e-3)
