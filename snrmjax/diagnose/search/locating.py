"""Where model and data disagree, before any name: stiffness, damping, harmonics, or neither."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from snrmjax.diagnose.misfit.effect_fit import Bench, Fit, unlikely

_FREE = 6  # of a free curve of amplitude
_SEEN = 2.0  # 1σ of a free curve beyond which an amplitude belongs to the range
_P_VALUE = 1e-3
_STEP = 0.01
_POWERS = np.arange(-4.0, 8.0, _STEP)  # of amplitude, among which one is looked for
_TELLING = 16.0  # of χ², that a power must explain before it is told
_STEPS, _SETTLED = 30, 0.02  # of a fit of curves to sizes, and the change of χ² that ends it
_STRAIGHT = 0.02  # of a change, by which straight pieces miss a power


class Located(NamedTuple):
    """One part of the disagreement."""

    part: str
    velocity_range: tuple[float, float]  # m/s
    p_value: float
    exponent: float | None = None  # of the change against amplitude
    exponent_std: float | None = None


class FreeFit(NamedTuple):
    """Stiffness and damping as free functions of amplitude, on top of the baseline."""

    chi_square: float
    freedom: int
    parts: tuple[Located, ...]

    @property
    def p_value(self) -> float:
        """Of what no function of amplitude explains."""
        return unlikely(self.chi_square, self.freedom)


def located(bench: Bench, base: Fit) -> FreeFit:
    """Fit free curves of stiffness and damping to the force, and judge every part by itself.

    Where sizes alone are compared, states off resonance tell the stiffness and those near it the
    damping: a part that hides behind the other is not told.
    """
    weighing, states = bench.weighing, bench.predictions.states
    speed = np.abs(states[4][:, 0])
    of_force = weighing.column < 2
    amplitude = np.log(speed / speed.max())
    knots = np.quantile(amplitude, np.linspace(0, 1, _FREE))
    knots = knots + 1e-9 * np.arange(_FREE)
    hats = np.stack([np.interp(amplitude, knots, row) for row in np.eye(_FREE)], axis=1)
    rows = np.where(of_force, base.rows, 0.0)
    force = _Rows(bench, of_force)
    nothing = force.chi_square(rows, np.zeros((len(rows), 0)))[0]
    both = [_curves(bench, rows, hats, [k]) for k in range(2)]
    alone = [force.fitted(curves, np.zeros(_FREE)) for curves in both]
    starts = (np.append(alone[0][1], np.zeros(_FREE)), np.append(np.zeros(_FREE), alone[1][1]))
    together = _curves(bench, rows, hats, [0, 1])
    fits = [force.fitted(together, start) for start in starts]
    free, values, covariance = min(fits, key=lambda fit: fit[0])
    if np.any(together.weight > 0):  # sizes bend: what curves of few knots leave is doubt as well
        covariance = covariance * max(free / max(int(of_force.sum()) - 2 * _FREE, 1), 1.0)
    parts = []
    for k, name in enumerate(("stiffness", "damping")):
        p_value = unlikely(alone[1 - k][0] - free, _FREE)
        if p_value < _P_VALUE:
            own = slice(k * _FREE, (k + 1) * _FREE)
            parts.append(
                Located(
                    name,
                    _range(speed, hats, values[own], covariance[own, own]),
                    p_value,
                    *power_of_amplitude(knots, values[own], covariance[own, own]),
                )
            )
    n_force = int(of_force.sum())
    left = unlikely(free, n_force - 2 * _FREE)
    everywhere = (float(speed.min()), float(speed.max()))
    if left < _P_VALUE and nothing > n_force:
        parts.append(Located("not_a_function_of_amplitude", everywhere, left))
    n_sensors = states[4].shape[1]
    orders = bench.predictions.chosen.orders
    for place, order in enumerate(orders):
        if order not in (2, 3):
            continue
        first = 2 * (n_sensors + place)
        mine = (weighing.column >= first) & (weighing.column < first + 2)
        if not mine.any():
            continue
        square = _Rows(bench, mine).chi_square(
            np.where(mine, base.rows, 0.0), np.zeros((len(rows), 0))
        )[0]
        p_value = unlikely(square, int(mine.sum()))
        if p_value < _P_VALUE:
            large = np.abs(base.rows[mine]) > 2.5
            where = speed[weighing.state[mine][large]] if large.any() else speed
            parts.append(
                Located(f"harmonic_{order}", (float(where.min()), float(where.max())), p_value)
            )
    return FreeFit(float(free), n_force - 2 * _FREE, tuple(parts))


def own_power(bench: Bench, nothing: Fit, fit: Fit, part: str) -> float | None:
    """The power of amplitude that a fitted answer itself has, located as in what was measured.

    A law has its power to lowest order only: softening by q² has terms of the fourth power of the
    amplitude too. None where the answer follows no power or does not change the part.
    """
    if bench.predictions.chosen.phase_unknown.any():
        return None  # sizes are not linear in what an answer changes
    alone = nothing._replace(rows=nothing.rows - fit.rows)
    powers = [one.exponent for one in located(bench, alone).parts if one.part == part]
    return powers[0] if powers else None


class _Curves(NamedTuple):
    """Rows with free curves on top of the baseline: linear in them, but for sizes."""

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


def _curves(bench: Bench, rows: np.ndarray, hats: np.ndarray, parts: list[int]) -> _Curves:
    """Curves of stiffness (0) or damping (1), or of both."""
    weighing = bench.weighing
    state, hats = weighing.state, hats[weighing.state]
    alone = bench.predictions.sizes.alone[state, 0] & (weighing.column == 0)
    return _Curves(
        rows,
        np.concatenate([bench.by_linear[:, [k]] * hats for k in parts], axis=1),
        bench.force[state],
        np.concatenate([bench.force_by_linear[state][:, [k]] * hats for k in parts], axis=1),
        np.where(alone, weighing.whiten[state, 0, 0], 0.0),
    )


class _Rows:
    """Least squares on some of the rows."""

    def __init__(self, bench: Bench, keep: np.ndarray):
        self.keep = keep
        self.root = np.linalg.inv(bench.weighing.of_rows(keep))

    def chi_square(
        self, rows: np.ndarray, columns: Float[np.ndarray, "row column"]
    ) -> tuple[float, np.ndarray, np.ndarray]:
        left = self.root @ rows[self.keep]
        if not columns.shape[1]:
            return float(left @ left), np.zeros(0), np.zeros((0, 0))
        arms = self.root @ columns[self.keep]
        size = np.linalg.norm(arms, axis=0)
        size = np.where(size > 0, size, 1.0)
        inverse = np.linalg.pinv((arms / size).T @ (arms / size), rcond=1e-10, hermitian=True)
        values = -inverse @ ((arms / size).T @ left)
        left = left + (arms / size) @ values
        return float(left @ left), values / size, inverse / np.outer(size, size)

    def fitted(
        self, curves: _Curves, start: Float[np.ndarray, " value"]
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """χ², values and their covariance; Levenberg–Marquardt from a start where sizes count."""
        if not np.any(curves.weight > 0):
            return self.chi_square(curves.rows, curves.arms)
        values, damping = start, 1e-3
        rows, slopes = curves.at(values)
        left = self.root @ rows[self.keep]
        for _ in range(_STEPS):
            arms = self.root @ slopes[self.keep]
            size = np.linalg.norm(arms, axis=0)
            size = np.where(size > 0, size, 1.0)
            matrix = (arms / size).T @ (arms / size) + damping * np.eye(len(size))
            moved = values - np.linalg.solve(matrix, (arms / size).T @ left) / size
            new_rows, new_slopes = curves.at(moved)
            new = self.root @ new_rows[self.keep]
            gained = float(left @ left - new @ new)
            if gained > 0:
                values, rows, slopes, left = moved, new_rows, new_slopes, new
            damping *= 0.1 if gained > 0 else 10.0
            if 0 < gained < _SETTLED or damping > 1e6:
                break
        return float(left @ left), values, self.chi_square(rows, slopes)[2]


def _range(
    speed: np.ndarray, hats: np.ndarray, values: np.ndarray, covariance: np.ndarray
) -> tuple[float, float]:
    curve = hats @ values
    std = np.sqrt(np.maximum(np.einsum("sk,kl,sl->s", hats, covariance, hats), 0.0))
    seen = np.abs(curve) > _SEEN * std
    where = speed[seen] if seen.any() else speed
    return float(where.min()), float(where.max())


def power_of_amplitude(
    logarithm: np.ndarray, values: np.ndarray, covariance: np.ndarray
) -> tuple[float | None, float | None]:
    """The power of amplitude that a free curve follows, and 1σ; None where it follows no power.

    Least squares on the curve itself with all its covariance: what the linear parameters leave
    open moves every amplitude alike, and small changes are kept although they are not seen.
    """
    straight = (_STRAIGHT * values) ** 2 + 1e-12 * np.trace(covariance)
    doubt = covariance + np.diag(straight)
    root = np.linalg.inv(np.linalg.cholesky(doubt))
    curve, shapes = root @ values, root @ np.exp(np.outer(logarithm, _POWERS))
    explained = (curve @ shapes) ** 2 / np.sum(shapes**2, axis=0)
    best = int(np.argmax(explained))
    left = float(curve @ curve - explained[best])
    if explained[best] < _TELLING or unlikely(left, _FREE - 2) < _P_VALUE:
        return None, None
    below = np.flatnonzero(explained > explained[best] - 1.0)
    if below[0] == 0 or below[-1] == len(_POWERS) - 1:
        return None, None
    return float(_POWERS[best]), float(0.5 * (_POWERS[below[-1]] - _POWERS[below[0]]) + _STEP / 2)
