"""Kinds of effects: how their shape is drawn, their first-order change of the dynamic stiffness.

Scaled as in `forces`. K = F/X is the force over the displacement of the mode of interest; that of
the baseline is 1 − w² + 2iζw + ¾a₃Q² to first order, with w = Ω/ω₀.
"""

from collections.abc import Callable
from dataclasses import dataclass

import forces
import jax.numpy as jnp
import numpy as np

Draw = np.random.Generator


@dataclass(frozen=True)
class Baseline:
    """What the model knows: a mode with a cubic stiffness, at levels of force."""

    damping: float
    cubic: float
    peaks: tuple[float, ...]  # displacement at resonance, level by level, 1 at the top


@dataclass(frozen=True)
class Effect:
    """An effect with its parameters by `kind.parameter`; `scaled` ones carry its size."""

    kind: str
    parameters: dict[str, float]
    scaled: tuple[str, ...]

    def sized(self, size: float) -> "Effect":
        """The same effect with its size multiplied."""
        grown = {n: v * (size if n in self.scaled else 1.0) for n, v in self.parameters.items()}
        return Effect(self.kind, grown, self.scaled)

    def get(self, name: str) -> float:
        """One parameter."""
        return self.parameters[f"{self.kind}.{name}"]


@dataclass(frozen=True)
class Points:
    """Motions: level, amplitude, frequency Ω/ω₀ and test order of each."""

    level: np.ndarray
    amplitude: np.ndarray
    frequency: np.ndarray
    order: np.ndarray


def _sign(rng: Draw) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _one(name: str, either_sign: bool) -> Callable[[Draw, Baseline], dict[str, float]]:
    return lambda rng, base: {name: _sign(rng) if either_sign else 1.0}


def _with(
    size: str, low: float, high: float, name: str, either_sign: bool = False
) -> Callable[[Draw, Baseline], dict[str, float]]:
    def shape(rng: Draw, base: Baseline) -> dict[str, float]:
        sign = _sign(rng) if either_sign else 1.0
        return {size: sign, name: float(rng.uniform(low, high))}

    return shape


def _resonance(n: int) -> Callable[[Draw, Baseline], dict[str, float]]:
    def shape(rng: Draw, base: Baseline) -> dict[str, float]:
        peak = base.peaks[-1]
        near = np.sqrt(1 + 0.75 * base.cubic * peak**2) + rng.uniform(-0.7, 0.7) * base.damping
        return {
            "coefficient": _sign(rng),
            "frequency": float(n * near),
            "damping_ratio": float(min(base.damping * rng.uniform(0.4, 1.5), 0.03)),
        }

    return shape


def _close_mode(rng: Draw, base: Baseline) -> dict[str, float]:
    away = _sign(rng) * rng.uniform(2.0, 6.0) * base.damping
    damping = base.damping * rng.uniform(0.5, 1.5)
    return {"constant": _sign(rng), "frequency": 1 + float(away), "damping_ratio": float(damping)}


def _two_gaps(rng: Draw, base: Baseline) -> dict[str, float]:
    gap, outer = rng.uniform(0.2, 0.4), rng.uniform(0.6, 0.8)
    second = rng.choice([-0.7, 1.5])
    return {"stiffness": 1.0, "gap": gap, "outer_gap": outer, "second": float(second)}


def _cable(rng: Draw, base: Baseline) -> dict[str, float]:
    return {"stiffness": 1.0, "gap": rng.uniform(0.2, 0.5), "width": rng.uniform(0.05, 0.12)}


def _valanis(rng: Draw, base: Baseline) -> dict[str, float]:
    slip, curvature = rng.uniform(0.15, 0.5), rng.uniform(0.4, 0.8)
    return {"stiffness": 1.0, "slip_displacement": slip, "curvature_exponent": curvature}


def _lap(rng: Draw, base: Baseline) -> dict[str, float]:
    slip, exponent = rng.uniform(0.25, 0.7), rng.uniform(1.2, 3.0)
    return {"stiffness": 1.0, "slip_displacement": slip, "exponent": exponent}


def _harmonics(rng: Draw, base: Baseline) -> dict[str, float]:
    return {"second": _sign(rng), "third": _sign(rng) * float(rng.uniform(0.4, 1.5))}


SHAPES: dict[str, tuple[Callable[[Draw, Baseline], dict[str, float]], tuple[str, ...]]] = {
    "linear_frequency_shift": (_one("relative_shift", True), ("relative_shift",)),
    "linear_damping_change": (_one("damping_ratio_change", True), ("damping_ratio_change",)),
    "cubic_stiffness": (_one("coefficient", True), ("coefficient",)),
    "quadratic_stiffness": (_one("coefficient", True), ("coefficient",)),
    "quintic_stiffness": (_one("coefficient", True), ("coefficient",)),
    "bilinear_stiffness": (_one("stiffness", True), ("stiffness",)),
    "gap_stiffness": (_with("stiffness", 0.35, 0.7, "gap"), ("stiffness",)),
    "one_sided_stop": (_with("stiffness", 0.35, 0.7, "gap"), ("stiffness",)),
    "coulomb_friction": (_one("force", False), ("force",)),
    "jenkins_slider": (_with("stiffness", 0.15, 0.5, "slip_displacement"), ("stiffness",)),
    "iwan_microslip": (_with("coefficient", 1.25, 1.8, "exponent"), ("coefficient",)),
    "quadratic_damping": (_one("coefficient", False), ("coefficient",)),
    "cubic_damping": (_one("coefficient", False), ("coefficient",)),
    "van_der_pol_damping": (_one("coefficient", False), ("coefficient",)),
    "frequency_drift": (_one("relative_drift", True), ("relative_drift",)),
    "added_mass": (_one("mass", True), ("mass",)),
    "force_gain_error": (_one("gain", True), ("gain",)),
    "force_offset_error": (_one("offset", True), ("offset",)),
    "sensor_gain_error": (_one("gain", True), ("gain",)),
    "sensor_phase_error": (_one("phase_deg", True), ("phase_deg",)),
    "internal_resonance_1_3": (_resonance(3), ("coefficient",)),
    "internal_resonance_1_2": (_resonance(2), ("coefficient",)),
    "residual_mode": (_one("receptance", True), ("receptance",)),
    "mode_shape_change": (_one("coefficient", True), ("coefficient",)),
    "force_harmonics": (_harmonics, ("second", "third")),
    "static_preload": (_one("constant_force", True), ("constant_force",)),
}
"""26 kinds of the library: shape at unit size, and the parameters that carry the size."""

OUTSIDE: dict[str, tuple[Callable[[Draw, Baseline], dict[str, float]], tuple[str, ...]]] = {
    "lugre": (_with("stiffness", 0.1, 0.3, "slip_displacement"), ("stiffness",)),
    "bouc_wen": (_with("stiffness", 0.15, 0.5, "slip_displacement"), ("stiffness",)),
    "delayed_feedback": (_with("coefficient", 0.6, 1.2, "lag", True), ("coefficient",)),
    "hertz_clearance": (_with("stiffness", 0.3, 0.6, "gap"), ("stiffness",)),
    "magnet_stiffness": (_with("stiffness", 0.4, 0.9, "width", True), ("stiffness",)),
    "square_root_damping": (_one("coefficient", False), ("coefficient",)),
    "asymmetric_damping": (_one("coefficient", False), ("coefficient",)),
    "rubbing": (_with("friction", 0.3, 0.6, "gap"), ("friction",)),
    "sensor_saturation": (_one("inverse_range", False), ("inverse_range",)),
    "frequency_jump": (_with("relative_jump", 0.35, 0.65, "at", True), ("relative_jump",)),
    "warming": (_with("softening", 0.15, 0.4, "rate"), ("softening",)),
    "close_mode": (_close_mode, ("constant",)),
}
"""Kinds that the library does not look for; `close_mode` is compared with some answers."""

LAWS: dict[str, tuple[Callable[[Draw, Baseline], dict[str, float]], tuple[str, ...]]] = {
    "tanh_spring": (_with("stiffness", 0.3, 0.9, "width"), ("stiffness",)),
    "logarithmic_spring": (_with("stiffness", 0.2, 0.6, "width"), ("stiffness",)),
    "sinh_spring": (_with("stiffness", 0.25, 0.5, "width"), ("stiffness",)),
    "trilinear_spring": (_two_gaps, ("stiffness",)),
    "power_contact": (_one("stiffness", False), ("stiffness",)),
    "exponential_contact": (_with("stiffness", 0.3, 0.6, "width"), ("stiffness",)),
    "magnet_gap": (_with("stiffness", 1.8, 3.0, "gap"), ("stiffness",)),
    "slack_cable": (_cable, ("stiffness",)),
    "stribeck_friction": (_with("force", 0.15, 0.5, "width"), ("force",)),
    "threshold_damper": (_with("coefficient", 0.25, 0.6, "gap"), ("coefficient",)),
    "aerodynamic_damping": (_one("coefficient", False), ("coefficient",)),
    "squeeze_film": (_with("coefficient", 1.25, 2.0, "gap"), ("coefficient",)),
    "sine_damping": (_with("coefficient", 0.6, 1.2, "width"), ("coefficient",)),
    "dahl": (_with("stiffness", 0.15, 0.6, "slip_displacement"), ("stiffness",)),
    "valanis": (_valanis, ("stiffness",)),
    "weibull_lap": (_lap, ("stiffness",)),
}
"""Laws of displacement, velocity or slip that no formula of the library has; see `laws`."""

SLIP = (*("jenkins_slider", "lugre", "bouc_wen", "dahl", "valanis", "weibull_lap"),)
IN_HARMONICS_ONLY = ("bilinear_stiffness", "force_harmonics")
IN_TEST_ORDER = ("frequency_drift", "frequency_jump", "warming")


def draw_effect(kind: str, rng: Draw, base: Baseline) -> Effect:
    """The shape of one effect, at unit size."""
    shape, scaled = {**SHAPES, **OUTSIDE, **LAWS}[kind]
    values = {f"{kind}.{name}": value for name, value in shape(rng, base).items()}
    return Effect(kind, values, tuple(f"{kind}.{name}" for name in scaled))


def _slider(q: np.ndarray, w: np.ndarray, k: float, slip: float) -> np.ndarray:
    x = np.minimum(slip / q, 1.0)
    theta = np.arccos(1 - 2 * x)
    stiffness = k / np.pi * (theta - np.sin(theta) * np.cos(theta)) - k
    return stiffness + 4j * k * x * (1 - x) / np.pi


def _over_a_cycle(effect: Effect, q: np.ndarray, w: np.ndarray) -> np.ndarray:
    beta = 2 * np.pi * (np.arange(1024) + 0.5)[:, None] / 1024
    p = {name: jnp.asarray(value) for name, value in effect.parameters.items()}
    p["lane.speed"] = jnp.asarray(q)
    y, u = q * np.cos(beta), -q * w * np.sin(beta)
    force = np.asarray(forces.MEMORYLESS[effect.kind](jnp.asarray(y), jnp.asarray(u), p))
    return 2 * np.mean(force * np.exp(-1j * beta), axis=0) / q


def _close(effect: Effect, w: np.ndarray) -> np.ndarray:
    w2, z2 = effect.get("frequency"), effect.get("damping_ratio")
    return effect.get("constant") / (w2**2 - w**2 + 2j * z2 * w2 * w)


def first_order_change(effect: Effect, at: Points, base: Baseline) -> np.ndarray:
    """ΔK of one effect at given motions, to lowest order in its size."""
    q, w, kind = at.amplitude, at.frequency, effect.kind
    k = 1 - w**2 + 2j * base.damping * w + 0.75 * base.cubic * q**2
    slope = 1.5 * base.cubic * q**2  # Q dK/dQ

    def seen(error: np.ndarray | complex) -> np.ndarray:  # X is recorded as X (1 + error)
        return -error * k - np.real(error) * slope

    def shifted(s: np.ndarray | float) -> np.ndarray:
        return 2 * s + 2j * base.damping * w * s

    if kind in SLIP:
        return _slider(q, w, effect.get("stiffness"), effect.get("slip_displacement"))
    if kind == "iwan_microslip":
        c, p = effect.get("coefficient"), effect.get("exponent")
        return c * q ** (p - 1) * (-1 + 4j * (p - 1) / (np.pi * (p + 1)))
    if kind == "delayed_feedback":
        lag = 1 / (1 + 1j * w * effect.get("lag")) ** 2
        return 0.75 * effect.get("coefficient") * q**2 * lag * np.abs(lag) ** 2
    if kind == "quadratic_stiffness":
        a = effect.get("coefficient")
        return -(a**2) * q**2 * (1 + 0.5 / (1 - 4 * w**2)) + 0j
    if kind == "static_preload":
        mean = effect.get("constant_force")
        return 3 * base.cubic * mean**2 + 0j * q
    if kind.startswith("internal_resonance"):
        b, w2 = effect.get("coefficient"), effect.get("frequency")
        n = int(kind[-1])
        second = w2**2 - (n * w) ** 2 + 2j * effect.get("damping_ratio") * w2 * n * w
        if n == 3:
            # The cube also drives the further mode at Ω, far from its resonance.
            return -(b**2) * q**4 * (3 / 16 / second + 27 / 16 / (w2**2 - w**2))
        return -(b**2) * q**2 * (0.5 / second + 1 / w2**2)
    changes: dict[str, Callable[[], np.ndarray]] = {
        "linear_frequency_shift": lambda: shifted(effect.get("relative_shift")),
        "linear_damping_change": lambda: 2j * w * effect.get("damping_ratio_change"),
        "frequency_drift": lambda: shifted(effect.get("relative_drift") * at.order),
        "frequency_jump": lambda: shifted(
            effect.get("relative_jump") * (at.order > effect.get("at"))
        ),
        "warming": lambda: shifted(-effect.get("softening") * q**2),
        "added_mass": lambda: -effect.get("mass") * w**2 + 0j,
        "force_gain_error": lambda: -effect.get("gain") * k,
        "force_offset_error": lambda: -effect.get("offset") * k / (np.abs(k) * q),
        "sensor_gain_error": lambda: seen(effect.get("gain")),
        "sensor_phase_error": lambda: seen(1j * np.radians(effect.get("phase_deg"))),
        "residual_mode": lambda: seen(effect.get("receptance") * k),
        "close_mode": lambda: seen(_close(effect, w) * k),
        "mode_shape_change": lambda: seen(effect.get("coefficient") * q**2),
        "sensor_saturation": lambda: seen(-0.375 * (effect.get("inverse_range") * w * q) ** 2),
        "force_harmonics": lambda: 0j * q,
    }
    return changes[kind]() if kind in changes else _over_a_cycle(effect, q, w)


def first_order_harmonics(effect: Effect, at: Points, base: Baseline) -> np.ndarray:
    """Change of |velocity| in harmonics 2 and 3 for the kinds that are seen there only."""
    q, w = at.amplitude, at.frequency
    if effect.kind == "bilinear_stiffness":
        second = 2 * q / (3 * np.pi) * effect.get("stiffness")
        return np.abs([2 * w * second / (1 - 4 * w**2), 0 * q])
    k = np.abs(1 - w**2 + 2j * base.damping * w + 0.75 * base.cubic * q**2) * q
    second, third = effect.get("second"), effect.get("third")
    return np.abs([2 * w * k * second / (1 - 4 * w**2), 3 * w * k * third / (1 - 9 * w**2)])


def lane_values(effect: Effect) -> dict[str, float]:
    """Parameters of the integration that this effect sets, by name."""
    single = {
        "linear_frequency_shift": {"lane.shift": "relative_shift"},
        "linear_damping_change": {"lane.extra_damping": "damping_ratio_change"},
        "frequency_drift": {"test.drift": "relative_drift"},
        "frequency_jump": {"test.jump": "relative_jump", "test.jump_at": "at"},
        "warming": {"test.warming": "softening", "test.warming_rate": "rate"},
        "added_mass": {"lane.mass": "mass"},
        "force_harmonics": {"lane.second": "second", "lane.third": "third"},
        "sensor_saturation": {"lane.saturation": "inverse_range"},
    }
    if effect.kind in single:
        return {lane: effect.get(name) for lane, name in single[effect.kind].items()}
    if effect.kind.startswith("internal_resonance"):
        return {
            "second.coupling": effect.get("coefficient"),
            "second.frequency": effect.get("frequency"),
            "second.damping": effect.get("damping_ratio"),
        }
    known = {*forces.MEMORYLESS, *forces.N_FAST, *forces.SLIDERS}
    return dict(effect.parameters) if effect.kind in known else {}


def recorded(
    effect: Effect, w: np.ndarray, force: np.ndarray, velocity: np.ndarray, motion: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Force and velocity (harmonic, point) as the instruments write them down.

    `motion` is the amplitude of the fundamental of the mode of interest.
    """
    orders = np.arange(len(velocity))[:, None]
    kind = effect.kind
    if kind == "force_gain_error":
        return force / (1 + effect.get("gain")), velocity
    if kind == "force_offset_error":
        return force - effect.get("offset"), velocity
    if kind == "sensor_gain_error":
        return force, velocity * (1 + effect.get("gain"))
    if kind == "sensor_phase_error":
        return force, velocity * np.exp(1j * orders * np.radians(effect.get("phase_deg")))
    if kind == "mode_shape_change":
        return force, velocity * (1 + effect.get("coefficient") * motion**2)
    if kind in ("residual_mode", "close_mode"):
        r = effect.get("receptance") if kind == "residual_mode" else _close(effect, w)
        return force, velocity + (orders == 1) * 1j * w * r * force
    return force, velocity
