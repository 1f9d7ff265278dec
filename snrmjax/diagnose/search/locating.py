"""Which part of the force balance disagrees: stiffness, damping, harmonics, or none of them."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from scipy.optimize import least_squares

from snrmjax.diagnose import priors
from snrmjax.diagnose.misfit.effect_fit import EffectFit
from snrmjax.diagnose.misfit.noise_model import chi_square_p_value
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit

_FREE = 6  # of a free curve of amplitude


class Located(NamedTuple):
    """One part of the force balance in which model and data disagree."""

    part: str
    velocity_range: tuple[float, float]  # m/s
    p_value: float
    exponent: float | None = None  # power of amplitude with which the part changes
    exponent_std: float | None = None


def locate_misfit(misfit: WeightedMisfit, base: EffectFit) -> tuple[Located, ...]:
    """Fit free curves of stiffness and damping to the force, and test every part by itself.

    Where sizes alone are compared, states off resonance determine the stiffness and those near it
    the damping: a part that the other one can explain as well is not reported.
    """
    noise, states = misfit.noise, misfit.predictions.states
    speed = np.abs(states.velocity[:, 0])
    of_force = noise.column < 2
    amplitude = np.log(speed / speed.max())
    knots = np.quantile(amplitude, np.linspace(0, 1, _FREE))
    knots = knots + 1e-9 * np.arange(_FREE)
    hats = np.stack([np.interp(amplitude, knots, row) for row in np.eye(_FREE)], axis=1)
    rows = np.where(of_force, base.rows, 0.0)
    force = _Rows(misfit, of_force)
    nothing = float(np.sum(force.decorrelated(rows) ** 2))
    both = [_curves(misfit, rows, hats, [k]) for k in range(2)]
    alone = [force.fitted(curves, np.zeros(_FREE)) for curves in both]
    starts = (np.append(alone[0][1], np.zeros(_FREE)), np.append(np.zeros(_FREE), alone[1][1]))
    together = _curves(misfit, rows, hats, [0, 1])
    fits = [force.fitted(together, start) for start in starts]
    free, values, covariance = min(fits, key=lambda fit: fit[0])
    # Sizes are not linear: what curves of few knots leave adds uncertainty.
    if np.any(together.weight > 0):
        covariance = covariance * max(free / max(int(of_force.sum()) - 2 * _FREE, 1), 1.0)
    parts = []
    for k, name in enumerate(("stiffness", "damping")):
        p_value = chi_square_p_value(alone[1 - k][0] - free, _FREE)
        if p_value < priors.REJECTED:
            some = slice(k * _FREE, (k + 1) * _FREE)
            own, spread = values[some], covariance[some, some]
            std = np.sqrt(np.maximum(np.einsum("sk,kl,sl->s", hats, spread, hats), 0.0))
            seen = np.abs(hats @ own) > 2 * std
            where = speed[seen] if seen.any() else speed
            ends = float(where.min()), float(where.max())
            parts.append(Located(name, ends, p_value, *power_of_amplitude(knots, own, spread)))
    n_force = int(of_force.sum())
    left = chi_square_p_value(free, n_force - 2 * _FREE)
    everywhere = (float(speed.min()), float(speed.max()))
    if left < priors.REJECTED and nothing > n_force:
        parts.append(Located("not_a_function_of_amplitude", everywhere, left))
    n_sensors = states.velocity.shape[1]
    orders = misfit.predictions.chosen.orders
    for place, order in enumerate(orders):
        if order not in (2, 3):
            continue
        first = 2 * (n_sensors + place)
        mine = (noise.column >= first) & (noise.column < first + 2)
        if not mine.any():
            continue
        left_of = _Rows(misfit, mine).decorrelated(np.where(mine, base.rows, 0.0))
        p_value = chi_square_p_value(float(left_of @ left_of), int(mine.sum()))
        if p_value < priors.REJECTED:
            large = np.abs(base.rows[mine]) > 2.5
            where = speed[noise.state[mine][large]] if large.any() else speed
            parts.append(
                Located(f"harmonic_{order}", (float(where.min()), float(where.max())), p_value)
            )
    return tuple(parts)


def power_of_answer(
    misfit: WeightedMisfit, baseline: EffectFit, fit: EffectFit, part: str
) -> float | None:
    """The power of amplitude with which a fitted answer changes a part, found as in the data.

    A law has its power to lowest order only: softening by q² has terms of the fourth power of the
    amplitude too. None where the answer follows no power or does not change the part.
    """
    if misfit.predictions.chosen.phase_unknown.any():
        return None  # sizes are not linear in what an answer changes
    alone = baseline._replace(rows=baseline.rows - fit.rows)
    powers = [one.exponent for one in locate_misfit(misfit, alone) if one.part == part]
    return powers[0] if powers else None


class _Curves(NamedTuple):
    """Rows with free curves added to the baseline: linear in them, except for sizes."""

    rows: Float[np.ndarray, " row"]
    arms: Float[np.ndarray, "row value"]
    force: Complex[np.ndarray, " row"]  # the model's, over the measured one
    by_value: Complex[np.ndarray, "row value"]
    weight: Float[np.ndarray, " row"]  # of the force's size where that alone is compared; else 0

    def at(self, values: Float[np.ndarray, " value"]) -> tuple[np.ndarray, np.ndarray]:
        """Rows and slopes."""
        rows, force = self.rows + self.arms @ values, self.force + self.by_value @ values
        size, alone = np.abs(force), self.weight > 0
        unit = force.conj() / np.where(size > 0, size, 1.0)
        arms = self.weight[:, None] * np.real(unit[:, None] * self.by_value)
        of_size = self.weight * (size - 1)
        return np.where(alone, of_size, rows), np.where(alone[:, None], arms, self.arms)


def _curves(
    misfit: WeightedMisfit, rows: np.ndarray, hats: np.ndarray, parts: list[int]
) -> _Curves:
    """Curves of stiffness (0) or damping (1), or of both."""
    noise = misfit.noise
    state, hats = noise.state, hats[noise.state]
    alone = misfit.predictions.sizes.alone[state, 0] & (noise.column == 0)
    return _Curves(
        rows,
        np.concatenate([misfit.by_linear[:, [k]] * hats for k in parts], axis=1),
        misfit.baseline.force[state],
        np.concatenate(
            [misfit.baseline.force_by_linear[state][:, [k]] * hats for k in parts], axis=1
        ),
        np.where(alone, noise.whiten[state, 0, 0], 0.0),
    )


class _Rows:
    """Least squares on some of the rows."""

    def __init__(self, misfit: WeightedMisfit, keep: np.ndarray):
        self.keep = keep
        self.covariance = misfit.noise.covariance.of_rows(keep)

    def decorrelated(self, rows: np.ndarray) -> np.ndarray:
        """The kept ones of rows, or of columns of them, made independent and of unit variance."""
        return self.covariance.decorrelated(rows[self.keep].T).T

    def chi_square(
        self, rows: np.ndarray, columns: Float[np.ndarray, "row column"]
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """χ², the most likely values of some columns, and their covariance."""
        left, arms = self.decorrelated(rows), self.decorrelated(columns)
        size = np.linalg.norm(arms, axis=0)
        size = np.where(size > 0, size, 1.0)
        inverse = np.linalg.pinv((arms / size).T @ (arms / size), rcond=1e-10, hermitian=True)
        values = -inverse @ ((arms / size).T @ left)
        left = left + (arms / size) @ values
        return float(left @ left), values / size, inverse / np.outer(size, size)

    def fitted(
        self, curves: _Curves, start: Float[np.ndarray, " value"]
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """χ², values and their covariance; by Levenberg–Marquardt where sizes are compared."""
        if not np.any(curves.weight > 0):
            return self.chi_square(curves.rows, curves.arms)

        def part(k: int) -> Callable[[np.ndarray], np.ndarray]:
            return lambda values: self.decorrelated(curves.at(values)[k])

        found = least_squares(part(0), start, part(1), method="lm")
        return 2 * float(found.cost), found.x, self.chi_square(*curves.at(found.x))[2]


def power_of_amplitude(
    logarithm: np.ndarray, values: np.ndarray, covariance: np.ndarray
) -> tuple[float | None, float | None]:
    """The power of amplitude that a free curve follows, and 1σ; None where it follows none.

    Least squares on the curve with its full covariance: uncertainty of the linear parameters
    moves every amplitude alike, and changes that are not significant by themselves are kept.
    """
    step = 0.01
    powers = np.arange(-4.0, 8.0, step)
    # Straight pieces miss a power by a fiftieth of the change.
    straight = (0.02 * values) ** 2 + 1e-12 * np.trace(covariance)
    doubt = covariance + np.diag(straight)
    root = np.linalg.inv(np.linalg.cholesky(doubt))
    curve, shapes = root @ values, root @ np.exp(np.outer(logarithm, powers))
    explained = (curve @ shapes) ** 2 / np.sum(shapes**2, axis=0)
    best = int(np.argmax(explained))
    left = float(curve @ curve - explained[best])
    if explained[best] < priors.TELLING or chi_square_p_value(left, _FREE - 2) < priors.REJECTED:
        return None, None
    below = np.flatnonzero(explained > explained[best] - 1.0)
    if below[0] == 0 or below[-1] == len(powers) - 1:
        return None, None
    return float(powers[best]), float(0.5 * (powers[below[-1]] - powers[below[0]]) + step / 2)
