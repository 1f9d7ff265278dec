"""The two numerical beams of the method paper, as reduced-order models.

Reference: Kwarta & Allen, Tabs. 2, 4 and A.1. The potential of the flat beam has the means of
the redundant entries of Tab. A.1 (relative spread at most 4.9e-4) with its labels corrected:
row β_ij multiplies q_i² q_j, and the last four rows are 123, 124, 134 and 234. Participations are
those of a uniform force on every free node.
"""

from typing import Literal

import numpy as np

from snrmjax.model.modes import linear_modes
from snrmjax.model.potential import polynomial_potential
from snrmjax.model.structures import Structure, structure
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

FLAT_BEAM_FORCES = (2.669e-3, 4.448e-3, 8.896e-3, 1.334e-2)
"""Forces in N of the flat beam's response functions in the paper (Fig. 8)."""

CURVED_BEAM_FORCES = (1.334e-4, 6.672e-4, 1.779e-3)
"""Forces in N of the curved beam's response functions in the paper (Fig. 11)."""

_FLAT_POTENTIAL = {
    "111": 6.1933e06,
    "112": 2.765e06,
    "113": -2.5927e06,
    "114": 4.2927e07,
    "122": -2.454e07,
    "123": -6.979e06,
    "124": -5.048e07,
    "133": 1.007e06,
    "134": -1.954e07,
    "144": 2.6853e07,
    "222": 6.61e06,
    "223": -7.4107e06,
    "224": 1.0373e06,
    "233": 3.6887e07,
    "234": 1.1e07,
    "244": -2.182e07,
    "333": -4.2367e06,
    "334": 5.8907e06,
    "344": -5.0857e06,
    "444": 3.8267e06,
    "1111": 3.4375e12,
    "1112": -1.107e13,
    "1113": -8.5868e12,
    "1114": 5.967e12,
    "1122": 6.34e13,
    "1123": -1.2808e13,
    "1124": 1.1832e13,
    "1133": 1.5265e14,
    "1134": -2.231e12,
    "1144": 2.8455e14,
    "1222": -8.9002e13,
    "1223": -2.341e13,
    "1224": 1.601e13,
    "1233": -2.0732e14,
    "1234": -1.226e14,
    "1244": -4.317e14,
    "1333": -1.8642e14,
    "1334": 9.316e13,
    "1344": -3.3272e14,
    "1444": 2.8288e14,
    "2222": 2.239e14,
    "2223": -2.1802e14,
    "2224": 1.9748e14,
    "2233": 1.2435e15,
    "2234": 2.23e14,
    "2244": 2.3015e15,
    "2333": -5.8695e14,
    "2334": 3.681e14,
    "2344": -9.4445e14,
    "2444": 1.0398e15,
    "3333": 1.5698e15,
    "3334": 8.697e14,
    "3344": 6.085e15,
    "3444": 1.703e15,
    "4444": 5.6675e15,
}


def flat_beam() -> Structure:
    """The flat clamped-clamped beam: four symmetric modes, 55 potential coefficients.

    One sensor, `midspan`. Strongly stiffening; its first nonlinear mode carries a 1:5 internal
    resonance with the model's second mode (mode 3 of the beam) between about 87.5 and 90.2 Hz.

    >>> flat_beam().n_modes
    4
    """
    modes = linear_modes(
        HERTZ * np.array([79.02, 427.46, 1057.30, 1970.70]),
        [0.05, 0.0009, 0.0008, 0.0006],
        [[11.84338, -10.48504, 10.54894, 10.54619]],
        [247.841, 108.510, 69.055, -50.640],
        sensors=("midspan",),
    )
    return structure(
        modes, polynomial_potential(_FLAT_POTENTIAL, 4), name="flat clamped-clamped beam"
    )


def curved_beam(reading: Literal["monostable", "as_printed"] = "monostable") -> Structure:
    """The curved clamped-clamped beam: one mode with quadratic and cubic stiffness.

    `as_printed` uses Tab. 4 as printed and is bistable (saddle at q = 5.33e-5, second well
    at 5.0e-4 kg^1/2 m). `monostable` has three times the cubic coefficient: it softens, then
    stiffens, in agreement with the paper's text and figures.
    One sensor, `midspan`. Raises `ValueError` for another reading.
    """
    factor = {"monostable": 3.0, "as_printed": 1.0}.get(reading)
    if factor is None:
        raise InputError(f'`reading` must be "monostable" or "as_printed", but is {reading!r}.')
    modes = linear_modes(
        HERTZ * np.array([64.78]), [0.05], [[12.77433]], [3341.536], sensors=("midspan",)
    )
    # The table gives the force α q² + β q³; the potential is α q³/3 + β q⁴/4.
    potential = polynomial_potential({"111": -3.4380e9 / 3, "1111": factor * 6.2183e12 / 4}, 1)
    return structure(modes, potential, name=f"curved clamped-clamped beam ({reading})")
