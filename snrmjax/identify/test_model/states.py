"""Measured states as the model of a test takes them: the motion of one mode, and its errors."""

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
"""Kinds of errors of a record; a fourth is the structure's own."""

LEVEL_ERRORS = ("gain", "phase", "stiffness", "damping")
"""Errors that all states of a level share, relative or in rad."""


class TestStates(NamedTuple):
    """States of one mode, with the other modes' response subtracted.

    With X = V/(iΩ) and the modal constant A, each state gives Z = FA/X = κ(K(a) − Ω² + iΩδ(a)),
    where κ is the modal mass over the model's; δ = 2ζ̃ω̃ and K = ω̃² are functions of a = |X|.
    """

    level: Int[np.ndarray, " state"]  # 0, 1, …
    frequency: Float[np.ndarray, " state"]  # rad/s
    force: Float[np.ndarray, " state"]  # N, or V where only the drive is known
    velocity: Complex[np.ndarray, " state"]  # m/s
    # 1σ of the logarithms of force and velocity, of the phase (rad) and, in a fourth column, of the
    # state-to-state scatter of the stiffness (relative); only their ratios count where not stated.
    errors: Float[np.ndarray, "state input"]
    stated: bool  # whether these are stated
    constant: float | Float[np.ndarray, " state"]  # A, 1/kg, of each state
    level_std: tuple[float, float, float, float]  # stated 1σ of `LEVEL_ERRORS`; zero: not stated
    mass_std: float  # relative 1σ of κ; zero where it is known
    force_is_free: bool = (
        False  # whether the force gain is unknown: level gains are then the force's
    )
    # 1σ of a phase error (rad) of all records, and of a force offset over the smallest force.
    phase_std: float = 0.0
    offset_std: float = 0.0
    # Covariate of a relative stiffness change, as time or another structure, and 1σ of the change
    # per unit of it.
    trend: Float[np.ndarray, " state"] | float = 0.0
    trend_std: float = 0.0
    # 1σ of both curves' exponents in the forcing frequency (`priors.OFF_RESONANCE`).
    off_resonance_std: tuple[float, float] = (0.0, 0.0)
    # Squared natural frequency (rad²/s²) and modal damping (1/s) of a linear test, a prior for the
    # smallest amplitude (`priors.NEAR_LINEAR`); None: unknown, or not to be used.
    linear: tuple[float, float] | None = None
    # Velocity of the other modes per 1σ of their linear parameters, m/s; None: all are known.
    other_modes: Complex[np.ndarray, "state deviation"] | None = None

    @property
    def n_levels(self) -> int:
        """Number of levels."""
        return int(self.level.max(initial=-1)) + 1

    @property
    def phase(self) -> Float[np.ndarray, " state"]:
        """Phases (rad) relative to their mean."""
        direction = self.velocity / np.abs(self.velocity)
        return np.angle(direction / np.mean(direction))

    @property
    def of_one_phase(self) -> bool:
        """Whether all states have the same phase."""
        return bool(np.max(np.abs(self.phase)) < ONE_PHASE)

    @property
    def near_one_phase(self) -> bool:
        """Whether the states may have been measured under phase control."""
        return bool(np.max(np.abs(self.phase)) < NEAR_ONE_PHASE)

    @property
    def amplitude(self) -> Float[np.ndarray, " state"]:
        """Displacement amplitudes, m."""
        return np.abs(self.velocity) / self.frequency

    @property
    def common_to_levels(self) -> Float[np.ndarray, "level direction"]:
        """Orthonormal basis of level patterns that other unknowns also produce: a constant, and a
        line over log force, as the curves give; for levels of one force, the constant alone.
        """
        level = np.arange(self.n_levels)
        along = np.log([np.median(self.force[self.level == k]) for k in level])
        constant, differs = np.ones(len(level)), np.ptp(along) > ONE_FORCE
        return np.linalg.qr(np.stack([constant, along - along[0]][: 1 + differs], axis=1))[0]


def state_errors(
    stated: Float[np.ndarray, "state input"],
) -> tuple[Float[np.ndarray, "state input"], bool]:
    """1σ of every state's errors, and whether they are stated.

    Where a state has none, all get the same relative noise, to be scaled. A force without stated
    error gets a fraction of the velocity's: near a fold, amplitude and phase errors alone act in
    one direction, and the covariance would be singular.
    """
    known = bool(np.all(np.isfinite(stated)) and np.all(stated[:, 1:] > 0))
    errors = stated.copy() if known else np.tile([0.0, 1.0, 1.0], (len(stated), 1))
    errors[:, 0] = np.where(errors[:, 0] > 0, errors[:, 0], FORCE_TO_VELOCITY * errors[:, 1])
    return errors, known
