"""Units of files and reports in those in which the package computes: rad/s and rad."""

import numpy as np

HERTZ = 2 * np.pi
"""One hertz in rad/s."""

DEGREE = np.pi / 180
"""One degree in rad."""
