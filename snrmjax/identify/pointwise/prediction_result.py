"""What an identified backbone predicts: a resonance, or a response curve, under one force."""

from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Complex, Float

from snrmjax.numerics.facts import Fact
from snrmjax.numerics.result import AbstractResult, Variable, quantity


class Resonance(AbstractResult):
    """A phase resonance under a given force: the nonlinear mode moves in phase with it."""

    force: float = quantity("", "N", "force amplitude")
    amplitude: float  # of the backbone's argument, m or m/s
    frequency: float = quantity("", "Hz", "frequency")  # rad/s
    damping_ratio: float = quantity("", "1", "damping ratio")
    # At the backbone's sensor, residual modes included.
    velocity: float = quantity("", "m/s", "velocity amplitude")
    continued: bool = quantity("", "1", "beyond the measured amplitudes")


class PredictedResponse(AbstractResult):
    """One connected response curve in order: up the low-frequency side, down the other.

    `isolated` is a closed curve, apart from the main one.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("point",)

    force: float  # N
    frequency: Float[np.ndarray, " point"] = quantity("point", "Hz", "frequency")  # rad/s
    velocity: Complex[np.ndarray, " point"]  # m/s at the backbone's sensor
    amplitude: Float[np.ndarray, " point"]  # of the backbone's argument
    stable: Bool[np.ndarray, " point"] = quantity("point", "1", "whether the motion is stable")
    branch: tuple[str, ...]  # "lead" (velocity leads the force) or "lag" for every point
    continued: Bool[np.ndarray, " point"] = quantity("point", "1", "beyond the measured amplitudes")
    isolated: bool
    # Where it extrapolates the backbone, and what was not located.
    notes: tuple[Fact, ...]

    @property
    def note(self) -> str:
        """The notes in words."""
        return " ".join(map(str, self.notes))

    def variables(self) -> dict[str, Variable]:
        """Those of the fields, with both parts of the velocity."""
        point, real, imaginary = ("point",), self.velocity.real, self.velocity.imag
        return {
            "point": Variable(point, np.arange(len(real)), "1", "point along the curve"),
            **super().variables(),
            "velocity_re_m_s": Variable(point, real, "m/s", "velocity in phase"),
            "velocity_im_m_s": Variable(point, imaginary, "m/s", "velocity 90° ahead"),
        }

    def attributes(self) -> dict[str, str | float | int]:
        """The force, whether the curve is isolated, and notes."""
        return {"force_n": self.force, "isolated": int(self.isolated), "note": self.note}
