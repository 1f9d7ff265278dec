"""Bands of curves over all members: where half of them lie, 95 % of them, and all of them."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from snrmjax.report.study.scalars import force_texts, readable
from snrmjax.study.computations.base import MEMBER

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
        found += [_identified(data, name) for name in ("natural_frequency_hz", "damping_ratio")]
    return found


def bounds_over(
    curve: Int[np.ndarray, " row"],
    x: Float[np.ndarray, " row"],
    y: Float[np.ndarray, " row"],
    at: Float[np.ndarray, " place"],
    begins: Bool[np.ndarray, " row"],
    n_curves: int,
) -> tuple[Float[np.ndarray, "curve place"], Float[np.ndarray, "curve place"]]:
    """Lowest and highest y of curves made of polylines at rising places x, NaN outside them.

    Arguments: `curve` is the number of the curve of every point, `begins` whether a point begins a
    polyline.
    """
    same = ~begins[1:]
    x0, x1, y0, y1 = (part[same] for part in (x[:-1], x[1:], y[:-1], y[1:]))
    first = np.searchsorted(at, np.minimum(x0, x1), side="left")
    count = np.searchsorted(at, np.maximum(x0, x1), side="right") - first
    segment = np.repeat(np.arange(len(x0)), count)
    place = np.arange(len(segment)) - np.repeat(np.cumsum(count) - count - first, count)
    width = np.where(x1 == x0, 1.0, x1 - x0)
    value = y0[segment] + (at[place] - x0[segment]) / width[segment] * (y1 - y0)[segment]
    of_curve = curve[1:][same][segment]
    low, high = np.full((n_curves, len(at)), np.inf), np.full((n_curves, len(at)), -np.inf)
    np.minimum.at(low, (of_curve, place), value)
    np.maximum.at(high, (of_curve, place), value)
    none = ~np.isfinite(high)
    return np.where(none, np.nan, low), np.where(none, np.nan, high)


def _blocks(n: int) -> Iterator[tuple[int, int]]:
    for begin in range(0, n, _BLOCK):
        yield begin, min(begin + _BLOCK, n)


def _gridded(data: "xarray.Dataset") -> list[BandPanel]:
    at, titles = data[_GRID].values, force_texts(data)
    n = data.sizes[MEMBER]
    sets = [(_Collected(n, len(at)), _Collected(n, len(at))) for _ in titles]
    for begin, end in _blocks(n):
        for side, name in enumerate(("lower_velocity_m_s", "upper_velocity_m_s")):
            rows = data[name][begin:end].values.reshape(end - begin, len(titles), len(at))
            for k, pair in enumerate(sets):
                pair[side].add(begin, rows[:, k])
    return [
        BandPanel(title, "Frequency of the force", "Velocity", "Hz", "m/s", *_pair(pair, at))
        for title, pair in zip(titles, sets, strict=True)
    ]


def _ragged(data: "xarray.Dataset", kind: _Curves) -> list[BandPanel]:
    titles, n = force_texts(data), data.sizes[MEMBER]
    count = data["n_points"].values.reshape(n, len(titles))
    if not count.sum():
        return []
    at = np.linspace(*_ends(data, kind.x, count.ravel()), _PLACES)
    sets = [(_Collected(n, len(at)), _Collected(n, len(at))) for _ in titles]
    row = 0
    for begin, end in _blocks(n):
        own = count[begin:end].ravel()
        rows = slice(row, row + int(own.sum()))
        row = rows.stop
        curve = np.repeat(np.arange(len(own)), own)
        x, y = data[kind.x][rows].values, kind.height(data, rows)
        begins = np.diff(curve, prepend=-1) != 0
        if "point_branch" in data:
            begins |= np.diff(data["point_branch"][rows].values, prepend=-1) != 0
        bounds = bounds_over(curve, x, y, at, begins, len(own))
        for side, values in enumerate(bounds):
            by_force = values.reshape(end - begin, len(titles), len(at))
            for k, pair in enumerate(sets):
                pair[side].add(begin, by_force[:, k])
    x_unit = "Hz" if kind.x.endswith("_hz") else "m/s"
    return [
        BandPanel(title, kind.x_label, kind.y_label, x_unit, kind.y_unit, *_pair(pair, at))
        for title, pair in zip(titles, sets, strict=True)
    ]


def _identified(data: "xarray.Dataset", name: str) -> BandPanel:
    """Identified curves over their median velocity at each share of the amplitude range."""
    velocity = np.nanmedian(data["velocity_m_s"].values, axis=0)
    n = data.sizes[MEMBER]
    sample = _Collected(n, len(velocity))
    for begin, end in _blocks(n):
        sample.add(begin, data[name][begin:end].values)
    unit = str(data[name].attrs.get("units", ""))
    label = readable(name)
    return BandPanel("", "Velocity", label, "m/s", unit, sample.band(velocity), None)


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
