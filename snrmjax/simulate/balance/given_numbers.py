"""Checks of the numbers that a user gives, with the same messages everywhere."""

from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from snrmjax.numerics.rules import InputError


def positive(name: str, values: Any) -> Float[np.ndarray, " value"]:
    """One or many numbers as a flat array; NaN within `jit`, where they have no values.

    Raises `ValueError` if there is none, or one that is not positive and finite.
    """
    if isinstance(values, jax.core.Tracer):
        return np.full(values.shape, np.nan)
    numbers = np.asarray(values, dtype=np.float64).ravel()
    wrong = numbers[~((numbers > 0) & np.isfinite(numbers))]
    if wrong.size:
        raise InputError(f"`{name}` must be positive and finite, but is {float(wrong[0]):g}.")
    if not numbers.size:
        raise InputError(f"`{name}` must have at least one number, but is empty.")
    return numbers


def frequency_range(from_frequency: float, to_frequency: float) -> Float[np.ndarray, " end"]:
    """Both ends in rad/s. Raises `ValueError` for an empty, negative or infinite range."""
    if not 0 < from_frequency < to_frequency < np.inf:
        raise InputError(
            "`from_frequency` must be positive and below a finite `to_frequency`, but they are "
            f"{float(from_frequency):g} and {float(to_frequency):g} rad/s."
        )
    return np.array([from_frequency, to_frequency], dtype=np.float64)
