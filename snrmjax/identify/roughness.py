"""How rough curves are along their amplitude: sizes of bends that change from one to the next."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from snrmjax.identify.level_scatter import Bends, Linearised

_VARIETY = 1.0  # 1σ of a size's logarithm about that of its curve, along the amplitude
_REACH = 2.0  # bends of a curve, over which sizes are alike
_NONE = 1e-6  # of the largest variance, a direction of the sizes that counts for nothing


def sizes_along(
    problem: Linearised,
    bends: Sequence[Bends],
    at: Sequence[Float[np.ndarray, " bend"]],
) -> list[Float[np.ndarray, " bend"]]:
    """1σ of every bend, curve by curve: the restricted likelihood's, with noise as stated.

    The logarithms of the sizes are each curve's own number plus a Gaussian process from bend to
    bend that all curves share: where the motion makes one of them turn, it does so with the
    others, and bends of two curves tell more of it than those of one. A curve's number and the
    process are the likeliest. A bend whose size is uncertain is expected to have the mean of the
    variances that it may have, so that little knowledge of the sizes does not narrow a band.
    Arguments: `problem` with a common size of the bends of a curve as their prior; `at` is the
    amplitude of every bend, in one unit for all curves, of which only the order counts.
    Reference: for the process, Goldberg, Williams & Bishop, Adv. Neural Inf. Process. Syst. 10
    (1997) 493; for bends of a size that varies, Ruppert & Carroll, Aust. N. Z. J. Stat. 42 (2000)
    205, doi:10.1111/1467-842X.00119.
    """
    of_curve = np.repeat(np.arange(len(bends)), [len(some.places) for some in bends])
    places = np.concatenate([some.places for some in bends])
    common = problem.prior_std[places]
    gram, pull = _of_bends(problem, places, common)
    from scipy.stats import rankdata  # takes as long to import as JAX

    # Counted in bends: levels lie closer where more happens.
    spread = _process(rankdata(np.concatenate(at)) / len(bends))
    columns = np.column_stack([of_curve[:, None] == np.arange(len(bends)), spread])
    n = len(bends)

    def criterion(point: np.ndarray) -> tuple[float, np.ndarray]:
        precision = np.exp(-2 * (columns @ point))
        inverse = np.linalg.inv(gram + np.diag(precision))
        bend = inverse @ pull
        determinant = np.linalg.slogdet(gram + np.diag(precision))[1]
        value = determinant - np.sum(np.log(precision)) - pull @ bend + point[n:] @ point[n:]
        slopes = 2 * columns.T @ (1 - (np.diagonal(inverse) + bend**2) * precision)
        slopes[n:] += 2 * point[n:]
        return float(value), slopes

    lowest = [np.log(some.ends[0] / problem.prior_std[some.places[0]]) for some in bends]
    highest = [np.log(some.ends[1] / problem.prior_std[some.places[0]]) for some in bends]
    free = [(None, None)] * spread.shape[1]
    start = np.zeros(columns.shape[1])
    limits = [*zip(lowest, highest, strict=True), *free]
    found = minimize(criterion, start, method="L-BFGS-B", jac=True, bounds=limits).x
    logarithm = columns @ found
    size = np.exp(logarithm)
    # Fisher's information of the logarithms: that of a Gaussian's variances.
    told = np.eye(len(size)) - np.linalg.inv(gram * np.outer(size, size) + np.eye(len(size)))
    information = spread.T @ (2 * told**2) @ spread + np.eye(spread.shape[1])
    variance = np.einsum("bi,ij,bj->b", spread, np.linalg.inv(information), spread)
    # The mean of the square of what is lognormal.
    expected = common * np.exp(logarithm + variance)
    return [expected[of_curve == k] for k in range(n)]


def _of_bends(
    problem: Linearised, places: np.ndarray, unit: Float[np.ndarray, " bend"]
) -> tuple[Float[np.ndarray, "bend bend"], Float[np.ndarray, " bend"]]:
    """JᵀJ of bends in some units, and Jᵀ·residuals, with all other unknowns at their best."""
    length = np.linalg.norm(problem.slopes, axis=0)
    others = (problem.prior_std > 0) & ((length > 0) | np.isfinite(problem.prior_std))
    others[places] = False
    x, prior = problem.slopes[:, others], np.diag(1.0 / problem.prior_std[others])
    stacked = np.vstack([x, prior])
    basis = np.linalg.qr(stacked / np.linalg.norm(stacked, axis=0))[0]
    both = np.column_stack([problem.slopes[:, places] * unit, problem.residuals])
    both = np.vstack([both, np.zeros((len(prior), both.shape[1]))])
    both = both - basis @ (basis.T @ both)
    left = both[:, -1]
    return both[:, :-1].T @ both[:, :-1], both[:, :-1].T @ left


def _process(at: Float[np.ndarray, " bend"]) -> Float[np.ndarray, "bend direction"]:
    """Directions of the sizes' logarithms, each of unit variance."""
    apart = (at[:, None] - at) / _REACH
    values, vectors = np.linalg.eigh(_VARIETY**2 * np.exp(-0.5 * apart**2))
    keep = values > _NONE * values[-1]
    return vectors[:, keep] * np.sqrt(values[keep])
