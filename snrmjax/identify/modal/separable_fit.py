"""Weighted least squares with shared poles, each channel linear in its own coefficients.

min over θ and c_i of Σ_i |W_i (y_i − B(θ) c_i)|²: the linear unknowns c_i are eliminated channel by
channel (variable projection), so that many sensors cost no more than their sum.
Reference: Golub & Pereyra, SIAM J. Numer. Anal. 10 (1973) 413, doi:10.1137/0710036; covariance of
neighbouring residuals: Newey & West, Econometrica 55 (1987) 703, doi:10.2307/1913610.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from snrmjax.numerics.levenberg_marquardt import MinimisationStatus, StepRule, minimise

_RULE = StepRule(steps=80, settled=1e-7, damping=1e-4, largest_damping=1e9)
_LAGS = 30  # rows, over which residuals are tested for correlation
_WHITE = 2.5  # standard errors, below which a correlation counts as that of white noise
SIGNIFICANT = 4.0
"""Smallest amplitude or residue of a significant mode, in standard errors."""
_TINY = 1e-150  # norm below which a column counts as zero


class TermColumns(NamedTuple):
    """Columns of the linear unknowns at given θ, and their derivatives.

    Rows are `sequences` of equal length one after another (real and imaginary parts of a response).
    """

    columns: Float[np.ndarray, "row term"]
    derivatives: Float[np.ndarray, "unknown row term"]


ColumnsAt = Callable[[Float[np.ndarray, " unknown"]], Sequence[TermColumns]]
"""The bases at θ, one for each group of channels."""


class ChannelRows(NamedTuple):
    """Rows of all channels; `groups` is the index of each channel's basis."""

    values: Float[np.ndarray, "channel row"]
    weights: Float[np.ndarray, "channel row"]  # 1/σ, 0 where not measured
    groups: Int[np.ndarray, " channel"]
    sequences: int  # of neighbouring rows, of equal length


class SeparableFit(NamedTuple):
    """Best θ and c, whitened residuals, and the parts of their covariances.

    An error of channel i is δc_i = B_i⁺ε_i − slopes_i δθ. `own` is the covariance of B_i⁺ε_i,
    `mixed` its covariance with δθ.
    """

    unknowns: Float[np.ndarray, " unknown"]
    coefficients: Float[np.ndarray, "channel term"]
    residuals: Float[np.ndarray, "channel row"]
    covariance: Float[np.ndarray, "unknown unknown"]
    slopes: Float[np.ndarray, "channel term unknown"]
    own: Float[np.ndarray, "channel term term"]
    mixed: Float[np.ndarray, "channel term unknown"]
    correlation: Float[np.ndarray, " lag"]  # of neighbouring residuals, from lag one
    status: MinimisationStatus

    def with_variance(self, variance: float) -> "SeparableFit":
        """The same with covariances for errors of another variance."""
        return self._replace(
            covariance=self.covariance * variance,
            own=self.own * variance,
            mixed=self.mixed * variance,
        )

    def term_covariance(self, term: int) -> Float[np.ndarray, "channel channel"]:
        """Covariance of one linear unknown over all channels."""
        k, t = self.slopes[:, term], self.mixed[:, term]
        shared = k @ self.covariance @ k.T - t @ k.T - k @ t.T
        return shared + np.diag(self.own[:, term, term])

    def cross_covariance(self, term: int) -> Float[np.ndarray, "unknown channel"]:
        """Covariance of θ with one linear unknown of every channel."""
        return self.mixed[:, term].T - self.covariance @ self.slopes[:, term].T


def fit_separable(
    basis_at: ColumnsAt,
    measured: ChannelRows,
    start: Float[np.ndarray, " unknown"],
    bounds: tuple[Float[np.ndarray, " unknown"], Float[np.ndarray, " unknown"]],
    *,
    settled: float = _RULE.settled,
) -> SeparableFit:
    """The weighted least-squares fit and its covariance for errors of unit variance.

    Significant correlation of neighbouring residuals (windows, smooth misfits) widens the
    covariance. The fit ends when a step lowers the sum of
    squares by less than `settled`.
    """

    def linearised(points: np.ndarray) -> list["_Compressed"]:
        return [_compressed(basis_at(point), measured) for point in points]

    begin, rule = (
        np.clip(start, *bounds)[None],
        dataclasses.replace(_RULE, settled=settled),
    )
    end = minimise(linearised, begin, linearised(begin), bounds, rule)[0]
    return _with_covariance(basis_at(end.point), measured, end.point, end.status)


class _Compressed(NamedTuple):
    """Residuals and Jacobian of the projected problem, each channel reduced by QR."""

    residuals: Float[np.ndarray, " row"]
    jacobian: Float[np.ndarray, "row unknown"]


class _Projected(NamedTuple):
    coefficients: np.ndarray  # term
    inverse: np.ndarray  # term, row: pseudo-inverse of the weighted basis
    slopes: np.ndarray  # row, unknown: weighted derivative of the model at fixed c
    outside: np.ndarray  # row, unknown: its part outside the column space
    residuals: np.ndarray  # row


def _projected(basis: TermColumns, values: np.ndarray, weights: np.ndarray) -> _Projected:
    weighted = basis.columns * weights[:, None]
    norm = np.linalg.norm(weighted, axis=0)
    norm = np.where(norm > _TINY, norm, 1.0)
    orthogonal, triangle = np.linalg.qr(weighted / norm)
    inverse = np.linalg.pinv(triangle, rcond=1e-12) @ orthogonal.T / norm[:, None]
    rows = values * weights
    coefficients = inverse @ rows
    slopes = (basis.derivatives @ coefficients).T * weights[:, None]
    outside = slopes - orthogonal @ (orthogonal.T @ slopes)
    residuals = rows - orthogonal @ (orthogonal.T @ rows)
    return _Projected(coefficients, inverse, slopes, outside, residuals)


def _compressed(bases: Sequence[TermColumns], measured: ChannelRows) -> _Compressed:
    parts = []
    if not all(np.isfinite(projected.columns).all() for projected in bases):
        unknowns = bases[0].derivatives.shape[0]
        return _Compressed(np.array([np.inf]), np.zeros((1, unknowns)))
    for values, weights, group in zip(*measured[:3], strict=True):
        projected = _projected(bases[group], values, weights)
        parts.append(
            np.linalg.qr(np.column_stack([-projected.outside, projected.residuals]), mode="r")
        )
    triangle = np.concatenate(parts)
    if not np.isfinite(triangle).all():
        triangle = np.full_like(triangle, np.inf)
    return _Compressed(triangle[:, -1], triangle[:, :-1])


def _with_covariance(
    bases: Sequence[TermColumns],
    measured: ChannelRows,
    point: np.ndarray,
    status: MinimisationStatus,
) -> SeparableFit:
    channels = [
        _projected(bases[group], values, weights)
        for values, weights, group in zip(*measured[:3], strict=True)
    ]
    residuals = np.stack([channel.residuals for channel in channels])
    correlation = _correlation(residuals, measured)
    spread = _Spread(correlation, measured.sequences)
    information = sum(channel.outside.T @ channel.outside for channel in channels)
    gain = np.linalg.pinv(np.asarray(information), rcond=1e-15, hermitian=True)
    meat = sum(spread.between(channel.outside, channel.outside) for channel in channels)
    slopes = np.stack([channel.inverse @ channel.slopes for channel in channels])
    own = np.stack([spread.between(channel.inverse.T, channel.inverse.T) for channel in channels])
    mixed = np.stack(
        [spread.between(channel.inverse.T, channel.outside) @ gain for channel in channels]
    )
    coefficients = np.stack([channel.coefficients for channel in channels])
    covariance = gain @ meat @ gain
    return SeparableFit(
        point, coefficients, residuals, covariance, slopes, own, mixed, correlation, status
    )


class _Spread(NamedTuple):
    """Errors of unit variance whose neighbours are correlated."""

    correlation: np.ndarray
    sequences: int

    def between(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """aᵀRb for the correlation matrix R of the rows."""
        total = a.T @ b
        if not self.correlation.size:
            return total
        x, y = (m.reshape(self.sequences, -1, m.shape[1]) for m in (a, b))
        for lag, value in enumerate(self.correlation, start=1):
            early, late = slice(None, -lag), slice(lag, None)
            total = total + value * np.einsum("snu,snv->uv", x[:, early], y[:, late])
            total = total + value * np.einsum("snu,snv->uv", x[:, late], y[:, early])
        return total


def _correlation(residuals: np.ndarray, measured: ChannelRows) -> np.ndarray:
    """Correlations of neighbouring residuals up to the first insignificant lag."""
    used = (measured.weights > 0).reshape(len(residuals) * measured.sequences, -1)
    rows = np.where(used, residuals.reshape(used.shape), 0.0)
    length = rows.shape[1]
    variance = np.sum(rows**2) / max(used.sum(), 1)
    correlations: list[float] = []
    for lag in range(1, min(_LAGS, length // 4) + 1):
        pairs = np.sum(used[:, :-lag] & used[:, lag:])
        if not pairs or variance == 0:
            break
        value = np.sum(rows[:, :-lag] * rows[:, lag:]) / pairs / variance
        if value * np.sqrt(pairs) < _WHITE:
            break
        correlations.append(float(value) * (1 - lag / length))
    return np.array(correlations)
