"""Modes that exchange energy: their model, its responses, and the bias of one-mode backbones."""

from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.identify.coupled.coupled_modes import CoupledModes, coupled_modes
from snrmjax.identify.inference.identification import Identification
from snrmjax.measure.states import SteadyStates
from snrmjax.model.structures import Structure
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.result import AbstractResult, quantity
from snrmjax.simulate.solutions.controlled import damped_normal_mode
from snrmjax.simulate.solutions.forced_response import ResponseCurve, forced_response

_POINTS = 50
_BEYOND = 1.1  # times the largest velocity, up to which the coupled mode is traced


class SingleModeBias(AbstractResult):
    """Bias of the identified one-mode curves against the coupled modes, at the reference sensor.

    NaN beyond a fold of the coupled mode in amplitude, where it has several frequencies.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("velocity_m_s", "sensor")

    velocity: Float[np.ndarray, " point"] = quantity("velocity_m_s", "m/s", "velocity amplitude")
    natural_frequency: Float[np.ndarray, " point"] = quantity(
        "velocity_m_s", "Hz", "natural frequency of the coupled mode"
    )
    damping_ratio: Float[np.ndarray, " point"] = quantity(
        "velocity_m_s", "1", "damping ratio of the coupled mode"
    )
    # Relative to those of the coupled mode.
    frequency_bias: Float[np.ndarray, " point"] = quantity(
        "velocity_m_s", "1", "relative error of the identified natural frequency"
    )
    damping_bias: Float[np.ndarray, " point"] = quantity(
        "velocity_m_s", "1", "relative error of the identified damping ratio"
    )

    # 1σ of the identified curve, and velocities of all sensors over that of the reference.
    frequency_std: Float[np.ndarray, " point"] = quantity("velocity_m_s", "1", "1σ, relative")
    shape: Float[np.ndarray, "point sensor"] = quantity(
        "velocity_m_s sensor", "1", "velocity in phase with the reference sensor's, over it"
    )
    sensors: tuple[str, ...] = quantity("sensor", "", "sensor", name="sensor", static=True)

    @property
    def at_largest(self) -> tuple[float, float, float, float]:
        """Velocity (m/s), both biases and 1σ of the frequency bias at the largest amplitude.

        Among amplitudes where the coupled mode is known; NaN if there is none.
        """
        known = np.flatnonzero(np.isfinite(self.frequency_bias))
        if not known.size:
            return (float("nan"),) * 4
        columns = self.velocity, self.frequency_bias, self.damping_bias, self.frequency_std
        velocity, frequency, damping, std = (float(column[known[-1]]) for column in columns)
        return velocity, frequency, damping, std


def single_mode_bias(identification: Identification, coupled: CoupledModes) -> SingleModeBias:
    """Bias of the identified backbone and damping against those of the coupled modes.

    The coupled modes' own curves are those of the damped nonlinear mode (`damped_normal_mode`) of
    the fitted model: where the one-mode assumption holds, both agree.

    Arguments: an identification of the same data, and the coupled modes fitted to them.
    Reference: Krack, Comput. Struct. 154 (2015) 59, doi:10.1016/j.compstruc.2015.03.008.
    """
    backbone = identification.backbone
    curve = backbone.sampled(_POINTS)
    speed = np.asarray(curve.velocity)
    model = coupled.model
    branch = damped_normal_mode(model, _BEYOND * float(np.nanmax(speed)))
    sensor = model.modes.sensors.index(backbone.sensor)
    fundamental = np.asarray(branch.velocity)[:, 1]
    observed = np.abs(fundamental[:, sensor])
    folds = np.flatnonzero(np.diff(observed) <= 0)
    rising = slice(0, int(folds[0]) + 1 if folds.size else len(observed))

    def at_speed(part: np.ndarray) -> np.ndarray:
        return np.interp(
            speed, observed[rising], np.asarray(part)[rising], left=np.nan, right=np.nan
        )

    mode = [at_speed(part) for part in (branch.frequency, branch.damping_ratio)]
    shapes = (fundamental / fundamental[:, [sensor]]).real
    return SingleModeBias(
        velocity=speed,
        natural_frequency=mode[0],
        damping_ratio=mode[1],
        frequency_bias=np.asarray(curve.natural_frequency) / mode[0] - 1,
        damping_bias=np.asarray(curve.damping_ratio) / mode[1] - 1,
        frequency_std=np.asarray(curve.natural_frequency_std) / mode[0],
        shape=np.stack([at_speed(column) for column in shapes.T], axis=1),
        sensors=model.modes.sensors,
    )


_AROUND = (
    0.5,
    1.0,
)  # of the measured frequency range, by which a prediction extends below and above it
_STDS = 2.0  # of the identified curve: a larger bias is reported as significant


class CoupledDetails(NamedTuple):
    """Coupled modes, the bias of a one-mode backbone, and predicted responses."""

    modes: CoupledModes
    bias: SingleModeBias
    responses: tuple[ResponseCurve, ...]

    def notes(self) -> list[Fact]:
        """Facts on the coupling and the bias of the backbone."""
        interaction, notes = self.modes.interaction, []
        if interaction is None:
            assessed = self.modes.interactions
            ratios = tuple((one.other + 1, one.ratio) for one in assessed)
            return [Fact("modes_not_coupled", looked=ratios)]
        notes.append(
            Fact(
                "modes_coupled",
                mode=interaction.mode + 1,
                other=interaction.other + 1,
                ratio=interaction.ratio,
                probability=interaction.probability,
                fraction=interaction.fraction,
            )
        )
        velocity, frequency, damping, std = self.bias.at_largest
        if np.isfinite(frequency):
            clear = abs(frequency) > _STDS * std
            values = {"velocity": velocity, "frequency": frequency, "damping": damping}
            notes.append(Fact("single_mode_biased", clear=clear, **values))
        return notes


def coupled_details(
    data: SteadyStates, model: Structure, identification: Identification, forces: Sequence[float]
) -> CoupledDetails:
    """Coupled modes of a test, and their responses to given forces (N).

    Raises what `coupled_modes` raises.
    """
    modes = coupled_modes(data, model)
    frequency = np.asarray(data.frequency)
    span = float(np.ptp(frequency))
    low, high = float(frequency.min()), float(frequency.max())
    curves: list[ResponseCurve] = []
    if forces:
        ends = max(low - _AROUND[0] * span, 0.5 * low), high + _AROUND[1] * span
        curves = forced_response(modes.model, list(dict.fromkeys(forces)), *ends)
    return CoupledDetails(modes, single_mode_bias(identification, modes), tuple(curves))
