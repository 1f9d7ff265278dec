"""Joint fits of resampled states, samples of the posterior, and bands compared with theirs."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from snrmjax.identify.inference.fitted_curves import (
    curve_values,
    displacement_near,
    values_with_slopes,
)
from snrmjax.identify.inference.sensitivity import sensitivity
from snrmjax.identify.joint.fitting import SOLVER
from snrmjax.identify.joint.force_balance import (
    BalanceData,
    Spread,
    weighing_at,
)
from snrmjax.identify.joint.free_unknowns import Restore
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.joint.residuals import (
    freed_residuals,
    on_levels,
)
from snrmjax.model.modes import LinearModes
from snrmjax.numerics.compiled import compiled


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
