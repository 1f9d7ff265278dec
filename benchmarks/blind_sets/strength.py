"""How strong an effect is: its distance from the refitted baseline, in units of the noise.

Per level, with r the change of the dynamic stiffness F/X at the recorded amplitude and frequency
(real and imaginary parts of all points), Σ the noise and J P Jᵀ what the baseline's own freedom
(ω₀, ζ and a₃ inside their priors) and the errors of a whole level can explain,

    S² = rᵀ (Σ + J P Jᵀ)⁻¹ r / number of points,   Σ = σ_a² a aᵀ + σ_p² b bᵀ + σ_f² |K|² I,

with a = K + Q dK/dQ and b = iK. The strength is the larger S of the bottom and the top level.
Effects that change nothing but harmonics are measured there: S² is the mean of 2|ΔV_h|²/σ_h²,
summed over harmonics 2 and 3.
"""

from dataclasses import dataclass

import numpy as np
from effects import (
    IN_HARMONICS_ONLY,
    Baseline,
    Effect,
    Points,
    first_order_change,
    first_order_harmonics,
)

AMPLITUDE_STD = 0.01
PHASE_STD = np.radians(0.7)
FORCE_STD = 0.003


@dataclass(frozen=True)
class Errors:
    """What is known about the baseline and the test: 1σ, relative for frequency and cubic."""

    frequency: float
    damping: float
    cubic: float
    level_gain: float
    level_phase: float  # rad
    harmonic: float  # of the scaled velocity


def _parts(z: np.ndarray) -> np.ndarray:
    return np.concatenate([np.real(z), np.imag(z)])


def baseline_balance(
    amplitude: np.ndarray, w: np.ndarray, base: Baseline
) -> tuple[np.ndarray, np.ndarray]:
    """K of the baseline alone and its third harmonic of y, for a fundamental Q cos Ωt.

    The harmonics 3, 5, 7, 9 that a cubic stiffness drives are iterated on in the time domain.
    """
    n, orders = 64, np.array([3, 5, 7, 9])
    beta = 2 * np.pi * np.arange(n) / n
    waves = np.exp(1j * orders[:, None] * beta)
    h = orders[:, None]
    response = 1 / (1 - (h * w) ** 2 + 2j * base.damping * h * w)
    higher = np.zeros((len(orders), len(w)), dtype=complex)
    force = np.zeros((n, len(w)))
    for _ in range(40):
        y = amplitude * np.cos(beta)[:, None] + np.real(np.einsum("hn,hp->np", waves, higher))
        force = base.cubic * y**3
        higher = -response * (2 / n) * np.einsum("hn,np->hp", waves.conj(), force)
    first = 2 / n * np.exp(-1j * beta) @ force
    return 1 - w**2 + 2j * base.damping * w + first / amplitude, higher[0]


def units_of_noise(
    change: np.ndarray, at: Points, base: Baseline, errors: Errors
) -> tuple[float, float]:
    """S of the bottom and the top level for a given change of K."""
    found = []
    for level in (at.level.min(), at.level.max()):
        own = at.level == level
        q, w, r = at.amplitude[own], at.frequency[own], change[own]
        if not own.any():
            found.append(0.0)
            continue
        n = len(q)
        k = 1 - w**2 + 2j * base.damping * w + 0.75 * base.cubic * q**2
        a, b = k + 1.5 * base.cubic * q**2, 1j * k
        covariance = np.diag(np.tile((FORCE_STD * np.abs(k)) ** 2, 2))
        for size, vector in ((AMPLITUDE_STD, a), (PHASE_STD, b)):
            wide = np.concatenate([np.diag(vector.real), np.diag(vector.imag)]) * size
            covariance += wide @ wide.T
        shared = np.stack(
            [
                errors.frequency * _parts(2 + 2j * base.damping * w),
                errors.damping * base.damping * _parts(2j * w),
                errors.cubic * base.cubic * _parts(0.75 * q**2 + 0j),
                errors.level_gain * _parts(a),
                errors.level_phase * _parts(b),
            ],
            axis=1,
        )
        covariance += shared @ shared.T
        d = _parts(r)
        found.append(float(np.sqrt(d @ np.linalg.solve(covariance, d) / n)))
    return found[0], found[1]


def harmonic_units(change: np.ndarray, at: Points, errors: Errors) -> tuple[float, float]:
    """S of bottom and top level for changes of harmonics (harmonic, point) of the velocity."""
    squares = np.sum(2 * np.abs(change) ** 2 / errors.harmonic**2, axis=0)
    ends = (at.level.min(), at.level.max())
    low, high = (float(np.sqrt(np.mean(squares[at.level == level]))) for level in ends)
    return low, high


def nominal_points(base: Baseline, per_level: int = 11) -> Points:
    """Motions of the baseline within ±60° of resonance."""
    phase = np.radians(np.linspace(-60, 60, per_level))
    level = np.repeat(np.arange(len(base.peaks)), per_level)
    peak, angle = np.asarray(base.peaks)[level], np.tile(phase, len(base.peaks))
    w = np.ones(len(level))
    for _ in range(50):
        q = peak * np.cos(angle) / w
        # Velocity leads by `angle`: below resonance.
        w = np.sqrt(1 + 0.75 * base.cubic * q**2 - 2 * base.damping * w * np.tan(angle))
    q = peak * np.cos(angle) / w
    return Points(level, q, w, np.linspace(0, 1, len(w)))


def first_order_units(effect: Effect, base: Baseline, errors: Errors) -> float:
    """S of one effect at nominal points, to lowest order in its size."""
    at = nominal_points(base)
    if effect.kind in IN_HARMONICS_ONLY:
        return max(harmonic_units(first_order_harmonics(effect, at, base), at, errors))
    return max(units_of_noise(first_order_change(effect, at, base), at, base, errors))


def first_order_size(effect: Effect, base: Baseline, errors: Errors, wanted: float) -> float:
    """Size at which S is `wanted` to lowest order; 0 if no size gives it."""

    # S is close to a power of the size, so that Newton's method on logarithms converges at once.
    log_size = np.log(1e-5)
    for _ in range(40):
        here, ahead = (
            first_order_units(effect.sized(float(np.exp(log_size + d))), base, errors)
            for d in (0.0, 0.05)
        )
        if here <= 0 or ahead <= here:
            return 0.0
        change = (np.log(wanted) - np.log(here)) * 0.05 / (np.log(ahead) - np.log(here))
        log_size += float(np.clip(change, -12.0, 12.0))
        if abs(change) < 1e-3:
            return float(np.exp(log_size))
    return 0.0
