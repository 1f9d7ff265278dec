"""What the uncertainty of a joint fit comes from: derivatives by measurements, contributions."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.identify.curves.family_base import AbstractFamily
from snrmjax.identify.inference.fitted_curves import (
    open_choice,
    values_at_displacement,
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
    JointFit,
)
from snrmjax.identify.joint.residuals import (
    all_residuals,
    freed_of_errors,
    whitened,
)
from snrmjax.model.modes import LinearModes
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.least_squares import inverse_of


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
