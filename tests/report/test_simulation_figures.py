"""Figures of simulated motions: events, units and the curves themselves."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from truths.beam_forces import FORCES
from truths.printed_page import unreadable

import snrmjax as sj
from snrmjax.numerics.units import HERTZ
from snrmjax.report.figures import simulation as plot
from snrmjax.report.style import SERIES


def named(axes, label):
    """The one line with a label."""
    (line,) = [line for line in axes.lines if line.get_label() == label]
    return line


def legend_names(figure):
    return {text.get_text() for text in figure.legends[0].get_texts()}


def test_simulated_responses_mark_folds_peaks_and_resonances(virtual):
    figure = plot.simulated_response_figure(virtual.curves)
    speeds, phases = figure.axes
    assert speeds.get_ylabel() == "Velocity amplitude (m/s)"
    assert phases.get_xlabel() == "Frequency (Hz)"
    assert {"40 µN", "80 µN", "0.1334 mN", "fold", "peak", "unstable"} <= legend_names(figure)
    (steep,) = [c for c in virtual.curves if c.force == FORCES[2]]
    for kind, marker in (("fold", "s"), ("peak", "^"), ("phase_resonance", "o")):
        marked = [line for line in speeds.lines if line.get_marker() == marker]
        expected = [c.frequency[c.at_events(kind)] / HERTZ for c in virtual.curves]
        drawn = np.concatenate([line.get_xdata() for line in marked])
        np.testing.assert_array_equal(drawn, np.concatenate(expected))
    assert len(steep.at_events("fold")) == 2
    dashed = [
        line for line in speeds.lines if line.get_linestyle() == "--" and len(line.get_xdata())
    ]
    unstable = sum(int(np.sum(c.is_unstable)) for c in virtual.curves)
    # A dashed piece ends on the first stable point.
    assert sum(len(line.get_xdata()) - 1 for line in dashed) == unstable


def test_simulated_responses_refuse_nothing(virtual):
    with pytest.raises(ValueError, match="no curve has a point"):
        plot.simulated_response_figure([])
    with pytest.raises(ValueError, match="`sensor` must be one of"):
        plot.simulated_response_figure(virtual.curves, sensor="quarter")


def test_normal_mode_against_frequency_and_energy(mode):
    figure = plot.normal_mode_figure(mode)
    speeds, energies = figure.axes
    fundamental, peak = (
        next(line for line in speeds.lines if line.get_color() == colour and len(line.get_xdata()))
        for colour in (named(speeds, "fundamental").get_color(), SERIES[5])
    )
    np.testing.assert_array_equal(fundamental.get_xdata(), mode.frequency / HERTZ)
    np.testing.assert_array_equal(fundamental.get_ydata(), np.abs(mode.velocity[:, 1, 0]))
    (curve,) = (line for line in energies.lines if len(line.get_xdata()))
    np.testing.assert_array_equal(curve.get_xdata(), mode.energy)
    np.testing.assert_array_equal(curve.get_ydata(), mode.frequency / HERTZ)
    assert energies.get_xscale() == "log"
    assert energies.get_xlabel() == "Energy (J)"
    # The second harmonic falls with the amplitude: below 1 % at a fiftieth of the largest one.
    peak = peak.get_ydata()
    small = fundamental.get_ydata() < 0.02 * fundamental.get_ydata().max()
    assert small.any()
    np.testing.assert_allclose(peak[small], fundamental.get_ydata()[small], rtol=0.01)
    with pytest.raises(ValueError, match="the branch has no point"):
        plot.normal_mode_figure(dataclasses.replace(mode, frequency=np.zeros(0)))


@pytest.mark.long
def test_normal_mode_of_a_pair_shows_shares_shape_and_instability():
    """One mass hits a cubic spring: the mode leaves it to the other mass, and loses stability."""
    spring = sj.model.make_effect("cubic_stiffness", {"coefficient": 0.5}, at="x1")
    matrices = sj.model.chain([1.0, 1.0], [1.0, 1.0, 1.0], [0.01, 0.01, 0.01])
    model = sj.model.from_matrices(*matrices, force="x1", effects=spring)
    branch = sj.nonlinear_normal_mode(model, 1.3, harmonic_order=5)
    figure = branch.plot()
    _, energies, fractions, shapes = figure.axes
    assert {"mode 1", "mode 2", "at x1", "at x2", "unstable"} <= legend_names(figure)
    dashed = [line for line in energies.lines if line.get_linestyle() == "--"]
    drawn = np.concatenate([line.get_ydata() for line in dashed])
    assert drawn.min() == pytest.approx(branch.frequency[branch.stability == 0].min() / HERTZ)
    ends = {named(fractions, f"mode {k}").get_color(): [] for k in (1, 2)}
    for line in fractions.lines:
        if len(line.get_xdata()):
            ends[line.get_color()].append(line.get_ydata()[-1])
    np.testing.assert_allclose(sum(np.array(v) for v in ends.values()), 100.0, rtol=1e-12)
    over = [line.get_ydata()[-1] for line in shapes.lines if len(line.get_xdata())]
    assert over[-1] == pytest.approx(
        branch.velocity[-1, 1, 1].imag / branch.velocity[-1, 1, 0].imag
    )
    assert unreadable(figure) == []


@pytest.mark.long
def test_events_are_drawn_over_their_parameter():
    modes = sj.model.linear_modes([1.0], [0.025], [[1.0]], [1.0])
    model = sj.model.structure(modes, sj.model.polynomial_potential({"1111": 0.025}, 1))
    (response,) = sj.forced_response(model, [0.18], 0.5, 1.6, harmonic_order=1, stability=False)

    def followed(kind, parameter, to):
        start = response.point(response.at_events(kind)[0])
        return sj.simulate.follow_event(model, 0.18, start, kind=kind, parameter=parameter, to=to)

    folds = followed("fold", "force", (0.01, 0.2))
    figure = plot.event_curve_figure([folds, followed("peak", "force", (0.01, 0.2))])
    frequencies, speeds = figure.axes
    assert frequencies.get_xlabel() == "Force (N)"
    assert speeds.get_ylabel() == "Velocity amplitude (m/s)"
    assert legend_names(figure) == {"fold", "peak", "turning point"}
    np.testing.assert_allclose(named(frequencies, "fold").get_ydata(), folds.frequency / HERTZ)
    (k,) = folds.at_events("cusp")
    turn = named(speeds, "turning point")
    np.testing.assert_allclose(turn.get_xydata(), [[folds.value[k], folds.amplitude[k]]])
    damped = followed("peak", "mode_1.damping_ratio", (0.02, 0.05))
    assert damped.plot().axes[0].get_xlabel() == "mode_1.damping_ratio"
    with pytest.raises(ValueError, match=r"must be over one parameter, but are over force, mode_1"):
        plot.event_curve_figure([folds, damped])


def test_results_are_drawn_with_their_errors_and_stability(identification, backbone, predicted):
    points, curve = identification.points, backbone.plot()
    stars = identification.points.plot()
    for figure in (curve, stars):
        natural, ratio = figure.axes
        assert natural.get_ylabel() == "Natural frequency (Hz)"
        assert ratio.get_ylabel() == "Damping ratio (% of critical)"
        assert unreadable(figure) == []
    (bars,) = [c for c in stars.axes[1].collections if hasattr(c, "get_segments")]
    lengths = [np.ptp(segment[:, 1]) for segment in bars.get_segments()]
    np.testing.assert_allclose(lengths, 2 * 196 * np.asarray(points.damping_ratio_std), rtol=1e-9)
    corners = curve.axes[1].collections[0].get_paths()[0].vertices
    end = backbone.values(jnp.asarray([float(backbone.largest)]))
    at_end = corners[np.isclose(corners[:, 0], float(end.velocity[0]), rtol=1e-9), 1]
    width = 2 * 196 * float(end.damping_ratio_std[0])
    assert np.ptp(at_end) == pytest.approx(width, rel=1e-6)
    (response,) = predicted
    speeds = response.plot().axes[0]
    dashed = [line for line in speeds.lines if line.get_linestyle() == "--"]
    drawn = sum(len(line.get_xdata()) - 1 for line in dashed if len(line.get_xdata()))
    assert drawn == np.sum(~response.stable) > 0
    low, high = speeds.get_xlim()
    assert response.frequency.min() / HERTZ < low < high < response.frequency.max() / HERTZ
