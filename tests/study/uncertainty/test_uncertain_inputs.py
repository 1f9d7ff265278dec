"""Distributions of uncertain inputs, against their own means and covariances."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from snrmjax.identify.calibrate.calibrated_model import CalibratedModel
from snrmjax.model.beams import curved_beam
from snrmjax.model.parameters import with_stated_std
from snrmjax.numerics.levenberg_marquardt import MinimisationStatus
from snrmjax.study.uncertainty.uncertain_inputs import (
    correlated_inputs,
    posterior_inputs,
    uncertain_inputs,
)

NAME = "mode_1.damping_ratio"


def test_inputs_have_the_mean_and_covariance_that_were_asked_for():
    mean = np.array([3.0, 0.05, 2.0, 400.0])
    correlation = np.array([[1, 0.6, 0, -0.3], [0.6, 1, 0, 0.2], [0, 0, 1, 0], [-0.3, 0.2, 0, 1]])
    std = np.array([0.3, 0.02, 0.5, 60.0])
    kinds = ("normal", "lognormal", "uniform", "lognormal")
    spread = correlation * np.outer(std, std)
    inputs = correlated_inputs(["a", "b", "c", "d"], mean, spread, kinds)
    z = stats.qmc.MultivariateNormalQMC(np.zeros(4), rng=np.random.default_rng(2)).random(2**15)
    values = np.asarray(jax.vmap(inputs.values)(z))
    # 2^15 members of a sequence: 1e-3 of a standard deviation.
    np.testing.assert_allclose((values.mean(axis=0) - mean) / std, 0, atol=1e-3)
    np.testing.assert_allclose(np.cov(values.T) / np.outer(std, std), correlation, atol=1e-2)
    half = np.sqrt(3) * std[2]
    for column, exact in (
        (0, stats.norm(3.0, 0.3)),
        (2, stats.uniform(2.0 - half, 2 * half)),
        (3, stats.lognorm(np.sqrt(np.log1p(0.15**2)), scale=400 / np.sqrt(1 + 0.15**2))),
    ):
        assert stats.kstest(values[:, column], exact.cdf).statistic < 2e-3
    assert not inputs.independent
    assert inputs.to_xarray()["std"].values == pytest.approx(std)
    assert "uncertain inputs: 4, some of them correlated" in repr(inputs)


def test_the_models_own_standard_deviations_are_the_default():
    model = with_stated_std(curved_beam(), ["mode_1.natural_frequency"], jnp.array([0.4]))
    inputs = uncertain_inputs(model)
    assert (inputs.names, inputs.std.tolist()) == (("mode_1.natural_frequency",), [0.4])
    assert inputs.mean == pytest.approx([2 * np.pi * 64.78], rel=1e-12)
    with pytest.raises(ValueError, match="states no standard deviation"):
        uncertain_inputs(curved_beam())


def test_a_calibration_gives_its_values_and_covariance():
    spread = np.array([[1e-6, 2e-5], [2e-5, 4e-3]])
    fields = {
        "model": curved_beam(),
        "values": np.array([0.05, 400.0]),
        "covariance": spread,
        "residuals": np.zeros((1, 2)),
        "state_converged": np.array([True]),
        "level_gain": np.zeros(1),
        "level_phase": np.zeros(1),
        "reduced_chi_square": 1.0,
        "names": (NAME, "mode_1.natural_frequency"),
        "noise_stated": True,
        "notes": (),
    }
    good = next(status for status in MinimisationStatus if status.found_minimum)
    inputs = posterior_inputs(CalibratedModel(status=good, **fields))
    assert inputs.factor @ inputs.factor.T == pytest.approx(spread, rel=1e-12)
    bad = next(status for status in MinimisationStatus if not status.found_minimum)
    with pytest.raises(ValueError, match="did not converge"):
        posterior_inputs(CalibratedModel(status=bad, **fields))


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (((), (), np.zeros((0, 0)), ("normal",)), "as many means"),
        ((("a", "a"), (1, 1), np.eye(2)), "given twice"),
        ((("a",), (1,), [[0.0]]), "positive variance"),
        ((("a",), (np.nan,), [[1.0]]), "finite mean"),
        ((("a",), (1,), [[1.0]], ("gamma",)), "must be one of"),
        ((("a",), (-1,), [[1.0]], ("lognormal",)), "is not positive"),
        ((("a", "b"), (1, 1), [[1, 2], [2, 1]]), "not positive definite"),
        ((("a", "b"), (1, 1), [[1, 0.5], [0.1, 1]]), "not symmetric"),
        ((("a", "b"), (1, 1), [[1, 0.5], [0.5, 1]], ("uniform", "normal")), "is uniform"),
        ((("a", "b"), (1, 1), [[4, -1], [-1, 4]], ("lognormal",) * 2), "no lognormal inputs"),
    ],
)
def test_impossible_distributions_are_refused(arguments, complaint):
    with pytest.raises(ValueError, match=complaint):
        correlated_inputs(*arguments)


@pytest.mark.parametrize(
    ("std", "settings", "complaint"),
    [
        ({"mode_1.dampening": 1.0}, {}, "mode_1.damping_ratio"),
        ({NAME: -0.1}, {}, "must be positive, but is -0.1"),
        ({NAME: 0.1}, {"force": 1.0}, "takes no `force`"),
        ({"force_n": 0.1}, {}, "needs `force`"),
        ({NAME: 0.1}, {"mean": {"force_n": 1.0}}, "`mean` names 'force_n'"),
        ({NAME: 0.1}, {"marginals": {"zeta": "normal"}}, "`marginals` names 'zeta'"),
    ],
)
def test_wrong_names_and_deviations_are_refused(std, settings, complaint):
    with pytest.raises(ValueError, match=complaint):
        uncertain_inputs(curved_beam(), std, **settings)
