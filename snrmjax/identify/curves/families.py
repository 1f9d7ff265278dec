"""Families of smooth curves of amplitude with a few parameters, for the joint fit."""

from abc import abstractmethod
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import expit

from snrmjax.identify.curves.family_base import (
    AbstractCurve,
    AbstractFamily,
    Argument,
    Coefficient,
    linear_start,
)
from snrmjax.identify.curves.splines import SmoothingSpline, Spline, spline_columns


class SumOfPowers(AbstractFamily):
    """Σ p_k (amplitude/scale)^power_k: linear in its parameters."""

    @classmethod
    @abstractmethod
    def powers(cls, order: int) -> tuple[float, ...]:
        """Powers of the terms."""

    @classmethod
    @abstractmethod
    def names(cls, order: int) -> tuple[str, ...]:
        """Names of the terms."""

    @property
    def order(self) -> int:
        """Number of terms beside the first."""
        return self.parameters.shape[0] - 1

    def __call__(self, amplitude: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """See `AbstractFamily`."""
        x = jnp.asarray(amplitude) / self.scale
        terms = [
            p * _power(x, power)
            for p, power in zip(self.parameters, self.powers(self.order), strict=True)
        ]
        return sum(terms[1:], terms[0])

    def coefficients(self) -> tuple[Coefficient, ...]:
        """See `AbstractFamily`."""
        pairs = zip(self.names(self.order), self.powers(self.order), strict=True)
        return tuple(Coefficient(name, power, True) for name, power in pairs)

    @classmethod
    def starts(
        cls,
        order: int,
        argument: Argument,
        amplitude: np.ndarray,
        values: np.ndarray,
        weight: np.ndarray,
    ) -> list[AbstractFamily]:
        """See `AbstractFamily`."""
        scale = float(np.max(amplitude))
        columns = np.stack([(amplitude / scale) ** p for p in cls.powers(order)], axis=1)
        start = linear_start(columns, values, weight)
        return [cls(jnp.asarray(start), jnp.asarray(scale, dtype=jnp.float64), argument)]


def _power(x: Array, power: float) -> Array:
    if power == 0:
        return jnp.ones_like(x)
    if power < 0:
        # Dry friction: its equivalent damping grows without bound towards rest.
        return jnp.where(x > 0, jnp.where(x > 0, x, 1.0) ** power, jnp.inf)
    return x ** (int(power) if float(power).is_integer() else power)


class Polynomial(SumOfPowers):
    """An even polynomial: what any smooth force gives, in ascending powers of amplitude²."""

    kind: ClassVar[str] = "polynomial"
    orders: ClassVar[tuple[int, ...]] = (0, 1, 2, 3, 4)

    @property
    def size(self) -> int | None:
        """See `AbstractFamily`: the number of terms beside the first."""
        return self.order

    @classmethod
    def powers(cls, order: int) -> tuple[float, ...]:
        """See `SumOfPowers`."""
        return tuple(2.0 * k for k in range(order + 1))

    @classmethod
    def names(cls, order: int) -> tuple[str, ...]:
        """See `SumOfPowers`."""
        return ("at_zero", *(f"power_{2 * k}" for k in range(1, order + 1)))


class Constant(SumOfPowers):
    """The same at every amplitude: the constant modal damping C of linear theory."""

    kind: ClassVar[str] = "constant"
    orders: ClassVar[tuple[int, ...]] = (0,)

    @classmethod
    def powers(cls, order: int) -> tuple[float, ...]:
        """See `SumOfPowers`."""
        return (0.0,)

    @classmethod
    def names(cls, order: int) -> tuple[str, ...]:
        """See `SumOfPowers`."""
        return ("constant",)


class ViscousQuadratic(SumOfPowers):
    """Viscous and quadratic damping: c|q̇|q̇ acts on the fundamental like 8cv/(3π)."""

    kind: ClassVar[str] = "viscous_quadratic"
    orders: ClassVar[tuple[int, ...]] = (1,)

    @classmethod
    def powers(cls, order: int) -> tuple[float, ...]:
        """See `SumOfPowers`."""
        return (0.0, 1.0)

    @classmethod
    def names(cls, order: int) -> tuple[str, ...]:
        """See `SumOfPowers`."""
        return ("viscous", "quadratic")


class ViscousCoulomb(SumOfPowers):
    """Viscous damping and dry friction: μ sign(q̇) acts on the fundamental like 4μ/(πv)."""

    kind: ClassVar[str] = "viscous_coulomb"
    orders: ClassVar[tuple[int, ...]] = (1,)

    @classmethod
    def powers(cls, order: int) -> tuple[float, ...]:
        """See `SumOfPowers`."""
        return (0.0, -1.0)

    @classmethod
    def names(cls, order: int) -> tuple[str, ...]:
        """See `SumOfPowers`."""
        return ("viscous", "coulomb")


class PowerLaw(AbstractFamily):
    """A value at zero and a power of amplitude whose positive exponent is free.

    The exponent may be anywhere in its range: the logarithm of its odds is expected within
    `odds_std` of zero, or it would run away where data want it at an end, and take the bands along.
    """

    odds_std: ClassVar[float] = 5.0  # an exponent of 99 % of its range is at one of these
    kind: ClassVar[str] = "power_law"
    orders: ClassVar[tuple[int, ...]] = (1,)
    largest_exponent: ClassVar[float] = 6.0
    tried: ClassVar[tuple[float, ...]] = (0.5, 1.0, 2.0, 4.0)

    def __call__(self, amplitude: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """See `AbstractFamily`."""
        x = jnp.asarray(amplitude) / self.scale
        known = x > 0
        power = jnp.exp(self.exponent * jnp.log(jnp.where(known, x, 1.0)))
        return self.parameters[0] + self.parameters[1] * jnp.where(known, power, 0.0)

    def prior_residuals(self) -> Float[Array, " row"]:
        """See `AbstractCurve`."""
        return self.parameters[2:] / self.odds_std

    @property
    def exponent(self) -> Float[Array, ""]:
        """Of the amplitude, between zero and `largest_exponent`."""
        return self.largest_exponent * jax.nn.sigmoid(self.parameters[2])

    def coefficients(self) -> tuple[Coefficient, ...]:
        """See `AbstractFamily`; the coefficient is the contribution at the largest amplitude."""
        return (
            Coefficient("at_zero", 0.0, True),
            Coefficient("at_largest", 0.0, True),
            Coefficient("logit_exponent", 0.0, False),
        )

    @classmethod
    def starts(
        cls,
        order: int,
        argument: Argument,
        amplitude: np.ndarray,
        values: np.ndarray,
        weight: np.ndarray,
    ) -> list[AbstractFamily]:
        """See `AbstractFamily`."""
        scale = float(np.max(amplitude))
        found: list[AbstractFamily] = []
        for power in cls.tried:
            columns = np.stack([np.ones(len(values)), (amplitude / scale) ** power], axis=1)
            share = power / cls.largest_exponent
            start = [*linear_start(columns, values, weight), np.log(share / (1 - share))]
            found.append(cls(jnp.asarray(start), jnp.asarray(scale, dtype=jnp.float64), argument))
        return found


class ViscousMicroslip(PowerLaw):
    """Viscous damping and microslip in joints, whose loss grows by a power between 2 and 3.

    Iwan's joints dissipate amplitude^(3+χ) with −1 < χ < 0 in a cycle, so that 2ζ̃ω̃ grows with
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
        texts = {kind: (one.__doc__ or "").strip().split("\n")[0] for kind, one in self.items()}
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
    """What the user fixed of a family."""

    kind: str  # or "auto"
    size: int | None
    argument: Argument | None


def parse_family(text: str) -> Choice:
    """Family, size and amplitude of "spline:5@velocity"; what is not said is None.

    Raises `ValueError` for what is no family.
    """
    head, _, argument = text.partition("@")
    kind, _, size = head.partition(":")
    if kind not in FAMILIES and kind != "auto":
        raise ValueError(f"{kind!r} is no family; there are {', '.join(FAMILIES)} and auto.")
    if size and not size.isdigit():
        raise ValueError(f"the size of a family must be a whole number, but is {size!r}.")
    known = {"": None} | {name: name for name in ARGUMENTS}
    if argument not in known:
        raise ValueError(f'the amplitude must be "displacement" or "velocity", not {argument!r}.')
    return Choice(kind, int(size) if size else None, known[argument])


def values_and_slopes(
    family: AbstractCurve, amplitude: Float[np.ndarray, " point"]
) -> tuple[Float[np.ndarray, " point"], Float[np.ndarray, "point parameter"]]:
    """Values of a curve and their derivatives by its parameters, on the host.

    What `jax.jacfwd` says, for the many families that a selection tries once each: their programs
    would take longer to compile than all of the selection takes.
    """
    x, parameters = amplitude / float(family.scale), np.asarray(family.parameters)
    if isinstance(family, SumOfPowers):
        powers = np.array(family.powers(family.order))
        some = np.where(x > 0, x, 1.0)[:, None] ** powers
        columns = np.where(x[:, None] > 0, some, powers == 0)
        # Dry friction: its equivalent damping grows without bound towards rest.
        dry = float(np.sum(parameters[powers < 0]))
        if dry != 0:
            values = columns @ parameters
            return np.where(x > 0, values, np.sign(dry) * np.inf), columns
    elif isinstance(family, Spline):
        columns = spline_columns(family, amplitude)
    elif isinstance(family, PowerLaw):
        exponent = float(family.largest_exponent * expit(parameters[2]))
        term, share = x**exponent, exponent / family.largest_exponent
        by_logit = exponent * (1 - share) * parameters[1] * term * np.log(np.where(x > 0, x, 1.0))
        values = parameters[0] + parameters[1] * term
        return values, np.stack([np.ones_like(x), term, by_logit], axis=1)
    else:
        at, direct = jnp.asarray(amplitude), _called_with
        columns = np.asarray(jax.jacfwd(lambda p: direct(family, p, at))(family.parameters))
        return np.asarray(family(at)), columns
    return columns @ parameters, columns


def _called_with(family: AbstractCurve, parameters: Array, amplitude: Array) -> Array:
    return eqx.tree_at(lambda f: f.parameters, family, parameters)(amplitude)
