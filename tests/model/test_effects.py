"""Effects: the force of each against a formula written here, its slopes, its power and its sign."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from snrmjax.model import effects
from snrmjax.model.effects import (
    DECLARED_EFFECTS,
    EFFECTS,
    AbstractEffect,
    effect_parameters,
    make_effect,
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


def test_the_family_is_complete():
    assert set(FAMILY) == set(EFFECTS)
    classes = {
        value
        for _, value in inspect.getmembers(effects, inspect.isclass)
        if issubclass(value, AbstractEffect) and value is not AbstractEffect
    }
    assert classes == set(EFFECTS.values())
    assert all(effect.kind == kind for kind, effect in EFFECTS.items())
    assert not DECLARED_EFFECTS & set(EFFECTS)


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
    # 1e-16·16/1e-5. The states keep that far from the kinks, where the slope must be finite.
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
        ("coulomb_friction", {"force": 1.0}, "unknown effect kind 'coulomb_friction'"),
        ("gap_stiffness", {"stiffness": 1.0}, r"takes the parameters \['stiffness', 'gap'\]"),
        ("cubic_damping", {"coefficient": 1.0, "gap": 1.0}, r"not \['coefficient', 'gap'\]"),
        ("cubic_damping", {"koefficient": 1.0}, "cubic_damping takes"),
        ("cubic_damping", {"coefficient": np.nan}, "`coefficient` of cubic_damping must be finite"),
    ],
)
def test_effects_that_do_not_exist_are_refused(kind, parameters, message):
    with pytest.raises(ValueError, match=message):
        make_effect(kind, parameters)
