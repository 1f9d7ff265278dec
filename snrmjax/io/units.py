"""Units of the files, for numbers that are rad/s and rad inside."""

import math

HERTZ = 2.0 * math.pi
"""One hertz in rad/s."""

DEGREE = math.pi / 180.0
"""One degree in rad."""


def in_unit(value: float, unit: float) -> float:
    """The number to write for `value` in a file whose unit is `unit`.

    The quotient can miss by a rounding the number that gave `value` when it was read; among the
    neighbours that read back as `value` exactly, the shortest is taken, so that a file which is
    read and written again keeps its numbers.

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
