"""A user's own family of curves: its terms, and numbers in them that a fit finds too."""

import itertools
from abc import abstractmethod
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.identify.curves.family_base import (
    AbstractCurve,
    AbstractFamily,
    Argument,
    Coefficient,
    Linearised,
    Terms,
    linear_start,
)
from snrmjax.identify.curves.splines import spline_terms

_LEAST = 1e-6  # of the largest amplitude: terms such as tanh(x)/x have no value at rest
_LOGARITHM_STD = 3.0  # of a number: within a factor of twenty of one
_KNOTS, _REACH = 64, 1.3  # of what programs draw, up to so many times the largest amplitude


class OwnFamily(AbstractFamily):
    """ω̃² or 2ζ̃ω̃ as Σ p_k h_k(x; numbers) of the amplitude x over the largest measured one.

    A subclass has a `kind`, `names` of its terms, `numbers` that they contain, each with the
    positive values at which a fit begins, and `columns`. Added to `sj.identify.FAMILIES` under its
    kind, `fit_jointly` takes it by name. Numbers are unknowns by their logarithm, within a factor
    of twenty of one (1σ). What predicts responses draws the curve as a natural spline through 64
    values, and follows the numbers to first order.
    """

    names: ClassVar[tuple[str, ...]]
    numbers: ClassVar[dict[str, tuple[float, ...]]] = {}
    orders: ClassVar[tuple[int, ...]] = (0,)

    @classmethod
    @abstractmethod
    def columns(cls, x: Float[Array, "*batch"], **numbers: Float[Array, ""]) -> list[Array]:
        """The terms h_k at relative amplitudes x > 0, as JAX computes them, in the order of
        `names`.
        """

    def __call__(self, amplitude: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """See `AbstractCurve`."""
        x = jnp.maximum(jnp.asarray(amplitude) / self.scale, _LEAST)
        own, n = jnp.asarray(self.parameters), len(self.names)
        terms = self.columns(x, **dict(zip(self.numbers, jnp.exp(own[n:]), strict=True)))
        return sum((size * term for size, term in zip(own[:n], terms, strict=True)), 0.0 * x)

    def linearised(
        self,
        amplitude: Float[np.ndarray, " point"],
        parameters: Float[np.ndarray, " parameter"] | None = None,
    ) -> Linearised:
        """See `AbstractFamily`; compiles, once for each number of points."""
        there = self if parameters is None else self.at(parameters)
        return AbstractCurve.linearised(there, amplitude)

    def terms(self) -> Terms:
        """See `AbstractFamily`."""
        knots, n = np.linspace(0.0, _REACH, _KNOTS) ** 2, len(self.names)
        values = self.linearised(float(self.scale) * np.sqrt(knots)).by_parameters
        prior = np.diag(1 / self.expected_std())[n:]
        mix = np.linalg.solve(spline_terms(knots, knots), values)
        offset = -mix[:, n:] @ np.asarray(self.parameters)[n:]
        return Terms(np.array([0.0, 2.0]), np.zeros(2, bool), 1.0, knots, mix, prior, offset)

    def expected_std(self) -> Float[np.ndarray, " parameter"]:
        """See `AbstractFamily`."""
        return np.repeat([np.inf, _LOGARITHM_STD], [len(self.names), len(self.numbers)])

    def coefficients(self) -> tuple[Coefficient, ...]:
        """See `AbstractFamily`."""
        values = (Coefficient(name, True) for name in self.names)
        return (*values, *(Coefficient(f"log_{name}", False) for name in self.numbers))

    @classmethod
    def starts(
        cls,
        order: int,
        argument: Argument,
        amplitude: np.ndarray,
        values: np.ndarray,
        weight: np.ndarray,
    ) -> list[AbstractFamily]:
        """See `AbstractFamily`: one at every combination of its numbers."""
        members: list[AbstractFamily] = []
        n, scale = len(cls.names), jnp.asarray(float(np.max(amplitude)))
        for numbers in itertools.product(*cls.numbers.values()):
            blank = cls(jnp.append(jnp.ones(n), jnp.log(jnp.array(numbers))), scale, argument)
            columns = blank.linearised(amplitude).by_parameters[:, :n]
            start = linear_start(columns, values, weight)
            members.append(blank.at(np.append(start, blank.parameters[n:])))
        return members
