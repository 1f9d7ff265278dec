"""Frequency response functions of a linear test: response over reference."""

from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from snrmjax.measure.recordings.channels import DERIVATIVE, Channel, checked_channels
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.result import AbstractResult, Variable, quantity, setting
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ


class FrequencyResponses(AbstractResult):
    """Responses over references (forces, or the motion of a base); see `frequency_responses`.

    Phasors e^{+iΩt}. Values are in SI units, (quantity of the response) over (that of the
    reference); NaN where a pair was not measured.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("response", "reference", "frequency_hz")

    responses: tuple[Channel, ...] = eqx.field(static=True)
    references: tuple[Channel, ...] = eqx.field(static=True)
    # Ascending.
    frequency: Float[np.ndarray, " frequency"] = quantity("frequency_hz", "Hz", "frequency")
    values: Complex[np.ndarray, "response reference frequency"] = quantity(
        "response reference frequency_hz", "SI", "response", name="value"
    )
    # NaN where not stated.
    coherence: Float[np.ndarray, "response reference frequency"] = quantity(
        "response reference frequency_hz", "1", "coherence"
    )
    averages: int | None = eqx.field(static=True, default=None)
    name: str = eqx.field(static=True, default="")
    notes: tuple[Fact | str, ...] = setting(default=())

    def receptance(self) -> Complex[np.ndarray, "response reference frequency"]:
        """Displacement over reference: velocities over iΩ, accelerations over −Ω².

        Raises `ValueError` for a response that is not a motion.
        """
        receptances = []
        for channel, row in zip(self.responses, self.values, strict=True):
            if channel.quantity not in DERIVATIVE:
                raise InputError(
                    f"channel {channel.name} must be a displacement, velocity or acceleration, but "
                    f"is {channel.quantity}."
                )
            receptances.append(row / (1j * self.frequency) ** DERIVATIVE[channel.quantity])
        return np.stack(receptances)

    def summary(self) -> tuple[str, ...]:
        """Channels and band."""
        hertz = self.frequency / HERTZ
        return (
            f"FrequencyResponses{': ' + self.name if self.name else ''}, {len(self.responses)} "
            f"responses over {len(self.references)} references at {len(hertz)} frequencies, "
            f"{hertz[0]:.6g} to {hertz[-1]:.6g} Hz",
            *(f"response {channel}" for channel in self.responses),
            *(f"reference {channel}" for channel in self.references),
            *(f"note: {note}" for note in self.notes),
        )

    def variables(self) -> dict[str, Variable]:
        """Columns by channels and frequency."""
        return {
            "response": channel_variable("response", self.responses),
            "reference": channel_variable("reference", self.references),
            **super().variables(),
        }


def channel_variable(dimension: str, channels: Sequence[Channel]) -> Variable:
    """The names of channels along a dimension of a data set."""
    names = np.array([channel.name for channel in channels], dtype=str)
    return Variable((dimension,), names, "", f"{dimension} channel")


def frequency_responses(
    frequency: Float[np.ndarray, " frequency"],
    values: Complex[np.ndarray, "response reference frequency"],
    responses: Sequence[Channel],
    references: Sequence[Channel],
    *,
    coherence: Float[np.ndarray, "response reference frequency"] | None = None,
    averages: int | None = None,
    name: str = "",
    notes: Sequence[Fact | str] = (),
) -> FrequencyResponses:
    """Build `FrequencyResponses` from arrays, with checks.

    Arguments: `frequency` in rad/s, ascending; `values` in the channels' own units, (response)
    over (reference), converted to SI by the calibrations.
    Raises `ValueError` for inconsistent shapes, frequencies that do not ascend from zero or above,
    channels as in `checked_channels`, infinite values and no value at all.
    """
    omega, numbers = np.asarray(frequency, dtype=float), np.asarray(values, dtype=complex)
    outputs, inputs = checked_channels(responses), checked_channels(references)
    wanted = (len(outputs), len(inputs), omega.size)
    if omega.ndim != 1 or numbers.shape != wanted:
        raise InputError(
            f"`values` must have shape {wanted} (responses, references, frequencies), but has "
            f"{numbers.shape}."
        )
    if (
        not omega.size
        or not np.isfinite(omega).all()
        or omega[0] < 0
        or np.any(np.diff(omega) <= 0)
    ):
        raise InputError("`frequency` must be finite and ascending from zero or above.")
    if np.isinf(numbers).any() or np.isnan(numbers).all():
        raise InputError("`values` must be finite where they were measured, and not all missing.")
    known = np.full(wanted, np.nan) if coherence is None else np.asarray(coherence, dtype=float)
    if known.shape != wanted:
        raise InputError(f"`coherence` must have shape {wanted}, but has {known.shape}.")
    scale = np.array([channel.calibration for channel in outputs])[:, None] / np.array(
        [channel.calibration for channel in inputs]
    )
    return FrequencyResponses(
        outputs,
        inputs,
        omega,
        numbers * scale[:, :, None],
        known,
        averages,
        name,
        tuple(notes),
    )
