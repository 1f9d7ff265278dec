"""Levels that differ by known errors: their states, and where each has its resonance."""

from typing import NamedTuple

import numpy as np
from truths.exact_states import CONSTANT, damping, squared

STD = {"gain": 0.02, "stiffness": 0.004, "damping": 0.06}  # 1σ of levels, relative
NOISE = 0.002
FORCES = (0.05, 0.12, 0.25, 0.45, 0.7, 1.0)  # of the largest, N
LARGEST = 2.8  # N


class Level(NamedTuple):
    """One level's force and errors."""

    force: float
    gain: float
    stiffness: float
    damping: float

    def resonance(self):
        """Ω and recorded velocity of the phase resonance, by bisection."""
        low, high = 0.0, 5e-3
        for _ in range(100):
            x = 0.5 * (low + high)
            omega = np.sqrt(squared(x) * (1 + self.stiffness))
            needed = x * omega * damping(x * omega) * (1 + self.damping) / CONSTANT
            low, high = (x, high) if needed < self.force else (low, x)
        return omega, x * omega * np.exp(self.gain)


def drawn_levels(rng):
    """Levels of one test."""
    spread = np.array([STD[name] for name in ("gain", "stiffness", "damping")])
    return [Level(LARGEST * one, *(spread * rng.normal(size=3))) for one in FORCES]


def states_of(levels, rng, per_level=9):
    """Noisy states within 50° of resonance: X and Ω from the closed form at the level's force."""
    rows = []
    for number, one in enumerate(levels):
        for phase in np.radians(np.linspace(-50, 50, per_level)):
            low, high = 0.0, 5e-3
            for _ in range(60):
                x = 0.5 * (low + high)
                own = squared(x) * (1 + one.stiffness)
                omega = np.sqrt(own)
                for _ in range(30):  # (ω̃² − Ω²) = Ωδ tan φ
                    loss = damping(x * omega) * (1 + one.damping)
                    omega = np.sqrt(own - omega * loss * np.tan(phase))
                needed = (own - omega**2 + 1j * omega * loss) * x / CONSTANT
                low, high = (x, high) if abs(needed) < one.force else (low, x)
            velocity = x * omega * np.exp(one.gain + 1j * phase)
            velocity *= np.exp(NOISE * (rng.normal() + 1j * rng.normal()))
            rows.append((number, omega, one.force, velocity))
    level, omega, force, velocity = (np.array(column) for column in zip(*rows, strict=True))
    return level, omega.real, force.real, velocity


def measured(levels, rng):
    """`SteadyStates` of levels, their noise stated."""
    import snrmjax as sj

    level, omega, force, velocity = states_of(levels, rng)
    n = len(level)
    return sj.measure.steady_states(
        *(level, omega, force, velocity),
        velocity_std=NOISE * np.abs(velocity),
        phase_std=np.full((n, 1), NOISE),
        force_std=1e-4 * force,
    )
