"""Newton's method in a hyperplane, one step at a time, for one problem or a batch."""

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
def solve_appended(
    columns: Float[Array, "column equation"],
) -> Float[Array, "right equation"]:
    """Solve for the right-hand sides appended to the columns of a square matrix."""
    size = columns.shape[1]
    # LU returns the appended columns multiplied by the inverse of L.
    factors = jax.lax.linalg.lu(columns.T)[0]
    return jax.lax.linalg.triangular_solve(
        factors[:, :size], factors[:, size:], left_side=True, lower=False
    ).T


@solve_appended.def_vmap
def _solve_appended_batch(count: int, batched: list[bool], columns: Array) -> tuple[Array, bool]:
    """One after the other on a CPU.

    A batched factorisation is distributed over a thread pool and waits for it: called from as many
    threads, it deadlocks (jaxlib 0.10).
    """
    if on_accelerator():
        return jax.vmap(solve_appended.fun)(columns), True
    return jax.lax.map(solve_appended, columns), True


class Trial(NamedTuple):
    """State of a Newton correction in the hyperplane through `start` normal to `across`."""

    start: Point
    across: Point
    point: Point  # the last iterate
    tangent: Point  # of unit length, along `across`, at the previous iterate
    n_solves: Int[Array, ""]
    converged: Bool[Array, ""]
    finite: Bool[Array, ""]

    @classmethod
    def at(cls, start: Point, across: Point) -> "Trial":
        """The state before the first step."""
        yes = jnp.array(True)
        return cls(start, across, start, across, jnp.array(0), ~yes, yes)

    def goes_on(self, iterations: Number) -> Bool[Array, ""]:
        """Whether to take another Newton step."""
        return self.finite & ~self.converged & (self.n_solves < iterations)

    def stepped(self, linearised: Linearised, tolerance: Number) -> "Trial":
        """The state after one Newton step.

        One LU factorisation of the bordered matrix, with both right-hand sides as further columns,
        yields the step and the tangent. Converged when the remaining error is below `tolerance`;
        it is estimated as the last step times its reduction of the residual.
        """
        size = self.start.shape[0]
        residual, jacobian = linearised(self.point)
        ahead = self.across @ (self.point - self.start)
        border = jnp.concatenate([self.across, jnp.stack([ahead, 1.0])])
        columns = jnp.concatenate([jacobian.T, residual[None], jnp.zeros((1, size - 1))])
        change, tangent = solve_appended(jnp.concatenate([columns, border[:, None]], axis=1))
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
    """Newton's method in the hyperplane through `start` normal to `direction`."""
    return jax.lax.while_loop(
        lambda trial: trial.goes_on(iterations),
        lambda trial: trial.stepped(linearised, tolerance),
        Trial.at(start, direction),
    )


def chosen(yes: Bool[Array, ""], first: T, second: T) -> T:
    """The first state if `yes`, else the second."""
    return jax.tree.map(lambda a, b: jnp.where(yes, a, b), first, second)
