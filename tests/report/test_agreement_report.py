"""A joint fit that contradicts the curve through the points: figure, table, note and summary."""

import json

import numpy as np
import pytest
from truths.exact_states import OMEGA, PARTICIPATION, SHAPE, noisy

import snrmjax as sj
from snrmjax.report import workflow
from snrmjax.report.joint_report import agreement_section, joint_figures

FAMILIES = "polynomial:1@displacement,viscous_quadratic@velocity"


def findings(wrong):
    modes = sj.model.linear_modes([OMEGA], [0.012], [[SHAPE]], [PARTICIPATION / wrong])
    settings = workflow.JointFitSettings(FAMILIES)
    model = sj.model.structure(modes)
    return workflow.identify_jointly(noisy(3), model, settings, workflow.Loads())


@pytest.fixture(scope="module")
def apart():
    return findings(1.06)


def labels(found):
    figure = joint_figures(found.fitted, found.identification.points)["joint_fit"]
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_both_are_shown_and_a_note_says_why(apart):
    (note,) = (note for note in apart.notes if "curve through the points" in note)
    assert "modal mass" in note
    assert "curve through the points" in labels(apart)
    section = agreement_section(apart.fitted.agreement)
    assert list(section.text) == [note]
    (table,) = section.tables
    velocity, points, joint, difference = (float(table.rows[5][k]) for k in (0, 4, 5, 6))
    assert 0.05 < velocity < 1.2
    # Relative to a modal mass 6 % too large damping is 6 % too small.
    assert joint / points == pytest.approx(1.06, abs=0.03)
    assert difference > 3


def test_they_are_in_the_summary(apart, tmp_path):
    workflow.write_findings(tmp_path, apart, "beam", {"data": "a.csv", "model": "b.toml"})
    told = json.loads((tmp_path / "summary.json").read_text())["agreement"]
    assert told["agree"] is False
    largest = max(abs(row["damping_difference_in_std"]) for row in told["table"])
    assert told["largest_difference_in_std"] == pytest.approx(largest, rel=1e-12)
    assert "and joint fit</h2>" in (tmp_path / "report.html").read_text()


def test_agreement_takes_a_sentence_and_no_curve():
    found = findings(1.0)
    assert not any("curve through the points" in note for note in found.notes)
    assert "curve through the points" not in labels(found)
    section = agreement_section(found.fitted.agreement)
    assert not section.tables
    assert "agree" in section.text[0]
    assert np.isfinite(found.fitted.agreement.largest)
