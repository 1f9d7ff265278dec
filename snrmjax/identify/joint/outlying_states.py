"""States that no noise explains: not settled, beside a jump, or wrongly recorded."""

import numpy as np

from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.units import HERTZ

_ONE_TEST_IN = 100  # has a state by chance that is called so
_BESIDE = 2  # states on each side, in the order of frequency within a level
_MEDIAN_OF_FOUR = 1.2  # variance of that median, times that of the mean


def outlying_states(fit: JointFit) -> np.ndarray:
    """Numbers of the states that lie farther from the curves than noise puts any of a test's.

    The two residuals of n states are those of a normal distribution: the largest of all is beyond
    √(−2 ln(p/n)) in the share p of tests, here one in a hundred (Bonferroni). So must be what a
    state differs by from its neighbours' median: curves that miss a stretch of states alike miss
    no single one.
    """
    residuals = np.nan_to_num(np.asarray(fit.residuals)[:, :2])
    level, frequency = np.asarray(fit.data.level), np.asarray(fit.data.frequency)
    beyond = np.sqrt(2 * np.log(_ONE_TEST_IN * max(1, len(residuals))))
    alone = np.zeros_like(residuals)
    for number in np.unique(level):
        rows = np.flatnonzero(level == number)
        rows = rows[np.argsort(frequency[rows], kind="stable")]
        for k, row in enumerate(rows):
            near = np.r_[rows[max(0, k - _BESIDE) : k], rows[k + 1 : k + 1 + _BESIDE]]
            if near.size > 1:
                spread = np.sqrt(1 + _MEDIAN_OF_FOUR / near.size)
                alone[row] = (residuals[row] - np.median(residuals[near], axis=0)) / spread
    far = (np.hypot(*residuals.T) > beyond) & (np.hypot(*alone.T) > beyond)
    return np.flatnonzero(far)


def note_on_outlying(fit: JointFit, *, robust: bool) -> tuple[Fact, ...]:
    """A note that names these states, the farthest first."""
    rows = outlying_states(fit)
    if not rows.size:
        return ()
    size = np.hypot(*np.asarray(fit.residuals)[rows, :2].T)
    rows = rows[np.argsort(-size)]
    data = fit.data
    states = tuple(
        (fit.level_numbers[int(data.level[k])], float(data.frequency[k]) / HERTZ)
        for k in rows.tolist()
    )
    return (Fact("states_outlying", states=states, farthest=float(size.max()), robust=robust),)
