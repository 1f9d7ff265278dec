"""What a joint fit makes small: every state's balance in units of its noise, and the priors."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from snrmjax.identify.joint.force_balance import (
    BalanceProblem,
    Unknowns,
    Weighting,
    force_balance,
    nearest_errors,
)
from snrmjax.identify.joint.free_unknowns import Unravel


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


def corrected_residuals(
    vector: Array, unravel: Unravel, problem: BalanceProblem
) -> Float[Array, " residual"]:
    """`all_residuals`, the states corrected for their most likely errors.

    The residuals are then those errors in units of their 1σ, whose slopes need no derivative of
    the errors themselves.
    """
    errors, own = nearest_errors(unravel(jax.lax.stop_gradient(vector)), problem)
    return all_residuals(vector, unravel, problem.with_data(correction=errors), own)
