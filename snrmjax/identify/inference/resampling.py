"""Joint fits of resampled states, samples of the posterior, and bands compared with theirs."""

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from snrmjax.identify.inference.fitted_curves import (
    displacement_near,
    on_backbone,
    values_with_slopes,
)
from snrmjax.identify.inference.sensitivity import sensitivity
from snrmjax.identify.inference.table_result import AbstractTable
from snrmjax.identify.joint.family_fit import SOLVER
from snrmjax.identify.joint.force_balance import BalanceProblem, filled
from snrmjax.identify.joint.free_unknowns import Unravel, padded_problem
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.joint.residuals import corrected_residuals
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.result import Variable

if TYPE_CHECKING:
    import arviz

_HERTZ = 2 * np.pi  # rad/s


def bootstrap(
    fit: JointFit, n_samples: int = 200, *, seed: int = 0, levels: bool = False
) -> Float[np.ndarray, "sample unknown"]:
    """Unknowns of refits to states drawn with replacement, within every level.

    With `levels` whole levels are drawn instead, which needs more of them than a curve has
    parameters. A refit that does not converge is a row of NaN.
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
    weights = weights * np.asarray(fit.data.weight)
    problem, (vector, unravel, own) = padded_problem(fit.problem), fit.packed()
    std = np.sqrt(np.diag(fit.packed().padded_covariance(fit.covariance)))
    every = np.stack([filled(row, len(problem.data.level), 0.0) for row in weights])
    settings = (vector, unravel, problem, jnp.asarray(std))
    return np.asarray(_resampled(*settings, jnp.asarray(every)))[:, own]


@compiled
def _resampled(
    vector: Array,
    unravel: Unravel,
    problem: BalanceProblem,
    std: Array,
    weights: Array,
) -> Float[Array, "sample unknown"]:
    unit = jnp.where(std > 0, std, 1.0)

    def one(weight: Array) -> Array:
        given = (unravel, problem.with_data(weight=weight))
        found: optx.Solution = optx.least_squares(
            lambda y, _: corrected_residuals(vector + y * unit, *given),
            *(SOLVER, jnp.zeros_like(vector)),
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

    The chain runs in the coordinates in which the fit's covariance is one. `inference_data` makes
    the samples an ArviZ `InferenceData`. Raises `ImportError` that says how to install numpyro
    where it is missing.
    """
    try:
        from numpyro.infer import MCMC, NUTS
    except ImportError as error:
        raise ImportError("sampling needs numpyro: pip install 'snrmjax[posterior]'.") from error
    vector, unravel = fit.vector()
    values, directions = np.linalg.eigh(fit.covariance)
    root = jnp.asarray(directions * np.sqrt(np.maximum(values, 0.0)))

    def potential(z: Array) -> Array:
        return 0.5 * jnp.sum(corrected_residuals(vector + root @ z, unravel, fit.problem) ** 2)

    chain = MCMC(
        NUTS(potential_fn=potential), num_warmup=warmup, num_samples=n_samples, progress_bar=False
    )
    chain.run(jax.random.key(seed), init_params=jnp.zeros(len(vector)))
    return np.asarray(vector + chain.get_samples() @ root.T)


def inference_data(
    fit: JointFit, samples: Float[np.ndarray, "sample unknown"]
) -> "arviz.InferenceData":
    """Samples of the unknowns, of a posterior or a bootstrap, as ArviZ's `InferenceData`.

    Each unknown is a variable by its name, with its unit, in one chain. Samples that are not
    finite, as of refits that failed, are left out.
    Raises `ImportError` that says how to install ArviZ where it is missing, and `ValueError` for
    samples of another number of unknowns.
    """
    try:
        import arviz
    except ImportError as error:
        message = "`InferenceData` needs ArviZ: pip install 'snrmjax[posterior]'."
        raise ImportError(message) from error
    drawn, names = np.asarray(samples), fit.names()
    if drawn.ndim != 2 or drawn.shape[1] != len(names):
        raise ValueError(
            f"`samples` must be (sample, unknown) with {len(names)} unknowns, but has the shape "
            f"{drawn.shape}."
        )
    drawn = drawn[np.all(np.isfinite(drawn), axis=1)]
    found = arviz.from_dict({name: drawn[None, :, k] for k, name in enumerate(names)})
    for name, unit in zip(names, fit.units(), strict=True):
        found.posterior[name].attrs["units"] = unit
    return found


class ComparedBand(NamedTuple):
    """1σ of a curve at one velocity by several ways; NaN for a way that was not gone."""

    velocity: float  # m/s
    quantity: str  # "natural_frequency" (rad/s) or "modal_damping" (1/s)
    gauss_newton: float
    implicit: float
    bootstrap: float
    posterior: float


class ComparedBands(AbstractTable[ComparedBand]):
    """1σ of both curves at some velocities by several ways."""

    n_failed: int  # refits of the bootstrap that did not converge and are left out

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`."""
        speeds = [one.velocity for one in self.rows]
        ratio = [one.bootstrap / one.gauss_newton for one in self.rows]
        return (
            f"ComparedBands: 1σ of both curves at {len(set(speeds))} velocities, "
            f"{min(speeds):.3g} to {max(speeds):.3g} m/s",
            f"bootstrap over covariance {min(ratio):.3g} to {max(ratio):.3g}",
            f"{self.n_failed} refits of the bootstrap did not converge and are left out",
        )

    def variables(self) -> dict[str, Variable]:
        """See `AbstractResult`; a natural frequency's 1σ in Hz."""
        unit = [_HERTZ if one.quantity == "natural_frequency" else 1.0 for one in self.rows]

        def way(name: str, meaning: str) -> Variable:
            values = np.array([getattr(one, name) for one in self.rows]) / unit
            return self.column(values, "", f"1σ by {meaning}; Hz or 1/s")

        return {
            "velocity_m_s": self.column([o.velocity for o in self.rows], "m/s", "velocity"),
            "quantity": self.column([one.quantity for one in self.rows], "", "which curve"),
            "gauss_newton": way("gauss_newton", "the covariance of the fit"),
            "implicit": way("implicit", "implicit derivatives"),
            "bootstrap": way("bootstrap", "refits to resampled states"),
            "posterior": way("posterior", "samples of the posterior"),
        }


def compare_bands(
    fit: JointFit,
    velocity: Float[np.ndarray, " point"],
    *,
    n_samples: int = 200,
    posterior: bool = False,
    seed: int = 0,
) -> ComparedBands:
    """The band of both curves by covariance, implicit derivatives, bootstrap and NUTS.

    The bootstrap knows nothing of errors that a level shares: where those rule, it is narrower.
    The bootstrap does not know of correlated residuals of neighbouring states either.
    Refits of the bootstrap that do not converge are left out and counted.
    """
    at = np.asarray(velocity, dtype=np.float64)
    values, slopes = values_with_slopes(fit, at)
    near, (_, unravel) = displacement_near(fit, at), fit.vector()

    def spread_of(samples: np.ndarray) -> np.ndarray:
        good = samples[np.all(np.isfinite(samples), axis=1)]
        drawn = np.array([on_backbone(unravel(one), at, near).values for one in good])
        with np.errstate(invalid="ignore"):
            drawn[:, :, 0] = np.sqrt(drawn[:, :, 0])
        return np.nanstd(drawn, axis=0) if len(good) else np.full((len(at), 2), np.nan)

    def linear(covariance: np.ndarray) -> np.ndarray:
        std = np.sqrt(np.einsum("acp,pq,acq->ac", slopes, covariance, slopes))
        std[:, 0] /= 2 * np.sqrt(values[:, 0])
        return std

    refits = bootstrap(fit, n_samples, seed=seed)
    ways = [
        linear(fit.covariance),
        linear(sensitivity(fit).covariance),
        spread_of(refits),
        spread_of(sample_posterior(fit, n_samples, seed=seed))
        if posterior
        else np.full((len(at), 2), np.nan),
    ]
    names = ("natural_frequency", "modal_damping")
    rows = tuple(
        ComparedBand(float(at[a]), names[c], *(float(way[a, c]) for way in ways))
        for c in range(2)
        for a in range(len(at))
    )
    return ComparedBands(rows, int(np.sum(~np.all(np.isfinite(refits), axis=1))))
