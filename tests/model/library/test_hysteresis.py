"""Bouc and Wen's law and contacts with normal motion, against integrations of their own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import snrmjax as sj

TAU = 2 * np.pi * np.arange(256) / 256


def bouc_wen(at="x1", **changed):
    values = {"stiffness": 2.0, "slip_force": 1.0, "exponent": 1.5, "unloading": 0.7}
    return sj.model.make_effect("bouc_wen", values | changed, at=at)


def path(tau):
    """A motion with four turning points, and its rate."""
    return (
        1.3 * np.cos(tau) + 0.8 * np.cos(2 * tau + 0.3) + 0.2,
        -1.3 * np.sin(tau) - 1.6 * np.sin(2 * tau + 0.3),
    )


def test_bouc_wen_is_the_steady_solution_of_its_equation():
    def rate(tau, f):
        v = path(tau)[1]
        return 2 * v * (1 - np.abs(f) ** 1.5 * (0.7 * np.sign(v * f) + 0.3))

    times = np.append(6 * np.pi + TAU, 8 * np.pi)
    options = {"rtol": 1e-9, "atol": 1e-10, "max_step": 0.02}
    wanted = solve_ivp(rate, (0, 8 * np.pi), [0.0], t_eval=times, **options).y[0, :-1]
    x, v = map(jnp.asarray, path(TAU))
    np.testing.assert_allclose(bouc_wen().cycle_force(x, v), wanted, atol=3e-6)
    np.testing.assert_allclose(
        bouc_wen(at=None).cycle_force(x, v), wanted - 2 * np.asarray(x), atol=3e-6
    )


def test_bouc_wen_loses_what_a_sharp_slider_loses():
    """With a large exponent it is a slider of the limit F: 4F(X − F/k) a cycle."""
    x = 4.0 * np.cos(TAU)
    force = bouc_wen(exponent=40.0, unloading=0.5).cycle_force(jnp.asarray(x), jnp.asarray(x))
    loss = np.sum(np.asarray(force) * 4.0 * -np.sin(TAU)) * TAU[1]
    assert loss == pytest.approx(4 * 1.0 * (4.0 - 0.5), rel=5e-3)


@pytest.mark.parametrize("size", [1e-9, 1e-3, 50.0])
def test_bouc_wen_from_sticking_to_sliding(size):
    force = np.asarray(bouc_wen().cycle_force(jnp.asarray(size * np.cos(TAU)), jnp.asarray(TAU)))
    largest = 2 * size if size < 1 else 1.0
    assert np.abs(force).max() == pytest.approx(largest, rel=2e-3)
    assert force[128] == pytest.approx(-force[0], rel=2e-3)


def contact(**changed):
    values = {"stiffness": 5.0, "normal_stiffness": 21.0, "friction": 0.85, "preload": 3.0}
    return sj.model.make_effect("friction_contact", values | changed, at="x", normal_at="y")


@pytest.mark.parametrize(
    "effect",
    [
        pytest.param(bouc_wen(), id="bouc_wen", marks=pytest.mark.long),
        pytest.param(contact(), id="friction_contact"),
    ],
)
def test_derivatives_are_those_of_differences(effect):
    x, v = map(jnp.asarray, path(TAU))
    if len(effect.influence_vectors) == 2:
        x = jnp.stack([x, 0.3 * jnp.roll(x, 40)], axis=1)
        v = jnp.stack([v, v], axis=1)
    way = jnp.asarray(np.sin(3 * TAU)).reshape(-1, *[1] * (x.ndim - 1)) * jnp.ones_like(x)

    def force(x, effect):
        return effect.cycle_force(x, v)

    along = jax.jvp(lambda x: force(x, effect), (x,), (way,))[1]
    step = 1e-6
    change = (force(x + step * way, effect) - force(x - step * way, effect)) / (2 * step)
    np.testing.assert_allclose(along, change, atol=2e-6 * float(jnp.abs(along).max()))
    for name in effect.parameters():
        value = getattr(effect, name)

        def of(value, name=name):
            return force(x, jax.tree.unflatten(*_with(effect, name, value)))

        along = jax.jvp(of, (value,), (jnp.ones(()),))[1]
        change = (of(value + step) - of(value - step)) / (2 * step)
        np.testing.assert_allclose(along, change, atol=1e-5 * (1 + float(jnp.abs(along).max())))


def _with(effect, name, value):
    leaves, kind = jax.tree.flatten(effect)
    names = list(effect.parameters())
    leaves[names.index(name)] = value
    return kind, leaves


def test_a_contact_needs_two_places_and_others_take_one():
    with pytest.raises(ValueError, match="needs two attachments: `at`"):
        sj.model.make_effect("friction_contact", dict.fromkeys(contact().parameters(), 1.0), at="x")
    with pytest.raises(ValueError, match="takes no `normal_at`"):
        sj.model.make_effect("cubic_stiffness", {"coefficient": 1.0}, at="x", normal_at="y")
    with pytest.raises(ValueError, match="`preload` of friction_contact must be zero or positive"):
        contact(preload=-1.0)


def test_files_hold_both_places_of_a_contact(tmp_path):
    modes = sj.model.linear_modes(
        [1.0, 2.0], [0.01, 0.01], [[1.0, 0.0], [0.0, 1.0]], [1.0, 1.0], sensors=["x", "y"]
    )
    sj.io.write_model(tmp_path / "m.toml", sj.model.structure(modes, effects=contact()))
    again = sj.read_model(tmp_path / "m.toml").effects[0]
    assert again.influence_vectors == contact().influence_vectors
    assert float(again.preload) == 3.0
    text = (tmp_path / "m.toml").read_text()
    (tmp_path / "m.toml").write_text(text.replace('normal_at = "y"', 'normal_between = ["y", "x"]'))
    assert sj.read_model(tmp_path / "m.toml").effects[0].influence_vectors[1] == (
        ("y", 1.0),
        ("x", -1.0),
    )
