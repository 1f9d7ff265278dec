"""Curves through values at knots: natural cubic splines in the squared amplitude."""

import itertools
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.identify.curves.family_base import AbstractFamily, Argument, Coefficient, linear_start

_NEAREST = 1.05  # ratio of two knots' amplitudes


class Spline(AbstractFamily):
    """A natural cubic spline in amplitude², through values at knots; the first knot is at zero.

    Drawn by `hats`, and not by intervals: the program is a tenth of what a search for intervals
    and its derivatives compile to.
    """

    kind: ClassVar[str] = "spline"
    orders: ClassVar[tuple[int, ...]] = (3, 4, 5, 6)
    knots: Float[Array, " knot"]  # of (amplitude/scale)²
    mix: Float[Array, "term knot"]  # from values at the knots to coefficients of 1, u and `hats`

    def __call__(self, amplitude: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """See `AbstractFamily`."""
        u = (jnp.asarray(amplitude) / self.scale) ** 2
        return _drawn(u, self.mix @ self.parameters, self.knots)

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
        columns = spline_columns(blank, amplitude)
        start = linear_start(columns, values, weight)
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


@jax.custom_jvp
def _drawn(u: Array, coefficients: Array, knots: Array) -> Array:
    line = jnp.stack([jnp.ones_like(u), u], axis=-1)
    return jnp.concatenate([line, hats(u, knots)[0]], axis=-1) @ coefficients


@_drawn.defjvp
def _drawn_and_slope(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    """One set of hats serves all directions, where automatic rules would draw them for each.

    Knots have no derivative: they are chosen, not fitted.
    """
    u, coefficients, knots = primals
    by_u, by_coefficients, _ = tangents
    slope = coefficients[1] + hats(u, knots)[1] @ coefficients[2:]
    return _drawn(u, coefficients, knots), slope * by_u + _drawn(u, by_coefficients, knots)


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
    largest_size: ClassVar[int] = 24
    bends: Float[Array, "bend knot"]  # from values at the knots
    bend_std: Float[Array, "*bend"]  # 1σ of the bends, one for all or each its own

    def prior_residuals(self) -> Float[Array, " row"]:
        """See `AbstractCurve`."""
        return self.bends @ self.parameters / self.bend_std

    @classmethod
    def sizes(cls, n_states: int, n_levels: int) -> tuple[int, ...]:
        """See `AbstractFamily`: one for three states at most; bends of a size make it smooth."""
        return (int(np.clip(n_states // 3, 2, cls.largest_size - 1)) + 1,)

    @classmethod
    def starts(
        cls,
        order: int,
        argument: Argument,
        amplitude: np.ndarray,
        values: np.ndarray,
        weight: np.ndarray,
    ) -> list[AbstractFamily]:
        """See `AbstractFamily`; knots at rest and at amplitudes of states.

        Amplitudes that almost coincide count once: of a level that passes its resonance most
        states are far below it, and the few at resonance need knots too.
        """
        scale = float(np.max(amplitude))
        knots = np.append(0.0, amplitudes_apart(amplitude / scale, order - 1, _NEAREST) ** 2)
        unit = jax.device_put(scale)
        blank = cls.through(knots, np.zeros(len(knots)), unit, argument)
        start = linear_start(spline_columns(blank, amplitude), values, weight)
        size = jax.device_put(max(float(np.std(values)), 1e-3 * float(np.max(np.abs(values)))))
        return [
            eqx.tree_at(lambda f: (f.parameters, f.bend_std), blank, (jax.device_put(start), size))
        ]

    @classmethod
    def through(
        cls,
        knots: Float[np.ndarray, " knot"],
        values: Float[np.ndarray, " knot"],
        scale: Float[Array, ""],
        argument: Argument,
    ) -> "SmoothingSpline":
        """See `Spline`; bends of all sizes are alike likely until `bend_std` says otherwise."""
        mix = jax.device_put(np.linalg.inv(spline_terms(knots, knots)))
        bends = jax.device_put(bends_of(knots))
        fixed = (scale, argument, jax.device_put(knots), mix, bends, jax.device_put(np.inf))
        return cls(jax.device_put(values), *fixed)


def amplitudes_apart(
    amplitude: Float[np.ndarray, " point"], most: int, ratio: float
) -> Float[np.ndarray, " knot"]:
    """Some of the amplitudes in rising order, each at least so many times the one below.

    Arguments: `amplitude` relative to the largest; of more than `most` even picks.
    """
    apart = [1.0]
    for one in np.sort(amplitude)[::-1]:
        if 0 < one * ratio <= apart[-1]:
            apart.append(float(one))
    pick = np.linspace(0, len(apart) - 1, min(most, len(apart)))
    return np.array(apart)[np.round(pick).astype(int)][::-1]


def spline_columns(
    curve: Spline, amplitude: Float[np.ndarray, " point"]
) -> Float[np.ndarray, "point knot"]:
    """Derivatives of a spline by its values at the knots, on the host."""
    u = (amplitude / float(curve.scale)) ** 2
    return spline_terms(u, np.asarray(curve.knots)) @ np.asarray(curve.mix)


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


def hats(u: Array | np.ndarray, knots: Float[Array | np.ndarray, " knot"]) -> tuple[Array, Array]:
    """Functions whose second derivative is a hat over three successive knots, and their slopes.

    Straight outside of their hat and made of clipped differences: nothing large cancels, as it
    does in sums of truncated powers. On the host for arrays of the host.
    """
    xp: Any = np if isinstance(u, np.ndarray) else jnp
    u = u[..., None]
    left, middle, right = knots[:-2], knots[1:-1], knots[2:]
    rise, fall = middle - left, right - middle
    up, down = xp.clip(u - left, 0.0, rise), xp.clip(u - middle, 0.0, fall)
    past, beyond = xp.maximum(u - middle, 0.0), xp.maximum(u - right, 0.0)
    value = up**3 / (6 * rise) + 0.5 * (rise * past + down**2 + fall * beyond)
    value = value - down**3 / (6 * fall)
    return value, 0.5 * up**2 / rise + down - 0.5 * down**2 / fall


def spline_terms(
    u: Float[np.ndarray, " point"], knots: Float[np.ndarray, " knot"]
) -> Float[np.ndarray, "point term"]:
    """1, u and the `hats` at some points u, on the host."""
    return np.column_stack([np.ones_like(u), u, hats(u, knots)[0]])
