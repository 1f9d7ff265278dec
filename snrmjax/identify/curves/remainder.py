"""A family of curves with what its terms leave, drawn as a smooth curve."""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.identify.curves.family_base import AbstractFamily, Coefficient, Terms
from snrmjax.identify.curves.splines import spline_terms


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
        left = (Coefficient(f"remainder_{k}", 0.0, True) for k in range(len(self.std)))
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
