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
_STIFFNESS = (0, 1, 2, 3, 4)  # powers of |a| of which ω̃² is made
_DAMPING = (0, -1, 1, 2)  # and c; friction's falls as 1/|a|
_PER_POWER = 6  # states
_KNOTS = 25  # amplitudes at which both are given
_SURE = 0.25  # relative 1σ of the modal constant up to which it is believed
_ROUNDS = 3
_BLURRED = 0.01  # of the force: error by the phasor's change up to which a state is used
_OUTLYING = 3.0  # or so many times the usual error
_PARTS = 8  # of the states, left out one after the other


class SweptMotion(NamedTuple):
    """Phasors of the reference channel's displacement during sweeps."""

    frequency: Float[np.ndarray, " state"]  # rad/s
    rate: Float[np.ndarray, " state"]  # rad/s²
    force: Complex[np.ndarray, " state"]  # N
    displacement: Complex[np.ndarray, " state"]  # m
    first: Complex[np.ndarray, " state"]  # m/s, its derivative
    second: Complex[np.ndarray, " state"]  # m/s²
    first_std: Float[np.ndarray, " state"]  # m/s, of `first`

    def part(self, rows: np.ndarray) -> "SweptMotion":
        """Some of the states."""
        return SweptMotion._make(column[rows] for column in self)


class ModalBalance(NamedTuple):
    """Modal parameters from the swept force balance; `constant` is NaN where it has none."""

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
    """Modal constant, stiffness and damping by amplitude from swept states, by least squares.

    The 1σ of the constant is by leaving out one eighth of the states after the other: where each
    amplitude is passed once only, the sweep hardly says it.
    """
    size = np.abs(motion.displacement)
    used = motion.part(size > _LOUD * size.max())
    knots = np.linspace(*_range(used), _KNOTS)
    balance = _solved(used, knots)
    if np.isfinite(balance.constant):
        # Once more without states that are blurred: at a jump, where a sweep begins.
        blur = 2 * used.frequency * used.first_std / np.abs(balance.constant * used.force)
        used = used.part(blur < max(_BLURRED, _OUTLYING * float(np.median(blur))))
        balance = _solved(used, knots) if used.frequency.size else _unknown(knots)
    if not np.isfinite(balance.constant):
        return balance
    place = np.arange(len(used.frequency)) * _PARTS // len(used.frequency)
    others = np.array([_solved(used.part(place != k), knots).constant for k in range(_PARTS)])
    std = float(np.sqrt((_PARTS - 1) / _PARTS * np.sum((others - others.mean()) ** 2)))
    std = float(np.hypot(std, balance.constant_std))
    if not std < _SURE * abs(balance.constant):
        return _unknown(knots)
    return balance._replace(constant_std=std)


def fraction_of_bias(motion: SweptMotion) -> Float[np.ndarray, " state"]:
    """About how much of each phasor is the sweep's doing, where nothing is known of the mode.

    To first order a sweep answers with H − (i/2) dΩ/dt d²H/dΩ² in place of H, at most all of it.
    """
    rate = np.where(motion.rate == 0, np.inf, motion.rate)
    return np.minimum(1.0, np.abs(motion.second / (2 * rate * motion.displacement)))


def _range(motion: SweptMotion) -> tuple[float, float]:
    size = np.abs(motion.displacement)
    return float(size.min()), float(size.max())


def _solved(used: SweptMotion, knots: np.ndarray) -> ModalBalance:
    """The least-squares fit to some states; its 1σ is that of independent errors."""
    size, largest = np.abs(used.displacement), float(knots[-1])
    powers = max(1, min(len(_STIFFNESS), len(size) // _PER_POWER))
    damped = min(powers, len(_DAMPING))
    if len(size) < powers + damped + 3:
        return _unknown(knots)

    def terms(amplitude: np.ndarray, of: tuple[int, ...]) -> np.ndarray:
        return (amplitude[:, None] / largest) ** np.array(of, dtype=float)

    per_motion = used.force / used.displacement
    # Each state weighs as its amplitude: errors of F/a grow as it falls.
    weight = np.tile(size / largest, 2)
    scale = float(np.median(used.frequency)) ** 2
    unit = scale / float(np.median(np.abs(per_motion)))
    stiff = terms(size, _STIFFNESS[:powers])
    lossy = terms(size, _DAMPING[:damped])
    none = [np.zeros_like(lossy), np.zeros_like(stiff)]
    turned = used.frequency[:, None] * np.sqrt(scale)
    design = np.block(
        [
            [per_motion.real[:, None] * unit, -stiff * scale, none[0]],
            [per_motion.imag[:, None] * unit, none[1], -turned * lossy],
        ]
    )
    damping = np.zeros(len(size))
    for _ in range(_ROUNDS):
        moving = _moving(used, damping) / used.displacement
        right = np.concatenate([moving.real - used.frequency**2, moving.imag])
        rows, wanted = design * weight[:, None], right * weight
        fitted, _, rank, _ = np.linalg.lstsq(rows, wanted, rcond=None)
        damping = lossy @ fitted[1 + powers :] * np.sqrt(scale)
    if rank < design.shape[1]:
        return _unknown(knots)
    rest = rows @ fitted - wanted
    spread = np.linalg.inv(rows.T @ rows)[0, 0] * np.sum(rest**2)
    spread /= max(len(rest) - design.shape[1], 1)
    left = (design @ fitted - right) * np.tile(size / np.abs(used.force), 2) / abs(fitted[0] * unit)
    return ModalBalance(
        float(fitted[0] * unit),
        float(np.sqrt(spread)) * unit,
        knots,
        terms(knots, _STIFFNESS[:powers]) @ fitted[1 : 1 + powers] * scale,
        terms(knots, _DAMPING[:damped]) @ fitted[1 + powers :] * np.sqrt(scale),
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
