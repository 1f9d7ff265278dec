"""The point between two neighbours of a curve where a test function changes its sign."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from snrmjax.simulate.continuation.continuation import Linearised, Point, StepControl, correct

_TRIALS = 40  # of the secant method, at most


class LocatedEvent(NamedTuple):
    """What was found of a sign change between two neighbours."""

    point: Point
    tangent: Point
    resolved: Bool[Array, ""]  # the point is there
    missed: Bool[Array, ""]  # the sign does change, but the point was not found


def locate_event(
    linearised: Linearised,
    test: Callable[[Point, Point], Float[Array, ""]],
    here: Point,
    tangent: Point,
    there: Point,
    control: StepControl,
    wanted: Bool[Array, ""] | bool = True,
) -> LocatedEvent:
    """The point between two neighbours where `test(point, tangent)` changes sign.

    Illinois' variant of the secant method in the arclength, each trial corrected across the
    tangent. It is resolved when the sign change lies between the neighbours, or beside them by
    less than the tangents of a curve are late; where the corrected neighbours have one sign there
    is nothing to find. Where it is not `wanted` nothing is computed.
    Reference: Dowell & Jarratt, BIT 11 (1971) 168, doi:10.1007/BF01934364.
    """
    length = tangent @ (there - here)

    def trial(share: Array, guess: Point) -> tuple[_Known, Bool[Array, ""]]:
        guess = guess + (share * length - tangent @ (guess - here)) * tangent
        found = correct(
            linearised, guess, tangent, 1e-3 * control.tolerance, 2 * control.iterations
        )
        # With the slope against the share of the way the curve between two trials is a cubic.
        slope = found.tangent * (length / (tangent @ found.tangent))
        value = test(found.point, found.tangent)
        return _Known(share, value, found.point, found.tangent, slope), found.converged

    def body(state: _Bracket) -> _Bracket:
        low, high, side, share = state.low, state.high, state.side, state.share
        is_low, is_high = state.trials == 0, state.trials == 1
        guess = jnp.where(is_low, here, jnp.where(is_high, there, _cubic(low, high, share)))
        found, converged = trial(share, guess)
        inner = ~is_low & ~is_high
        in_upper = inner & (jnp.sign(found.value) == jnp.sign(low.value))
        in_lower = inner & ~in_upper
        halved = jnp.where(in_lower & (side == -1), 0.5, 1.0)
        low = low._replace(value=low.value * halved)
        halved = jnp.where(in_upper & (side == 1), 0.5, 1.0)
        high = high._replace(value=high.value * halved)
        low = _chosen(in_upper | is_low, found, low)
        high = _chosen(in_lower | is_high, found, high)
        differ = low.value * high.value <= 0
        secant = (low.share * high.value - high.share * low.value) / (high.value - low.value)
        secant = jnp.where(jnp.isfinite(secant), secant, 0.5 * (low.share + high.share))
        next_share = jnp.where(is_low, 1.0, secant)
        settled = (inner & (jnp.abs(next_share - share) < 1e-12)) | (inner & (found.value == 0))
        return _Bracket(
            trials=state.trials + 1,
            low=low,
            high=high,
            side=jnp.where(in_upper, 1, jnp.where(in_lower, -1, 0)),
            share=jnp.where(settled, share, next_share),
            last=found,
            converged=converged,
            doubtful=state.doubtful | (~inner & ~converged) | (is_high & differ),
            settled=settled,
        )

    zero = jnp.array(0.0)
    nothing = _Known(zero, zero, here, tangent, tangent)
    state = _Bracket(
        trials=jnp.array(0),
        low=nothing,
        high=nothing,
        side=jnp.array(0),
        share=zero,
        last=nothing,
        converged=jnp.array(True),
        doubtful=jnp.array(False),
        settled=~jnp.asarray(wanted),
    )
    end = jax.lax.while_loop(lambda s: ~s.settled & (s.trials < _TRIALS), body, state)
    inside = jnp.abs(end.share - 0.5) < 0.51
    changes = end.low.value * end.high.value <= 0
    resolved = end.converged & inside & changes & jnp.asarray(wanted)
    # Tangents along a curve are a little late: a sign may seem to change where it does not.
    missed = ~resolved & end.doubtful & jnp.asarray(wanted)
    return LocatedEvent(end.last.point, end.last.tangent, resolved, missed)


class _Known(NamedTuple):
    """What a trial between two neighbours found."""

    share: Array  # of the way
    value: Array  # of the test function, halved where the other end keeps moving
    point: Array
    tangent: Array  # of unit length
    slope: Array  # dpoint/dshare


class _Bracket(NamedTuple):
    """The state of the search for a sign change."""

    trials: Array
    low: _Known
    high: _Known
    side: Array  # which end moved last
    share: Array  # of the way, for the next trial
    last: _Known
    converged: Array  # the last trial
    doubtful: Array  # an end is not known, or the sign differs at the ends
    settled: Array


def _chosen(first: Bool[Array, ""], yes: _Known, no: _Known) -> _Known:
    return _Known(*(jnp.where(first, a, b) for a, b in zip(yes, no, strict=True)))


def _cubic(low: _Known, high: _Known, share: Array) -> Point:
    """Where the cubic through two trials and their tangents is."""
    width = high.share - low.share
    s = (share - low.share) / width
    chord = high.point - low.point
    bend_low, bend_high = low.slope * width - chord, high.slope * width - chord
    return low.point + s * chord + s * (1 - s) * ((1 - s) * bend_low - s * bend_high)
