"""Expected gains of starts, single and in pairs, against least squares by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
from truths.made_up_misfits import noise_of

from snrmjax.diagnose.misfit.candidates import EffectCandidate
from snrmjax.diagnose.search.model_search import screened_pairs

N = 60


def made_up(columns, base):
    """Evidence in which a candidate's starts change all rows by given columns."""
    return SimpleNamespace(
        noise=noise_of(np.ones((N, 1, 1))),
        base=base,
        n_rows=N,
        start_changes=lambda c: np.stack(columns[c.kind])[:, :, None],
    )


def candidate(kind, starts=((2.0,),), lower=-np.inf):
    return EffectCandidate(kind, starts, (1.0,), (lower,), (np.inf,))


def test_the_two_that_explain_the_misfit_come_first_scaled_as_they_fit():
    rng = np.random.default_rng(0)
    one, two, other = rng.normal(size=(3, N))
    # What mixes both explains more by itself than either.
    columns = {"one": [one], "two": [other, two], "mixed": [one + two + 0.3 * other]}
    misfit = made_up(columns, -(3.0 * one - 0.5 * two))
    kinds = [candidate("mixed"), candidate("one"), candidate("two", ((1.0, 7.0), (4.0, 8.0)))]
    gain, first, second = screened_pairs(misfit, kinds)[0]
    assert (first.kind, second.kind) == ("one", "two")
    assert first.starts == (pytest.approx((6.0,), rel=1e-9),)
    assert second.starts == (pytest.approx((-2.0, 8.0), rel=1e-9),)
    assert gain == pytest.approx(np.sum(misfit.base**2) - 2 * np.log(N), rel=1e-9)


def test_what_cannot_be_negative_is_not_expected_so():
    one, two = np.random.default_rng(1).normal(size=(2, N))
    misfit = made_up({"one": [one], "two": [two]}, -(one - two))
    assert screened_pairs(misfit, [candidate("one"), candidate("two")])
    assert not screened_pairs(misfit, [candidate("one"), candidate("two", lower=0.0)])


def test_no_kind_fills_all_pairs_and_what_is_nearly_alike_is_expected_to_gain_little():
    changes = np.random.default_rng(2).normal(size=(6, N))
    columns = {f"kind {k}": [change] for k, change in enumerate(changes)}
    # Their difference, a hundred times enlarged, would explain more than anything else.
    hidden = np.random.default_rng(3).normal(size=N)
    columns["twin"] = [changes[0] + 0.01 * hidden]
    misfit = made_up(columns, -100 * changes[0] - changes[1] + 1.5 * hidden)
    pairs = screened_pairs(misfit, [candidate(kind) for kind in columns])
    kinds = [{one.kind, two.kind} for _, one, two in pairs]
    assert kinds[0] == {"kind 0", "kind 1"}
    assert max(sum(name in pair for pair in kinds) for name in columns) == 3
