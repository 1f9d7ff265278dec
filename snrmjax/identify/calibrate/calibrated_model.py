"""Result of a calibration: a model with fitted parameters and their covariance."""

from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from snrmjax.model.structures import Structure
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.levenberg_marquardt import MinimisationStatus
from snrmjax.numerics.result import AbstractResult, Variable, quantity, setting


class AbstractCalibration(AbstractResult):
    """A model with fitted parameters and their covariance.

    `covariance` and `std` are scaled by the reduced χ² where no noise is stated, or where the
    residuals contradict the stated noise.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("parameter",)

    model: Structure  # with the fitted values
    # SI units, rad/s for frequencies.
    values: Float[np.ndarray, " parameter"] = quantity("parameter", "SI", "value", name="value")
    covariance: Float[np.ndarray, "parameter parameter"] = quantity(
        "parameter other_parameter", "SI", "covariance of the values"
    )
    reduced_chi_square: float = setting()
    names: tuple[str, ...] = quantity("parameter", "", "name", name="parameter", static=True)
    noise_stated: bool = eqx.field(static=True)
    status: MinimisationStatus = setting()
    notes: tuple[Fact, ...] = setting()

    @property
    def std(self) -> Float[np.ndarray, " parameter"]:
        """1σ of the values."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def noise_scale(self) -> float:
        """Rms residual over the stated noise: the root of the reduced χ²."""
        return float(np.sqrt(self.reduced_chi_square))

    @property
    def converged(self) -> bool:
        """Whether the fit ended at a minimum."""
        return self.status.found_minimum

    @abstractmethod
    def data_in_words(self) -> str:
        """Number and kind of the data used."""

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`."""
        values = zip(self.names, self.values, self.std, strict=True)
        return (
            f"{type(self).__name__}: {len(self.names)} parameters from {self.data_in_words()} "
            f"({self.status})",
            *(f"{name} = {value:.6g} ± {std:.2g} (1σ)" for name, value, std in values),
            f"residuals {self.noise_scale:.3g} times the "
            f"{'stated' if self.noise_stated else 'assumed'} noise",
            *(f"note: {note}" for note in self.notes),
        )

    def variables(self) -> dict[str, Variable]:
        """Those of the fields, with 1σ of the values."""
        return {**super().variables(), "std": Variable(("parameter",), self.std, "SI", "1σ")}


class CalibratedModel(AbstractCalibration):
    """A model with parameters fitted to steady states; see `calibrate_model`.

    `residuals` are whitened: of unit variance if noise and model are right; NaN where nothing was
    measured or the state has no weight. A state's columns are real and imaginary parts of the
    force, of the other sensors' fundamentals and of the harmonics. `level_gain` and `level_phase`
    are the fitted errors common to all velocities of a level.
    """

    residuals: Float[np.ndarray, "state column"] = quantity(
        "state column", "1", "residual in units of 1σ", name="residual"
    )
    state_converged: Bool[np.ndarray, " state"] = quantity("state", "1", "has weight")
    level_gain: Float[np.ndarray, " level"] = quantity("level", "1", "velocities too large by")
    level_phase: Float[np.ndarray, " level"] = quantity("level", "deg", "velocities lead by")

    def data_in_words(self) -> str:
        """See `AbstractCalibration`."""
        return f"{int(np.sum(self.state_converged))} of {len(self.state_converged)} steady states"
