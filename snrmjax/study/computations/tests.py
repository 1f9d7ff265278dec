"""Tests of every member: virtual tests, identifications, diagnoses."""

from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from snrmjax.diagnose.diagnosis import diagnose_model
from snrmjax.diagnose.verdict import answer_of
from snrmjax.identify.inference.identification import Identification, identify_backbone
from snrmjax.identify.pointwise.inversion import PointStatus
from snrmjax.measure.states import SteadyStates
from snrmjax.model.modes import LinearModes, reference_sensor
from snrmjax.model.structures import Structure
from snrmjax.numerics.units import HERTZ
from snrmjax.simulate.virtual_test.phase_resonance_test import phase_resonance_test
from snrmjax.simulate.virtual_test.recording import NO_ERRORS, MeasurementErrors, Recording
from snrmjax.study.computations.base import (
    MEMBER,
    TEXT,
    AbstractSingly,
    Axis,
    MemberStatus,
    Output,
)
from snrmjax.study.computations.responses import ResponseRange

FRACTION = "relative_amplitude"
_POINTS = 11  # of a curve over the measured range
_CURVE = (MEMBER, FRACTION)
_OUTPUTS = {
    "status": Output((MEMBER,), TEXT, "", "solved, or why not"),
    "n_states": Output((MEMBER,), "i4", "1", "steady states of the test"),
    "n_solved": Output((MEMBER,), "i4", "1", "steady states that the inverse method solved"),
    "velocity_m_s": Output(_CURVE, "f8", "m/s", "velocity on the backbone", True),
    "natural_frequency_hz": Output(_CURVE, "f8", "Hz", "natural frequency"),
    "natural_frequency_std_hz": Output(_CURVE, "f8", "Hz", "its standard deviation"),
    "damping_ratio": Output(_CURVE, "f8", "1", "damping ratio"),
    "damping_ratio_std": Output(_CURVE, "f8", "1", "its standard deviation"),
}


class AbstractIdentified(AbstractSingly):
    """Backbone and damping by the pointwise inverse method, at fractions of the amplitude range."""

    def outputs(self) -> dict[str, Output]:
        """See `AbstractComputation.outputs`."""
        return _OUTPUTS

    def axes(self) -> dict[str, Axis]:
        """See `AbstractComputation.axes`."""
        text = "place between the smallest (0) and the largest (1) measured amplitude"
        return {FRACTION: Axis(np.linspace(0.0, 1.0, _POINTS), "1", text)}

    def sensor(self, modes: LinearModes) -> str:
        """The sensor with the largest shape of the mode of interest."""
        return modes.sensors[reference_sensor(modes)]

    def identified(self, data: SteadyStates, model: Structure) -> dict[str, np.ndarray]:
        """One member's row."""
        identification: Identification = identify_backbone(data, model)
        backbone, status = identification.backbone, np.asarray(identification.points.status)
        values = backbone.sampled(_POINTS)
        row = {
            "velocity_m_s": values.velocity,
            "natural_frequency_hz": np.asarray(values.natural_frequency) / HERTZ,
            "natural_frequency_std_hz": np.asarray(values.natural_frequency_std) / HERTZ,
            "damping_ratio": values.damping_ratio,
            "damping_ratio_std": values.damping_ratio_std,
        }
        return {
            "status": np.array([MemberStatus.SOLVED]),
            "n_states": np.array([data.n_states], dtype="i4"),
            "n_solved": np.array([np.sum(status == PointStatus.OK)], dtype="i4"),
            **{name: np.asarray(one)[None] for name, one in row.items()},
        }


class VirtualTests(AbstractIdentified):
    """A virtual near-resonance test of every member with its own noise, and its identification.

    `levels` are the forces of the test in N.
    """

    kind: ClassVar[str] = "virtual_test"
    members_a_chunk: ClassVar[int] = 8

    within: ResponseRange
    levels: Float[np.ndarray, " level"]
    errors: MeasurementErrors = NO_ERRORS
    points_per_level: int = eqx.field(static=True, default=5)

    def member(self, model: Structure, force: np.ndarray | None, seed: int) -> dict:
        """See `AbstractSingly.member`."""
        test = phase_resonance_test(
            model,
            self.levels,
            *self.within.ends,
            points_per_level=self.points_per_level,
            recording=Recording(self.errors, seed=seed),
        )
        return self.identified(test.steady_states, model)


class Identifications(AbstractIdentified):
    """The same measured steady states identified with the linear modes of every member."""

    kind: ClassVar[str] = "identify"
    members_a_chunk: ClassVar[int] = 16

    data: SteadyStates

    def member(self, model: Structure, force: np.ndarray | None, seed: int) -> dict:
        """See `AbstractSingly.member`."""
        return self.identified(self.data, model)


class Diagnoses(AbstractSingly):
    """The same measured steady states diagnosed against the model of every member."""

    kind: ClassVar[str] = "diagnose"
    members_a_chunk: ClassVar[int] = 4

    data: SteadyStates

    def outputs(self) -> dict[str, Output]:
        """See `AbstractComputation.outputs`."""
        at = (MEMBER,)
        return {
            "status": Output(at, TEXT, "", "answered, or why not"),
            "verdict": Output(at, TEXT, "", "none, named, drawn, ambiguous, unknown, …"),
            "effects": Output(at, TEXT, "", "the best single answer, joined by +"),
            "probability": Output(at, "f8", "1", "of that answer"),
            "gap_before": Output(at, "f8", "1", "misfit in units of the noise, model as given"),
            "gap_after": Output(at, "f8", "1", "the same with the effects"),
        }

    def member(self, model: Structure, force: np.ndarray | None, seed: int) -> dict:
        """See `AbstractSingly.member`."""
        diagnosis = diagnose_model(model, self.data)
        answer = answer_of(diagnosis.effects)
        return {
            "status": np.array([MemberStatus.ANSWERED]),
            "verdict": np.array([str(diagnosis.verdict.value)]),
            "effects": np.array(["+".join(diagnosis.effects)]),
            "probability": np.array([diagnosis.answer.probabilities.get(answer, np.nan)]),
            "gap_before": np.array([diagnosis.gap.before]),
            "gap_after": np.array([diagnosis.gap.after]),
        }
