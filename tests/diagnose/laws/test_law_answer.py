"""Laws drawn from sets whose truth is a formula that no class of the library has."""

import functools

import numpy as np
import pytest
from truths.balanced_sets import balanced, files, linear_model, quadratic

import snrmjax as sj
from snrmjax.diagnose.diagnosis import Verdict
from snrmjax.diagnose.laws.law_search import drawn_tables, fit_laws
from snrmjax.diagnose.misfit.candidates import candidate
from snrmjax.diagnose.misfit.effect_fit import fit_effect, with_errors_passed_on
from snrmjax.diagnose.misfit.predictions import predictions_of, scales_of
from snrmjax.diagnose.misfit.weighted_misfit import weighted_misfit
from snrmjax.io.diagnosis_results import summarise_diagnosis
from snrmjax.io.models import read_model, write_model

pytestmark = pytest.mark.usefixtures("optimised")
# Of benchmarks/blind_sets (seed 11, integrated in time by code of its own): a cable that goes
# slack, f = k w [ln(1 + e^((−y−g)/w)) − ln(1 + e^(−g/w)) + y/(1 + e^(g/w))] with y = q/Q and f in
# units of ω₀²Q, and the mode's frequency and shape at the sensor.
STIFFNESS, GAP, WIDTH = 0.1224035995157855, 0.354320445440356, 0.05366527538412173
FREQUENCY, SCALE, SHAPE = 2 * np.pi * 471.16823786824773, 4.73533674968921e-06, 2.162400259129301


def cable(displacement):
    """The force at the sensor, N, at displacements of the sensor, m."""
    y = displacement / SHAPE / SCALE
    lost = np.logaddexp(0, (-y - GAP) / WIDTH) - np.logaddexp(0, -GAP / WIDTH)
    force = STIFFNESS * (WIDTH * lost + y / (1 + np.exp(GAP / WIDTH)))
    return force * FREQUENCY**2 * SCALE / SHAPE


@functools.cache
def slack():
    return sj.diagnose_model(*files("slack_cable", "drawn"))


@pytest.mark.long
def test_a_law_of_a_time_integrated_set_is_drawn_with_its_band():
    found = slack()
    assert found.verdict is Verdict.DRAWN
    assert found.effects == ("uneven_stiffness_law",)
    (law,) = found.answer.laws
    assert (law.law, law.symmetries) == ("spring", ("odd", "even"))
    assert not law.onsets[0].adds
    assert law.onsets[-1].side == -1
    inside = np.abs(law.force - cable(law.at)) <= 1.96 * law.force_std + 1e-12
    length = np.gradient(law.at)
    assert np.sum(length[inside]) > 0.9 * np.sum(length)
    # The band says something: a tenth of the force where that is large.
    top = np.argmax(np.abs(law.force))
    assert law.force_std[top] < 0.1 * abs(law.force[top])
    assert law.force[law.at == 0.0] == law.force_std[law.at == 0.0] == 0.0
    assert found.gap.interpolated.after < 1.3 < 2.5 < found.gap.interpolated.before
    assert found.checks.p_value > 1e-3
    assert found.completed.effects[0].kind == "uneven_stiffness_law"


@pytest.mark.long
def test_the_law_stands_in_the_summary_and_the_model_returns_from_its_file(tmp_path):
    found = slack()
    entry = summarise_diagnosis(found)
    assert entry["verdict"] == "drawn"
    law = entry["law"]
    assert {"class", "displacement_m", "force_n", "force_std_n"} <= set(law)
    assert len(law["displacement_m"]) == len(law["force_n"]) == len(law["force_std_n"])
    assert "drawn from the data" in found.verdict_sentence
    # Outside the library 15 % are no curve of one quantity, whatever the data are.
    own = entry["probabilities"]["+".join(found.effects)]
    assert sum(entry["probabilities"].values()) == pytest.approx(1.0)
    assert own <= 0.85 * (own + entry["probabilities"]["unknown"]) * (1 + 1e-9)
    assert own <= entry["probability"] <= 0.85
    write_model(tmp_path / "model.toml", found.completed)
    back = read_model(tmp_path / "model.toml").effects[0]
    # φ f at x = φ q is the modal force: the table of the sensor is that of the model.
    q = np.array(law["displacement_m"]) / SHAPE
    force = np.array([float(back.force(one, 0.0)) for one in q]) / SHAPE
    np.testing.assert_allclose(force, law["force_n"], rtol=1e-6, atol=1e-9)


@pytest.mark.long
def test_a_law_draws_what_a_formula_of_the_library_does_but_the_formula_costs_less():
    """Quadratic damping by a closed balance: the force 2δ'·8/3π of a velocity, 9.4 v|v|."""
    misfit = weighted_misfit(predictions_of(linear_model(), balanced(quadratic)))
    one = candidate("quadratic_damping", scales_of(misfit.predictions))
    misfit = with_errors_passed_on(misfit, fit_effect(misfit, one))
    effect, law = fit_effect(misfit, one), fit_laws(misfit)
    assert law.posterior.parts[0] in ("odd_damper", "displacement_damping")
    assert effect.criterion < law.criterion
    if law.posterior.parts[0] == "odd_damper":
        (table,) = drawn_tables(law)
        truth = 8.0 * 3 * np.pi / 8 * table.at**2 / 4.0  # over the square of the shape
        inside = np.abs(table.force - truth) <= 1.96 * table.force_std
        assert np.mean(inside) > 0.9


@pytest.mark.long
def test_no_law_is_drawn_where_the_misfit_is_no_function_of_the_motion():
    """A natural frequency that differs from level to level, which nobody stated."""
    found = sj.diagnose_model(linear_model(), balanced(lambda v: 0.0 * v, shift=2e-3, levels=6))
    assert found.verdict is not Verdict.DRAWN
    assert found.answer.laws == ()
