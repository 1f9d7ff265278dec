"""One posterior of a test: both curves, the modal mass, levels, what is left, and the noise.

The closed form of the two equations of the method is linear in all that is unknown. Written for
Z = FA/X of every state (`TestStates`), what can be wrong moves it to first order:

| error | residual Z − κ(K − Ω² + iΩδ) moves by |
|---|---|
| force, relative | Z |
| velocity, relative | −Z − κ a (K′ + iΩδ′): a itself moves |
| phase | −iZ |
| stiffness of a level, relative | −κK |
| damping of a level, relative | −iΩκδ |

Slopes and weights are those at the states corrected for their most likely errors, found in a few
rounds (orthogonal distance regression). Given the hyperparameters (noise, sizes of levels' errors,
of the curves' bends and of the discrepancy) all is one Gaussian (`linear_gaussian`); those are
taken where likelihood times prior is largest, and integrated over by Laplace's approximation.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import ndtri, stdtrit

from snrmjax.identify.checks.residual_autocorrelation import share_told_by
from snrmjax.identify.test_model import priors
from snrmjax.identify.test_model.balance import Balance
from snrmjax.identify.test_model.curve_basis import MOST_KNOTS, CurveBasis
from snrmjax.identify.test_model.hyper import (
    ALONG,
    BENDS,
    FIRST_ALONG,
    LEVELS,
    MASS,
    NOISE,
    OFFSET,
    PHASE,
    TREND,
    Gaussian,
    Hyper,
    Places,
    averaged,
    bounds_of,
    differing_levels,
    hyper_at,
    objective_of,
    places_of,
    point_of,
    prior_variances,
    sizes_of_bends,
    starting_point,
)
from snrmjax.identify.test_model.linear_gaussian import (
    LinearRows,
    laplace_evidence,
    maximised,
)
from snrmjax.identify.test_model.states import TestStates
from snrmjax.numerics.blocks import on_one_core

_ROUNDS = 12  # at most
_SETTLED = 2  # rounds, until steps are checked and the modal mass is free
_GUESS = 0.3  # 1σ of the modal mass, from which on it is asked for and not known
_TRIED = 4  # rounds of each start
_MANY = 48  # rounds of each, where all still moves
_LOST = 3.0  # 1σ of stated noise, beyond which a walk is not where the records are explained
_STILL = 0.05  # standard deviations of all unknowns, below which nothing moves any more
_SHORTEST = 0.05  # share of a step that is still tried
_FARTHEST = np.array([1.0, 1.0, 0.5, 0.5])  # of a level's errors, relative or rad
_STIFFNESS = 2  # of `LEVEL_ERRORS`
_REACH = 3.0  # times the dynamic stiffness, that a natural frequency may lie beside a test


class CurveValues(NamedTuple):
    """Both curves at some amplitudes, with their covariance."""

    squared_frequency: Float[np.ndarray, " point"]  # ω̃², rad²/s²
    modal_damping: Float[np.ndarray, " point"]  # δ, 1/s
    covariance: Float[np.ndarray, "point two two"]
    slopes: Float[np.ndarray, "point two"]  # by the logarithm of amplitude


class TestPosterior(NamedTuple):
    """What the states say together; `fit_test` makes it."""

    states: TestStates
    basis: CurveBasis
    units: tuple[float, float]  # rad²/s² and 1/s, of the two curves' coefficients
    mean: Float[np.ndarray, " unknown"]
    covariance: Float[np.ndarray, "unknown unknown"]
    hyper: Hyper
    log_evidence: float
    corrections: Float[np.ndarray, "state input"]  # most likely errors, subtracted from the record
    residuals: Float[np.ndarray, "state part"]  # whitened: of unit variance where all is right
    arms_of_stiffness: Float[np.ndarray, "state part"]  # how a relative change of ω̃² moves them
    effective_unknowns: float  # that the states, and not their priors, tell
    places: Places
    differing: tuple[bool, bool, bool, bool]  # whether levels differ by more than is stated
    weight: Float[np.ndarray, " state"]  # 1, or less for an outlier
    share: float  # of the states that count, where neighbours err alike
    settled: bool  # whether the last round moved nothing by more than its error

    @property
    def modal_mass(self) -> tuple[float, float]:
        """κ, the modal mass over the model's, and its 1σ."""
        return 1 + float(self.mean[MASS]), float(np.sqrt(self.covariance[MASS, MASS]))

    @property
    def instrument_phase(self) -> float:
        """Phase that all records share, rad."""
        return float(self.mean[PHASE])

    @property
    def force_offset(self) -> float:
        """Offset of the force, over the smallest."""
        return float(self.mean[OFFSET])

    @property
    def trend(self) -> tuple[float, float]:
        """Relative change of the stiffness per unit of the states' trend, and its 1σ."""
        return float(self.mean[TREND]), float(np.sqrt(self.covariance[TREND, TREND]))

    @property
    def level_errors(self) -> Float[np.ndarray, "level error"]:
        """Most likely errors of every level: gain and phase (rad) of its record, and relative
        deviations of stiffness and damping.
        """
        return self.mean[self.places.levels]

    def curves(self, amplitude: Float[np.ndarray, " point"]) -> CurveValues:
        """ω̃² and δ at displacement amplitudes (m), with their covariance."""
        values, by_log = self.basis.values(amplitude)
        found, steep = (self._rows(terms) @ self.mean for terms in (values, by_log))
        rows = self.slopes(amplitude)
        covariance = np.einsum("npi,ij,nqj->npq", rows, self.covariance, rows)
        return CurveValues(found[:, 0] + self.places.reference, found[:, 1], covariance, steep)

    def slopes(self, amplitude: Float[np.ndarray, " point"]) -> Float[np.ndarray, "point two n"]:
        """Derivatives of ω̃² and δ at displacement amplitudes (m) by all unknowns."""
        rows = self._rows(self.basis.values(amplitude)[0])
        rows[:, :, MASS] = -(rows @ self.mean) / (1 + self.mean[MASS])
        return rows

    def _rows(self, terms: Float[np.ndarray, "point function"]) -> Float[np.ndarray, "point two n"]:
        """Curves of these functions by the unknowns, at their modal mass."""
        rows = np.zeros((len(terms), 2, len(self.mean)))
        both = zip((self.places.stiffness, self.places.damping), self.units, strict=True)
        for k, (own, unit) in enumerate(both):
            rows[:, k, own] = unit * terms / (1 + self.mean[MASS])
        return rows


@on_one_core
def fit_test(
    states: TestStates,
    *,
    discrepancy: bool = False,
    robust: bool = False,
    rounds: int = _ROUNDS,
    most_knots: int | None = None,
    tempered: bool = False,
    levels_apart: bool = False,
    compare_levels: bool = True,
    start: "TestPosterior | None" = None,
    over_sizes: bool = False,
) -> TestPosterior:
    """The posterior of a test.

    Arguments: with `discrepancy` what one mode leaves off resonance is unknown too: smooth in phase
    and amplitude, zero at phase resonance; with `robust` noise has outliers (Student's t);
    curves have `most_knots` at most; with `tempered` states whose neighbours miss the curves alike
    count as fewer; with `levels_apart` one start has natural frequencies of levels apart from the
    beginning, which levels that lie bandwidths apart need; without `compare_levels` nothing is
    said on which errors levels differ by (`differing`), which takes half the time; rounds go on
    from `start`, of states that are nearly these and without discrepancy, instead of anew; with
    `over_sizes` curves are averaged over the sizes that their bends may have.
    Raises `ValueError` for fewer than two states.
    """
    if len(states.level) < 2:
        raise ValueError(f"a test needs at least two states, not {len(states.level)}.")
    n, omega = len(states.level), states.frequency
    reference = float(np.mean(omega**2))
    z = 1j * omega * states.constant * states.force / (states.velocity)
    # Of curves: all that the test passed through, and the damping as single states have it.
    units = (
        float(np.ptp(omega**2) + _REACH * np.median(np.abs(z))),
        float(np.quantile(np.abs(z.imag / omega), 0.9) + 1e-12 * np.sqrt(reference)),
    )
    basis = CurveBasis.of(states.amplitude, most_knots or MOST_KNOTS)
    if start is not None:
        basis, units, reference = start.basis, start.units, start.places.reference
    n_others = 0 if states.beside is None else states.beside.shape[1]
    places = places_of(basis, states.n_levels, discrepancy, reference, n_others)
    beside = np.zeros((n, 2 * ALONG * discrepancy), dtype=complex)
    balance = Balance(states, basis, places, units, np.ones(n), beside)
    # From straight lines over a², which hardening by hundreds of bandwidths is, and from curves
    # that bend as they like from the first, which arches are: the more probable goes on.
    starts = [(True, False), (False, False), *[(False, True)] * levels_apart]
    walks = [
        _Walk(balance, straight=straight, apart=apart, robust=robust, tempered=tempered)
        for straight, apart in starts
    ]
    if start is not None:
        walks = [walks[0].from_(start)]
    for walk in walks:
        walk.advance(min(_TRIED, rounds))
    share = min(walk.share for walk in walks)
    walk = max(walks, key=lambda one: one.likelihood_of(share))
    walk.advance(rounds - min(_TRIED, rounds))
    if rounds == _ROUNDS and walk.is_lost:  # among steep curves the way is long
        for one in walks:
            one.advance(_MANY - one.turn)
        walk = max(walks, key=lambda one: one.likelihood_of(share))
    found = walk.found
    if found is None:
        raise ValueError(f"`rounds` must be at least one, not {rounds}.")
    # The size of what few levels differ by is not well known: as Student's t has it. What they have
    # in common may be anything of that size.
    last = walk.balance.straight(found.mean, found.errors, apart=False)
    equations = last.equations._replace(share=found.equations.share)

    variances = prior_variances(basis, places, states)

    def gaussian(point: np.ndarray) -> Gaussian:
        noise, variance = np.exp(point[NOISE]), variances(point)
        mean, covariance = equations.posterior(noise, variance)
        known = variance > 0
        told = np.zeros_like(variance)  # curves take what they can of levels' errors
        told[known] = 1 - np.diag(covariance)[known] / variance[known]
        for own, std in zip(places.levels.T, states.level_std, strict=True):
            variance[own] *= 1.0 if std > 0 else students_factor(float(np.sum(told[own]))) ** 2
        wide = equations.posterior(noise, variance)[1]
        return Gaussian(mean, wide, float(np.sum(told)))

    objective = objective_of(found.equations, states, basis, places)
    bounds = bounds_of(states, basis, found.point)
    point, said = found.point, gaussian(found.point)
    if over_sizes:
        sized = sizes_of_bends(objective, found.point, bounds)
        point, said = averaged(sized, gaussian)
    flat = objective_of(found.equations, states, basis, places, flat=True)
    return TestPosterior(
        states,
        basis,
        units,
        said.mean,
        said.covariance,
        hyper_at(point, basis),
        laplace_evidence(objective, found.point, bounds),
        found.errors,
        found.residuals * np.exp(found.point[NOISE] - point[NOISE]),
        last.arms_of_stiffness,
        said.told,
        places,
        differing_levels(flat, found.point, bounds, states) if compare_levels else (False,) * 4,
        walk.balance.weight,
        found.equations.share,
        walk.still,
    )


def few_levels_factor(n_levels: int) -> float:
    """By how much a 95 % band is wider whose 1σ had to be found from so few levels.

    Student's t over the normal. Two levels count as three: with t of one degree no band would be of
    use.
    """
    return students_factor(n_levels - 1)


def students_factor(freedom: float) -> float:
    """By how much a 95 % band is wider whose 1σ was found with so many degrees of freedom."""
    return float(stdtrit(max(freedom, 2), 0.975) / ndtri(0.975))


class _Found(NamedTuple):
    """What a round found."""

    point: Float[np.ndarray, " hyper"]
    likelihood: float
    equations: LinearRows
    mean: Float[np.ndarray, " unknown"]
    residuals: Float[np.ndarray, "state part"]
    errors: Float[np.ndarray, "state input"]


class _Walk:
    """Rounds of making the problem straight and solving it, from one start on."""

    def __init__(
        self, balance: Balance, *, straight: bool, apart: bool, robust: bool, tempered: bool
    ):
        """From the records; the first rounds with `straight` lines over a², the very first with
        natural frequencies of levels `apart`, if asked.
        """
        places, discrepancy = balance.places, balance.beside.shape[1] > 0
        self.balance, self.straight, self.apart = balance, straight, apart
        self.robust, self.tempered = robust, tempered
        self.start = starting_point(balance.states, balance.basis, discrepancy)
        self.point, self.errors = self.start, np.zeros_like(balance.states.errors)
        self.mean = np.zeros(places.others.stop)
        self.mean[places.damping.start] = 1.0
        self.found: _Found | None = None
        self.turn, self.still, self.share = 0, False, 1.0

    def from_(self, start: TestPosterior) -> "_Walk":
        """The same, going on from what was found for other states."""
        self.mean, self.errors, self.point = start.mean, start.corrections, point_of(start.hyper)
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
            return not self.tempered
        beyond = self.found.point[NOISE] - np.log(priors.STATED_NOISE.median)
        return bool(beyond > _LOST * priors.STATED_NOISE.spread)

    def advance(self, rounds: int) -> None:
        """Some rounds more, or until nothing moves."""
        for _ in range(rounds):
            if self.still:
                return
            self._round()

    def likelihood_of(self, share: float) -> float:
        """The same, were so many of the states independent."""
        if self.found is None:
            return -np.inf
        states, basis, places = self.balance.states, self.balance.basis, self.balance.places
        equations = self.found.equations._replace(share=share)
        return objective_of(equations, states, basis, places)(self.found.point)[0]

    def _round(self) -> None:
        k, states, basis = self.turn, self.balance.states, self.balance.basis
        places, start = self.balance.places, self.start
        if k == _SETTLED:
            self.balance = self.balance.with_discrepancy(self.mean, self.errors)
        this = self.balance.straight(self.mean, self.errors, first=k == 0)
        this = this._replace(equations=this.equations._replace(share=self.share))
        bounds = bounds_of(states, basis, self.point)
        along = slice(FIRST_ALONG, FIRST_ALONG + basis.directions.shape[1])
        if k == 0:  # no level differs from another yet, and bends are of one size
            bounds[LEVELS] = [
                own if self.apart and kind == _STIFFNESS else (own[0], own[0])
                for kind, own in enumerate(bounds[LEVELS])
            ]
            bounds[along] = [(0.0, 0.0)] * (along.stop - along.start)
        if k < _SETTLED and self.straight:
            bounds[BENDS] = [(low, low) for low, _ in bounds[BENDS]]
        # What curves do not follow yet would pass for another modal mass.
        free = k >= _SETTLED or states.mass_std > _GUESS
        held = states if free else states._replace(mass_std=0.0)
        objective = objective_of(this.equations, held, basis, places)
        begin = self.point if k > (_SETTLED if self.straight else 1) else start
        for _ in range(2):
            point = maximised(objective, begin, bounds)
            noise = float(np.exp(point[NOISE]))
            variance = prior_variances(basis, places, held)(point)
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
        if k <= _SETTLED or self.tempered or value > self.likelihood:
            self.found = _Found(point, value, this.equations, goal, left / noise, moved.errors)
        size = np.sqrt(np.diag(covariance) + 1e-300)
        self.still = k > _SETTLED and np.max(np.abs(moved.unknowns - self.mean) / size) < _STILL
        self.point, self.mean, self.errors = point, moved.unknowns, moved.errors
        self.turn += 1
        if self.tempered:
            told = share_told_by(left, states.level, states.frequency)
            self.share = max(told, priors.LEAST_SHARE)
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

    def cost(unknowns: np.ndarray, own: np.ndarray) -> float:
        if not np.all(np.isfinite(own)):
            return np.inf
        bound = variance > 0
        prior = float(np.sum(unknowns[bound] ** 2 / variance[bound]))
        return balance.misfit(unknowns, own) / noise**2 + prior

    if free:
        own = balance.nearest_errors(goal, errors)
        # Where phasors are no mode's the way may be lost.
        return _Moved(goal, own) if np.all(np.isfinite(own)) else _Moved(mean, errors)
    before = cost(mean, balance.nearest_errors(mean, errors))
    share, best = 1.0, (np.inf, mean, errors)
    while share > _SHORTEST:
        unknowns = mean + share * (goal - mean)
        own = balance.nearest_errors(unknowns, errors)
        value = cost(unknowns, own)
        if np.isfinite(value) and value < best[0]:
            best = (value, unknowns, own)
        if value <= before:
            break
        share *= 0.5
    return _Moved(*best[1:])
