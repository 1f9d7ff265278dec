"""How large the noise is, and how far levels differ, from the residuals of a linearised fit."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import minimize

_NOTHING = 1e-9  # 1σ that stands for none at all
_LARGEST = 0.3  # 1σ of a deviation; levels that differ by more are not one structure's
_WORTH = 5.41  # of −2 log likelihood: 1 %, one-sided, since four kinds of error are tried


class Scatter(NamedTuple):
    """1σ of what nobody stated."""

    noise: float  # by which the residuals exceed the stated noise
    noise_std: float
    level: tuple[float, ...]  # of every kind of error that a level shares, stated or found

    @property
    def contradicts_upward(self) -> bool:
        """Whether the residuals are too large for the stated noise."""
        return self.noise - 3 * self.noise_std > 1


class Linearised(NamedTuple):
    """A fit near its solution: residuals + slopes·change, priors on some of the unknowns."""

    residuals: Float[np.ndarray, " row"]
    slopes: Float[np.ndarray, "row unknown"]
    prior_std: Float[np.ndarray, " unknown"]  # infinite where there is no prior
    deviation: Float[np.ndarray, " unknown"]  # present value minus its prior's mean


def level_columns(
    by_state: Float[np.ndarray, "state part error"], level: np.ndarray, n_levels: int
) -> Float[np.ndarray, "row unknown"]:
    """Slopes of stacked residuals with respect to every level's own errors, level by level."""
    n, parts, errors = by_state.shape
    members = (level[:, None] == np.arange(n_levels)).astype(float)
    full = by_state[:, :, None, :] * members[:, None, :, None]
    return full.reshape(n * parts, n_levels * errors)


def estimated_scatter(problem: Linearised, index: Int[np.ndarray, "level error"]) -> Scatter:
    """Restricted maximum likelihood of the noise and of what levels share beyond what is stated.

    Arguments: `index` says where among the unknowns the levels' errors are; kinds of error whose
    `prior_std` is zero were not stated and are estimated. They enter one after the other, while
    the likelihood asks for them; with fewer than three levels none does.
    Reference: Patterson & Thompson, Biometrika 58 (1971) 545, doi:10.1093/biomet/58.3.545.
    """
    likelihood = _Likelihood.of(problem, index)
    stated = problem.prior_std[index[0]]
    open_kinds = [k for k in range(index.shape[1]) if stated[k] == 0] if len(index) > 2 else []
    found = likelihood.best(stated, np.zeros(len(stated), dtype=bool))
    chosen = np.zeros(len(stated), dtype=bool)
    while open_kinds:
        trials = []
        for kind in open_kinds:
            more = chosen.copy()
            more[kind] = True
            trials.append((likelihood.best(stated, more), kind))
        better, kind = min(trials, key=lambda trial: trial[0].value)
        if better.value > found.value - _WORTH:
            break
        found = better
        chosen[kind] = True
        open_kinds.remove(kind)
    return Scatter(
        noise=found.noise,
        noise_std=found.noise / np.sqrt(2 * likelihood.dof),
        level=tuple(float(s) for s in found.level),
    )


class _Best(NamedTuple):
    value: float  # −2 log likelihood
    noise: float
    level: np.ndarray


class _Likelihood(NamedTuple):
    gram: np.ndarray
    pull: np.ndarray
    total: float
    rows: int
    dof: int
    prior_std: np.ndarray
    where: np.ndarray  # of the levels' errors, (level, error)

    @classmethod
    def of(cls, problem: Linearised, index: np.ndarray) -> "_Likelihood":
        x, std = problem.slopes, problem.prior_std
        bound = np.isfinite(std)
        # Residuals that would be left if every bound unknown went back to its prior's mean.
        residuals = problem.residuals - x[:, bound] @ problem.deviation[bound]
        n = len(residuals)
        dof = max(n - int(np.sum(~bound)), 1)
        return cls(x.T @ x, x.T @ residuals, float(residuals @ residuals), n, dof, std, index)

    def value(self, noise: float, level: np.ndarray) -> float:
        """−2 log of the restricted likelihood."""
        std = self.prior_std.copy()
        std[self.where] = level
        # What moves nothing and has no prior says nothing.
        keep = (std > 0) & ((np.diag(self.gram) > 0) | np.isfinite(std))
        own = std[keep & np.isfinite(std)]
        a = self.gram[np.ix_(keep, keep)] / noise**2 + np.diag(1.0 / std[keep] ** 2)
        size = np.sqrt(np.diag(a))
        factor = np.linalg.cholesky(a / np.outer(size, size) + 1e-13 * np.eye(len(a)))
        q = np.linalg.solve(factor, self.pull[keep] / noise**2 / size)
        determinant = 2 * np.sum(np.log(np.diag(factor))) + 2 * np.sum(np.log(size))
        return float(
            self.total / noise**2
            - q @ q
            + determinant
            + 2 * np.sum(np.log(own))
            + self.rows * np.log(noise**2)
        )

    def best(self, stated: np.ndarray, chosen: Bool[np.ndarray, " error"]) -> _Best:
        """The likeliest noise, and 1σ of the chosen kinds of error."""

        def unpacked(point: np.ndarray) -> tuple[float, np.ndarray]:
            level = stated.copy()
            level[chosen] = np.clip(np.exp(point[1:]), _NOTHING, _LARGEST)
            return float(np.exp(np.clip(point[0], -40.0, 40.0))), level

        start = np.log([max(np.sqrt(self.total / self.dof), 1e-12), *np.full(chosen.sum(), 0.01)])
        corners = np.concatenate([start[None], start + np.eye(len(start))])
        answer = minimize(
            lambda point: self.value(*unpacked(point)),
            start,
            method="Nelder-Mead",
            options={"xatol": 1e-2, "fatol": 1e-2, "initial_simplex": corners},
        )
        return _Best(float(answer.fun), *unpacked(answer.x))
