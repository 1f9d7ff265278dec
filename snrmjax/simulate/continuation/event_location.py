"""The point between two neighbours of a curve where a test function changes its sign."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from snrmjax.simulate.continuation.continuation import StepControl
from snrmjax.simulate.continuation.newton import Linearised, Point, Trial, chosen

_TRIALS = 40  # of the secant method, at most
_CLOSE = 1e-10  # of the way between the neighbours: the next trial would be as near


class EventSearch(eqx.Module):
    """The search between two neighbours of a curve for where `test(point, tangent)` changes sign.

    Anderson and Björck's variant of the secant method in the arclength, each trial corrected
    across the tangent at the first neighbour, `here`. The event is resolved when the sign change
    lies between the neighbours, or beside them by less than the tangents of a curve are late;
    where the corrected neighbours have one sign there is nothing to find.
    Reference: Anderson & Björck, BIT 13 (1973) 253, doi:10.1007/BF01951936.
    """

    linearised: Linearised
    test: Callable[[Point, Point], Float[Array, ""]]
    here: Point
    tangent: Point
    there: Point
    control: StepControl

    def begun(self) -> "Bracket":
        """Before the first trial, at `here`."""
        zero, no = jnp.array(0.0), jnp.array(False)
        nothing = _Known(zero, zero, self.here, self.tangent, self.tangent)
        return Bracket(
            trials=jnp.array(0),
            low=nothing,
            high=nothing,
            side=jnp.array(0),
            fraction=zero,
            last=nothing,
            converged=~no,
            doubtful=no,
            ended=no,
            trial=self._trial(zero, self.here),
        )

    def advanced(self, state: "Bracket") -> "Bracket":
        """After one step of Newton's method."""
        trial = state.trial.stepped(self.linearised, 1e-3 * self.control.tolerance)
        state = state._replace(trial=trial)
        going = trial.goes_on(2 * self.control.iterations)
        return chosen(going, state, self._judged(state))

    def ended(self, wanted: Bool[Array, ""] | bool = True) -> "Bracket":
        """The search at its end; it is not begun where it is not wanted."""
        return jax.lax.while_loop(
            lambda state: ~state.ended,
            lambda state: self.advanced(state),
            self.begun()._replace(ended=~jnp.asarray(wanted)),
        )

    def _length(self) -> Float[Array, ""]:
        return self.tangent @ (self.there - self.here)

    def _trial(self, fraction: Array, guess: Point) -> Trial:
        """The correction at a share of the way, from a guess beside it."""
        beside = fraction * self._length() - self.tangent @ (guess - self.here)
        return Trial.at(guess + beside * self.tangent, self.tangent)

    def _judged(self, state: "Bracket") -> "Bracket":
        """After a correction that has ended, with the next one begun."""
        low, high, side, fraction, trial = (
            state.low,
            state.high,
            state.side,
            state.fraction,
            state.trial,
        )
        # With the slope against the share of the way the curve between two trials is a cubic.
        slope = trial.tangent * (self._length() / (self.tangent @ trial.tangent))
        value = self.test(trial.point, trial.tangent)
        found = _Known(fraction, value, trial.point, trial.tangent, slope)
        is_low, is_high = state.trials == 0, state.trials == 1
        inner = ~is_low & ~is_high
        in_upper = inner & (jnp.sign(found.value) == jnp.sign(low.value))
        in_lower = inner & ~in_upper
        # An end that stays counts less: by the share of its value that the other one lost.
        lost = [1 - value / end.value for end in (low, high)]
        less = [jnp.where(part > 0, part, 0.5) for part in lost]
        by_low = jnp.where(in_lower & (side == -1), less[1], 1.0)
        by_high = jnp.where(in_upper & (side == 1), less[0], 1.0)
        low, high = (e._replace(value=e.value * by) for e, by in ((low, by_low), (high, by_high)))
        low = chosen(in_upper | is_low, found, low)
        high = chosen(in_lower | is_high, found, high)
        differ = low.value * high.value <= 0
        secant = (low.fraction * high.value - high.fraction * low.value) / (high.value - low.value)
        secant = jnp.where(jnp.isfinite(secant), secant, 0.5 * (low.fraction + high.fraction))
        next_fraction = jnp.where(is_low, 1.0, secant)
        settled = inner & ((jnp.abs(next_fraction - fraction) < _CLOSE) | (found.value == 0))
        next_fraction = jnp.where(settled, fraction, next_fraction)
        guess = jnp.where(is_low, self.there, _cubic(low, high, next_fraction))
        return Bracket(
            trials=state.trials + 1,
            low=low,
            high=high,
            side=jnp.where(in_upper, 1, jnp.where(in_lower, -1, 0)),
            fraction=next_fraction,
            last=found,
            converged=trial.converged,
            doubtful=state.doubtful | (~inner & ~trial.converged) | (is_high & differ),
            ended=settled | (state.trials + 1 >= _TRIALS),
            trial=self._trial(next_fraction, guess),
        )


class _Known(NamedTuple):
    """What a trial between two neighbours found."""

    fraction: Array  # of the way
    value: Array  # of the test function, less where the other end keeps moving
    point: Array
    tangent: Array  # of unit length
    slope: Array  # dpoint/dshare


class Bracket(NamedTuple):
    """The state of the search for a sign change."""

    trials: Array
    low: _Known
    high: _Known
    side: Array  # which end moved last
    fraction: Array  # of the way, for the next trial
    last: _Known
    converged: Array  # the last trial
    doubtful: Array  # an end is not known, or the sign differs at the ends
    ended: Array
    trial: Trial  # under way

    @property
    def resolved(self) -> Bool[Array, ""]:
        """Whether the event is at the last point, once the search has ended."""
        inside = abs(self.fraction - 0.5) < 0.51
        return self.converged & inside & (self.low.value * self.high.value <= 0)

    @property
    def missed(self) -> Bool[Array, ""]:
        """Whether the sign does change, but the point was not found."""
        # Tangents along a curve are a little late: a sign may seem to change where it does not.
        return self.doubtful & ~self.resolved


def _cubic(low: _Known, high: _Known, fraction: Array) -> Point:
    """Where the cubic through two trials and their tangents is."""
    width = high.fraction - low.fraction
    s = (fraction - low.fraction) / width
    chord = high.point - low.point
    bend_low, bend_high = low.slope * width - chord, high.slope * width - chord
    return low.point + s * chord + s * (1 - s) * ((1 - s) * bend_low - s * bend_high)
