"""First-order change of the readings by effects: functions for the rows of `table`.

Values are relative to ω₀², as functions of the amplitude over the largest one. Nonlinear parameters
(a gap, an exponent) have a grid of values. Other harmonics are those of the force under the
measured fundamental motion.
"""

from collections.abc import Callable

import numpy as np

from snrmjax.diagnose import priors
from snrmjax.diagnose.kinds import describing
from snrmjax.diagnose.readings import HarmonicReading, Readings
from snrmjax.numerics.units import HERTZ

# Over the largest amplitude; fine enough that neighbouring values show a corner between them.
GAPS = np.linspace(0.04, 0.96, 47)
STIFFNESSES = np.log([0.02, 0.2, 2.0, 20.0])  # ln, of a stop, over ω₀²
# ln, over ω₀² and the largest amplitude
QUADRATICS = np.log([0.003, 0.008, 0.02, 0.05, 0.12, 0.3])
PRELOADS = np.log([0.02, 0.06, 0.2, 0.6])  # ln, static displacement over the largest amplitude
BILINEARS = np.log([0.003, 0.01, 0.03, 0.1, 0.3])  # ln, over ω₀²
SLIPS = np.linspace(np.log(0.02), np.log(0.95), 47)  # ln, over the largest amplitude
EXPONENTS = np.linspace(1.1, 2.9, 10)
DETUNINGS = np.linspace(-0.04, 0.04, 9)
APART = np.array([-0.3, -0.1, -0.05, -0.02, 0.02, 0.05, 0.1, 0.3])  # of a close mode, over ω₀
MOTION_GAINS = np.linspace(-0.44, 0.76, 16)  # at the largest amplitude
DAMPINGS = np.log([0.5, 2.0])  # ln, of a further mode, over the mode's own

_ITERATIONS = 40  # each of which reduces the error of such a gain by a factor of two or more
_POWERS = 4  # of the amplitude, from 0

Change = Callable[..., np.ndarray]


def stiffness_at_constant_damping_ratio(r: Readings) -> np.ndarray:
    """Of a stiffness with the damping ratio unchanged: 2iζω₀Ω changes by half its fraction."""
    return 1 + 1j * r.damping_ratio * r.relative_frequency


def of_force(force: Callable[..., np.ndarray]) -> tuple[Change, Change]:
    """Change and higher harmonics of a force of displacement, velocity over ω₀ and shape."""

    def of_order(r: Readings, order: int, *shape: float) -> np.ndarray:
        omega = r.relative_frequency[:, None]
        return describing.harmonic(
            lambda q, slope: force(q, omega * slope, *shape), r.relative_amplitude, order
        )

    return (
        lambda r, *shape: of_order(r, 1, *shape),
        lambda r, one, *shape: of_order(r, one.order, *shape),
    )


def quadratic_change(r: Readings, log_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Of a force s q², and the second harmonic of the motion."""
    x, omega = r.relative_amplitude, r.frequency_over_level
    return describing.quadratic(x, omega, r.damping_ratio, np.exp(log_s))


def bilinear_change(r: Readings, log_k: float) -> tuple[np.ndarray, np.ndarray]:
    """Of k|q|/2, by the mean −ka/π and the second harmonic 2ka/(3π) of the motion."""
    k = np.exp(log_k)
    twice = 2 * k / (3 * np.pi) * np.ones_like(r.dynamic_stiffness)
    return -2 * (k / np.pi) ** 2 + twice**2 / (4 * r.frequency_over_level**2 - 1), twice


def preload_change(r: Readings, log_static: float) -> tuple[np.ndarray, np.ndarray]:
    """Of a static displacement q₀ on the model's own cubic force γ q³, and the second harmonic.

    About q₀ that force is γ q₀³ + 3γ q₀² q + 3γ q₀ q² + γ q³.
    """
    static = np.exp(log_static)
    square = 3 * cubic_of_model(r) * static  # of a force square × q²
    if square == 0:
        return 0 * r.dynamic_stiffness, 0 * r.dynamic_stiffness
    x, omega = r.relative_amplitude, r.frequency_over_level
    change, twice = describing.quadratic(x, omega, r.damping_ratio, abs(square))
    return square * static + change, np.sign(square) * twice


def preload(r: Readings, strength: float, log_static: float, side: float) -> tuple[float]:
    """The constant force at a strength, which goes with the square of the static displacement."""
    static = side * np.exp(log_static) * np.sqrt(max(strength, 0.0))
    force = static + cubic_of_model(r) * static**3
    return (float(-force * r.natural_frequency**2 * r.largest),)


def cubic_of_model(r: Readings) -> float:
    """γ over ω₀² for the largest amplitude 1, where the model's stiffness is that of γ q³."""
    stiffness = r.model.value.real / r.natural_frequency**2
    stiffness = stiffness - stiffness[r.model.logs == 0]
    unit = 0.75 * np.expm1(2 * r.model.logs)[:, None] * r.relative_amplitude**2
    return float(np.sum(unit * stiffness) / np.sum(unit**2))


def second_harmonic_of(law: Callable[[Readings, float], tuple[np.ndarray, np.ndarray]]) -> Change:
    """The second harmonic of an even law of either sign."""

    def higher(r: Readings, one: HarmonicReading, log_s: float, side: float) -> np.ndarray:
        return side * law(r, log_s)[1] * (one.order == 2)

    return higher


def at_stop(q: np.ndarray, _: np.ndarray, width: float, log_k: float) -> np.ndarray:
    """Force of a one-sided stop about the mean displacement that it causes."""
    mean = describing.mean_at_stop(np.max(np.abs(q), axis=1), width, np.exp(log_k))
    return np.maximum(q + mean[:, None] - width, 0.0)


def resonance_change(order: int) -> Change:
    """By a mode near `order` times the frequency, coupled by the potential b qⁿ p."""

    def change(r: Readings, detuning: float, log_times: float) -> np.ndarray:
        ratio = np.exp(log_times) * max(r.damping_ratio, 1e-4)
        return describing.resonant(
            r.relative_amplitude, r.frequency_over_level, order, detuning, ratio
        )

    return change


def third_of_resonance(order: int) -> Change:
    """Third harmonic of n b qⁿ⁻¹ p with p at n times the frequency: n − 1 times the change."""
    change = resonance_change(order)

    def higher(r: Readings, one: HarmonicReading, *shape: float) -> np.ndarray:
        return (order - 1) * change(r, *shape) * (one.order == 3)

    return higher


def resonance_parameters(order: int) -> Callable[..., tuple[float, ...]]:
    """Coupling b from strength s = n b² a²ⁿ⁻²/(4ⁿ⁻¹ ω₀⁴) at the largest amplitude a."""

    def parameters(r: Readings, s: float, detuning: float, log_times: float) -> tuple[float, ...]:
        square = max(s, 0.0) * 4 ** (order - 1) / order
        coupling = np.sqrt(square) * r.natural_frequency**2 / r.largest ** (order - 1)
        hz = order * (1 + detuning) * r.natural_frequency / HERTZ
        return float(coupling), hz, float(np.exp(log_times)) * max(r.damping_ratio, 1e-4)

    return parameters


def close_mode_change(r: Readings, apart: float, log_times: float) -> np.ndarray:
    """Change by a mode at (1 + `apart`) ω₀ driven by the same force."""
    own, omega = 1 + apart, r.relative_frequency
    ratio = np.exp(log_times) * max(r.damping_ratio, 1e-4)
    return relative_stiffness(r) ** 2 / (own**2 - omega**2 + 2j * ratio * own * omega)


def relative_stiffness(r: Readings) -> np.ndarray:
    """The measured dynamic stiffness over ω₀²."""
    return r.dynamic_stiffness / r.natural_frequency**2


def larger_motion(power: int) -> Change:
    """Change where motions are recorded too large by g ∝ aᵖ of the true amplitude a.

    Arguments: `power`: p. The change of the model is exact, Zₘ(a)/(1 + g) − Zₘ(a(1 + g)). What the
    readings have beyond it, H, changes by −g(H + dH/d ln a).
    """

    def change(r: Readings, gain: float) -> np.ndarray:
        g = _gains(r, gain, power)
        known = r.model.at(0 * g)
        of_model = r.model.at(-np.log1p(g)) / (1 + g) - known
        beyond, weight = r.dynamic_stiffness - known - of_model, np.sqrt(np.linalg.det(r.root))
        value, slope = _smooth(r.relative_amplitude, beyond, weight)
        return _per_gain(r, of_model - g * (value + slope), gain)

    return change


def harmonics_of_larger_motion(power: int) -> Change:
    """Likewise of cₕ/x, whose harmonics have the same gain: −g dH/d ln a beyond the model."""

    def higher(r: Readings, one: HarmonicReading, gain: float) -> np.ndarray:
        g = _gains(r, gain, power)
        of_model = one.model.at(-np.log1p(g)) - one.model.at(0 * g)
        _, slope = _smooth(r.relative_amplitude, one.beyond - of_model, one.weight)
        return _per_gain(r, of_model - g * slope, gain)

    return higher


def _gains(r: Readings, gain: float, power: int) -> np.ndarray:
    """Gain g ∝ aᵖ of every state, with `gain` at the largest one; a: true amplitude."""
    g = gain * np.ones_like(r.relative_amplitude)
    for _ in range(_ITERATIONS if power else 0):
        g = gain * (r.relative_amplitude * (1 + gain) / (1 + g)) ** power
    return g


def _smooth(x: np.ndarray, values: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values as a polynomial of the amplitude, and its derivative by ln of the amplitude.

    Shrunk as far as it may be noise: James and Stein, Proc. 4th Berkeley Symp. 1 (1961) 361.
    `weight`: 1 over the 1σ of real and imaginary parts.
    """
    powers = np.arange(_POWERS)
    terms = x[:, None] ** powers
    fitted = np.linalg.lstsq(terms * weight[:, None], values * weight, rcond=None)[0]
    explained = np.sum(np.abs(terms @ fitted * weight) ** 2)
    fitted = fitted * max(0.0, 1 - 2 * _POWERS / max(explained, 1e-300))
    return terms @ fitted, terms @ (powers * fitted)


def _per_gain(r: Readings, change: np.ndarray, gain: float) -> np.ndarray:
    return change * (priors.GAIN / (gain * r.natural_frequency**2))


def shape_change(r: Readings, strength: float, _: float) -> tuple[float]:
    """Coefficient s, with s Q² the gain at the largest true amplitude Q."""
    gain = strength * priors.GAIN
    return (gain * ((1 + gain) / r.largest) ** 2,)


def forced_harmonic(r: Readings, one: HarmonicReading, order: float) -> np.ndarray:
    """The response to a harmonic of the exciter force."""
    return one.forced / r.natural_frequency**2 * (one.order == order)
