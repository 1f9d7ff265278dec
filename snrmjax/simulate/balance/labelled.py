"""Quantities of periodic motions as results label them."""

import numpy as np
from jaxtyping import Array, Complex, Float

from snrmjax.measure.signals import peak_amplitude
from snrmjax.numerics.blocks import by_blocks
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.result import Variable

HERTZ = 2 * np.pi
_BLOCK = 256  # points whose peaks are found at a time: one size compiles once
_IN_PHASE, _AHEAD = "in phase with the force", "a quarter period ahead of the force"


def fundamental_variables(
    velocity: Complex[np.ndarray, "point harmonic sensor"],
) -> dict[str, Variable]:
    """Velocities (m/s) along a curve, by the names of the files' columns."""
    at, fundamental = ("point", "sensor"), velocity[:, 1]
    return {
        "velocity_h1_re_m_s": Variable(
            at, fundamental.real, "m/s", f"velocity fundamental, {_IN_PHASE}"
        ),
        "velocity_h1_im_m_s": Variable(
            at, fundamental.imag, "m/s", f"velocity fundamental, {_AHEAD}"
        ),
        "velocity_peak_m_s": Variable(at, velocity_peaks(velocity), "m/s", "largest over a period"),
    }


def batch_variables(
    velocity: Complex[Array, "*batch harmonic sensor"], **others: tuple[object, str, str]
) -> dict[str, Variable]:
    """Velocities (m/s) of motions one by one, and other quantities of each: values, unit, meaning.

    One axis is called `motion`; of several each has a number.
    """
    phasors = np.asarray(velocity)
    axes = tuple(f"batch_{k}" for k in range(phasors.ndim - 2))
    axes = ("motion",) if len(axes) == 1 else axes
    wide = (*axes, "harmonic", "sensor_number")
    return {
        **{name: Variable(axes, np.asarray(v), *said) for name, (v, *said) in others.items()},
        "velocity_re_m_s": Variable(wide, phasors.real, "m/s", _IN_PHASE),
        "velocity_im_m_s": Variable(wide, phasors.imag, "m/s", _AHEAD),
    }


def velocity_peaks(
    velocity: Complex[np.ndarray, "point harmonic *sensor"],
) -> Float[np.ndarray, "point *sensor"]:
    """Peak of the time signal at every point and sensor, without the mean (which is 0)."""
    orders = tuple(range(1, velocity.shape[1]))
    harmonics = np.moveaxis(velocity[:, 1:], 1, -1)
    (peaks,) = by_blocks(lambda rows: (_peaks(rows, orders),), _BLOCK, harmonics)
    return peaks


_peaks = compiled(peak_amplitude)
