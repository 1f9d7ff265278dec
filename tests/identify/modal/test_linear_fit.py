"""Linear modes from frequency responses, against eigenvalues of a chain of masses."""

import dataclasses

import numpy as np
import pytest
from truths.modal_structures import (
    HERTZ,
    accelerations,
    chain,
    held_linear,
    integrated,
    random_force,
    receptance,
    welch,
)

from snrmjax.identify.modal.free_decay import fit_free_decay
from snrmjax.identify.modal.linear_fit import fit_linear_modes
from snrmjax.identify.modal.modal_bases import BasisSettings, receptance_bases
from snrmjax.identify.modal.response_data import joined_responses
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.frequency_responses import frequency_responses
from snrmjax.measure.recordings.time_recording import time_recording

STRUCTURE = chain([1.0, 1.2, 0.8], [8e4, 9e4, 1.1e5], [0.01, 0.008, 0.006])
FORCE = Channel("hammer", "force", "N", point="1", direction="+z")
ACCELEROMETERS = [
    Channel(f"a{k + 1}", "acceleration", "m/s^2", point=str(k + 1), direction="+z")
    for k in range(3)
]
LINES = np.arange(8, 130, 0.25) * HERTZ


def exact(omega=LINES, structure=STRUCTURE, driven=0):
    """Accelerances."""
    return -(omega**2) * receptance(structure, omega, driven)


def responses(values, omega=LINES, channels=ACCELEROMETERS, **more):
    return frequency_responses(omega, values[:, None], channels, [FORCE], **more)


def noisy(seed=0, noise=0.3, averages=20):
    rng, clean = np.random.default_rng(seed), exact()
    coherence = np.abs(clean) ** 2 / (np.abs(clean) ** 2 + noise**2)
    std = np.abs(clean) * np.sqrt((1 - coherence) / coherence / 2 / averages)
    error = rng.normal(size=clean.shape) + 1j * rng.normal(size=clean.shape)
    return responses(clean + std * error, coherence=coherence[:, None], averages=averages)


def test_exact_responses_give_the_modes():
    modes = fit_linear_modes(responses(exact()))
    assert np.allclose(modes.natural_frequency, STRUCTURE.natural_frequency, rtol=1e-9)
    assert np.allclose(modes.damping_ratio, STRUCTURE.damping_ratio, rtol=1e-7)
    residue = STRUCTURE.shapes * STRUCTURE.shapes[0]
    assert np.allclose(modes.residue, residue, atol=1e-7)
    assert np.all(modes.collinearity > 1 - 1e-9)
    assert np.allclose(modes.curves.fitted, modes.curves.measured, rtol=1e-6)


def test_units_and_quantities_do_not_matter():
    # A laser in mm/s at the second mass and a displacement at the third: same modes, residues.
    values = exact()
    values[1] *= 1e3 / (1j * LINES)
    values[2] /= -(LINES**2)
    channels = [
        ACCELEROMETERS[0],
        Channel("laser", "velocity", "mm/s", 1e-3),
        Channel("probe", "displacement"),
    ]
    modes = fit_linear_modes(responses(values, channels=channels))
    assert np.allclose(modes.residue, STRUCTURE.shapes * STRUCTURE.shapes[0], atol=1e-6)


def test_noise_by_coherence_stays_in_the_band():
    errors = []
    for seed in range(4):
        modes = fit_linear_modes(noisy(seed))
        assert modes.n_modes == 3
        residue = STRUCTURE.shapes * STRUCTURE.shapes[0]
        errors += [
            (modes.natural_frequency - STRUCTURE.natural_frequency) / modes.natural_frequency_std,
            (modes.damping_ratio - STRUCTURE.damping_ratio) / modes.damping_ratio_std,
            ((modes.residue - residue) / modes.residue_std).ravel(),
        ]
        # The residuals are those of the stated coherence.
        assert np.all(np.abs(modes.misfit - 1) < 0.1)
    size = np.sqrt(np.mean(np.concatenate(errors) ** 2))
    # 60 normalised errors, correlated within a fit: their rms is 1 within some 25 %.
    assert 0.75 < size < 1.3


def test_unstated_errors_are_estimated_from_the_residuals():
    data = noisy()
    modes = fit_linear_modes(
        dataclasses.replace(data, coherence=np.full_like(data.coherence, np.nan))
    )
    stated = fit_linear_modes(data)
    assert modes.source == "residuals"
    assert np.all(np.isnan(modes.misfit))
    ratio = modes.natural_frequency_std / stated.natural_frequency_std
    assert np.all((ratio > 0.8) & (ratio < 1.25))


def test_two_modes_within_one_half_power_band():
    # 0.08 % apart with 0.35 % of damping: one peak.
    close = chain([1.0, 1.0], [1e5, 80.0, 1e5], [0.003, 0.0035], walls=(True, True))
    omega = np.arange(45, 56, 0.02) * HERTZ
    clean = exact(omega, close)
    rng = np.random.default_rng(0)
    noise = 0.02 * (rng.normal(size=clean.shape) + 1j * rng.normal(size=clean.shape))
    modes = fit_linear_modes(responses(clean + noise, omega, ACCELEROMETERS[:2]))
    assert modes.n_modes == 2
    assert np.allclose(modes.natural_frequency, close.natural_frequency, rtol=1e-4)
    assert np.allclose(modes.damping_ratio, close.damping_ratio, rtol=0.02)


def test_modes_by_hand_and_by_order():
    data = noisy()
    two = STRUCTURE.natural_frequency[:2]
    by_hand = fit_linear_modes(data, poles=list(two * 1.005), to_frequency=75 * HERTZ)
    assert np.allclose(by_hand.natural_frequency, two, rtol=2e-4)
    # Most poles of a high order are spurious: they are rejected by their residues.
    by_order = fit_linear_modes(data, order=30)
    assert np.allclose(by_order.natural_frequency, STRUCTURE.natural_frequency, rtol=1e-4)


def test_modes_outside_the_band_are_residual_terms():
    # The band holds the second mode alone: one below, one above.
    modes = fit_linear_modes(responses(exact()), from_frequency=45 * HERTZ, to_frequency=75 * HERTZ)
    assert modes.n_modes == 1
    assert modes.natural_frequency[0] == pytest.approx(STRUCTURE.natural_frequency[1], rel=1e-5)
    residue = STRUCTURE.shapes[:, 1] * STRUCTURE.shapes[0, 1]
    assert np.allclose(modes.residue[:, 0], residue, rtol=5e-3)


def test_the_phase_of_an_instrument_is_fitted():
    rotated = exact() * np.exp(0.1j)
    modes = fit_linear_modes(responses(rotated), instrument_phase=True)
    assert modes.phase == pytest.approx(0.1, abs=1e-6)
    assert np.allclose(modes.damping_ratio, STRUCTURE.damping_ratio, rtol=1e-5)
    # Not fitted, it appears in the residues.
    fixed = fit_linear_modes(responses(rotated))
    # In part: the fitted poles follow some of it.
    assert np.all((fixed.mean_phase > 0.03) & (fixed.mean_phase < 0.12))
    (note, *_) = [note for note in fixed.notes if note.kind == "residues_turned"]
    assert "(free it)" in str(note)


def test_a_fitted_phase_is_not_advised():
    """One mode alone is rotated, as by a missed neighbour."""
    omega, damping = STRUCTURE.natural_frequency[1], STRUCTURE.damping_ratio[1]
    part = (STRUCTURE.shapes[:, 1] * STRUCTURE.shapes[0, 1])[:, None] * -(LINES**2)
    part = part / (omega**2 - LINES**2 + 2j * damping * omega * LINES)
    rotated = exact() + (np.exp(0.3j) - 1) * part
    modes = fit_linear_modes(responses(rotated), instrument_phase=True)
    (note, *_) = [note for note in modes.notes if note.kind == "residues_turned"]
    assert "free it" not in str(note)
    assert "a missed neighbouring mode" in str(note)


def test_derivatives_of_the_bases():
    omega = np.linspace(50, 70, 9)
    start = np.array([58.0, 63.0, 0.01, 0.02, 0.1])
    for window in (None, 40.0):
        settings = BasisSettings(phase=True, curved=True, window_time=window)
        slopes = receptance_bases(omega, start, settings, (2,))[0].derivatives
        for k, step in enumerate(1e-5 * np.abs(start)):
            moved = start + step * np.eye(5)[k]
            back = start - step * np.eye(5)[k]
            ahead = receptance_bases(omega, moved, settings, (2,))[0].columns
            behind = receptance_bases(omega, back, settings, (2,))[0].columns
            size = np.abs(slopes[k]).max()
            # Central differences of relative step 1e-5; the windowed ones are differences too.
            assert np.allclose(slopes[k], (ahead - behind) / (2 * step), atol=1e-5 * size)


def test_leakage_of_a_window_is_modelled_or_stated():
    light = STRUCTURE._replace(damping_ratio=np.array([0.003, 0.002, 0.002]))
    rng, rate, finer = np.random.default_rng(1), 512, 8
    force = random_force(rng, 200 * rate * finer, rate * finer, 150.0)
    motion = accelerations(light, force, rate * finer)[:, ::finer]
    motion = motion + 0.02 * motion.std() * rng.normal(size=motion.shape)
    omega, values, coherence, count = welch(held_linear(force)[::finer], motion, rate, 4096)
    keep = (omega > 10 * HERTZ) & (omega < 110 * HERTZ)
    data = responses(
        values[:, keep], omega[keep], coherence=coherence[:, None, keep], averages=count
    )
    modelled, plain = fit_linear_modes(data, window="hann"), fit_linear_modes(data)
    error = np.abs(modelled.damping_ratio - light.damping_ratio)
    assert np.all(error < 4 * modelled.damping_ratio_std)
    # One to three lines in the half-power bands: leakage adds damping, as the notes state.
    deviation = plain.damping_ratio / light.damping_ratio - 1
    bias = [note["bias"] for note in plain.notes if note.kind == "leakage"]
    assert max(bias) > 0.03
    random = plain.damping_ratio_std / light.damping_ratio
    assert np.all(np.abs(deviation - bias) < 4 * random)
    assert np.max(deviation / random) > 4
    # Residues of an accelerance under the window, whose impulse response begins with an impulse.
    residue = STRUCTURE.shapes * STRUCTURE.shapes[0]
    assert np.all(np.abs(modelled.residue - residue) < 5 * modelled.residue_std + 1e-3)


def decay(seed=0, noise=0.02):
    start = np.concatenate([np.zeros(3), np.linalg.inv(STRUCTURE.mass)[0]])
    velocity = integrated(STRUCTURE, np.zeros((2048, 3)), 1024.0, start=start)[1].T
    rng = np.random.default_rng(seed)
    values = velocity + noise * np.abs(velocity).max() * rng.normal(size=velocity.shape)
    return time_recording(values, [Channel(f"v{k + 1}", "velocity") for k in range(3)], 1024.0)


def test_a_free_decay_gives_frequency_damping_and_shape():
    # Spurious clusters among the thirty orders are rejected by their amplitudes.
    modes = fit_free_decay(decay(), highest_order=30)
    assert modes.n_modes == 3
    for value, std, truth in (
        (modes.natural_frequency, modes.natural_frequency_std, STRUCTURE.natural_frequency),
        (modes.damping_ratio, modes.damping_ratio_std, STRUCTURE.damping_ratio),
    ):
        assert np.all(np.abs(value - truth) < 4 * std)
        assert np.all(std / truth < [0.05, 0.05, 0.05])
    top = np.argmax(np.abs(STRUCTURE.shapes), axis=0)
    relative = STRUCTURE.shapes / STRUCTURE.shapes[top, range(3)]
    assert np.all(np.abs(modes.shape - relative) <= 4 * modes.shape_std + 1e-12)
    # Several decays halve the variance.
    both = fit_free_decay([decay(1), decay(2)], highest_order=12)
    ratio = both.natural_frequency_std / modes.natural_frequency_std
    assert np.allclose(ratio, np.sqrt(0.5), rtol=0.15)


def test_results_are_labelled_and_drawn():
    modes = fit_linear_modes(responses(exact()), poles=[400.0], to_frequency=75 * HERTZ)
    data = modes.to_xarray()
    assert data.natural_frequency_hz.attrs["units"] == "Hz"
    assert data.residue.dims == ("sensor", "mode")
    measured = modes.plot(sensors=["a2"]).axes[0].lines[0]
    assert np.allclose(measured.get_xdata(), modes.curves.omega / HERTZ)
    assert np.allclose(measured.get_ydata(), np.abs(modes.curves.measured[1]))


BAD = [
    ("negative damping", lambda: fit_linear_modes(responses(exact().conj()))),
    ("is zero or missing", lambda: fit_linear_modes(responses(exact() * [[1], [0], [1]]))),
    (
        "must be from 0 to 1",
        lambda: fit_linear_modes(responses(exact(), coherence=np.full((3, 1, len(LINES)), 1.2))),
    ),
    (
        "coherence is zero at most lines",
        lambda: fit_linear_modes(responses(exact(), coherence=np.zeros((3, 1, len(LINES))))),
    ),
    ("modes need 6 lines", lambda: fit_linear_modes(responses(exact()[:, :1], LINES[:1]))),
    (
        "modes need 6 lines",
        lambda: fit_linear_modes(responses(exact()), from_frequency=200 * HERTZ),
    ),
    (
        "band must rise",
        lambda: fit_linear_modes(
            responses(exact()), from_frequency=50 * HERTZ, to_frequency=20 * HERTZ
        ),
    ),
    ("pole must lie in the band", lambda: fit_linear_modes(responses(exact()), poles=[2000.0])),
    ("at least one", lambda: fit_linear_modes(responses(exact()), poles=[])),
    ("`order` must be from 1", lambda: fit_linear_modes(responses(exact()), order=99)),
    ("highest order must be", lambda: fit_linear_modes(responses(exact()), highest_order=9999)),
    ("`residual_terms` must be", lambda: fit_linear_modes(responses(exact()), residual_terms="x")),
    ("`window` must be", lambda: fit_linear_modes(responses(exact()), window="boxcar")),
    (
        "evenly spaced lines",
        lambda: fit_linear_modes(responses(exact(LINES**1.01), LINES**1.01), window="hann"),
    ),
    (
        "must be a displacement, velocity or acceleration",
        lambda: fit_linear_modes(
            responses(exact(), channels=[*ACCELEROMETERS[:2], Channel("v", "voltage")])
        ),
    ),
    (
        "over one reference, but there are 2",
        lambda: fit_linear_modes(
            frequency_responses(
                LINES,
                np.stack([exact(), exact()], axis=1),
                ACCELEROMETERS,
                [FORCE, Channel("second", "force")],
            )
        ),
    ),
    ("no reference 'x'", lambda: fit_linear_modes(responses(exact()), reference="x")),
    ("comes 2 times", lambda: joined_responses([responses(exact()), responses(exact())])),
    (
        "share their frequencies",
        lambda: joined_responses([responses(exact()), responses(exact()[:, 1:], LINES[1:])]),
    ),
    (
        "`std` must be positive",
        lambda: fit_linear_modes(responses(exact()), std=np.zeros((3, len(LINES)))),
    ),
    (
        "needs a channel that is",
        lambda: fit_free_decay(time_recording(np.ones((1, 99)), [FORCE], 9.0)),
    ),
    (
        "is zero throughout",
        lambda: fit_free_decay(time_recording(np.zeros((1, 99)), [ACCELEROMETERS[0]], 9.0)),
    ),
    (
        "40 samples at least",
        lambda: fit_free_decay(time_recording(np.ones((1, 9)), [ACCELEROMETERS[0]], 9.0)),
    ),
]


@pytest.mark.parametrize(("message", "wrong"), BAD, ids=[f"{k} {b[0]}" for k, b in enumerate(BAD)])
def test_wrong_input_is_named(message, wrong):
    with pytest.raises(ValueError, match=message) as error:
        wrong()
    assert str(error.value).rstrip().endswith(".")


def test_noise_alone_has_no_modes():
    rng = np.random.default_rng(3)
    noise = rng.normal(size=(3, len(LINES))) + 1j * rng.normal(size=(3, len(LINES)))
    with pytest.raises(ValueError, match=r"no pole is stable|no mode stands out"):
        fit_linear_modes(responses(noise))
