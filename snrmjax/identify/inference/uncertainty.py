"""How sure a joint fit is: by implicit derivatives, profiles, resampling and sampling."""

from enum import IntEnum
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from snrmjax.identify.curves.family_base import AbstractFamily
from snrmjax.identify.inference.fitted_curves import (
    curve_values,
    displacement_near,
    open_choice,
    values_at_displacement,
    values_with_slopes,
)
from snrmjax.identify.joint.force_balance import (
    LEVEL_ERRORS,
    STATE_ERRORS,
    BalanceData,
    Spread,
    Unknowns,
    slopes_by_error,
    weighing_at,
)
from snrmjax.identify.joint.free_unknowns import Restore
from snrmjax.identify.joint.joint_fit import (
    SOLVER,
    JointFit,
)
from snrmjax.identify.joint.level_slopes import on_levels
from snrmjax.identify.joint.residuals import (
    all_residuals,
    freed_of_errors,
    freed_residuals,
    whitened,
)
from snrmjax.model.modes import LinearModes
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.least_squares import inverse_of

_PIN = 1e4  # weight, in its own 1σ, with which a profile holds an unknown
_RISE = 3.84  # of χ² at the ends of a 95 % interval


class Sensitivity(NamedTuple):
    """Derivatives of the free unknowns by everything that was measured or stated."""

    by_measurement: Float[np.ndarray, "unknown state error"]  # of `STATE_ERRORS`, relative or rad
    by_prior: Float[np.ndarray, "unknown prior"]  # levels, linear parameters, bends; per 1σ
    covariance: Float[np.ndarray, "unknown unknown"]  # what follows from both


class Contribution(NamedTuple):
    """What one source of error contributes to the band of a curve."""

    source: str
    frequency_share: float  # of the variance of ω̃, mean over amplitudes
    damping_share: float  # of the variance of 2ζ̃ω̃
    kind: str  # of source: what all levels, or all linear parameters, have in common


class IntervalEnd(IntEnum):
    """How an end of a profile's 95 % interval is known."""

    BRACKETED = 0  # between two values whose refits converged
    BEYOND_REACH = 1  # χ² rises by less than 3.84 up to the last value tried: farther away
    NOT_COMPUTED = 2  # the refits that would bracket it failed


END_MESSAGE: dict[IntervalEnd, str] = {
    IntervalEnd.BRACKETED: "between two computed values",
    IntervalEnd.BEYOND_REACH: "beyond the values tried: ask for a larger `reach`",
    IntervalEnd.NOT_COMPUTED: "not computed: the refits that would bracket it failed",
}


class Profile(NamedTuple):
    """The best fit's cost against one unknown, the others fitted anew."""

    name: str
    values: Float[np.ndarray, " point"]
    rise: Float[np.ndarray, " point"]  # of χ² over its least value; NaN where the refit failed
    lower: float  # 95 %, where the rise is 3.84; −∞ beyond the values tried, NaN not computed
    upper: float  # likewise, +∞
    lower_status: IntervalEnd
    upper_status: IntervalEnd


def sensitivity(fit: JointFit) -> Sensitivity:
    """Derivatives of the fit by every measured force, velocity and phase, second order included.

    At the minimum of χ²(θ, data) the implicit function theorem gives dθ/dy = −H⁻¹ ∂²χ²/∂θ∂y with
    the whole Hessian H, where Gauss and Newton leave out the residuals' curvature; the covariance
    of independent errors of the stated size follows. Where states are freed of their errors, they
    are so anew; else weights count as given.

    What the residuals of neighbours have in common is not in it.

    Returns a `Sensitivity`. One call costs about as much as a fit.
    """
    vector, restore = fit.vector()
    settings = (vector, restore, fit.data, fit.modes, fit.spread)
    hessian, mixed = _second_order(*settings, np.array(fit.freed))
    # In units of the unknowns' own curvature: a value at rest may be known a million times worse.
    curvature = np.diagonal(np.asarray(hessian))
    unit = 1 / np.sqrt(np.where(curvature > 0, curvature, 1.0))
    scaled = np.asarray(hessian) * np.outer(unit, unit)
    inverse = np.linalg.pinv(scaled, rcond=1e-13, hermitian=True) * np.outer(unit, unit)
    p, n = len(vector), len(fit.data.level)
    by_state = -inverse @ np.asarray(mixed).reshape(p, -1)
    n_priors = fit.data.n_levels * len(LEVEL_ERRORS) + len(fit.unknowns.linear)
    by_bends = inverse @ _bend_slopes(fit).T
    by_prior = np.concatenate([inverse[:, p - n_priors :], by_bends], axis=1)
    spread = by_state * np.asarray(fit.data.std).reshape(-1)
    return Sensitivity(
        by_measurement=by_state.reshape(p, n, len(STATE_ERRORS)),
        by_prior=by_prior,
        covariance=spread @ spread.T + by_prior @ by_prior.T,
    )


@compiled
def _second_order(
    vector: Array,
    restore: Restore,
    data: BalanceData,
    modes: LinearModes,
    spread: Spread,
    freed: Array,
) -> tuple[Array, Array]:
    weighing = weighing_at(restore(vector), data, modes, spread)

    def anew(unknowns: Unknowns, error: Array) -> Array:
        """Records that err by so much, freed of their likeliest errors again."""
        velocity = data.velocity * jnp.exp(error[:, 1] + 1j * error[:, 2])
        records = (data.force * jnp.exp(error[:, 0]), velocity, data.correction - error)
        erring = eqx.tree_at(lambda d: (d.force, d.velocity, d.correction), data, records)
        errors, own = freed_of_errors(unknowns, erring, modes, spread)
        erring = eqx.tree_at(lambda d: d.correction, erring, errors)
        return whitened(unknowns, erring, modes, spread, own)

    def as_it_is(unknowns: Unknowns, error: Array) -> Array:
        erring = eqx.tree_at(lambda d: d.correction, data, data.correction + error)
        return whitened(unknowns, erring, modes, spread, weighing)

    def gradient(vector: Array, error: Array) -> Array:
        def cost(vector: Array) -> Array:
            unknowns = restore(vector)
            points = jax.lax.cond(freed, anew, as_it_is, unknowns, error)
            curves = (unknowns.squared_frequency, unknowns.modal_damping)
            priors = jnp.sum(unknowns.level**2) + jnp.sum(unknowns.linear**2)
            priors = priors + sum(jnp.sum(c.prior_residuals() ** 2) for c in curves)
            return 0.5 * (jnp.sum(points**2) + priors)

        return jax.grad(cost)(vector)

    none = jnp.zeros((len(data.level), len(STATE_ERRORS)))
    hessian = jax.jacfwd(gradient)(vector, none)
    # Every state's errors enter its own residuals: one pull back for each unknown.
    mixed = jax.jacrev(gradient, argnums=1)(vector, none)
    return hessian, mixed


def _bend_slopes(fit: JointFit) -> Float[np.ndarray, "row unknown"]:
    """Derivatives, by the unknowns, of what is expected near zero of both curves."""

    def of(curve: AbstractFamily, parameters: Array) -> Array:
        return eqx.tree_at(lambda f: f.parameters, curve, parameters).prior_residuals()

    begin, blocks = 0, []
    for curve in (fit.unknowns.squared_frequency, fit.unknowns.modal_damping):
        slopes = np.asarray(jax.jacfwd(of, argnums=1)(curve, curve.parameters))
        end = begin + slopes.shape[1]
        blocks.append(np.pad(slopes, ((0, 0), (begin, len(fit.covariance) - end))))
        begin = end
    return np.concatenate(blocks)


def contributions(fit: JointFit, *, n_amplitudes: int = 25) -> list[Contribution]:
    """What noise, every level's errors and every linear parameter add to the bands of both curves.

    To first order, as the fit's own covariance: (JᵀJ)⁻¹ = Σ (dθ/dy σ)² over every error y, with
    dθ/dy = −(JᵀJ)⁻¹Jᵀ ∂r/∂y and weights that go along with the error; what the residuals of
    neighbours have in common adds to it, and what the choice among families leaves open.

    Returns shares of the variance between the smallest and the largest measured displacement,
    largest first; they sum to one but for rounding.
    """
    vector, restore = fit.vector()
    found = _first_order(vector, restore, fit.data, fit.modes, fit.spread)
    jacobian, by_error = np.asarray(found[0]), np.asarray(found[1])
    p, n, n_levels = len(vector), len(fit.data.level), fit.data.n_levels
    inverse = inverse_of(jacobian)
    points = jacobian[: 2 * n].reshape(n, 2, p)
    by_state = np.einsum("pq,siq,sie->pse", inverse, points, by_error) * np.asarray(fit.data.std)
    measured = np.asarray(fit.motion().displacement)
    at = np.linspace(measured.min(), measured.max(), n_amplitudes)
    slopes = values_at_displacement(fit, at)[1]

    rows: list[tuple[str, str, np.ndarray]] = []
    for k, kind in enumerate(STATE_ERRORS):
        if np.any(by_state[:, :, k]):
            name = f"random error of {kind}"
            rows.append((name, name, by_state[:, :, k]))
    n_linear = len(fit.unknowns.linear)
    levels = inverse[:, p - n_linear - n_levels * len(LEVEL_ERRORS) : p - n_linear]
    levels = levels.reshape(p, n_levels, len(LEVEL_ERRORS))
    for k, kind in enumerate(LEVEL_ERRORS):
        if fit.level_std[k] > 0:
            rows += [
                (f"{kind} of level {m + 1}", f"{kind} of levels", levels[:, m, k : k + 1])
                for m in range(n_levels)
            ]
    for k in range(n_linear):
        column = inverse[:, p - n_linear + k]
        if fit.spread.linear[k] > 0:
            rows.append((f"linear parameter {k + 1}", "linear parameters", column[:, None]))
    name = "smoothness of the curves"
    rows.append((name, name, inverse @ _bend_slopes(fit).T))
    if np.any(fit.neighbour_correlation > 0):
        name = "misfits that neighbours share"
        unit = np.sqrt(np.diagonal(inverse))
        added = (fit.covariance - inverse) / np.outer(unit, unit)
        values, directions = np.linalg.eigh(added)
        rows.append((name, name, unit[:, None] * directions * np.sqrt(np.maximum(values, 0.0))))
    summed = [np.sum((slopes @ columns) ** 2, axis=2) for *_, columns in rows]
    if fit.rivals:
        name = "choice of the families"
        rows.append((name, name, np.ones((p, 1))))
        summed.append(np.sum(open_choice(fit, displacement=at) ** 2, axis=0))
    parts = np.stack(summed)
    shares = np.mean(parts / np.sum(parts, axis=0), axis=1).tolist()
    listed = [
        Contribution(source, share[0], share[1], kind)
        for (source, kind, columns), share in zip(rows, shares, strict=True)
        if columns.shape[1]
    ]
    return sorted(listed, key=lambda row: -row.frequency_share - row.damping_share)


@compiled
def _first_order(
    vector: Array, restore: Restore, data: BalanceData, modes: LinearModes, spread: Spread
) -> tuple[Array, Array]:
    """Slopes of the residuals by the unknowns, and of the states' by their own errors."""
    slopes = slopes_by_error(restore(vector), data, modes, spread)
    weighing = weighing_at(restore(vector), data, modes, spread)
    given = (restore, data, modes, spread, weighing)
    jacobian = jax.jacfwd(lambda v: all_residuals(v, *given))(vector)
    return jacobian, jnp.sqrt(data.weight)[:, None, None] * (weighing.whiten @ slopes)


def profile(fit: JointFit, name: str, *, n_points: int = 15, reach: float = 3.5) -> Profile:
    """χ² against one unknown, everything else fitted anew at each of its values.

    Where the interval differs from ±1.96σ the unknown is not quadratic: believe the profile. It
    takes states for independent, though: where the residuals of neighbours are alike
    (`fit.neighbour_correlation`), it is too narrow, and ±1.96σ is right.

    Arguments: `name` one of `fit.names()`; `reach` in standard deviations on either side.
    Raises `ValueError` for a name that the fit does not have.
    """
    names = fit.names()
    if name not in names:
        raise ValueError(f"the fit has no unknown {name!r}; it has {', '.join(names[:6])}, …")
    index, (vector, restore) = names.index(name), fit.vector()
    std = np.sqrt(np.diag(fit.covariance))
    offsets = np.linspace(-reach, reach, n_points | 1)
    values = float(vector[index]) + std[index] * offsets
    cost = np.asarray(
        _pinned(
            *(vector, restore, fit.data, fit.modes, fit.spread),
            *(np.array(fit.freed), jnp.asarray(std), np.array(index), jnp.asarray(values)),
        )
    )
    middle = len(cost) // 2
    # The value in the middle is the fit's own.
    rise = cost - cost[middle]
    below, below_status = _crossing(values[middle::-1], rise[middle::-1])
    above, above_status = _crossing(values[middle:], rise[middle:])
    return Profile(name, values, rise, below, above, below_status, above_status)


def _crossing(values: np.ndarray, rise: np.ndarray) -> tuple[float, IntervalEnd]:
    """Where the rise first passes 3.84, going outwards from the fit's own value.

    Values at which the refit failed are left out: neighbours that were computed bracket the end.
    """
    known = np.isfinite(rise)
    outside = np.flatnonzero(rise[known] >= _RISE)
    if outside.size and outside[0] > 0:
        pair = slice(outside[0] - 1, outside[0] + 1)
        end = np.interp(_RISE, rise[known][pair], values[known][pair])
        return float(end), IntervalEnd.BRACKETED
    if known[-1] and known[0]:
        return float(np.sign(values[-1] - values[0]) * np.inf), IntervalEnd.BEYOND_REACH
    return float("nan"), IntervalEnd.NOT_COMPUTED


@compiled
def _pinned(
    vector: Array,
    restore: Restore,
    data: BalanceData,
    modes: LinearModes,
    spread: Spread,
    freed: Array,
    std: Array,
    index: Array,
    values: Array,
) -> Float[Array, " value"]:
    weighing = weighing_at(restore(vector), data, modes, spread)
    unit = jnp.where(std > 0, std, 1.0)

    def one(value: Array) -> Array:
        def residuals(y: Array, _: None = None) -> Array:
            point = vector + y * unit
            free = freed_residuals(point, restore, data, modes, spread, weighing, freed)
            held = _PIN * (point[index] - value) / unit[index]
            return jnp.append(free, held)

        start = jnp.zeros_like(vector).at[index].set((value - vector[index]) / unit[index])
        found: optx.Solution = optx.least_squares(
            residuals, SOLVER, start, max_steps=200, throw=False
        )
        good = found.result == optx.RESULTS.successful
        return jnp.where(good, jnp.sum(residuals(found.value)[:-1] ** 2), jnp.nan)

    return jax.lax.map(one, values)


def bootstrap(
    fit: JointFit, n_samples: int = 200, *, seed: int = 0, levels: bool = False
) -> Float[np.ndarray, "sample unknown"]:
    """Unknowns of refits to states drawn with replacement, within every level.

    With `levels` whole levels are drawn instead, which needs more of them than a curve has
    parameters. A refit that fails is NaN.
    """
    rng = np.random.default_rng(seed)
    level = np.asarray(fit.data.level)
    weights = np.zeros((n_samples, len(level)))
    for row in weights:
        if levels:
            drawn = rng.integers(fit.data.n_levels, size=fit.data.n_levels)
            row += np.bincount(drawn, minlength=fit.data.n_levels)[level]
        else:
            for number in range(fit.data.n_levels):
                mine = np.flatnonzero(level == number)
                np.add.at(row, rng.choice(mine, size=mine.size), 1.0)
    vector, restore = fit.vector()
    std = jnp.asarray(np.sqrt(np.diag(fit.covariance)))
    weights = weights * np.asarray(fit.data.weight)
    settings = (vector, restore, fit.data, fit.modes, fit.spread, np.array(fit.freed), std)
    return np.asarray(_resampled(*settings, jnp.asarray(weights)))


@compiled
def _resampled(
    vector: Array,
    restore: Restore,
    data: BalanceData,
    modes: LinearModes,
    spread: Spread,
    freed: Array,
    std: Array,
    weights: Array,
) -> Float[Array, "sample unknown"]:
    weighing = weighing_at(restore(vector), data, modes, spread)
    unit = jnp.where(std > 0, std, 1.0)

    def one(weight: Array) -> Array:
        given = (eqx.tree_at(lambda d: d.weight, data, weight), modes, spread, weighing, freed)
        found: optx.Solution = optx.least_squares(
            lambda y, _: freed_residuals(vector + y * unit, restore, *given),
            *(on_levels(SOLVER, restore, data), jnp.zeros_like(vector)),
            max_steps=200,
            throw=False,
        )
        good = found.result == optx.RESULTS.successful
        return jnp.where(good, vector + found.value * unit, jnp.nan)

    return jax.lax.map(one, weights)


def sample_posterior(
    fit: JointFit, n_samples: int = 500, *, warmup: int = 300, seed: int = 0
) -> Float[np.ndarray, "sample unknown"]:
    """Unknowns drawn from exp(−χ²/2) by NUTS (numpyro, an extra: `pip install snrmjax[posterior]`).

    The chain runs in the coordinates in which the fit's covariance is one. Raises `ImportError`
    that says how to install numpyro where it is missing.
    """
    try:
        from numpyro.infer import MCMC, NUTS
    except ImportError as error:
        raise ImportError("sampling needs numpyro: pip install 'snrmjax[posterior]'.") from error
    vector, restore = fit.vector()
    values, directions = np.linalg.eigh(fit.covariance)
    root = jnp.asarray(directions * np.sqrt(np.maximum(values, 0.0)))
    weighing = weighing_at(restore(vector), fit.data, fit.modes, fit.spread)

    def potential(z: Array) -> Array:
        point = vector + root @ z
        given = (fit.data, fit.modes, fit.spread, weighing, jnp.asarray(fit.freed))
        residuals = freed_residuals(point, restore, *given)
        return 0.5 * jnp.sum(residuals**2)

    chain = MCMC(
        NUTS(potential_fn=potential), num_warmup=warmup, num_samples=n_samples, progress_bar=False
    )
    chain.run(jax.random.key(seed), init_params=jnp.zeros(len(vector)))
    return np.asarray(vector + chain.get_samples() @ root.T)


class ComparedBand(NamedTuple):
    """1σ of a curve at one velocity by several ways; NaN for a way that was not gone."""

    velocity: float  # m/s
    quantity: str  # "natural_frequency" (rad/s) or "modal_damping" (1/s)
    gauss_newton: float
    implicit: float
    bootstrap: float
    posterior: float


def compare_bands(
    fit: JointFit,
    velocity: Float[np.ndarray, " point"],
    *,
    n_samples: int = 200,
    posterior: bool = False,
    seed: int = 0,
) -> list[ComparedBand]:
    """The band of both curves by covariance, implicit derivatives, bootstrap and NUTS.

    The bootstrap knows nothing of errors that a level shares: where those rule, it is narrower.
    Only the fit's own covariance includes what the residuals of neighbouring states share.
    """
    at = np.asarray(velocity, dtype=np.float64)
    values, slopes = values_with_slopes(fit, at)
    restore, near = fit.vector()[1], jnp.asarray(displacement_near(fit, at))

    def spread_of(samples: np.ndarray) -> np.ndarray:
        drawn = np.array(_curves_of(restore, jnp.asarray(samples), jnp.asarray(at), near))
        with np.errstate(invalid="ignore"):
            drawn[:, :, 0] = np.sqrt(drawn[:, :, 0])
        return np.nanstd(drawn, axis=0)

    def linear(covariance: np.ndarray) -> np.ndarray:
        std = np.sqrt(np.einsum("acp,pq,acq->ac", slopes, covariance, slopes))
        std[:, 0] /= 2 * np.sqrt(values[:, 0])
        return std

    ways = [
        linear(fit.covariance),
        linear(sensitivity(fit).covariance),
        spread_of(bootstrap(fit, n_samples, seed=seed)),
        spread_of(sample_posterior(fit, n_samples, seed=seed))
        if posterior
        else np.full((len(at), 2), np.nan),
    ]
    names = ("natural_frequency", "modal_damping")
    return [
        ComparedBand(float(at[a]), names[c], *(float(way[a, c]) for way in ways))
        for c in range(2)
        for a in range(len(at))
    ]


@compiled
def _curves_of(restore: Restore, samples: Array, velocity: Array, near: Array) -> Array:
    return jax.lax.map(lambda v: curve_values(restore(v), velocity, near), samples)
