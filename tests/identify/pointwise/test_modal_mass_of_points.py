"""The error of the modal mass in points and curves, and a mass that the states contradict."""

import numpy as np
import pytest
from truths.exact_states import NOISE, OMEGA, PARTICIPATION, SHAPE, exact, noisy, stated

import snrmjax as sj
from snrmjax.identify.inference.identification import errors_from_scatter

WRONG, STD = 1.06, 0.03  # of the model's modal mass; its stated 1σ


def modes(mass=1.0, std=None):
    """The one mode with a modal mass so many times the true one."""
    told = None if std is None else sj.model.LinearModesStd(modal_mass=[std])
    return sj.model.linear_modes([OMEGA], [0.012], [[SHAPE]], [PARTICIPATION / mass], std=told)


def without_noise_stated(data):
    columns = (data.level, data.frequency, data.force, data.velocity)
    return sj.measure.steady_states(*(np.asarray(column) for column in columns))


def about_mass(found):
    return [note for note in found.notes if note.kind == "modal_mass_moved"]


@pytest.fixture(scope="module")
def data():
    return noisy(3)


@pytest.fixture(scope="module")
def right(data):
    return sj.identify_backbone(data, modes())


@pytest.mark.parametrize("noise_stated", [True, False])
def test_points_include_the_error_of_the_mass_as_a_model_with_that_mass_moves_them(
    data, noise_stated
):
    plain, told = (sj.identify.identify_points(data, modes(std=std)) for std in (None, STD))
    if not noise_stated:
        plain = errors_from_scatter(plain, 0.01)
        told = errors_from_scatter(told, 0.01, modal_mass_std=STD)
    away = 1e-4
    moved = sj.identify.identify_points(data, modes(1 + away))
    for name in ("natural_frequency", "damping_ratio"):
        values = np.asarray(getattr(plain, name))
        by_mass = (np.asarray(getattr(moved, name)) - values) / away
        own, all_ = (np.asarray(getattr(one, f"{name}_std")) for one in (plain, told))
        # The difference quotient's own error: half of 1e-4. A damping ratio that was read off the
        # scatter has the natural frequency's error, too.
        np.testing.assert_allclose(
            np.sqrt(all_**2 - own**2), STD * abs(by_mass), rtol=2e-4 if noise_stated else 0.02
        )


def test_another_mass_is_said_where_the_states_ask_for_it(data, right):
    assert about_mass(right) == []
    for states in (data, without_noise_stated(data)):
        (note,) = about_mass(sj.identify_backbone(states, modes(WRONG)))
        true = 1 / (SHAPE * PARTICIPATION)
        assert abs(note["found_kg"] - true) < 2.5 * note["std_kg"] < 0.03 * true
        assert note["model_kg"] == pytest.approx(WRONG * true)


def test_exact_states_tell_the_mass_itself():
    found = sj.identify_backbone(noisy(), modes(WRONG))
    assert float(found.backbone.modal_constant) == pytest.approx(SHAPE * PARTICIPATION, rel=1e-3)


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
    assert sum(said) <= 3
