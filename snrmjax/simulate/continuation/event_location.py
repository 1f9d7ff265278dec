"""Location of the zero of a test function between two neighbouring points of a curve."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from snrmjax.numerics.newton import Linearised, Point, Trial, chosen
from snrmjax.simulate.continuation.continuation import StepControl

_TRIALS = 40  # most trials of the secant method
_CLOSE = 1e-10  # change of the position between the neighbours at which the search ends


class EventSearch(eqx.Module):
    """Search between two neighbours of a curve for the sign change of `test(point, tangent)`.

    Anderson and Björck's variant of the secant method in the arclength, each trial corrected
    across the tangent at the first neighbour, `here`. The event is resolved when the sign change
    lies between the neighbours, or outside by less than the lag of the curve's tangents; there is
    none where the corrected neighbours have the same sign.
    Reference: Anderson & Björck, BIT 13 (1973) 253, doi:10.1007/BF01951936.
    """

    linearised: Linearised
    test: Callable[[Point, Point], Float[Array, ""]]
    here: Point
    tangent: Point
    there: Point
    control: StepControl

    def initial(self) -> "Bracket":
        """The state before the first trial, at `here`."""
        zero, no = jnp.array(0.0), jnp.array(False)
        nothing = _TrialPoint(zero, zero, self.here, self.tangent, self.tangent)
        return Bracket(
            trials=jnp.array(0),
            low=nothing,
            high=nothing,
            side=jnp.array(0),
            fraction=zero,
            last=nothing,
            converged=~no,
            uncertain=no,
            ended=no,
            trial=self._trial(zero, self.here),
        )

    def advanced(self, state: "Bracket") -> "Bracket":
        """The state after one Newton step."""
        trial = state.trial.stepped(self.linearised, 1e-3 * self.control.tolerance)
        state = state._replace(trial=trial)
        going = trial.goes_on(2 * self.control.iterations)
        return chosen(going, state, self._assessed(state))

    def ended(self, wanted: Bool[Array, ""] | bool = True) -> "Bracket":
        """The final state of the search; it does not run if it is not `wanted`."""
        return jax.lax.while_loop(
            lambda state: ~state.ended,
            lambda state: self.advanced(state),
            self.initial()._replace(ended=~jnp.asarray(wanted)),
        )

    def _length(self) -> Float[Array, ""]:
        return self.tangent @ (self.there - self.here)

    def _trial(self, fraction: Array, guess: Point) -> Trial:
        """The correction at a fraction of the interval, from a guess projected onto its plane."""
        shift = fraction * self._length() - self.tangent @ (guess - self.here)
        return Trial.at(guess + shift * self.tangent, self.tangent)

    def _assessed(self, state: "Bracket") -> "Bracket":
        """The state after a finished correction, with the next one started."""
        low, high, side, fraction, trial = (
            state.low,
            state.high,
            state.side,
            state.fraction,
            state.trial,
        )
        # With slopes by the fraction of the interval the curve between two trials is a cubic.
        slope = trial.tangent * (self._length() / (self.tangent @ trial.tangent))
        value = self.test(trial.point, trial.tangent)
        latest = _TrialPoint(fraction, value, trial.point, trial.tangent, slope)
        is_low, is_high = state.trials == 0, state.trials == 1
        inner = ~is_low & ~is_high
        in_upper = inner & (jnp.sign(latest.value) == jnp.sign(low.value))
        in_lower = inner & ~in_upper
        # The value of an end that stays is reduced in proportion to the decrease of the other one.
        lost = [1 - value / end.value for end in (low, high)]
        less = [jnp.where(part > 0, part, 0.5) for part in lost]
        by_low = jnp.where(in_lower & (side == -1), less[1], 1.0)
        by_high = jnp.where(in_upper & (side == 1), less[0], 1.0)
        low, high = (e._replace(value=e.value * by) for e, by in ((low, by_low), (high, by_high)))
        low = chosen(in_upper | is_low, latest, low)
        high = chosen(in_lower | is_high, latest, high)
        differ = low.value * high.value <= 0
        secant = (low.fraction * high.value - high.fraction * low.value) / (high.value - low.value)
        secant = jnp.where(jnp.isfinite(secant), secant, 0.5 * (low.fraction + high.fraction))
        next_fraction = jnp.where(is_low, 1.0, secant)
        settled = inner & ((jnp.abs(next_fraction - fraction) < _CLOSE) | (latest.value == 0))
        next_fraction = jnp.where(settled, fraction, next_fraction)
        guess = jnp.where(is_low, self.there, _cubic(low, high, next_fraction))
        return Bracket(
            trials=state.trials + 1,
            low=low,
            high=high,
            side=jnp.where(in_upper, 1, jnp.where(in_lower, -1, 0)),
            fraction=next_fraction,
            last=latest,
            converged=trial.converged,
            uncertain=state.uncertain | (~inner & ~trial.converged) | (is_high & differ),
            ended=settled | (state.trials + 1 >= _TRIALS),
            trial=self._trial(next_fraction, guess),
        )


class _TrialPoint(NamedTuple):
    """Result of a trial between two neighbours."""

    fraction: Array  # of the interval
    value: Array  # of the test function, reduced while the other end keeps moving
    point: Array
    tangent: Array  # of unit length
    slope: Array  # dpoint/dfraction


class Bracket(NamedTuple):
    """The state of the search for a sign change."""

    trials: Array
    low: _TrialPoint
    high: _TrialPoint
    side: Array  # which end moved last
    fraction: Array  # of the interval, for the next trial
    last: _TrialPoint
    converged: Array  # of the last trial
    uncertain: Array  # an end did not converge, or the sign differs at the ends
    ended: Array
    trial: Trial  # current

    @property
    def resolved(self) -> Bool[Array, ""]:
        """Whether the event is at the last point, once the search has ended."""
        inside = abs(self.fraction - 0.5) < 0.51
        return self.converged & inside & (self.low.value * self.high.value <= 0)

    @property
    def missed(self) -> Bool[Array, ""]:
        """Whether the sign changes but the event was not located."""
        # Tangents lag by one Newton step: a sign may appear to change where it does not.
        return self.uncertain & ~self.resolved


def _cubic(low: _TrialPoint, high: _TrialPoint, fraction: Array) -> Point:
    """Point of the cubic through two trials and their tangents."""
    width = high.fraction - low.fraction
    s = (fraction - low.fraction) / width
    chord = high.point - low.point
    excess_low, excess_high = low.slope * width - chord, high.slope * width - chord
    return low.point + s * chord + s * (1 - s) * ((1 - s) * excess_low - s * excess_high)
