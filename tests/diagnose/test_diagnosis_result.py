"""What a diagnosis shows of itself: one screen of text, a labelled data set, a figure."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure
from truths.balanced_sets import balanced, linear_model, quadratic

import snrmjax as sj
from snrmjax.diagnose.decide import Verdict, verdict_sentence
from snrmjax.diagnose.diagnosis import _notes_on_fits
from snrmjax.diagnose.diagnosis_result import CompletedStatus, unit_of
from snrmjax.diagnose.search.model_search import TriedEffect
from snrmjax.numerics.levenberg_marquardt import MinimisationStatus


@pytest.fixture(scope="module")
def found():
    return sj.diagnose_model(linear_model(), balanced(quadratic))


def test_a_diagnosis_says_itself_on_one_screen(found):
    text, _, _ = repr(found).partition("\n  notes:\n")
    first, *lines = text.splitlines()
    assert first.startswith("Diagnosis: The model")
    assert "quadratic_damping" in first
    assert len(lines) < 20
    value, std = found.parameters["quadratic_damping.coefficient"]
    (line,) = (one for one in lines if "coefficient" in one)
    assert f"{value:.4g} ± {std:.2g}" in line
    assert line.endswith(unit_of("quadratic_damping.coefficient"))
    assert any("left out" in one for one in lines)
    assert lines[-1].strip().startswith("status: fit converged")
    assert "_" not in lines[-1]


def test_a_diagnosis_prints_its_notes_in_lines_of_a_hundred_columns(found):
    note = "a note of many words, " * 20 + "which ends here."
    noted = dataclasses.replace(found, notes=("the first note.", note))
    _, _, printed = repr(noted).partition("\n  notes:\n")
    lines = printed.splitlines()
    assert lines[0] == "  - the first note."
    assert " ".join(line.strip() for line in lines[1:]) == f"- {note}"
    assert max(map(len, lines)) <= 100
    assert "notes:" not in repr(dataclasses.replace(found, notes=()))


def test_the_last_line_says_how_the_fits_ended(found):
    nothing = found.answer._replace(
        status=MinimisationStatus.NOT_FITTED, completed_status=CompletedStatus.NOTHING_ADDED
    )
    for answer, line in (
        (nothing, "status: nothing was added to the model"),
        (found.answer, "status: fit converged"),
    ):
        one = dataclasses.replace(found, answer=answer, notes=())
        assert repr(one).splitlines()[-1].strip() == line


def test_a_diagnosis_is_a_labelled_data_set(found):
    data = found.to_xarray()
    assert data.sizes["candidate"] == sum(len(step) for step in found.table)
    assert list(data["part"].values) == ["damping"]
    assert data["velocity_low_m_s"].attrs["units"] == "m/s"
    assert float(data["velocity_low_m_s"][0]) < float(data["velocity_high_m_s"][0])
    (value,) = data["value"].values
    assert value == found.parameters["quadratic_damping.coefficient"].value
    assert str(data["unit"].values[0]) == unit_of("quadratic_damping.coefficient") != ""
    best = str(data["candidate"][int(np.argmax(data["gain"].values))].values)
    assert best in found.candidates[0]
    assert data.attrs["verdict"] == found.verdict == "ambiguous"
    assert set(data["fit_status"].values) <= {"converged", "stalled", "step_limit", "not_finite"}


def test_a_diagnosis_is_drawn(found):
    figure = found.plot()
    assert isinstance(figure, Figure)
    assert len(figure.axes[0].collections[0].get_offsets()) == len(found.force_misfit.rows)


def test_effects_that_could_not_be_fitted_are_named():
    def tried(kind, gain, status):
        return TriedEffect(kind, gain, -gain, {}, status)

    step = (
        tried("cubic_damping", 50.0, MinimisationStatus.CONVERGED),
        tried("quadratic_damping", 47.0, MinimisationStatus.STEP_LIMIT),
        tried("jenkins_slider", 3.0, MinimisationStatus.STEP_LIMIT),
        tried("one_sided_stop", -np.inf, MinimisationStatus.NOT_FINITE),
    )
    found = SimpleNamespace(table=(step,))
    (lost,) = _notes_on_fits(found)
    assert lost.startswith("one_sided_stop could not be fitted")


def test_every_verdict_has_a_sentence_of_its_own():
    classes = (("cubic_damping", "quadratic_damping"),)
    sentences = [verdict_sentence(one, classes, 4.0, 1.0) for one in Verdict]
    assert len(set(sentences)) == len(Verdict) == 6
    assert all(one[0].isupper() and one.endswith(".") for one in sentences)
    told = verdict_sentence(Verdict.AMBIGUOUS, classes, 4.0, 1.0)
    assert "cubic_damping or quadratic_damping" in told
    three = verdict_sentence(Verdict.UNKNOWN, (("a",), ("b",), ("c",)), 4.0, 1.0)
    assert "the best attempt is a, b and c:" in three
    assert "4.0 to 1.0" in told
    alone = verdict_sentence(Verdict.AMBIGUOUS, (("cubic_damping",),), 4.0, 1.0)
    assert "probably" in alone
