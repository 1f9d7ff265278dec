"""Squares of mass-normalised shapes from frequencies without and with a small mass."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.identify.modal.modal_fit import WIDE, LinearModalFit
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

_SHIFT_STDS = 3.0  # smallest significant frequency shift, in standard errors
_LARGE = 0.1  # relative frequency shift above which the mass also changes the shapes
_STEP = 1e-7
_BY_BAND = "narrow the band to modes that both tests show, or give their poles by hand"


class SquaredShapes(NamedTuple):
    """φ² at the added mass, 1/kg, for each mode."""

    squared: Float[np.ndarray, " mode"]
    squared_std: Float[np.ndarray, " mode"]
    notes: tuple[Fact, ...]


def squared_shapes(
    without: LinearModalFit, with_mass: LinearModalFit, mass: float, mass_std: float = 0.0
) -> SquaredShapes:
    """φ² at an added mass Δm, from the frequencies ω₀ without and ω₁ with it.

    The inertia force of the mass is Δm Ω² x: Σ_k φ_k²/(ω₀k² − ω₁r²) = 1/(Δm ω₁r²) for every mode r
    with the mass. One mode alone: φ² = (ω₀²/ω₁² − 1)/Δm, exact if the mass does not change
    the shape. To first order φ² = 2(ω₀ − ω₁)/(ω₀Δm), too small by the relative amount
    3/2 (ω₀ − ω₁)/ω₀. Errors of both frequencies and of the mass are propagated.

    Raises `ValueError` for a mass that is not positive, fewer modes with the mass, and frequencies
    that the mass does not lower by at least three standard errors.
    """
    if not (np.isfinite(mass) and mass > 0 and mass_std >= 0):
        raise InputError(f"an added mass must be positive (kg), but is {mass:g} ± {mass_std:g}.")
    before, own_std = without.natural_frequency, without.natural_frequency_std
    after, after_std = _partners(without, with_mass)
    shift, spread = before - after, np.hypot(own_std, after_std)
    for k in range(len(before)):
        if shift[k] < _SHIFT_STDS * spread[k]:
            raise InputError(
                f"the added mass of {mass:.4g} kg must lower the frequency of mode {k + 1}, but "
                f"it goes from {before[k] / HERTZ:.7g} to {after[k] / HERTZ:.7g} Hz, "
                f"{shift[k] / HERTZ:.2g} ± {WIDE * spread[k] / HERTZ:.2g} Hz (95 %) lower: take "
                "a larger mass, or a position that moves more."
            )
    squared = _solved(before, after, mass)
    if np.any(squared <= 0):
        k = int(np.argmin(squared))
        raise InputError(
            f"the frequencies with the added mass of {mass:.4g} kg give mode {k + 1} a squared "
            f"shape of {squared[k]:.3g} 1/kg: they are not those of the same structure with that "
            "mass."
        )
    variance = (squared / mass * mass_std) ** 2
    for values, errors, is_before in ((before, own_std, True), (after, after_std, False)):
        for k, error in enumerate(errors):
            moved = values.copy()
            moved[k] *= 1 + _STEP
            other = _solved(moved, after, mass) if is_before else _solved(before, moved, mass)
            variance = variance + ((other - squared) / (_STEP * values[k]) * error) ** 2
    first = 2 * shift / before / mass / squared - 1
    notes = [
        Fact(
            "added_mass_shift",
            mode=k + 1,
            mass_kg=mass,
            shift_hz=float(shift[k]) / HERTZ,
            std_hz=float(spread[k]) / HERTZ,
            first_order=float(first[k]),
        )
        for k in range(len(before))
    ]
    if np.any(shift > _LARGE * before):
        notes.append(Fact("added_mass_large"))
    return SquaredShapes(squared, np.sqrt(variance), tuple(notes))


def _solved(before: np.ndarray, after: np.ndarray, mass: float) -> np.ndarray:
    matrix = 1 / (before[None] ** 2 - after[:, None] ** 2)
    return np.linalg.solve(matrix, 1 / (mass * after**2))


def _partners(without: LinearModalFit, with_mass: LinearModalFit) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies with the mass and their 1σ, one for each mode without it."""
    before, after = without.natural_frequency, with_mass.natural_frequency
    if len(after) == len(before):
        return after, with_mass.natural_frequency_std
    if len(after) < len(before):
        raise InputError(
            f"the test with the added mass must show the {len(before)} modes of the test without "
            f"it, but shows {len(after)}: {_BY_BAND}."
        )
    # A mass lowers each frequency, but not below the next lower one (interlacing).
    chosen = [
        int(np.argmin(np.where(after <= frequency, frequency - after, np.inf)))
        for frequency in before
    ]
    if len(set(chosen)) < len(chosen):
        raise InputError(f"the modes of both tests cannot be paired: {_BY_BAND}.")
    return after[chosen], with_mass.natural_frequency_std[chosen]
