"""Measured states as the model of a test sees them: the motion of one mode, and its errors."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from snrmjax.identify.test_model.priors import (
    FORCE_TO_VELOCITY,
    NEAR_ONE_PHASE,
    ONE_FORCE,
    ONE_PHASE,
)

RECORDED = 3
"""Kinds of errors of a record; a fourth is of the structure."""

LEVEL_ERRORS = ("gain", "phase", "stiffness", "damping")
"""What all states of a level may have in common, relative or in rad."""


class TestStates(NamedTuple):
    """States of one mode, with all that moves beside it taken away.

    With X = V/(iΩ) and the modal constant A a state says Z = FA/X = κ(K(a) − Ω² + iΩδ(a)), where
    κ is the modal mass over the model's; δ = 2ζ̃ω̃ and K = ω̃² belong to the amplitude a = |X|.
    """

    level: Int[np.ndarray, " state"]  # 0, 1, …
    frequency: Float[np.ndarray, " state"]  # rad/s
    force: Float[np.ndarray, " state"]  # N, or V where only the drive is known
    velocity: Complex[np.ndarray, " state"]  # m/s
    # 1σ of the logarithms of force and velocity and of the phase (rad), and, if there is a fourth,
    # of a relative stiffness that wanders from state to state; in parts where not stated.
    errors: Float[np.ndarray, "state input"]
    stated: bool  # whether these were
    constant: float | Float[np.ndarray, " state"]  # A, 1/kg, as it drives each state
    level_std: tuple[float, float, float, float]  # stated 1σ of `LEVEL_ERRORS`; zero: not stated
    mass_std: float  # relative 1σ of κ; zero where it is known
    force_is_free: bool = False  # whether a gain of the force is: a level's gain is then its own
    # 1σ of a phase (rad) that all records share, and of an offset of the force over the smallest.
    phase_std: float = 0.0
    offset_std: float = 0.0
    # What a relative change of stiffness may be in proportion to, as the time of a test or another
    # structure, and 1σ of that change per unit of it.
    trend: Float[np.ndarray, " state"] | float = 0.0
    trend_std: float = 0.0
    # 1σ of how what moves both curves goes with the forcing frequency (`priors.OFF_RESONANCE`).
    off_resonance_std: tuple[float, float] = (0.0, 0.0)
    # Squared natural frequency (rad²/s²) and modal damping (1/s) of a linear test, which the
    # smallest amplitude has about (`priors.NEAR_LINEAR`); None: not known, or not to count.
    linear: tuple[float, float] | None = None
    # What other modes move beside it for 1σ of their linear parameters, m/s; None: all are known.
    beside: Complex[np.ndarray, "state deviation"] | None = None

    @property
    def n_levels(self) -> int:
        """How many levels."""
        return int(self.level.max(initial=-1)) + 1

    @property
    def phase(self) -> Float[np.ndarray, " state"]:
        """Phases (rad) from their mean one on."""
        direction = self.velocity / np.abs(self.velocity)
        return np.angle(direction / np.mean(direction))

    @property
    def of_one_phase(self) -> bool:
        """Whether all states have the same phase."""
        return bool(np.max(np.abs(self.phase)) < ONE_PHASE)

    @property
    def near_one_phase(self) -> bool:
        """Whether their phase may have been controlled."""
        return bool(np.max(np.abs(self.phase)) < NEAR_ONE_PHASE)

    @property
    def amplitude(self) -> Float[np.ndarray, " state"]:
        """Displacement amplitudes, m."""
        return np.abs(self.velocity) / self.frequency

    @property
    def common_to_levels(self) -> Float[np.ndarray, "level direction"]:
        """Orthonormal: a constant, and a line over the logarithm of the levels' forces, which
        curves of amplitude have as well; of levels of one force, a constant alone.
        """
        level = np.arange(self.n_levels)
        along = np.log([np.median(self.force[self.level == k]) for k in level])
        constant, apart = np.ones(len(level)), np.ptp(along) > ONE_FORCE
        return np.linalg.qr(np.stack([constant, along - along[0]][: 1 + apart], axis=1))[0]


def state_errors(
    stated: Float[np.ndarray, "state input"],
) -> tuple[Float[np.ndarray, "state input"], bool]:
    """1σ of every state's errors, and whether they are stated.

    Where a state has none, all get parts of one unknown size. A force of which no error is stated
    gets a share of the velocity's: without any, a state near a fold would be exact in one
    direction.
    """
    known = bool(np.all(np.isfinite(stated)) and np.all(stated[:, 1:] > 0))
    errors = stated.copy() if known else np.tile([0.0, 1.0, 1.0], (len(stated), 1))
    errors[:, 0] = np.where(errors[:, 0] > 0, errors[:, 0], FORCE_TO_VELOCITY * errors[:, 1])
    return errors, known
