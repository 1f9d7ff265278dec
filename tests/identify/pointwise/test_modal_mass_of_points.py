"""The error of the modal mass in points and curves, and a mass that the states contradict."""

from pathlib import Path

import numpy as np
import pytest
from truths.exact_states import NOISE, OMEGA, PARTICIPATION, SHAPE, exact, noisy, stated

import snrmjax as sj
from snrmjax.identify.pointwise.curve_fit import linearised_on_host

MEASURED = Path(__file__).resolve().parents[4] / "shared" / "data" / "brake_reuss_beam"
WRONG, STD = 1.06, 0.03  # of the model's modal mass; its stated 1σ


def modes(mass=1.0, std=None):
    """The one mode with a modal mass so many times the true one."""
    told = None if std is None else sj.model.LinearModesStd(modal_mass=[std])
    return sj.model.linear_modes([OMEGA], [0.012], [[SHAPE]], [PARTICIPATION / mass], std=told)


def without_noise_stated(data):
    columns = (data.level, data.frequency, data.force, data.velocity)
    return sj.measure.steady_states(*(np.asarray(column) for column in columns))


def about_mass(found):
    return [note for note in found.notes if "modal mass" in note]


@pytest.fixture(scope="module")
def data():
    return noisy(3)


@pytest.fixture(scope="module")
def right(data):
    return sj.identify_backbone(data, modes())


@pytest.fixture(scope="module", params=["stated", "unstated"])
def pair(request, data, right):
    """Without and with a stated error of the modal mass; with noise stated and without."""
    if request.param == "stated":
        return right, sj.identify_backbone(data, modes(std=STD))
    data = without_noise_stated(data)
    return sj.identify_backbone(data, modes()), sj.identify_backbone(data, modes(std=STD))


def test_points_include_the_error_of_the_mass_as_a_model_with_that_mass_moves_them(pair):
    plain, told = pair
    away = 1e-4
    moved = sj.identify.identify_points(noisy(3), modes(1 + away))
    for name in ("natural_frequency", "damping_ratio"):
        values = np.asarray(getattr(plain.points, name))
        np.testing.assert_array_equal(np.asarray(getattr(told.points, name)), values)
        by_mass = (np.asarray(getattr(moved, name)) - values) / away
        own, all_ = (np.asarray(getattr(one.points, f"{name}_std")) for one in (plain, told))
        # The difference quotient's own error: half of 1e-4.
        np.testing.assert_allclose(np.sqrt(all_**2 - own**2), STD * abs(by_mass), rtol=2e-4)


def test_bands_of_curves_include_the_mass_undiminished_by_the_number_of_points(pair):
    plain, told = (found.fit.backbone for found in pair)
    at = np.linspace(float(plain.smallest), float(plain.largest), 20)
    before, after = plain.values(at), told.values(at)
    np.testing.assert_array_equal(after.natural_frequency, before.natural_frequency)
    np.testing.assert_array_equal(after.modal_damping, before.modal_damping)
    damping = np.sqrt(np.asarray(after.modal_damping_std) ** 2 - before.modal_damping_std**2)
    np.testing.assert_allclose(damping / before.modal_damping, STD, rtol=0.03)  # curves smooth
    # Off resonance only: states lie on both sides of it, where a wrong mass moves ω̃ oppositely.
    half_width = float(np.max(before.modal_damping)) / 2 * np.tan(np.radians(60))
    natural = np.sqrt(
        np.maximum(
            np.asarray(after.natural_frequency_std) ** 2 - before.natural_frequency_std**2, 0
        )
    )
    assert 0 < np.max(natural) < 0.5 * STD * half_width


def test_one_side_of_resonance_leaves_the_mass_in_the_frequency():
    level, omega, force, velocity = exact(per_level=27, widest=60)
    use = np.angle(velocity) > np.radians(20)
    states = stated(level[use], omega[use], force[use], velocity[use])
    # Three knots: nothing is chosen anew for another mass.
    curve, told, away = (
        sj.identify_backbone(states, one, n_knots=3).fit.backbone
        for one in (modes(), modes(std=STD), modes(1.001))
    )
    added = np.asarray(told.squared_frequency_covariance - curve.squared_frequency_covariance)
    curve, away = curve.squared_frequency, away.squared_frequency
    at = np.linspace(float(curve.knots[0]), float(curve.knots[-1]), 9)
    (values, by_values), (moved, _) = (linearised_on_host(one, at) for one in (curve, away))
    added = np.einsum("pk,kl,pl->p", by_values, added, by_values)
    np.testing.assert_allclose(np.sqrt(added), STD * abs(moved - values) / 0.001, rtol=0.03)


def test_another_mass_is_said_where_the_states_ask_for_it(data, right):
    assert about_mass(right) == []
    for states in (data, without_noise_stated(data)):
        (note,) = about_mass(sj.identify_backbone(states, modes(WRONG)))
        asked, _, std = note.split("modal mass of ")[1].split(" ")[:3]
        true = 1 / (SHAPE * PARTICIPATION)
        assert abs(float(asked) - true) < 2 * float(std) < 0.03 * true
        assert f"the model has {WRONG * true:.4g} kg" in note
        assert "larger" in note  # 2ζ̃ω̃ = F/(m v) at resonance: a smaller mass, more damping


def test_exact_states_tell_the_mass_itself():
    (note,) = about_mass(sj.identify_backbone(noisy(), modes(WRONG)))
    assert "ask for a modal mass of 0.1667 " in note
    assert "it is 6 % larger" in note


def test_states_near_resonance_say_nothing_of_the_mass():
    level, omega, force, velocity = exact(per_level=9, widest=8)
    rng = np.random.default_rng(1)
    noise = NOISE["velocity"] * rng.normal(size=len(level))
    found = sj.identify_backbone(
        stated(level, omega, force, velocity * np.exp(noise)), modes(WRONG)
    )
    assert about_mass(found) == []


@pytest.mark.long
def test_levels_of_another_gain_ask_for_no_mass():
    """60 tests with level gains of 1 % that nobody states: 3σ is by chance once in 370."""
    said = [
        bool(about_mass(sj.identify_backbone(without_noise_stated(noisy(k, gain=0.01)), modes())))
        for k in range(60)
    ]
    assert sum(said) <= 3  # five levels: a jackknife has four degrees of freedom


@pytest.mark.skipif(not MEASURED.exists(), reason="measured data are not there: ../shared/data")
def test_bolted_beam_under_constant_force_asks_for_more_than_its_model_has():
    """Some 6 % more by the data's own description; 1.97 kg by a joint fit."""
    model = sj.read_model(MEASURED / "model.toml")
    data = sj.read_steady_states(MEASURED / "force_controlled.csv", model)
    (note,) = about_mass(sj.identify_backbone(data, model))
    assert 1.93 < float(note.split("modal mass of ")[1].split(" ")[0]) < 2.01
    assert "the model has 1.892 kg" in note
    assert "smaller" in note
