"""Units of files in the internal units rad/s and rad, and units in print."""

import math

HERTZ = 2 * math.pi
"""One hertz in rad/s."""

DEGREE = math.pi / 180
"""One degree in rad."""


def unit_in_print(unit: str) -> str:
    """A unit in print: roots of the kilogram with a root sign, nothing for "1".

    Files and data sets keep the plain spelling.

    >>> unit_in_print("1/(kg^1/2 m)"), unit_in_print("kg^-1/2"), unit_in_print("1")
    ('1/(√kg m)', '1/√kg', '')
    """
    return "" if unit == "1" else unit.replace("kg^1/2", "√kg").replace("kg^-1/2", "1/√kg")
