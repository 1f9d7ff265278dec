"""Two equations for two unknowns by Newton's method, many at a time."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, Float

from snrmjax.numerics.rules import InputError


class CramersRule(lx.AbstractLinearSolver[Any]):
    """Solves a 2×2 linear system by Cramer's rule, for cheap Newton steps.

    With `zero_stays_zero` a zero right side gives zero even for a singular matrix: in reverse mode
    a failed member of a batch then does not affect the others.
    """

    zero_stays_zero: bool = False

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> Array:
        """See `lineax.AbstractLinearSolver.init`."""
        if operator.in_size() != 2 or operator.out_size() != 2:
            raise InputError("`CramersRule` solves systems of two equations for two unknowns only.")
        return operator.as_matrix()

    def compute(
        self, state: Array, vector: Array, options: dict[str, Any]
    ) -> tuple[Array, lx.RESULTS, dict[str, Any]]:
        """See `lineax.AbstractLinearSolver.compute`."""
        (a, b), (c, d) = state
        x = (d * vector[0] - b * vector[1]) / (a * d - b * c)
        y = (a * vector[1] - c * vector[0]) / (a * d - b * c)
        answer = jnp.stack([x, y])
        if self.zero_stays_zero:
            answer = jnp.where(jnp.all(vector == 0), 0.0, answer)
        return answer, lx.RESULTS.successful, {}

    def transpose(self, state: Array, options: dict[str, Any]) -> tuple[Array, dict[str, Any]]:
        """See `lineax.AbstractLinearSolver.transpose`."""
        return state.T, {}

    def conj(self, state: Array, options: dict[str, Any]) -> tuple[Array, dict[str, Any]]:
        """See `lineax.AbstractLinearSolver.conj`."""
        return state.conj(), {}

    def assume_full_rank(self) -> bool:
        """See `lineax.AbstractLinearSolver.assume_full_rank`."""
        return True


_NEWTON: optx.AbstractRootFinder = optx.Newton(rtol=1e-11, atol=1e-12, linear_solver=CramersRule())
_STEPS = 8  # from the closed form one step is enough, two where the two roots nearly meet
_ADJOINT = optx.ImplicitAdjoint(linear_solver=CramersRule(zero_stays_zero=True))


def root_of_two(
    equations: Callable[[Array, Any], Array], start: Float[Array, "2"], args: Any
) -> tuple[Float[Array, "2"], Bool[Array, ""]]:
    """The root near a start, and whether it was reached; differentiable with respect to `args`."""
    solution: optx.Solution = optx.root_find(
        equations, _NEWTON, start, args, max_steps=_STEPS, adjoint=_ADJOINT, throw=False
    )
    return solution.value, jnp.asarray(solution.result == optx.RESULTS.successful)
