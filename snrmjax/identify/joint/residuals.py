"""What a joint fit makes small, its slopes, and the steps that a fit takes on them.

Residuals are every state's balance in units of its noise, and the priors. An error of a level
moves the states of that level alone: one push forward through the residuals serves this error in
all levels. Of eight levels with four errors each, 32 pushes become four.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int

from snrmjax.identify.joint.force_balance import (
    BalanceData,
    BalanceProblem,
    Unknowns,
    Weighting,
    force_balance,
    nearest_errors,
)
from snrmjax.identify.joint.free_unknowns import Unravel
from snrmjax.numerics.blocks import mapped

_SINGULAR = 1e-13  # of JᵀJ's diagonal, what is added to it: rounding must not make it singular


def whitened(
    unknowns: Unknowns,
    problem: BalanceProblem,
    weighting: Weighting,
) -> Float[Array, "state part"]:
    """Residuals of the states, of unit variance where the noise is as stated."""
    balance = force_balance(unknowns, problem, problem.data.correction) + weighting.offset
    return jnp.sqrt(problem.data.weight)[:, None] * jnp.einsum(
        "sij,sj->si", weighting.whiten, balance
    )


def all_residuals(
    vector: Array,
    unravel: Unravel,
    problem: BalanceProblem,
    weighting: Weighting,
) -> Float[Array, " residual"]:
    """Whitened residuals of the states, then the priors of levels, linear parameters and curves."""
    unknowns = unravel(vector)
    points = whitened(unknowns, problem, weighting).reshape(-1)
    curves = (unknowns.squared_frequency, unknowns.modal_damping)
    priors = [unknowns.level.reshape(-1), unknowns.linear, *(c.prior_residuals() for c in curves)]
    return jnp.concatenate([points, *priors])


def level_of_residuals(unravel: Unravel, data: BalanceData) -> Int[Array, " residual"]:
    """Whose deviations move each of `all_residuals`; −1 where it is no level's."""
    unknowns = unravel.unknowns
    curves = (unknowns.squared_frequency, unknowns.modal_damping)
    n_levels, n_errors = unknowns.level.shape
    nobody = unknowns.linear.size + sum(c.prior_residuals().size for c in curves)
    own = (jnp.repeat(data.level, 2), jnp.repeat(jnp.arange(n_levels), n_errors))
    return jnp.concatenate([*own, jnp.full(nobody, -1)])


def corrected_residuals(
    vector: Array,
    unravel: Unravel,
    problem: BalanceProblem,
    weighting: Weighting,
    correcting: Array,
) -> Float[Array, " residual"]:
    """`all_residuals`, the states corrected for their most likely errors if `correcting`.

    The residuals are then those errors in units of their 1σ, whose slopes need no derivative of
    the errors themselves. Otherwise the weighting is the given one.
    """
    errors, own = jax.lax.cond(
        correcting,
        lambda at: nearest_errors(unravel(at), problem),
        lambda _: (problem.data.correction, weighting),
        jax.lax.stop_gradient(vector),
    )
    return all_residuals(vector, unravel, problem.with_data(correction=errors), own)


class LevelPattern(eqx.Module):
    """Which unknowns are pushed forward together, since they move different residuals."""

    seeds: Float[Array, "push unknown"]
    push: Int[Array, " unknown"]  # that an unknown is in
    owner: Int[Array, " unknown"]  # the level that it is of, or −1
    level: Int[Array, " residual"]  # whose errors move it, or −1
    places: Int[Array, "level error"]  # of errors among the unknowns

    @classmethod
    def of(cls, unravel: Unravel, data: BalanceData) -> "LevelPattern":
        """The pattern of `all_residuals` with these unknowns."""
        places, n = unravel.level_places, unravel.vector().size
        n_levels, n_errors = places.shape
        push, owner = np.arange(n), np.full(n, -1)
        push[places] = places[0]
        push[places[-1, -1] + 1 :] -= places.size - n_errors
        owner[places] = np.arange(n_levels)[:, None]
        seeds = np.zeros((push[-1] + 1, n))
        seeds[push, np.arange(n)] = 1.0
        return cls(
            seeds=jnp.asarray(seeds),
            push=jnp.asarray(push),
            owner=jnp.asarray(owner),
            level=level_of_residuals(unravel, data),
            places=jnp.asarray(places),
        )

    def pushed(
        self, push: Callable[[Float[Array, " unknown"]], Float[Array, " residual"]]
    ) -> Float[Array, "push residual"]:
        """All seeds, pushed forward through the residuals."""
        return mapped(push, self.seeds)

    def jacobian(self, pushed: Float[Array, "push residual"]) -> Float[Array, "residual unknown"]:
        """Derivatives of the residuals J, of what was pushed."""
        moves = (self.owner < 0) | (self.owner == self.level[:, None])
        return jnp.where(moves, pushed[self.push].T, 0.0)

    def normal_equations(
        self, pushed: Float[Array, "push residual"], residuals: Float[Array, " residual"]
    ) -> tuple[Float[Array, "unknown unknown"], Float[Array, " unknown"]]:
        """JᵀJ and Jᵀ·residuals, without the zeros of J."""
        n_levels, n_errors = self.places.shape
        columns = self.places.reshape(-1)
        errors = jax.lax.dynamic_slice_in_dim(pushed, columns[0], n_errors)
        members = (self.level[:, None] == jnp.arange(n_levels)).astype(pushed.dtype)
        by_level = jnp.einsum("per,rl->ple", pushed[:, None] * errors, members)
        apart = (self.owner[:, None] >= 0) & (self.owner[:, None] != self.owner[columns])
        own = jnp.where(apart, 0.0, by_level.reshape(len(pushed), -1)[self.push])
        matrix = (pushed @ pushed.T)[self.push][:, self.push]
        matrix = matrix.at[:, columns].set(own).at[columns].set(own.T)
        right = (pushed @ residuals)[self.push]
        return matrix, right.at[columns].set(((errors * residuals) @ members).T.reshape(-1))


class _Normal(NamedTuple):
    """The normal equations at a point that a fit has accepted."""

    matrix: Float[Array, "unknown unknown"]
    right: Float[Array, " unknown"]


class NormalSteps(optx.AbstractDescent):
    """Damped Gauss–Newton steps by Cholesky's factors of JᵀJ + λI.

    JᵀJ is formed once where the fit goes on from, so that a step that fails costs a factor of a
    small matrix and no slopes. In units that make the columns of J alike its condition is the
    square of J's; rounding shortens steps then, but does not move the point where they end: there
    Jᵀ·residuals, of which it knows every digit, is zero.
    """

    pattern: LevelPattern

    def init(self, y: Array, f_info_struct: Any) -> _Normal:
        """See `optimistix.AbstractDescent`."""
        return _Normal(jnp.eye(y.size), jnp.zeros(y.size))

    def query(self, y: Array, f_info: Any, state: _Normal) -> _Normal:
        """See `optimistix.AbstractDescent`."""
        pushed = self.pattern.pushed(f_info.jac.mv)
        return _Normal(*self.pattern.normal_equations(pushed, f_info.residual))

    def step(self, step_size: Array, state: _Normal) -> tuple[Array, Any]:
        """See `optimistix.AbstractDescent`."""
        damping = 1 / step_size + _SINGULAR * jnp.diagonal(state.matrix)
        factor = jax.scipy.linalg.cho_factor(state.matrix + jnp.diag(damping))
        # A step that is not finite is one that fails: more damping follows.
        return -jax.scipy.linalg.cho_solve(factor, state.right), optx.RESULTS.successful


def on_levels(
    solver: optx.AbstractLeastSquaresSolver, unravel: Unravel, data: BalanceData
) -> optx.AbstractLeastSquaresSolver:
    """A solver for residuals in the order of `all_residuals`, with steps by `NormalSteps`."""
    steps = NormalSteps(LevelPattern.of(unravel, data))
    return eqx.tree_at(lambda damped: damped.descent, solver, steps)
