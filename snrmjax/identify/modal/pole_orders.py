"""Poles of frequency responses over model orders: least-squares complex frequency estimator.

The common-denominator form with complex coefficients, on a z-plane whose circle is the band, for
lines at any spacing and with weights.
Reference: Guillaume, Verboven, Vanlanduit, Van der Auweraer & Peeters, Proc. IMAC-XXI (2003);
Verboven, PhD thesis, Vrije Universiteit Brussel (2002), section 5.3.3.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

_ARC = 0.9 * 2 * np.pi  # of the circle, covered by the band
_STABLE = 0.2  # of the decay rate: largest change of a stable pole from one order to the next
_NEAR = 0.5  # of the decay rate: largest distance of poles of one cluster
_FLOOR = 2e-5  # of a frequency, below which poles count as equal
_FRACTION = 0.3  # smallest fraction of the orders, from its first on, with a pole in a cluster
_FEWEST_ORDERS = 3
LIGHTLY_DAMPED = 0.25
"""Damping ratio below which a pole may be a mode."""


class PoleOrders(NamedTuple):
    """Poles of all model orders, one entry each; see `poles_of_responses` and `poles_of_decay`."""

    order: Int[np.ndarray, " pole"]
    pole: Complex[np.ndarray, " pole"]  # rad/s, imaginary part positive
    stable: np.ndarray  # whether a pole of the order below is near
    highest: int  # order

    @property
    def natural_frequency(self) -> Float[np.ndarray, " pole"]:
        """|λ| in rad/s."""
        return np.abs(self.pole)

    @property
    def damping_ratio(self) -> Float[np.ndarray, " pole"]:
        """−Re λ/|λ|."""
        return -self.pole.real / np.abs(self.pole)


def poles_of_responses(
    omega: Float[np.ndarray, " line"],
    values: Complex[np.ndarray, "channel line"],
    weights: Float[np.ndarray, "channel line"],
    highest: int,
) -> PoleOrders:
    """Poles in the band of orders 1 to `highest`.

    Arguments: `values` as measured, zero where `weights` are zero.
    """
    start, width = omega[0], omega[-1] - omega[0]
    rate = _ARC / width
    powers = np.exp(1j * rate * np.outer(omega - start, np.arange(highest + 1)))
    n = highest + 1
    blocks = []
    for row, weight in zip(values, weights, strict=True):
        x = powers * weight[:, None]
        y = -x * row[:, None]
        blocks.append((x.conj().T @ x, x.conj().T @ y, y.conj().T @ y))
    by_order: list[tuple[int, np.ndarray]] = []
    for order in range(1, n):
        part = slice(0, order + 1)
        reduced = np.zeros((order + 1, order + 1), dtype=complex)
        for r, s, t in blocks:
            inside = np.linalg.lstsq(r[part, part], s[part, part], rcond=1e-12)[0]
            reduced += t[part, part] - s[part, part].conj().T @ inside
        # The lowest coefficient is one: spurious poles then lie outside the unit circle.
        rest = np.linalg.lstsq(reduced[1:, 1:], -reduced[1:, 0], rcond=1e-14)[0]
        roots = np.roots(np.concatenate([[1.0], rest])[::-1])
        roots = roots[np.abs(roots) > 0]
        angle = np.angle(roots) % (2 * np.pi)
        pole = (np.log(np.abs(roots)) + 1j * angle) / rate + 1j * start
        by_order.append((order, pole[(angle > 0) & (angle < _ARC)]))
    return gathered(by_order, highest)


def gathered(
    by_order: Sequence[tuple[int, Complex[np.ndarray, " pole"]]], highest: int
) -> PoleOrders:
    """Poles of all orders, with their stability."""
    stable, before = [], np.empty(0, dtype=complex)
    for _, poles in by_order:
        near = np.abs(poles[:, None] - before) < _STABLE * np.abs(poles.real[:, None])
        near |= np.abs(poles[:, None] - before) < _FLOOR * np.abs(poles[:, None])
        stable.append(near.any(axis=1) if before.size else np.zeros(poles.shape, dtype=bool))
        before = poles
    order = np.concatenate([np.full(poles.size, n) for n, poles in by_order]).astype(int)
    all_poles = np.concatenate([poles for _, poles in by_order])
    return PoleOrders(order, all_poles, np.concatenate(stable), highest)


def clusters(
    orders: PoleOrders, band: tuple[float, float] = (0.0, np.inf)
) -> Complex[np.ndarray, " cluster"]:
    """Clusters of stable poles over the model orders: lightly damped or growing, in the band.

    Medians of the clusters by frequency, rad/s; the real part is negative for decaying ones.
    """
    ratio = np.abs(orders.damping_ratio)
    use = orders.stable & (ratio < LIGHTLY_DAMPED) & (ratio > 0)
    use &= (orders.natural_frequency >= band[0]) & (orders.natural_frequency <= band[1])
    model_order, pole = orders.order[use], orders.pole[use]
    means: list[complex] = []
    left = np.ones(pole.size, dtype=bool)
    while left.any():
        rest, at = pole[left], model_order[left]
        decay = np.abs(rest.real)
        reach = np.maximum(_NEAR * 0.5 * (decay[:, None] + decay), _FLOOR * np.abs(rest))
        near = (np.abs(rest[:, None] - rest) < reach) & (rest.real[:, None] * rest.real > 0)
        # The pole with most neighbours and the nearest pole of each order form the next cluster:
        # two poles of one order are two modes, however near.
        seed = int(np.argmax(near.sum(axis=1)))
        members = _nearest_of_each(at, np.abs(rest - rest[seed]), near[seed])
        count, first = len(np.unique(at[members])), at[members].min()
        if count >= max(_FEWEST_ORDERS, _FRACTION * (orders.highest - first + 1)):
            mine = rest[members]
            means.append(complex(np.median(mine.real), np.median(mine.imag)))
        left[np.flatnonzero(left)[members]] = False
    centres = np.array(means, dtype=complex)
    return centres[np.argsort(centres.imag, kind="stable")]


def _nearest_of_each(order: np.ndarray, distance: np.ndarray, among: np.ndarray) -> np.ndarray:
    """Mask of the nearest pole of every order."""
    chosen = np.zeros(len(order), dtype=bool)
    for number in np.unique(order[among]):
        rows = np.flatnonzero(among & (order == number))
        chosen[rows[np.argmin(distance[rows])]] = True
    return chosen
