"""The true modes of a benchmark of coupled sets, against closed forms."""

import numpy as np
import pytest
from scipy.special import ellipj, ellipk

OWN, RATIO = 2 * np.pi * np.array([40.0, 121.0]), np.array([0.004, 0.003])
SHAPE = np.array([[1.5, 0.8], [0.7, -1.2]])


@pytest.fixture(scope="module")
def score(of_benchmark):
    return of_benchmark("coupled_sets/score")


def test_alone_the_true_mode_is_the_duffing_oscillators(score):
    size = 1e-3
    cubic = 0.05 * OWN[0] ** 2 / size**2  # of 4 · V's coefficient
    key = {"omega": OWN, "zeta": RATIO, "shape": SHAPE, "terms": {"1111": cubic / 4}}
    omega = np.sqrt(OWN[0] ** 2 + cubic * size**2)
    modulus = cubic * size**2 / (2 * omega**2)
    period = 4 * ellipk(modulus) / omega
    t = period * np.arange(4096) / 4096
    motion = size * ellipj(omega * t, modulus)[1]
    fundamental = 2 * np.mean(motion * np.cos(2 * np.pi * t / period))
    speed = SHAPE[0, 0] * fundamental * 2 * np.pi / period
    frequency, damping = score.true_mode(key, 0, np.linspace(0.1, 1.0, 10) * speed)[:, -1]
    assert frequency == pytest.approx(2 * np.pi / period, rel=1e-7)
    assert damping == pytest.approx(RATIO[0] * OWN[0] * period / (2 * np.pi), rel=1e-7)


def test_where_both_modes_decay_alike_so_does_the_coupled_one(score):
    ratio = 0.004 * OWN[0] / OWN  # both lose 2 · 0.004 · OWN[0] of their energy a second
    terms = {"1111": 2e8 * OWN[0] ** 2 * 1e-4, "1112": 3e3 * OWN[0] ** 2}
    key = {"omega": OWN, "zeta": ratio, "shape": SHAPE, "terms": terms}
    frequency, damping = score.true_mode(key, 1, np.linspace(0.01, 0.15, 15))
    assert frequency[-1] > 1.001 * OWN[0]
    np.testing.assert_allclose(damping * frequency, ratio[0] * OWN[0], rtol=1e-7)
