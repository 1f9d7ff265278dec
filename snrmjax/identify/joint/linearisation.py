"""The whitened balance of all states as a linear function of everything a joint fit may change."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from snrmjax.identify.joint.force_balance import (
    LEVEL_ERRORS,
    BalanceData,
    Spread,
    Unknowns,
    force_balance,
    motion_of,
    weighing_at,
)
from snrmjax.identify.joint.free_unknowns import programmed, with_room
from snrmjax.model.modes import LinearModes
from snrmjax.numerics.compiled import compiled


class BalanceSlopes(NamedTuple):
    """The whitened balance at the pilot and its slopes, on the host."""

    balance: np.ndarray  # (state, part)
    by_squared: np.ndarray  # (state, part)
    by_damping: np.ndarray
    by_level: np.ndarray  # (state, part, error), in the errors' own units
    by_other: np.ndarray  # (state, part, unknown): gain, offset, phase, linear deviations
    displacement: np.ndarray
    speed: np.ndarray
    squared: np.ndarray
    damping: np.ndarray


def balance_slopes(
    unknowns: Unknowns, data: BalanceData, modes: LinearModes, spread: Spread
) -> BalanceSlopes:
    """The balance and its slopes at some unknowns and at the states as they are corrected.

    Deviations of levels are in their own units here, not of some 1σ. What has a prior counts from
    its prior's mean: the balance is that of levels and linear modes without deviations.
    """
    n, room = len(data.level), with_room(data)
    restore = programmed(unknowns, (), room.n_levels).restore
    parts = _slopes(restore.unknowns, room, modes, spread.linear)
    return BalanceSlopes(*(np.asarray(part)[:n] for part in parts))


@compiled
def _slopes(unknowns: Unknowns, data: BalanceData, modes: LinearModes, linear: Array) -> tuple:
    unit = Spread(jnp.ones(len(LEVEL_ERRORS)), linear)
    weighing = weighing_at(unknowns, data, modes, unit)

    def balance(level: Array, other: tuple[Array, Array, Array, Array]) -> Array:
        each = eqx.tree_at(
            lambda u: (*(u.log_force_gain, u.force_offset, u.instrument_phase, u.linear, u.level),),
            unknowns,
            (*other, unknowns.level + level),
        )
        own = force_balance(each, data, modes, unit, data.correction) + weighing.offset
        return jnp.einsum("sij,sj->si", weighing.whiten, own)

    other = (
        *(unknowns.log_force_gain, unknowns.force_offset),
        *(unknowns.instrument_phase, unknowns.linear),
    )
    still = jnp.zeros_like(unknowns.level)
    # Every level's error moves its own states only: one push forward for all levels.
    kinds = still.shape[1]
    directions = jnp.broadcast_to(jnp.eye(kinds)[:, None, :], (kinds, *still.shape))
    push = jax.vmap(lambda d: jax.jvp(lambda b: balance(b, other), (still,), (d,))[1])
    by_level = jnp.moveaxis(push(directions), 0, 2)
    others = jax.jacfwd(lambda o: balance(still, o))(other)
    columns = [others[0][..., None], others[1][..., None], others[2][..., None], others[3]]
    motion = motion_of(unknowns, data, modes, unit, data.correction)
    # The balance is linear in the values of both curves.
    constant = modes.mode_shape[data.sensor, modes.mode_of_interest]
    constant = constant * modes.participation[modes.mode_of_interest]
    by_damping = motion.velocity / (constant * motion.force)
    by_squared = by_damping / (1j * data.frequency)
    level = unknowns.level[data.level]

    def parts(slope: Array, share: Array) -> Array:
        both = jnp.stack([slope.real, slope.imag], axis=1) * share[:, None]
        return jnp.einsum("sij,sj->si", weighing.whiten, both)

    nominal = balance(still, other) - jnp.einsum("sie,se->si", by_level, level)
    nominal = nominal - jnp.einsum("sio,o->si", others[3], unknowns.linear)
    return (
        *(nominal, parts(by_squared, 1 + level[:, 2])),
        parts(by_damping, 1 + level[:, 3]),
        by_level,
        jnp.concatenate(columns, axis=2),
        *(motion.displacement, jnp.abs(motion.velocity)),
        unknowns.squared_frequency(motion.amplitude(unknowns.squared_frequency)),
        unknowns.modal_damping(motion.amplitude(unknowns.modal_damping)),
    )
