"""Columns of a receptance by modes and residual terms, with their derivatives by the poles.

H(Ω) = e^{iψ} [Σ A_r/(ω_r² − Ω² + 2iζ_rω_rΩ) + L/Ω² + U], all A_r, L, U real: real normal modes with
viscous modal damping, seen through an instrument that may turn the phase by ψ.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from snrmjax.identify.modal.separable_fit import TermColumns

_STEP = 1e-6  # relative, of the differences by poles of a windowed response


class BasisSettings(NamedTuple):
    """What a receptance is made of, beside its modes.

    `window_time` is the length, s, of Hann's window in an averaged estimate; None: no leakage.
    """

    lower: bool = True  # a term 1/Ω²
    upper: bool = True  # a constant
    curved: bool = False  # a term Ω²: of modes not far above the band
    phase: bool = False  # an unknown phase of the instrument
    window_time: float | None = None


def unpacked(
    unknowns: Float[np.ndarray, " unknown"], settings: BasisSettings
) -> tuple[Float[np.ndarray, " mode"], Float[np.ndarray, " mode"], float]:
    """Natural frequencies, damping ratios and phase of the unknowns."""
    n = (len(unknowns) - settings.phase) // 2
    return unknowns[:n], unknowns[n : 2 * n], float(unknowns[-1]) if settings.phase else 0.0


def receptance_bases(
    omega: Float[np.ndarray, " line"],
    unknowns: Float[np.ndarray, " unknown"],
    settings: BasisSettings,
    powers: Sequence[int] = (0,),
) -> list[TermColumns]:
    """Bases of receptances, real parts above imaginary parts, terms: modes, 1/Ω², constant, Ω².

    Arguments: `unknowns` natural frequencies (rad/s), damping ratios, then the phase if it is
    unknown; `powers` of iΩ by which the receptance was measured, which matter under a window.
    """
    natural, ratio, angle = unpacked(unknowns, settings)
    turn = np.exp(1j * angle)
    others = [omega**-2.0] * settings.lower + [np.ones_like(omega)] * settings.upper
    others += [(omega / omega[-1]) ** 2] * settings.curved
    bases = []
    for power in powers:
        if settings.window_time is None:
            modes, by_frequency, by_ratio = _plain(omega, natural, ratio)
        else:
            modes, by_frequency, by_ratio = _leaked(
                omega, natural, ratio, power, settings.window_time
            )
        columns = turn * np.column_stack([modes, *others])
        slopes = np.zeros((len(unknowns), *columns.shape), dtype=complex)
        at, n = np.arange(len(natural)), len(natural)
        slopes[at, :, at] = turn * by_frequency.T
        slopes[n + at, :, at] = turn * by_ratio.T
        if settings.phase:
            slopes[-1] = 1j * columns
        bases.append(TermColumns(real_and_imaginary(columns, 0), real_and_imaginary(slopes, 1)))
    return bases


def real_and_imaginary(
    values: Complex[np.ndarray, "..."], axis: int = -1
) -> Float[np.ndarray, "..."]:
    """Real parts, then imaginary parts along an axis."""
    return np.concatenate([values.real, values.imag], axis=axis)


def _plain(
    omega: np.ndarray, natural: np.ndarray, ratio: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    at = omega[:, None]
    modes = 1 / (natural**2 - at**2 + 2j * ratio * natural * at)
    by_frequency = -(modes**2) * (2 * natural + 2j * ratio * at)
    return modes, by_frequency, -(modes**2) * 2j * natural * at


def _leaked(
    omega: np.ndarray, natural: np.ndarray, ratio: np.ndarray, power: int, time: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    def modes(w: np.ndarray, z: np.ndarray) -> np.ndarray:
        pole = -z * w + 1j * w * np.sqrt(1 - z**2)
        early, late = (
            p**power * _windowed(p - 1j * omega[:, None], time) for p in (pole, pole.conj())
        )
        response = (early - late) / (2j * pole.imag) + (1.0 if power == 2 else 0.0)
        return response / (1j * omega[:, None]) ** power

    step = _STEP * natural
    by_frequency = (modes(natural + step, ratio) - modes(natural - step, ratio)) / (2 * step)
    by_ratio = (modes(natural, ratio + _STEP) - modes(natural, ratio - _STEP)) / (2 * _STEP)
    return modes(natural, ratio), by_frequency, by_ratio


def _windowed(s: Complex[np.ndarray, "..."], time: float) -> Complex[np.ndarray, "..."]:
    """∫ from 0 to T of r(τ) e^{sτ}, with r the autocorrelation of Hann's window, r(0) = 1.

    r(τ) = (1 − τ/T)(2/3 + cos(2πτ/T)/3) + sin(2πτ/T)/(2π). An averaged cross-spectrum of
    stationary signals is that of the impulse response times r.
    """
    turn = 2j * np.pi / time
    ahead, behind = s + turn, s - turn
    falling = 2 / 3 * _falling(s, time) + (_falling(ahead, time) + _falling(behind, time)) / 6
    return falling + (_constant(ahead, time) - _constant(behind, time)) / (4j * np.pi)


def _constant(s: np.ndarray, time: float) -> np.ndarray:
    """∫ from 0 to T of e^{sτ}."""
    x = s * time
    small = np.abs(x) < 1e-4
    safe = np.where(small, 1.0, x)
    return time * np.where(small, 1 + x / 2 + x**2 / 6, np.expm1(safe) / safe)


def _falling(s: np.ndarray, time: float) -> np.ndarray:
    """∫ from 0 to T of (1 − τ/T) e^{sτ}."""
    x = s * time
    small = np.abs(x) < 1e-3
    safe = np.where(small, 1.0, x)
    series = 1 / 2 + x / 6 + x**2 / 24 + x**3 / 120
    return time * np.where(small, series, (np.expm1(safe) - safe) / safe**2)
