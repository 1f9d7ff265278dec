"""What a diagnosis takes for likely, and where it decides: every number with its reason.

Priors of curves, levels and noise are those of every test (`identify.test_model.priors`).
"""

import numpy as np

# --- hypotheses: odds against a model that lacks nothing

EFFECTS = (1.0, 0.44, 0.033, 0.0034)
"""Of none, one, two, three effects of the library, all kinds together: who asks has seen a misfit,
and structures with one nonlinearity are the rule."""

DISCREPANCY = 0.1
"""Of an answer beside a misfit that no effect of the library explains, to that answer."""

IMITATION = 0.4
"""Of a law outside the library that is known to act like an answer, to that answer."""

UNNAMED = 0.004
"""The same where no such law is known."""

NO_CURVE = 0.15
"""Of laws outside the library that follow a drawn curve within noise, those that are none of one
quantity: friction with rates, contact that bounces, damping with a memory."""

LEVELS_APART = 0.4
"""Of levels that differ by more than was stated, to levels that do not: temperature and clamps."""

WRONG_NOISE = 0.5
"""Of noise that is stated wrong, to noise stated right."""

RIGHT_NOISE = 0.2
"""1σ of the logarithm of noise over stated noise: deviations of ten readings are good to 20 %."""

TOLERATED_NOISE = (-0.38, 0.22)
"""Of that logarithm, overstated and understated: √2 (0.35) lies between the error of a phasor and
that of its parts; of noise understated by more than a quarter effects would be named."""

MOST_NOISE = float(np.log(4.0))
"""The largest wrong statement considered: a factor of four, either way."""

# --- sizes that are integrated over

DISCREPANCY_SIZES = (0.3, 100.0)
"""Root-mean-square size of a discrepancy in units of noise, between which its logarithm is flat."""

# --- levels of confidence, in 1σ of a normal distribution

BAND, ONE_SIDED = 1.96, 1.64
"""Of 95 % between two limits, and of 95 % beyond one."""

# --- decisions

NO_ANSWER = 0.9
"""Probability of a law outside the library from which on nothing is named: a wrong name costs nine
times as much as an open question."""

NO_DOUBT = 0.1
"""The same up to which an answer is named without a word."""

AS_GOOD = 0.01
"""Odds to the best answer down to which another one belongs to the class: of a hundred names that
stand alone one may be wrong."""

DETECTED = 10.0
"""Gain of Schwarz's criterion from which on an effect counts as detected: odds of 150 to one pay
for the choice among some thirty effects."""

AS_GOOD_BY_CRITERION = 6.0
"""Difference of Schwarz's criterion within which two models count as equally good: odds of 20."""

REJECTED = 1e-3
"""Probability by chance below which a check refutes: some thirty checks are made of a test."""

CONTRADICTED = 4.0
"""1σ between the power of amplitude in the data and that of a law: curves of a few knots are no
exact powers."""

PULLED = 2.0
"""1σ of a stated parameter, by which an answer may move it without a word."""

MOVED_GAIN = 0.05
"""Of the logarithm of a free gain, by which a right law moves what smooth curves gave."""

FAR_GAIN = 3.0
"""Ratio of a gain to its first value, beyond which the answer has moved it away."""

FAR_MASS = 3.0
"""1σ of a modal mass of which none is stated, beyond which it explains no gain."""

LOOSE_GAIN = 0.1
"""Relative 1σ of a force's gain, beyond which no close mode is looked for: beside a force that may
be nothing a mode could be all that one sees."""

OTHER_MODE = 0.1
"""Relative shift of a natural frequency that is no error of a linear test."""

TELLING = 16.0
"""Of χ², that a power of amplitude must explain to be reported: 4σ."""

BEYOND_DATA = 10.0
"""Times all that was measured: effects that must be larger cannot be detected."""

SAME_FORCE, HELD_RESPONSE = 0.05, 0.2
"""Relative distance from its level's force up to which a state was measured at it, and share of
states beyond, from which on a test may hold the response."""

AS_NOISE = 1.3
"""Times the noise, up to which a misfit counts as noise; beyond it every 1σ is too small."""

FAR_MISSED = 2.0
"""Times the noise, from which on a top level that was left out proves nothing of a law."""

MISSED, MISSED_BY_ONE = 0.05, 0.01
"""Probability by chance of a level that was left out: below the first it counts against an answer
that another law could imitate, below the second against one of several."""

TOLERATED_VARIANCE = 1.7
"""Over the stated one, that neighbouring states may show: stated too small by a third, noise is no
sign of further physics."""

OPEN = 0.1
"""Share of their probability that refuted answers keep: checks rest on approximations too."""

# --- records corrected for the errors that an answer finds in them

FARTHEST_ERROR = 0.5
"""Relative or rad: an answer that needs larger errors of a velocity explains nothing; published
levels differ by 15 %."""

SETTLED_ERROR = 0.02
"""The same, that an answer's errors may move by in the last round: its square is below noise."""

FAR_BEHIND = 25.0
"""Of ln p behind an answer that fits, from which on others are not corrected for their errors: that
moves the ln p of answers near it by ten or so. Behind one that leaves more than noise, as many
times more as its χ² is over what noise leaves."""

# --- what is unknown of gains, and of drawn laws

FREE_GAIN_STD = 1.0
"""Relative 1σ of a force gain that is unknown."""

FREE_LEVEL_FORCE_STD = 0.3
"""Relative 1σ of the force of a level that is left free: far more than a calibration is off."""

LAW_REACHES = (0.35, 0.7, 1.4, 2.8)
"""Of a drawn law's process, in logarithms of displacement or velocity, all as likely."""

LAW_SIZES = 2.0 ** np.arange(-7.0, 9.0)
"""Of the same, in units of a change that is plainly seen."""

# --- how far the search goes

HOPELESS = 5.0
"""Times χ² of the best fit so far, or of noise, beyond which a fit is given up on the way."""

PAIRS, SIMPLE, MOST_EFFECTS = 8, 2, 3
"""Pairs that are fitted from their own starts; parameters up to which an effect is not compared
with two simple ones; and effects of an answer: three can follow most laws."""

FEW_EFFECTS = 2
"""Of an answer beside which no law is drawn."""

REFINED, NEAREST_ANSWERS = 8, 4
"""Likeliest answers that are corrected for their own errors; and whose effects are looked for again
with many harmonics, which cost most."""

SAME_NOISE = 0.8
"""Share of a size of noise that is as much."""

FREE_CURVE = 6
"""Knots of a free curve of amplitude: a power of it is told from others."""
