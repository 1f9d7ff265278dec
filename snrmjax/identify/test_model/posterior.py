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

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import fdtrc, ndtri, stdtrit

from snrmjax.identify.test_model import priors
from snrmjax.identify.test_model.balance import Balance
from snrmjax.identify.test_model.curve_basis import CurveBasis
from snrmjax.identify.test_model.curve_terms import CurveTerms
from snrmjax.identify.test_model.hyper import (
    ALONG,
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
    prior_variances,
    remainders,
    roughness_stds,
)
from snrmjax.identify.test_model.linear_gaussian import laplace_evidence
from snrmjax.identify.test_model.state_noise import StateNoise, noise_of_states
from snrmjax.identify.test_model.states import RECORDED, TestStates
from snrmjax.identify.test_model.walk import Reached, Rounds, likeliest_walk
from snrmjax.numerics.blocks import on_one_core

_ALL = Rounds()
_NOISE_ROUNDS = 3  # of finding what noise is made of, at most
_SAME_NOISE = 0.1  # relative, by which its parts then move
_LITTLE_MORE = 2.0  # times: phases that were not controlled spread far more than by scatter
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
    terms: tuple[CurveTerms, CurveTerms]  # of ω̃² and δ
    mean: Float[np.ndarray, " unknown"]
    covariance: Float[np.ndarray, "unknown unknown"]
    hyper: Hyper
    log_evidence: float
    log_likelihood: float  # of the states alone, at the most likely unknowns
    corrections: Float[np.ndarray, "state input"]  # most likely errors, subtracted from the record
    residuals: Float[np.ndarray, "state part"]  # whitened: of unit variance where all is right
    effective_unknowns: float  # that the states, and not their priors, tell
    places: Places
    differing: tuple[bool, bool, bool, bool]  # whether levels differ by more than is stated
    weight: Float[np.ndarray, " state"]  # 1, or less for an outlier
    fraction: float  # of the states that count, where neighbours err alike
    settled: bool  # whether the last round moved nothing by more than its error
    in_order: tuple[bool, ...]  # which errors of levels run with their forces: curves do
    remainders: tuple[bool, bool]  # whether noise does not explain what a family leaves
    level_std: Float[np.ndarray, " error"]  # 1σ of levels' errors as the covariance has them

    @property
    def frequency_scatter(self) -> float:
        """1σ by which the natural frequency scatters from state to state, relative.

        Zero where the noise of force and velocity explains the scatter.
        """
        stiffness = self.states.errors[:, RECORDED:].sum(axis=1)
        return 0.5 * self.hyper.noise * float(np.max(stiffness, initial=0.0))

    @property
    def phase_is_controlled(self) -> bool:
        """Whether phases spread little more than scatter of the natural frequency would make them.

        The phase was then controlled, and the states do not determine the modal mass: a small mass
        with a wide resonance would explain the small spread.
        """
        if self.states.of_one_phase:
            return True
        bandwidth = np.median(np.abs(self.curves(self.states.amplitude).modal_damping))
        turned = 2 * self.frequency_scatter * float(np.median(self.states.frequency) / bandwidth)
        return _LITTLE_MORE * turned > float(np.std(self.states.phase))

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

    def beginning(
        self,
        parent: Int[np.ndarray, " level"] | None = None,
        terms: tuple[CurveTerms, CurveTerms] | None = None,
    ) -> "TestPosterior":
        """Where a fit begins of the same states in other levels, each a part of a `parent` of
        these, or by other terms: from a family as it is, and from smooth functions near these.
        """
        parent = np.arange(len(self.places.levels)) if parent is None else parent
        terms = self.terms if terms is None else terms
        n_others = self.places.others.stop - self.places.others.start
        reference = 0.0 if terms[0].family is not None else self.places.reference
        places = places_of(terms, len(parent), False, reference, n_others)
        mean, own = np.zeros(places.others.stop), self.places
        mean[: places.stiffness.start] = self.mean[: places.stiffness.start]
        mean[places.others], mean[places.levels] = self.mean[own.others], self.level_errors[parent]
        was = (own.stiffness, own.damping)
        for k, (now, functions) in enumerate(
            zip(terms, (places.stiffness, places.damping), strict=True)
        ):
            if now.n_functions == self.terms[k].n_functions and now.family is None:
                mean[functions] = self.mean[was[k]]
            elif now.family is not None:
                # A family that goes on without its remainder, or is new to the states.
                start = now.family.parameters / now.units[: now.n_own]
                scaled = np.where(now.scaled[: now.n_own], self.modal_mass[0], 1.0) * start
                mean[functions.start : functions.start + now.n_own] = scaled
        return self._replace(mean=mean, places=places, terms=terms)

    def curves(self, amplitude: Float[np.ndarray, " point"]) -> CurveValues:
        """ω̃² and δ at displacement amplitudes (m), with their covariance."""
        both = zip(self.terms, (self.places.stiffness, self.places.damping), strict=True)
        pairs = [terms.curve(amplitude, self.mean[functions]) for terms, functions in both]
        values, steep = np.moveaxis(np.array(pairs), 0, 2) / (1 + self.mean[MASS])
        rows = self.slopes(amplitude)
        covariance = np.einsum("npi,ij,nqj->npq", rows, self.covariance, rows)
        return CurveValues(values[:, 0] + self.places.reference, values[:, 1], covariance, steep)

    def slopes(self, amplitude: Float[np.ndarray, " point"]) -> Float[np.ndarray, "point two n"]:
        """Derivatives of ω̃² and δ at displacement amplitudes (m) by all unknowns."""
        rows = np.zeros((len(amplitude), 2, len(self.mean)))
        both = zip(self.terms, (self.places.stiffness, self.places.damping), strict=True)
        for k, (terms, functions) in enumerate(both):
            own, mass = self.mean[functions], 1 + self.mean[MASS]
            rows[:, k, functions] = terms.columns(amplitude, own) / mass
            rows[:, k, MASS] = -terms.curve(amplitude, own)[0] / mass**2
        return rows


@on_one_core
def fit_test(
    states: TestStates,
    *,
    discrepancy: bool = False,
    robust: bool = False,
    power_likelihood: bool = False,
    over_sizes: bool = False,
    compare_levels: bool = True,
    parts_of_noise: bool = False,
    rounds: Rounds = _ALL,
) -> TestPosterior:
    """The posterior of a test.

    Arguments: with `discrepancy` what one mode leaves off resonance is unknown too: smooth in phase
    and amplitude, zero at phase resonance; with `robust` noise has outliers (Student's t); with
    `power_likelihood` states whose neighbours miss the curves alike count as fewer; with
    `over_sizes` curves are averaged over the roughness that they may have; without
    `compare_levels` nothing is reported on which errors levels differ by (`differing`), which
    takes half the time; with
    `parts_of_noise` scatter of the natural frequency from state to state is estimated, and a noise
    floor where no noise is stated (`StateNoise`): the posterior's `states` have them as errors.
    Raises `ValueError` for fewer than two states.
    """
    if len(states.level) < 2:
        raise ValueError(f"a test needs at least two states, not {len(states.level)}.")
    if parts_of_noise:
        return _with_parts_of_noise(
            functools.partial(
                fit_test,
                discrepancy=discrepancy,
                robust=robust,
                power_likelihood=power_likelihood,
                over_sizes=over_sizes,
                compare_levels=compare_levels,
            ),
            states,
            rounds,
        )
    n, omega = len(states.level), states.frequency
    reference = float(np.mean(omega**2))
    z = 1j * omega * states.constant * states.force / (states.velocity)
    # Of curves: all that the test passed through, and the damping as single states have it.
    units = (
        float(np.ptp(omega**2) + _REACH * np.median(np.abs(z))),
        float(np.quantile(np.abs(z.imag / omega), 0.9) + 1e-12 * np.sqrt(reference)),
    )
    basis = CurveBasis.of(states.amplitude, rounds.most_knots, crowded=rounds.crowded)
    terms = CurveTerms(basis, units[0]), CurveTerms(basis, units[1])
    start = rounds.start
    if start is not None:
        terms, reference = start.terms, start.places.reference
    n_others = 0 if states.beside is None else states.beside.shape[1]
    places = places_of(terms, states.n_levels, discrepancy, reference, n_others)
    beside = np.zeros((n, 2 * ALONG * discrepancy), dtype=complex)
    balance = Balance(states, terms, places, np.ones(n), beside)
    if start is not None:
        balance = balance._replace(in_order=start.in_order)
    walk = likeliest_walk(balance, rounds, robust=robust, power_likelihood=power_likelihood)
    # Where neighbouring states miss the curves alike, levels may differ by what the model lacks.
    while walk.found is not None and walk.found.equations.fraction < 1:
        in_order = walk.balance.in_order
        more = levels_in_order(states, walk.found.mean[places.levels])
        if not np.any(more > in_order):
            break
        balance = balance._replace(in_order=tuple((more | in_order).tolist()))
        walk = likeliest_walk(balance, rounds, robust=robust, power_likelihood=power_likelihood)
    reached = walk.found
    if reached is None:
        raise ValueError(f"`rounds.most` must be at least one, not {rounds.most}.")
    # The size of what few levels differ by is not well known: as Student's t has it. What they have
    # in common may be anything of that size, and so may what runs with their order: the curves
    # have it, and bands say that it may be the levels'.
    last = walk.balance.straight(reached.mean, reached.errors, apart=False)
    equations = last.equations._replace(fraction=reached.equations.fraction)
    exchanged = equations
    if any(walk.balance.in_order):
        free = walk.balance._replace(in_order=(False,) * 4)
        anew = free.straight(reached.mean, reached.errors, apart=False)
        exchanged = anew.equations._replace(fraction=equations.fraction)

    variances = prior_variances(terms, places, states)

    def gaussian(point: np.ndarray) -> Gaussian:
        noise, variance = np.exp(point[NOISE]), variances(point)
        # In the mean levels have no error in common: the prior of the curves' roughness would
        # make the curves smaller, and put the rest down to the levels.
        mean = reached.equations.posterior(noise, variance)[0]
        covariance = equations.posterior(noise, variance)[1]
        known = variance > 0
        informed = np.zeros_like(variance)  # curves take what they can of levels' errors
        informed[known] = 1 - np.diag(covariance)[known] / variance[known]
        for errors_of_kind, std in zip(places.levels.T, states.level_std, strict=True):
            variance[errors_of_kind] *= (
                1.0 if std > 0 else students_factor(float(np.sum(informed[errors_of_kind]))) ** 2
            )
        wide = exchanged.posterior(noise, variance)[1]
        return Gaussian(mean, wide, float(np.sum(informed)), np.sqrt(variance[places.levels[0]]))

    objective = objective_of(reached.equations, states, terms, places)
    bounds = bounds_of(states, terms, reached.point)
    point, summary = reached.point, gaussian(reached.point)
    if over_sizes:
        sized = roughness_stds(objective, reached.point, bounds)
        point, summary = averaged(sized, gaussian)
    flat = objective_of(reached.equations, states, terms, places, flat=True)
    posterior = TestPosterior(
        states,
        terms,
        summary.mean,
        summary.covariance,
        hyper_at(point, terms),
        laplace_evidence(objective, reached.point, bounds),
        _log_likelihood(reached),
        reached.errors,
        reached.residuals * np.exp(reached.point[NOISE] - point[NOISE]),
        summary.told,
        places,
        differing_levels(flat, reached.point, bounds, states) if compare_levels else (False,) * 4,
        walk.balance.weight,
        reached.equations.fraction,
        walk.still,
        walk.balance.in_order,
        remainders(reached.equations, states, terms, places, reached.point),
        summary.level_std,
    )
    if states.linear is None:
        return posterior
    return posterior._replace(log_evidence=posterior.log_evidence + _near_linear(posterior))


def _with_parts_of_noise(
    fit: Callable[..., TestPosterior], states: TestStates, rounds: Rounds
) -> TestPosterior:
    """The posterior with all parts of the states' noise that the data clearly show.

    In several rounds: scatter of the frequency that is taken for noise of the phase changes the
    modal mass, and with it the residuals. Where the phase may have been controlled the first round
    keeps the model's mass: a mass near zero would explain the scatter without any noise.
    """
    first = states._replace(mass_std=0.0) if states.near_one_phase else states
    found, parts = fit(first, rounds=rounds), StateNoise(0.0, 0.0, 1.0)
    for _ in range(_NOISE_ROUNDS):
        balance = Balance(
            *(states, found.terms, found.places, found.weight),
            np.zeros((len(states.level), 0), complex),
        )
        last = parts
        parts = noise_of_states(balance, found.mean, found.corrections, found.hyper.noise)
        same = np.allclose(parts, last, rtol=_SAME_NOISE, atol=0.0)
        if same or (not any(parts[:2]) and not any(last[:2]) and first is states):
            break
        first = states
        found = fit(parts.of(states), rounds=rounds)
    return found


def _near_linear(posterior: TestPosterior) -> float:
    """ln of the density of both curves at the smallest amplitude over that of the linear test's.

    A discrepancy counts by the linear test's damping too: it is no tenth of one that is a hundred
    times larger.
    """
    at_rest = posterior.curves(np.array([posterior.states.amplitude.min()]))
    found = np.concatenate([at_rest.squared_frequency, at_rest.modal_damping])
    least = 1e-3  # of the linear ones: noise may take a damping below zero
    off = np.log(np.maximum(found / np.array(posterior.states.linear), least)) / priors.NEAR_LINEAR
    added = max(posterior.hyper.discrepancy) * np.exp(off[1] * priors.NEAR_LINEAR[1])
    over = added / (priors.DISCREPANCY.scale * np.exp(priors.NEAR_LINEAR[1]))
    return -0.5 * float(off @ off + over**2)


def levels_in_order(
    states: TestStates, errors: Float[np.ndarray, "level error"]
) -> Bool[np.ndarray, " error"]:
    """Which unstated errors of levels run with the levels' forces by more than chance does."""
    common, n = states.common_to_levels, states.n_levels
    if common.shape[1] < 2 or n < 3:
        return np.zeros(errors.shape[1], dtype=bool)
    constant, line = (common.T @ errors) ** 2
    left = np.maximum(np.sum(errors**2, axis=0) - constant - line, 1e-12 * line + 1e-300)
    chance = fdtrc(1, n - 2, line * (n - 2) / left)
    return (chance < priors.IN_ORDER) & ~(np.array(states.level_std) > 0)


def _log_likelihood(reached: Reached) -> float:
    """ln of the density of the records, were the most likely unknowns the true ones."""
    left, noise = reached.residuals, float(reached.point[NOISE])
    each = np.log(2 * np.pi) + 2 * noise
    return reached.equations.offset - 0.5 * float(np.sum(left**2) + left.size * each)


def students_factor(freedom: float) -> float:
    """By how much a 95 % band is wider whose 1σ was found with so many degrees of freedom.

    Student's t over the normal. One counts as two: with t of one no band would be of use.
    """
    return float(stdtrit(max(freedom, 2), 0.975) / ndtri(0.975))
