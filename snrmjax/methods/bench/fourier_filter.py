"""Adaptive filters that follow the Fourier coefficients of signals, sample by sample.

At each sample the coefficients move along the gradient of the squared error of the series: a
least-mean-squares filter, which is a band-pass of half width `rate` about every harmonic.

Reference: B. Widrow & S. D. Stearns, Adaptive Signal Processing (1985), chapter 12.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int


class FourierState(NamedTuple):
    """What the filters know: complex amplitudes (peak) and means."""

    harmonics: Complex[Array, "channel order"]
    means: Float[Array, " channel"]

    def fundamental(self, channel: int) -> Complex[Array, ""]:
        """The first of the followed harmonics of one channel."""
        return self.harmonics[channel, 0]


def nothing_followed(channels: int, orders: Int[np.ndarray, " order"]) -> FourierState:
    """The state before the first sample."""
    return FourierState(jnp.zeros((channels, len(orders)), dtype=complex), jnp.zeros(channels))


def followed(
    state: FourierState,
    seen: Float[Array, " channel"],
    angle: Float[Array, ""],
    orders: Int[np.ndarray, " order"],
    share: Float[Array, ""],
) -> FourierState:
    """The state after one sample of each channel.

    Arguments: `angle` of the fundamental in rad; `share` is the filter's rate times the sampling
    period: what a coefficient forgets in a sample.
    """
    basis = jnp.exp(1j * orders * angle)
    error = seen - state.means - jnp.real(state.harmonics @ basis)
    return FourierState(
        state.harmonics + 2 * share * error[:, None] * jnp.conj(basis),
        state.means + share * error,
    )
