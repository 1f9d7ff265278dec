"""Nonlinear normal modes of the members, and their damped modes."""

from typing import ClassVar

import equinox as eqx
import numpy as np

from snrmjax.model.structures import Structure
from snrmjax.numerics.units import HERTZ
from snrmjax.simulate.continuation.continuation import CurveStatus
from snrmjax.simulate.solutions.controlled import damped_normal_mode
from snrmjax.simulate.solutions.normal_modes import nonlinear_normal_mode
from snrmjax.study.computations.base import (
    MEMBER,
    TEXT,
    AbstractSingly,
    MemberStatus,
    Output,
)

_AT = ("point",)
_SUMMARY = {
    "status": Output((MEMBER,), TEXT, "", "how the mode ended"),
    "n_points": Output((MEMBER,), "i4", "1", "points of the mode"),
    "end_frequency_hz": Output((MEMBER,), "f8", "Hz", "frequency of the last point"),
    "end_velocity_m_s": Output((MEMBER,), "f8", "m/s", "velocity of the last point", True),
    "point_frequency_hz": Output(_AT, "f8", "Hz", "natural frequency"),
    "point_velocity_m_s": Output(_AT, "f8", "m/s", "velocity fundamental", True),
}


class AbstractModes(AbstractSingly):
    """A nonlinear mode of every member, point by point."""

    members_a_chunk: ClassVar[int] = 32
    further: ClassVar[
        tuple[str, str, str]
    ]  # output of a point in addition to frequency and velocity

    def outputs(self) -> dict[str, Output]:
        """See `AbstractComputation.outputs`."""
        name, unit, meaning = self.further
        return {**_SUMMARY, name: Output(_AT, "f8", unit, meaning)}


class NormalModes(AbstractModes):
    """The undamped nonlinear normal mode of interest up to a frequency (rad/s)."""

    kind: ClassVar[str] = "nnm"
    further: ClassVar[tuple[str, str, str]] = ("point_energy_j", "J", "energy of the motion")

    to_frequency: float
    harmonic_order: int = eqx.field(static=True, default=9)

    def member(self, model: Structure, force: np.ndarray | None, seed: int) -> dict:
        """See `AbstractSingly.member`."""
        mode = nonlinear_normal_mode(
            model, self.to_frequency, harmonic_order=self.harmonic_order, stability=False
        )
        speed = np.abs(mode.velocity[:, 1, 0])
        return {**_rows(mode.status, mode.frequency, speed), "point_energy_j": mode.energy}


class DampedModes(AbstractModes):
    """The damped nonlinear mode of interest up to a velocity (m/s) at the sensor."""

    kind: ClassVar[str] = "damped_nnm"
    further: ClassVar[tuple[str, str, str]] = ("point_damping_ratio", "1", "damping ratio")

    largest_velocity: float
    harmonic_order: int = eqx.field(static=True, default=9)

    def member(self, model: Structure, force: np.ndarray | None, seed: int) -> dict:
        """See `AbstractSingly.member`."""
        mode = damped_normal_mode(model, self.largest_velocity, harmonic_order=self.harmonic_order)
        rows = _rows(mode.status, mode.frequency, np.abs(mode.velocity[:, 1, 0]))
        if mode.status == CurveStatus.AMPLITUDE_LIMIT:  # as requested: a whole mode
            rows["status"] = np.array([MemberStatus.LARGEST_VELOCITY])
        return {**rows, "point_damping_ratio": mode.damping_ratio}


def _rows(status: CurveStatus, frequency: np.ndarray, speed: np.ndarray) -> dict:
    last = (frequency[-1] / HERTZ, speed[-1]) if len(frequency) else (np.nan, np.nan)
    return {
        "status": np.array([status.name.lower()]),
        "n_points": np.array([len(frequency)], dtype="i4"),
        "end_frequency_hz": np.array([last[0]]),
        "end_velocity_m_s": np.array([last[1]]),
        "point_frequency_hz": frequency / HERTZ,
        "point_velocity_m_s": speed,
    }
