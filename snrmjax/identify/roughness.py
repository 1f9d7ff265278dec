"""How rough curves are along their amplitude: bends that are alike, of sizes that change."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from snrmjax.identify.level_scatter import Bends, Linearised

_VARIETY = 1.0  # 1σ of a size's logarithm about that of its curve, along the amplitude
_REACH = 2.0  # bends of a curve, over which sizes are alike
_ALIKE = 0.8  # bends, over which those of a curve are alike
_NONE = 1e-6  # of the largest variance, a direction of the sizes that counts for nothing


def sizes_along(
    problem: Linearised,
    bends: Sequence[Bends],
    at: Sequence[Float[np.ndarray, " bend"]],
) -> list[Float[np.ndarray, " bend"]]:
    """1σ of every bend, curve by curve: the restricted likelihood's, with noise as stated.

    Bends that are neighbours are alike (`likeness`). The logarithms of their sizes are each curve's
    own number plus a Gaussian process from bend to bend that all curves share: where the motion
    makes one of them turn, it does so with the others, and bends of two curves tell more of it
    than those of one. A curve's number and the process are the likeliest. A bend whose size is
    uncertain is expected to have the mean of the
    variances that it may have, so that little knowledge of the sizes does not narrow a band.
    Arguments: `problem` with a common size of the bends of a curve as their prior; `bends` of a
    curve by rising amplitude; `at` is the amplitude of every bend, in one unit for all curves, of
    which only the order counts.
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

    alike = np.zeros((len(places), len(places)))
    for k, some in enumerate(bends):
        alike[np.ix_(of_curve == k, of_curve == k)] = likeness(len(some.places))
    unlike = np.linalg.inv(alike)

    def criterion(point: np.ndarray) -> tuple[float, np.ndarray]:
        logarithm = columns @ point
        precision = unlike * np.exp(-logarithm[:, None] - logarithm)
        inverse = np.linalg.inv(gram + precision)
        bend = inverse @ pull
        determinant = np.linalg.slogdet(gram + precision)[1] + 2 * np.sum(logarithm)
        value = determinant - pull @ bend + point[n:] @ point[n:]
        # Columns of a symmetric matrix: the diagonal of a product.
        known = np.sum(inverse * precision, axis=1)
        slopes = 2 * columns.T @ (1 - known - bend * (precision @ bend))
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
    told = unlike - unlike @ np.linalg.inv(gram * np.outer(size, size) + unlike) @ unlike
    share = alike @ told
    information = spread.T @ (share * share.T + told * (share @ alike)) @ spread
    information += np.eye(spread.shape[1])
    variance = np.einsum("bi,ij,bj->b", spread, np.linalg.inv(information), spread)
    # The mean of the square of what is lognormal.
    expected = common * np.exp(logarithm + variance)
    return [expected[of_curve == k] for k in range(n)]


def likeness(n_bends: int) -> Float[np.ndarray, "bend bend"]:
    """Correlation of the bends of one curve: what makes it bend does not end at the next level."""
    apart = np.subtract.outer(np.arange(n_bends), np.arange(n_bends)) / _ALIKE
    return np.exp(-0.5 * apart**2)


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
