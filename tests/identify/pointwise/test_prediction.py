"""Predicted resonances and responses of backbones in closed form, against scipy."""

from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import PchipInterpolator
from scipy.optimize import brentq
from truths.shape_preserving import ShapePreservingCurve

from snrmjax.identify.pointwise.backbone import Backbone
from snrmjax.identify.pointwise.prediction import (
    LARGEST_AMPLITUDE_RATIO,
    predict_response,
    resonances,
)
from snrmjax.model.modes import RigidBodyModes, linear_modes, residual_velocity

W0 = 500.0
SHAPE, PARTICIPATION = 2.0, -1.5  # a negative modal constant
CONSTANT = SHAPE * PARTICIPATION
LARGEST = 1e-3
MODES = linear_modes(
    [W0, 1700.0],
    [0.01, 0.02],
    [[SHAPE, 0.8]],
    [PARTICIPATION, 0.5],
    sensors=("tip",),
    rigid_body=RigidBodyModes([[0.6]], [0.4]),
)
POINTS = 120  # a side; one number for all tests, so that they compile once
predict = partial(predict_response, points_per_side=POINTS)
UNIT = {"displacement": 1.0, "velocity": W0}  # the same motion in either argument


def backbone(squared, damping, argument="displacement", knots=(0.0, 0.3, 0.45, 0.8, 1.0)):
    """Curves through values at knots, given as parts of the largest amplitude."""
    knots = UNIT[argument] * LARGEST * jnp.asarray(knots)
    pair = (ShapePreservingCurve(jnp.asarray(v), knots[-1], knots) for v in (squared, damping))
    return Backbone(
        *pair,
        covariance=jnp.zeros((2 * knots.size, 2 * knots.size)),
        modal_constant=jnp.asarray(CONSTANT),
        smallest=knots[0],
        largest=knots[-1],
        argument=argument,
        sensor="tip",
    )


def line(change):
    """1 + change · (a/largest)² at the knots: the spline through a line in a² is that line."""
    return 1 + change * np.array([0.0, 0.3, 0.45, 0.8, 1.0]) ** 2


STIFFENING = 0.3  # ω̃² grows by 30 % up to the largest amplitude
RATE = 2 * 0.02 * W0  # 2ζ̃ω̃
DUFFING = backbone(W0**2 * line(STIFFENING), RATE * line(0.0))
SOFTENING = backbone(W0**2 * line(-0.2), RATE * line(0.0))
PAPERS = backbone(W0**2 * line(0.3), RATE * line(0.5), "velocity")
# Damping with a bump: little at small and at large amplitudes, much between.
BUMP = RATE * np.array([1.0, 1.0, 6.0, 0.6, 0.6])
BUMPED = backbone(W0**2 * line(0.2), BUMP)
BACKBONES = {"stiffening": DUFFING, "softening": SOFTENING, "velocity": PAPERS, "bump": BUMPED}


def curves(which):
    """ω̃² and 2ζ̃ω̃ of an amplitude by scipy, continued along the end slope in its square."""

    def of(curve):
        u, values = np.asarray(curve.knots) ** 2, np.asarray(curve.parameters)
        inside = PchipInterpolator(u, values)
        slope = inside.derivative()(u[-1])
        return lambda a: inside(np.minimum(a**2, u[-1])) + slope * np.maximum(a**2 - u[-1], 0)

    return of(which.squared_frequency), of(which.modal_damping)


def velocity_amplitude(which, amplitude, frequency):
    return amplitude * (frequency if which.argument == "displacement" else 1.0)


def all_resonances(which, force):
    """Amplitudes where v·2ζ̃ω̃ = |A|F, from a fine search by scipy."""
    squared, damping = curves(which)

    def excess(a):
        omega = np.sqrt(squared(a))
        return velocity_amplitude(which, a, omega) * damping(a) - abs(CONSTANT) * force

    grid = LARGEST_AMPLITUDE_RATIO * float(which.largest) * np.linspace(1e-9, 1, 20001)
    signs = np.sign(excess(grid))
    brackets = [(grid[k], grid[k + 1]) for k in np.flatnonzero(signs[1:] != signs[:-1])]
    return [brentq(excess, a, b, xtol=1e-18, rtol=1e-14) for a, b in brackets]


def force_for(which, amplitude):
    """The force whose resonance has this amplitude (as a part of the largest)."""
    squared, damping = curves(which)
    a = amplitude * float(which.largest)
    omega = np.sqrt(squared(a))
    return float(velocity_amplitude(which, a, omega) * damping(a) / abs(CONSTANT))


class TestDampingThatGoesToNothing:
    """δ falls as 1 − a²/4: a·δ rises up to a = 1.155, beyond the data, and δ is zero at 2."""

    FALLING = backbone(W0**2 * line(0.0), RATE * line(-0.25))

    def test_only_the_resonance_before_it_is_one(self):
        force = force_for(self.FALLING, 1.1)
        (tip,) = resonances(self.FALLING, MODES, force, largest_amplitude_ratio=2.5)
        assert tip.amplitude == pytest.approx(1.1 * LARGEST, rel=1e-9)
        (curve,) = predict_response(self.FALLING, MODES, force, largest_amplitude_ratio=2.5)
        assert not curve.isolated
        assert curve.amplitude.max() < 1.12 * LARGEST

    def test_nothing_is_predicted_where_there_is_no_damping_left(self):
        force = 1.05 * force_for(self.FALLING, 1.15)  # more than any amplitude needs
        assert resonances(self.FALLING, MODES, force, largest_amplitude_ratio=2.5) == []
        (curve,) = predict_response(self.FALLING, MODES, force, largest_amplitude_ratio=2.5)
        assert curve.amplitude.max() <= 2.0 * LARGEST * (1 + 1e-9)


class TestResonances:
    @pytest.mark.parametrize("part", [1e-3, 0.1, 0.6, 1.0, 1.4])
    def test_resonance_of_a_duffing_oscillator(self, part):
        force = force_for(DUFFING, part)
        # ω̃² a² δ² = (|A|F)² with ω̃² = ω0² + b a² and constant δ: quadratic in a².
        b = STIFFENING * W0**2 / LARGEST**2
        load = (CONSTANT * force / RATE) ** 2
        roots = np.roots([b, W0**2, -load])
        u = roots[roots > 0][0]
        (predicted,) = resonances(DUFFING, MODES, force)
        frequency = np.sqrt(W0**2 + b * u)
        # The companion matrix and Newton's method: a few roundings.
        np.testing.assert_allclose(predicted.amplitude, np.sqrt(u), rtol=1e-10)
        np.testing.assert_allclose(predicted.frequency, frequency, rtol=1e-12)
        np.testing.assert_allclose(predicted.damping_ratio, RATE / (2 * frequency), rtol=1e-10)
        assert predicted.continued == (part > 1.0)
        assert predicted.force == force
        own = np.sign(CONSTANT) * frequency * np.sqrt(u)  # in phase or in antiphase
        rest = residual_velocity(MODES, jnp.asarray(frequency), jnp.asarray(force))
        np.testing.assert_allclose(predicted.velocity, abs(own + complex(rest[0])), rtol=1e-10)

    def test_resonance_with_growing_damping_is_the_root_of_a_cubic(self):
        which = backbone(W0**2 * line(0.0), RATE * line(2.0))
        for part in (0.05, 0.5, 1.0):
            force = force_for(which, part)
            # ω0 a (δ0 + 2 δ0 (a/largest)²) = |A|F
            roots = np.roots([2 * RATE * W0, 0, RATE * W0, -abs(CONSTANT) * force / LARGEST])
            (root,) = roots[np.isreal(roots)].real
            (predicted,) = resonances(which, MODES, force)
            np.testing.assert_allclose(predicted.amplitude, root * LARGEST, rtol=1e-10)

    @pytest.mark.parametrize("name", list(BACKBONES))
    def test_all_of_them_by_scipy(self, name):
        which = BACKBONES[name]
        counts = set()
        for part in (0.02, 0.2, 0.32, 0.9, 1.0):
            force = force_for(which, part)
            truth = all_resonances(which, force)
            predicted = resonances(which, MODES, force)
            counts.add(len(truth))
            np.testing.assert_allclose([one.amplitude for one in predicted], truth, rtol=1e-10)
            squared, damping = curves(which)
            for one, a in zip(predicted, truth, strict=True):
                np.testing.assert_allclose(one.frequency, np.sqrt(squared(a)), rtol=1e-10)
                np.testing.assert_allclose(
                    one.damping_ratio, damping(a) / (2 * np.sqrt(squared(a))), rtol=1e-10
                )
        assert counts == ({1, 3} if name == "bump" else {1})

    def test_small_forces_have_a_resonance_too(self):
        for part in (1e-4, 1e-7):
            (predicted,) = resonances(DUFFING, MODES, force_for(DUFFING, part))
            np.testing.assert_allclose(predicted.amplitude, part * LARGEST, rtol=1e-10)

    def test_a_force_beyond_the_continued_curve_has_none(self):
        force = force_for(DUFFING, 1.01 * LARGEST_AMPLITUDE_RATIO)
        assert resonances(DUFFING, MODES, force) == []
        assert (
            len(resonances(DUFFING, MODES, force_for(DUFFING, 0.99 * LARGEST_AMPLITUDE_RATIO))) == 1
        )

    def test_a_larger_ratio_looks_further(self):
        # Beyond the knots ω̃² continues along a², in which the Duffing backbone is a line already,
        # and the damping is constant: the extrapolation is exact.
        force = force_for(DUFFING, 3.7)
        (predicted,) = resonances(DUFFING, MODES, force, largest_amplitude_ratio=4.0)
        np.testing.assert_allclose(predicted.amplitude, 3.7 * LARGEST, rtol=1e-10)
        assert predicted.continued
        assert not resonances(DUFFING, MODES, force, largest_amplitude_ratio=3.6)

    def test_a_curve_reaches_as_far_as_asked_and_says_where_it_extrapolates(self):
        force = force_for(DUFFING, 3.0)
        (short,) = predict_response(DUFFING, MODES, force)
        (long,) = predict_response(DUFFING, MODES, force, largest_amplitude_ratio=4.0)
        assert short.amplitude.max() <= LARGEST_AMPLITUDE_RATIO * LARGEST
        # The largest displacement lies beyond the phase resonance by ζ²/2 of it, here 3e-5.
        np.testing.assert_allclose(long.amplitude.max(), 3.0 * LARGEST, rtol=1e-4)
        n = int(long.continued.sum())
        assert 0 < n < len(long.continued)
        (note,) = long.notes
        assert (note["n_points"], note["of"]) == (n, len(long.continued))
        assert note["ratio"] == pytest.approx(3, rel=1e-4)
        (small,) = predict_response(DUFFING, MODES, force_for(DUFFING, 0.5))
        assert small.notes == ()

    @pytest.mark.parametrize("ratio", [0.0, -1.0, np.nan, np.inf])
    @pytest.mark.parametrize("verb", [resonances, predict_response])
    def test_the_ratio_must_be_positive(self, verb, ratio):
        with pytest.raises(ValueError, match="`largest_amplitude_ratio` must be positive"):
            verb(DUFFING, MODES, force_for(DUFFING, 0.5), largest_amplitude_ratio=ratio)

    @pytest.mark.parametrize("force", [0.0, -1.0, np.nan, np.inf])
    @pytest.mark.parametrize("verb", [resonances, predict_response])
    def test_a_force_must_be_positive(self, verb, force):
        with pytest.raises(ValueError, match="`force` must be positive"):
            verb(DUFFING, MODES, force)


def force_balance(which, curve):
    """|(ω̃² − Ω² + iδΩ) X| − |A|F, relative, at every point, with curves by scipy."""
    squared, damping = curves(which)
    a, omega = curve.amplitude, curve.frequency
    displacement = velocity_amplitude(which, a, omega) / omega
    stiffness = squared(a) - omega**2 + 1j * damping(a) * omega
    return np.abs(stiffness) * displacement / (abs(CONSTANT) * curve.force) - 1


def mode_phasor(curve):
    """Velocity of the nonlinear mode: what is left without the residual modes."""
    force = jnp.full(curve.frequency.size, curve.force)
    rest = residual_velocity(MODES, jnp.asarray(curve.frequency), force)
    return curve.velocity - np.asarray(rest)[:, 0]


class TestResponse:
    @pytest.mark.parametrize("part", [0.05, 0.9, 1.2])
    @pytest.mark.parametrize("name", list(BACKBONES))
    def test_every_point_satisfies_the_force_balance(self, name, part):
        which = BACKBONES[name]
        force = force_for(which, part)
        predicted = predict(which, MODES, force)
        squared, damping = curves(which)
        for curve in predicted:
            assert curve.frequency.size > 100
            # Ω² = middle ± root: rounding of ω̃², grown by ω̃/δ = 50 near resonance.
            np.testing.assert_allclose(force_balance(which, curve), 0.0, atol=1e-10)
            phasor, a, omega = mode_phasor(curve), curve.amplitude, curve.frequency
            # The complex balance, the paper's Eq. (10) times i.
            c = squared(a) - omega**2 + 1j * damping(a) * omega
            np.testing.assert_allclose(phasor * c, 1j * CONSTANT * force * omega, rtol=1e-9)
            np.testing.assert_allclose(
                np.abs(phasor), velocity_amplitude(which, a, omega), rtol=1e-9
            )
            below = omega <= np.sqrt(squared(a)) * (1 + 1e-12)
            lead = np.array(curve.branch) == "lead"
            clear = np.abs(omega / np.sqrt(squared(a)) - 1) > 1e-9
            np.testing.assert_array_equal(lead[clear], below[clear])
            np.testing.assert_array_equal(curve.continued, a > float(which.largest) * (1 + 1e-9))
        peak = max(curve.amplitude.max() for curve in predicted)
        reached = max(all_resonances(which, force))
        # The largest amplitude is within δ²/8ω² of the phase resonance.
        np.testing.assert_allclose(peak, reached, rtol=(damping(reached) / W0) ** 2)

    def test_a_linear_backbone_gives_the_linear_response(self):
        which = backbone(W0**2 * line(0.0), RATE * line(0.0))
        force = force_for(which, 0.8)
        (curve,) = predict(which, MODES, force)
        c = W0**2 - curve.frequency**2 + 1j * RATE * curve.frequency
        np.testing.assert_allclose(mode_phasor(curve), 1j * CONSTANT * force * curve.frequency / c)
        assert curve.stable.all()
        assert not curve.isolated
        assert curve.amplitude.min() < 0.03 * curve.amplitude.max()
        assert (np.diff(curve.frequency) > -1e-9).all()  # in order, from low to high frequency

    def test_isolated_curve_between_two_upper_resonances(self):
        force = force_for(BUMPED, 0.9)
        low, middle, high = all_resonances(BUMPED, force)
        main, isola = predict(BUMPED, MODES, force)
        assert (main.isolated, isola.isolated) == (False, True)
        # A displacement extreme lies within δ²/8ω² of the phase resonance.
        near = (BUMP.max() / W0) ** 2
        np.testing.assert_allclose(main.amplitude.max(), low, rtol=near)
        np.testing.assert_allclose(isola.amplitude.min(), middle, rtol=near)
        np.testing.assert_allclose(isola.amplitude.max(), high, rtol=near)
        # Closed: both sides meet at both ends, in frequency too, as √ of the bisection's 1e-16.
        ends = isola.frequency[[0, -1]]
        np.testing.assert_allclose(ends[0], ends[1], rtol=1e-6)
        half = isola.frequency.size // 2
        np.testing.assert_allclose(isola.frequency[half - 1], isola.frequency[half], rtol=1e-6)
        # Its lower half is a saddle, its upper end (stiffening) stable on one side.
        assert not isola.stable[np.argsort(isola.amplitude)[:4]].any()
        assert isola.stable.any()
        # Without the bump's far side there is no isolated curve.
        assert len(predict(BUMPED, MODES, force_for(BUMPED, 0.2))) == 1

    def test_frequency_limits(self):
        force = force_for(DUFFING, 0.7)
        (whole,) = predict(DUFFING, MODES, force)
        (part,) = predict(DUFFING, MODES, force, from_frequency=480.0, to_frequency=560.0)
        inside = (whole.frequency >= 480.0) & (whole.frequency <= 560.0)
        assert 0 < inside.sum() < inside.size
        for name in ("frequency", "velocity", "amplitude", "stable", "branch", "continued"):
            np.testing.assert_array_equal(
                np.asarray(getattr(part, name)), np.asarray(getattr(whole, name))[inside]
            )
        assert predict(DUFFING, MODES, force, from_frequency=1e5) == []

    def test_number_and_range_of_points(self):
        (curve,) = predict(DUFFING, MODES, force_for(DUFFING, 0.7))
        # Small amplitudes far below resonance ask for a frequency below zero: they are left out.
        assert 2 * POINTS - 10 < curve.frequency.size <= 2 * POINTS
        amplitudes = curve.amplitude
        np.testing.assert_allclose(amplitudes.min(), 0.02 * amplitudes.max(), rtol=1e-9)
        top = int(np.argmax(amplitudes))
        assert np.all(np.diff(amplitudes[: top + 1]) > 0)
        assert np.all(np.diff(amplitudes[top + 1 :]) < 0)

    def test_units(self):
        force = force_for(DUFFING, 0.7)
        (plain,) = predict(DUFFING, MODES, force)
        # Time in another unit: frequencies times 4, displacements at the same forces over 16.
        fast = Backbone(
            *(
                ShapePreservingCurve(by * c.parameters, c.scale / 16, c.knots / 16)
                for c, by in ((DUFFING.squared_frequency, 16), (DUFFING.modal_damping, 4))
            ),
            covariance=DUFFING.covariance,
            modal_constant=DUFFING.modal_constant,
            smallest=DUFFING.smallest / 16,
            largest=DUFFING.largest / 16,
            argument="displacement",
            sensor="tip",
        )
        modes = linear_modes(
            4 * np.asarray(MODES.natural_frequency),
            MODES.damping_ratio,
            MODES.mode_shape,
            MODES.participation,
            sensors=("tip",),
            rigid_body=RigidBodyModes(MODES.rigid_body_shape, MODES.rigid_body_participation),
        )
        (scaled,) = predict(fast, modes, force)
        # Powers of two: the same roundings.
        np.testing.assert_allclose(scaled.frequency, 4 * plain.frequency, rtol=1e-13)
        np.testing.assert_allclose(scaled.velocity, plain.velocity / 4, rtol=1e-11)
        np.testing.assert_array_equal(scaled.stable, plain.stable)


def slow_flow(which, force, frequency):
    """Averaged motion q = Re(z e^{iΩt}): ż = (|A|F − (ω̃² − Ω² + iδΩ) z) / (2iΩ)."""
    squared, damping = curves(which)

    def rate(_, state):
        z = state[0] + 1j * state[1]
        a = abs(z) * (1.0 if which.argument == "displacement" else frequency)
        stiffness = squared(a) - frequency**2 + 1j * damping(a) * frequency
        change = (abs(CONSTANT) * force - stiffness * z) / (2j * frequency)
        return [change.real, change.imag]

    return rate


class TestStability:
    @pytest.mark.parametrize("name", ["stiffening", "softening", "velocity"])
    def test_unstable_exactly_between_the_folds(self, name):
        which = BACKBONES[name]
        (curve,) = predict(which, MODES, force_for(which, 0.9))
        # The frequency along the curve, up one side and down the other: between the folds it
        # runs backwards.
        backwards = np.diff(curve.frequency) < 0
        assert 10 < backwards.sum() < backwards.size / 2
        middle = 0.5 * (curve.frequency[1:] + curve.frequency[:-1])
        same = curve.stable[1:] == curve.stable[:-1]  # not the step over a fold itself
        step = np.abs(np.diff(curve.frequency)) > 1e-9 * middle
        np.testing.assert_array_equal(backwards[same & step], ~curve.stable[1:][same & step])
        assert (~same).sum() == 2

    def test_a_small_force_has_no_folds(self):
        (curve,) = predict(DUFFING, MODES, force_for(DUFFING, 0.05))
        assert curve.stable.all()

    @pytest.mark.parametrize(
        ("name", "part", "number"),
        [("stiffening", 0.9, 0), ("velocity", 0.9, 0), ("bump", 0.9, 1)],
    )
    def test_the_averaged_motion_returns_or_leaves(self, name, part, number):
        which = BACKBONES[name]
        force = force_for(which, part)
        curve = predict(which, MODES, force)[number]
        squared, damping = curves(which)
        checked = {True: 0, False: 0}
        for k in np.linspace(3, curve.frequency.size - 4, 14).astype(int):
            omega, a = curve.frequency[k], curve.amplitude[k]
            z = abs(CONSTANT) * force / (squared(a) - omega**2 + 1j * damping(a) * omega)
            start = z * (1 + 1e-4 * np.exp(0.7j))
            time = 40.0 / damping(a)  # twenty times the decay of a free vibration
            end = solve_ivp(
                slow_flow(which, force, omega),
                (0.0, time),
                [start.real, start.imag],
                rtol=1e-8,
                atol=1e-8 * abs(z),
            ).y[:, -1]
            distance = abs(end[0] + 1j * end[1] - z) / abs(z)
            # Within 1e-5 it came back from 1e-4, beyond 1e-3 it left; near a fold it may do
            # neither in that time.
            neighbours = curve.stable[k - 3 : k + 4]
            if neighbours.all() or not neighbours.any():
                assert distance < 1e-5 if curve.stable[k] else distance > 1e-3
                checked[bool(curve.stable[k])] += 1
        assert min(checked.values()) >= 2

    def test_negative_damping_of_small_changes_is_unstable(self):
        # 2δ + a δ' < 0 where damping falls faster than the square of the amplitude.
        which = backbone(W0**2 * line(0.0), RATE * np.array([1.0, 1.0, 0.9, 0.1, 0.1]))
        _, damping = curves(which)
        predicted = predict(which, MODES, force_for(which, 0.3))
        for curve in predicted:
            a, h = curve.amplitude, 1e-6 * curve.amplitude
            slope = (damping(a + h) - damping(a - h)) / (2 * h)
            trace = 2 * damping(a) + a * slope
            assert not curve.stable[trace < -1e-3 * RATE].any()
        every = np.concatenate([curve.stable for curve in predicted])
        assert every.any()
        assert not every.all()
