"""How well one mode with any smooth curves explains states, as recorded or as they may be meant.

Every hypothesis is fitted by the one model of a test (`identify.test_model`): its evidence is the
density of what was recorded, however it is read, so that hypotheses compare directly.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.doctor.priors import ANY_MASS, CLEARLY, FITS_WELL, NO_MODE, SCATTER
from snrmjax.identify.checks.residual_autocorrelation import share_told_by
from snrmjax.identify.test_model.posterior import TestPosterior, fit_test
from snrmjax.identify.test_model.priors import LEAST_SHARE
from snrmjax.identify.test_model.states import TestStates
from snrmjax.identify.test_model.walk import Rounds

_ROUNDS, _FINE = 6, 16  # of a fit: for most; for what is to be said
_KNOTS = 24  # of its curves, at most
_NEARLY = 1.0  # relative, of amplitudes for which fits may go on from one another
_STAYS = 0.3  # of ln κ, from which on forces are scaled anew: what is linear reaches as far
_ALLED = 3  # fits of a modal mass from one start, at most
_MAGNITUDES = (8.0, 1 / 8, 64.0, 1 / 64)  # over the model's
_GUESSED = 1e3  # its 1σ in the first of them


class Judged(NamedTuple):
    """A hypothesis and how it fits."""

    states: TestStates  # as it reads them
    posterior: TestPosterior
    evidence: float  # ln of the density of the recorded phasors' logarithms

    @property
    def misfit(self) -> float:
        """Relative error of independent states as likely as these, curves and levels paid.

        n states with an error σ of amplitude and phase have ln p = −n(2 ln σ + ln 2π + 1).
        """
        each = self.posterior.log_evidence / len(self.states.level)
        return float(np.exp(min(-0.5 * (each + np.log(2 * np.pi) + 1), 99.0)))

    @property
    def noise(self) -> float:
        """What is left of single states, relative."""
        return self.posterior.hyper.noise

    @property
    def damping(self) -> Float[np.ndarray, " state"]:
        """δ at the states, 1/s."""
        return self.posterior.curves(self.states.amplitude).modal_damping

    @property
    def stiffness(self) -> Float[np.ndarray, " state"]:
        """ω̃² at the states, rad²/s²."""
        return self.posterior.curves(self.states.amplitude).squared_frequency

    @property
    def fits(self) -> bool:
        """Whether it fits in itself, with energy lost and not gained."""
        return self.misfit < FITS_WELL and self.damped

    @property
    def damped(self) -> bool:
        """Whether the mode loses energy, but for a tenth of the states and their noise."""
        return bool(np.quantile(self.damping, 0.1) > 0)

    def gain(self, recorded: "Judged") -> float:
        """ln of the odds against the table as recorded; an undamped mode has no odds."""
        if not self.damped:
            return -np.inf
        return self.evidence - recorded.evidence if recorded.damped else np.inf

    def leaves_less(self, recorded: "Judged") -> bool:
        """Whether one mode misses states by less, once they are read so.

        Where an error is steep in what was recorded, stretched errors alone may be likelier.
        """
        return self.misfit < recorded.misfit or not recorded.damped

    def is_likelier(self, other: "Judged") -> bool:
        """Whether it is the likelier of two that explain a table, and fits in itself."""
        here, there = (one._from(one) for one in (self, other))
        return self.fits and here.leaves_less(there) and here.gain(there) > 0

    def beats(self, recorded: "Judged", *, beside: bool = True) -> bool:
        """Whether it fits in itself, and the table as recorded clearly less.

        Odds count by the share of states that tell something of their own: where neighbours still
        miss the curves alike, what was undone is not what is wrong.
        """
        return self.fits and self.explains(recorded, beside=beside)

    def explains(self, recorded: "Judged", *, beside: bool = True) -> bool:
        """Whether the table as recorded is clearly less likely, and misses its states by more.

        Also with what one mode leaves off resonance `beside` it: then nothing else need be wrong.
        And each also from where the other has curves and levels: of two fits that might both go
        there none is less likely for having stopped on the way.
        """

        def clearly(here: "Judged", there: "Judged") -> bool:
            return here.leaves_less(there) and here.share * here.gain(there) > CLEARLY

        if not clearly(self, recorded):
            return False
        here, there = self._from(self), recorded._from(recorded)
        there = there._from(here)
        here = here._from(there)
        if beside:
            here, there = (one._from(None, discrepancy=True) for one in (here, there))
        return clearly(here, there)

    @property
    def share(self) -> float:
        """Of independent states."""
        left = self.posterior.residuals
        return max(share_told_by(left, self.states.level, self.states.frequency), LEAST_SHARE)

    def _from(self, start: "Judged | None", *, discrepancy: bool = False) -> "Judged":
        """The likelier of this fit and one with as many rounds as the steepest curves need, from
        another of nearly these amplitudes on.
        """
        if start is not None and start is not self:
            own, other = self.states.amplitude, start.states.amplitude
            if not (start.damped and np.allclose(own, other, rtol=_NEARLY)):
                return self
        jacobian = self.evidence - self.posterior.log_evidence
        fit = judge(self.states, jacobian, _FINE, start, discrepancy=discrepancy)
        return likelier((self, fit))


def likelier(fits: Iterable[Judged]) -> Judged:
    """The likeliest of fits, those before all that lose energy."""
    return max(fits, key=lambda one: (one.damped, one.evidence))


class Scale(NamedTuple):
    """The most likely modal mass over the model's."""

    judged: Judged  # with forces divided by it
    mass: float
    std: float  # of its logarithm


def judge(
    states: TestStates,
    log_jacobian: float = 0.0,
    rounds: int = _ROUNDS,
    start: Judged | None = None,
    *,
    discrepancy: bool = False,
) -> Judged:
    """Fit states by the model of a test.

    Arguments: `log_jacobian` of the recorded to these phasors, both as logarithms;
    `rounds` of the fit, which go on from `start` where that is of nearly these states;
    with `discrepancy` beside what one mode leaves off resonance.
    """
    for fewer in (rounds, 2, 1):
        first = None if start is None else start.posterior
        walked = Rounds(fewer, _KNOTS, states.n_levels > 1, first)
        try:
            posterior = fit_test(
                states, discrepancy=discrepancy, compare_levels=False, rounds=walked
            )
            break
        except np.linalg.LinAlgError:  # of phasors that are no mode's
            if fewer == 1:
                raise
    return Judged(states, posterior, posterior.log_evidence + log_jacobian)


def any_mass(states: TestStates, log_jacobian: float = 0.0, *, far: bool = False) -> Scale:
    """The fit with the likeliest modal mass, whatever the model's is.

    From where a first fit that knows nothing of it puts it; or where its best fit leaves more than
    instruments do, and so was no good guide, from other orders of magnitude (`far`).
    """
    first = judge(states._replace(mass_std=_GUESSED), log_jacobian)
    mass, std = first.posterior.modal_mass
    found = _about(states, max(abs(mass), 1e-3 * std, 1e-12), log_jacobian)
    if not (far and SCATTER < found.judged.misfit < NO_MODE):
        return found
    tried = [found, *(_about(states, one, log_jacobian, 1) for one in _MAGNITUDES)]
    best = max(tried, key=lambda one: one.judged.evidence)
    return best if best is found else _about(states, best.mass, log_jacobian)


def _about(states: TestStates, start: float, log_jacobian: float, steps: int = _ALLED) -> Scale:
    """The likeliest modal mass from some on: forces are divided by it until it stays."""
    mass, std = start, np.inf
    for _ in range(steps):
        scale = mass
        judged = judge(with_mass(states, scale)._replace(mass_std=ANY_MASS), log_jacobian)
        step, std = judged.posterior.modal_mass
        mass = scale * max(step, 1 / _GUESSED)
        if abs(np.log(mass / scale)) < _STAYS:
            break
    return Scale(judged, mass, std / step if step > 0 else np.inf)


def with_mass(states: TestStates, mass: float) -> TestStates:
    """Forces divided by κ."""
    return states._replace(force=states.force / mass)
