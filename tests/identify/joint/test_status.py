"""Status of joint fits that did not converge, and how often programs compile."""

import logging

import jax
import numpy as np
import pytest
from truths.exact_states import TRUE, modes, noisy
from truths.joint_fits import noisy_fit

import snrmjax as sj
from snrmjax.identify.inference import forced_motion
from snrmjax.identify.joint import posterior_view
from snrmjax.io.joint_results import summarise_fit
from snrmjax.numerics.facts import Fact


def test_an_unconverged_fit_reports_it(monkeypatch):
    whole = posterior_view.fit_test

    def moving(*given, **named):
        return whole(*given, **named)._replace(converged=False)

    monkeypatch.setattr(posterior_view, "fit_test", moving)
    fit = sj.fit_jointly(noisy(1, gain=0.01), modes(), level_gain_std=0.01, **TRUE)
    assert not fit.converged
    assert fit.status.startswith("not converged")
    assert fit.notes[0].kind == "fit_not_converged"
    stated = {"reason": "not converged", "named": False, "noise_stated": True}
    for levels_stated, advice in ((False, "state the errors of the levels"), (True, "name a fami")):
        note = str(Fact("fit_not_converged", **stated, levels_stated=levels_stated))
        assert advice in note
        assert "noise of the states" not in note
    assert fit.notes[0]["levels_stated"] is False
    assert fit.notes[0]["noise_stated"] == fit.noise.stated
    assert "not converged" in repr(fit)


def test_resonances_and_folds_not_located_are_counted_and_noted(monkeypatch):
    fit = noisy_fit()
    before = sj.identify.fitted_response(fit, 2.2)[0]
    assert before.not_located == ()
    assert before.notes == ()
    whole = forced_motion.solved_point

    def lost(one, force, start, *new):
        return None if start.kind == "fold" else whole(one, force, start)

    monkeypatch.setattr(forced_motion, "solved_point", lost)
    found = sj.identify.fitted_response(fit, 2.2)[0]
    assert found.folds == ()
    assert [one.kind for one in found.not_located] == ["fold"] * len(before.folds)
    for one, known in zip(found.not_located, before.folds, strict=True):
        assert not one.located
        assert np.isnan(one.frequency_std)
        assert one.frequency == pytest.approx(known.frequency, rel=1e-3)
    assert len(found.notes[-1]["points"]) == 2
    assert len(summarise_fit(fit, [found])["not_located"]) == 2


def test_results_have_a_repr_a_plot_and_a_data_set():
    fit = noisy_fit()
    response, fractions = sj.identify.fitted_response(fit, 2.2)[0], sj.identify.contributions(fit)
    for result, name, unit in (
        (fit, "frequency_hz", "Hz"),
        (response, "velocity_std_m_s", "m/s"),
        (response.resonances[0], "frequency_std_hz", "Hz"),
        (fractions, "damping_fraction", "1"),
    ):
        assert len(repr(result).splitlines()) < 25
        assert result.to_xarray()[name].attrs["units"] == unit
    assert "converged" in repr(fit)
    assert list(fractions.to_pandas()["frequency_fraction"]) == [
        one.frequency_fraction for one in fractions
    ]
    for result in (fit, response, fractions):
        assert result.plot().axes


def compiled_programs(caplog, call):
    """Names of the programs that a call compiles."""
    caplog.clear()
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        call()
    messages = [record.getMessage() for record in caplog.records]
    return [text.split()[4] for text in messages if text.startswith("Finished XLA compilation")]


@pytest.mark.long
def test_one_set_of_programs_serves_all_sizes_of_data_and_families(caplog):
    """32 states instead of 31, or another family, recompile no program of the package."""

    def everything(n, damping):
        data = noisy(1, gain=0.01)
        part = jax.tree.map(lambda rows: rows[:n], data)
        given = {"backbone": "polynomial:1@displacement", "damping": damping}
        fit = sj.fit_jointly(part, modes(), level_gain_std=0.01, **given)
        sj.identify.fitted_values(fit, np.array([0.1, 0.2]))
        sj.identify.fitted_response(fit, 0.8)
        sj.identify.contributions(fit)
        sj.identify.bootstrap(fit, 2)
        sj.next_measurements(fit, 1, forces=[0.8])
        return fit

    def fresh(x):
        return x + 1

    assert "fresh" in compiled_programs(caplog, lambda: jax.jit(fresh)(1.0))[0]
    everything(31, "viscous_quadratic@velocity")
    found = compiled_programs(caplog, lambda: everything(32, "viscous_quadratic@velocity"))
    own = (
        *("_slopes", "_velocity_of_others", "_first_order"),
        *("_resampled", "_bands", "_point_with_slopes", "_at_velocity", "_at_displacement"),
    )
    assert [name for name in found if any(one in name for one in own)] == []
    found = compiled_programs(caplog, lambda: everything(32, "polynomial:2@displacement"))
    assert [name for name in found if any(one in name for one in own)] == []
