"""What the choice among families leaves open, against the rivals' own answers."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from truths.exact_states import modes, noisy

import snrmjax as sj
from snrmjax.identify.curves.families import ARGUMENTS
from snrmjax.identify.inference.fitted_curves import as_backbone, beyond_estimation, open_choice
from snrmjax.identify.inference.sensitivity import contributions
from snrmjax.identify.joint.joint_fit import FamilyChoice, Rival
from snrmjax.identify.joint.ranking import _weights
from snrmjax.identify.prediction.new_level import ON_THE_CURVES
from snrmjax.io.joint_results import read_joint_fit, summarise_fit, write_joint_fit

FORCE = 2.2  # N


@pytest.fixture(scope="module")
def fit():
    """Damping whose law 45 noisy states leave open; the backbone is given."""
    data = noisy(4, gain=0.01)
    given = {"backbone": "polynomial:1@displacement", "level_gain_std": 0.01}
    return sj.fit_jointly(data, modes(), **given)


def by_estimation_alone(fit):
    """The same fit, sure of its families."""
    return eqx.tree_at(lambda f: f.families.rivals, fit, ())


def test_what_differs_by_more_than_chance_counts_with_its_weight():
    # Variances 1 and 3: a difference of 2σ² = 2 is expected, what is beyond speaks of the choice.
    found = beyond_estimation(0.25, np.zeros(4), np.ones(4), np.array([3.0, -3, 1, np.nan]), 3.0)
    np.testing.assert_allclose(found, [0.5 * np.sqrt(7), -0.5 * np.sqrt(7), 0.0, 0.0], rtol=1e-15)


def test_weights_are_those_of_the_scores(fit):
    for curve in ("backbone", "damping"):
        mine = [one for one in fit.families.candidates if one.curve == curve]
        assert sum(one.weight for one in mine) == pytest.approx(1.0, rel=1e-12)
        best = max(mine, key=lambda one: one.score)
        for one in mine:
            ratio = np.exp(one.score - best.score)
            assert one.weight == pytest.approx(ratio * best.weight, rel=1e-9)


def test_rivals_are_fits_of_what_was_tried_and_not_taken(fit):
    assert len(fit.families.rivals) >= 2
    assert {one.curve for one in fit.families.rivals} == {"damping"}  # the backbone was no choice
    taken = type(fit.unknowns.modal_damping), fit.unknowns.modal_damping.argument
    for one in fit.families.rivals:
        curve = one.fit.unknowns.modal_damping
        assert (type(curve), curve.argument) != taken or len(curve.parameters) != len(
            fit.unknowns.modal_damping.parameters
        )
        assert curve.argument in ARGUMENTS
        assert one.fit.converged
        assert one.fit.families.rivals == ()
        # It was fitted itself, to the same data: χ² is about as small.
        assert np.sum(one.fit.residuals**2) < 1.2 * np.sum(fit.residuals**2)


def test_a_family_that_is_given_has_no_rivals():
    given = {"backbone": "polynomial:1@displacement", "damping": "viscous_quadratic@velocity"}
    assert sj.fit_jointly(noisy(4), modes(), **given).families.rivals == ()


def widened(std, answers, weights):
    """1σ with the excess of every rival's difference: value and 1σ, ours first."""
    (value, own), *others = answers
    total = own**2
    for weight, (other, spread) in zip(weights, others, strict=True):
        total += weight * np.maximum((other - value) ** 2 - np.abs(spread**2 - own**2), 0.0)
    assert std == pytest.approx(np.sqrt(total), rel=1e-3)
    return np.sqrt(total)


@pytest.mark.parametrize("argument", ARGUMENTS)
def test_bands_of_curves_hold_what_rivals_say(fit, argument):
    displacement, velocity = fit.largest
    at = {
        argument: np.linspace(0.1, 1.3, 7) * {"displacement": displacement}.get(argument, velocity)
    }
    found = sj.identify.fitted_values(fit, **at)
    alone = by_estimation_alone(fit)
    answers = [
        sj.identify.fitted_values(one, **at)
        for one in (alone, *(r.fit for r in fit.families.rivals))
    ]
    weights = [one.weight for one in fit.families.rivals]
    for name in ("natural_frequency", "modal_damping"):
        pairs = [
            (np.asarray(getattr(a, name)), np.asarray(getattr(a, name + "_std"))) for a in answers
        ]
        total = widened(np.asarray(getattr(found, name + "_std")), pairs, weights)
    # Somewhere it matters: laws of damping part ways at rest and beyond the data.
    assert np.max(total / np.asarray(answers[0].modal_damping_std)) > 1.05


def test_bands_of_a_resonance_and_a_fold_hold_what_rivals_say(fit):
    found = sj.identify.fitted_response(fit, FORCE)[0]
    answers = [
        sj.identify.fitted_response(one, FORCE)[0]
        for one in (by_estimation_alone(fit), *(r.fit for r in fit.families.rivals))
    ]
    weights = [one.weight for one in fit.families.rivals]
    for kind in ("resonances", "folds"):
        points = [max(getattr(a, kind), key=lambda p: p.velocity) for a in answers]
        mine = max(getattr(found, kind), key=lambda p: p.velocity)
        for name in ("frequency", "velocity"):
            pairs = [(getattr(p, name), getattr(p, name + "_std")) for p in points]
            widened(getattr(mine, name + "_std"), pairs, weights)


def test_bands_along_a_response_hold_what_rivals_say(fit):
    """On a flank, where the velocity at one frequency is one and can be looked up."""
    ours, alone = (
        sj.identify.fitted_response(f, FORCE)[0] for f in (fit, by_estimation_alone(fit))
    )
    tip = np.argmax(np.abs(ours.velocity))
    place = tip // 2  # on the way up
    omega = ours.frequency[place]
    pairs = [(abs(alone.velocity[place]), alone.velocity_std[place])]
    for one in fit.families.rivals:
        theirs = sj.identify.fitted_response(one.fit, FORCE, points_per_side=2000)[0]
        rising = slice(0, np.argmax(np.abs(theirs.velocity)))
        size, at = np.abs(theirs.velocity[rising]), theirs.frequency[rising]
        std = np.interp(omega, at, theirs.velocity_std[rising])
        pairs.append((np.interp(omega, at, size), std))
    widened(ours.velocity_std[place], pairs, [one.weight for one in fit.families.rivals])


def beside(fit, *rivals):
    """The fit beside some rivals."""
    return dataclasses.replace(fit, families=FamilyChoice(rivals=rivals))


def against(fit, *factors, weight=0.25):
    """The fit beside rivals whose damping is so many times its own, as well known."""
    alone = by_estimation_alone(fit)

    def louder(factor):
        parameters = factor * alone.unknowns.modal_damping.parameters
        return eqx.tree_at(lambda f: f.unknowns.modal_damping.parameters, alone, parameters)

    rivals = tuple(Rival("damping", weight, louder(factor)) for factor in factors)
    return beside(alone, *rivals)


def test_rivals_add_up_in_any_order(fit):
    """Along a response, on whose upper flank all of them differ."""

    def added(*factors):
        wide = sj.identify.fitted_response(against(fit, *factors), FORCE)[0].velocity_std
        return (
            wide**2
            - sj.identify.fitted_response(by_estimation_alone(fit), FORCE)[0].velocity_std ** 2
        )

    one, other, both, turned = added(1.1), added(1.3), added(1.1, 1.3), added(1.3, 1.1)
    tip = np.argmax(one)
    assert one[tip] > 0
    np.testing.assert_allclose(both[tip - 20 : tip], (one + other)[tip - 20 : tip], rtol=1e-9)
    np.testing.assert_allclose(turned, both, rtol=1e-9)


@pytest.mark.parametrize("factor", [1.05, 1.3, 1.6])
def test_a_resonance_is_as_uncertain_as_its_rival_is_far(fit, factor):
    mine = sj.identify.fitted_response(by_estimation_alone(fit), FORCE, of=ON_THE_CURVES)[
        0
    ].resonances[0]
    wide = sj.identify.fitted_response(against(fit, factor), FORCE, of=ON_THE_CURVES)[0].resonances[
        0
    ]
    rival = against(fit, factor).families.rivals[0].fit
    theirs = sj.identify.fitted_response(rival, FORCE, of=ON_THE_CURVES)[0].resonances[0]
    apart = (theirs.velocity - mine.velocity) ** 2
    excess = apart - abs(theirs.velocity_std**2 - mine.velocity_std**2)
    expected = np.sqrt(mine.velocity_std**2 + 0.25 * excess)
    assert wide.velocity_std == pytest.approx(expected, rel=1e-6)


def test_a_band_at_one_velocity_does_not_hang_on_what_else_is_asked(fit):
    # ω̃² = a(1 − 0.4 u) turns back at u = 1.25: 1.25 times the largest velocity is beyond that.
    alone = by_estimation_alone(fit)
    vector = np.array(alone.vector()[0])
    vector[1] = -0.4 * vector[0]
    falling = eqx.tree_at(lambda f: f.unknowns, alone, alone.vector()[1](jnp.asarray(vector)))
    either = beside(alone, Rival("backbone", 0.5, falling))
    at = np.array([0.2, 0.5, 1.25]) * fit.largest[1]
    few, all_three = (open_choice(either, velocity=at[:n])[0] for n in (2, 3))
    np.testing.assert_allclose(all_three[:2], few, rtol=1e-6)
    assert np.all(np.abs(few[:, 0]) > 0)
    assert not all_three[2].any()  # a velocity that the rival does not have


def test_at_rest_dry_friction_leaves_damping_as_open_as_just_beside(fit):
    given = {"backbone": "polynomial:1@displacement", "damping": "viscous_coulomb@displacement"}
    dry = sj.fit_jointly(noisy(4, gain=0.01), modes(), level_gain_std=0.01, **given)
    assert np.isinf(
        np.asarray(sj.identify.fitted_values(dry, displacement=np.zeros(1)).modal_damping)
    )
    parameters = dry.unknowns.modal_damping.parameters.at[1].set(2.0)
    dry = eqx.tree_at(lambda f: f.unknowns.modal_damping.parameters, dry, parameters)
    either = beside(by_estimation_alone(fit), Rival("damping", 0.5, dry))
    at = np.array([0.0, 0.005, 0.01]) * fit.largest[0]
    shift = open_choice(either, displacement=at)[0, :, 1]
    assert shift[2] > 0
    np.testing.assert_array_equal(shift, shift[2])


def test_families_without_a_score_weigh_nothing():
    np.testing.assert_array_equal(_weights(np.array([-np.inf, 0.0, np.nan])), [0, 1, 0])
    np.testing.assert_array_equal(_weights(np.array([-np.inf, -np.inf])), [0, 0])


def test_the_choice_is_a_contribution(fit):
    shares = {one.source: one for one in contributions(fit)}
    assert sum(one.damping_share for one in shares.values()) == pytest.approx(1.0, rel=1e-6)
    measured = np.asarray(fit.motion().displacement)
    at = np.linspace(measured.min(), measured.max(), 25)
    with_choice = np.asarray(sj.identify.fitted_values(fit, displacement=at).modal_damping_std)
    without = np.asarray(
        sj.identify.fitted_values(by_estimation_alone(fit), displacement=at).modal_damping_std
    )
    expected = np.mean(1 - (without / with_choice) ** 2)
    assert shares["choice of the families"].damping_share == pytest.approx(expected, rel=0.02)


def test_knots_for_classical_predictions_have_the_same_band(fit):
    backbone = as_backbone(fit)
    at = np.asarray(backbone.modal_damping.knots)[5::20]
    std = np.sqrt(np.diag(np.asarray(backbone.modal_damping_covariance)))[5::20]
    expected = np.asarray(sj.identify.fitted_values(fit, displacement=at).modal_damping_std)
    np.testing.assert_allclose(std, expected, rtol=1e-9)


def test_rivals_come_back_from_the_file(fit, tmp_path):
    write_joint_fit(tmp_path / "fit.json", fit)
    again = read_joint_fit(tmp_path / "fit.json")
    at = np.linspace(0.0, 1.0, 5) * fit.largest[0]
    np.testing.assert_array_equal(
        open_choice(again, displacement=at), open_choice(fit, displacement=at)
    )
    assert [r["weight"] for r in summarise_fit(again, ())["rivals"]] == [
        one.weight for one in fit.families.rivals
    ]
