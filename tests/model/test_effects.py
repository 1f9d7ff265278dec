"""Effects: the force of each against a formula written here, its slopes, its power and its sign."""

import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

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

# kind: parameters, force by hand, and whether it is odd in (q, q̇), even, or neither.
FAMILY = {
    "cubic_stiffness": ({"coefficient": 1.3}, lambda q, v: 1.3 * q**3, "odd"),
    "quadratic_stiffness": ({"coefficient": -0.7}, lambda q, v: -0.7 * q**2, "even"),
    "quintic_stiffness": ({"coefficient": 2.0}, lambda q, v: 2.0 * q**5, "odd"),
    "bilinear_stiffness": ({"stiffness": 0.8}, lambda q, v: 0.4 * abs(q), "even"),
    "gap_stiffness": (
        {"stiffness": 3.0, "gap": 0.4},
        lambda q, v: 3.0 * (q - 0.4 if q > 0.4 else q + 0.4 if q < -0.4 else 0.0),
        "odd",
    ),
    "one_sided_stop": (
        {"stiffness": 3.0, "gap": 0.4},
        lambda q, v: 3.0 * (q - 0.4) if q > 0.4 else 0.0,
        "neither",
    ),
    "quadratic_damping": ({"coefficient": 0.6}, lambda q, v: 0.6 * v * abs(v), "odd"),
    "cubic_damping": ({"coefficient": 0.6}, lambda q, v: 0.6 * v**3, "odd"),
    "van_der_pol_damping": ({"coefficient": 0.9}, lambda q, v: 0.9 * q * q * v, "odd"),
    "static_preload": ({"constant_force": -1.1}, lambda q, v: -1.1, "even"),
}
DISSIPATIVE = {"quadratic_damping", "cubic_damping", "van_der_pol_damping"}
STATES = [(q, v) for q in (-1.5, -0.41, -0.1, 0.0, 0.39, 0.7) for v in (-2.0, -0.3, 0.0, 1.1)]


# The other kinds with their parameters in order: CONTRACT.md's, and `close_mode`.
OTHER_KINDS = {
    "linear_frequency_shift": ("relative_shift",),
    "linear_damping_change": ("damping_ratio_change",),
    "added_mass": ("mass",),
    "frequency_drift": ("relative_drift",),
    "coulomb_friction": ("force",),
    "jenkins_slider": ("stiffness", "slip_displacement"),
    "iwan_microslip": ("coefficient", "exponent"),
    "force_gain_error": ("gain",),
    "force_offset_error": ("offset",),
    "sensor_gain_error": ("gain",),
    "sensor_phase_error": ("phase_deg",),
    "internal_resonance_1_3": ("coefficient", "frequency_hz", "damping_ratio"),
    "internal_resonance_1_2": ("coefficient", "frequency_hz", "damping_ratio"),
    "residual_mode": ("receptance",),
    "close_mode": ("modal_constant", "frequency_hz", "damping_ratio"),
    "mode_shape_change": ("coefficient",),
    "force_harmonics": ("second", "third"),
}
MODULES = (
    *(effect_base, stiffness, damping, friction),
    *(linear_changes, internal_resonances, measurement_chain),
)


def test_the_family_is_complete():
    assert set(EFFECTS) == set(FAMILY) | set(OTHER_KINDS)
    assert len(EFFECTS) == len(FAMILY) + len(OTHER_KINDS) == 27
    classes = {
        value
        for module in MODULES
        for _, value in inspect.getmembers(module, inspect.isclass)
        if issubclass(value, AbstractEffect) and not value.__name__.startswith("Abstract")
    }
    assert classes == set(EFFECTS.values())
    assert all(effect.kind == kind for kind, effect in EFFECTS.items())
    assert {k for k, e in EFFECTS.items() if issubclass(e, AbstractMemoryless)} == set(FAMILY)


@pytest.mark.parametrize("kind", OTHER_KINDS)
def test_parameters_in_order_and_as_arrays(kind):
    names = OTHER_KINDS[kind]
    assert effect_parameters(kind) == names
    values = dict.fromkeys(names, 0.5) | ({"exponent": 1.5} if "exponent" in names else {})
    effect = make_effect(kind, values)
    for name in names:
        value = getattr(effect, name)
        assert eqx.is_array(value)
        assert value.shape == ()


@pytest.mark.parametrize("kind", FAMILY)
def test_force_slopes_and_symmetry(kind):
    parameters, by_hand, parity = FAMILY[kind]
    assert effect_parameters(kind) == tuple(parameters)
    effect = make_effect(kind, parameters)
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
    if parity != "neither":
        np.testing.assert_array_equal(mirrored, -force if parity == "odd" else force)
    if kind in DISSIPATIVE:
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
