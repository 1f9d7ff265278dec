"""Phasors of a record: tracked sample by sample by a controller, or fitted to a whole record.

The filter updates the Fourier coefficients at each sample along the gradient of the squared error
of the series (least mean squares): a band-pass of half width `rate` about every harmonic.

Reference: B. Widrow & S. D. Stearns, Adaptive Signal Processing (1985), chapter 12.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

HANN = 1.5  # noise bandwidth of a Hann window over that of a rectangular one
PARTS = 10  # of a record, for its scatter
_MOST_HARMONICS = 9  # removed from a record to estimate its noise


class ControlledMotion(NamedTuple):
    """A motion under control: fundamentals over the recorded part and their errors, 1σ.

    NaN if not available; without `on_target` the target was missed or the motion was not steady.
    """

    on_target: bool
    frequency: float  # rad/s
    frequency_std: float = np.nan  # rad/s; NaN where the frequency is prescribed
    force: complex = complex(np.nan)  # N
    velocity: complex = complex(np.nan)  # m/s
    ratio_std: float = np.nan  # of force over velocity, relative: of real and imaginary part each
    velocity_std: float = np.nan  # relative
    invasive: float = np.nan  # higher harmonics of the voltage over its fundamental


class FourierState(NamedTuple):
    """State of the filters: complex amplitudes (peak) and means."""

    harmonics: Complex[Array, "channel order"]
    means: Float[Array, " channel"]


def empty_filter(channels: int, orders: Int[np.ndarray, " order"]) -> FourierState:
    """The state before the first sample."""
    return FourierState(jnp.zeros((channels, len(orders)), dtype=complex), jnp.zeros(channels))


def followed(
    state: FourierState,
    seen: Float[Array, " channel"],
    angle: Float[Array, ""],
    orders: Int[np.ndarray, " order"],
    fraction: Float[Array, ""],
) -> FourierState:
    """The state after one sample of each channel.

    Arguments: `angle` of the fundamental in rad; `fraction` is the filter's rate times the sampling
    period, by which the error of a coefficient decays per sample.
    """
    basis = jnp.exp(1j * orders * angle)
    error = seen - state.means - jnp.real(state.harmonics @ basis)
    return FourierState(
        state.harmonics + 2 * fraction * error[:, None] * jnp.conj(basis),
        state.means + fraction * error,
    )


def through_hann_window(
    signal: Float[np.ndarray, " sample"], angle: Float[np.ndarray, "*order sample"]
) -> Complex[np.ndarray, "*order sample"]:
    """A signal demodulated by an angle, through a Hann window; its mean is the amplitude.

    A record need not contain whole cycles.
    """
    window = np.hanning(len(signal))
    return signal * (2 * np.exp(-1j * angle) * (window / window.mean()))


def noise_of_sample(
    signal: Float[np.ndarray, " sample"], angle: Float[np.ndarray, " sample"]
) -> float:
    """1σ of a sample: the residual of a record without its mean and harmonics of the drive."""
    design, solved = _series(signal, angle)
    return float(np.std(signal - design @ solved))


def scatter_of_ratio(
    force: Float[np.ndarray, " sample"],
    velocity: Float[np.ndarray, " sample"],
    angle: Float[np.ndarray, " sample"],
) -> float:
    """Relative 1σ of mean force over velocity, of each component, from parts of a record."""

    def fundamental(signal: np.ndarray, angle: np.ndarray) -> complex:
        _, solved = _series(signal, angle)
        return complex(solved[1] - 1j * solved[1 + _MOST_HARMONICS])

    parts = np.array_split(np.arange(len(angle)), PARTS)
    each = np.array(
        [fundamental(force[k], angle[k]) / fundamental(velocity[k], angle[k]) for k in parts]
    )
    spread = np.abs(each - each.mean()) / abs(each.mean())
    return float(np.sqrt(np.sum(spread**2) / (2 * (PARTS - 1) * PARTS)))


def _series(signal: np.ndarray, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean, cosines and sines of the drive's harmonics, and their fitted amplitudes."""
    angles = angle[:, None] * np.arange(1, _MOST_HARMONICS + 1)
    design = np.concatenate([np.ones((len(angle), 1)), np.cos(angles), np.sin(angles)], axis=1)
    return design, np.linalg.lstsq(design, signal, rcond=None)[0]
