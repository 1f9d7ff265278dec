"""Curves through values at knots: natural cubic splines in the squared amplitude."""

import itertools
from typing import ClassVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from snrmjax.identify.curves.family_base import (
    AbstractFamily,
    Argument,
    Coefficient,
    Terms,
    hats,
    linear_start,
)

_CROWD = 4  # states between two knots, at most
_CLOSEST = 1.003  # ratio of knots' amplitudes: velocities are hardly known better


class Spline(AbstractFamily):
    """A natural cubic spline in amplitude², through values at knots; the first knot is at zero.

    Drawn by `hats`, and not by intervals: the program is a tenth of what a search for intervals
    and its derivatives compile to.
    """

    kind: ClassVar[str] = "spline"
    orders: ClassVar[tuple[int, ...]] = (3, 4, 5, 6)
    knots: Float[Array, " knot"]  # of (amplitude/scale)²
    mix: Float[Array, "term knot"]  # from values at the knots to coefficients of 1, u and `hats`

    def terms(self) -> Terms:
        """See `AbstractFamily`."""
        line, free = np.array([0.0, 2.0]), np.zeros(2, dtype=bool)
        return Terms(line, free, 1.0, self.knots, self.mix, np.zeros((0, len(self.knots))))

    @property
    def size(self) -> int | None:
        """See `AbstractFamily`: the number of knots."""
        return self.parameters.shape[0]

    def coefficients(self) -> tuple[Coefficient, ...]:
        """See `AbstractFamily`."""
        n = self.parameters.shape[0]
        return tuple(Coefficient(f"knot_{k}", 0.0, True) for k in range(n))

    @classmethod
    def starts(
        cls,
        order: int,
        argument: Argument,
        amplitude: np.ndarray,
        values: np.ndarray,
        weight: np.ndarray,
    ) -> list[AbstractFamily]:
        """See `AbstractFamily`; knots at zero and where the amplitudes divide into equal parts."""
        scale = float(np.max(amplitude))
        shares = np.quantile(amplitude / scale, np.linspace(0, 1, order)[1:])
        # Knots that coincide, of levels at one amplitude, are drawn apart evenly instead.
        knots = np.concatenate([[0.0], shares**2])
        if np.min(np.diff(knots)) < 0.02 / order:
            knots = np.linspace(0.0, 1.0, order) ** 2
        unit = jax.device_put(scale)
        blank = cls.through(knots, np.zeros(order), unit, argument)
        start = linear_start(blank.linearised(amplitude).by_parameters, values, weight)
        return [eqx.tree_at(lambda f: f.parameters, blank, jax.device_put(start))]

    @classmethod
    def through(
        cls,
        knots: Float[np.ndarray, " knot"],
        values: Float[np.ndarray, " knot"],
        scale: Float[Array, ""],
        argument: Argument,
    ) -> "Spline":
        """The spline through values at knots, which are squares of amplitude/scale."""
        mix = jax.device_put(np.linalg.inv(spline_terms(knots, knots)))
        return cls(jax.device_put(values), scale, argument, jax.device_put(knots), mix)


class SmoothingSpline(Spline):
    """A natural cubic spline with many knots that is as smooth as the data ask for.

    Its bends, the differences of a value from the straight line between those at the next knots,
    have a prior 1σ, one for all or one that changes along the curve, which the model of a test
    finds (`test_model`). A band then covers what the curve may do between knots; with few free
    knots it does not cover what they cannot follow. Knots are many, about evenly spaced in the
    logarithm of amplitude: steps of damping as joints begin to slip lie between levels too.
    Reference: Nychka, J. Am. Stat. Assoc. 83 (1988) 1134, doi:10.1080/01621459.1988.10478711.
    """

    kind: ClassVar[str] = "smoothing_spline"
    orders: ClassVar[tuple[int, ...]] = (12,)
    bends: Float[Array, "bend knot"]  # from values at the knots
    bend_std: Float[Array, "*bend"]  # 1σ of the bends, one for all or each its own

    def terms(self) -> Terms:
        """See `AbstractFamily`."""
        # One 1σ for all bends, or one each.
        return super().terms()._replace(prior=self.bends / self.bend_std[..., None])

    @classmethod
    def through(
        cls,
        knots: Float[np.ndarray, " knot"],
        values: Float[np.ndarray, " knot"],
        scale: Float[Array, ""],
        argument: Argument,
        bend_std: Float[np.ndarray, " bend"] | float = np.inf,
    ) -> "SmoothingSpline":
        """See `Spline`; bends of all sizes are alike likely unless `bend_std` says otherwise."""
        mix = np.linalg.inv(spline_terms(knots, knots))
        arrays = jax.device_put((values, knots, mix, bends_of(knots), bend_std))
        return cls(arrays[0], scale, argument, *arrays[1:])


def amplitudes_apart(
    amplitude: Float[np.ndarray, " point"], most: int, ratio: float, *, crowded: bool = False
) -> Float[np.ndarray, " knot"]:
    """Some of the amplitudes in rising order, each at least so many times the one below.

    With `crowded` also every `_CROWD`th where amplitudes crowd: a curve that is steep there keeps
    the amplitudes of many states alike, as a wire that meets a critical velocity.

    Arguments: `amplitude` relative to the largest; of more than `most` even picks.
    """
    apart, since = [1.0], 0
    for size in np.sort(amplitude)[::-1]:
        since += 1
        if 0 < size * (_CLOSEST if crowded and since >= _CROWD else ratio) <= apart[-1]:
            apart.append(float(size))
            since = 0
    pick = np.linspace(0, len(apart) - 1, min(most, len(apart)))
    return np.array(apart)[np.round(pick).astype(int)][::-1]


def bends_of(knots: Float[np.ndarray, " knot"]) -> Float[np.ndarray, "bend knot"]:
    """Change of slope at every inner knot, times the mean distance to its neighbours.

    A bend's variance is expected to grow with that distance, counted in logarithms of amplitude:
    in units of the mean one.
    """
    gap, amplitude = np.diff(knots), np.sqrt(knots)
    matrix = np.zeros((len(gap) - 1, len(knots)))
    for k, (below, above) in enumerate(itertools.pairwise(gap)):
        mean = 0.5 * (below + above)
        matrix[k, k : k + 3] = mean * np.array([1 / below, -1 / below - 1 / above, 1 / above])
    reach = np.log(amplitude[2:] / np.maximum(amplitude[:-2], 0.5 * amplitude[1:-1]))
    mean = np.mean(reach) if reach.size else 1.0  # two knots have no bend between them
    return matrix / np.sqrt(reach / mean)[:, None]


def spline_terms(
    u: Float[np.ndarray, " point"], knots: Float[np.ndarray, " knot"]
) -> Float[np.ndarray, "point term"]:
    """1, u and the `hats` at some points u, on the host."""
    return np.column_stack([np.ones_like(u), u, hats(u, knots, np)[0]])
