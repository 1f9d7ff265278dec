"""Responses and resonances predicted from identified curves under given forces."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

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
from snrmjax.identify.prediction.resonance_distribution import (
    ResonanceDistribution,
    notes_on_resonance,
    notes_on_trends,
)
from snrmjax.measure.states import SteadyStates
from snrmjax.model.structures import Structure
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError
from snrmjax.pipelines.options import IdentifyOptions

Note = Fact | str


class Prediction(NamedTuple):
    """Prediction of the identified curves under one force."""

    force: float  # N
    resonances: Sequence[Resonance]  # in order of amplitude
    responses: Sequence[PredictedResponse]  # the main curve first; those of a joint fit with 1σ
    further: ResonanceDistribution  # of the resonance of a new level
    drive: float | None = None  # V, where the force is known as a drive voltage
    at: str | None = None  # point of the force, if not that of the test
    unit: str = "N"  # of the force; m/s² of a base

    @property
    def banded(self) -> list[FittedResponse]:
        """The responses that have bands."""
        return [each for each in self.responses if isinstance(each, FittedResponse)]

    @property
    def load(self) -> Fact:
        """The force, and its drive voltage if that is known."""
        return Fact("load", force=self.force, drive=self.drive, at=self.at, unit=self.unit)


def reach_of(options: IdentifyOptions) -> float:
    """Multiple of the largest measured amplitude up to which curves are extrapolated."""
    return LARGEST_AMPLITUDE_RATIO if options.extrapolate is None else options.extrapolate


def predictions_of_points(
    identification: Identification, model: Structure, options: IdentifyOptions
) -> tuple[Prediction, ...]:
    """Predictions of curves through points."""
    fit = identification.fit
    ratio: dict[str, Any] = {"largest_amplitude_ratio": reach_of(options)}
    predictions = []
    for force in dict.fromkeys(options.predict_force):
        level = new_level(fit, force, day=_day_of(options), at=options.predict_at)
        backbone = identification.backbone.moved_by(level.over_test(fit))
        modes = model.modes if level.forced is None else level.forced
        predictions.append(
            Prediction(
                force,
                resonances(backbone, modes, force, **ratio),
                predict_response(backbone, modes, force, **ratio),
                predicted_resonance(
                    fit, force, of=level, self_excited=options.self_excited, **ratio
                ),
                at=options.predict_at,
                unit=modes.force_unit,
            )
        )
    return tuple(predictions)


def predictions_of_fit(
    fit: JointFit, options: IdentifyOptions
) -> tuple[tuple[Prediction, ...], tuple[Note, ...]]:
    """Predictions of a joint fit, and notes on trends of its levels, which widen the bands."""
    loads: list[tuple[float, float | None, bool]] = []
    for force in dict.fromkeys(options.predict_force):
        by_drive = fit.drive_known_only and options.predict_at is None
        record = float(fit.recorded_force(np.array(force))) if by_drive else None
        loads.append((force, record, False))
    for drive in dict.fromkeys(options.predict_drive):
        loads.append((float(fit.force_of_drive(np.array(drive))), drive, True))
    predictions: list[Prediction] = []
    notes: list[Note] = []
    for force, record, as_recorded in loads:
        settings: dict[str, Any] = {
            "largest_amplitude_ratio": reach_of(options),
            "of": new_level(
                fit,
                force,
                as_recorded=as_recorded,
                day=_day_of(options),
                at=options.predict_at,
            ),
        }
        further = predicted_resonance(fit, force, self_excited=options.self_excited, **settings)
        banded = _of_distribution(fitted_response(fit, force, **settings), further)
        peaks = sorted(
            (peak for one in banded for peak in one.resonances), key=lambda t: t.amplitude
        )
        point, unit = options.predict_at, fit.modes.force_unit
        predictions.append(Prediction(force, peaks, banded, further, record, point, unit))
        notes += notes_on_trends(settings["of"].trends, predictions[-1].load)
    return tuple(predictions), tuple(notes)


def _of_distribution(
    responses: list[FittedResponse], further: ResonanceDistribution
) -> list[FittedResponse]:
    """The responses, with the first resonance's 1σ from the sampled distribution.

    A linearised 1σ is not valid where curves end or damping falls to zero.
    """
    peaks = [peak for one in responses for peak in one.resonances]
    first = min(peaks, key=lambda peak: peak.amplitude, default=None)
    if first is None or not np.isfinite(further.frequency_std):
        return responses
    std = (further.frequency_std, further.velocity_std)
    changed = dataclasses.replace(first, frequency_std=std[0], velocity_std=std[1])
    return [
        dataclasses.replace(
            one, resonances=tuple(changed if peak is first else peak for peak in one.resonances)
        )
        for one in responses
    ]


def require_drive(data: SteadyStates) -> None:
    """Raise `ValueError` for data whose force is known in newtons."""
    if np.any(np.isfinite(np.asarray(data.force))):
        raise InputError(
            "`--predict-drive` is for data with a drive voltage (`drive_v`), but these have the "
            "force in newtons (`force_n`): use `--predict-force`."
        )


def notes_on_predictions(
    predictions: Sequence[Prediction], backbone: Backbone, data: SteadyStates
) -> list[Note]:
    """Notes on forces whose resonance is beyond the range or the data, or is one of several.

    Also where the curves have no resonance in the range, but a measured level of that force has.
    """
    notes: list[Note] = []
    for each in predictions:
        notes += notes_on_resonance(each.further, each.load)
        as_in_test = each.at is None and not each.resonances
        near = level_in_resonance(data, backbone, each.force) if as_in_test else None
        if near is not None:
            notes.append(
                Fact(
                    "level_missed_by_curves",
                    level=near.level,
                    force=near.force,
                    frequency_hz=near.frequency,
                    velocity=near.velocity,
                )
            )
        if any(resonance.continued for resonance in each.resonances):
            notes.append(Fact("resonance_beyond_data", load=each.load))
        notes += [
            Fact("response_note", load=each.load, note=str(response.note))
            for response in each.responses
            if response.note
        ]
        if len(each.resonances) > 1:
            notes.append(Fact("several_resonances", n=len(each.resonances), load=each.load))
    return notes


def _day_of(options: IdentifyOptions) -> DayToDay | None:
    """Day-to-day changes from the option `--day-std`."""
    if options.day_std is None:
        return None
    try:
        day = DayToDay(*map(float, options.day_std.split(",")))
    except (TypeError, ValueError):
        day = DayToDay(-1.0)
    if not all(0 <= each < 1 for each in day):
        raise InputError(
            "`--day-std` takes up to three relative standard deviations from 0 to below 1, "
            f"FREQUENCY,DAMPING,GAIN as 0.001,0.05,0.02, but is {options.day_std!r}."
        )
    return day
