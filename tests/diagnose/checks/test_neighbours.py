"""Noise from neighbouring states, for synthetic rows of known noise and order."""

import numpy as np
import pytest
from truths.made_up_misfits import (
    ANGLE,
    LEVELS,
    N_STATES,
    PER_LEVEL,
    fit_to,
    misfit_of,
    noise,
)

from snrmjax.diagnose.checks.residuals import neighbour_noise

# Neighbouring differences share states: about half as many are independent.
STD = np.sqrt(2 / (0.51 * 2 * LEVELS * (PER_LEVEL - 2)))


def test_the_order_of_rows_does_not_change_the_noise_of_neighbours():
    rows = noise() + 3 * np.repeat(np.sin(np.pi * ANGLE), 2)
    shuffled = np.random.default_rng(2).permutation(N_STATES)
    mixed = rows.reshape(-1, 2)[shuffled].reshape(-1)
    variance = neighbour_noise(misfit_of(shuffled), fit_to(mixed))
    assert variance == pytest.approx(neighbour_noise(misfit_of(), fit_to(rows)), rel=1e-12)
    assert variance == pytest.approx(1.0, abs=3 * STD)


def test_its_error_is_the_scatter_of_many_sets():
    variances = [neighbour_noise(misfit_of(), fit_to(noise(seed))) for seed in range(200)]
    assert np.std(variances) == pytest.approx(STD, rel=0.2)


def test_shared_errors_are_no_noise_of_neighbours():
    """A shared error ten times as large as the noise, that alternates from state to state."""
    alternating = np.repeat((-1.0) ** np.arange(N_STATES), 2)[:, None]
    rows = noise() + 10 * alternating[:, 0]
    shared = neighbour_noise(misfit_of(shared=10 * alternating), fit_to(rows))
    assert shared == pytest.approx(1.0, abs=3 * STD)
    assert neighbour_noise(misfit_of(), fit_to(rows)) > 100


def test_what_is_smooth_in_the_order_of_the_test_is_no_noise_where_phases_are_guessed():
    """Phases of a wrong model shuffle the states: neighbours then differ by more than noise."""
    shuffled = np.random.default_rng(3).permutation(PER_LEVEL)
    order = (np.arange(LEVELS)[:, None] * PER_LEVEL + shuffled).reshape(-1)
    smooth = 5 * np.repeat(np.tile(np.linspace(-1.0, 1.0, PER_LEVEL) ** 2, LEVELS), 2)
    fit = fit_to(smooth + noise())
    known, guessed = (misfit_of(order, phase_unknown=k) for k in (False, True))
    assert neighbour_noise(known, fit) > 2
    assert neighbour_noise(guessed, fit) == pytest.approx(1.0, abs=0.3)
    # Noise that is larger than stated is so in every order.
    assert neighbour_noise(guessed, fit_to(2 * noise())) == pytest.approx(4.0, rel=0.3)
