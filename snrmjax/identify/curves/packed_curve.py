"""Every family of curves in arrays of one size: one compiled program then serves them all."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from snrmjax.identify.curves.families import PowerLaw, SumOfPowers
from snrmjax.identify.curves.family_base import AbstractCurve, AbstractFamily
from snrmjax.identify.curves.splines import SmoothingSpline, Spline, hats

_FAR = 1e6  # (amplitude/scale)² of a knot that is none
_SIZE = 12  # parameters; a larger family takes a multiple of it


class PackedCurve(AbstractCurve):
    """Σ c_k x^e_k + Σ d_k h_k(x²), with the `hats` h_k and coefficients linear in the parameters.

    What a family does not have is multiplied by zero: parameters beyond its own move nothing.
    """

    exponents: Float[Array, " term"]
    is_free: Bool[Array, " term"]  # the exponent is that of a power law
    largest_exponent: Float[Array, ""]
    knots: Float[Array, " knot"]
    mix: Float[Array, "basis parameter"]  # from parameters to coefficients
    of_velocity: Bool[Array, ""]
    prior: Float[Array, "row parameter"]  # what of the parameters is expected near zero, in its 1σ

    def prior_residuals(self) -> Float[Array, " row"]:
        """See `AbstractCurve`."""
        return self.prior @ self.parameters

    def __call__(self, amplitude: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """See `AbstractCurve`."""
        x = jnp.asarray(amplitude) / self.scale
        shape = (self.exponents, self.is_free, self.largest_exponent, self.knots, self.mix)
        return _value(x, self.parameters, shape)

    def amplitude(self, displacement: Array, velocity: Array) -> Array:
        """See `AbstractCurve`."""
        return jnp.where(self.of_velocity, velocity, displacement)


_Shape = tuple[Array, Array, Array, Array, Array]


class _Basis(NamedTuple):
    """The basis at x, its derivative by x and by a power law's exponent."""

    value: Float[Array, "*batch basis"]
    by_x: Float[Array, "*batch basis"]
    by_exponent: Float[Array, "*batch basis"]


def _basis(x: Array, parameters: Array, shape: _Shape) -> _Basis:
    exponents, is_free, largest, knots, _ = shape
    x = x[..., None]
    exponents = jnp.where(is_free, largest * jax.nn.sigmoid(parameters[2]), exponents)
    known = x > 0
    inside = jnp.where(known, x, 1.0)
    powers = jnp.exp(exponents * jnp.log(inside))
    bent, by_u = hats(x[..., 0] ** 2, knots)
    rest = jnp.where(exponents == 0, 1.0, 0.0)
    none = jnp.zeros_like(bent)
    growing = jnp.where(known, exponents * powers / inside, jnp.where(exponents == 1, 1.0, 0.0))
    logarithms = jnp.where(known & is_free, powers * jnp.log(inside), 0.0)
    return _Basis(
        jnp.concatenate([jnp.where(known, powers, rest), bent], axis=-1),
        jnp.concatenate([growing, 2 * x * by_u], axis=-1),
        jnp.concatenate([logarithms, none], axis=-1),
    )


@jax.custom_jvp
def _value(x: Array, parameters: Array, shape: _Shape) -> Array:
    coefficients = shape[-1] @ parameters
    value = _basis(x, parameters, shape).value @ coefficients
    # Dry friction: its equivalent damping grows without bound towards rest.
    dry = jnp.sum(jnp.where(shape[0] < 0, coefficients[: shape[0].size], 0.0))
    return jnp.where((dry != 0) & (x <= 0), jnp.sign(dry) * jnp.inf, value)


@_value.defjvp
def _value_and_slope(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    """One basis serves all directions, where automatic rules would draw its powers for each."""
    x, parameters, shape = primals
    by_x, by_parameters, _ = tangents
    basis, mix = _basis(x, parameters, shape), shape[-1]
    coefficients = mix @ parameters
    share = jax.nn.sigmoid(parameters[2])
    by_logit = (basis.by_exponent @ coefficients) * shape[2] * share * (1 - share)
    columns = (basis.value @ mix).at[..., 2].add(by_logit)
    slope = (basis.by_x @ coefficients) * by_x + columns @ by_parameters
    return _value(x, parameters, shape), slope


def _filled(parameters: Array, missing: int) -> Array:
    """With zeros behind: on the host, where nothing compiles for one more size, if it can be."""
    if isinstance(parameters, jax.core.Tracer):
        return jnp.pad(parameters, (0, missing))
    return jnp.asarray(np.pad(np.asarray(parameters), (0, missing)))


def packed(family: AbstractFamily, room: int = 0) -> AbstractCurve:
    """The same curve as an `PackedCurve`; a family that users wrote stays what it is.

    There is room for so many parameters at least.
    """
    n = family.parameters.shape[0]
    size = -(-max(n, room) // _SIZE) * _SIZE
    exponents, knots = np.zeros(size), _FAR * np.arange(1.0, size + 3)
    mix, free = np.zeros((2 * size, size)), np.zeros(size, dtype=bool)
    largest, prior = 1.0, np.zeros((size, size))
    if isinstance(family, SmoothingSpline):
        prior[: n - 2, :n] = np.asarray(family.bends) / np.asarray(family.bend_std)[..., None]
    if isinstance(family, SumOfPowers):
        exponents[:n] = [*family.terms(family.order).values()]
        mix[:n, :n] = np.eye(n)
    elif isinstance(family, PowerLaw):
        free[1], largest, prior[0, 2] = True, family.largest_exponent, 1 / family.odds_std
        mix[:2, :2] = np.eye(2)
    elif isinstance(family, Spline):
        exponents[1] = 2.0
        knots[:n] = np.asarray(family.knots)
        mix[:2, :n] = np.asarray(family.mix)[:2]
        mix[size : size + n - 2, :n] = np.asarray(family.mix)[2:]
    else:
        return family
    return PackedCurve(
        parameters=_filled(family.parameters, size - n),
        scale=family.scale,
        exponents=jnp.asarray(exponents),
        is_free=jnp.asarray(free),
        largest_exponent=jnp.asarray(largest),
        knots=jnp.asarray(knots),
        mix=jnp.asarray(mix),
        of_velocity=jnp.asarray(family.argument == "velocity"),
        prior=jnp.asarray(prior),
    )
