"""Effects: the force of each against a formula written here, its slopes, its power and its sign."""

import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.kinds import KINDS, MEMORYLESS, of_class

from snrmjax.model import effect_base
from snrmjax.model.effect_base import AbstractEffect, AbstractMemoryless
from snrmjax.model.effects import EFFECTS, effect_parameters, make_effect
from snrmjax.model.library import (
    damping,
    friction,
    internal_resonances,
    linear_changes,
    measurement_chain,
    stiffness,
)

STATES = [(q, v) for q in (-1.5, -0.31, -0.1, 0.0, 0.29, 0.7) for v in (-2.0, -0.3, 0.0, 1.1)]


MODULES = (
    *(effect_base, stiffness, damping, friction),
    *(linear_changes, internal_resonances, measurement_chain),
)


def test_the_family_is_complete():
    missing = {*EFFECTS} ^ {*KINDS}
    assert not missing, f"tests/truths/kinds.py: {missing} without a row, or without an effect."
    classes = {
        value
        for module in MODULES
        for _, value in inspect.getmembers(module, inspect.isclass)
        if issubclass(value, AbstractEffect) and not value.__name__.startswith("Abstract")
    }
    assert classes == set(EFFECTS.values())
    assert all(effect.kind == kind for kind, effect in EFFECTS.items())
    differ = {*of_class(AbstractMemoryless)} ^ {*MEMORYLESS}
    assert not differ, f"tests/truths/kinds.py: {differ} need the force written again."


@pytest.mark.parametrize("kind", KINDS)
def test_parameters_in_order_and_as_arrays(kind):
    values = KINDS[kind].parameters
    assert effect_parameters(kind) == tuple(values)
    effect = make_effect(kind, values)
    for name in values:
        value = getattr(effect, name)
        assert eqx.is_array(value)
        assert value.shape == ()


@pytest.mark.parametrize("kind", MEMORYLESS)
def test_force_slopes_and_symmetry(kind):
    row = MEMORYLESS[kind]
    effect = make_effect(kind, row.parameters)

    def by_hand(q, v):
        return row.force(q, v, row.parameters)

    q, v = map(jnp.asarray, np.array(STATES).T)

    @jax.jit
    def evaluated(q, v):
        slopes = (jax.vmap(jax.grad(effect.force, argnums=k))(q, v) for k in (0, 1))
        return jax.vmap(effect.force)(q, v), *slopes

    force, by_q, by_v = map(np.asarray, evaluated(q, v))
    wanted = np.array([by_hand(*state) for state in STATES])
    np.testing.assert_allclose(force, wanted, rtol=1e-14, atol=1e-15)  # rounding
    np.testing.assert_array_equal(force[0], effect.force(q[0], v[0]))  # scalars as well

    # Central differences with a step of 1e-5: truncation h²/6·|f'''| ≤ 1e-10·20 and rounding
    # 1e-16·16/1e-5. The states keep that far from the corners, where the slope must be finite.
    step = 1e-5
    smooth_q, smooth_v = np.asarray(q) != 0, np.asarray(v) != 0
    by_difference = [(by_hand(a + step, b) - by_hand(a - step, b)) / (2 * step) for a, b in STATES]
    np.testing.assert_allclose(by_q[smooth_q], np.array(by_difference)[smooth_q], atol=3e-9)
    by_difference = [(by_hand(a, b + step) - by_hand(a, b - step)) / (2 * step) for a, b in STATES]
    np.testing.assert_allclose(by_v[smooth_v], np.array(by_difference)[smooth_v], atol=3e-9)
    assert np.all(np.isfinite(by_q))
    assert np.all(np.isfinite(by_v))

    mirrored = np.asarray(evaluated(-q, -v)[0])
    if row.symmetry != "neither":
        np.testing.assert_array_equal(mirrored, -force if row.symmetry == "odd" else force)
    if row.dissipates:
        assert np.all(force * np.asarray(v) >= 0)
        assert np.any(force * np.asarray(v) > 0)
    else:
        np.testing.assert_array_equal(by_v, 0.0)


@pytest.mark.parametrize(
    ("kind", "parameters", "message"),
    [
        ("cubic", {"coefficient": 1.0}, "unknown effect kind 'cubic'; known are.*cubic_stiffness"),
        ("coulomb", {"force": 1.0}, "unknown effect kind 'coulomb'"),
        ("gap_stiffness", {"stiffness": 1.0}, r"takes the parameters \['stiffness', 'gap'\]"),
        ("cubic_damping", {"coefficient": 1.0, "gap": 1.0}, r"not \['coefficient', 'gap'\]"),
        ("cubic_damping", {"koefficient": 1.0}, "cubic_damping takes"),
        ("cubic_damping", {"coefficient": np.nan}, "`coefficient` of cubic_damping must be finite"),
        ("cubic_damping", {"coefficient": jnp.inf}, "`coefficient` of cubic_damping must be fin"),
        ("coulomb_friction", {"force": 1.0, "smoothing_velocity": 1.0}, r"\['force'\], not"),
        ("gap_stiffness", {"stiffness": 1.0, "gap": -1.0}, "`gap` of gap_.* zero or positive.* -1"),
        ("coulomb_friction", {"force": -1.0}, "`force` of coulomb_friction must be zero or pos"),
        (
            "jenkins_slider",
            {"stiffness": 1.0, "slip_displacement": 0.0},
            "`slip_displacement` of jenkins_slider must be positive, but is 0",
        ),
        (
            "jenkins_slider",
            {"stiffness": -1.0, "slip_displacement": 1.0},
            "`stiffness` of jenkins_slider must be zero or positive",
        ),
        (
            "iwan_microslip",
            {"coefficient": 1.0, "exponent": 3.0},
            "`exponent` of iwan_microslip must be above 1 and below 3, but is 3",
        ),
        ("iwan_microslip", {"coefficient": 1.0, "exponent": 1.0}, "`exponent` of iwan_.* is 1"),
        ("iwan_microslip", {"coefficient": -1.0, "exponent": 2.0}, "`coefficient` of iwan_mic"),
        ("linear_frequency_shift", {"relative_shift": -1.0}, "`relative_shift` .* above -1"),
        ("frequency_drift", {"relative_drift": -1.5}, "`relative_drift` .* above -1, but is -1.5"),
        ("added_mass", {"mass": -1.0}, "`mass` of added_mass must be above -1"),
        ("force_gain_error", {"gain": -1.0}, "`gain` of force_gain_error must be above -1"),
        ("sensor_gain_error", {"gain": -2.0}, "`gain` of sensor_gain_error must be above -1"),
        (
            "internal_resonance_1_3",
            {"coefficient": 1.0, "frequency_hz": 0.0, "damping_ratio": 0.0},
            "`frequency_hz` of internal_resonance_1_3 must be positive",
        ),
        (
            "internal_resonance_1_2",
            {"coefficient": 1.0, "frequency_hz": 1.0, "damping_ratio": 1.0},
            "`damping_ratio` of internal_resonance_1_2 must be from 0 to below 1, but is 1",
        ),
    ],
)
def test_effects_and_parameters_that_cannot_be_are_refused(kind, parameters, message):
    with pytest.raises(ValueError, match=message):
        make_effect(kind, parameters)
