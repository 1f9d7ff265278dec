"""Tests that are not diagnosed, as page and messages report."""

import numpy as np
import pytest
from truths.one_mode import OMEGA, SHAPE, ZETA, model, noisy, states, table
from typer.testing import CliRunner

import snrmjax as sj
from snrmjax.cli import app
from snrmjax.pipelines.whole_test import not_diagnosed


def measured(change=lambda w, v: v):
    level, w, f, v = states()
    return table(level, w, f, change(w, noisy(v)))


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda w, v: v / 9.80665, "the response in g"),
        (lambda w, v: 1j * w * v, "acceleration"),
        (lambda w, v: v.conj(), "conjugated"),
    ],
)
def test_columns_that_mean_something_else_are_not_diagnosed(change, why):
    (fact,) = not_diagnosed(measured(change), model())
    assert fact.kind == "diagnosis_left_out"
    assert why in fact["why"]


def test_a_mode_far_from_the_linear_one_is_diagnosed():
    """Effects may be why its lowest level is 15 % off."""
    modes = sj.model.linear_modes([1.15 * OMEGA], [ZETA], [[SHAPE]], [SHAPE], sensors=("tip",))
    assert not_diagnosed(measured(), sj.model.structure(modes)) == ()
    assert not_diagnosed(measured(), model()) == ()


@pytest.mark.long
def test_going_on_in_spite_of_a_wrong_unit_ends_without_a_diagnosis(tmp_path):
    folder, out = tmp_path / "raw", tmp_path / "out"
    folder.mkdir()
    sj.io.write_model(folder / "model.toml", model())
    sj.io.write_steady_states(folder / "states.csv", measured(lambda w, v: 1e3 * v))
    done = CliRunner().invoke(app, ["test", str(folder), "--out", str(out), "--go-on"])
    assert done.exit_code == 0, done.exception
    page = (out / "report.html").read_text()
    for text in (" ".join(done.output.split()), page):
        assert "The diagnosis was skipped, as it would attribute an error" in text
    assert "The diagnosis was skipped: the first note gives the reason." in page
    assert not (out / "diagnose").exists()
    assert np.isfinite(
        np.loadtxt(out / "identify" / "backbone.csv", delimiter=",", skiprows=1)
    ).any()
