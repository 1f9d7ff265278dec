"""Modes as a model takes them: shapes, participations, errors, rigid-body mode."""

from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from snrmjax.model.modes import Beside, LinearModes, LinearModesStd, RigidBodyModes, linear_modes
from snrmjax.model.moving_base import BaseMotion
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.result import AbstractResult, Variable, quantity, setting
from snrmjax.numerics.units import HERTZ

_WIDE = 1.96  # standard deviations of a 95 % band


class ScaledModes(AbstractResult):
    """Linear modes with shapes and participations; see `scale_modes`.

    `per` is the unit of what drives them: a participation is Φᵀb per newton, or per m/s² of a base,
    or per volt. `mass_normalised` is False where nothing gave the scale: then each shape is ±1 at
    its largest sensor, and shape times participation is the fitted residue all the same, but for
    free decays, which have none.
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

        Raises `ValueError` for a mode of interest that is not there.
        """
        if not 0 <= interest < self.n_modes:
            raise ValueError(
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
            beside=Beside(base=self.base),
        )

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`; 95 % bands."""
        names = ", ".join(self.sensors)
        lines = [f"ScaledModes: {self.n_modes} modes at {names}, {self.scaled_by}"]
        for k in range(self.n_modes):
            top = int(np.argmax(np.abs(self.shape[:, k])))
            lines.append(
                f"mode {k + 1}: {self.natural_frequency[k] / HERTZ:.7g} ± "
                f"{_WIDE * self.natural_frequency_std[k] / HERTZ:.2g} Hz, damping "
                f"{100 * self.damping_ratio[k]:.4g} ± "
                f"{_WIDE * 100 * self.damping_ratio_std[k]:.2g} %, shape "
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
