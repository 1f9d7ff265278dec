"""Reports: escaped, complete in one file, and right in their numbers."""

import base64
import dataclasses
import io
import re
from html.parser import HTMLParser

import equinox as eqx
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.interpolate import CubicSpline

import snrmjax as sj
from snrmjax.identify.pointwise.prediction import Resonance
from snrmjax.numerics.units import HERTZ
from snrmjax.report import html as reports
from snrmjax.report.figures.identification import backbone_figure, response_figure
from snrmjax.report.html import Report, ReportFigure, ReportTable, Section, write_report
from snrmjax.report.pages.identification import (
    ComparedResponses,
    identification_report,
    identification_sentence,
    identification_summary,
    resonance_table,
)

NASTY = "<script>alert(1)</script>"
LINEAR_HZ, DAMPING = 80.0, 0.02
LINEAR_DAMPING = 2 * DAMPING * LINEAR_HZ * HERTZ  # 1/s


@pytest.mark.parametrize(
    ("note", "shown"),
    [
        ("run1.mat: 44 settled steps", "run1.mat: 44 settled steps."),
        ("second run.h5: three steps.", "second run.h5: three steps."),
        ("a_states.csv has no phases", "a_states.csv has no phases."),
        ("run1.mat, run2.mat are alike", "run1.mat, run2.mat are alike."),
        ("the file run1.mat names no sensor", "The file run1.mat names no sensor."),
        ("0.3 % is left", "0.3 % is left."),
        ("two levels", "Two levels."),
    ],
)
def test_a_note_begins_with_a_capital_but_for_a_files_name(tmp_path, note, shown):
    write_report(tmp_path / "report.html", Report("t", notes=[note]))
    assert f"<li>{shown}</li>" in (tmp_path / "report.html").read_text()


@pytest.fixture(scope="module")
def modes():
    return sj.model.linear_modes(
        [LINEAR_HZ * HERTZ], [DAMPING], [[2.0]], [3.0], sensors=(f"tip {NASTY}",)
    )


@pytest.fixture(scope="module")
def data(modes):
    """Exact states of a mode that stiffens with its displacement, at constant damping."""
    displacement = np.repeat(np.linspace(1e-4, 1e-3, 8), 4)
    phase = np.tile(np.radians([-40.0, -20.0, 20.0, 40.0]), 8)
    natural = frequency_at(displacement)
    # tan φ = (ω̃² − Ω²)/(2ζ̃ω̃Ω), solved for Ω.
    slope = 0.5 * LINEAR_DAMPING * np.tan(phase)
    omega = np.hypot(slope, natural) - slope
    force = displacement * np.hypot(natural**2 - omega**2, LINEAR_DAMPING * omega) / 6.0
    level = np.repeat(np.arange(1, 9), 4)
    velocity = displacement * omega * np.exp(1j * phase)
    return sj.measure.steady_states(
        level,
        omega,
        force,
        velocity,
        sensors=modes.sensors,
        velocity_std=0.01 * np.abs(velocity)[:, None],
    )


def frequency_at(displacement):
    """ω̃ in rad/s at a displacement in m: 80 Hz, and 4 Hz more at one millimetre."""
    return HERTZ * np.hypot(LINEAR_HZ, np.sqrt(84.0**2 - 80.0**2) * displacement / 1e-3)


@pytest.fixture(scope="module")
def identification(data, modes):
    return sj.identify_backbone(data, modes, n_knots=4)


def resonance(force, velocity, frequency_hz, *, continued=False):
    return Resonance(force, 1e-3, frequency_hz * HERTZ, 0.019, velocity, continued)


def simulated(force, velocities, frequencies_hz, events):
    """A response by harmonic balance of which only these points matter."""
    n = len(velocities)
    velocity = np.zeros((n, 2, 1), dtype=complex)
    velocity[:, 1, 0] = velocities
    return sj.simulate.ResponseCurve(
        force=force,
        frequency=HERTZ * np.asarray(frequencies_hz),
        coefficients=np.zeros((n, 3, 1)),
        velocity=velocity,
        multipliers=np.full((n, 2), 0.5 + 0j),
        event=tuple(events),
        status=sj.simulate.CurveStatus.UPPER_END,
        sensors=(f"tip {NASTY}",),
    )


@pytest.fixture(scope="module")
def report(identification, modes):
    curves = [simulated(0.05, [0.05, 0.11, 0.05], [79, 80, 81], ["", "phase_resonance", ""])]
    figures = {
        "backbone": backbone_figure(identification.points, identification.backbone),
        "prediction": response_figure(identification.backbone, [], simulated=curves),
    }
    return identification_report(
        identification,
        modes,
        figures,
        title=f"Beam {NASTY}",
        done={"data": f"{NASTY}.csv"},
        notes=[f"the column {NASTY} was not used", "all is well", "all is well"],
        responses=ComparedResponses([], [resonance(0.05, 0.1, 80.2)], curves),
        further=[Section(f"More {NASTY}", [NASTY], (), [ReportTable([NASTY], [[NASTY]], NASTY)])],
    )


@pytest.fixture(scope="module")
def html(report):
    return reports.report_html(report)


class Balance(HTMLParser):
    """Collects tags and fails when they do not match."""

    def __init__(self):
        super().__init__()
        self.open, self.seen = [], []

    def handle_starttag(self, tag, attrs):
        self.seen.append((tag, dict(attrs)))
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def parsed(html):
    parser = Balance()
    parser.feed(html)
    parser.close()
    assert parser.open == []
    return parser.seen


def test_everything_said_is_escaped(html):
    tags = parsed(html)
    assert "<script" not in html.lower()
    assert "script" not in {tag for tag, _ in tags}
    # Title twice, data file, sensor, note, heading, paragraph, table header, cell and caption.
    assert html.count("&lt;script&gt;alert(1)&lt;/script&gt;") >= 10
    assert f"<h1>Beam {NASTY}</h1>".replace(NASTY, "&lt;script&gt;alert(1)&lt;/script&gt;") in html


def test_nothing_is_loaded_from_elsewhere(html):
    assert "http://" not in html
    assert "https://" not in html
    assert "url(" not in html
    assert "@import" not in html
    tags = parsed(html)
    assert not {"link", "iframe", "object", "video", "a", "base"} & {tag for tag, _ in tags}
    for _, attributes in tags:
        assert not {"href", "srcset", "onload", "onerror"} & set(attributes)
        assert attributes.get("src", "data:").startswith("data:image/png;base64,") or (
            "src" not in attributes
        )


def test_figures_are_inside_and_described(html, report):
    images = [attributes for tag, attributes in parsed(html) if tag == "img"]
    assert len(images) == sum(len(section.figures) for section in report.sections) == 2
    for image in images:
        content = base64.b64decode(image["src"].split(",", 1)[1], validate=True)
        pixels = mpl.image.imread(io.BytesIO(content), format="png")
        assert pixels.shape[1] > 1000
        assert np.ptp(pixels[..., :3]) == 1.0
        assert image["alt"]
    assert html.count("<figcaption>") == 2
    assert "0° is the phase resonance" in html


def test_notes_are_sentences_and_said_once(html):
    assert html.count("<li>All is well.</li>") == html.count("ll is well") == 1
    assert "<li>The column &lt;script&gt;" in html
    assert "was not used.</li>" in html


def test_sections_come_in_order(html):
    headings = re.findall(r"<h2>(.*?)</h2>", html)
    assert headings[:3] == [
        "Notes",
        "Backbone and damping",
        "Predicted responses",
    ]
    assert headings[3].startswith("More")
    assert headings[4:] == ["How to read this, and when to trust it"]


def test_inputs_and_result_come_before_the_notes():
    html = reports.report_html(
        Report("T", [("data", "a.csv"), ("model", "m")], [("x", "1 Hz")], result=f"So {NASTY}.")
    )
    body = html[html.index("<h1>") :]
    places = [body.index(text) for text in ("data: a.csv · model: m", "So &lt;", "1 Hz", "Notes")]
    assert places == sorted(places)
    parsed(html)


def test_folded_tables_show_one_line_until_they_are_opened():
    table = ReportTable(("size", "unit"), [("1", "N"), ("2", "")], folded="Two sizes")
    html = reports.report_html(Report("T", sections=[Section("S", tables=[table])]))
    inside = html[html.index("<details>") : html.index("</details>")]
    assert "<summary>Two sizes</summary>" in inside
    # Narrow screens name each cell and leave out empty ones.
    assert '<td data-name="size"><span>2</span></td><td class="empty" data-name="unit">' in inside
    parsed(html)


def test_report_without_anything_to_remark(tmp_path):
    html = reports.report_html(Report("Empty"))
    assert "No remarks." in html
    assert re.findall(r"<h2>(.*?)</h2>", html) == ["Notes"]
    parsed(html)


def test_headline_numbers_are_those_of_the_curves(identification, modes, data):
    rows = dict(identification_summary(identification, modes))
    # The backbone is exact to 0.05 %; the smallest amplitude is 0.1 mm, the largest 1 mm.
    first, last = rows["natural frequency (± 95 %)"].split(", ")
    expected = frequency_at(np.array([1e-4, 1e-3])) / HERTZ
    for text, hertz, displacement in zip((first, last), expected, (1e-4, 1e-3), strict=True):
        value, spread, velocity = re.fullmatch(r"(\S+) ± (\S+) Hz at (\S+) m/s", text).groups()
        assert float(value) == pytest.approx(hertz, rel=5e-4)
        assert 0 < float(spread) < 1
        assert float(velocity) == pytest.approx(displacement * hertz * HERTZ, rel=5e-3)
    assert rows["linear mode"] == "80 Hz, 2 % damping"
    change = float(rows["change over the range"].split(" Hz")[0])
    assert change == pytest.approx(expected[1] - expected[0], abs=0.05)
    damping = float(rows["damping ratio (± 95 %)"].split(" ±")[0])
    assert damping == pytest.approx(2.0, rel=5e-3)
    # Curves without a turn have nothing lower or higher than their ends, and nothing is left out.
    assert not {"lowest to highest frequency", "lowest to highest damping", "left out"} & set(rows)
    assert rows["steady states used"] == f"32 of 32 at sensor tip {NASTY}"
    assert rows["phases measured"] == "−40° to 40°, 0° is resonance"
    assert rows["noise"].startswith("stated; states scatter about the curves by")
    assert rows["argument of the curves"] == "displacement amplitude"


def test_the_result_is_one_sentence(identification, modes):
    sentence = identification_sentence(identification, modes)
    hertz, displacement = frequency_at(np.array([1e-4, 1e-3])) / HERTZ, np.array([1e-4, 1e-3])
    match = re.fullmatch(
        rf"From (\S+) to (\S+) m/s at {re.escape(f'tip {NASTY}')}, "
        r"the natural frequency of mode 1 rises from "
        r"(\S+) to (\S+) Hz and its damping ratio falls from (\S+) to (\S+) %\.",
        sentence,
    )
    speed = displacement * hertz * HERTZ
    # Three and four digits are printed; the curve is exact to 0.05 %.
    assert float(match[1]) == pytest.approx(speed[0], rel=6e-3)
    assert float(match[2]) == pytest.approx(speed[1], rel=6e-3)
    np.testing.assert_allclose([float(match[3]), float(match[4])], hertz, rtol=1e-3)
    # Constant modal damping: the ratio falls as the frequency rises.
    np.testing.assert_allclose([float(match[5]), float(match[6])], 160 / hertz, rtol=1e-2)


def test_a_curve_that_turns_tells_its_lowest_and_highest_value(identification, modes):
    squared = identification.backbone.squared_frequency
    values = squared.parameters.at[1].set((70.0 * HERTZ) ** 2)
    dipped = eqx.tree_at(lambda b: b.squared_frequency.parameters, identification.backbone, values)
    rows = dict(identification_summary(dataclasses.replace(identification, backbone=dipped), modes))
    ends = re.fullmatch(
        r"(\S+) Hz at \S+ m/s to (\S+) Hz at \S+ m/s", rows["lowest to highest frequency"]
    )
    knots = np.asarray(squared.knots)
    drawn = CubicSpline(knots, np.asarray(values), bc_type="natural")
    u = np.linspace(float(dipped.smallest), float(dipped.largest), 2000) ** 2
    hertz = np.sqrt(drawn(u / float(squared.scale) ** 2)) / HERTZ
    assert float(ends[1]) == pytest.approx(hertz.min(), abs=0.2)  # between two of 200 samples
    assert float(ends[2]) == pytest.approx(hertz.max(), abs=0.1)
    turned = dataclasses.replace(identification, backbone=dipped)
    assert "natural frequency of mode 1 lies between" in identification_sentence(turned, modes)


def test_points_left_out_are_counted_with_the_reason(identification, modes):
    points = identification.points
    status = (
        points.status.at[0]
        .set(int(sj.identify.PointStatus.NO_ROOT))
        .at[1:3]
        .set(int(sj.identify.PointStatus.NEGATIVE_DAMPING))
    )
    doubted = dataclasses.replace(
        identification, points=eqx.tree_at(lambda p: p.status, points, status)
    )
    rows = dict(identification_summary(doubted, modes))
    assert rows["steady states used"].startswith("29 of 32")
    assert rows["left out"] == (
        "2 (negative damping: phase beyond 90° of resonance), "
        "1 (no root: amplitude and phase contradict the residual modes)"
    )


def test_unstated_noise_and_scatter_of_levels(identification, modes):
    level = np.array([0.0, 0.0, 2 * 0.2 / LINEAR_HZ, 0.001 / DAMPING])
    noise = dataclasses.replace(
        identification.fit.noise, scale=0.012, scale_std=0.001, level_std=level, stated=False
    )
    fit = dataclasses.replace(identification.fit, noise=noise)
    rows = dict(identification_summary(dataclasses.replace(identification, fit=fit), modes))
    assert rows["noise"] == (
        "not stated; states scatter about the curves by 1.20 ± 0.10 % of the velocity, errors of "
        "whole levels excluded"
    )
    assert rows["scatter from level to level"] == "0.25 % in natural frequency, 5 % in damping (1σ)"


def test_resonances_beside_the_nearest_of_harmonic_balance(identification):
    backbone = identification.backbone
    found = [resonance(2e-3, 0.202, 81.0), resonance(1e-3, 0.1, 80.0, continued=True)]
    curves = [
        simulated(
            1e-3,
            [0.1, 0.125, 0.3],
            [80.0, 80.5, 95.0],
            ["", "phase_resonance", "phase_resonance"],
        ),
        simulated(2e-3, [0.2], [82.0], ["fold"]),
        simulated(3e-3, [0.3], [82.0], ["phase_resonance"]),
    ]
    table = resonance_table(backbone, found, curves, [1e-3, 3e-3])
    assert table.header[0] == "force (mN)"
    assert [row[0] for row in table.rows] == ["1", "2", "3"]
    first, second, third = table.rows
    assert first[1:5] == ["0.1", "80", "1.9", "yes"]
    # 0.1 is 20 % below 0.125 m/s, and 80 is 0.5 below 80.5 Hz.
    assert first[5:] == ["0.125", "80.5", "−20", "−0.5"]
    assert second[4:] == ["no", "none found", "", "", ""]
    assert third[1:] == ["not in range", *[""] * 7]
    assert {len(row) for row in table.rows} == {len(table.header)}


def test_resonances_alone(identification):
    table = resonance_table(identification.backbone, [resonance(2.0, 0.02, 81.0)])
    assert table.header == [
        "force (N)",
        "velocity (mm/s)",
        "frequency (Hz)",
        "damping (%)",
        "beyond the data",
    ]
    assert table.rows == [["2", "20", "81", "1.9", "no"]]


def test_curves_that_start_at_zero_are_told_from_there(identification, modes):
    free = identification.backbone
    squared, damping = free.squared_frequency.parameters, free.modal_damping.parameters
    # The first knot is at rest.
    anchored = eqx.tree_at(
        lambda b: (b.squared_frequency.parameters, b.modal_damping.parameters, b.smallest),
        free,
        (
            squared.at[0].set((LINEAR_HZ * HERTZ) ** 2),
            damping.at[0].set(LINEAR_DAMPING),
            jnp.zeros(()),
        ),
    )
    rows = dict(
        identification_summary(dataclasses.replace(identification, backbone=anchored), modes)
    )
    assert re.match(r"80(\.0\d*)? ± \S+ Hz at 0 m/s", rows["natural frequency (± 95 %)"])
    assert re.match(r"2(\.0\d*)? ± \S+ % at 0 m/s", rows["damping ratio (± 95 %)"])


@pytest.mark.parametrize(
    ("value", "spread", "text"),
    [
        (79.1234, 0.0841, "79.123 ± 0.084"),
        (94.6, 12.0, "95 ± 12"),
        (94.6, 0.0, "94.6"),
        (94.6, np.nan, "94.6"),
        (5.0, 1e-9, "5"),
        (2.4731e9, 6.2e7, "(2.473 ± 0.062) × 10⁹"),
        (-6.0208e-6, 8.7e-8, "(−6.021 ± 0.087) × 10⁻⁶"),
        (0.0, 0.1, "0.00 ± 0.10"),
        (1.5e-11, 0.0, "1.5 × 10⁻¹¹"),
    ],
)
def test_errors_have_two_digits(value, spread, text):
    assert reports.with_error(value, spread) == text


def test_reports_are_written_whole_or_not_at_all(tmp_path, report, html, monkeypatch):
    target = tmp_path / "report.html"
    write_report(target, report)
    assert target.read_text(encoding="utf-8") == html
    broken = Report("Broken", sections=[Section("One", (), [ReportFigure(Figure(), None)])])
    with pytest.raises(AttributeError):
        write_report(target, broken)
    with pytest.raises(ValueError, match="its folder does not exist"):
        write_report(tmp_path / "no" / "report.html", report)

    def fail(*_args, **_keywords):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(ValueError, match="No space left"):
        write_report(target, Report("Other"))
    assert target.read_text(encoding="utf-8") == html
    assert [file.name for file in tmp_path.iterdir()] == ["report.html"]
