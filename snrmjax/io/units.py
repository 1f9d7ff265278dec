"""Numbers of files, in their units, from those in rad/s and rad."""

import math


def in_unit(value: float, unit: float) -> float:
    """The number to write for `value` in a file whose unit is `unit`.

    The quotient may differ by a rounding from the number that was read as `value`; of the
    neighbours that read back exactly as `value`, the shortest is used, so that a file that is read
    and written again keeps its numbers.

    Arguments: `value` in rad/s or rad, `unit` likewise. Returns the number in that unit; read
    back, it is `value` to one rounding, and exactly so when `value` itself came from a file.

    >>> from snrmjax.numerics.units import HERTZ
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
