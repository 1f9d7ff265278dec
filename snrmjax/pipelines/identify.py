"""Identification: backbone and damping from steady states, with predicted responses."""

import dataclasses
import functools
import logging
from typing import Any, NamedTuple

import numpy as np

from snrmjax.doctor.column_misreadings import caveat, linear_damping_note, with_caveat
from snrmjax.identify.coupled.coupled_modes import other_mode_moves
from snrmjax.identify.coupled.coupled_test import CoupledDetails, coupled_details
from snrmjax.identify.inference.contributions import Contribution, contributions
from snrmjax.identify.inference.fitted_curves import fitted_values
from snrmjax.identify.inference.fitted_response import FittedResponse, fitted_response
from snrmjax.identify.inference.identification import (
    Identification,
    identification_of_fit,
    identify_backbone,
)
from snrmjax.identify.inference.optimal_design import NextMeasurements, next_measurements
from snrmjax.identify.joint.joint_fit import JointFit, corrected_states, fit_jointly
from snrmjax.identify.joint.notes import note_on_outlying
from snrmjax.identify.pointwise.backbone import BackboneValues
from snrmjax.identify.pointwise.prediction import PredictedResponse, Resonance
from snrmjax.identify.prediction.resonance_distribution import notes_on_negative_damping
from snrmjax.measure.states import SteadyStates, check_force, check_phases
from snrmjax.model.structures import Structure, driven_in_newtons
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError
from snrmjax.pipelines.options import COUPLED_MODES, IdentifyOptions, checked
from snrmjax.pipelines.predictions import (
    Note,
    Prediction,
    notes_on_predictions,
    predictions_of_fit,
    predictions_of_points,
    reach_of,
    require_drive,
)
from snrmjax.simulate.solutions.forced_response import ResponseCurve
from snrmjax.simulate.solutions.normal_modes import NormalModeBranch

_log = logging.getLogger(__name__)

BACKBONE_POINTS = 200
"""Number of amplitudes of the written curves."""

_CHECKED = 100  # amplitudes at which curves are checked for negative damping


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
    def responses(self) -> list[PredictedResponse]:
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

    State by state with curves through the points, or by one joint fit of all states where one of
    `fit`, `free` and `further` is stated.

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
    identified = (
        _by_joint_fit(data, model, alone) if options.is_joint else _by_points(data, model, alone)
    )
    if not coupled and (options.modes is not None or not other_mode_moves(data, model)):
        return identified
    forces = options.predict_force if coupled else ()
    # With the gain and the phase that a joint fit identified for the instruments.
    details = coupled_details(identified.data, model, identified.identification, forces)
    notes = _each_once((*identified.notes, *details.notes()))
    return identified._replace(options=options, coupled=details, notes=notes)


def _by_points(data: SteadyStates, model: Structure, options: IdentifyOptions) -> IdentifiedTest:
    check_phases(data, "an identification")
    check_force(data, "an identification state by state")
    try:
        identification = identify_backbone(
            data,
            model,
            amplitude=options.amplitude,
            measure=options.measure,
            n_knots=options.knots,
        )
    except InputError as error:
        raise with_caveat(error, data, model) from error
    backbone = identification.backbone
    predictions = predictions_of_points(identification, model, options)
    checked_curves = backbone.sampled(_CHECKED, reach=reach_of(options) if predictions else 1.0)
    notes = (
        *caveat(data, model, identification.points),
        *identification.notes,
        *notes_on_negative_damping(checked_curves),
        *notes_on_predictions(predictions, backbone, data),
    )
    values = backbone.sampled(BACKBONE_POINTS)
    return IdentifiedTest(
        data, model, options, identification, values, predictions, _each_once(notes)
    )


def _by_joint_fit(data: SteadyStates, model: Structure, options: IdentifyOptions) -> IdentifiedTest:
    names = (options.fit or "auto").split(",")
    if len(names) > 2:
        raise InputError(
            f"--fit takes one or two families, but {options.fit!r} names {len(names)}."
        )
    fitted = functools.partial(
        fit_jointly,
        data,
        model,
        backbone=names[0],
        damping=names[1] if len(names) == 2 else "auto",
        free=[name for several in options.free for name in several.split(",")],
    )
    _log.info("fits backbone and damping curves to %d states", len(data.frequency))
    fit = fitted(robust=options.robust or None)
    data = corrected_states(data, fit)
    identification = identification_of_fit(data, fit)
    predictions, trends = predictions_of_fit(fit, options)
    _log.info("compares further measurements")
    advice = next_measurements(fit, options.further) if options.further else None
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
    forces = sorted({one.force for one in advice or ()})
    responses = tuple(fitted_response(fit, force)[0] for force in forces)
    details = FitDetails(fit, tuple(contributions(fit)), advice, responses)
    ends = float(identification.backbone.smallest), float(identification.backbone.largest)
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
