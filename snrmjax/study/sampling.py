"""The members of a study: one row of values for every member."""

import math
from collections.abc import Sequence
from typing import Literal, get_args

import equinox as eqx
import numpy as np
from jaxtyping import Float

from snrmjax.numerics.rules import InputError
from snrmjax.study.variations import AbstractVariation

Method = Literal["grid", "list", "latin_hypercube", "sobol", "random", "saltelli"]
MOST_MEMBERS = 100_000_000
FEWEST_ROWS = 16  # of Saltelli's scheme


class Sampling(eqx.Module):
    """Sampling method of the members.

    "grid": every combination of the values; "list": the first value of each quantity, the second
    of each, and so on; the others draw `members` samples of the distributions. "saltelli" draws
    rows of a Sobol' sequence in pairs and exchanges each quantity in turn between them, as
    `sobol_indices` requires.
    """

    method: Method = eqx.field(static=True)
    members: int | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        """Raises `ValueError` for an unknown method and for `members` below one."""
        if self.method not in get_args(Method):
            raise InputError(f"`method` must be one of {', '.join(get_args(Method))}.")
        if self.members is not None and self.members < 1:
            raise InputError(f"`members` must be at least 1, but is {self.members}.")


def number_of_members(variations: Sequence[AbstractVariation], sampling: Sampling) -> int:
    """Number of members of a study, before they are drawn.

    Raises `ValueError` where it is not determined, contradictory or above a hundred million.
    """
    if sampling.method in ("grid", "list"):
        n = _counted_by_values(variations, sampling)
        if sampling.members not in (None, n):
            raise InputError(
                f"a {sampling.method} of these values has {n} members, but `members` is "
                f"{sampling.members}: leave it out."
            )
    elif sampling.members is None:
        raise InputError(f"the method {sampling.method} needs `members`, the number of samples.")
    else:
        n = sampling.members
    if sampling.method == "saltelli":
        a_row = len(variations) + 2
        rows, rest = divmod(n, a_row)
        if rest or rows < FEWEST_ROWS or rows & (rows - 1):
            raise InputError(
                f"saltelli needs {a_row} times a power of two of members (the quantities and two "
                f"more), {a_row * FEWEST_ROWS} at least, but has {n}."
            )
    if n > MOST_MEMBERS:
        raise InputError(f"a study has at most {MOST_MEMBERS:.0e} members, but this has {n:.3g}.")
    return n


def _counted_by_values(variations: Sequence[AbstractVariation], sampling: Sampling) -> int:
    counts = {}
    for variation in variations:
        values = variation.grid()
        if values is None:
            raise InputError(
                f"a {sampling.method} needs values, but {', '.join(variation.names)} has a "
                "distribution: give `values`, or a `range` with `points`, or another method."
            )
        counts[variation.names[0]] = len(values)
    if not counts:
        raise InputError(f"a {sampling.method} needs at least one quantity that varies.")
    if sampling.method == "grid":
        return math.prod(counts.values())
    if len(set(counts.values())) > 1:
        each = ", ".join(f"{name} {n}" for name, n in counts.items())
        raise InputError(f"a list needs equally many values of each quantity, but has: {each}.")
    return next(iter(counts.values()))


def drawn_members(
    variations: Sequence[AbstractVariation], sampling: Sampling, seed: int
) -> Float[np.ndarray, "member name"]:
    """The value of every varied quantity for every member, in the order of the variations.

    Draws by `scipy.stats.qmc`: Latin hypercube, scrambled Sobol' sequence (its first `members`
    points), or independently. For every pair of rows a, b Saltelli's scheme has the members a, a
    with each quantity of b in turn (jointly distributed ones together), and b.
    """
    n = number_of_members(variations, sampling)
    if sampling.method in ("grid", "list"):
        values = [np.asarray(variation.grid()) for variation in variations]
        if sampling.method == "list":
            return np.stack(values, axis=1)
        return np.stack([a.ravel() for a in np.meshgrid(*values, indexing="ij")], axis=1)
    if not variations:
        return np.zeros((n, 0))
    unit = _unit_cube(sampling.method, n, [len(variation.names) for variation in variations], seed)
    columns, start = [], 0
    for variation in variations:
        end = start + len(variation.names)
        columns.append(variation.quantiles(unit[:, start:end]))
        start = end
    return np.concatenate(columns, axis=1)


def _unit_cube(
    method: Method, n: int, groups: Sequence[int], seed: int
) -> Float[np.ndarray, "member name"]:
    """Points of the unit cube; `groups` are the numbers of quantities per variation."""
    from scipy.stats import qmc

    width = sum(groups)

    random = np.random.default_rng(seed)
    if method == "saltelli":
        pairs = qmc.Sobol(2 * width, rng=random).random(n // (len(groups) + 2))
        one, other = pairs[:, None, :width], pairs[:, None, width:]
        swapped = np.repeat(np.eye(len(groups), dtype=bool), groups, axis=1)
        exchanged = np.where(swapped, other, one)
        return np.concatenate([one, exchanged, other], axis=1).reshape(n, width)
    if method == "latin_hypercube":
        return qmc.LatinHypercube(width, rng=random).random(n)
    if method == "sobol":
        # A Sobol' sequence is balanced for powers of two; its first n points are the members.
        return qmc.Sobol(width, rng=random).random_base2((n - 1).bit_length())[:n]
    return random.random((n, width))


def member_seed(seed: int, member: int) -> int:
    """The seed of a member's noise, from the study's seed and the member's number only."""
    return int(np.random.SeedSequence(seed, spawn_key=(member,)).generate_state(1)[0])
