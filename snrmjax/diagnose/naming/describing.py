"""Describing functions of the library's laws: stiffness and damping of a harmonic motion.

For q = a cos Ωt the fundamental of a force is (k + iΩc) a. Values are relative to ω₀² (k) and to ω₀
(c), and the argument x is the amplitude over the largest one of the test.
Reference: Gelb & Vander Velde, Multiple-Input Describing Functions and Nonlinear System Design
(1968), appendix B; for Masing's rule on a power law, Segalman, ASME J. Appl. Mech. 72 (2005) 752.
"""

import numpy as np
from jaxtyping import Complex, Float

Amplitudes = Float[np.ndarray, " state"]


def gap(x: Amplitudes, width: float) -> Amplitudes:
    """Stiffness of springs of stiffness 1 behind gaps of a width on both sides."""
    r = np.clip(width / np.maximum(x, 1e-12), 0.0, 1.0)
    return np.where(x > width, 1 - (2 / np.pi) * (np.arcsin(r) + r * np.sqrt(1 - r * r)), 0.0)


def stop(x: Amplitudes, width: float, stiffness: float) -> Amplitudes:
    """Stiffness of a spring of ω₀² `stiffness` behind a gap on one side, over that stiffness.

    The motion's mean gives way to it: q₀ + stiffness · mean contact force = 0, by bisection.
    """
    low, high = -x, np.zeros_like(x)
    for _ in range(50):
        mean = 0.5 * (low + high)
        s = np.clip((width - mean) / np.maximum(x, 1e-12), -1.0, 1.0)
        angle = np.arccos(s)
        contact = x * (np.sin(angle) - s * angle) / np.pi
        too_high = mean + stiffness * contact > 0
        low, high = np.where(too_high, low, mean), np.where(too_high, mean, high)
    return (angle - s * np.sqrt(1 - s * s)) / np.pi


def slider(x: Amplitudes, slip: float) -> tuple[Amplitudes, Amplitudes]:
    """Loss of stiffness, and Ω times damping, of a slider of stuck stiffness 1."""
    r = np.clip(slip / np.maximum(x, 1e-12), 0.0, 1.0)
    t = np.arccos(1 - 2 * r)
    slips = x > slip
    lost = np.where(slips, (t - 0.5 * np.sin(2 * t)) / np.pi - 1, 0.0)
    return lost, np.where(slips, 4 * r * (1 - r) / np.pi, 0.0)


def masing(exponent: float, samples: int = 400) -> tuple[float, float]:
    """Loss of stiffness, and Ω times damping, of the backbone −|x|^p sgn x with Masing's rule.

    At unit amplitude; at others both are x^(p − 1) times as large.
    """
    t = (np.arange(samples) + 0.5) * np.pi / samples
    q = np.cos(t)
    force = -1 + 2 * ((1 - q) / 2) ** exponent
    return 2 * float(np.mean(force * q)), -2 * float(np.mean(force * np.sin(t)))


def quadratic(
    x: Amplitudes, frequency: Float[np.ndarray, " state"], ratio: float, strength: float
) -> Complex[np.ndarray, " state"]:
    """Dynamic stiffness that a spring of force `strength` q² (over ω₀² and the largest a) adds.

    By the mean and the second harmonic of the motion: s q₀ + ½ s a² + … = 0, in fixed-point steps.
    """
    own = 1 - 4 * frequency**2 + 4j * ratio * frequency
    mean, second = np.zeros_like(x), np.zeros_like(x) + 0j
    for _ in range(40):
        square = mean**2 + 0.5 * x**2 + 0.5 * np.abs(second) ** 2
        mean = np.clip(-strength * square, -0.5 / strength, 0.0)
        second = -0.5 * strength * x**2 / (own + 2 * strength * mean)
    return strength * (2 * mean + second)


def resonant(
    x: Amplitudes, frequency: Float[np.ndarray, " state"], order: int, detuning: float, ratio: float
) -> Complex[np.ndarray, " state"]:
    """Dynamic stiffness that a mode at n (1 + detuning) ω₀ with V = b qⁿ p adds, over its largest.

    Arguments: `frequency` Ω/ω₀; `order` n, 2 or 3; `ratio` the damping ratio of that mode.
    """
    own = order * (1 + detuning)
    driven = order * frequency
    change = -(x ** (2 * order - 2)) / (own**2 - driven**2 + 2j * ratio * own * driven)
    return change / np.max(np.abs(change))
