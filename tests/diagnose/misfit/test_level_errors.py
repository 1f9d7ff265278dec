"""Hypotheses compared with records that are corrected for errors: levels far off, steep curves."""

import dataclasses

import numpy as np
import pytest
from truths.balanced_sets import OMEGA, PARTICIPATION, SHAPE, linear_model

import snrmjax as sj
from snrmjax.diagnose.misfit.candidates import candidate
from snrmjax.diagnose.misfit.effect_fit import baseline_fit, fit_effect
from snrmjax.diagnose.misfit.level_errors import (
    FARTHEST,
    at_likely_errors,
    at_records,
    at_reference,
    likely_errors,
    with_corrected_records,
)
from snrmjax.diagnose.misfit.predictions import predictions_of, scales_of
from snrmjax.diagnose.misfit.reference import with_reference
from snrmjax.diagnose.misfit.weighted_misfit import weighted_misfit
from snrmjax.diagnose.search.model_search import refitted

RATIO, NOISE = 0.002, 0.003
GAIN, PHASE = np.array([0.15, -0.1, 0.08, -0.12, 0.05]), np.radians([3.0, -2.0, 1.0, -3.0, 2.0])


def hardening(stiffening, gain=GAIN, phase=PHASE):
    """States of one harmonic whose ω̃² grows by a share at the top level, and levels' errors.

    The force that a motion needs is known in closed form: nothing is solved, and there is no noise.
    """
    rows = []
    for level, tip in enumerate(np.geomspace(2e-4, 1e-3, 5)):
        for theta in np.radians(np.linspace(-60, 60, 9)):
            x = tip * np.cos(theta)
            squared = OMEGA**2 * (1 + stiffening * (x / 1e-3) ** 2)
            omega = np.sqrt(squared) * (1 - RATIO * np.tan(theta))
            needed = squared - omega**2 + 2j * RATIO * OMEGA * omega
            error = np.exp(gain[level] + 1j * phase[level])
            velocity = 1j * omega * x * np.exp(-1j * np.angle(needed)) * error
            rows.append((level, omega, abs(needed) * x / (SHAPE * PARTICIPATION), velocity))
    level, omega, force, velocity = (np.array(column) for column in zip(*rows, strict=True))
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


def corrected(misfit, fit, data):
    """A fit where nothing moves any more."""
    scales = scales_of(misfit.predictions)
    for _ in range(8):
        straight, _, _ = at_likely_errors(misfit, fit, data)
        if straight is misfit:
            return misfit, fit
        misfit, fit = straight, refitted(straight, scales, fit)
    raise AssertionError("errors still move")


def test_large_errors_of_levels_beside_a_steep_curve_are_found():
    data = hardening(0.3)  # 75 bandwidths
    predictions = with_reference(compared(data))
    predictions = at_reference(weighted_misfit(predictions), data)
    misfit = weighted_misfit(predictions)
    fit = fit_effect(misfit, candidate("cubic_stiffness", scales_of(predictions)))
    misfit, fit = corrected(misfit, fit, data)
    # Without noise only the levels' errors cost: (0.15/0.15)² …, and what they have in common.
    assert fit.chi_square < 12.0
    added = likely_errors(misfit, fit.rows)
    level = np.asarray(misfit.predictions.chosen.states.level)
    gain = np.array([added[level == k, 1].mean() for k in range(5)])
    phase = np.array([added[level == k, 2].mean() for k in range(5)])
    # A gain that all share is one with the coefficient and the force: only differences are seen.
    np.testing.assert_allclose(gain - gain.mean(), -(GAIN - GAIN.mean()), atol=0.004)
    np.testing.assert_allclose(phase, -PHASE, atol=0.003)


@pytest.mark.parametrize("stated", [True, False])
def test_a_linear_structure_with_errors_of_levels_lacks_nothing(stated):
    sizes = {"level_gain_std": 0.15, "level_phase_std": 0.05} if stated else {}
    model = linear_model(damping=RATIO, damping_std=0.2 * RATIO, **sizes)
    data, rng = hardening(0.0), np.random.default_rng(3)
    noise = NOISE * (rng.normal(size=(data.n_states, 2)) @ [1.0, 1j])
    data = dataclasses.replace(data, velocity=data.velocity * np.exp(noise)[:, None])
    found = sj.diagnose_model(model, data)
    assert found.verdict == "none"
    assert next(iter(found.probabilities)) == "none"


def test_a_law_that_is_wrong_is_not_explained_by_errors():
    data = hardening(0.3)
    misfit = weighted_misfit(compared(data))
    fit = baseline_fit(misfit)
    for _ in range(8):
        straight, moved, largest = at_likely_errors(misfit, fit, data)
        if straight is misfit:
            break
        misfit, fit = straight, baseline_fit(straight)
    assert largest > FARTHEST or moved > 0.02 or fit.chi_square > 1e3


def test_records_as_they_are_carry_nothing_over():
    data = hardening(0.05)
    predictions = with_reference(compared(data))
    there = weighted_misfit(at_reference(weighted_misfit(predictions), data))
    assert np.max(np.abs(there.predictions.added)) > 0.05
    back = at_records(there, baseline_fit(there), data)
    assert np.all(back.predictions.added == 0)
    assert np.all(back.predictions.offset == 0)
    plain = weighted_misfit(predictions)
    np.testing.assert_allclose(back.baseline.columns, plain.baseline.columns, rtol=1e-6, atol=1e-9)


def test_corrections_turn_harmonics_as_errors_of_time():
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
        turned = harmonics[..., k] * np.exp(0.1 + 0.02j * order)
        np.testing.assert_allclose(new.harmonics[..., k], turned, rtol=1e-12)
