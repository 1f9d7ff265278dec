"""Units as written in laboratory files, converted to SI."""

import ast
import functools
import importlib
import math
import re
from decimal import Decimal
from typing import Any, NamedTuple, get_args

from snrmjax.io.files import shown
from snrmjax.measure.recordings.channels import Quantity
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

_LONGEST = 40
_ALLOWED = re.compile(r"[A-Za-zµμΩ°%/*^·.()0-9 _+\-⁻¹²³]*")
_NUMBER = re.compile(r"\s*([+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?)\s*(?=\D|$)")
_AS_PYTHON = str.maketrans(
    {"⁻": "-", "¹": "1", "²": "2", "³": "3", "·": "*", ".": "*", "µ": "u", "μ": "u"}
    | {"°": " deg ", "%": " percent "}
)
_NOTHING = {"", "-", "--", "1", "eu", "none", "unknown", "n/a", "na", "a.u."}
_ODD = re.compile(r"[0-9.]{2,}|\^\s*[^-1-9(]|\*\*|\^.*\^.*\^")
_AMPLITUDE_KINDS = {
    "peak_to_peak": r"pk[-_ ]?pk|p[-_ ]?p|p2p|peak[-_ ]?to[-_ ]?peak|cr[eê]te[-_ ][aà][-_ ]cr[eê]te"
    r"|spitze[-_ ]spitze",
    "rms": r"rms|eff(?:ektiv[a-z]*|icace)?",
    "peak": r"pk|peak|cr[eê]te|spitzen?[a-z]*|scheitel[a-z]*",
}
_AMPLITUDE = "|".join(f"(?P<{kind}>{words})" for kind, words in _AMPLITUDE_KINDS.items())
_AMPLITUDE = rf"(?:(?<![^\W\d_])|(?<=V))(?:{_AMPLITUDE})(?![^\W\d_])\.?"
_AMPLITUDE_WORD = re.compile(_AMPLITUDE, re.IGNORECASE)
_AMPLITUDE_SUFFIX = re.compile(
    rf"[\s_,]*(?:(?P<round>\()|(?P<square>\[))?{_AMPLITUDE}(?(round)\)|(?(square)\]))$",
    re.IGNORECASE,
)

_LEVEL = re.compile(
    r"(?:d[Bb]|DB|[Dd]ecibels?)(?:\s*(?P<volt>[mµu]?V|u)\b|\s*\(?(?P<size>rms|pk|peak)\b\)?)?"
    r"(?:\s*\(?\s*(?:(?:re|ref|rel|reference|bezogen auf|bez)\b\.?(?:\s*to\b)?|//|:)\s*[:=]?\s*"
    r"(?P<reference>[^()]*(?:\([^()]*\)[^()]*)*?)\)?|\s*\((?P<inner>[^()]*/[^()]*|g|N)\)"
    r"|\s*\([A-Z]\)|\s*FS)?"
)
_VOLT_LEVELS = {"V": "1 V rms", "mV": "1 mV rms", "uV": "1 uV rms", "µV": "1 uV rms"}
_VOLT_LEVELS["u"] = "0.7746 V rms"

_Powers = tuple[int, int, int, int, int]  # of metre, kilogram, second, ampere and radian
_VOLT: _Powers = (2, 1, -3, -1, 0)
_DIMENSIONS: dict[str, _Powers] = {
    "force": (1, 1, -2, 0, 0),
    "displacement": (1, 0, 0, 0, 0),
    "velocity": (1, 0, -1, 0, 0),
    "acceleration": (1, 0, -2, 0, 0),
    "voltage": _VOLT,
    "frequency": (0, 0, -1, 0, 0),
    "angle": (0, 0, 0, 0, 1),
    "time": (0, 0, 1, 0, 0),
    "mass": (0, 1, 0, 0, 0),
}
_PI = "3.141592653589793238462643383279502884"
# Spellings, factor to SI, powers. In vibration tests g is gravity, never gram, and lb a force.
_KNOWN: tuple[tuple[str, Decimal, _Powers], ...] = (
    ("m meter metre", Decimal(1), _DIMENSIONS["displacement"]),
    ("in inch", Decimal("0.0254"), _DIMENSIONS["displacement"]),
    ("ft foot feet", Decimal("0.3048"), _DIMENSIONS["displacement"]),
    ("mil mils thou", Decimal("0.0000254"), _DIMENSIONS["displacement"]),
    ("micron", Decimal("1e-6"), _DIMENSIONS["displacement"]),
    ("ips", Decimal("0.0254"), _DIMENSIONS["velocity"]),
    ("g G gn g_n gs", Decimal("9.80665"), _DIMENSIONS["acceleration"]),
    ("N newton Newton", Decimal(1), _DIMENSIONS["force"]),
    ("lbf lb lbs", Decimal("4.4482216152605"), _DIMENSIONS["force"]),
    ("kgf kp", Decimal("9.80665"), _DIMENSIONS["force"]),
    ("V volt Volt", Decimal(1), _VOLT),
    ("A ampere", Decimal(1), (0, 0, 0, 1, 0)),
    ("s sec second", Decimal(1), _DIMENSIONS["time"]),
    ("min minute", Decimal(60), _DIMENSIONS["time"]),
    ("h hour", Decimal(3600), _DIMENSIONS["time"]),
    ("kg", Decimal(1), _DIMENSIONS["mass"]),
    ("Hz hertz", Decimal(1), _DIMENSIONS["frequency"]),
    ("rpm", Decimal(_PI) / 30, (0, 0, -1, 0, 1)),
    ("rad radian", Decimal(1), _DIMENSIONS["angle"]),
    ("deg degree Grad", Decimal(_PI) / 180, _DIMENSIONS["angle"]),
    ("Pa pascal", Decimal(1), (-1, 1, -2, 0, 0)),
    ("1", Decimal(1), (0, 0, 0, 0, 0)),
)
_UNITS = {name: (factor, powers) for names, factor, powers in _KNOWN for name in names.split()}
_ALONE = {"1", "G", "gs", "ips", "mils", "lb", "lbs", "h", "min"}  # without a prefix
_GRAM = (Decimal("0.001"), _DIMENSIONS["mass"])
_PREFIXES = {
    **{"n": -9, "u": -6, "m": -3, "c": -2, "d": -1, "h": 2, "k": 3, "M": 6, "G": 9},
    **{"nano": -9, "micro": -6, "milli": -3, "centi": -2, "kilo": 3, "mega": 6},
}
_SPELLED = {
    prefix + name: (factor.scaleb(power), powers)
    for prefix, power in reversed(_PREFIXES.items())
    for name, (factor, powers) in (_UNITS | {"g": _GRAM}).items()
    if name not in _ALONE
} | _UNITS
_MOTIONS = ("displacement", "velocity", "acceleration")
_WITH_VOLTS = ("force", *_MOTIONS)


class UnitMeaning(NamedTuple):
    """Meaning of a unit: a number in it times `factor` is in the SI unit of `dimension`.

    `dimension` is a quantity of a channel, or "frequency" (SI unit rad/s), "angle" (rad), "time",
    "mass", "other". For a sensitivity ("10.2 mV/g") it is the measured quantity, and `per_volt`
    is true; for a motion per force ("g/N", "(1/lbf)*(m/s^2)") it is the motion, `factor` is in its
    SI unit per newton, and `per_force` is true. `amplitude` is the suffix ("g rms"): "rms", "peak",
    "peak_to_peak", or empty.
    """

    dimension: str
    factor: float
    amplitude: str = ""
    per_volt: bool = False
    per_force: bool = False

    @property
    def quantity(self) -> Quantity:
        """The quantity of a channel in that unit."""
        known: tuple[Quantity, ...] = get_args(Quantity)
        return next((quantity for quantity in known if quantity == self.dimension), "unknown")


@functools.lru_cache(maxsize=1024)
def unit_meaning(text: str) -> UnitMeaning:
    """Meaning of a unit: "N", "m/s²", "g" (gravity), "in/s", "lbf", "10.2 mV/g", "mm/s rms".

    An empty text, "EU" and "-" are of unknown dimension with the factor 1. Other units than those
    of the table in this module are Pint's, if installed.
    Raises `ValueError` for a text that is no unit.

    >>> unit_meaning("g").factor, unit_meaning("mm/s").dimension
    (9.80665, 'velocity')
    """
    plain = text.strip().strip("[]").strip()
    if level_reference(plain) is not None:
        raise _not_understood(text, ", but is a level")
    if plain.lower() in _NOTHING:
        return UnitMeaning("unknown", 1.0)
    if len(plain) > _LONGEST or not _ALLOWED.fullmatch(plain):
        raise _not_understood(text)
    plain, tail = without_amplitude_kind(plain)
    amplitude = amplitude_kind(tail)
    number = _NUMBER.match(plain)
    value = float(number[1]) if number else 1.0
    if number:
        plain = plain[number.end() :].strip()
        plain = f"1{plain}" if plain.startswith("/") else plain
    if value <= 0 or not math.isfinite(value) or not plain:
        raise _not_understood(text)
    factor, powers = _parsed(plain, text)
    for dimension in _WITH_VOLTS:
        if powers[:4] == _product(_VOLT, _DIMENSIONS[dimension], -1)[:4]:
            return UnitMeaning(dimension, 1 / (value * factor), amplitude, True)
        if powers[:4] == _product(_DIMENSIONS[dimension], _VOLT, -1)[:4]:
            return UnitMeaning(dimension, value * factor, amplitude, True)
    for dimension in _MOTIONS:
        ratio = _product(_DIMENSIONS[dimension], _DIMENSIONS["force"], -1)
        if powers[:4] == ratio[:4]:
            return UnitMeaning(dimension, value * factor, amplitude, per_force=True)
    alike = (name for name, of in _DIMENSIONS.items() if powers[:4] == of[:4])
    dimension = next(alike, "other")
    if dimension == "frequency" and not powers[4]:
        factor *= HERTZ
    if dimension == "angle" and not powers[4]:
        dimension = "other"
    return UnitMeaning(dimension, value * factor, amplitude)


def meaning_or_none(text: str) -> UnitMeaning | None:
    """`unit_meaning` of a text, or None where it is no unit."""
    try:
        return unit_meaning(text)
    except InputError:
        return None


def level_reference(text: str) -> str | None:
    """The reference of a level in dB as a unit, "" if unknown, None if no level.

    >>> [level_reference(unit) for unit in ("dB re 1e-9 m/s", "dB (ref. g/N)", "dBV", "dB", "m/s")]
    ['1e-9 m/s', 'g/N', '1 V rms', '', None]
    """
    plain = text.strip().strip("[]").strip()
    match = _LEVEL.fullmatch(plain)
    if match is None:
        return "" if re.match(r"d[Bb](?!ar)|DB|[Dd]ecibel", plain) else None
    if match["volt"]:
        return _VOLT_LEVELS[match["volt"]]
    reference = (match["reference"] or match["inner"] or "").strip()
    power = re.match(r"10\s*(?:\^\s*\(?|\*\*)?\s*([-−⁻][0-9¹²³⁴⁵⁶⁷⁸⁹]{1,2})\)?\s*", reference)
    if power:
        digits = power[1].translate(str.maketrans("−⁻¹²³⁴⁵⁶⁷⁸⁹", "--123456789"))
        reference = f"1e{digits} {reference[power.end() :]}"
    return f"{reference} {match['size'] or ''}".strip()


def amplitude_kind(text: str) -> str:
    """Kind of amplitudes stated by a unit or a name: "rms", "peak", "peak_to_peak", or "".

    >>> [amplitude_kind(text) for text in ("N rms", "Kraft eff.", "v_pk_pk", "effort")]
    ['rms', 'rms', 'peak_to_peak', '']
    """
    match = _AMPLITUDE_WORD.search(text)
    return (match.lastgroup or "") if match else ""


def without_amplitude_kind(text: str) -> tuple[str, str]:
    """A unit or a name without the amplitude kind at its end, and that word.

    >>> [without_amplitude_kind(text) for text in ("Kraft (N) eff.", "mm/s [rms]", "Kraft (N eff)")]
    [('Kraft (N)', 'eff.'), ('mm/s', '[rms]'), ('Kraft (N eff)', '')]
    """
    match = _AMPLITUDE_SUFFIX.search(text)
    return (text[: match.start()].strip(), match[0].strip(" _,")) if match else (text, "")


def amplitude_words_removed(text: str) -> str:
    """A name without all words for an amplitude kind.

    >>> amplitude_words_removed("F_eff"), amplitude_words_removed("rms force")
    ('F_', ' force')
    """
    return _AMPLITUDE_WORD.sub("", text)


def unit_in_table(text: str) -> str:
    """A name's ending as a unit of the table in this module, for `unit_meaning`; empty if none.

    Pint's units are excluded, since they include words like point and hand. "_" means "/".

    >>> unit_in_table("mm_s"), unit_in_table("Deg"), unit_in_table("m/s²"), unit_in_table("point")
    ('mm/s', 'deg', 'm/s²', '')
    """
    plain = re.sub(r"_per_|_", "/", text)
    words = re.findall(r"[^\W\d]+", plain.translate(_AS_PYTHON))
    known = {word: word if word in _SPELLED else _in_another_case(word) for word in words}
    if not re.match(r"[^\W\d]|[(°]", plain) or not all(known.values()):
        return ""
    plain = re.sub(r"[A-Za-z]+", lambda match: known.get(match[0], match[0]), plain)
    return "" if meaning_or_none(plain) is None else plain


def channel_meaning(text: str) -> tuple[Quantity, float]:
    """Quantity and calibration of a channel whose file states a unit; unknown where unreadable.

    For a motion per force they are those of the motion, per newton.
    """
    meaning = meaning_or_none(text)
    if meaning is None or meaning.quantity == "unknown" or meaning.per_volt:
        return "unknown", 1.0
    return meaning.quantity, meaning.factor


def is_per_force(text: str) -> bool:
    """Whether a unit is a motion per force, as "g/N"."""
    meaning = meaning_or_none(text)
    return meaning is not None and meaning.per_force


def _not_understood(text: str, why: str = "") -> InputError:
    return InputError(f"{shown(text)} is not understood as a unit{why}.")


def _product(first_powers: _Powers, other: _Powers, power: int) -> _Powers:
    """The powers of a product of `first_powers` and `other` to a power."""
    first, second, third, fourth, fifth = (
        a + power * b for a, b in zip(first_powers, other, strict=True)
    )
    return first, second, third, fourth, fifth


def _parsed(plain: str, text: str) -> tuple[float, _Powers]:
    """Factor to SI and powers of a unit without number and suffix."""
    words = plain.translate(_AS_PYTHON)
    words = re.sub(r"(?<=[A-Za-z])\^?(-?[1-9])(?![0-9])", r"^\1", words)
    # pC/N has the dimension of m/V, but a charge needs the amplifier's gain: refused.
    if re.search(r"(?<![A-Za-z])[a-z]?C(?![A-Za-z])", words) or _ODD.search(words):
        raise _not_understood(text)
    times = re.sub(r"(?<=[\w)])\s+(?=[\w(])", "*", words.strip())
    named = re.sub(r"[^\W\d]+", r"u_\g<0>", times).replace("^", "**")  # "in" is a Python keyword
    try:
        scale, powers = _evaluated(ast.parse(named, mode="eval").body)
    except ImportError as error:
        needed = " without the package pint (pip install 'snrmjax[lab]')"
        raise _not_understood(text, needed) from error
    except Exception as error:  # Pint has many, AssertionError and tokenize's among them
        raise _not_understood(text) from error
    factor = float(scale)
    if not (math.isfinite(factor) and factor > 0):
        raise _not_understood(text)
    return factor, powers


def _evaluated(node: ast.expr) -> tuple[Decimal, _Powers]:
    """A product, quotient or power of units."""
    match node:
        case ast.Name(id=name):
            return _unit(name.removeprefix("u_"))
        case ast.Constant(value=1):
            return Decimal(1), (0, 0, 0, 0, 0)
        case ast.BinOp(op=ast.Mult() | ast.Div() as op, left=left, right=right):
            (scale, powers), (other, others) = _evaluated(left), _evaluated(right)
            sign = 1 if isinstance(op, ast.Mult) else -1
            return scale * other**sign, _product(powers, others, sign)
        case ast.BinOp(op=ast.Pow(), left=left, right=right):
            scale, powers = _evaluated(left)
            exponent = ast.literal_eval(right)
            return scale**exponent, _product((0, 0, 0, 0, 0), powers, exponent)
    raise InputError("neither a product nor a power of units")


def _in_another_case(name: str) -> str:
    """The unique unit without prefix that matches except for case: "Deg", "HZ"; empty if none."""
    alike = [known for known in _UNITS if len(known) > 1 and known.lower() == name.lower()]
    return alike[0] if len({_UNITS[known] for known in alike}) == 1 else ""


def _unit(name: str) -> tuple[Decimal, _Powers]:
    """A unit by name, with prefix or plural; by Pint if not in the table."""
    singular = name[:-1] if len(name) > 3 and name[-1] == "s" else name
    for word in (name, singular, _in_another_case(name)):
        if word in _SPELLED:
            return _SPELLED[word]
    base = _registry().Quantity(Decimal(1), _registry().parse_units(name)).to_base_units()
    of = {str(key).strip("[]"): int(power) for key, power in base.dimensionality.items()}
    length, mass, time, current = (of.pop(key, 0) for key in ("length", "mass", "time", "current"))
    radians = int("radian" in str(base.units))
    return base.magnitude, (0, 0, 0, 0, 0) if of else (length, mass, time, current, radians)


@functools.cache
def _registry() -> Any:
    return importlib.import_module("pint").UnitRegistry(non_int_type=Decimal, cache_folder=None)
