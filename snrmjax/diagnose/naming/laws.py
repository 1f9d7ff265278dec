"""First-order change of the readings by every kind of effect in the library.

Values are relative to ω₀², as functions of the amplitude over the largest one. Nonlinear parameters
(a gap, an exponent) have a grid of values. Other harmonics are those of the force under the
measured fundamental motion.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex

from snrmjax.diagnose import priors
from snrmjax.diagnose.naming import describing
from snrmjax.diagnose.naming.readings import HarmonicReading, Readings
from snrmjax.model.library.damping import (
    CubicDamping,
    QuadraticDamping,
    VanDerPolDamping,
)
from snrmjax.model.library.friction import (
    CoulombFriction,
    IwanMicroslip,
    JenkinsSlider,
)
from snrmjax.model.library.internal_resonances import (
    InternalResonanceOneToThree,
    InternalResonanceOneToTwo,
)
from snrmjax.model.library.linear_changes import (
    AddedMass,
    FrequencyDrift,
    LinearDampingChange,
    LinearFrequencyShift,
)
from snrmjax.model.library.measurement_chain import (
    CloseMode,
    ForceGainError,
    ForceHarmonics,
    ForceOffsetError,
    ModeShapeChange,
    ResidualMode,
    SensorGainError,
    SensorPhaseError,
)
from snrmjax.model.library.stiffness import (
    BilinearStiffness,
    CubicStiffness,
    GapStiffness,
    OneSidedStop,
    QuadraticStiffness,
    QuinticStiffness,
)
from snrmjax.numerics.units import HERTZ

# Over the largest amplitude; fine enough that neighbouring values show a corner between them.
_GAPS = np.linspace(0.04, 0.96, 47)
_STIFFNESSES = np.log([0.2, 2.0, 20.0])  # ln, of a stop, over ω₀²
# ln, over ω₀² and the largest amplitude
_QUADRATICS = np.log([0.003, 0.008, 0.02, 0.05, 0.12, 0.3])
_BILINEARS = np.log([0.003, 0.01, 0.03, 0.1, 0.3])  # ln, over ω₀²
_SLIPS = np.linspace(np.log(0.02), np.log(0.95), 47)  # ln, over the largest amplitude
_EXPONENTS = np.linspace(1.1, 2.9, 10)
_DETUNINGS = np.linspace(-0.04, 0.04, 9)
_APART = np.array([-0.3, -0.1, -0.05, -0.02, 0.02, 0.05, 0.1, 0.3])  # of a close mode, over ω₀
_MOTION_GAINS = np.linspace(-0.24, 0.24, 8)  # at the largest amplitude
_ITERATIONS = 40  # each of which reduces the error of such a gain by a factor of two or more
_POWERS = 4  # of the amplitude, from 0
_DAMPINGS = np.log([0.5, 2.0])  # ln, of a further mode, over the mode's own


class Law(NamedTuple):
    """The change by one kind of effect."""

    # Change of the dynamic stiffness over ω₀², by readings and shape.
    change: Callable[..., Complex[np.ndarray, " state"]]
    # Harmonic of the force, likewise, by readings, one recorded harmonic and shape.
    higher: Callable[..., Complex[np.ndarray, " state"]] | None = None
    axes: tuple[np.ndarray, ...] = ()  # values of the shape
    choices: tuple[float, ...] = ()  # discrete values of a last shape number, not refined
    sign: int = 0  # of the strength
    std: float | None = None  # 1σ of the strength; None: over `STRENGTHS`
    unit: float | None = None  # shape at strength 1, where the change depends on the strength
    odds: float = 1.0  # over those of a law
    of_instrument: bool = False
    # Parameters of the effect in modal units, by readings, strength and shape.
    parameters: Callable[..., tuple[float, ...]] | None = None


Change = Callable[..., np.ndarray]


def _stiffness(power: int) -> Change:
    return lambda r: r.relative_amplitude**power + 0j


def _same_ratio(r: Readings) -> np.ndarray:
    """Of a stiffness with the damping ratio unchanged: 2iζω₀Ω changes by half its fraction."""
    return 1 + 1j * r.damping_ratio * r.relative_frequency


def _damping(power: int, frequency_power: int) -> Change:
    """Damping by a force ∝ a^(power + 1) Ω^frequency_power."""
    return lambda r: 1j * r.relative_amplitude**power * r.relative_frequency**frequency_power


def _of_force(force: Callable[..., np.ndarray]) -> Change:
    """Harmonics of a force of displacement, velocity over ω₀ and shape."""

    def higher(r: Readings, one: HarmonicReading, *shape: float) -> np.ndarray:
        omega = r.relative_frequency[:, None]
        return describing.harmonic(
            lambda q, slope: force(q, omega * slope, *shape), r.relative_amplitude, one.order
        )

    return higher


def _slider(r: Readings, log_slip: float) -> np.ndarray:
    lost, damping = describing.slider(r.relative_amplitude, np.exp(log_slip))
    return lost + 1j * damping


def _iwan(r: Readings, exponent: float) -> np.ndarray:
    lost, damping = describing.masing(exponent)
    return (lost + 1j * damping) * r.relative_amplitude ** (exponent - 1)


def _quadratic(r: Readings, log_s: float) -> tuple[np.ndarray, np.ndarray]:
    x, omega = r.relative_amplitude, r.relative_frequency
    return describing.quadratic(x, omega, r.damping_ratio, np.exp(log_s))


def _bilinear(r: Readings, log_k: float) -> tuple[np.ndarray, np.ndarray]:
    """Of k|q|/2, by the mean −ka/π and the second harmonic 2ka/(3π) of the motion."""
    k = np.exp(log_k)
    twice = 2 * k / (3 * np.pi) * np.ones_like(r.dynamic_stiffness)
    return -2 * (k / np.pi) ** 2 + twice**2 / (4 * r.relative_frequency**2 - 1), twice


def _second_of(law: Callable[[Readings, float], tuple[np.ndarray, np.ndarray]]) -> Change:
    """The second harmonic of an even law of either sign."""

    def higher(r: Readings, one: HarmonicReading, log_s: float, side: float) -> np.ndarray:
        return side * law(r, log_s)[1] * (one.order == 2)

    return higher


def _at_stop(r: Readings, one: HarmonicReading, width: float, log_k: float) -> np.ndarray:
    mean = describing.mean_at_stop(r.relative_amplitude, width, np.exp(log_k))[:, None]
    return describing.harmonic(
        lambda q, _: np.maximum(q + mean - width, 0.0), r.relative_amplitude, one.order
    )


def _resonance(order: int) -> Change:
    def change(r: Readings, detuning: float, log_times: float) -> np.ndarray:
        ratio = np.exp(log_times) * max(r.damping_ratio, 1e-4)
        return describing.resonant(
            r.relative_amplitude, r.relative_frequency, order, detuning, ratio
        )

    return change


def _third_of_resonance(order: int) -> Change:
    """Third harmonic of n b qⁿ⁻¹ p with p at n times the frequency: n − 1 times the change."""
    change = _resonance(order)

    def higher(r: Readings, one: HarmonicReading, *shape: float) -> np.ndarray:
        return (order - 1) * change(r, *shape) * (one.order == 3)

    return higher


def _of_resonance(order: int) -> Callable[..., tuple[float, ...]]:
    """Coupling b from strength s = n b² a²ⁿ⁻²/(4ⁿ⁻¹ ω₀⁴) at the largest amplitude a."""

    def parameters(r: Readings, s: float, detuning: float, log_times: float) -> tuple[float, ...]:
        square = max(s, 0.0) * 4 ** (order - 1) / order
        coupling = np.sqrt(square) * r.natural_frequency**2 / r.largest ** (order - 1)
        hz = order * (1 + detuning) * r.natural_frequency / HERTZ
        return float(coupling), hz, float(np.exp(log_times)) * max(r.damping_ratio, 1e-4)

    return parameters


def _close_mode(r: Readings, apart: float, log_times: float) -> np.ndarray:
    """Change by a mode at (1 + `apart`) ω₀ driven by the same force."""
    own, omega = 1 + apart, r.relative_frequency
    ratio = np.exp(log_times) * max(r.damping_ratio, 1e-4)
    return _relative(r) ** 2 / (own**2 - omega**2 + 2j * ratio * own * omega)


def _relative(r: Readings) -> np.ndarray:
    return r.dynamic_stiffness / r.natural_frequency**2


def _larger_motion(power: int) -> Change:
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


def _harmonics_of_larger_motion(power: int) -> Change:
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
    return change * priors.GAIN / (gain * r.natural_frequency**2)


def _shape_change(r: Readings, strength: float, _: float) -> tuple[float]:
    """Coefficient s, with s Q² the gain at the largest true amplitude Q."""
    gain = strength * priors.GAIN
    return (gain * ((1 + gain) / r.largest) ** 2,)


def _forced(r: Readings, one: HarmonicReading, order: float) -> np.ndarray:
    return one.forced / r.natural_frequency**2 * (one.order == order)


_INSTRUMENT: dict[str, Any] = {"odds": priors.INSTRUMENT, "of_instrument": True}
_OF_GAIN: dict[str, Any] = {"std": 1.0, **_INSTRUMENT}

LAWS: dict[str, Law] = {
    LinearFrequencyShift.kind: Law(
        _same_ratio, parameters=lambda r, s: (float(np.sqrt(max(1 + s, 0.0))) - 1,)
    ),
    CubicStiffness.kind: Law(
        _stiffness(2),
        _of_force(lambda q, _: 4 / 3 * q**3),
        parameters=lambda r, s: (s * r.natural_frequency**2 / (0.75 * r.largest**2),),
    ),
    QuinticStiffness.kind: Law(
        _stiffness(4),
        _of_force(lambda q, _: 1.6 * q**5),
        parameters=lambda r, s: (s * r.natural_frequency**2 / (0.625 * r.largest**4),),
    ),
    QuadraticStiffness.kind: Law(
        lambda r, log_s, _: _quadratic(r, log_s)[0],
        _second_of(_quadratic),
        axes=(_QUADRATICS,),
        choices=(1.0, -1.0),
        sign=1,
        parameters=lambda r, s, log_s, side: (
            side * float(np.exp(log_s) * np.sqrt(max(s, 0.0))) * r.natural_frequency**2 / r.largest,
        ),
    ),
    BilinearStiffness.kind: Law(
        lambda r, log_k, _: _bilinear(r, log_k)[0],
        _second_of(_bilinear),
        axes=(_BILINEARS,),
        choices=(1.0, -1.0),
        sign=-1,
        parameters=lambda r, s, log_k, side: (
            side * float(np.exp(log_k) * np.sqrt(max(-s, 0.0))) * r.natural_frequency**2,
        ),
    ),
    GapStiffness.kind: Law(
        lambda r, width: describing.gap(r.relative_amplitude, width) + 0j,
        _of_force(lambda q, _, width: np.sign(q) * np.maximum(np.abs(q) - width, 0.0)),
        (_GAPS,),
        sign=1,
        parameters=lambda r, s, width: (s * r.natural_frequency**2, width * r.largest),
    ),
    OneSidedStop.kind: Law(
        lambda r, width, log_k: describing.stop(r.relative_amplitude, width, np.exp(log_k)) + 0j,
        _at_stop,
        (_GAPS, _STIFFNESSES),
        sign=1,
        parameters=lambda r, s, width, _: (s * r.natural_frequency**2, width * r.largest),
    ),
    LinearDampingChange.kind: Law(_damping(0, 1), parameters=lambda r, s: (s / 2,)),
    QuadraticDamping.kind: Law(
        _damping(1, 2),
        _of_force(lambda _, v: 3 * np.pi / 8 * v * np.abs(v)),
        sign=1,
        parameters=lambda r, s: (s * 3 * np.pi / (8 * r.largest),),
    ),
    CubicDamping.kind: Law(
        _damping(2, 3),
        _of_force(lambda _, v: 4 / 3 * v**3),
        parameters=lambda r, s: (s / (0.75 * r.largest**2 * r.natural_frequency),),
    ),
    VanDerPolDamping.kind: Law(
        _damping(2, 1),
        _of_force(lambda q, v: 4 * q**2 * v),
        parameters=lambda r, s: (4 * s * r.natural_frequency / r.largest**2,),
    ),
    CoulombFriction.kind: Law(
        _damping(-1, 0),
        _of_force(lambda _, v: np.pi / 4 * np.sign(v)),
        sign=1,
        parameters=lambda r, s: (s * r.natural_frequency**2 * np.pi * r.largest / 4,),
    ),
    JenkinsSlider.kind: Law(
        _slider,
        _of_force(lambda q, v, log_slip: describing.slipping(q, v, np.exp(log_slip))),
        (_SLIPS,),
        sign=1,
        parameters=lambda r, s, log_slip: (
            s * r.natural_frequency**2,
            float(np.exp(log_slip)) * r.largest,
        ),
    ),
    IwanMicroslip.kind: Law(
        _iwan,
        _of_force(describing.microslip),
        (_EXPONENTS,),
        sign=1,
        parameters=lambda r, s, p: (s * r.natural_frequency**2 / r.largest ** (p - 1), p),
    ),
    InternalResonanceOneToTwo.kind: Law(
        _resonance(2),
        _third_of_resonance(2),
        (_DETUNINGS, _DAMPINGS),
        sign=1,
        odds=priors.RESONANCE,
        parameters=_of_resonance(2),
    ),
    InternalResonanceOneToThree.kind: Law(
        _resonance(3),
        _third_of_resonance(3),
        (_DETUNINGS, _DAMPINGS),
        sign=1,
        odds=priors.RESONANCE,
        parameters=_of_resonance(3),
    ),
    AddedMass.kind: Law(
        lambda r: -(r.relative_frequency**2) * priors.ADDED_MASS + 0j,
        std=1.0,
        odds=priors.INSTRUMENT,
        parameters=lambda r, s: (s * priors.ADDED_MASS,),
    ),
    ForceHarmonics.kind: Law(
        lambda r, _: np.zeros_like(r.dynamic_stiffness),
        _forced,
        choices=(2.0, 3.0),
        parameters=lambda r, s, order: (s * (order == 2), s * (order == 3)),
        **_INSTRUMENT,
    ),
    ForceGainError.kind: Law(
        lambda r: _relative(r) * priors.GAIN,
        parameters=lambda r, s: (-s * priors.GAIN,),
        **_OF_GAIN,
    ),
    SensorGainError.kind: Law(
        _larger_motion(0),
        _harmonics_of_larger_motion(0),
        axes=(_MOTION_GAINS,),
        unit=priors.GAIN,
        parameters=lambda r, s, _: (s * priors.GAIN,),
        **_OF_GAIN,
    ),
    ModeShapeChange.kind: Law(
        _larger_motion(2),
        _harmonics_of_larger_motion(2),
        axes=(_MOTION_GAINS,),
        unit=priors.GAIN,
        std=1.0,
        odds=priors.INSTRUMENT,
        parameters=_shape_change,
    ),
    CloseMode.kind: Law(
        _close_mode,
        axes=(_APART, _DAMPINGS),
        parameters=lambda r, s, apart, log_times: (
            -s * r.constant,
            (1 + apart) * r.natural_frequency / HERTZ,
            float(np.exp(log_times)) * max(r.damping_ratio, 1e-4),
        ),
        **_INSTRUMENT,
    ),
    ResidualMode.kind: Law(
        lambda r: _relative(r) ** 2,
        parameters=lambda r, s: (-s * r.constant / r.natural_frequency**2,),
        **_INSTRUMENT,
    ),
    SensorPhaseError.kind: Law(
        lambda r: -1j * _relative(r) * priors.INSTRUMENT_PHASE,
        parameters=lambda r, s: (float(np.rad2deg(s * priors.INSTRUMENT_PHASE)),),
        **_OF_GAIN,
    ),
    ForceOffsetError.kind: Law(
        lambda r: _relative(r) * np.min(r.force) / r.force * priors.FORCE_OFFSET,
        parameters=lambda r, s: (-s * priors.FORCE_OFFSET * float(np.min(r.force)),),
        **_OF_GAIN,
    ),
    FrequencyDrift.kind: Law(
        lambda r: 2 * r.order * priors.DRIFT * _same_ratio(r),
        parameters=lambda r, s: (s * priors.DRIFT,),
        **_OF_GAIN,
    ),
}
"""Change of the dynamic stiffness over ω₀², by kind of effect."""
