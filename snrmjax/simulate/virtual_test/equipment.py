"""Parameters of shaker, amplifier and instruments of the virtual laboratory."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.numerics.rules import InputError


class Shaker(NamedTuple):
    """An electrodynamic shaker on its amplifier: U = R i + G v_a, and G i moves the armature.

    A stiff stinger moves the armature with the drive point. The force cell sits between stinger
    and structure. The amplifier clips voltage, then current.
    """

    resistance: float = 3.0  # ohm
    motor_constant: float = 15.0  # N/A, and V s/m
    mass: float = 0.0  # kg, armature and the shaker side of the force cell
    damping: float = 0.0  # N s/m
    stiffness: float = 0.0  # N/m, of the armature's suspension
    largest_voltage: float = np.inf  # V, of the amplifier
    largest_current: float = np.inf  # A, of the amplifier


class Instruments(NamedTuple):
    """Noise and anti-alias filter of the force and velocity channels.

    The anti-alias filter, a Butterworth low-pass of `filter_order`, acts before sampling on both
    channels, so that their relative phase is preserved. Controllers see the recorded signals.
    """

    force_noise: float = 0.0  # N, 1σ of a sample
    velocity_noise: float = 0.0  # m/s, 1σ of a sample
    filter_corner_hz: float = np.inf  # of the anti-alias filter; infinite for none
    filter_order: int = 4


def check_shaker(shaker: Shaker) -> None:
    """Raise `ValueError` for impossible parameters of a shaker."""
    limits = min(shaker.largest_voltage, shaker.largest_current)
    if not (shaker.resistance > 0 and limits > 0 and np.min(shaker) >= 0):
        raise InputError(
            "a shaker's numbers must not be negative, and its resistance, `largest_voltage` and "
            f"`largest_current` must be positive, but are {shaker}."
        )
    if not np.isfinite(shaker[:5]).all():
        raise InputError(f"only the amplifier's limits may be infinite, but {shaker} has others.")


def check_instruments(instruments: Instruments, sampling_rate: float) -> None:
    """Raise `ValueError` for impossible parameters of the instruments at this rate (Hz)."""
    force, velocity, corner, order = instruments
    if min(force, velocity) < 0:
        raise InputError(f"the instruments' noise must not be negative, but is {instruments}.")
    good = int(order) == order and order >= 1
    if not (good and (0 < corner <= sampling_rate / 2 or corner == np.inf)):
        raise InputError(
            f"`filter_corner_hz` must be positive and at most half the sampling rate, "
            f"{sampling_rate / 2:g} Hz, or infinite, and `filter_order` a whole number of at least "
            f"1, but are {corner:g} Hz and {order}."
        )


def filter_sections(instruments: Instruments, rate: float) -> Float[np.ndarray, "section 6"]:
    """Second-order sections of the anti-alias filter at a rate in Hz; empty without a filter."""
    from scipy.signal import butter

    if not np.isfinite(instruments.filter_corner_hz):
        return np.zeros((0, 6))
    return butter(instruments.filter_order, instruments.filter_corner_hz, fs=rate, output="sos")
