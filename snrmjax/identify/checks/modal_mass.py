"""Whether states away from resonance contradict the modal mass of the model."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from snrmjax.identify.checks.residual_autocorrelation import (
    added_covariance,
    along_resonance,
    residual_autocorrelation,
)

_STEPS = 20
_SETTLED = 1e-10  # of a step's logarithm of the mass
_FAR = 1.0  # of a logarithm: no linear test is as wrong, and a step stays below
_CONTRADICTS = 3.0  # 1σ, from which on the data's mass is said
_NOTICED = 0.01  # relative: smaller errors of a modal mass go without a word


class MassOfStates(NamedTuple):
    """The logarithm of the modal mass that states ask for over the model's, with its 1σ."""

    log_ratio: float
    std: float

    @property
    def contradicts(self) -> bool:
        """Whether the states ask for another modal mass than the model's."""
        away = abs(self.log_ratio)
        return away >= _CONTRADICTS * self.std and away > _NOTICED


class ScatteredFrequencies(NamedTuple):
    """Squared natural frequencies of single states, found with the model's modal mass."""

    level: Int[np.ndarray, " state"]
    frequency: Float[np.ndarray, " state"]  # rad/s, of the force
    squared: Float[np.ndarray, " state"]  # ω̃², rad²/s²
    std: Float[np.ndarray, " state"]  # 1σ, or relative sizes where the noise is not stated
    shared: Float[np.ndarray, "state kind"]  # 1σ of what the states of a level share


def mass_of_states(
    states: ScatteredFrequencies,
    curve: Float[np.ndarray, " state"],
    by_values: Float[np.ndarray, "state knot"],
    *,
    stated: bool,
) -> MassOfStates | None:
    """The modal mass at which states on both sides of resonance lie on one curve of ω̃².

    A state's ω̃² − Ω² is in proportion to the force over the modal mass: with a mass e^q times the
    model's, states whose points follow from the model's mass lie at Ω² + e^q (g − Ω²), g the true
    curve. Fits q and the curve's values by Gauss–Newton. The covariance includes what levels
    share, how far the answer changes when levels are left out in turn (jackknife), and the
    correlation of residuals along a level.

    Arguments: `curve` at the states, which the fit starts from, and its derivatives by the values
    that it has at its knots; `stated` whether the 1σ of the states are absolute.
    Returns None where the states do not determine the mass, or too few are left to tell how well.
    """
    every = np.arange(len(states.level))
    whole = _fit(states, curve, by_values, every)
    if whole is None:
        return None
    log_ratio, jacobian, residuals = whole
    spare = len(residuals) - np.linalg.matrix_rank(jacobian)
    if spare < 1:
        return None
    scale = float(np.sqrt(residuals @ residuals / spare))
    if stated:
        scale = max(scale, 1.0)
    arms = np.linalg.pinv(jacobian, rcond=1e-12)[-1]
    _, member = np.unique(states.level, return_inverse=True)
    of_levels = [np.bincount(member, weights=arms * kind / states.std) for kind in states.shared.T]
    levels = along_resonance(states.level, states.frequency)
    correlation = residual_autocorrelation(residuals[:, None] / scale, levels)
    size = np.linalg.norm(jacobian, axis=0)
    size = np.where(size > 0, size, 1.0)
    _, values, rows = np.linalg.svd(jacobian / size, full_matrices=False)
    root = (rows.T / np.where(values > 1e-12 * values[0], values, np.inf)) / size[:, None]
    more = added_covariance(root, jacobian[:, None, :], correlation, levels)[-1, -1]
    variance = scale**2 * (arms @ arms + more) + sum(float(one @ one) for one in of_levels)
    others = [_fit(states, curve, by_values, every[member != k]) for k in range(member.max() + 1)]
    left = [one[0] for one in others if one is not None]
    if len(left) > 2:
        variance = max(variance, (len(left) - 1) * float(np.var(left)))
    return MassOfStates(log_ratio, float(np.sqrt(variance)))


def _fit(
    states: ScatteredFrequencies,
    curve: Float[np.ndarray, " state"],
    by_values: Float[np.ndarray, "state knot"],
    use: Int[np.ndarray, " used"],
) -> tuple[float, Float[np.ndarray, "used unknown"], Float[np.ndarray, " used"]] | None:
    """q, the derivatives of the residuals and these, in units of the states' 1σ."""
    squared, std, forced = states.squared[use], states.std[use], states.frequency[use] ** 2
    design, log_ratio = by_values[use], 0.0
    change = np.zeros(design.shape[1])
    for _ in range(_STEPS):
        away = curve[use] + design @ change - forced
        growth = np.exp(log_ratio)
        jacobian = growth * np.column_stack([design, away]) / std[:, None]
        residuals = (squared - forced - growth * away) / std
        step = np.linalg.pinv(jacobian, rcond=1e-12) @ residuals
        log_ratio += float(step[-1])
        change = change + step[:-1]
        if not abs(log_ratio) < _FAR:
            return None
        if abs(step[-1]) < _SETTLED:
            return log_ratio, jacobian, residuals
    return None
