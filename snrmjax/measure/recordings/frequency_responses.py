"""Frequency responses of a linear test: response over reference, by frequency."""

from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from snrmjax.measure.recordings.channels import Channel, checked_channels
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.result import AbstractResult, Variable

_HERTZ = 2 * np.pi


class FrequencyResponses(AbstractResult):
    """Responses over references (forces, or the motion of a base); see `frequency_responses`.

    Phasors e^{+iΩt}. Values are in SI units, (quantity of the response) over (that of the
    reference); NaN where a pair was not measured.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("response", "reference", "frequency_hz")

    frequency: Float[np.ndarray, " frequency"]  # rad/s, rising
    values: Complex[np.ndarray, "response reference frequency"]
    coherence: Float[np.ndarray, "response reference frequency"]  # NaN where not stated
    responses: tuple[Channel, ...] = eqx.field(static=True)
    references: tuple[Channel, ...] = eqx.field(static=True)
    averages: int | None = eqx.field(static=True, default=None)
    name: str = eqx.field(static=True, default="")
    notes: tuple[Fact | str, ...] = eqx.field(static=True, default=())

    def receptance(self) -> Complex[np.ndarray, "response reference frequency"]:
        """Displacement over reference: velocities over iΩ, accelerations over −Ω².

        Raises `ValueError` for a response of another quantity.
        """
        turned = []
        for one, row in zip(self.responses, self.values, strict=True):
            if one.quantity not in _POWER:
                raise ValueError(
                    f"channel {one.name} must be a displacement, velocity or acceleration, but is "
                    f"{one.quantity}."
                )
            turned.append(row / (1j * self.frequency) ** _POWER[one.quantity])
        return np.stack(turned)

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`."""
        hertz = self.frequency / _HERTZ
        return (
            f"FrequencyResponses{': ' + self.name if self.name else ''}, {len(self.responses)} "
            f"responses over {len(self.references)} references at {len(hertz)} frequencies, "
            f"{hertz[0]:.6g} to {hertz[-1]:.6g} Hz",
            *(f"response {one}" for one in self.responses),
            *(f"reference {one}" for one in self.references),
            *(f"note: {note}" for note in self.notes),
        )

    def variables(self) -> dict[str, Variable]:
        """See `AbstractResult`."""
        at = ("response", "reference", "frequency_hz")
        names = np.array([one.name for one in self.responses], dtype=str)
        driven = np.array([one.name for one in self.references], dtype=str)
        return {
            "response": Variable(at[:1], names, "", "response channel"),
            "reference": Variable(at[1:2], driven, "", "reference channel"),
            "frequency_hz": Variable(at[2:], self.frequency / _HERTZ, "Hz", "frequency"),
            "value_re": Variable(at, self.values.real, "SI", "real part of the response"),
            "value_im": Variable(at, self.values.imag, "SI", "imaginary part of the response"),
            "coherence": Variable(at, self.coherence, "1", "coherence"),
        }


_POWER = {"displacement": 0, "velocity": 1, "acceleration": 2}


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
    """Frequency responses, checked.

    Arguments: `frequency` in rad/s, rising; `values` in the channels' own units, (response) over
    (reference): their calibrations turn them into SI.
    Raises `ValueError` for sizes that disagree, frequencies that do not rise from zero or above,
    channels as in `checked_channels`, infinite values and no value at all.
    """
    omega, every = np.asarray(frequency, dtype=float), np.asarray(values, dtype=complex)
    outputs, inputs = checked_channels(responses), checked_channels(references)
    wanted = (len(outputs), len(inputs), omega.size)
    if omega.ndim != 1 or every.shape != wanted:
        raise ValueError(
            f"`values` must have shape {wanted} (responses, references, frequencies), but has "
            f"{every.shape}."
        )
    if (
        not omega.size
        or not np.isfinite(omega).all()
        or omega[0] < 0
        or np.any(np.diff(omega) <= 0)
    ):
        raise ValueError("`frequency` must be finite and rise from zero or above.")
    if np.isinf(every).any() or np.isnan(every).all():
        raise ValueError("`values` must be finite where they were measured, and not all missing.")
    known = np.full(wanted, np.nan) if coherence is None else np.asarray(coherence, dtype=float)
    if known.shape != wanted:
        raise ValueError(f"`coherence` must have shape {wanted}, but has {known.shape}.")
    scale = np.array([one.calibration for one in outputs])[:, None] / np.array(
        [one.calibration for one in inputs]
    )
    return FrequencyResponses(
        omega,
        every * scale[:, :, None],
        known,
        outputs,
        inputs,
        averages,
        name,
        tuple(notes),
    )
