"""Evidence of answers against integrals done otherwise, and what their probabilities add up to."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.special import logsumexp
from scipy.stats import halfcauchy, halfnorm, multivariate_normal, norm
from truths.balanced_sets import balanced, linear_model, quadratic
from truths.made_up_misfits import fit_to, misfit_of, noise

import snrmjax as sj
from snrmjax.diagnose import priors
from snrmjax.diagnose.evidence import (
    NOISE_REJECTED,
    NONE,
    UNKNOWN,
    Marginal,
    Weighed,
    Weights,
    _Sizes,
    _sizes_of,
    answer_of,
    discrepancies,
    either,
    log_evidence,
    marginal_of,
    weights_of,
)
from snrmjax.diagnose.misfit.candidates import candidate
from snrmjax.diagnose.misfit.effect_fit import baseline_fit, fit_effect
from snrmjax.diagnose.misfit.predictions import predictions_of, scales_of
from snrmjax.diagnose.misfit.weighted_misfit import weighted_misfit
from snrmjax.diagnose.search.locating import hat_functions
from snrmjax.diagnose.search.model_search import FoundEffects
from snrmjax.identify.test_model.linear_gaussian import LinearRows
from snrmjax.identify.test_model.priors import FlatSize, HalfNormalSize


def diagnosed(law, **settings):
    return sj.diagnose_model(linear_model(), balanced(law, **settings))


@pytest.fixture(scope="module")
def damped():
    return diagnosed(quadratic)


@pytest.fixture(scope="module")
def misfit():
    return weighted_misfit(predictions_of(linear_model(), balanced(quadratic)))


@pytest.fixture(scope="module")
def fit(misfit):
    return fit_effect(misfit, candidate("quadratic_damping", scales_of(misfit.predictions)))


def weighed(name, log_weight):
    kinds = frozenset() if name == "none" else frozenset(name.split("+"))
    return Weighed(kinds, None, fit_to(noise()), log_weight)  # names and weights alone count


def test_two_descriptions_of_the_same_data_are_weighed_together():
    one = Weights((weighed("none", 0.0), weighed("a", -1.0)), unknown=-2.0, noise_rejected=-np.inf)
    two = Weights((weighed("a", 1.0), weighed("b", -3.0)), unknown=-4.0, noise_rejected=-5.0)
    found = either(one, two, np.log(0.4)).probabilities()
    odds = {
        NONE: 1.0,
        ("a",): np.exp(-1) + 0.4 * np.exp(1),
        ("b",): 0.4 * np.exp(-3),
        UNKNOWN: np.exp(-2) + 0.4 * np.exp(-4),
        NOISE_REJECTED: 0.4 * np.exp(-5),
    }
    assert found == pytest.approx({k: v / sum(odds.values()) for k, v in odds.items()})
    assert next(iter(found)) == ("a",)


def test_probabilities_are_weights_over_their_sum():
    for shift in (0.0, -1e4):
        answers = (weighed("a+b", np.log(2) + shift), weighed("none", shift))
        found = Weights(answers, shift, -np.inf).probabilities()
        assert found == pytest.approx({("a", "b"): 0.5, NONE: 0.25, UNKNOWN: 0.25})
    assert next(iter(found)) == ("a", "b")


def test_an_answer_is_one_whatever_the_order_of_its_effects():
    assert answer_of(("b", "a")) == answer_of(frozenset("ab")) == ("a", "b")
    assert answer_of(()) == NONE


def test_laws_that_act_like_an_answer_have_their_share_of_its_weight():
    some = Weights((weighed("a", 0.0), weighed("none", -50.0)), -50.0, -50.0)
    both = some.with_imitations(2)
    odds = both.probabilities()[UNKNOWN] / both.probabilities()[("a",)]
    assert odds == pytest.approx(2 * priors.IMITATION)
    assert some.with_imitations(0) is some
    nothing = Weights((weighed("none", 0.0), weighed("a", -50.0)), -50.0, -50.0)
    assert nothing.with_imitations(2) is nothing  # nobody imitates what lacks nothing


def test_noise_a_tenth_off_costs_little_evidence_and_four_times_off_much():
    """Against the density of independent normal numbers at the right noise."""
    sizes = _sizes_of(misfit_of())

    def lost(scale):
        left = scale * norm.ppf((np.arange(200) + 0.5) / 200)
        model = Marginal(LinearRows.of(np.zeros((200, 0)), left), np.zeros(0, dtype=int), 0.0)
        best, found = norm.logpdf(left, scale=scale).sum(), log_evidence(model, sizes)
        return best - found.right, best - found.wrong

    right, wrong = zip(*(lost(scale) for scale in (1.0, 1.1, 3.0)), strict=True)
    assert max(right[:2]) < 3
    assert right[0] < right[1]
    assert right[2] > 50
    # Noise of any size is believed there, for what its range costs.
    assert wrong[2] < 5 < wrong[0]


def test_evidence_of_a_small_answer_is_the_integral_over_its_sizes():
    """By quadrature over the noise, the size of levels' errors and that of a discrepancy."""
    rng = np.random.default_rng(5)
    n, widths = 30, (2, 4, 3)  # directions of parameters, levels and a discrepancy
    design = rng.normal(size=(n, sum(widths)))
    true = np.concatenate([rng.normal(size=2), 1.5 * rng.normal(size=4), 2 * rng.normal(size=3)])
    rows = design @ true + rng.normal(size=n)
    group = np.repeat([-1, 2, 4], widths)
    model = Marginal(LinearRows.of(design, rows), group, 0.0)
    bounds = np.log([0.1, 30.0])
    flat = FlatSize(*bounds)
    grid_noise = np.linspace(-0.6, 0.6, 13)
    density = norm.pdf(grid_noise, scale=0.2)

    noise = np.linspace(-0.6, 0.6, 57)
    right = norm.logpdf(noise, scale=0.2)
    sizes = _Sizes(
        (None, None, HalfNormalSize(1.0), None, flat),
        ((0, 0), (0, 0), (np.log(1e-3), np.log(1e3)), (0, 0), tuple(bounds)),
        *(noise, right - logsumexp(right), np.full(len(noise), -np.inf)),
    )
    grids = grid_noise, np.linspace(-6, 3, 40), np.linspace(*bounds, 24)
    scale, *two = np.meshgrid(*grids, indexing="ij")
    variance = np.repeat(np.exp(2 * np.stack([0 * scale, *two], axis=-1)), widths, axis=-1)
    noises = np.exp(2 * scale)[..., None, None] * np.eye(n)
    covariance = noises + (design * variance[..., None, :]) @ design.T
    square = np.linalg.solve(covariance, rows[:, None])[..., 0] @ rows
    values = -0.5 * (square + np.linalg.slogdet(covariance)[1] + n * np.log(2 * np.pi))
    values += halfnorm.logpdf(np.exp(two[0])) + two[0] - np.log(np.ptp(bounds))
    most = values.max()
    weighted = np.exp(values - most) * density[:, None, None] / trapezoid(density, grid_noise)
    for grid in reversed(grids):
        weighted = trapezoid(weighted, grid)
    truth = float(np.log(weighted)) + most
    found = log_evidence(model, sizes)
    # Laplace's approximation of sizes that four and three numbers say.
    assert found.right == pytest.approx(truth, abs=0.3)
    assert found.wrong == -np.inf


def test_evidence_of_an_effect_is_the_integral_over_its_prior(misfit, fit):
    """By quadrature over the strength, every prediction computed anew."""
    one = candidate("quadratic_damping", scales_of(misfit.predictions))
    strength = fit.values[0] * np.linspace(0.5, 1.5, 41)
    rows, _ = misfit.evaluated(fit.labels, strength[:, None])
    shared = misfit.noise.shared
    covariance = np.eye(misfit.n_rows) + shared @ shared.T
    logs = multivariate_normal.logpdf(rows, cov=covariance)
    prior = halfcauchy.pdf(strength, scale=one.starts[0][0])
    truth = np.log(trapezoid(np.exp(logs - logs.max()) * prior, strength)) + logs.max()
    answer = marginal_of(misfit, fit)
    said = answer.rows.log_likelihood(1.0, np.ones(len(answer.group)))[0]
    assert said == pytest.approx(truth, abs=0.05)  # the peak is one per cent wide and nearly normal
    nothing = marginal_of(misfit, baseline_fit(misfit))
    assert nothing.rows.log_likelihood(1.0, np.ones(len(nothing.group)))[0] < said - 100


def test_a_fit_that_ended_early_is_not_credited_with_what_a_step_might_gain(misfit, fit):
    sizes = _sizes_of(misfit)
    moved = 4 / np.linalg.norm(misfit.noise.decorrelated(fit.slopes[:, 0]))  # 4σ
    away = fit._replace(rows=fit.rows + moved * fit.slopes[:, 0])
    ended, early = (log_evidence(marginal_of(misfit, one), sizes).right for one in (fit, away))
    assert ended - early == pytest.approx(8.0, abs=0.3)  # ½ 4²; the noise is free within 20 %
    lost = fit._replace(rows=np.full(misfit.n_rows, np.nan))
    assert marginal_of(misfit, lost) is None


def test_evidence_does_not_depend_on_the_size_of_noise_that_was_taken():
    """The same rows where no noise is stated, in units of noise twice as large."""
    made, rows = misfit_of(), noise(3)
    found = []
    for scale in (1.0, 2.0):
        predictions = made.predictions
        predictions.chosen.noise_stated, predictions.error_scale = False, scale
        marginal = marginal_of(made, fit_to(rows / scale))
        found.append(log_evidence(marginal, _sizes_of(made)).right)
    # A sum over noises of which either grid has others.
    assert found[0] == pytest.approx(found[1], abs=0.3)


def test_hat_functions_add_up_to_one_and_have_as_many_states_each():
    where = np.random.default_rng(6).lognormal(size=300)
    hats = hat_functions(where, 6)
    assert np.sum(hats, axis=1) == pytest.approx(1.0)
    assert hats.min() >= 0
    # Between two knots, where both their curves act, is a fifth of the states.
    between = np.sum(hats[:, 1:] * hats[:, :-1] > 0, axis=0)
    assert between == pytest.approx(np.full(5, 60), abs=2)


@pytest.mark.parametrize("harmonics", [False, True])
def test_discrepancies_have_the_size_of_the_noise(misfit, harmonics):
    if harmonics:
        data = balanced(quadratic)
        n = data.n_states
        data = dataclasses.replace(
            data,
            harmonic_order=(3,),
            harmonics=1e-3 * np.ones((n, 1, 1)) * np.asarray(data.velocity)[:, :, None],
            harmonic_std=0.01 * np.abs(np.asarray(data.velocity)),
        )
        misfit = weighted_misfit(predictions_of(linear_model(), data))
    sets = list(discrepancies(misfit))
    assert len(sets) == 3 + harmonics
    for columns in sets:
        assert len(columns) == misfit.n_rows
        square = np.sum(columns**2, axis=1)
        assert np.mean(square[square > 0]) == pytest.approx(1.0)


def test_a_smooth_misfit_that_no_effect_explains_is_one_of_an_unknown_law():
    """A force that is smooth along a level, and noise of the same size."""
    made = misfit_of()
    *_, along = discrepancies(made)
    sizes = _sizes_of(made)
    true = 3 * np.random.default_rng(8).normal(size=along.shape[1])
    for rows, better in ((noise(4) + along @ true, True), (noise(4), False)):
        fit = fit_to(rows)
        alone = marginal_of(made, fit)
        beside = marginal_of(made, fit, along)
        lead = log_evidence(beside, sizes).right - log_evidence(alone, sizes).right
        assert lead > 10 if better else -5 < lead < 0
        probabilities = weights_of(FoundEffects(made, fit, fit, (), ())).probabilities()
        assert (probabilities[UNKNOWN] > 0.9) == better


def test_an_answer_is_probable_and_all_add_up(damped):
    assert damped.effects == ("quadratic_damping",)
    assert sum(damped.probabilities.values()) == pytest.approx(1.0)
    assert max(damped.probabilities, key=damped.probabilities.get) == "quadratic_damping"
    assert damped.probabilities.get("none", 0.0) < 1e-6


def test_the_answer_given_has_the_probability_of_its_classes(damped):
    said = {("quadratic_damping",): 0.6, ("cubic_damping",): 0.3, ("unknown",): 0.1}
    classes = (("quadratic_damping", "cubic_damping"),)
    answer = damped.answer._replace(candidates=classes, probabilities=said)
    wider = dataclasses.replace(damped, answer=answer)
    assert wider.probability == pytest.approx(0.9)
    unknown = dataclasses.replace(wider, verdict=sj.diagnose.Verdict.UNKNOWN)
    assert unknown.probability == 0.1


def test_where_nothing_is_missing_that_is_the_most_probable():
    found = diagnosed(np.zeros_like)
    assert found.verdict == "none"
    assert found.probability == found.probabilities["none"] > 0.6


@pytest.mark.long
def test_a_law_that_no_effect_follows_leaves_unknown_probable():
    """Damping that rises and falls twice over the levels."""
    found = diagnosed(lambda velocity: 3 + 3 * np.sin(4 * np.log(velocity)))
    assert found.probabilities["unknown"] > 0.95
