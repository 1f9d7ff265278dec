"""Joint fits that many tests ask, each made once in a session."""

import functools

from truths.exact_states import TRUE, modes, noisy

import snrmjax as sj


@functools.cache
def noisy_fit():
    """A fit of noisy states whose levels' gains differ by 1 %, with the families of the truth."""
    return sj.fit_jointly(noisy(1, gain=0.01), modes(), level_gain_std=0.01, **TRUE)


@functools.cache
def exact_fit():
    """The same of states without noise: its curves are the known ones."""
    return sj.fit_jointly(noisy(), modes(), **TRUE)
