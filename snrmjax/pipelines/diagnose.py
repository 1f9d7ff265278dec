"""Diagnosis: what a model lacks, and the responses with and without it."""

import dataclasses
import logging
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from snrmjax.diagnose.diagnosis import diagnose_model
from snrmjax.diagnose.diagnosis_result import Diagnosis, FormerAnswer
from snrmjax.diagnose.location.where import Localisation, few_places, locate_force
from snrmjax.diagnose.response_prediction import (
    HeldCurve,
    LevelPredictions,
    LevelResponse,
    held_curves,
    holds_response,
    level_forces,
    predict_levels,
)
from snrmjax.diagnose.verdict import Verdict
from snrmjax.io.diagnosis_results import placed_answer
from snrmjax.io.files import FilePath
from snrmjax.io.measurement_plans import read_further_states
from snrmjax.io.models import read_model
from snrmjax.io.tables import read_steady_states
from snrmjax.measure.states import SteadyStates
from snrmjax.model.structures import Structure, driven_in_newtons
from snrmjax.numerics.facts import Fact

# Of a completed model's resonance from the measured one: far beyond what levels repeat to.
_FAR_OFF = 0.01  # relative, of frequencies
_FAR_APART = 0.2  # of the logarithm of velocities
_log = logging.getLogger(__name__)


class SimulatedLevels(NamedTuple):
    """Responses of all levels, of the model as given and as completed.

    Where a test holds its response, `held` are the forces that hold it, of both models.
    """

    predicted: LevelPredictions
    held: tuple[list[HeldCurve], list[HeldCurve]] | None


class DiagnosedTest(NamedTuple):
    """A diagnosis, and what was simulated of it."""

    diagnosis: Diagnosis
    model: Structure  # as given
    simulated: SimulatedLevels | None = None  # None: not asked for, or nothing to simulate
    where: Localisation | None = None  # None: nothing is missing, or there is but one place

    @property
    def is_placed(self) -> bool:
        """Whether the answer is a law at one place, which explains all sensors to the noise.

        The law alone that is named for the mode as a whole stays with the mode.
        """
        if self.where is None or not self.where.explains:
            return False
        law, diagnosis = self.where.places[0].law, self.diagnosis
        of_mode = diagnosis.effects if diagnosis.verdict is Verdict.NAMED else ()
        return law is not None and of_mode != (law.kind,)

    @property
    def verdict(self) -> Verdict:
        """The verdict on the whole test, as `diagnosis.json` has it.

        `diagnosis.verdict` is that on effects of the mode alone, by the reference sensor; where a
        law at one place explains all sensors, its verdict takes the place of theirs.
        """
        if self.where is not None and self.is_placed:
            return Verdict(placed_answer(self.where)["verdict"])
        return self.diagnosis.verdict

    @property
    def predicted(self) -> tuple[LevelResponse, ...]:
        """The simulated resonances of all levels."""
        return () if self.simulated is None else tuple(self.simulated.predicted.levels)


def diagnose_test(
    data: SteadyStates,
    model: Structure,
    *,
    simulate: bool = True,
    former: FormerAnswer | None = None,
    where: Sequence[str] = (),
) -> DiagnosedTest:
    """Find what the model lacks and where; if asked for, simulate all levels with and without it.

    Arguments: `former` answer of fewer states; `where` it may be, points and pairs ("x3-x2"), by
    default all points and neighbouring pairs if there are several sensors and few points. Where no
    structure can have the parameters found, nothing is simulated.
    Raises `ValueError` as `diagnose_model` and `locate_force` do.
    """
    model = driven_in_newtons(model)
    _log.info("compares %d states with the model", len(data.frequency))
    found = diagnose_model(model, data, former=former)
    _log.info("looks for the point where the missing force acts")
    place = _localisation(found, data, model, where)
    if place is not None and DiagnosedTest(found, model, where=place).is_placed:
        found = _completed_at(found, place)
    if not (simulate and found.effects and found.completed is not None):
        return DiagnosedTest(found, model, where=place)
    _log.info("simulates the responses of all levels")
    simulated = simulated_levels(found, model)
    n, of = len(simulated.predicted.levels), len(level_forces(data, found.force_misfit.sensor))
    if n < of:
        note = Fact("some_levels_simulated", n=n, of=of)
        found = dataclasses.replace(found, notes=(*found.notes, note))
    levels = tuple(each.level for each in simulated.predicted.levels if not each.complete)
    if levels:
        note = Fact("responses_not_complete", levels=levels)
        found = dataclasses.replace(found, notes=(*found.notes, note))
    missed = tuple(each.level for each in simulated.predicted.levels if _is_missed(each))
    if missed:
        note = Fact("resonances_missed", levels=missed)
        found = dataclasses.replace(found, notes=(*found.notes, note))
    return DiagnosedTest(found, model, simulated, place)


def _completed_at(found: Diagnosis, place: Localisation) -> Diagnosis:
    """The diagnosis whose completed model has the law at its place."""
    answer = found.answer._replace(completed=place.model)
    checks = found.checks._replace(completed_without={})  # these have effects on the mode
    notes = [note for note in found.notes if getattr(note, "kind", "") != "other_sensors_missed"]
    return dataclasses.replace(found, answer=answer, checks=checks, notes=tuple(notes))


def _is_missed(level: LevelResponse) -> bool:
    """Whether the completed model has no resonance, or one far from the level's measured one."""
    there, after = level.measured, level.completed
    if np.isfinite(there.frequency) and not np.isfinite(after.frequency):
        return level.complete
    off = abs(after.frequency - there.frequency) > _FAR_OFF * there.frequency
    return bool(off or abs(np.log(after.velocity / there.velocity)) > _FAR_APART)


def _localisation(
    found: Diagnosis, data: SteadyStates, model: Structure, where: Sequence[str]
) -> Localisation | None:
    """Where the force acts that a model lacks, if it lacks one and there is a choice."""
    missing = found.verdict not in (Verdict.NOTHING_MISSING, Verdict.NOISE_REJECTED)
    told = np.isfinite(np.asarray(data.force)).any() and not np.asarray(data.phase_unknown).any()
    asked = bool(where) or (len(data.sensors) > 1 and few_places(model))
    return locate_force(data, model, where) if missing and told and asked else None


def simulated_levels(diagnosis: Diagnosis, model: Structure) -> SimulatedLevels:
    """Resonances and responses of all levels, with the model as given and as completed.

    Raises `ValueError` where there is no completed model.
    """
    data, sensor = diagnosis.data, diagnosis.force_misfit.sensor
    predicted = predict_levels(diagnosis, model)
    if diagnosis.completed is None or not holds_response(data, predicted.levels):
        return SimulatedLevels(predicted, None)
    given = held_curves(model, data, sensor)
    completed = held_curves(diagnosis.completed, data, sensor, diagnosis.answer.force_gain)
    return SimulatedLevels(predicted, (given, completed))


def read_test(
    data: FilePath, model: FilePath, further: Sequence[FilePath] = ()
) -> tuple[Structure, SteadyStates]:
    """A model, and a table of steady states with those of further tables of the same structure."""
    structure = read_model(model)
    measured = read_steady_states(data, structure)
    for path in further:
        measured = read_further_states(path, structure, measured)
    return structure, measured
