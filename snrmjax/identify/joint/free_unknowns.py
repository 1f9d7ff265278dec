"""The free unknowns of a fit as one vector, and the derivatives of its residuals."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from snrmjax.identify.curves.family_base import packed
from snrmjax.identify.joint.force_balance import (
    BalanceData,
    BalanceProblem,
    PriorStd,
    Unknowns,
    filled,
    force_balance,
    with_room,
)
from snrmjax.identify.test_model.balance import whitening
from snrmjax.identify.test_model.states import LEVEL_ERRORS
from snrmjax.numerics.blocks import mapped
from snrmjax.numerics.compiled import compiled

_LEVELS = 8  # levels are padded to multiples of it

FREE = ("force_gain", "force_offset", "instrument_phase")
"""Unknowns of the measurement that a fit may estimate."""


class Unravel(eqx.Module):
    """Map from the vector of free unknowns to all unknowns."""

    unknowns: Unknowns
    free: tuple[str, ...] = eqx.field(static=True)

    def vector(self) -> Float[Array, " unknown"]:
        """The free unknowns."""
        moving = eqx.filter(self.unknowns, free_unknowns(self.unknowns, self.free))
        leaves = jax.tree.leaves(moving)
        if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            return ravel_pytree(moving)[0]
        # On the host, which compiles nothing for a new size.
        return jax.device_put(np.concatenate([np.ravel(np.asarray(leaf)) for leaf in leaves]))

    def __call__(self, vector: Float[Array, " unknown"]) -> Unknowns:
        """All unknowns, the free ones from the vector."""
        moving, fixed = eqx.partition(self.unknowns, free_unknowns(self.unknowns, self.free))
        if isinstance(vector, jax.core.Tracer):
            return eqx.combine(ravel_pytree(moving)[1](vector), fixed)
        leaves, structure = jax.tree.flatten(moving)
        ends = np.cumsum([leaf.size for leaf in leaves])
        pieces = np.split(np.asarray(vector), ends[:-1])
        parts = [part.reshape(leaf.shape) for part, leaf in zip(pieces, leaves, strict=True)]
        return eqx.combine(jax.tree.unflatten(structure, jax.device_put(parts)), fixed)


class PackedUnknowns(NamedTuple):
    """The free unknowns for compiled programs: curves padded to one form and size.

    `own` are the indices of the fit's unknowns in the padded vector; the other entries are inert.
    """

    vector: Float[Array, " entry"]
    unravel: Unravel
    own: Int[np.ndarray, " unknown"]

    def padded_covariance(
        self, covariance: Float[np.ndarray, "unknown unknown"]
    ) -> Float[np.ndarray, "entry entry"]:
        """The covariance of the fit's unknowns, padded to all entries of the vector."""
        full = np.zeros((len(self.vector), len(self.vector)))
        full[np.ix_(self.own, self.own)] = covariance
        return full


def packed_unknowns(
    unknowns: Unknowns, free: tuple[str, ...], n_levels: int | None = None
) -> PackedUnknowns:
    """Unknowns padded for a program that serves every family and `n_levels` levels."""
    curves, present = (unknowns.squared_frequency, unknowns.modal_damping), len(unknowns.level)
    most = max(curve.parameters.shape[0] for curve in curves)
    pair = tuple(packed(curve, most) for curve in curves)
    whole = eqx.tree_at(lambda u: (u.squared_frequency, u.modal_damping), unknowns, pair)
    if n_levels is not None:
        whole = eqx.tree_at(lambda u: u.level, whole, filled(unknowns.level, n_levels, 0.0))
    vector = Unravel(whole, free).vector()
    (n, m), (size, other) = (
        (u.squared_frequency.parameters.shape[0], u.modal_damping.parameters.shape[0])
        for u in (unknowns, whole)
    )
    linear = len(vector) - len(unknowns.linear)
    spare = (len(whole.level) - present) * len(LEVEL_ERRORS)
    rest = (*range(size + other, linear - spare), *range(linear, len(vector)))
    indices = [*range(n), *range(size, size + m), *rest]
    return PackedUnknowns(vector, Unravel(whole, free), np.array(indices))


def padded_levels(n_levels: int) -> int:
    """Padded number of levels, a multiple of eight, so that few sizes compile."""
    return _LEVELS * -(-n_levels // _LEVELS)


def padded_problem(problem: BalanceProblem) -> BalanceProblem:
    """The problem padded with zero-weight states and levels, so that few sizes compile."""
    data, size = problem.data, with_room(len(problem.data.level))
    roomy = jax.tree.map(lambda a: filled(a, size, None), data)
    weight, levels = filled(data.weight, size, 0.0), padded_levels(data.n_levels)
    roomy = dataclasses.replace(roomy, weight=weight, n_levels=levels)
    return dataclasses.replace(problem, data=roomy)


def free_unknowns(unknowns: Unknowns, free: tuple[str, ...]) -> Unknowns:
    """Leaves that a fit may change, as a filter for `equinox.partition`."""
    frozen = jax.tree.map(lambda _: False, unknowns)
    moving = [
        *("force_gain" in free, "force_offset" in free, "instrument_phase" in free),
        *(True, True, True, True),
    ]

    def where(u: Unknowns) -> tuple:
        return (
            *(u.log_force_gain, u.force_offset, u.instrument_phase),
            *(u.level, u.linear, u.squared_frequency.parameters, u.modal_damping.parameters),
        )

    return eqx.tree_at(where, frozen, tuple(moving))


def named_unknowns(
    unknowns: Unknowns,
    data: BalanceData,
    free: tuple[str, ...],
    numbers: Sequence[int] | None = None,
) -> tuple[tuple[str, str], ...]:
    """Names and units of the free unknowns in the order of their vector.

    Arguments: `numbers` of the levels in the file; by default counted from 0.
    """
    curves = (
        ("backbone", "rad^2/s^2", unknowns.squared_frequency),
        ("damping", "1/s", unknowns.modal_damping),
    )
    levels = range(data.n_levels) if numbers is None else numbers
    measurement = {"force_gain": "log", "force_offset": "smallest force", "instrument_phase": "rad"}
    return (
        *(
            (f"{name}.{c.name}", unit if c.is_value else "1")
            for name, unit, family in curves
            for c in family.coefficients()
        ),
        *((name, unit) for name, unit in measurement.items() if name in free),
        *((f"level_{k}.{e}", "std") for k in levels for e in LEVEL_ERRORS),
        *((f"linear_{k}", "std") for k in range(unknowns.linear.shape[0] - 3)),
        *((name, "std") for name in ("stiffness_off_resonance", "damping_off_resonance")),
        ("modal_mass", "std"),
    )


@compiled
def _slopes(vector: Array, unravel: Unravel, problem: BalanceProblem) -> tuple[Array, Array]:
    """Derivatives of the balance by the unknowns, and by the states' errors.

    A state depends on its own errors only: one forward-mode product per kind of error gives all.
    """
    at = problem.data.correction
    n_states, kinds = at.shape
    directions = jnp.broadcast_to(jnp.eye(kinds)[:, None, :], (kinds, n_states, kinds))
    unknowns = unravel(vector)
    along = jax.linearize(lambda error: force_balance(unknowns, problem, error), at)[1]
    by_unknown = jax.jacfwd(lambda v: force_balance(unravel(v), problem, at))(vector)
    return by_unknown, jnp.moveaxis(mapped(along, directions), 0, 2)


def whitened_slopes(
    program: PackedUnknowns, problem: BalanceProblem, n_states: int
) -> tuple[Float[np.ndarray, "state part unknown"], Float[np.ndarray, "state part input"]]:
    """Whitened derivatives of the first states' balances, by the fit's unknowns and by relative
    errors of the states (`STATE_ERRORS`): rows have unit variance where errors are as stated.

    Evaluated at the corrected states, which lie on the curves: noise does not enter the slopes.
    """
    slopes = _slopes(program.vector, program.unravel, problem)
    by_unknown, by_error = (np.asarray(part)[:n_states] for part in slopes)
    std, weight = (np.asarray(p)[:n_states] for p in (problem.data.std, problem.data.weight))
    root, _ = whitening(by_error[:, 0] + 1j * by_error[:, 1], std, weight)
    return root @ by_unknown[:, :, program.own], root @ by_error


def prior_residuals(unknowns: Unknowns, prior: PriorStd) -> Float[Array, " residual"]:
    """Prior residuals of level errors, linear parameters and curves, in units of their 1σ."""
    curves = (unknowns.squared_frequency, unknowns.modal_damping)
    level = (unknowns.level * prior.level_ratio).reshape(-1)
    linear = unknowns.linear * prior.linear_ratio
    return jnp.concatenate([level, linear, *(curve.prior_residuals() for curve in curves)])
