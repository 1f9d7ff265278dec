"""Linear modes for a model: shapes, participations, errors, rigid-body mode."""

from typing import ClassVar, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from snrmjax.identify.modal.modal_fit import WIDE, LinearModalFit
from snrmjax.model.modes import (
    LinearModes,
    LinearModesStd,
    OptionalModalData,
    RigidBodyModes,
    linear_modes,
)
from snrmjax.model.moving_base import BaseMotion
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.result import AbstractResult, Variable, quantity, setting
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ


class ScaledModes(AbstractResult):
    """Linear modes with shapes and participations; see `scale_modes`.

    `per` is the unit of the excitation: a participation is Φᵀb per newton, per m/s² of a base or
    per volt. `mass_normalised` is False without a scale: each shape is then ±1 at its largest
    sensor; shape times participation is still the fitted residue, except for free decays, which
    have none.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("mode", "sensor")

    natural_frequency: Float[np.ndarray, " mode"] = quantity("mode", "Hz", "natural frequency")
    natural_frequency_std: Float[np.ndarray, " mode"] = quantity("mode", "Hz", "its 1σ")
    damping_ratio: Float[np.ndarray, " mode"] = quantity("mode", "1", "damping ratio")
    damping_ratio_std: Float[np.ndarray, " mode"] = quantity("mode", "1", "its 1σ")
    shape: Float[np.ndarray, "sensor mode"]  # kg^-1/2
    shape_std: Float[np.ndarray, "sensor mode"]
    participation: Float[np.ndarray, " mode"]  # kg^-1/2 per `per`
    participation_std: Float[np.ndarray, " mode"]
    # Of shape times participation.
    modal_mass_std: Float[np.ndarray, " mode"] = quantity("mode", "1", "relative 1σ of modal mass")
    rigid_shape: Float[np.ndarray, " sensor"] | None  # kg^-1/2; None: no rigid-body mode
    rigid_participation: float
    sensors: tuple[str, ...] = quantity("sensor", "", "sensor", name="sensor", static=True)
    scaled_by: Fact = setting()
    per: str = setting(default="N")
    mass_normalised: bool = eqx.field(static=True, default=True)
    notes: tuple[Fact | str, ...] = setting(default=())
    base: BaseMotion | None = eqx.field(static=True, default=None)

    @property
    def n_modes(self) -> int:
        """Number of modes."""
        return len(self.natural_frequency)

    def linear_modes(self, interest: int = 0) -> LinearModes:
        """The modes of a model; `interest` counts from zero.

        Raises `ValueError` for a mode of interest that does not exist.
        """
        if not 0 <= interest < self.n_modes:
            raise InputError(
                f"the mode of interest must be from 1 to {self.n_modes}, the number of modes, but "
                f"is {interest + 1}."
            )
        rigid = None
        if self.rigid_shape is not None:
            rigid = RigidBodyModes(
                np.asarray(self.rigid_shape)[:, None], np.array([self.rigid_participation])
            )
        known = np.all(np.isfinite(self.modal_mass_std))
        return linear_modes(
            self.natural_frequency,
            self.damping_ratio,
            self.shape,
            self.participation,
            sensors=self.sensors,
            mode_of_interest=interest,
            rigid_body=rigid,
            std=LinearModesStd(
                self.natural_frequency_std,
                self.damping_ratio_std,
                self.modal_mass_std if known else None,
            ),
            optional=OptionalModalData(base=self.base),
        )

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`; 95 % bands."""
        names = ", ".join(self.sensors)
        lines = [f"ScaledModes: {self.n_modes} modes at {names}, {self.scaled_by}"]
        for k in range(self.n_modes):
            top = int(np.argmax(np.abs(self.shape[:, k])))
            lines.append(
                f"mode {k + 1}: {self.natural_frequency[k] / HERTZ:.7g} ± "
                f"{WIDE * self.natural_frequency_std[k] / HERTZ:.2g} Hz, damping "
                f"{100 * self.damping_ratio[k]:.4g} ± "
                f"{WIDE * 100 * self.damping_ratio_std[k]:.2g} %, shape "
                f"{self.shape[top, k]:.5g} at {self.sensors[top]}, participation "
                f"{self.participation[k]:.5g} per {self.per}"
            )
        return (*lines, *(f"note: {note}" for note in self.notes))

    def variables(self) -> dict[str, Variable]:
        """Those of the fields, with shapes and participations in the unit of their scale."""
        mode, both = ("mode",), ("sensor", "mode")
        unit, driven = "kg^-1/2" if self.mass_normalised else "1", f"participation per {self.per}"
        return {
            "mode": Variable(mode, np.arange(1, self.n_modes + 1), "1", "mode"),
            **super().variables(),
            "participation": Variable(mode, self.participation, unit, driven),
            "participation_std": Variable(mode, self.participation_std, unit, "its 1σ"),
            "shape": Variable(both, self.shape, unit, "mode shape"),
            "shape_std": Variable(both, self.shape_std, unit, "its 1σ"),
        }


_RESIDUAL_STDS = 5.0  # smallest significant low residual, in standard errors
_APART = (
    1.2  # ratio of the residual's mass to the stated one above which the note reports a difference
)


class RigidBodyMode(NamedTuple):
    """Shape at the sensors and participation, both kg^-1/2; no shape for a fixed structure."""

    shape: Float[np.ndarray, " sensor"] | None
    participation: float
    notes: tuple[Fact, ...]


def rigid_body_mode(
    fit: LinearModalFit,
    gain: float,
    free: float | None,
    drive: tuple[int, float] | None,
    scaled_by: Fact,
) -> RigidBodyMode:
    """The rigid-body mode from the low residuals or from the stated mass of a free structure.

    A rigid-body mode has the receptance −φp/Ω²: the low residual of the drive point is −1/m, m the
    driven mass. Modes below the band look alike, so that the mode is added only for a structure
    declared free: `free` is its mass in kg, 0 if unknown, None if not declared. `drive` is the
    index of the sensor at the force and its sign relative to it.
    Raises `ValueError` where the residual contradicts a free structure.
    """
    lower, std = fit.lower / gain, fit.lower_std / abs(gain)
    at, sign = drive or (0, 1.0)
    residual = residual_std = np.nan
    if drive is not None and std[at] > 0:
        residual, residual_std = sign * lower[at], std[at]
    significant = residual < -_RESIDUAL_STDS * residual_std
    if free is None:
        note = (
            (Fact("low_residual_of_free_mass", mass_kg=float(-1 / residual)),)
            if significant
            else ()
        )
        return RigidBodyMode(None, 0.0, note)
    if free < 0 or not np.isfinite(free):
        raise InputError(f"the mass of a free structure must be positive (kg), but is {free:g}.")
    if free > 0:
        ones = np.full(len(fit.sensors), free**-0.5)
        if not significant:
            return RigidBodyMode(ones, free**-0.5, (Fact("rigid_body_of_stated_mass"),))
        ratio = float(-1 / residual / free)
        off = not 1 / _APART < ratio < _APART
        note = (Fact("low_residual_of_mass", mass_kg=ratio * free, ratio=ratio, off=off),)
        signs = np.sign(lower) * np.sign(lower[at])
        ones = ones * np.where(signs == 0, 1.0, signs) * sign
        return RigidBodyMode(ones, free**-0.5, note)
    if not significant:
        what = (
            "is not known"
            if np.isnan(residual)
            else f"is {residual:.3g} ± {WIDE * residual_std:.2g} 1/kg"
        )
        raise InputError(
            f"a free structure responds with −1/(m Ω²) at low frequency, but the low residual at "
            f"the drive point {what}: state its mass, or do not declare it free."
        )
    participation = float(np.sqrt(-residual))
    mass = {"mass_kg": float(-1 / residual), "std_kg": float(residual_std / residual**2)}
    note = (Fact("rigid_body_of_residuals", **mass, scaled_by=scaled_by),)
    return RigidBodyMode(-lower / participation, participation, note)
