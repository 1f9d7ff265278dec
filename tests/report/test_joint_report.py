"""Reports and figures of joint fits: the numbers of the fit, and bars of the whole variance."""

import dataclasses
import re

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from truths.exact_states import damping, modes, noisy, squared
from truths.joint_fits import exact_fit, noisy_fit
from truths.printed_page import unreadable

import snrmjax as sj
from snrmjax.identify.inference.contributions import Contribution, contributions
from snrmjax.identify.inference.fitted_response import fitted_response
from snrmjax.identify.inference.identification import identification_of_fit
from snrmjax.io.joint_results import read_joint_fit, write_joint_fit
from snrmjax.numerics.units import DEGREE, HERTZ
from snrmjax.pipelines.identify import FitDetails
from snrmjax.report import sampling as plot_data
from snrmjax.report.figures import joint_fit as joint_plot
from snrmjax.report.html import Report, report_html
from snrmjax.report.pages import joint_fit as joint_report
from snrmjax.report.pages.identification import identification_report, identification_summary

TRUE = {"backbone": "polynomial:1@displacement", "damping": "viscous_quadratic@velocity"}


@pytest.fixture(scope="module")
def fit():
    """A fit of noisy states, level gains included."""
    return noisy_fit()


@pytest.fixture(scope="module")
def details(fit):
    advice = sj.next_measurements(fit, 3)
    forces = sorted({one.force for one in advice})
    responses = tuple(fitted_response(fit, force)[0] for force in forces)
    return FitDetails(fit, tuple(contributions(fit)), advice, responses)


@pytest.fixture(scope="module")
def figures(details):
    points = sj.identify.identify_points(noisy(1, gain=0.01), modes())
    return joint_report.joint_figures(details, points)


def test_the_report_passes_the_amplitude_on(details):
    points = sj.identify.identify_points(noisy(1, gain=0.01), modes())
    shown = plot_data.SHOWN_AMPLITUDES["displacement"]
    figures = joint_report.joint_figures(details, points, shown)
    for name in ("joint_fit", "residuals"):
        assert figures[name].axes[0].get_xlabel().startswith("Displacement amplitude (")


@pytest.fixture(scope="module")
def sections(details, figures):
    return joint_report.joint_sections(details, figures)


def close_to(text, value, rel=0.0):
    """Whether a printed number is a value, rounded to the digits that are printed."""
    text = text.replace("−", "-")
    last = 10.0 ** -len(text.partition(".")[2])
    assert float(text) == pytest.approx(value, abs=0.501 * last, rel=rel)


def test_the_table_of_parameters_has_the_numbers_of_the_file(fit, sections, tmp_path):
    write_joint_fit(tmp_path / "fit.json", fit)
    again = read_joint_fit(tmp_path / "fit.json")
    values, std = np.asarray(again.vector()[0]), np.sqrt(np.diag(again.covariance))
    rows = sections[0].tables[0].rows
    assert [row[0] for row in rows] == list(again.names())[: len(rows)]
    assert len(rows) == 4
    for row, value, spread in zip(rows, values, std, strict=False):
        printed = row[1].split(" ± ")
        close_to(printed[0], value)
        close_to(printed[1], spread)
    # ω at rest is 500 rad/s; its square's 1σ is 2ω times that of ω.
    hertz = re.fullmatch(r"(\S+) ± (\S+) Hz", rows[0][3]).groups()
    close_to(hertz[0], np.sqrt(values[0]) / HERTZ)
    close_to(hertz[1], std[0] / (2 * np.sqrt(values[0])) / HERTZ)
    assert abs(float(hertz[0]) - 500 / HERTZ) < 4 * float(hertz[1])
    html = report_html(Report("Fit", sections=sections))
    assert all(row[1] in html for row in rows)


def test_a_gain_is_a_number_with_a_unit_and_per_cent():
    one = {"value": float(np.log(0.079)), "std": 0.058, "unit": "log"}
    (row,) = joint_report.parameter_table({"parameters": {"force_gain": one}}, "N/V").rows
    assert row == ("force_gain", "0.079 ± 5.8 %", "N/V", "")


@pytest.mark.parametrize("free", [(), ("force_gain",)])
def test_a_report_of_a_joint_fit_tells_the_joint_fit(fit, free):
    found = identification_of_fit(noisy(1, gain=0.01), fit)
    found = dataclasses.replace(found, fit=dataclasses.replace(fit, free=free))
    rows = dict(identification_summary(found, modes()))
    # The exact states' level gain is 1 %, stated; the damping of the truth is the velocity's.
    assert rows["scatter from level to level"] == "1 % in gain (1σ)"
    argument = "natural frequency: displacement amplitude; damping: velocity amplitude"
    assert rows["argument of the curves"] == argument
    assert rows["noise"].startswith("stated; states scatter about the curves by")
    report = identification_report(found, modes(), {"backbone": Figure()}, title="")
    text = report.sections[0].figures[0].caption + " ".join(report.sections[-1].text)
    assert "joint fit to all steady states" in text
    assert ("is not in them" in text) == (not free)
    assert ("error of the fitted force gain" in text) == bool(free)


def test_errors_found_are_those_of_the_fit(fit, sections):
    rows = dict(sections[0].tables[1].rows)
    scale = rows["random noise, from the residuals"]
    assert scale.endswith("× the stated one")
    close_to(scale.split(" ± ")[0], fit.noise.scale)
    assert rows["gain of a level"] == "1 %"
    assert rows["natural frequency, from state to state"] == "0 %"


def test_bars_of_one_colour_are_the_whole_variance(details, figures):
    (axes,) = figures["contributions"].axes
    bars = {b.get_label(): [patch.get_width() for patch in b] for b in axes.containers}
    assert sum(bars["natural frequency"]) == pytest.approx(100, abs=1e-6)
    assert sum(bars["damping"]) == pytest.approx(100, abs=1e-6)
    names = [text.get_text() for text in axes.get_yticklabels()]
    # Five levels' gains are one bar.
    gains = sum(
        s.damping_fraction for s in details.fractions if s.source.startswith("gain of level")
    )
    assert bars["damping"][names.index("gain of levels")] == pytest.approx(100 * gains)
    assert axes.yaxis_inverted()


def test_small_contributions_share_a_bar():
    rows = [Contribution(n, *s, n) for n, s in {"a": (0.995, 0.998), "b": (0.003, 0.001)}.items()]
    rows.append(Contribution("c", 0.002, 0.001, "c"))
    (axes,) = joint_plot.contributions_figure(rows).axes
    names = [text.get_text() for text in axes.get_yticklabels()]
    assert names == ["a", "2 smaller ones together"]
    widths = [[patch.get_width() for patch in bars] for bars in axes.containers]
    np.testing.assert_allclose(widths, [[99.5, 0.5], [99.8, 0.2]], rtol=1e-12)


def test_the_table_of_contributions_sums_to_one_hundred(details, sections):
    rows = sections[1].tables[0].rows
    for column in (1, 2):
        # Each row is rounded to 0.05.
        assert sum(float(row[column]) for row in rows) == pytest.approx(100, abs=0.05 * len(rows))
    many = [Contribution(f"s{k}", 0.05, 0.05, "s") for k in range(20)]
    last = joint_report.contribution_table(many).rows[-1]
    assert last == ("8 further ones together", "40.0", "40.0")


def test_lines_are_the_known_curves():
    exact = exact_fit()
    figure = joint_plot.fitted_curves_figure([joint_plot.FitSeries("fit", exact)])
    natural, ratio = figure.axes
    (line,), (ratios,) = natural.lines, ratio.lines
    velocity, omega = line.get_xdata(), HERTZ * line.get_ydata()
    # The states are exact; what is left is the end of the solver.
    np.testing.assert_allclose(omega**2, squared(velocity / omega), rtol=1e-7)
    np.testing.assert_allclose(
        ratios.get_ydata(), 100 * damping(velocity) / (2 * omega), rtol=1e-7, atol=0
    )
    assert natural.get_ylabel() == "Natural frequency (Hz)"
    assert natural.get_xlabel() == ratio.get_xlabel() == "Velocity amplitude (m/s)"


def test_a_legend_shows_a_name_in_all_its_colours():
    # Drawn without bands of its own the second would have that of the first in the legend.
    pair = [joint_plot.FitSeries(name, exact_fit()) for name in ("one", "two")]
    figure = joint_plot.fitted_curves_figure(pair)
    (box,) = figure.legends
    areas = box.findobj(Rectangle)
    drawn = [area.get_facecolor()[0][:3] for area in figure.axes[0].collections]
    assert [area.get_facecolor()[:3] for area in areas] == [tuple(colour) for colour in drawn]
    assert len({tuple(colour) for colour in drawn}) == 2
    assert [text.get_text() for text in box.get_texts()].count("95 % band") == 1


def test_curves_and_residuals_are_drawn_over_the_amplitude_that_is_asked_for():
    exact, shown = exact_fit(), plot_data.SHOWN_AMPLITUDES["displacement"]
    figure = joint_plot.fitted_curves_figure([joint_plot.FitSeries("fit", exact)], shown=shown)
    left = joint_plot.residuals_figure(exact, shown)
    level = figure.axes[0].get_xlabel()
    size = {"m": 1.0, "mm": 1e-3, "µm": 1e-6}[level.removeprefix("Displacement amplitude (")[:-1]]
    assert figure.axes[1].get_xlabel() == left.axes[0].get_xlabel() == level
    (line,) = figure.axes[0].lines
    # The truth's backbone is a function of the displacement, v/ω of every state.
    omega = HERTZ * line.get_ydata()
    np.testing.assert_allclose(omega**2, squared(size * line.get_xdata()), rtol=1e-7)
    states = np.abs(np.asarray(exact.motion().velocity)) / np.asarray(exact.data.frequency)
    np.testing.assert_allclose(left.axes[0].lines[0].get_xdata(), states / size, rtol=1e-12)


def test_bands_are_ninety_five_per_cent(fit, figures):
    natural, ratio = figures["joint_fit"].axes
    values = sj.identify.fitted_values(fit, np.array([0.0, fit.largest[1]]))
    for axes, value, std, unit in (
        (natural, values.natural_frequency, values.natural_frequency_std, 1 / HERTZ),
        (ratio, values.damping_ratio, values.damping_ratio_std, 100.0),
    ):
        band = axes.collections[-1]  # the paler one of a further level is below it
        corners = band.get_paths()[0].vertices
        for k, x in ((0, 0.0), (1, fit.largest[1])):
            y = corners[np.isclose(corners[:, 0], x), 1]
            expected = unit * (float(value[k]) + 1.96 * float(std[k]) * np.array([-1, 1]))
            np.testing.assert_allclose([y.min(), y.max()], expected, rtol=1e-9)


def test_residuals_are_drawn_and_counted(fit, figures):
    speeds, phases, spread = figures["residuals"].axes
    drawn = [line for line in speeds.lines if line.get_marker() == "o"]
    np.testing.assert_array_equal(np.array([d.get_ydata() for d in drawn]).T, fit.residuals)
    # The states lie within 60° of resonance, noise of 0.7° aside.
    angles = np.concatenate([one.get_xdata() for one in phases.lines if one.get_marker() == "o"])
    assert 55 < np.abs(angles).max() < 64
    outside = 100 * np.mean(np.abs(fit.residuals) > 1.96)
    assert f"{outside:.1f} % outside ±1.96 σ" in spread.get_title(loc="left")
    assert f"rms {np.sqrt(np.mean(fit.residuals**2)):.2f}" in spread.get_title(loc="left")
    assert plot_data.fit_residuals(fit).level.min() == 1


def test_advised_states_are_marked_and_listed(details, figures, sections):
    speeds, phases = figures["next"].axes
    marks = [line for line in speeds.lines if line.get_marker() == "o"]
    assert len(marks) == len(details.advice) == 3
    for mark, one in zip(marks, details.advice, strict=True):
        assert mark.get_xdata() == pytest.approx(one.frequency / HERTZ)
    labels = ", ".join(text.get_text() for text in speeds.texts)
    assert sorted(labels.split(", ")) == ["1", "2", "3"]
    turned = [line.get_ydata() for line in phases.lines if line.get_marker() == "o"]
    np.testing.assert_allclose(np.ravel(turned), [a.phase / DEGREE for a in details.advice])
    rows = sections[2].tables[0].rows
    assert [row[-1] for row in rows] == [str(one.reason) for one in details.advice]
    close_to(rows[0][2], details.advice[0].frequency / HERTZ)


def test_states_that_lie_together_share_a_label(details):
    first = details.advice[0]
    advice = [first, first._replace(rank=2, frequency=1.001 * first.frequency)]
    figure = joint_plot.next_measurements_figure(details.responses, advice, sensor="tip")
    assert [text.get_text() for text in figure.axes[0].texts] == ["1, 2"]


def test_nothing_to_show_is_an_error():
    for draw, named in (
        (joint_plot.contributions_figure, "nothing to show"),
        (joint_plot.fitted_curves_figure, "no fit"),
        (lambda rows: joint_plot.next_measurements_figure(rows, [], sensor="tip"), "no response"),
    ):
        with pytest.raises(ValueError, match=named):
            draw([])


def test_figures_of_a_fit_can_be_read_on_a_printed_page(figures):
    for name, figure in figures.items():
        assert unreadable(figure) == [], name
