"""How well one mode with any smooth curves explains states, as recorded or as they may be meant.

Every hypothesis is fitted by the one model of a test (`identify.test_model`): its evidence is the
density of what was recorded, however it is read, so that hypotheses compare directly.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.doctor.priors import CLEARLY, FITS_WELL, PER_STATE, SCATTER
from snrmjax.identify.test_model.posterior import TestPosterior, fit_test
from snrmjax.identify.test_model.states import TestStates

_ROUNDS, _FINE = 4, 12  # of a fit: for most; for what is to be said
_STEP, _WIDER = 0.18, 1.8  # of a search for ln κ: its first step and by what it grows
_SEARCHED = 8  # fits of that search, at most
_GUESSED = 1e3  # 1σ of κ where nothing is known of it
_SIGN = 4.0  # 1σ from which on its sign is known


class Judged(NamedTuple):
    """A hypothesis and how it fits."""

    states: TestStates  # as it reads them
    posterior: TestPosterior
    evidence: float  # ln of the density of the recorded phasors' logarithms

    @property
    def misfit(self) -> float:
        """Relative error of independent states that have the same density, curves and levels paid.

        n states with an error σ of amplitude and phase have ln p = −n(2 ln σ + ln 2π + 1).
        """
        each = self.evidence / len(self.states.level)
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

    def beats(self, recorded: "Judged") -> bool:
        """Whether it fits in itself, and the table as recorded clearly less.

        Much less where it leaves more than instruments do: then curves are not what it takes.
        """
        return self._clearly_above(recorded) and self._finer()._clearly_above(recorded._finer())

    def _clearly_above(self, recorded: "Judged") -> bool:
        each = PER_STATE if self.misfit < SCATTER else 4 * PER_STATE
        return self.fits and self.gain(recorded) > max(CLEARLY, each * len(self.states.level))

    def _finer(self) -> "Judged":
        """Fitted with as many rounds as the steepest curves need."""
        return judge(self.states, self.evidence - self.posterior.log_evidence, _FINE)


class Scale(NamedTuple):
    """The most likely modal mass over the model's."""

    judged: Judged  # with forces divided by it
    mass: float
    std: float  # of its logarithm


def judge(states: TestStates, log_jacobian: float = 0.0, rounds: int = _ROUNDS) -> Judged:
    """Fit states with the modal mass held.

    Arguments: `log_jacobian` of the recorded to these phasors, both as logarithms;
    `rounds` of the fit.
    """
    held = states._replace(mass_std=0.0)
    for fewer in (rounds, 2, 1):
        try:
            posterior = fit_test(held, rounds=fewer)
            break
        except np.linalg.LinAlgError:  # of phasors that are no mode's
            if fewer == 1:
                raise
    return Judged(states, posterior, posterior.log_evidence + log_jacobian)


def guessed_mass(states: TestStates) -> float:
    """κ of a quick fit that leaves it free: its sign and size, where curves are not steep.

    NaN where that fit does not tell its sign.
    """
    scale = 1.0
    for _ in range(4):
        found = fit_test(states._replace(mass_std=_GUESSED), rounds=3)
        mass, std = found.modal_mass
        step = max(abs(mass), 1e-3 * std, 1e-12)
        states, scale = with_mass(states, step), scale * step
        if abs(np.log(step)) < 1.0:
            return float(np.copysign(scale, mass)) if abs(mass) > _SIGN * std else np.nan
    return np.nan


def with_mass(states: TestStates, mass: float) -> TestStates:
    """Forces divided by κ."""
    return states._replace(force=states.force / mass)


def best_scale(states: TestStates, start: float, first: Judged, log_jacobian: float) -> Scale:
    """The modal mass of the largest evidence, from `start` on, where the fit is `first`."""
    top = climbed(
        lambda x: judge(with_mass(states, float(np.exp(x))), log_jacobian),
        *(float(np.log(start)), _STEP, first),
    )
    mass, std = float(np.exp(top.value)), top.std
    # Where a free fit stays here it is finer than the parabola's steps.
    free, free_std = fit_test(
        top.judged.states._replace(mass_std=_GUESSED), rounds=_ROUNDS
    ).modal_mass
    if abs(free - 1) < _STEP and free_std < std:
        mass, std = mass * free, free_std
    return Scale(top.judged, mass, std)


class Top(NamedTuple):
    """The most likely value of one parameter."""

    value: float
    std: float  # of a parabola through its neighbours
    judged: Judged


def climbed(fit: Callable[[float], Judged], start: float, step: float, first: Judged) -> Top:
    """The value of the largest evidence uphill from `start`, where the fit is `first`."""
    known = {start: first}

    def loss(x: float) -> float:
        if x not in known:
            known[x] = fit(x)
        return -known[x].evidence

    at = [start - step, start, start + step]
    for _ in range(_SEARCHED - 2):
        values = [loss(one) for one in at]
        if values[1] <= min(values):
            break
        if values[0] < values[2]:
            at = [at[0] - _WIDER * (at[1] - at[0]), at[0], at[1]]
        else:
            at = [at[1], at[2], at[2] + _WIDER * (at[2] - at[1])]
    while True:
        values = [loss(one) for one in at]
        left, right = ((values[1] - values[k]) / (at[1] - at[k]) for k in (0, 2))
        curvature = 2 * (right - left) / (at[2] - at[0])
        lowest = 0.5 * (at[0] + at[1]) - left / curvature if curvature > 0 else at[1]
        near = abs(lowest - at[1]) < 0.1 * step
        if len(known) >= _SEARCHED or near or not at[0] < lowest < at[2]:
            break
        best = min((lowest, at[1]), key=loss)
        below = max(one for one in known if one < best)
        above = min(one for one in known if one > best)
        at = [below, best, above]
    std = float(1 / np.sqrt(curvature)) if curvature > 0 else np.inf
    return Top(at[1], std, known[at[1]])
