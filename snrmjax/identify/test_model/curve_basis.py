"""Smooth curves of amplitude as sums of fixed functions with prior variances.

A constant, a and a², and a Gaussian process (Matérn 5/2 in the logarithm of amplitude) as a sum of
sines whose variances are its spectral density: length and size of the process are in the variances
alone, so that the functions are evaluated once. Beyond the range it fades: there the powers speak.
Reference: Solin & Särkkä, Stat. Comput. 30 (2020) 419, doi:10.1007/s11222-019-09886-w.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.identify.test_model.priors import CURVE_CONSTANT, CURVE_SLOPES

_SINES = 24
_ROOM = 1.5  # half length of the sines' domain, over half the range
_FLOOR = 0.03  # of the largest amplitude, at most: below it the logarithm is bent straight
N_POWERS = 3
N_FUNCTIONS = N_POWERS + _SINES
LENGTHS = (0.2, 3.0)
"""Of the range: shorter ones the sines do not follow, longer ones are parabolas."""


class CurveBasis(NamedTuple):
    """The functions for one range of amplitudes."""

    largest: float  # m
    low: float  # ends of the range in the bent logarithm
    high: float
    floor: float  # of the largest amplitude

    @classmethod
    def of(cls, amplitude: Float[np.ndarray, " state"]) -> "CurveBasis":
        """For measured amplitudes."""
        largest, smallest = float(np.max(amplitude)), float(np.min(amplitude))
        floor = min(_FLOOR, smallest / largest)
        low, high = (float(np.log(u + floor)) for u in (smallest / largest, 1.0))
        return cls(largest, min(low, high - 0.3), high, floor)

    def values(
        self, amplitude: Float[np.ndarray, " point"]
    ) -> tuple[Float[np.ndarray, "point function"], Float[np.ndarray, "point function"]]:
        """The functions, and their derivatives by the logarithm of amplitude."""
        u = np.asarray(amplitude, dtype=float) / self.largest
        x, slope = np.log(u + self.floor), u / (u + self.floor)
        half = 0.5 * _ROOM * (self.high - self.low)
        rate = np.pi * np.arange(1, _SINES + 1) / (2 * half)
        # Beyond the domain the process is what it is at its end.
        inside = np.abs(x - self._middle) < half
        at = np.clip(x - self._middle, -half, half)[:, None] + half
        sines = np.sin(rate * at) / np.sqrt(half)
        cosines = np.where(inside, slope, 0.0)[:, None] * rate * np.cos(rate * at) / np.sqrt(half)
        one = np.ones_like(u)
        return (
            np.column_stack([one, u, u**2, sines]),
            np.column_stack([0 * one, u, 2 * u**2, cosines]),
        )

    def log_variances(
        self, log_size: float, log_length: float
    ) -> tuple[Float[np.ndarray, " function"], Float[np.ndarray, "function two"]]:
        """ln of the prior variances by the process's size and length, and their slopes.

        The length is over the range. The powers have variances of their own.
        """
        span = self.high - self.low
        length = np.exp(log_length) * span
        rate = np.pi * np.arange(1, _SINES + 1) / (_ROOM * span)
        of_rate = 5 / length**2 + rate**2
        density = np.log(16 / 3) + 2 * log_size + 2.5 * np.log(5) - 5 * np.log(length)
        density = density - 3 * np.log(of_rate)
        powers = 2 * np.log([CURVE_CONSTANT, CURVE_SLOPES, CURVE_SLOPES])
        slopes = np.zeros((N_FUNCTIONS, 2))
        slopes[N_POWERS:, 0] = 2.0
        slopes[N_POWERS:, 1] = -5 + 30 / length**2 / of_rate
        return np.concatenate([powers, density]), slopes

    @property
    def _middle(self) -> float:
        return 0.5 * (self.low + self.high)
