"""Fourier bases against numpy's FFT and against the time signals themselves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from snrmjax.simulate.balance.harmonics import (
    alias_free_samples,
    displacement_phasors,
    harmonic_basis,
    squared_orders,
    tangent_blocks,
    velocity_phasors,
)

# Sums of at most a hundred terms of order one.
ROUNDING = 1e-13


def signal(coefficients, tau):
    """X₀ + Σ a_h cos hτ + b_h sin hτ and its derivative, written out."""
    value = np.full(tau.shape, coefficients[0])
    rate = np.zeros(tau.shape)
    for h in range(1, (len(coefficients) - 1) // 2 + 1):
        a, b = coefficients[2 * h - 1], coefficients[2 * h]
        value = value + a * np.cos(h * tau) + b * np.sin(h * tau)
        rate = rate - h * a * np.sin(h * tau) + h * b * np.cos(h * tau)
    return value, rate


@pytest.mark.parametrize(("order", "n_samples"), [(1, 4), (3, 7), (5, 24), (9, 41)])
def test_basis_samples_analyses_and_differentiates(order, n_samples):
    basis = harmonic_basis(order, n_samples)
    x = np.random.default_rng(order).normal(size=2 * order + 1)
    tau = 2 * np.pi * np.arange(n_samples) / n_samples
    value, rate = signal(x, tau)
    np.testing.assert_allclose(basis.synthesis @ x, value, atol=ROUNDING)
    np.testing.assert_allclose(basis.synthesis @ basis.derivative @ x, rate, atol=10 * ROUNDING)
    np.testing.assert_allclose(basis.analysis @ value, x, atol=ROUNDING)
    # The analysis of any samples, not only of what the basis spans, is their discrete transform.
    samples = np.random.default_rng(7).normal(size=n_samples)
    spectrum = np.fft.rfft(samples)[: order + 1] * 2 / n_samples
    wanted = np.zeros(2 * order + 1)
    wanted[0] = spectrum[0].real / 2
    wanted[1::2], wanted[2::2] = spectrum[1:].real, -spectrum[1:].imag
    np.testing.assert_allclose(basis.analysis @ samples, wanted, atol=ROUNDING)
    twice = basis.derivative @ basis.derivative
    np.testing.assert_allclose(-twice, np.diag(squared_orders(order)), atol=ROUNDING)


@pytest.mark.parametrize("cosine_only", [False, True])
@pytest.mark.parametrize(("order", "n_samples"), [(1, 4), (3, 7), (5, 24), (6, 25)])
def test_blocks_are_the_tangent_of_sampling_multiplying_and_analysing(
    order, n_samples, cosine_only
):
    basis = harmonic_basis(order, n_samples, cosine_only=cosine_only)
    entries = np.random.default_rng(1).normal(size=(n_samples, 2))
    blocks = tangent_blocks(basis, jnp.asarray(entries))
    for number in range(2):
        wanted = basis.analysis @ np.diag(entries[:, number]) @ basis.synthesis
        np.testing.assert_allclose(blocks[:, :, number], wanted, atol=ROUNDING)


def test_cosines_are_the_even_part_of_the_basis():
    whole, even = harmonic_basis(4, 20), harmonic_basis(4, 20, cosine_only=True)
    rows = [0, 1, 3, 5, 7]
    np.testing.assert_array_equal(even.synthesis, whole.synthesis[:, rows])
    np.testing.assert_array_equal(even.analysis, whole.analysis[rows])
    assert not np.any(even.derivative)
    assert squared_orders(4).tolist() == [0, 1, 1, 4, 4, 9, 9, 16, 16]
    assert squared_orders(4, cosine_only=True).tolist() == [0, 1, 4, 9, 16]


@pytest.mark.parametrize(("order", "degree"), [(1, 1), (5, 3), (9, 3), (4, 5)])
def test_polynomials_are_sampled_without_aliasing(order, degree):
    n_samples = alias_free_samples(order, degree)
    assert n_samples % 4 == 0
    assert n_samples >= 4 * order + 4
    x = np.random.default_rng(3).normal(size=2 * order + 1)

    def coefficients(count):
        basis = harmonic_basis(order, count)
        return basis.analysis @ (basis.synthesis @ x) ** degree

    exact = coefficients(16 * n_samples)
    scale = np.abs(exact).max()
    np.testing.assert_allclose(coefficients(n_samples), exact, atol=ROUNDING * scale)
    if degree >= 3:  # with (degree + 1)·order samples the highest harmonic aliases onto itself
        wrong = coefficients((degree + 1) * order) - exact
        assert np.abs(wrong[-2:]).max() > 1e3 * ROUNDING * scale


def test_phasors_give_the_time_signal_at_the_sensors():
    order, omega = 4, 3.7
    x = np.random.default_rng(5).normal(size=(2 * order + 1, 2))
    shape = np.array([[1.0, -0.5], [0.2, 3.0], [0.0, 1.0]])
    t = np.linspace(0.0, 2 * np.pi / omega, 33)
    value, rate = zip(*(signal(x[:, m], omega * t) for m in range(2)), strict=True)
    turning = np.exp(1j * omega * np.outer(t, np.arange(order + 1)))
    q = (turning @ np.asarray(displacement_phasors(jnp.asarray(x)))).real
    np.testing.assert_allclose(q, np.stack(value, axis=1), atol=ROUNDING)
    phasors = velocity_phasors(jnp.asarray(x), jnp.asarray(omega), jnp.asarray(shape))
    v = (turning @ np.asarray(phasors)).real
    np.testing.assert_allclose(v, omega * np.stack(rate, axis=1) @ shape.T, atol=100 * ROUNDING)
    assert not np.any(phasors[0])  # the mean has no velocity

    traces = []

    @jax.jit
    def many(x, omega):
        traces.append(1)
        return jax.vmap(velocity_phasors, in_axes=(0, 0, None))(x, omega, jnp.asarray(shape))

    batch = jnp.stack([jnp.asarray(x), -2.0 * jnp.asarray(x)])
    frequency = jnp.array([omega, 1.0])
    wanted = velocity_phasors(batch, frequency, jnp.asarray(shape))
    np.testing.assert_allclose(many(batch, frequency), wanted, atol=100 * ROUNDING)
    np.testing.assert_allclose(wanted[0], phasors, atol=100 * ROUNDING)
    many(2 * batch, frequency)
    assert len(traces) == 1
