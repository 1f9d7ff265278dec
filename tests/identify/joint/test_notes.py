"""Notes of a joint fit on its data."""

import dataclasses

import numpy as np
import pytest
from truths.exact_states import TRUE, modes, noisy
from truths.joint_fits import noisy_fit

import snrmjax as sj
from snrmjax.identify.inference.contributions import contributions
from snrmjax.identify.joint.notes import (
    NoiseEstimate,
    notes_on_autocorrelation,
    notes_on_level_errors,
    notes_on_noise,
    notes_on_stated_errors,
)
from snrmjax.io.joint_results import read_joint_fit, write_joint_fit
from snrmjax.numerics.facts import Fact


def test_noise_and_levels_beyond_the_stated_ones_are_noted():
    found = NoiseEstimate(15.0, 0.6, np.array([0.041, 0.0, 0.0, 0.0]), True)
    taken = np.array([0.05, 0.0, 0.01, 0.0])
    kinds = [one.kind for one in notes_on_noise(found, 1.8e-4, np.zeros(4), taken, 4)]
    assert kinds == ["noise_exceeded", "frequency_wanders", "levels_differ"]
    unstated = dataclasses.replace(found, stated=False)
    wanders, differ = notes_on_noise(unstated, 1.8e-4, np.zeros(4), taken, 4)
    # The given scatter is used, whatever the noise.
    assert wanders == Fact("frequency_wanders", std=1.8e-4, noise_stated=False)
    assert differ == Fact("levels_differ", std=(0.041, 0.0, 0.0, 0.0), beyond_stated=False)
    given = np.array([0.05, 0.05, 0.0, 0.0])
    assert notes_on_noise(unstated, 0.0, given, taken, 4) == []
    (few,) = notes_on_noise(unstated, 0.0, given, taken, 2)
    assert few == Fact("few_levels", n_levels=2, assumed=(0.0, 0.0, 0.01, 0.0))


def test_parts_of_correlated_residuals_are_named():
    (note,) = notes_on_autocorrelation(np.array([0.92, 0.73]))
    assert (note["in_phase"], note["quadrature"]) == (0.92, 0.73)
    # 1.92/0.08 = 24 points of a first-order process count as one.
    assert note["states_as_one"] == pytest.approx(24)
    assert notes_on_autocorrelation(np.zeros(2)) == []


def test_level_corrections_are_noted():
    change = np.array([0.019, 0.031, 0.043, 0.067])
    found = np.zeros((4, 4))
    found[:, 0] = -np.log1p(change)  # a velocity that reads too low is scaled up
    (note,) = notes_on_level_errors(found, (1, 2, 3, 4), np.arange(1.0, 5.0))
    assert note["of"] == "velocities"
    np.testing.assert_allclose(note["change"], change)
    assert note["trend"] == 1
    (note,) = notes_on_level_errors(found, (1, 2, 3, 4), np.array([4.0, 3.0, 2.0, 1.0]))
    assert note["trend"] == -1
    (note,) = notes_on_level_errors(found * [[1], [-1], [1], [1]], (7, 2, 3, 9), np.arange(4.0))
    assert (note["levels"], note["trend"]) == ((7, 2, 3, 9), 0)
    assert notes_on_level_errors(np.zeros((4, 4)), (1, 2, 3, 4), np.arange(4.0)) == []


@pytest.fixture(scope="module")
def numbered():
    """A fit of levels numbered 10, 20, … in the file."""
    plain = noisy(1, gain=0.01)
    data = sj.measure.steady_states(
        10 * (1 + np.asarray(plain.level)),
        *(plain.frequency, plain.force, plain.velocity[:, 0]),
        velocity_std=0.01 * np.abs(plain.velocity[:, 0]),
        phase_std=np.full(len(plain.level), 0.01),
    )
    true = {"backbone": "polynomial:1@displacement", "damping": "viscous_quadratic@velocity"}
    return sj.fit_jointly(data, modes(), **true, level_gain_std=0.01)


def test_levels_have_the_numbers_of_their_file(numbered, tmp_path):
    found = numbered.to_xarray()
    assert set(found["level"].values) == set(numbered.level_numbers)
    assert min(numbered.level_numbers) == 10
    assert "level_10.gain" in found["parameter"].values
    assert "gain of level 10" in {one.source for one in contributions(numbered)}
    # Names by index stay, for other programs.
    assert "level_0.gain" in numbered.names()
    write_joint_fit(tmp_path / "fit.json", numbered)
    assert read_joint_fit(tmp_path / "fit.json").level_numbers == numbered.level_numbers


def test_the_repr_uses_words_and_per_cent():
    text = repr(noisy_fit())
    assert "damping: viscous and quadratic damping of velocity" in text
    assert "@" not in text.splitlines()[0]


class TestStatedErrorsOfLevels:
    def test_a_violation_and_a_common_shift_are_noted(self):
        deviation = np.zeros((5, 4))
        deviation[:, 0] = [3.8, 4.1, 4.0, 4.2, 3.9]
        (note,) = notes_on_stated_errors(deviation, np.array([0.005, 0, 0, 0]))
        assert (note["error"], note["stated"]) == ("gain", 0.005)
        assert note["rms"] == pytest.approx(4, abs=0.01)
        assert note["mean"] == pytest.approx(4)

    def test_opposite_deviations_have_no_common_part(self):
        deviation = np.array([[4.0, 0, 0, 0], [-4.0, 0, 0, 0]])
        (note,) = notes_on_stated_errors(deviation, np.array([0.01, 0, 0, 0]))
        assert note["mean"] is None

    def test_errors_as_stated_are_not_noted(self):
        rng = np.random.default_rng(0)
        stated = np.array([0.01, 0.01, 0, 0])
        found = sum(
            bool(notes_on_stated_errors(rng.normal(size=(5, 4)), stated)) for _ in range(500)
        )
        assert found <= 5  # one expected of 500 draws with two stated kinds; six are one in 1700
        fit = sj.fit_jointly(noisy(5, gain=0.01), modes(), level_gain_std=0.01, **TRUE)
        assert "level_beyond_stated" not in {one.kind for one in fit.notes}
