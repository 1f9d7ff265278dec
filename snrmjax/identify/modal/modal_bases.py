"""Basis columns of a receptance: modes and residual terms, with derivatives by the poles.

H(Ω) = e^{iψ} [Σ A_r/(ω_r² − Ω² + 2iζ_rω_rΩ) + L/Ω² + U], all A_r, L, U real: real normal modes with
viscous modal damping, measured through an instrument with a phase error ψ.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from snrmjax.identify.modal.separable_fit import TermColumns

_NEWTON, _SETTLED = 40, 1e-9  # largest number of Newton steps, and relative step at convergence
_STEP = 1e-6  # relative, of finite differences of a windowed response


class AmplitudeDependence(NamedTuple):
    """A mode whose stiffness, and damping, change with a power p of its own amplitude.

    D(q) q = F with D = ω² − Ω² + 2iζωΩ + u² (s + itΩ/u)(|q|/R)^p, q its response per unit of
    residue: the unknown s is the relative change of the stiffness at the largest amplitude R, t/2ζ
    that of the damping. q is the solution with amplitude nearest to `near`. With `apart`, marked
    rows have a separate frequency and damping ratio.
    """

    mode: int
    power: int
    damping: bool  # whether t is an unknown
    unit: float  # u, rad/s
    load: Float[np.ndarray, " line"]  # F
    near: Float[np.ndarray, " line"]  # |q|, approximate
    apart: Float[np.ndarray, " line"] | None = None  # 1 for rows with separate values

    @property
    def n_terms(self) -> int:
        """Number of added unknowns: s, then t, then the changes of ω (over u) and of ζ."""
        return 1 + self.damping + 2 * (self.apart is not None)


class BasisSettings(NamedTuple):
    """Terms of a receptance in addition to its modes.

    `window_time` is the length, s, of Hann's window in an averaged estimate; None: no leakage.
    """

    lower: bool = True  # a term 1/Ω²
    upper: bool = True  # a constant
    curved: bool = False  # a term Ω², for modes not far above the band
    phase: bool = False  # an unknown phase of the instrument
    window_time: float | None = None
    dependence: AmplitudeDependence | None = None

    @property
    def n_terms(self) -> int:
        """Unknowns of the amplitude dependence."""
        return 0 if self.dependence is None else self.dependence.n_terms

    def modes_of(self, unknowns: Float[np.ndarray, " unknown"]) -> int:
        """Number of modes in the unknowns."""
        return (len(unknowns) - self.phase - self.n_terms) // 2


def unpacked(
    unknowns: Float[np.ndarray, " unknown"], settings: BasisSettings
) -> tuple[Float[np.ndarray, " mode"], Float[np.ndarray, " mode"], float]:
    """Natural frequencies, damping ratios and phase of the unknowns."""
    n = settings.modes_of(unknowns)
    return unknowns[:n], unknowns[n : 2 * n], float(unknowns[-1]) if settings.phase else 0.0


def receptance_bases(
    omega: Float[np.ndarray, " line"],
    unknowns: Float[np.ndarray, " unknown"],
    settings: BasisSettings,
    powers: Sequence[int] = (0,),
) -> list[TermColumns]:
    """Bases of receptances, real parts above imaginary parts, terms: modes, 1/Ω², constant, Ω².

    Arguments: `unknowns` natural frequencies (rad/s), damping ratios, those of the amplitude
    dependence, then the phase if it is unknown; `powers` of iΩ in the measured
    quantities, which matter under a window.
    """
    natural, ratio, angle = unpacked(unknowns, settings)
    phase_factor = np.exp(1j * angle)
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
        terms = None
        if settings.dependence is not None:
            k, n = settings.dependence.mode, len(natural)
            added = unknowns[2 * n : 2 * n + settings.n_terms]
            modes[:, k], by_frequency[:, k], by_ratio[:, k], terms = _dependent(
                omega, (natural[k], ratio[k]), added, settings.dependence
            )
        columns = phase_factor * np.column_stack([modes, *others])
        slopes = np.zeros((len(unknowns), *columns.shape), dtype=complex)
        at, n = np.arange(len(natural)), len(natural)
        slopes[at, :, at] = phase_factor * by_frequency.T
        slopes[n + at, :, at] = phase_factor * by_ratio.T
        if terms is not None and settings.dependence is not None:
            slopes[2 * n : 2 * n + len(terms), :, settings.dependence.mode] = phase_factor * terms
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


def _dependent(
    omega: np.ndarray, mode: tuple[float, float], added: np.ndarray, of: AmplitudeDependence
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The column q/F of an amplitude-dependent mode, and its derivatives.

    With respect to frequency, ratio and the unknowns of the dependence. q solves a real equation
    for |q|, by Newton's method; the derivatives are those of D(q) q = F and of its conjugate.
    """
    apart = 0.0 if of.apart is None else of.apart
    own = added[-2:] if of.apart is not None else np.zeros(2)
    natural, ratio = mode[0] + own[0] * of.unit * apart, mode[1] + own[1] * apart
    strength = of.unit**2 * (added[0] + 1j * (added[1] if of.damping else 0.0) * omega / of.unit)
    linear = natural**2 - omega**2 + 2j * ratio * natural * omega
    p, largest, amplitude = of.power, float(of.near.max()), of.near.copy()
    with np.errstate(all="ignore"):
        for _ in range(_NEWTON):
            dynamic = linear + strength * (amplitude / largest) ** p
            slope = p * np.real(np.conj(dynamic) * strength) * (amplitude / largest) ** p
            slope = np.abs(dynamic) ** 2 + slope
            change = 0.5 * amplitude * (np.abs(dynamic) ** 2 - (of.load / amplitude) ** 2) / slope
            amplitude = np.clip(amplitude - change, 0.5 * amplitude, 2 * amplitude)
            settled = np.abs(change) < _SETTLED * amplitude
            if settled.all():
                break
        fraction = (amplitude / largest) ** p
        q = of.load / (linear + strength * fraction)
        q = np.where(settled, q, np.nan)
        ahead = linear + strength * fraction * (1 + p / 2)
        behind = strength * fraction * p / 2 * (q / np.abs(q)) ** 2

        def slope_by(equation: np.ndarray) -> np.ndarray:
            g = equation * q
            slope = behind * np.conj(g) - np.conj(ahead) * g
            return slope / (np.abs(ahead) ** 2 - np.abs(behind) ** 2) / of.load

        by_frequency = slope_by(2 * natural + 2j * ratio * omega)
        by_ratio = slope_by(2j * natural * omega)
        terms = [slope_by(of.unit**2 * fraction)]
        terms += [slope_by(1j * of.unit * omega * fraction)] * of.damping
        if of.apart is not None:
            terms += [of.unit * apart * by_frequency, apart * by_ratio]
    return q / of.load, by_frequency, by_ratio, np.array(terms)


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
    shift = 2j * np.pi / time
    ahead, behind = s + shift, s - shift
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
