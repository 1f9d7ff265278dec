"""What a study's data set has one number of for every member: outputs and varied quantities."""

import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.report.html import ten_to
from snrmjax.report.style import unit_for
from snrmjax.study.computations.base import FORCE, MEMBER

if TYPE_CHECKING:
    import xarray

_COUNTS = re.compile(r"^(n|first)_")  # counts tell how a computation went, not what it found
_SHARE = "relative_amplitude"
_ENDS = ((0, "smallest"), (-1, "largest"))
_UNITS = re.compile(r"_(m_s|hz|n|j)(?=_at_|$)")  # in names
_FEWEST_DIGITS, _MOST_DIGITS = -2, 4  # powers of ten that axes are written with
_PREFIXED = ("m/s", "N", "J")  # units that read better with a prefix where numbers are small


class Scalar(NamedTuple):
    """One number of every member, NaN where a member has none."""

    name: str  # of the variable
    unit: str
    meaning: str
    values: Float[np.ndarray, " member"]
    force: float | None = None  # N, where members are computed for several forces
    at_force: str = ""  # the same in words

    @property
    def label(self) -> str:
        """As figures name it, without its unit."""
        return readable(self.name)

    @property
    def title(self) -> str:
        """As tables name it."""
        return f"{self.label} at {self.at_force}" if self.at_force else self.label

    @property
    def is_count(self) -> bool:
        """Whether it counts something, such as folds or points."""
        return bool(_COUNTS.match(self.name))

    @property
    def varies(self) -> bool:
        """Whether at least two members differ by more than rounding."""
        found = self.values[np.isfinite(self.values)]
        return found.size > 1 and bool(np.ptp(found) > 1e-12 * np.max(np.abs(found)))


class Display(NamedTuple):
    """How numbers are shown: divided by `size`, in `unit`."""

    size: float
    unit: str

    def labelled(self, text: str) -> str:
        """A label with the unit."""
        return f"{text} ({self.unit})" if self.unit else text


def display(values: Float[np.ndarray, "..."], unit: str) -> Display:
    """The unit in which values of this unit read well."""
    if unit in _PREFIXED and np.any(np.isfinite(values)):
        return Display(*unit_for(values, unit))
    return Display(1.0, "" if unit == "1" else unit)


def display_on_axis(values: Float[np.ndarray, "..."], unit: str) -> Display:
    """The same for an axis, with a power of ten where numbers are very large or very small."""
    shown = display(values, unit)
    largest = np.max(np.abs(values), initial=0.0, where=np.isfinite(values)) / shown.size
    power = 0 if largest == 0 else int(np.floor(np.log10(largest)))
    if _FEWEST_DIGITS <= power <= _MOST_DIGITS:
        return shown
    return Display(shown.size * 10.0**power, f"{ten_to(power)} {shown.unit}".rstrip())


def readable(name: str) -> str:
    """A variable's name as words: "peak_velocity_m_s" is "Peak velocity"."""
    text = _UNITS.sub("", re.sub("^n_", "number_of_", name)).replace("_", " ")
    return text[:1].upper() + text[1:]


def force_texts(data: "xarray.Dataset") -> list[str]:
    """The forces of a study in words, in one unit; one empty text where there is one force only."""
    if FORCE not in data.dims:
        return [""]
    forces = data[FORCE].values
    unit = unit_for(forces.min(), "N")
    return [f"{force / unit.size:.4g} {unit.name}" for force in forces.tolist()]


def varied_quantities(data: "xarray.Dataset") -> dict[str, Float[np.ndarray, " member"]]:
    """Values of every quantity that varies, by name."""
    names = [str(name) for name, one in data.coords.items() if one.dims == (MEMBER,)]
    return {
        name: np.asarray(data[name].values, dtype=np.float64) for name in names if name != MEMBER
    }


def varied_unit(data: "xarray.Dataset", name: str) -> str:
    """The unit of a varied quantity, empty where it is not stated."""
    return str(data[name].attrs.get("units", ""))


def scalars(data: "xarray.Dataset") -> Iterator[Scalar]:
    """Every output that is one number a member, one at a time, and one for each force.

    Beside the variables over `member` alone: the lowest and the highest frequency of a fold, and
    identified curves at the smallest and the largest amplitude.
    """
    for name, variable in data.data_vars.items():
        text = str(name)
        if variable.dtype.kind not in "fi" or text.startswith("first_"):
            continue
        meaning, unit = variable.attrs.get("long_name", ""), variable.attrs.get("units", "")
        if variable.dims in ((MEMBER,), (MEMBER, FORCE)):
            yield from _by_force(data, text, unit, meaning, variable.values)
        elif variable.dims == (MEMBER, _SHARE):
            for k, which in _ENDS:
                words = f"{meaning}, at the {which} amplitude"
                ended = f"{text}_at_{which}_amplitude"
                yield from _by_force(data, ended, unit, words, variable[:, k].values)
    if "fold_frequency_hz" in data:
        folds = data["fold_frequency_hz"].values
        counts, first = data["n_folds"].values, data["first_fold"].values
        for name, reduce in (("lowest", np.fmin), ("highest", np.fmax)):
            values = _of_each(folds, first, counts, reduce)
            text = f"{name} frequency at which the response folds"
            yield from _by_force(data, f"{name}_fold_frequency_hz", "Hz", text, values)


def _by_force(
    data: "xarray.Dataset", name: str, unit: str, meaning: str, values: np.ndarray
) -> Iterator[Scalar]:
    numbers = np.asarray(values, dtype=np.float64)
    if numbers.ndim == 1:
        yield Scalar(name, unit, meaning, numbers)
        return
    forces = data[FORCE].values.tolist()
    for k, (force, text) in enumerate(zip(forces, force_texts(data), strict=True)):
        yield Scalar(name, unit, meaning, numbers[:, k], force, text)


def _of_each(
    rows: np.ndarray, first: np.ndarray, count: np.ndarray, reduce: np.ufunc
) -> np.ndarray:
    """A reduction over each member's rows of a ragged variable, NaN for a member without any."""
    found = np.full(count.shape, np.nan)
    has = count > 0
    if has.any():
        # Rows are in the order of members: one's end is the next one's beginning.
        found[has] = reduce.reduceat(rows, first[has])
    return found
