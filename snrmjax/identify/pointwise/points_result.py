"""Points of the backbone and of the damping, one from each steady state."""

from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from snrmjax.identify.curves.family_base import Argument
from snrmjax.identify.pointwise.inversion_result import PointStatus
from snrmjax.numerics.compiled import as_numpy
from snrmjax.numerics.result import AbstractResult, Variable, quantity, setting


class BackbonePoints(AbstractResult):
    """One natural frequency and damping ratio from every steady state.

    Amplitudes are those of the nonlinear mode at one sensor, `sensor`. Standard deviations (1σ)
    are NaN where no noise is stated. `alternative_…` is what amplitude and phase alone would also
    allow; NaN where there is no other root.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("state", "level")

    level: Int[Array, " state"] = quantity("state", "1", "level of the test")
    frequency: Float[Array, " state"] = quantity("state", "Hz", "forcing frequency")  # rad/s
    force: Float[Array, " state"] = quantity("state", "N", "force amplitude")
    velocity: Complex[Array, " state"]  # m/s as measured, residual modes included
    appropriation: Float[Array, " state"] = quantity(
        "state", "1", "appropriation indicator, Eq. (20)", name="nnmai"
    )
    mode_velocity: Complex[Array, " state"]  # m/s, of the nonlinear mode alone
    natural_frequency: Float[Array, " state"] = quantity("state", "Hz", "natural frequency")
    natural_frequency_std: Float[Array, " state"] = quantity("state", "Hz", "its 1σ")
    damping_ratio: Float[Array, " state"] = quantity("state", "1", "damping ratio")
    damping_ratio_std: Float[Array, " state"] = quantity("state", "1", "its 1σ")
    amplitude: Float[Array, " state"]  # m or m/s, the argument of the backbone
    backbone_velocity: Float[Array, " state"] = quantity(
        "state", "m/s", "velocity amplitude where the point lies on the backbone"
    )
    alternative_natural_frequency: Float[Array, " state"]  # rad/s
    alternative_damping_ratio: Float[Array, " state"]
    sensitivity: Float[Array, "state output input"]  # of ω̃², 2ζ̃ω̃, log amplitude to `INPUTS`
    relative_std: Float[Array, "state input"]  # 1σ of `INPUTS`
    filter_residual: Float[Array, " state"]  # part of the mode's motion that its shape misses
    status: Int[Array, " state"] = quantity("state", "", "outcome", of=PointStatus)
    sensor: str = setting()
    argument: Argument = eqx.field(static=True)

    def variables(self) -> dict[str, Variable]:
        """Those of the fields, with the measured velocity's magnitude and phase."""
        velocity = np.asarray(self.velocity)
        phase = np.degrees(np.angle(velocity))
        return {
            "state": Variable(("state",), np.arange(len(velocity)), "1", "steady state"),
            **super().variables(),
            "velocity_m_s": Variable(("state",), np.abs(velocity), "m/s", "velocity amplitude"),
            "phase_deg": Variable(("state",), phase, "deg", "velocity phase to the force"),
        }

    def attributes(self) -> dict[str, str | float | int]:
        """The sensor, and the amplitude at which frequencies and dampings belong."""
        return {**super().attributes(), "amplitude": self.argument}

    @property
    def modal_damping(self) -> Float[Array, " state"]:
        """2ζ̃ω̃ in 1/s."""
        return 2 * as_numpy(self.damping_ratio) * as_numpy(self.natural_frequency)

    @property
    def usable(self) -> Array:
        """Points that enter curves: solved, and solved without doubt."""
        return as_numpy(self.status) == int(PointStatus.OK)
