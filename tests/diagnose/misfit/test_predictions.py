"""Predictions of the quick programs against Newton's method and finite differences."""

import dataclasses
import importlib
import sys
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

import snrmjax
import snrmjax as sj
from snrmjax.diagnose.misfit.candidates import candidate, parameter_labels
from snrmjax.diagnose.misfit.predictions import predictions_of, scales_of
from snrmjax.diagnose.misfit.programs import HARMONICS
from snrmjax.identify.calibrate.inverse_force import inverse_force
from snrmjax.model.effects import EFFECTS, effect_parameters, make_effect

OMEGA, ZETA = 300.0, 0.01
QUICK = ("iwan_microslip", "internal_resonance_1_3", "mode_shape_change")
EVERY = [k if k in QUICK else pytest.param(k, marks=pytest.mark.long) for k in EFFECTS]


@pytest.fixture(scope="module")
def predictions():
    """States with two per cent more force than a linear model needs."""
    modes = sj.model.linear_modes([OMEGA], [ZETA], [[2.0]], [3.0])
    model = dataclasses.replace(sj.model.structure(modes), name="")
    frequency = OMEGA * np.tile(np.linspace(0.98, 1.02, 4), 2)
    q = np.repeat([1e-3, 3e-3], 4) * np.exp(1j * np.tile([-0.5, -1.2, -2.0, -2.6], 2))
    needed = np.abs((OMEGA**2 - frequency**2 + 2j * ZETA * OMEGA * frequency) * q) / 3.0
    level = np.repeat([1, 2], 4)
    data = sj.measure.steady_states(level, frequency, 1.02 * needed, 2j * frequency * q)
    return predictions_of(model, data), data


class SmoothFriction(sj.model.AbstractMemoryless):
    """f = c tanh(q̇/knee): a user's effect without typical values."""

    kind: ClassVar[str] = "smooth_friction"
    coefficient: Array
    knee: Array

    def force(self, displacement, velocity):
        """See `AbstractMemoryless.force`."""
        return self.coefficient * jnp.tanh(velocity / self.knee)


@pytest.fixture
def own_friction(predictions):
    """Predictions with an effect of one's own, its structure and its parameters."""
    ours, data = predictions
    sj.model.register_effect(SmoothFriction)
    own = predictions_of(ours.model, data)
    yield own, own.group, parameter_labels("smooth_friction")
    del EFFECTS["smooth_friction"]


@pytest.mark.parametrize("registered", [pytest.param("before", marks=pytest.mark.long), "after"])
def test_an_effect_of_ones_own_is_treated_alike_whenever_it_is_registered(
    predictions, registered, monkeypatch
):
    """Before or after the diagnosis is imported for the first time, which is when it is used."""
    for name in [name for name in sys.modules if name.startswith("snrmjax.diagnose")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(snrmjax, "diagnose", sj.diagnose)
    monkeypatch.delitem(EFFECTS, "smooth_friction", raising=False)
    if registered == "before":
        monkeypatch.setitem(EFFECTS, "smooth_friction", SmoothFriction)
    weighted, own, simulation = (
        importlib.import_module(f"snrmjax.diagnose.{name}")
        for name in ("misfit.weighted_misfit", "misfit.predictions", "response_prediction")
    )
    monkeypatch.setitem(EFFECTS, "smooth_friction", SmoothFriction)
    model, data = predictions[0].model, predictions[1]
    fresh = own.predictions_of(model, data)
    misfit = weighted.weighted_misfit(fresh)
    assert np.isfinite(misfit.base).all()
    for kind in ("smooth_friction", "cubic_damping"):
        one = candidate(kind, own.scales_of(fresh))
        (rows,), _ = misfit.evaluated(parameter_labels(kind), np.array(one.starts[:1]))
        change = rows - misfit.base
        assert np.isfinite(change).all()
        assert np.any(change != 0)
    # Without strength it counts for nothing: a linear mode at resonance.
    found = SmoothFriction(jnp.array(0.01), jnp.array(3e-4))
    completed = dataclasses.replace(model, effects=(found,))
    before = simulation.predicted_levels(model, completed, data, 0).before
    for force, curve in zip(simulation.level_forces(data).values(), before, strict=True):
        largest = np.max(np.abs(curve.velocity[:, 1, 0]))
        assert largest == pytest.approx(2.0 * 3.0 * force / (2 * ZETA * OMEGA), rel=1e-2)


def moderate(kind, scales):
    """Parameters that change the motion plainly, but not greatly."""
    start = list(candidate(kind, scales).starts[-1])
    start[0] *= 0.5
    return np.array(start)


@pytest.mark.parametrize("kind", EVERY)
def test_misfits_are_those_of_newtons_method(predictions, kind):
    ours, data = predictions
    values = moderate(kind, scales_of(ours))
    found = force_misfit(ours, kind, values[None])[0]
    effect = make_effect(kind, dict(zip(effect_parameters(kind), values, strict=True)))
    model = dataclasses.replace(ours.model, effects=(effect,))
    needed = inverse_force(model, data, harmonic_order=HARMONICS)
    assert needed.converged.all()
    misfit = np.asarray(needed.force) / np.asarray(data.force) - 1
    # Steps end below 1e-5.
    change = np.max(np.abs(misfit - baseline_misfit(ours)))
    assert np.max(np.abs(found - misfit)) < 1e-5 * max(change, 1e-3)


@pytest.mark.parametrize("kind", EFFECTS)
def test_slopes_are_those_of_finite_differences(predictions, kind):
    ours, _ = predictions
    values = moderate(kind, scales_of(ours))
    labels = parameter_labels(kind)
    every = ours.group.at(labels, values)
    slopes = ours.of(every[None], labels).slopes[0]
    for k in range(len(labels)):
        step = np.zeros(len(labels))
        step[k] = 1e-3 * (abs(values[k]) or 1.0)
        up, down = force_misfit(ours, kind, np.stack([values + step, values - step]))
        expected = (up - down) / (2 * step[k])
        found = slopes[:, 0, k] + 1j * slopes[:, 1, k]
        # They carry the baseline's Jacobian: exact for what an effect does by itself.
        assert np.max(np.abs(found - expected)) < 0.03 * np.max(np.abs(expected)) + 1e-12


def force_misfit(ours, kind, values):
    """Complex force misfits of trials, over the measured force."""
    found = ours.of(ours.group.at(parameter_labels(kind), values))
    return found.columns[..., 0] + 1j * found.columns[..., 1]


def baseline_misfit(ours):
    """The same of the baseline."""
    group = ours.group
    found = ours.of(group.values[None])
    return found.columns[0, :, 0] + 1j * found.columns[0, :, 1]


def test_without_convergence_of_the_second_motion_its_first_step_is_the_slope(predictions):
    ours, _ = predictions
    group, label = ours.group, "cubic_stiffness.coefficient"
    usual = ours.of(group.values[None], [label]).slopes[0, :, :2, 0]
    far = group._replace(unit=1e7 * group.unit)
    there = group.at([label], 2.5e-4 * far.unit[group.indices([label])])
    lost = ~np.isfinite(ours.of(there[None]).columns).all(axis=(0, 2))
    assert lost[4:].all()  # the larger motions
    slopes = (
        dataclasses.replace(ours, group=far).of(group.values[None], [label]).slopes[0, :, :2, 0]
    )
    # The force of the prescribed motion is linear in the coefficient, and so is the first step.
    np.testing.assert_allclose(slopes[lost], usual[lost], rtol=0, atol=1e-2 * np.abs(usual).max())


def test_uncertain_parameters_have_slopes_however_small_they_are(predictions):
    """A coefficient is 1e-3 of its own 1σ: the slope is that of the force of a cubic spring."""
    _, data = predictions
    linear = sj.model.linear_modes([OMEGA], [ZETA], [[2.0]], [3.0])
    potential = sj.model.polynomial_potential({"1111": 1e3}, 1, coefficient_std={"1111": 1e6})
    ours = predictions_of(dataclasses.replace(sj.model.structure(linear, potential), name=""), data)
    group = ours.group
    slopes = ours.of(group.values[None], ["potential.1111"]).slopes[0]
    frequency, velocity = np.asarray(data.frequency), np.asarray(data.velocity)[:, 0]
    # ∂V/∂q = 4 a q³, whose fundamental is 3 a |q|² q.
    q = velocity / (2j * frequency)
    expected = 3 * np.abs(q) ** 2 * q / 3.0 / np.asarray(data.force)
    np.testing.assert_allclose(slopes[:, 0] + 1j * slopes[:, 1], expected[:, None], rtol=1e-2)


def test_shapes_of_a_users_effect_have_slopes_whatever_their_magnitude(own_friction):
    """A knee of 3e-4 m/s, for which one is no suitable unit."""
    ours, group, labels = own_friction
    values = group.values.copy()
    indices = group.indices(labels)
    values[indices] = 0.3 * group.unit[indices[0]], 3e-4
    slopes = ours.of(values[None], labels).slopes[0, :, :, 1]
    ends = np.stack([values, values])
    ends[:, indices[1]] += np.array([1e-3, -1e-3]) * 3e-4
    columns = ours.of(ends).columns
    expected = (columns[0] - columns[1]) / (2e-3 * 3e-4)
    np.testing.assert_allclose(slopes, expected, atol=0.03 * np.abs(expected).max())
