"""What a joint fit makes small: every state's balance in units of its noise, and the priors."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from snrmjax.identify.joint.force_balance import (
    BalanceData,
    Spread,
    Unknowns,
    Weighing,
    force_balance,
    nearest_errors,
    weighing_at,
)
from snrmjax.identify.joint.free_unknowns import Restore
from snrmjax.model.modes import LinearModes


def whitened(
    unknowns: Unknowns,
    data: BalanceData,
    modes: LinearModes,
    spread: Spread,
    weighing: Weighing,
) -> Float[Array, "state part"]:
    """Residuals of the states, of unit variance where the noise is as stated."""
    balance = force_balance(unknowns, data, modes, spread, data.correction) + weighing.offset
    return jnp.sqrt(data.weight)[:, None] * jnp.einsum("sij,sj->si", weighing.whiten, balance)


def all_residuals(
    vector: Array,
    restore: Restore,
    data: BalanceData,
    modes: LinearModes,
    spread: Spread,
    weighing: Weighing,
) -> Float[Array, " residual"]:
    """Whitened residuals of the states, then the priors of levels, linear parameters and curves."""
    unknowns = restore(vector)
    points = whitened(unknowns, data, modes, spread, weighing).reshape(-1)
    curves = (unknowns.squared_frequency, unknowns.modal_damping)
    priors = [unknowns.level.reshape(-1), unknowns.linear, *(c.prior_residuals() for c in curves)]
    return jnp.concatenate([points, *priors])


def level_of_residuals(restore: Restore, data: BalanceData) -> Int[Array, " residual"]:
    """Whose deviations move each of `all_residuals`; −1 where it is no level's."""
    unknowns = restore.unknowns
    curves = (unknowns.squared_frequency, unknowns.modal_damping)
    n_levels, n_errors = unknowns.level.shape
    nobody = unknowns.linear.size + sum(c.prior_residuals().size for c in curves)
    own = (jnp.repeat(data.level, 2), jnp.repeat(jnp.arange(n_levels), n_errors))
    return jnp.concatenate([*own, jnp.full(nobody, -1)])


def freed_of_errors(
    unknowns: Unknowns, data: BalanceData, modes: LinearModes, spread: Spread
) -> tuple[Array, Weighing]:
    """Corrections that free the states of their likeliest errors, and their weighing there."""
    errors = nearest_errors(unknowns, data, modes, spread)
    data = eqx.tree_at(lambda d: d.correction, data, errors)
    return errors, weighing_at(unknowns, data, modes, spread)


def freed_residuals(
    vector: Array,
    restore: Restore,
    data: BalanceData,
    modes: LinearModes,
    spread: Spread,
    weighing: Weighing,
    freed: Array,
) -> Float[Array, " residual"]:
    """`all_residuals`, with states that are `freed` of their likeliest errors at these unknowns.

    The residuals are then those errors in units of their 1σ, whose slopes need no derivative of
    the errors themselves. Without `freed` the weighing is the given one.
    """
    errors, own = jax.lax.cond(
        freed,
        lambda at: freed_of_errors(restore(at), data, modes, spread),
        lambda _: (data.correction, weighing),
        jax.lax.stop_gradient(vector),
    )
    erring = eqx.tree_at(lambda d: d.correction, data, errors)
    return all_residuals(vector, restore, erring, modes, spread, own)
