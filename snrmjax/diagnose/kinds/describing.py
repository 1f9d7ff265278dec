"""Harmonics of the library's laws: equivalent stiffness and damping, and higher ones.

For q = a cos Ωt the fundamental of a force is (k + iΩc) a. Values are relative to ω₀² (k) and to ω₀
(c), and the argument x is the amplitude over the largest of the test.
Reference: Gelb & Vander Velde, Multiple-Input Describing Functions and Nonlinear System Design
(1968), appendix B; for Masing's rule on a power law, Segalman, ASME J. Appl. Mech. 72 (2005) 752.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Complex, Float

Amplitudes = Float[np.ndarray, " state"]
Cycle = Float[np.ndarray, "state sample"]
Force = Callable[[Cycle, Cycle], Cycle]
"""Of a displacement x cos t and its derivative −x sin t, over half a cycle or the whole."""

_SAMPLES = 256


def harmonic(force: Force, x: Amplitudes, order: int) -> Complex[np.ndarray, " state"]:
    """Harmonic cₕ of the force under harmonic motion, over the amplitude: f = Re Σ cₕ eʰⁱᵗ.

    By quadrature over the cycle.
    """
    t = (np.arange(_SAMPLES) + 0.5) * 2 * np.pi / _SAMPLES
    values = force(np.outer(x, np.cos(t)), -np.outer(x, np.sin(t)))
    return 2 * np.mean(values * np.exp(-1j * order * t), axis=1) / np.maximum(x, 1e-12)


def mean_at_stop(x: Amplitudes, width: float, stiffness: float) -> Amplitudes:
    """Mean displacement q₀ under contact with a one-sided spring of ω₀² `stiffness`.

    From q₀ + stiffness · mean contact force = 0, by bisection.
    """
    low, high = -x, np.zeros_like(x)
    for _ in range(50):
        mean = 0.5 * (low + high)
        s = np.clip((width - mean) / np.maximum(x, 1e-12), -1.0, 1.0)
        angle = np.arccos(s)
        contact = x * (np.sin(angle) - s * angle) / np.pi
        too_high = mean + stiffness * contact > 0
        low, high = np.where(too_high, low, mean), np.where(too_high, mean, high)
    return mean


def slipping(q: Cycle, slope: Cycle, slip: float) -> Cycle:
    """Force of a Jenkins slider of stuck stiffness 1, less its stuck force."""
    largest = np.max(np.abs(q), axis=1, keepdims=True)
    down = np.maximum(_falling(q, slope) - largest + slip, -slip)
    force = np.where(slope <= 0, down, -down)
    return np.where(largest > slip, force - q, 0.0)


def microslip(q: Cycle, slope: Cycle, exponent: float) -> Cycle:
    """Force of the backbone −|x|^p sgn x by Masing's rule."""
    largest = np.max(np.abs(q), axis=1, keepdims=True)
    down = 2 * ((largest - _falling(q, slope)) / 2) ** exponent - largest**exponent
    return np.where(slope <= 0, down, -down)


def _falling(q: Cycle, slope: Cycle) -> Cycle:
    """The displacement, mirrored while it rises: maps both loop branches to the falling one."""
    return np.where(slope <= 0, q, -q)


def quadratic(
    x: Amplitudes, frequency: Float[np.ndarray, " state"], ratio: float, strength: float
) -> tuple[Complex[np.ndarray, " state"], Complex[np.ndarray, " state"]]:
    """Fundamental and second harmonic of a spring of force `strength` q², over the amplitude.

    `strength` is relative to ω₀² and the largest amplitude. With the mean and the second harmonic
    of the motion, q₀ + ½ s a² + … = 0, by fixed-point iteration.
    """
    own = 1 - 4 * frequency**2 + 4j * ratio * frequency
    mean, second = np.zeros_like(x), np.zeros_like(x) + 0j
    for _ in range(40):
        square = mean**2 + 0.5 * x**2 + 0.5 * np.abs(second) ** 2
        mean = np.clip(-strength * square, -0.5 / strength, 0.0)
        second = -0.5 * strength * x**2 / (own + 2 * strength * mean)
    twice = strength * (0.5 * x**2 + 2 * mean * second) / np.maximum(x, 1e-12)
    return strength * (2 * mean + second), twice


def resonant(
    x: Amplitudes, frequency: Float[np.ndarray, " state"], order: int, detuning: float, ratio: float
) -> Complex[np.ndarray, " state"]:
    """Dynamic stiffness added by a mode at n (1 + detuning) ω₀ with V = b qⁿ p.

    For n b² a²ⁿ⁻²/4ⁿ⁻¹ = ω₀⁴ x²ⁿ⁻².
    Arguments: `frequency`: Ω/ω₀; `order`: n, 2 or 3; `ratio`: damping ratio of that mode.
    """
    own = order * (1 + detuning)
    driven = order * frequency
    return -(x ** (2 * order - 2)) / (own**2 - driven**2 + 2j * ratio * own * driven)
