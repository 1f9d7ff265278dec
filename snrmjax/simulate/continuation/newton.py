"""Newton's method across a direction: one step at a time, alone or side by side."""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from snrmjax.numerics.blocks import on_accelerator

T = TypeVar("T")
Point = Float[Array, " unknown"]
Number = float | Array | np.ndarray
Linearised = Callable[[Point], tuple[Float[Array, " equation"], Float[Array, "equation unknown"]]]


@jax.custom_batching.custom_vmap
def solved_behind(
    columns: Float[Array, "column equation"],
) -> Float[Array, "right equation"]:
    """The solutions for the right-hand sides that stand behind the columns of a square matrix."""
    size = columns.shape[1]
    # The columns behind the square part come out multiplied by the inverse of L.
    factors = jax.lax.linalg.lu(columns.T)[0]
    return jax.lax.linalg.triangular_solve(
        factors[:, :size], factors[:, size:], left_side=True, lower=False
    ).T


@solved_behind.def_vmap
def _solved_side_by_side(count: int, batched: list[bool], columns: Array) -> tuple[Array, bool]:
    """One after the other on a CPU.

    A factorisation of many matrices at once spreads over the threads of a pool and waits for them:
    called from as many threads itself, it waits for ever (jaxlib 0.10).
    """
    if on_accelerator():
        return jax.vmap(solved_behind.fun)(columns), True
    return jax.lax.map(solved_behind, columns), True


class Trial(NamedTuple):
    """A correction under way: Newton's method in the hyperplane through `start` across `across`."""

    start: Point
    across: Point
    point: Point  # the last iterate
    tangent: Point  # of unit length, along `across`, at the iterate before
    n_solves: Int[Array, ""]
    converged: Bool[Array, ""]
    finite: Bool[Array, ""]

    @classmethod
    def at(cls, start: Point, across: Point) -> "Trial":
        """A correction that is to begin."""
        yes = jnp.array(True)
        return cls(start, across, start, across, jnp.array(0), ~yes, yes)

    def goes_on(self, iterations: Number) -> Bool[Array, ""]:
        """Whether another step of Newton's method is wanted."""
        return self.finite & ~self.converged & (self.n_solves < iterations)

    def stepped(self, linearised: Linearised, tolerance: Number) -> "Trial":
        """After one step of Newton's method.

        One LU factorisation of the bordered matrix, with both right-hand sides as further columns,
        gives the step and the tangent. Converged when the error that is left falls below
        `tolerance`; it is judged by the last step times what that step left of the residual.
        """
        size = self.start.shape[0]
        residual, jacobian = linearised(self.point)
        ahead = self.across @ (self.point - self.start)
        border = jnp.concatenate([self.across, jnp.stack([ahead, 1.0])])
        columns = jnp.concatenate([jacobian.T, residual[None], jnp.zeros((1, size - 1))])
        change, tangent = solved_behind(jnp.concatenate([columns, border[:, None]], axis=1))
        new, step = self.point - change, jnp.max(jnp.abs(change))
        left = jnp.max(jnp.abs(linearised(new)[0])) / jnp.max(jnp.abs(residual))
        done = (step <= tolerance) | ((step * left <= tolerance) & (step < 0.1))
        return self._replace(
            point=new,
            tangent=tangent / jnp.linalg.norm(tangent),
            n_solves=self.n_solves + 1,
            converged=done & jnp.isfinite(step),
            finite=jnp.isfinite(step),
        )


def correct(
    linearised: Linearised,
    start: Point,
    direction: Point,
    tolerance: Number,
    iterations: Number,
) -> Trial:
    """Newton's method in the hyperplane through `start` across `direction`, to its end."""
    return jax.lax.while_loop(
        lambda trial: trial.goes_on(iterations),
        lambda trial: trial.stepped(linearised, tolerance),
        Trial.at(start, direction),
    )


def chosen(yes: Bool[Array, ""], first: T, second: T) -> T:
    """One of two states of one kind."""
    return jax.tree.map(lambda a, b: jnp.where(yes, a, b), first, second)
