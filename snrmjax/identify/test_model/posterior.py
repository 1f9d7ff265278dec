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
of the curves' processes and of the discrepancy) all is one Gaussian (`linear_gaussian`); those are
taken where likelihood times prior is largest, and integrated over by Laplace's approximation.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from snrmjax.identify.test_model import priors
from snrmjax.identify.test_model.curve_basis import CurveBasis
from snrmjax.identify.test_model.hyper import (
    ALONG,
    DAMPING,
    LEVELS,
    STIFFNESS,
    Hyper,
    Places,
    bounds_of,
    hyper_at,
    objective_of,
    places_of,
    prior_variances,
    starting_point,
)
from snrmjax.identify.test_model.linear_gaussian import (
    LinearRows,
    MostLikely,
    Objective,
    maximised,
    most_likely,
)
from snrmjax.identify.test_model.states import TestStates
from snrmjax.numerics.blocks import on_one_core

_ROUNDS = 6
_WITHOUT_PROCESS, _AS_RECORDED = 2, 2  # rounds until curves are free, until states are corrected
_REACH = 3.0  # times the dynamic stiffness, that a natural frequency may lie beside a test
_FARTHEST = 0.3  # relative or rad, of a state's correction
_LINEAR = 0.5  # relative or rad, of a level's error, that a straight line reaches
_SIGMAS = 4.0  # of a level's error, at which the problem is made straight at most


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
    places: Places
    differing: tuple[bool, bool, bool, bool]  # whether levels differ by more than is stated

    @property
    def modal_mass(self) -> tuple[float, float]:
        """κ, the modal mass over the model's, and its 1σ."""
        return 1 + float(self.mean[0]), float(np.sqrt(self.covariance[0, 0]))

    @property
    def level_errors(self) -> Float[np.ndarray, "level error"]:
        """Most likely errors of every level: gain and phase (rad) of its record, and relative
        deviations of stiffness and damping.
        """
        return self.mean[self.places.levels]

    def curves(self, amplitude: Float[np.ndarray, " point"]) -> CurveValues:
        """ω̃² and δ at displacement amplitudes (m), with their covariance."""
        values, slopes = self.basis.values(amplitude)
        mass = 1 + self.mean[0]
        reference = self.places.reference
        n = len(values)
        rows = np.zeros((n, 2, len(self.mean)))
        found = np.zeros((n, 2))
        steep = np.zeros((n, 2))
        for k, (own, unit) in enumerate(
            zip((self.places.stiffness, self.places.damping), self.units, strict=True)
        ):
            found[:, k] = unit * (values @ self.mean[own]) / mass
            steep[:, k] = unit * (slopes @ self.mean[own]) / mass
            rows[:, k, own] = unit * values / mass
            rows[:, k, 0] = -found[:, k] / mass
        covariance = np.einsum("npi,ij,nqj->npq", rows, self.covariance, rows)
        return CurveValues(found[:, 0] + reference, found[:, 1], covariance, steep)


class _Round(NamedTuple):
    """The problem made straight at some corrections."""

    equations: LinearRows
    design: Float[np.ndarray, "row unknown"]
    rows: Float[np.ndarray, " row"]
    slopes: Complex[np.ndarray, "state input"]  # of the residual by the states' errors
    root: Float[np.ndarray, "state 2 2"]


@on_one_core
def fit_test(
    states: TestStates, *, discrepancy: bool = False, robust: bool = False, rounds: int = _ROUNDS
) -> TestPosterior:
    """The posterior of a test.

    Arguments: with `discrepancy` what one mode leaves off resonance is unknown too: smooth along a
    level, zero at phase resonance; with `robust` noise has outliers (Student's t).
    Raises `ValueError` for fewer than two states.
    """
    if len(states.level) < 2:
        raise ValueError(f"a test needs at least two states, not {len(states.level)}.")
    n, omega = len(states.level), states.frequency
    reference = float(np.mean(omega**2))
    z = _dynamic_stiffness(states, np.zeros_like(states.errors))
    # Of curves: all that the test passed through, and the damping as single states have it.
    units = (
        float(np.ptp(omega**2) + _REACH * np.median(np.abs(z))),
        float(np.quantile(np.abs(z.imag / omega), 0.9) + 1e-12 * np.sqrt(reference)),
    )
    basis = CurveBasis.of(states.amplitude)
    places = places_of(states.n_levels, discrepancy, reference)
    corrections, weight = np.zeros_like(states.errors), np.ones(n)
    at_levels = np.zeros((states.n_levels, 2))
    mean = np.zeros(places.levels[-1, -1] + 1 + 2 * ALONG * states.n_levels * discrepancy)
    mean[places.damping.start] = 1.0
    smooth = mean
    stated = np.array(states.level_std[:2])
    farthest = _SIGMAS * np.where(stated > 0, stated, [one.scale for one in priors.LEVELS[:2]])
    start = starting_point(states, discrepancy)
    point, found = start, None
    for k in range(rounds):
        problem = _Problem(
            states, basis, places, units, mean, smooth, corrections, at_levels, weight
        )
        this = _straight(problem, first=k == 0)
        bounds = bounds_of(states, point)
        if k < _WITHOUT_PROCESS:  # parabolas first, whose slopes are sound
            for own in (STIFFNESS.start, DAMPING.start):
                bounds[own] = (bounds[own][0], bounds[own][0])
        if k == 0:  # and no level differs from another yet
            bounds[LEVELS] = [(low, low) for low, _ in bounds[LEVELS]]
        objective = objective_of(this.equations, states, basis, places)
        begin = point if k > _WITHOUT_PROCESS else start
        for _ in range(2):
            best = most_likely(objective, begin, bounds)
            point, hyper = best.point, hyper_at(best.point)
            variance = prior_variances(hyper, basis, places, states)[0]
            mean, covariance = this.equations.posterior(hyper.noise, variance)
            if np.max(np.abs(mean[places.levels[:, :2]])) < _LINEAR:
                break
            # A gain of two would be a turned sign: no straight line goes that far.
            bounds[LEVELS] = [(low, low) for low, _ in bounds[LEVELS]]
        # Slopes of curves that bend as they like would let errors of amplitude explain all.
        variance[places.processes] = 0.0
        smooth = this.equations.posterior(hyper.noise, variance)[0]
        left = (this.rows - this.design @ mean).reshape(n, 2)
        # A step may lead away from where the problem is straight: the best round counts.
        if found is None or k <= _WITHOUT_PROCESS or best.log_evidence > found.best.log_evidence:
            found = _Found(best, this, mean, covariance, left / hyper.noise, corrections)
        if k >= _AS_RECORDED:
            # The errors with which every state lies on the curves, to first order.
            parts = np.stack([this.slopes.real, this.slopes.imag], axis=1)
            pull = np.einsum("nij,nj->ni", this.root.transpose(0, 2, 1), left)
            errors = -np.einsum("nie,ni->ne", parts, pull) * states.errors**2
            corrections = np.clip(errors, -_FARTHEST, _FARTHEST)
            at_levels = np.clip(mean[places.levels][:, :2], -farthest, farthest)
        if robust:
            square = np.sum(left**2, axis=1) / hyper.noise**2
            weight = (priors.STUDENT_FREEDOM + 2) / (priors.STUDENT_FREEDOM + square)
    if found is None:
        raise ValueError(f"`rounds` must be at least one, not {rounds}.")
    flat = objective_of(found.round.equations, states, basis, places, flat=True)
    return TestPosterior(
        states,
        basis,
        units,
        found.mean,
        found.covariance,
        hyper_at(found.best.point),
        found.best.log_evidence,
        found.corrections,
        found.residuals,
        places,
        _differing(flat, found.best.point, bounds_of(states, start), states),
    )


def _differing(
    objective: Objective, point: np.ndarray, bounds: list[tuple[float, float]], states: TestStates
) -> tuple[bool, bool, bool, bool]:
    """Which unstated errors of levels the likelihood asks for: the others are left out in turn."""
    kept = [k for k, std in enumerate(states.level_std) if not std > 0]
    if states.n_levels < 2:
        kept = []
    point = maximised(objective, point, bounds)
    value = objective(point)[0]
    while kept:
        trials = []
        for kind in kept:
            held = list(bounds)
            for k in range(4):
                if not states.level_std[k] > 0 and (k == kind or k not in kept):
                    low = bounds[LEVELS.start + k][0]
                    held[LEVELS.start + k] = (low, low)
            without = maximised(objective, point, held)
            trials.append((objective(without)[0], kind, without))
        least, kind, without = max(trials, key=lambda trial: trial[0])
        if value - least > 0.5 * priors.LEVELS_DIFFER:
            break
        kept.remove(kind)
        point, value = without, least
    return 0 in kept, 1 in kept, 2 in kept, 3 in kept


class _Found(NamedTuple):
    """What a round found."""

    best: MostLikely
    round: _Round
    mean: Float[np.ndarray, " unknown"]
    covariance: Float[np.ndarray, "unknown unknown"]
    residuals: Float[np.ndarray, "state part"]
    corrections: Float[np.ndarray, "state input"]


class _Problem(NamedTuple):
    """Where the problem is made straight."""

    states: TestStates
    basis: CurveBasis
    places: Places
    units: tuple[float, float]
    mean: Float[np.ndarray, " unknown"]
    smooth: Float[np.ndarray, " unknown"]  # with parabolas in place of the curves
    corrections: Float[np.ndarray, "state input"]
    at_levels: Float[np.ndarray, "level two"]  # gain and phase of the levels' records
    weight: Float[np.ndarray, " state"]


def _dynamic_stiffness(states: TestStates, errors: np.ndarray) -> Complex[np.ndarray, " state"]:
    """Z = FA/X of states with these errors added to their records."""
    velocity = states.velocity * np.exp(errors[:, 1] + 1j * errors[:, 2])
    return 1j * states.frequency * states.constant * states.force * np.exp(errors[:, 0]) / velocity


def _straight(problem: _Problem, *, first: bool) -> _Round:
    states, basis, places, units, mean, smooth, corrections, at_levels, weight = problem
    omega, level = states.frequency, states.level
    gain, phase = at_levels[level].T
    nothing = np.zeros_like(gain)
    parts = (gain, nothing, phase) if states.force_is_free else (nothing, gain, phase)
    added = corrections - np.stack(parts, axis=1)
    z = _dynamic_stiffness(states, added)
    amplitude = states.amplitude * np.exp(added[:, 1])
    values, by_log = basis.values(amplitude)
    mass = 1 + mean[0]
    curve = [
        units[0] * (values @ mean[places.stiffness]),
        units[1] * (values @ mean[places.damping]),
    ]
    slope = units[0] * (by_log @ smooth[places.stiffness]) + 1j * omega * units[1] * (
        by_log @ smooth[places.damping]
    )
    if first:
        slope = 0.0 * slope
    # Errors of levels multiply what the model has, as soon as there is one: with the record itself
    # they could explain all of it away.
    own = z if first else mass * (places.reference - omega**2) + curve[0] + 1j * omega * curve[1]
    slopes = np.stack([z, -z - slope, -1j * z], axis=1)
    design = np.zeros((len(z), len(mean)), dtype=complex)
    design[:, 0] = places.reference - omega**2
    design[:, places.stiffness] = units[0] * values
    design[:, places.damping] = 1j * omega[:, None] * units[1] * values
    of_gain = own if states.force_is_free else -own - slope
    of_level = (of_gain, -1j * own, curve[0] + mass * places.reference, 1j * omega * curve[1])
    for k, column in enumerate(of_level):
        design[np.arange(len(z)), places.levels[level, k]] = column
    if places.discrepancy[0].stop > places.discrepancy[0].start:
        theta = np.angle(z / 1j)
        along = np.sin(theta)[:, None] * np.cos(np.arange(ALONG) * theta[:, None])
        along = along * np.exp(-0.25 * (np.arange(ALONG) * priors.DISCREPANCY_LENGTH) ** 2)
        size = np.abs(omega * curve[1])[:, None] * along
        columns = ALONG * level[:, None] + np.arange(ALONG)
        for part, unit in zip(places.discrepancy, (1.0, 1j), strict=True):
            design[np.arange(len(z))[:, None], part.start + columns] = unit * size
    # Residual at the record: rows − design @ unknowns, by its straight line from the corrected one.
    rows = z - (places.reference - omega**2) - np.sum(slopes * corrections, axis=1)
    rows = rows + of_level[0] * gain + of_level[1] * phase
    root, log_det = _whitening(slopes, states.errors, weight)
    white = np.einsum("nij,njk->nik", root, np.stack([design.real, design.imag], axis=1))
    goal = np.einsum("nij,nj->ni", root, np.stack([rows.real, rows.imag], axis=1))
    # Of the rows to what was recorded: |∂Z/∂X| a state.
    jacobian = float(np.sum(np.log(np.abs(z) * np.abs(z + slope))))
    matrix, vector = white.reshape(-1, len(mean)), goal.reshape(-1)
    equations = LinearRows.of(matrix, vector, jacobian - 0.5 * log_det)
    return _Round(equations, matrix, vector, slopes, root)


def _whitening(
    slopes: Complex[np.ndarray, "state input"],
    std: Float[np.ndarray, "state input"],
    weight: Float[np.ndarray, " state"],
) -> tuple[Float[np.ndarray, "state 2 2"], float]:
    """Inverse Cholesky factors of every state's covariance, and the sum of log determinants."""
    scaled = slopes * std / np.sqrt(weight)[:, None]
    a = np.sum(scaled.real**2, axis=1)
    b = np.sum(scaled.real * scaled.imag, axis=1)
    c = np.sum(scaled.imag**2, axis=1)
    floor = 1e-12 * (a + c)  # rounding must not make it singular
    a = a + floor
    det = np.maximum(a * c - b**2, floor * a)
    root = np.zeros((len(a), 2, 2))
    root[:, 0, 0] = 1 / np.sqrt(a)
    low = np.sqrt(det / a)
    root[:, 1, 0] = -b / (a * low)
    root[:, 1, 1] = 1 / low
    return root, float(np.sum(np.log(det)))
