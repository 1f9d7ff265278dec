"""Duffing's oscillator: a structure for the virtual laboratory, and its decay in time."""

import numpy as np
from scipy.integrate import solve_ivp

import snrmjax as sj

REST, RATIO = 2 * np.pi * 40.0, 0.01  # rad/s
CUBIC = 3e9  # of the structure, per unit of modal mass, 1/(m² s²)
MASS = 0.8  # kg
DECAY_RATE, DECAY_CUBIC = 1.2, 6e9  # of the decay: 1/s, 1/(m² s²)


def beam(sign=1.0):
    """The structure; by the sign its sensor looks the other way."""
    shape = 1 / np.sqrt(MASS)
    modes = sj.model.linear_modes([REST], [RATIO], [[sign * shape]], [shape])
    # ẍ + … + β x³ with x = φ q is q̈ + … + β φ² q³: V = β φ² q⁴ / 4.
    potential = sj.model.polynomial_potential({"1111": CUBIC * shape**2 / 4}, 1)
    return sj.model.structure(modes, potential)


def decay(sampling_rate):
    """Time and q̇ after a release at 2 mm: q̈ + D q̇ + ω² q + β q³ = 0, integrated."""
    time = np.arange(0, 2.5, 1 / sampling_rate)

    def rate(_, state):
        q, v = state
        return v, -DECAY_RATE * v - REST**2 * q - DECAY_CUBIC * q**3

    found = solve_ivp(rate, (0, time[-1]), (2e-3, 0.0), t_eval=time, rtol=1e-10, atol=1e-14)
    return time, found.y[1]
