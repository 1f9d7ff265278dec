"""From swept to steady: the force that would hold each state of a slow sweep.

While a record is swept, the phasor a of a mode's displacement obeys

    ä + (2iΩ + c) ȧ + iΩ̇ a + (ω̃² − Ω² + icΩ) a = A F,

c and ω̃² functions of |a| where the structure is nonlinear, A its modal constant. Whoever keeps a
and Ω and takes from the force what the first three terms need has a steady state, of the same
amplitude: F − (ä + (2iΩ + c) ȧ + iΩ̇ a)/A. A follows from the sweep itself, since ω̃² and c must be
one function each of |a| below and above resonance.

Reference: the averaged equation is that of A. H. Nayfeh & D. T. Mook, Nonlinear Oscillations
(1979), section 4.1, with a frequency that moves.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

_LOUD = 0.1  # of the largest amplitude: below, other modes are heard
_KNOTS = 7
_PER_KNOT = 6  # states
_SMOOTH = 1e-3  # of the balance, against bends between knots that no state shows
_SURE = 0.25  # relative 1σ of the modal constant up to which it is believed
_ROUNDS = 3


class SweptMotion(NamedTuple):
    """Phasors of the reference channel's displacement during sweeps."""

    frequency: Float[np.ndarray, " state"]  # rad/s
    rate: Float[np.ndarray, " state"]  # rad/s²
    force: Complex[np.ndarray, " state"]  # N
    displacement: Complex[np.ndarray, " state"]  # m
    first: Complex[np.ndarray, " state"]  # m/s, its derivative
    second: Complex[np.ndarray, " state"]  # m/s²


class ModalBalance(NamedTuple):
    """What the balance of a mode says of it; `constant` is NaN where it says nothing."""

    constant: float  # modal constant, 1/kg: displacement times ω² over force, of one mode
    constant_std: float
    amplitude: Float[np.ndarray, " knot"]  # m
    stiffness: Float[np.ndarray, " knot"]  # ω̃², 1/s²
    damping: Float[np.ndarray, " knot"]  # c = 2ζ̃ω̃, 1/s
    misfit: float  # rms of what the balance leaves, as a share of the force

    def force_to_move(self, motion: SweptMotion) -> Complex[np.ndarray, " state"]:
        """The part of the force (N) that moves the phasor instead of holding it."""
        damping = np.interp(np.abs(motion.displacement), self.amplitude, self.damping)
        return _moving(motion, damping) / self.constant


def modal_balance(motion: SweptMotion) -> ModalBalance:
    """Modal constant, stiffness and damping by amplitude from swept states, by least squares."""
    size = np.abs(motion.displacement)
    loud = size > _LOUD * size.max()
    used = SweptMotion(*(column[loud] for column in motion))
    size = size[loud]
    count = int(np.clip(len(size) // _PER_KNOT, 1, _KNOTS))
    knots = np.linspace(size.min(), size.max(), count) if count > 1 else np.array([size.max()])
    hats = np.stack([np.interp(size, knots, row) for row in np.eye(count)], axis=1)
    if len(size) < 2 * count + 2:
        return _unknown(knots)
    per_motion = used.force / used.displacement
    none = np.zeros((len(size), count))
    # Each state weighs as its amplitude: errors of F/a grow as it falls.
    weight = np.tile(size / size.max(), 2)
    scale = np.median(used.frequency) ** 2
    omega = used.frequency[:, None]
    unit = scale / np.median(np.abs(per_motion))
    design = np.block(
        [
            [per_motion.real[:, None] * unit, -hats * scale, none],
            [per_motion.imag[:, None] * unit, none, -omega * hats * np.sqrt(scale)],
        ]
    )
    bends = np.zeros((2 * max(count - 2, 0), design.shape[1]))
    for k in range(count - 2):
        for part in range(2):
            at = 1 + part * count + k
            bends[part * (count - 2) + k, at : at + 3] = [1, -2, 1]
    bends *= _SMOOTH * scale * np.sqrt(len(size))
    damping = np.zeros(len(size))
    for _ in range(_ROUNDS):
        moving = _moving(used, damping) / used.displacement
        right = np.concatenate([moving.real - used.frequency**2, moving.imag])
        rows = np.concatenate([design * weight[:, None], bends])
        wanted = np.concatenate([right * weight, np.zeros(len(bends))])
        found, _, rank, _ = np.linalg.lstsq(rows, wanted, rcond=None)
        damping = hats @ found[1 + count :] * np.sqrt(scale)
    if rank < design.shape[1]:
        return _unknown(knots)
    rest = rows @ found - wanted
    freedom = max(2 * len(size) - design.shape[1], 1)
    spread = np.linalg.inv(rows.T @ rows)[0, 0] * np.sum(rest**2) / freedom
    constant, std = found[0] * unit, float(np.sqrt(spread)) * unit
    if not (std < _SURE * abs(constant)):
        return _unknown(knots)
    left = (design @ found - right) * np.tile(size / np.abs(used.force), 2) / abs(constant)
    return ModalBalance(
        float(constant),
        std,
        knots,
        found[1 : 1 + count] * scale,
        found[1 + count :] * np.sqrt(scale),
        float(np.sqrt(2 * np.mean(left**2))),
    )


def _moving(motion: SweptMotion, damping: np.ndarray) -> np.ndarray:
    return (
        motion.second
        + (2j * motion.frequency + damping) * motion.first
        + 1j * motion.rate * motion.displacement
    )


def _unknown(knots: np.ndarray) -> ModalBalance:
    nothing = np.full(len(knots), np.nan)
    return ModalBalance(np.nan, np.nan, knots, nothing, nothing, np.nan)
