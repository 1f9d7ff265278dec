"""What a joint fit says of fits that did not converge, and how often its programs compile."""

import logging

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.exact_states import TRUE, modes, noisy
from truths.joint_fits import noisy_fit

import snrmjax as sj
from snrmjax.identify.curves.families import parse_family
from snrmjax.identify.inference import located_points
from snrmjax.identify.inference.located_points import LocatedStatus
from snrmjax.identify.joint import joint_fit
from snrmjax.identify.joint.fitting import FitStatus
from snrmjax.identify.joint.force_balance import BalanceProblem, PriorStd, balance_data
from snrmjax.identify.joint.initial_guess import initial_guess
from snrmjax.identify.joint.notes import notes_on_families
from snrmjax.identify.joint.selection import FamilyRequest, SelectionStatus, select_families
from snrmjax.io.joint_results import read_joint_fit, summarise_fit, write_joint_fit

OPEN = {"backbone": "polynomial:1@displacement", "level_gain_std": 0.01}


@pytest.mark.parametrize("status", [FitStatus.STEP_LIMIT, FitStatus.NOT_FINITE])
def test_rivals_whose_fit_failed_are_counted_and_said(monkeypatch, tmp_path, status):
    """The first fit of a rival fails; those that choose and fit the families do not."""
    whole, fits = joint_fit.fitted, []

    def failing(*given):
        found, rounds = whole(*given), given[-1].rounds
        # Rivals are fitted roughly, after the fit itself.
        is_rival = rounds == joint_fit._ROUGHLY and joint_fit._ROUNDS in fits
        fits.append("rival" if is_rival else rounds)
        return found._replace(status=status) if fits.count("rival") == is_rival == 1 else found

    monkeypatch.setattr(joint_fit, "fitted", failing)
    fit = sj.fit_jointly(noisy(4, gain=0.01), modes(), **OPEN)
    (failed,) = fit.families.failed
    assert failed.status == status
    assert failed.curve == "damping"
    assert len(fit.families.rivals) >= 1
    every = 1 + len(fit.families.rivals)
    (note,) = (note for note in fit.notes if "competing families" in note)
    assert f"1 of {every} competing families could not be fitted" in note
    assert failed.family in note
    assert summarise_fit(fit, ())["failed_rivals"][0]["status"] == status.name.lower()
    write_joint_fit(tmp_path / "fit.json", fit)
    assert read_joint_fit(tmp_path / "fit.json").families.failed == fit.families.failed


def test_a_fit_that_used_up_its_steps_says_so(monkeypatch):
    whole = joint_fit.fitted

    def short(*given):
        return whole(*given)._replace(status=FitStatus.STEP_LIMIT)

    monkeypatch.setattr(joint_fit, "fitted", short)
    fit = sj.fit_jointly(noisy(1, gain=0.01), modes(), level_gain_std=0.01, **TRUE)
    assert fit.status == FitStatus.STEP_LIMIT
    assert not fit.converged
    assert "steps" in fit.notes[0]
    assert "not converged" in repr(fit)


def test_a_first_fit_that_used_up_its_steps_is_no_start(monkeypatch):
    """It may have ended anywhere: here with gains of levels that no test has."""
    whole, starts = joint_fit.fitted, []

    def lost(start, problem, components, settings, *new):
        found = whole(start, problem, components, settings)
        if settings.rounds != joint_fit._ROUGHLY:
            starts.append(np.asarray(start.level))
            return found
        away = eqx.tree_at(lambda u: u.level, found.unknowns, found.unknowns.level + 50.0)
        return found._replace(unknowns=away, status=FitStatus.STEP_LIMIT)

    data = noisy(1, gain=0.01)
    plain = sj.fit_jointly(data, modes(), level_gain_std=0.01, **TRUE)
    monkeypatch.setattr(joint_fit, "fitted", lost)
    fit = sj.fit_jointly(data, modes(), level_gain_std=0.01, **TRUE)
    assert fit.converged
    assert np.max(np.abs(starts[0])) < 10  # of 1σ
    # The same curves, though their terms count at the largest amplitude of where a fit began.
    values = [sj.identify.fitted_values(one, np.linspace(0.3, 0.9, 4)) for one in (fit, plain)]
    for name in ("natural_frequency", "modal_damping"):
        found, wanted = (getattr(each, name) for each in values)
        # Both end where a round moves less than a tenth of the squared distance.
        assert np.max(np.abs(found - wanted) / getattr(values[1], f"{name}_std")) < 0.3


def test_where_the_chosen_family_does_not_converge_the_next_best_is_taken(monkeypatch):
    """One kind of damping is made to use up its steps: what else fits is tried."""
    asked = {"backbone": "polynomial:1@displacement", "level_gain_std": 0.01}
    data = noisy(4, gain=0.01)
    chosen = sj.fit_jointly(data, modes(), **asked)
    whole, failing = joint_fit.fitted, chosen.unknowns.modal_damping.kind

    def some_fail(*given):
        found = whole(*given)
        failed = found.unknowns.modal_damping.kind == failing
        return found._replace(status=FitStatus.STEP_LIMIT) if failed else found

    monkeypatch.setattr(joint_fit, "fitted", some_fail)
    fit = sj.fit_jointly(data, modes(), **asked)
    assert fit.converged
    assert fit.unknowns.squared_frequency.label == chosen.unknowns.squared_frequency.label
    assert fit.unknowns.modal_damping.kind != failing
    assert "did not converge; these are the next best that did" in fit.notes[0]
    (mine,) = (c for c in fit.families.candidates if c.chosen and c.curve == "damping")
    assert mine.family == fit.unknowns.modal_damping.kind
    assert len(fit.families.candidates) == len(chosen.families.candidates)


def test_a_fit_that_is_not_finite_is_an_error(monkeypatch):
    whole = joint_fit.fitted

    def broken(*given):
        return whole(*given)._replace(status=FitStatus.NOT_FINITE)

    monkeypatch.setattr(joint_fit, "fitted", broken)
    with pytest.raises(ValueError, match="infinite or undefined"):
        sj.fit_jointly(noisy(1), modes(), **TRUE)


def test_a_choice_of_families_that_did_not_settle_says_so(monkeypatch):
    """Level-to-level variance that comes and goes with every choice of families."""
    from snrmjax.identify.joint import selection

    whole, calls = selection.estimated_components, []

    def restless(*given, **named):
        calls.append(1)
        found = whole(*given, **named)
        return found._replace(level=(0.01 * (len(calls) % 2), 0.0, 0.0, 0.0))

    one = modes()
    data, _ = balance_data(noisy(1), one)
    problem = BalanceProblem(data, one, PriorStd(jnp.zeros(4), jnp.zeros(1)))
    request = FamilyRequest(*(parse_family(TRUE[name]) for name in ("backbone", "damping")), ())
    settings = (problem, initial_guess(problem, ()), request)
    assert select_families(*settings, components_too=True).status == SelectionStatus.SETTLED
    monkeypatch.setattr(selection, "estimated_components", restless)
    found = select_families(*settings, components_too=True)
    assert found.status == SelectionStatus.NOT_SETTLED
    (note,) = notes_on_families(found.status, found.table)
    assert "still changed one another" in note


def test_families_ranked_by_unfinished_fits_are_named():
    fit = noisy_fit()
    chosen = next(one for one in fit.families.candidates if one.curve == "damping" and one.chosen)
    assert notes_on_families(SelectionStatus.SETTLED, fit.families.candidates) == ()
    (note,) = notes_on_families(SelectionStatus.SETTLED, [chosen._replace(converged=False)])
    assert (
        "(viscous and quadratic damping of velocity for the damping) was not fitted to the end"
        in note
    )


def test_resonances_and_folds_that_are_not_located_are_counted_and_said(monkeypatch):
    fit = noisy_fit()
    before = sj.identify.fitted_response(fit, 2.2)[0]
    assert before.not_located == ()
    assert before.note == ""
    whole = located_points._solved

    def lost(one, force, place, *new):
        return None if place.kind == "fold" else whole(one, force, place)

    monkeypatch.setattr(located_points, "_solved", lost)
    found = sj.identify.fitted_response(fit, 2.2)[0]
    assert found.folds == ()
    assert [one.kind for one in found.not_located] == ["fold"] * len(before.folds)
    for one, known in zip(found.not_located, before.folds, strict=True):
        assert one.status == LocatedStatus.NOT_LOCATED
        assert np.isnan(one.frequency_std)
        assert one.frequency == pytest.approx(known.frequency, rel=1e-3)
    assert "2 resonances or folds under 2.2 N could not be located" in found.note
    assert len(summarise_fit(fit, [found])["not_located"]) == 2


def test_results_say_themselves_and_become_data_sets():
    fit = noisy_fit()
    response, shares = sj.identify.fitted_response(fit, 2.2)[0], sj.identify.contributions(fit)
    for result, name, unit in (
        (fit, "frequency_hz", "Hz"),
        (response, "velocity_std_m_s", "m/s"),
        (response.resonances[0], "frequency_std_hz", "Hz"),
        (shares, "damping_share", "1"),
    ):
        assert len(repr(result).splitlines()) < 25
        assert result.to_xarray()[name].attrs["units"] == unit
    assert "converged" in repr(fit)
    assert list(shares.to_pandas()["frequency_share"]) == [one.frequency_share for one in shares]
    for result in (fit, response, shares):
        assert result.plot().axes


def compiled_programs(caplog, call):
    """Names of the programs that a call compiles."""
    caplog.clear()
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        call()
    said = [record.getMessage() for record in caplog.records]
    return [text.split()[4] for text in said if text.startswith("Finished XLA compilation")]


@pytest.mark.long
def test_one_set_of_programs_serves_all_sizes_of_data_and_families(caplog):
    """32 states in place of 31, or another family, compile no program of the package anew."""

    def everything(n, damping):
        data = noisy(1, gain=0.01)
        part = jax.tree.map(lambda rows: rows[:n], data)
        given = {"backbone": "polynomial:1@displacement", "damping": damping}
        fit = sj.fit_jointly(part, modes(), level_gain_std=0.01, **given)
        sj.identify.fitted_values(fit, np.array([0.1, 0.2]))
        sj.identify.fitted_response(fit, 0.8)
        sj.identify.contributions(fit)
        sj.identify.profile(fit, "backbone.at_zero", n_points=3, reach=1.0)
        sj.identify.bootstrap(fit, 2)
        sj.next_measurements(fit, 1, forces=[0.8])
        return fit

    def fresh(x):
        return x + 1

    assert "fresh" in compiled_programs(caplog, lambda: jax.jit(fresh)(1.0))[0]
    everything(31, "viscous_quadratic@velocity")
    found = compiled_programs(caplog, lambda: everything(32, "viscous_quadratic@velocity"))
    own = (
        *("_linearised", "_solve", "_slopes", "recorded_motion", "_first_order", "_pinned"),
        *("_resampled", "_bands", "_point_with_slopes", "_at_velocity", "_at_displacement"),
    )
    assert [name for name in found if any(one in name for one in own)] == []
    found = compiled_programs(caplog, lambda: everything(32, "polynomial:2@displacement"))
    assert [name for name in found if any(one in name for one in own)] == []
