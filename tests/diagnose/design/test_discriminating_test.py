"""The recommended measurement decides: against closed forms of damped linear modes.

The states are those of `truths.growing_damping`.
"""

import numpy as np
import pytest
from truths.growing_damping import (
    OMEGA,
    PARTICIPATION,
    PHASES,
    SHAPE,
    THIRD,
    linear_model,
    measured,
)

import snrmjax as sj
from snrmjax.diagnose.design.design_points import (
    DesignPoints,
    Rows,
    predicted_test,
    refitted_chi_square,
    shared_by_both,
)
from snrmjax.diagnose.design.discriminating_test import (
    DiscriminatingTest,
    discriminating_test,
    recommendation,
)
from snrmjax.diagnose.fitted_effects import FittedEffects
from snrmjax.diagnose.misfit.candidates import candidate, only_by_calibration
from snrmjax.diagnose.misfit.effect_fit import baseline_fit, fit_effect
from snrmjax.diagnose.misfit.noise_model import shared_covariance
from snrmjax.diagnose.misfit.predictions import predictions_of, scales_of
from snrmjax.diagnose.misfit.weighted_misfit import weighted_misfit
from snrmjax.io.diagnosis_results import summarise_diagnosis
from snrmjax.numerics.facts import Fact


@pytest.fixture(scope="module")
def ambiguous():
    return sj.diagnose_model(linear_model(), measured())


def test_a_sum_of_squares_is_refitted_with_all_that_is_free():
    rng = np.random.default_rng(0)
    rows = Rows(rng.normal(size=30), rng.normal(size=(30, 2)) * [1e6, 1e-3])
    shared = rng.normal(size=(30, 4))
    # The same by one regression: shared errors are parameters that were measured as zero.
    matrix = np.block([[rows.slopes / [1e6, 1e-3], shared], [np.zeros((4, 2)), np.eye(4)]])
    left = np.linalg.lstsq(matrix, np.append(rows.left, np.zeros(4)))[1]
    covariance = shared_covariance(shared)
    assert refitted_chi_square(rows, covariance) == pytest.approx(left[0], rel=1e-9)
    # A misfit along a free parameter costs nothing.
    assert refitted_chi_square(Rows(rows.slopes[:, 0], rows.slopes), covariance) < 1e-9


def fitted(*rivals):
    """The first of some effects as the answer, with the others as its rivals."""
    predictions = predictions_of(linear_model(), measured())
    misfit, scales = weighted_misfit(predictions), scales_of(predictions)
    nothing = baseline_fit(misfit)
    fits = [fit_effect(misfit, candidate(kind, scales)) for kind in rivals]
    return FittedEffects(misfit, fits[0], nothing, tuple(fits[1:]), (rivals,))


def test_a_common_force_gain_is_shared_by_both_tests():
    predictions = predictions_of(linear_model(), measured(), force_gain_std=0.2)
    first, further = weighted_misfit(predictions), weighted_misfit(predictions)
    kept = np.arange(further.n_rows) < 6
    shared = shared_by_both(first, further, kept)
    by_gain = shared[:, predictions.n_baseline_errors - 1]
    assert np.max(np.abs(by_gain[: first.n_rows])) > 1.0
    np.testing.assert_array_equal(by_gain[: first.n_rows], first.noise.shared[:, -1])
    np.testing.assert_array_equal(by_gain[first.n_rows :], further.noise.shared[kept][:, -1])


def test_design_points_obey_the_law_that_predicts_them():
    answer = fitted("cubic_damping")
    (coefficient,) = answer.fit.values
    phase = np.radians([-50.0, -10.0, 30.0])
    test = predicted_test(answer.misfit, answer.fit, (DesignPoints(4, 2.0, phase),), 1e-3)
    states = test.misfit.predictions.chosen.states
    omega, velocity = np.asarray(states.frequency), np.asarray(states.velocity)[:, 0]
    np.testing.assert_allclose(np.angle(velocity), phase, atol=2e-3)
    speed = np.abs(velocity) / SHAPE
    tip = np.max(np.abs(np.asarray(measured().velocity)[4 * len(PHASES) :, 0])) / SHAPE
    assert speed[1] == pytest.approx(2 * tip * np.cos(phase[1]), rel=0.03)
    own = answer.misfit.baseline_parameters(answer.fit.rows)
    natural, ratio = (own[f"mode_1.{name}"] for name in ("natural_frequency", "damping_ratio"))
    damping = 2 * ratio * natural + 0.75 * coefficient * speed**2
    needed = (natural**2 - omega**2 + 1j * omega * damping) * speed / omega / PARTICIPATION
    # 5e-3: effect of a third harmonic of 1 % on the fundamental.
    np.testing.assert_allclose(np.asarray(states.force), np.abs(needed), rtol=5e-3)
    # 0.08: the damping of the third harmonic itself, three times 8 % of 8, and twice.
    third = np.asarray(states.harmonics)[:, 0, 1] / np.abs(velocity)
    wanted = THIRD["cubic_damping"] * 0.75 * coefficient * speed**2 / omega
    np.testing.assert_allclose(third, wanted * np.exp(3j * np.angle(velocity)), rtol=0.08)


def test_the_expected_gain_is_that_of_the_closed_form(ambiguous):
    test = ambiguous.discriminating_test
    assert set(ambiguous.candidates[0]) == set(THIRD)
    assert (test.kind, test.quantity, test.harmonics) == ("harmonics", "harmonic 3", (3,))
    assert test.operating_point.level == 4
    x = np.abs(np.asarray(measured().velocity)[4 * len(PHASES) :, 0]) / SHAPE / OMEGA
    coefficient, _ = ambiguous.parameters["cubic_damping.coefficient"]
    growth = 0.75 * coefficient * OMEGA**2
    apart = 0.5 * growth * x**3 * SHAPE  # V₃ of both differs by Δδ/2Ω
    expected = np.sum(apart**2) / (test.harmonic_std**2 / 2)
    # 0.05: refit of the rival, and the variation of Ω off resonance.
    assert test.expected_gain == pytest.approx(expected, rel=0.05)
    assert test.settles
    assert "harmonic 3" in ambiguous.decide_by
    summary = summarise_diagnosis(ambiguous)["request"]
    assert summary["kind"] == "harmonics"
    assert summary["force_n"] == pytest.approx(test.operating_point.force)


@pytest.mark.parametrize("truth", list(THIRD))
def test_the_recommended_measurement_leaves_the_truth(ambiguous, truth):
    test = ambiguous.discriminating_test
    data = measured(truth, test.harmonic_std, (test.operating_point.level,))
    answer = sj.diagnose_model(linear_model(), data)
    assert answer.candidates == ((truth,),)


def test_where_no_measurement_would_decide_this_is_reported():
    answer = fitted(*THIRD)
    test = discriminating_test(answer, (0,))
    weak = test._replace(expected_gain=0.5 * test.needed_gain)
    asked = recommendation(answer, weak, phases=True)["measurements"]
    assert asked == (Fact("no_test_settles"), test.measurement)
    assert recommendation(answer, test, phases=True)["measurements"] == asked[1:]


def test_what_no_test_of_one_mode_separates_needs_a_calibration():
    gains = {"force_gain_error", "sensor_gain_error"}
    assert only_by_calibration(gains | {"cubic_stiffness", "added_mass"}) == gains
    assert not only_by_calibration(("gap_stiffness", "one_sided_stop"))
    assert DiscriminatingTest("calibration").settles
