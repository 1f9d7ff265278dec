"""Units as laboratories write them, and what they mean in SI."""

import functools
import math
import re
from decimal import Decimal
from typing import Any, NamedTuple, get_args

from snrmjax.io.files import shown
from snrmjax.io.laboratory.libraries import library
from snrmjax.measure.recordings.channels import Quantity

_LONGEST = 40
_ALLOWED = re.compile(r"[A-Za-zµμΩ°%/*^·.()0-9 _+\-⁻¹²³]*")
_NUMBER = re.compile(r"\s*([+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?)\s*(?=\D|$)")
_SUPERSCRIPTS = str.maketrans({"⁻": "-", "¹": "1", "²": "2", "³": "3"})
_NOTHING = {"", "-", "--", "1", "eu", "none", "unknown", "n/a", "na", "a.u."}
_WORDS = {
    "g": "standard_gravity",  # in vibration tests g is gravity, never gram
    "G": "standard_gravity",
    "gn": "standard_gravity",
    "g_n": "standard_gravity",
    "gs": "standard_gravity",
    "ips": "(inch/second)",
    "mil": "thou",
    "mils": "thou",
    "lb": "lbf",
    "lbs": "lbf",
    "kp": "kgf",
    "°": "degree",
}
_ODD = re.compile(r"[0-9.]{2,}|\^\s*[^-1-9(]|\*\*|\^.*\^.*\^")
_SIZE = {
    "rms": "rms",
    "eff": "rms",
    "pk": "peak",
    "peak": "peak",
    "pp": "peak_to_peak",
    "pk-pk": "peak_to_peak",
    "p-p": "peak_to_peak",
    "pkpk": "peak_to_peak",
}
_SIZED = re.compile(
    r"(?<![A-Za-z])(?:\(|\[)?(pk-pk|p-p|pkpk|peak|rms|eff|pk|pp)(?:\)|\])?\s*$|(?<=V)(rms|pp|pk)$",
    re.IGNORECASE,
)


class UnitMeaning(NamedTuple):
    """What a unit says: a number in it times `factor` is in the SI unit of `dimension`.

    `dimension` is a quantity of a channel, or "frequency" (SI unit rad/s), "angle" (rad), "time",
    "mass", "other". Of a sensitivity ("10.2 mV/g") it is the quantity that volts stand for, and
    `per_volt` is true. `size` is what a suffix says ("g rms"): "rms", "peak", "peak_to_peak", or
    nothing.
    """

    dimension: str
    factor: float
    size: str = ""
    per_volt: bool = False

    @property
    def quantity(self) -> Quantity:
        """The quantity of a channel in that unit."""
        known: tuple[Quantity, ...] = get_args(Quantity)
        return next((one for one in known if one == self.dimension), "unknown")


@functools.lru_cache(maxsize=1024)
def unit_meaning(text: str) -> UnitMeaning:
    """What a unit means: "N", "m/s²", "g" (gravity), "in/s", "lbf", "10.2 mV/g", "mm/s rms".

    An empty text, "EU" and "-" are of unknown dimension with the factor 1.
    Raises `ValueError` for what is no unit.

    >>> unit_meaning("g").factor, unit_meaning("mm/s").dimension
    (9.80665, 'velocity')
    """
    plain = text.strip().strip("[]").strip()
    if plain.lower() in _NOTHING:
        return UnitMeaning("unknown", 1.0)
    if len(plain) > _LONGEST or not _ALLOWED.fullmatch(plain):
        raise ValueError(f"{shown(text)} is not understood as a unit.")
    size = ""
    match = _SIZED.search(plain)
    if match is not None:
        size = _SIZE[(match[1] or match[2]).lower()]
        plain = plain[: match.start()].strip()
    number = _NUMBER.match(plain)
    value = float(number[1]) if number else 1.0
    if number:
        plain = plain[number.end() :].strip()
    if value <= 0 or not math.isfinite(value) or not plain:
        raise ValueError(f"{shown(text)} is not understood as a unit.")
    dimension, factor = _parsed(plain, text)
    if dimension.startswith("volt per "):
        return UnitMeaning(dimension.removeprefix("volt per "), 1 / (value * factor), size, True)
    if dimension.endswith(" per volt"):
        return UnitMeaning(dimension.removesuffix(" per volt"), value * factor, size, True)
    return UnitMeaning(dimension, value * factor, size)


def channel_meaning(text: str) -> tuple[Quantity, float]:
    """Quantity and calibration of a channel whose file states a unit; unknown where unreadable."""
    try:
        meaning = unit_meaning(text)
    except ValueError:
        return "unknown", 1.0
    if meaning.quantity == "unknown" or meaning.per_volt:
        return "unknown", 1.0
    return meaning.quantity, meaning.factor


def _parsed(plain: str, text: str) -> tuple[str, float]:
    """Dimension and factor of a unit without number and suffix."""
    words = plain.translate(_SUPERSCRIPTS).replace("·", "*").replace("μ", "µ")
    words = re.sub(r"(?<=[A-Za-z])\^?(-?[1-9])(?![0-9])", r"^\1", words)
    # pC/N has the dimension of m/V: a charge needs its amplifier's gain, and is no voltage.
    if re.search(r"(?<![A-Za-z])[a-zµ]?C(?![A-Za-z])", words) or _ODD.search(words):
        raise ValueError(f"{shown(text)} is not understood as a unit.")
    words = re.sub(r"[A-Za-z_µ°]+", lambda found: _WORDS.get(found[0], found[0]), words)
    registry = _registry()
    try:
        base = registry.Quantity(Decimal(1), registry.parse_units(words)).to_base_units()
        factor = float(base.magnitude)
    except Exception as error:  # Pint has many, AssertionError and tokenize's among them
        raise ValueError(f"{shown(text)} is not understood as a unit.") from error
    if not (math.isfinite(factor) and factor > 0):
        raise ValueError(f"{shown(text)} is not understood as a unit.")
    alike = [name for name, like in _likes().items() if base.dimensionality == like]
    if not alike:
        return "other", factor
    name = alike[0]
    if name == "frequency":
        return name, factor if "radian" in str(base.units) else 2 * math.pi * factor
    if name == "angle" and "radian" not in str(base.units):
        return "other", factor
    return name, factor


@functools.cache
def _registry() -> Any:
    """Pint's registry, in exact decimals."""
    return library("pint", "reading units").UnitRegistry(non_int_type=Decimal, cache_folder=None)


@functools.cache
def _likes() -> dict[str, Any]:
    """The dimensionality of each dimension by name."""
    units = {
        "force": "newton",
        "displacement": "meter",
        "velocity": "meter/second",
        "acceleration": "meter/second^2",
        "voltage": "volt",
        "frequency": "hertz",
        "angle": "radian",
        "time": "second",
        "mass": "kilogram",
        "volt per force": "volt/newton",
        "volt per displacement": "volt/meter",
        "volt per velocity": "volt*second/meter",
        "volt per acceleration": "volt*second^2/meter",
        "force per volt": "newton/volt",
        "displacement per volt": "meter/volt",
        "velocity per volt": "meter/second/volt",
        "acceleration per volt": "meter/second^2/volt",
    }
    registry = _registry()
    return {name: registry.parse_units(unit).dimensionality for name, unit in units.items()}
