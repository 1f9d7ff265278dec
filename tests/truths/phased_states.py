"""States of one mode with set changes of stiffness and damping, at set phases, and readings."""

import numpy as np

import snrmjax.identify.test_model.states as test_states
from snrmjax.diagnose.naming.hypotheses import best_hypotheses
from snrmjax.diagnose.naming.parts import naming_of
from snrmjax.diagnose.readings import LinearTest, ModelMotion, readings_of
from snrmjax.model.effect_metadata import MotionScales
from snrmjax.model.effects import EFFECTS

OMEGA, RATIO, SHAPE = 500.0, 0.01, 2.0


PHASES = (-60.0, -40, -20, 0, 20, 40, 60)
LEVEL_STD = (1e-3, 1e-3, 1e-4, 1e-3)


def states_of(
    stiffness, damping, *, noise=2e-3, seed=0, levels=5, phases=PHASES, level_std=LEVEL_STD
):
    """States of one mode at some levels of amplitude, off resonance by set phases, with noise.

    Arguments: relative changes of ω₀² and of 2ζ as functions of amplitude over the largest.
    """
    rng = np.random.default_rng(seed)
    amplitude = np.geomspace(1e-4, 1e-3, levels)
    phase = np.radians(phases)
    a, turn = (part.ravel() for part in np.meshgrid(amplitude, phase, indexing="ij"))
    level = np.repeat(np.arange(levels), len(phase))
    x = a / a.max()
    squared = OMEGA**2 * (1 + stiffness(x))
    # At the velocity phase θ: Re Z = tan θ · Im Z, and Im Z = Ω δ.
    omega = np.sqrt(squared)
    for _ in range(50):
        lost = OMEGA * (2 * RATIO + damping(x, omega / OMEGA))
        omega = np.sqrt(squared - np.tan(turn) * omega * lost)
    z = squared - omega**2 + 1j * omega * lost
    constant = SHAPE**2
    velocity = 1j * omega * a * np.exp(1j * (turn - np.pi / 2))
    force = np.abs(z) * a / constant
    velocity = velocity * np.exp(noise * (rng.normal(size=a.size) + 1j * rng.normal(size=a.size)))
    errors = np.tile([0.1 * noise, noise, noise], (a.size, 1))
    return test_states.TestStates(
        *(level, omega, force, velocity, errors, True, constant, level_std, 0.01)
    )


def readings(stiffness, damping, harmonics=None, **settings):
    """What the states read beyond the linear mode; `harmonics` makes records of the states."""
    states = states_of(stiffness, damping, **settings)
    scales = MotionScales(
        *(float(np.median(states.amplitude)) / SHAPE, float(states.amplitude.max()) / SHAPE, OMEGA),
        *(0.01 * OMEGA**2, 1e-4, float(states.force.min()), RATIO),
    )
    linear = LinearTest(OMEGA, RATIO, 0.0, 0.0, 0.01, SHAPE, 1.0, scales)
    recorded = None if harmonics is None else harmonics(states)
    return readings_of(
        states, np.linspace(0, 1, len(states.level)), linear_motion, linear, recorded
    )


def linear_motion(_, omega):
    """That of the linear mode alone, without any other harmonic."""
    return ModelMotion(dynamic(omega)[None], np.zeros((1, len(omega), 2), complex))


def dynamic(omega):
    """Dynamic stiffness of the linear mode."""
    return OMEGA**2 - omega**2 + 2j * RATIO * OMEGA * omega


def named(stiffness, damping, harmonics=None, **settings):
    """The problem of such a test, and what explains it."""
    problem, cells = best_hypotheses(readings(stiffness, damping, harmonics, **settings), EFFECTS)
    return problem, naming_of(problem, cells)


def nothing(x, _=None):
    """No change."""
    return 0 * x
