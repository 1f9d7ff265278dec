"""The columns of a steady-state table, and the checks of its header."""

import re
from collections.abc import Iterable
from typing import NamedTuple

from snrmjax.io.rows import Cells, shortened_name
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.names import near_miss
from snrmjax.numerics.rules import (
    FRACTION,
    IN_RANGE_HZ,
    NOT_NEGATIVE,
    POSITIVE,
    SHORT,
    WHOLE,
    InputError,
    Rule,
)

PHASOR = ("velocity_re_m_s", "velocity_im_m_s")
"""Real and imaginary part of the fundamental."""

AMPLITUDE = "velocity_m_s"
"""The amplitude of the fundamental: used where both parts of the phasor are missing."""

REQUIRED: dict[str, tuple[Rule, ...]] = {
    "level": (WHOLE, SHORT),
    "frequency_hz": (POSITIVE, IN_RANGE_HZ),
    **dict.fromkeys(PHASOR, ()),
}
"""Columns of every table, in addition to `force_n` or `drive_v`, with rules for their numbers."""

FORCES: dict[str, tuple[Rule, ...]] = {"force_n": (POSITIVE,), "drive_v": (POSITIVE,)}
"""Exactly one of these columns is required, or both parts of a base acceleration."""

BASE = ("base_acceleration_re_m_s2", "base_acceleration_im_m_s2")
"""Phasor of the base acceleration, in place of a force."""

BASE_STD = "base_acceleration_std_m_s2"
"""1σ of the base acceleration."""

OPTIONAL: dict[str, tuple[Rule, ...]] = {
    "velocity_std_m_s": (NOT_NEGATIVE,),
    "phase_std_deg": (NOT_NEGATIVE,),
    "force_std_n": (NOT_NEGATIVE,),
    "order": (FRACTION,),
    "harmonic_std_m_s": (NOT_NEGATIVE,),
}
"""Optional columns of numbers; a field may be empty."""

_KNOWN = frozenset(
    (*REQUIRED, *FORCES, *BASE, BASE_STD, *OPTIONAL, "sensor")
)  # all except the harmonics
_STEMS = {
    stem: name for name in _KNOWN if (stem := re.sub(r"_(hz|n|v|m_s|m_s2|deg)$", "", name)) != name
}
# Units that may follow a stem where the column is meant, but in another unit.
_UNIT = re.compile(
    r"[kmg]?hz|(?:m?rad|deg(?:rees?)?)(?:_?s|_per_s)?|[rc]pm|[kmun]?n|newtons?|lbf?|kgf|[kmu]?v|"
    r"volts?|(?:[kcmun]?m|in|ft)(?:_s2?|_h|_per_s)?|ips|g|m?s|percent|pct|db|rel|rms(?:_m_s)?"
)
_HARMONIC = re.compile(r"velocity_h(?:0|([2-9]|[1-9][0-9]{1,3})_(?:re|im))_m_s")
_LIKE_HARMONIC = re.compile(r"velocity_h([0-9]+)(.*)")


class Header(NamedTuple):
    """The columns used, the harmonic orders among them, and notes."""

    used: frozenset[str]
    harmonic_order: tuple[int, ...]
    notes: tuple[Fact, ...]

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


def is_ours(names: Iterable[str]) -> bool:
    """Whether the names are those of our format; its reader then reports any error."""
    return {"frequency_hz", "velocity_re_m_s"} <= {*names} or {
        *("frequency_hz", AMPLITUDE, "level")
    } <= {*names}


def read_header(cells: Cells, *, force_known: bool = False) -> Header:
    """The columns of a steady-state table.

    Raises `ValueError` for a missing or wrongly suffixed column.
    """
    names, file = [name for name in cells.names if name], cells.file
    notes = [
        Fact("column_without_name", number=k + 1, file=file)
        for k, name in enumerate(cells.names)
        if not name
    ]
    used = {name for name in names if name in _KNOWN or _HARMONIC.fullmatch(name)}
    if AMPLITUDE in names and used.isdisjoint(PHASOR):
        used.add(AMPLITUDE)
    further = [name for name in names if name not in used]
    for name in further:
        expected = _misnamed(name)
        other_force_known = expected in FORCES and not used.isdisjoint(FORCES)
        if expected is not None and (expected in used or not other_force_known):
            raise InputError(
                f"the column `{shortened_name(name)}` of {file} is not one of the format: "
                f"expected `{expected}`."
            )
    _require(used, further, file, force_known)
    for name in further:
        near = near_miss(name, sorted(_KNOWN - used), cutoff=0.8) or ""
        notes.append(Fact("column_not_used", name=shortened_name(name), file=file, near=near))
    return Header(frozenset(used), _harmonic_orders(used, file), tuple(notes))


def _require(used: set[str], further: list[str], file: str, force_known: bool) -> None:
    """Refuse a header that lacks a column or has both force and drive."""

    def instead(name: str) -> str:
        """The column that was perhaps meant by a missing one."""
        near = near_miss(name, further)
        return "" if near is None else f" (is it `{shortened_name(near)}`?)"

    for name in REQUIRED:
        if name not in used and not (name in PHASOR and AMPLITUDE in used):
            raise InputError(f"{file} lacks the column `{name}`{instead(name)}.")
    forces = used.intersection(FORCES)
    _require_base(used, forces, file)
    if BASE[0] in used:
        return
    if not forces and not force_known:
        near = instead("force_n") or instead("drive_v")
        raise InputError(f"{file} lacks the column `force_n` or `drive_v`{near}.")
    if len(forces) == 2:
        raise InputError(
            f"{file} must have either `force_n` or `drive_v`, but has both columns: "
            "`drive_v` is for a force that is only known in volts."
        )


def _require_base(used: set[str], forces: set[str], file: str) -> None:
    """Refuse an incomplete base acceleration, base and force together, and a misplaced 1σ."""
    of_base = used.intersection(BASE)
    if len(of_base) == 1:
        missing = next(name for name in BASE if name not in used)
        raise InputError(f"{file} has the column `{of_base.pop()}`, but lacks `{missing}`.")
    if of_base and forces:
        raise InputError(
            f"{file} must have either a force or the acceleration of a base, but has the columns "
            f"`{sorted(forces)[0]}` and `{BASE[0]}`."
        )
    wrong, right = (("force_std_n", BASE_STD), (BASE_STD, "force_std_n"))[not of_base]
    if wrong in used:
        raise InputError(
            f"{file} has the column `{wrong}`, but "
            + ("a base moves it" if of_base else "no base's acceleration")
            + f": expected `{right}`."
        )


def _harmonic_orders(used: set[str], file: str) -> tuple[int, ...]:
    """The harmonics of a table, each complete."""
    orders = set()
    for match in filter(None, map(_HARMONIC.fullmatch, sorted(used))):
        order = int(match[1] or 0)
        for partner in harmonic_columns(order):
            if partner not in used:
                raise InputError(f"{file} has the column `{match[0]}`, but lacks `{partner}`.")
        orders.add(order)
    return tuple(sorted(orders))


def _misnamed(name: str) -> str | None:
    """The column that an unknown name must mean, or None."""
    plain = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
    if plain in _KNOWN:
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
