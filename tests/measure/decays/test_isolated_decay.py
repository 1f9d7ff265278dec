"""One mode of a decay apart from others, hum, an offset and noise, against its own equation."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from truths import duffing

import snrmjax as sj
from snrmjax.measure.decays.mode_ridge import spectral_peaks

HERTZ, RATE = 2 * np.pi, 2000.0
TIME = np.arange(0, 2.5, 1 / RATE)
REST, DAMPING = duffing.REST, duffing.DECAY_RATE


@pytest.fixture(scope="module")
def mode():
    return duffing.decay(RATE)[1]


@pytest.fixture(scope="module")
def backbone():
    """Fundamental velocity and frequency of undamped motions, integrated over half a cycle."""

    def turns(_, state):
        return state[1]

    turns.terminal, turns.direction = True, 1.0
    rows = []
    for size in np.linspace(1e-5, 2.1e-3, 60):
        result = solve_ivp(
            lambda _, s: (s[1], -(REST**2) * s[0] - duffing.DECAY_CUBIC * s[0] ** 3),
            *((0, 0.1), (size, -1e-12)),
            events=turns,
            dense_output=True,
            rtol=1e-10,
            atol=1e-14,
        )
        omega = np.pi / result.t_events[0][0]
        angle = np.pi * (np.arange(100) + 0.5) / 100
        rows.append((-2 * np.mean(result.sol(angle / omega)[1] * np.sin(angle)), omega))
    return np.array(rows).T


def tone(hertz, size, ratio=0.0):
    return size * np.exp(-ratio * HERTZ * hertz * TIME) * np.cos(HERTZ * hertz * TIME + 0.4)


def interfering(mode, seed=0):
    """30 % of the velocity at 2.7 times the frequency, 20 % at half of it, hum, offset, noise."""
    largest = np.abs(mode).max()
    noise = 0.01 * np.random.default_rng(seed).standard_normal(len(TIME))
    others = tone(108.0, 0.3, 0.002) + tone(20.0, 0.2, 0.01) + tone(60.0, 0.01)
    return mode + largest * (others + noise + 0.03)


def test_the_frequency_of_a_mode_with_company_is_its_own(mode, backbone):
    result = sj.measure.isolate_decay(TIME, interfering(mode), 1.01 * REST)
    true = np.interp(np.exp(result.level.real), *backbone)
    # The amplitude at which the truth is taken has its own error, along the backbone.
    slope = result.smooth_bend.imag / result.smooth_rate.real
    score = (result.rate.imag - true) / np.hypot(result.rate_std.imag, slope * result.level_std)
    assert true.max() / true.min() > 1.05
    assert np.mean(np.abs(score) < 1.96) > 0.85
    assert 0.4 < np.sqrt(np.mean(score**2)) < 1.6
    # Between the ends, where the filter sees both sides: 1 % of noise in some 300 samples.
    np.testing.assert_allclose(result.rate.imag[2:-2], true[2:-2], rtol=1e-3)


def test_what_lies_beside_the_mode_is_measured(mode):
    record = interfering(mode)
    result = sj.measure.isolate_decay(TIME, record, REST)
    centred = record - record.mean()
    np.testing.assert_allclose(
        result.interfering.mode_fraction, np.sum(mode**2) / np.sum(centred**2), atol=0.02
    )
    assert result.interfering.frequency / HERTZ == pytest.approx(108, abs=1)
    ((hertz, size),) = result.interfering.hum
    assert hertz == pytest.approx(60, abs=0.1)
    assert size == pytest.approx(0.01 * np.abs(mode).max(), rel=0.3)


def near_mains(ratio, hertz=60.027):
    """The decay of a mode near 60 Hz with its third harmonic."""
    level = np.exp(-ratio * HERTZ * hertz * TIME)
    own = level * np.cos(HERTZ * hertz * TIME) + 0.05 * level**3 * np.cos(3 * HERTZ * hertz * TIME)
    return own + 1e-3 * np.random.default_rng(3).standard_normal(len(TIME)), HERTZ * hertz


@pytest.mark.parametrize("ratio", [0.0005, 0.003])
def test_a_harmonic_of_the_mode_near_a_multiple_of_the_mains_is_no_hum(ratio):
    record, omega = near_mains(ratio)
    assert sj.measure.isolate_decay(TIME, record, omega).interfering.hum == ()


def test_hum_next_to_a_harmonic_of_the_mode_is_found():
    record, omega = near_mains(0.003)  # with 0.0005 it decays too little to differ in 2.5 s
    result = sj.measure.isolate_decay(TIME, record + tone(180.0, 0.02), omega)
    ((hertz, size),) = result.interfering.hum
    assert hertz == pytest.approx(180.0, abs=0.2)
    assert size == pytest.approx(0.02, rel=0.5)


def test_a_mode_alone_passes_through(mode, backbone):
    result = sj.measure.isolate_decay(TIME, mode, REST)
    first = int(np.argmin(np.abs(TIME - result.time[0])))
    away = result.velocity - mode[first : first + len(result.velocity)]
    assert np.sqrt(np.mean(away**2) / np.mean(mode**2)) < 2e-3
    # The decaying motion is slower than the undamped one by (D/2ω)²/2: 3e-6.
    true = np.interp(np.exp(result.level.real), *backbone)
    np.testing.assert_allclose(result.rate.imag[1:-1], true[1:-1], rtol=1e-4)


@pytest.mark.parametrize("times", [0.9, 1.08])
def test_a_mode_inside_the_band_is_refused(mode, times):
    other = tone(40.0 * times, 0.5 * np.abs(mode).max(), 0.004)
    with pytest.raises(ValueError, match=r"inside its band of .* another motion near"):
        sj.measure.isolate_decay(TIME, mode + other, REST)


def test_the_decay_begins_where_the_mode_dominates(mode):
    """A neighbour, inside the band, that dies out in half a second."""
    other = tone(37.0, 0.5 * np.abs(mode).max(), 0.03)
    result = sj.measure.isolate_decay(TIME, mode + other, REST)
    assert 0.05 < result.begin < 1.0


def test_records_without_the_mode_are_refused(mode):
    noise = np.random.default_rng(1).standard_normal(len(TIME))
    for record, words in (
        (noise, "cannot be isolated|no decaying mode"),
        (np.where(TIME > 1, np.nan, mode), "NaN or inf"),
        (np.clip(mode, -0.2, 0.2), "it is clipped"),
    ):
        with pytest.raises(ValueError, match=words):
            sj.measure.isolate_decay(TIME, record, REST)
    with pytest.raises(ValueError, match="12 cycles are needed"):
        sj.measure.isolate_decay(TIME[:400], mode[:400], REST)
    with pytest.raises(ValueError, match="8 samples a cycle are needed"):
        sj.measure.isolate_decay(TIME[::10], mode[::10], REST)


def test_a_beat_whose_phase_runs_backwards_is_refused(capfd):
    """Before, numbers that are not finite reached LAPACK, which printed a complaint."""
    rng = np.random.default_rng(0)
    time, omega = np.arange(0, 5.8, 1 / 1500), 2 * np.pi * 39.9
    one = np.exp(-0.0025 * omega * time) * np.cos(omega * time + 0.3)
    other = np.exp(-0.0011 * 0.89 * omega * time) * np.cos(0.89 * omega * time + 1.5)
    signal = one + 0.6 * other + 0.003 * rng.standard_normal(len(time))
    with pytest.raises(ValueError, match="its phase runs backwards"):
        sj.measure.isolate_decay(time, signal, omega)
    assert capfd.readouterr() == ("", "")


def test_noise_of_an_integrated_acceleration_is_no_motion():
    """Its density at 240 Hz is far above the median of all bins up to 4 kHz."""
    rate, n = 8192.0, 2**16
    white = np.fft.rfft(np.random.default_rng(0).normal(size=n))
    omega = HERTZ * np.fft.rfftfreq(n, 1 / rate)
    velocity = np.fft.irfft(white / np.maximum(omega, 1.0), n)
    peaks = spectral_peaks(np.arange(n) / rate, velocity, HERTZ * 240)
    near = (peaks.frequency > HERTZ * 120) & (peaks.frequency < HERTZ * 480)
    # Twelve independent bins there, each above ten medians of its power with 2⁻¹⁰; the median
    # over an octave to either side of 1/f² noise is lower by about 0.8² (2^-6.4).
    assert near.any(axis=1).mean() < 0.2
