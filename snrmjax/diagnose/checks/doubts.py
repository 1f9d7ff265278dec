"""Reasons to doubt an answer that fits: what a law outside the library could do as well."""

from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.diagnose.misfit.candidates import CLOSE, RESONANCE_ORDER
from snrmjax.diagnose.search.locating import Located

_CONTRADICTED = 4.0  # 1σ between an exponent and the law that was named
_CURVE = 0.05  # 1σ of an exponent that a free curve of few knots adds


class Doubt(NamedTuple):
    """Why an answer may be an imitation, and what would tell."""

    reason: str
    decide_by: str
    refutes: bool = False
    twin: bool = False  # the other law does the same to all that was measured


# Exponents of the change of ω̃² or δ against amplitude, by the part where it shows.
_EXPONENTS = {
    "coulomb_friction": ("damping", -1.0),
    "quadratic_damping": ("damping", 1.0),
    "cubic_damping": ("damping", 2.0),
    "van_der_pol_damping": ("damping", 2.0),
    "cubic_stiffness": ("stiffness", 2.0),
    "quadratic_stiffness": ("stiffness", 2.0),
    "quintic_stiffness": ("stiffness", 4.0),
}

_SAME_PART = (
    frozenset(
        {
            *("quadratic_stiffness", "cubic_stiffness", "quintic_stiffness", "static_preload"),
            *("bilinear_stiffness", "gap_stiffness", "one_sided_stop"),
        }
    ),
    frozenset(
        {
            *("coulomb_friction", "quadratic_damping", "cubic_damping", "van_der_pol_damping"),
            "linear_damping_change",
        }
    ),
    frozenset({"jenkins_slider", "iwan_microslip"}),
    frozenset({"force_gain_error", "sensor_gain_error", "mode_shape_change", "residual_mode"}),
)
DIRECTED = ("quadratic_damping", "cubic_damping")
"""Damping as of a fluid, which a valve may let pass in one direction only."""
GROWING = (*DIRECTED, "van_der_pol_damping")
"""Damping that grows with the amplitude and takes energy out where its coefficient is positive."""
_WIDER = "widen the range of levels at both ends and record the second and third harmonics"


def doubts(
    effects: tuple[str, ...],
    located: tuple[Located, ...],
    orders: tuple[int, ...] = (),
    both_ways: frozenset[str] = frozenset(),
    own_power: float | None = None,
    feeding: frozenset[str] = frozenset(),
    wide: frozenset[str] = frozenset(),
) -> list[Doubt]:
    """Reasons to doubt the effects that were found, from what was located before any name.

    `orders` are the harmonics that were measured; `both_ways` are kinds of damping that harmonic 2
    shows to act in both directions; `own_power` is the power of amplitude that one effect, as
    fitted, has at the states, which is that of its law to lowest order only; `feeding` are kinds
    of damping that were found to put energy in; `wide` are internal resonances as `never_seen`
    has them.
    """
    found = _of_harmonics(effects, orders, both_ways)
    # Nothing passive does so; what does has a source, and the law of a loop need not be this one.
    found += [
        Doubt(
            f"{kind} below zero feeds the motion: a feedback or a force that lags behind the "
            "displacement does the same.",
            "measure with every feedback off, or record the force of the loop",
            twin=True,
        )
        for kind in effects
        if kind in feeding
    ]
    if len(effects) == 1:
        found += _of_exponent(effects[0], located, own_power)
    if "iwan_microslip" in effects:
        found.append(
            Doubt(
                "other laws of friction with the same backbone, such as Bouc and Wen's, fit as "
                "well.",
                "measure a hysteresis loop, or levels over two decades",
                twin=True,
            )
        )
    found += [
        Doubt(
            f"{kind} is wider than all frequencies measured: nothing was seen of it as a "
            "resonance, and many laws of amplitude look like one side of it.",
            "step through a wider range of frequencies at the largest level",
        )
        for kind in effects
        if kind in wide
    ]
    if CLOSE in effects:
        found.append(
            Doubt(
                "a mode close by has three numbers of its own: to one sensor a clearance beside a "
                "cubic stiffness, or several small errors, can look like it.",
                "measure with a second sensor, where a further mode has another shape, or sweep "
                "through the frequency at which it is said to be",
                twin=True,
            )
        )
    if len(effects) > 2:
        found.append(Doubt("three effects together can follow most laws.", _WIDER))
    alike = [pair for pair in combinations(effects, 2) if any(g >= set(pair) for g in _SAME_PART)]
    if alike:
        found.append(
            Doubt(
                f"{' and '.join(alike[0])} act on the same part: they may be one law that the "
                "library does not have.",
                _WIDER,
            )
        )
    elif len(effects) > 1 and RESONANCE_ORDER.keys() & set(effects):
        found.append(
            Doubt(
                "a further mode beside another effect can imitate a law that the library does not "
                "have.",
                f"step finely through the frequency of the further mode, or {_WIDER}",
            )
        )
    return found


def never_seen(kind: str, shape: tuple[float, ...], frequency: Float[np.ndarray, " state"]) -> bool:
    """Whether an internal resonance is wider than the range of frequencies measured.

    Arguments: the further mode's frequency in Hz and damping ratio; frequencies of states in rad/s.
    """
    if kind not in RESONANCE_ORDER:
        return False
    hz, ratio = shape
    width = 2 * ratio * hz / RESONANCE_ORDER[kind]  # half-power, as the force steps
    return width > float(np.ptp(frequency)) / (2 * np.pi)


def _of_harmonics(
    effects: tuple[str, ...], orders: tuple[int, ...], both_ways: frozenset[str]
) -> list[Doubt]:
    """What has the same fundamental, and is told by a harmonic that was not or hardly measured."""
    found = []
    mine = [kind for kind in effects if kind in DIRECTED and kind not in both_ways]
    if mine:
        closer = " with less noise" if 2 in orders else ""
        found.append(
            Doubt(
                f"a damping that acts in one direction only has the same fundamental as {mine[0]}.",
                f"record harmonic 2 at the largest level{closer}",
                twin=True,
            )
        )
    if "mode_shape_change" in effects and 3 not in orders:
        found.append(
            Doubt(
                "a sensor that saturates can do what mode_shape_change does.",
                "record harmonic 3 at the largest level, or use a second sensor",
            )
        )
    return found


def part_of(effects: tuple[str, ...]) -> str | None:
    """The part that a single effect changes with a power of amplitude; None for others."""
    return _EXPONENTS[effects[0]][0] if len(effects) == 1 and effects[0] in _EXPONENTS else None


def _of_exponent(effect: str, located: tuple[Located, ...], own_power: float | None) -> list[Doubt]:
    """The power of amplitude that was located, against that of the law that was named."""
    if effect not in _EXPONENTS:
        return []
    part, expected = _EXPONENTS[effect]
    expected = expected if own_power is None else own_power
    mine = [p for p in located if p.part == part and p.exponent is not None]
    if not mine or mine[0].exponent is None or mine[0].exponent_std is None:
        return []
    exponent, std = mine[0].exponent, float(np.hypot(mine[0].exponent_std, _CURVE))
    if abs(exponent - expected) > _CONTRADICTED * std:
        reason = (
            f"the {part} changes with the power {exponent:.2f} ± {std:.2f} of the amplitude, "
            f"which is not the {expected:.3g} of {effect}."
        )
        return [Doubt(reason, _WIDER, refutes=True)]
    if effect == "coulomb_friction" and abs(exponent + 0.5) < 2 * std:
        reason = "damping that goes with the square root of the velocity fits as well."
        return [Doubt(reason, "measure smaller amplitudes, or a free decay")]
    return []
