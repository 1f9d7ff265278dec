"""Possible errors of a test, corrected one at a time, and the fit of one mode to each."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from snrmjax.doctor.findings import Kind
from snrmjax.doctor.fitted_hypothesis import (
    CheckedStates,
    FittedHypothesis,
    fit_hypothesis,
    likelier,
)
from snrmjax.doctor.force_checks import deepest_fall
from snrmjax.doctor.priors import (
    CLEARLY,
    FORCE_FALLS,
    GAIN_MATTERS,
    MOVES,
    NO_MODE,
    OTHER_GAIN,
    SCATTER,
)
from snrmjax.identify.checks.residual_autocorrelation import states_of_levels
from snrmjax.identify.test_model.states import TestStates

_OWN_OF_CURVES = 2  # clipped states needed: fewer are explained by value and slope of the curves
_LEVELS_GAIN = 0.02  # spread of ln of the clipped force within a level; less is a gain of the level
_SHORTEST_SWEEP = 3  # states, from one reversal of the frequency to the next
_LEFT = (0.2, 0.45, 0.7, 0.85)  # remaining fraction of a step change, at its end


class TestCorrection(NamedTuple):
    """A table with one error corrected."""

    kind: Kind
    fit: FittedHypothesis
    value: float = np.nan  # its own parameter
    gains: tuple[float, ...] = ()  # ln of recorded over true force, for each level
    file: int = 0  # with another structure, from 1
    column: str = ""  # that is clipped: "response" or "force"


def corrections(
    checked: CheckedStates, states: TestStates, base: FittedHypothesis
) -> Iterator[TestCorrection]:
    """Each correction with its most likely parameter.

    Arguments: `states` as interpreted; `base` their fit.
    """
    for k, levels in enumerate(checked.files):
        if k > 0 or len(checked.files) > 2:  # of two files only the second is tried
            member = np.isin(states.level, levels)
            moved = _with_trend(states, base, member - float(np.mean(member)))
            yield TestCorrection("different_structures", *moved, file=k + 1)
    if base.misfit > NO_MODE:
        return
    yield TestCorrection("drift", *_with_trend(states, base, checked.order - 0.5))
    gains = base.posterior.level_errors[:, 0]
    if states.n_levels > 1 and (base.misfit > SCATTER or np.ptp(gains) > GAIN_MATTERS):
        std = (OTHER_GAIN, *states.level_std[1:])
        fit = _with_more_unknowns(states._replace(force_is_free=True, level_std=std), base)
        gains = fit.posterior.level_errors[:, 0]
        yield TestCorrection("volts_as_force", fit, gains=tuple(gains.tolist()))
    yield from _clipped(states, base)
    if not base.posterior.phase_is_controlled:  # a controller waits for the steady state
        yield from _unsettled(checked, states, base)
        yield from _noisy_force(states, base)


def _with_more_unknowns(states: TestStates, base: FittedHypothesis) -> FittedHypothesis:
    """The fit of states with additional unknowns: from scratch, and starting at the fit without."""
    return likelier((fit_hypothesis(states), fit_hypothesis(states, start=base)))


def _with_trend(
    states: TestStates, base: FittedHypothesis, along: np.ndarray
) -> tuple[FittedHypothesis, float]:
    """Fit with a natural frequency that varies along `along`, and its relative change."""
    fit = _with_more_unknowns(states._replace(trend=along, trend_std=MOVES), base)
    stiffness = np.maximum(1 + fit.posterior.trend[0] * along, 1e-6)  # over the mean one
    return fit, float(np.sqrt(stiffness[np.argmax(along)] / stiffness[np.argmin(along)])) - 1


def sweeps_apart(
    checked: CheckedStates, states: TestStates, base: FittedHypothesis
) -> FittedHypothesis | None:
    """The best fit in which sweeps of a level differ for other reasons than a drift of the test.

    Sweep rate, settling and transient warming make sweeps differ: by one amount between both
    directions, by a change that restarts with each level, or by an independent error of each sweep.
    None where each level was swept once.
    """
    sweep, rising = sweeps(states.level, states.frequency, checked.order)
    if sweep.max() == states.level.max():
        return None
    parent = np.array([states.level[sweep == k][0] for k in range(sweep.max() + 1)])
    own = states._replace(level=sweep, level_std=(*states.level_std[:2], 0.0, states.level_std[3]))
    start = base._replace(posterior=base.posterior.beginning(parent))
    middle = np.array([checked.order[states.level == k].mean() for k in range(states.n_levels)])
    anew = checked.order - middle[states.level]
    alike = (_with_trend(states, base, along)[0] for along in (rising, anew))
    return likelier((*alike, fit_hypothesis(own, start=start)))


def sweeps(
    level: Int[np.ndarray, " state"],
    frequency: Float[np.ndarray, " state"],
    order: Float[np.ndarray, " state"],
) -> tuple[Int[np.ndarray, " state"], Float[np.ndarray, " state"]]:
    """The sweep of every state, counted from 0, and its direction: ½ upwards, −½ downwards.

    A sweep ends where the frequency reverses. If one is then shorter than three states, frequencies
    were not swept: the level is one part, without a direction.
    """
    sweep, rising = np.zeros(len(level), dtype=int), np.zeros(len(level))
    count = 0
    for of_level in states_of_levels(level, order):
        up = np.diff(frequency[of_level]) > 0
        begins = [0]
        for k in range(len(up)):
            if k > begins[-1] and up[k] != up[begins[-1]]:
                begins.append(k + 1)
        parts = np.split(of_level, begins[1:])
        if min(len(part) for part in parts) < _SHORTEST_SWEEP:
            parts = [of_level]
        else:
            for k, part in enumerate(parts):
                rising[part] = up[begins[k]] - 0.5
        for part in parts:
            sweep[part] = count
            count += 1
    return sweep, rising


class Tried(NamedTuple):
    """One trial value of a correction's parameter."""

    value: float
    states: TestStates
    log_jacobian: float = 0.0


def likeliest(base: FittedHypothesis, tried: Sequence[Tried]) -> tuple[float, FittedHypothesis]:
    """The most likely of several values of equal prior probability, nearest to the recorded first.

    Each fit starts from the last; the search ends once one is clearly less likely.
    """
    value, best, last = np.nan, None, base
    for one in tried:
        last = fit_hypothesis(one.states, one.log_jacobian - np.log(len(tried)), start=last)
        if best is None or last.evidence > best.evidence:
            value, best = one.value, last
        if last.evidence < max(best.evidence, base.evidence) - CLEARLY:
            break
    return value, best or base


def _clipped(states: TestStates, base: FittedHypothesis) -> Iterator[TestCorrection]:
    """The response or the force clipped at a limit."""
    amplitude, force = np.abs(states.velocity), states.force
    limits = (0.96, 0.93, 0.9, 0.87, 0.84, 0.81)  # over the largest recorded fundamental
    tried = []
    for limit in limits:
        true, stretch = unclipped(amplitude, limit * amplitude.max())
        if np.sum(amplitude > limit * amplitude.max()) <= _OWN_OF_CURVES:
            continue
        errors = states.errors.copy()
        errors[:, 1] *= stretch
        corrected = states._replace(velocity=states.velocity * true / amplitude, errors=errors)
        tried.append(Tried(limit, corrected, float(np.sum(np.log(stretch)))))
    value, fit = likeliest(base, tried)
    if tried:
        yield TestCorrection("clipped_channel", fit, value * amplitude.max(), column="response")
    tried = []
    for limit in limits:
        true, _ = unclipped(force, limit * force.max())
        gain = np.log(true / force)
        if max(np.ptp(gain[states.level == k]) for k in range(states.n_levels)) > _LEVELS_GAIN:
            tried.append(Tried(limit, states._replace(force=true)))
    value, fit = likeliest(base, tried)
    if tried:
        yield TestCorrection("clipped_channel", fit, value * force.max(), column="force")


def unclipped(
    recorded: Float[np.ndarray, " state"], limit: float
) -> tuple[Float[np.ndarray, " state"], Float[np.ndarray, " state"]]:
    """True amplitudes of sines whose clipped fundamental was recorded, and their stretch.

    The fundamental of a sine of amplitude a clipped at c is a(2/π)(asin s + s√(1 − s²)),
    s = c/a. The stretch is d ln(true) / d ln(recorded).
    """
    s = np.concatenate([np.linspace(1.0, 0.05, 400), np.geomspace(0.05, 0.004, 60)[1:]])
    first = (2 / np.pi) * (np.arcsin(s) + s * np.sqrt(1 - s**2)) / s  # over the limit
    above = recorded > limit
    inside = np.minimum(recorded, first[-1] * limit) / limit
    true = np.where(above, limit / np.interp(inside, first, s), recorded)
    slope = np.gradient(
        -np.log(s), np.log(np.maximum.accumulate(first) + 1e-12 * np.arange(len(s)))
    )
    stretch = np.where(above, np.interp(inside, first, slope), 1.0)
    return true, np.clip(stretch, 1.0, 1e4)


def _unsettled(
    checked: CheckedStates, states: TestStates, base: FittedHypothesis
) -> Iterator[TestCorrection]:
    """Remainder of the previous state: of the mode's motion, or in the analyser's average.

    In the rotating frame of the force, V_n = V + (V_{n−1} − V) r after a dwell T. For the mode's
    free decay r = e^{(−δ/2 + i(ω̃ − Ω))T}; for an average with a time constant, as in a lock-in
    amplifier, r is the same real number at every state.
    """
    damping = np.abs(base.damping)
    omega = np.sqrt(np.maximum(base.stiffness, 0.25 * states.frequency**2))
    typical = float(np.median(damping)) / 2
    before = np.full(len(states.level), -1)
    for of_level in states_of_levels(states.level, checked.order):
        before[of_level[1:]] = of_level[:-1]
    rate = (-damping / 2 + 1j * (omega - states.frequency)) / typical if typical > 0 else 0.0
    for decay in (rate, -1.0):
        tried = []
        for fraction in _LEFT:
            left = np.where(before < 0, 0.0, np.exp(-np.log(fraction) * decay))
            true = (states.velocity - left * states.velocity[before]) / (1 - left)
            stretch = np.abs(states.velocity / (true * (1 - left)))
            errors = states.errors.copy()
            errors[:, 1:3] *= stretch[:, None]
            corrected = states._replace(velocity=true, errors=errors)
            tried.append(Tried(fraction, corrected, 2 * float(np.sum(np.log(stretch)))))
        value, fit = likeliest(base, tried)
        yield TestCorrection("unsettled_steps", fit, value)


def _noisy_force(states: TestStates, base: FittedHypothesis) -> Iterator[TestCorrection]:
    """A force that drops at resonance into the noise of its cell, constant in newtons."""
    if deepest_fall(states) < FORCE_FALLS:
        return
    tried = []
    least = float(states.force.min())
    for ratio in (4.0, 12.0, 40.0):  # noise of the cell over all other noise, at the smallest force
        floor = ratio * least / states.force
        errors = states.errors.copy()
        errors[:, [0, 2]] = np.hypot(errors[:, [0, 2]], floor[:, None])
        tried.append(Tried(ratio, states._replace(errors=errors)))
    ratio, fit = likeliest(base, tried)
    yield TestCorrection("force_dropout", fit, ratio * least * fit.noise)
