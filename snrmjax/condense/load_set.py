"""Sets of static load cases: combinations of modal forces and their scale."""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.condense.load_cases import ReductionBasis, StaticCases
from snrmjax.condense.potential_fit import check_degree
from snrmjax.model.modes import have_values
from snrmjax.numerics.rules import InputError

NONLINEAR_RATIO = 0.02
"""Default load scale: the nonlinear part of the force is 2 % of the linear one.

It is then far above the round-off of any code (a table of six digits still resolves it to 5e-5),
and truncated terms of the polynomial are small: for six structures (benchmarks/rom_load_scale.py)
the coefficients change by less than 2 % for loads up to 1.8 to 5.6 times as large and down to a
hundredth and less.
"""

StaticSolver = Callable[[Float[np.ndarray, "case mode"]], StaticCases]
"""Solves static load cases for modal forces (kg^1/2 m/s²), one row per case."""

_ROUNDS, _CLOSE = 12, 0.15  # iterations of the search for a ratio, and its tolerance
_FURTHEST = 30.0  # largest factor on a displacement in one iteration


class LoadSet(NamedTuple):
    """Modal forces of static load cases, and their names, such as "+1 -3"."""

    force: Float[Array, "case mode"]  # f, kg^1/2 m/s²: the external force is F = M Φ f
    names: tuple[str, ...]


def modal_loads(
    basis: ReductionBasis,
    displacement: float | Sequence[float] | Float[Array | np.ndarray, " mode"],
    *,
    degree: int = 3,
    most_modes: int | None = None,
    levels: Sequence[float] | None = None,
) -> LoadSet:
    """Forces along single modes, pairs, triples, … of them, with all combinations of signs.

    A single mode gets the force that moves the linear structure by the displacement d at the
    maximum of the mode shape: f_r = ω_r² d_r / max|φ_r|. In a combination of k modes each gets a
    k-th of that, so that all cases have displacements of similar magnitude.

    Arguments: `displacement` in m, one for all modes or one for each; `degree` of the force to be
    fitted, which sets how many modes are combined (as many, since q₁q₂q₃ needs three modes in
    motion) and the number of load levels; `most_modes` and `levels` (fractions of the
    displacement) override them. Differentiable by `basis` and `displacement`.
    Raises `ValueError` for a displacement, number of modes or level that is not positive.
    Reference: Kuether, Deaner, Hollkamp & Allen, AIAA J. 53 (2015) 3273, doi:10.2514/1.J053838
    (constant modal displacement).

    >>> basis = ReductionBasis(np.array([2.0]), np.array([[0.5]]), np.array([[2.0]]), (1,))
    >>> modal_loads(basis, 1e-3, levels=(1.0,))
    LoadSet(force=Array([[ 0.008],
           [-0.008]], dtype=float64), names=('+1', '-1'))
    """
    check_degree(degree)
    n = len(basis.numbers)
    wanted = jnp.asarray(displacement, dtype=jnp.float64)
    known = np.asarray(wanted) if have_values(wanted) else np.ones(wanted.shape)
    if wanted.shape not in ((), (n,)) or not np.all(np.isfinite(known) & (known > 0)):
        raise InputError(
            f"`displacement` must be positive (m), one number or one for each of the {n} modes, "
            f"but is {displacement}."
        )
    if most_modes is not None and most_modes < 1:
        raise InputError(f"`most_modes` must be at least 1, but is {most_modes}.")
    fractions = default_levels(n, degree) if levels is None else tuple(levels)
    if not fractions or not all(np.isfinite(level) and level > 0 for level in fractions):
        raise InputError(f"`levels` must be positive fractions, at least one, but is {levels}.")
    signs = _combinations(n, min(n, most_modes or degree))
    alone = basis.frequency**2 * wanted / basis.largest
    rows = signs / np.sum(np.abs(signs), axis=1, keepdims=True)
    names = [_name(row, basis.numbers) for row in signs]
    return LoadSet(
        jnp.concatenate([level * rows * alone for level in fractions]),
        tuple(
            name if len(fractions) == 1 else f"{name} at {level:.3g}"
            for level in fractions
            for name in names
        ),
    )


def default_levels(n_modes: int, degree: int) -> tuple[float, ...]:
    """Fractions of the full load at which each combination is run.

    One level for every two degrees of the force, since cases of both signs separate even from odd
    terms; one more with one or two modes, for redundancy to check the fit.

    >>> default_levels(4, 3), default_levels(1, 3)
    ((1.0,), (0.5, 1.0))
    """
    count = max(degree // 2, 1) + (n_modes <= 2)
    return tuple(float(level) for level in np.arange(1, count + 1) / count)


def displacement_for_ratio(
    basis: ReductionBasis,
    solve: StaticSolver,
    *,
    ratio: float = NONLINEAR_RATIO,
    start: float | Float[Array, " mode"],
) -> Float[np.ndarray, " mode"]:
    """The displacement of each mode alone at which nonlinear over linear force reaches a ratio.

    The ratio is that of the forces f − ω²q and ω²q, with each mode divided by ω, so that its square
    compares energies and the reaction on other modes is included. It is the larger one of both
    signs. The search assumes a power law in the displacement: each iteration runs two load cases
    for every mode.

    Arguments: `start` an initial displacement in m, such as the thickness.
    Returns displacements in m for `modal_loads`. Raises `ValueError` if a mode does not reach
    the ratio, such as in a linear structure, or if its load cases do not converge.
    """
    n = len(basis.numbers)
    if not 0 < ratio < 1:
        raise InputError(f"`ratio` must lie between 0 and 1, but is {ratio}.")
    amplitude = np.broadcast_to(np.asarray(start, dtype=float), (n,)).copy()
    before = (amplitude, np.full(n, np.nan))
    low, high = np.zeros(n), np.full(n, np.inf)  # brackets of the displacement
    for _ in range(_ROUNDS):
        current = _nonlinear_ratio(basis, solve, amplitude)
        close = np.abs(np.log(current / ratio)) < _CLOSE
        if np.all(close):
            return amplitude
        low = np.where(current < ratio, np.fmax(low, amplitude), low)
        high = np.where(current >= ratio, np.fmin(high, amplitude), high)
        power = _power(before, (amplitude, current))
        before = (amplitude, current)
        step = np.where(np.isfinite(current), (ratio / np.fmin(current, 1e300)) ** (1 / power), 0.2)
        new = amplitude * np.clip(step, 1 / _FURTHEST, _FURTHEST)
        outside = (low > 0) & np.isfinite(high) & ((new <= low) | (new >= high))
        new = np.where(outside, np.sqrt(low * np.where(outside, high, 1.0)), new)
        amplitude = np.where(close, amplitude, new)
    worst = int(np.argmax(np.abs(np.log(current / ratio))))
    last = f"{before[0][worst]:.3g} m"
    if np.isinf(current[worst]):
        why = f"the load cases at {last} have no solution"
    else:
        why = f"it is {current[worst]:.3g} at {last}"
    raise InputError(
        f"no load along mode {basis.numbers[worst]} has a nonlinear force of {ratio:g} times the "
        f"linear one ({why}): state the load scale."
    )


def _nonlinear_ratio(
    basis: ReductionBasis, solve: StaticSolver, amplitude: Float[np.ndarray, " mode"]
) -> Float[np.ndarray, " mode"]:
    """|f − ω²q|/|ω²q| of each mode alone, the larger of both signs; infinite if not solved."""
    frequency = np.asarray(basis.frequency)
    alone = np.diag(frequency**2 * amplitude / np.asarray(basis.largest))
    cases = solve(np.concatenate([alone, -alone]))
    linear = np.asarray(cases.modal_displacement) * frequency
    rest = np.linalg.norm(np.asarray(cases.force) / frequency - linear, axis=1)
    whole = np.linalg.norm(linear, axis=1)
    good = cases.usable & (whole > 0)
    ratio = np.where(good, rest / np.where(good, whole, 1.0), np.inf).reshape(2, amplitude.size)
    # A linear structure has a ratio of the order of rounding.
    return np.fmax(ratio.max(axis=0), np.finfo(float).eps)


def _power(before: tuple[np.ndarray, np.ndarray], now: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """The power of displacement with which the ratio grows: 1 for an arch, 2 for a flat beam."""
    known = np.isfinite(before[1]) & np.isfinite(now[1]) & (before[0] != now[0])
    rise = np.log(np.where(known, now[1], 1.0) / np.where(known, before[1], 1.0))
    run = np.log(np.where(known, now[0] / before[0], math.e))
    return np.where(known, np.clip(rise / run, 0.7, 4.0), 1.5)


def _combinations(n_modes: int, most: int) -> np.ndarray:
    """Rows of signs (or zero) of all combinations of one to `most` modes."""
    rows = []
    for count in range(1, most + 1):
        for modes in itertools.combinations(range(n_modes), count):
            for signs in itertools.product((1.0, -1.0), repeat=count):
                row = np.zeros(n_modes)
                row[list(modes)] = signs
                rows.append(row)
    return np.array(rows)


def _name(signs: np.ndarray, numbers: Sequence[int]) -> str:
    return " ".join(
        f"{'+' if sign > 0 else '-'}{number}"
        for sign, number in zip(signs, numbers, strict=True)
        if sign
    )
