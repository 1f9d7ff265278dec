"""The evidence and the posterior of laws, against the same Gaussians written out in full."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal, truncnorm

from snrmjax.diagnose import priors
from snrmjax.diagnose.laws.law_prior import (
    PARTS,
    LawProblem,
    Process,
    _gaussian,
    _not_negative,
    _table,
    best_processes,
    law_prior,
)

KNOTS = np.log(np.geomspace(0.1, 1.0, 6))
RNG = np.random.default_rng(3)
COLUMNS = {name: RNG.normal(size=(30, 6)) for name in PARTS}
ROWS = RNG.normal(size=30) + COLUMNS["displacement_damping"] @ np.linspace(0.5, 1.0, 6)


def problem(rows=ROWS):
    whole = np.concatenate(list(COLUMNS.values()), axis=1)
    places = dict.fromkeys(PARTS, KNOTS)
    return LawProblem(whole.T @ whole, -whole.T @ rows, float(rows @ rows), places)


PAIR = ("displacement_damping", "odd_spring"), (Process(2.0, 1.4), Process(0.5, 0.7))


def full_covariance(parts, processes):
    root = law_prior(problem(), parts, processes)
    arms = np.concatenate([COLUMNS[part] for part in parts], axis=1) @ root
    return np.eye(30) + arms @ arms.T


@pytest.mark.parametrize(("parts", "processes"), [PAIR, (PAIR[0][:1], PAIR[1][:1])])
def test_the_cost_is_that_of_the_full_gaussian(parts, processes):
    alone = multivariate_normal(np.zeros(30), np.eye(30)).logpdf(ROWS)
    with_law = multivariate_normal(np.zeros(30), full_covariance(parts, processes)).logpdf(ROWS)
    found = _gaussian(problem(), parts, processes)
    assert found.cost == pytest.approx(2 * (alone - with_law), abs=1e-8)
    # The same number stands in the table of sizes and reaches, others beside it or not.
    for k, process in enumerate(processes):
        place = (
            priors.LAW_REACHES.index(process.reach),
            priors.LAW_SIZES.tolist().index(process.size),
        )
        assert _table(problem(), parts, processes, k)[place] == pytest.approx(found.cost, abs=1e-8)


def test_the_posterior_is_that_of_the_joint_gaussian():
    parts, processes = PAIR
    root = law_prior(problem(), parts, processes)
    prior = root @ root.T
    arms = np.concatenate([COLUMNS[part] for part in parts], axis=1)
    # rows = −arms w + noise, conditioned as any joint Gaussian.
    gain = -prior @ arms.T @ np.linalg.inv(full_covariance(parts, processes))
    found = _gaussian(problem(), parts, processes)
    np.testing.assert_allclose(found.mean, gain @ ROWS, atol=1e-9)
    np.testing.assert_allclose(found.covariance, prior + gain @ arms @ prior, atol=1e-8)


def test_a_part_that_is_not_there_costs_and_one_that_is_gains():
    strong = problem(
        RNG.normal(size=30) - COLUMNS["displacement_damping"] @ np.linspace(1.0, 2.0, 6)
    )
    noise = problem(RNG.normal(size=30))
    assert best_processes(strong, ("displacement_damping",))[1] < -50.0
    assert best_processes(noise, ("odd_spring",))[1] > 0.0
    both = best_processes(strong, ("displacement_damping", "odd_spring"))[1]
    assert both > best_processes(strong, ("displacement_damping",))[1]


def test_entries_that_must_not_be_negative_have_the_truncated_mean():
    mean, std = np.array([-0.5, 1.0]), np.array([1.0, 2.0])
    found, covariance = _not_negative(mean, np.diag(std**2), np.array([True, False]))
    truth = truncnorm(0.5, np.inf, loc=-0.5, scale=1.0)
    # 270 samples: four errors of a mean.
    assert found[0] == pytest.approx(truth.mean(), abs=4 * truth.std() / np.sqrt(270))
    assert found[1] == pytest.approx(1.0, abs=4 * 2.0 / np.sqrt(270))
    assert np.sqrt(covariance[0, 0]) == pytest.approx(truth.std(), rel=0.2)
