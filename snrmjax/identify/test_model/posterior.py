"""Joint posterior of a test: both curves, modal mass, level errors, discrepancy, and noise.

The force balance is linear in all unknowns. For Z = FA/X of every state (`TestStates`), errors
change its residual to first order:

| error | change of the residual Z − κ(K − Ω² + iΩδ) |
|---|---|
| force, relative | Z |
| velocity, relative | −Z − κ a (K′ + iΩδ′), as a changes too |
| phase | −iZ |
| stiffness of a level, relative | −κK |
| damping of a level, relative | −iΩκδ |

It is linearised at the states corrected for their most likely errors, in Gauss–Newton iterations
(orthogonal distance regression). Given the hyperparameters (1σ of noise, level errors, roughness
and discrepancy) the posterior is Gaussian (`linear_gaussian`); the hyperparameters are at their
posterior mode, and the evidence integrates over them by Laplace's approximation.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import fdtrc, ndtri, stdtrit

from snrmjax.identify.test_model import priors
from snrmjax.identify.test_model.balance import Balance
from snrmjax.identify.test_model.curve_basis import CurveBasis
from snrmjax.identify.test_model.curve_terms import CurveTerms
from snrmjax.identify.test_model.gauss_newton import Iterate, Rounds, multistart
from snrmjax.identify.test_model.hyper import (
    ALONG,
    MASS,
    NOISE,
    OFFSET,
    PHASE,
    TREND,
    Gaussian,
    Hyper,
    Layout,
    averaged,
    bounds_of,
    differing_levels,
    hyper_at,
    layout_of,
    objective_of,
    prior_variances,
    remainders,
    roughness_grid,
)
from snrmjax.identify.test_model.linear_gaussian import laplace_evidence
from snrmjax.identify.test_model.state_noise import StateNoise, noise_of_states
from snrmjax.identify.test_model.states import RECORDED, TestStates
from snrmjax.numerics.blocks import on_one_core
from snrmjax.numerics.rules import InputError

_ALL = Rounds()
_NOISE_ROUNDS = 3  # of estimating the noise components, at most
_SAME_NOISE = 0.1  # relative convergence tolerance of the components
_LITTLE_MORE = 2.0  # ratio of phase spread to frequency scatter: more is not phase control
_REACH = 3.0  # dynamic stiffnesses that ω̃² may lie outside the tested range of Ω²


class CurveValues(NamedTuple):
    """Both curves at some amplitudes, with their covariance."""

    squared_frequency: Float[np.ndarray, " point"]  # ω̃², rad²/s²
    modal_damping: Float[np.ndarray, " point"]  # δ, 1/s
    covariance: Float[np.ndarray, "point two two"]
    slopes: Float[np.ndarray, "point two"]  # by the logarithm of amplitude


class TestPosterior(NamedTuple):
    """Posterior of all states together, by `fit_test`."""

    states: TestStates
    terms: tuple[CurveTerms, CurveTerms]  # of ω̃² and δ
    mean: Float[np.ndarray, " unknown"]
    covariance: Float[np.ndarray, "unknown unknown"]
    hyper: Hyper
    log_evidence: float
    log_likelihood: float  # of the states alone, at the most likely unknowns
    corrections: Float[np.ndarray, "state input"]  # most likely errors, added to the record
    residuals: Float[np.ndarray, "state part"]  # whitened: unit variance if the model holds
    effective_unknowns: float  # number that the states, not the priors, determine
    layout: Layout
    differing: tuple[bool, bool, bool, bool]  # by more than stated, of `LEVEL_ERRORS`
    weight: Float[np.ndarray, " state"]  # 1, or less for an outlier
    fraction: float  # independent fraction of the states, for correlated residuals
    converged: bool  # whether the last iteration was below tolerance
    in_order: tuple[bool, ...]  # which level errors correlate with force
    remainders: tuple[bool, bool]  # whether a family leaves more than noise
    level_std: Float[np.ndarray, " error"]  # 1σ of level errors in the covariance

    @property
    def frequency_scatter(self) -> float:
        """Relative 1σ of the natural frequency's scatter from state to state.

        Zero where the noise of force and velocity explains the residuals.
        """
        stiffness = self.states.errors[:, RECORDED:].sum(axis=1)
        return 0.5 * self.hyper.noise * float(np.max(stiffness, initial=0.0))

    @property
    def phase_is_controlled(self) -> bool:
        """Whether the phases spread little more than the natural frequency's scatter implies.

        The phase was then controlled, and the states do not determine the modal mass: a small mass
        with a broad resonance would explain the small spread as well.
        """
        if self.states.of_one_phase:
            return True
        bandwidth = np.median(np.abs(self.curves(self.states.amplitude).modal_damping))
        phase_std = 2 * self.frequency_scatter * float(np.median(self.states.frequency) / bandwidth)
        return _LITTLE_MORE * phase_std > float(np.std(self.states.phase))

    @property
    def modal_mass(self) -> tuple[float, float]:
        """κ, the modal mass over the model's, and its 1σ."""
        return 1 + float(self.mean[MASS]), float(np.sqrt(self.covariance[MASS, MASS]))

    @property
    def instrument_phase(self) -> float:
        """Phase error common to all records, rad."""
        return float(self.mean[PHASE])

    @property
    def force_offset(self) -> float:
        """Force offset, relative to the smallest force."""
        return float(self.mean[OFFSET])

    @property
    def trend(self) -> tuple[float, float]:
        """Relative stiffness change per unit of the states' trend, and its 1σ."""
        return float(self.mean[TREND]), float(np.sqrt(self.covariance[TREND, TREND]))

    @property
    def level_errors(self) -> Float[np.ndarray, "level error"]:
        """Most likely errors of every level: gain, phase (rad), and relative deviations of
        stiffness and damping.
        """
        return self.mean[self.layout.levels]

    def beginning(
        self,
        parent: Int[np.ndarray, " level"] | None = None,
        terms: tuple[CurveTerms, CurveTerms] | None = None,
    ) -> "TestPosterior":
        """Starting point for the same states with levels split (`parent` of each new one), or with
        other curve terms: a family starts as given, smooth curves near the current ones.
        """
        parent = np.arange(len(self.layout.levels)) if parent is None else parent
        terms = self.terms if terms is None else terms
        n_others = self.layout.others.stop - self.layout.others.start
        reference = 0.0 if terms[0].family is not None else self.layout.reference
        layout = layout_of(terms, len(parent), False, reference, n_others)
        mean, own = np.zeros(layout.others.stop), self.layout
        mean[: layout.stiffness.start] = self.mean[: layout.stiffness.start]
        mean[layout.others], mean[layout.levels] = self.mean[own.others], self.level_errors[parent]
        was = (own.stiffness, own.damping)
        for k, (now, functions) in enumerate(
            zip(terms, (layout.stiffness, layout.damping), strict=True)
        ):
            if now.n_functions == self.terms[k].n_functions and now.family is None:
                mean[functions] = self.mean[was[k]]
            elif now.family is not None:
                # A family resumed without its remainder, or a new one.
                start = now.family.parameters / now.units[: now.n_own]
                scaled = np.where(now.scaled[: now.n_own], self.modal_mass[0], 1.0) * start
                mean[functions.start : functions.start + now.n_own] = scaled
        return self._replace(mean=mean, layout=layout, terms=terms)

    def curves(self, amplitude: Float[np.ndarray, " point"]) -> CurveValues:
        """ω̃² and δ at displacement amplitudes (m), with their covariance."""
        both = zip(self.terms, (self.layout.stiffness, self.layout.damping), strict=True)
        pairs = [terms.curve(amplitude, self.mean[functions]) for terms, functions in both]
        values, steep = np.moveaxis(np.array(pairs), 0, 2) / (1 + self.mean[MASS])
        rows = self.slopes(amplitude)
        covariance = np.einsum("npi,ij,nqj->npq", rows, self.covariance, rows)
        return CurveValues(values[:, 0] + self.layout.reference, values[:, 1], covariance, steep)

    def slopes(self, amplitude: Float[np.ndarray, " point"]) -> Float[np.ndarray, "point two n"]:
        """Derivatives of ω̃² and δ at displacement amplitudes (m) by all unknowns."""
        rows = np.zeros((len(amplitude), 2, len(self.mean)))
        both = zip(self.terms, (self.layout.stiffness, self.layout.damping), strict=True)
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
    robust: bool | None = False,
    power_likelihood: bool = False,
    average_roughness: bool = False,
    compare_levels: bool = True,
    parts_of_noise: bool = False,
    rounds: Rounds = _ALL,
) -> TestPosterior:
    """The posterior of a test.

    Arguments: `discrepancy` adds a misfit of the single-mode model off resonance, smooth in phase
    and amplitude and zero at phase resonance; `robust` allows outliers (Student's t), None: where
    that is more probable;
    `power_likelihood` counts states with correlated residuals as fewer; `average_roughness`
    averages over the roughness of the curves; without `compare_levels` nothing is reported on how
    levels differ (`differing`), which halves the time; `parts_of_noise` estimates the natural
    frequency's scatter from state to state, and a noise floor where no noise is stated
    (`StateNoise`): the posterior's `states` include them as errors.
    Raises `ValueError` for fewer than two states.
    """
    if len(states.level) < 2:
        raise InputError(f"a test needs at least two states, not {len(states.level)}.")
    settings: dict[str, Any] = {
        "discrepancy": discrepancy,
        "power_likelihood": power_likelihood,
        "average_roughness": average_roughness,
        "compare_levels": compare_levels,
    }
    if robust is None:
        settings |= {"parts_of_noise": parts_of_noise}
        return _with_likely_noise(functools.partial(fit_test, states, rounds=rounds, **settings))
    if parts_of_noise:
        fit = functools.partial(fit_test, robust=robust, **settings)
        return _with_parts_of_noise(fit, states, rounds)
    n, omega = len(states.level), states.frequency
    reference = float(np.mean(omega**2))
    z = 1j * omega * states.constant * states.force / (states.velocity)
    # Units of the curves: the range of Ω² with the dynamic stiffness, and single-state damping.
    units = (
        float(np.ptp(omega**2) + _REACH * np.median(np.abs(z))),
        float(np.quantile(np.abs(z.imag / omega), 0.9) + 1e-12 * np.sqrt(reference)),
    )
    basis = CurveBasis.of(states.amplitude, rounds.most_knots, crowded=rounds.crowded)
    terms = CurveTerms(basis, units[0]), CurveTerms(basis, units[1])
    start = rounds.start
    if start is not None:
        terms, reference = start.terms, start.layout.reference
    n_others = 0 if states.other_modes is None else states.other_modes.shape[1]
    layout = layout_of(terms, states.n_levels, discrepancy, reference, n_others)
    discrepancy_basis = np.zeros((n, 2 * ALONG * discrepancy), dtype=complex)
    balance = Balance(states, terms, layout, np.ones(n), discrepancy_basis)
    if start is not None:
        balance = balance._replace(in_order=start.in_order)
    solver = multistart(balance, rounds, robust=robust, power_likelihood=power_likelihood)
    # Correlated residuals: level errors may stand in for model error. Those that correlate with
    # force are then excluded from the level errors.
    while solver.best is not None and solver.best.equations.fraction < 1:
        in_order = solver.balance.in_order
        more = levels_in_order(states, solver.best.mean[layout.levels])
        if not np.any(more > in_order):
            break
        balance = balance._replace(in_order=tuple((more | in_order).tolist()))
        solver = multistart(balance, rounds, robust=robust, power_likelihood=power_likelihood)
    best = solver.best
    if best is None:
        raise InputError(f"`rounds.most` must be at least one, not {rounds.most}.")
    # 1σ of level errors from few levels is uncertain: widened as Student's t. The common level
    # error is not projected out: states off resonance determine it. States at one phase do not, and
    # the roughness prior would shift a part of the damping to it: there the projected equations
    # give the mean. A part correlated with force is attributed to the curves; the bands allow for
    # both as level errors (`exchanged`).
    last = solver.balance.linearised(best.mean, best.errors, apart=False)
    fraction = best.equations.fraction * (priors.STUDENT_INFORMATION if robust else 1.0)
    equations = last.equations._replace(fraction=fraction)
    exchanged = equations
    if any(solver.balance.in_order):
        free = solver.balance._replace(in_order=(False,) * 4)
        anew = free.linearised(best.mean, best.errors, apart=False)
        exchanged = anew.equations._replace(fraction=fraction)

    variances = prior_variances(terms, layout, states)
    objective = objective_of(best.equations, states, terms, layout)

    def gaussian(point: np.ndarray) -> Gaussian:
        noise, variance = np.exp(point[NOISE]), variances(point)
        estimating = best.equations if states.near_one_phase else equations
        mean = estimating.posterior(noise, variance)[0]
        covariance = equations.posterior(noise, variance)[1]
        known = variance > 0
        informed = np.zeros_like(variance)  # per unknown, after what curves absorb
        informed[known] = 1 - np.diag(covariance)[known] / variance[known]
        for errors_of_kind, std in zip(layout.levels.T, states.level_std, strict=True):
            variance[errors_of_kind] *= (
                1.0 if std > 0 else students_factor(float(np.sum(informed[errors_of_kind]))) ** 2
            )
        wide = exchanged.posterior(noise, variance)[1]
        return Gaussian(mean, wide, float(np.sum(informed)), np.sqrt(variance[layout.levels[0]]))

    bounds = bounds_of(states, terms, best.point)
    point, summary = best.point, gaussian(best.point)
    if average_roughness:
        grid = roughness_grid(objective, best.point, bounds)
        point, summary = averaged(grid, gaussian)
    flat = objective_of(best.equations, states, terms, layout, flat=True)
    tails = _log_tails(best.residuals, best.weight) if robust else 0.0
    posterior = TestPosterior(
        states,
        terms,
        summary.mean,
        summary.covariance,
        hyper_at(point, terms),
        laplace_evidence(objective, best.point, bounds) + best.equations.fraction * tails,
        _log_likelihood(best) + tails,
        best.errors,
        best.residuals * np.exp(best.point[NOISE] - point[NOISE]),
        summary.effective_unknowns,
        layout,
        differing_levels(flat, best.point, bounds, states) if compare_levels else (False,) * 4,
        solver.balance.weight,
        best.equations.fraction,
        solver.converged,
        solver.balance.in_order,
        remainders(best.equations, states, terms, layout, best.point),
        summary.level_std,
    )
    if states.linear is None:
        return posterior
    return posterior._replace(log_evidence=posterior.log_evidence + _near_linear(posterior))


def _with_parts_of_noise(
    fit: Callable[..., TestPosterior], states: TestStates, rounds: Rounds
) -> TestPosterior:
    """The posterior with all noise components that the data clearly show.

    Iterated, since frequency scatter treated as phase noise biases the modal mass, and with it the
    residuals. Where the phase may have been controlled, the first fit keeps the model's mass: one
    near zero would explain the scatter without any noise.
    """
    first = states._replace(mass_std=0.0) if states.near_one_phase else states
    posterior, parts = fit(first, rounds=rounds), StateNoise(0.0, 0.0, 1.0)
    for _ in range(_NOISE_ROUNDS):
        balance = Balance(
            states,
            posterior.terms,
            posterior.layout,
            posterior.weight,
            np.zeros((len(states.level), 0), complex),
        )
        last = parts
        parts = noise_of_states(
            balance, posterior.mean, posterior.corrections, posterior.hyper.noise
        )
        same = np.allclose(parts, last, rtol=_SAME_NOISE, atol=0.0)
        if same or (not any(parts[:2]) and not any(last[:2]) and first is states):
            break
        first = states
        posterior = fit(parts.of(states), rounds=rounds)
    return posterior


def _near_linear(posterior: TestPosterior) -> float:
    """ln of the prior density of both curves at the smallest amplitude, about the linear test.

    A discrepancy is relative to the linear test's damping too, as a fitted damping a hundred times
    larger would otherwise allow a discrepancy a hundred times larger.
    """
    at_rest = posterior.curves(np.array([posterior.states.amplitude.min()]))
    fitted = np.concatenate([at_rest.squared_frequency, at_rest.modal_damping])
    least = 1e-3  # of the linear values: noise may make a damping negative
    deviation = (
        np.log(np.maximum(fitted / np.array(posterior.states.linear), least)) / priors.NEAR_LINEAR
    )
    added = max(posterior.hyper.discrepancy) * np.exp(deviation[1] * priors.NEAR_LINEAR[1])
    over = added / (priors.DISCREPANCY.scale * np.exp(priors.NEAR_LINEAR[1]))
    return -0.5 * float(deviation @ deviation + over**2)


def levels_in_order(
    states: TestStates, errors: Float[np.ndarray, "level error"]
) -> Bool[np.ndarray, " error"]:
    """Which unstated level errors correlate significantly with the levels' log force (F test)."""
    common, n = states.common_to_levels, states.n_levels
    if common.shape[1] < 2 or n < 3:
        return np.zeros(errors.shape[1], dtype=bool)
    constant, line = (common.T @ errors) ** 2
    rest = np.maximum(np.sum(errors**2, axis=0) - constant - line, 1e-12 * line + 1e-300)
    chance = fdtrc(1, n - 2, line * (n - 2) / rest)
    return (chance < priors.IN_ORDER) & ~(np.array(states.level_std) > 0)


def _log_likelihood(best: Iterate) -> float:
    """ln of the density of the records at the most likely unknowns."""
    residuals, noise = best.residuals, float(best.point[NOISE])
    each = np.log(2 * np.pi) + 2 * noise
    return best.equations.offset - 0.5 * float(np.sum(residuals**2) + residuals.size * each)


def _log_tails(
    residuals: Float[np.ndarray, "state part"], weight: Float[np.ndarray, " state"]
) -> float:
    """ln of Student's t over the weighted normal density that stands for it, at the residuals.

    Reference: for the weights of the bivariate distribution, Lange, Little & Taylor, J. Am. Stat.
    Assoc. 84 (1989) 881, doi:10.1080/01621459.1989.10478852.
    """
    freedom, square = priors.STUDENT_FREEDOM, np.sum(residuals**2, axis=1)
    tail = 0.5 * (freedom + 2) * np.log1p(square / (weight * freedom))
    return float(np.sum(0.5 * square - np.log(weight) - tail))


def students_factor(freedom: float) -> float:
    """Ratio of Student's t to the normal 97.5 % quantile: widening of a 95 % band.

    At least two degrees of freedom: with one the band would be useless.
    """
    return float(stdtrit(max(freedom, 2), 0.975) / ndtri(0.975))


def farthest_by_chance(
    n_states: int, expected: float = priors.FALSE_OUTLIERS, *, robust: bool = False
) -> float:
    """Magnitude of whitened residuals that `expected` of the states exceed by chance (Bonferroni).

    For two normal residuals of each of n states, n exp(−r²/2) are expected beyond r. With `robust`
    noise the residuals are in units of its scale, which is smaller than its 1σ.
    """
    return (priors.STUDENT_STD if robust else 1.0) * float(
        np.sqrt(2 * np.log(max(1, n_states) / expected))
    )


def _with_likely_noise(fit: Callable[..., TestPosterior]) -> TestPosterior:
    """The posterior with normal noise, or with Student's t where outliers are present and it gives
    the records a larger likelihood.

    Without outliers it may do so too, where the stated noise is too small.
    """
    normal = fit(robust=False)
    n, largest = len(normal.weight), float(np.max(np.hypot(*normal.residuals.T)))
    # An outlier hides in the noise and level errors that it enlarges: a second fit already where
    # one state is expected to lie as far by chance, as in 63 % of tests without outliers.
    if largest <= farthest_by_chance(n, expected=1.0):
        return normal
    tails = fit(robust=True)
    farthest = float(np.max(np.hypot(*tails.residuals.T) / np.sqrt(tails.weight)))
    has_outliers = farthest > farthest_by_chance(n, robust=True)
    return tails if has_outliers and tails.log_likelihood > normal.log_likelihood else normal
