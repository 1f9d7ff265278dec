"""Completed models, and answers with unphysical parameters."""

import json

import numpy as np
import pytest
from truths.balanced_sets import OMEGA, ZETA, balanced, linear_model

import snrmjax as sj
from snrmjax.diagnose.diagnosis_result import completed_model
from snrmjax.io.models import read_model
from snrmjax.pipelines.diagnose import diagnose_test
from snrmjax.report.pages.diagnosis import write


def fed(velocity):
    """A negative linear damping, −0.2 of the model's, and a larger quadratic damping."""
    return -1.2 * 2 * ZETA * OMEGA + 120.0 * velocity


def test_a_negative_damping_ratio_is_no_reason_to_lose_the_answer(tmp_path):
    """The model is uncertain of its damping ratio; the data put it below zero."""
    model, data = linear_model(damping_std=3.0), balanced(fed)
    test = diagnose_test(data, model)
    write(tmp_path, test)
    found = test.diagnosis
    assert "quadratic_damping" in found.effects
    assert found.completed is None
    assert not found.answer.extended
    (note,) = (note for note in found.notes if note.kind == "not_physical")
    assert "damping_ratio" in note["reason"]
    ratio = float(note["reason"].split("but is ")[1].rstrip("."))
    assert ratio == pytest.approx(-0.2 * ZETA, rel=0.1)
    written = json.loads((tmp_path / "diagnosis.json").read_text())
    assert written["effects"] == list(found.effects)
    assert written["gap"]["after"] < 1.2
    assert (tmp_path / "report.html").exists()
    assert (tmp_path / "residuals.png").exists()
    assert not (tmp_path / "model.toml").exists()


def test_a_negative_frequency_is_refused_with_a_reason():
    """A relative shift of −1.4 leaves a natural frequency below zero, which no structure has."""
    kinds, values = ("linear_frequency_shift",), {"linear_frequency_shift.relative_shift": -1.4}
    refused = completed_model(linear_model(), {}, kinds, values)
    assert refused.model is None
    assert "relative_shift" in refused.reason
    own = {"mode_1.natural_frequency": -3.0}
    below = completed_model(linear_model(), own, kinds, dict.fromkeys(values, 0.1))
    assert below.model is None
    assert "natural_frequency" in below.reason


def test_a_model_that_lacks_nothing_stays_as_it_is():
    model = linear_model()
    found = completed_model(model, {"mode_1.damping_ratio": 0.02}, (), {})
    assert found.model is model
    assert not found.extended


def test_a_completed_model_has_the_identified_effects(tmp_path):
    found = completed_model(
        linear_model(),
        {"mode_1.damping_ratio": 0.02},
        ("cubic_stiffness",),
        {"cubic_stiffness.coefficient": 7.0},
    )
    assert found.extended
    sj.io.write_model(tmp_path / "model.toml", found.model)
    again = read_model(tmp_path / "model.toml")
    assert float(again.modes.damping_ratio[0]) == pytest.approx(0.02)
    assert float(again.effects[0].coefficient) == 7.0
    assert np.isfinite(float(again.modes.natural_frequency[0]))
