"""Parts of the force balance with a misfit: stiffness, damping, harmonics, or none of them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.diagnose import priors
from snrmjax.diagnose.misfit.effect_fit import EffectFit
from snrmjax.diagnose.misfit.noise_model import chi_square_p_value, unit_columns
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit

_FREE = priors.FREE_CURVE


class Located(NamedTuple):
    """One part of the force balance in which model and data disagree."""

    part: str
    velocity_range: tuple[float, float]  # m/s
    p_value: float


def locate_misfit(misfit: WeightedMisfit, base: EffectFit) -> tuple[Located, ...]:
    """Fit free curves of stiffness and damping to the force, and test the significance of each.

    Where only magnitudes are compared, states off resonance determine the stiffness and those near
    it the damping, to first order: a part that the other one can explain is not reported.
    """
    noise, states = misfit.noise, misfit.predictions.states
    speed = np.abs(states.velocity[:, 0])
    amplitude = np.log(speed / speed.max())
    knots = np.quantile(amplitude, np.linspace(0, 1, _FREE)) + 1e-9 * np.arange(_FREE)
    hats = np.stack([np.interp(amplitude, knots, row) for row in np.eye(_FREE)], axis=1)
    of_force = noise.column < 2
    covariance = noise.covariance.of_rows(of_force)
    left = covariance.decorrelated(base.rows[of_force])
    curves = [
        covariance.decorrelated((misfit.by_linear[:, [k]] * hats[noise.state])[of_force].T).T
        for k in range(2)
    ]
    alone = [_fitted(left, sensitivities)[0] for sensitivities in curves]
    free, values, spread = _fitted(left, np.concatenate(curves, axis=1))
    n_force = int(of_force.sum())
    if misfit.predictions.magnitudes.alone.any():  # not linear in the curves
        spread = spread * max(free / max(n_force - 2 * _FREE, 1), 1.0)
    parts = []
    for k, name in enumerate(("stiffness", "damping")):
        p_value = chi_square_p_value(alone[1 - k] - free, _FREE)
        if p_value < priors.REJECTED:
            some = slice(k * _FREE, (k + 1) * _FREE)
            curve, own = values[some], spread[some, some]
            std = np.sqrt(np.maximum(np.einsum("sk,kl,sl->s", hats, own, hats), 0.0))
            ends = _range(speed, np.abs(hats @ curve) > 2 * std)
            parts.append(Located(name, ends, p_value))
    p_value = chi_square_p_value(free, n_force - 2 * _FREE)
    if p_value < priors.REJECTED and float(left @ left) > n_force:
        parts.append(Located("not_a_function_of_amplitude", _range(speed), p_value))
    for index, order in enumerate(misfit.predictions.chosen.orders):
        first = 2 * (states.velocity.shape[1] + index)
        rows = (noise.column == first) | (noise.column == first + 1)
        if order not in (2, 3) or not rows.any():
            continue
        of_order = noise.covariance.of_rows(rows).decorrelated(base.rows[rows])
        p_value = chi_square_p_value(float(of_order @ of_order), int(rows.sum()))
        if p_value < priors.REJECTED:
            large = noise.state[rows][np.abs(base.rows[rows]) > 2.5]
            ends = _range(speed, np.isin(np.arange(len(speed)), large))
            parts.append(Located(f"harmonic_{order}", ends, p_value))
    return tuple(parts)


def _range(speed: np.ndarray, visible: np.ndarray | None = None) -> tuple[float, float]:
    """The velocity range of the `visible` states; of all states if there are none."""
    where = speed if visible is None or not visible.any() else speed[visible]
    return float(where.min()), float(where.max())


def _fitted(
    left: Float[np.ndarray, " row"], sensitivities: Float[np.ndarray, "row column"]
) -> tuple[float, np.ndarray, np.ndarray]:
    """χ², least-squares values of some columns, and their covariance."""
    scaled, norm = unit_columns(sensitivities)
    inverse = np.linalg.pinv(scaled.T @ scaled, rcond=1e-10, hermitian=True)
    values = -inverse @ (scaled.T @ left)
    left = left + scaled @ values
    return float(left @ left), values / norm, inverse / np.outer(norm, norm)
