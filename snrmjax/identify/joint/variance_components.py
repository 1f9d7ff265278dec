"""Noise and level-to-level variance from the residuals of a linearised fit, and its solution."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import minimize, minimize_scalar
from scipy.special import ndtri, stdtrit

_NOTHING = 1e-9  # 1σ that stands for none at all
_SMALL = 0.01  # 1σ of a deviation with which its search begins
_LARGEST = 0.3  # 1σ of a deviation; levels that differ by more are not one structure's
_AT_THE_END, _BEYOND = 0.99, 2.0  # of that: where a search has stopped short, and by too far
_WORTH = 5.41  # of −2 log likelihood: 1 %, one-sided, since four kinds of error are tried
_CLEAR = 20.0  # the same of the phase beside a rough curve, whose bends it imitates
_PHASE = 1  # of the kinds of error
_UPPER = 0.975  # share below the upper end of a 95 % band
_STIFF = 10.0  # times the smallest bends, of a curve that is straight at first


class VarianceComponents(NamedTuple):
    """Estimated 1σ of the noise and of the errors that the states of a level share."""

    noise: float  # by which the residuals exceed the stated noise
    noise_std: float
    level: tuple[float, ...]  # of every kind of error that a level shares, stated or found
    bends: tuple[float, ...] = ()  # of the curves whose bends were asked for
    unbounded: tuple[
        int, ...
    ] = ()  # kinds of error left out: largest likelihood at a size that no test has
    independent: float = 1.0  # share of the states that count, where neighbours err alike

    @property
    def unit(self) -> float:
        """What residuals are counted in: the noise, larger where few states are independent."""
        return self.noise / float(np.sqrt(self.independent))

    @property
    def contradicts_upward(self) -> bool:
        """Whether the residuals are too large for the stated noise."""
        return self.noise - 3 * self.noise_std > 1

    @property
    def contradicts_downward(self) -> bool:
        """Whether they are too small for it."""
        return self.noise + 3 * self.noise_std < 1


class Linearised(NamedTuple):
    """A fit near its solution: residuals + slopes·change, priors on some of the unknowns."""

    residuals: Float[np.ndarray, " row"]
    slopes: Float[np.ndarray, "row unknown"]
    prior_std: Float[np.ndarray, " unknown"]  # infinite where there is no prior
    deviation: Float[np.ndarray, " unknown"]  # present value minus its prior's mean


def level_columns(
    by_state: Float[np.ndarray, "state part error"], level: np.ndarray, n_levels: int
) -> Float[np.ndarray, "row unknown"]:
    """Slopes of stacked residuals with respect to every level's own errors, level by level."""
    n, parts, errors = by_state.shape
    members = (level[:, None] == np.arange(n_levels)).astype(float)
    full = by_state[:, :, None, :] * members[:, None, :, None]
    return full.reshape(n * parts, n_levels * errors)


class Bends(NamedTuple):
    """Unknowns of one size that has to be found, whatever levels do."""

    places: Int[np.ndarray, " unknown"]
    ends: tuple[float, float]  # between which their 1σ is


def estimated_components(
    problem: Linearised,
    index: Int[np.ndarray, "level error"],
    *,
    look: bool = True,
    bends: Sequence[Bends] = (),
    independent: float = 1.0,
) -> VarianceComponents:
    """Restricted maximum likelihood of the noise and of what levels share beyond what is stated.

    Arguments: `index` says where among the unknowns the levels' errors are; kinds of error whose
    `prior_std` is zero were not stated and are estimated. They enter one after the other, while
    the likelihood asks for them; with a single level, or without `look`, none does. One that is
    likeliest at sizes no test has, as a gain of levels may be beside a force gain that nobody
    knows, is none.
    `bends` of curves are estimated along with them: rough curves and levels that differ explain
    the same residuals. Where neighbouring states err alike only a share of them is `independent`:
    the likelihood counts for so much less, and what it must gain to believe in an error of levels
    stays the same.
    References: Patterson & Thompson, Biometrika 58 (1971) 545, doi:10.1093/biomet/58.3.545; for a
    likelihood that counts for less, Pauli, Racugno & Ventura, Stat. Sin. 21 (2011) 149.
    """
    n_errors = index.shape[1]
    groups = (*index.T, *(some.places for some in bends))
    likelihood = _Likelihood.of(problem, groups).of_a_share(independent)
    ends = (*[(_NOTHING, _LARGEST)] * n_errors, *(some.ends for some in bends))
    present = [float(problem.prior_std[some.places[0]]) for some in bends]
    stated = np.array([*problem.prior_std[index[0]], *present])
    look = look and len(index) > 1
    open_kinds = [k for k in range(n_errors) if stated[k] == 0] if look else []
    price = np.where(np.arange(n_errors) == _PHASE, _CLEAR if bends else _WORTH, _WORTH)

    wide = (*[(_NOTHING, 10 * _LARGEST)] * n_errors, *(some.ends for some in bends))

    def more_of(chosen: np.ndarray, kind: int) -> np.ndarray:
        return chosen | (np.arange(len(chosen)) == kind)

    def forward(stated: np.ndarray, chosen: np.ndarray) -> tuple[_Best, np.ndarray, list[int]]:
        found, left = likelihood.best(stated, chosen, ends), list(open_kinds)
        unbounded: list[int] = []
        while left:
            trials = []
            for kind in left:
                trials.append((likelihood.best(stated, more_of(chosen, kind), ends), kind))
            better, kind = min(trials, key=lambda trial: trial[0].value)
            if better.value > found.value - price[kind]:
                break
            left.remove(kind)
            if np.max(better.std[open_kinds]) > _AT_THE_END * _LARGEST:
                freely = likelihood.best(stated, more_of(chosen, kind), wide)
                if np.max(freely.std[open_kinds]) > _BEYOND * _LARGEST:
                    unbounded.append(kind)
                    continue
            found, chosen = better, more_of(chosen, kind)
        return found, chosen, unbounded

    is_bend = np.arange(len(stated)) >= n_errors
    found, chosen, unbounded = forward(stated, is_bend)
    if bends and look:
        # Levels that differ look like bends to whom bends come first: here they come last.
        straight = np.where(is_bend, _STIFF * np.array([e[0] for e in ends]), stated)
        _, kinds, others = forward(straight, np.zeros(len(stated), dtype=bool))
        other = likelihood.best(straight, kinds | is_bend, ends)
        cost, other_cost = (float(price[mask[:n_errors]].sum()) for mask in (chosen, kinds))
        # Levels that differ by as much as no structure's do are a curve's, in steps.
        sound = np.max(other.std[open_kinds], initial=0.0) <= _AT_THE_END * _LARGEST
        if sound and other.value + other_cost < found.value + cost:
            found, unbounded = other, others
    return VarianceComponents(
        noise=found.noise,
        noise_std=found.noise / np.sqrt(2 * likelihood.dof),
        level=tuple(found.std[:n_errors].tolist()),
        bends=tuple(found.std[n_errors:].tolist()),
        unbounded=tuple(sorted(unbounded)),
        independent=independent,
    )


def few_levels_factor(n_levels: int) -> float:
    """By how much a 95 % band is wider whose 1σ had to be found from so few levels.

    Student's t over the normal. Two levels count as three: one difference tells no more than an
    order of size, and with t of one degree no band would be of use.
    """
    return float(stdtrit(max(n_levels - 1, 2), _UPPER) / ndtri(_UPPER))


def likeliest_std(problem: Linearised, bends: Bends) -> float:
    """Restricted maximum likelihood of the bends' 1σ, with noise as stated."""
    likelihood = _Likelihood.of(problem, (bends.places,))
    found = minimize_scalar(
        lambda point: likelihood.value_and_slopes(1.0, np.exp([point]))[0],
        bounds=tuple(np.log(bends.ends)),
        method="bounded",
    )
    return float(np.exp(found.x))


class _Best(NamedTuple):
    value: float  # −2 log likelihood
    noise: float
    std: np.ndarray  # of the groups


class _Likelihood(NamedTuple):
    gram: np.ndarray
    pull: np.ndarray
    total: float
    rows: float
    dof: float
    prior_std: np.ndarray
    groups: tuple[np.ndarray, ...]  # of unknowns that have a 1σ in common

    @classmethod
    def of(cls, problem: Linearised, groups: tuple[np.ndarray, ...]) -> "_Likelihood":
        x, std = problem.slopes, problem.prior_std
        bound = np.isfinite(std)
        # Residuals that would be left if every bound unknown went back to its prior's mean.
        residuals = problem.residuals - x[:, bound] @ problem.deviation[bound]
        n = len(residuals)
        dof = max(n - int(np.sum(~bound)), 1)
        return cls(x.T @ x, x.T @ residuals, float(residuals @ residuals), n, dof, std, groups)

    def of_a_share(self, independent: float) -> "_Likelihood":
        """The likelihood where only a share of the states tells something of its own."""
        spent = self.rows - self.dof
        return self._replace(
            gram=independent * self.gram,
            pull=independent * self.pull,
            total=independent * self.total,
            rows=spent + independent * self.dof,
            dof=independent * self.dof,
        )

    def value_and_slopes(
        self, noise: float, of_groups: np.ndarray
    ) -> tuple[float, Float[np.ndarray, " logarithm"]]:
        """−2 log of the restricted likelihood, and slopes by the logarithms of its arguments."""
        std = self.prior_std.copy()
        for group, own in zip(self.groups, of_groups, strict=True):
            std[group] = own
        # What moves nothing and has no prior says nothing.
        diagonal = np.diagonal(self.gram)
        keep = (std > 0) & ((diagonal > 0) | np.isfinite(std))
        every = bool(keep.all())
        gram = (self.gram if every else self.gram[np.ix_(keep, keep)]) / noise**2
        pull, own = self.pull[keep] / noise**2, std[keep]
        a = gram + np.diag(1.0 / own**2)
        size = np.sqrt(np.diagonal(a))
        factor = np.linalg.cholesky(a / np.outer(size, size) + 1e-13 * np.eye(len(a)))
        root = np.linalg.inv(factor) / size
        x = root.T @ (root @ pull)
        determinant = 2 * np.sum(np.log(np.diagonal(factor))) + 2 * np.sum(np.log(size))
        value = float(
            self.total / noise**2
            - pull @ x
            + determinant
            + 2 * np.sum(np.log(own[np.isfinite(own)]))
            + self.rows * np.log(noise**2)
        )
        # Traces of the inverse times what changes; the inverse is rootᵀ·root.
        by_noise = 2 * (
            self.rows
            - self.total / noise**2
            + 2 * (pull @ x)
            - x @ gram @ x
            - np.sum((root @ gram) * root)
        )
        share = np.zeros(len(std))
        share[keep] = 1.0 - (np.sum(root**2, axis=0) + x**2) / own**2
        return value, np.array([by_noise, *(2 * np.sum(share[group]) for group in self.groups)])

    def best(
        self,
        stated: np.ndarray,
        chosen: Bool[np.ndarray, " group"],
        ends: Sequence[tuple[float, float]],
    ) -> _Best:
        """The likeliest noise, and 1σ of the chosen groups."""
        asked = np.concatenate([[True], chosen])

        def unpacked(point: np.ndarray) -> tuple[float, np.ndarray]:
            std = stated.copy()
            std[chosen] = np.exp(point[1:])
            return float(np.exp(point[0])), std

        def of_logarithms(point: np.ndarray) -> tuple[float, np.ndarray]:
            value, slopes = self.value_and_slopes(*unpacked(point))
            return value, slopes[asked]

        middle = np.log(max(np.sqrt(self.total / self.dof), 1e-12))
        limits = [tuple(np.log(pair)) for pair, one in zip(ends, chosen, strict=True) if one]
        # What was found before goes on from there.
        start = np.log(np.where(stated[chosen] > 0, stated[chosen], _SMALL))
        answer = minimize(
            of_logarithms,
            np.concatenate([[middle], start]),
            method="L-BFGS-B",
            jac=True,
            bounds=[(middle - 30.0, middle + 3.0), *limits],
            options={"ftol": 1e-9, "gtol": 1e-4},
        )
        return _Best(float(answer.fun), *unpacked(answer.x))


def effective_parameters(problem: Linearised, own: np.ndarray) -> float:
    """Parameters that the data, and not their priors, tell, of some of the unknowns."""
    keep, matrix, size = _normal(problem)
    at = np.flatnonzero(np.isin(np.flatnonzero(keep), own))
    variance = np.diagonal(np.linalg.inv(matrix))[at] / size[at] ** 2
    return float(np.sum(1.0 - variance / problem.prior_std[keep][at] ** 2))


def _normal(problem: Linearised) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unknowns that may move, JᵀJ with priors, and their units."""
    keep = problem.prior_std > 0
    x = problem.slopes[:, keep]
    prior = 1.0 / problem.prior_std[keep]
    size = np.hypot(np.linalg.norm(x, axis=0), prior)
    size = np.where(size > 0, size, 1.0)
    matrix = (x / size).T @ (x / size) + np.diag((prior / size) ** 2)
    return keep, matrix + 1e-12 * np.eye(len(matrix)), size


def solved(problem: Linearised) -> Float[np.ndarray, " unknown"]:
    """The change of the unknowns that least squares with the priors asks for."""
    keep, matrix, size = _normal(problem)
    right = (problem.slopes[:, keep] / size).T @ problem.residuals
    change = np.zeros(len(keep))
    change[keep] = -np.linalg.solve(matrix, right) / size
    return change


def expected_decrease(problem: Linearised) -> float:
    """By how much `solved` would lower the sum of squares, priors included."""
    keep, matrix, size = _normal(problem)
    right = (problem.slopes[:, keep] / size).T @ problem.residuals
    return float(right @ np.linalg.solve(matrix, right))


def left_out_scores(problem: Linearised, folds: list[np.ndarray]) -> tuple[np.ndarray, float]:
    """Log predictive density of every left-out part, and the error in units of its prediction."""
    keep, matrix, size = _normal(problem)
    x = problem.slopes[:, keep] / size
    change = -np.linalg.solve(matrix, x.T @ problem.residuals)
    left = problem.residuals + x @ change
    # As many unknowns as there are, not states: with W what the other parts know, the prediction's
    # covariance is C = 1 + own·W⁻¹·ownᵀ, its determinant that of all parts over W's, and its error
    # C times what the fit to all parts leaves.
    floor = 1e-10 * np.eye(len(matrix))
    sign_of_all, of_all = np.linalg.slogdet(matrix + floor)
    scores, squares, count = [], 0.0, 0
    for rows in folds:
        own, rest = x[rows], left[rows]
        without, pull = matrix - own.T @ own + floor, own.T @ rest
        sign, logarithm = np.linalg.slogdet(without)
        square = float(rest @ rest + pull @ np.linalg.solve(without, pull))
        known = sign * sign_of_all > 0
        scores.append(-0.5 * (square + of_all - logarithm) if known else -np.inf)
        squares, count = squares + square, count + len(rest)
    return np.array(scores), float(np.sqrt(squares / count))
