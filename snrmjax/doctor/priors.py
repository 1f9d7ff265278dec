"""What the check takes for likely, and what it takes to say otherwise: every number that decides.

Relative sizes and natural logarithms where nothing else is said. Errors of states, levels and
curves have their priors in `identify.test_model.priors`.
"""

FITS_WELL = 0.06
"""Relative error of a state, up to which a hypothesis fits in itself: single modes leave 1 to 5 %
of measured beams, and twelve states pay for their curves with as much."""

SCATTER = 0.012
"""Relative error of a state that needs no error of the test: analysers and levels leave it."""

NO_MODE = 0.3
"""Misfit beyond which nothing that is small can have gone wrong, and phases are no mode's."""

CLEARLY = 12.0
"""ln of the odds, before priors, of what is said: some twenty hypotheses, true in one table of a
hundred together, leave one wrong answer in a hundred from 20 · 10⁴ on."""

MOST_OF_MISFIT = 0.5
"""Of the mean square that states are missed by, which is left at most where what is wrong is named:
if more of it has another cause, that may have this one's signs too, as a steep curve has a limit's.
"""

FEWEST_STATES = 8
"""Of a table that is looked at: fewer say nothing of curves of their own."""

MODAL_MASS = 0.05
"""1σ of the modal mass over a linear test's: shapes and calibrations are good to some per cent.

States tell a modal mass where they do so better; within it a factor is √2 or a unit's."""

ANY_MASS = 1.0
"""1σ of a modal mass of which nothing is known, over where the states have it."""

MOVES = 0.1
"""1σ of what a stiffness changes along a test or from a structure to another: 5 % of frequency, as
joints run in, masses are added or a room warms up."""

OTHER_GAIN = 0.4
"""1σ of the force's gain of a level on another range, or in volts."""

OTHER_RANGE = 2.4
"""|ln| of a gain, beyond a range's factor of ten, that two levels do not have where one mode fits
them as recorded: such gains flatten steep damping, as of dry friction."""

OTHER_SCALE = 0.125
"""|ln κ| from which on a modal mass is no linear test's: 2.5 times its 5 %."""

MOVED_MATTERS = 0.25
"""Change of a natural frequency over its bandwidth, from which on it bends curves."""

GAIN_MATTERS = 0.1
"""Change of a gain between levels or along a test, beyond instruments' few per cent."""

FORCE_FALLS = 0.5
"""Share of a level's force that is missing at resonance, or of a response's: half is lost."""

HELD = 0.05
"""Spread of ln |V| within a level whose response is controlled."""

TOGETHER = 0.6
"""Correlation of the logarithms of force, mobility and response where one makes the other."""

FAR_FREQUENCY, FAR_DAMPING = 0.05, 3.0
"""Of the lowest level from the linear mode, relative and as a ratio: beyond any drift."""

BAND = 1.96
"""1σ of a 95 % band."""

MORE_DAMPING = 0.3
"""Relative, over the linear test's at all amplitudes: mounting alone changes some 10 %."""

FORCE_HARMONIC = 0.04
"""Of the force's fundamental: amplifiers and good controllers stay below 2 %."""

CERTAIN = 6.0
"""1σ of what is told by many neighbouring states, lines or steps."""

STILL_MOVING = 0.03
"""Change of the response over the force at the end of a step: damping is off as much."""

FEWEST_CYCLES = 3.5
"""Of a step that is looked at: fewer have no phasor and a transient besides."""

FEW_BLOCKS = 4
"""Of a step, which have no scatter of their own to compare a change with."""

STEPS_MOVE = 0.3
"""Share of steps that must: a jump or a slow beat may move single ones."""

FLAT_TOP = 0.26
"""Share of a mean cycle within 3 % of its extremes; a sine has 0.156."""

PILED_UP = 0.003
"""Share of samples in runs of three at exactly the extreme of their channel."""

FOLDED_LINE = 2e-3
"""Of the fundamental: a line between harmonics from which on it is one of the drive's."""
