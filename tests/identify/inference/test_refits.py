"""Derivatives of a joint fit by its inputs: against refits, inside jit and vmap."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.exact_states import CONSTANT, OMEGA, PARTICIPATION, SHAPE, TRUE, modes, noisy
from truths.joint_fits import noisy_fit

import snrmjax as sj
from snrmjax.identify.inference.fitted_curves import values_at_displacement
from snrmjax.identify.joint.free_unknowns import Unravel

AT = np.linspace(4e-4, 1.9e-3, 5)
STATED = {"level_phase_std": 0.005, "level_frequency_std": 0.5, "level_damping_std": 2e-4}


@pytest.fixture(scope="module")
def fit():
    """A fit with stated level errors: the noise is the only estimated 1σ."""
    return fitted(noisy(1, gain=0.01))


def fitted(data, linear=None):
    model = sj.model.structure(linear or modes(), level_gain_std=0.01, **STATED)
    return sj.fit_jointly(data, model, **TRUE)


@pytest.fixture(scope="module")
def vector(fit):
    """The free unknowns of a refit by the changes of its inputs, compiled."""
    return jax.jit(lambda changes: Unravel(sj.identify.refit(fit, changes), fit.free).vector())


@pytest.fixture(scope="module")
def found(fit):
    """Sensitivities of the unknowns."""
    return sj.identify.influence(fit)


def changed(fit, name, index, change):
    """Inputs with one number changed."""
    none = sj.identify.FitInputs.none(fit)
    return dataclasses.replace(none, **{name: getattr(none, name).at[index].add(change)})


def test_influences_are_differences_of_refits(fit, vector, found):
    std = np.sqrt(np.diag(fit.covariance))
    unmoved = (np.asarray(vector(sj.identify.FitInputs.none(fit))) - fit.vector()[0]) / std
    assert np.max(np.abs(unmoved)) < 1e-3  # iterations of the fit end within 0.05
    inputs = (("amplitude", 7), ("phase", 20), ("force", 3), ("participation", 0))
    for name, index in (*inputs, ("noise", 1), ("level", 0), ("level", 3), ("linear", 1)):
        ends = (np.asarray(vector(changed(fit, name, index, sign * 1e-4))) for sign in (1, -1))
        difference = np.subtract(*ends) / 2e-4 / std
        exact = getattr(found.by, name)[:, index] / std
        # Central differences of 1e-4: errors of 1e-8 times the curvature.
        np.testing.assert_allclose(exact, difference, atol=1e-5 * np.abs(difference).max())
    assert found.names == fit.names()


def test_influences_are_those_of_complete_fits(fit, found):
    """Complete fits estimate the noise again, which hardly matters."""
    slopes = values_at_displacement(fit, AT).slopes
    values = values_at_displacement(fit, AT).values
    data = noisy(1, gain=0.01)
    change = 0.01
    scale = np.ones(len(data.level))
    scale[7] += change
    cases = {
        ("amplitude", 7): fitted(
            dataclasses.replace(data, velocity=data.velocity * scale[:, None])
        ),
        ("force", 7): fitted(dataclasses.replace(data, force=data.force * scale)),
        ("participation", 0): fitted(
            data,
            sj.model.linear_modes([OMEGA], [0.012], [[SHAPE]], [PARTICIPATION * (1 + change)]),
        ),
    }
    assert CONSTANT == SHAPE * PARTICIPATION
    for (name, index), again in cases.items():
        moved = values_at_displacement(again, AT).values - values
        expected = slopes @ getattr(found.by, name)[:, index] * np.log1p(change)
        np.testing.assert_allclose(moved, expected, atol=0.05 * np.abs(expected).max(axis=0).max())


def test_refits_work_inside_jit_and_vmap_and_in_reverse_mode(fit, vector):
    changes = [changed(fit, "amplitude", k, 0.01) for k in (3, 30)]
    both = jax.tree.map(lambda *rows: jnp.stack(rows), *changes)
    curve = eqx.filter_jit(lambda one: sj.identify.refit(fit, one).modal_damping(1e-3))
    np.testing.assert_allclose(
        jax.vmap(vector)(both), [vector(one) for one in changes], rtol=1e-9, atol=1e-9
    )
    plain = sj.identify.refit(fit, changes[0])
    np.testing.assert_allclose(plain.modal_damping(1e-3), curve(changes[0]), rtol=1e-10)
    along = jax.jvp(curve, (changes[0],), (changes[1],))[1]
    back = jax.grad(curve)(changes[0])
    assert jnp.vdot(back.amplitude, changes[1].amplitude) == pytest.approx(float(along), rel=1e-8)


def test_a_refit_that_does_not_converge_is_nan(fit):
    far = dataclasses.replace(sj.identify.FitInputs.none(fit), force=jnp.full(45, jnp.inf))
    assert np.isnan(sj.identify.refit(fit, far).modal_damping(1e-3))


def test_smooth_curves_have_an_influence_of_their_roughness():
    fit = sj.fit_jointly(noisy(1, gain=0.01), modes(), level_gain_std=0.01)
    rough = values_at_displacement(fit, AT).slopes @ sj.identify.influence(fit).by.roughness
    assert rough.shape == (5, 2, 2)
    assert np.all(np.abs(rough[:, 1, 1]).max() > 0)
    # A family has none.
    named = sj.identify.influence(noisy_fit()).by.roughness
    np.testing.assert_array_equal(named, 0.0)
