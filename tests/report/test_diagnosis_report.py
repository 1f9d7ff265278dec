"""The report of a diagnosis in words, and its figures: laws and responses that are known."""

import dataclasses
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from truths.printed_page import unreadable

import snrmjax as sj
from snrmjax.diagnose.location.laws_at_points import LocatedLaw
from snrmjax.diagnose.location.where import Localisation, LocatedForce
from snrmjax.diagnose.misfit.locating import Located
from snrmjax.diagnose.verdict import Verdict
from snrmjax.model.effects import EFFECTS, effect_parameters, make_effect
from snrmjax.numerics.units import HERTZ
from snrmjax.pipelines.diagnose import DiagnosedTest, simulated_levels
from snrmjax.report import style as drawing
from snrmjax.report.figures import diagnosis as plot
from snrmjax.report.html import report_html
from snrmjax.report.pages import diagnosis as diagnosis_page

SHAPE, PARTICIPATION, OMEGA, ZETA = 2.0, 3.0, 100.0, 0.01
LARGEST = 0.6  # m/s
BLIND = Path(__file__).parents[1] / "diagnose" / "blind"


@pytest.fixture(scope="module")
def states():
    """Three levels of three states near 100 rad/s, each at one velocity and force."""
    level = np.repeat([1, 2, 3], 3)
    velocity = np.repeat([0.1, 0.3, LARGEST], 3) * np.exp(1j * np.tile([-0.5, 0.0, 0.5], 3))
    frequency = np.tile([99.0, 100.0, 101.0], 3)
    return sj.measure.steady_states(
        *(level, frequency, np.repeat([1.0, 3.0, 6.0], 3)), velocity[:, None], sensors=("tip",)
    )


def model(*effects):
    modes = sj.model.linear_modes([OMEGA], [ZETA], [[SHAPE]], [PARTICIPATION], sensors=("tip",))
    return sj.model.structure(modes, effects=effects)


def curves(effect, states):
    """The axes of one effect's law, and its curves as pairs of coordinates in SI units."""
    (axes,) = plot.effect_laws_figure(model(effect), states).axes
    lines = [line for line in axes.lines if len(line.get_xdata()) > 2]
    return axes, [(np.asarray(x), np.asarray(y)) for x, y in (line.get_data() for line in lines)]


def test_drag_is_drawn_against_velocity_in_newtons_at_the_drive(states):
    axes, ((v, force),) = curves(make_effect("quadratic_damping", {"coefficient": 6.0}), states)
    assert axes.get_xlabel() == "Velocity (m/s)"
    assert axes.get_ylabel() == "Equivalent force (N)"
    assert np.ptp(v) == pytest.approx(2 * LARGEST, rel=1e-12)
    # f = c q̇|q̇| with q̇ = v/φ, and Φᵀb F = f.
    np.testing.assert_allclose(force, 6.0 * v * np.abs(v) / SHAPE**2 / PARTICIPATION, atol=1e-12)


def test_a_spring_is_drawn_against_displacement(states):
    axes, ((x, force),) = curves(make_effect("cubic_stiffness", {"coefficient": 2e7}), states)
    assert axes.get_xlabel() == "Displacement (mm)"
    x = 1e-3 * x
    # Of the largest level, the state with the lowest frequency moves farthest.
    assert x.max() == pytest.approx(LARGEST / 99.0, rel=1e-12)
    np.testing.assert_allclose(force, 2e7 * (x / SHAPE) ** 3 / PARTICIPATION, atol=1e-12)


def test_friction_with_a_memory_is_a_loop_for_each_of_three_amplitudes(states):
    slider = make_effect("jenkins_slider", {"stiffness": 100.0, "slip_displacement": 2e-4})
    axes, loops = curves(slider, states)
    assert axes.get_xlabel() == "Displacement (mm)"
    widths = [1e-3 * np.ptp(x) / 2 for x, _ in loops]
    np.testing.assert_allclose(widths, np.array([0.1, 0.3, LARGEST]) / 99.0, rtol=1e-12)
    labels = [text.get_text() for text in axes.figure.legends[0].get_texts()]
    assert labels == ["up to 1.01 mm", "up to 3.03 mm", "up to 6.06 mm"]
    x, force = (1e-3 * loops[-1][0], loops[-1][1])
    scale = 1e-3 if "mN" in axes.get_ylabel() else 1.0
    # A slider dissipates 4 k d (X − d) a cycle at the mode: here by displacement and newtons.
    work = abs(np.sum(0.5 * (force[1:] + force[:-1]) * np.diff(x))) * scale
    q, slip = x.max() / SHAPE, 2e-4
    assert work == pytest.approx(
        4 * 100.0 * slip * (q - slip) * SHAPE / PARTICIPATION, rel=2e-3
    )  # polygons of 360 sides


def test_drift_is_drawn_for_the_first_and_the_last_state(states):
    axes, (first, last) = curves(make_effect("frequency_drift", {"relative_drift": 0.01}), states)
    assert not first[1].any()
    assert {text.get_text() for text in axes.figure.legends[0].get_texts()} == {
        *("first state of the test", "last state"),
    }
    assert np.abs(last[1]).max() > 0


def test_an_effect_of_the_instruments_is_drawn_as_what_it_changes(states):
    (axes,) = plot.effect_laws_figure(
        model(make_effect("sensor_gain_error", {"gain": 0.07})), states
    ).axes
    size, turn = [line for line in axes.lines if line.get_marker() == "o"]
    np.testing.assert_allclose(size.get_ydata(), 7.0, rtol=1e-12)
    np.testing.assert_allclose(turn.get_ydata(), 0.0, atol=1e-12)
    assert axes.get_ylabel() == "Change of the velocity (%, °)"
    receptance = 1e-5
    residual = make_effect("residual_mode", {"receptance": receptance})
    (axes,) = plot.effect_laws_figure(model(residual), states).axes
    size, turn = [line for line in axes.lines if line.get_marker() == "o"]
    velocity, omega = np.asarray(states.velocity)[:, 0], np.asarray(states.frequency)
    ratio = 1 + 1j * omega * receptance * np.asarray(states.force) / velocity
    np.testing.assert_allclose(
        sorted(size.get_ydata()), sorted(100 * (np.abs(ratio) - 1)), atol=1e-9
    )


def test_every_effect_of_the_library_has_a_law(states):
    """No kind is left without a drawing, whatever its class."""
    likely = {"frequency_hz": 20.0, "damping_ratio": 0.01, "exponent": 1.5, "gap": 1e-3}
    effects = [
        make_effect(kind, {p: likely.get(p, 0.01) for p in effect_parameters(kind)})
        for kind in EFFECTS
    ]
    figure = plot.effect_laws_figure(model(*effects), states)
    assert len(figure.axes) == len(effects)
    for axes in figure.axes:
        assert re.search(r"\(.+\)$", axes.get_xlabel())
        assert re.search(r"\(.+\)$", axes.get_ylabel())
    with pytest.raises(ValueError, match="no effect to show"):
        plot.effect_laws_figure(model(), states)


def test_effects_are_named_in_words():
    assert plot.effect_name("one_sided_stop") == "one sided stop"
    assert plot.effect_name("internal_resonance_1_2") == "internal resonance 1:2"
    assert plot.effect_name("van_der_pol_damping") == "Van der Pol damping"


@pytest.fixture(scope="module")
def drag():
    """Quadratic damping that is missing, found: model, states and diagnosis."""
    given = sj.read_model(BLIND / "blind_12.toml")
    data = sj.read_steady_states(BLIND / "blind_12.csv", given)
    return given, data, sj.diagnose_model(given, data)


@pytest.fixture(scope="module")
def pictures(drag):
    given, _, found = drag
    simulated = simulated_levels(found, given)
    responses = diagnosis_page.responses_figure(found, simulated)
    figures = {**diagnosis_page.diagnosis_figures(found), "responses": responses}
    return simulated.predicted.levels, figures


def html_of(found, pictures, **settings):
    predicted, figures = pictures
    pixels = dict.fromkeys(figures, drawing.PrintedFigure(b"PNG", 7.0))  # words are tested here
    return report_html(diagnosis_page.diagnosis_report(found, "One", pixels, predicted, **settings))


def test_the_report_begins_with_the_verdict_in_a_sentence(drag, pictures):
    found = drag[2]
    html = html_of(found, pictures)
    body = html[html.index("<h1>") :]
    assert body.index('class="result"') < body.index('class="pairs"') < body.index("<h2>")
    sentence = re.search(r'<p class="result">(.*?)</p>', body)[1]
    assert re.match(r"Quadratic damping explains \d+ % \(\d+ to \d+\) of the change", sentence)
    assert re.search(r"the misfit falls from 4\.\d to 1\.0 times the noise", sentence)
    assert "quadratic_damping" not in body
    assert "may be" not in body


def test_limits_and_losing_candidates_are_folded_away(drag, pictures):
    html = html_of(drag[2], pictures)
    folded = re.findall(r"<details>\n<summary>(.*?)</summary>.*?</details>", html, re.DOTALL)
    assert folded[-1] == f"Detection limits of {len(drag[2].detection_limits)} further effects"
    assert folded[:-1] == [f"{len(drag[2].table)} fits compared"]


@pytest.mark.parametrize(
    ("verdict", "words"),
    [
        ("none", "No missing effect is detected in these data"),
        ("named", "Quadratic damping explains "),
        ("unknown", "no effect in the library explains reliably"),
        ("noise_rejected", "The stated noise is inconsistent"),
    ],
)
def test_each_verdict_is_one_plain_sentence(drag, verdict, words):
    sentence = dataclasses.replace(drag[2], verdict=verdict).verdict_sentence
    assert words in sentence
    assert sentence.endswith(".")
    assert "_" not in sentence


def test_rivals_are_told_where_there_are_some(drag):
    rivals = (("quadratic_damping", "cubic_damping", "jenkins_slider"),)
    unclear = dataclasses.replace(
        drag[2], verdict="ambiguous", parts=(), answer=drag[2].answer._replace(candidates=rivals)
    )
    assert unclear.verdict_sentence.startswith(
        "The model lacks quadratic damping, cubic damping or Jenkins slider, and these data cannot "
        "distinguish them"
    )


def test_a_parameter_without_an_error_is_said_to_be_undetermined(drag, pictures):
    name = "quadratic_damping.coefficient"
    value = drag[2].parameters[name][0]
    html = html_of(drag[2], pictures)
    assert re.search(rf"{value:.1f} ± \d\.\d", html)
    answer = drag[2].answer._replace(parameters={name: (value, 0.0)})
    html = html_of(dataclasses.replace(drag[2], answer=answer), pictures)
    assert "1σ not determined by these data" in html
    assert "e+00" not in html


def test_disagreement_is_located_in_words():
    part = Located("damping", (0.0401, 0.161), 0.0)
    assert diagnosis_page._located(part) == (
        "The damping differs from the model's, at velocity amplitudes from 0.0401 to 0.161 m/s "
        "(by chance: below 10⁻¹²)."
    )
    part = Located("not_a_function_of_amplitude", (0.001, 0.02), 2e-7)
    assert "not a function of amplitude" in diagnosis_page._located(part)
    assert "from 1 to 20 mm/s (by chance: 2 × 10⁻⁷)" in diagnosis_page._located(part)


def test_predictions_of_unseen_levels_are_told_from_those_of_the_completed_model(drag, pictures):
    levels, figures = pictures
    unseen = max(levels, key=lambda one: one.force)
    assert unseen.withheld
    assert unseen.completed.velocity != unseen.after.velocity
    html = html_of(drag[2], (levels, figures)).replace("\u00a0", " ")
    own, out = f"{unseen.completed.frequency:.5g} Hz", f"{unseen.after.frequency:.5g} Hz"
    assert f"completed model: {own}" in html
    assert f"predicted without level {unseen.level}: {out}" in html
    assert "predicted without this level" in html
    table = html[html.index("predicted without this level") :]
    table = table[: table.index("</table>")]
    assert len(set(re.findall(r"\d ([mµ]?m/s)", table))) == 1


def test_the_terminal_has_what_was_found_with_its_error_and_unit(drag):
    given, _, found = drag
    value, std = found.parameters["quadratic_damping.coefficient"]
    (line,) = (one for one in diagnosis_page.headline(DiagnosedTest(found, given)) if "± 1σ" in one)
    words = r"identified \(± 1σ\): quadratic damping, coefficient (\S+) ± (\S+) 1/\(√kg m\)"
    printed = re.fullmatch(words, line)
    assert printed
    # To two digits of the error.
    assert [float(text) for text in printed.groups()] == pytest.approx([value, std], rel=0.05)
    poor = dataclasses.replace(found, verdict="unknown", gap=found.gap._replace(after=169.0))
    (line,) = (one for one in diagnosis_page.headline(DiagnosedTest(poor, given)) if "± 1σ" in one)
    assert line.startswith("best attempt (± 1σ): quadratic damping, coefficient")
    assert line.endswith("; the ± holds only if the noise is as stated")
    nothing = dataclasses.replace(found, answer=found.answer._replace(effects=(), candidates=()))
    assert not any("±" in one for one in diagnosis_page.headline(DiagnosedTest(nothing, given)))


def test_a_law_at_a_place_has_physical_units_in_the_terminal(drag):
    given, _, found = drag
    law = LocatedLaw("cubic_stiffness", 1.0, 10, {"coefficient": 2e4}, {"coefficient": 300.0})
    place = LocatedForce("tip", (("tip", 1.0),), 0.9, law, {"cubic_stiffness": 1.0})
    other = place._replace(name="everywhere", influence=None, probability=0.1)
    where = Localisation(
        *((place, other), given, None, ("tip", "everywhere"), np.array([0.9, 0.1])), misfit=1.0
    )
    poor = dataclasses.replace(found, verdict=Verdict.UNKNOWN)
    lines = diagnosis_page.headline(DiagnosedTest(poor, given, where=where))
    assert "identified (± 1σ): cubic stiffness at tip, coefficient 20000 ± 300 N/m³" in lines


def test_a_best_attempt_and_its_errors_are_called_so(drag, pictures):
    found = drag[2]
    assert "holds only if the noise is as stated" not in html_of(found, pictures)
    poor = dataclasses.replace(found, verdict="unknown", gap=found.gap._replace(after=169.0))
    html = html_of(poor, pictures)
    assert "best attempt: quadratic damping" in html
    assert "The best attempt, which does not explain the data" in html
    assert "× noise; the ± holds only if the noise is as stated" in html
    assert "holds only if the noise is as stated" in repr(poor)
    assert "the remaining misfit is 170 times that noise" in html


def test_what_these_data_cannot_show_is_said_to_be_so(drag, pictures):
    found = drag[2]
    assert "not detectable in these data" not in html_of(found, pictures)
    name = next(one for one in found.detection_limits if one.startswith("cubic_stiffness."))
    far = {name: 1e6 * found.detection_limits[name]}
    for limits in (far, {"force_gain_error.gain": 25.0}):
        html = html_of(dataclasses.replace(found, detection_limits=limits), pictures)
        assert "not detectable in these data" in html


def test_gains_of_candidates_have_sensible_digits():
    assert diagnosis_page._gain(8881703213.0) == "8.9 × 10⁹"
    assert diagnosis_page._gain(431.6) == "432"
    assert diagnosis_page._gain(-6.1) == "−6"


def test_levels_that_hold_the_response_are_told_and_their_states_pale(drag, pictures):
    data = drag[1]
    assert not diagnosis_page.is_response_controlled(data, pictures[0])
    assert "control the response" not in html_of(drag[2], pictures)
    force = np.asarray(data.force)
    swept = dataclasses.replace(data, force=force * np.linspace(0.7, 1.3, len(force)))
    assert not diagnosis_page.is_response_controlled(
        swept, pictures[0]
    )  # its velocities change far more
    velocity, level = np.asarray(data.velocity), np.asarray(data.level)
    size = np.abs(velocity[:, 0])
    held = np.array([np.median(size[level == one]) for one in level]) / size
    swept = dataclasses.replace(swept, velocity=velocity * held[:, None])
    assert diagnosis_page.is_response_controlled(swept, pictures[0])
    html = html_of(dataclasses.replace(drag[2], data=swept), pictures)
    assert "control the response" in html
    forces = [one.force for one in pictures[0]]
    assert plot.at_curve_force(data, forces).all()
    assert 0 < plot.at_curve_force(swept, forces).mean() < 0.8


def test_misfit_and_responses_stand_over_the_states(drag, pictures):
    _, data, found = drag
    before, after = pictures[1]["residuals"].axes[:2]
    rows, frequency = found.force_misfit.rows, np.asarray(data.frequency)
    for axes, misfit in ((before, found.force_misfit.before), (after, found.force_misfit.after)):
        (dots,) = axes.collections
        size = np.sqrt(np.nanmean(misfit**2, axis=1))
        np.testing.assert_allclose(np.asarray(dots.get_array()), np.sort(size), rtol=1e-12)
        x = np.asarray(dots.get_offsets())[:, 0]
        np.testing.assert_allclose(
            np.sort(x),
            np.sort(frequency[rows]) / HERTZ,
            rtol=1e-12,
        )
    (ring,) = [line for line in after.lines if line.get_marker() == "o"]
    out = found.gap.interpolated.level
    assert len(ring.get_xdata()) == np.sum(np.asarray(data.level)[rows] == out)
    given_axes, completed = pictures[1]["responses"].axes
    assert given_axes.get_ylim() == completed.get_ylim()
    n_levels = len(np.unique(np.asarray(data.level)))
    drawn = [line for line in completed.lines if line.get_color() == drawing.IDENTIFIED]
    assert len(drawn) == n_levels
    with pytest.raises(ValueError, match="no response to show"):
        plot.comparison_figure([], [], data)


def test_figures_of_a_diagnosis_can_be_read_on_a_printed_page(pictures, states):
    loops = make_effect("jenkins_slider", {"stiffness": 100.0, "slip_displacement": 2e-4})
    gain = make_effect("sensor_gain_error", {"gain": 0.07})
    coupled = {"coefficient": 1e9, "frequency_hz": 30.0, "damping_ratio": 0.01}
    further = make_effect("internal_resonance_1_2", coupled)
    figures = pictures[1] | {
        "two laws": plot.effect_laws_figure(model(loops, gain), states),
        "three laws": plot.effect_laws_figure(model(loops, gain, further), states),
    }
    for name, figure in figures.items():
        assert unreadable(figure) == [], name


def test_a_response_of_which_no_point_was_found_leaves_its_place_empty(states):
    velocity = np.zeros((0, 2, len(states.sensors)), dtype=complex)
    none = SimpleNamespace(force=1.0, frequency=np.zeros(0), velocity=velocity)
    given, completed = plot.comparison_figure([none], [none], states).axes
    assert not any(len(line.get_xdata()) for line in completed.lines if line.get_linestyle() == "-")
    assert given.get_ylim() == completed.get_ylim()
