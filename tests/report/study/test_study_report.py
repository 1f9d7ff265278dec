"""The report of a study, from a data set whose distribution, effects and failures are known."""

import json
import re

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from typer.testing import CliRunner

from snrmjax.cli import app
from snrmjax.numerics.facts import Fact
from snrmjax.report.study.study_figures import display_on_axis, main_effects_figure
from snrmjax.report.study.study_report import (
    study_sentence,
    summary_table,
    write_study_report,
)
from snrmjax.study.analysis.digest import digest, failure_fraction, failures_of, ranked_by_failure
from snrmjax.study.analysis.outputs import Scalar, scalars, summarized

NASTY = "<script>alert(1)</script>$x^2$"
FORCES = (0.001, 0.002)
N = 400


def data_set(n=N, **attributes):
    """Peaks 0.1·F·(1 + 4 a) and failures where b > 0.8, b being of no other effect."""
    unit = np.random.default_rng(0).random((2, n))
    a, b = unit
    peak = 0.1 * np.array(FORCES) * (1 + 4 * a[:, None])
    failed = b > 0.8
    peak[failed] = np.nan
    status = np.where(failed, "step_too_small", "upper_end")
    at = ("member", "force_n")
    return xr.Dataset(
        {
            "status": (at, np.stack([np.full(n, "upper_end"), status], axis=1)),
            "n_folds": (at, np.stack([np.zeros(n, int), np.full(n, 2)], axis=1)),
            "first_fold": (at, np.stack([2 * np.arange(n), 2 * np.arange(n)], axis=1)),
            "fold_frequency_hz": (("fold",), np.tile([52.0, 50.0], n) + np.repeat(a, 2)),
            "fold_velocity_m_s": (("fold",), np.ones(2 * n)),
            "n_points": (at, np.full((n, 2), 100)),
            "peak_velocity_m_s": (at, peak, {"units": "m/s", "long_name": "highest"}),
        },
        {
            "force_n": ("force_n", list(FORCES)),
            "a.b": (("member",), a, {"units": "Hz"}),
            NASTY: (("member",), b),
            "constant": (("member",), np.ones(n)),
        },
        {"title": f"study {NASTY}", "study": json.dumps({}), **attributes},
    )


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    return folder, write_study_report(folder, data_set())


def test_summary_of_known_numbers():
    values = np.append(np.arange(1001.0), np.nan)
    found = summarized(Scalar("peak_velocity_m_s", "m/s", "", values))
    assert (found.members, found.missing, found.least, found.most) == (1002, 1, 0.0, 1000.0)
    assert (found.mean, found.varies) == (500.0, True)
    assert found.std == pytest.approx(np.sqrt(1001 * 1002 / 12), rel=1e-12)  # of 0..n-1, ddof 1
    np.testing.assert_allclose(found.quantiles, [25.0, 250.0, 500.0, 750.0, 975.0])


def test_summary_without_any_value():
    found = summarized(Scalar("peak_velocity_m_s", "m/s", "", np.full(3, np.nan)))
    assert found.missing == 3
    assert np.isnan([found.mean, found.std, found.least, *found.quantiles]).all()
    assert not found.varies


def test_members_beyond_the_range_count_on_their_side():
    """Of 0…99 all above 39 are known to lie beyond 39: the quantiles are those of all hundred."""
    values = np.where(np.arange(100.0) > 39, np.inf, np.arange(100.0))
    found = summarized(Scalar("peak_frequency_hz", "Hz", "", values, ends=(0.0, 39.0)))
    assert (found.described, found.above, found.below, found.missing) == (100, 60, 0, 0)
    np.testing.assert_allclose(found.quantiles, [2.475, 24.75, np.inf, np.inf, np.inf])
    assert np.isnan([found.mean, found.std]).all()
    cells = summary_table([found], "").rows[0]
    assert cells[2:] == ("100, 60 above 39", "", "above 39", "2.475 to above 39", "0 to above 39")
    part = summarized(Scalar("peak_frequency_hz", "Hz", "", np.where(values > 39, np.nan, values)))
    assert summary_table([part], "").rows[0][2] == "40 of 100"


def test_summary_csv_has_every_output_and_force(written):
    folder, _ = written
    table = pd.read_csv(folder / "summary.csv")
    peaks = table[table.variable == "peak_velocity_m_s"]
    assert peaks.force_n.tolist() == list(FORCES)
    assert set(peaks.unit) == {"m/s"}
    whole = data_set().peak_velocity_m_s
    np.testing.assert_allclose(peaks["97.5%"], np.nanquantile(whole, 0.975, axis=0), rtol=1e-12)
    np.testing.assert_allclose(
        peaks["50%"] / peaks.force_n, 0.3, rtol=0.1
    )  # of 0.1 (1 + 4 U(0, 1))
    assert (peaks.without_value == int(np.isnan(whole[:, 0]).sum())).all()


def test_folds_are_the_lowest_and_the_highest_of_each_member():
    data = data_set()
    found = {(one.name, one.force): one.values for one in scalars(data)}
    assert np.isnan(found["lowest_fold_frequency_hz", FORCES[0]]).all()
    a = data["a.b"].values
    np.testing.assert_allclose(found["lowest_fold_frequency_hz", FORCES[1]], 50.0 + a)
    np.testing.assert_allclose(found["highest_fold_frequency_hz", FORCES[1]], 52.0 + a)


def test_the_effect_is_that_of_the_only_quantity_that_acts(written):
    folder, _ = written
    table = pd.read_csv(folder / "main_effects.csv")
    peaks = table[table.variable == "peak_velocity_m_s"]
    assert peaks.groupby("force_n").varied.first().tolist() == ["a.b", "a.b"]
    own = peaks[peaks.varied == "a.b"].first_order_fraction
    np.testing.assert_allclose(own, 1.0, atol=1e-9)  # linear: the curve is exact
    assert (peaks[peaks.varied == NASTY].first_order_fraction.abs() < 0.1).all()
    assert set(table.varied) == {"a.b", NASTY}


def test_failures_are_placed(written):
    _, found = written
    b = data_set()[NASTY].values
    n_failed = int(np.sum(b > 0.8))
    assert found.failures.n_failed == n_failed
    assert found.failures.counts == {"upper_end": 2 * N - n_failed, "step_too_small": n_failed}
    assert found.failures.failed_counts == {"step_too_small": n_failed}
    both = {"a": data_set()["a.b"].values, "b": b}
    assert ranked_by_failure(both, found.failures.failed) == ["b", "a"]
    fraction = failure_fraction(b, found.failures.failed)
    assert fraction.edges[8] == pytest.approx(0.8, abs=0.05)
    np.testing.assert_array_equal(fraction.fraction[[0, 3, 6, 9]], [0.0, 0.0, 0.0, 1.0])
    assert np.all((fraction.low <= fraction.fraction) & (fraction.fraction <= fraction.high))
    # Wilson's interval of 0 of 40: 1 - 1/(1 + z²/n) = 0.088.
    assert fraction.high[0] == pytest.approx(1.96**2 / (40 + 1.96**2), abs=1e-4)


def test_a_status_of_success_is_no_failure():
    ends = ["upper_end", "lower_end", "closed", "largest_velocity", "solved", "answered"]
    data = xr.Dataset({"status": (("member",), [*ends, "point_limit", "refused: no"])})
    assert failures_of(data).failed.tolist() == [False] * 6 + [True] * 2


def test_the_page_is_whole_and_escaped(written):
    folder, found = written
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "<script" not in page
    assert "&lt;script&gt;" in page
    figures = {path.name for path in folder.glob("*.png")}
    assert figures == {"distributions.png", "main_effects.png", "failures.png"}
    assert page.count("data:image/png;base64,") == len(figures)
    sentence = study_sentence(found)
    n_failed = found.failures.n_failed
    ended = f"{N} members, of which {n_failed} have no complete result: {n_failed} step_too_small."
    assert sentence.startswith(ended)
    part = f"Peak velocity at 0.002 N of {N - n_failed} of {N} members: median 0.6"
    assert part in sentence
    assert "95 % of these " in sentence
    assert f"100 % of its variance over the {N - n_failed} members with a value" in sentence
    assert sentence.replace("<", "&lt;") in page


def test_notes_tell_what_the_numbers_are_not():
    grid = {"study": json.dumps({"study": {"sampling": {"method": "grid"}}})}
    few, together = data_set(40, **grid), data_set()
    together["also"] = ("member",), together["a.b"].values + 0.1 * together[NASTY].values
    together = together.set_coords("also")
    first, second, *_ = digest(few).facts
    assert first == Fact("members_chosen", method="grid")
    assert (second.kind, second["fewest"]) == ("too_few_for_fractions", 50)
    facts = {fact.kind: fact for fact in digest(together).facts}
    assert facts["varied_together"]["pairs"] == (("a.b", "also"),)
    assert "members_chosen" not in facts
    n_failed = int(np.sum(data_set()[NASTY] > 0.8))
    missing = ("peak_velocity_m_s", FORCES[0], n_failed, N)
    assert missing in facts["values_missing"]["outputs"]


def test_dots_of_few_members_are_seen_and_named_by_their_force():
    found = digest(data_set(3))
    figure = main_effects_figure(found.effects, {"a.b": found.quantities["a.b"]}, found.units)
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names[:2] == ["0.001 N", "0.002 N"]
    dots = figure.axes[0].get_lines()[0]
    # A dot is drawn at half of its marker's size, in points: two at least to be seen on a page.
    assert dots.get_markersize() / 2 > 2
    assert dots.get_alpha() > 0.5


def test_answers_of_diagnoses_are_counted(tmp_path):
    data = xr.Dataset(
        {
            "status": (("member",), ["answered"] * 4),
            "verdict": (("member",), ["named", "named", "none", "named"]),
            "effects": (("member",), ["cubic", "cubic", "", "gap"]),
            "gap_before": (("member",), [5.0, 6.0, 1.0, 4.0]),
        },
        {"x": (("member",), [1.0, 2.0, 3.0, 4.0])},
    )
    write_study_report(tmp_path, data)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    cells = re.findall(r"<td[^>]*><span>(.*?)</span></td>", page)
    at = cells.index("named")
    assert cells[at : at + 3] == ["named", "3", "75 %"]
    assert (tmp_path / "answers.png").exists()
    assert not (tmp_path / "main_effects.csv").exists()


def test_the_command_writes_the_report(tmp_path):
    data_set(40).to_zarr(tmp_path / "s.zarr", zarr_format=2, consolidated=True)
    out = tmp_path / "report"
    done = CliRunner().invoke(app, ["study", "report", str(tmp_path / "s.zarr"), "--out", str(out)])
    assert done.exit_code == 0, done.output
    assert "Peak velocity at 0.002 N" in done.output
    assert "Number of points" not in done.output
    assert {path.name for path in out.iterdir()} >= {"summary.csv", "report.html"}


def test_the_command_without_a_study(tmp_path):
    arguments = ["study", "report", str(tmp_path / "none.zarr"), "--out", str(tmp_path / "r")]
    done = CliRunner().invoke(app, arguments)
    assert isinstance(done.exception, ValueError)
    assert "does not exist" in str(done.exception)
    assert not (tmp_path / "r").exists()


def test_units_of_axes():
    assert display_on_axis(np.array([-1.2e9, np.nan]), "").labelled("k") == "k (10⁹)"
    assert display_on_axis(np.array([0.02, 0.03]), "m/s").labelled("v") == "v (mm/s)"
    assert display_on_axis(np.array([40.0, 90.0]), "Hz").labelled("f") == "f (Hz)"
