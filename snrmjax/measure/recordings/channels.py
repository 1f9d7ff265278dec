"""A channel of a test: what was measured, in which unit, where and in which direction."""

from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

from snrmjax.numerics.rules import NOT_ZERO, require

Quantity = Literal["force", "displacement", "velocity", "acceleration", "voltage", "unknown"]

SI_UNIT: dict[Quantity, str] = {
    "force": "N",
    "displacement": "m",
    "velocity": "m/s",
    "acceleration": "m/s^2",
    "voltage": "V",
    "unknown": "",
}
"""The unit of each quantity in which all of the package computes."""

DERIVATIVE: dict[Quantity, int] = {"displacement": 0, "velocity": 1, "acceleration": 2}
"""Which derivative of the displacement a quantity of motion is."""


class Channel(NamedTuple):
    """One channel of a recording.

    A recorded number times `calibration` is in the SI unit of `quantity`. `unit` is the file's own
    word for its numbers. `point` and `direction` say where (a node's number or a name; +x, -z, …);
    they are empty where nobody said.
    """

    name: str
    quantity: Quantity = "unknown"
    unit: str = ""
    calibration: float = 1.0
    point: str = ""
    direction: str = ""

    @property
    def si_unit(self) -> str:
        """SI unit of what `calibration` gives."""
        return SI_UNIT[self.quantity]

    def __str__(self) -> str:
        """In words: name, quantity and place."""
        place = f" at {self.point}{self.direction}" if self.point or self.direction else ""
        unit = f", {self.unit}" if self.unit else ""
        return f"{self.name} ({self.quantity}{unit}{place})"


def checked_channels(channels: Sequence[Channel]) -> tuple[Channel, ...]:
    """Channels of one recording as a tuple.

    Raises `ValueError` for none, for a doubled or empty name, an unknown quantity, and a
    calibration that is zero or not finite.
    """
    listed = tuple(channels)
    if not listed:
        raise ValueError("a recording needs at least one channel.")
    names = [channel.name for channel in listed]
    for channel in listed:
        if not channel.name or names.count(channel.name) > 1:
            raise ValueError(f"channels need names of their own, but are {', '.join(names)}.")
        if channel.quantity not in get_args(Quantity):
            raise ValueError(
                f"the quantity of channel {channel.name} must be one of {', '.join(SI_UNIT)}, but "
                f"is {channel.quantity!r}."
            )
        require(f"the calibration of channel {channel.name}", channel.calibration, NOT_ZERO)
    return listed


def channel_number(channels: Sequence[Channel], name: str) -> int:
    """Where the channel of a name stands. Raises `ValueError` that lists the names there are."""
    names = [channel.name for channel in channels]
    if name not in names:
        raise ValueError(f"there is no channel {name!r}; there are {', '.join(names)}.")
    return names.index(name)
