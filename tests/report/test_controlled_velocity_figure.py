"""Forces that hold the velocity of a level, against those of a linear mode."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from truths.balanced_sets import OMEGA, PARTICIPATION, SHAPE, ZETA, linear_model

import snrmjax as sj
from snrmjax.diagnose.response_prediction import controlled_velocity_curves
from snrmjax.numerics.units import HERTZ
from snrmjax.report.figures.diagnosis import controlled_velocity_figure

HELD = (0.02, 0.05)  # m/s


def force_of(omega, velocity):
    """|ω₀² − Ω² + 2iζω₀Ω| v/(ΩΦ_rΦᵀb)."""
    stiffness = OMEGA**2 - omega**2 + 2j * ZETA * OMEGA * omega
    return np.abs(stiffness) * velocity / (omega * SHAPE * PARTICIPATION)


@pytest.fixture(scope="module")
def data():
    """Two levels of a held velocity."""
    level, omega = np.repeat([3, 4], 9), np.tile(OMEGA * np.linspace(0.97, 1.03, 9), 2)
    held = np.array(HELD)[level - 3]
    stiffness = OMEGA**2 - omega**2 + 2j * ZETA * OMEGA * omega
    phase = 0.5 * np.pi - np.angle(stiffness)
    return sj.measure.steady_states(level, omega, force_of(omega, held), held * np.exp(1j * phase))


def test_the_force_that_holds_a_velocity_is_that_of_the_mode(data):
    curves = controlled_velocity_curves(linear_model(), data, 0)
    assert [one.level for one in curves] == [3, 4]
    for one, held in zip(curves, HELD, strict=True):
        assert one.velocity == pytest.approx(held, rel=1e-12)
        np.testing.assert_allclose(one.force, force_of(one.frequency, held), rtol=1e-8)
        assert one.frequency[[0, -1]] == pytest.approx(OMEGA * np.array([0.97, 1.03]))


def test_a_recorded_force_is_the_acting_one_over_its_gain(data):
    (whole, _), (half, _) = (
        controlled_velocity_curves(linear_model(), data, 0, gain) for gain in (1.0, 2.0)
    )
    np.testing.assert_allclose(2 * half.force, whole.force, rtol=1e-12)


def test_lines_pass_through_the_measured_forces(data):
    curves = controlled_velocity_curves(linear_model(), data, 0)
    figure = controlled_velocity_figure(curves, curves, data, "sensor 1")
    for axes in figure.axes[:2]:
        (dots,) = (line for line in axes.lines if line.get_marker() == "o")
        lines = [line for line in axes.lines if line is not dots]
        assert len(lines) == 2
        x, y = dots.get_data()
        for line, mine in zip(lines, (x[:9], x[9:]), strict=True):
            at = np.interp(mine, *line.get_data())
            own = y[:9] if line is lines[0] else y[9:]
            np.testing.assert_allclose(at, own, rtol=2e-3)  # straight between 81 points
        assert mine.min() * HERTZ == pytest.approx(0.97 * OMEGA)
        assert "Force amplitude" in figure.axes[0].get_ylabel()
    plt.close(figure)
