"""How smooth curves are along their amplitude, and their columns in a linearised fit."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from snrmjax.identify.curves.families import PowerLaw, values_and_slopes
from snrmjax.identify.curves.family_base import AbstractFamily
from snrmjax.identify.curves.splines import SmoothingSpline, bent
from snrmjax.identify.joint.variance_components import Bends, Linearised

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


class CurveColumns(NamedTuple):
    """A curve where its priors have it, and its derivatives by what may move it."""

    values: Float[np.ndarray, " point"]
    slopes: Float[np.ndarray, "point unknown"]
    prior_std: Float[np.ndarray, " unknown"]  # infinite where there is no prior


def curve_columns(curve: AbstractFamily, at: Float[np.ndarray, " point"]) -> CurveColumns:
    """Of a smoothing spline the unknowns are a straight line and bends, else the parameters.

    A power law is straightened where it is, and drawn for the mean of what its exponent may be.
    """
    values, slopes = values_and_slopes(curve, at)
    if isinstance(curve, PowerLaw):
        middle = values - slopes[:, 2] * float(curve.parameters[2])
        return CurveColumns(middle, slopes, np.array([np.inf, np.inf, curve.odds_std]))
    if not isinstance(curve, SmoothingSpline):
        return CurveColumns(values, slopes, np.full(slopes.shape[1], np.inf))
    parts = bent(curve)
    return CurveColumns(slopes @ parts.straight, slopes @ parts.both, parts.prior_std)


def places_of_bends(
    curve: SmoothingSpline,
    displacement: Float[np.ndarray, " point"],
    speed: Float[np.ndarray, " point"],
) -> Float[np.ndarray, " bend"]:
    """Displacements where a curve may bend; those of one of velocity by the states near them."""
    at = float(curve.scale) * np.sqrt(np.asarray(curve.knots)[1:-1])
    if curve.argument == "velocity":
        order = np.argsort(speed)
        return np.interp(at, speed[order], displacement[order])
    return at


def with_sizes(curve: SmoothingSpline, size: Float[np.ndarray, " bend"]) -> SmoothingSpline:
    """A curve with bends of these sizes, alike from one to the next, and not yet otherwise.

    Its bends are then combinations of them that are independent, each in its own 1σ.
    """
    root = np.linalg.cholesky(likeness(len(size))) * size[:, None]
    bends = np.linalg.solve(root, np.asarray(curve.bends))
    return dataclasses.replace(curve, bends=jnp.asarray(bends), bend_std=jnp.ones(len(size)))


def moved(curve: AbstractFamily, change: Float[np.ndarray, " unknown"]) -> AbstractFamily:
    """A curve after a change of what `curve_columns` calls its unknowns."""
    if isinstance(curve, SmoothingSpline):
        parts = bent(curve)
        values = parts.straight + parts.both @ change
    else:
        known = [1.0, 1.0, 0.0] if isinstance(curve, PowerLaw) else 1.0
        values = np.asarray(curve.parameters) * np.array(known) + change
    return dataclasses.replace(curve, parameters=jnp.asarray(values))
