"""The whole diagnosis: locate, name, add, verify, or say that there is nothing or no answer."""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from snrmjax.diagnose.checks.cross_validation import HeldOut, gap, held_out, without_level
from snrmjax.diagnose.checks.damping_asymmetry import acts_both_ways
from snrmjax.diagnose.checks.doubts import Doubt, doubts, grows, never_seen, part_of
from snrmjax.diagnose.checks.level_variance import says_of_levels, with_levels_as_found
from snrmjax.diagnose.checks.verdict import (
    judged,
    neighbour_noise,
    not_foretold,
    tolerated,
    unproved,
)
from snrmjax.diagnose.design.discriminating_test import DiscriminatingTest, requested
from snrmjax.diagnose.misfit.amplitudes import what_is_lost
from snrmjax.diagnose.misfit.candidates import (
    EffectCandidate,
    candidate,
    decide_by,
    only_by_calibration,
)
from snrmjax.diagnose.misfit.effect_fit import EffectFit, at_phases_of, baseline_fit, unfitted
from snrmjax.diagnose.misfit.predictions import Predictions, predictions_of, scales_of
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit, weighted_misfit
from snrmjax.diagnose.search.locating import Located, located, own_power
from snrmjax.diagnose.search.model_search import DETECTED, FoundEffects, Row, named
from snrmjax.identify.calibrate.calibration_states import ASSUMED_ERROR
from snrmjax.measure.states import SteadyStates
from snrmjax.model.effect_base import AbstractLinearChange
from snrmjax.model.effect_metadata import MotionScales
from snrmjax.model.effects import EFFECTS, effect_parameters, make_effect
from snrmjax.model.parameters import with_parameters
from snrmjax.model.structures import Structure
from snrmjax.numerics.blocks import on_one_core

_LOOSE = 0.1  # relative 1σ of a force's gain
_LEAST_STATES = 6
_ANOTHER = 0.1  # relative shift of a natural frequency that is no error of a linear test
_TURNS, _NEAR = 4, 0.85  # of noise that nobody stated: at most, and when it is found
_TRIALS = 4  # of a limit
_FINEST = 0.03  # of the assumed error: no balance of a few harmonics is better than that


class Gap(NamedTuple):
    """Root-mean-square misfits in units of the stated noise."""

    before: float
    after: float
    interpolated: HeldOut | None
    extrapolated: HeldOut | None


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """What a model lacks, why one believes it, and what would settle what is open."""

    verdict: str  # "none", "named", "ambiguous", "unknown" or "noise_rejected"
    effects: tuple[str, ...]
    candidates: tuple[tuple[str, ...], ...]
    decide_by: str | None
    located: tuple[Located, ...]
    parameters: dict[str, tuple[float, float]]  # value and 1σ
    gap: Gap
    detection_limits: dict[str, float]
    p_value: float  # of the misfit that is left
    noise_scale: float  # that neighbouring states show, over the stated noise
    notes: tuple[str, ...]
    table: tuple[tuple[Row, ...], ...]
    completed: Structure
    request: DiscriminatingTest | None  # the measurement of `decide_by`, where one was weighed
    blind: dict[int, Structure]  # completed without having seen a level
    force_gain: float  # acting force over recorded one, where a gain was free; else 1
    rows: Int[np.ndarray, " state"]  # of the data, that were used
    sensor: int  # whose velocity was held
    # Force misfit over noise, less what states share; NaN where the size alone is compared.
    before: Float[np.ndarray, "state part"]
    after: Float[np.ndarray, "state part"]


@on_one_core
def diagnose_model(
    model: Structure, data: SteadyStates, *, force_gain_std: float = 0.0
) -> Diagnosis:
    """Find the physics that a model lacks to explain measured steady states.

    Works in the force balance: the measured fundamental is held, harmonic balance settles the
    other harmonics, and the force needed is compared with the measured one. The library's effects
    are fitted with the baseline's parameters free inside their stated errors and the levels'
    errors inside theirs; Schwarz's criterion decides. Answers that a linear mode close by could
    have caused are compared with one.

    `force_gain_std` is the relative 1σ of a gain that all forces share: 1 where it is unknown.
    Where neither noise nor errors of levels are stated, both are found: the noise is what the
    answer leaves, and levels differ by what no smooth curves of amplitude explain.

    Returns a `Diagnosis`. Raises `ValueError` for too few states, an unknown force or sensors
    other than the model's.
    Validity: steady motions with the period of the force; effects that change the motion
    moderately, so that two of them add up.
    """
    predictions = predictions_of(model, data, force_gain_std)
    n_states = len(predictions.chosen.rows)
    unknown = predictions.chosen.phase_unknown[:, 0]
    if 2 * n_states - unknown.sum() < 2 * _LEAST_STATES:
        raise ValueError(
            f"a diagnosis needs at least {_LEAST_STATES} usable steady states, or "
            f"{2 * _LEAST_STATES} where phases are unknown, not {n_states}."
        )
    notes: list[str] = []
    given = model
    # Beside a gain that nobody knows no joint fit tells what levels scatter.
    tells = force_gain_std == 0 and not np.any(np.asarray(data.phase_unknown))
    silent = not predictions.chosen.noise_stated and not says_of_levels(model)
    if silent and tells and predictions.chosen.n_levels > 2:
        model, note = with_levels_as_found(model, data)
        if note:
            notes.append(note)
            predictions = predictions_of(model, data, force_gain_std)
    misfit = weighted_misfit(predictions)
    if not np.isfinite(misfit.base).all():
        raise ValueError(
            "the model has no motion of the measured amplitude for some states: it is too far "
            "from the data to be compared."
        )
    scales = scales_of(predictions)
    present = {effect.kind for effect in model.effects}
    if force_gain_std > 0:  # of a gain that is not known none can be missing, nor of the mass
        present |= {kind for kind, effect in EFFECTS.items() if effect.like_force_gain}
    if force_gain_std > _LOOSE:  # beside a force that may be nothing a mode could be all one sees
        present |= {kind for kind, effect in EFFECTS.items() if not effect.searched}
    if unknown.all():
        present |= {kind for kind, effect in EFFECTS.items() if effect.only_phase}
    kinds = tuple(kind for kind in EFFECTS if kind not in present)
    if predictions.chosen.noise_stated:
        found = named(misfit, scales, kinds)
    else:
        found, size = _named_and_noise(predictions, misfit, scales, kinds)
        notes.append(
            f"no noise is stated: {100 * size * ASSUMED_ERROR:.2g} % and as many hundredths of a "
            "radian are taken, which is what the answer leaves; how well it fits is no proof then."
        )
    misfit, fit = at_phases_of(found.misfit, found.fit), found.fit
    free = located(misfit, found.nothing)
    noise, noise_std = neighbour_noise(misfit, fit)
    verdict, reasons = judged(found, noise, noise_std)
    open_ends: list[Doubt] = []
    if verdict in ("named", "ambiguous"):
        both_ways = frozenset(kind for kind in fit.kinds if acts_both_ways(misfit, fit, kind))
        part = part_of(fit.kinds)
        power = own_power(misfit, found.nothing, fit, part) if part else None
        feeding = frozenset(k for k in fit.kinds if grows(k) and fit.of_kind(k)[0] < 0)
        orders = predictions.chosen.orders
        stepped = np.asarray(predictions.chosen.states.frequency)
        wide = frozenset(k for k in fit.kinds if never_seen(k, fit.of_kind(k)[1:], stepped))
        open_ends = doubts(fit.kinds, free.parts, orders, both_ways, power, feeding, wide)
    if open_ends:
        verdict = "unknown" if any(doubt.refutes for doubt in open_ends) else "ambiguous"
        reasons = [doubt.reason for doubt in open_ends]
    values, own = _values(misfit, fit), misfit.baseline_parameters(fit.rows)
    n_levels = predictions.chosen.n_levels
    inner = outer = None
    blind = {}
    if n_levels > 2:
        order = _by_amplitude(misfit)
        places = (order[n_levels // 2], order[-1])
        inner, outer = (
            held_out(misfit, found.nothing, fit, place, tolerated(noise)) for place in places
        )
        missed = not_foretold(
            inner,
            outer,
            doubted=not all(d.twin for d in open_ends),
            unclear=any(len(group) > 1 for group in found.classes),
            parts_missing=bool(unknown.any()),
        )
        if verdict in ("named", "ambiguous") and missed is not None:
            verdict, reasons = "unknown", [missed, *reasons]
        open_end = unproved(outer) if verdict in ("named", "ambiguous") else None
        if open_end is not None:
            verdict, reasons = "ambiguous", [*reasons, open_end.reason]
            open_ends.append(open_end)
        for place in places if fit.kinds else ():
            unseen = without_level(misfit, fit, place)
            mine = dict(zip(fit.labels, unseen.values.tolist(), strict=True))
            blind[unseen.level] = _completed(model, unseen.baseline, fit.kinds, mine)
    elif n_levels < 3:
        notes.append(
            f"{n_levels} level{'s' if n_levels > 1 else ''} only: nothing can be held out to prove "
            "the answer."
        )
    chosen = misfit.predictions.chosen
    phase = np.angle(np.asarray(chosen.states.velocity)[:, 0])
    lost = what_is_lost(chosen, phase, misfit.level_numbers)
    notes = [*reasons, *notes, *lost, *predictions.chosen.notes]
    best = {name: value for name, (value, _) in values.items()}
    completed = _completed(model if fit.kinds else given, own, fit.kinds, best)
    shift = _frequency_shift(model, completed)
    if abs(shift) > _ANOTHER:
        notes.append(
            f"the model's natural frequency is off by {100 * shift:.0f} %: are these measurements "
            "of another mode?"
        )
    # Without phases the first thing to measure is these.
    request = _request(found) if verdict == "ambiguous" and not unknown.any() else None
    force = misfit.noise.column < 2
    return Diagnosis(
        verdict=verdict,
        effects=fit.kinds if verdict != "none" else (),
        candidates=found.classes if verdict != "none" else (),
        decide_by=_decide_by(found, request, open_ends, phases=not unknown.any()),
        located=free.parts,
        parameters=values,
        gap=Gap(gap(misfit, found.nothing), gap(misfit, fit), inner, outer),
        detection_limits=_limits(misfit, fit, scales, present),
        p_value=found.p_value,
        noise_scale=float(np.sqrt(noise)),
        notes=tuple(notes),
        table=found.table,
        completed=completed,
        request=request,
        blind=blind,
        force_gain=_force_gain(misfit, fit),
        rows=predictions.chosen.rows[np.unique(misfit.noise.state[force])],
        sensor=predictions.chosen.sensors[0],
        before=_of_force(misfit, found.nothing),
        after=_of_force(misfit, fit),
    )


def _named_and_noise(
    predictions: Predictions, misfit: WeightedMisfit, scales: MotionScales, kinds: tuple[str, ...]
) -> tuple[FoundEffects, float]:
    """What is missing, with noise as large as what is left; its size over the assumed one.

    It begins with what no free curves of amplitude explain, and is never below what neighbouring
    states show.
    """
    nothing = baseline_fit(misfit)
    least = max(float(np.sqrt(neighbour_noise(at_phases_of(misfit, nothing), nothing)[0])), _FINEST)
    predictions = predictions.with_errors_scaled(least)
    misfit = weighted_misfit(predictions)
    free = located(misfit, baseline_fit(misfit))
    factor = float(np.sqrt(max(free.chi_square / max(free.freedom, 1), 1.0)))
    size = least
    for _ in range(_TURNS):
        predictions = predictions.with_errors_scaled(factor)
        size *= factor
        found = named(weighted_misfit(predictions), scales, kinds)
        factor = max(gap(found.misfit, found.fit), least / size)
        if factor > _NEAR:
            break
    return found, size


def _request(found: FoundEffects) -> DiscriminatingTest | None:
    """The measurement that would settle the classes of several effects."""
    open_places = [k for k, group in enumerate(found.classes) if len(group) > 1]
    places = tuple(
        k for k in open_places if set(found.classes[k]) - only_by_calibration(found.classes[k])
    )
    if not open_places:
        return None
    unclear = {kind for k in open_places for kind in found.classes[k]}
    too = any(only_by_calibration(found.classes[k]) for k in open_places)
    request = requested(found, places) if places else None
    if request is not None:
        return request._replace(calibration_too=too)
    return DiscriminatingTest("calibration", decide_by(unclear, harmonics=True)) if too else None


def _decide_by(
    found: FoundEffects, request: DiscriminatingTest | None, open_ends: list[Doubt], *, phases: bool
) -> str | None:
    """What would settle it, in words: of the classes, and of the doubts."""
    groups = [set(group) for group in found.classes if len(group) > 1]
    harmonics = bool(found.misfit.predictions.chosen.orders)
    sentences = []
    if groups and not phases:
        sentences.append("Record the phase of the velocity relative to the force.")
    if request is None or request.kind == "calibration":
        sentences += [decide_by(set().union(*groups), harmonics=harmonics)] if groups else []
    else:
        static = [only_by_calibration(group) for group in groups]
        sentences += [decide_by(group, harmonics=True) for group in static if group]
        if request.kind == "harmonics" and request.settles:
            rest = set().union(*groups) - set().union(*static)
            sentences.append(decide_by(rest, harmonics=harmonics))
        if not request.settles:
            sentences.append("No single measurement that was weighed would settle it; the nearest:")
        sentences.append(request.sentence)
    sentences += [f"{d.decide_by[0].upper()}{d.decide_by[1:]}." for d in open_ends]
    return " ".join(sentences) or None


def _by_amplitude(misfit: WeightedMisfit) -> list[int]:
    """Levels from the smallest to the largest velocity."""
    level = np.asarray(misfit.predictions.chosen.states.level)
    speed = np.abs(np.asarray(misfit.predictions.chosen.states.velocity)[:, 0])
    peak = [speed[level == k].max() for k in range(misfit.predictions.chosen.n_levels)]
    return [int(k) for k in np.argsort(peak)]


def _of_force(misfit: WeightedMisfit, fit: EffectFit) -> Float[np.ndarray, "state part"]:
    """What is left of the force, in its two parts or one."""
    noise, chosen = misfit.noise, misfit.predictions.chosen
    mine = noise.column < 2
    left = np.full((len(chosen.rows), 2), np.nan)
    left[noise.state[mine], noise.column[mine]] = noise.without_shared(fit.rows)[mine]
    return left[np.unique(noise.state[mine])]


def _force_gain(misfit: WeightedMisfit, fit: EffectFit) -> float:
    """Acting force over recorded one, as the data put it where it is unknown."""
    std, place = misfit.predictions.force_gain_std, len(misfit.predictions.stated)
    return 1 + std * float(misfit.noise.shared_errors(fit.rows)[place]) if std > 0 else 1.0


def _values(misfit: WeightedMisfit, fit: EffectFit) -> dict[str, tuple[float, float]]:
    if not fit.labels:
        return {}
    arms = misfit.noise.decorrelated(fit.slopes.T).T
    size = np.linalg.norm(arms, axis=0)
    size = np.where(size > 0, size, 1.0)
    inverse = np.linalg.pinv((arms / size).T @ (arms / size), rcond=1e-12, hermitian=True)
    std = np.sqrt(np.diag(inverse)) / size
    return {
        label: (float(value), float(error))
        for label, value, error in zip(fit.labels, fit.values, std, strict=True)
    }


def _limits(
    misfit: WeightedMisfit, fit: EffectFit, scales: MotionScales, present: set[str]
) -> dict[str, float]:
    """The size of every effect that would have been seen beside what was found."""
    limits = {}
    for kind in EFFECTS:
        if kind in present or kind in fit.kinds or not EFFECTS[kind].searched:
            continue
        tried = candidate(kind, scales)
        change = misfit.first_change(tried)
        square = misfit.chi_square(change)
        if not square > 0:
            continue
        need = DETECTED + len(tried.unit) * np.log(misfit.n_rows)
        power = 2 if misfit.predictions.chosen.orders else 2 * tried.strength_order
        name = f"{kind}.{effect_parameters(kind)[0]}"
        limit = float(abs(tried.starts[0][0]) * (need / square) ** (1 / power))
        limits[name] = _tried(misfit, tried, limit, need)
    return limits


def _tried(misfit: WeightedMisfit, one: EffectCandidate, limit: float, need: float) -> float:
    """A limit as trials at it correct it where sizes are compared: they are not linear in it."""
    if not misfit.predictions.sizes.alone.any():
        return limit
    first, *shape = one.starts[0]
    for _ in range(_TRIALS):
        start = (float(np.copysign(limit, first)), *shape)
        rows = unfitted(misfit, one._replace(starts=(start,))).rows
        square = misfit.chi_square(rows - misfit.base)
        if not 0 < square < np.inf:
            break
        # χ² grows with a power between the second and the fourth.
        limit *= float(np.clip(need / square, 0.01, 100.0)) ** (1 / 3)
    return limit


def _frequency_shift(model: Structure, completed: Structure) -> float:
    """Relative shift of the natural frequency by the linear changes that were found."""
    j, added = model.modes.mode_of_interest, completed.effects[len(model.effects) :]
    linear = [effect for effect in added if isinstance(effect, AbstractLinearChange)]
    changed = dataclasses.replace(model, effects=(*model.effects, *linear))
    before, after = model.linear_terms(), changed.linear_terms()
    square = after.stiffness[j] / before.stiffness[j] * (before.mass[j] / after.mass[j])
    return float(jnp.sqrt(square)) - 1


def _completed(
    model: Structure, own: dict[str, float], kinds: tuple[str, ...], values: dict[str, float]
) -> Structure:
    """The model with what was found, and its own parameters where the data put them.

    A model that lacks nothing stays as it is.
    """
    if not kinds:
        return model
    added = tuple(
        make_effect(kind, {name: values[f"{kind}.{name}"] for name in effect_parameters(kind)})
        for kind in kinds
    )
    moved = with_parameters(model, tuple(own), jnp.array(list(own.values()))) if own else model
    return dataclasses.replace(moved, effects=(*model.effects, *added))
