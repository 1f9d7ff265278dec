"""Derivatives of every function of `sj.measure` that promises them, with failed members too."""

import dataclasses

import numpy as np
import pytest
from truths.derivatives import check_derivatives, numbers

import snrmjax as sj

ORDERS = (0, 1, 2, 3)
OMEGA = 2 * np.pi * 20.0
TIME = np.linspace(0.0, 0.21, 64)[:5]
RNG = np.random.default_rng(3)
AMPLITUDES = RNG.normal(size=(3, 4)) + 1j * RNG.normal(size=(3, 4))


def moved(relative):
    """Twelve complex amplitudes, changed in magnitude by twelve numbers."""
    return AMPLITUDES * (1 + relative.reshape(3, 4))


def of_signals(relative):
    amplitudes = moved(relative[:12])
    loop = sj.measure.force_velocity_loop(2.0, amplitudes, ORDERS, n_points=5)
    return numbers(
        sj.measure.synthesise(amplitudes, ORDERS, OMEGA * (1 + relative[12]), TIME),
        sj.measure.peak_amplitude(amplitudes, ORDERS),
        loop.velocity,
        loop.mean_power,
    )


def test_signals():
    check_derivatives(of_signals, 13)


def of_indicators(relative, data):
    velocity = data.velocity * (1 + relative[:3, None] + 1j * relative[3:6, None])
    changed = dataclasses.replace(data, velocity=velocity)
    return numbers(
        sj.measure.appropriation_of(changed),
        sj.measure.nnm_appropriation(velocity[..., None], (1,)),
        sj.measure.nnm_appropriation(changed.harmonics * (1 + 1j * relative[6]), (2, 3)),
    )


@pytest.mark.parametrize("broken", [None, 0.0, np.nan])
def test_indicators(broken):
    velocity = AMPLITUDES[:, :2].copy()
    measured = np.ones((3, 2), dtype=bool)
    if broken is not None:
        velocity[1], measured[1] = broken, False
    data = sj.measure.steady_states(
        [1, 1, 1],
        np.full(3, OMEGA),
        np.ones(3),
        velocity,
        sensors=("a", "b"),
        measured=measured,
        harmonics=RNG.normal(size=(3, 2, 2)) + 1j * RNG.normal(size=(3, 2, 2)),
        harmonic_order=(2, 3),
    )
    # State 1 fails, but for its harmonics, which count.
    check_derivatives(of_indicators, 7, data, failed=[] if broken is None else [1, 4])
