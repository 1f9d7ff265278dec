"""Outlying states are reported, and get little weight in a robust fit."""

import numpy as np
from truths.one_mode import OMEGA, model, noisy, states, table

from snrmjax.identify.inference.fitted_curves import fitted_values
from snrmjax.identify.joint.joint_fit import fit_jointly
from snrmjax.identify.joint.notes import note_on_outlying
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
    found = identify_test(data, model(), fit="auto")
    (note,) = outlier_notes(found)
    named = {(2, round(w[20] / OMEGA, 9)), (3, round(w[33] / OMEGA, 9))}
    states_named = {(one, round(hertz * 2 * np.pi / OMEGA, 9)) for one, hertz in note["states"]}
    assert named <= states_named
    assert "little weight here" in str(note)
    plain = fit_jointly(data, model(), robust=False)
    assert "--robust" in str(note_on_outlying(plain)[0])

    def off(values):
        return float(np.max(np.abs(np.asarray(values.damping_ratio) - good_ratio)))

    at = np.asarray(good.values.velocity)
    good_ratio = np.asarray(good.values.damping_ratio)
    without, with_all = (fitted_values(fit, velocity=at) for fit in (found.joint.fit, plain))
    assert off(without) < 0.5 * off(with_all)
