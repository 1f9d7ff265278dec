"""Newton's method, with its tolerances: to a root, and onto a curve.

`newton` solves as many equations as unknowns, each of order one (or over their `scale`). On a curve
one equation is missing: `correct` solves for its point in a hyperplane, and `Trial` takes single
steps, so that many curves advance in lanes; one factorisation then yields the tangent too.
"""

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


CLOSE = 1e-6  # change after which one more step is exact to rounding
ROUNDING = 1e-9  # largest further step at a root that is known to all its digits


class Root(NamedTuple):
    """Where Newton's method ended, and the equations there."""

    point: Point
    residual: Float[Array, " unknown"]
    jacobian: Float[Array, "unknown unknown"]
    change: Float[Array, ""]  # largest entry of the last step over the scale
    n_steps: Int[Array, ""]
    scale: Number

    def one_more(
        self, residual: Float[Array, " unknown"] | None = None, within: float = CLOSE
    ) -> tuple[Point, Bool[Array, ""]]:
        """The point after a further step, and whether the iteration converged `within` it.

        With a differentiable `residual` at the point the step carries its first derivatives.
        """
        step = jnp.linalg.solve(self.jacobian, self.residual if residual is None else residual)
        largest = jnp.max(jnp.abs(jax.lax.stop_gradient(step) / self.scale))
        return self.point - step, (self.change <= CLOSE) & (largest <= within)


def newton(linearised: Linearised, start: Point, *, most: int = 20, scale: Number = 1.0) -> Root:
    """Newton's method from `start` until a step changes no unknown by more than `CLOSE`.

    Arguments: `linearised` returns equations and Jacobian; `most` steps; `scale` of the unknowns.
    The result ends one step early: `Root.one_more` takes it, by the Jacobian already known.
    """

    def step(last: Root) -> Root:
        change = jnp.linalg.solve(last.jacobian, last.residual)
        point, size = last.point - change, jnp.max(jnp.abs(change / scale))
        return Root(point, *linearised(point), size, last.n_steps + 1, scale)

    def goes_on(last: Root) -> Array:
        return (last.n_steps < 1) | ((last.n_steps < most) & (last.change > CLOSE))

    # The first step is zero, so that the equations are compiled only once.
    nothing, eye = jnp.zeros_like(start), jnp.eye(start.shape[0])
    first = Root(start, nothing, eye, jnp.array(jnp.inf), jnp.array(-1), scale)
    return jax.lax.while_loop(goes_on, step, first)


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
    tolerance: Number = 1e-10,
    iterations: Number = 30,
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
