"""Outlying states are reported, and get little weight in a robust fit."""

import numpy as np
from truths.one_mode import OMEGA, model, noisy, states, table

from snrmjax.pipelines import identify_test


def outlier_notes(found):
    return [note for note in found.notes if getattr(note, "kind", "") == "states_outlying"]


def test_unsettled_states_are_reported():
    level, w, force, exact = states()
    clean = noisy(exact)
    good = identify_test(table(level, w, force, clean), model(), fit="auto")
    assert outlier_notes(good) == []
    moved = clean.copy()
    moved[[20, 33]] *= [np.exp(0.2j), np.exp(-0.3j)]
    data = table(level, w, force, moved, velocity_std=None, phase_std=None)
    plain = identify_test(data, model(), fit="auto")
    (note,) = outlier_notes(plain)
    named = {(2, round(w[20] / OMEGA, 9)), (3, round(w[33] / OMEGA, 9))}
    found = {(one, round(hertz * 2 * np.pi / OMEGA, 9)) for one, hertz in note["states"]}
    assert named <= found
    assert "--robust" in str(note)
    robust = identify_test(data, model(), fit="auto", robust=True)
    assert "little weight here" in str(outlier_notes(robust)[0])

    def off(result):
        curve = result.values
        return float(np.max(np.abs(np.asarray(curve.damping_ratio) - good_ratio(curve))))

    def good_ratio(curve):
        return np.asarray(good.values.damping_ratio)

    assert off(robust) < 0.5 * off(plain)
