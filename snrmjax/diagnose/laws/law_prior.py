"""How likely laws are: Gaussian processes along their knots, weighed by the evidence.

Secants w at the knots have a prior N(0, Λ): a Gaussian process of the logarithm of displacement or
velocity, with a size and a reach of its own for every part of a law. With rows y + Aw of unit
variance, −2 ln of the evidence over that without a law is

    ln|I + ΛG| − gᵀ(G + Λ⁻¹)⁻¹g,   G = AᵀA, g = −Aᵀy:

what the law explains, less the cost of its effective number of parameters. Reference: Rasmussen &
Williams, Gaussian Processes for Machine Learning (2006), section 2.7 and chapter 5.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import block_diag, cho_solve, solve_triangular
from scipy.optimize import nnls
from scipy.special import logsumexp

from snrmjax.diagnose import priors


class LawPart(NamedTuple):
    """A part of a law: a table of secants, or two with one sign or opposite ones."""

    law: str
    tables: tuple[int, ...]
    signs: tuple[float, ...]
    symmetry: str = ""
    not_negative: bool = False


PARTS = {
    "odd_spring": LawPart("spring", (0, 1), (1.0, 1.0), "odd"),
    "even_spring": LawPart("spring", (0, 1), (1.0, -1.0), "even"),
    "odd_damper": LawPart("damper", (2,), (1.0,), "odd"),
    "displacement_damping": LawPart("displacement_damping", (3,), (1.0,)),
    "slip": LawPart("slip", (4,), (1.0,), not_negative=True),
}
"""Parts of laws, by what they are called here; tables are those of `LawColumns`.

A damper that differs between the directions is not among them: its even part acts as that of a
spring does, for the square of the velocity is what the square of the displacement lacks.
"""


class LawProblem(NamedTuple):
    """Rows of unit variance as a linear function of the secants, in units plainly seen.

    Of columns A by the secants of all `PARTS`, one after the other, and rows y: AᵀA and −Aᵀy.
    """

    gram: Float[np.ndarray, "secant secant"]
    pull: Float[np.ndarray, " secant"]
    square: float  # yᵀy
    place: dict[str, Float[np.ndarray, " knot"]]  # logarithms of where the knots are

    def of(self, parts: Sequence[str]) -> Int[np.ndarray, " secant"]:
        """The places of some parts among all secants."""
        n = len(self.pull) // len(PARTS)
        names = list(PARTS)
        first = np.array([n * names.index(part) for part in parts], dtype=int)
        return np.asarray((first[:, None] + np.arange(n)).reshape(-1))


class Process(NamedTuple):
    """The prior of one part: its standard deviation and its reach."""

    size: float
    reach: float


class LawPosterior(NamedTuple):
    """Secants of some parts, one after the other, in units plainly seen."""

    parts: tuple[str, ...]
    processes: tuple[Process, ...]
    cost: float  # −2 ln of the evidence, over that without a law
    freedom: float  # effective number of parameters
    mean: Float[np.ndarray, " secant"]
    covariance: Float[np.ndarray, "secant secant"]


def best_processes(problem: LawProblem, parts: Sequence[str]) -> tuple[list[Process], float]:
    """The likeliest sizes and reaches of some parts together, and the cost with them.

    The cost has the mean of the evidence over sizes and reaches of each part, the others at their
    best: what is not determined is not free of charge.
    """
    alone = [_table(problem, (part,), (Process(1.0, 1.0),), 0) for part in parts]
    found = [_least(table) for table in alone]
    tables: list[np.ndarray] = []
    for _ in range(3 if len(parts) > 1 else 1):
        before, tables = list(found), []
        for k in range(len(parts)):
            table = _table(problem, parts, found, k)
            tables.append(table)
            found[k] = _least(table)
        if found == before:
            break
    least = min(float(np.min(table)) for table in tables)
    means = [_mean(table) - float(np.min(table)) for table in tables]
    bounds = [
        _cost_of_bounds(problem, parts, found, k)
        for k, part in enumerate(parts)
        if PARTS[part].not_negative
    ]
    return found, least + sum(means) + sum(bounds)


def posterior(problem: LawProblem, parts: Sequence[str]) -> LawPosterior:
    """What rows say of some parts together, sizes and reaches of the processes uncertain too.

    Sliders have no negative stiffness: of theirs the Gaussian's part without is meant.
    """
    found, cost = best_processes(problem, parts)
    best = _gaussian(problem, parts, found)
    mean, covariance = best.mean.copy(), best.covariance.copy()
    for k in range(len(parts)):
        table = _table(problem, parts, found, k)
        weights = np.exp(-0.5 * (table - np.min(table)))
        weights /= weights.sum()
        several = []
        for reach, size in zip(*np.nonzero(weights > 1e-2), strict=True):
            others = list(found)
            others[k] = Process(float(priors.LAW_SIZES[size]), priors.LAW_REACHES[reach])
            several.append((weights[reach, size], _gaussian(problem, parts, others)))
        total = sum(weight for weight, _ in several)
        centre = sum(weight * one.mean for weight, one in several) / total
        spread = sum(
            weight * (one.covariance + np.outer(one.mean - centre, one.mean - centre))
            for weight, one in several
        )
        mean += centre - best.mean
        covariance += spread / total - best.covariance
    signs = [np.full(len(problem.place[part]), PARTS[part].not_negative) for part in parts]
    bounded = np.concatenate(signs)
    if bounded.any():
        mean, covariance = _not_negative(mean, covariance, bounded)
    return LawPosterior(tuple(parts), tuple(found), cost, best.freedom, mean, covariance)


def law_prior(
    problem: LawProblem, parts: Sequence[str], processes: Sequence[Process]
) -> Float[np.ndarray, "secant direction"]:
    """A root of the prior covariance of some parts together."""
    roots = [_root(problem, *pair) for pair in zip(parts, processes, strict=True)]
    return np.asarray(block_diag(*roots))


class _Gaussian(NamedTuple):
    cost: float
    freedom: float
    mean: np.ndarray
    covariance: np.ndarray


def _gaussian(problem: LawProblem, parts: Sequence[str], processes: Sequence[Process]) -> _Gaussian:
    """The posterior for given processes, of secants that may have either sign."""
    root, places = law_prior(problem, parts, processes), problem.of(parts)
    matrix = np.eye(len(places)) + root.T @ problem.gram[np.ix_(places, places)] @ root
    lower = np.linalg.cholesky(matrix)
    pull = root.T @ problem.pull[places]
    inverse = cho_solve((lower, True), np.eye(len(matrix)))
    best = inverse @ pull
    cost = 2 * float(np.sum(np.log(np.diag(lower)))) - float(pull @ best)
    freedom = float(len(matrix) - np.trace(inverse))
    return _Gaussian(cost, freedom, root @ best, root @ inverse @ root.T)


def _beside(
    problem: LawProblem, parts: Sequence[str], processes: Sequence[Process], k: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """A part's problem, with other parts as a further noise; what these cost."""
    others = [part for number, part in enumerate(parts) if number != k]
    rest = [one for number, one in enumerate(processes) if number != k]
    places, theirs = problem.of([parts[k]]), problem.of(others)
    gram, pull = problem.gram[np.ix_(places, places)], problem.pull[places]
    if not others:
        return gram, pull, 0.0
    root = law_prior(problem, others, rest)
    arms = root.T @ problem.gram[np.ix_(theirs, theirs)] @ root
    lower = np.linalg.cholesky(np.eye(len(root)) + arms)
    both = np.column_stack([problem.gram[np.ix_(theirs, places)], problem.pull[theirs]])
    both = solve_triangular(lower, root.T @ both, lower=True)
    across, along = both[:, :-1], both[:, -1]
    cost = 2 * float(np.sum(np.log(np.diag(lower)))) - float(along @ along)
    return gram - across.T @ across, pull - across.T @ along, cost


def _table(
    problem: LawProblem, parts: Sequence[str], processes: Sequence[Process], k: int
) -> Float[np.ndarray, "reach size"]:
    """Cost for every reach and size of one part, the others as they are."""
    gram, pulled, fixed = _beside(problem, parts, processes, k)
    table = np.zeros((len(priors.LAW_REACHES), len(priors.LAW_SIZES)))
    for number, reach in enumerate(priors.LAW_REACHES):
        root = _root(problem, parts[k], Process(1.0, reach))
        values, vectors = np.linalg.eigh(root.T @ gram @ root)
        values = np.maximum(values, 0.0)
        pull = vectors.T @ (root.T @ pulled)
        scaled = priors.LAW_SIZES[:, None] ** 2
        table[number] = np.sum(np.log1p(scaled * values), axis=1)
        table[number] -= np.sum(scaled * pull**2 / (1 + scaled * values), axis=1)
    return table + fixed


def _cost_of_bounds(
    problem: LawProblem, parts: Sequence[str], processes: Sequence[Process], k: int
) -> float:
    """What the likeliest secants that are zero or above explain less than the likeliest."""
    gram, pull, _ = _beside(problem, parts, processes, k)
    inverse = np.linalg.inv(_root(problem, parts[k], processes[k]))
    lower = np.linalg.cholesky(gram + inverse.T @ inverse)
    # |lowerᵀw − lower⁻¹pull|² is zero where the secants may have either sign.
    return float(nnls(lower.T, solve_triangular(lower, pull, lower=True))[1] ** 2)


def _least(table: np.ndarray) -> Process:
    reach, size = np.unravel_index(np.argmin(table), table.shape)
    return Process(float(priors.LAW_SIZES[size]), priors.LAW_REACHES[reach])


def _mean(table: np.ndarray) -> float:
    """−2 ln of the mean evidence."""
    return float(-2 * (logsumexp(-0.5 * table) - np.log(table.size)))


def _root(problem: LawProblem, part: str, process: Process) -> Float[np.ndarray, "knot knot"]:
    """Cholesky's factor of a process with Matérn's covariance of order 5/2."""
    place = problem.place[part]
    apart = np.sqrt(5.0) * np.abs(place[:, None] - place) / process.reach
    alike = (1 + apart + apart**2 / 3) * np.exp(-apart)
    return process.size * np.linalg.cholesky(alike + 1e-6 * np.eye(len(place)))


def _not_negative(
    mean: np.ndarray, covariance: np.ndarray, bounded: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of a Gaussian's part with some entries zero or above.

    By trajectories on ellipses that are reflected at the bounds: exact Hamiltonian Monte Carlo.
    Reference: Pakman & Paninski, J. Comput. Graph. Stat. 23 (2014) 518,
    doi:10.1080/10618600.2013.788448.
    """
    scale = np.sqrt(np.diag(covariance))
    alike = covariance / np.outer(scale, scale)
    root = np.linalg.cholesky(alike + 1e-6 * np.eye(len(mean)))
    walls, off = root[bounded], (mean / scale)[bounded]  # walls @ z + off ≥ 0
    size = np.linalg.norm(walls, axis=1)
    rng = np.random.default_rng(len(mean))
    inside = np.where(bounded, np.maximum(mean / scale, 0.1), mean / scale)
    z = np.linalg.solve(root, inside - mean / scale)
    drawn = []
    for _ in range(300):
        speed, left = rng.normal(size=len(z)), np.pi / 2
        for _ in range(200):
            a, b = walls @ speed, walls @ z
            reach = np.hypot(a, b)
            meets = reach > np.abs(off)
            turn = np.arccos(np.clip(-off / np.where(meets, reach, np.inf), -1, 1))
            angle = np.arctan2(a, b)
            times = np.concatenate([angle + turn, angle - turn]) % (2 * np.pi)
            times = np.where(np.tile(meets, 2) & (times > 1e-9), times, np.inf)
            first = int(np.argmin(times))
            time = min(float(times[first]), left)
            z, speed = (
                speed * np.sin(time) + z * np.cos(time),
                speed * np.cos(time) - z * np.sin(time),
            )
            left -= time
            if left <= 0:
                break
            wall = first % len(off)
            across = walls[wall] / size[wall]
            speed = speed - 2 * (speed @ across) * across
        drawn.append(z)
    samples = (np.array(drawn[30:]) @ root.T + mean / scale) * scale
    samples[:, bounded] = np.maximum(samples[:, bounded], 0.0)
    return samples.mean(axis=0), np.cov(samples.T)
