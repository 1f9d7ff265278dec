"""Bends of a size that changes along the amplitude: against the likelihood written out in full."""

import numpy as np
from scipy.linalg import block_diag, null_space
from scipy.optimize import minimize

from snrmjax.identify.joint.smoothness import likeness, sizes_along
from snrmjax.identify.joint.variance_components import Bends, Linearised

N = 12
AT = np.linspace(-2.5, 0.0, N)  # logarithms of amplitude
ENDS = (1e-6, 1e3)


def turning(at):
    """Sizes of bends that are large near one amplitude."""
    return 0.05 + np.exp(-(((at + 1.0) / 0.4) ** 2))


def linearised(seed, sizes, noise, units=(1.0, 1.0)):
    """Readings of two curves of bends of some sizes, with offsets that every third one shares."""
    rng = np.random.default_rng(seed)
    n_rows = 3 * N
    place = np.linspace(0.0, 1.0, n_rows)
    line = np.column_stack([np.ones(n_rows), place])
    bent = np.maximum(place[:, None] - np.linspace(0.05, 0.9, N), 0.0) * 6
    shared = np.eye(3)[np.arange(2 * n_rows) % 3]
    first, second = (np.column_stack([line, bent * unit]) for unit in units)
    bends = [np.linalg.cholesky(likeness(N)) @ rng.normal(size=N) * sizes for _ in range(2)]
    read = np.r_[bent @ bends[0], bent @ bends[1]] + shared @ (0.1 * rng.normal(size=3))
    read += noise * rng.normal(size=2 * n_rows)
    slopes = np.hstack([block_diag(first, second), shared]) / noise
    free = np.full(2, np.inf)
    prior = np.r_[free, np.full(N, 0.3 / units[0]), free, np.full(N, 0.3 / units[1])]
    prior = np.r_[prior, np.full(3, 0.1)]
    places = [2 + np.arange(N), N + 4 + np.arange(N)]
    problem = Linearised(-read / noise, slopes, prior, np.zeros(len(prior)))
    return problem, [
        Bends(p, (ENDS[0] / u, ENDS[1] / u)) for p, u in zip(places, units, strict=True)
    ]


def written_out(problem, bends):
    """The same from the density of what straight lines leave of the readings."""
    infinite = np.isinf(problem.prior_std)
    contrast = null_space(problem.slopes[:, infinite].T).T
    data = contrast @ problem.residuals
    arms = [contrast @ problem.slopes[:, some.places] for some in bends]
    fixed = ~infinite
    for some in bends:
        fixed[some.places] = False
    rest = contrast @ problem.slopes[:, fixed] * problem.prior_std[fixed]
    rest = np.eye(len(data)) + rest @ rest.T
    root = np.linalg.cholesky(
        np.exp(-0.5 * ((np.arange(N)[:, None] - np.arange(N)) / 2.0) ** 2) + 1e-9 * np.eye(N)
    )

    def logarithms(point):
        start = np.log([problem.prior_std[some.places[0]] for some in bends])
        return [start[k] + point[k] + root @ point[2:] for k in range(2)]

    def own(size):
        return likeness(N) * np.outer(size, size)

    def covariance(sizes):
        return rest + sum(a @ own(s) @ a.T for a, s in zip(arms, sizes, strict=True))

    def criterion(point):
        v = covariance(np.exp(logarithms(point)))
        value = data @ np.linalg.solve(v, data) + np.linalg.slogdet(v)[1]
        return value + point[2:] @ point[2:]

    point = minimize(criterion, np.zeros(2 + N), method="BFGS", options={"gtol": 1e-5}).x
    sizes = np.exp(logarithms(point))
    inverse = np.linalg.inv(covariance(sizes))
    by = [
        sum(a @ (own(s) * np.add.outer(root[:, j], root[:, j])) @ a.T
            for a, s in zip(arms, sizes, strict=True))
        for j in range(N)
    ]  # fmt: skip
    half = [inverse @ slope for slope in by]
    information = np.array([[0.5 * np.sum(p * q.T) for q in half] for p in half])
    variance = np.diagonal(root @ np.linalg.inv(information + np.eye(N)) @ root.T)
    return sizes * np.exp(variance)


def test_sizes_are_those_of_the_likelihood_written_out():
    problem, bends = linearised(1, turning(AT), 0.05)
    found = np.array(sizes_along(problem, bends, [AT, AT]))
    # Two minimisations, each to about 1e-3 of a size's own uncertainty.
    np.testing.assert_allclose(found, written_out(problem, bends), rtol=5e-3)


def test_sizes_do_not_depend_on_units():
    ours = np.array(sizes_along(*linearised(2, turning(AT), 0.05), [AT, AT]))
    other = np.array(sizes_along(*linearised(2, turning(AT), 0.05, (1e3, 1e-4)), [AT, AT]))
    np.testing.assert_allclose(other * [[1e3], [1e-4]], ours, rtol=1e-3)


def test_bends_are_larger_where_the_curve_turns():
    found = [
        np.array(sizes_along(*linearised(seed, turning(AT), 0.01), [AT, AT])) for seed in range(20)
    ]
    middle = np.abs(AT + 1.0) < 0.15
    ratio = np.log(found)[:, :, middle].mean() - np.log(found)[:, :, AT < -1.6].mean()
    # Twenty tests tell sizes to 5 %; the process draws them together.
    truth = np.log(turning(AT))[middle].mean() - np.log(turning(AT))[AT < -1.6].mean()
    assert 0.6 * truth < ratio < 1.05 * truth


def test_sizes_of_which_nothing_is_told_are_the_mean_of_what_they_may_be():
    found = np.array(sizes_along(*linearised(4, turning(AT), 1e5), [AT, AT]))
    # Logarithms of unit variance about the common size: the mean square is e² times as large.
    np.testing.assert_allclose(found, 0.3 * np.e, rtol=1e-3)


def test_only_the_order_of_amplitudes_counts():
    problem, bends = linearised(5, turning(AT), 0.05)
    ours = sizes_along(problem, bends, [AT, AT])
    np.testing.assert_array_equal(sizes_along(problem, bends, [np.exp(AT)] * 2), ours)
