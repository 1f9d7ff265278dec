"""Curves through values at knots: natural cubic splines in the squared amplitude."""

import itertools
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.identify.curves.family_base import (
    AbstractFamily,
    Argument,
    Coefficient,
    Scattered,
    Terms,
    hats,
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
        return tuple(Coefficient(f"knot_{k}", True) for k in range(n))

    @classmethod
    def starts(cls, order: int, near: Scattered) -> list[AbstractFamily]:
        """See `AbstractFamily`; knots at zero and where the amplitudes divide into equal parts."""
        scale = near.largest
        fractions = np.quantile(near.amplitude / scale, np.linspace(0, 1, order)[1:])
        # Knots that coincide, of levels at one amplitude, are drawn apart evenly instead.
        knots = np.concatenate([[0.0], fractions**2])
        if np.min(np.diff(knots)) < 0.02 / order:
            knots = np.linspace(0.0, 1.0, order) ** 2
        unit = jax.device_put(scale)
        blank = cls.through(knots, np.zeros(order), unit, near.argument)
        start = near.fitted(blank.linearised(near.amplitude).by_parameters)
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
    roughness: Float[Array, "bend knot"]  # from values at the knots
    roughness_std: Float[Array, "*bend"]  # 1σ of the bends, one for all or each its own

    def terms(self) -> Terms:
        """See `AbstractFamily`."""
        # One 1σ for all bends, or one each.
        return super().terms()._replace(prior=self.roughness / self.roughness_std[..., None])

    @classmethod
    def through(
        cls,
        knots: Float[np.ndarray, " knot"],
        values: Float[np.ndarray, " knot"],
        scale: Float[Array, ""],
        argument: Argument,
        roughness_std: Float[np.ndarray, " bend"] | float = np.inf,
    ) -> "SmoothingSpline":
        """See `Spline`; without `roughness_std` any roughness is equally likely."""
        mix = np.linalg.inv(spline_terms(knots, knots))
        arrays = jax.device_put((values, knots, mix, roughness_of(knots), roughness_std))
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


def roughness_of(knots: Float[np.ndarray, " knot"]) -> Float[np.ndarray, "bend knot"]:
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


class WithRemainder(AbstractFamily):
    """A curve by a family, and the natural spline in amplitude² that the family leaves.

    Its parameters are the family's, then the coefficients of smooth functions (a straight line and
    curvatures), which are expected within `std` of zero.
    """

    kind: ClassVar[str] = "with_remainder"
    family: AbstractFamily
    knots: Float[Array, " knot"]  # of (amplitude/scale)², the family's own among them
    own: Float[Array, "hat own"]  # from the family's hats to those of all knots
    mix: Float[Array, "term function"]  # from functions to coefficients of 1, u and all hats
    std: Float[Array, " function"]

    @classmethod
    def of(
        cls,
        family: AbstractFamily,
        knots: Float[np.ndarray, " knot"],
        functions: Float[np.ndarray, "knot function"],
        coefficients: Float[np.ndarray, " function"],
        std: Float[np.ndarray, " function"],
    ) -> "WithRemainder":
        """A family with natural splines through values at knots, squares of amplitude/scale."""
        theirs = np.asarray(family.terms().knots)
        union = np.unique(np.concatenate([knots, theirs]))
        terms = np.linalg.solve(spline_terms(knots, knots), functions)
        # The second derivative of a natural spline is straight between its knots.
        inner = union[1:-1]
        mix = np.vstack([terms[:2], _hats_at(inner, knots) @ terms[2:]])
        own = _hats_at(inner, theirs)
        parameters = np.concatenate([np.asarray(family.parameters), coefficients])
        arrays = jax.device_put((parameters, union, own, mix, std))
        return cls(arrays[0], family.scale, family.argument, family, *arrays[1:])

    def terms(self) -> Terms:
        """See `AbstractFamily`."""
        traced = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(self))
        xp: Any = jnp if traced else np
        terms, n = self.family.terms(), len(self.family.parameters)
        powers, more = len(terms.exponents), len(self.std)
        mine = xp.concatenate([terms.mix[:powers], xp.zeros((2, n)), self.own @ terms.mix[powers:]])
        theirs = xp.concatenate([xp.zeros((powers, more)), self.mix])
        known = xp.broadcast_to(terms.offset, (len(terms.mix),))
        first = xp.concatenate([terms.prior, xp.zeros((len(terms.prior), more))], axis=1)
        rest = xp.concatenate([xp.zeros((more, n)), xp.diag(1 / self.std)], axis=1)
        return terms._replace(
            exponents=np.append(terms.exponents, [0.0, 2.0]),
            is_free=np.append(terms.is_free, [False, False]),
            knots=self.knots,
            mix=xp.concatenate([mine, theirs], axis=1),
            prior=xp.concatenate([first, rest]),
            offset=xp.concatenate([known[:powers], xp.zeros(2), self.own @ known[powers:]]),
        )

    def coefficients(self) -> tuple[Coefficient, ...]:
        """See `AbstractFamily`."""
        left = (Coefficient(f"remainder_{k}", True) for k in range(len(self.std)))
        return (*self.family.coefficients(), *left)

    @classmethod
    def starts(cls, *_: Any) -> list[AbstractFamily]:
        """See `AbstractFamily`: none without a family to begin with."""
        return []

    @property
    def largest_remainder(self) -> float:
        """The largest that the family leaves at measured amplitudes, over the curve there."""
        knots = np.asarray(self.knots)
        at = np.sqrt(knots[(knots > 0) & (knots <= 1)]) * float(self.scale)
        whole = self.linearised(at).value
        n = len(self.family.parameters)
        own = self.family.linearised(at, np.asarray(self.parameters)[:n]).value
        return float(np.max(np.abs(whole - own) / np.abs(whole)))

    @property
    def label(self) -> str:
        """See `AbstractFamily`: the family's."""
        return self.family.label

    @property
    def words(self) -> str:
        """See `AbstractFamily`."""
        return f"{self.family.words}, with a smooth remainder"


def _hats_at(
    inner: Float[np.ndarray, " knot"], knots: Float[np.ndarray, " own"]
) -> Float[np.ndarray, "knot hat"]:
    """Second derivatives at some points of the `hats` of other knots."""
    if len(knots) < 3:
        return np.zeros((len(inner), 0))
    each = np.eye(len(knots))[1:-1]
    return np.stack([np.interp(inner, knots, hat) for hat in each], axis=1)
