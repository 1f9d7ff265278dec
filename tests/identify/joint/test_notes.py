"""What a joint fit says in words of its data."""

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


def of_noise(*, stated, noise=15.0):
    found = NoiseEstimate(noise, 0.6, np.array([0.041, 0.0, 0.0, 0.0]), stated)
    return notes_on_noise(found, 1.8e-4, np.zeros(4), 4)


def test_the_wandering_frequency_is_the_one_of_the_error_table():
    # 0.018 % whatever the noise: the argument is final, and needs no factor.
    for stated in (True, False):
        (note,) = [one for one in of_noise(stated=stated) if "natural frequency varies" in one]
        assert "by 0.018 % from" in note


def test_without_stated_noise_nothing_is_said_of_one():
    notes = of_noise(stated=False)
    assert len(notes) == 2
    assert not any("the stated noise does not" in one or "stated error" in one for one in notes)
    misfit, *_ = of_noise(stated=True)
    assert misfit.startswith("the fit misses the data by 15 ± 0.6 times the stated noise")
    assert misfit.endswith("the bands are 15 times wider for it.")


def test_parts_of_correlated_residuals_are_named():
    (note,) = notes_on_autocorrelation(np.array([0.92, 0.73]))
    assert "correlation 0.92 for the part in phase with the force, 0.73 for the part in" in note
    # 1.92/0.08 = 24 points of a first-order process know as much as one.
    assert "about 24 points count as one" in note.lower()


def test_what_a_fit_did_to_each_level_is_said():
    change = np.array([0.019, 0.031, 0.043, 0.067])
    found = np.zeros((4, 4))
    found[:, 0] = -np.log1p(change)  # a velocity that reads too low is scaled up
    (note,) = notes_on_level_errors(found, (1, 2, 3, 4), np.arange(1.0, 5.0))
    assert "velocities of levels 1 to 4 by +1.9, +3.1, +4.3 and +6.7 %" in note
    assert "they grow with the force of the level, so they are probably not random" in note
    (note,) = notes_on_level_errors(found, (1, 2, 3, 4), np.array([4.0, 3.0, 2.0, 1.0]))
    assert "they fall with the force" in note
    (note,) = notes_on_level_errors(found * [[1], [-1], [1], [1]], (7, 2, 3, 9), np.arange(4.0))
    assert "levels 7, 2, 3 and 9" in note
    assert "probably" not in note
    assert notes_on_level_errors(np.zeros((4, 4)), (1, 2, 3, 4), np.arange(4.0)) == ()


@pytest.fixture(scope="module")
def numbered():
    """A fit of levels that its file numbers 10, 20, …"""
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
    # What readers of the file rely on stays.
    assert "level_0.gain" in numbered.names()
    write_joint_fit(tmp_path / "fit.json", numbered)
    assert read_joint_fit(tmp_path / "fit.json").level_numbers == numbered.level_numbers


def test_one_screen_speaks_in_words_and_per_cent():
    text = repr(noisy_fit())
    assert "damping: viscous and quadratic damping of velocity" in text
    assert "@" not in text.splitlines()[0]


class TestStatedErrorsOfLevels:
    def test_a_breach_and_a_common_shift_are_said(self):
        deviation = np.zeros((5, 4))
        deviation[:, 0] = [3.8, 4.1, 4.0, 4.2, 3.9]
        (note,) = notes_on_stated_errors(deviation, np.array([0.005, 0, 0, 0]))
        assert "ask for at least 2 % in gain" in note
        assert "their mean is +4 of it" in note
        assert "0.5 % in gain" in note

    def test_opposite_deviations_have_no_common_part(self):
        found = notes_on_stated_errors(
            np.array([[4.0, 0, 0, 0], [-4.0, 0, 0, 0]]), np.array([0.01, 0, 0, 0])
        )
        assert "ask for at least 4 % in gain" in found[0]
        assert "their mean" not in found[0]

    def test_errors_as_stated_are_no_matter(self):
        rng = np.random.default_rng(0)
        stated = np.array([0.01, 0.01, 0, 0])
        said = sum(
            bool(notes_on_stated_errors(rng.normal(size=(5, 4)), stated)) for _ in range(500)
        )
        assert said <= 5  # one expected of 500 draws with two stated kinds; six are one in 1700
        fit = sj.fit_jointly(noisy(5, gain=0.01), modes(), level_gain_std=0.01, **TRUE)
        assert not any("levels deviate by" in one for one in fit.notes)
