"""One thing at a time that may have gone wrong with a test, undone, and how one mode fits then."""

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

_OWN_OF_CURVES = 2  # states, beyond which both curves' value and slope are no matter of a limit
_LEVELS_GAIN = 0.02  # ln of what a limit takes from forces: cut more alike it is a gain of levels
_SHORTEST_SWEEP = 3  # states, from one turn of the frequency to the next
_LEFT = (0.2, 0.45, 0.7, 0.85)  # of what a step changes, at its end


class TestCorrection(NamedTuple):
    """A table read with one thing undone."""

    kind: Kind
    judged: FittedHypothesis
    value: float = np.nan  # its own parameter
    gains: tuple[float, ...] = ()  # ln of each level's force over what it should be
    file: int = 0  # that is of another structure, from 1
    column: str = ""  # that is cut off: "response" or "force"


def corrections(
    seen: CheckedStates, states: TestStates, base: FittedHypothesis
) -> Iterator[TestCorrection]:
    """Each correction with its likeliest parameter.

    Arguments: `states` as they are read; `base` how they fit.
    """
    for k, levels in enumerate(seen.files):
        if k > 0 or len(seen.files) > 2:  # of two the first differs as the second from it
            member = np.isin(states.level, levels)
            moved = _moving(states, base, member - float(np.mean(member)))
            yield TestCorrection("different_structures", *moved, file=k + 1)
    if base.misfit > NO_MODE:
        return
    yield TestCorrection("drift", *_moving(states, base, seen.order - 0.5))
    gains = base.posterior.level_errors[:, 0]
    if states.n_levels > 1 and (base.misfit > SCATTER or np.ptp(gains) > GAIN_MATTERS):
        std = (OTHER_GAIN, *states.level_std[1:])
        judged = _freer(states._replace(force_is_free=True, level_std=std), base)
        gains = judged.posterior.level_errors[:, 0]
        yield TestCorrection("volts_as_force", judged, gains=tuple(gains.tolist()))
    yield from _clipped(states, base)
    if not base.posterior.phase_is_controlled:  # a controller waits, and sets the force
        yield from _unsettled(seen, states, base)
        yield from _noisy_force(states, base)


def _freer(states: TestStates, base: FittedHypothesis) -> FittedHypothesis:
    """The fit of states with more that is unknown: anew, and from the fit without it on."""
    return likelier((fit_hypothesis(states), fit_hypothesis(states, start=base)))


def _moving(
    states: TestStates, base: FittedHypothesis, along: np.ndarray
) -> tuple[FittedHypothesis, float]:
    """A natural frequency that changes in proportion to something, and by how much (relative)."""
    judged = _freer(states._replace(trend=along, trend_std=MOVES), base)
    stiffness = np.maximum(1 + judged.posterior.trend[0] * along, 1e-6)  # over the mean one
    return judged, float(np.sqrt(stiffness[np.argmax(along)] / stiffness[np.argmin(along)])) - 1


def sweeps_apart(
    seen: CheckedStates, states: TestStates, base: FittedHypothesis
) -> FittedHypothesis | None:
    """The fit where what sweeps of a level differ by does not go with the time of the test.

    They differ by their pace, by settling and by warmth that comes and goes: both directions by one
    amount, all levels by a change that begins anew with each, or every sweep by its own error, as
    levels do. None where each level was swept once.
    """
    sweep, rising = sweeps(states.level, states.frequency, seen.order)
    if sweep.max() == states.level.max():
        return None
    parent = np.array([states.level[sweep == k][0] for k in range(sweep.max() + 1)])
    own = states._replace(level=sweep, level_std=(*states.level_std[:2], 0.0, states.level_std[3]))
    start = base._replace(posterior=base.posterior.beginning(parent))
    middle = np.array([seen.order[states.level == k].mean() for k in range(states.n_levels)])
    anew = seen.order - middle[states.level]
    alike = (_moving(states, base, along)[0] for along in (rising, anew))
    return likelier((*alike, fit_hypothesis(own, start=start)))


def sweeps(
    level: Int[np.ndarray, " state"],
    frequency: Float[np.ndarray, " state"],
    order: Float[np.ndarray, " state"],
) -> tuple[Int[np.ndarray, " state"], Float[np.ndarray, " state"]]:
    """The sweep of every state, counted from 0, and its direction: ½ upwards, −½ downwards.

    A sweep ends where the frequency does not go on in its direction. Where one is then shorter than
    three states, frequencies were not swept: the level is one part, without a direction.
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
    """One value of a correction's parameter."""

    value: float
    states: TestStates
    log_jacobian: float = 0.0


def likeliest(base: FittedHypothesis, tried: Sequence[Tried]) -> tuple[float, FittedHypothesis]:
    """The likeliest of several values, alike likely before, from what is nearest to the table as
    it is on.

    Each fit goes on from the last; where one is clearly less likely, so are those beyond.
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
    """The response or the force cut off at a limit."""
    size, force = np.abs(states.velocity), states.force
    limits = (0.96, 0.93, 0.9, 0.87, 0.84, 0.81)  # over the largest recorded fundamental
    tried = []
    for limit in limits:
        true, stretch = unclipped(size, limit * size.max())
        if np.sum(size > limit * size.max()) <= _OWN_OF_CURVES:
            continue
        errors = states.errors.copy()
        errors[:, 1] *= stretch
        moved = states._replace(velocity=states.velocity * true / size, errors=errors)
        tried.append(Tried(limit, moved, float(np.sum(np.log(stretch)))))
    value, judged = likeliest(base, tried)
    if tried:
        yield TestCorrection("clipped_channel", judged, value * size.max(), column="response")
    tried = []
    for limit in limits:
        true, _ = unclipped(force, limit * force.max())
        gain = np.log(true / force)
        if max(np.ptp(gain[states.level == k]) for k in range(states.n_levels)) > _LEVELS_GAIN:
            tried.append(Tried(limit, states._replace(force=true)))
    value, judged = likeliest(base, tried)
    if tried:
        yield TestCorrection("clipped_channel", judged, value * force.max(), column="force")


def unclipped(
    recorded: Float[np.ndarray, " state"], limit: float
) -> tuple[Float[np.ndarray, " state"], Float[np.ndarray, " state"]]:
    """Amplitudes of sines whose fundamental was recorded behind a limit, and their stretch.

    The fundamental of a sine of amplitude a that is cut off at c is a(2/π)(asin s + s√(1 − s²)),
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
    seen: CheckedStates, states: TestStates, base: FittedHypothesis
) -> Iterator[TestCorrection]:
    """What is left of the state before: of the mode's motion, or in the analyser's average.

    In a frame that turns with the force, V_n = V + (V_{n−1} − V) r after a dwell T: of a motion,
    which decays and turns at the mode's own pace, r = e^{(−δ/2 + i(ω̃ − Ω))T}; of an average with
    a time constant, as a lock-in amplifier has, r is the same real number at every state.
    """
    damping = np.abs(base.damping)
    omega = np.sqrt(np.maximum(base.stiffness, 0.25 * states.frequency**2))
    typical = float(np.median(damping)) / 2
    before = np.full(len(states.level), -1)
    for of_level in states_of_levels(states.level, seen.order):
        before[of_level[1:]] = of_level[:-1]
    pace = (-damping / 2 + 1j * (omega - states.frequency)) / typical if typical > 0 else 0.0
    for decay in (pace, -1.0):
        tried = []
        for fraction in _LEFT:
            left = np.where(before < 0, 0.0, np.exp(-np.log(fraction) * decay))
            true = (states.velocity - left * states.velocity[before]) / (1 - left)
            stretch = np.abs(states.velocity / (true * (1 - left)))
            errors = states.errors.copy()
            errors[:, 1:3] *= stretch[:, None]
            moved = states._replace(velocity=true, errors=errors)
            tried.append(Tried(fraction, moved, 2 * float(np.sum(np.log(stretch)))))
        value, judged = likeliest(base, tried)
        yield TestCorrection("unsettled_steps", judged, value)


def _noisy_force(states: TestStates, base: FittedHypothesis) -> Iterator[TestCorrection]:
    """A force that falls at resonance into its cell's noise, which is of one size in newtons."""
    if deepest_fall(states) < FORCE_FALLS:
        return
    tried = []
    least = float(states.force.min())
    for ratio in (4.0, 12.0, 40.0):  # the cell's noise over that of all else, at the least force
        floor = ratio * least / states.force
        errors = states.errors.copy()
        errors[:, [0, 2]] = np.hypot(errors[:, [0, 2]], floor[:, None])
        tried.append(Tried(ratio, states._replace(errors=errors)))
    ratio, judged = likeliest(base, tried)
    yield TestCorrection("force_dropout", judged, ratio * least * judged.noise)
