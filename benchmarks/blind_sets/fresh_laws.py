"""Sixteen laws of displacement, velocity or slip more, for tests of what `laws` has led to.

Scaled as in `forces`; the slope of a spring at rest is part of the linear frequency and taken out.
`first_loading` is the force of slip while it grows from rest, beside the stuck spring.
"""

from collections.abc import Callable, Mapping

import jax.numpy as jnp
import numpy as np
from jax import Array

Parameters = Mapping[str, Array]
SLIDERS = {"two_stage_joint": 2, "uniform_lap": 40}
_MIDDLE = (np.arange(SLIDERS["uniform_lap"]) + 0.5) / SLIDERS["uniform_lap"]


def _own(kind: str, p: Parameters) -> Callable[[str], Array]:
    return lambda name: p[f"{kind}.{name}"]


def _over(y: Array, gap: Array) -> Array:
    return jnp.maximum(y - gap, 0.0)


def _string_spring(y: Array, u: Array, p: Parameters) -> Array:
    own = _own("string_spring", p)
    return own("stiffness") * y * (1 - 1 / jnp.sqrt(1 + (y / own("width")) ** 2))


def _pendulum_spring(y: Array, u: Array, p: Parameters) -> Array:
    own = _own("pendulum_spring", p)
    return own("stiffness") * (own("width") * jnp.sin(y / own("width")) - y)


def _morse_spring(y: Array, u: Array, p: Parameters) -> Array:
    own = _own("morse_spring", p)
    width = own("width")
    return own("stiffness") * (width * (jnp.exp(-y / width) - jnp.exp(-2 * y / width)) - y)


def _septic_spring(y: Array, u: Array, p: Parameters) -> Array:
    return _own("septic_spring", p)("stiffness") * y**7


def _square_stop(y: Array, u: Array, p: Parameters) -> Array:
    own = _own("square_stop", p)
    return own("stiffness") * (_over(y, own("gap")) ** 2 - _over(-y, own("gap")) ** 2)


def _one_sided_hertz(y: Array, u: Array, p: Parameters) -> Array:
    own = _own("one_sided_hertz", p)
    over = _over(y, own("gap"))
    return own("stiffness") * over * jnp.sqrt(over)


def _electrostatic_gap(y: Array, u: Array, p: Parameters) -> Array:
    own = _own("electrostatic_gap", p)
    return -own("stiffness") * y * ((1 - (y / own("gap")) ** 2) ** -2 - 1)


def _eddy_brake(y: Array, u: Array, p: Parameters) -> Array:
    own = _own("eddy_brake", p)
    return own("force") * 2 * (u / own("width")) / (1 + (u / own("width")) ** 2)


def _fluid_valve(y: Array, u: Array, p: Parameters) -> Array:
    own = _own("fluid_valve", p)
    return own("coefficient") * jnp.where(u > 0, 1.0, own("back")) * jnp.abs(u) * u


def _steep_damper(y: Array, u: Array, p: Parameters) -> Array:
    return _own("steep_damper", p)("coefficient") * u * jnp.abs(u) * jnp.sqrt(jnp.abs(u))


def _saturating_damper(y: Array, u: Array, p: Parameters) -> Array:
    own = _own("saturating_damper", p)
    return own("force") * jnp.tanh(u / own("width"))


def _film_beyond_gap(y: Array, u: Array, p: Parameters) -> Array:
    own = _own("film_beyond_gap", p)
    return own("coefficient") * _over(jnp.abs(y), own("gap")) * u


def _bell_damping(y: Array, u: Array, p: Parameters) -> Array:
    own = _own("bell_damping", p)
    return own("coefficient") * (1 - jnp.exp(-((y / own("width")) ** 2))) * u


def _stroke_damping(y: Array, u: Array, p: Parameters) -> Array:
    return _own("stroke_damping", p)("coefficient") * jnp.abs(y) * u


MEMORYLESS: dict[str, Callable[[Array, Array, Parameters], Array]] = {
    "string_spring": _string_spring,
    "pendulum_spring": _pendulum_spring,
    "morse_spring": _morse_spring,
    "septic_spring": _septic_spring,
    "square_stop": _square_stop,
    "one_sided_hertz": _one_sided_hertz,
    "electrostatic_gap": _electrostatic_gap,
    "eddy_brake": _eddy_brake,
    "fluid_valve": _fluid_valve,
    "steep_damper": _steep_damper,
    "saturating_damper": _saturating_damper,
    "film_beyond_gap": _film_beyond_gap,
    "bell_damping": _bell_damping,
    "stroke_damping": _stroke_damping,
}

OF: dict[str, str] = {
    **dict.fromkeys(("string_spring", "pendulum_spring", "morse_spring"), "displacement"),
    **dict.fromkeys(("septic_spring", "square_stop", "one_sided_hertz"), "displacement"),
    "electrostatic_gap": "displacement",
    **dict.fromkeys(("eddy_brake", "fluid_valve", "steep_damper", "saturating_damper"), "velocity"),
    **dict.fromkeys(
        ("film_beyond_gap", "bell_damping", "stroke_damping"), "damping by displacement"
    ),
    **dict.fromkeys(SLIDERS, "slip"),
}
"""What each law is a function of."""


def sliders(kind: str, p: Parameters) -> tuple[Array, Array]:
    """Stiffness and slip displacement of each slider (slider, lane)."""
    own = _own(kind, p)
    stiffness, slip = own("stiffness"), own("slip_displacement")
    if kind == "two_stage_joint":
        share = own("share")
        limits = jnp.stack([slip, slip * own("ratio")])
        return jnp.stack([share * stiffness, (1 - share) * stiffness]), limits
    limits = _MIDDLE[:, None] * slip
    return jnp.broadcast_to(stiffness / len(_MIDDLE), limits.shape), limits


def first_loading(kind: str, p: Mapping[str, float], x: np.ndarray) -> np.ndarray:
    """Force beside the stuck spring while x grows from rest."""
    lanes = sliders(kind, {name: jnp.asarray([value]) for name, value in p.items()})
    stiffness, slip = (np.asarray(one)[:, :1] for one in lanes)
    return -np.sum(stiffness * np.maximum(x - slip, 0.0), axis=0)
