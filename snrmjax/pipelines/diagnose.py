"""Diagnosis: missing physics of a model, and responses with and without it."""

import dataclasses
import logging
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from snrmjax.diagnose.diagnosis import diagnose_model
from snrmjax.diagnose.diagnosis_result import Diagnosis, FormerAnswer
from snrmjax.diagnose.location.where import Localisation, few_attachment_points, locate_force
from snrmjax.diagnose.response_prediction import (
    ControlledVelocityCurve,
    LevelPredictions,
    LevelResponse,
    controlled_velocity_curves,
    is_response_controlled,
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
from snrmjax.numerics.names import with_former_attributes

# Deviations of a completed model's resonance from the measured one, far above repeatability.
_FAR_OFF = 0.01  # relative, of frequencies
_FAR_APART = 0.2  # of the logarithm of velocities
_log = logging.getLogger(__name__)


@with_former_attributes({"held": "required_forces"})
class SimulatedLevels(NamedTuple):
    """Responses of all levels, of the given and of the completed model.

    For a response-controlled test `required_forces` are the required forces of both models.
    """

    predicted: LevelPredictions
    required_forces: tuple[list[ControlledVelocityCurve], list[ControlledVelocityCurve]] | None


@with_former_attributes({"is_placed": "is_located"})
class DiagnosedTest(NamedTuple):
    """A diagnosis, and its simulated responses."""

    diagnosis: Diagnosis
    model: Structure  # as given
    simulated: SimulatedLevels | None = None  # None: not requested, or nothing to simulate
    where: Localisation | None = None  # None: nothing missing, or a single point

    @property
    def is_located(self) -> bool:
        """Whether the answer is a law at one point that explains all sensors within the noise.

        A single effect named for the whole mode remains an effect on the mode.
        """
        if self.where is None or not self.where.explains:
            return False
        law, diagnosis = self.where.candidates[0].law, self.diagnosis
        of_mode = diagnosis.effects if diagnosis.verdict is Verdict.NAMED else ()
        return law is not None and of_mode != (law.kind,)

    @property
    def verdict(self) -> Verdict:
        """The verdict on the whole test, as in `diagnosis.json`.

        `diagnosis.verdict` is that on effects on the mode, by the reference sensor; a law at one
        point that explains all sensors replaces it.
        """
        if self.where is not None and self.is_located:
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
    """Find and locate the missing physics of a model; optionally simulate all levels with it.

    Arguments: `former` answer from fewer states; `where` are candidate points and pairs ("x3-x2"),
    by default all points and neighbouring pairs if there are several sensors and few points. Where
    no structure can have the identified parameters, nothing is simulated.
    Raises `ValueError` as `diagnose_model` and `locate_force` do.
    """
    model = driven_in_newtons(model)
    _log.info("compares %d states with the model", len(data.frequency))
    diagnosis = diagnose_model(model, data, former=former)
    _log.info("looks for the point where the missing force acts")
    location = _localisation(diagnosis, data, model, where)
    if location is not None and DiagnosedTest(diagnosis, model, where=location).is_located:
        diagnosis = _completed_at(diagnosis, location)
    if not (simulate and diagnosis.effects and diagnosis.completed is not None):
        return DiagnosedTest(diagnosis, model, where=location)
    _log.info("simulates the responses of all levels")
    simulated = simulated_levels(diagnosis, model)
    n, of = len(simulated.predicted.levels), len(level_forces(data, diagnosis.force_misfit.sensor))
    if n < of:
        note = Fact("some_levels_simulated", n=n, of=of)
        diagnosis = dataclasses.replace(diagnosis, notes=(*diagnosis.notes, note))
    levels = tuple(each.level for each in simulated.predicted.levels if not each.complete)
    if levels:
        note = Fact("responses_not_complete", levels=levels)
        diagnosis = dataclasses.replace(diagnosis, notes=(*diagnosis.notes, note))
    missed = tuple(each.level for each in simulated.predicted.levels if _is_missed(each))
    if missed:
        note = Fact("resonances_missed", levels=missed)
        diagnosis = dataclasses.replace(diagnosis, notes=(*diagnosis.notes, note))
    return DiagnosedTest(diagnosis, model, simulated, location)


def _completed_at(diagnosis: Diagnosis, location: Localisation) -> Diagnosis:
    """The diagnosis with the law at its point in the completed model."""
    answer = diagnosis.answer._replace(completed=location.model)
    checks = diagnosis.checks._replace(completed_without={})  # they have effects on the mode
    notes = [
        note for note in diagnosis.notes if getattr(note, "kind", "") != "other_sensors_missed"
    ]
    return dataclasses.replace(diagnosis, answer=answer, checks=checks, notes=tuple(notes))


def _is_missed(level: LevelResponse) -> bool:
    """Whether the completed model has no resonance, or one far from the level's measured one."""
    measured, completed = level.measured, level.completed
    if np.isfinite(measured.frequency) and not np.isfinite(completed.frequency):
        return level.complete
    off = abs(completed.frequency - measured.frequency) > _FAR_OFF * measured.frequency
    return bool(off or abs(np.log(completed.velocity / measured.velocity)) > _FAR_APART)


def _localisation(
    diagnosis: Diagnosis, data: SteadyStates, model: Structure, where: Sequence[str]
) -> Localisation | None:
    """Location of the missing force, if there is one and several points are possible."""
    missing = diagnosis.verdict not in (Verdict.NOTHING_MISSING, Verdict.NOISE_REJECTED)
    complete = (
        np.isfinite(np.asarray(data.force)).any() and not np.asarray(data.phase_unknown).any()
    )
    located = bool(where) or (len(data.sensors) > 1 and few_attachment_points(model))
    return locate_force(data, model, where) if missing and complete and located else None


def simulated_levels(diagnosis: Diagnosis, model: Structure) -> SimulatedLevels:
    """Resonances and responses of all levels, of the given and of the completed model.

    Raises `ValueError` where there is no completed model.
    """
    data, sensor = diagnosis.data, diagnosis.force_misfit.sensor
    predicted = predict_levels(diagnosis, model)
    if diagnosis.completed is None or not is_response_controlled(data, predicted.levels):
        return SimulatedLevels(predicted, None)
    given = controlled_velocity_curves(model, data, sensor)
    completed = controlled_velocity_curves(
        diagnosis.completed, data, sensor, diagnosis.answer.force_gain
    )
    return SimulatedLevels(predicted, (given, completed))


def read_test(
    data: FilePath, model: FilePath, further: Sequence[FilePath] = ()
) -> tuple[Structure, SteadyStates]:
    """A model, and the steady states of a table and of further tables of the same structure."""
    structure = read_model(model)
    measured = read_steady_states(data, structure)
    for path in further:
        measured = read_further_states(path, structure, measured)
    return structure, measured
