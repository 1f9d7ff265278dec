"""Bands of curves over all members: where half of them lie, 95 % of them, and all of them."""

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.report.study.scalars import force_texts, readable
from snrmjax.study.computations.base import MEMBER
from snrmjax.study.computations.responses import bounds_over

if TYPE_CHECKING:
    import xarray

SAMPLED = 4096
"""Curves, drawn at random, of which medians and 95 % bands are made where there are more."""

_BLOCK = 512  # members that are read together
_PLACES = 121  # of a grid that the data set does not have
_GRID, _SHARE = "frequency_hz", "relative_amplitude"
_LEAST = 0.9  # share of the members that must have a curve at a place for its band
_RANGE = (2.5, 50.0, 97.5)


class Band(NamedTuple):
    """Curves of all members over the places of one axis, NaN where few members have a curve."""

    at: Float[np.ndarray, " place"]
    low: Float[np.ndarray, " place"]  # 2.5 %
    median: Float[np.ndarray, " place"]
    high: Float[np.ndarray, " place"]  # 97.5 %
    least: Float[np.ndarray, " place"]
    most: Float[np.ndarray, " place"]


class BandPanel(NamedTuple):
    """What one panel shows: bands of the highest and the lowest value at each place."""

    title: str
    x: str
    y: str
    x_unit: str
    y_unit: str
    upper: Band
    lower: Band | None  # where curves have several values at a place, as around folds


class _Collected:
    """Rows of one curve at a time: extremes of all of them, and a sample for quantiles."""

    def __init__(self, n_members: int, n_places: int) -> None:
        random = np.random.default_rng(0)
        every = np.arange(n_members)
        self.chosen = every if n_members <= SAMPLED else random.choice(every, SAMPLED, False)
        self.rows: list[np.ndarray] = []
        self.least, self.most = np.full(n_places, np.inf), np.full(n_places, -np.inf)

    def add(self, begin: int, rows: np.ndarray) -> None:
        """The curves of members from `begin` on."""
        mine = self.chosen[(self.chosen >= begin) & (self.chosen < begin + len(rows))] - begin
        self.rows.append(rows[mine])
        self.least = np.fmin(self.least, np.fmin.reduce(rows, axis=0))
        self.most = np.fmax(self.most, np.fmax.reduce(rows, axis=0))

    def band(self, at: np.ndarray) -> Band:
        rows = np.concatenate(self.rows)
        has = np.mean(np.isfinite(rows), axis=0) >= _LEAST
        found = np.full((len(_RANGE), len(at)), np.nan)
        if has.any():
            found[:, has] = np.nanpercentile(rows[:, has], _RANGE, axis=0)
        ends = [np.where(np.isfinite(end) & has, end, np.nan) for end in (self.least, self.most)]
        return Band(at, found[0], found[1], found[2], *ends)


class _Curves(NamedTuple):
    """Ragged curves of a data set: which variables they are made of, and what they are called."""

    x: str
    y: tuple[str, ...]  # one, or the two parts of a phasor
    x_label: str
    y_label: str
    y_unit: str

    def height(self, data: "xarray.Dataset", rows: slice) -> Float[np.ndarray, " row"]:
        """What the curves show of some rows."""
        parts = [data[name][rows].values for name in self.y]
        return np.asarray(parts[0] if len(parts) == 1 else np.hypot(*parts))


_RAGGED = (
    _Curves(
        "point_frequency_hz",
        ("point_velocity_re_m_s", "point_velocity_im_m_s"),
        *("Frequency of the force", "Velocity", "m/s"),
    ),
    _Curves(
        *("point_velocity_m_s", ("point_frequency_hz",)), *("Velocity", "Natural frequency", "Hz")
    ),
    _Curves(*("point_velocity_m_s", ("point_damping_ratio",)), *("Velocity", "Damping ratio", "1")),
)


def band_panels(data: "xarray.Dataset") -> list[BandPanel]:
    """The bands that a data set has curves for; none where it has none.

    Blocks of members are read one after another, so memory does not grow with the study.
    """
    if "upper_velocity_m_s" in data:
        return _gridded(data)
    found = []
    for kind in _RAGGED:
        if all(name in data for name in (kind.x, *kind.y)):
            found += _ragged(data, kind)
    if "natural_frequency_hz" in data and data["natural_frequency_hz"].dims == (MEMBER, _SHARE):
        for name in ("natural_frequency_hz", "damping_ratio"):
            found += _identified(data, name)
    return found


def _blocks(n: int) -> Iterator[tuple[int, int]]:
    for begin in range(0, n, _BLOCK):
        yield begin, min(begin + _BLOCK, n)


def _gridded(data: "xarray.Dataset") -> list[BandPanel]:
    at = data[_GRID].values

    def bounds(begin: int, end: int) -> tuple[np.ndarray, np.ndarray]:
        low, high = (data[f"{name}_velocity_m_s"][begin:end].values for name in ("lower", "upper"))
        return low, high

    return _panels(data, bounds, at, ("Frequency of the force", "Velocity", "Hz", "m/s"))


def _ragged(data: "xarray.Dataset", kind: _Curves) -> list[BandPanel]:
    n, count = data.sizes[MEMBER], data["n_points"].values
    if not count.sum():
        return []
    at = np.linspace(*_ends(data, kind.x, count.ravel()), _PLACES)
    first = np.append(0, np.cumsum(count.reshape(n, -1).sum(axis=1)))

    def bounds(begin: int, end: int) -> tuple[np.ndarray, np.ndarray]:
        rows, own = slice(first[begin], first[end]), count[begin:end].ravel()
        curve = np.repeat(np.arange(len(own)), own)
        x, y = data[kind.x][rows].values, kind.height(data, rows)
        begins = np.diff(curve, prepend=-1) != 0
        if "point_branch" in data:
            begins |= np.diff(data["point_branch"][rows].values, prepend=-1) != 0
        return bounds_over(curve, x, y, at, begins, len(own))

    x_unit = "Hz" if kind.x.endswith("_hz") else "m/s"
    return _panels(data, bounds, at, (kind.x_label, kind.y_label, x_unit, kind.y_unit))


def _panels(
    data: "xarray.Dataset",
    bounds: Callable[[int, int], tuple[np.ndarray, np.ndarray]],
    at: Float[np.ndarray, " place"],
    words: tuple[str, str, str, str],
) -> list[BandPanel]:
    """A panel for each force, from the lowest and highest values of some members at a time."""
    titles, n = force_texts(data), data.sizes[MEMBER]
    sets = [(_Collected(n, len(at)), _Collected(n, len(at))) for _ in titles]
    for begin, end in _blocks(n):
        for side, values in enumerate(bounds(begin, end)):
            by_force = values.reshape(end - begin, len(titles), len(at))
            for k, pair in enumerate(sets):
                pair[side].add(begin, by_force[:, k])
    return [
        BandPanel(title, *words, *_pair(pair, at)) for title, pair in zip(titles, sets, strict=True)
    ]


def _identified(data: "xarray.Dataset", name: str) -> list[BandPanel]:
    """Identified curves over their median velocity at each share of the amplitude range."""

    def bounds(begin: int, end: int) -> tuple[np.ndarray, np.ndarray]:
        rows = data[name][begin:end].values
        return rows, rows

    at = np.nanmedian(data["velocity_m_s"].values, axis=0)
    unit = str(data[name].attrs.get("units", ""))
    return _panels(data, bounds, at, ("Velocity", readable(name), "m/s", unit))


def _pair(pair: tuple[_Collected, _Collected], at: np.ndarray) -> tuple[Band, Band | None]:
    """Bands of the highest and the lowest values; of one kind where they are the same."""
    lower, upper = (one.band(at) for one in pair)
    scale = max(np.nanmax(np.abs(upper.high), initial=0.0), 1e-300)
    apart = np.zeros(len(at), dtype=bool)
    for one, other in zip(upper[1:], lower[1:], strict=True):
        apart |= np.abs(one - other) > 1e-3 * scale
    if not apart.any():
        return upper, None
    first, last = np.flatnonzero(apart)[[0, -1]]
    drawn = (np.arange(len(at)) >= first - 1) & (np.arange(len(at)) <= last + 1)
    own = [np.where(drawn, one, np.nan) for one in lower[1:]]
    return upper, Band(at, *own)


def _ends(data: "xarray.Dataset", name: str, count: np.ndarray) -> tuple[float, float]:
    """Between which values `_LEAST` of the curves have points, read in blocks of curves."""
    low, high, row = [], [], 0
    own = count[count > 0]
    for begin, end in _blocks(len(own)):
        ends = row + np.cumsum(own[begin:end])
        values = data[name][row : int(ends[-1])].values
        first = ends - own[begin:end] - row
        low.append(np.minimum.reduceat(values, first))
        high.append(np.maximum.reduceat(values, first))
        row = int(ends[-1])
    begins, stops = np.concatenate(low), np.concatenate(high)
    return float(np.quantile(begins, _LEAST)), float(np.quantile(stops, 1 - _LEAST))
