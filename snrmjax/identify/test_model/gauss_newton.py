"""Gauss–Newton iterations of the model of a test.

Each iteration linearises the force balance about the current unknowns and the states' most likely
errors, maximises the hyperparameters of the linear problem, and solves it for all unknowns.
"""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.identify.checks.residual_autocorrelation import independent_fraction
from snrmjax.identify.test_model import priors
from snrmjax.identify.test_model.balance import Balance
from snrmjax.identify.test_model.curve_basis import MOST_KNOTS
from snrmjax.identify.test_model.hyper import (
    FIRST_ALONG,
    LEVELS,
    NOISE,
    ROUGHNESS,
    bounds_of,
    end_of_along,
    objective_of,
    point_of,
    prior_variances,
    starting_point,
)
from snrmjax.identify.test_model.linear_gaussian import LinearRows, maximised

if TYPE_CHECKING:
    from snrmjax.identify.test_model.posterior import TestPosterior

_ROUNDS = 12  # iterations at most
_SETTLED = 2  # iterations before steps are damped and the modal mass is free
_GUESS = 0.3  # 1σ of the modal mass above which it is free from the first iteration
_TRIED = 4  # iterations of each start before the best is chosen
_FURTHER = 12  # more iterations without the power likelihood, whose weight may oscillate
_MANY = 48  # iterations of each start, where the best has failed
_NOISE_LIMIT = 3.0  # 1σ of the noise prior above the stated noise, beyond which a fit has failed
_TOLERANCE = 0.05  # standard deviations: convergence tolerance of the largest step
_SHORTEST = 0.05  # smallest fraction of a step in the line search
_FARTHEST = np.array([1.0, 1.0, 0.5, 0.5])  # bounds of level errors, relative or rad
_STIFFNESS = 2  # of `LEVEL_ERRORS`


class Rounds(NamedTuple):
    """Number and starting point of the iterations.

    With `levels_apart` one start has differing natural frequencies of levels from the first
    iteration on, needed where levels lie bandwidths apart. A `start`, the posterior of nearly the
    same states without discrepancy, is resumed from.
    """

    most: int = _ROUNDS
    most_knots: int = MOST_KNOTS  # of each curve
    levels_apart: bool = False
    start: "TestPosterior | None" = None
    crowded: bool = False  # whether knots are denser where states cluster
    same_fraction: bool = False  # whether to keep the independent fraction of `start`


def multistart(
    balance: Balance, rounds: Rounds, *, robust: bool, power_likelihood: bool
) -> "GaussNewton":
    """The most probable solution from several starts.

    One start holds both curves to straight lines in a² at first, for hardening by hundreds of
    bandwidths; the other leaves their roughness free, for softening arches.
    """
    starts = [(True, False), (False, False), *[(False, True)] * rounds.levels_apart]
    runs = [
        GaussNewton(
            balance,
            straight=straight,
            apart=apart,
            robust=robust,
            power_likelihood=power_likelihood,
        )
        for straight, apart in starts
    ]
    if rounds.start is not None:
        runs = [runs[0].resumed_from(rounds.start)]
        if rounds.same_fraction:
            runs[0].fraction, runs[0].fraction_is_known = rounds.start.fraction, True
    first = min(_TRIED, rounds.most)
    for run in runs:
        run.advance(first)
    fraction = min(run.fraction for run in runs)
    best = max(runs, key=lambda one: one.likelihood_of(fraction))
    best.advance(rounds.most - first)
    if rounds.most == _ROUNDS and best.has_failed:  # steep curves converge slowly
        for one in runs:
            one.advance(_MANY - one.count)
        best = max(runs, key=lambda one: one.likelihood_of(fraction))
    elif rounds.most == _ROUNDS and not power_likelihood:
        # Whether twelve iterations converge may depend on the processor's rounding.
        best.advance(_FURTHER)
    return best


class Iterate(NamedTuple):
    """Result of one iteration."""

    point: Float[np.ndarray, " hyper"]
    likelihood: float
    equations: LinearRows
    mean: Float[np.ndarray, " unknown"]
    residuals: Float[np.ndarray, "state part"]
    errors: Float[np.ndarray, "state input"]
    weight: Float[np.ndarray, " state"]  # of the states in `equations`


class GaussNewton:
    """Gauss–Newton iterations from one start."""

    def __init__(
        self, balance: Balance, *, straight: bool, apart: bool, robust: bool, power_likelihood: bool
    ):
        """Start from the records; with `straight` the first iterations hold the curves to lines in
        a², with `apart` levels may differ in natural frequency from the first one on.
        """
        layout, discrepancy = balance.layout, balance.discrepancy.shape[1] > 0
        self.balance, self.straight, self.apart = balance, straight, apart
        self.robust, self.power_likelihood = robust, power_likelihood
        self.start = starting_point(balance.states, balance.terms, discrepancy)
        self.point, self.errors = self.start, np.zeros_like(balance.states.errors)
        self.mean = np.zeros(layout.others.stop)
        self.mean[layout.damping.start] = 1.0
        self.best: Iterate | None = None
        self.count, self.converged, self.fraction, self.fraction_is_known = 0, False, 1.0, False

    def resumed_from(self, start: "TestPosterior") -> "GaussNewton":
        """Resume from the posterior of other states."""
        self.mean, self.point = start.mean, point_of(start.hyper)
        known = min(self.errors.shape[1], start.corrections.shape[1])
        self.errors[:, :known] = start.corrections[:, :known]
        self.count = _SETTLED + 1
        return self

    @property
    def likelihood(self) -> float:
        """ln of likelihood times prior of the best iterate."""
        return -np.inf if self.best is None else self.best.likelihood

    @property
    def has_failed(self) -> bool:
        """Whether the iterations have not converged, and stated noise is exceeded by far.

        Under the power likelihood the independent fraction may oscillate: that is no failure.
        """
        if self.converged or self.best is None:
            return False
        if not self.balance.states.stated:
            return not self.power_likelihood
        beyond = self.best.point[NOISE] - np.log(priors.STATED_NOISE.median)
        return bool(beyond > _NOISE_LIMIT * priors.STATED_NOISE.spread)

    def advance(self, rounds: int) -> None:
        """Iterate this many times more, or until converged."""
        for _ in range(rounds):
            if self.converged:
                return
            self._iterate()

    def likelihood_of(self, fraction: float) -> float:
        """`likelihood` with this independent fraction of the states, to compare starts."""
        if self.best is None:
            return -np.inf
        states, terms, layout = self.balance.states, self.balance.terms, self.balance.layout
        equations = self.best.equations._replace(fraction=fraction)
        return objective_of(equations, states, terms, layout)(self.best.point)[0]

    def _iterate(self) -> None:
        k, states, terms = self.count, self.balance.states, self.balance.terms
        layout, start = self.balance.layout, self.start
        if k == _SETTLED:
            self.balance = self.balance.with_discrepancy(self.mean, self.errors)
        linear = self.balance.linearised(self.mean, self.errors, first=k == 0)
        linear = linear._replace(equations=linear.equations._replace(fraction=self.fraction))
        bounds = bounds_of(states, terms, self.point)
        along = slice(FIRST_ALONG, end_of_along(terms))
        if k == 0:  # levels are alike, and roughness is uniform along the curve
            bounds[LEVELS] = [
                bound if self.apart and kind == _STIFFNESS else (bound[0], bound[0])
                for kind, bound in enumerate(bounds[LEVELS])
            ]
            bounds[along] = [(0.0, 0.0)] * (along.stop - along.start)
        if k < _SETTLED and self.straight:
            bounds[ROUGHNESS] = [(low, low) for low, _ in bounds[ROUGHNESS]]
        # Misfit of the early curves would be absorbed by the modal mass.
        free = k >= _SETTLED or states.mass_std > _GUESS
        states_used = states if free else states._replace(mass_std=0.0)
        objective = objective_of(linear.equations, states_used, terms, layout)
        begin = self.point if k > (_SETTLED if self.straight else 1) else start
        for _ in range(2):
            point = maximised(objective, begin, bounds)
            noise = float(np.exp(point[NOISE]))
            variance = prior_variances(terms, layout, states_used)(point)
            goal, covariance = linear.equations.posterior(noise, variance)
            if np.all(np.abs(goal[layout.levels]) < _FARTHEST):
                break
            # Larger level errors are implausible for one structure: solve again without them.
            bounds[LEVELS] = [(low, low) for low, _ in bounds[LEVELS]]
        step = _line_search(
            self.balance, self.mean, goal, self.errors, noise, variance, free=k < _SETTLED
        )
        residual = (linear.rows - linear.design @ goal).reshape(-1, 2)
        value = objective(point)[0]
        if k <= _SETTLED or self.power_likelihood or value > self.likelihood:
            weight, white = self.balance.weight, residual / noise
            self.best = Iterate(point, value, linear.equations, goal, white, step.errors, weight)
        std = np.sqrt(np.diag(covariance) + 1e-300)
        self.converged = (
            k > _SETTLED and np.max(np.abs(step.unknowns - self.mean) / std) < _TOLERANCE
        )
        self.point, self.mean, self.errors = point, step.unknowns, step.errors
        self.count += 1
        if self.power_likelihood and not self.fraction_is_known:
            fraction = independent_fraction(residual, states.level, states.frequency)
            self.fraction = max(fraction, priors.LEAST_FRACTION)
        if self.robust:
            square = np.sum(residual**2, axis=1) / (noise**2 * self.balance.weight)
            weight = (priors.STUDENT_FREEDOM + 2) / (priors.STUDENT_FREEDOM + square)
            self.balance = self.balance._replace(weight=weight)


class _Step(NamedTuple):
    """Unknowns after a step, and the states' errors there."""

    unknowns: Float[np.ndarray, " unknown"]
    errors: Float[np.ndarray, "state input"]


def _line_search(
    balance: Balance,
    mean: np.ndarray,
    goal: np.ndarray,
    errors: np.ndarray,
    noise: float,
    variance: np.ndarray,
    *,
    free: bool,
) -> _Step:
    """Line search towards the solution of the linear problem; the full step if `free`."""

    def cost(unknowns: np.ndarray, nearest: np.ndarray) -> float:
        if not np.all(np.isfinite(nearest)):
            return np.inf
        bound = variance > 0
        prior = float(np.sum(unknowns[bound] ** 2 / variance[bound]))
        return balance.misfit(unknowns, nearest) / noise**2 + prior

    if free:
        nearest = balance.nearest_errors(goal, errors)
        # Phasors that no mode explains can overflow: keep the last iterate.
        return _Step(goal, nearest) if np.all(np.isfinite(nearest)) else _Step(mean, errors)
    before = cost(mean, balance.nearest_errors(mean, errors))
    fraction, best = 1.0, (np.inf, mean, errors)
    while fraction > _SHORTEST:
        unknowns = mean + fraction * (goal - mean)
        nearest = balance.nearest_errors(unknowns, errors)
        value = cost(unknowns, nearest)
        if np.isfinite(value) and value < best[0]:
            best = (value, unknowns, nearest)
        if value <= before:
            break
        fraction *= 0.5
    return _Step(*best[1:])
