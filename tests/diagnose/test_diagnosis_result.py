"""Output of a diagnosis: one screen of text, a labelled data set, a figure."""

import dataclasses

import numpy as np
import pytest
from matplotlib.figure import Figure
from truths.balanced_sets import balanced, linear_model, quadratic

import snrmjax as sj
from snrmjax.diagnose.diagnosis_result import unit_of
from snrmjax.diagnose.verdict import Verdict
from snrmjax.numerics.levenberg_marquardt import MinimisationStatus


@pytest.fixture(scope="module")
def found():
    return sj.diagnose_model(linear_model(), balanced(quadratic))


def test_a_diagnosis_prints_on_one_screen(found):
    first, *lines = repr(dataclasses.replace(found, notes=("a note.",))).splitlines()
    assert first == f"Diagnosis: {found.verdict_sentence}"
    value, std = found.parameters["quadratic_damping.coefficient"]
    (line,) = (one for one in lines if "coefficient" in one)
    assert f"{value:.4g} ± {std:.2g}" in line
    assert line.endswith("1/(√kg m)")
    assert sum("left out" in one for one in lines) == 2
    assert [one.strip() for one in lines[-2:]] == ["status: fit converged", "note: a note."]
    assert len(lines) < 12


def test_a_model_that_stays_as_it_is_ends_so(found):
    nothing = found.answer._replace(status=MinimisationStatus.NOT_FITTED, extended=False)
    texts = repr(dataclasses.replace(found, answer=nothing, notes=()))
    assert texts.splitlines()[-1].strip() == "status: nothing was added to the model"


def test_a_diagnosis_is_a_labelled_data_set(found):
    data = found.to_xarray()
    assert data.sizes["candidate"] == len(found.table)
    assert list(data["part"].values) == ["damping"]
    assert data["velocity_low_m_s"].attrs["units"] == "m/s"
    assert float(data["velocity_low_m_s"][0]) < float(data["velocity_high_m_s"][0])
    (value,) = data["value"].values
    assert value == found.parameters["quadratic_damping.coefficient"].value
    assert str(data["unit"].values[0]) == unit_of("quadratic_damping.coefficient") != ""
    best = str(data["candidate"][int(np.argmax(data["gain"].values))].values)
    assert best in found.candidates[0]
    assert data.attrs["verdict"] == found.verdict == "named"
    assert set(data["fit_status"].values) <= {"converged", "stalled", "step_limit", "not_finite"}


def test_a_diagnosis_is_drawn(found):
    figure = found.plot()
    assert isinstance(figure, Figure)
    assert len(figure.axes[0].collections[0].get_offsets()) == len(found.force_misfit.rows)


def test_every_verdict_has_a_sentence_of_its_own(found):
    whole = dataclasses.replace(found, parts=())  # as where phases are unknown
    texts = {dataclasses.replace(whole, verdict=one).verdict_sentence for one in Verdict}
    assert len(texts) == len(Verdict) == 6
