"""The appropriation indicator, straight from the paper's definition in displacements."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from hypothesis import given, settings
from hypothesis import strategies as st

import snrmjax  # noqa: F401
from snrmjax.measure.signals import appropriation_of, nnm_appropriation
from snrmjax.measure.states import steady_states

OMEGA = 500.0
ORDERS = (1, 2, 3, 4, 5)
RNG = np.random.default_rng(0)
VELOCITY = RNG.standard_normal((3, 5)) + 1j * RNG.standard_normal((3, 5))


def paper_indicator(velocity, orders):
    """Eq. (20) in its own terms: displacements in the time of F sin Ωt, by their Fourier sums."""
    quarter = 2 * np.pi / OMEGA / 4
    samples = 64
    time = np.arange(samples) * 4 * quarter / samples
    total = 0.0
    for k, column in zip(orders, velocity.T, strict=True):
        displacement = column / (1j * k * OMEGA)
        # cos Ωt = sin Ω(t + quarter): the paper's time is ours plus a quarter of a period.
        motion = (displacement[:, None] * np.exp(1j * k * OMEGA * (time - quarter))).real
        x = 2 * np.mean(motion * np.exp(-1j * k * OMEGA * time), axis=1)
        total += (x.real @ x.real) / np.vdot(x, x).real
    return total / len(orders)


class TestAppropriation:
    def test_is_the_papers_definition(self):
        value = nnm_appropriation(VELOCITY, ORDERS)
        # Sums of 64 terms of order one.
        np.testing.assert_allclose(value, paper_indicator(VELOCITY, ORDERS), rtol=1e-13)
        one = nnm_appropriation(VELOCITY[0], ORDERS)
        np.testing.assert_allclose(one, paper_indicator(VELOCITY[:1], ORDERS), rtol=1e-13)

    @given(st.floats(-np.pi, np.pi), st.floats(1e-12, 1e12))
    @settings(max_examples=50, deadline=None, derandomize=True)
    def test_fundamental_alone_is_cos_squared(self, phase, magnitude):
        velocity = jnp.array([magnitude * np.exp(1j * phase)])
        np.testing.assert_allclose(
            nnm_appropriation(velocity, (1,)), np.cos(phase) ** 2, atol=1e-15
        )

    def test_is_one_on_a_nonlinear_normal_mode(self):
        # An NNM from rest: q = Σ c_k cos kΩt, forced in quadrature to its fundamental. Resonance
        # wants the force to lead by a quarter period: F cos Ωt with q = Σ c_k cos k(Ωt − π/2).
        harmonics = np.array([1.0, 0.2, -0.3, 0.05, 0.1])
        order = np.asarray(ORDERS)
        velocity = 1j * order * OMEGA * harmonics * np.exp(-0.5j * np.pi * order)
        np.testing.assert_allclose(nnm_appropriation(velocity, ORDERS), 1.0, rtol=1e-14)
        # A quarter period late it is forced in phase with the displacement, and Δ forgets it.
        late = velocity * np.exp(-0.5j * np.pi * order)
        np.testing.assert_allclose(nnm_appropriation(late[[0, 2, 4]], (1, 3, 5)), 0.0, atol=1e-15)

    def test_is_one_on_an_integrated_undamped_oscillator(self):
        # Free motion of q̈ + q + q² + q³ = 0 from rest, integrated: an NNM with all harmonics.
        def period_end(t, y):
            return y[1]

        period_end.direction = -1.0
        solution = scipy.integrate.solve_ivp(
            lambda t, y: [y[1], -y[0] - y[0] ** 2 - y[0] ** 3],
            (0, 20),
            [0.4, 0.0],
            events=period_end,
            dense_output=True,
            rtol=1e-11,
            atol=1e-12,
        )
        period = next(t for t in solution.t_events[0] if t > 1e-3)
        time = np.linspace(0.0, period, 200, endpoint=False)
        order = np.arange(6)
        # At resonance the force is in phase with the velocity, −sin Ωt: its phasor is i.
        relative = np.fft.rfft(solution.sol(time)[1])[:6] * (-1j) ** order
        # The integrator's 1e-11 against the smallest harmonic counted, about 1e-6 of the first.
        value = nnm_appropriation(relative, order)
        np.testing.assert_allclose(value, 1.0, atol=1e-6)

    def test_invariance(self):
        value = nnm_appropriation(VELOCITY, ORDERS)
        np.testing.assert_allclose(nnm_appropriation(1e-200 * VELOCITY, ORDERS), value, rtol=1e-13)
        np.testing.assert_allclose(nnm_appropriation(-VELOCITY, ORDERS), value, rtol=1e-13)
        swapped = nnm_appropriation(VELOCITY[::-1, ::-1], ORDERS[::-1])
        np.testing.assert_allclose(swapped, value, rtol=1e-13)

    def test_what_does_not_count(self):
        value = nnm_appropriation(VELOCITY[:, :2], (1, 2))
        zero = np.zeros((3, 1))
        with_zero = np.concatenate([VELOCITY[:, :2], zero], axis=1)
        np.testing.assert_allclose(nnm_appropriation(with_zero, (1, 2, 3)), value, rtol=1e-14)
        with_nan = np.concatenate([VELOCITY[:, :2], zero * np.nan], axis=1)
        np.testing.assert_allclose(nnm_appropriation(with_nan, (1, 2, 3)), value, rtol=1e-14)
        with_mean = np.concatenate([zero + 1.0, VELOCITY[:, :2]], axis=1)
        np.testing.assert_allclose(nnm_appropriation(with_mean, (0, 1, 2)), value, rtol=1e-14)
        blind = VELOCITY[:, :2].copy()
        blind[1] = np.nan
        np.testing.assert_allclose(
            nnm_appropriation(blind, (1, 2)), nnm_appropriation(VELOCITY[[0, 2], :2], (1, 2))
        )
        assert np.isnan(nnm_appropriation(np.zeros(2), (1, 2)))
        assert np.isnan(nnm_appropriation(np.full(2, np.nan), (1, 2)))

    def test_gradient_jit_and_vmap(self):
        parts = np.concatenate([VELOCITY.real, VELOCITY.imag]).ravel()
        traces = []

        def indicator(x):
            traces.append(1)
            return nnm_appropriation(jax.lax.complex(*x.reshape(2, 3, 5)), ORDERS)

        step = 1e-6
        unit = step * np.eye(30)
        many = jax.jit(jax.vmap(indicator))
        slopes = (many(parts + unit) - many(parts - unit)) / (2 * step)
        # Central differences: rounding 1e-16 / step.
        np.testing.assert_allclose(jax.grad(indicator)(parts), slopes, atol=1e-9)
        silent = jax.grad(lambda x: nnm_appropriation(jnp.array([1.0 + 1.0j, x + 0j]), (1, 2)))(0.0)
        assert np.isfinite(silent)
        batch = np.stack([parts, 2 * parts, parts[::-1]])
        traces.clear()
        mapped = jax.jit(jax.vmap(indicator))
        values = mapped(batch)
        mapped(2 * batch)
        assert len(traces) == 1
        np.testing.assert_allclose(values, [indicator(row) for row in batch], rtol=1e-14)

    def test_wrong_arguments(self):
        with pytest.raises(ValueError, match=r"`velocity_amplitudes` must end in an axis of 2"):
            nnm_appropriation(VELOCITY, (1, 2))
        with pytest.raises(ValueError, match=r"`orders` must be distinct whole numbers"):
            nnm_appropriation(VELOCITY[:, :2], (1, 1))


def mode_indicator(velocity):
    """Eq. (21): the indicator of single-harmonic responses at several sensors."""
    return nnm_appropriation(np.asarray(velocity)[..., None], (1,))


class TestModeIndicator:
    def test_exact(self):
        velocity = np.array([3.0 + 4.0j, 1.0 - 2.0j])
        np.testing.assert_allclose(mode_indicator(velocity), (9 + 1) / (25 + 5), rtol=1e-14)
        # A normal mode of real shape, driven at resonance, whatever the sign at a sensor.
        assert mode_indicator(np.array([1.0 + 0j, -2.0])) == 1.0
        np.testing.assert_allclose(
            mode_indicator(np.stack([velocity, velocity * 1j])), [1 / 3, 2 / 3], rtol=1e-14
        )

    def test_unmeasured_sensors(self):
        assert mode_indicator(np.array([np.nan, 2.0 + 0j])) == 1.0
        assert np.isnan(mode_indicator(np.array([0j, np.nan])))


class TestAppropriationOf:
    def data(self, **change):
        given = {
            "level": np.array([1, 1, 2]),
            "frequency": np.full(3, OMEGA),
            "force": np.ones(3),
            "velocity": VELOCITY[:, :2],
            "sensors": ("a", "b"),
            "harmonic_order": (0, 1, 2, 3),
            "harmonics": np.stack([np.ones((3, 2)), VELOCITY[:, 2:4], *[VELOCITY[:, 3:]] * 2], -1),
        }
        return steady_states(**(given | change))

    def test_counts_each_harmonic_once(self):
        data = self.data()
        expected = [
            paper_indicator(
                np.stack([VELOCITY[k, :2], VELOCITY[k, 3:], VELOCITY[k, 3:]], axis=1), (1, 2, 3)
            )
            for k in range(3)
        ]
        np.testing.assert_allclose(appropriation_of(data), expected, rtol=1e-13)

    def test_without_harmonics_it_is_the_mode_indicator(self):
        data = self.data(harmonics=None, harmonic_order=())
        np.testing.assert_allclose(
            appropriation_of(data), mode_indicator(VELOCITY[:, :2]), rtol=1e-13
        )

    def test_unmeasured(self):
        measured = np.array([[True, True], [True, False], [False, False]])
        velocity = np.where(measured, VELOCITY[:, :2], 0.0)
        data = self.data(measured=measured, velocity=velocity)
        value = appropriation_of(data)
        np.testing.assert_allclose(value[0], appropriation_of(self.data())[0], rtol=1e-14)
        single = np.stack([VELOCITY[1, :1], VELOCITY[1, 3:4], VELOCITY[1, 3:4]], axis=1)
        np.testing.assert_allclose(value[1], paper_indicator(single, (1, 2, 3)), rtol=1e-13)
        assert np.isnan(value[2])
