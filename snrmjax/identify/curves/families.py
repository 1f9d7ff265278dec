"""Families of smooth curves of amplitude with a few parameters, for the joint fit."""

import itertools
from abc import abstractmethod
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.identify.curves.family_base import (
    AbstractCurve,
    AbstractFamily,
    Argument,
    Coefficient,
    Linearised,
    Scattered,
    Terms,
)
from snrmjax.identify.curves.splines import SmoothingSpline, Spline, spline_terms
from snrmjax.numerics.names import take_former
from snrmjax.numerics.rules import InputError


class SumOfPowers(AbstractFamily):
    """Σ p_k (amplitude/scale)^power_k: linear in its parameters."""

    named: ClassVar[dict[str, float]]  # the terms and their powers, where their number is fixed

    @classmethod
    def powers(cls, order: int) -> dict[str, float]:
        """Names of the terms and their powers."""
        return cls.named

    @property
    def order(self) -> int:
        """Number of terms after the first."""
        return self.parameters.shape[0] - 1

    def terms(self) -> Terms:
        """See `AbstractFamily`."""
        return Terms.of_powers(list(self.powers(self.order).values()))

    def coefficients(self) -> tuple[Coefficient, ...]:
        """See `AbstractFamily`."""
        return tuple(Coefficient(name, True) for name in self.powers(self.order))

    @classmethod
    def starts(cls, order: int, near: Scattered) -> list[AbstractFamily]:
        """See `AbstractFamily`."""
        relative = near.amplitude / near.largest
        start = near.fitted(np.stack([relative**p for p in cls.powers(order).values()], axis=1))
        return [cls(jnp.asarray(start), jnp.asarray(near.largest), near.argument)]


class Polynomial(SumOfPowers):
    """An even polynomial, as any smooth force gives, in ascending powers of amplitude²."""

    kind: ClassVar[str] = "polynomial"
    orders: ClassVar[tuple[int, ...]] = (0, 1, 2, 3, 4)

    @property
    def size(self) -> int | None:
        """See `AbstractFamily`: the number of terms after the first."""
        return self.order

    @classmethod
    def powers(cls, order: int) -> dict[str, float]:
        """See `SumOfPowers`."""
        return {"at_zero": 0.0} | {f"power_{2 * k}": 2.0 * k for k in range(1, order + 1)}


class Constant(SumOfPowers):
    """Constant in amplitude: the modal damping C of linear theory."""

    kind: ClassVar[str] = "constant"
    orders: ClassVar[tuple[int, ...]] = (0,)
    named: ClassVar[dict[str, float]] = {"constant": 0.0}


class ViscousQuadratic(SumOfPowers):
    """Viscous and quadratic damping: c|q̇|q̇ is equivalent to 8cv/(3π) on the fundamental."""

    kind: ClassVar[str] = "viscous_quadratic"
    orders: ClassVar[tuple[int, ...]] = (1,)
    named: ClassVar[dict[str, float]] = {"viscous": 0.0, "quadratic": 1.0}


class ViscousCoulomb(SumOfPowers):
    """Viscous damping and dry friction: μ sign(q̇) is equivalent to 4μ/(πv) on the fundamental."""

    kind: ClassVar[str] = "viscous_coulomb"
    orders: ClassVar[tuple[int, ...]] = (1,)
    named: ClassVar[dict[str, float]] = {"viscous": 0.0, "coulomb": -1.0}


class PowerLaw(AbstractFamily):
    """A value at zero and a power of amplitude with free positive exponent.

    The exponent is bounded by a logistic map; its log odds have a prior 1σ of `odds_std`, without
    which they would diverge where the data favour a bound, and the bands with them.
    """

    odds_std: ClassVar[float] = 5.0  # 1σ is an exponent at 99 % of its range
    kind: ClassVar[str] = "power_law"
    orders: ClassVar[tuple[int, ...]] = (1,)
    largest_exponent: ClassVar[float] = 6.0
    tried: ClassVar[tuple[float, ...]] = (0.5, 1.0, 2.0, 4.0)

    def terms(self) -> Terms:
        """See `AbstractFamily`."""
        plain = Terms.of_powers([0.0, 0.0], 3)
        return plain._replace(
            is_free=np.array([False, True]),
            largest_exponent=self.largest_exponent,
            prior=np.array([[0.0, 0.0, 1 / self.odds_std]]),
        )

    @property
    def exponent(self) -> Float[Array, ""]:
        """Of the amplitude, between zero and `largest_exponent`."""
        return self.largest_exponent * jax.nn.sigmoid(self.parameters[2])

    def coefficients(self) -> tuple[Coefficient, ...]:
        """See `AbstractFamily`; the coefficient is the contribution at the largest amplitude."""
        return (
            *(Coefficient("at_zero", True), Coefficient("at_largest", True)),
            Coefficient("logit_exponent", False),
        )

    @classmethod
    def starts(cls, order: int, near: Scattered) -> list[AbstractFamily]:
        """See `AbstractFamily`."""
        members: list[AbstractFamily] = []
        relative, scale = near.amplitude / near.largest, jnp.asarray(near.largest)
        for power in cls.tried:
            columns = np.stack([np.ones(len(relative)), relative**power], axis=1)
            fraction = power / cls.largest_exponent
            start = [*near.fitted(columns), np.log(fraction / (1 - fraction))]
            members.append(cls(jnp.asarray(start), scale, near.argument))
        return members


class ViscousMicroslip(PowerLaw):
    """Viscous damping and microslip in joints, dissipation with a power between 2 and 3.

    Iwan's joints dissipate ∝ amplitude^(3+χ) per cycle with −1 < χ < 0, so that 2ζ̃ω̃ grows with
    the power 1 + χ, between zero and one. Reference: Segalman, J. Appl. Mech. 72 (2005) 752,
    doi:10.1115/1.1989354.
    """

    kind: ClassVar[str] = "viscous_microslip"
    largest_exponent: ClassVar[float] = 1.0
    tried: ClassVar[tuple[float, ...]] = (0.2, 0.5, 0.8)


class FamilyTable(dict[str, type[AbstractFamily]]):
    """Families of curves by name. It prints as a table: name and description."""

    def __repr__(self) -> str:
        """One line for each family."""
        width = max((len(kind) for kind in self), default=0)
        texts = {
            kind: (family.__doc__ or "").strip().split("\n")[0] for kind, family in self.items()
        }
        return "\n".join(f"{kind:{width}}  {text}" for kind, text in texts.items())


FAMILIES: dict[str, type[AbstractFamily]] = FamilyTable(
    (family.kind, family)
    for family in (
        *(Polynomial, Spline, SmoothingSpline, PowerLaw),
        *(Constant, ViscousQuadratic, ViscousCoulomb, ViscousMicroslip),
    )
)
"""Families by name; `print(FAMILIES)` is a table of them."""

FamilyTable.__doc__ = f"{FamilyTable.__doc__}\n\n{FAMILIES!r}"

ARGUMENTS: tuple[Argument, ...] = ("displacement", "velocity")
"""Amplitudes that a curve may be a function of."""


class Choice(NamedTuple):
    """The user's choice of a family."""

    kind: str  # or "auto"
    size: int | None
    argument: Argument | None


def parse_family(text: str) -> Choice:
    """Family, size and amplitude of "spline:5@velocity"; None for parts not given.

    Raises `ValueError` for an unknown family, size or amplitude.
    """
    head, _, argument = text.partition("@")
    kind, _, size = head.partition(":")
    if kind not in FAMILIES and kind != "auto":
        raise InputError(f"{kind!r} is no family; there are {', '.join(FAMILIES)} and auto.")
    if size and not size.isdigit():
        raise InputError(f"the size of a family must be a whole number, but is {size!r}.")
    known = {"": None} | {name: name for name in ARGUMENTS}
    if argument not in known:
        raise InputError(f'the amplitude must be "displacement" or "velocity", not {argument!r}.')
    return Choice(kind, int(size) if size else None, known[argument])


_LEAST = 1e-6  # of the largest amplitude: tanh(x)/x and the like are 0/0 at rest
_LOGARITHM_STD = 3.0  # prior 1σ of ln of a number: a factor of twenty
_KNOTS, _REACH = 64, 1.3  # of the spline in programs; its end over the largest amplitude


class OwnFamily(AbstractFamily):
    """ω̃² or 2ζ̃ω̃ as Σ p_k h_k(x; s) of the amplitude x over the largest measured one.

    A subclass has a `kind`, `names` of its terms, the `nonlinear_parameters` s, each with its
    positive starting values, and `columns`. Added to `sj.identify.FAMILIES` under its kind,
    `fit_jointly` takes it by name. Nonlinear parameters are unknowns by their logarithm, with a
    prior 1σ of a factor of twenty about one. Response prediction uses a natural spline through 64
    values of the curve, linearised in them.
    """

    names: ClassVar[tuple[str, ...]]
    nonlinear_parameters: ClassVar[dict[str, tuple[float, ...]]] = {}
    orders: ClassVar[tuple[int, ...]] = (0,)

    def __init_subclass__(cls, **settings: Any) -> None:
        super().__init_subclass__(**settings)
        take_former(cls, {"numbers": "nonlinear_parameters"})

    @classmethod
    @abstractmethod
    def columns(cls, x: Float[Array, "*batch"], **shapes: Float[Array, ""]) -> list[Array]:
        """The terms h_k at relative amplitudes x > 0, in JAX operations and in the order of
        `names`; `shapes` are the nonlinear parameters.
        """

    def __call__(self, amplitude: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """See `AbstractCurve`."""
        x = jnp.maximum(jnp.asarray(amplitude) / self.scale, _LEAST)
        own, n = jnp.asarray(self.parameters), len(self.names)
        terms = self.columns(
            x, **dict(zip(self.nonlinear_parameters, jnp.exp(own[n:]), strict=True))
        )
        return sum(
            (coefficient * term for coefficient, term in zip(own[:n], terms, strict=True)), 0.0 * x
        )

    def linearised(
        self,
        amplitude: Float[np.ndarray, " point"],
        parameters: Float[np.ndarray, " parameter"] | None = None,
    ) -> Linearised:
        """See `AbstractFamily`; compiles once per number of points."""
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
        return np.repeat(
            [np.inf, _LOGARITHM_STD], [len(self.names), len(self.nonlinear_parameters)]
        )

    def coefficients(self) -> tuple[Coefficient, ...]:
        """See `AbstractFamily`."""
        values = (Coefficient(name, True) for name in self.names)
        return (*values, *(Coefficient(f"log_{name}", False) for name in self.nonlinear_parameters))

    @classmethod
    def starts(cls, order: int, near: Scattered) -> list[AbstractFamily]:
        """See `AbstractFamily`: one at every combination of starting values."""
        members: list[AbstractFamily] = []
        n, scale = len(cls.names), jnp.asarray(near.largest)
        for shapes in itertools.product(*cls.nonlinear_parameters.values()):
            blank = cls(jnp.append(jnp.ones(n), jnp.log(jnp.array(shapes))), scale, near.argument)
            start = near.fitted(blank.linearised(near.amplitude).by_parameters[:, :n])
            members.append(blank.at(np.append(start, blank.parameters[n:])))
        return members
