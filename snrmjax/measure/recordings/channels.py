"""A channel of a test: quantity, unit, point and direction."""

from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

from snrmjax.numerics.rules import NOT_ZERO, InputError, require

Quantity = Literal["force", "displacement", "velocity", "acceleration", "voltage", "unknown"]

SI_UNIT: dict[Quantity, str] = {
    "force": "N",
    "displacement": "m",
    "velocity": "m/s",
    "acceleration": "m/s^2",
    "voltage": "V",
    "unknown": "",
}
"""The unit of each quantity in all computations."""

DERIVATIVE: dict[Quantity, int] = {"displacement": 0, "velocity": 1, "acceleration": 2}
"""Order of each motion quantity as a derivative of the displacement."""


class Channel(NamedTuple):
    """One channel of a recording.

    A recorded number times `calibration` is in the SI unit of `quantity`. `unit` is the unit as
    written in the file. `point` (a node number or a name) and `direction` (+x, -z, …) are empty if
    unknown.
    """

    name: str
    quantity: Quantity = "unknown"
    unit: str = ""
    calibration: float = 1.0
    point: str = ""
    direction: str = ""

    @property
    def si_unit(self) -> str:
        """SI unit of the calibrated values."""
        return SI_UNIT[self.quantity]

    def __str__(self) -> str:
        """As text: name, quantity, unit and point."""
        location = f" at {self.point}{self.direction}" if self.point or self.direction else ""
        unit = f", {self.unit}" if self.unit else ""
        return f"{self.name} ({self.quantity}{unit}{location})"


def checked_channels(channels: Sequence[Channel]) -> tuple[Channel, ...]:
    """Channels of one recording as a tuple.

    Raises `ValueError` for no channel, a repeated or empty name, an unknown quantity, and a
    calibration that is zero or not finite.
    """
    listed = tuple(channels)
    if not listed:
        raise InputError("a recording needs at least one channel.")
    names = [channel.name for channel in listed]
    for channel in listed:
        if not channel.name or names.count(channel.name) > 1:
            raise InputError(f"channels need distinct names, but are {', '.join(names)}.")
        if channel.quantity not in get_args(Quantity):
            raise InputError(
                f"the quantity of channel {channel.name} must be one of {', '.join(SI_UNIT)}, but "
                f"is {channel.quantity!r}."
            )
        require(f"the calibration of channel {channel.name}", channel.calibration, NOT_ZERO)
    return listed


def channel_number(channels: Sequence[Channel], name: str) -> int:
    """Index of a channel by name. Raises `ValueError` that lists the existing names."""
    names = [channel.name for channel in channels]
    if name not in names:
        raise InputError(f"there is no channel {name!r}; there are {', '.join(names)}.")
    return names.index(name)
