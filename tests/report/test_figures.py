"""Figures: what is drawn, in which unit, and how it is marked."""

import dataclasses
import itertools
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
import pytest
from truths.beam_forces import FORCES
from truths.printed_page import unreadable

import snrmjax as sj
from snrmjax.identify.pointwise.backbone_points import BackbonePoints
from snrmjax.io.results import write_backbone
from snrmjax.numerics.units import DEGREE, HERTZ
from snrmjax.report import style as drawing
from snrmjax.report.figures import identification as plot
from snrmjax.report.figures.simulation import normal_mode_figure, simulated_response_figure
from snrmjax.report.sampling import SHOWN_AMPLITUDES
from snrmjax.report.style import png_bytes, save_figure


def named(axes, label):
    """The one line with a label."""
    (line,) = [line for line in axes.lines if line.get_label() == label]
    return line


def pieces(axes, colour):
    """The unnamed lines of a colour, which are the pieces of curves."""
    same = [line for line in axes.lines if mpl.colors.same_color(line.get_color(), colour)]
    return [
        line for line in same if line.get_label().startswith("_") and line.get_marker() == "None"
    ]


def at_ends(backbone):
    """Velocity, ω̃, the 1σ of ω̃ and ζ̃, and modal damping at the ends of the data."""
    ends = jnp.stack([backbone.smallest, backbone.largest])
    at = backbone.values(ends)
    chosen = (
        at.velocity,
        at.natural_frequency,
        at.natural_frequency_std,
        at.damping_ratio_std,
        at.modal_damping,
    )
    return [np.asarray(one) for one in chosen]


def legend_names(figure):
    return {text.get_text() for text in figure.legends[0].get_texts()}


def test_backbone_points_are_drawn_in_hertz_and_per_cent(identification, backbone):
    points = identification.points
    figure = plot.backbone_figure(points, backbone)
    speeds, phases, dampings = figure.axes
    dots, stars = named(speeds, "measured"), named(speeds, "identified, 95 % bars")
    assert speeds.get_ylabel() == "Velocity amplitude (m/s)"
    np.testing.assert_array_equal(dots.get_xdata(), np.asarray(points.frequency) / HERTZ)
    np.testing.assert_array_equal(dots.get_ydata(), np.abs(np.asarray(points.velocity)))
    np.testing.assert_array_equal(stars.get_xdata(), np.asarray(points.natural_frequency) / HERTZ)
    np.testing.assert_array_equal(stars.get_ydata(), points.backbone_velocity)
    assert dots.get_color() == drawing.MEASURED
    assert stars.get_color() == drawing.IDENTIFIED
    assert stars.get_marker() == "*"
    turned = named(phases, "measured")
    np.testing.assert_allclose(
        turned.get_ydata(), np.angle(np.asarray(points.mode_velocity)) / DEGREE, rtol=1e-14
    )
    (ratios,) = [line for line in dampings.lines if line.get_marker() == "*"]
    np.testing.assert_array_equal(ratios.get_ydata(), 100 * np.asarray(points.damping_ratio))
    # Amplitude and phase share the frequencies below both.
    assert [axes.get_xlabel() for axes in figure.axes] == [
        *("", "Frequency (Hz)", "Velocity amplitude (m/s)"),
    ]
    assert phases.get_xlim() == speeds.get_xlim()
    assert phases.get_ylabel() == "Velocity phase (°)"
    assert dampings.get_ylabel() == "Damping ratio (% of critical)"
    assert {-90.0, -45.0, 0.0, 45.0, 90.0} <= set(phases.get_yticks())
    assert phases.get_ylim() == (-100.0, 100.0)


def test_backbone_curve_and_band_are_those_of_the_backbone(identification, backbone):
    figure = plot.backbone_figure(identification.points, backbone)
    speeds, _, dampings = figure.axes
    curve = named(speeds, "identified curve")
    velocities, expected, std, damping_std, _ = at_ends(backbone)
    expected = expected / HERTZ
    # Compiled for another shape, the same sums may round otherwise.
    np.testing.assert_allclose(curve.get_xdata()[[0, -1]], expected, rtol=1e-12)
    np.testing.assert_allclose(curve.get_ydata()[[0, -1]], velocities, rtol=1e-12)
    assert "95 % band" in legend_names(figure)
    band = speeds.collections[-1].get_paths()[0].vertices
    for velocity, middle, half in zip(velocities, expected, std, strict=True):
        edges = band[np.isclose(band[:, 1], velocity, rtol=1e-12), 0]
        np.testing.assert_allclose(
            [edges.min(), edges.max()],
            [middle - 1.96 * half / HERTZ, middle + 1.96 * half / HERTZ],
            rtol=1e-9,
        )
    band = dampings.collections[-1].get_paths()[0].vertices
    edges = band[np.isclose(band[:, 0], velocities[1], rtol=1e-12), 1]
    np.testing.assert_allclose(np.ptp(edges), 2 * 1.96 * 100 * damping_std[1], rtol=1e-9)


def test_error_bars_are_95_per_cent(identification, backbone):
    points = identification.points
    figure = plot.backbone_figure(points, backbone)
    for axes, direction, scale, std in (
        (figure.axes[0], 0, 1 / HERTZ, points.natural_frequency_std),
        (figure.axes[2], 1, 100.0, points.damping_ratio_std),
    ):
        (bars,) = [c for c in axes.collections if isinstance(c, mpl.collections.LineCollection)]
        lengths = [np.ptp(segment[:, direction]) for segment in bars.get_segments()]
        np.testing.assert_allclose(lengths, 2 * 1.96 * scale * np.asarray(std), rtol=1e-9)


def test_points_out_of_the_curves_are_grey_crosses(identification, backbone):
    points = identification.points
    status = points.status.at[1].set(int(sj.identify.PointStatus.NEGATIVE_DAMPING))
    status = status.at[3].set(int(sj.identify.PointStatus.NO_ROOT))
    natural = points.natural_frequency.at[3].set(jnp.nan)
    doubted = eqx.tree_at(lambda p: (p.status, p.natural_frequency), points, (status, natural))
    figure = plot.backbone_figure(doubted, backbone)
    speeds = figure.axes[0]
    crosses = named(speeds, "measured, left out")
    assert crosses.get_marker() == "x"
    assert mpl.colors.same_color(crosses.get_markeredgecolor(), drawing.EXCLUDED)
    frequency = np.asarray(points.frequency) / HERTZ
    np.testing.assert_array_equal(crosses.get_xdata(), frequency[[1, 3]])
    np.testing.assert_array_equal(
        named(speeds, "measured").get_xdata(), np.delete(frequency, [1, 3])
    )
    assert len(named(speeds, "identified, 95 % bars").get_xdata()) == len(frequency) - 2
    assert "measured, left out" not in legend_names(plot.backbone_figure(points, backbone))


def test_backbone_beside_truth_and_linear_mode(identification, backbone, model, mode):
    figure = plot.backbone_figure(identification.points, backbone, truth=mode, modes=model.modes)
    speeds, _, dampings = figure.axes
    truth, linear = named(speeds, "true mode"), named(speeds, "linear mode")
    assert truth.get_linestyle() == "--"
    assert truth.get_color() == "black"
    drawn = np.isfinite(truth.get_xdata())
    np.testing.assert_array_equal(truth.get_xdata()[drawn], mode.frequency[drawn] / HERTZ)
    np.testing.assert_array_equal(truth.get_ydata(), np.abs(mode.velocity[:, 1, 0]))
    assert (truth.get_ydata()[drawn] <= speeds.get_ylim()[1]).all()
    # One rounding of rad/s and back.
    assert linear.get_xdata()[0] == pytest.approx(64.78, rel=1e-15)
    (at_zero,) = [line for line in dampings.lines if line.get_marker() == "D"]
    assert (at_zero.get_xdata()[0], at_zero.get_ydata()[0]) == (0.0, 5.0)


def test_phase_is_zero_at_resonance_whatever_the_modal_constant(identification, backbone):
    points = identification.points
    turned = eqx.tree_at(lambda p: p.mode_velocity, points, -points.mode_velocity)
    opposite = eqx.tree_at(lambda b: b.modal_constant, backbone, -backbone.modal_constant)
    one = named(plot.backbone_figure(points, backbone).axes[1], "measured")
    other = named(plot.backbone_figure(turned, opposite).axes[1], "measured")
    np.testing.assert_array_equal(one.get_ydata(), other.get_ydata())


def test_small_velocities_are_in_millimetres(identification, backbone):
    points = identification.points
    small = eqx.tree_at(
        lambda p: (p.velocity, p.backbone_velocity),
        points,
        (0.1 * points.velocity, 0.1 * points.backbone_velocity),
    )
    speeds = plot.backbone_figure(small, backbone).axes[0]
    assert speeds.get_ylabel() == "Velocity amplitude (mm/s)"
    np.testing.assert_allclose(
        named(speeds, "measured").get_ydata(), 100 * np.abs(points.velocity), rtol=1e-14
    )


@pytest.mark.parametrize(("name", "power"), [("displacement", -1), ("acceleration", 1)])
def test_other_amplitudes_are_the_velocitys_at_each_frequency(
    identification, backbone, name, power
):
    """Ω of a measured state, ω̃ on the backbone; both axes, and the modal damping's."""
    shown = SHOWN_AMPLITUDES[name]
    points = identification.points
    figure = plot.backbone_figure(points, backbone, shown=shown)
    top, _, damping = figure.axes
    assert top.get_ylabel().startswith(f"{name.capitalize()} amplitude (")
    assert damping.get_xlabel() == top.get_ylabel()
    unit = {"µm": 1e-6, "mm": 1e-3, "m": 1.0, "m/s²": 1.0, "mm/s²": 1e-3, "km/s²": 1e3}
    size = unit[top.get_ylabel().split("(")[1].rstrip(")")]
    use = np.asarray(points.usable)
    dots = named(top, "measured")
    expected = np.abs(points.velocity) * np.asarray(points.frequency) ** float(power)
    np.testing.assert_allclose(dots.get_ydata() * size, expected[use], rtol=1e-12)
    series = [plot.DampingSeries("identified", points=points, backbone=backbone)]
    label = plot.modal_damping_figure(series, shown=shown).axes[0].get_xlabel()
    assert label == top.get_ylabel()


def test_another_amplitude_is_added_to_a_table_and_nothing_else_changes(tmp_path, identification):
    write_backbone(tmp_path / "old.csv", identification)
    write_backbone(tmp_path / "new.csv", identification, added=("displacement_m", -1))
    old = (tmp_path / "old.csv").read_text().splitlines()
    new = (tmp_path / "new.csv").read_text().splitlines()
    assert [line.rsplit(",", 1)[0] for line in new] == old
    rows = np.genfromtxt(tmp_path / "new.csv", delimiter=",", names=True)
    omega = 2 * np.pi * rows["natural_frequency_hz"]
    # 12 digits in the file
    np.testing.assert_allclose(rows["displacement_m"] * omega, rows["velocity_m_s"], rtol=1e-11)


def test_far_outliers_leave_the_axis_and_are_counted(identification, backbone):
    points = identification.points
    wild = eqx.tree_at(lambda p: p.damping_ratio, points, points.damping_ratio.at[2].set(3.0))
    dampings = plot.backbone_figure(wild, backbone).axes[2]
    assert dampings.get_ylim()[1] < 100.0
    assert [text.get_text() for text in dampings.texts] == ["1 point outside the y range"]
    assert not plot.backbone_figure(points, backbone).axes[2].texts


def test_many_points_are_drawn_small(identification, backbone):
    points = identification.points
    tiled = jax.tree.map(lambda column: jnp.concatenate([column] * 10), points)
    few, many = (
        named(plot.backbone_figure(p, backbone).axes[0], "identified, 95 % bars")
        for p in (points, tiled)
    )
    assert len(points.status) < drawing.CROWD < len(many.get_xdata())
    assert many.get_markersize() < few.get_markersize()


ARRAYS = [
    field.name
    for field in dataclasses.fields(BackbonePoints)
    if field.name not in ("sensor", "argument")
]


def test_names_of_sensors_are_shown_as_they_are(virtual):
    odd = r"$\frac{1_$"
    curves = [dataclasses.replace(curve, sensors=(odd,)) for curve in virtual.curves]
    figure = simulated_response_figure(curves, sensor=odd)
    assert png_bytes(figure, dots_per_inch=40)
    assert figure.axes[0].get_title(loc="left") == r"(a) amplitude at \$\frac{1_\$"


def test_response_pieces_make_up_the_predicted_curve(backbone, predicted, resonance, virtual):
    figure = plot.response_figure(backbone, predicted, resonance, measured=virtual.steady_states)
    speeds, phases = figure.axes
    (curve,) = predicted
    for axes, y in (
        (speeds, np.abs(curve.velocity)),
        (phases, np.angle(curve.velocity) / DEGREE),
    ):
        lines = [line for line in pieces(axes, drawing.IDENTIFIED) if line.get_linestyle() != ":"]
        assert len(lines) > 1
        x = np.concatenate([line.get_xdata()[:-1] for line in lines])
        np.testing.assert_array_equal(x, curve.frequency[:-1] / HERTZ)
        drawn = np.concatenate([line.get_ydata()[:-1] for line in lines])
        np.testing.assert_array_equal(drawn, y[:-1])
        for line, following in itertools.pairwise(lines):
            assert line.get_xdata()[-1] == following.get_xdata()[0]
    widths = {line.get_linestyle(): line.get_linewidth() for line in lines}
    assert set(widths) == {"-", "--"}
    assert widths["--"] < widths["-"]
    start = 0
    for line in lines:
        stable = curve.stable[start]
        assert line.get_linestyle() == ("-" if stable else "--")
        assert line.get_alpha() == (0.4 if curve.continued[start] else 1.0)
        start += len(line.get_xdata()) - 1
    star = named(speeds, "resonance")
    np.testing.assert_array_equal(star.get_xdata(), [one.frequency / HERTZ for one in resonance])
    np.testing.assert_array_equal(star.get_ydata(), [one.velocity for one in resonance])
    near = np.isclose(np.asarray(virtual.steady_states.force), FORCES[2])
    np.testing.assert_array_equal(
        named(speeds, "measured").get_xdata(),
        np.asarray(virtual.steady_states.frequency)[near] / HERTZ,
    )
    assert speeds.get_title(loc="left") == "force 0.1334 mN: amplitude at midspan"
    assert phases.get_ylabel() == "Velocity phase (°)"
    assert "unstable" in legend_names(figure)


def test_parts_beyond_the_data_are_pale(backbone, predicted):
    (curve,) = predicted
    far = np.abs(curve.velocity) > 0.5 * np.abs(curve.velocity).max()
    beyond = dataclasses.replace(curve, continued=far)
    figure = plot.response_figure(backbone, [beyond])
    lines = [p for p in pieces(figure.axes[0], drawing.IDENTIFIED) if p.get_linestyle() != ":"]
    for line in lines:
        inside = np.abs(line.get_ydata()[1:-1])
        limit = 0.5 * np.abs(curve.velocity).max()
        assert (inside > limit).all() if line.get_alpha() < 1 else (inside <= limit).all()
    assert "beyond the data" in legend_names(figure)


def test_responses_have_a_row_a_force_and_simulation_behind(backbone, predicted, virtual):
    figure = plot.response_figure(backbone, predicted, simulated=virtual.curves)
    assert len(figure.axes) == 2 * len(FORCES)
    for force, axes in zip(FORCES, figure.axes[::2], strict=True):
        assert axes.get_title(loc="left").startswith(f"force {drawing.with_unit(force, 'N')}:")
        (curve,) = [c for c in virtual.curves if c.force == force]
        lines = pieces(axes, drawing.BACKGROUND)
        x = np.concatenate([line.get_xdata()[:-1] for line in lines])
        np.testing.assert_array_equal(x, curve.frequency[:-1] / HERTZ)
    assert not curve.is_stable.all()
    assert {line.get_linestyle() for line in lines} == {"-", "--"}
    # Only the last force was predicted, and only the lowest row names the frequency.
    solid = [
        [p for p in pieces(a, drawing.IDENTIFIED) if p.get_linestyle() != ":"] for a in figure.axes
    ]
    assert [bool(lines) for lines in solid] == [False] * 4 + [True] * 2
    assert [a.get_xlabel() for a in figure.axes] == [""] * 4 + ["Frequency (Hz)"] * 2


def test_frequency_range_of_responses(backbone, predicted):
    given = plot.response_figure(backbone, predicted, frequency_range=(50 * HERTZ, 70 * HERTZ))
    np.testing.assert_allclose(given.axes[0].get_xlim(), (50.0, 70.0), rtol=1e-15)
    low, high = plot.response_figure(backbone, predicted).axes[0].get_xlim()
    amplitude = np.abs(predicted[0].velocity)
    large = predicted[0].frequency[amplitude > 0.25 * amplitude.max()] / HERTZ
    assert low < large.min()
    assert large.max() < high


def test_responses_refuse_what_they_cannot_show(backbone, virtual):
    with pytest.raises(ValueError, match="no response to show"):
        plot.response_figure(backbone, [])
    elsewhere = dataclasses.replace(backbone, sensor="quarter")
    with pytest.raises(ValueError, match=r"one of midspan, but is 'quarter'"):
        plot.response_figure(elsewhere, [], simulated=virtual.curves)


def test_loops_of_force_and_velocity(virtual):
    data = virtual.steady_states
    figure = plot.force_velocity_figure(data, [0, 4, 2, 7])
    assert len(figure.axes) == 4
    for axes, k in zip(figure.axes, [0, 4, 2, 7], strict=True):
        line, loop = axes.lines
        force, scale = float(data.force[k]), 1e6 if "µN" in axes.get_xlabel() else 1e3
        degrees = float(jnp.angle(data.velocity[k, 0])) / DEGREE
        title = f"level {int(data.level[k])}, {float(data.frequency[k]) / HERTZ:.4g} Hz\nphase "
        title += f"{'−' if degrees < 0 else '+'}{abs(degrees):.0f}°, indicator "
        assert axes.get_title(loc="left").startswith(title)
        np.testing.assert_allclose(loop.get_xdata().max(), scale * force, rtol=1e-12)
        np.testing.assert_allclose(loop.get_ydata()[0], loop.get_ydata()[-1], rtol=1e-12)
        # At the largest force the velocity is the sum of all in-phase parts.
        in_phase = data.velocity[k, 0].real + data.harmonics[k, 0].real.sum()
        per = 1e3 if "mm/s" in axes.get_ylabel() else 1.0
        np.testing.assert_allclose(loop.get_ydata()[0], per * in_phase, rtol=1e-12)
        assert line.get_linestyle() == "--"
        np.testing.assert_allclose(line.get_ydata()[1], per * data.velocity[k, 0].real)


def test_loops_leave_unmeasured_harmonics_out(virtual):
    data = virtual.steady_states
    missing = eqx.tree_at(lambda d: d.harmonics, data, jnp.full_like(data.harmonics, jnp.nan))
    (axes,) = plot.force_velocity_figure(missing, [1]).axes
    x, y = axes.lines[1].get_data()
    per = 1e3 if "mm/s" in axes.get_ylabel() else 1.0
    np.testing.assert_allclose(y.max(), per * abs(data.velocity[1, 0]), rtol=1e-3)
    assert np.isfinite(x).all()


@pytest.mark.parametrize("states", [[], [400], [-1]])
def test_loops_refuse_states_that_are_not_there(virtual, states):
    with pytest.raises(ValueError, match="`states` must be rows measured at 'midspan'"):
        plot.force_velocity_figure(virtual.steady_states, states)


def test_modal_damping_of_several_series(identification, backbone):
    points = identification.points
    series = [
        plot.DampingSeries("both", points, backbone),
        plot.DampingSeries("_points", points),
        plot.DampingSeries("curve", backbone=backbone),
        plot.DampingSeries("nothing"),
    ]
    figure = plot.modal_damping_figure(series, linear=40.7)
    (axes,) = figure.axes
    assert legend_names(figure) == {"both", " _points", "curve", "linear mode"}
    assert axes.get_ylabel() == "Modal damping 2ζω (1/s)"
    assert len(axes.collections) == 2
    np.testing.assert_array_equal(named(axes, " _points").get_ydata(), points.modal_damping)
    curve = named(axes, "curve")
    assert curve.get_color() == drawing.SERIES[2]
    np.testing.assert_allclose(curve.get_ydata()[[0, -1]], at_ends(backbone)[-1], rtol=1e-12)
    assert named(axes, "linear mode").get_ydata()[0] == 40.7
    with pytest.raises(ValueError, match="no series has points or a backbone"):
        plot.modal_damping_figure(series[3:])


def test_saved_figures_are_png_files(tmp_path, mode):
    figure = normal_mode_figure(mode)
    save_figure(tmp_path / "mode.png", figure, dots_per_inch=50)
    image = mpl.image.imread(tmp_path / "mode.png")
    assert image.shape[:2] == (160, 360)
    assert np.ptp(image[..., :3]) == 1.0
    assert [file.name for file in tmp_path.iterdir()] == ["mode.png"]


def test_figures_are_saved_whole_or_not_at_all(tmp_path, mode, monkeypatch):
    figure = normal_mode_figure(mode)
    target = tmp_path / "mode.png"
    target.write_bytes(b"before")
    with pytest.raises(ValueError, match=r"must end in \.png, but is mode\.pdf"):
        save_figure(tmp_path / "mode.pdf", figure)
    with pytest.raises(ValueError, match="its folder does not exist"):
        save_figure(tmp_path / "no" / "mode.png", figure)

    def fail(*_args, **_keywords):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(ValueError, match="No space left"):
        save_figure(target, figure)
    assert target.read_bytes() == b"before"
    assert [file.name for file in tmp_path.iterdir()] == ["mode.png"]


def test_matplotlib_is_left_as_it_was(identification, backbone):
    before = dict(mpl.rcParams)
    png_bytes(plot.backbone_figure(identification.points, backbone), dots_per_inch=40)
    assert dict(mpl.rcParams) == before


@pytest.mark.long
def test_plotting_needs_no_display():
    name = "snrmjax.report.figures.identification"
    lines = f"import {name}, sys; sys.exit('matplotlib.pyplot' in sys.modules)"
    finished = subprocess.run([sys.executable, "-c", lines], check=False, timeout=120)
    assert finished.returncode == 0


@pytest.mark.parametrize(
    ("value", "name", "text"),
    [
        (0.2, "m/s", "0.2 m/s"),
        (0.0999, "m/s", "99.9 mm/s"),
        (5e-5, "m/s", "50 µm/s"),
        (3.2e-9, "N", "3.2 nN"),
        (1.166e-11, "N", "1.166e-11 N"),
    ],
)
def test_units_suit_the_size(value, name, text):
    assert drawing.with_unit(value, name) == text
    assert drawing.unit_for([0.0], name) == (1.0, name)
    assert drawing.unit_for([np.nan, -value], name) == drawing.unit_for(value, name)


def test_figures_can_be_read_on_a_printed_page(
    identification, backbone, model, mode, predicted, resonance, virtual
):
    series = [plot.DampingSeries("both", identification.points, backbone)]
    for figure in (
        plot.backbone_figure(identification.points, backbone, truth=mode, modes=model.modes),
        plot.response_figure(
            *(backbone, predicted, resonance),
            simulated=virtual.curves,
            measured=virtual.steady_states,
        ),
        plot.force_velocity_figure(virtual.steady_states, [0, 4, 2, 7]),
        plot.modal_damping_figure(series, linear=40.7),
        simulated_response_figure(virtual.curves),
        normal_mode_figure(mode),
    ):
        assert unreadable(figure) == []


def test_bars_that_cannot_be_seen_are_not_promised():
    span = np.array([42.0, 43.0])
    names = [plot._named_with_bars((np.full(2, size), span)) for size in (0.1, 1e-4, 0.0, np.nan)]
    assert names == [
        "identified, 95 % bars",
        "identified, 95 % bars smaller than the stars",
        *["identified"] * 2,
    ]
