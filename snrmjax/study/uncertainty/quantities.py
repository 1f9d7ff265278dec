"""Quantities of uncertain inputs: what uncertainty is propagated to."""

import abc
from collections.abc import Callable
from enum import IntEnum
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from snrmjax.numerics.blocks import by_blocks, mapped
from snrmjax.numerics.compiled import jitted
from snrmjax.study.uncertainty.uncertain_inputs import UncertainInputs

_BLOCK = 64  # members that one call works on


class MemberStatus(IntEnum):
    """What became of one quantity of one member."""

    FOUND = 0
    REPLACED = 1  # the motion could not be followed; the whole response curve has one in its place
    CEASED = 2  # neither followed nor on the whole response curve
    IMPOSSIBLE = 3  # inputs that no structure has, such as a negative damping ratio
    NOT_FINITE = 4  # a function's value is NaN or infinite


MEMBER_MESSAGE: dict[MemberStatus, str] = {
    MemberStatus.FOUND: "found",
    MemberStatus.REPLACED: "another motion in place of the nominal one, which two folds or peaks"
    " that merge, or an internal resonance, end on the way to these inputs",
    MemberStatus.CEASED: "no such motion: two folds or peaks merge on the way to these inputs",
    MemberStatus.IMPOSSIBLE: "impossible inputs (a natural frequency, damping ratio or force that"
    " is not positive)",
    MemberStatus.NOT_FINITE: "a value that is not finite",
}


class Expansion(NamedTuple):
    """Quantities about z = 0, the nominal inputs, by the standard normal numbers z."""

    value: Float[np.ndarray, " quantity"]
    gradient: Float[np.ndarray, "quantity input"]
    hessian: Float[np.ndarray, "quantity input input"]


class SolvedMembers(NamedTuple):
    """Quantities of members; NaN where the status is neither `FOUND` nor `REPLACED`."""

    values: Float[np.ndarray, "member quantity"]
    status: Int[np.ndarray, "member quantity"]  # a `MemberStatus` each


class AbstractQuantities(eqx.Module):
    """Named quantities as functions of uncertain inputs."""

    inputs: eqx.AbstractVar[UncertainInputs]
    names: eqx.AbstractVar[tuple[str, ...]]
    units: eqx.AbstractVar[tuple[str, ...]]

    @abc.abstractmethod
    def expansion(self) -> Expansion:
        """Values, gradients and Hessians at the nominal inputs."""

    @abc.abstractmethod
    def members(self, z: Float[np.ndarray, "member input"]) -> SolvedMembers:
        """The quantities of every member."""


class FunctionQuantities(AbstractQuantities):
    """The results of a differentiable JAX function of the inputs' values.

    `function` takes a vector of inputs and gives one of quantities; NaN says that it failed.

    >>> import jax.numpy as jnp
    >>> from snrmjax.study.uncertainty.uncertain_inputs import correlated_inputs
    >>> inputs = correlated_inputs(["a", "b"], [1.0, 2.0], [[0.01, 0.0], [0.0, 0.04]])
    >>> area = FunctionQuantities(lambda x: x[:1] * x[1], inputs, ("area",), ("m^2",))
    >>> area.expansion().gradient.round(12).tolist()
    [[0.2, 0.2]]
    """

    function: Callable[[Float[Array, " input"]], Float[Array, " quantity"]]
    inputs: UncertainInputs
    names: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)

    def expansion(self) -> Expansion:
        """See `AbstractQuantities`."""
        value, gradient, hessian = _expanded(self, jnp.zeros(len(self.inputs.names)))
        return Expansion(np.asarray(value), np.asarray(gradient), np.asarray(hessian))

    def members(self, z: Float[np.ndarray, "member input"]) -> SolvedMembers:
        """See `AbstractQuantities`."""
        (values,) = by_blocks(lambda rows: (_values(self, rows),), _BLOCK, np.asarray(z))
        finite = np.isfinite(values)
        status = np.where(finite, int(MemberStatus.FOUND), int(MemberStatus.NOT_FINITE))
        return SolvedMembers(np.where(finite, values, np.nan), status)

    def at(self, z: Float[Array, " input"]) -> Float[Array, " quantity"]:
        """The quantities at standard normal numbers."""
        return self.function(self.inputs.values(z))


@jitted
def _expanded(quantities: FunctionQuantities, z: Array) -> tuple[Array, Array, Array]:
    slopes = jax.jacfwd(quantities.at)
    return quantities.at(z), slopes(z), jax.jacfwd(slopes)(z)


@jitted
def _values(quantities: FunctionQuantities, z: Array) -> Array:
    return mapped(quantities.at, z)
