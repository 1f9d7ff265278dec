"""Evidence of readings on the exact responses of one mode."""

from types import SimpleNamespace

import numpy as np
import pytest
from truths.one_mode import model, noisy, states, table

from snrmjax.doctor.checked_states import checked_states
from snrmjax.doctor.judgement import best_scale, climbed, guessed_mass, judge, with_mass


def checked():
    level, w, force, v = states()
    return checked_states(table(level, w, force, noisy(v)), model(), 0, np.ones(len(v), dtype=bool))


def test_the_misfit_of_right_states_is_their_noise():
    """0.3 % of 45 states; curves and levels cost some 60 % more of so few."""
    judged = judge(checked().test)
    assert judged.noise == pytest.approx(0.003, rel=0.25)  # of 90 numbers, some 20 of them used up
    assert 0.003 < judged.misfit < 0.006
    assert judged.fits


def test_evidence_does_not_depend_on_units():
    """Densities are those of logarithms: of mm and mN they are the same."""
    states = checked().test
    scaled = states._replace(force=1e3 * states.force, velocity=1e3 * states.velocity)
    assert judge(scaled).evidence == pytest.approx(judge(states).evidence, abs=1e-3)


def test_conjugated_phasors_do_not_fit_the_models_mass_and_their_conjugates_do():
    seen = checked()
    wrong = judge(seen.read(seen.recorded.conj()))
    assert judge(seen.test).beats(wrong)
    assert not wrong.beats(judge(seen.test))


def test_a_wrong_scale_is_found_again():
    states = with_mass(checked().test, 1 / 1.37)
    assert guessed_mass(states) == pytest.approx(1.37, rel=0.02)
    scale = best_scale(states, 1.3, judge(with_mass(states, 1.3)), 0.0)
    assert abs(np.log(scale.mass / 1.37)) < 4 * scale.std  # 4σ: one in 16000 by chance
    assert scale.std < 0.01


@pytest.mark.parametrize("place", [0.05, -0.4, 1.0])
def test_the_top_of_a_parabola_is_climbed_exactly(place):
    def fit(x):
        return SimpleNamespace(evidence=-0.5 * ((x - place) / 0.02) ** 2)

    top = climbed(fit, 0.0, 0.1, fit(0.0))
    assert top.value == pytest.approx(place, abs=0.01)  # a tenth of the step
    assert top.std == pytest.approx(0.02, rel=1e-6)
