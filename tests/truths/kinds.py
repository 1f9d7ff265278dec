"""Every kind of effect of the library: parameters, and the force of memoryless ones written again.

The one table of the tests of all kinds: a new kind needs a row here.
"""

import re
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from snrmjax.model.effects import EFFECTS

Parameters = dict[str, float]


class Kind(NamedTuple):
    """One kind of effect.

    `parameters`, of order one, change motions of order one clearly. `weak` ones change a lightly
    damped resonance by 5 % and more without a second motion; they are in units of the natural
    frequency and of the largest amplitude.
    """

    parameters: Parameters
    weak: Parameters | None = None  # None without an effect on the motion
    force: Callable | None = None  # f(q, q̇, parameters) of a memoryless one
    symmetry: str = ""  # of that: odd, even or neither in (q, q̇)
    dissipates: bool = False
    only_with: tuple[str, ...] = ()  # kinds without which the fundamental is unchanged


COEFFICIENT = "coefficient"


def power(value, weak, force, symmetry="odd", **more):
    """A law with a single parameter, its coefficient."""
    return Kind({COEFFICIENT: value}, {COEFFICIENT: weak}, force, symmetry, **more)


def added_mode(order, weak, ratio):
    """An internal resonance with a mode near `order` times the frequency, first of 5 rad/s."""
    near = {"frequency_hz": (order + 0.02) / (2 * np.pi), "damping_ratio": ratio}
    own = {COEFFICIENT: 0.4, "frequency_hz": 5 * order / (2 * np.pi), "damping_ratio": 0.02}
    return Kind(own, {COEFFICIENT: weak, **near})


KINDS = {
    "cubic_stiffness": power(0.8, 0.05, lambda q, v, p: p[COEFFICIENT] * q**3),
    "quadratic_stiffness": power(0.6, 0.25, lambda q, v, p: p[COEFFICIENT] * q**2, "even"),
    "quintic_stiffness": power(0.8, 0.05, lambda q, v, p: p[COEFFICIENT] * q**5),
    "bilinear_stiffness": Kind(
        {"stiffness": 1.2},
        {"stiffness": 0.3},
        lambda q, v, p: 0.5 * p["stiffness"] * np.abs(q),
        "even",
    ),
    "gap_stiffness": Kind(
        {"stiffness": 1.5, "gap": 0.3},
        {"stiffness": 0.15, "gap": 0.3},
        lambda q, v, p: p["stiffness"] * (q - np.clip(q, -p["gap"], p["gap"])),
        "odd",
    ),
    "one_sided_stop": Kind(
        {"stiffness": 1.5, "gap": 0.2},
        {"stiffness": 0.2, "gap": 0.3},
        lambda q, v, p: p["stiffness"] * np.maximum(q - p["gap"], 0.0),
        "neither",
    ),
    "quadratic_damping": power(
        *(0.3, 0.03, lambda q, v, p: p[COEFFICIENT] * np.abs(v) * v), dissipates=True
    ),
    "cubic_damping": power(0.2, 0.03, lambda q, v, p: p[COEFFICIENT] * v**3, dissipates=True),
    "van_der_pol_damping": power(
        *(0.8, 0.12, lambda q, v, p: p[COEFFICIENT] * q**2 * v), dissipates=True
    ),
    "static_preload": Kind(
        {"constant_force": 0.9},
        {"constant_force": 0.3},
        lambda q, v, p: p["constant_force"] + 0.0 * q,
        "even",
        only_with=("cubic_stiffness",),
    ),
    "coulomb_friction": Kind({"force": 0.7}, {"force": 0.012}),
    "jenkins_slider": Kind(
        {"stiffness": 1.5, "slip_displacement": 0.4}, {"stiffness": 0.2, "slip_displacement": 0.1}
    ),
    "iwan_microslip": Kind(
        {COEFFICIENT: 0.9, "exponent": 1.6}, {COEFFICIENT: 0.1, "exponent": 1.5}
    ),
    "added_mass": Kind({"mass": 0.15}, {"mass": 0.05}),
    "linear_frequency_shift": Kind({"relative_shift": -0.1}, {"relative_shift": 0.02}),
    "linear_damping_change": Kind({"damping_ratio_change": 0.05}, {"damping_ratio_change": 0.01}),
    "frequency_drift": Kind({"relative_drift": 0.07}, {"relative_drift": 0.03}),
    "force_harmonics": Kind(
        {"second": 0.3, "third": -0.2},
        {"second": 0.8, "third": 0.5},
        only_with=("cubic_stiffness", "quadratic_stiffness"),
    ),
    "internal_resonance_1_3": added_mode(3, 0.5, 0.01),
    "internal_resonance_1_2": added_mode(2, 0.2, 0.02),
    "force_gain_error": Kind({"gain": 0.1}),
    "force_offset_error": Kind({"offset": 0.1}),
    "sensor_gain_error": Kind({"gain": 0.1}),
    "sensor_phase_error": Kind({"phase_deg": 5.0}),
    "residual_mode": Kind({"receptance": 0.1}),
    "close_mode": Kind({"modal_constant": 0.1, "frequency_hz": 0.4, "damping_ratio": 0.02}),
    "mode_shape_change": Kind({COEFFICIENT: 0.1}),
}
MEMORYLESS = {kind: of for kind, of in KINDS.items() if of.force is not None}


def of_class(base):
    """The kinds of this table with a class that is derived from `base`."""
    return [kind for kind in KINDS if issubclass(EFFECTS[kind], base)]


def silent(kind, parameters):
    """The same parameters with zero strength; the others may be out of range at zero."""
    every = enumerate(EFFECTS[kind].parameters().items())
    strengths = {name for k, (name, of) in every if k == 0 or of.typical == 0}
    return {name: 0.0 if name in strengths else value for name, value in parameters.items()}


UNITS = {"kg": (1, 0, 0), "m": (0, 1, 0), "s": (0, 0, 1), "1": (0, 0, 0)}
POWERS = {"": 1.0, "²": 2.0, "⁴": 4.0, "^1/2": 0.5}


def dimension(unit, exponent):
    """Exponents of kg, m and s of a unit as effects write it."""
    unit = unit.replace("(kg^1/2 m)^(1-exponent)", "power").replace("Hz", "1/s")
    above, *below = re.sub(r"\^1/2", "^½", unit).split("/")
    total = np.zeros(3)
    for sign, part in ((1, above), *((-1, part) for part in below)):
        for word in part.strip("()").split():
            if word == "power":
                total += (1 - exponent) * np.array([0.5, 1, 0])
                continue
            name, exponent_of = re.fullmatch(r"(kg|m|s|1)(.*)", word.replace("^½", "^1/2")).groups()
            total += sign * POWERS[exponent_of] * np.array(UNITS[name])
    return total


def in_units(kind, parameters, length, time):
    """Parameters from units of a `length` (kg^1/2 m) and a `time` (s) to those of the class."""
    exponent = parameters.get("exponent", 1.0)
    values = {}
    for name, of in EFFECTS[kind].parameters().items():
        _, of_length, of_time = dimension(of.unit, exponent)  # kg^1/2 comes with every m
        values[name] = parameters[name] * length**of_length * time**of_time
    return values
