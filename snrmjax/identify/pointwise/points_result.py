"""Points of the backbone and of the damping, one from each steady state."""

from typing import ClassVar, Literal

import equinox as eqx
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from snrmjax.identify.pointwise.inversion_result import (
    PointStatus,
    spans,
    status_names,
    statuses_in_words,
)
from snrmjax.numerics.result import AbstractResult, Variable

AmplitudeArgument = Literal["displacement", "velocity"]

_HERTZ = 2 * np.pi


class BackbonePoints(AbstractResult):
    """One natural frequency and damping ratio from every steady state.

    Amplitudes are those of the nonlinear mode at one sensor, `sensor`. Standard deviations (1σ)
    are NaN where no noise is stated. `alternative_…` is what amplitude and phase alone would also
    allow; NaN where there is no other root.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("state", "level")

    level: Int[Array, " state"]  # of the test
    frequency: Float[Array, " state"]  # rad/s, of the force
    force: Float[Array, " state"]  # N
    velocity: Complex[Array, " state"]  # m/s as measured, residual modes included
    appropriation: Float[Array, " state"]  # Eq. (20)
    mode_velocity: Complex[Array, " state"]  # m/s, of the nonlinear mode alone
    natural_frequency: Float[Array, " state"]  # rad/s
    natural_frequency_std: Float[Array, " state"]
    damping_ratio: Float[Array, " state"]
    damping_ratio_std: Float[Array, " state"]
    amplitude: Float[Array, " state"]  # m or m/s, the argument of the backbone
    backbone_velocity: Float[Array, " state"]  # m/s, where the point lies on the backbone
    alternative_natural_frequency: Float[Array, " state"]  # rad/s
    alternative_damping_ratio: Float[Array, " state"]
    sensitivity: Float[Array, "state output input"]  # of ω̃², 2ζ̃ω̃, log amplitude to `INPUTS`
    relative_std: Float[Array, "state input"]  # 1σ of `INPUTS`
    linear_variance: Float[Array, "state output"]  # from the other linear modes' stated errors
    filter_residual: Float[Array, " state"]  # part of the mode's motion that its shape misses
    status: Int[Array, " state"]  # `PointStatus`
    sensor: str = eqx.field(static=True)
    argument: AmplitudeArgument = eqx.field(static=True)

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`."""
        stated = np.isfinite(np.asarray(self.natural_frequency_std))
        n_levels = len(np.unique(np.asarray(self.level)))
        return (
            f"BackbonePoints: {len(self.status)} steady states of {n_levels} levels at "
            f"{self.sensor!r} ({statuses_in_words(self.status)})",
            f"natural frequency {spans(np.asarray(self.natural_frequency) / _HERTZ)} Hz",
            f"damping ratio {spans(100 * np.asarray(self.damping_ratio))} %",
            f"velocity on the backbone {spans(self.backbone_velocity)} m/s",
            f"standard deviations of {int(stated.sum())} points",
        )

    def variables(self) -> dict[str, Variable]:
        """See `AbstractResult`; the columns of `points.csv`."""

        def column(values: Array | np.ndarray, unit: str, meaning: str) -> Variable:
            return Variable(("state",), np.asarray(values), unit, meaning)

        natural, velocity = np.asarray(self.natural_frequency), np.asarray(self.velocity)
        natural_std = np.asarray(self.natural_frequency_std)
        phase = np.degrees(np.angle(velocity))
        return {
            "state": column(np.arange(len(natural)), "1", "steady state"),
            "level": column(self.level, "1", "level of the test"),
            "frequency_hz": column(np.asarray(self.frequency) / _HERTZ, "Hz", "forcing frequency"),
            "force_n": column(self.force, "N", "force amplitude"),
            "velocity_m_s": column(np.abs(velocity), "m/s", "velocity amplitude"),
            "phase_deg": column(phase, "deg", "velocity phase relative to the force"),
            "nnmai": column(self.appropriation, "1", "appropriation indicator"),
            "natural_frequency_hz": column(natural / _HERTZ, "Hz", "natural frequency"),
            "natural_frequency_std_hz": column(natural_std / _HERTZ, "Hz", "its 1σ"),
            "damping_ratio": column(self.damping_ratio, "1", "damping ratio"),
            "damping_ratio_std": column(self.damping_ratio_std, "1", "its 1σ"),
            "backbone_velocity_m_s": column(
                self.backbone_velocity, "m/s", "velocity amplitude on the backbone"
            ),
            "status": column(status_names(self.status), "", "what became of the inversion"),
        }

    def attributes(self) -> dict[str, str | float | int]:
        """See `AbstractResult`."""
        return {"sensor": self.sensor, "amplitude": self.argument}

    @property
    def modal_damping(self) -> Float[Array, " state"]:
        """2ζ̃ω̃ in 1/s."""
        return 2 * self.damping_ratio * self.natural_frequency

    @property
    def usable(self) -> Array:
        """Points that enter curves: solved, and solved without doubt."""
        return self.status == int(PointStatus.OK)
