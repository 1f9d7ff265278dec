"""Where model and data disagree, before any name: stiffness, damping, harmonics, or neither."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.diagnose.evidence import Bench, Fit, unlikely

_FREE = 6  # of a free curve of amplitude
_SEEN = 2.0  # 1σ of a free curve beyond which an amplitude belongs to the range
_P_VALUE = 1e-3


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
    """Fit free curves of stiffness and damping to the force, and judge every part by itself."""
    weighing, states = bench.weighing, bench.predictions.states
    speed = np.abs(states[4][:, 0])
    of_force = weighing.column < 2
    amplitude = np.log(speed / speed.max())
    knots = np.quantile(amplitude, np.linspace(0, 1, _FREE))
    knots = knots + 1e-9 * np.arange(_FREE)
    hats = np.stack([np.interp(amplitude, knots, row) for row in np.eye(_FREE)], axis=1)
    both = [bench.by_linear[:, [k]] * hats[weighing.state] for k in range(2)]
    rows = np.where(of_force, base.rows, 0.0)
    force = _Rows(bench, of_force)
    nothing = force.chi_square(rows, np.zeros((len(rows), 0)))[0]
    free, values, covariance = force.chi_square(rows, np.concatenate(both, axis=1))
    parts = []
    for k, name in enumerate(("stiffness", "damping")):
        without = force.chi_square(rows, both[1 - k])[0]
        p_value = unlikely(without - free, _FREE)
        if p_value < _P_VALUE:
            own = slice(k * _FREE, (k + 1) * _FREE)
            parts.append(
                Located(
                    name,
                    _range(speed, hats, values[own], covariance[own, own]),
                    p_value,
                    *_exponent(knots, values[own], covariance[own, own]),
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


def _range(
    speed: np.ndarray, hats: np.ndarray, values: np.ndarray, covariance: np.ndarray
) -> tuple[float, float]:
    curve = hats @ values
    std = np.sqrt(np.maximum(np.einsum("sk,kl,sl->s", hats, covariance, hats), 0.0))
    seen = np.abs(curve) > _SEEN * std
    where = speed[seen] if seen.any() else speed
    return float(where.min()), float(where.max())


def _exponent(
    logarithm: np.ndarray, values: np.ndarray, covariance: np.ndarray
) -> tuple[float | None, float | None]:
    """Slope of log |change| against log amplitude, where the change has one sign."""
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    sure = np.abs(values) > 2 * std
    if sure.sum() < 3 or len(set(np.sign(values[sure]))) > 1:
        return None, None
    x, y, e = logarithm[sure], np.log(np.abs(values[sure])), std[sure] / np.abs(values[sure])
    weight = 1 / np.maximum(e, 0.02) ** 2
    mean = np.sum(weight * x) / np.sum(weight)
    spread = np.sum(weight * (x - mean) ** 2)
    if spread < 1e-6:
        return None, None
    return float(np.sum(weight * (x - mean) * y) / spread), float(1 / np.sqrt(spread))
