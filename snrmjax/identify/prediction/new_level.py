"""Errors of a level that was not measured: as levels differ, with their trend, on another day."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.pointwise.snrm import participation_of
from snrmjax.identify.test_model.states import LEVEL_ERRORS
from snrmjax.model.modes import LinearModes
from snrmjax.numerics.compiled import on_numbers

_FEWEST = 3  # levels, of which a straight line leaves something
_CHANCE = 0.05  # of a trend where levels differ at random


class DayToDay(NamedTuple):
    """By how much another day's test of the same structure differs, relative, 1σ."""

    frequency: float = 0.0
    damping: float = 0.0
    gain: float = 0.0  # of velocities over forces


class LevelTrend(NamedTuple):
    """One kind of levels' errors that changes steadily with their force: a law, not chance."""

    kind: str  # of `LEVEL_ERRORS`
    first: float  # the straight line at the smallest force; relative, or rad
    last: float  # at the largest
    there: float  # at the force of the prediction
    p_value: float


class NewLevel(NamedTuple):
    """What a level may err in beside the fitted curves, 1σ each, and how its force is known."""

    std: Float[np.ndarray, " error"]  # of `LEVEL_ERRORS`
    drive: float | None = None  # the record (N or V) of the force; None: the force itself is given
    trends: tuple[LevelTrend, ...] = ()
    another_day: bool = False  # whether `std` holds another day's errors too
    forced: LinearModes | None = None  # the modes as the force moves them; None: as in the test

    def modes(self, fit: JointFit) -> LinearModes:
        """The linear modes, moved as the predicted force does."""
        return fit.modes if self.forced is None else self.forced

    def over_test(self, fit: JointFit) -> float:
        """How many times as much a newton moves the mode of interest as it did in the test."""
        if self.forced is None:
            return 1.0
        return float(participation_of(self.forced) / participation_of(fit.modes))


ON_THE_CURVES = NewLevel(np.zeros(len(LEVEL_ERRORS)))
"""No level at all: the force in newtons moves the fitted mode itself."""


@on_numbers("Differentiate `sj.identify.refit`.")
def new_level(
    fit: JointFit,
    force: float,
    *,
    as_recorded: bool = False,
    day: DayToDay | None = None,
    at: str | None = None,
) -> NewLevel:
    """The errors of one further level under a force, as large as the fit's levels have them.

    An error that changes steadily with the levels' force counts as large as its straight line has
    it there.

    Arguments: `force` in N; `as_recorded` where not the force is given but what the test records of
    it, whose gain then errs too; `day` what another day's test differs by; `at` the sensor or point
    where the force acts, if not where it did in the test.
    Raises what `LinearModes.forced_at` raises.
    Not differentiable: differentiate `snrmjax.identify.refit`.
    """
    std = np.array(fit.prior.new_level, dtype=float)
    forced = None if at is None else fit.modes.forced_at(at)
    new = NewLevel(std, another_day=day is not None, forced=forced)
    as_in_test = force * abs(new.over_test(fit))
    trends = _trends(fit, as_in_test) if fit.data.n_levels >= _FEWEST else ()
    for trend in trends:
        place = LEVEL_ERRORS.index(trend.kind)
        std[place] = np.hypot(std[place], trend.there)
    if day is not None:
        std = np.hypot(std, [day.gain, 0.0, 2 * day.frequency, day.damping])
    record = float(fit.recorded_force(np.array(force))) if as_recorded else None
    return new._replace(std=std, drive=record, trends=trends)


def _trends(fit: JointFit, force: float) -> tuple[LevelTrend, ...]:
    trends, level = [], np.asarray(fit.data.level)
    known = fit.force_of_drive(np.asarray(fit.data.force))
    size = np.array([np.median(known[level == k]) for k in range(fit.data.n_levels)])
    if not np.ptp(size) > 0:
        return ()
    from scipy.stats import linregress  # slow to import, and rarely needed

    deviation = np.asarray(fit.unknowns.level * fit.prior.level)
    for kind, errors in zip(LEVEL_ERRORS, deviation.T, strict=True):
        line = linregress(size, errors) if np.any(errors != 0) else None
        if line is not None and line.pvalue < _CHANCE:
            places = (size.min(), size.max(), force)
            first, last, there = (float(line.intercept + line.slope * at) for at in places)
            trends.append(LevelTrend(kind, first, last, there, float(line.pvalue)))
    return tuple(trends)
