"""States that no noise explains: not settled, beside a jump, or wrongly recorded."""

import numpy as np

from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.units import HERTZ

_ONE_TEST_IN = 100  # has a state by chance that is called so


def outlying_states(fit: JointFit) -> np.ndarray:
    """Numbers of the states that lie farther from the curves than noise puts any of a test's.

    The two residuals of n states are those of a normal distribution: the largest of all is beyond
    √(−2 ln(p/n)) in the share p of tests, here one in a hundred (Bonferroni).
    """
    size = np.hypot(*np.nan_to_num(np.asarray(fit.residuals)[:, :2]).T)
    return np.flatnonzero(size > np.sqrt(2 * np.log(_ONE_TEST_IN * max(1, len(size)))))


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
