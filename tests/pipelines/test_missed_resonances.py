"""A completed model with a wrong resonance: the note states the levels."""

import dataclasses

import numpy as np
import pytest
from truths.balanced_sets import (
    OMEGA,
    PARTICIPATION,
    SHAPE,
    ZETA,
    balanced,
    linear_model,
    quadratic,
)

import snrmjax as sj
from snrmjax.diagnose.response_prediction import LevelResponse, PhaseResonance
from snrmjax.pipelines import diagnose


@pytest.fixture(scope="module")
def found():
    return sj.diagnose_model(linear_model(), balanced(quadratic))


def diagnosed(found, monkeypatch, completed):
    """The test's diagnosis with another completed model: its notes by their kinds."""
    other = dataclasses.replace(found, answer=found.answer._replace(completed=completed))
    monkeypatch.setattr(diagnose, "diagnose_model", lambda *_, **__: other)
    test = diagnose.diagnose_test(found.data, linear_model())
    return {note.kind: note for note in test.diagnosis.notes if not isinstance(note, str)}


def test_a_completed_model_that_has_the_resonances_takes_no_word(found, monkeypatch):
    assert "resonances_missed" not in diagnosed(found, monkeypatch, found.completed)


def test_levels_that_a_completed_model_misses_are_named(found, monkeypatch):
    """Without the damping that is missing: a linear mode has F·A/(2ζω₀) at resonance."""
    data, far = found.data, []
    level, speed = np.asarray(data.level), np.abs(np.asarray(data.velocity)[:, 0])
    for number in sorted(set(level.tolist())):
        at = np.flatnonzero(level == number)
        at = at[np.argmax(speed[at])]
        linear = float(data.force[at]) * SHAPE * PARTICIPATION / (2 * ZETA * OMEGA)
        if abs(np.log(linear / speed[at])) > 0.2:
            far.append(number)
    assert 0 < len(far) < 5
    hardly = sj.model.make_effect("quadratic_damping", {"coefficient": 1e-9})
    completed = dataclasses.replace(found.completed, effects=(hardly,))
    note = diagnosed(found, monkeypatch, completed)["resonances_missed"]
    assert list(note["levels"]) == far
    assert str(note).endswith(".")


def test_a_completed_model_without_a_resonance_misses_them(found):
    there = PhaseResonance(50.0, 1.0)
    nowhere = PhaseResonance(np.nan, np.nan)
    level = LevelResponse(1, 1.0, there, there, there, False, True, there)
    assert not diagnose._is_missed(level)
    assert diagnose._is_missed(level._replace(completed=nowhere))
    # A jump past the resonance was measured, or the response was not followed to its end.
    assert not diagnose._is_missed(level._replace(measured=nowhere))
    assert not diagnose._is_missed(level._replace(completed=nowhere, complete=False))
