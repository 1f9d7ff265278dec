"""From swept to steady states: the force that would sustain each state of a slow sweep.

During a sweep the phasor a of a mode's displacement obeys

    ä + (2iΩ + c) ȧ + iΩ̇ a + (ω̃² − Ω² + icΩ) a = A F,

with c and ω̃² functions of |a| for a nonlinear structure and A its modal constant. The steady state
with the same a and Ω belongs to the force without the first three terms,
F − (ä + (2iΩ + c) ȧ + iΩ̇ a)/A. A follows from the sweep itself, since ω̃² and c must be the same
functions of |a| below and above resonance.

Reference: the averaged equation is that of A. H. Nayfeh & D. T. Mook, Nonlinear Oscillations
(1979), section 4.1, with a varying frequency.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

_LOUD = 0.1  # of the largest amplitude: below, other modes contribute
_STIFFNESS = (0, 1, 2, 3, 4)  # powers of |a| in ω̃²
_DAMPING = (0, -1, 1, 2)  # and in c; friction decreases as 1/|a|
_PER_POWER = 6  # states
_KNOTS = 25  # amplitudes of the tabulated results
_SURE = 0.25  # largest relative 1σ of an accepted modal constant
_ROUNDS = 3
_BLURRED = 0.01  # of the force: largest error by the phasor's rate for a state to be used
_OUTLYING = 3.0  # or this multiple of the median error
_PARTS = 8  # blocks of the jackknife


class SweptMotion(NamedTuple):
    """Displacement phasors of the reference channel during sweeps."""

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
    """Modal parameters from the swept force balance; `constant` is NaN if undetermined."""

    constant: float  # modal constant, 1/kg: displacement times ω² over force, of one mode
    constant_std: float
    amplitude: Float[np.ndarray, " knot"]  # m
    stiffness: Float[np.ndarray, " knot"]  # ω̃², 1/s²
    damping: Float[np.ndarray, " knot"]  # c = 2ζ̃ω̃, 1/s
    misfit: float  # rms residual of the balance, relative to the force

    def force_to_move(self, motion: SweptMotion) -> Complex[np.ndarray, " state"]:
        """The part of the force (N) that changes the phasor instead of sustaining it."""
        damping = np.interp(np.abs(motion.displacement), self.amplitude, self.damping)
        return _transient_terms(motion, damping) / self.constant


def modal_balance(motion: SweptMotion) -> ModalBalance:
    """Modal constant, stiffness and damping by amplitude from swept states, by least squares.

    The 1σ of the constant is a jackknife over eighths of the states: it is large if each amplitude
    is passed only once.
    """
    amplitude = np.abs(motion.displacement)
    used = motion.part(amplitude > _LOUD * amplitude.max())
    knots = np.linspace(*_range(used), _KNOTS)
    balance = _solved(used, knots)
    if np.isfinite(balance.constant):
        # Again without blurred states: at a jump, or at the start of a sweep.
        blur = 2 * used.frequency * used.first_std / np.abs(balance.constant * used.force)
        used = used.part(blur < max(_BLURRED, _OUTLYING * float(np.median(blur))))
        balance = _solved(used, knots) if used.frequency.size else _unknown(knots)
    if not np.isfinite(balance.constant):
        return balance
    block = np.arange(len(used.frequency)) * _PARTS // len(used.frequency)
    others = np.array([_solved(used.part(block != k), knots).constant for k in range(_PARTS)])
    std = float(np.sqrt((_PARTS - 1) / _PARTS * np.sum((others - others.mean()) ** 2)))
    std = float(np.hypot(std, balance.constant_std))
    if not std < _SURE * abs(balance.constant):
        return _unknown(knots)
    return balance._replace(constant_std=std)


def fraction_of_bias(motion: SweptMotion) -> Float[np.ndarray, " state"]:
    """Estimated relative bias of each phasor by the sweep, without knowledge of the mode.

    To first order the response is H − (i/2) dΩ/dt d²H/dΩ² instead of H; limited to 1.
    """
    rate = np.where(motion.rate == 0, np.inf, motion.rate)
    return np.minimum(1.0, np.abs(motion.second / (2 * rate * motion.displacement)))


def _range(motion: SweptMotion) -> tuple[float, float]:
    amplitude = np.abs(motion.displacement)
    return float(amplitude.min()), float(amplitude.max())


def _solved(used: SweptMotion, knots: np.ndarray) -> ModalBalance:
    """The least-squares fit to some states, with the 1σ for independent errors."""
    amplitude, largest = np.abs(used.displacement), float(knots[-1])
    powers = max(1, min(len(_STIFFNESS), len(amplitude) // _PER_POWER))
    damped = min(powers, len(_DAMPING))
    if len(amplitude) < powers + damped + 3:
        return _unknown(knots)

    def terms(at: np.ndarray, of: tuple[int, ...]) -> np.ndarray:
        return (at[:, None] / largest) ** np.array(of, dtype=float)

    per_motion = used.force / used.displacement
    # Weighted by amplitude: errors of F/a grow as it decreases.
    weight = np.tile(amplitude / largest, 2)
    scale = float(np.median(used.frequency)) ** 2
    unit = scale / float(np.median(np.abs(per_motion)))
    stiff = terms(amplitude, _STIFFNESS[:powers])
    lossy = terms(amplitude, _DAMPING[:damped])
    none = [np.zeros_like(lossy), np.zeros_like(stiff)]
    rate = used.frequency[:, None] * np.sqrt(scale)
    design = np.block(
        [
            [per_motion.real[:, None] * unit, -stiff * scale, none[0]],
            [per_motion.imag[:, None] * unit, none[1], -rate * lossy],
        ]
    )
    damping = np.zeros(len(amplitude))
    for _ in range(_ROUNDS):
        transient = _transient_terms(used, damping) / used.displacement
        right = np.concatenate([transient.real - used.frequency**2, transient.imag])
        rows, wanted = design * weight[:, None], right * weight
        fitted, _, rank, _ = np.linalg.lstsq(rows, wanted, rcond=None)
        damping = lossy @ fitted[1 + powers :] * np.sqrt(scale)
    if rank < design.shape[1]:
        return _unknown(knots)
    rest = rows @ fitted - wanted
    spread = np.linalg.inv(rows.T @ rows)[0, 0] * np.sum(rest**2)
    spread /= max(len(rest) - design.shape[1], 1)
    residual = (
        (design @ fitted - right)
        * np.tile(amplitude / np.abs(used.force), 2)
        / abs(fitted[0] * unit)
    )
    return ModalBalance(
        float(fitted[0] * unit),
        float(np.sqrt(spread)) * unit,
        knots,
        terms(knots, _STIFFNESS[:powers]) @ fitted[1 : 1 + powers] * scale,
        terms(knots, _DAMPING[:damped]) @ fitted[1 + powers :] * np.sqrt(scale),
        float(np.sqrt(2 * np.mean(residual**2))),
    )


def _transient_terms(motion: SweptMotion, damping: np.ndarray) -> np.ndarray:
    return (
        motion.second
        + (2j * motion.frequency + damping) * motion.first
        + 1j * motion.rate * motion.displacement
    )


def _unknown(knots: np.ndarray) -> ModalBalance:
    nothing = np.full(len(knots), np.nan)
    return ModalBalance(np.nan, np.nan, knots, nothing, nothing, np.nan)
