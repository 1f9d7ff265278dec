"""Evidence of fitted answers: how probable each makes the data, whatever its parameters are.

Laplace's approximation about the best fit. The stated priors are, of a strength, a Cauchy
distribution about zero with the strength from which a fit begins as its scale, which changes the
dynamic stiffness by `VISIBLE_CHANGE`, and of every other parameter a flat one between its bounds.
The baseline's parameters and the errors of levels are marginalised exactly, by the covariance.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import solve_triangular

from snrmjax.diagnose.misfit.candidates import candidate
from snrmjax.diagnose.misfit.coordinates import coordinates
from snrmjax.diagnose.misfit.effect_fit import EffectFit
from snrmjax.diagnose.misfit.predictions import scales_of
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit
from snrmjax.model.effect_metadata import MotionScales
from snrmjax.model.effects import effect_parameters


class Marginal(NamedTuple):
    """A model whose parameters are marginalised: ln p = volume − n ln s − χ²/2s² + constant.

    For noise s times the stated one. The constant is the same for all models of the same data
    under the same covariance.
    """

    n_rows: int
    chi_square: float  # that is left
    volume: float  # −½ ln det of posterior over prior precision: Occam's factor

    def log_likelihood(self, scale: Float[np.ndarray, " scale"]) -> Float[np.ndarray, " scale"]:
        """ln p for noises so many times the stated one."""
        return self.volume - self.n_rows * np.log(scale) - 0.5 * self.chi_square / scale**2


class FittedAnswer(NamedTuple):
    """An answer, linear about its best fit, in units of noise that is independent."""

    kinds: tuple[str, ...]
    left: Float[np.ndarray, " row"]
    arms: Float[np.ndarray, "row parameter"]  # by parameters, times the width of their priors

    def marginal(self) -> Marginal:
        """Its parameters marginalised."""
        return self.with_discrepancy(np.zeros((len(self.left), 0)), (0.0,))[0]

    def with_discrepancy(
        self, directions: Float[np.ndarray, "row any"], sizes: Sequence[float]
    ) -> list[Marginal]:
        """Its parameters marginalised, and further directions with normal priors of some sizes."""
        arms, left = self.arms, self.left
        lower = np.linalg.cholesky(np.eye(arms.shape[1]) + arms.T @ arms)
        own = solve_triangular(lower, arms.T @ np.column_stack([left, directions]), lower=True)
        # At the best fit no parameter would lower χ²: where a fit ended before, none is said to.
        square = float(left @ left)
        volume = -float(np.sum(np.log(np.diag(lower))))
        overlap = directions.T @ directions - own[:, 1:].T @ own[:, 1:]
        along = directions.T @ left - own[:, 1:].T @ own[:, 0]
        values, vectors = np.linalg.eigh(overlap)
        values, along = np.maximum(values, 0.0), (along @ vectors) ** 2
        return [
            Marginal(
                len(left),
                square - float(np.sum(size**2 * along / (1 + size**2 * values))),
                volume - 0.5 * float(np.sum(np.log1p(size**2 * values))),
            )
            for size in sizes
        ]


def fitted_answer(misfit: WeightedMisfit, fit: EffectFit) -> FittedAnswer | None:
    """A fit with the priors of its parameters; None where it has no motion."""
    left = misfit.noise.decorrelated(fit.rows)
    if not fit.kinds:
        return FittedAnswer((), left, np.zeros((len(left), 0)))
    scales = scales_of(misfit.predictions)
    law = coordinates(fit.labels, scales.amplitude)
    slopes = law.slopes(fit.values, fit.slopes)
    arms = misfit.noise.decorrelated(slopes.T).T
    if not (np.all(np.isfinite(left)) and np.all(np.isfinite(arms))):
        return None
    width = np.zeros(len(fit.values))
    for kind in fit.kinds:
        mine = [k for k, label in enumerate(fit.labels) if label.startswith(f"{kind}.")]
        width[mine] = _widths(kind, law.inward(fit.values)[mine], scales)
    return FittedAnswer(fit.kinds, left, arms * width)


def _widths(
    kind: str, at: Float[np.ndarray, " parameter"], scales: MotionScales
) -> Float[np.ndarray, " parameter"]:
    """1σ of normal priors about a fit that are as high there as the stated priors."""
    one = candidate(kind, scales)
    law = coordinates([f"{kind}.{name}" for name in effect_parameters(kind)], scales.amplitude)
    starts = np.abs(law.inward(np.array(one.starts)))
    lower, upper = np.array(one.lower), np.array(one.upper)
    scale = np.median(starts, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    sides = np.where(lower == 0, 2.0, 1.0)
    height = sides / (np.pi * scale * (1 + (at / scale) ** 2))
    flat = np.isfinite(upper - lower)
    flat[0] = False
    height[flat] = 1 / (upper - lower)[flat]
    return 1 / (np.sqrt(2 * np.pi) * height)
