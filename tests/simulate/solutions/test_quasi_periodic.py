"""Quasi-periodic branches: where they end, and the motion that SciPy integrates."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import snrmjax as sj
from snrmjax.model.attachment import between
from snrmjax.pipelines.simulate import simulate_responses
from snrmjax.simulate.solutions.quasi_periodic import TorusEnd

# NLvib's second example: two masses with two cubic springs.
MASS = np.array([1.0, 0.05])
STIFFNESS = np.array([[1.0453, -0.0453], [-0.0453, 0.0453]])
DAMPING = np.array([[0.015, -0.013], [-0.013, 0.013]])


@pytest.fixture(scope="module")
def pair():
    springs = (
        sj.model.make_effect("cubic_stiffness", {"coefficient": 1.0}, at="x1"),
        sj.model.make_effect("cubic_stiffness", {"coefficient": 0.0042}, at=between("x1", "x2")),
    )
    model = sj.model.from_matrices(np.diag(MASS), DAMPING, STIFFNESS, force="x1", effects=springs)
    response = sj.forced_response(model, 0.11, 1.05, 1.25, harmonic_order=7)[0]
    return model, response, sj.simulate.quasi_periodic_branch(model, response, slow_order=3)


def test_the_branch_goes_from_one_bifurcation_to_the_other(pair):
    """Published: 1.11271 and 1.19574 rad/s."""
    _, response, branch = pair
    assert branch.status == TorusEnd.PERIODIC
    assert branch.frequency[0] == pytest.approx(1.11271, abs=1e-4)
    assert branch.frequency[-1] == pytest.approx(1.19574, abs=3e-4)
    assert branch.modulation[0] == 0.0
    for ends in (branch.least_amplitude, branch.largest_amplitude):
        np.testing.assert_allclose(ends[0], np.abs(branch.velocity[0]), rtol=1e-12)
    assert branch.modulation[-1] < 0.02 < branch.modulation.max()
    first, last = response.at_events("neimark_sacker")
    for index, end in ((first, 0), (last, -1)):
        angles = np.abs(np.angle(response.multipliers[index]))
        slow = angles / (2 * np.pi) * response.frequency[index]
        assert np.min(np.abs(slow - branch.slow_frequency[end])) < 2e-4


def test_a_motion_is_the_one_that_scipy_finds(pair):
    _, _, branch = pair
    index = int(np.argmin(np.abs(branch.frequency - 1.15)))
    omega = float(branch.frequency[index])

    def rates(t, y):
        x, v = y[:2], y[2:]
        spring = 0.0042 * (x[0] - x[1]) ** 3
        inner = DAMPING @ v + STIFFNESS @ x + np.array([x[0] ** 3 + spring, -spring])
        return np.concatenate([v, (np.array([0.11 * np.cos(omega * t), 0.0]) - inner) / MASS])

    options = {"rtol": 1e-7, "atol": 1e-9}
    period = 2 * np.pi / omega
    begin = solve_ivp(rates, (0, 250 * period), np.zeros(4), **options).y[:, -1]
    times = period * np.arange(150 * 40) / 40
    motion = solve_ivp(rates, (0, times[-1]), begin, t_eval=times, **options).y[2:]
    np.testing.assert_allclose(
        np.abs(motion).max(axis=1), branch.largest_velocity[index], rtol=0.01
    )
    demodulation = np.exp(-1j * omega * times) * np.hanning(len(times))
    mean = 2 * np.abs(motion @ demodulation) / np.sum(np.hanning(len(times)))
    np.testing.assert_allclose(mean, np.abs(branch.velocity[index]), rtol=5e-3)
    # The amplitude goes up and down: of the part of the spectrum about Ω, ends of the record cut.
    spectrum = np.fft.fft(motion, axis=1)
    order = np.fft.fftfreq(len(times), times[1]) * period
    around = np.where(np.abs(order - 1) < 0.5, 2 * spectrum, 0.0)
    amplitude = np.abs(np.fft.ifft(around, axis=1))[:, 1000:-1000]
    np.testing.assert_allclose(amplitude.max(axis=1), branch.largest_amplitude[index], rtol=0.02)
    np.testing.assert_allclose(amplitude.min(axis=1), branch.least_amplitude[index], rtol=0.03)


@pytest.mark.long
def test_responses_are_simulated_with_their_quasi_periodic_motions(pair, tmp_path):
    """Both ends of the window are Neimark-Sacker points: one branch, in a table and a figure."""
    model, _, branch = pair
    ends = 1.05 / (2 * np.pi), 1.25 / (2 * np.pi)
    found = simulate_responses(model, [0.11], *ends, harmonics=7, quasi_periodic=True)
    (only,) = found.quasi_periodic
    np.testing.assert_allclose(only.frequency, branch.frequency, rtol=1e-12)
    sj.write_results(found, tmp_path)
    rows = np.genfromtxt(tmp_path / "quasi_periodic.csv", delimiter=",", names=True)
    np.testing.assert_allclose(rows["slow_period_s"], 2 * np.pi / branch.slow_frequency, rtol=1e-9)
    r = branch.sensors.index(found.sensor)
    np.testing.assert_allclose(rows["velocity_h1_least_m_s"], branch.least_amplitude[:, r])
    assert (tmp_path / "quasi_periodic.png").read_bytes()[:4] == b"\x89PNG"
    speeds, periods = only.plot().axes
    assert speeds.patches  # the range
    np.testing.assert_allclose(periods.lines[0].get_ydata(), only.slow_period)
    none = simulate_responses(model, [0.01], *ends, harmonics=3, quasi_periodic=True)
    assert none.quasi_periodic == ()
    assert "no_event_to_follow" in [note.kind for note in none.notes]


def test_what_cannot_be_followed_is_refused(pair):
    model, response, _ = pair
    with pytest.raises(ValueError, match="no Neimark-Sacker point there"):
        sj.simulate.quasi_periodic_branch(model, response, 0)
    with pytest.raises(ValueError, match="`slow_order` must be 1 or more"):
        sj.simulate.quasi_periodic_branch(model, response, slow_order=0)
    slider = {"stiffness": 1.0, "slip_displacement": 1.0}
    stuck = sj.model.make_effect("jenkins_slider", slider, at="x1")
    rubbing = sj.model.from_matrices(np.diag(MASS), DAMPING, STIFFNESS, force="x1", effects=stuck)
    with pytest.raises(ValueError, match="with internal variables"):
        sj.simulate.quasi_periodic_branch(rubbing, response)
    with pytest.raises(ValueError, match="with internal variables"):
        simulate_responses(rubbing, [0.1], 0.1, 0.2, quasi_periodic=True)
