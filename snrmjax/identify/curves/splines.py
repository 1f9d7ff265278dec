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

_CROWD = 4  # states between two knots at most
_CLOSEST = 1.003  # ratio of knots' amplitudes: about the accuracy of velocities


class Spline(AbstractFamily):
    """A natural cubic spline in amplitude², through values at knots; the first knot is at zero.

    Evaluated as a sum of `hats`, which compiles to a tenth of an interval search with its
    derivatives.
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
        """See `AbstractFamily`; knots at zero and at quantiles of the amplitudes."""
        scale = near.largest
        fractions = np.quantile(near.amplitude / scale, np.linspace(0, 1, order)[1:])
        # Coinciding knots, from levels at one amplitude, are replaced by even ones.
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
    """A natural cubic spline with many knots and a roughness penalty.

    Its roughness, the distance of a value from the chord between its neighbours, has a prior 1σ,
    constant or varying along the curve, estimated by the model of a test (`test_model`). The band
    then covers the curve between knots as well; with few free knots it misses their interpolation
    error. Knots are about evenly spaced in log amplitude: the damping steps of joints that begin to
    slip may lie between levels.
    Reference: Nychka, J. Am. Stat. Assoc. 83 (1988) 1134, doi:10.1080/01621459.1988.10478711.
    """

    kind: ClassVar[str] = "smoothing_spline"
    orders: ClassVar[tuple[int, ...]] = (12,)
    roughness: Float[Array, "curvature knot"]  # from values at the knots
    roughness_std: Float[Array, "*curvature"]  # 1σ of the roughness, common or at each knot

    def terms(self) -> Terms:
        """See `AbstractFamily`."""
        # A common 1σ, or one at each inner knot.
        return super().terms()._replace(prior=self.roughness / self.roughness_std[..., None])

    @classmethod
    def through(
        cls,
        knots: Float[np.ndarray, " knot"],
        values: Float[np.ndarray, " knot"],
        scale: Float[Array, ""],
        argument: Argument,
        roughness_std: Float[np.ndarray, " curvature"] | float = np.inf,
    ) -> "SmoothingSpline":
        """See `Spline`; without `roughness_std` any roughness is equally likely."""
        mix = np.linalg.inv(spline_terms(knots, knots))
        arrays = jax.device_put((values, knots, mix, roughness_of(knots), roughness_std))
        return cls(arrays[0], scale, argument, *arrays[1:])


def amplitudes_apart(
    amplitude: Float[np.ndarray, " point"], most: int, ratio: float, *, crowded: bool = False
) -> Float[np.ndarray, " knot"]:
    """A subset of the amplitudes in rising order, neighbours at least a factor `ratio` apart.

    With `crowded` also every `_CROWD`th where amplitudes cluster, as they do where a curve is
    steep: a wire at a critical velocity.

    Arguments: `amplitude` relative to the largest; more than `most` are thinned evenly.
    """
    apart, since = [1.0], 0
    for value in np.sort(amplitude)[::-1]:
        since += 1
        if 0 < value * (_CLOSEST if crowded and since >= _CROWD else ratio) <= apart[-1]:
            apart.append(float(value))
            since = 0
    pick = np.linspace(0, len(apart) - 1, min(most, len(apart)))
    return np.array(apart)[np.round(pick).astype(int)][::-1]


def roughness_of(knots: Float[np.ndarray, " knot"]) -> Float[np.ndarray, "curvature knot"]:
    """Roughness matrix: change of slope at every inner knot, times the mean knot spacing there.

    Scaled for a prior variance that grows with the spacing in log amplitude, relative to the mean
    spacing.
    """
    gap, amplitude = np.diff(knots), np.sqrt(knots)
    matrix = np.zeros((len(gap) - 1, len(knots)))
    for k, (below, above) in enumerate(itertools.pairwise(gap)):
        mean = 0.5 * (below + above)
        matrix[k, k : k + 3] = mean * np.array([1 / below, -1 / below - 1 / above, 1 / above])
    reach = np.log(amplitude[2:] / np.maximum(amplitude[:-2], 0.5 * amplitude[1:-1]))
    mean = np.mean(reach) if reach.size else 1.0  # two knots have no inner knot
    return matrix / np.sqrt(reach / mean)[:, None]


def spline_terms(
    u: Float[np.ndarray, " point"], knots: Float[np.ndarray, " knot"]
) -> Float[np.ndarray, "point term"]:
    """1, u and the `hats` at points u, on the host."""
    return np.column_stack([np.ones_like(u), u, hats(u, knots, np)[0]])


class WithRemainder(AbstractFamily):
    """A family plus a smooth remainder, a natural spline in amplitude².

    Its parameters are the family's, then the coefficients of the smooth functions (a straight line
    and curvatures), which have the prior 1σ `std`.
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
        # The second derivative of a natural spline is piecewise linear.
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
        remainder = (Coefficient(f"remainder_{k}", True) for k in range(len(self.std)))
        return (*self.family.coefficients(), *remainder)

    @classmethod
    def starts(cls, *_: Any) -> list[AbstractFamily]:
        """See `AbstractFamily`: none, as it needs a fitted family."""
        return []

    @property
    def largest_remainder(self) -> float:
        """Largest relative remainder at measured amplitudes."""
        knots = np.asarray(self.knots)
        at = np.sqrt(knots[(knots > 0) & (knots <= 1)]) * float(self.scale)
        whole = self.linearised(at).value
        n = len(self.family.parameters)
        own = self.family.linearised(at, np.asarray(self.parameters)[:n]).value
        return float(np.max(np.abs(whole - own) / np.abs(whole)))

    @property
    def label(self) -> str:
        """See `AbstractFamily`: that of the family."""
        return self.family.label

    @property
    def words(self) -> str:
        """See `AbstractFamily`."""
        return f"{self.family.words}, with a smooth remainder"


def _hats_at(
    inner: Float[np.ndarray, " knot"], knots: Float[np.ndarray, " own"]
) -> Float[np.ndarray, "knot hat"]:
    """Second derivatives of the `hats` of other knots at these points."""
    if len(knots) < 3:
        return np.zeros((len(inner), 0))
    each = np.eye(len(knots))[1:-1]
    return np.stack([np.interp(inner, knots, hat) for hat in each], axis=1)
