"""Identification: backbone and damping from steady states, and predictions from them."""

import dataclasses
import logging
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from snrmjax.doctor.column_misreadings import caveat, linear_damping_note, with_caveat
from snrmjax.identify.coupled.coupled_modes import other_mode_moves
from snrmjax.identify.coupled.coupled_test import CoupledDetails, coupled_details
from snrmjax.identify.inference.contributions import Contribution, contributions
from snrmjax.identify.inference.fitted_curves import fitted_values
from snrmjax.identify.inference.fitted_response import (
    FittedResponse,
    fitted_response,
    predicted_resonance,
)
from snrmjax.identify.inference.identification import (
    Identification,
    identification_of_fit,
    identify_backbone,
)
from snrmjax.identify.inference.optimal_design import NextMeasurements, next_measurements
from snrmjax.identify.joint.joint_fit import JointFit, corrected_states, fit_jointly
from snrmjax.identify.joint.notes import note_on_outlying
from snrmjax.identify.pointwise.backbone import Backbone, BackboneValues
from snrmjax.identify.pointwise.missing_resonance import level_in_resonance
from snrmjax.identify.pointwise.prediction import (
    LARGEST_AMPLITUDE_RATIO,
    Resonance,
)
from snrmjax.identify.prediction.new_level import DayToDay, new_level
from snrmjax.identify.prediction.resonance_distribution import (
    ResonanceDistribution,
    notes_on_negative_damping,
    notes_on_resonance,
    notes_on_trends,
)
from snrmjax.measure.states import SteadyStates, check_force, check_phases
from snrmjax.model.structures import Structure, driven_in_newtons
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError
from snrmjax.pipelines.options import COUPLED_MODES, IdentifyOptions, checked
from snrmjax.simulate.solutions.forced_response import ResponseCurve
from snrmjax.simulate.solutions.normal_modes import NormalModeBranch

Note = Fact | str
_log = logging.getLogger(__name__)

BACKBONE_POINTS = 200
"""Number of amplitudes of the written curves."""

_CHECKED = 100  # amplitudes at which curves are checked for negative damping


class Prediction(NamedTuple):
    """Prediction of the identified curves under one force."""

    force: float  # N
    resonances: Sequence[Resonance]  # in order of amplitude
    responses: Sequence[FittedResponse]  # the main curve first
    further: ResonanceDistribution  # of the resonance of a new level
    drive: float | None = None  # V, where the force is known as a drive voltage
    at: str | None = None  # point of the force, if not that of the test
    unit: str = "N"  # of the force; m/s² of a base

    @property
    def load(self) -> Fact:
        """The force, and its drive voltage if that is known."""
        return Fact("load", force=self.force, drive=self.drive, at=self.at, unit=self.unit)


def reach_of(options: IdentifyOptions) -> float:
    """Multiple of the largest measured amplitude up to which curves are extrapolated."""
    return LARGEST_AMPLITUDE_RATIO if options.extrapolate is None else options.extrapolate


def predictions_of_fit(
    fit: JointFit, options: IdentifyOptions
) -> tuple[tuple[Prediction, ...], tuple[Note, ...]]:
    """Predictions of the curves, and notes on trends of the levels, which widen the bands."""
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


class FitDetails(NamedTuple):
    """A joint fit with the contributions to its bands, and advised measurements."""

    fit: JointFit
    fractions: tuple[Contribution, ...]
    advice: NextMeasurements | None  # None: not requested
    responses: tuple[FittedResponse, ...]  # main curves under the advised forces


class IdentifiedTest(NamedTuple):
    """An identification with its predictions and, for synthetic data, the true responses."""

    data: SteadyStates
    model: Structure
    options: IdentifyOptions
    identification: Identification
    values: BackboneValues  # of the curves, from the smallest to the largest measured amplitude
    predictions: tuple[Prediction, ...]
    notes: tuple[Note, ...]
    joint: FitDetails | None = None  # None: curves through points
    truth: NormalModeBranch | None = None
    simulated: tuple[ResponseCurve, ...] = ()
    coupled: CoupledDetails | None = None  # None: not requested, and no second mode responds

    @property
    def responses(self) -> list[FittedResponse]:
        """Predicted responses of all forces."""
        return [response for prediction in self.predictions for response in prediction.responses]

    @property
    def resonances(self) -> list[Resonance]:
        """Predicted resonances of all forces."""
        return [resonance for prediction in self.predictions for resonance in prediction.resonances]

    @property
    def advice(self) -> NextMeasurements | None:
        """Advised measurements, if requested."""
        return None if self.joint is None else self.joint.advice


def identify_test(
    data: SteadyStates,
    model: Structure,
    options: IdentifyOptions | None = None,
    **settings: Any,
) -> IdentifiedTest:
    """Identify backbone and damping, predict responses, and advise further measurements.

    The curves are those of one joint fit of all states; where one of `fit`, `free` and `further` is
    stated, with its details.

    Arguments: `data` in N or, for a joint fit, in V; `options`, or its fields by keyword.
    Returns an `IdentifiedTest`.
    Raises `ValueError` for an option without effect, and as `identify_backbone`, `fit_jointly`,
    `predict_response` and `fitted_response` do; where columns of the data are probably
    misread the error states it.
    """
    options = checked(dataclasses.replace(options or IdentifyOptions(), **settings))
    if model.modes.unbalance is not None and (options.predict_force or options.predict_drive):
        raise InputError(
            "predictions are for a force in N that is the same at every frequency, but the model's "
            "[force] is an unbalance: remove `unbalance_kg_m` to predict for a force."
        )
    model = driven_in_newtons(model)
    if options.predict_drive:
        require_drive(data)
    if (options.modes or 1) > COUPLED_MODES:
        raise InputError(f"`--modes` must be 1 or 2, but is {options.modes}.")
    coupled, alone = options.modes == COUPLED_MODES, options
    if coupled:  # responses are then those of the coupled modes
        alone = dataclasses.replace(options, predict_force=())
    identified = _identified(data, model, alone)
    if not coupled and (options.modes is not None or not other_mode_moves(data, model)):
        return identified
    forces = options.predict_force if coupled else ()
    # With the gain and the phase that a joint fit identified for the instruments.
    details = coupled_details(identified.data, model, identified.identification, forces)
    notes = _each_once((*identified.notes, *details.notes()))
    return identified._replace(options=options, coupled=details, notes=notes)


def _identified(data: SteadyStates, model: Structure, options: IdentifyOptions) -> IdentifiedTest:
    """Points, curves and predictions, with the details of the fit if a joint one is requested."""
    if options.is_joint:
        _log.info("fits backbone and damping curves to %d states", len(data.frequency))
        fit = _joint_fit(data, model, options)
        data = corrected_states(data, fit)
        identification = identification_of_fit(data, fit)
    else:
        identification = _by_points(data, model, options)
        fit = identification.fit
    predictions, trends = predictions_of_fit(fit, options)
    details = _details(fit, options) if options.is_joint else None
    advice = details.advice if details else None
    caveats = () if "force_gain" in fit.names() else caveat(data, model, identification.points)
    reach = np.linspace(0.0, reach_of(options) if predictions else 1.0, _CHECKED) * fit.largest[0]
    notes = (
        *caveats,
        *data.notes,
        *note_on_outlying(fit),
        *identification.notes,
        *linear_damping_note(fit, model),
        *_note_on_gain(fit),
        *notes_on_negative_damping(fitted_values(fit, displacement=reach)),
        *trends,
        *notes_on_predictions(predictions, identification.backbone, data),
        *(advice.notes if advice else ()),
        *_note_on_advice(advice, options),
    )
    backbone = identification.backbone
    values = backbone.sampled(BACKBONE_POINTS)
    if options.is_joint:
        ends = float(backbone.smallest), float(backbone.largest)
        values = fitted_values(fit, displacement=np.linspace(*ends, BACKBONE_POINTS))
    return IdentifiedTest(
        data,
        model,
        options,
        identification,
        values,
        predictions,
        _each_once(notes),
        joint=details,
    )


def _by_points(data: SteadyStates, model: Structure, options: IdentifyOptions) -> Identification:
    check_phases(data, "an identification")
    check_force(data, "an identification state by state")
    try:
        return identify_backbone(
            data,
            model,
            amplitude=options.amplitude,
            measure=options.measure,
            n_knots=options.knots,
        )
    except InputError as error:
        raise with_caveat(error, data, model) from error


def _joint_fit(data: SteadyStates, model: Structure, options: IdentifyOptions) -> JointFit:
    names = (options.fit or "auto").split(",")
    if len(names) > 2:
        raise InputError(
            f"--fit takes one or two families, but {options.fit!r} names {len(names)}."
        )
    return fit_jointly(
        data,
        model,
        backbone=names[0],
        damping=names[1] if len(names) == 2 else "auto",
        free=[name for several in options.free for name in several.split(",")],
        robust=options.robust or None,
    )


def _details(fit: JointFit, options: IdentifyOptions) -> FitDetails:
    _log.info("compares further measurements")
    advice = next_measurements(fit, options.further) if options.further else None
    forces = sorted({one.force for one in advice or ()})
    responses = tuple(fitted_response(fit, force)[0] for force in forces)
    return FitDetails(fit, tuple(contributions(fit)), advice, responses)


def _note_on_gain(fit: JointFit) -> tuple[Note, ...]:
    """The identified force per volt, where only the drive voltage is known."""
    if not fit.drive_known_only:
        return ()
    column = fit.names().index("force_gain")
    std = float(np.sqrt(fit.covariance[column, column]))
    gain = float(np.exp(fit.unknowns.log_force_gain))
    return (Fact("force_from_drive", newtons_per_volt=gain, relative_std=std),)


def _note_on_advice(advice: NextMeasurements | None, options: IdentifyOptions) -> tuple[Note, ...]:
    if advice is None or advice.status.kind == "advice_complete":
        return ()
    return (Fact("fewer_advised", n=len(advice), wanted=options.further, why=advice.status),)


def _each_once(notes: tuple[Note, ...]) -> tuple[Note, ...]:
    return tuple(dict.fromkeys(notes))
