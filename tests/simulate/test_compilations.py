"""Public functions do not recompile for other floating-point numbers."""

import jax
import numpy as np
import pytest

import snrmjax as sj

CONTROL = sj.simulate.StepControl


def oscillator(ratio):
    modes = sj.model.linear_modes([2.0], [ratio], [[1.0]], [1.5])
    potential = sj.model.polynomial_potential({"111": 0.05, "1111": 0.3 + ratio}, 1)
    return sj.model.structure(modes, potential)


def motion(k):
    x = np.zeros((7, 1))
    x[1] = 0.01 + 0.001 * k
    return x, 1.5 + 0.01 * k


# Each is called with 0.0, 1.0 and 2.0: no two calls have a number in common.
VERBS = {
    "forced_response": lambda k: sj.forced_response(
        *(oscillator(0.02 + 0.001 * k), 0.1 + 0.01 * k, 1.0 + 0.1 * k, 3.0 + 0.1 * k),
        harmonic_order=3,
        steps=CONTROL(largest=0.05 + 0.01 * k, largest_miss=0.3 + 0.01 * k),
    ),
    "nonlinear_normal_mode": lambda k: sj.nonlinear_normal_mode(
        oscillator(0.02 + 0.001 * k), 2.4 + 0.1 * k, harmonic_order=3
    ),
    "damped_normal_mode": lambda k: sj.simulate.damped_normal_mode(
        oscillator(0.02 + 0.001 * k), 1.0 + 0.1 * k, harmonic_order=3
    ),
    "phase_controlled": lambda k: sj.simulate.phase_controlled(
        oscillator(0.02 + 0.001 * k), 0.1 + 0.01 * k, harmonic_order=3
    ),
    "response_controlled": lambda k: sj.simulate.response_controlled(
        oscillator(0.02 + 0.001 * k), 0.5 + 0.1 * k, 1.7 + 0.1 * k, 2.5 + 0.1 * k, harmonic_order=3
    ),
    "periodic_motion": lambda k: sj.simulate.periodic_motion(
        oscillator(0.02 + 0.001 * k), 0.02 + 0.001 * k, motion(k), value=1.5 + 0.01 * k
    ),
    "follow_event": lambda k: sj.simulate.follow_event(
        *(oscillator(0.02 + 0.001 * k), 0.1 + 0.01 * k, motion(k)),
        kind="phase_resonance",
        parameter="mode_1.damping_ratio",
        to=(0.01 + 0.001 * k, 0.04 + 0.001 * k),
        steps=CONTROL(largest=0.05 + 0.01 * k),
    ),
    "solve_at_frequency": lambda k: sj.simulate.solve_at_frequency(
        oscillator(0.02 + 0.001 * k), 0.02 + 0.001 * k, 1.5 + 0.01 * k, motion(k)[0][None]
    ),
}


@pytest.mark.parametrize("verb", VERBS)
def test_other_numbers_compile_nothing(verb, compilations):
    jax.clear_caches()  # of what other tests compiled
    VERBS[verb](0.0)
    assert len(compilations) > 0  # the counter works
    del compilations[:]
    VERBS[verb](1.0)
    VERBS[verb](2.0)
    assert len(compilations) == 0
