"""A drawn law in the units of a test: its table at one sensor, its effects, its class in words."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from snrmjax.diagnose.laws.law_prior import PARTS
from snrmjax.diagnose.laws.law_search import LawFit, secants_of
from snrmjax.model.effect_base import AbstractEffect
from snrmjax.model.effect_metadata import Argument
from snrmjax.model.library.free_laws import (
    DampingLaw,
    DisplacementDampingLaw,
    SlipLaw,
    StiffnessLaw,
    UnevenStiffnessLaw,
)

SURE = 1.96
"""1σ of a 95 % band."""

_TWO_SIDED = {"even spring"}
_KINDS = {
    "odd spring": StiffnessLaw.kind,
    "even spring": UnevenStiffnessLaw.kind,
    "odd damper": DampingLaw.kind,
    "film": DisplacementDampingLaw.kind,
    "slip": SlipLaw.kind,
}
_PREFIXES = ((1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"))


class DrawnLaw(NamedTuple):
    """A law that was drawn from data, as an equivalent force at the reference sensor.

    `at` is the displacement (m) or the velocity (m/s) of that sensor, `force` (N) what a spring, a
    damper or a joint between the sensor's point and the ground would have to exert there beside
    the linear model, with its 1σ: of a mode of the shape φ at the sensor, x = φq, and φ times the
    force is the modal force. Of friction it is the first loading from rest, beside the stuck
    stiffness; of a damping that depends on the displacement the force at the velocity `passing`.
    """

    name: str  # its class in words
    argument: Argument  # displacement or velocity
    at: Float[np.ndarray, " knot"]
    force: Float[np.ndarray, " knot"]
    force_std: Float[np.ndarray, " knot"]
    largest: float  # of `at`, that was measured: what is beyond is extrapolated
    passing: float | None = None  # m/s


class _Table(NamedTuple):
    """Modal force of one kind of law, linear in the secants, where it is given."""

    parts: tuple[str, ...]
    argument: Argument
    at: np.ndarray
    force: np.ndarray
    std: np.ndarray


def law_kind(part: str) -> str:
    """The kind of effect that a part of a law becomes."""
    return _KINDS[part]


def law_effects(fit: LawFit, secants: Float[np.ndarray, "table knot"]) -> list[AbstractEffect]:
    """Effects of the model, one for the springs, one for the dampers and so on, by importance."""
    found: list[AbstractEffect] = []
    x, v, s = (jnp.asarray(knots) for knots in fit.knots)
    w = jnp.asarray(secants)
    for group in _grouped(fit.posterior.parts):
        two_sided = bool(_TWO_SIDED & set(group))
        if group[0].endswith("spring"):
            own = UnevenStiffnessLaw(x, w[0] * x, w[1] * x) if two_sided else None
            found.append(own or StiffnessLaw(x, w[0] * x))
        elif group[0].endswith("damper"):
            found.append(DampingLaw(v, w[2] * v))
        elif group[0] == "film":
            found.append(DisplacementDampingLaw(x, w[4]))
        else:
            found.append(SlipLaw(s, jnp.maximum(w[5], 0.0)))
    return found


def drawn_tables(fit: LawFit) -> list[DrawnLaw]:
    """The tables of a fitted law, the most important first."""
    predictions = fit.misfit.predictions
    modes = predictions.model.modes
    states = predictions.chosen.states
    shape = float(modes.mode_shape[predictions.chosen.sensors[0], modes.mode_of_interest])
    speed = np.abs(np.asarray(states.velocity)[:, 0])
    size = abs(shape)
    tables = []
    for group in _grouped(fit.posterior.parts):
        passing = float(speed.max()) if group == ("film",) else None
        at, force, std, side = _modal_table(fit, group, (passing or 0.0) / size)
        if side and shape < 0:
            at, force, std = -at[::-1], -force[::-1], std[::-1]
        is_velocity = group[0].endswith("damper")
        measured = speed if is_velocity else speed / np.asarray(states.frequency)
        tables.append(
            DrawnLaw(
                _words(group, at * size, force, std),
                Argument.VELOCITY if is_velocity else Argument.DISPLACEMENT,
                at * size,
                force / size,
                std / size,
                float(measured.max()),
                passing,
            )
        )
    return tables


def _grouped(parts: Sequence[str]) -> list[tuple[str, ...]]:
    """Parts of one kind of law together, in the order in which they were found."""
    groups: dict[int, list[str]] = {}
    for part in parts:
        groups.setdefault(PARTS[part].tables[0], []).append(part)
    return [tuple(sorted(group, reverse=True)) for group in groups.values()]


def _modal_table(
    fit: LawFit, group: tuple[str, ...], passing: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, bool]:
    """Knots, modal force and its 1σ of some parts, from rest or, two-sided, through it."""
    post, knots = fit.posterior, fit.knots
    n = len(knots.slip)
    eye = np.eye(len(post.parts) * n)
    tables = secants_of(post.parts, eye, fit.units)  # secant, table, knot
    two_sided = bool(_TWO_SIDED & set(group))
    if group == ("slip",):
        at = knots.displacement
        force = -np.einsum("ek,kx->ex", tables[:, 5], np.maximum(at - knots.slip[:, None], 0.0))
    elif group == ("film",):
        at, force = knots.displacement, passing * tables[:, 4]
    else:
        first = PARTS[group[0]].tables[0]
        at = knots.velocity if group[0].endswith("damper") else knots.displacement
        force = tables[:, first] * at
        if two_sided:
            force = np.concatenate([-(tables[:, first + 1] * at)[:, ::-1], force], axis=1)
            at = np.concatenate([-at[::-1], at])
    mean = post.mean @ force
    std = np.sqrt(np.maximum(np.einsum("ex,ef,fx->x", force, post.covariance, force), 0.0))
    rest = len(at) // 2 if two_sided else 0
    at, mean, std = (np.insert(one, rest, 0.0) for one in (at, mean, std))
    return at, mean, std, two_sided


def _words(group: tuple[str, ...], at: np.ndarray, force: np.ndarray, std: np.ndarray) -> str:
    """The class of a law: what it is, and from where it grows which way."""
    names = {
        "spring": ("stiffness", "hardening", "softening"),
        "damper": ("damping", "more damping", "less damping"),
        "film": ("damping that depends on the displacement", "more damping", "less damping"),
        "slip": ("friction with a memory", "gaining stiffness", "losing stiffness"),
    }
    word = group[0].split()[-1]
    name, more, less = names[word]
    symmetry = [part.split()[0] for part in group if " " in part]
    unit = "m/s" if word == "damper" else "m"
    text = f"{' and '.join(symmetry)} {name}".strip()
    sides = [("", at > 0, force)]
    if at[0] < 0:
        sides = [(" for positive values", at > 0, force), (" for negative values", at < 0, -force)]
    for side, there, signed in sides:
        order = np.argsort(np.abs(at[there]))
        x, f = np.abs(at[there])[order], signed[there][order]
        seen = np.abs(f) > SURE * std[there][order]
        for start, sign in _turns(f, seen):
            text += f", {more if sign > 0 else less} from {_short(x[start], unit)}{side}"
    return text


def _turns(force: np.ndarray, seen: Bool[np.ndarray, " knot"]) -> list[tuple[int, float]]:
    """Where a force that is sure begins, and where it changes its sign."""
    found: list[tuple[int, float]] = []
    for k in np.flatnonzero(seen):
        if not found or np.sign(force[k]) != found[-1][1]:
            found.append((int(k), float(np.sign(force[k]))))
    return found


def _short(value: float, unit: str) -> str:
    size, prefix = next(((s, p) for s, p in _PREFIXES if value >= s), _PREFIXES[-1])
    return f"{value / size:.2g} {prefix}{unit}"
