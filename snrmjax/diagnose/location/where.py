"""Where in a structure a nonlinear force acts: places weighed by what sensors and laws say."""

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.diagnose.location.laws_at_places import PlacedLaw, law_fit
from snrmjax.diagnose.location.source_patterns import (
    SensorRecords,
    SourceFit,
    SourcePattern,
    sensor_records,
    source_fit,
    source_pattern,
)
from snrmjax.identify.calibrate.calibration_states import ComparedColumns, calibration_states
from snrmjax.measure.states import SteadyStates, check_phases
from snrmjax.model.effect_base import AbstractForce
from snrmjax.model.effects import EFFECTS, make_effect
from snrmjax.model.modes import LinearModes
from snrmjax.model.places import Row, row_over_points
from snrmjax.model.structures import Structure
from snrmjax.numerics.blocks import on_one_core, over_cores
from snrmjax.numerics.compiled import on_numbers
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.result import AbstractResult, quantity, setting

EVERYWHERE = "everywhere"
"""The place of a force on the modal coordinate of interest: distributed as its inertia is."""

_ORDERS = 9  # harmonics that are looked at, at most
_FAR = 40.0  # of χ² over its scale, beyond the best: places that no law can bring back
_SURE = 0.5  # probability from which on a place is named
_MOST = 16  # candidates that are made unasked
_HOPELESS = 30.0  # times the best misfit of rough fits, beyond which a law is not fitted
_AGAIN = 8  # of the best fits, that are tried from further starts if they do not fit
_FEWEST = 3.0  # numbers that count where no law fits
_NOT_THERE = 1.5  # times the noise, from which on no place reproduces the response
_STILL = 0.02  # of the largest motion, below which a row says nothing


class PlacedForce(NamedTuple):
    """A place with how probable it is, and the law that explains the sensors best there."""

    name: str
    row: Row | None  # None: everywhere
    probability: float
    law: PlacedLaw | None  # the best one; None where the sensors' pattern rules the place out
    laws: dict[str, float]  # probabilities of laws there, if the force is of one of them


class Localisation(AbstractResult):
    """Places of a nonlinear force, the most probable first; see `locate_force`.

    `misfit` is the root of what the best place leaves, in units of the noise: well above one, the
    force acts at none of the candidates, at several, or not in this linear structure.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("place",)

    places: tuple[PlacedForce, ...]
    model: Structure  # with the law at the most probable place
    settled_by: str | None  # a point that tells the two most probable places apart as a sensor
    name: tuple[str, ...] = quantity("place", "", "place", name="place", static=True)
    probability: Float[np.ndarray, " place"] = quantity("place", "1", "probability")
    misfit: float = setting()

    @property
    def words(self) -> Fact:
        """Where the force acts, as far as it can be told."""
        first, second = self.places[:2]
        values = {
            "place": first.name,
            "probability": first.probability,
            "other": second.name,
            "misfit": self.misfit,
            "sensor": self.settled_by,
        }
        if not self.fits:
            law = first.law
            return Fact("no_place_fits", **values, kind="" if law is None else law.kind)
        if self.told:
            return Fact("force_placed", **values)
        return Fact("force_not_placed", **values)

    @property
    def answer(self) -> Fact:
        """What explains the states where no effect on the mode alone does."""
        law = self.places[0].law
        return Fact("placed_law_explains", kind="" if law is None else law.kind)

    @property
    def explains(self) -> bool:
        """Whether a law at one place, and no distributed one, leaves no more than noise."""
        first = self.places[0]
        fits = first.law is not None and first.law.fits
        return self.told and first.row is not None and fits

    @property
    def fits(self) -> bool:
        """Whether what the best place leaves is about as large as the noise, if that is known."""
        return not self.misfit > _NOT_THERE

    @property
    def told(self) -> bool:
        """Whether one place is more probable than all others together."""
        return bool(self.probability[0] > _SURE)

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`."""
        head = self.name[0] if self.told else "cannot be told"
        head = head if self.fits else "at none of these places"
        lines = [f"Whereabouts: {head}"]
        for place in self.places:
            law = "" if place.law is None else f", as {place.law.kind}"
            lines.append(f"{place.name}: {place.probability:.3g}{law}")
        if not self.told and self.settled_by is not None:
            lines.append(f"a sensor at {self.settled_by} would tell the first two apart")
        return (*lines, f"the best leaves {self.misfit:.3g} times the noise")

    @property
    def by_place(self) -> dict[str, float]:
        """Probabilities by place, as `diagnosis.json` has them."""
        return dict(zip(self.name, self.probability.tolist(), strict=True))


@on_numbers("Differentiate the force that a motion needs: `sj.identify.inverse_force`.")
@on_one_core
def locate_force(
    data: SteadyStates,
    model: Structure,
    candidates: Mapping[str, object] | Sequence[str] = (),
    *,
    laws: Sequence[str] = (),
) -> Localisation:
    """Say at which of some places a force acts that the model lacks.

    A force along a row moves all sensors at every harmonic by the linear structure's response to
    it: places are weighed by what their patterns leave, without a law. Those that patterns cannot
    tell apart, as behind one sensor all are, are weighed by laws: the force that the sensors ask
    for must be a law of the motion there. Weights are Gaussian likelihoods, with the noise as large
    as the best place leaves.

    Arguments: `data` of one sensor or more with phases, best with harmonics and their errors;
    `model` with shapes at the candidates, best from matrices; `candidates` are names of points or
    pairs ("a-b": between a and b), or rows by name; by default all points and neighbouring pairs in
    their order. `EVERYWHERE`, a force on the mode of interest, is always among them. `laws` are
    kinds of effects, by default all forces of the library.
    Returns `Localisation`. Raises `ValueError` for unknown points, no candidate, unknown phases.
    Validity: one force at one place beside a linear structure that is right.
    Not differentiable: differentiate the force that a motion needs:
    `snrmjax.identify.inverse_force`.
    """
    check_phases(data, "the search for the place of a force")
    chosen = calibration_states(model, data, _ORDERS)
    records, modes = sensor_records(chosen), model.modes
    rows = _rows(modes, candidates)
    patterns = {n: source_pattern(records, chosen, modes, w) for n, (_, w) in rows.items()}
    fits = {name: source_fit(records, pattern) for name, pattern in patterns.items()}
    square = np.array([fits[name].chi_square for name in rows])
    freedom = max(next(iter(fits.values())).freedom, 1)
    scale = max(1.0, float(square.min()) / freedom) if freedom > 1 else 1.0
    weight = -0.5 * (square - square.min()) / scale
    near = [name for name, w in zip(rows, weight, strict=True) if w > -_FAR]
    misfit = float(square.min()) / freedom if freedom > 1 else np.nan
    kinds = laws or [k for k, effect in EFFECTS.items() if issubclass(effect, AbstractForce)]
    best, by_law, of_laws = _by_laws(near, records, patterns, fits, kinds)
    if len(near) > 1:
        misfit = of_laws
        weight = np.array([by_law.get(name, -np.inf) for name in rows])
    probability = np.exp(weight - weight.max())
    probability /= probability.sum()
    order = np.argsort(-probability, kind="stable")
    names = tuple(list(rows)[k] for k in order)
    places = tuple(
        PlacedForce(name, rows[name][0], float(p), *best.get(name, (None, {})))
        for name, p in zip(names, probability[order], strict=True)
    )
    return Localisation(
        places=places,
        model=_completed(model, places[0]),
        settled_by=_settling_point(chosen, modes, [rows[name][1] for name in names[:2]]),
        name=names,
        probability=probability[order],
        misfit=float(np.sqrt(misfit)),
    )


def _completed(model: Structure, place: PlacedForce) -> Structure:
    """The model with the law at its place."""
    law = place.law
    if law is None:
        return model
    effect = make_effect(law.kind, law.parameters, at=place.row)
    return dataclasses.replace(model, effects=(*model.effects, effect))


def _settling_point(
    chosen: ComparedColumns, modes: LinearModes, rows: Sequence[Float[np.ndarray, " mode"]]
) -> str | None:
    """The point without a sensor that moves most differently if a force acts along one of two rows.

    Both forces are those that the sensors ask for.
    """
    if not modes.points or len(rows) < 2:
        return None
    whole = dataclasses.replace(
        modes,
        mode_shape=np.concatenate([modes.mode_shape, modes.point_shape]),  # type: ignore[arg-type]
        sensors=(*modes.sensors, *modes.points),
        points=(),
    )
    everywhere = chosen._replace(
        sensors=(*chosen.sensors, *range(len(modes.sensors), len(whole.sensors)))
    )
    records = sensor_records(chosen)
    n, moved = len(chosen.sensors), []
    for row in rows:
        seen = source_pattern(records, everywhere, whole, row)
        own = SourcePattern(seen.driven[..., :n], seen.pattern[..., :n], *seen[2:])
        force = np.sum(source_fit(records, own).weights * (records.seen - own.driven), axis=2)
        moved.append(seen.driven[..., n:] + seen.pattern[..., n:] * force[..., None])
    scale = np.max(records.std()[:, :, :1], axis=0)
    apart = np.sum(np.abs((moved[0] - moved[1]) / scale) ** 2, axis=(0, 1))
    return modes.points[int(np.argmax(apart))]


def _by_laws(
    near: Sequence[str],
    records: SensorRecords,
    patterns: Mapping[str, SourcePattern],
    fits: Mapping[str, SourceFit],
    laws: Sequence[str],
) -> tuple[dict[str, tuple[PlacedLaw, dict[str, float]]], dict[str, float], float]:
    """The best law of every place, the logarithms of their evidence, and what the best leaves."""
    pairs = [(name, kind) for name in near for kind in laws]

    def fitted(
        pair: tuple[str, str], before: PlacedLaw | None = None, *, rough: bool = False
    ) -> PlacedLaw:
        name, kind = pair
        return law_fit(kind, records, patterns[name], fits[name], rough=rough, before=before)

    rough = [fit.chi_square for fit in over_cores(partial(fitted, rough=True), pairs)]
    hopeful = [pair for pair, s in zip(pairs, rough, strict=True) if s < _HOPELESS * min(rough)]
    every = _from_further_starts(hopeful, over_cores(fitted, hopeful), fitted)
    found: dict[str, list[PlacedLaw]] = {}
    for (name, _), fit in zip(hopeful, every, strict=True):
        found.setdefault(name, []).append(fit)
    least = min(every, key=lambda fit: fit.chi_square)
    scale = max(1.0, least.chi_square / least.freedom)
    # Where no law fits, what is left is no noise: then few numbers count, as of Student's t.
    counts = max(least.freedom / scale, _FEWEST)
    evidence, best = {}, {}
    for name, there in found.items():
        worse = np.array([fit.chi_square / least.chi_square for fit in there])
        # A parameter more costs what it explains of noise alone.
        terms = -0.5 * counts * np.log(worse) - np.array([len(fit.std) for fit in there])
        evidence[name] = float(np.logaddexp.reduce(terms))
        fractions = np.exp(terms - evidence[name])
        kinds = {fit.kind: float(fraction) for fit, fraction in zip(there, fractions, strict=True)}
        best[name] = there[int(np.argmax(fractions))], kinds
    return best, evidence, least.chi_square / least.freedom


def _from_further_starts(
    pairs: Sequence[tuple[str, str]],
    once: Sequence[PlacedLaw],
    fitted: Callable[..., PlacedLaw],
) -> list[PlacedLaw]:
    """Fits at places, those of the best that may have ended too early from further starts."""
    every = list(once)
    least = min(every, key=lambda fit: fit.chi_square)
    near = [k for k, fit in enumerate(every) if fit.chi_square < _HOPELESS * least.chi_square]
    near.sort(key=lambda k: every[k].chi_square)
    again = [k for k in near[:_AGAIN] if not (every[k].determined and every[k].fits)]
    further = over_cores(lambda k: fitted(pairs[k], every[k]), again)
    for k, fit in zip(again, further, strict=True):
        every[k] = fit
    return every


def few_places(model: Structure) -> bool:
    """Whether points and neighbouring pairs are few enough to be looked at unasked, and several."""
    n = len(model.modes.sensors) + len(model.modes.points)
    return n > 2 and 2 * n - 1 <= _MOST


def _rows(
    modes: LinearModes, candidates: Mapping[str, object] | Sequence[str]
) -> dict[str, tuple[Row | None, Float[np.ndarray, " mode"]]]:
    """Rows over points and over modes by their names, the mode of interest's own last."""
    given: dict[str, object] = (
        dict(candidates)
        if isinstance(candidates, Mapping)
        else {name: _place(name) for name in candidates}
    )
    unasked = not given
    if unasked:
        points = (*modes.sensors, *modes.points)
        given = {name: name for name in points}
        given |= {f"{b}-{a}": {b: 1.0, a: -1.0} for a, b in itertools.pairwise(points)}
    j, rows = modes.mode_of_interest, {}
    for name, at in given.items():
        row = row_over_points(at)  # type: ignore[arg-type]
        rows[name] = (row, np.asarray(sum(w * np.asarray(modes.shape_at(p)) for p, w in row)))
    moved = {name: abs(float(over[j])) for name, (_, over) in rows.items()}
    largest = max(moved.values())
    kept = {name: one for name, one in rows.items() if moved[name] > _STILL * largest}
    if unasked and len(kept) > _MOST:
        raise ValueError(
            f"{len(kept)} points and pairs are too many to choose from: name up to {_MOST} of them "
            f"as candidates, such as {', '.join(list(kept)[:3])}."
        )
    return {**kept, EVERYWHERE: (None, np.eye(modes.n_modes)[j])}


def _place(name: str) -> object:
    first, *others = name.split("-")
    return {first: 1.0, **dict.fromkeys(others, -1.0)} if others else name
