"""What a result is told with: predictions beside an identification, its figures, its report."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from snrmjax.identify.identification import Identification, identify_backbone
from snrmjax.identify.prediction import (
    CONTINUED,
    PredictedResponse,
    Resonance,
    predict_response,
    resonances,
)
from snrmjax.measure.steady_states import SteadyStates
from snrmjax.model.structure import Structure, equilibria
from snrmjax.simulate.forced_response import ResponseCurve
from snrmjax.simulate.normal_modes import NormalModeBranch


class Prediction(NamedTuple):
    """What the identified backbone says about one force."""

    force: float  # N
    resonances: list[Resonance]
    responses: list[PredictedResponse]


class Presentation(NamedTuple):
    """An identification with its predictions and, where it is known, the truth."""

    data: SteadyStates
    model: Structure
    identification: Identification
    predictions: tuple[Prediction, ...]
    notes: tuple[str, ...]
    truth: NormalModeBranch | None
    simulated: tuple[ResponseCurve, ...]


def present_identification(
    data: SteadyStates,
    model: Structure,
    forces: Sequence[float],
    *,
    truth: NormalModeBranch | None = None,
    simulated: Sequence[ResponseCurve] = (),
    **options: Any,
) -> Presentation:
    """Identify the mode of interest and predict its responses to some forces (N).

    `truth` and `simulated` are shown for comparison; `options` go to `identify_backbone`.
    """
    identification = identify_backbone(data, model.modes, **options)
    backbone = identification.fit.backbone
    predictions, notes = [], list(identification.notes)
    for force in forces:
        found = resonances(backbone, model.modes, force)
        responses = predict_response(backbone, model.modes, force)
        if not found:
            notes.append(
                f"no resonance at {force:g} N up to {CONTINUED:g} times the largest measured "
                "amplitude."
            )
        elif any(one.continued for one in found):
            notes.append(f"the resonance at {force:g} N lies beyond the measured amplitudes.")
        if len(found) > 1:
            notes.append(f"{len(found)} resonances at {force:g} N: the damping allows several.")
        predictions.append(Prediction(force, found, responses))
    return Presentation(
        data, model, identification, tuple(predictions), tuple(notes), truth, tuple(simulated)
    )


def equilibria_notes(model: Structure) -> list[str]:
    """A sentence when the structure has other equilibria than rest."""
    found = equilibria(model)
    others = [e for e in found if np.linalg.norm(e.displacement) > 0]
    if not others:
        return []
    shape = np.asarray(model.modes.mode_shape)
    listed = ", ".join(
        f"{'stable' if e.stable else 'unstable'} at q = {np.array2string(e.displacement, precision=3)}"
        f" ({model.modes.sensors[0]} {1e3 * (shape @ e.displacement)[0]:.3g} mm)"
        for e in others
    )
    return [f"the model has {len(others)} further equilibria: {listed}. Curves start from rest."]
