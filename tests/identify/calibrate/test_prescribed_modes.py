"""Motions of several modes prescribed as measured: coefficients of an independent balance."""

import numpy as np
import pytest
from truths.two_modes import steady_states, structure

import snrmjax as sj

TERMS = {(4, 0): 2e4, (3, 1): 1.5e4, (2, 2): 3e4}
KEYS = ("1111", "1112", "1122")
NAMES = [f"potential.{key}" for key in KEYS]


@pytest.mark.parametrize(
    "sensors", [pytest.param(("a", "b"), marks=pytest.mark.long), ("a",)], ids=["two", "one"]
)
def test_coefficients_are_recovered(sensors):
    data = steady_states(TERMS, sensors=sensors)
    fit = sj.calibrate_model(
        structure(KEYS, sensors), data, NAMES, prescribed_modes=(0, 1), harmonic_order=5
    )
    # Both balances have five harmonics; the states are exact to what `fsolve` leaves.
    np.testing.assert_allclose(fit.values, list(TERMS.values()), rtol=1e-5)
    assert fit.state_converged.all()


def test_stated_errors_are_those_of_the_coefficients():
    standardised = []
    for seed in range(6):
        # The second mode moves little more than its noise: errors in variables.
        data = steady_states(TERMS, noise=5e-3, seed=seed, forces=(0.5, 1.0))
        fit = sj.calibrate_model(
            structure(KEYS), data, NAMES, prescribed_modes=(0, 1), harmonic_order=5
        )
        standardised.append((fit.values - np.array(list(TERMS.values()))) / fit.std)
        # 14 states of 2 sensors and 4 orders: 1σ of the reduced χ² is 0.1.
        assert 0.7 < fit.reduced_chi_square < 1.4
    # The rms of 18 standardised errors, 3 independent per seed: 0.6 to 1.5 by chance.
    assert 0.6 < np.sqrt(np.mean(np.square(standardised))) < 1.5


def test_wrong_modes_are_refused():
    data, model = steady_states(TERMS), structure(KEYS)
    for wrong in ((0, 0), (2,)):
        with pytest.raises(ValueError, match="different modes from 0 to 1"):
            sj.calibrate_model(model, data, NAMES, prescribed_modes=wrong)
