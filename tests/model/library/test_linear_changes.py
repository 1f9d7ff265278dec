"""Changes of the linear terms against structures that were built with them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from snrmjax.model.effects import make_effect
from snrmjax.model.modes import linear_modes
from snrmjax.model.structures import structure

FREQUENCY, RATIO = np.array([300.0, 500.0]), np.array([0.02, 0.01])


def changed(*effects, order=0.0, mode_of_interest=1):
    modes = linear_modes(
        FREQUENCY, RATIO, np.ones((1, 2)), np.ones(2), mode_of_interest=mode_of_interest
    )
    made = tuple(make_effect(kind, {name: value}) for kind, name, value in effects)
    model = dataclasses.replace(structure(modes, effects=made), test_order=jnp.asarray(order))
    return tuple(np.asarray(part) for part in model.linear_terms()[:3])


def terms_of(frequency, ratio, mass=(1.0, 1.0)):
    frequency, ratio = np.asarray(frequency), np.asarray(ratio)
    return np.asarray(mass), 2 * ratio * frequency, frequency**2


def assert_same(result, wanted):
    for part, other in zip(result, wanted, strict=True):
        np.testing.assert_allclose(part, other, rtol=4e-16)  # two roundings


def test_without_changes_the_terms_are_the_modes_own():
    assert_same(changed(), terms_of(FREQUENCY, RATIO))


@pytest.mark.parametrize("j", [0, 1])
def test_each_change_is_a_structure_built_with_it(j):
    def at(values, change):
        return [value + change * (k == j) for k, value in enumerate(values)]

    shift = ("linear_frequency_shift", "relative_shift", 0.03)
    wanted = terms_of(at(FREQUENCY, 0.03 * FREQUENCY[j]), RATIO)
    assert_same(changed(shift, mode_of_interest=j), wanted)
    assert_same(changed(shift, mode_of_interest=j, order=0.4), wanted)

    drift = ("frequency_drift", "relative_drift", -0.05)
    for order in (0.0, 0.4, 1.0):
        wanted = terms_of(at(FREQUENCY, -0.05 * order * FREQUENCY[j]), RATIO)
        assert_same(changed(drift, mode_of_interest=j, order=order), wanted)

    damping = ("linear_damping_change", "damping_ratio_change", -0.004)
    assert_same(changed(damping, mode_of_interest=j), terms_of(FREQUENCY, at(RATIO, -0.004)))

    mass = ("added_mass", "mass", 0.2)
    wanted = terms_of(FREQUENCY, RATIO, at((1.0, 1.0), 0.2))
    assert_same(changed(mass, mode_of_interest=j), wanted)


def test_changes_add_up():
    all_of_them = (
        ("linear_frequency_shift", "relative_shift", 0.03),
        ("frequency_drift", "relative_drift", -0.05),
        ("linear_damping_change", "damping_ratio_change", 0.004),
        ("added_mass", "mass", 0.2),
        ("added_mass", "mass", 0.1),
    )
    base = changed()
    together = changed(*all_of_them, order=0.7)
    alone = [changed(one, order=0.7) for one in all_of_them]
    for k in range(3):
        wanted = base[k] + sum(part[k] - base[k] for part in alone)
        np.testing.assert_allclose(together[k], wanted, rtol=1e-14)
    np.testing.assert_array_equal(together[0], [1.0, 1.3])


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("linear_frequency_shift", "relative_shift"),
        ("frequency_drift", "relative_drift"),
        ("linear_damping_change", "damping_ratio_change"),
        ("added_mass", "mass"),
    ],
)
def test_traced_parameters_and_their_slopes(kind, name):
    def terms(value, frequency, ratio, order):
        return jnp.stack(make_effect(kind, {name: value}).linear_terms(frequency, ratio, order))

    point = tuple(map(jnp.array, (0.1, 500.0, 0.01, 0.7)))
    slopes = jax.jit(jax.jacfwd(terms, argnums=(0, 1, 2, 3)))(*point)
    for k, slope in enumerate(slopes):
        step = 1e-4 * point[k]
        ends = [
            terms(*(p + sign * step * (i == k) for i, p in enumerate(point))) for sign in (1, -1)
        ]
        # At most cubic: h²/6·f''' and rounding 1e-16·5e4/(1e-4·0.01).
        np.testing.assert_allclose(slope, (ends[0] - ends[1]) / (2 * step), rtol=1e-7, atol=1e-5)
    many = jax.vmap(terms, in_axes=(0, None, None, None))(jnp.array([0.1, 0.2]), *point[1:])
    np.testing.assert_allclose(many[0], terms(*point), rtol=1e-15)
