"""Hypotheses compared with corrected records: large level errors, steep curves."""

import dataclasses

import numpy as np
import pytest
from truths.balanced_sets import OMEGA, PARTICIPATION, SHAPE, linear_model

import snrmjax as sj
from snrmjax.diagnose.explained_parts import named_parts
from snrmjax.diagnose.fitted_effects import refined
from snrmjax.diagnose.misfit.candidates import candidate
from snrmjax.diagnose.misfit.effect_fit import (
    at_reference,
    baseline_fit,
    fit_effect,
    likely_errors,
    without_errors,
)
from snrmjax.diagnose.misfit.predictions import predictions_of, scales_of, with_corrected_records
from snrmjax.diagnose.misfit.reference import with_reference
from snrmjax.diagnose.misfit.weighted_misfit import weighted_misfit

pytestmark = pytest.mark.usefixtures("optimised")  # searches run for longer than they compile
RATIO, NOISE = 0.002, 0.003
GAIN, PHASE = np.array([0.15, -0.1, 0.08, -0.12, 0.05]), np.radians([3.0, -2.0, 1.0, -3.0, 2.0])


def hardening(stiffening, gain=GAIN, phase=PHASE, stiffer=0 * GAIN, noise=0.0):
    """Single-harmonic states with ω̃² larger by a fraction at the top level, and level errors.

    `stiffer` are relative deviations of the levels' linear stiffness; dashpots are all the same.
    The force that a motion needs is known in closed form: nothing is solved.
    """
    rng = np.random.default_rng(3)
    rows = []
    for level, tip in enumerate(np.geomspace(1e-3, 2e-4, len(gain))):
        for theta in np.radians(np.linspace(-60, 60, 9)):
            x = tip * np.cos(theta)
            squared = OMEGA**2 * (1 + stiffer[level] + stiffening * (x / 1e-3) ** 2)
            omega = np.sqrt(squared) * (1 - RATIO * np.tan(theta))
            needed = squared - omega**2 + 2j * RATIO * OMEGA * omega
            error = np.exp(gain[level] + 1j * phase[level])
            velocity = 1j * omega * x * np.exp(-1j * np.angle(needed)) * error
            rows.append((level, omega, abs(needed) * x / (SHAPE * PARTICIPATION), velocity))
    level, omega, force, velocity = (np.array(column) for column in zip(*rows, strict=True))
    velocity = velocity * np.exp(noise * (rng.normal(size=(len(level), 2)) @ [1.0, 1j]))
    return sj.measure.steady_states(
        level.real.astype(int),
        omega.real,
        force.real,
        velocity,
        velocity_std=NOISE * np.abs(velocity),
        phase_std=np.full((len(level), 1), NOISE),
        force_std=0.1 * NOISE * force.real,
    )


def compared(data, **settings):
    """Predictions of one harmonic, with errors of levels as stated."""
    model = linear_model(damping=RATIO, level_gain_std=0.15, level_phase_std=0.05, **settings)
    return predictions_of(model, data, harmonics=1)


@pytest.mark.long
def test_large_level_errors_on_a_steep_curve_are_found():
    data = hardening(0.3)  # 75 bandwidths
    misfit = weighted_misfit(at_reference(with_reference(compared(data)), data))
    fit = fit_effect(misfit, candidate("cubic_stiffness", scales_of(misfit.predictions)))
    misfit, fit = refined(data, misfit, fit)
    # Without noise χ² is only that of the level errors: (0.15/0.15)² …
    assert fit.chi_square < 12.0
    added = likely_errors(misfit, fit.rows)
    level = np.asarray(misfit.predictions.chosen.states.level)
    gain = np.array([added[level == k, 1].mean() for k in range(5)])
    phase = np.array([added[level == k, 2].mean() for k in range(5)])
    # A common gain cannot be separated from coefficient and force: compare differences.
    np.testing.assert_allclose(gain - gain.mean(), -(GAIN - GAIN.mean()), atol=0.004)
    np.testing.assert_allclose(phase, -PHASE, atol=0.003)


def test_a_common_gain_is_a_level_error_as_long_as_level_errors_are_as_large():
    """A common gain of 10 %, with level errors of 15 % (1σ) and steep curves."""
    data = hardening(0.3, gain=GAIN + 0.1, noise=NOISE)
    kinds = ("cubic_stiffness", "sensor_gain_error", "force_gain_error", "added_mass")
    found = named_parts(compared(data), data, kinds).naming
    assert found.effects == ("cubic_stiffness",)
    assert found.misfit < 1.2
    assert next(iter(found.answers)) == ("cubic_stiffness",)
    assert found.answers["cubic_stiffness",] > 0.88  # e² over all others


def test_errors_move_the_force_as_the_true_curve_does():
    """Slopes of K(a) − Ω² + iΩδ by log amplitude, over it, at the motion that was there."""
    data = hardening(0.3, noise=NOISE)
    predictions = with_reference(compared(data))
    reference = predictions.reference
    level = np.asarray(predictions.chosen.states.level)[reference.rows]
    omega, recorded = np.asarray(data.frequency), np.asarray(data.velocity)[:, 0]
    x = np.abs(recorded) / np.exp(GAIN[level]) / omega
    squared = OMEGA**2 * (1 + 0.3 * (x / 1e-3) ** 2)
    needed = squared - omega**2 + 2j * RATIO * OMEGA * omega
    wanted = 1 + 2 * (squared - OMEGA**2) / needed
    off = np.abs(reference.by_velocity - wanted) / np.abs(wanted)
    # The common gain of the levels is unknown: its effect on the amplitude counts twice.
    assert np.median(off) < 0.1
    # Level phases, up to 3°, do not rotate it. At the end of the curves, the largest level (first),
    # phase and damping depend on this level alone.
    rotation = np.angle(reference.by_velocity / wanted)
    middle = np.array([np.median(rotation[level == k]) for k in range(1, 5)])
    assert np.max(np.abs(middle)) < np.radians(1.0)


@pytest.mark.parametrize("kind", [None, "sensor_gain_error", "linear_frequency_shift"])
def test_errors_do_not_explain_an_answer_that_is_wrong(kind):
    data = hardening(0.3)
    misfit = weighted_misfit(at_reference(with_reference(compared(data)), data))
    fit = baseline_fit(misfit)
    if kind is not None:
        fit = fit_effect(misfit, candidate(kind, scales_of(misfit.predictions)))
    _, fit = refined(data, misfit, fit)
    assert fit.chi_square > 1e4  # of 90 rows


@pytest.mark.parametrize(
    "level_errors",
    [
        {"level_gain_std": 0.15, "level_phase_std": 0.05, "level_frequency_std": 0.01 * OMEGA},
        {},
    ],
)
def test_a_linear_structure_with_errors_of_levels_lacks_nothing(level_errors):
    model = linear_model(damping=RATIO, damping_std=0.2 * RATIO, **level_errors)
    stiffer = 0.02 * np.array([1.0, -0.7, 0.4, -1.2, 0.3])
    found = sj.diagnose_model(model, hardening(0.0, stiffer=stiffer, noise=NOISE))
    assert found.verdict == "none"
    assert next(iter(found.probabilities)) == "none"


def test_an_error_of_the_only_level_is_no_defect_of_the_instruments():
    """Level phase errors are unstated: 0.25° is less than levels usually differ by."""
    data = hardening(0.0, gain=[0.0], phase=[np.radians(-0.25)], stiffer=[0.0], noise=5e-4)
    error = 5e-4 * np.abs(np.asarray(data.velocity))
    data = dataclasses.replace(data, velocity_std=error, phase_std=np.full_like(error, 5e-4))
    level_errors = {
        "level_gain_std": 0.01,
        "level_frequency_std": 1e-3 * OMEGA,
        "level_damping_std": 0.05 * RATIO,
    }
    model = linear_model(damping=RATIO, damping_std=0.2 * RATIO, **level_errors)
    found = sj.diagnose_model(model, data)
    assert found.verdict == "none"
    assert found.gap.after < 1.3  # the level's own phase counts among its errors


def test_uncorrected_records_have_no_offset():
    data = hardening(0.05)
    predictions = with_reference(compared(data))
    there = weighted_misfit(at_reference(predictions, data))
    assert np.max(np.abs(there.predictions.added)) > 0.05
    none = np.zeros_like(there.predictions.added)
    back = without_errors(there, baseline_fit(there), data, none)
    assert np.all(back.predictions.offset == 0)
    plain = weighted_misfit(predictions)
    np.testing.assert_allclose(back.baseline.columns, plain.baseline.columns, rtol=1e-6, atol=1e-9)


def test_corrections_rotate_harmonics_as_time_shifts():
    data = hardening(0.0)
    n = data.n_states
    harmonics = np.full((n, 1, 2), 0.1 + 0.05j) * np.abs(np.asarray(data.velocity))[:, :, None]
    data = dataclasses.replace(
        data,
        harmonics=harmonics,
        harmonic_order=(2, 3),
        harmonic_std=np.full((n, 1), 1e-4),
    )
    added = np.tile([0.0, 0.1, 0.02], (n, 1))
    new = with_corrected_records(data, np.arange(n), (0,), added)
    np.testing.assert_allclose(new.velocity, data.velocity * np.exp(0.1 + 0.02j), rtol=1e-12)
    for k, order in enumerate((2, 3)):
        rotation = harmonics[..., k] * np.exp(0.1 + 0.02j * order)
        np.testing.assert_allclose(new.harmonics[..., k], rotation, rtol=1e-12)


def with_noise_as_harmonics(data, seed=5):
    """Harmonics 2 and 3 of a linear structure: nothing but noise of the stated level."""
    rng = np.random.default_rng(seed)
    n = data.n_states
    std = 0.005 * np.max(np.abs(data.velocity))
    noise = rng.normal(size=(n, 1, 2, 2)) @ [1.0, 1j] * std / np.sqrt(2)
    return dataclasses.replace(
        data, harmonics=noise, harmonic_order=(2, 3), harmonic_std=np.full((n, 1), std)
    )


def test_level_errors_act_on_harmonics_and_not_on_their_noise():
    """A linear structure has no harmonics, so that no gain and no phase can change them."""
    predictions = predictions_of(
        linear_model(damping=RATIO), with_noise_as_harmonics(hardening(0.0))
    )
    by_error, _ = predictions.by_error(predictions.group.values)
    assert by_error.shape[1:] == (6, 3)
    assert np.max(np.abs(by_error[:, :2])) > 0.5
    # Finite differences have a second-order error of the noise: at most 0.2 times a small step.
    np.testing.assert_allclose(by_error[:, 2:], 0.0, atol=2e-5)


@pytest.mark.long
def test_a_gain_with_level_errors_does_not_explain_the_noise_of_harmonics():
    """Level errors as large as −100 % would, and then noise far below the stated."""
    data = hardening(0.0, gain=0 * GAIN + np.log(0.88), phase=0 * PHASE, noise=NOISE)
    found = sj.diagnose_model(
        linear_model(damping=RATIO, damping_std=0.05 * RATIO), with_noise_as_harmonics(data)
    )
    assert found.verdict in ("named", "ambiguous")
    assert {"sensor_gain_error", "force_gain_error"} & set(found.candidates[0])
    assert found.probabilities["noise_rejected"] < 0.01
