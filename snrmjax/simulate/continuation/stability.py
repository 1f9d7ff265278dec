"""Stability of periodic motions from the monodromy matrix of the linearised equations."""

from enum import IntEnum
from functools import partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from snrmjax.model.structures import Structure
from snrmjax.numerics.blocks import by_member, mapped, over_cores, padded
from snrmjax.numerics.compiled import compiled
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance
from snrmjax.simulate.continuation.monodromy import monodromy

_BLOCKS = ((1, 128), (2, 64))  # modes, and points whose linearised motions are side by side
_BLOCK = 32  # of more modes
STEPS_PER_CYCLE = 6  # of the fastest tangent frequency
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
    steps_per_cycle: int = STEPS_PER_CYCLE,
) -> Complex[np.ndarray, "point multiplier"]:
    """Floquet multipliers of periodic motions: eigenvalues of the map over one period.

    Integrates m δq̈ + C(t)δq̇ + K(t)δq = 0 with the tangent matrices along the motion, by methods
    that keep a conservative structure's multipliers on the unit circle, however light the
    damping (see `monodromy`): kicked oscillators, of order 4, for springs and a potential; exact
    pieces between slips and contacts where nothing else is nonlinear; Magnus' method of order 6
    for all others. Sliders are linearised as they are: dragged or stuck. A motion is stable when
    all multipliers lie inside the unit circle.

    Arguments: Fourier coefficients (kg^1/2 m) of the structure as simulated, `frequency` in
    rad/s, `steps_per_cycle` of the fastest tangent frequency. Points are worked on in blocks of
    one size, so that neither their number nor that of the steps compiles anew.
    Returns NaN for points that are not finite, and where more than 8192 steps would be needed.
    """
    values = np.asarray(coefficients, dtype=np.float64)
    omega = np.asarray(frequency, dtype=np.float64)
    if not len(values):
        return np.zeros((0, 2 * model.n_modes), dtype=np.complex128)

    size = dict(_BLOCKS).get(model.n_modes, _BLOCK)

    def block(begin: int) -> np.ndarray:
        here = slice(begin, begin + size)
        rows, speed = padded(values[here], size), padded(omega[here], size)
        found = monodromy(model, rows, speed, float(steps_per_cycle))
        maps = np.asarray(found)[: len(values[here])]
        known = np.all(np.isfinite(values[here]), axis=(1, 2))[:, None, None]
        return _eigenvalues(np.where(known, maps, np.nan), 2 * model.n_modes)

    return np.concatenate(over_cores(block, range(0, len(values), size)))


def many_multipliers(
    balances: HarmonicBalance, owner: np.ndarray, points: Float[np.ndarray, "point unknown"]
) -> Complex[np.ndarray, "point multiplier"]:
    """Floquet multipliers of scaled points of several structures: `owner` says of which."""
    if not len(points):
        return np.zeros((0, 2 * balances.model.n_modes), dtype=np.complex128)
    coefficients, frequency = balances.motions(points, owner)
    maps = by_member(_monodromies, balances.model, owner, coefficients, frequency)
    return _eigenvalues(maps, 2 * balances.model.n_modes)


@partial(compiled, long_loops=True)
def _monodromies(
    models: Structure,
    coefficients: Float[Array, "row point coefficient mode"],
    frequency: Float[Array, "row point"],
) -> Float[Array, "row point state state"]:
    def of_row(model: Structure, coefficients: Array, frequency: Array) -> Array:
        return monodromy(model, coefficients, frequency, jnp.array(float(STEPS_PER_CYCLE)))

    return mapped(of_row, models, coefficients, frequency)


def _eigenvalues(
    maps: Float[np.ndarray, "*batch state state"], number: int
) -> Complex[np.ndarray, "*batch multiplier"]:
    """The largest eigenvalues of maps, NaN of those that are not finite.

    States beyond `number` are positions of sliders, which the motion sets anew in each period.
    """
    finite = np.all(np.isfinite(maps), axis=(-2, -1))[..., None]
    found: np.ndarray = np.linalg.eigvals(np.where(finite[..., None], maps, 0.0))
    if found.shape[-1] > number:
        largest = np.argsort(-np.abs(found), axis=-1)[..., :number]
        found = np.take_along_axis(found, largest, axis=-1)
    return np.where(finite, found, np.nan)


def stability_of(
    multipliers: Complex[np.ndarray, "*batch multiplier"],
) -> Int[np.ndarray, "*batch"]:
    """A `Stability` for every motion: stable when all its multipliers are inside the unit circle.

    On the circle but for rounding counts as inside; multipliers of NaN were not computed.
    """
    largest = np.max(np.abs(multipliers), axis=-1)
    known = np.where(largest < 1.0 + MARGIN, int(Stability.STABLE), int(Stability.UNSTABLE))
    return np.where(np.isnan(largest), int(Stability.NOT_COMPUTED), known)
