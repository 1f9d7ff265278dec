"""Bands of curves over all members: where half of them lie, 95 % of them, and all of them."""

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
"""Curves, drawn at random, of which medians and 95 % bands are made where there are more."""

_BLOCK = 512  # members that are read together
_PLACES = 121  # of a grid that the data set does not have
_LEAST = 0.9  # share of the members that must have a curve at a place for its band
_RANGE = (2.5, 50.0, 97.5)
_ALIKE = 1e-3  # of the largest value: bands that differ by less are one

# Lowest and highest values of the curves of members from one to another, at the places.
Bounds = Callable[[int, int], tuple[np.ndarray, np.ndarray]]


class Band(NamedTuple):
    """Curves of all members over the places of one axis, NaN where few members have a curve."""

    at: Float[np.ndarray, " place"]
    low: Float[np.ndarray, " place"]  # 2.5 %
    median: Float[np.ndarray, " place"]
    high: Float[np.ndarray, " place"]  # 97.5 %
    least: Float[np.ndarray, " place"]
    most: Float[np.ndarray, " place"]


class CurveBands(NamedTuple):
    """Bands of the highest and the lowest value at each place, of one force."""

    x: str  # names of the quantities, with the ends that say their units
    y: str
    force: float | None  # N, where members are computed for several forces
    upper: Band
    lower: Band | None  # where curves have several values at a place, as around folds


class _Collected:
    """Rows of one curve at a time: extremes of all of them, and a sample for quantiles."""

    def __init__(self, n_members: int, n_places: int) -> None:
        random, members = np.random.default_rng(0), np.arange(n_members)
        many = n_members > SAMPLED
        self.chosen = random.choice(members, SAMPLED, False) if many else members
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
    """The bands that a data set has curves for; none where it has none.

    Curves are read by blocks of members.
    """
    if "upper_velocity_m_s" in data:

        def on_grid(begin: int, end: int) -> tuple[np.ndarray, np.ndarray]:
            lower, upper = (data[f"{which}_velocity_m_s"] for which in ("lower", "upper"))
            return lower[begin:end].values, upper[begin:end].values

        return _by_force(data, on_grid, data[GRID].values, GRID, "velocity_m_s")
    bands = []
    for x, parts, y in _RAGGED:
        if all(name in data for name in (x, *parts)) and data["n_points"].values.any():
            at, bounds = _along(data, x, parts)
            bands += _by_force(data, bounds, at, x.removeprefix("point_"), y)
    for name in ("natural_frequency_hz", "damping_ratio"):
        if name in data and data[name].dims == (MEMBER, FRACTION):
            # Over the median velocity at each share of the amplitude range.
            at = np.nanmedian(data["velocity_m_s"].values, axis=0)
            values = data[name].values
            bands += _by_force(data, partial(_rows, values), at, "velocity_m_s", name)
    return bands


def _rows(values: np.ndarray, begin: int, end: int) -> tuple[np.ndarray, np.ndarray]:
    return values[begin:end], values[begin:end]


def _along(
    data: "xarray.Dataset", name: str, parts: tuple[str, ...]
) -> tuple[Float[np.ndarray, " place"], Bounds]:
    """Places between which nine tenths of the curves have points, and the curves there."""
    n, count = data.sizes[MEMBER], data["n_points"].values
    each = count[count > 0]
    begins = np.cumsum(each) - each
    x = data[name].values
    ends = np.minimum.reduceat(x, begins), np.maximum.reduceat(x, begins)
    at = np.linspace(np.quantile(ends[0], _LEAST), np.quantile(ends[1], 1 - _LEAST), _PLACES)
    first = np.append(0, np.cumsum(count.reshape(n, -1).sum(axis=1)))

    def bounds(begin: int, end: int) -> tuple[np.ndarray, np.ndarray]:
        rows, points = slice(first[begin], first[end]), count[begin:end].ravel()
        curve = np.repeat(np.arange(len(points)), points)
        heights = [data[part][rows].values for part in parts]
        new = np.diff(curve, prepend=-1) != 0
        if "point_branch" in data:
            new |= np.diff(data["point_branch"][rows].values, prepend=-1) != 0
        height = heights[0] if len(heights) == 1 else np.hypot(*heights)
        return bounds_over(curve, x[rows], height, at, new, len(points))

    return at, bounds


def _by_force(
    data: "xarray.Dataset", bounds: Bounds, at: Float[np.ndarray, " place"], x: str, y: str
) -> list[CurveBands]:
    forces = data[FORCE].values.tolist() if FORCE in data.dims else [None]
    n = data.sizes[MEMBER]
    sides = [(_Collected(n, len(at)), _Collected(n, len(at))) for _ in forces]
    for begin in range(0, n, _BLOCK):
        for side, values in enumerate(bounds(begin, min(begin + _BLOCK, n))):
            by_force = values.reshape(-1, len(forces), len(at))
            for k, pair in enumerate(sides):
                pair[side].add(begin, by_force[:, k])
    return [
        CurveBands(x, y, force, *_apart(*(one.band(at) for one in pair)))
        for force, pair in zip(forces, sides, strict=True)
    ]


def _apart(lower: Band, upper: Band) -> tuple[Band, Band | None]:
    """The band of the highest values, and that of the lowest where it is another."""
    scale = max(np.nanmax(np.abs(upper.high), initial=0.0), 1e-300)
    gaps = np.abs(np.array(upper[1:]) - np.array(lower[1:])) > _ALIKE * scale
    places = np.flatnonzero(gaps.any(axis=0))
    if not places.size:
        return upper, None
    index = np.arange(len(upper.at))
    drawn = (index >= places[0] - 1) & (index <= places[-1] + 1)
    return upper, Band(upper.at, *(np.where(drawn, one, np.nan) for one in lower[1:]))
