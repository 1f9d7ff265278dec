"""Responses to the motion of a base, as motion relative to it over its acceleration."""

import dataclasses
from collections.abc import Mapping
from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float

from snrmjax.identify.modal.response_data import coherence_std
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses

MotionKind = Literal["absolute", "relative"]

_POWERS = {"displacement": 0, "velocity": 1, "acceleration": 2}


class BaseResponses(NamedTuple):
    """Relative accelerations over the base's, and their 1σ where a coherence states it."""

    responses: FrequencyResponses
    std: Float[np.ndarray, "response frequency"] | None  # of real and of imaginary part


def relative_to_base(
    responses: FrequencyResponses,
    motion: MotionKind,
    *,
    along: Mapping[str, float] | None = None,
) -> BaseResponses:
    """Acceleration relative to a moving base over the base's acceleration.

    A structure on a base with acceleration a has z̈ + … = −Γ a in each mode: relative to the base
    it is driven by the force −m a at every mass, and z/a = −Σ φΓ/(ω² − Ω² + 2iζωΩ). An absolute
    motion is that plus the base's own, −1/Ω² times the sensor's direction cosine.

    Arguments: one reference that is a displacement, velocity or acceleration; `motion` what the
    responses are; `along` the cosine between a sensor and the base's motion, 1 where not named.
    Raises `ValueError` for another number or kind of references, for responses that are no motion
    and for unknown sensors.
    """
    if motion not in get_args(MotionKind):
        raise ValueError(f"the motion must be 'absolute' or 'relative', but is {motion!r}.")
    if len(responses.references) != 1 or responses.references[0].quantity not in _POWERS:
        listed = ", ".join(str(channel) for channel in responses.references)
        raise ValueError(
            "motion over a base needs one reference that is a displacement, velocity or "
            f"acceleration, but has {listed}."
        )
    names = [channel.name for channel in responses.responses]
    for name in along or {}:
        if name not in names:
            raise ValueError(f"there is no sensor {name!r}; there are {', '.join(names)}.")
    reference = responses.references[0]
    keep = responses.frequency > 0
    s = 1j * responses.frequency[keep]
    turned, spread = [], []
    for channel, row, known in zip(
        responses.responses, responses.values[:, 0], responses.coherence[:, 0], strict=True
    ):
        if channel.quantity not in _POWERS:
            raise ValueError(f"{channel.name} must be a motion, but is {channel.quantity}.")
        over = row[keep] * s ** (_POWERS[reference.quantity] - _POWERS[channel.quantity])
        spread.append(coherence_std(np.abs(over), known[keep], responses.averages))
        of_base = (along or {}).get(channel.name, 1.0) if motion == "absolute" else 0.0
        turned.append(over - of_base)
    std = np.array(spread)
    relative = dataclasses.replace(
        responses,
        frequency=responses.frequency[keep],
        values=np.array(turned)[:, None],
        coherence=np.full((len(names), 1, int(keep.sum())), np.nan),
        responses=tuple(
            channel._replace(quantity="acceleration", unit="m/s^2", calibration=1.0)
            for channel in responses.responses
        ),
        references=(Channel(reference.name, "acceleration", "m/s^2", 1.0, *reference[4:]),),
    )
    return BaseResponses(relative, std if np.isfinite(std).all() and np.all(std > 0) else None)
