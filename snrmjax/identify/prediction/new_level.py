"""Errors of a level that was not measured: scatter and trend of levels, day-to-day variation."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.pointwise.snrm import participation_of
from snrmjax.identify.test_model.states import LEVEL_ERRORS
from snrmjax.model.modes import LinearModes
from snrmjax.numerics.compiled import on_numbers

_FEWEST = 3  # levels for a linear regression
_CHANCE = 0.05  # p-value below which a trend is significant


class DayToDay(NamedTuple):
    """Relative 1σ of day-to-day variation between tests of the same structure."""

    frequency: float = 0.0
    damping: float = 0.0
    gain: float = 0.0  # of velocities over forces


class LevelTrend(NamedTuple):
    """A significant linear trend of one kind of level errors with force."""

    kind: str  # of `LEVEL_ERRORS`
    first: float  # regression line at the smallest force; relative, or rad
    last: float  # at the largest
    there: float  # at the force of the prediction
    p_value: float


class NewLevel(NamedTuple):
    """1σ of a new level's errors about the fitted curves, and how its force is given."""

    std: Float[np.ndarray, " error"]  # of `LEVEL_ERRORS`
    drive: float | None = None  # recorded force (N or V); None: the true force is given
    trends: tuple[LevelTrend, ...] = ()
    another_day: bool = False  # whether `std` includes day-to-day variation
    forced: LinearModes | None = None  # modes under the new force location; None: as in the test

    def modes(self, fit: JointFit) -> LinearModes:
        """The linear modes with the participation of the predicted force."""
        return fit.modes if self.forced is None else self.forced

    def over_test(self, fit: JointFit) -> float:
        """Participation of the mode of interest over that in the test."""
        if self.forced is None:
            return 1.0
        return float(participation_of(self.forced) / participation_of(fit.modes))


WITHOUT_LEVEL_ERRORS = NewLevel(np.zeros(len(LEVEL_ERRORS)))
"""The fitted curves themselves, without level errors, under a force in newtons."""


@on_numbers("Differentiate `sj.identify.refit`.")
def new_level(
    fit: JointFit,
    force: float,
    *,
    as_recorded: bool = False,
    day: DayToDay | None = None,
    at: str | None = None,
) -> NewLevel:
    """Level errors of a new level under a force, with the fit's level-to-level 1σ.

    Where a level error has a significant trend with force, its regression value at this force is
    added (in quadrature).

    Arguments: `force` in N; with `as_recorded` the level is set by the recorded force, which then
    has a gain error too; `day` the day-to-day variation; `at` the sensor or point where the force
    acts, if not as in the test.
    Raises what `LinearModes.forced_at` raises.
    Not differentiable: differentiate `snrmjax.identify.refit`.
    """
    std = np.array(fit.prior.new_level, dtype=float)
    forced = None if at is None else fit.modes.forced_at(at)
    new = NewLevel(std, another_day=day is not None, forced=forced)
    as_in_test = force * abs(new.over_test(fit))
    trends = _trends(fit, as_in_test) if fit.data.n_levels >= _FEWEST else ()
    for trend in trends:
        kind = LEVEL_ERRORS.index(trend.kind)
        std[kind] = np.hypot(std[kind], trend.there)
    if day is not None:
        std = np.hypot(std, [day.gain, 0.0, 2 * day.frequency, day.damping])
    record = float(fit.recorded_force(np.array(force))) if as_recorded else None
    return new._replace(std=std, drive=record, trends=trends)


def _trends(fit: JointFit, force: float) -> tuple[LevelTrend, ...]:
    trends, level = [], np.asarray(fit.data.level)
    known = fit.force_of_drive(np.asarray(fit.data.force))
    level_force = np.array([np.median(known[level == k]) for k in range(fit.data.n_levels)])
    if not np.ptp(level_force) > 0:
        return ()
    from scipy.stats import linregress  # slow to import, and rarely needed

    deviation = np.asarray(fit.unknowns.level * fit.prior.level)
    for kind, errors in zip(LEVEL_ERRORS, deviation.T, strict=True):
        line = linregress(level_force, errors) if np.any(errors != 0) else None
        if line is not None and line.pvalue < _CHANCE:
            forces = (level_force.min(), level_force.max(), force)
            first, last, there = (float(line.intercept + line.slope * at) for at in forces)
            trends.append(LevelTrend(kind, first, last, there, float(line.pvalue)))
    return tuple(trends)
