"""Base of all curves of amplitude: powers and spline functions, in NumPy and JAX alike.

Every member of a family is ω̃²(amplitude) in rad²/s² or 2ζ̃ω̃(amplitude) in 1/s. Its parameters are
the contributions of its terms at the largest measured amplitude, all in the unit of the curve.
"""

import dataclasses
from abc import abstractmethod
from typing import Any, ClassVar, Literal, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.special import expit

from snrmjax.numerics.compiled import compiled

Argument = Literal["displacement", "velocity"]

_KIND_WORDS = {
    "polynomial": "even polynomial",
    "power_law": "power law",
    "smoothing_spline": "smoothing spline",
    "viscous_quadratic": "viscous and quadratic damping",
    "viscous_coulomb": "viscous and Coulomb damping",
    "viscous_microslip": "viscous and microslip damping",
}
_FAR = 1e6  # (amplitude/scale)² of padding knots
_SIZE = 12  # parameters and powers are padded to multiples of it


class Coefficient(NamedTuple):
    """A parameter of a family."""

    name: str
    is_value: bool  # False: dimensionless, such as an exponent


class Terms(NamedTuple):
    """Σ c_k x^e_k + Σ d_k h_k(x²) with `hats` h_k, coefficients linear in the parameters."""

    exponents: Float[Array | np.ndarray, " term"]
    is_free: Bool[Array | np.ndarray, " term"]  # the exponent is the third parameter's
    largest_exponent: Float[Array, ""] | float  # of a free exponent, times a logistic function
    knots: Float[Array | np.ndarray, " knot"]
    mix: Float[Array | np.ndarray, "basis parameter"]  # from parameters to coefficients
    prior: Float[Array | np.ndarray, "row parameter"]  # prior residuals, in their 1σ
    offset: Float[Array | np.ndarray, "*basis"] | float = 0.0  # constant part of the coefficients

    @classmethod
    def of_powers(cls, exponents: list[float], n_parameters: int | None = None) -> "Terms":
        """Powers alone, each with its parameter; further parameters have no term."""
        n = len(exponents) if n_parameters is None else n_parameters
        powers, free = np.array(exponents, dtype=float), np.zeros(len(exponents), dtype=bool)
        return cls(powers, free, 1.0, np.zeros(0), np.eye(len(exponents), n), np.zeros((0, n)))


class Linearised(NamedTuple):
    """A curve at some amplitudes, with its derivatives."""

    value: Any
    by_parameters: Any  # trailing axis of parameters
    by_amplitude: Any


class _Evaluated(NamedTuple):
    """A curve at given x, and the quantities that its derivatives need."""

    value: Any
    basis: Any  # trailing axis of terms
    by_x: Any
    by_third: Any  # by the third parameter as an exponent, besides its coefficient


def _evaluated(x: Any, parameters: Any, terms: Terms, xp: Any) -> _Evaluated:
    """The curve in NumPy or JAX (`xp`)."""
    n, has_third = len(terms.exponents), parameters.shape[0] > 2
    hat_values, by_u = hats(x**2, terms.knots, xp)
    x = x[..., None]
    known = x > 0
    inside = xp.where(known, x, 1.0)
    fraction = (expit if xp is np else jax.nn.sigmoid)(parameters[2]) if has_third else 0.0
    exponents = xp.where(terms.is_free, terms.largest_exponent * fraction, terms.exponents)
    powers = inside**exponents
    at_rest = xp.where(exponents == 0, 1.0, 0.0)
    rising = xp.where(known, exponents * powers / inside, xp.where(exponents == 1, 1.0, 0.0))
    basis = xp.concatenate([xp.where(known, powers, at_rest), hat_values], axis=-1)
    slopes = xp.concatenate([rising, 2 * x * by_u], axis=-1)
    coefficients = terms.mix @ parameters + terms.offset
    by_exponent = xp.where(known & terms.is_free, powers * xp.log(inside), 0.0) @ coefficients[:n]
    by_third = terms.largest_exponent * fraction * (1 - fraction) * by_exponent
    # Dry friction: its equivalent damping ∝ 1/v is infinite at rest.
    dry = xp.sum(xp.where(terms.exponents < 0, coefficients[:n], 0.0))
    infinite = (dry != 0) & (x[..., 0] <= 0)
    value = xp.where(infinite, xp.copysign(xp.inf, dry), basis @ coefficients)
    return _Evaluated(value, basis, slopes @ coefficients, by_third)


@jax.custom_jvp
def _value(x: Array, parameters: Array, terms: Terms) -> Array:
    return _evaluated(x, parameters, terms, jnp).value


@_value.defjvp
def _value_and_slope(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    """The basis is evaluated once for all tangents, where automatic rules would repeat it for each.

    Terms are chosen, not fitted: they have no derivative.
    """
    (x, parameters, terms), (by_x, by_parameters, _) = primals, tangents
    drawn = _evaluated(x, parameters, terms, jnp)
    slope = drawn.by_x * by_x + drawn.basis @ (terms.mix @ by_parameters)
    if parameters.shape[0] > 2:
        slope = slope + drawn.by_third * by_parameters[2]
    return _value(x, parameters, terms), slope


def hats(u: Any, knots: Any, xp: Any) -> tuple[Any, Any]:
    """Functions whose second derivative is a hat over three successive knots, and their slopes.

    Linear outside of the hat, and formed from clipped differences: no cancellation, unlike sums of
    truncated powers. Arguments: `xp` is NumPy or JAX's.
    """
    u = u[..., None]
    left, middle, right = knots[:-2], knots[1:-1], knots[2:]
    rise, fall = middle - left, right - middle
    up, down = xp.clip(u - left, 0.0, rise), xp.clip(u - middle, 0.0, fall)
    past, beyond = xp.maximum(u - middle, 0.0), xp.maximum(u - right, 0.0)
    value = up**3 / (6 * rise) + 0.5 * (rise * past + down**2 + fall * beyond)
    value = value - down**3 / (6 * fall)
    return value, 0.5 * up**2 / rise + down - 0.5 * down**2 / fall


class AbstractCurve(eqx.Module):
    """A curve of amplitude with fitted parameters."""

    parameters: Float[Array, " parameter"]
    scale: Float[Array, ""]  # the largest measured amplitude, m or m/s

    @abstractmethod
    def __call__(self, amplitude: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Value at amplitudes of its argument, exact in the limit of zero."""

    def linearised(self, amplitude: Float[np.ndarray, " point"]) -> Linearised:
        """Values and derivatives by the parameters and by the amplitude, on the host."""
        return Linearised(*map(np.asarray, _by_program(self, jnp.asarray(amplitude))))


@compiled
def _by_program(curve: AbstractCurve, at: Array) -> Linearised:
    def of(parameters: Array, at: Array) -> Array:
        return eqx.tree_at(lambda f: f.parameters, curve, parameters)(at)

    # Values depend on their own amplitude only: one forward-mode product gives all slopes.
    value, slope = jax.jvp(lambda at: of(curve.parameters, at), (at,), (jnp.ones_like(at),))
    return Linearised(value, jax.jacfwd(of)(curve.parameters, at), slope)


class PackedCurve(AbstractCurve):
    """Terms of any family padded to one size, so that one compiled program serves all.

    Padding is multiplied by zero: parameters beyond the family's own have no effect.
    """

    made_of: Terms
    of_velocity: Bool[Array, ""]

    def __call__(self, amplitude: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """See `AbstractCurve`."""
        return _value(jnp.asarray(amplitude) / self.scale, self.parameters, self.made_of)

    def amplitude(self, displacement: Array, velocity: Array) -> Array:
        """The amplitude that this curve is a function of."""
        return jnp.where(self.of_velocity, velocity, displacement)

    def prior_residuals(self) -> Float[Array, " row"]:
        """Prior residuals of the curve, in units of their 1σ."""
        return jnp.asarray(self.made_of.prior @ self.parameters)


class Scattered(NamedTuple):
    """Weighted points of a curve, from which a family is started."""

    argument: Argument
    amplitude: Float[np.ndarray, " point"]
    values: Float[np.ndarray, " point"]
    weight: Float[np.ndarray, " point"]

    @property
    def largest(self) -> float:
        """The largest amplitude."""
        return float(np.max(self.amplitude))

    def fitted(self, columns: Float[np.ndarray, "point column"]) -> Float[np.ndarray, " column"]:
        """Weighted least-squares coefficients of columns."""
        weighted, goal = columns * self.weight[:, None], self.values * self.weight
        return np.asarray(np.linalg.lstsq(weighted, goal, rcond=1e-10)[0])


class AbstractFamily(AbstractCurve):
    """A named curve of amplitude, displacement or velocity (`argument`)."""

    kind: ClassVar[str]
    orders: ClassVar[tuple[int, ...]]  # sizes that selection tries, simplest first
    argument: Argument = eqx.field(static=True)

    @abstractmethod
    def terms(self) -> Terms:
        """The terms of the curve in amplitude/`scale`."""

    @abstractmethod
    def coefficients(self) -> tuple[Coefficient, ...]:
        """Names of the parameters, and which are values of the curve."""

    @classmethod
    @abstractmethod
    def starts(cls, order: int, near: Scattered) -> list["AbstractFamily"]:
        """Members fitted to scattered points: one where the family is linear, else several."""

    @property
    def size(self) -> int | None:
        """The size given with the family's name; None where there is only one."""
        return None

    def __call__(self, amplitude: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """See `AbstractCurve`."""
        return packed(self)(amplitude)

    def linearised(
        self,
        amplitude: Float[np.ndarray, " point"],
        parameters: Float[np.ndarray, " parameter"] | None = None,
    ) -> Linearised:
        """See `AbstractCurve`; without compilation. For other `parameters`, if given."""
        host = jax.tree.map(np.asarray, self)
        scale, terms = float(host.scale), host.terms()
        own = host.parameters if parameters is None else parameters
        drawn = _evaluated(np.asarray(amplitude) / scale, own, terms, np)
        columns = drawn.basis @ terms.mix
        if columns.shape[-1] > 2:
            columns[..., 2] += drawn.by_third
        return Linearised(drawn.value, columns, drawn.by_x / scale)

    def amplitude(self, displacement: Array, velocity: Array) -> Array:
        """The amplitude that this curve is a function of."""
        return displacement if self.argument == "displacement" else velocity

    def prior_residuals(self) -> Float[Array, " row"]:
        """Prior residuals of the curve, in units of their 1σ."""
        return jnp.asarray(self.terms().prior @ self.parameters)

    def at(self, parameters: Float[np.ndarray, " parameter"]) -> Self:
        """The member of the same family with other parameters."""
        return dataclasses.replace(self, parameters=jax.device_put(parameters))

    def expected_std(self) -> Float[np.ndarray, " parameter"]:
        """Prior 1σ about zero of every parameter; infinite where flat."""
        rows = np.linalg.norm(np.asarray(self.terms().prior), axis=0)
        return np.divide(1.0, rows, out=np.full(len(rows), np.inf), where=rows > 0)

    @property
    def label(self) -> str:
        """Family, size and amplitude as the joint fit takes them: "polynomial:2@velocity"."""
        size = "" if self.size is None else f":{self.size}"
        return f"{self.kind}{size}@{self.argument}"

    @property
    def words(self) -> str:
        """Family, size and amplitude in words: "power law of velocity"."""
        if self.kind == "constant" or (self.kind == "polynomial" and self.size == 0):
            return "constant"
        sized = ""
        if "spline" in self.kind:
            sized = f", {self.size} knots"
        elif self.kind == "polynomial":
            sized = f", {self.size} {'term' if self.size == 1 else 'terms'} plus a constant"
        return f"{_KIND_WORDS.get(self.kind, self.kind)} of {self.argument}{sized}"


def packed(family: AbstractFamily, room: int = 0) -> PackedCurve:
    """The same curve padded to one size, with room for at least `room` parameters.

    On the host where possible, which compiles nothing for a new size.
    """
    traced = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(family))
    xp: Any = jnp if traced else np
    family = family if traced else jax.tree.map(np.asarray, family)
    terms, parameters = family.terms(), family.parameters
    n, k, h = parameters.shape[0], len(terms.exponents), max(len(terms.knots) - 2, 0)
    size, powers = (-(-most // _SIZE) * _SIZE for most in (max(n, room, h), k))

    def filled(rows: Any, *lengths: int) -> Array:
        rows = xp.asarray(rows)
        added = [(0, to - now) for to, now in zip(lengths, rows.shape, strict=True)]
        return xp.pad(rows, added)

    far = _FAR * np.arange(1.0, size + 3)[len(terms.knots) :]
    mix = [filled(terms.mix[:k], powers, size), filled(terms.mix[k : k + h], size, size)]
    offset = xp.broadcast_to(terms.offset, (k + h,))
    curve = PackedCurve(
        parameters=filled(parameters, size),
        scale=xp.asarray(family.scale),
        made_of=Terms(
            exponents=filled(terms.exponents, powers),
            is_free=filled(terms.is_free, powers),
            largest_exponent=xp.asarray(terms.largest_exponent),
            knots=xp.concatenate([terms.knots, far]),
            mix=xp.concatenate(mix),
            prior=filled(terms.prior, size, size),
            offset=xp.concatenate([filled(offset[:k], powers), filled(offset[k:], size)]),
        ),
        of_velocity=xp.asarray(family.argument == "velocity"),
    )
    return curve if traced else jax.device_put(curve)
