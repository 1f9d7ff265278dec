"""Predictions of identified curves under the forces that were asked for, and notes on them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from snrmjax.identify.inference.fitted_response import (
    FittedResponse,
    fitted_response,
    predicted_resonance,
)
from snrmjax.identify.inference.identification import Identification
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.pointwise.backbone import Backbone
from snrmjax.identify.pointwise.missing_resonance import level_in_resonance
from snrmjax.identify.pointwise.prediction import (
    LARGEST_AMPLITUDE_RATIO,
    PredictedResponse,
    Resonance,
    predict_response,
    resonances,
)
from snrmjax.identify.prediction.new_level import DayToDay, new_level
from snrmjax.identify.prediction.notes import notes_on_resonance, notes_on_trends
from snrmjax.identify.prediction.resonance_distribution import ResonanceDistribution
from snrmjax.measure.states import SteadyStates
from snrmjax.model.structures import Structure


@dataclass(frozen=True)
class Loads:
    """The forces for which responses are predicted, how far curves are continued, and when."""

    forces: tuple[float, ...] = ()  # N
    drives: tuple[float, ...] = ()  # V, where the force is known as a drive voltage
    largest_amplitude_ratio: float = LARGEST_AMPLITUDE_RATIO
    day: DayToDay | None = None  # of another day's test
    self_excited: bool = False  # negative damping is possible


class Prediction(NamedTuple):
    """What the identified curves predict under one force."""

    force: float  # N
    resonances: Sequence[Resonance]  # in order of amplitude
    responses: Sequence[PredictedResponse]  # the main curve first; those of a joint fit with 1σ
    further: ResonanceDistribution  # of the resonance of a level that was not measured
    drive: float | None = None  # V, where the force is known as a drive voltage

    @property
    def banded(self) -> list[FittedResponse]:
        """The responses that have bands."""
        return [one for one in self.responses if isinstance(one, FittedResponse)]

    @property
    def load(self) -> str:
        """The force in words, and its drive voltage where the force is known as one."""
        if self.drive is None:
            return f"{self.force:g} N"
        return f"{self.drive:.5g} V ({self.force:.4g} N)"


def predictions_of_points(
    found: Identification, model: Structure, loads: Loads
) -> tuple[Prediction, ...]:
    """What curves through points predict."""
    backbone, ratio = found.backbone, loads.largest_amplitude_ratio
    return tuple(
        Prediction(
            force,
            resonances(backbone, model.modes, force, largest_amplitude_ratio=ratio),
            predict_response(backbone, model.modes, force, largest_amplitude_ratio=ratio),
            predicted_resonance(
                found.fit,
                force,
                largest_amplitude_ratio=ratio,
                of=new_level(found.fit, force, day=loads.day),
                self_excited=loads.self_excited,
            ),
        )
        for force in dict.fromkeys(loads.forces)
    )


def predictions_of_fit(
    fit: JointFit, loads: Loads
) -> tuple[tuple[Prediction, ...], tuple[str, ...]]:
    """What a joint fit predicts, and notes on trends of its levels, by which bands are wider."""
    asked: list[tuple[float, float | None, bool]] = []
    for force in dict.fromkeys(loads.forces):
        record = float(fit.recorded_force(np.array(force))) if fit.drive_known_only else None
        asked.append((force, record, False))
    for drive in dict.fromkeys(loads.drives):
        asked.append((float(fit.force_of_drive(np.array(drive))), drive, True))
    found: list[Prediction] = []
    notes: list[str] = []
    for force, record, as_recorded in asked:
        new = new_level(fit, force, as_recorded=as_recorded, day=loads.day)
        ratio = loads.largest_amplitude_ratio
        banded = fitted_response(fit, force, largest_amplitude_ratio=ratio, of=new)
        further = predicted_resonance(
            fit, force, largest_amplitude_ratio=ratio, of=new, self_excited=loads.self_excited
        )
        tips = sorted((tip for one in banded for tip in one.resonances), key=lambda t: t.amplitude)
        found.append(Prediction(force, tips, banded, further, record))
        notes += notes_on_trends(new.trends, found[-1].load)
    return tuple(found), tuple(notes)


def require_drive(data: SteadyStates) -> None:
    """Raise `ValueError` for data whose force is known in newtons."""
    if np.any(np.isfinite(np.asarray(data.force))):
        raise ValueError(
            "`--predict-drive` is for data with a drive voltage (`drive_v`), but these have the "
            "force in newtons (`force_n`): use `--predict-force`."
        )


def notes_on_predictions(
    predictions: Sequence[Prediction], backbone: Backbone, data: SteadyStates
) -> list[str]:
    """Sentences on forces whose resonance lies beyond the range or the data, or is one of several.

    Where the curves have none within the range, but a level of that force was measured in
    resonance, this is said too.
    """
    notes = []
    for one in predictions:
        notes += notes_on_resonance(one.further, one.load)
        near = None if one.resonances else level_in_resonance(data, backbone, one.force)
        if near is not None:
            notes.append(
                f"level {near.level} has its resonance under {near.force:.4g} N, measured at "
                f"{near.frequency:.5g} Hz, {near.velocity:.3g} m/s: the curves miss this level."
            )
        if any(each.continued for each in one.resonances):
            notes.append(f"the resonance at {one.load} lies beyond the measured amplitudes.")
        notes += [f"response at {one.load}: {each.note}" for each in one.responses if each.note]
        if len(one.resonances) > 1:
            notes.append(
                f"{len(one.resonances)} resonances at {one.load}: damping that falls with "
                "amplitude allows several."
            )
    return notes
