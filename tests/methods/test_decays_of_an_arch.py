"""Decays of an arch (even terms, a drifting mean, heavy damping) by all decay methods."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import snrmjax as sj

REST, RATIO, SIZE, RATE = 2 * np.pi * 65.0, 0.05, 4e-4, 4000.0  # rad/s, 1, m, Hz
EVEN, CUBIC = 0.6 / SIZE, 0.25 / SIZE**2


def restoring_force(q):
    return REST**2 * (q + EVEN * q**2 + CUBIC * q**3)


@pytest.fixture(scope="module")
def decay():
    time = np.arange(0, 0.4, 1 / RATE)
    found = solve_ivp(
        lambda _, state: (state[1], -restoring_force(state[0]) - 2 * RATIO * REST * state[1]),
        *((0, time[-1]), (SIZE, 0.0)),
        t_eval=time,
        rtol=1e-10,
        atol=1e-14,
    )
    noise = 1e-4 * found.y[1].max() * np.random.default_rng(0).standard_normal(len(time))
    return time, found.y[1] + noise


@pytest.fixture(scope="module")
def mode():
    """Fundamental velocity, natural frequency and damping ratio of undamped motions."""

    def turning_point(_, state):
        return state[1]

    turning_point.terminal, turning_point.direction = True, 1.0
    rows = []
    for amplitude in np.linspace(0.03, 0.9, 12) * SIZE:
        found = solve_ivp(
            lambda _, state: (state[1], -restoring_force(state[0])),
            *((0, 0.02), (amplitude, -1e-12)),
            events=turning_point,
            dense_output=True,
            rtol=1e-10,
            atol=1e-14,
        )
        omega = np.pi / found.t_events[0][0]
        angle = np.pi * (np.arange(200) + 0.5) / 200
        speed = -found.sol(angle / omega)[1]
        fundamental = 2 * np.mean(speed * np.sin(angle))
        dissipation = 4 * RATIO * REST * np.mean(speed**2) / fundamental**2
        rows.append((fundamental, omega, dissipation / (2 * omega)))
    return np.array(rows).T


# Worst relative errors of frequency and damping: a motion that decays by a quarter per cycle has
# few extremes per local line; a surface is exact but for noise (1e-4) and the first and last
# cycles; the manifold's polynomials are truncated at degree 7, which affects large amplitudes.
@pytest.mark.parametrize(
    ("method", "frequency", "damping"),
    [
        (sj.methods.resonant_decay, 5e-3, 0.03),
        (sj.methods.restoring_force, 5e-4, 0.01),
        pytest.param(
            lambda *record, **floor: sj.methods.ssm(*record, terms=4, **floor),
            *(5e-4, 0.015),
            marks=pytest.mark.long,
        ),
    ],
    ids=["resonant_decay", "restoring_force", "ssm"],
)
def test_a_softening_mode_of_even_terms(decay, mode, method, frequency, damping):
    result = method(*decay, least_amplitude=0.05 * mode[0, -1])
    good = (
        result.has_result & (result.velocity < mode[0, -1]) & (result.velocity > 0.1 * mode[0, -1])
    )
    assert good.sum() > 2
    omega, ratio = (np.interp(result.velocity[good], mode[0], row) for row in mode[1:])
    np.testing.assert_allclose(result.natural_frequency[good], omega, rtol=frequency)
    np.testing.assert_allclose(result.damping_ratio[good], ratio, rtol=damping)
