"""Points of the backbone against steady states whose ω̃ and ζ̃ are known; errors by Monte Carlo."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from snrmjax.identify.pointwise.backbone_points import identify_points
from snrmjax.identify.pointwise.inversion import PointStatus
from snrmjax.measure.states import steady_states
from snrmjax.model.modes import LinearModesStd, RigidBodyModes, linear_modes

SENSORS = ("tip", "middle", "root")
NATURAL = np.array([310.0, 500.0, 1400.0])
DAMPING = np.array([0.02, 0.01, 0.015])
SHAPE = np.array([[1.1, 2.0, -0.8], [0.5, -1.2, 0.9], [-0.2, 0.6, 0.4]])
PARTICIPATION = np.array([0.9, 1.5, 1.1])
RIGID_SHAPE = np.array([[0.7], [0.5], [0.4]])
RIGID_PARTICIPATION = np.array([0.6])


def three_modes(sensors=(0, 1, 2), time=1.0, force=1.0, residual=1.0, std=None):
    """The second of three modes is of interest; `time` and `force` are other units."""
    rows = list(sensors)
    others = np.array([residual, 1.0, residual])
    return linear_modes(
        time * NATURAL,
        DAMPING,
        SHAPE[rows],
        PARTICIPATION * others / force,
        sensors=tuple(SENSORS[k] for k in rows),
        mode_of_interest=1,
        rigid_body=RigidBodyModes(RIGID_SHAPE[rows], residual * RIGID_PARTICIPATION / force),
        std=std,
    )


def mode_velocity(natural, damping, frequency, force):
    """V_nl of Eq. (10b) at every sensor, relative to the force (the paper's times i)."""
    c = natural**2 - frequency**2 + 2j * damping * natural * frequency
    return (1j * frequency * PARTICIPATION[1] * force / c)[:, None] * SHAPE[:, 1]


def residual_velocity(frequency, force, natural=NATURAL, damping=DAMPING):
    keep = [0, 2]
    w = frequency[:, None]
    c = natural[keep] ** 2 - w**2 + 2j * damping[keep] * natural[keep] * w
    modal = 1j * w * PARTICIPATION[keep] * force[:, None] / c
    rigid = RIGID_SHAPE[:, 0] * RIGID_PARTICIPATION * (force / frequency)[:, None]
    return modal @ SHAPE[:, keep].T - 1j * rigid


N = 4000  # one number of states for all tests: the package compiles once for it


class Truth:
    """Steady states with a softening backbone and any damping, phases within 70° of resonance."""

    def __init__(self, n=N):
        rng = np.random.default_rng(0)
        self.force = np.repeat([0.5, 1.0, 2.0, 4.0], n // 4)
        self.level = np.repeat([1, 2, 3, 4], n // 4)
        self.natural = 500.0 - 10.0 * self.force + rng.uniform(-1, 1, n)
        self.damping = 0.01 + 0.002 * self.force
        self.phase = np.radians(rng.uniform(-70, 70, n))
        offset = self.damping * np.tan(self.phase)
        self.frequency = self.natural / (offset + np.sqrt(offset**2 + 1))
        self.own = mode_velocity(self.natural, self.damping, self.frequency, self.force)
        self.velocity = self.own + residual_velocity(self.frequency, self.force)

    def table(self, sensors=(0, 1, 2), **more):
        rows = list(sensors)
        names = tuple(SENSORS[k] for k in rows)
        return steady_states(
            self.level, self.frequency, self.force, self.velocity[:, rows], sensors=names, **more
        )


TRUTH = Truth()
# The truth and the inverse round a few times; the residual is up to 10 % of the response.
ROUNDING = 1e-12


class TestExactStates:
    @pytest.mark.parametrize("sensors", [(0,), (0, 1, 2)])
    def test_points_are_the_truth(self, sensors):
        points = identify_points(TRUTH.table(sensors), three_modes(sensors))
        assert points.sensor == "tip"
        assert (np.asarray(points.status) == PointStatus.OK).all()
        np.testing.assert_allclose(points.natural_frequency, TRUTH.natural, rtol=ROUNDING)
        np.testing.assert_allclose(points.damping_ratio, TRUTH.damping, rtol=1e-11)
        np.testing.assert_allclose(
            points.modal_damping, 2 * TRUTH.damping * TRUTH.natural, rtol=1e-11
        )
        np.testing.assert_allclose(points.velocity, TRUTH.velocity[:, 0], rtol=ROUNDING)
        np.testing.assert_allclose(points.mode_velocity, TRUTH.own[:, 0], rtol=ROUNDING)
        np.testing.assert_allclose(np.asarray(points.filter_residual), 0.0, atol=ROUNDING)
        np.testing.assert_array_equal(points.level, TRUTH.level)
        assert np.isnan(np.asarray(points.natural_frequency_std)).all()  # no noise is stated
        assert np.isnan(np.asarray(points.alternative_natural_frequency)).all()

    def test_where_points_lie_on_the_backbone(self):
        data, modes = TRUTH.table((0,)), three_modes((0,))
        displaced = identify_points(data, modes)
        size = np.abs(TRUTH.own[:, 0])
        np.testing.assert_allclose(displaced.amplitude, size / TRUTH.frequency, rtol=ROUNDING)
        np.testing.assert_allclose(
            displaced.backbone_velocity, size * TRUTH.natural / TRUTH.frequency, rtol=ROUNDING
        )
        paper = identify_points(data, modes, amplitude="velocity")
        np.testing.assert_allclose(paper.amplitude, size, rtol=ROUNDING)
        np.testing.assert_allclose(paper.backbone_velocity, size, rtol=ROUNDING)
        assert (displaced.argument, paper.argument) == ("displacement", "velocity")
        # Two programs: the last bit may differ.
        np.testing.assert_allclose(
            paper.natural_frequency, displaced.natural_frequency, rtol=2 * np.finfo(float).eps
        )

    def test_a_sensor_that_missed_a_state_is_left_out(self):
        velocity = TRUTH.velocity.copy()
        measured = np.ones(velocity.shape, bool)
        measured[::2, 2], measured[1::2, 0] = False, False
        velocity[~measured] = 0.0
        data = steady_states(
            TRUTH.level,
            TRUTH.frequency,
            TRUTH.force,
            velocity,
            sensors=SENSORS,
            measured=measured,
        )
        points = identify_points(data, three_modes())
        np.testing.assert_allclose(points.natural_frequency, TRUTH.natural, rtol=ROUNDING)
        np.testing.assert_allclose(points.velocity, TRUTH.velocity[:, 0], rtol=ROUNDING)
        # A state without a measurement is not solved and does not affect the others.
        measured[3] = False
        lost = identify_points(
            eqx.tree_at(lambda d: d.measured, data, jnp.asarray(measured)), three_modes()
        )
        assert int(lost.status[3]) == PointStatus.NOT_FINITE
        assert not bool(lost.usable[3])
        assert np.isnan([lost.natural_frequency[3], lost.amplitude[3]]).all()
        others = np.arange(len(TRUTH.level)) != 3
        np.testing.assert_array_equal(
            np.asarray(lost.damping_ratio)[others], np.asarray(points.damping_ratio)[others]
        )

    def test_a_shape_that_does_not_fit_shows_in_the_residual(self):
        velocity = TRUTH.velocity.copy()
        velocity[:, 1] += 0.2 * TRUTH.own[:, 1]
        data = eqx.tree_at(lambda d: d.velocity, TRUTH.table(), jnp.asarray(velocity))
        points = identify_points(data, three_modes())
        # Least squares of Φη = V with one entry 20 % too large, by numpy.
        shape = SHAPE[:, 1:2]
        wrong = shape[:, 0] * [1.0, 1.2, 1.0]
        eta, squares, _, _ = np.linalg.lstsq(shape, wrong, rcond=None)
        expected = np.sqrt(squares[0]) / np.linalg.norm(wrong)
        np.testing.assert_allclose(points.filter_residual, expected, rtol=1e-10)  # rounding
        own = TRUTH.own[:, 0] * eta[0]
        np.testing.assert_allclose(points.mode_velocity, own, rtol=1e-11)

    def test_the_order_of_rows_does_not_matter(self):
        order = np.random.default_rng(1).permutation(len(TRUTH.level))
        data = TRUTH.table(velocity_std=0.01 * np.abs(TRUTH.velocity))
        plain = identify_points(data, three_modes())
        moved = identify_points(
            jax.tree.map(lambda column: column[order], data),
            three_modes(),
        )
        for name in ("natural_frequency", "damping_ratio", "amplitude", "damping_ratio_std"):
            np.testing.assert_allclose(
                getattr(moved, name), np.asarray(getattr(plain, name))[order], rtol=ROUNDING
            )

    def test_other_units(self):
        std = 0.01 * np.abs(TRUTH.velocity)
        plain = identify_points(TRUTH.table(velocity_std=std), three_modes())
        # All frequencies 7 times as high under the same forces: velocities fall by 7, displacements
        # by 49. Force in mN.
        data = steady_states(
            TRUTH.level,
            7 * TRUTH.frequency,
            1e3 * TRUTH.force,
            TRUTH.velocity / 7,
            sensors=SENSORS,
            velocity_std=std / 7,
        )
        scaled = identify_points(data, three_modes(time=7.0, force=1e3))
        for name, factor in (
            ("natural_frequency", 7),
            ("natural_frequency_std", 7),
            ("damping_ratio", 1),
            ("damping_ratio_std", 1),
            ("amplitude", 1 / 49),
            ("backbone_velocity", 1 / 7),
        ):
            np.testing.assert_allclose(
                getattr(scaled, name), factor * np.asarray(getattr(plain, name)), rtol=1e-11
            )


class TestPeak:
    def test_peak_of_a_hand_made_signal(self):
        # v₁ cos τ + 0.2 v₁ cos 3τ peaks at τ = 0, at 1.2 v₁, whatever the phase of v₁.
        own = TRUTH.velocity[:, 0]
        phase_factor = own / np.abs(own)
        third = 0.2 * np.abs(own) * phase_factor**3
        modes = three_modes((0,))
        data = TRUTH.table((0,), harmonics=third[:, None, None], harmonic_order=(3,))
        actual = identify_points(data, modes, measure="peak")
        larger = eqx.tree_at(lambda d: d.velocity, TRUTH.table((0,)), 1.2 * own[:, None])
        expected = identify_points(larger, modes)
        # The peak is exact to rounding; its phase stays that of the fundamental.
        np.testing.assert_allclose(actual.natural_frequency, expected.natural_frequency, 1e-11)
        np.testing.assert_allclose(actual.damping_ratio, expected.damping_ratio, rtol=1e-10)
        fundamental = identify_points(data, modes)
        np.testing.assert_allclose(fundamental.damping_ratio, TRUTH.damping, rtol=1e-11)
        # Eq. (20): the mean over both harmonics of cos² of their phases.
        both = np.stack([own, third])
        indicator = np.mean((both.real / np.abs(both)) ** 2, axis=0)
        np.testing.assert_allclose(fundamental.appropriation, indicator, rtol=1e-12)

    def test_harmonics_that_were_not_measured_count_as_nothing(self):
        own = TRUTH.velocity[:, 0]
        harmonics = np.full((len(own), 1, 1), np.nan + 0j)
        data = TRUTH.table((0,), harmonics=harmonics, harmonic_order=(3,))
        actual = identify_points(data, three_modes((0,)), measure="peak")
        np.testing.assert_allclose(actual.damping_ratio, TRUTH.damping, rtol=1e-11)


def one_state():
    """One state of the truth, N times over: its level is the number of the copy."""
    k = 7
    return {
        "level": np.arange(N),
        "frequency": np.full(N, TRUTH.frequency[k]),
        "force": np.full(N, TRUTH.force[k]),
        "velocity": np.repeat(TRUTH.velocity[k : k + 1], N, axis=0),
    }


def spread(points):
    """Scatter of the points over their stated 1σ, for ω̃ and ζ̃; known to 1.1 % from 4000 draws."""
    ratios = []
    for name in ("natural_frequency", "damping_ratio"):
        stated = np.asarray(getattr(points, name + "_std"))
        assert (stated > 0).all()
        ratios.append(np.std(getattr(points, name), ddof=1) / np.sqrt(np.mean(stated**2)))
    return np.array(ratios)


class TestStatedErrors:
    @pytest.mark.parametrize(
        ("amplitude", "phase", "force"),
        [
            (0.01, 0.0, None),
            (0.0, 0.008, None),
            (None, None, 0.02),
            (0.01, 0.008, 0.02),
        ],
    )
    @pytest.mark.parametrize("sensors", [(0,), (0, 1, 2)])
    def test_monte_carlo_of_measured_noise(self, sensors, amplitude, phase, force):
        values = one_state()
        rng = np.random.default_rng(4)
        rows = list(sensors)
        exact = values["velocity"][:, rows]
        # Sensors of different quality, the second one ten times worse.
        quality = np.array([1.0, 10.0, 0.5])[rows]
        normal = rng.standard_normal((2, *exact.shape))
        factor = np.ones(exact.shape, complex)
        if amplitude:
            factor = factor * (1 + amplitude * quality * normal[0])
        if phase:
            factor = factor * np.exp(1j * phase * quality * normal[1])
        recorded = values["force"].copy()
        if force:
            recorded = recorded * (1 + force * rng.standard_normal(N))
        data = steady_states(
            values["level"],
            values["frequency"],
            recorded,
            exact * factor,
            sensors=tuple(SENSORS[k] for k in rows),
            velocity_std=None if amplitude is None else amplitude * quality * np.abs(exact),
            phase_std=None if phase is None else np.broadcast_to(phase * quality, exact.shape),
            force_std=None if force is None else force * values["force"],
        )
        points = identify_points(data, three_modes(sensors))
        # 10 %: 1.1 % of the draw, and errors of 1 % (10 % in the worst sensor) to second order.
        np.testing.assert_allclose(spread(points), 1.0, atol=0.1)

    def test_sensors_are_weighted_by_their_errors(self):
        values = one_state()
        exact, rng = values["velocity"], np.random.default_rng(8)
        std = np.array([0.004, 0.03, 0.001])  # m/s, circles in the complex plane
        noise = std * (rng.standard_normal((2, N, 3)).T @ [1, 1j]).T
        data = steady_states(
            values["level"],
            values["frequency"],
            values["force"],
            exact + noise,
            sensors=SENSORS,
            velocity_std=np.broadcast_to(std, exact.shape),
        )
        points = identify_points(data, three_modes())
        np.testing.assert_allclose(spread(points), 1.0, atol=0.1)
        # The best linear estimate of η from V_s = Φ_s η + noise has 1/var = Σ Φ_s²/std_s².
        best = SHAPE[0, 1] / np.sqrt(np.sum((SHAPE[:, 1] / std) ** 2))
        actual = np.std(np.asarray(points.mode_velocity).real, ddof=1)
        np.testing.assert_allclose(actual, best, rtol=0.05)  # four times the 1.1 % of 4000 draws
        assert best < 0.8 * std[0]

    @pytest.mark.parametrize("sensors", [(0,), (0, 1, 2)])
    def test_monte_carlo_of_the_residual_modes(self, sensors):
        # The truth moves, the modes of the model stay: one table holds all draws.
        values = one_state()
        rng = np.random.default_rng(6)
        frequency_std, damping_std = np.array([3.0, 9.0, 40.0]), np.array([4e-3, 9.0, 3e-3])
        normal = rng.standard_normal((2, N, 3))
        velocity = np.repeat(TRUTH.own[7:8], N, axis=0)
        force, frequency = values["force"][:1], values["frequency"][:1]
        for row in range(N):
            velocity[row] += residual_velocity(
                frequency,
                force,
                NATURAL + frequency_std * normal[0, row],
                DAMPING + damping_std * normal[1, row],
            )[0]
        rows = list(sensors)
        data = steady_states(
            values["level"],
            values["frequency"],
            values["force"],
            velocity[:, rows],
            sensors=tuple(SENSORS[k] for k in rows),
            # Noise that is nearly none: only the residual modes' errors count.
            velocity_std=np.full((N, len(rows)), 1e-12),
        )
        modes = three_modes(sensors, std=LinearModesStd(frequency_std, damping_std))
        np.testing.assert_allclose(spread(identify_points(data, modes)), 1.0, atol=0.1)

    def test_derivatives_with_respect_to_the_measured_quantities(self):
        sensors = (0,)
        modes = three_modes(sensors)
        base = TRUTH.table(sensors)
        points = identify_points(base, modes)

        def outputs(log_force, log_velocity, phase):
            data = eqx.tree_at(
                lambda d: (d.force, d.velocity),
                base,
                (
                    base.force * np.exp(log_force),
                    base.velocity * np.exp(log_velocity + 1j * phase),
                ),
            )
            moved = identify_points(data, modes)
            return np.stack(
                [moved.natural_frequency**2, moved.modal_damping, np.log(moved.amplitude)], axis=1
            )

        step = 1e-5
        for k, move in enumerate(np.eye(3) * step):
            slope = (outputs(*move) - outputs(*-move)) / (2 * step)
            # Second order: (1e-5)² over the square of the distance to the axes, 0.3 rad; and
            # rounding 1e-16 × 2.5e5 / 1e-5.
            np.testing.assert_allclose(points.sensitivity[:, :, k], slope, rtol=1e-7, atol=1e-5)

    def test_what_is_not_stated(self):
        size = np.abs(TRUTH.velocity[:, :1])
        modes = three_modes((0,))
        only_amplitude = identify_points(TRUTH.table((0,), velocity_std=0.01 * size), modes)
        # An amplitude error without a phase error is a circle; the force counts as exact.
        np.testing.assert_allclose(
            only_amplitude.relative_std, np.broadcast_to([0, 0.01, 0.01], (N, 3)), rtol=1e-12
        )
        some = np.full(size.shape, np.nan)
        some[5] = 0.02 * size[5]
        mixed = identify_points(TRUTH.table((0,), velocity_std=some), modes)
        stated = np.isfinite(np.asarray(mixed.natural_frequency_std))
        assert list(np.flatnonzero(stated)) == [5]


class TestRefusals:
    def test_a_force_that_is_not_known(self):
        n = len(TRUTH.level)
        data = steady_states(
            TRUTH.level,
            TRUTH.frequency,
            np.full(n, np.nan),
            TRUTH.velocity[:, :1],
            sensors=("tip",),
            drive=np.ones(n),
        )
        with pytest.raises(
            ValueError,
            match=r"only a drive voltage .* `--fit auto --free force_gain`",
        ):
            identify_points(data, three_modes((0,)))

    def test_states_without_an_answer_leave_the_others_alone(self):
        velocity, force = TRUTH.velocity[:, :1].copy(), TRUTH.force.copy()
        expected = {
            3: PointStatus.NOT_FINITE,
            5: PointStatus.NOT_FINITE,
            8: PointStatus.ZERO_FORCE,
            13: PointStatus.NEGATIVE_DAMPING,
            21: PointStatus.NO_REAL_FREQUENCY,
        }
        velocity[3], velocity[5], force[8] = 0.0, np.nan, 0.0
        velocity[13] *= -1
        velocity[21] += -TRUTH.own[21, 0] - 1e-4j  # Ω² less than AΩ/|V_nl|
        exact = identify_points(TRUTH.table((0,)), three_modes((0,)))
        data = steady_states(TRUTH.level, TRUTH.frequency, force, velocity, sensors=("tip",))
        points = identify_points(data, three_modes((0,)))
        others = np.setdiff1d(np.arange(N), list(expected))
        for name in ("natural_frequency", "damping_ratio", "amplitude", "status"):
            np.testing.assert_array_equal(
                np.asarray(getattr(points, name))[others], np.asarray(getattr(exact, name))[others]
            )
        np.testing.assert_array_equal(
            np.asarray(points.sensitivity)[others], np.asarray(exact.sensitivity)[others]
        )
        for state, status in expected.items():
            assert int(points.status[state]) == status
            solved = status == PointStatus.NEGATIVE_DAMPING
            assert bool(jnp.isfinite(points.natural_frequency[state])) == solved
            assert bool(jnp.isfinite(points.sensitivity[state]).all()) == solved
            assert not bool(points.usable[state])

    def test_other_sensors(self):
        message = r"`data` has the sensors \['tip'\], but `modes` has \['tip', 'middle', 'root'\]"
        with pytest.raises(ValueError, match=message):
            identify_points(TRUTH.table((0,)), three_modes())

    def test_a_peak_without_harmonics(self):
        with pytest.raises(ValueError, match="needs harmonics"):
            identify_points(TRUTH.table((0,)), three_modes((0,)), measure="peak")

    @pytest.mark.parametrize(
        ("setting", "message"),
        [({"amplitude": "energy"}, "not 'energy'"), ({"measure": "rms"}, "not 'rms'")],
    )
    def test_unknown_words(self, setting, message):
        with pytest.raises(ValueError, match=message):
            identify_points(TRUTH.table((0,)), three_modes((0,)), **setting)

    def test_no_states(self):
        empty = steady_states([], [], [], np.zeros((0, 1)), sensors=("tip",))
        with pytest.raises(ValueError, match="no steady states"):
            identify_points(empty, three_modes((0,)))
