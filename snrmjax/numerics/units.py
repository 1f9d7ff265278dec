"""Units of files in the internal units rad/s and rad, numbers of files, and units in print."""

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


def in_unit(value: float, unit: float) -> float:
    """The number to write for `value` in a file whose unit is `unit`.

    The quotient may differ by a rounding from the number that was read as `value`; of the
    neighbours that read back exactly as `value`, the shortest is used, so that a file that is read
    and written again keeps its numbers.

    Arguments: `value` in rad/s or rad, `unit` likewise. Returns the number in that unit; read
    back, it is `value` to one rounding, and exactly so when `value` itself came from a file.

    >>> in_unit(79.02 * HERTZ, HERTZ)
    79.02
    """
    quotient = value / unit
    candidates = [quotient]
    for direction in (-math.inf, math.inf):
        near = math.nextafter(quotient, direction)
        candidates += [near, math.nextafter(near, direction)]
    exact = [number for number in candidates if number * unit == value]
    return min(exact, key=lambda number: len(repr(number)), default=quotient)
