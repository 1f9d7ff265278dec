"""Joint fits of structures whose damping depends on more than the amplitude."""

import numpy as np
import pytest
from scipy.optimize import brentq

import snrmjax as sj

HERTZ = 2 * np.pi
OWN, MASS = 80.0 * HERTZ, 2.0  # rad/s, kg
FORCES = (0.2, 0.45, 0.9, 1.5)  # N


def squared_frequency(amplitude: np.ndarray) -> np.ndarray:
    """ω̃² of a joint that opens: softening with the displacement amplitude (m)."""
    return OWN**2 * (1 - 0.012 * amplitude / (amplitude + 2e-4))


def damping(amplitude: np.ndarray, phase: np.ndarray, asymmetry: float) -> np.ndarray:
    """2ζ̃ω̃ that grows with amplitude, and off resonance depends on phase by `asymmetry`."""
    side = np.where(phase > 0, 1.0, -0.4) * asymmetry * np.sin(phase) ** 2
    return 2 * OWN * 0.002 * (1 + amplitude / 1.5e-4) * (1 + side)


def steady_state(force: float, phase: float, asymmetry: float) -> tuple[float, float]:
    """Frequency (rad/s) and velocity (m/s) with this phase: the force balance, solved for both."""

    def frequency(amplitude: float) -> float:
        tangent = damping(amplitude, phase, asymmetry) * np.tan(phase)
        return 0.5 * (-tangent + np.sqrt(tangent**2 + 4 * squared_frequency(amplitude)))

    def excess(amplitude: float) -> float:
        speed = frequency(amplitude) * amplitude
        return MASS * damping(amplitude, phase, asymmetry) * speed - force * np.cos(phase)

    amplitude = brentq(excess, 1e-9, 1e-1, xtol=1e-16)
    return frequency(amplitude), frequency(amplitude) * amplitude


def rows_of(asymmetry: float, seed: int, gain: tuple[float, ...] = (1, 1, 1, 1)) -> tuple:
    """Level, frequency, force, velocity of a test; each level's true force has a `gain`.

    Velocities and phases have 0.2 % noise.
    """
    random = np.random.default_rng(seed)
    rows = [
        (level, *steady_state(force * own, phase, asymmetry), phase, force)
        for level, (force, own) in enumerate(zip(FORCES, gain, strict=True), start=1)
        for phase in np.radians(np.linspace(-70, 70, 25))
    ]
    level, frequency, speed, phase, force = np.array(rows).T
    noise = 0.002 * random.standard_normal((2, len(rows)))
    return level.astype(int), frequency, force, speed * np.exp(noise[0] + 1j * (phase + noise[1]))


def modes() -> sj.model.LinearModes:
    """The linear mode of a low-amplitude test."""
    return sj.model.linear_modes([OWN], [0.002], [[MASS**-0.5]], [MASS**-0.5])


@pytest.mark.parametrize("asymmetry", [pytest.param(0.0, marks=pytest.mark.long), 0.4])
def test_bands_hold_what_was_measured_at_resonance(asymmetry):
    level, frequency, force, velocity = rows_of(asymmetry, seed=5)
    fit = sj.fit_jointly(sj.measure.steady_states(level, frequency, force, velocity), modes())
    own, speed = np.array([steady_state(force, 0.0, asymmetry) for force in FORCES]).T
    found = sj.identify.fitted_values(fit, speed)
    assert np.max(np.abs(found.natural_frequency - own) / found.natural_frequency_std) < 2.5
    # Fitted as a phase error, the asymmetry would shift all levels by 30 mHz.
    off = np.asarray(found.natural_frequency) - own
    assert abs(np.mean(off)) < 0.01 * HERTZ
    # Correlated residuals reduce the independent states: curves are smoother than the truth.
    assert np.max(np.abs(off)) < 0.025 * HERTZ
    ratio = damping(speed / own, np.zeros(len(own)), asymmetry) / (2 * own)
    assert np.max(np.abs(found.damping_ratio - ratio) / found.damping_ratio_std) < 2.5
    assert not np.any(fit.noise.level_std[:2])  # the instruments have no errors


@pytest.mark.long
def test_a_free_force_gain_leaves_the_velocities_unscaled():
    gains = (1.06, 1.02, 0.98, 0.94)
    level, frequency, force, velocity = rows_of(0.0, seed=6, gain=gains)
    none = np.full(len(level), np.nan)
    data = sj.measure.steady_states(level, frequency, none, velocity, drive=force / 3)
    fit = sj.fit_jointly(data, modes())
    assert fit.noise.level_std[0] > 0.01
    # Gains have mean 1; their common part is the instrument's.
    assert float(np.exp(fit.unknowns.log_force_gain)) == pytest.approx(3.0, rel=0.02)
    assert fit.largest[1] == pytest.approx(np.max(np.abs(velocity)), rel=1e-12)
    (note,) = (note for note in fit.notes if note.get("of") == "forces")
    assert note["levels"] == (1, 2, 3, 4)
    assert note["change"][0] > 0
