"""The law that data ask for, by a few rounds of Gauss and Newton, and its tables at a sensor."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from snrmjax.diagnose import priors
from snrmjax.diagnose.laws.law_columns import TABLES, LawColumns, LawKnots, law_columns
from snrmjax.diagnose.laws.law_prior import (
    PARTS,
    LawPosterior,
    LawProblem,
    best_processes,
    posterior,
)
from snrmjax.diagnose.misfit.predictions import scales_of
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit
from snrmjax.model.effect_base import AbstractEffect
from snrmjax.model.effect_metadata import Argument
from snrmjax.model.library.free_laws import (
    DampingLaw,
    DisplacementDampingLaw,
    SlipLaw,
    StiffnessLaw,
    UnevenStiffnessLaw,
)
from snrmjax.numerics.facts import Fact

_KNOTS = 24


class LawFit(NamedTuple):
    """A law fitted to a weighted misfit."""

    misfit: WeightedMisfit  # with errors passed on as the law passes them
    knots: LawKnots
    units: dict[str, Float[np.ndarray, " knot"]]  # of the secants of every part
    columns: LawColumns  # at the law
    problem: LawProblem  # linearised there
    posterior: LawPosterior
    rivals: tuple[str, ...]  # parts, each of which would do about as well in place of the first
    settled: bool

    @property
    def rows(self) -> Float[np.ndarray, " row"]:
        """Misfits that are left, in units of noise."""
        return self.misfit.noise.noise_units(self.columns.columns[None])[0]

    @property
    def criterion(self) -> float:
        """−2 ln of the evidence, but for what it is without a misfit: as Schwarz's criterion."""
        return self.problem.square + self.posterior.cost

    @property
    def share(self) -> float:
        """The probability of its class among laws of one quantity, all as likely before."""
        least = self.posterior.cost
        alone: dict[str, float] = {}
        for name, part in PARTS.items():
            cost = best_processes(self.problem, (name,))[1]
            alone[part.law] = min(cost, alone.get(part.law, np.inf))
        alone.pop(PARTS[self.posterior.parts[0]].law)
        return 1 / (1 + float(np.sum(np.exp(-0.5 * (np.array(list(alone.values())) - least)))))

    @property
    def secants(self) -> Float[np.ndarray, "table knot"]:
        """The mean of the secants, table by table."""
        return secants_of(self.posterior.parts, self.posterior.mean, self.units)


def fit_laws(misfit: WeightedMisfit) -> LawFit | None:
    """The law that explains a misfit best, whatever it explains; None where none has a motion.

    A second and a third part are added while the evidence gains as much as an effect must. None
    where they are not those of one law: a free stiffness beside a free damping could follow errors
    of the instruments, and Masing's rule ties the damping of slip to its stiffness.
    """
    predictions, scales = misfit.predictions, scales_of(misfit.predictions)
    # Over the measured range of motion of the mode of interest.
    states, modes = predictions.chosen.states, predictions.model.modes
    shape = float(modes.mode_shape[predictions.chosen.sensors[0], modes.mode_of_interest])
    v = np.abs(np.asarray(states.velocity)[:, 0] / shape)
    q = v / np.asarray(states.frequency)
    ranges = ((q, 0.25), (v, 0.25), (q, 0.1))  # the first knots over the smallest amplitude
    knots = LawKnots(*(np.geomspace(k * s.min(), s.max(), _KNOTS) for s, k in ranges))
    units = {}
    for name, part in PARTS.items():
        is_stiffness = part.tables[0] in (0, 4)
        size = scales.change / (1.0 if is_stiffness else scales.frequency)
        units[name] = np.full(_KNOTS, size)
    # Where the linear frequency was measured, little slips.
    units["slip"] = units["slip"] * knots.slip / knots.slip[-1]
    secants = np.zeros((TABLES, _KNOTS))
    columns = law_columns(predictions, knots, secants)
    if not np.isfinite(columns.columns).all():
        return None
    settled, nothing = False, 0.05  # rms change of the rows, in units of noise
    parts: tuple[str, ...] = ()
    rivals: tuple[str, ...] = ()
    for number in range(6):
        problem = law_problem(misfit, columns, secants, knots, units)
        # First one part alone: errors are not passed on yet as the law does.
        if number < 3:
            parts, rivals = _parts(problem, 1 if number == 0 else 3)
        found = posterior(problem, parts)
        aim = secants_of(parts, found.mean, units)
        change = (aim - secants).reshape(-1)
        for _ in range(5):
            ahead = law_columns(predictions, knots, aim, columns)
            if np.isfinite(ahead.columns).all():
                break
            aim = 0.5 * (aim + secants)
        else:
            return None
        # A step that changes no row any more, in the weighting of the step before.
        moved = (columns.by_secant.reshape(*columns.columns.shape, -1) @ change)[None]
        moved = misfit.noise.decorrelated(misfit.noise.noise_units(moved)[0])
        settled = bool(np.sqrt(np.mean(moved**2)) < nothing)
        secants, columns = aim, ahead
        misfit = misfit.reweighted(columns.passed_on)
        if settled and number > 0:
            break
        if number >= 2 and not _is_one(parts):
            return None
    if not _is_one(parts):
        return None
    problem = law_problem(misfit, columns, secants, knots, units)
    final = posterior(problem, parts)._replace(mean=found.mean)
    return LawFit(misfit, knots, units, columns, problem, final, rivals, settled)


def _is_one(parts: Sequence[str]) -> bool:
    """Whether parts are those of one law: a spring, a damper, one by displacement or slip."""
    return len({PARTS[part].law for part in parts}) == 1


def law_problem(
    misfit: WeightedMisfit,
    columns: LawColumns,
    secants: Float[np.ndarray, "table knot"],
    knots: LawKnots,
    units: dict[str, Float[np.ndarray, " knot"]],
    kept: Bool[np.ndarray, " row"] | None = None,
) -> LawProblem:
    """The misfit as a linear function of the secants, as it is at some of them; by some rows."""
    noise = misfit.noise
    by = np.moveaxis(columns.by_secant.reshape(*columns.columns.shape, -1), 2, 0)
    arms = noise.noise_units(by).T
    rows = noise.noise_units(columns.columns[None])[0] - arms @ secants.reshape(-1)
    whole, place = [], {}
    for name, part in PARTS.items():
        n = len(units[name])
        signed = [
            sign * arms[:, table * n : (table + 1) * n]
            for table, sign in zip(part.tables, part.signs, strict=True)
        ]
        whole.append(units[name] * sum(signed))
        place[name] = np.log(knots[(0, 0, 1, 0, 2)[part.tables[0]]])
    both = noise.decorrelated(np.column_stack([*whole, rows]).T, kept).T
    columns_of, left = both[:, :-1], both[:, -1]
    gram, pull = columns_of.T @ columns_of, -columns_of.T @ left
    return LawProblem(gram, pull, float(left @ left), place)


def secants_of(
    parts: Sequence[str],
    values: Float[np.ndarray, "*entry secant"],
    units: dict[str, Float[np.ndarray, " knot"]],
) -> Float[np.ndarray, "*entry table knot"]:
    """Tables of secants from those of some parts, in units plainly seen."""
    by_part = values.reshape(*values.shape[:-1], len(parts), -1)
    found = np.zeros((*values.shape[:-1], TABLES, by_part.shape[-1]))
    for k, name in enumerate(parts):
        for table, sign in zip(PARTS[name].tables, PARTS[name].signs, strict=True):
            found[..., table, :] += sign * units[name] * by_part[..., k, :]
    return found


def _parts(problem: LawProblem, most: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The parts with the best evidence, added one by one, and the rivals of the first."""
    alone = {part: best_processes(problem, (part,))[1] for part in PARTS}
    order = sorted(PARTS, key=lambda part: alone[part])
    best: tuple[str, ...] = (order[0],)
    cost = alone[order[0]]
    rivals = tuple(part for part in order[1:] if alone[part] < cost + priors.AS_GOOD_BY_CRITERION)
    for first in order[:2]:
        parts: tuple[str, ...] = (first,)
        its_cost = alone[first]
        while len(parts) < most:
            costs = {
                part: best_processes(problem, (*parts, part))[1]
                for part in PARTS
                if part not in parts
            }
            added = min(costs, key=lambda part: costs[part])
            if costs[added] > its_cost - priors.DETECTED:
                break
            parts, its_cost = (*parts, added), costs[added]
        if its_cost < cost - (priors.DETECTED if len(parts) > len(best) else 0.0):
            best, cost = parts, its_cost
    return best, rivals if len(best) == 1 else ()


LAW_KINDS = {
    "odd_spring": StiffnessLaw.kind,
    "even_spring": UnevenStiffnessLaw.kind,
    "odd_damper": DampingLaw.kind,
    "displacement_damping": DisplacementDampingLaw.kind,
    "slip": SlipLaw.kind,
}


class LawOnset(NamedTuple):
    """From where on a force is seen, or changes its sign."""

    at: float  # m or m/s
    side: int  # 1 or −1 of a law that differs between positive and negative values, else 0
    adds: bool  # to stiffness or damping


class DrawnLaw(NamedTuple):
    """A law that was drawn from data, as an equivalent force at the reference sensor.

    `at` is the displacement (m) or the velocity (m/s) of that sensor, `force` (N) what a spring, a
    damper or a joint between the sensor's point and the ground would have to exert there beside
    the linear model, with its 1σ: of a mode of the shape φ at the sensor, x = φq, and φ times the
    force is the modal force. Of friction it is the first loading from rest, beside the stuck
    stiffness; of a damping that depends on the displacement the force at the velocity `passing`.
    """

    law: str  # "spring", "damper", "displacement_damping" or "slip"
    symmetries: tuple[str, ...]  # "odd", "even", where a law has them
    onsets: tuple[LawOnset, ...]
    argument: Argument  # displacement or velocity
    at: Float[np.ndarray, " knot"]
    force: Float[np.ndarray, " knot"]
    force_std: Float[np.ndarray, " knot"]
    largest: float  # of `at`, that was measured: what is beyond is extrapolated
    passing: float | None = None  # m/s

    @property
    def title(self) -> str:
        """Its class in words."""
        return str(Fact("law_class", law=self.law, symmetries=self.symmetries, onsets=()))

    @property
    def name(self) -> str:
        """Its class in words, and from where on it acts which way."""
        return str(Fact("law_class", law=self.law, symmetries=self.symmetries, onsets=self.onsets))


def law_effects(fit: LawFit, secants: Float[np.ndarray, "table knot"]) -> list[AbstractEffect]:
    """Effects of the model, one for the springs, one for the dampers and so on, by importance."""
    found: list[AbstractEffect] = []
    x, v, slip = (jnp.asarray(knots) for knots in fit.knots)
    w = jnp.asarray(secants)
    for group in _grouped(fit.posterior.parts):
        match PARTS[group[0]].law:
            case "spring" if "even_spring" in group:
                found.append(UnevenStiffnessLaw(x, w[0] * x, w[1] * x))
            case "spring":
                found.append(StiffnessLaw(x, w[0] * x))
            case "damper":
                found.append(DampingLaw(v, w[2] * v))
            case "displacement_damping":
                found.append(DisplacementDampingLaw(x, w[3]))
            case _:
                found.append(SlipLaw(slip, jnp.maximum(w[4], 0.0)))
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
        law, symmetries = PARTS[group[0]].law, (PARTS[part].symmetry for part in group)
        passing = float(speed.max()) if law == "displacement_damping" else None
        at, force, std, side = _modal_table(fit, group, (passing or 0.0) / size)
        if side and shape < 0:
            at, force, std = -at[::-1], -force[::-1], std[::-1]
        is_velocity = law == "damper"
        measured = speed if is_velocity else speed / np.asarray(states.frequency)
        tables.append(
            DrawnLaw(
                *(law, tuple(filter(None, symmetries)), _onsets(at * size, force, std)),
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
    law, two_sided = PARTS[group[0]].law, "even_spring" in group
    if law == "slip":
        at = knots.displacement
        force = -np.einsum("ek,kx->ex", tables[:, 4], np.maximum(at - knots.slip[:, None], 0.0))
    elif law == "displacement_damping":
        at, force = knots.displacement, passing * tables[:, 3]
    else:
        first = PARTS[group[0]].tables[0]
        at = knots.velocity if law == "damper" else knots.displacement
        force = tables[:, first] * at
        if two_sided:
            force = np.concatenate([-(tables[:, first + 1] * at)[:, ::-1], force], axis=1)
            at = np.concatenate([-at[::-1], at])
    mean = post.mean @ force
    std = np.sqrt(np.maximum(np.einsum("ex,ef,fx->x", force, post.covariance, force), 0.0))
    rest = len(at) // 2 if two_sided else 0
    at, mean, std = (np.insert(one, rest, 0.0) for one in (at, mean, std))
    return at, mean, std, two_sided


def _onsets(at: np.ndarray, force: np.ndarray, std: np.ndarray) -> tuple[LawOnset, ...]:
    """Where a force that is sure begins, or changes its sign, from rest to either side."""
    found = []
    for side in (1, -1) if at[0] < 0 else (0,):
        there = at < 0 if side < 0 else at > 0
        order = np.argsort(np.abs(at[there]))
        x, f = np.abs(at[there])[order], (force[there] * (side or 1))[order]
        last = 0.0
        for k in np.flatnonzero(np.abs(f) > priors.BAND * std[there][order]):
            if np.sign(f[k]) != last:
                last = np.sign(f[k])
                found.append(LawOnset(float(x[k]), side, bool(last > 0)))
    return tuple(found)
