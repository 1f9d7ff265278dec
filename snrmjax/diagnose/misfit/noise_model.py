"""The noise of measured states: each by itself, and all that they have in common."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import solve_triangular
from scipy.special import chdtrc

from snrmjax.diagnose.misfit.predictions import Measured
from snrmjax.identify.calibrate.calibration_states import whitened_columns


class NoiseModel(NamedTuple):
    """Covariance of the misfits of all states, in units of each state's own noise.

    A row is one measured number: a column of a state. The covariance is I + S Sᵀ: 1 for a state's
    own noise, and S for errors that states share, which are those of a level and those of the
    baseline model's parameters.
    """

    whiten: Float[np.ndarray, "state column column"]
    known: Bool[np.ndarray, "state column"]
    shared: Float[np.ndarray, "row shared"]  # S: slopes by the shared errors, times their 1σ
    lower: Float[np.ndarray, "row row"]  # Cholesky's factor of the covariance
    state: Int[np.ndarray, " row"]
    column: Int[np.ndarray, " row"]

    def noise_units(
        self, columns: Float[np.ndarray, "trial state column"]
    ) -> Float[np.ndarray, "trial row"]:
        """Measured columns in units of their own noise; NaN stays NaN."""
        return np.einsum("sij,...sj->...si", self.whiten, columns)[..., self.known]

    def decorrelated(
        self, rows: Float[np.ndarray, "*entry row"]
    ) -> Float[np.ndarray, "*entry row"]:
        """Rows made independent and of unit variance, shared errors included."""
        good = np.all(np.isfinite(rows), axis=-1, keepdims=True)
        flat = np.where(good, rows, 0.0).reshape(-1, rows.shape[-1])
        found = solve_triangular(self.lower, flat.T, lower=True).T.reshape(rows.shape)
        return np.where(good, found, np.nan)

    def without_shared(self, rows: Float[np.ndarray, " row"]) -> Float[np.ndarray, " row"]:
        """Rows less the most likely values of the shared errors."""
        half = solve_triangular(self.lower, rows, lower=True)
        return np.asarray(solve_triangular(self.lower, half, lower=True, trans="T"))

    def shared_errors(
        self, rows: Float[np.ndarray, " row"], kept: Bool[np.ndarray, " row"] | None = None
    ) -> Float[np.ndarray, " shared"]:
        """Most likely values of the shared errors in units of their 1σ, from all rows or some."""
        if kept is not None:
            half = solve_triangular(self.of_rows(kept), rows[kept], lower=True)
            left = solve_triangular(self.of_rows(kept), half, lower=True, trans="T")
            return np.asarray(-self.shared[kept].T @ left)
        return np.asarray(-self.shared.T @ self.without_shared(rows))

    def of_rows(self, keep: Bool[np.ndarray, " row"]) -> Float[np.ndarray, "kept kept"]:
        """Cholesky's factor of the covariance of some of the rows."""
        shared = self.shared[keep]
        return np.linalg.cholesky(np.eye(int(keep.sum())) + shared @ shared.T)


def noise_model(
    measured: Measured,
    baseline: Float[np.ndarray, "state column prior"],
    by_linear: Float[np.ndarray, "state column two"],
    level_std: Float[np.ndarray, " four"],
) -> NoiseModel:
    """The noise of states with errors of the baseline model and of whole levels.

    Arguments: `baseline` are slopes by the baseline's own parameters, times their 1σ;
    `by_linear` are slopes by natural frequency and damping ratio; `level_std` has the 1σ of a
    level's gain, phase, natural frequency and damping ratio.
    """
    states, levels = measured.states, measured.chosen.n_levels
    known = measured.known
    n_sensors = np.asarray(states.velocity).shape[1]
    gain = measured.by_error[:, :, 1 : n_sensors + 1].sum(axis=2)
    phase = measured.by_error[:, :, n_sensors + 1 :].sum(axis=2)
    member = (np.asarray(states.level)[:, None] == np.arange(levels)).astype(float)
    slopes = (gain, phase, *np.moveaxis(by_linear, 2, 0))
    parts = [
        std * slope[:, :, None] * member[:, None, :]
        for slope, std in zip(slopes, level_std, strict=True)
        if std > 0
    ]
    every = np.concatenate([baseline, *parts], axis=2)
    own = np.asarray(whitened_columns(measured.whiten, every))[known]
    state, column = np.nonzero(known)
    lower = np.linalg.cholesky(np.eye(len(own)) + own @ own.T)
    return NoiseModel(measured.whiten, known, own, lower, state, column)


def chi_square_p_value(chi_square: float, freedom: int) -> float:
    """Probability of at least this χ² by chance, for so many degrees of freedom."""
    # Rounding may have made a sum of squares negative.
    return float(chdtrc(max(freedom, 1), np.maximum(chi_square, 0.0)))
