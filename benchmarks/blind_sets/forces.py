"""Forces of the blind test structures, written down for this benchmark alone.

Everything is scaled: time with ω₀ of the mode of interest, displacement with its amplitude Q_s at
the top level, so that y = q/Q_s, u = dy/d(ω₀t) and forces are in units of ω₀²Q_s. Parameters are
named `kind.parameter`, one value a lane; a term acts where its parameters are given.
"""

from collections.abc import Callable, Mapping

import jax.numpy as jnp
import laws
import numpy as np
from jax import Array

Parameters = Mapping[str, Array]
SIGN_WIDTH = 0.02  # width of a rounded sign over the velocity amplitude of the level


def _sign(u: Array, p: Parameters) -> Array:
    return jnp.tanh(u / (SIGN_WIDTH * p["lane.speed"]))


def _beyond(y: Array, gap: Array) -> Array:
    return jnp.maximum(y - gap, 0.0) - jnp.maximum(-y - gap, 0.0)


def _hertz(y: Array, p: Parameters) -> Array:
    over = _beyond(y, p["hertz_clearance.gap"])
    return p["hertz_clearance.stiffness"] * jnp.sign(over) * jnp.abs(over) ** 1.5


def _magnet(y: Array, p: Parameters) -> Array:
    # The stiffness at rest is part of the linear frequency.
    return (
        p["magnet_stiffness.stiffness"] * y * (1 / (1 + (y / p["magnet_stiffness.width"]) ** 2) - 1)
    )


def _root(u: Array, p: Parameters) -> Array:
    small = (0.5 * SIGN_WIDTH * p["lane.speed"]) ** 2
    return p["square_root_damping.coefficient"] * u / (u**2 + small) ** 0.25


def _rubbing(y: Array, u: Array, p: Parameters) -> Array:
    # Friction whose normal force grows with the penetration of a clearance.
    pressed = jnp.maximum(jnp.abs(y) - p["rubbing.gap"], 0.0)
    return p["rubbing.friction"] * pressed * _sign(u, p)


MEMORYLESS: dict[str, Callable[[Array, Array, Parameters], Array]] = {
    "baseline": lambda y, u, p: p["baseline.cubic"] * y**3,
    "cubic_stiffness": lambda y, u, p: p["cubic_stiffness.coefficient"] * y**3,
    "quadratic_stiffness": lambda y, u, p: p["quadratic_stiffness.coefficient"] * y**2,
    "quintic_stiffness": lambda y, u, p: p["quintic_stiffness.coefficient"] * y**5,
    "bilinear_stiffness": lambda y, u, p: 0.5 * p["bilinear_stiffness.stiffness"] * jnp.abs(y),
    "gap_stiffness": lambda y, u, p: (
        p["gap_stiffness.stiffness"] * _beyond(y, p["gap_stiffness.gap"])
    ),
    "one_sided_stop": lambda y, u, p: (
        p["one_sided_stop.stiffness"] * jnp.maximum(y - p["one_sided_stop.gap"], 0.0)
    ),
    "coulomb_friction": lambda y, u, p: p["coulomb_friction.force"] * _sign(u, p),
    "quadratic_damping": lambda y, u, p: p["quadratic_damping.coefficient"] * jnp.abs(u) * u,
    "cubic_damping": lambda y, u, p: p["cubic_damping.coefficient"] * u**3,
    "van_der_pol_damping": lambda y, u, p: p["van_der_pol_damping.coefficient"] * y**2 * u,
    "static_preload": lambda y, u, p: p["static_preload.constant_force"] + 0.0 * y,
    "hertz_clearance": lambda y, u, p: _hertz(y, p),
    "magnet_stiffness": lambda y, u, p: _magnet(y, p),
    "square_root_damping": lambda y, u, p: _root(u, p),
    "asymmetric_damping": lambda y, u, p: (
        p["asymmetric_damping.coefficient"] * jnp.maximum(u, 0.0) ** 2
    ),
    "rubbing": lambda y, u, p: _rubbing(y, u, p),
    **laws.MEMORYLESS,
}
"""f(y, u), on the left of y'' + 2ζy' + y + … = P cos Ωt."""

N_FAST = {"lugre": 1, "bouc_wen": 1, "delayed_feedback": 2, **dict.fromkeys(laws.FAST, 1)}
"""Internal states with a rate of their own, by kind."""


def fast_force(kind: str, y: Array, states: Array, p: Parameters) -> Array:
    """Force of a kind with internal states; the stuck stiffness is part of the linear frequency."""
    if kind == "delayed_feedback":
        return p["delayed_feedback.coefficient"] * states[1] ** 3
    return p[f"{kind}.stiffness"] * (states[0] - y)


def fast_rate(kind: str, y: Array, u: Array, states: Array, p: Parameters) -> Array:
    """Rates of the internal states per unit of ω₀t."""
    if kind == "delayed_feedback":  # two lags in series
        lag = p["delayed_feedback.lag"]
        return jnp.stack([(y - states[0]) / lag, (states[0] - states[1]) / lag])
    if kind in laws.FAST:
        return laws.fast_rate(kind, u, states[0], p)[None]
    z, slip = states[0], p[f"{kind}.slip_displacement"]
    if kind == "lugre":
        stribeck = jnp.exp(-((u / (0.3 * p["lane.speed"])) ** 2))
        return (u - jnp.abs(u) * z / (slip * (1 + 0.5 * stribeck)))[None]
    fraction = jnp.sqrt((z / slip) ** 2 + 1e-12)
    return (u - fraction**1.5 * (0.7 * u + 0.3 * jnp.abs(u) * z / (slip * fraction)))[None]


SLIDERS = {"jenkins_slider": 1, "iwan_microslip": 60, **laws.SLIDERS}
"""Sliders (a spring to a block that slips) by kind; an Iwan element is an array of them."""

_EDGE = np.linspace(0.0, 1.0, SLIDERS["iwan_microslip"] + 1)
_MIDDLE = 0.5 * (_EDGE[1:] + _EDGE[:-1])
IWAN_RANGE = 1.6  # largest slip displacement over Q_s


def sliders(kind: str, p: Parameters) -> tuple[Array, Array]:
    """Stiffness and slip displacement of each slider (slider, lane).

    Iwan: the backbone −c x^p has the stiffness density c p (p − 1) s^(p−2) over the slip
    displacement s, here put into cells that are even in s^(p−1), as s runs to `IWAN_RANGE`.
    """
    if kind in laws.SLIDERS:
        return laws.lap_sliders(p)
    if kind == "jenkins_slider":
        return p["jenkins_slider.stiffness"][None], p["jenkins_slider.slip_displacement"][None]
    c, power = p["iwan_microslip.coefficient"], p["iwan_microslip.exponent"]
    total = c * power * IWAN_RANGE ** (power - 1)
    stiffness = jnp.broadcast_to(total / len(_MIDDLE), (len(_MIDDLE), *total.shape))
    # One common grid in s^(p−1): cells are then equally stiff.
    return stiffness, IWAN_RANGE * _MIDDLE[:, None] ** (1 / (power - 1))


def dragged(y: Array, blocks: Array, slip: Array) -> Array:
    """Positions of the sliders' blocks after y moved without turning."""
    return jnp.clip(blocks, y - slip, y + slip)


def kinds_in(p: Parameters) -> set[str]:
    """Kinds of which parameters are given."""
    return {name.split(".")[0] for name in p}
