"""Results of fits of linear modes: poles, residues and residual terms with their errors."""

from abc import abstractmethod
from typing import ClassVar, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from snrmjax.identify.modal.pole_orders import PoleOrders
from snrmjax.identify.modal.response_data import ErrorSource
from snrmjax.measure.recordings.channels import Channel
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.levenberg_marquardt import MinimisationStatus
from snrmjax.numerics.result import AbstractResult, Variable, quantity, setting
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

WIDE = 1.96
"""Standard deviations of a 95 % band."""
REAL = 0.9
"""Phase collinearity below which a mode is called complex."""


class ResponseCurves(NamedTuple):
    """Measured and fitted receptances, SI."""

    omega: Float[np.ndarray, " line"]  # rad/s
    measured: Complex[np.ndarray, "sensor line"]  # NaN where not measured
    fitted: Complex[np.ndarray, "sensor line"]
    std: Float[np.ndarray, "sensor line"]  # 1σ of real and of imaginary part, used as weights


class AbstractModalFit(AbstractResult):
    """Fitted linear modes in order of frequency, with their errors.

    `mode_covariance` of a mode starts with natural frequency (rad/s) and damping ratio.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("mode", "sensor")

    natural_frequency: Float[np.ndarray, " mode"] = quantity("mode", "Hz", "natural frequency")
    damping_ratio: Float[np.ndarray, " mode"] = quantity("mode", "1", "damping ratio")
    mode_covariance: Float[np.ndarray, "mode entry entry"]
    # 1 for a real mode, NaN for one sensor.
    collinearity: Float[np.ndarray, " mode"] = quantity(
        "mode", "1", "modal phase collinearity", name="phase_collinearity"
    )
    orders: PoleOrders
    sensors: tuple[Channel, ...] = eqx.field(static=True)
    status: MinimisationStatus = setting()
    notes: tuple[Fact | str, ...] = setting()

    @property
    def n_modes(self) -> int:
        """Number of modes."""
        return len(self.natural_frequency)

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """Names of the responses in order."""
        return tuple(sensor.name for sensor in self.sensors)

    @property
    def natural_frequency_std(self) -> Float[np.ndarray, " mode"]:
        """1σ, rad/s."""
        return np.sqrt(self.mode_covariance[:, 0, 0])

    @property
    def damping_ratio_std(self) -> Float[np.ndarray, " mode"]:
        """1σ."""
        return np.sqrt(self.mode_covariance[:, 1, 1])

    @abstractmethod
    def source_in_words(self) -> str:
        """The data that the modes were fitted to."""

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`; 95 % bands."""
        rows = zip(
            self.natural_frequency / HERTZ,
            WIDE * self.natural_frequency_std / HERTZ,
            100 * self.damping_ratio,
            WIDE * 100 * self.damping_ratio_std,
            strict=True,
        )
        return (
            f"{type(self).__name__}: {self.n_modes} modes {self.source_in_words()}, "
            f"{self.status.value}",
            *(
                f"mode {k + 1}: {f:.7g} ± {df:.2g} Hz, damping {z:.4g} ± {dz:.2g} %"
                for k, (f, df, z, dz) in enumerate(rows)
            ),
            *(f"note: {note}" for note in self.notes),
        )

    def variables(self) -> dict[str, Variable]:
        """Those of the fields, with errors, by mode and sensor."""
        mode, hertz = ("mode",), self.natural_frequency_std / HERTZ
        return {
            "mode": Variable(mode, np.arange(1, self.n_modes + 1), "1", "mode"),
            "sensor": Variable(("sensor",), np.array(self.sensor_names), "", "sensor"),
            **super().variables(),
            "natural_frequency_std_hz": Variable(mode, hertz, "Hz", "its 1σ"),
            "damping_ratio_std": Variable(mode, self.damping_ratio_std, "1", "its 1σ"),
        }


def phase_collinearity(
    shape: Complex[np.ndarray, "sensor mode"],
) -> tuple[Float[np.ndarray, " mode"], Float[np.ndarray, " mode"]]:
    """Modal phase collinearity, NaN for one sensor, and the mean phase (rad) of the shape.

    Reference: Pappa, Elliott & Schenk, J. Guid. Control Dyn. 16 (1993) 860, doi:10.2514/3.21092.
    """
    a, b = shape.real, shape.imag
    xx, yy, xy = np.sum(a * a, axis=0), np.sum(b * b, axis=0), np.sum(a * b, axis=0)
    collinearity = ((xx - yy) ** 2 + 4 * xy**2) / np.maximum(xx + yy, 1e-300) ** 2
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)
    return collinearity if len(shape) > 1 else np.full(shape.shape[1], np.nan), angle


class LinearModalFit(AbstractModalFit):
    """Linear modes from frequency responses over one reference; see `fit_linear_modes`.

    H = e^{iψ} [Σ residue/(ω² − Ω² + 2iζωΩ) + lower/Ω² + upper] is a displacement over the
    reference. Over a force in N a residue is φ_sensor φ_driven in 1/kg. `mode_covariance`
    continues with the residues of all sensors.
    """

    residue: Float[np.ndarray, "sensor mode"]  # displacement over reference, times s^-2
    lower: Float[np.ndarray, " sensor"]  # of 1/Ω²; 0 where it was not fitted
    lower_std: Float[np.ndarray, " sensor"]
    upper: Float[np.ndarray, " sensor"] = quantity(
        "sensor", "SI", "constant receptance", name="upper_residual"
    )
    upper_std: Float[np.ndarray, " sensor"] = quantity(
        "sensor", "SI", "its 1σ", name="upper_residual_std"
    )
    phase: float  # rad, ψ of the instrument; 0 where it was not fitted
    phase_std: float
    # Deviation from real residues.
    mean_phase: Float[np.ndarray, " mode"] = quantity("mode", "deg", "phase of complex residues")
    mean_phase_std: Float[np.ndarray, " mode"]
    lines_in_band: Float[np.ndarray, " mode"] = quantity(
        "mode", "1", "lines in the half-power band", name="lines_in_half_power_band"
    )
    # NaN where none is stated.
    misfit: Float[np.ndarray, " sensor"] = quantity("sensor", "1", "rms residual over stated 1σ")
    curves: ResponseCurves
    reference: Channel = eqx.field(static=True)
    source: ErrorSource = eqx.field(static=True)

    @property
    def residue_std(self) -> Float[np.ndarray, "sensor mode"]:
        """1σ of the residues."""
        return np.sqrt(np.diagonal(self.mode_covariance, axis1=1, axis2=2)[:, 2:]).T

    def sensor_number(self, name: str) -> int:
        """Index of a sensor. Raises `ValueError` with the available names."""
        if name not in self.sensor_names:
            raise InputError(
                f"there is no sensor {name!r}; there are {', '.join(self.sensor_names)}."
            )
        return self.sensor_names.index(name)

    def source_in_words(self) -> str:
        """See `AbstractModalFit`."""
        omega = self.curves.omega / HERTZ
        return (
            f"at {len(self.sensors)} sensors over {self.reference.name}, {omega[0]:.6g} to "
            f"{omega[-1]:.6g} Hz"
        )

    def variables(self) -> dict[str, Variable]:
        """Those of the fields, with residues and residual terms in the reference's unit."""
        both, sensor = ("sensor", "mode"), ("sensor",)
        unit = "1/kg" if self.reference.quantity == "force" else "SI"
        return {
            **super().variables(),
            "residue": Variable(both, self.residue, unit, "residue of the receptance"),
            "residue_std": Variable(both, self.residue_std, unit, "its 1σ"),
            "lower_residual": Variable(sensor, self.lower, unit, "coefficient of 1/Ω²"),
            "lower_residual_std": Variable(sensor, self.lower_std, unit, "its 1σ"),
        }

    def attributes(self) -> dict[str, str | float | int]:
        """The reference, the source of the errors, status and notes of the fit."""
        more = {"reference": self.reference.name, "errors_from": self.source}
        return {**super().attributes(), **more}
