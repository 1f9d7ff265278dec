"""Laws of displacement, velocity or slip that no earlier set had, scaled as in `forces`.

The slope of a spring at rest is part of the linear frequency and taken out. `TRUTH` gives each
law as a curve for the score: the force against displacement or velocity, the damping against
displacement, or the force of the first loading, all beside the linear terms.
"""

from collections.abc import Callable, Mapping

import jax.numpy as jnp
import numpy as np
from jax import Array

Parameters = Mapping[str, Array]
SLIDERS_OF_A_LAP = 48
_QUANTILE = (np.arange(SLIDERS_OF_A_LAP) + 0.5) / SLIDERS_OF_A_LAP
SIGN_WIDTH = 0.02  # width of a rounded sign over the velocity amplitude of the level


def _own(kind: str, p: Parameters) -> Callable[[str], Array]:
    return lambda name: p[f"{kind}.{name}"]


def _beyond(y: Array, gap: Array) -> Array:
    return jnp.maximum(y - gap, 0.0) - jnp.maximum(-y - gap, 0.0)


def _tanh_spring(y: Array, u: Array, p: Parameters) -> Array:
    own = _own("tanh_spring", p)
    return own("stiffness") * (own("width") * jnp.tanh(y / own("width")) - y)


def _logarithmic_spring(y: Array, u: Array, p: Parameters) -> Array:
    own = _own("logarithmic_spring", p)
    return own("stiffness") * (own("width") * jnp.arcsinh(y / own("width")) - y)


def _sinh_spring(y: Array, u: Array, p: Parameters) -> Array:
    own = _own("sinh_spring", p)
    return own("stiffness") * (own("width") * jnp.sinh(y / own("width")) - y)


def _trilinear_spring(y: Array, u: Array, p: Parameters) -> Array:
    own = _own("trilinear_spring", p)
    second = own("second") * _beyond(y, own("outer_gap"))
    return own("stiffness") * (_beyond(y, own("gap")) + second)


def _power_contact(y: Array, u: Array, p: Parameters) -> Array:
    own = _own("power_contact", p)
    return own("stiffness") * y * jnp.sqrt(jnp.abs(y))


def _exponential_contact(y: Array, u: Array, p: Parameters) -> Array:
    own = _own("exponential_contact", p)
    width = own("width")
    return own("stiffness") * (width * jnp.expm1(y / width) - y)


def _magnet_gap(y: Array, u: Array, p: Parameters) -> Array:
    own = _own("magnet_gap", p)
    gap = own("gap")
    return -own("stiffness") * gap * ((1 - y / gap) ** -2 - 1 - 2 * y / gap)


def _slack_cable(y: Array, u: Array, p: Parameters) -> Array:
    own = _own("slack_cable", p)
    gap, width = own("gap"), own("width")
    at_rest = 1 / (1 + jnp.exp(gap / width))
    start = jnp.logaddexp(0.0, -gap / width)
    lost = width * (jnp.logaddexp(0.0, (-y - gap) / width) - start) + at_rest * y
    return own("stiffness") * lost


def _stribeck_friction(y: Array, u: Array, p: Parameters) -> Array:
    own = _own("stribeck_friction", p)
    falling = 0.4 + 0.6 * jnp.exp(-jnp.abs(u) / own("width"))
    return own("force") * falling * jnp.tanh(u / (SIGN_WIDTH * p["lane.speed"]))


def _threshold_damper(y: Array, u: Array, p: Parameters) -> Array:
    own = _own("threshold_damper", p)
    return own("coefficient") * _beyond(u, own("gap"))


def _aerodynamic_damping(y: Array, u: Array, p: Parameters) -> Array:
    return _own("aerodynamic_damping", p)("coefficient") * u * jnp.sqrt(jnp.abs(u))


def _squeeze_film(y: Array, u: Array, p: Parameters) -> Array:
    own = _own("squeeze_film", p)
    return own("coefficient") * (1 / (1 - jnp.abs(y) / own("gap")) - 1) * u


def _sine_damping(y: Array, u: Array, p: Parameters) -> Array:
    own = _own("sine_damping", p)
    return own("coefficient") * jnp.sin(0.5 * jnp.pi * y / own("width")) ** 2 * u


MEMORYLESS: dict[str, Callable[[Array, Array, Parameters], Array]] = {
    "tanh_spring": _tanh_spring,
    "logarithmic_spring": _logarithmic_spring,
    "sinh_spring": _sinh_spring,
    "trilinear_spring": _trilinear_spring,
    "power_contact": _power_contact,
    "exponential_contact": _exponential_contact,
    "magnet_gap": _magnet_gap,
    "slack_cable": _slack_cable,
    "stribeck_friction": _stribeck_friction,
    "threshold_damper": _threshold_damper,
    "aerodynamic_damping": _aerodynamic_damping,
    "squeeze_film": _squeeze_film,
    "sine_damping": _sine_damping,
}
FAST = ("dahl", "valanis")
SLIDERS = {"weibull_lap": SLIDERS_OF_A_LAP}

OF: dict[str, str] = {
    **dict.fromkeys(
        ("tanh_spring", "logarithmic_spring", "sinh_spring", "trilinear_spring", "power_contact"),
        "displacement",
    ),
    **dict.fromkeys(("exponential_contact", "magnet_gap", "slack_cable"), "displacement"),
    **dict.fromkeys(("stribeck_friction", "threshold_damper", "aerodynamic_damping"), "velocity"),
    **dict.fromkeys(("squeeze_film", "sine_damping"), "damping by displacement"),
    **dict.fromkeys(("dahl", "valanis", "weibull_lap"), "slip"),
}
"""What each law is a function of."""


def fast_rate(kind: str, u: Array, z: Array, p: Parameters) -> Array:
    """Rate of the elastic stretch z of a law with a memory, per unit of ω₀t."""
    own = _own(kind, p)
    fraction = jnp.sign(u) * z / own("slip_displacement")
    if kind == "dahl":
        return u * (1 - fraction)
    return u * (1 - fraction) / (1 - own("curvature_exponent") * fraction)


def lap_sliders(p: Parameters) -> tuple[Array, Array]:
    """Stiffness and slip displacement of a lap joint whose slip limits are Weibull's."""
    own = _own("weibull_lap", p)
    slip = (-np.log1p(-_QUANTILE))[:, None] ** (1 / own("exponent")) * own("slip_displacement")
    stiffness = own("stiffness") / SLIDERS_OF_A_LAP
    return jnp.broadcast_to(stiffness, slip.shape), slip


def true_curve(kind: str, parameters: Mapping[str, float], x: np.ndarray) -> np.ndarray:
    """The law at scaled displacements or velocities: see `OF`; slip on the first loading."""
    p = {name: jnp.asarray(value) for name, value in parameters.items()}
    p["lane.speed"] = jnp.asarray(1e-3)
    zero, one = jnp.zeros_like(jnp.asarray(x)), jnp.ones_like(jnp.asarray(x))
    if OF[kind] == "displacement":
        return np.asarray(MEMORYLESS[kind](jnp.asarray(x), zero, p))
    if OF[kind] == "velocity":
        return np.asarray(MEMORYLESS[kind](zero, jnp.asarray(x), p))
    if OF[kind] == "damping by displacement":
        return np.asarray(MEMORYLESS[kind](jnp.asarray(x), one, p))
    if kind == "weibull_lap":
        lanes = lap_sliders({name: value[None] for name, value in p.items()})
        stiffness, slip = (np.asarray(one)[:, 0] for one in lanes)
        return -np.sum(stiffness[:, None] * np.maximum(x - slip[:, None], 0.0), axis=0)
    fine = np.linspace(0.0, float(np.max(x)), 4001)
    z = np.zeros_like(fine)
    for k in range(len(fine) - 1):  # dz/dy by the midpoint rule
        step = fine[k + 1] - fine[k]
        half = z[k] + 0.5 * step * float(fast_rate(kind, 1.0, z[k], p))
        z[k + 1] = z[k] + step * float(fast_rate(kind, 1.0, half, p))
    stiffness = parameters[f"{kind}.stiffness"]
    return stiffness * (np.interp(x, fine, z) - x)
