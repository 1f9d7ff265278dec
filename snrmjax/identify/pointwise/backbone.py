"""A mode's natural frequency and damping as curves of its amplitude, with one band."""

import dataclasses
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.identify.curves.family_base import AbstractCurve, Argument
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.result import AbstractResult, Variable, quantity

_SAMPLES = 200  # as many as in the files written: one compiled function serves both


class BackboneValues(AbstractResult):
    """A backbone at given amplitudes, with 1σ."""

    coordinates: ClassVar[tuple[str, ...]] = ("velocity_m_s",)

    velocity: Float[Array, " point"] = quantity("velocity_m_s", "m/s", "velocity amplitude")
    natural_frequency: Float[Array, " point"] = quantity("velocity_m_s", "Hz", "natural frequency")
    natural_frequency_std: Float[Array, " point"] = quantity("velocity_m_s", "Hz", "its 1σ")
    damping_ratio: Float[Array, " point"] = quantity("velocity_m_s", "1", "damping ratio")
    damping_ratio_std: Float[Array, " point"] = quantity("velocity_m_s", "1", "its 1σ")
    modal_damping: Float[Array, " point"] = quantity(
        "velocity_m_s", "1/s", "modal damping 2ζω", name="modal_damping_1_s"
    )
    modal_damping_std: Float[Array, " point"] = quantity(
        "velocity_m_s", "1/s", "its 1σ", name="modal_damping_std_1_s"
    )


class Backbone(AbstractResult):
    """ω̃ and ζ̃ of one mode as functions of the amplitude of its motion at one sensor.

    `squared_frequency` is ω̃² (rad²/s²) and `modal_damping` 2ζ̃ω̃ (1/s), against the
    displacement (m) or the velocity (m/s) amplitude, depending on `argument`; `covariance` is
    that of the parameters of the first, then of the second. The curves are differentiable with
    respect to amplitude and parameters.
    """

    squared_frequency: AbstractCurve
    modal_damping: AbstractCurve
    covariance: Float[Array, "parameter parameter"]
    modal_constant: Float[Array, ""]  # Φ_r Φᵀb, 1/kg: acceleration per newton at resonance
    smallest: Float[Array, ""]  # amplitude of the smallest state used
    largest: Float[Array, ""]  # amplitude of the largest state used
    argument: Argument = eqx.field(static=True)
    sensor: str = eqx.field(static=True)
    coordinates: ClassVar[tuple[str, ...]] = ("velocity_m_s",)

    def variables(self) -> dict[str, Variable]:
        """Those between the smallest and the largest measured amplitude."""
        return dict(self.sampled().variables())

    def attributes(self) -> dict[str, str | float | int]:
        """The sensor, and the amplitude that the curves are functions of."""
        return {"sensor": self.sensor, "amplitude": self.argument}

    def moved_by(self, ratio: float) -> "Backbone":
        """The same mode with its modal constant scaled, as for a force at another position."""
        return dataclasses.replace(self, modal_constant=self.modal_constant * ratio)

    def sampled(self, n_points: int = _SAMPLES, *, reach: float = 1.0) -> BackboneValues:
        """Values from the smallest to `reach` times the largest measured amplitude."""
        ends = float(self.smallest), reach * float(self.largest)
        return self.values(np.linspace(*ends, n_points))

    @compiled
    def natural_frequency(self, amplitude: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """ω̃ in rad/s."""
        squared = self.squared_frequency(amplitude)
        return jnp.sqrt(jnp.where(squared > 0, squared, jnp.nan))

    @compiled
    def damping_ratio(self, amplitude: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """ζ̃ as a fraction of critical."""
        return self.modal_damping(amplitude) / (2 * self.natural_frequency(amplitude))

    @compiled
    def velocity(self, amplitude: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Velocity amplitude in m/s on the backbone, where Ω = ω̃."""
        if self.argument == "velocity":
            return jnp.asarray(amplitude)
        return jnp.asarray(amplitude) * self.natural_frequency(amplitude)

    def values(self, amplitude: Float[Array | np.ndarray, " point"]) -> BackboneValues:
        """Both curves at given amplitudes, with standard deviations (1σ).

        Evaluated on the host, without compilation; for derivatives use `natural_frequency` and
        `damping_ratio`.
        """
        at = np.asarray(amplitude, dtype=float)
        curves = self.squared_frequency, self.modal_damping
        (squared, by_squared, _), (modal, by_modal, _) = (c.linearised(at) for c in curves)
        slopes = np.zeros((len(at), 2, by_squared.shape[1] + by_modal.shape[1]))
        slopes[:, 0, : by_squared.shape[1]] = by_squared
        slopes[:, 1, by_squared.shape[1] :] = by_modal
        covariance = np.einsum("pck,kl,pdl->pcd", slopes, np.asarray(self.covariance), slopes)
        omega = np.sqrt(np.where(squared > 0, squared, np.nan))
        speed = at if self.argument == "velocity" else at * omega
        return banded_values(speed, squared, modal, covariance)


def banded_values(
    velocity: Float[np.ndarray, " point"],
    squared: Float[np.ndarray, " point"],
    modal: Float[np.ndarray, " point"],
    covariance: Float[np.ndarray, "point 2 2"],
) -> BackboneValues:
    """Both curves at velocities, from ω̃², 2ζ̃ω̃ and their covariance at every point.

    ζ̃ = δ/(2√s): dζ̃ = dδ/(2ω̃) − ζ̃ ds/(2s).
    """
    omega = np.sqrt(np.where(squared > 0, squared, np.nan))
    zeta = modal / (2 * omega)
    slope = np.stack([-zeta / (2 * omega**2), 1 / (2 * omega)], axis=1)
    of_zeta = np.einsum("pc,pcd,pd->p", slope, covariance, slope)
    variances = np.stack([covariance[:, 0, 0], of_zeta, covariance[:, 1, 1]])
    std = np.sqrt(np.maximum(variances, 0.0))
    columns = (velocity, omega, std[0] / (2 * omega), zeta, std[1], modal, std[2])
    return BackboneValues(*jax.device_put(columns))
