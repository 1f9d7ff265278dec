"""The header of a steady-state table: which column is what, and what is wrong with it."""

import re
from typing import NamedTuple

from snrmjax.io.files import near_miss, shown, suggestion

REQUIRED = ("level", "frequency_hz", "velocity_re_m_s", "velocity_im_m_s")
"""Columns that every table has, beside `force_n` or `drive_v`."""

PHASOR = ("velocity_re_m_s", "velocity_im_m_s")
"""Those of the fundamental."""

AMPLITUDE = "velocity_m_s"
"""The amplitude of the fundamental: in place of both parts of the phasor, and only then."""

FORCES = ("force_n", "drive_v")
"""Columns of which a table has exactly one."""

OPTIONAL = ("velocity_std_m_s", "phase_std_deg", "force_std_n", "order", "harmonic_std_m_s")
"""Columns of numbers that a table may have, and in which a field may be empty."""

KNOWN = frozenset((*REQUIRED, *FORCES, *OPTIONAL, "sensor"))
"""All columns but those of the harmonics."""

_STEMS = {
    "frequency": "frequency_hz",
    "force": "force_n",
    "drive": "drive_v",
    "velocity_re": "velocity_re_m_s",
    "velocity_im": "velocity_im_m_s",
    "velocity_std": "velocity_std_m_s",
    "phase_std": "phase_std_deg",
    "force_std": "force_std_n",
    "harmonic_std": "harmonic_std_m_s",
}

# What stands behind a stem when someone meant the column, but in another unit or in none.
_UNIT = re.compile(
    r"[kmg]?hz|(?:m?rad|deg(?:rees?)?)(?:_?s|_per_s)?|[rc]pm|[kmun]?n|newtons?|lbf?|kgf|[kmu]?v|"
    r"volts?|(?:[kcmun]?m|in|ft)(?:_s2?|_h|_per_s)?|ips|g|m?s|percent|pct|db|rel|rms(?:_m_s)?"
)

_HARMONIC = re.compile(r"velocity_h(?:0|([2-9]|[1-9][0-9]{1,3})_(?:re|im))_m_s")
_LIKE_HARMONIC = re.compile(r"velocity_h([0-9]+)(.*)")
_PLAIN_NUMBER = re.compile(r"[+-]?[0-9.]+(?:[eE][+-]?[0-9]+)?")


class Header(NamedTuple):
    """Where each used column stands (from zero), the harmonics present, and notes."""

    position: dict[str, int]
    n_columns: int
    harmonic_order: tuple[int, ...]
    notes: tuple[str, ...]

    @property
    def harmonics(self) -> tuple[str, ...]:
        """The columns of the harmonics."""
        return tuple(name for k in self.harmonic_order for name in harmonic_columns(k))


def harmonic_columns(order: int) -> tuple[str, ...]:
    """The columns of one harmonic: its real and imaginary part, or the mean.

    >>> harmonic_columns(0), harmonic_columns(3)
    (('velocity_h0_m_s',), ('velocity_h3_re_m_s', 'velocity_h3_im_m_s'))
    """
    if order == 0:
        return ("velocity_h0_m_s",)
    return (f"velocity_h{order}_re_m_s", f"velocity_h{order}_im_m_s")


def read_header(names: list[str], file: str) -> Header:
    """Find the columns of a steady-state table.

    Arguments: `names` from the header row, without spaces around them; `file` as messages name
    it. Raises `ValueError` for a missing, doubled or wrongly suffixed column.

    >>> names = ["force_n", "level", "frequency_hz", "velocity_re_m_s", "velocity_im_m_s"]
    >>> read_header(names, "beam.csv").position["level"]
    1
    """
    if len(names) == 1 and re.search(r"[;\t]", names[0]):
        mark = "semicolons" if ";" in names[0] else "tabs"
        raise ValueError(
            f"the fields of {file} must be separated by commas, but its header row has {mark}."
        )
    if all(_PLAIN_NUMBER.fullmatch(name) for name in names):
        raise ValueError(
            f"row 1 of {file} must be a header row with the names of the columns, "
            f"but has {shown(names[0])}."
        )
    position: dict[str, int] = {}
    notes: list[str] = []
    for k, name in enumerate(names):
        if name == "":
            notes.append(f"column {k + 1} of {file} has no name and is not used.")
        elif name in position:
            raise ValueError(
                f"each column must stand once, but {file} has the column `{_short(name)}` twice "
                f"(columns {position[name] + 1} and {k + 1})."
            )
        else:
            position[name] = k
    used = {name: k for name, k in position.items() if name in KNOWN or _HARMONIC.fullmatch(name)}
    if AMPLITUDE in position and not any(name in position for name in PHASOR):
        used[AMPLITUDE] = position[AMPLITUDE]
    further = [name for name in position if name not in used]
    for name in further:
        expected = _misnamed(name)
        other_force_known = expected in FORCES and any(force in used for force in FORCES)
        if expected is not None and (expected in used or not other_force_known):
            raise ValueError(
                f"the column `{_short(name)}` of {file} is not one of the format: "
                f"expected `{expected}`."
            )
    _require(used, further, file)
    for name in further:
        near = suggestion(name, KNOWN - set(used), cutoff=0.8)
        notes.append(f"the column `{_short(name)}` of {file} is not used{near}.")
    return Header(used, len(names), _harmonic_orders(used, file), tuple(notes))


def _require(used: dict[str, int], further: list[str], file: str) -> None:
    """Refuse a header that lacks a column or has both force and drive."""
    for name in REQUIRED:
        if name not in used and not (name in PHASOR and AMPLITUDE in used):
            raise ValueError(f"{file} lacks the column `{name}`{_instead(name, further)}.")
    forces = [name for name in FORCES if name in used]
    if not forces:
        near = _instead("force_n", further) or _instead("drive_v", further)
        raise ValueError(f"{file} lacks the column `force_n` or `drive_v`{near}.")
    if len(forces) == 2:
        raise ValueError(
            f"{file} must have either `force_n` or `drive_v`, but has both columns: "
            "`drive_v` is for a force that is only known in volts."
        )


def _harmonic_orders(used: dict[str, int], file: str) -> tuple[int, ...]:
    """The harmonics of a table, each complete."""
    orders = set()
    for name in used:
        if name in KNOWN or name == AMPLITUDE:
            continue
        match = _HARMONIC.fullmatch(name)
        order = 0 if match is None or match[1] is None else int(match[1])
        for partner in harmonic_columns(order):
            if partner not in used:
                raise ValueError(f"{file} has the column `{name}`, but lacks `{partner}`.")
        orders.add(order)
    return tuple(sorted(orders))


def _misnamed(name: str) -> str | None:
    """The column that an unknown name must have meant, or nothing."""
    plain = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
    if plain in KNOWN:
        return plain
    harmonic = _LIKE_HARMONIC.fullmatch(plain)
    if harmonic is not None:
        order = harmonic[1].lstrip("0")[:4]
        if order == "":
            return "velocity_h0_m_s"
        part = "im" if "im" in harmonic[2] else "re"
        return f"velocity_{part}_m_s" if order == "1" else f"velocity_h{order}_{part}_m_s"
    for stem, column in _STEMS.items():
        if plain == stem or (
            plain.startswith(f"{stem}_") and _UNIT.fullmatch(plain, len(stem) + 1)
        ):
            return column
    return None


def _instead(name: str, further: list[str]) -> str:
    """The column that may stand for a missing one, ready to end a message, or nothing."""
    near = near_miss(name, further)
    return "" if near is None else f" (is it `{_short(near)}`?)"


def _short(name: str) -> str:
    """A column's name on one line and not too long."""
    text = name if name.isprintable() else ascii(name)
    return text if len(text) <= 40 else f"{text[:37]}..."
