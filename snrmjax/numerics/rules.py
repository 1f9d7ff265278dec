"""Checks of input numbers: each a condition with its wording for error messages."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np


class InputError(ValueError):
    """Refusal of an input that is wrong or cannot be answered, with a message that says why.

    Whatever else is raised, a `ValueError` of NumPy or JAX too, is an error of this package.
    """

    @classmethod
    def located(cls, where: str, error: Exception | str) -> "InputError":
        """A refusal with the file, table or record it concerns in front, unless it names it."""
        message = str(error)
        return cls(message if where in message else f"{where}: {message}")


class Rule(NamedTuple):
    """A condition on a number or on every entry, and its wording in a message."""

    expected: str
    good: Callable[[Any], Any]


FINITE = Rule("finite", np.isfinite)
POSITIVE = Rule("positive", lambda value: value > 0)
NOT_NEGATIVE = Rule("zero or positive", lambda value: value >= 0)
NOT_ZERO = Rule("a number other than zero", lambda value: value != 0)
ABOVE_MINUS_ONE = Rule("above -1", lambda value: value > -1)
AT_LEAST_ONE = Rule("1 or more", lambda value: value >= 1)
FRACTION = Rule("from 0 to 1", lambda value: (value >= 0) & (value <= 1))
BELOW_ONE = Rule("from 0 to below 1", lambda value: (value >= 0) & (value < 1))
BETWEEN_ZERO_AND_ONE = Rule("between 0 and 1", lambda value: (value > 0) & (value < 1))
BETWEEN_ONE_AND_THREE = Rule("above 1 and below 3", lambda value: (value > 1) & (value < 3))
WHOLE = Rule("a whole number", lambda value: value == np.floor(value))
SHORT = Rule("of at most 15 digits", lambda value: abs(value) < 1e15)
# So that it does not overflow in rad/s.
IN_RANGE_HZ = Rule("below 1e300 Hz", lambda value: value < 1e300)

OF_A_FREQUENCY = (POSITIVE, IN_RANGE_HZ)
"""Of the natural frequency of a further mode, in Hz."""

OF_A_DAMPING_RATIO = (BELOW_ONE,)
"""Of the damping ratio of a further mode."""


def require(subject: str, value: Any, *rules: Rule) -> None:
    """Raises `ValueError` for the first number that is not finite or breaks one of the rules.

    `subject` names the quantity in the message, with backticks. Traced numbers are not checked.
    """
    import jax  # imported late so that `snrmjax --help` is fast

    if isinstance(value, jax.core.Tracer):
        return
    entries = np.asarray(value)
    for rule in (FINITE, *rules):
        bad = np.argwhere(~np.asarray(rule.good(entries)))
        if len(bad):
            index = tuple(bad[0].tolist())
            entry = f"entry {index[0] if len(index) == 1 else index} is" if index else "is"
            raise InputError(f"{subject} must be {rule.expected}, but {entry} {entries[index]:g}.")
