"""The measurement that is asked for would settle it: against closed forms of damped linear modes.

Cubic damping c q̇³ and van der Pol's c q²q̇ with one Δδ = ¾cΩ²Q² = cQ²/4 do the same to a
fundamental. Their forces have third harmonics of ¼cΩ³Q³ and ¼cΩQ³, of opposite sign: to first order
|V₃/V₁| = Δδ/8Ω and 3Δδ/8Ω, ahead and behind by a quarter of the phase of V₁ thrice.
"""

import numpy as np
import pytest

import snrmjax as sj
from snrmjax.diagnose.design.design_points import (
    DesignPoints,
    Rows,
    predicted_test,
    refitted_chi_square,
)
from snrmjax.diagnose.design.discriminating_test import DiscriminatingTest, discriminating_test
from snrmjax.diagnose.design.recommendation import recommendation
from snrmjax.diagnose.misfit.candidates import only_by_calibration
from snrmjax.diagnose.misfit.predictions import predictions_of, scales_of
from snrmjax.diagnose.misfit.weighted_misfit import weighted_misfit
from snrmjax.diagnose.search.model_search import find_effects
from snrmjax.io.diagnosis_results import summarise_diagnosis

SHAPE, PARTICIPATION, OMEGA, ZETA = 2.0, 3.0, 300.0, 0.01
NOISE = {"velocity": 0.01, "phase": 0.012, "force": 0.003}
GROWTH = 6e6  # Δδ over Q², 1/s and kg^1/2 m
THIRD = {"cubic_damping": 1j / 8, "van_der_pol_damping": -3j / 8}  # V₃/V₁ over Δδ/Ω
PHASES = np.radians(np.linspace(-55, 55, 9))
TIPS = np.geomspace(1e-4, 1e-3, 5)  # Q at resonance


def linear_model():
    modes = sj.model.linear_modes(
        [OMEGA],
        [ZETA],
        [[SHAPE]],
        [PARTICIPATION],
        std=sj.model.LinearModesStd([1e-4 * OMEGA], [0.01 * ZETA]),
    )
    return sj.model.structure(modes)


def measured(kind=None, harmonic_std=np.nan, harmonics_at=(), seed=0):
    """States of a linear mode with δ = 2ζω₀ + GROWTH·Q², harmonic 3 at some levels, and noise."""
    rng = np.random.default_rng(seed)
    level, phase = (a.ravel() for a in np.meshgrid(np.arange(5), PHASES, indexing="ij"))
    x = TIPS[level] * np.cos(phase)
    omega = OMEGA * (1 - ZETA * np.tan(phase))
    growth = GROWTH * x**2
    needed = OMEGA**2 - omega**2 + 1j * omega * (2 * ZETA * OMEGA + growth)
    force = np.abs(needed) * x / PARTICIPATION
    exact = 1j * omega * x * np.exp(-1j * np.angle(needed)) * SHAPE
    n = len(level)
    own = np.exp(NOISE["velocity"] * rng.normal(size=n) + 1j * NOISE["phase"] * rng.normal(size=n))
    velocity = exact * own
    third = np.zeros(n, dtype=complex)
    if kind is not None:
        turn = np.exp(3j * np.angle(exact))
        third = THIRD[kind] * growth / omega * np.abs(exact) * turn * own**3 / np.abs(own) ** 2
        third = third + harmonic_std / np.sqrt(2) * (rng.normal(size=n) + 1j * rng.normal(size=n))
    seen = np.isin(level, harmonics_at)
    second = harmonic_std / np.sqrt(2) * (rng.normal(size=n) + 1j * rng.normal(size=n))
    return sj.measure.steady_states(
        level,
        omega,
        force * np.exp(NOISE["force"] * rng.normal(size=n)),
        velocity,
        velocity_std=NOISE["velocity"] * np.abs(velocity),
        phase_std=np.full(n, NOISE["phase"]),
        force_std=NOISE["force"] * force,
        harmonics=np.stack([second, third], axis=1)[:, None] if kind else None,
        harmonic_std=np.where(seen, harmonic_std, np.nan),
        harmonic_order=(2, 3) if kind else (),
    )


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
    assert refitted_chi_square(rows, shared) == pytest.approx(left[0], rel=1e-9)
    # What a parameter can do by itself costs nothing.
    assert refitted_chi_square(Rows(rows.slopes[:, 0], rows.slopes), shared) < 1e-9


def test_design_points_obey_the_law_that_predicts_them():
    predictions = predictions_of(linear_model(), measured())
    misfit, scales = weighted_misfit(predictions), scales_of(predictions)
    found = find_effects(misfit, scales, ("cubic_damping",))
    (size,) = found.fit.values
    phase = np.radians([-50.0, -10.0, 30.0])
    test = predicted_test(found.misfit, found.fit, (DesignPoints(4, 2.0, phase),), 1e-3)
    states = test.misfit.predictions.chosen.states
    omega, velocity = np.asarray(states.frequency), np.asarray(states.velocity)[:, 0]
    np.testing.assert_allclose(np.angle(velocity), phase, atol=2e-3)
    speed = np.abs(velocity) / SHAPE
    tip = np.max(np.abs(np.asarray(measured().velocity)[4 * len(PHASES) :, 0])) / SHAPE
    assert speed[1] == pytest.approx(2 * tip * np.cos(phase[1]), rel=0.03)
    own = found.misfit.baseline_parameters(found.fit.rows)
    natural, ratio = (own[f"mode_1.{name}"] for name in ("natural_frequency", "damping_ratio"))
    damping = 2 * ratio * natural + 0.75 * size * speed**2
    needed = (natural**2 - omega**2 + 1j * omega * damping) * speed / omega / PARTICIPATION
    # 5e-3: what a third harmonic of 1 % does to the fundamental.
    np.testing.assert_allclose(np.asarray(states.force), np.abs(needed), rtol=5e-3)
    # 0.08: the damping of the third harmonic itself, three times 8 % of 8, and twice.
    third = np.asarray(states.harmonics)[:, 0, 1] / np.abs(velocity)
    wanted = THIRD["cubic_damping"] * 0.75 * size * speed**2 / omega
    np.testing.assert_allclose(third, wanted * np.exp(3j * np.angle(velocity)), rtol=0.08)


def test_the_expected_gain_is_that_of_the_closed_form(ambiguous):
    test = ambiguous.discriminating_test
    assert set(ambiguous.candidates[0]) == set(THIRD)
    assert (test.kind, test.quantity, test.harmonics) == ("harmonics", "harmonic 3", (3,))
    assert test.place.level == 4
    x = np.abs(np.asarray(measured().velocity)[4 * len(PHASES) :, 0]) / SHAPE / OMEGA
    size, _ = ambiguous.parameters["cubic_damping.coefficient"]
    growth = 0.75 * size * OMEGA**2
    apart = 0.5 * growth * x**3 * SHAPE  # V₃ of both differs by Δδ/2Ω
    expected = np.sum(apart**2) / (test.harmonic_std**2 / 2)
    # 0.05: what the rival gives way, and Ω that is another one off resonance.
    assert test.expected_gain == pytest.approx(expected, rel=0.05)
    assert test.settles
    assert "harmonic 3" in ambiguous.decide_by
    summary = summarise_diagnosis(ambiguous)["request"]
    assert summary["kind"] == "harmonics"
    assert summary["force_n"] == pytest.approx(test.place.force)


@pytest.mark.parametrize("truth", list(THIRD))
def test_the_measurement_that_was_asked_for_leaves_the_truth(ambiguous, truth):
    asked = ambiguous.discriminating_test
    data = measured(truth, asked.harmonic_std, (asked.place.level,))
    found = sj.diagnose_model(linear_model(), data)
    assert found.candidates == ((truth,),)


def test_where_no_measurement_would_settle_it_that_is_said():
    predictions = predictions_of(linear_model(), measured())
    found = find_effects(weighted_misfit(predictions), scales_of(predictions), tuple(THIRD))
    test = discriminating_test(found, (0,))
    weak = test._replace(expected_gain=0.5 * test.needed_gain)
    said = recommendation(found, weak, [], phases=True)
    assert said.startswith("No single test")
    assert test.sentence in said
    assert "No single" not in recommendation(found, test, [], phases=True)


def test_what_no_test_of_one_mode_separates_needs_a_calibration():
    gains = {"force_gain_error", "sensor_gain_error"}
    assert only_by_calibration(gains | {"cubic_stiffness", "added_mass"}) == gains
    assert not only_by_calibration(("gap_stiffness", "one_sided_stop"))
    assert DiscriminatingTest("calibration", "").settles
