"""What a calibration finds: a model with fitted parameters, and how well they are known."""

from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from snrmjax.model.structures import Structure
from snrmjax.numerics.levenberg_marquardt import MinimisationStatus
from snrmjax.numerics.result import AbstractResult, Variable


class CalibratedModel(AbstractResult):
    """A model with fitted parameters, and how well they are known.

    `residuals` are whitened: of unit variance if noise and model are right; NaN where nothing was
    measured or the state has no weight. A state's columns are real and imaginary parts of the
    force, of the other sensors' fundamentals and of the harmonics. `covariance` and `std` are
    widened by `noise_scale` where no noise is stated or where the residuals contradict it. What a
    level shares is by how much its velocities were found to be too large and to lead.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("parameter",)

    model: Structure  # with the fitted values, and their 1σ where it has a place for them
    values: Float[np.ndarray, " parameter"]
    covariance: Float[np.ndarray, "parameter parameter"]
    residuals: Float[np.ndarray, "state column"]
    state_converged: Bool[np.ndarray, " state"]
    level_gain: Float[np.ndarray, " level"]  # relative
    level_phase: Float[np.ndarray, " level"]  # rad
    reduced_chi_square: float
    names: tuple[str, ...] = eqx.field(static=True)
    noise_stated: bool = eqx.field(static=True)
    status: MinimisationStatus = eqx.field(static=True)
    notes: tuple[str, ...] = eqx.field(static=True)

    @property
    def std(self) -> Float[np.ndarray, " parameter"]:
        """1σ of the values."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def noise_scale(self) -> float:
        """The residuals over the stated noise: the root of the reduced χ²."""
        return float(np.sqrt(self.reduced_chi_square))

    @property
    def converged(self) -> bool:
        """Whether the fit ended at a minimum."""
        return self.status.found_minimum

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`."""
        n, used = len(self.state_converged), int(np.sum(self.state_converged))
        values = zip(self.names, self.values, self.std, strict=True)
        return (
            f"CalibratedModel: {len(self.names)} parameters from {used} of {n} steady states "
            f"({self.status})",
            *(f"{name} = {value:.6g} ± {std:.2g} (1σ)" for name, value, std in values),
            f"residuals {self.noise_scale:.3g} times the "
            f"{'stated' if self.noise_stated else 'assumed'} noise",
            *(f"note: {note}" for note in self.notes),
        )

    def variables(self) -> dict[str, Variable]:
        """See `AbstractResult`; values in the SI units of each parameter, rad/s for frequencies."""
        across, states = ("parameter", "other_parameter"), ("state", "column")
        unit = "SI"
        return {
            "parameter": Variable(("parameter",), np.array(self.names), "", "parameter"),
            "value": Variable(("parameter",), self.values, unit, "fitted value"),
            "std": Variable(("parameter",), self.std, unit, "1σ"),
            "covariance": Variable(across, self.covariance, unit, "covariance of the values"),
            "residual": Variable(states, self.residuals, "1", "residual in units of 1σ"),
            "state_converged": Variable(("state",), self.state_converged, "1", "has weight"),
            "level_gain": Variable(("level",), self.level_gain, "1", "velocities too large by"),
            "level_phase_deg": Variable(
                ("level",), np.degrees(self.level_phase), "deg", "velocities lead by"
            ),
        }

    def attributes(self) -> dict[str, str | float | int]:
        """See `AbstractResult`."""
        return {
            "status": str(self.status),
            "reduced_chi_square": self.reduced_chi_square,
            "notes": "\n".join(self.notes),
        }
