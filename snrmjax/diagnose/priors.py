"""What is taken for likely before a test is seen, and numbers that decide, each with why."""

import numpy as np

SIZES = (0.25, 0.5, 0.2, 0.04, 0.01)
"""Of no effect, one, two …: who asks has seen a misfit, and one nonlinearity is the rule."""

RESONANCE, INSTRUMENT = 0.03, 0.2
"""Of an internal resonance and of an instrument's error, over that of a law: modes seldom lie
within 5 % of a multiple of another, and instruments are checked before a test."""

STRENGTHS = np.geomspace(1e-5, 1.0, 11)
"""1σ of a law's largest relative change of stiffness, or of damping over ω₀, all as likely: from
what no test sees to a change as large as the linear stiffness."""

NO_REMAINDER = 0.3
"""Probability that laws leave nothing: structures are seldom in a library exactly."""

REMAINDERS = np.geomspace(1e-5, 1.0, 9)
"""Sizes of a remainder where there is one, in the units of strengths, all as likely."""

REMAINDER_LENGTHS = (1.0, 3.0, 10.0)
"""Of ln a, over which remainders may change: within a factor of e in amplitude, as those of joints
and walls do, or as slowly as another power of it. Of these the most probable is taken."""

FLOOR = 1e-3
"""Relative error of a state's amplitude and phase that is never undercut: what is smooth along a
sweep and in no model. Half and twice as much give the same answers on measured structures."""

DESCRIBED = 0.01
"""Relative 1σ of the force of a law that is taken at the fundamental alone: the third harmonic of
one that changes the stiffness by a tenth is about a hundredth of the motion."""

ALONG = 0.4
"""Of a remainder, 1σ of what it has along a law's own curve and no row can tell from the law:
contributions that grow with amplitude look more like laws than smooth curves at random do."""

HARMONIC = 0.02
"""Relative error of a reading of another harmonic: a law's force is taken at the fundamental alone,
whose other harmonics change it by about as much."""

HARMONIC_REMAINDERS = np.array([0.0, 1e-4, 1e-3, 1e-2, 1e-1])
"""Sizes of what laws leave of another harmonic of the force, over ω₀² and the amplitude: zero with
`NO_REMAINDER`, the others as likely."""

INSTRUMENT_PHASE = 0.1
"""rad, 1σ of a phase that all records share where it is a hypothesis: 6°."""

GAIN = 0.1
"""Relative 1σ of a gain that is a hypothesis: a wrong range or sensitivity."""

OF_LEVELS = 0.5
"""Of these, from which on a gain or a phase of that size may be what the errors of levels have in
common, and is no hypothesis of the instruments."""

ADDED_MASS = 0.05
"""Relative 1σ of a mass that was added. Beside a change of stiffness one of any size would follow a
resonance wherever it goes."""

FORCE_OFFSET = 0.1
"""1σ of an offset of the force over the smallest force."""

DRIFT = 0.005
"""1σ of a relative drift of the natural frequency over a test: some 20 K in metals."""

VISIBLE = 2.0
"""1σ, from which on a law's strength or a remainder counts as seen: less is no answer."""

NEGLIGIBLE = 0.05
"""Of a part's change: a law that explains less of it is no part of an answer."""

BELOW_BANDWIDTH = 0.03
"""Of the damping: changes of it, and of the stiffness over it, that are smaller are no finding: a
resonance moves by so much of its bandwidth, and describing functions leave out as much."""

NAMED = 0.9
"""Probability from which on a law is named: a wrong name costs nine times as much as none."""

EXPLAINED, AT_LEAST = 0.8, 0.5
"""Of a part's change, from which on a law is the answer and the remainder a correction, and what
the lower end of its 95 % band must reach. Where the remainder may be noise the band need only
reach the first."""

TOLERATED_NOISE = (-0.38, 0.22)
"""Of that logarithm, overstated and understated: √2 (0.35) lies between the error of a phasor and
that of its parts; of noise understated by more than a quarter effects would be named."""

BAND, ONE_SIDED = 1.96, 1.64
"""Of 95 % between two limits, and of 95 % beyond one."""

DETECTED = 10.0
"""Gain of Schwarz's criterion from which on an effect counts as detected: odds of 150 to one pay
for the choice among some thirty effects."""

AS_GOOD_BY_CRITERION = 6.0
"""Difference of Schwarz's criterion within which two models count as equally good: odds of 20."""

REJECTED = 1e-3
"""Probability by chance below which a check refutes: some thirty checks are made of a test."""

PULLED = 2.0
"""1σ of a stated parameter, by which an answer may move it without a word."""

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

TOLERATED_VARIANCE = 1.7
"""Over the stated one, that neighbouring states may show: stated too small by a third, noise is no
sign of further physics."""

FARTHEST_ERROR = 0.5
"""Relative or rad: an answer that needs larger errors of a velocity explains nothing; published
levels differ by 15 %."""

SETTLED_ERROR = 0.02
"""The same, that an answer's errors may move by in the last round: its square is below noise."""

FREE_GAIN_STD = 1.0
"""Relative 1σ of a force gain that is unknown."""

FREE_CURVE = 6
"""Knots of a free curve of amplitude: a power of it is told from others."""
