"""Bands of curves over all members: median, 95 % range and extremes."""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.study.computations.base import FORCE, MEMBER
from snrmjax.study.computations.responses import GRID, bounds_over
from snrmjax.study.computations.tests import FRACTION

if TYPE_CHECKING:
    import xarray

SAMPLED = 4096
"""Largest number of curves for medians and 95 % bands; of more a random sample is drawn."""

_BLOCK = 512  # members read at once
_GRID_POINTS = 121  # points of the grid for curves by points
_LEAST = 0.9  # least fraction of members with a curve at a grid point of the band
_RANGE = (2.5, 50.0, 97.5)
_ALIKE = 1e-3  # of the largest value: bands with a smaller difference are merged

# Lowest and highest values, at the grid points, of the curves of a range of members.
Bounds = Callable[[int, int], tuple[np.ndarray, np.ndarray]]


class Band(NamedTuple):
    """Bands of all members over one axis, NaN where few members have a curve."""

    at: Float[np.ndarray, " point"]
    low: Float[np.ndarray, " point"]  # 2.5 %
    median: Float[np.ndarray, " point"]
    high: Float[np.ndarray, " point"]  # 97.5 %
    least: Float[np.ndarray, " point"]
    most: Float[np.ndarray, " point"]


class CurveBands(NamedTuple):
    """Bands of the highest and the lowest value at each point, for one force."""

    x: str  # names of the quantities with unit suffix
    y: str
    force: float | None  # N, where members are computed for several forces
    upper: Band
    lower: Band | None  # where curves have several values at a point, as between folds


class _Collected:
    """Accumulates extremes of all curves, and a sample for quantiles."""

    def __init__(self, n_members: int, n_points: int) -> None:
        random, members = np.random.default_rng(0), np.arange(n_members)
        many = n_members > SAMPLED
        self.chosen = random.choice(members, SAMPLED, False) if many else members
        self.rows: list[np.ndarray] = []
        self.least, self.most = np.full(n_points, np.inf), np.full(n_points, -np.inf)

    def add(self, start: int, rows: np.ndarray) -> None:
        """The curves of members from `start` on."""
        sampled = self.chosen[(self.chosen >= start) & (self.chosen < start + len(rows))] - start
        self.rows.append(rows[sampled])
        self.least = np.fmin(self.least, np.fmin.reduce(rows, axis=0))
        self.most = np.fmax(self.most, np.fmax.reduce(rows, axis=0))

    def band(self, at: np.ndarray) -> Band:
        rows = np.concatenate(self.rows)
        has = np.mean(np.isfinite(rows), axis=0) >= _LEAST
        quantiles = np.full((len(_RANGE), len(at)), np.nan)
        if has.any():
            quantiles[:, has] = np.nanpercentile(rows[:, has], _RANGE, axis=0)
        ends = [np.where(np.isfinite(end) & has, end, np.nan) for end in (self.least, self.most)]
        return Band(at, *quantiles, *ends)


_RAGGED = (  # variables of points, and what their curves are called
    ("point_frequency_hz", ("point_velocity_re_m_s", "point_velocity_im_m_s"), "velocity_m_s"),
    ("point_velocity_m_s", ("point_frequency_hz",), "natural_frequency_hz"),
    ("point_velocity_m_s", ("point_damping_ratio",), "damping_ratio"),
)


def curve_bands(data: "xarray.Dataset") -> list[CurveBands]:
    """The bands of all kinds of curves in a data set.

    Curves are read by blocks of members.
    """
    if "upper_velocity_m_s" in data:

        def on_grid(start: int, end: int) -> tuple[np.ndarray, np.ndarray]:
            lower, upper = (data[f"{which}_velocity_m_s"] for which in ("lower", "upper"))
            return lower[start:end].values, upper[start:end].values

        return _by_force(data, on_grid, data[GRID].values, GRID, "velocity_m_s")
    bands = []
    for x, parts, y in _RAGGED:
        if all(name in data for name in (x, *parts)) and data["n_points"].values.any():
            at, bounds = _along(data, x, parts)
            bands += _by_force(data, bounds, at, x.removeprefix("point_"), y)
    for name in ("natural_frequency_hz", "damping_ratio"):
        if name in data and data[name].dims == (MEMBER, FRACTION):
            # Over the median velocity at each fraction of the amplitude range.
            at = np.nanmedian(data["velocity_m_s"].values, axis=0)
            values = data[name].values
            bands += _by_force(data, partial(_rows, values), at, "velocity_m_s", name)
    return bands


def _rows(values: np.ndarray, start: int, end: int) -> tuple[np.ndarray, np.ndarray]:
    return values[start:end], values[start:end]


def _along(
    data: "xarray.Dataset", name: str, parts: tuple[str, ...]
) -> tuple[Float[np.ndarray, " point"], Bounds]:
    """Grid over the range that nine tenths of the curves cover, and the curves on it."""
    n, count = data.sizes[MEMBER], data["n_points"].values
    each = count[count > 0]
    begins = np.cumsum(each) - each
    x = data[name].values
    ends = np.minimum.reduceat(x, begins), np.maximum.reduceat(x, begins)
    at = np.linspace(np.quantile(ends[0], _LEAST), np.quantile(ends[1], 1 - _LEAST), _GRID_POINTS)
    first = np.append(0, np.cumsum(count.reshape(n, -1).sum(axis=1)))

    def bounds(start: int, end: int) -> tuple[np.ndarray, np.ndarray]:
        rows, points = slice(first[start], first[end]), count[start:end].ravel()
        curve = np.repeat(np.arange(len(points)), points)
        heights = [data[part][rows].values for part in parts]
        new = np.diff(curve, prepend=-1) != 0
        if "point_branch" in data:
            new |= np.diff(data["point_branch"][rows].values, prepend=-1) != 0
        height = heights[0] if len(heights) == 1 else np.hypot(*heights)
        return bounds_over(curve, x[rows], height, at, new, len(points))

    return at, bounds


def _by_force(
    data: "xarray.Dataset", bounds: Bounds, at: Float[np.ndarray, " point"], x: str, y: str
) -> list[CurveBands]:
    forces = data[FORCE].values.tolist() if FORCE in data.dims else [None]
    n = data.sizes[MEMBER]
    sides = [(_Collected(n, len(at)), _Collected(n, len(at))) for _ in forces]
    for start in range(0, n, _BLOCK):
        for side, values in enumerate(bounds(start, min(start + _BLOCK, n))):
            by_force = values.reshape(-1, len(forces), len(at))
            for k, pair in enumerate(sides):
                pair[side].add(start, by_force[:, k])
    return [
        CurveBands(x, y, force, *_apart(*(one.band(at) for one in pair)))
        for force, pair in zip(forces, sides, strict=True)
    ]


def _apart(lower: Band, upper: Band) -> tuple[Band, Band | None]:
    """The band of the highest values, and that of the lowest where it differs."""
    scale = max(np.nanmax(np.abs(upper.high), initial=0.0), 1e-300)
    gaps = np.abs(np.array(upper[1:]) - np.array(lower[1:])) > _ALIKE * scale
    apart = np.flatnonzero(gaps.any(axis=0))
    if not apart.size:
        return upper, None
    index = np.arange(len(upper.at))
    drawn = (index >= apart[0] - 1) & (index <= apart[-1] + 1)
    return upper, Band(upper.at, *(np.where(drawn, one, np.nan) for one in lower[1:]))
