"""Numbers that a user gives: checked once, in the same words everywhere."""

from typing import Any

import jax
import numpy as np
from jaxtyping import Float


def positive(name: str, values: Any) -> Float[np.ndarray, " value"]:
    """One or many numbers in a row; within `jit`, where they have no values, NaN.

    Raises `ValueError` unless there is one at least and all are positive and finite.
    """
    if isinstance(values, jax.core.Tracer):
        return np.full(values.shape, np.nan)
    row = np.asarray(values, dtype=np.float64).ravel()
    wrong = row[~((row > 0) & np.isfinite(row))]
    if wrong.size:
        raise ValueError(f"`{name}` must be positive and finite, but is {float(wrong[0]):g}.")
    if not row.size:
        raise ValueError(f"`{name}` must have at least one number, but is empty.")
    return row


def frequency_range(from_frequency: float, to_frequency: float) -> Float[np.ndarray, " end"]:
    """Both ends in rad/s. Raises `ValueError` when they are no range."""
    if not 0 < from_frequency < to_frequency < np.inf:
        raise ValueError(
            "`from_frequency` must be positive and below a finite `to_frequency`, but they are "
            f"{float(from_frequency):g} and {float(to_frequency):g} rad/s."
        )
    return np.array([from_frequency, to_frequency], dtype=np.float64)
