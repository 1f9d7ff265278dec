"""Stability of periodic motions from the monodromy matrix of the linearised equations."""

from enum import IntEnum

import numpy as np
from jaxtyping import Array, Complex, Float, Int

from snrmjax.model.structures import Structure
from snrmjax.numerics.blocks import over_cores, padded
from snrmjax.simulate.continuation.monodromy import monodromy

_BLOCK = 32  # points whose linearised motions are integrated side by side
MARGIN = 1e-6  # beyond the unit circle: what the multipliers of a conservative motion may err by


class Stability(IntEnum):
    """Whether a periodic motion is stable: what a small disturbance does to it."""

    NOT_COMPUTED = -1  # not asked for, or the multipliers could not be computed
    UNSTABLE = 0
    STABLE = 1


def floquet_multipliers(
    model: Structure,
    coefficients: Float[Array | np.ndarray, "point coefficient mode"],
    frequency: Float[Array | np.ndarray, " point"],
    *,
    steps_per_cycle: int = 6,
) -> Complex[np.ndarray, "point multiplier"]:
    """Floquet multipliers of periodic motions: eigenvalues of the map over one period.

    Integrates m δq̈ + C(t)δq̇ + K(t)δq = 0 with the tangent matrices along the motion, by methods
    that keep a conservative structure's multipliers on the unit circle, however light the
    damping: kicked oscillators, of order 4, for a potential alone, and Magnus' method of order 6
    where other forces act (see `monodromy`). Sliders are linearised as they are: dragged or
    stuck. A motion is stable when all multipliers lie inside the unit circle.

    Arguments: Fourier coefficients (kg^1/2 m) of the structure as simulated, `frequency` in
    rad/s, `steps_per_cycle` of the fastest tangent frequency. Points are worked on in blocks of
    one size, so that neither their number nor that of the steps compiles anew.
    Returns NaN for points that are not finite, and where more than 8192 steps would be needed.
    """
    values = np.asarray(coefficients, dtype=np.float64)
    omega = np.asarray(frequency, dtype=np.float64)
    if not len(values):
        return np.zeros((0, 2 * model.n_modes), dtype=np.complex128)

    def block(begin: int) -> np.ndarray:
        here = slice(begin, begin + _BLOCK)
        rows = padded(values[here], _BLOCK)
        speed = padded(omega[here], _BLOCK)
        found = monodromy(model, rows, speed, float(steps_per_cycle))
        maps = np.asarray(found)[: len(values[here])]
        finite = np.all(np.isfinite(maps), axis=(1, 2))[:, None]
        finite &= np.all(np.isfinite(values[here]), axis=(1, 2))[:, None]
        return np.where(finite, np.linalg.eigvals(np.where(finite[:, :, None], maps, 0.0)), np.nan)

    return np.concatenate(over_cores(block, range(0, len(values), _BLOCK)))


def stability_of(
    multipliers: Complex[np.ndarray, "*batch multiplier"],
) -> Int[np.ndarray, "*batch"]:
    """A `Stability` for every motion: stable when all its multipliers are inside the unit circle.

    On the circle but for rounding counts as inside; multipliers of NaN were not computed.
    """
    largest = np.max(np.abs(multipliers), axis=-1)
    known = np.where(largest < 1.0 + MARGIN, int(Stability.STABLE), int(Stability.UNSTABLE))
    return np.where(np.isnan(largest), int(Stability.NOT_COMPUTED), known)
