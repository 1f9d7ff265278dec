"""Localisation: the attachment point of a nonlinear force, from sensor patterns and laws."""

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.diagnose.location.laws_at_points import LocatedLaw, law_fit
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
from snrmjax.model.attachment import InfluenceVector, influence_vector
from snrmjax.model.effect_base import AbstractForce
from snrmjax.model.effects import EFFECTS, make_effect
from snrmjax.model.modes import LinearModes
from snrmjax.model.structures import Structure
from snrmjax.numerics.blocks import on_one_core, over_cores
from snrmjax.numerics.compiled import on_numbers
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.names import with_former_attributes
from snrmjax.numerics.result import AbstractResult, quantity, setting
from snrmjax.numerics.rules import InputError

EVERYWHERE = "everywhere"
"""Name of a force on the modal coordinate of interest, distributed as its inertia."""

_ORDERS = 9  # highest harmonic used
_FAR = 40.0  # nats below the best, beyond which laws are not tried
_SURE = 0.5  # probability from which on a point is named
_MOST = 16  # most default candidates
_RULED_OUT = 30.0  # ratio to the best rough χ² beyond which a law is not fitted
_AGAIN = 8  # best fits to be retried from further starts if they do not fit
_FEWEST = 3.0  # least degrees of freedom where no law fits
_NOT_THERE = 1.5  # times the noise, from which on no point reproduces the response
_UNMOVED = 0.02  # of the largest motion, below which a candidate is left out


class LocatedForce(NamedTuple):
    """A candidate location with its probability and its best law."""

    name: str
    influence: InfluenceVector | None  # None: everywhere
    probability: float
    law: LocatedLaw | None  # the best one; None where the sensor pattern rules the location out
    laws: dict[str, float]  # probabilities of laws there, given one of them


@with_former_attributes(
    {
        "told": "is_determined",
        "settled_by": "separating_sensor",
        "places": "candidates",
        "by_place": "probabilities",
    }
)
class Localisation(AbstractResult):
    """Locations of a nonlinear force, the most probable first; see `locate_force`.

    `misfit` is the rms residual of the best location in units of the noise: well above one, the
    force acts at none of the candidates or at several, or the linear structure is wrong.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("place",)

    candidates: tuple[LocatedForce, ...]
    model: Structure  # with the law at the most probable location
    separating_sensor: str | None  # the best additional sensor to separate the two most probable
    name: tuple[str, ...] = quantity("place", "", "place", name="place", static=True)
    probability: Float[np.ndarray, " place"] = quantity("place", "1", "probability")
    misfit: float = setting()

    @property
    def words(self) -> Fact:
        """Where the force acts, as far as determined."""
        first, second = self.candidates[:2]
        values = {
            "place": first.name,
            "probability": first.probability,
            "other": second.name,
            "misfit": self.misfit,
            "sensor": self.separating_sensor,
        }
        if not self.fits:
            law = first.law
            return Fact("no_place_fits", **values, kind="" if law is None else law.kind)
        if self.is_determined:
            return Fact("force_placed", **values)
        return Fact("force_not_placed", **values)

    @property
    def answer(self) -> Fact:
        """The located law as an answer, where no effect on the mode explains the states."""
        law = self.candidates[0].law
        return Fact("placed_law_explains", kind="" if law is None else law.kind)

    @property
    def explains(self) -> bool:
        """Whether a law at one location, other than a distributed one, fits within noise."""
        first = self.candidates[0]
        fits = first.law is not None and first.law.fits
        return self.is_determined and first.influence is not None and fits

    @property
    def fits(self) -> bool:
        """Whether the residual of the best location is about the noise, if that is known."""
        return not self.misfit > _NOT_THERE

    @property
    def is_determined(self) -> bool:
        """Whether one location is more probable than all others together."""
        return bool(self.probability[0] > _SURE)

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`."""
        head = self.name[0] if self.is_determined else "not determined"
        head = head if self.fits else "none of these candidates"
        lines = [f"Localisation: {head}"]
        for location in self.candidates:
            law = "" if location.law is None else f", as {location.law.kind}"
            lines.append(f"{location.name}: {location.probability:.3g}{law}")
        if not self.is_determined and self.separating_sensor is not None:
            lines.append(f"a sensor at {self.separating_sensor} would separate the first two")
        return (*lines, f"misfit of the best: {self.misfit:.3g} times the noise")

    @property
    def probabilities(self) -> dict[str, float]:
        """Probabilities by location, as in `diagnosis.json`."""
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
    """Locate a force that the model lacks among candidate attachment points.

    A force along an influence vector moves all sensors at every harmonic in the pattern of the
    linear structure's response. Candidates are first compared by the residuals of their patterns,
    without a law. Those that patterns cannot separate, such as all with one sensor, are compared by
    laws: the force required by the sensors must be a law of the motion there. Likelihoods are
    Gaussian, with the noise scaled to the residual of the best candidate.

    Arguments: `data`: of one sensor or more with phases, best with harmonics and their errors;
    `model`: with shapes at the candidates, best from matrices; `candidates`: names of points or
    pairs ("a-b": between a and b), or influence vectors by name; by default all points and
    neighbouring pairs in their order. `EVERYWHERE`, a force on the mode of interest, is always
    included. `laws`: kinds of effects, by default all forces of the library.
    Returns `Localisation`. Raises `ValueError` for unknown points, no candidate, unknown phases.
    Validity: one force at one location, and a correct linear structure.
    Not differentiable: differentiate the force that a motion needs:
    `snrmjax.identify.inverse_force`.
    """
    check_phases(data, "the localisation of a force")
    chosen = calibration_states(model, data, _ORDERS)
    records, modes = sensor_records(chosen), model.modes
    vectors = _influence_vectors(modes, candidates)
    patterns = {n: source_pattern(records, chosen, modes, w) for n, (_, w) in vectors.items()}
    fits = {name: source_fit(records, pattern) for name, pattern in patterns.items()}
    square = np.array([fits[name].chi_square for name in vectors])
    freedom = max(next(iter(fits.values())).freedom, 1)
    scale = max(1.0, float(square.min()) / freedom) if freedom > 1 else 1.0
    weight = -0.5 * (square - square.min()) / scale
    near = [name for name, w in zip(vectors, weight, strict=True) if w > -_FAR]
    misfit = float(square.min()) / freedom if freedom > 1 else np.nan
    kinds = laws or [k for k, effect in EFFECTS.items() if issubclass(effect, AbstractForce)]
    best, by_law, of_laws = _by_laws(near, records, patterns, fits, kinds)
    if len(near) > 1:
        misfit = of_laws
        weight = np.array([by_law.get(name, -np.inf) for name in vectors])
    probability = np.exp(weight - weight.max())
    probability /= probability.sum()
    order = np.argsort(-probability, kind="stable")
    names = tuple(list(vectors)[k] for k in order)
    located = tuple(
        LocatedForce(name, vectors[name][0], float(p), *best.get(name, (None, {})))
        for name, p in zip(names, probability[order], strict=True)
    )
    return Localisation(
        candidates=located,
        model=_completed(model, located[0]),
        separating_sensor=_settling_point(chosen, modes, [vectors[name][1] for name in names[:2]]),
        name=names,
        probability=probability[order],
        misfit=float(np.sqrt(misfit)),
    )


def _completed(model: Structure, located: LocatedForce) -> Structure:
    """The model with the located law."""
    law = located.law
    if law is None:
        return model
    effect = make_effect(law.kind, law.parameters, at=located.influence)
    return dataclasses.replace(model, effects=(*model.effects, effect))


def _settling_point(
    chosen: ComparedColumns, modes: LinearModes, vectors: Sequence[Float[np.ndarray, " mode"]]
) -> str | None:
    """The point without a sensor where forces along two influence vectors differ most.

    Both forces are those required by the sensors.
    """
    if not modes.points or len(vectors) < 2:
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
    n, responses = len(chosen.sensors), []
    for vector in vectors:
        seen = source_pattern(records, everywhere, whole, vector)
        own = SourcePattern(seen.driven[..., :n], seen.pattern[..., :n], *seen[2:])
        force = np.sum(source_fit(records, own).weights * (records.seen - own.driven), axis=2)
        responses.append(seen.driven[..., n:] + seen.pattern[..., n:] * force[..., None])
    scale = np.max(records.std()[:, :, :1], axis=0)
    apart = np.sum(np.abs((responses[0] - responses[1]) / scale) ** 2, axis=(0, 1))
    return modes.points[int(np.argmax(apart))]


def _by_laws(
    near: Sequence[str],
    records: SensorRecords,
    patterns: Mapping[str, SourcePattern],
    fits: Mapping[str, SourceFit],
    laws: Sequence[str],
) -> tuple[dict[str, tuple[LocatedLaw, dict[str, float]]], dict[str, float], float]:
    """The best law of every location, log evidences, and the reduced χ² of the best fit."""
    pairs = [(name, kind) for name in near for kind in laws]

    def fitted(
        pair: tuple[str, str], before: LocatedLaw | None = None, *, rough: bool = False
    ) -> LocatedLaw:
        name, kind = pair
        return law_fit(kind, records, patterns[name], fits[name], rough=rough, before=before)

    rough = [fit.chi_square for fit in over_cores(partial(fitted, rough=True), pairs)]
    promising = [pair for pair, s in zip(pairs, rough, strict=True) if s < _RULED_OUT * min(rough)]
    every = _from_further_starts(promising, over_cores(fitted, promising), fitted)
    by_point: dict[str, list[LocatedLaw]] = {}
    for (name, _), fit in zip(promising, every, strict=True):
        by_point.setdefault(name, []).append(fit)
    least = min(every, key=lambda fit: fit.chi_square)
    scale = max(1.0, least.chi_square / least.freedom)
    # Where no law fits, residuals are not noise: few effective numbers, as with Student's t.
    counts = max(least.freedom / scale, _FEWEST)
    evidence, best = {}, {}
    for name, some in by_point.items():
        worse = np.array([fit.chi_square / least.chi_square for fit in some])
        # A penalty of 1 a parameter, as in Akaike's criterion.
        terms = -0.5 * counts * np.log(worse) - np.array([len(fit.std) for fit in some])
        evidence[name] = float(np.logaddexp.reduce(terms))
        fractions = np.exp(terms - evidence[name])
        kinds = {fit.kind: float(fraction) for fit, fraction in zip(some, fractions, strict=True)}
        best[name] = some[int(np.argmax(fractions))], kinds
    return best, evidence, least.chi_square / least.freedom


def _from_further_starts(
    pairs: Sequence[tuple[str, str]],
    once: Sequence[LocatedLaw],
    fitted: Callable[..., LocatedLaw],
) -> list[LocatedLaw]:
    """All fits, with the best ones repeated from further starts where they did not fit."""
    every = list(once)
    least = min(every, key=lambda fit: fit.chi_square)
    near = [k for k, fit in enumerate(every) if fit.chi_square < _RULED_OUT * least.chi_square]
    near.sort(key=lambda k: every[k].chi_square)
    again = [k for k in near[:_AGAIN] if not (every[k].determined and every[k].fits)]
    further = over_cores(lambda k: fitted(pairs[k], every[k]), again)
    for k, fit in zip(again, further, strict=True):
        every[k] = fit
    return every


def few_attachment_points(model: Structure) -> bool:
    """Whether points and neighbouring pairs are few enough, and several, for the default search."""
    n = len(model.modes.sensors) + len(model.modes.points)
    return n > 2 and 2 * n - 1 <= _MOST


def _influence_vectors(
    modes: LinearModes, candidates: Mapping[str, object] | Sequence[str]
) -> dict[str, tuple[InfluenceVector | None, Float[np.ndarray, " mode"]]]:
    """Influence vectors over points and modes by name, with the mode of interest last."""
    given: dict[str, object] = (
        dict(candidates)
        if isinstance(candidates, Mapping)
        else {name: _point_weights(name) for name in candidates}
    )
    by_default = not given
    if by_default:
        points = (*modes.sensors, *modes.points)
        given = {name: name for name in points}
        given |= {f"{b}-{a}": {b: 1.0, a: -1.0} for a, b in itertools.pairwise(points)}
    j, vectors = modes.mode_of_interest, {}
    for name, at in given.items():
        vector = influence_vector(at)  # type: ignore[arg-type]
        vectors[name] = (
            vector,
            np.asarray(sum(w * np.asarray(modes.shape_at(p)) for p, w in vector)),
        )
    moved = {name: abs(float(over[j])) for name, (_, over) in vectors.items()}
    largest = max(moved.values())
    kept = {name: one for name, one in vectors.items() if moved[name] > _UNMOVED * largest}
    if by_default and len(kept) > _MOST:
        raise InputError(
            f"{len(kept)} points and pairs are too many candidates: name up to {_MOST} of them, "
            f"such as {', '.join(list(kept)[:3])}."
        )
    return {**kept, EVERYWHERE: (None, np.eye(modes.n_modes)[j])}


def _point_weights(name: str) -> object:
    first, *others = name.split("-")
    return {first: 1.0, **dict.fromkeys(others, -1.0)} if others else name
