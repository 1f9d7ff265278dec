"""Standard deviations of a table's amplitudes and phases, as lock-in amplifiers list them."""

import re

import numpy as np
from jaxtyping import Float

from snrmjax.io.exchange.import_map import Assumption, Assumptions, ImportMap, ResponseMap
from snrmjax.io.exchange.import_units import require_name
from snrmjax.io.laboratory.contents import NumberTable
from snrmjax.io.laboratory.names import role_of

_DEVIATION = re.compile(r"stdev|stddev|std|sigma|deviation|dev")
_OF_ONE_ROW = Assumption("1σ of the row, by its name (if of each of N readings: divide by √N)")


def with_errors_by_name(
    table: NumberTable, told: ResponseMap, assumed: Assumptions, number: int
) -> ResponseMap:
    """A response with the columns of its errors: those that are named after it and its phase."""
    phase = told.phase
    if not phase:
        phases = [name for name in table.columns if role_of(name) == "phase"]
        phase = phases[0] if len(phases) == 1 else ""
    found = {"amplitude_std": told.channel, "phase_std": phase}
    for key, of in found.items():
        name = "" if getattr(told, key) or not of else _error_of(of, table)
        if name:
            told = told._replace(**{key: name})
            assumed[f"response {number}.{key}"] = _OF_ONE_ROW
    return told


def response_errors(
    table: NumberTable,
    told: ResponseMap,
    whole: ImportMap,
    file: str,
    scale: Float[np.ndarray, " row"],
) -> Float[np.ndarray, "2 row"]:
    """1σ of the velocity (m/s) and of the phase (rad) of every row; NaN where none is stated.

    Arguments: `scale` is what an amplitude of the table is multiplied with; phases' errors have
    the unit of the phases.
    Raises `ValueError` for a column that is missing or has negative numbers.
    """
    missing = np.full(table.n_rows, np.nan)
    amplitude = _deviations(table, told.amplitude_std, file, "--amplitude-std")
    phase = _deviations(table, told.phase_std, file, "--phase-std")
    turn = 1.0 if _in_radians(table, told, whole) else np.pi / 180
    return np.stack(
        [
            missing if amplitude is None else amplitude * scale,
            missing if phase is None else phase * turn,
        ]
    )


def _in_radians(table: NumberTable, told: ResponseMap, whole: ImportMap) -> bool:
    """Whether an error of the phase is in radians: as its name, its unit or the phase's says."""
    for name in (told.phase_std, told.phase):
        unit = table.units.get(name, "").lower()
        if unit.startswith("rad") or re.search(r"rad(?![a-z])", name.lower()):
            return True
        if unit.startswith(("deg", "°")) or re.search(r"deg", name.lower()):
            return False
    return whole.phase_unit == "rad"


def _error_of(name: str, table: NumberTable) -> str:
    """The column whose name is this one with a word for a deviation; empty unless it is one."""
    stem = _bare(name)
    found = [one for one in table.columns if role_of(one) == "deviation" and _bare(one) == stem]
    return found[0] if len(found) == 1 else ""


def _bare(name: str) -> str:
    """A name in small letters without its unit and without a word for a deviation.

    >>> _bare("R"), _bare("R_std"), _bare("Theta [deg]"), _bare("ThetaDev"), _bare("phase_std_deg")
    ('r', 'r', 'theta', 'theta', 'phase')
    """
    plain = re.sub(r"[\[(].*[\])]\s*$", "", name.strip()).lower()
    letters = re.sub(r"[\s_.\-]", "", _DEVIATION.sub("", plain))
    return re.sub(r"(deg|rad)$", "", letters)


def _deviations(
    table: NumberTable, name: str, file: str, option: str
) -> Float[np.ndarray, " row"] | None:
    if not name:
        return None
    require_name(option, name, table.columns, "columns", file)
    values = np.real(np.asarray(table.columns[name])).astype(float)
    if np.nanmin(values, initial=0.0) < 0:
        row = int(np.flatnonzero(values < 0)[0]) + 1
        raise ValueError(
            f"{name} of {file} must be standard deviations, not negative, but row {row} has "
            f"{values[row - 1]:g}: {option} names another column."
        )
    return values
