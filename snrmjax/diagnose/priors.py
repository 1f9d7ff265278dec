"""Prior probabilities and thresholds of the diagnosis, each with its reason."""

import numpy as np

EFFECT_COUNTS = (0.25, 0.5, 0.2, 0.04, 0.01)
"""Prior of no effect, one, two …: a diagnosis is run for a misfit, and most have one cause."""

RESONANCE, INSTRUMENT = 0.03, 0.2
"""Prior odds of an internal resonance and of an instrument error over a law: modes seldom lie
within 5 % of a multiple of another, and instruments are checked before a test."""

STRENGTHS = np.geomspace(1e-5, 1.0, 11)
"""1σ of a law's largest relative change of stiffness, or of damping over ω₀, equally likely: from
below what a test can resolve to a change as large as the linear stiffness."""

NO_REMAINDER = 0.3
"""Probability that laws leave no remainder: a library seldom describes a structure exactly."""

REMAINDERS = np.geomspace(1e-5, 1.0, 9)
"""Standard deviations of a remainder, where there is one, in units of strengths, equally likely."""

REMAINDER_LENGTHS = (1.0, 3.0, 10.0)
"""Correlation lengths of remainders in ln a: changes within a factor of e in amplitude, as of
joints and contacts, up to ones as slow as another power of it. The most probable one is used."""

FLOOR = 1e-3
"""Lower limit of a state's relative amplitude error and phase error (rad): smooth along a sweep
and in no model. Half and twice this value give the same answers on measured structures."""

DESCRIBED = 0.01
"""Relative 1σ of a law's force from its describing function alone: the third harmonic of a law
that changes the stiffness by a tenth is about a hundredth of the motion."""

ALONG = 0.4
"""Fraction of a remainder, 1σ, that may lie along a law's own curve, where no row distinguishes
it from the law: contributions that grow with amplitude resemble laws more than random curves do."""

HARMONIC = 0.02
"""Relative error of a harmonic of a law's force, taken at the fundamental motion alone: the other
harmonics of the motion change it by about as much."""

HARMONIC_REMAINDERS = np.array([0.0, 1e-4, 1e-3, 1e-2, 1e-1])
"""Standard deviations of the remainder of another harmonic of the force, over ω₀² and the
amplitude: zero with `NO_REMAINDER`, the others equally likely."""

INSTRUMENT_PHASE = 0.1
"""rad, 1σ of a phase error common to all records, as a hypothesis: 6°."""

GAIN = 0.1
"""Relative 1σ of a gain error, as a hypothesis: a wrong range or sensitivity."""

OF_LEVELS = 0.5
"""Fraction of these: from level errors of this 1σ on, a common gain or phase may be their mean,
and is no instrument hypothesis."""

ADDED_MASS = 0.05
"""Relative 1σ of an added mass. With a stiffness change alongside, a mass of any magnitude would
follow a resonance anywhere."""

FORCE_OFFSET = 0.1
"""1σ of an offset of the force over the smallest force."""

DRIFT = 0.005
"""1σ of a relative drift of the natural frequency over a test: some 20 K in metals."""

VISIBLE = 2.0
"""Number of 1σ from which on a law's strength or a remainder counts as significant."""

NEGLIGIBLE = 0.05
"""Fraction of a part's change below which a law is no part of an answer."""

BELOW_BANDWIDTH = 0.03
"""Smallest relevant change of damping, or of stiffness, over the damping: the resonance shifts by
this fraction of its bandwidth, and describing functions are no more exact."""

NAMED = 0.9
"""Probability from which on a law is named: a wrong name costs nine times as much as none."""

EXPLAINED, AT_LEAST = 0.8, 0.5
"""Fraction of a part's change from which on a law is the answer and the remainder a correction,
and the required lower end of its 95 % band. Where the remainder may be noise, the value need only
reach the latter and the upper end the former."""

TOLERATED_NOISE = (-0.38, 0.22)
"""Tolerated logarithm of noise over stated noise. Below: √2 (0.35) is the ratio of a phasor's
error to that of its parts. Above: noise understated by more than a quarter makes false effects."""

BAND, ONE_SIDED = 1.96, 1.64
"""Normal quantiles of 95 %, two-sided and one-sided."""

DETECTED = 10.0
"""Gain of Schwarz's criterion from which on an effect counts as detected: odds of 150 to one make
up for the choice among some thirty effects."""

AS_GOOD_BY_CRITERION = 6.0
"""Difference of Schwarz's criterion within which two models count as equally good: odds of 20."""

REJECTED = 1e-3
"""p-value below which a check rejects: some thirty checks are made of a test."""

SHIFTED = 2.0
"""Number of 1σ by which an answer may shift a stated parameter without a note."""

LOOSE_GAIN = 0.1
"""Relative 1σ of a force gain beyond which no close mode is considered: with an almost unknown
force, the close mode could explain the whole response."""

OTHER_MODE = 0.1
"""Relative shift of a natural frequency that exceeds any error of a linear test."""

BEYOND_DATA = 10.0
"""Multiple of all that was measured beyond which an effect counts as undetectable."""

SAME_FORCE, RESPONSE_CONTROLLED = 0.05, 0.2
"""Relative distance from its level's force within which a state was measured at it, and fraction
of states beyond from which on a test may be response-controlled."""

AS_NOISE = 1.3
"""Multiple of the noise up to which a misfit counts as noise; beyond it every 1σ is too small."""

FARTHEST_ERROR = 0.5
"""Relative or rad: an answer that requires larger velocity errors explains nothing; published
levels differ by 15 %."""

SETTLED_ERROR = 0.02
"""Tolerance of such errors between the last two iterations, relative or rad: its square is below
the noise."""

FREE_GAIN_STD = 1.0
"""Relative 1σ of a force gain that is unknown."""

FREE_CURVE = 6
"""Knots of a free curve of amplitude: enough to distinguish powers of it."""
