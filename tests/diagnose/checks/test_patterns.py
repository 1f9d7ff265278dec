"""What is left of a fit to a linear mode whose natural frequency does what a test makes it do."""

from types import SimpleNamespace

import numpy as np
import pytest
from truths.made_up_misfits import noise_of

from snrmjax.diagnose.checks.residuals import left_curve, pattern
from snrmjax.diagnose.misfit.effect_fit import EffectFit

LEVELS, PER_LEVEL, DAMPING = 5, 16, 0.01
N = LEVELS * PER_LEVEL
LEVEL = np.repeat(np.arange(LEVELS), PER_LEVEL)
ANGLE = np.tile(np.linspace(-1.0, 1.0, PER_LEVEL), LEVELS)  # phase of the velocity
SIZE = 1.6**LEVEL * np.cos(ANGLE)
ORDER = np.linspace(0.0, 1.0, N)
AMPLITUDE_STD, PHASE_STD = 0.01, np.radians(0.7)


def misfit_of(phase_unknown=False):
    """A mode of unit frequency: K = 1 − Ω² + 2iζΩ, and what its errors make of K over noise.

    A velocity with an error ε + iφ needs the force K(1 + ε + iφ): whitening divides by K, and
    by the two errors' 1σ.
    """
    omega = 1 - DAMPING * np.tan(ANGLE)  # the velocity leads below resonance
    stiffness = 1 - omega**2 + 2j * DAMPING * omega
    whiten = np.zeros((N, 2, 2))
    inverse = 1 / stiffness
    whiten[:, 0, 0], whiten[:, 0, 1] = inverse.real, -inverse.imag
    whiten[:, 1, 0], whiten[:, 1, 1] = inverse.imag, inverse.real
    whiten = np.array([1 / AMPLITUDE_STD, 1 / PHASE_STD])[:, None] * whiten
    # One unit of ω₀² adds 1, one of damping adds iΩ.
    parts = np.stack([np.ones(N), 1j * omega], axis=1)
    by_linear = np.einsum("sij,jsk->sik", whiten, np.stack([parts.real, parts.imag]))
    shared = 0.002 * by_linear.reshape(2 * N, 2)[:, :1]  # of the linear test
    velocity = (SIZE * np.exp(1j * ANGLE))[:, None]
    chosen = SimpleNamespace(
        states=SimpleNamespace(level=LEVEL, velocity=velocity),
        rows=np.arange(N),
        n_levels=LEVELS,
        phase_unknown=np.full((N, 1), phase_unknown),
    )
    return SimpleNamespace(
        noise=noise_of(whiten, shared),
        predictions=SimpleNamespace(chosen=chosen),
        level_numbers=np.arange(1, LEVELS + 1),
        by_linear=by_linear.reshape(2 * N, 2),
        n_rows=2 * N,
    )


def noise(seed=0):
    return np.random.default_rng(seed).normal(size=2 * N)


def changed(misfit, law, part=0):
    """Of a change of the square of the natural frequency (part 0) or of the damping (1)."""
    return misfit.by_linear[:, part] * np.repeat(law, 2)


def fitted(misfit, rows, law, part=0):
    """What is left when so much of a law is taken as fits."""
    slopes = changed(misfit, law, part)[:, None]
    left, arms = misfit.noise.decorrelated(rows), misfit.noise.decorrelated(slopes.T).T
    rows = rows - slopes @ np.linalg.lstsq(arms, left)[0]
    bounds = np.full(1, np.inf)
    square = float(np.sum(misfit.noise.decorrelated(rows) ** 2))
    return EffectFit(("law",), (), np.zeros(1), square, rows, slopes, -bounds, bounds)


@pytest.mark.parametrize("size", [0.5, 1.0, 4.0])
def test_noise_of_any_size_has_no_pattern(size):
    misfit = misfit_of()
    for seed in range(8):
        fit = fitted(misfit, size * noise(seed), SIZE**2)
        assert pattern(misfit, fit) is None
        assert left_curve(misfit, fit) is None


def test_a_natural_frequency_that_jumps_is_no_drift():
    misfit = misfit_of()
    drift = noise() + changed(misfit, 1e-3 * ORDER)
    assert left_curve(misfit, fitted(misfit, drift, ORDER)) is None
    jump = noise() + changed(misfit, 1e-3 * (ORDER > 0.5))
    assert left_curve(misfit, fitted(misfit, jump, ORDER))["curve"] == "order"


@pytest.mark.parametrize(("part", "name"), [(0, "stiffness"), (1, "damping")])
def test_a_law_of_another_power_leaves_a_curve_of_amplitude(part, name):
    misfit, share = misfit_of(), SIZE / SIZE.max()
    rows = noise() + changed(misfit, 3e-3 * share**4, part)
    assert left_curve(misfit, fitted(misfit, rows, share**4, part)) is None
    assert left_curve(misfit, fitted(misfit, rows, share**2, part))["curve"] == name


def test_what_the_answer_itself_could_still_do_is_no_curve():
    """A fit a little away from its best is no other law."""
    misfit = misfit_of()
    fit = fitted(misfit, noise(), SIZE**2)
    away = fit._replace(rows=fit.rows + changed(misfit, 2e-3 * (SIZE / SIZE.max()) ** 2))
    assert left_curve(misfit, away) is None
    assert left_curve(misfit, away._replace(slopes=np.zeros((2 * N, 0)))) is not None


def test_states_at_temperatures_of_their_own_are_no_noise():
    """Every state has a natural frequency of its own: misfits have one direction."""
    misfit = misfit_of()
    scatter = np.random.default_rng(5).normal(size=N)
    rows = noise() + changed(misfit, 1e-3 * scatter)
    reason = pattern(misfit, fitted(misfit, rows, SIZE**2))
    assert reason.kind == "states_wander"
    # The same number of misfits as large, in all directions, is noise.
    large = float(np.sqrt(np.mean(rows**2)))
    assert pattern(misfit, fitted(misfit, large * noise(1), SIZE**2)) is None


def test_curves_are_not_asked_of_sizes():
    misfit = misfit_of(phase_unknown=True)
    rows = noise() + changed(misfit, 1e-3 * (ORDER > 0.5))
    assert left_curve(misfit, fitted(misfit, rows, ORDER)) is None
