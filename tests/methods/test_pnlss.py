"""Nonlinear state-space models of oscillators with a known nonlinear mode."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import cont2discrete

import snrmjax as sj
from snrmjax.measure import Channel, time_recording
from snrmjax.methods.records.state_space import StateSpace, hold, modal_constant, monomials
from snrmjax.methods.records.state_space import response as model_response
from snrmjax.methods.records.state_space_fit import _order, fit_state_space
from snrmjax.methods.records.state_space_start import linear_terms, subspace_poles

REST, RATIO, CUBIC, MASS = 2 * np.pi * 40.0, 0.01, 6e9, 0.5  # rad/s, 1, 1/(m² s²), kg
RATE, SAMPLES = 1000.0, 1024


def discrete_oscillator():
    """Multiplier, input and feedthrough of mobility s/(s² + …)/m for a force straight in between.

    By SciPy's first-order hold, brought to the model's coordinates by its frequency response.
    """
    matrix = np.array([[0.0, 1.0], [-(REST**2), -2 * RATIO * REST]])
    found = cont2discrete(
        (matrix, np.array([[0.0], [1 / MASS]]), np.array([[0.0, 1.0]]), np.zeros((1, 1))),
        *(1 / RATE, "foh"),
    )
    points = np.exp(1j * np.linspace(0.05, 1.2, 60))
    a, b, c, d = found[:4]
    values = np.array([(c @ np.linalg.solve(z * np.eye(2) - a, b) + d)[0, 0] for z in points])
    return np.linalg.eigvals(a), points, values


def test_the_linear_part_is_that_of_an_oscillator_for_a_force_straight_between_samples():
    multipliers, points, values = discrete_oscillator()
    weight = np.ones(len(points))
    found = subspace_poles(points, values, weight, 2)
    # Exact arithmetic would give them exactly: rounding of a least-squares problem.
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(multipliers), rtol=1e-9)
    upper = multipliers[multipliers.imag > 0]
    poles = np.stack([upper.real, upper.imag], axis=1)
    drive, through = linear_terms(points, values, weight, poles)
    model = StateSpace(poles, drive, np.array(through), np.zeros((2, 0)))
    np.testing.assert_allclose(model_response(model, points), values, rtol=1e-9)
    assert float(modal_constant(model, 0)) * RATE == pytest.approx(1 / MASS, rel=1e-9)
    # A band-limited force over the hold: what is left are images beyond the sampling rate.
    omega = np.angle(points) * RATE
    mobility = 1j * omega / MASS / (REST**2 - omega**2 + 2j * RATIO * REST * omega)
    near = np.abs(omega / REST - 1) < 0.5
    images = (omega[near] / (2 * np.pi * RATE)) ** 2 / (2 * np.pi * RATE * MASS)
    off = np.abs(values / hold(np.angle(points)) - mobility)[near]
    assert np.all(off < 3 * images + 1e-12)


def test_monomials_are_all_of_some_degrees():
    assert len(monomials(4, (2, 3))) == 10 + 20  # (n + d − 1 over d)
    assert sorted(monomials(2, (3,))) == [(0, 3), (1, 2), (2, 1), (3, 0)]


def multisine(rms, seed, *, periods=5, noise=1e-3, motion="velocity"):
    """A record of m(q̈ + 2ζω q̇ + ω² q + β q³) = F(t), F a multisine of 18 to 90 Hz."""
    rng = np.random.default_rng(seed)
    line = np.arange(int(18 * SAMPLES / RATE), int(90 * SAMPLES / RATE))
    phase = rng.uniform(0, 2 * np.pi, len(line))
    amplitude = rms * np.sqrt(2 / len(line))
    time = np.arange(periods * SAMPLES) / RATE

    def force(t):
        return amplitude * np.sum(np.cos(2 * np.pi * line * RATE / SAMPLES * t + phase))

    def rate(t, state):
        q, v = state
        return v, force(t) / MASS - REST**2 * q - CUBIC * q**3 - 2 * RATIO * REST * v

    found = solve_ivp(
        rate, (0, time[-1]), (0, 0), t_eval=time, rtol=1e-7, atol=1e-10, method="DOP853"
    )
    force_samples = np.array([force(t) for t in time])
    q, v = found.y
    acceleration = force_samples / MASS - REST**2 * q - CUBIC * q**3 - 2 * RATIO * REST * v
    motion_samples = {"velocity": v, "acceleration": acceleration}[motion]
    motion_samples = motion_samples + noise * motion_samples.std() * rng.standard_normal(
        len(motion_samples)
    )
    channels = [Channel("force", "force"), Channel("tip", motion)]
    return time_recording(
        np.stack([force_samples, motion_samples]), channels, RATE, name="multisine"
    )


def backbone(velocity):
    """One term of harmonic balance: within 3e-4 of the exact one at the amplitudes here."""
    half = REST**2 / 2
    return np.sqrt(half + np.sqrt(half**2 + 0.75 * CUBIC * velocity**2))


@pytest.mark.long
@pytest.mark.parametrize("motion", ["velocity", "acceleration"])
def test_mode_of_a_duffing_oscillator_from_three_realisations(motion):
    records = [multisine(0.5, seed, motion=motion) for seed in (0, 1, 2)]
    result = sj.methods.pnlss(records, "force", "tip")
    assert result.has_result.all()
    # Four of the fit's 1σ, and for frequency the truncation error of one-term harmonic balance.
    off = np.asarray(result.natural_frequency) - backbone(np.asarray(result.velocity))
    assert np.all(np.abs(off) < 4 * np.asarray(result.natural_frequency_std) + 3e-5 * REST)
    modal = 2 * np.asarray(result.damping_ratio) * np.asarray(result.natural_frequency)
    away = modal / (2 * RATIO * REST) - 1
    relative = np.asarray(result.damping_ratio_std) / np.asarray(result.damping_ratio)
    assert np.all(np.abs(away) < np.maximum(4 * relative, 2e-3))
    assert result.notes[0]["validation"] < 0.05


@pytest.mark.long
def test_a_model_that_does_not_fit_is_refused():
    with pytest.raises(
        ValueError, match=r"the residual of the best model of degree 3 .* of the velocity"
    ):
        sj.methods.pnlss(multisine(8.0, 0, periods=3), "force", "tip")


def test_what_cannot_be_fitted_is_refused():
    rng = np.random.default_rng(0)
    once = np.fft.irfft(np.fft.rfft(rng.standard_normal(256)) * (np.arange(129) < 40), 256)
    force_samples = np.tile(once, 4)
    moved = np.roll(force_samples, 3)

    def record(values, rate=RATE):
        channels = [Channel("force", "force"), Channel("tip", "velocity")]
        return time_recording(np.stack([force_samples, values]), channels, rate)

    fit = fit_state_space
    with pytest.raises(ValueError, match="`order` must be 2, 4 or 6"):
        fit(record(moved), "force", "tip", order=3)
    with pytest.raises(ValueError, match="`degrees` must lie between 2 and 7"):
        fit(record(moved), "force", "tip", degrees=(1, 3))
    with pytest.raises(ValueError, match=r"the record stays at its largest value.*clipped"):
        fit(record(np.clip(moved, -0.3, 0.3)), "force", "tip")
    far = sj.model.linear_modes([400 * 2 * np.pi], [0.01], [[1.0]], [1.0])
    with pytest.raises(ValueError, match="lines around the mode at 400 Hz are needed"):
        fit(record(moved), "force", "tip", far)
    with pytest.raises(ValueError, match="two periods are needed after the 3 discarded"):
        fit(record(moved), "force", "tip", skip=3)
    with pytest.raises(ValueError, match="does not have 1 oscillating modes"):
        fit(record(force_samples), "force", "tip")


@pytest.mark.long
def test_realisations_and_levels_of_one_test_are_one_model():
    shape = 1 / np.sqrt(MASS)
    modes = sj.model.linear_modes([REST], [RATIO], [[shape]], [shape], sensors=("tip",))
    records = [multisine(rms, seed, periods=3) for rms, seed in ((0.5, 0), (0.25, 1), (0.5, 2))]
    (result,) = sj.methods.compare_methods(records, modes, ["pnlss"]).results
    assert [n["n"] for n in result.notes if n.kind == "one_model_of_records"] == [3]
    assert result.notes[0]["validation"] < 0.05
    assert result.has_result.sum() == 25
    off = np.asarray(result.natural_frequency) - backbone(np.asarray(result.velocity))
    assert np.all(np.abs(off) < 4 * np.asarray(result.natural_frequency_std) + 3e-5 * REST)


def test_a_model_has_two_states_for_each_mode_that_is_excited():
    frequency = 2 * np.pi * np.array([30.0, 60.0])
    linear = SimpleNamespace(responses=SimpleNamespace(frequency=frequency))
    near = sj.model.linear_modes(
        2 * np.pi * np.array([40.0, 42.0, 90.0]), 3 * [0.01], np.ones((1, 3)), np.ones(3)
    )
    assert _order(linear, None) == 2
    assert _order(linear, near) == 4
    many = sj.model.linear_modes(
        2 * np.pi * np.linspace(40.0, 50.0, 6), 6 * [0.01], np.ones((1, 6)), np.ones(6)
    )
    assert _order(linear, many) == 6


@pytest.mark.long
@pytest.mark.parametrize(("drag", "reported"), [(0.0, False), (30.0, True)])
def test_forces_that_are_not_polynomial_are_reported(drag, reported):
    """v|v| is not polynomial: the residual exceeds the noise."""
    effects = [sj.model.make_effect("quadratic_damping", {"coefficient": drag})] if drag else []
    modes = sj.model.linear_modes([REST], [RATIO], [[1.0]], [1.0])
    laboratory = sj.simulate.Laboratory(
        *(sj.model.structure(modes, effects=effects), sj.simulate.Shaker(0.1, 0.1)),
        sj.simulate.Instruments(velocity_noise=1e-4, force_noise=1e-3),
        2000.0,
    )
    played = sj.simulate.multisine_test(laboratory, 1.0, np.arange(50, 120), 4000, 5, seed=0).record
    channels = [Channel("force", "force"), Channel("tip", "velocity")]
    values = np.stack([np.asarray(played.force), np.asarray(played.velocity)])
    record = time_recording(values, channels, 2000.0, name="multisine")
    notes = sj.methods.pnlss(record, "force", "tip", modes).notes
    assert any(note.kind == "misfit_beyond_noise" for note in notes) is reported
