"""Labelled variables of periodic motions for data sets."""

import numpy as np
from jaxtyping import Array, Complex, Float

from snrmjax.measure.signals import peak_amplitude
from snrmjax.numerics.blocks import by_blocks
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.result import Variable

_BLOCK = 256  # points per call: one block size compiles once
_IN_PHASE, _AHEAD = "in phase with the force", "a quarter period ahead of the force"


def fundamental_variables(
    velocity: Complex[np.ndarray, "point harmonic sensor"],
) -> dict[str, Variable]:
    """Velocities (m/s) along a curve, under the column names of files."""
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
    """Velocities (m/s) of single motions, and other quantities: values, unit, meaning.

    A single batch axis is called `motion`; several are numbered.
    """
    phasors = np.asarray(velocity)
    axes = tuple(f"batch_{k}" for k in range(phasors.ndim - 2))
    axes = ("motion",) if len(axes) == 1 else axes
    wide = (*axes, "harmonic", "sensor_number")
    return {
        **{name: Variable(axes, np.asarray(v), *about) for name, (v, *about) in others.items()},
        "velocity_re_m_s": Variable(wide, phasors.real, "m/s", _IN_PHASE),
        "velocity_im_m_s": Variable(wide, phasors.imag, "m/s", _AHEAD),
    }


def velocity_peaks(
    velocity: Complex[np.ndarray, "point harmonic *sensor"],
) -> Float[np.ndarray, "point *sensor"]:
    """Peak of the time signal at every point and sensor; its mean is zero."""
    orders = tuple(range(1, velocity.shape[1]))
    harmonics = np.moveaxis(velocity[:, 1:], 1, -1)
    (peaks,) = by_blocks(lambda rows: (_peaks(rows, orders),), _BLOCK, harmonics)
    return peaks


_peaks = compiled(peak_amplitude)
