"""Internal resonances against structures that were built with the further mode."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from snrmjax.model.effects import make_effect
from snrmjax.model.modes import LinearModesStd, RigidBodyModes, linear_modes, linear_response
from snrmjax.model.potential import polynomial_potential
from snrmjax.model.structures import displacement_scale, simulated_structure, structure

THIRD = {"coefficient": 7.0, "frequency_hz": 30.0, "damping_ratio": 0.04}
SECOND = {"coefficient": -3.0, "frequency_hz": 20.0, "damping_ratio": 0.0}


def coupled(*effects, mode_of_interest=1):
    modes = linear_modes(
        [40.0, 60.0],
        [0.01, 0.02],
        [[1.0, 2.0], [3.0, 4.0], [5.0, -6.0]],
        [1.5, -2.5],
        mode_of_interest=mode_of_interest,
        rigid_body=RigidBodyModes(np.ones((3, 1)), np.ones(1)),
        std=LinearModesStd([0.1, 0.2], [0.001, 0.002]),
    )
    potential = polynomial_potential(
        {"1111": 2.0, "112": 0.5, "222222": 1.0}, 2, coefficient_std={"112": 0.1}
    )
    made = structure(
        modes, potential, effects=effects, level_gain_std=0.01, level_phase_std=0.02, name="coupled"
    )
    return dataclasses.replace(made, test_order=jnp.asarray(0.3))


def by_hand(extra, frequencies_hz, ratios, mode_of_interest, effects):
    n = len(frequencies_hz)
    modes = linear_modes(
        [40.0, 60.0, *(2 * np.pi * np.array(frequencies_hz))],
        [0.01, 0.02, *ratios],
        np.hstack([[[1.0, 2.0], [3.0, 4.0], [5.0, -6.0]], np.zeros((3, n))]),
        [1.5, -2.5, *[0.0] * n],
        mode_of_interest=mode_of_interest,
        rigid_body=RigidBodyModes(np.ones((3, 1)), np.ones(1)),
        std=LinearModesStd([0.1, 0.2, *[0.0] * n], [0.001, 0.002, *[0.0] * n]),
    )
    potential = polynomial_potential(
        {"1111": 2.0, "112": 0.5, "222222": 1.0} | extra, 2 + n, coefficient_std={"112": 0.1}
    )
    made = structure(
        modes, potential, effects=effects, level_gain_std=0.01, level_phase_std=0.02, name="coupled"
    )
    return dataclasses.replace(made, test_order=jnp.asarray(0.3))


def assert_same(one, other):
    a, tree_a = jax.tree.flatten(one)
    b, tree_b = jax.tree.flatten(other)
    assert tree_a == tree_b
    for x, y in zip(a, b, strict=True):
        np.testing.assert_array_equal(x, y)


DRAG = make_effect("quadratic_damping", {"coefficient": 0.3})


@pytest.mark.parametrize(
    ("parts", "j", "extra", "frequencies", "ratios"),
    [
        ((("internal_resonance_1_3", THIRD),), 1, {"2223": 7.0}, [30.0], [0.04]),
        ((("internal_resonance_1_2", SECOND),), 0, {"113": -3.0}, [20.0], [0.0]),
        (
            (("internal_resonance_1_3", THIRD), ("internal_resonance_1_2", SECOND)),
            1,
            {"2223": 7.0, "224": -3.0},
            [30.0, 20.0],
            [0.04, 0.0],
        ),
    ],
)
def test_expanded_structure_is_the_one_built_by_hand(parts, j, extra, frequencies, ratios):
    made = [make_effect(kind, parameters) for kind, parameters in parts]
    model = coupled(made[0], DRAG, *made[1:], mode_of_interest=j)
    expanded = simulated_structure(model)
    wanted = dataclasses.replace(by_hand(extra, frequencies, ratios, j, (DRAG,)), name="")
    assert_same(expanded, wanted)
    assert simulated_structure(expanded) is expanded
    assert model.n_modes == 2  # the model itself stays
    assert np.all(displacement_scale(expanded) > 0)
    # The linear response does not see the further mode.
    at = jnp.array([45.0, 70.0]), jnp.array([1.0, 2.0])
    np.testing.assert_array_equal(
        linear_response(expanded.modes, *at), linear_response(model.modes, *at)
    )


def test_without_a_further_mode_it_is_the_model_without_its_name():
    model = coupled(DRAG)
    simulated = simulated_structure(model)
    assert_same(simulated, dataclasses.replace(model, name=""))
    assert simulated_structure(simulated) is simulated


def test_force_of_the_coupling_and_its_slopes():
    @eqx.filter_jit
    def force(parameters, q):
        effect = make_effect("internal_resonance_1_3", parameters)
        expanded = simulated_structure(coupled(effect))
        return expanded.nonlinear_force(q, jnp.zeros_like(q))

    q = jnp.array([[0.3, -0.8, 0.4], [1.1, 0.7, -0.2]])
    added = force(THIRD, q) - force(THIRD | {"coefficient": 0.0}, q)
    y, z = np.asarray(q)[:, 1], np.asarray(q)[:, 2]
    wanted = np.stack([0 * y, 3 * 7.0 * y**2 * z, 7.0 * y**3], axis=1)
    np.testing.assert_allclose(added, wanted, atol=1e-14)  # rounding
    slope = jax.jacfwd(lambda b: force(THIRD | {"coefficient": b}, q))(jnp.array(7.0))
    np.testing.assert_allclose(slope, wanted / 7.0, atol=1e-14)
    stiffness = jax.grad(
        lambda f: (
            simulated_structure(
                coupled(make_effect("internal_resonance_1_2", SECOND | {"frequency_hz": f}))
            )
            .linear_terms()
            .stiffness[-1]
        )
    )(jnp.array(20.0))
    assert float(stiffness) == pytest.approx(2 * (2 * np.pi) ** 2 * 20.0, rel=1e-14)
