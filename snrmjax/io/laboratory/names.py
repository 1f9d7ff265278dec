"""Interpretation of column and variable names in several languages."""

import re
from collections.abc import Mapping
from typing import NamedTuple

from snrmjax.io.laboratory.physical_units import (
    amplitude_words_removed,
    level_reference,
    meaning_or_none,
    unit_in_table,
    unit_meaning,
    without_amplitude_kind,
)

_QUANTITIES = ("force", "drive", "displacement", "velocity", "acceleration", "frequency", "time")
_BY_UNIT = {one: one for one in _QUANTITIES} | {"angle": "phase", "voltage": "drive"}
_ROLES = {
    "time": r"t|time|times|zeit|temps|tiempo|time_?(axis|vector|stamp|sec)|x_?time",
    "rate": r"fs|f_s|fsamp|sr|rate|samp(le|ling)?_?(rate|freq(uency)?)|abtast(rate|freq\w*)|"
    r"fr[ée]q\w*_d_[ée]chantillonnage",
    "step": r"dt|delta_?t|d_t|sample_?(time|interval)|time_?step|wf_increment|ts|increment",
    "frequency": r"f|freq\w*|\w*frequenz\w*|fr[ée]q\w*|(drive|excitation|forcing)_?freq\w*|"
    r"f_?exc|omega\w*|w|frf_?freq",
    "level": r"levels?|lvl|run|stufe|niveau|setpoint|block|sweep|entry|z_axis_value",
    "deviation": r"\w*(std|sigma|dev|deviation|uncert\w*)\w*",
    "phase": r"\w*(pha(se|z)|phasage)\w*|phi\w*|(\w*_)?ph|theta\w*|arg\w*",
    "real": r"x|\w+[_. ](re|real|x)|re|real|(re|real)[_ ]\w+|in_?phase",
    "imaginary": r"y|\w+[_. ](im|imag|y)|im|imag|(im|imag)[_ ]\w+|quad\w*",
    "drive": r"\w*(drive|volt\w*|source|generator|amplifier|signal|spannung)\w*|"
    r"v_?(in|out|exc)|u",
    "force": r"\w*(force|kraft|load_?cell|hammer|impedance_?head_?f)\w*|fexc|f_?amp\w*|lc\w*",
    "mark": r"flags?|\w*_flags?|valid\w*|ok|is_\w+|overload\w*|ovld?|clipped|settled|converged|"
    r"status|quality|mask|reject\w*|outlier\w*|n?_?(avg|averages)|error_?code\w*",
    "coherence": r"\w*coh\w*",
    "velocity": r"\w*(velo\w*|vibrometer|ldv|geschw\w*|vitesse)|v|vel\w*",
    "acceleration": r"\w*(acc\w*|beschl\w*)|a",
    "displacement": r"\w*(disp\w*|weg|position|d[ée]pl\w*|auslenk\w*)\w*|d",
    "amplitude": r"\w*(amp\w*|magn\w*|abs)|r|h|frf\w*|response\w*|xfer|transfer\w*|\w*laser\w*",
}
_COMPILED = {role: re.compile(pattern, re.IGNORECASE) for role, pattern in _ROLES.items()}

# Dimensions of the units that fit each role.
_FITTING = {
    **{motion: (motion,) for motion in ("displacement", "velocity", "acceleration")},
    **{"time": ("time",), "step": ("time",), "rate": ("frequency",), "frequency": ("frequency",)},
    **{"phase": ("angle",), "force": ("force",), "drive": ("voltage", "force"), "coherence": ()},
}
_SYMBOLS = {"f": ("frequency", "force"), "w": ("frequency",)}  # w may be a deflection, too
# Without time, which is stated by name, and voltage, which any sensor may have.
_KNOWN_BY_UNIT = ("force", "displacement", "velocity", "acceleration", "frequency", "angle")
# Units that also mean something else: in, left bottom, radial, gradient, gain.
_WORDS = ("in", "lb", "lbs", "gs", "gn", "kp", "rad", "Grad", "mil", "mils", "thou", "ft", "foot")
_ALONE = ("N", "rad", "Grad")  # of these and of single letters, the ones accepted as a whole name

_BOUNDARY = re.compile(
    r"\s(?:in|en)\s+|[\s_/,.\-]+|(?<=[a-z0-9])(?=[A-Z])|(?<=[a-zA-Z])(?=°)"
    r"|(?<=[a-fh-z])(?=(?:deg|rad|hz)$)"
)
_IN_BRACKETS = re.compile(r"^(.*?)\s*(?:\[([^\[\]]*)\]|\(((?:[^()]|\([^()]*\))*)\))$")
_DATE = re.compile(r"[0-9]+[-/.:][0-9]+[-/.:]|[0-9]:[0-9]")  # dates and times of day are no units

# Levels: "vel_dB", "Mag [dB re 1 m/s]", "20*log10(|v|)".
_LEVEL = re.compile(r"(?<![^\W\d_])(?:d[Bb]|DB|[Dd]ecibels?)(?:V|u|[mµu]V)?(?!\w).*$|(?<=[a-z])dB$")
_LOGARITHM = re.compile(r"20\s*[*·x]?\s*log", re.IGNORECASE)

_BASE = re.compile(
    r"(.*[^a-z])?(base|table|shaker|control|ctrl|foot|fixture|slip|basis|tisch|fu[sß]s?punkt|pot)"
    r"([^a-z].*)?",
    re.IGNORECASE,
)


def is_of_base(name: str) -> bool:
    """Whether a name is that of a base motion: a shaker table, a control channel.

    >>> is_of_base("Control [g]"), is_of_base("table_acc"), is_of_base("tip")
    (True, True, False)
    """
    return bool(_BASE.fullmatch(name.strip()[:60]))


class Label(NamedTuple):
    """A column's name split into the word and its unit, if any."""

    word: str
    unit: str = ""
    is_bracketed: bool = False


def label_of(name: str) -> Label:
    """Split a name into word and unit: in brackets, as ending, or the whole name.

    Text in brackets is a unit. An ending is a unit only if unambiguous: the word before it names
    the same quantity ("acc_g", "force_n") or none, and then the unit is not a letter or word of
    another meaning ("tip_mm", but not "ref_m", "x_max_in", "v_rad").

    >>> label_of("Kraft eff. (N)")[:2], label_of("vel_mm_s")[:2], label_of("f/Hz")[:2]
    (('Kraft eff.', 'N'), ('vel', 'mm/s'), ('f', 'Hz'))
    >>> label_of("mm/s")[:2], label_of("g")[:2], label_of("acc_mm_s")[:2]
    (('', 'mm/s'), ('g', ''), ('acc_mm_s', ''))
    """
    plain, amplitude = without_amplitude_kind(name.strip())
    if (level := _level_of(name.strip())) is not None:
        return level
    match = _IN_BRACKETS.match(plain)
    if match and _DATE.search(match[2] or match[3] or ""):
        return Label(name.strip())
    if match:
        word = f"{match[1].rstrip(' /,_-')} {amplitude}".strip()
        return Label(word, (match[2] or match[3] or "").strip(), True)
    for start, end in [(0, 0), *(boundary.span() for boundary in _BOUNDARY.finditer(plain))]:
        word, ending = plain[:start], plain[end:]
        unit = unit_in_table(ending)
        if not unit and len(word) > 1 and len(ending) == 1:  # as in our own "force_n"
            unit = unit_in_table(ending.upper())
        if not unit:
            continue
        if _is_unit_of(word, unit):
            return Label(f"{word} {amplitude}".strip(), unit)
        # The ending belongs to a composite unit (N_m), unless the first letter is a symbol: A_mm.
        if word or not _role_by_name(_BOUNDARY.split(plain)[0]):
            break
    return Label(name.strip())


def column_unit(name: str, stated: str) -> str:
    """The unit of a column: stated, or in its name. dB in the name takes precedence.

    >>> column_unit("vel_mm_s", ""), column_unit("vel", "mm/s"), column_unit("vel_dB", "mm/s")
    ('mm/s', 'mm/s', 'dB')
    """
    named = label_of(name).unit
    is_level = level_reference(named) is not None and level_reference(stated) is None
    return named if is_level or not stated else stated


def _level_of(name: str) -> Label | None:
    """A level's name split, as "vel" and "dB re 1 m/s"; None for no level."""
    match = _LEVEL.search(name)
    if match is None:
        return Label(name, "dB") if _LOGARITHM.search(name) else None
    word, unit = name[: match.start()].rstrip(), match[0]
    is_bracketed = word.endswith(("(", "["))
    if is_bracketed:
        unit = unit.rpartition(")" if word.endswith("(") else "]")[0] or unit
    if level_reference(unit) is None:
        return None
    word = word[:-1].rstrip(" /,_-") if is_bracketed else word.rstrip(" /,_-.")
    return Label(word, unit.strip(), is_bracketed)


def _is_unit_of(word: str, unit: str) -> bool:
    """Whether an ending is a unit that fits the word before it, or the word names no quantity.

    A voltage fits only the drive signal: for a sensor it leaves the sensitivity open.
    """
    meaning, role = unit_meaning(unit), _role_by_name(word)
    is_symbol = word.lower() in _SYMBOLS
    fitting = _SYMBOLS.get(word.lower()) or _FITTING.get(role) or ()
    if meaning.per_volt or (meaning.per_force and not word):
        return False
    if meaning.dimension in fitting:
        return True
    if role in _FITTING and role != "drive" and not is_symbol:
        return False
    is_plain = (len(unit) > 1 and unit not in _WORDS) or unit == "°"
    return meaning.dimension in _KNOWN_BY_UNIT and (is_plain or (not word and unit in _ALONE))


def role_of(name: str, unit: str = "") -> str:
    """Role of a column by its name or, where that is unknown, by its unit; or empty.

    Roles by name are "frequency", "force", "phase", "time", … The name may be a path ("data.freq")
    and contain a unit (`label_of`). Roles by unit are "frequency", "phase", "time", "force",
    "drive" (volts) or a motion; they take precedence over a contradicting name.
    Arguments: `unit` as stated elsewhere in the file, which takes precedence over the name's.

    >>> role_of("data.Frequency [Hz]"), role_of("Kraft (N)"), role_of("fs"), role_of("qwe")
    ('frequency', 'force', 'rate', '')
    """
    label = label_of(name)
    by_name = _role_by_name(label.word)
    stated = unit or label.unit
    if by_name == "level" and level_reference(stated) is not None:
        by_name = "amplitude"  # a level in dB numbers no levels of a test
    meaning = meaning_or_none(level_reference(stated) or stated)
    if meaning is None:
        return by_name
    by_unit = _BY_UNIT.get(meaning.dimension, "")
    is_drive = by_unit == "drive" and by_name != "drive"  # any sensor may be in volts
    plain = not by_name or (by_name in _QUANTITIES and by_unit in _QUANTITIES)
    return by_unit if by_unit and plain and not is_drive else by_name


def listed_name(name: str, units: Mapping[str, str]) -> str:
    """The listed name of a column that may be given as in the file, with its unit in brackets.

    Arguments: `units` of the listed names, "" where unknown.

    >>> listed_name("Kraft (N)", {"Kraft": "N"}), listed_name("Kraft (N)", {"Kraft": "V"})
    ('Kraft', 'Kraft (N)')
    """
    label = label_of(name)
    known = label.is_bracketed and units.get(label.word) == label.unit
    return label.word if known and name not in units else name


def _role_by_name(word: str) -> str:
    """Role of a name without its unit, or empty."""
    last = amplitude_words_removed(word).strip(" ._-").rsplit(".", 1)[-1]
    plain = re.sub(r"[\s\-'’]+", "_", last.strip())[:60]
    if plain == "F":  # f is a frequency
        return "force"
    roles = (role for role, pattern in _COMPILED.items() if pattern.fullmatch(plain))
    return next(roles, "")
