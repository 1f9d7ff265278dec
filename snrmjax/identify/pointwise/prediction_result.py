"""What an identified backbone predicts: a resonance, or a response curve, under one force."""

from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Complex, Float

from snrmjax.identify.pointwise.inversion_result import spans
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.result import AbstractResult, Variable

_HERTZ = 2 * np.pi


class Resonance(AbstractResult):
    """A phase resonance under a given force: the nonlinear mode moves in phase with it."""

    force: float  # N
    amplitude: float  # of the backbone's argument, m or m/s
    frequency: float  # rad/s
    damping_ratio: float
    velocity: float  # m/s at the backbone's sensor, residual modes included
    continued: bool  # beyond the measured amplitudes

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`."""
        where = "beyond the measured amplitudes" if self.continued else "as far as was measured"
        return (
            f"Resonance under {self.force:.4g} N at {self.frequency / _HERTZ:.6g} Hz",
            f"velocity {self.velocity:.4g} m/s, damping ratio {100 * self.damping_ratio:.4g} %",
            where,
        )

    def variables(self) -> dict[str, Variable]:
        """See `AbstractResult`."""
        return {
            "force_n": Variable((), self.force, "N", "force amplitude"),
            "frequency_hz": Variable((), self.frequency / _HERTZ, "Hz", "frequency"),
            "velocity_m_s": Variable((), self.velocity, "m/s", "velocity amplitude"),
            "damping_ratio": Variable((), self.damping_ratio, "1", "damping ratio"),
            "continued": Variable((), self.continued, "1", "beyond the measured amplitudes"),
        }


class PredictedResponse(AbstractResult):
    """One connected response curve in order: up the low-frequency side, down the other."""

    coordinates: ClassVar[tuple[str, ...]] = ("point",)

    force: float  # N
    frequency: Float[np.ndarray, " point"]  # rad/s
    velocity: Complex[np.ndarray, " point"]  # m/s at the backbone's sensor
    amplitude: Float[np.ndarray, " point"]  # of the backbone's argument
    stable: Bool[np.ndarray, " point"]
    branch: tuple[str, ...]  # "lead" (velocity leads the force) or "lag" for every point
    continued: Bool[np.ndarray, " point"]  # beyond the measured amplitudes
    isolated: bool  # a closed curve, apart from the main one
    notes: tuple[Fact, ...]  # where it extrapolates the backbone, and what is not located

    @property
    def note(self) -> str:
        """The notes in words."""
        return " ".join(map(str, self.notes))

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`."""
        kind = "isolated curve" if self.isolated else "main curve"
        lines = [
            f"PredictedResponse under {self.force:.4g} N: {kind} of {len(self.frequency)} points",
            f"{spans(np.asarray(self.frequency) / _HERTZ)} Hz",
            f"velocity {spans(np.abs(self.velocity))} m/s",
            f"{int(np.sum(~np.asarray(self.stable)))} points unstable",
        ]
        return (*lines, self.note) if self.note else tuple(lines)

    def variables(self) -> dict[str, Variable]:
        """See `AbstractResult`; the columns of `prediction.csv`."""

        def column(values: np.ndarray, unit: str, meaning: str) -> Variable:
            return Variable(("point",), np.asarray(values), unit, meaning)

        return {
            "point": column(np.arange(len(self.frequency)), "1", "point along the curve"),
            "frequency_hz": column(np.asarray(self.frequency) / _HERTZ, "Hz", "frequency"),
            "velocity_re_m_s": column(self.velocity.real, "m/s", "velocity in phase"),
            "velocity_im_m_s": column(self.velocity.imag, "m/s", "velocity 90° ahead"),
            "stable": column(self.stable, "1", "whether the motion is stable"),
            "continued": column(self.continued, "1", "beyond the measured amplitudes"),
        }

    def attributes(self) -> dict[str, str | float | int]:
        """See `AbstractResult`."""
        return {"force_n": self.force, "isolated": int(self.isolated), "note": self.note}
