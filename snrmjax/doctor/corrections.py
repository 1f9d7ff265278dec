"""One thing at a time that may have gone wrong with a test, undone, and how one mode fits then."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.doctor.checked_states import CheckedStates
from snrmjax.doctor.findings import Kind
from snrmjax.doctor.force_checks import deepest_fall
from snrmjax.doctor.judgement import Judged, climbed, judge
from snrmjax.doctor.priors import AS_STATED, FORCE_FALLS, GAIN_MATTERS, SCATTER
from snrmjax.identify.test_model.states import TestStates

_LIMITS = (0.8, 0.85, 0.92)  # of a channel, over its largest recorded fundamental
_SHARES = (0.2, 0.45, 0.7, 0.85)  # of a transient that are left at the end of a step
_TREND = 0.5  # of a natural frequency, over its bandwidth: first step of a search
_WIDEST = 0.1  # a bandwidth over its frequency: of a larger one no drift is told
_FLOORS = (4.0, 12.0, 40.0)  # noise of the force's cell over that of all else, at the least force
_WIDE_GAIN = 0.4  # 1σ of a level's gain where forces may have several scales


class TestCorrection(NamedTuple):
    """A table read with one thing undone."""

    kind: Kind
    name: str  # which of that kind
    judged: Judged
    value: float = np.nan  # its own parameter
    gains: tuple[float, ...] = ()  # ln of each level's force over what it should be


def corrections(seen: CheckedStates, states: TestStates, base: Judged) -> Iterator[TestCorrection]:
    """Each correction with its likeliest parameter.

    What leaves scatter of the states is not looked for where they scatter as they should.
    Arguments: `states` as they are read; `base` how they fit.
    """
    yield _drifting(seen, states, base)
    scattered = base.noise > AS_STATED * seen.noise or not np.isfinite(seen.noise)
    scattered = scattered and base.misfit > SCATTER
    gains = base.posterior.level_errors[:, 0]
    if states.n_levels > 1 and (scattered or np.ptp(gains) > GAIN_MATTERS):
        yield _of_other_gains(states)
    if scattered:
        yield from _clipped(states)
        yield from _unsettled(seen, states, base)
        yield from _noisy_force(seen, states)


def _likeliest(tried: list[tuple[float, TestStates, float]]) -> tuple[float, Judged]:
    """The likeliest of several values, each with states and a Jacobian."""
    judged = [(value, judge(states, jacobian)) for value, states, jacobian in tried]
    return max(judged, key=lambda one: one[1].evidence)


def _clipped(states: TestStates) -> Iterator[TestCorrection]:
    """The response or the force cut off at a limit."""
    size = np.abs(states.velocity)
    tried = []
    for limit in _LIMITS:
        true, stretch = unclipped(size, limit * size.max())
        errors = states.errors * np.column_stack([np.ones_like(size), stretch, np.ones_like(size)])
        moved = states._replace(velocity=states.velocity * true / size, errors=errors)
        tried.append((limit * float(size.max()), moved, float(np.sum(np.log(stretch)))))
    value, judged = _likeliest(tried)
    yield TestCorrection("clipped_channel", "velocity", judged, value)
    force = states.force
    tried = [
        (x * float(force.max()), states._replace(force=unclipped(force, x * force.max())[0]), 0.0)
        for x in _LIMITS
    ]
    value, judged = _likeliest(tried)
    yield TestCorrection("clipped_channel", "force", judged, value)


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


def _unsettled(seen: CheckedStates, states: TestStates, base: Judged) -> Iterator[TestCorrection]:
    """What is left of the motion of the state before, decaying and turning at the mode's own pace.

    In a frame that turns with the force, V_n = V + (V_{n−1} − V) e^{(−δ/2 + i(ω̃ − Ω))T} after a
    dwell T.
    """
    damping = np.abs(base.damping)
    omega = np.sqrt(np.maximum(base.stiffness, 0.25 * states.frequency**2))
    typical = float(np.median(damping)) / 2
    before = np.full(len(states.level), -1)
    for k in range(states.n_levels):
        mine = np.flatnonzero(states.level == k)
        mine = mine[np.argsort(seen.order[mine], kind="stable")]
        before[mine[1:]] = mine[:-1]
    first = before < 0
    tried = []
    for share in _SHARES:
        rate = -np.log(share) / typical if typical > 0 else 0.0
        left = np.exp((-damping / 2 + 1j * (omega - states.frequency)) * rate)
        left = np.where(first, 0.0, left)
        true = (states.velocity - left * states.velocity[before]) / (1 - left)
        stretch = np.abs(states.velocity / (true * (1 - left)))
        errors = states.errors * np.column_stack([np.ones_like(stretch), stretch, stretch])
        moved = states._replace(velocity=true, errors=errors)
        tried.append((share, moved, 2 * float(np.sum(np.log(stretch)))))
    value, judged = _likeliest(tried)
    yield TestCorrection("unsettled_steps", "turning", judged, value)


def _drifting(seen: CheckedStates, states: TestStates, base: Judged) -> TestCorrection:
    """A natural frequency that changes along the test.

    Frequencies are divided by e^ν(order − ½): then K, Ω² and Ωδ are all those of the middle.
    """
    place = seen.order - 0.5
    width = min(float(np.median(np.abs(base.damping) / states.frequency)), _WIDEST)

    def moved(change: float) -> TestStates:
        factor = np.exp(change * place)
        return states._replace(
            frequency=states.frequency / factor,
            velocity=states.velocity / factor,
            force=states.force / factor**2,
        )

    top = climbed(lambda change: judge(moved(change)), 0.0, _TREND * width, base)
    return TestCorrection("drift", "frequency", top.judged, top.value)


def _noisy_force(seen: CheckedStates, states: TestStates) -> Iterator[TestCorrection]:
    """A force that falls at resonance into its cell's noise, which is of one size in newtons."""
    if deepest_fall(states) < FORCE_FALLS:
        return
    tried = []
    least = float(states.force.min())
    for ratio in _FLOORS:
        floor = ratio * least / states.force
        errors = np.hypot(states.errors, np.stack([floor, 0 * floor, floor], axis=1))
        tried.append((ratio, states._replace(errors=errors), 0.0))
    ratio, judged = _likeliest(tried)
    yield TestCorrection("force_dropout", "floor", judged, ratio * least * judged.noise)


def _of_other_gains(states: TestStates) -> TestCorrection:
    """A scale of its own for the force of each level."""
    gains = np.zeros(states.n_levels)
    std = (_WIDE_GAIN, *states.level_std[1:])
    now = states
    for _ in range(2):
        free = now._replace(force_is_free=True, level_std=std)
        step = judge(free).posterior.level_errors[:, 0]
        gains = gains + step
        now = states._replace(force=states.force * np.exp(-gains[states.level]))
    each = np.log(_WIDE_GAIN * np.sqrt(2 * np.pi) / 0.005)  # a gain found to 0.5 %
    judged = judge(now)
    judged = judged._replace(evidence=judged.evidence - each * states.n_levels)
    return TestCorrection("volts_as_force", "gain_of_level", judged, gains=tuple(gains.tolist()))
