"""Models that a function makes of uncertain inputs, each made once and in a program of its own.

A beam is condensed by many steps: within the program of a response they would be compiled anew for
every kind of motion, with all their derivatives, and done again at every step of a continuation.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from snrmjax.model.parameters import with_parameters
from snrmjax.model.structures import Structure
from snrmjax.numerics.blocks import by_blocks, mapped
from snrmjax.numerics.compiled import compiled
from snrmjax.study.uncertainty.uncertain_inputs import FORCE, UncertainInputs

ModelOf = Callable[[dict[str, Array]], Structure]
_BLOCK = 32  # members that one call works on


class ModelSeries(NamedTuple):
    """A model whose numbers are a quadratic of standard normal numbers z, exact at z = 0."""

    template: Structure
    numbers: Float[Array, " number"]
    slopes: Float[Array, "number input"]
    curvature: Float[Array, "number input input"]

    def at(self, z: Float[Array, " input"]) -> Float[Array, " number"]:
        """The numbers at z."""
        bends = jnp.einsum("nij,i,j->n", self.curvature, z, z)
        return self.numbers + self.slopes @ z + 0.5 * bends

    def model(self, z: Float[Array, " input"]) -> Structure:
        """The model at z."""
        return with_numbers(self.template, self.at(z))

    def toward(self, rest: Float[Array, " number"], share: Array) -> "ModelSeries":
        """The series on the way to a member that differs from it by `rest`.

        At a share of 1 the model at that member's z is its own; at 0 nothing is changed up to the
        second derivative.
        """
        return self._replace(numbers=self.numbers + share**3 * rest)


class Base(NamedTuple):
    """What is not uncertain."""

    model: Structure
    force: Float[np.ndarray, ""]  # N, where it is not among the inputs
    series: ModelSeries | None = None  # where the inputs are no numbers of the model

    def toward(self, rest: Float[Array, " number"], share: Array) -> "Base":
        """The same on the way to a member whose model is the series and `rest`."""
        if self.series is None:
            return self
        return self._replace(series=self.series.toward(rest, share))

    def at(
        self, inputs: UncertainInputs, z: Float[Array, " input"]
    ) -> tuple[Structure, Float[Array, ""]]:
        """Model and force at standard normal numbers."""
        values, model = inputs.values(z), self.model
        own = [k for k, name in enumerate(inputs.names) if name != FORCE]
        if self.series is not None:
            model = self.series.model(jnp.asarray(z))
        elif own:
            names = [inputs.names[k] for k in own]
            model = with_parameters(model, names, values[np.array(own)])
        if FORCE in inputs.names:
            return model, values[inputs.names.index(FORCE)]
        return model, jnp.asarray(self.force)


class MadeModels(eqx.Module):
    """The models of a differentiable function of the inputs' values; `made_models` makes it."""

    model_of: ModelOf
    inputs: UncertainInputs
    series: ModelSeries  # at the nominal inputs

    def numbers(self, z: Float[np.ndarray, "member input"]) -> Float[np.ndarray, "member number"]:
        """The numbers of every member's own model; NaN where there is none."""
        (found,) = by_blocks(lambda rows: (_numbers(self.model_of, self.inputs, rows),), _BLOCK, z)
        return found

    def rest(self, z: Float[np.ndarray, "member input"]) -> Float[np.ndarray, "member number"]:
        """The numbers of every member less those of the series."""
        return self.numbers(z) - np.asarray(jax.vmap(self.series.at)(jnp.asarray(z)))


def made_models(model_of: ModelOf, inputs: UncertainInputs) -> MadeModels:
    """The models that a function makes of inputs, with both derivatives at the nominal ones.

    Raises `ValueError` where `model_of` does for the nominal inputs.
    """
    zero = jnp.zeros(len(inputs.names))
    template = _made(model_of, inputs, zero)
    return MadeModels(model_of, inputs, ModelSeries(template, *_expanded(model_of, inputs)))


def with_numbers(template: Structure, numbers: Float[Array, " number"]) -> Structure:
    """A model with other numbers, in the order of its leaves."""
    arrays, others = eqx.partition(template, _is_number)
    return eqx.combine(ravel_pytree(arrays)[1](jnp.asarray(numbers)), others)


def _is_number(leaf: object) -> bool:
    return isinstance(leaf, float) or eqx.is_inexact_array(leaf)


def _made(model_of: ModelOf, inputs: UncertainInputs, z: Array) -> Structure:
    return model_of(dict(zip(inputs.names, inputs.values(z), strict=True)))


def _numbers_at(model_of: ModelOf, inputs: UncertainInputs, z: Array) -> Array:
    return ravel_pytree(eqx.filter(_made(model_of, inputs, z), _is_number))[0]


@compiled
def _expanded(model_of: ModelOf, inputs: UncertainInputs) -> tuple[Array, Array, Array]:
    def at(z: Array) -> tuple[Array, Array]:
        numbers = _numbers_at(model_of, inputs, z)
        return numbers, numbers

    def first(z: Array) -> tuple[Array, tuple[Array, Array]]:
        slopes, numbers = jax.jacfwd(at, has_aux=True)(z)
        return slopes, (numbers, slopes)

    curvature, (numbers, slopes) = jax.jacfwd(first, has_aux=True)(jnp.zeros(len(inputs.names)))
    return numbers, slopes, curvature


@compiled
def _numbers(model_of: ModelOf, inputs: UncertainInputs, z: Array) -> Array:
    return mapped(lambda row: _numbers_at(model_of, inputs, row), z)
