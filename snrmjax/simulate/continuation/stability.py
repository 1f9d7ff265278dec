"""Stability of periodic motions from the monodromy matrix of the linearised equations."""

from enum import IntEnum
from functools import partial

import numpy as np
from jaxtyping import Array, Complex, Float, Int

from snrmjax.model.structures import Structure
from snrmjax.numerics.blocks import by_member, mapped, on_one_core, stacked
from snrmjax.numerics.compiled import compiled, on_numbers
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance
from snrmjax.simulate.continuation.left_out_harmonics import completed_motions, has_contacts
from snrmjax.simulate.continuation.monodromy import monodromy

STEPS_PER_CYCLE = 6  # of the fastest tangent frequency
MARGIN = 1e-6  # beyond the unit circle: numerical error of conservative multipliers


class Stability(IntEnum):
    """Stability of a periodic motion against small disturbances."""

    NOT_COMPUTED = -1  # not requested, or the multipliers could not be computed
    UNSTABLE = 0
    STABLE = 1


@on_numbers("The motion itself is differentiable: `sj.simulate.periodic_motion`.")
@on_one_core
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
    intervals between slip and contact events where nothing else is nonlinear; Magnus' method of
    order 6 for all others. Sliders are linearised in their current state, slipping or stuck. A
    motion is stable when all multipliers lie inside the unit circle.

    Arguments: Fourier coefficients (kg^1/2 m) of the structure as simulated, `frequency` in
    rad/s, `steps_per_cycle` of the fastest tangent frequency. Points are computed in blocks of
    one size, so that neither their number nor that of the steps recompiles.
    Returns NaN for points that are not finite, and where more than 8192 steps would be needed.
    Not differentiable; the motion itself is: `snrmjax.simulate.periodic_motion`.
    """
    values = np.asarray(coefficients, dtype=np.float64)
    omega = np.asarray(frequency, dtype=np.float64)
    owner = np.zeros(len(values), dtype=int)
    return _multipliers(stacked([model]), owner, values, omega, float(steps_per_cycle))


def many_multipliers(
    balances: HarmonicBalance, owner: np.ndarray, points: Float[np.ndarray, "point unknown"]
) -> Complex[np.ndarray, "point multiplier"]:
    """Floquet multipliers of scaled points of several structures, whose indices are `owner`.

    With contacts or friction the motions are first solved with twice the harmonics.
    """
    whole = has_contacts(balances.model) and len(points) > 0
    motions = (
        completed_motions(balances, owner, points) if whole else balances.motions(points, owner)
    )
    return _multipliers(balances.model, owner, *motions, STEPS_PER_CYCLE)


def _multipliers(
    models: Structure,
    owner: np.ndarray,
    coefficients: np.ndarray,
    frequency: np.ndarray,
    steps_per_cycle: float,
) -> Complex[np.ndarray, "point multiplier"]:
    multipliers = np.full((len(owner), 2 * models.n_modes), np.nan, dtype=np.complex128)
    # All points of a batch take as many steps as the most demanding one.
    known = np.all(np.isfinite(coefficients), axis=(1, 2)) & np.isfinite(frequency)
    if known.any():
        steps, rows = np.array(float(steps_per_cycle)), (coefficients[known], frequency[known])
        maps = by_member(lambda *given: _monodromies(*given, steps), models, owner[known], *rows)
        multipliers[known] = _eigenvalues(maps, multipliers.shape[1])
    return multipliers


@partial(compiled, long_loops=True)
def _monodromies(
    models: Structure,
    coefficients: Float[Array, "row point coefficient mode"],
    frequency: Float[Array, "row point"],
    steps_per_cycle: Float[Array, ""],
) -> Float[Array, "row point state state"]:
    def of_row(model: Structure, coefficients: Array, frequency: Array) -> Array:
        return monodromy(model, coefficients, frequency, steps_per_cycle)

    return mapped(of_row, models, coefficients, frequency)


def _eigenvalues(
    maps: Float[np.ndarray, "*batch state state"], number: int
) -> Complex[np.ndarray, "*batch multiplier"]:
    """The largest eigenvalues of maps, NaN for maps that are not finite.

    States beyond `number` are slider positions, which the motion resets in each period.
    """
    finite = np.all(np.isfinite(maps), axis=(-2, -1))[..., None]
    values: np.ndarray = np.linalg.eigvals(np.where(finite[..., None], maps, 0.0))
    if values.shape[-1] > number:
        largest = np.argsort(-np.abs(values), axis=-1)[..., :number]
        values = np.take_along_axis(values, largest, axis=-1)
    return np.where(finite, values, np.nan)


def stability_of(
    multipliers: Complex[np.ndarray, "*batch multiplier"],
) -> Int[np.ndarray, "*batch"]:
    """A `Stability` for every motion: stable when all its multipliers are inside the unit circle.

    On the circle to rounding counts as inside; NaN multipliers were not computed.
    """
    largest = np.max(np.abs(multipliers), axis=-1)
    known = np.where(largest < 1.0 + MARGIN, int(Stability.STABLE), int(Stability.UNSTABLE))
    return np.where(np.isnan(largest), int(Stability.NOT_COMPUTED), known)
