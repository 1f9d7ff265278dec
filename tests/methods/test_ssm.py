"""Spectral submanifolds of decays of known backbone and damping."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import ellipj, ellipk
from truths import duffing

import snrmjax as sj
from snrmjax.methods.records.normal_form import NormalForm, form_of, sensor_signal, unknowns_of

REST, DAMPING, CUBIC = duffing.REST, duffing.DECAY_RATE, duffing.DECAY_CUBIC


@pytest.fixture(scope="module")
def decay():
    return duffing.decay(2000)


def exact():
    """Fundamental velocity, frequency and D ⟨v²⟩/(V²/2) of the undamped motion X cn(u | m)."""
    rows = []
    for size in np.linspace(1e-5, 2.1e-3, 200):
        stiff = REST**2 + CUBIC * size**2
        m = CUBIC * size**2 / (2 * stiff)
        quarter = ellipk(m)
        sn, _, dn, _ = ellipj(np.linspace(0, 4 * quarter, 257)[:-1], m)
        speed = -size * np.sqrt(stiff) * sn * dn
        fundamental = 2 * np.abs(np.fft.rfft(speed)[1]) / len(speed)
        power = DAMPING * np.mean(speed**2) / (fundamental**2 / 2)
        rows.append((fundamental, np.pi * np.sqrt(stiff) / (2 * quarter), power))
    return np.array(rows).T


def scores(result):
    """Errors over 1σ, and relative errors, of frequency and modal damping."""
    velocity, omega, lost = exact()
    true = np.interp(result.velocity, velocity, omega)
    ratio = np.interp(result.velocity, velocity, lost) / (2 * true)
    found = result.natural_frequency, result.damping_ratio
    std = result.natural_frequency_std, result.damping_ratio_std
    away = np.stack(found) - np.stack([true, ratio])
    return away / np.stack(std), away / np.stack([true, ratio])


def test_duffing_decays_along_its_backbone(decay):
    result = sj.methods.ssm(*decay, terms=5)
    assert result.has_result.all()
    assert np.ptp(result.natural_frequency) > 0.08 * REST
    _, relative = scores(result)
    # What a polynomial of degree 9 leaves of these curves, near the largest amplitude.
    assert np.abs(relative[0]).max() < 5e-5
    assert np.abs(relative[1]).max() < 0.01


def test_the_record_of_a_form_and_its_derivatives():
    time = np.arange(0, 1.0, 1 / 500)
    harmonics = np.array([[0.02 + 0.01j, 0.003], [0.03j, 0.01 - 0.002j]])
    decay, frequency = np.array([-1.2, -0.3, 0.05]), np.array([150.0, 8.0, -3.0])
    form = NormalForm(
        decay, frequency, harmonics, (2, 3), np.array([1e-3, 2e-3]), 0.4, np.array([-0.1, 0.3])
    )

    def rate(_, state):  # in Cartesian coordinates, with the polynomials written out
        r = 2 * np.sum(state**2) / 0.4**2 - 1
        known = np.array([1, r, 2 * r**2 - 1])
        x, y = state
        return decay @ known * x - frequency @ known * y, frequency @ known * x + decay @ known * y

    begin = 0.4 * np.exp(-0.1) * np.array([np.cos(0.3), np.sin(0.3)])
    x, y = solve_ivp(rate, (0, 1), begin, "DOP853", t_eval=time, rtol=1e-11, atol=1e-13).y
    z = (x + 1j * y) / 0.4
    wave = 0.4 * z + sum(
        (c + d * abs(z) ** 2) * z**order for order, (c, d) in zip((2, 3), harmonics, strict=True)
    )
    found = sensor_signal(form, time)
    np.testing.assert_allclose(found.signal, wave.real + 1e-3 + 2e-3 * np.abs(z) ** 2, atol=2e-6)
    point = unknowns_of(form)
    for k in range(len(point)):
        step = 1e-5 * max(1, abs(point[k])) * np.eye(len(point))[k]
        ends = [
            sensor_signal(form_of(point + s * step, 3, (2, 3), 0.4), time).signal for s in (1, -1)
        ]
        slope = (ends[0] - ends[1]) / (2 * step[k])
        np.testing.assert_allclose(found.jacobian[:, k], slope, atol=2e-5 * np.abs(slope).max())


@pytest.mark.long
@pytest.mark.parametrize(("noise", "seeds"), [(1e-3, 20), (1e-2, 60), (5e-2, 20)])
def test_bands_cover(decay, noise, seeds):
    time, velocity = decay
    fractions = []
    for seed in range(seeds):
        rng = np.random.default_rng([seed, round(1e4 * noise)])
        added = noise * velocity.max() * rng.standard_normal(len(time))
        fractions.append(np.abs(scores(sj.methods.ssm(time, velocity + added))[0]))
    within, independent = np.array(fractions), 5 * seeds  # five coefficients a curve
    for size, fraction in ((1.0, 0.683), (1.96, 0.95)):
        found = np.mean(within < size, axis=(0, 2))
        assert np.all(
            np.abs(found - fraction) < 3 * np.sqrt(fraction * (1 - fraction) / independent)
        )


def test_bad_records_are_refused(decay):
    time, velocity = decay
    for times, record, words in (
        (time[:300], velocity[:300], "12 cycles are needed, or 5 in which"),
        (time, np.clip(velocity, -0.2, 0.2), "it is clipped"),
        (time[::8], velocity[::8], "samples a cycle"),
        (time**1.1, velocity, "evenly spaced"),
        (time, np.where(time > 1, np.nan, velocity), "NaN or inf"),
    ):
        with pytest.raises(ValueError, match=words):
            sj.methods.ssm(times, record)
    with pytest.raises(ValueError, match="`terms` must be from 1 to 7"):
        sj.methods.ssm(time, velocity, terms=8)


def test_growth_is_not_a_mode(decay):
    time, velocity = decay
    result = sj.methods.ssm(time, velocity[::-1].copy(), terms=3)
    assert not result.has_result.any()
