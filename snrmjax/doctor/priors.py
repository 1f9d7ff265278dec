"""Priors and thresholds of the check: every number that decides.

Relative values and natural logarithms unless stated otherwise. Errors of states, levels and curves
have their priors in `identify.test_model.priors`.
"""

FITS_WELL = 0.06
"""Relative error of a state up to which a hypothesis fits: single modes leave 1 to 5 % on measured
beams, and with twelve states the curves cost as much."""

SCATTER = 0.012
"""Relative error of a state without any error of the test, from analysers and levels."""

NO_MODE = 0.3
"""Misfit above which no small error explains the table, and phases are not those of a mode."""

CLEARLY = 12.0
"""ln of the Bayes factor required for a finding: with some twenty hypotheses, true in one table of
a hundred together, a factor of 20 · 10⁴ leaves one wrong finding in a hundred."""

MOST_OF_MISFIT = 0.5
"""Largest fraction of the mean square misfit that may remain after a reported correction: a larger
remaining cause may also explain this one, as a steep curve resembles clipping."""

FEWEST_STATES = 8
"""Of a checked table: fewer do not determine curves."""

MODAL_MASS = 0.05
"""1σ of the modal mass of a linear test: shapes and calibrations are accurate to some per cent.

Also the tolerance for recognising √2 or the factor of a unit."""

ANY_MASS = 1.0
"""1σ of ln of an unknown modal mass, about the value of the states."""

MOVES = 0.1
"""1σ of stiffness changes along a test or between structures: 5 % of frequency, as joints run in,
masses are added or a room warms up."""

OTHER_GAIN = 0.4
"""1σ of the force gain of a level measured on another range, or in volts."""

OTHER_RANGE = 2.4
"""|ln| of a gain above a factor of ten, rejected for two levels where one mode fits as recorded:
such gains flatten steep damping, as of dry friction."""

OTHER_SCALE = 0.125
"""|ln κ| above which a modal mass contradicts the linear test: 2.5 times its 5 %."""

MOVED_MATTERS = 0.25
"""Change of a natural frequency over its bandwidth above which it distorts curves."""

GAIN_MATTERS = 0.1
"""Change of a gain between levels or along a test, above the few per cent of instruments."""

FORCE_FALLS = 0.5
"""Fraction of a level's force or response that is missing at resonance: half is lost."""

CONTROLLED = 0.05
"""Spread of ln |V| within a level whose response is controlled."""

TOGETHER = 0.6
"""Correlation of the logarithms of force, mobility and response if one causes the other."""

FAR_FREQUENCY, FAR_DAMPING = 0.05, 3.0
"""Deviation of the lowest level from the linear mode, relative and as a ratio: above any drift."""

BAND = 1.96
"""Half-width of a 95 % band in 1σ."""

MORE_DAMPING = 0.3
"""Relative excess over the linear test at all amplitudes: mounting alone changes some 10 %."""

FORCE_HARMONIC = 0.04
"""Of the force's fundamental: amplifiers and good controllers stay below 2 %."""

CERTAIN = 6.0
"""Number of 1σ required from many neighbouring states, lines or steps."""

STILL_MOVING = 0.03
"""Change of the response over the force at the end of a step: damping is off by as much."""

FEWEST_CYCLES = 3.5
"""Of a checked step: fewer do not give a phasor and a transient."""

FEW_BLOCKS = 4
"""Blocks of a step, up to which their scatter cannot be estimated."""

STEPS_MOVE = 0.3
"""Fraction of steps that must move: a jump or a slow beat may affect single ones."""

FLAT_TOP = 0.26
"""Fraction of a mean cycle within 3 % of its extremes; a sine has 0.156."""

PILED_UP = 0.003
"""Fraction of samples in runs of three at exactly the extreme of their channel."""

FOLDED_LINE = 2e-3
"""Of the fundamental: smallest line between harmonics that counts as an alias of the drive."""
