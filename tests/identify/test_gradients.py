"""Derivatives of every function of `sj.identify` that promises them, with failed members too."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.derivatives import check_derivatives, numbers
from truths.shape_preserving import ShapePreservingCurve

import snrmjax as sj
from snrmjax.identify.calibrate.inverse_force import inverse_force
from snrmjax.identify.curves.splines import Spline
from snrmjax.identify.pointwise.backbone import Backbone
from snrmjax.identify.pointwise.inversion import PointStatus

FREQUENCY = np.array([490.0, 497.0, 500.0, 506.0, 512.0, 495.0])
FORCE = np.array([1.0, 1.0, 2.0, 2.0, 1.5, 0.7])
NATURAL = 500.0 - 2.0 * FORCE
DAMPING = 0.01 + 0.002 * FORCE
N = len(FORCE)


def modes(sensors=2):
    return sj.model.linear_modes(
        [310.0, 500.0, 1400.0],
        [0.02, 0.01, 0.015],
        np.array([[1.1, 2.0, -0.8], [0.5, -1.2, 0.9]])[:sensors],
        [0.9, 1.5, 1.1],
        mode_of_interest=1,
        rigid_body=sj.model.RigidBodyModes(np.array([[0.7], [0.5]])[:sensors], [0.6]),
        std=sj.model.LinearModesStd([0.5, 0.0, 2.0], [0.001, 0.0, 0.001]),
    )


MODES = {sensors: modes(sensors) for sensors in (1, 2)}


def moved_modes(linear, relative):
    """Frequencies, dampings and participations, changed by nine numbers, and shapes by three."""
    return dataclasses.replace(
        linear,
        natural_frequency=linear.natural_frequency * (1 + relative[:3]),
        damping_ratio=linear.damping_ratio * (1 + relative[3:6]),
        participation=linear.participation * (1 + relative[6:9]),
        mode_shape=linear.mode_shape * (1 + relative[9:])
        if len(relative) > 9
        else linear.mode_shape,
    )


VELOCITY = np.asarray(sj.identify.snrm_velocity(MODES[2], NATURAL, DAMPING, FREQUENCY, FORCE))

# What befalls state 2, and the status that it then has.
FAILURES = {
    "zero velocity": (PointStatus.NOT_FINITE, {"velocity": 0.0}),
    "velocity not a number": (PointStatus.NOT_FINITE, {"velocity": np.nan}),
    "not measured": (PointStatus.NOT_FINITE, {"measured": False, "velocity": 0.0}),
    "zero force": (PointStatus.ZERO_FORCE, {"force": 0.0}),
    "force not a number": (PointStatus.NOT_FINITE, {"force": np.nan}),
    "no real frequency": (PointStatus.NO_REAL_FREQUENCY, {"velocity": -1e-4j}),
}
# How the noise is stated: not at all, completely, or without the phase and the force.
STATED = {
    "nothing stated": {},
    "all stated": {
        "velocity_std": 0.01 * np.abs(VELOCITY),
        "phase_std": np.full((N, 2), 0.02),
        "force_std": 0.005 * FORCE,
    },
    "velocities stated": {"velocity_std": 0.01 * np.abs(VELOCITY)},
}


def table(failure=None, sensors=2, **stated):
    velocity, force = VELOCITY[:, :sensors].copy(), FORCE.copy()
    measured = np.ones(velocity.shape, dtype=bool)
    changed = {} if failure is None else FAILURES[failure][1]
    own = np.asarray(
        sj.identify.snrm_velocity(MODES[2], NATURAL, DAMPING, FREQUENCY, 1e-30 + FORCE)
    )
    if failure == "no real frequency":
        # The mode itself moves by next to nothing, at right angles: ω̃² = Ω² − AΩ/|V| < 0.
        shape = np.asarray(modes().mode_shape)[:sensors, 1]
        alone = np.asarray(
            sj.identify.nonlinear_mode_velocity(
                3.0 * FORCE[2], NATURAL[2], DAMPING[2], FREQUENCY[2]
            )
        )
        velocity[2] = own[2, :sensors] - alone * shape / 2.0 + changed["velocity"] * shape
    elif "velocity" in changed:
        velocity[2] = changed["velocity"]
    force[2] = changed.get("force", force[2])
    measured[2] = changed.get("measured", True)
    stated = {k: v[:, :sensors] if np.ndim(v) == 2 else v for k, v in stated.items()}
    names = modes(sensors).sensors
    return sj.measure.steady_states(
        np.ones(N), FREQUENCY, force, velocity, measured=measured, sensors=names, **stated
    )


def moved_table(data, relative):
    """Amplitudes, phases, forces and frequencies of all states, changed by 4N numbers."""
    size, phase, force, frequency = relative.reshape(4, N)
    return dataclasses.replace(
        data,
        velocity=data.velocity * ((1 + size) * jnp.exp(1j * phase))[:, None],
        force=data.force * (1 + force),
        frequency=data.frequency * (1 + 1e-2 * frequency),
    )


def told(points):
    """Everything of the points that is a number and no derivative."""
    names = (
        *("velocity", "mode_velocity", "appropriation", "natural_frequency", "damping_ratio"),
        *("amplitude", "backbone_velocity", "natural_frequency_std", "damping_ratio_std"),
        *("alternative_natural_frequency", "alternative_damping_ratio", "relative_std"),
    )
    return numbers(*(getattr(points, name) for name in names))


def by_measurements(relative, data):
    points = sj.identify.identify_points(moved_table(data, relative), MODES[2])
    return told(points)


def by_one_sensor(relative, data):
    return told(sj.identify.identify_points(data, moved_modes(MODES[1], relative)))


def by_two_sensors(relative, data):
    return told(sj.identify.identify_points(data, moved_modes(MODES[2], relative)))


OTHERS = np.setdiff1d(np.arange(N), 2)


def of_the_others(relative, data):
    """What the states but the failed one say, by everything."""
    moved, shared = moved_table(data, relative[:-9]), relative[-9:]
    points = sj.identify.identify_points(moved, moved_modes(MODES[2], shared))
    each = (points.natural_frequency, points.damping_ratio, points.amplitude)
    return numbers(*(value[OTHERS] for value in each))


class TestIdentifyPoints:
    @pytest.mark.long
    @pytest.mark.parametrize("stated", STATED)
    def test_by_what_was_measured(self, stated):
        check_derivatives(by_measurements, 4 * N, table(**STATED[stated]))

    @pytest.mark.long
    @pytest.mark.parametrize("sensors", [1, 2])
    def test_by_the_linear_modes(self, sensors):
        function = by_one_sensor if sensors == 1 else by_two_sensors
        check_derivatives(
            function, 12 if sensors == 1 else 9, table(sensors=sensors, **STATED["all stated"])
        )

    @pytest.mark.parametrize(
        "stated", [pytest.param("nothing stated", marks=pytest.mark.long), "all stated"]
    )
    @pytest.mark.parametrize("failure", FAILURES)
    def test_a_failed_state_leaves_the_others_alone(self, failure, stated):
        data = table(failure, **STATED[stated])
        status = sj.identify.identify_points(data, MODES[2]).status
        assert int(status[2]) == FAILURES[failure][0]
        size, failed = 4 * N + 9, [k * N + 2 for k in range(4)]
        found = check_derivatives(of_the_others, size, data, failed=failed)
        alone = check_derivatives(of_the_others, size, table(**STATED[stated]))
        largest = np.max(np.abs(found), axis=1, keepdims=True)
        np.testing.assert_allclose(found / largest, alone / largest, atol=1e-12)

    @pytest.mark.long
    @pytest.mark.parametrize("failure", FAILURES)
    def test_all_states_of_a_batch_with_a_failed_one(self, failure):
        check_derivatives(by_two_sensors, 9, table(failure, **STATED["all stated"]))


CONSTANT = 3.0 * FORCE
RESIDUAL = VELOCITY[:, 0] - np.asarray(
    sj.identify.nonlinear_mode_velocity(CONSTANT, NATURAL, DAMPING, FREQUENCY)
)


class TestInversion:
    def test_the_function_itself(self):
        def of(relative):
            natural, damping, frequency, force = relative.reshape(4, N)
            changed = [
                a * (1 + r)
                for a, r in zip(
                    (NATURAL, DAMPING, FREQUENCY, FORCE),
                    (natural, damping, frequency, force),
                    strict=True,
                )
            ]
            own = sj.identify.nonlinear_mode_velocity(changed[3], *changed[:3])
            return numbers(own, sj.identify.snrm_velocity(MODES[2], *changed))

        check_derivatives(of, 4 * N)

    @pytest.mark.parametrize("broken", [0.0, pytest.param(np.nan, marks=pytest.mark.long)])
    def test_closed_form(self, broken):
        own = VELOCITY[:, 0] - RESIDUAL
        own[2] = broken

        def of(relative):
            size, phase, frequency = relative.reshape(3, N)
            velocity = own * (1 + size) * jnp.exp(1j * phase)
            return numbers(
                *sj.identify.closed_form(CONSTANT, FREQUENCY * (1 + 1e-2 * frequency), velocity)
            )

        check_derivatives(of, 3 * N, failed=[2, N + 2, 2 * N + 2])

    @pytest.mark.parametrize("broken", [0.0, pytest.param(np.nan, marks=pytest.mark.long)])
    def test_phasor(self, broken):
        velocity = VELOCITY[:, 0].copy()
        velocity[2] = broken

        def of(relative):
            size, phase, force = relative[:-1].reshape(3, N)
            points = sj.identify.invert_phasor(
                CONSTANT * (1 + force),
                FREQUENCY,
                velocity * (1 + size) * jnp.exp(1j * phase),
                RESIDUAL * (1 + relative[-1]),  # of all members
            )
            return numbers(*jax.tree.leaves(points)[:4])

        check_derivatives(of, 3 * N + 1, failed=[2, N + 2, 2 * N + 2])

    def test_amplitude_and_phase_with_both_roots_and_without_any(self):
        """A batch of members with one root, with two, with none, and with nothing measured."""
        residual = np.array([0.1 + 0.05j, -0.5 + 0.1j, 0.1j, 2.0j, 0.2, 0.1])
        amplitude = np.array([0.6, 0.35, 0.5, 0.1, 0.0, np.nan])
        phase = np.array([0.1, 0.3, -0.4, 0.2, 0.0, 0.1])

        def points_of(relative):
            size, angle, frequency = relative[:-1].reshape(3, N)
            return sj.identify.invert_amplitude_phase(
                np.full(N, 6.0),
                500.0 * (1 + 1e-2 * frequency),
                amplitude * (1 + size),
                phase + angle,
                residual * (1 + relative[-1]),
            )

        status = np.asarray(points_of(jnp.zeros(3 * N + 1)).status)
        assert PointStatus.TWO_ROOTS in status
        assert {PointStatus.OK, PointStatus.NO_ROOT, PointStatus.NOT_FINITE} < set(status.tolist())
        failed = np.flatnonzero(np.isin(status, [PointStatus.NO_ROOT, PointStatus.NOT_FINITE]))
        check_derivatives(
            lambda relative: numbers(*jax.tree.leaves(points_of(relative))[:4]),
            3 * N + 1,
            failed=[k * N + m for k in range(3) for m in failed],
        )


def preserving(knots, values):
    return ShapePreservingCurve(values, jnp.asarray(knots[-1]), jnp.asarray(knots))


def natural(knots, values):
    blank = Spline.through((knots / knots[-1]) ** 2, np.ones(5), jnp.asarray(knots[-1]), "velocity")
    return eqx.tree_at(lambda c: c.parameters, blank, values)


@pytest.mark.parametrize(
    ("curve", "argument"),
    [
        (natural, "displacement"),
        pytest.param(natural, "velocity", marks=pytest.mark.long),
        pytest.param(preserving, "velocity", marks=pytest.mark.long),
        pytest.param(preserving, "displacement", marks=pytest.mark.long),
    ],
)
def test_backbone_curves(curve, argument):
    knots = np.linspace(0.1, 1.0, 5)
    # Knots and beyond: with a kink there, a curve has no derivative at a knot.
    amplitude = np.array([0.03, 0.23, 0.4, 0.72, 0.91, 1.3])

    def of(relative):
        backbone = Backbone(
            curve(knots, 2.5e5 * (1 + 0.1 * knots**2) * (1 + relative[:5])),
            curve(knots, 10.0 * (1 + knots) * (1 + relative[5:10])),
            1e-4 * jnp.eye(10),
            *(jnp.asarray(3.0), jnp.asarray(0.1), jnp.asarray(1.0)),
            argument,
            "sensor 1",
        )
        at = amplitude * (1 + relative[10:])
        curves = backbone.natural_frequency, backbone.damping_ratio, backbone.velocity
        return numbers(*(of(at) for of in (*curves, backbone.modal_damping)))

    check_derivatives(of, 16)


@pytest.mark.long
def test_inverse_force_with_a_state_that_was_not_measured():
    beam = sj.model.structure(
        sj.model.linear_modes([500.0], [0.01], [[2.0]], [3.0]),
        sj.model.polynomial_potential({"1111": 2e9}, 1),
    )
    velocity = np.array([0.1 + 0.05j, np.nan, 0.2 - 0.01j])
    data = sj.measure.steady_states([1, 1, 2], [500.0, 501.0, 503.0], [0.5, 0.5, 1.0], velocity)
    assert np.asarray(inverse_force(beam, data, harmonic_order=3).converged).tolist() == [
        True,
        False,
        True,
    ]

    def of(relative):
        moved = eqx.tree_at(
            lambda m: (m.potential.coefficient, m.modes.damping_ratio, m.modes.natural_frequency),
            beam,
            (
                beam.potential.coefficient * (1 + relative[0]),
                beam.modes.damping_ratio * (1 + relative[1]),
                beam.modes.natural_frequency * (1 + relative[2]),
            ),
        )
        return numbers(inverse_force(moved, data, harmonic_order=3).force)

    check_derivatives(of, 3)
