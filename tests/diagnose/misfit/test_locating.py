"""The power of amplitude that a free curve follows, from curves whose power is known."""

import numpy as np

from snrmjax.diagnose.misfit.locating import power_of_amplitude

AMPLITUDE = np.log(np.array([0.12, 0.3, 0.5, 0.7, 0.85, 1.0]))
OWN, SHARED = 0.05, 0.3  # 1σ of every knot, and of a common offset
COVARIANCE = OWN**2 * np.eye(6) + SHARED**2 * np.ones((6, 6))


def drawn(rng, power):
    """A free curve, one at its largest, with its errors."""
    exact = np.exp(power * AMPLITUDE)
    return exact / exact.max() + OWN * rng.normal(size=6) + SHARED * rng.normal()


def test_the_power_and_its_error_are_right_with_an_unknown_offset():
    rng = np.random.default_rng(0)
    for power in (1.0, 2.0, 4.0, -1.0):
        found = [power_of_amplitude(AMPLITUDE, drawn(rng, power), COVARIANCE) for _ in range(200)]
        fits = np.array([pair for pair in found if pair[0] is not None])
        assert len(fits) > 180
        off = (fits[:, 0] - power) / fits[:, 1]
        assert abs(np.mean(off)) < 0.25
        assert 0.8 < np.std(off) < 1.25


def test_individually_insignificant_changes_are_kept():
    """Significant changes alone (beyond 2σ) would give too small a power."""
    rng = np.random.default_rng(1)
    covariance = 0.15**2 * np.eye(6)
    found = [
        power_of_amplitude(AMPLITUDE, np.exp(2 * AMPLITUDE) + 0.15 * rng.normal(size=6), covariance)
        for _ in range(300)
    ]
    fits = np.array([pair for pair in found if pair[0] is not None])
    assert np.median(fits[:, 0]) > 1.85
    assert np.mean(np.abs(fits[:, 0] - 2.0) < 1.96 * fits[:, 1]) > 0.9


def test_a_curve_of_no_power_has_none():
    rng = np.random.default_rng(2)
    covariance = OWN**2 * np.eye(6)
    peak = np.array([0.0, 0.8, 1.0, 0.6, 0.3, 0.1])
    assert power_of_amplitude(AMPLITUDE, peak, covariance) == (None, None)
    assert power_of_amplitude(AMPLITUDE, OWN * rng.normal(size=6), covariance) == (None, None)


def softened(amplitude):
    """Fundamental amplitude and ω² of q̈ + q + q² = 0, whose motion begins at rest at −amplitude.

    By quadrature over the angle θ in q = middle − half·cos θ between the turning points.
    """
    theta = (np.arange(400) + 0.5) * np.pi / 400
    low = -amplitude
    # ½q² + ⅓q³ has one value at both ends: the other root besides q = low, within the well.
    high = np.max(np.roots([1 / 3, 0.5 + low / 3, low * (0.5 + low / 3)]).real)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    q = middle - half * np.cos(theta)
    # 2(V(low) − V(q)) = (q − low)(high − q)(⅔(q + low + high) + 1)
    slow = 1 / np.sqrt(2 / 3 * (q + low + high) + 1)
    time = np.cumsum(slow) - 0.5 * slow
    omega = 1 / np.mean(slow)
    phase = np.pi * time / np.sum(slow)
    # Over half a period in time; the other half mirrors it.
    return abs(2 * np.sum(q * np.cos(phase) * slow) / np.sum(slow)), omega**2
