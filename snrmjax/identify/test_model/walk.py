"""Rounds of making a test's balance straight and solving it, until nothing moves.

In each the most likely hyperparameters are found for the straight problem, and all unknowns with
them; the next is straight about these and every state's most likely errors.
"""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.identify.checks.residual_autocorrelation import fraction_told_by
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

_ROUNDS = 12  # at most
_SETTLED = 2  # rounds, until steps are checked and the modal mass is free
_GUESS = 0.3  # 1σ of the modal mass, from which on it is asked for and not known
_TRIED = 4  # rounds of each start
_FURTHER = 12  # where states are not counted as fewer, which moves for ever
_MANY = 48  # rounds of each, where all still moves
_LOST = 3.0  # 1σ of stated noise, beyond which a walk is not where the records are explained
_STILL = 0.05  # standard deviations of all unknowns, below which nothing moves any more
_SHORTEST = 0.05  # share of a step that is still tried
_FARTHEST = np.array([1.0, 1.0, 0.5, 0.5])  # of a level's errors, relative or rad
_STIFFNESS = 2  # of `LEVEL_ERRORS`


class Rounds(NamedTuple):
    """How many rounds there may be, and from where.

    With `levels_apart` one start has natural frequencies of levels apart from the beginning, which
    levels that lie bandwidths apart need. Rounds go on from `start`, of states that are nearly
    these and without discrepancy, instead of anew.
    """

    most: int = _ROUNDS
    most_knots: int = MOST_KNOTS  # of the curves
    levels_apart: bool = False
    start: "TestPosterior | None" = None
    crowded: bool = False  # whether knots crowd where states do
    same_fraction: bool = False  # whether as many states count as at the start


def likeliest_walk(
    balance: Balance, rounds: Rounds, *, robust: bool, power_likelihood: bool
) -> "Walk":
    """The more probable of the ends of all starts.

    From straight lines over a², which hardening by hundreds of bandwidths is, and from curves that
    bend as they like from the first, which arches are.
    """
    starts = [(True, False), (False, False), *[(False, True)] * rounds.levels_apart]
    walks = [
        Walk(
            balance,
            straight=straight,
            apart=apart,
            robust=robust,
            power_likelihood=power_likelihood,
        )
        for straight, apart in starts
    ]
    if rounds.start is not None:
        walks = [walks[0].from_(rounds.start)]
        if rounds.same_fraction:
            walks[0].fraction, walks[0].fraction_is_known = rounds.start.fraction, True
    first = min(_TRIED, rounds.most)
    for walk in walks:
        walk.advance(first)
    fraction = min(walk.fraction for walk in walks)
    best = max(walks, key=lambda one: one.likelihood_of(fraction))
    best.advance(rounds.most - first)
    if rounds.most == _ROUNDS and best.is_lost:  # among steep curves the way is long
        for one in walks:
            one.advance(_MANY - one.turn)
        best = max(walks, key=lambda one: one.likelihood_of(fraction))
    elif (
        rounds.most == _ROUNDS and not power_likelihood
    ):  # which of two processors is still is chance
        best.advance(_FURTHER)
    return best


class Reached(NamedTuple):
    """What a round found."""

    point: Float[np.ndarray, " hyper"]
    likelihood: float
    equations: LinearRows
    mean: Float[np.ndarray, " unknown"]
    residuals: Float[np.ndarray, "state part"]
    errors: Float[np.ndarray, "state input"]


class Walk:
    """Rounds of making the problem straight and solving it, from one start on."""

    def __init__(
        self, balance: Balance, *, straight: bool, apart: bool, robust: bool, power_likelihood: bool
    ):
        """From the records; the first rounds with `straight` lines over a², the very first with
        natural frequencies of levels `apart`, if asked.
        """
        places, discrepancy = balance.places, balance.beside.shape[1] > 0
        self.balance, self.straight, self.apart = balance, straight, apart
        self.robust, self.power_likelihood = robust, power_likelihood
        self.start = starting_point(balance.states, balance.terms, discrepancy)
        self.point, self.errors = self.start, np.zeros_like(balance.states.errors)
        self.mean = np.zeros(places.others.stop)
        self.mean[places.damping.start] = 1.0
        self.found: Reached | None = None
        self.turn, self.still, self.fraction, self.fraction_is_known = 0, False, 1.0, False

    def from_(self, start: "TestPosterior") -> "Walk":
        """The same, going on from what was found for other states."""
        self.mean, self.point = start.mean, point_of(start.hyper)
        known = min(self.errors.shape[1], start.corrections.shape[1])
        self.errors[:, :known] = start.corrections[:, :known]
        self.turn = _SETTLED + 1
        return self

    @property
    def likelihood(self) -> float:
        """ln of likelihood times prior of what was found."""
        return -np.inf if self.found is None else self.found.likelihood

    @property
    def is_lost(self) -> bool:
        """Whether all still moves, and noise, where it is stated, is larger than it ever is.

        Where states count as fewer if neighbours err alike, their share may move for ever.
        """
        if self.still or self.found is None:
            return False
        if not self.balance.states.stated:
            return not self.power_likelihood
        beyond = self.found.point[NOISE] - np.log(priors.STATED_NOISE.median)
        return bool(beyond > _LOST * priors.STATED_NOISE.spread)

    def advance(self, rounds: int) -> None:
        """Some rounds more, or until nothing moves."""
        for _ in range(rounds):
            if self.still:
                return
            self._round()

    def likelihood_of(self, fraction: float) -> float:
        """The same, were so many of the states independent."""
        if self.found is None:
            return -np.inf
        states, terms, places = self.balance.states, self.balance.terms, self.balance.places
        equations = self.found.equations._replace(fraction=fraction)
        return objective_of(equations, states, terms, places)(self.found.point)[0]

    def _round(self) -> None:
        k, states, terms = self.turn, self.balance.states, self.balance.terms
        places, start = self.balance.places, self.start
        if k == _SETTLED:
            self.balance = self.balance.with_discrepancy(self.mean, self.errors)
        this = self.balance.straight(self.mean, self.errors, first=k == 0)
        this = this._replace(equations=this.equations._replace(fraction=self.fraction))
        bounds = bounds_of(states, terms, self.point)
        along = slice(FIRST_ALONG, end_of_along(terms))
        if k == 0:  # no level differs from another yet, and bends are of one size
            bounds[LEVELS] = [
                bound if self.apart and kind == _STIFFNESS else (bound[0], bound[0])
                for kind, bound in enumerate(bounds[LEVELS])
            ]
            bounds[along] = [(0.0, 0.0)] * (along.stop - along.start)
        if k < _SETTLED and self.straight:
            bounds[ROUGHNESS] = [(low, low) for low, _ in bounds[ROUGHNESS]]
        # What curves do not follow yet would pass for another modal mass.
        free = k >= _SETTLED or states.mass_std > _GUESS
        held = states if free else states._replace(mass_std=0.0)
        objective = objective_of(this.equations, held, terms, places)
        begin = self.point if k > (_SETTLED if self.straight else 1) else start
        for _ in range(2):
            point = maximised(objective, begin, bounds)
            noise = float(np.exp(point[NOISE]))
            variance = prior_variances(terms, places, held)(point)
            goal, covariance = this.equations.posterior(noise, variance)
            if np.all(np.abs(goal[places.levels]) < _FARTHEST):
                break
            # Levels that differ by more are no levels of one structure: not this way.
            bounds[LEVELS] = [(low, low) for low, _ in bounds[LEVELS]]
        moved = _step(
            self.balance, self.mean, goal, self.errors, noise, variance, free=k < _SETTLED
        )
        left = (this.rows - this.design @ goal).reshape(-1, 2)
        value = objective(point)[0]
        if k <= _SETTLED or self.power_likelihood or value > self.likelihood:
            self.found = Reached(point, value, this.equations, goal, left / noise, moved.errors)
        size = np.sqrt(np.diag(covariance) + 1e-300)
        self.still = k > _SETTLED and np.max(np.abs(moved.unknowns - self.mean) / size) < _STILL
        self.point, self.mean, self.errors = point, moved.unknowns, moved.errors
        self.turn += 1
        if self.power_likelihood and not self.fraction_is_known:
            fraction = fraction_told_by(left, states.level, states.frequency)
            self.fraction = max(fraction, priors.LEAST_FRACTION)
        if self.robust:
            square = np.sum(left**2, axis=1) / noise**2
            weight = (priors.STUDENT_FREEDOM + 2) / (priors.STUDENT_FREEDOM + square)
            self.balance = self.balance._replace(weight=weight)


class _Moved(NamedTuple):
    """Unknowns after a step, and the states' errors with them."""

    unknowns: Float[np.ndarray, " unknown"]
    errors: Float[np.ndarray, "state input"]


def _step(
    balance: Balance,
    mean: np.ndarray,
    goal: np.ndarray,
    errors: np.ndarray,
    noise: float,
    variance: np.ndarray,
    *,
    free: bool,
) -> _Moved:
    """Towards the goal of the straight problem as far as the true one agrees; all of it if free."""

    def cost(unknowns: np.ndarray, nearest: np.ndarray) -> float:
        if not np.all(np.isfinite(nearest)):
            return np.inf
        bound = variance > 0
        prior = float(np.sum(unknowns[bound] ** 2 / variance[bound]))
        return balance.misfit(unknowns, nearest) / noise**2 + prior

    if free:
        nearest = balance.nearest_errors(goal, errors)
        # Where phasors are no mode's the way may be lost.
        return _Moved(goal, nearest) if np.all(np.isfinite(nearest)) else _Moved(mean, errors)
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
    return _Moved(*best[1:])
