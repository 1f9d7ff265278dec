import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from snrmjax.study.sampling import Sampling, drawn_members, member_seed, number_of_members
from snrmjax.study.variations import (
    Discrete,
    LogNormal,
    MultivariateNormal,
    Normal,
    Uniform,
)

MEAN, COVARIANCE = np.array([3.0, -1.0]), np.array([[0.04, 0.03], [0.03, 0.09]])


def test_a_grid_is_every_combination_with_the_last_quantity_fastest():
    varied = (Discrete("a", [1.0, 2.0]), Uniform("b", 0.0, 1.0, 3))
    rows = drawn_members(varied, Sampling("grid"), 0)
    expected = [[1, 0], [1, 0.5], [1, 1], [2, 0], [2, 0.5], [2, 1]]
    np.testing.assert_array_equal(rows, expected)


def test_a_list_takes_the_values_side_by_side():
    varied = (Discrete("a", [1.0, 2.0]), Discrete("b", [5.0, 7.0]))
    np.testing.assert_array_equal(drawn_members(varied, Sampling("list"), 0), [[1, 5], [2, 7]])


@pytest.mark.parametrize("method", ["latin_hypercube", "sobol", "random"])
def test_samples_follow_their_distributions(method):
    varied = (
        Uniform("a", -1.0, 3.0),
        Normal("b", 2.0, 0.5),
        LogNormal("c", 4.0, 2.0),
        MultivariateNormal(["d", "e"], MEAN, COVARIANCE),
    )
    rows = drawn_members(varied, Sampling(method, 4000), 11)
    # Of the quantity itself: scipy's lognormal by the mean and deviation of its logarithm.
    spread = np.sqrt(np.log(1 + (2.0 / 4.0) ** 2))
    laws = [
        stats.uniform(-1.0, 4.0),
        stats.norm(2.0, 0.5),
        stats.lognorm(spread, scale=4.0 * np.exp(-(spread**2) / 2)),
        stats.norm(3.0, 0.2),
        stats.norm(-1.0, 0.3),
    ]
    for column, law in zip(rows.T, laws, strict=True):
        assert stats.kstest(column, law.cdf).pvalue > 1e-3
    # Its standard error is (1 − ρ²)/√n = 0.012.
    assert np.corrcoef(rows[:, 3], rows[:, 4])[0, 1] == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize(
    "one",
    [
        Uniform("a", -1.0, 3.0),
        Normal("b", 2.0, 0.5),
        LogNormal("c", 4.0, 2.0),
        MultivariateNormal(["d", "e"], MEAN, COVARIANCE),
    ],
    ids=["uniform", "normal", "lognormal", "joint"],
)
def test_what_derivatives_are_taken_by_is_what_members_are_drawn_from(one):
    unit = np.random.default_rng(0).random((50, len(one.names)))
    values = one.at(jnp.asarray(stats.norm.ppf(unit)))
    np.testing.assert_allclose(values, one.quantiles(unit), rtol=1e-12)


def test_values_in_a_sample_are_taken_equally_often():
    rows = drawn_members((Discrete("a", [1.0, 2.0, 4.0]),), Sampling("latin_hypercube", 300), 0)
    assert np.unique(rows, return_counts=True)[1].tolist() == [100, 100, 100]


def test_the_seed_decides_and_nothing_else():
    varied = (Uniform("a", 0.0, 1.0),)
    first = drawn_members(varied, Sampling("sobol", 10), 1)
    np.testing.assert_array_equal(first, drawn_members(varied, Sampling("sobol", 10), 1))
    assert not np.array_equal(first, drawn_members(varied, Sampling("sobol", 10), 2))
    assert len({member_seed(3, k) for k in range(1000)}) == 1000
    assert member_seed(3, 7) == member_seed(3, 7) != member_seed(4, 7)


@pytest.mark.parametrize(
    ("varied", "sampling", "words"),
    [
        ((), Sampling("grid"), "at least one quantity"),
        ((Uniform("a", 0, 1),), Sampling("grid"), "a has a distribution"),
        ((Uniform("a", 0, 1),), Sampling("sobol"), "needs `members`"),
        ((Discrete("a", [1.0, 2.0]),), Sampling("grid", 3), "has 2 members"),
        ((Discrete("a", [1.0]), Discrete("b", [1.0, 2.0])), Sampling("list"), "a 1, b 2"),
        (tuple(Uniform(n, 0, 1, 10**6) for n in "ab"), Sampling("grid"), "1e+12"),
    ],
)
def test_members_that_make_no_sense_are_refused_before_they_are_drawn(varied, sampling, words):
    with pytest.raises(ValueError, match=words.replace("+", r"\+")):
        number_of_members(varied, sampling)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Discrete("a", []), "at least one number"),
        (lambda: Discrete("a", [1.0, np.nan]), "must be finite"),
        (lambda: Uniform("a", 2.0, 2.0), "must rise"),
        (lambda: Uniform("a", 0.0, 1.0, 1), "`points` of a"),
        (lambda: Normal("a", 0.0, -1.0), "`std` of a must be positive"),
        (lambda: LogNormal("a", -1.0, 1.0), "`mean` of a must be positive"),
        (lambda: MultivariateNormal(["a", "b"], MEAN, np.eye(3)), "2 by 2"),
        (lambda: MultivariateNormal(["a", "b"], MEAN, np.diag([1.0, -1.0])), "variance of b"),
        (lambda: MultivariateNormal(["a", "b"], MEAN, [[1.0, 2.0], [2.0, 1.0]]), "semidefinite"),
        (lambda: MultivariateNormal(["a", "b"], MEAN, [[1.0, 0.5], [0.1, 1.0]]), "symmetric"),
    ],
)
def test_variations_that_make_no_sense_are_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()
