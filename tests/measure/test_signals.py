"""Synthesis, peaks and force-velocity loops against their definitions and scipy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import snrmjax  # noqa: F401
from snrmjax.measure.signals import force_velocity_loop, peak_amplitude, synthesise

OMEGA = 2 * np.pi * 80.0
ORDERS = (1, 2, 3)
# Mean, then harmonics 1 to 3.
TRUTH = np.array([0.3, 1.0 - 0.4j, 0.05 + 0.02j, -0.08j])


class TestSynthesis:
    def test_synthesise(self):
        time = np.linspace(0.0, 4 * np.pi / OMEGA, 120)
        signal = sum((x * np.exp(1j * k * OMEGA * time)).real for k, x in enumerate(TRUTH))
        values = synthesise(np.stack([TRUTH, 2 * TRUTH]), (0, 1, 2, 3), OMEGA, time)
        np.testing.assert_allclose(values, [signal, 2 * signal], atol=1e-13)

    @pytest.mark.parametrize("verb", [synthesise, peak_amplitude])
    def test_wrong_orders(self, verb):
        rest = {synthesise: (1.0, np.zeros(2)), peak_amplitude: ()}[verb]
        with pytest.raises(ValueError, match=r"must end in an axis of 2 harmonics"):
            verb(TRUTH, (1, 2), *rest)
        with pytest.raises(ValueError, match=r"`orders` must be distinct whole numbers"):
            verb(TRUTH, (1, 2, 3, 3), *rest)


def brute_peak(amplitudes, orders):
    """Largest magnitude by scipy, bracketed by a fine grid."""

    def negative(angle):
        return -abs(
            sum((x * np.exp(1j * k * angle)).real for k, x in zip(orders, amplitudes, strict=True))
        )

    grid = np.linspace(0, 2 * np.pi, 4001)
    best = grid[np.argmin([negative(angle) for angle in grid])]
    result = scipy.optimize.minimize_scalar(
        negative, bounds=(best - 2e-3, best + 2e-3), method="bounded", options={"xatol": 1e-10}
    )
    return -result.fun


class TestPeak:
    @pytest.mark.parametrize("seed", range(6))
    def test_against_scipy(self, seed):
        rng = np.random.default_rng(seed)
        orders = ((0, 1, 2, 3), (1, 5, 9))[seed % 2]
        amplitudes = rng.standard_normal(len(orders)) + 1j * rng.standard_normal(len(orders))
        if orders[0] == 0:
            amplitudes[0] = amplitudes[0].real
        # A peak is flat: scipy's 1e-10 rad costs 1e-18, so both are exact to rounding.
        np.testing.assert_allclose(
            peak_amplitude(amplitudes, orders), brute_peak(amplitudes, orders), rtol=1e-12
        )

    def test_exact_peaks(self):
        for amplitudes, peak, tolerance in (
            ([0, 3 - 4j, 0, 0], 5.0, 1e-14),
            ([0, 1.0, 0.25, 0], 1.25, 1e-14),  # cos τ + ¼ cos 2τ at τ = 0
            ([-0.5, 1.0, 0, 0], 1.5, 1e-14),  # the mean counts, and so does the trough
            # cos τ − ⅑ cos 3τ has a quartic peak at τ = 0, where Newton's method is slow.
            ([0, 1.0, 0, -1 / 9], 8 / 9, 1e-12),
            ([0, 0, 0, 0], 0.0, 0.0),
        ):
            result = peak_amplitude(np.array(amplitudes, dtype=complex), (0, 1, 2, 3))
            np.testing.assert_allclose(result, peak, rtol=tolerance)

    def test_time_shift_and_units(self):
        turned = TRUTH * np.exp(0.77j * np.arange(4))
        peak = peak_amplitude(TRUTH, (0, 1, 2, 3))
        np.testing.assert_allclose(peak_amplitude(turned, (0, 1, 2, 3)), peak, rtol=1e-13)
        np.testing.assert_allclose(peak_amplitude(1e-9 * TRUTH, (0, 1, 2, 3)), 1e-9 * peak)

    def test_derivatives(self):
        def peak(parts):
            return peak_amplitude(jax.lax.complex(*jnp.split(parts, 2)), ORDERS)

        parts = np.array([1.0, 0.2, -0.1, -0.4, 0.1, 0.15])
        step = 1e-5
        ahead, behind = parts + step * np.eye(6), parts - step * np.eye(6)
        peaks, gradients = (jax.jit(jax.vmap(f)) for f in (peak, jax.grad(peak)))
        slopes = (peaks(ahead) - peaks(behind)) / (2 * step)
        # Central differences: rounding 1e-16 / step, truncation step².
        np.testing.assert_allclose(gradients(parts[None])[0], slopes, atol=1e-9)
        curvature = (gradients(ahead) - gradients(behind)) / (2 * step)
        np.testing.assert_allclose(jax.jit(jax.hessian(peak))(parts), curvature, atol=1e-8)
        assert np.isfinite(gradients(np.zeros((1, 6)))).all()

    def test_jit_and_vmap_agree(self):
        batch = np.random.default_rng(0).standard_normal((2, 3, 4)) + 0j
        orders = (0, 1, 2, 3)
        plain = peak_amplitude(batch, orders)
        assert plain.shape == (2, 3)
        mapped = jax.vmap(jax.vmap(lambda x: peak_amplitude(x, orders)))(batch)
        compiled = jax.jit(lambda x: peak_amplitude(x, orders))(batch)
        np.testing.assert_allclose(mapped, plain, rtol=1e-14)
        np.testing.assert_allclose(compiled, plain, rtol=1e-14)


class TestLoop:
    def test_area_is_the_power(self):
        force, velocity = 2.5, np.array([0.3 + 0.2j, 0.05 - 0.1j, 0.02j])
        loop = force_velocity_loop(force, velocity, ORDERS, 1001)
        # Displacement over one period by its own integral; the area of the loop, over the period.
        displacement = [v / (1j * k * OMEGA) for k, v in zip(ORDERS, velocity, strict=True)]
        x = sum(
            (d * np.exp(1j * k * loop.phase)).real
            for k, d in zip(ORDERS, displacement, strict=True)
        )
        area = 0.5 * np.sum((loop.force[1:] + loop.force[:-1]) * np.diff(x))
        # The trapezoidal rule on a periodic curve, step 2π/1000: error of order (2π/1000)².
        np.testing.assert_allclose(area * OMEGA / (2 * np.pi), loop.mean_power, rtol=1e-4)
        np.testing.assert_allclose(loop.mean_power, 0.5 * 2.5 * 0.3, rtol=1e-15)

    def test_is_closed_and_straight_at_resonance(self):
        loop = force_velocity_loop(2.0, np.array([0.4 + 0j]), (1,), 64)
        np.testing.assert_allclose(loop.velocity, 0.2 * loop.force, atol=1e-15)
        np.testing.assert_allclose(loop.force[0], loop.force[-1], atol=1e-14)
        lagging = force_velocity_loop(2.0, np.array([-0.4j]), (1,))
        np.testing.assert_allclose(
            (lagging.force / 2.0) ** 2 + (lagging.velocity / 0.4) ** 2, 1.0, rtol=1e-14
        )
        assert lagging.mean_power == 0.0

    def test_batch(self):
        forces = np.array([1.0, 2.0])
        loop = force_velocity_loop(forces, np.array([[0.1j], [0.2 + 0j]]), (1,), 11)
        assert loop.force.shape == loop.velocity.shape == (2, 11)
        np.testing.assert_allclose(loop.mean_power, [0.0, 0.2], atol=1e-16)

    def test_needs_the_fundamental(self):
        with pytest.raises(ValueError, match=r"`orders` must contain the fundamental, 1"):
            force_velocity_loop(1.0, np.array([0.1 + 0j]), (2,))
