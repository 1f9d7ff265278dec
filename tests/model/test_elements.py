"""Forces at points: against hand-written equations, and their files."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import snrmjax as sj
from snrmjax.model.attachment import between, influence_text, influence_vector
from snrmjax.model.effects import ELEMENTS
from snrmjax.model.structures import simulated_structure

MASS, STIFFNESS = np.diag([1.0, 2.0]), np.array([[3.0, -1.0], [-1.0, 2.0]])
DAMPING = np.array([[0.05, -0.03], [-0.03, 0.04]])


def two_masses(*effects, **settings):
    return sj.model.from_matrices(
        MASS, DAMPING, STIFFNESS, ("a", "b"), force="a", effects=effects, **settings
    )


def spring(value, at):
    return sj.model.make_effect("cubic_stiffness", {"coefficient": value}, at=at)


def physical(model, q):
    """Displacements of the points from modal ones."""
    return np.asarray(q) @ np.asarray(model.modes.mode_shape).T


def test_forces_act_on_points_and_between_them():
    model = two_masses(spring(2.0, "a"), spring(5.0, between("b", "a")))
    q = jnp.array([[0.3, -0.8], [1.1, 0.7], [-0.4, 0.1]])
    a, b = physical(model, q).T
    by_hand = np.stack([2 * a**3 - 5 * (b - a) ** 3, 5 * (b - a) ** 3], axis=1)
    wanted = by_hand @ np.asarray(model.modes.mode_shape)
    np.testing.assert_allclose(model.nonlinear_force(q, q), wanted, rtol=1e-12)
    energy = 0.5 * a**4 + 1.25 * (b - a) ** 4
    linear = 0.5 * np.einsum("ti,ij,tj->t", np.stack([a, b], 1), STIFFNESS, np.stack([a, b], 1))
    np.testing.assert_allclose(model.potential_energy(q), energy + linear, rtol=1e-12)


@pytest.mark.parametrize("at", [None, "a", between("a", "b")])
def test_forces_of_one_kind_at_one_place_add_up(at):
    one = two_masses(spring(5.0, at), spring(2.0, "b"))
    two = two_masses(spring(2.0, at), spring(3.0, at), spring(2.0, "b"))
    alone, twice = two_masses(spring(5.0, at)), two_masses(spring(2.0, at), spring(3.0, at))
    q = jnp.array([[0.3, -0.8], [1.1, 0.7], [-0.4, 0.1]])
    for first, second in ((one, two), (alone, twice)):
        np.testing.assert_allclose(
            first.nonlinear_force(q, q), second.nonlinear_force(q, q), rtol=1e-13
        )
        np.testing.assert_allclose(first.slopes(q, q)[0], second.slopes(q, q)[0], rtol=1e-13)


def test_a_further_mode_moves_no_point():
    """An internal resonance adds a mode that forces at points and coupled damping do not touch."""
    resonance = sj.model.make_effect(
        "internal_resonance_1_3", {"coefficient": 2.0, "frequency_hz": 1.0, "damping_ratio": 0.01}
    )
    model = two_masses(spring(2.0, "b"), resonance, sensors=["a"])
    wide = simulated_structure(model)
    assert wide.n_modes == 3
    q = jnp.array([[0.3, -0.8, 0.0], [1.1, 0.7, 0.0]])
    without = two_masses(spring(2.0, "b"))
    added = np.asarray(wide.nonlinear_force(q, q) - wide.potential.force(q))
    np.testing.assert_allclose(
        added[:, :2], without.nonlinear_force(q[:, :2], q[:, :2]), rtol=1e-13
    )
    assert not np.any(added[:, 2])
    matrix = np.asarray(wide.linear_terms().damping_matrix())
    np.testing.assert_allclose(matrix[:2, :2], without.linear_terms().damping_matrix(), rtol=1e-13)
    assert not np.any(matrix[2, :2])


def test_slopes_are_those_of_the_force():
    drag = sj.model.make_effect("cubic_damping", {"coefficient": 0.7}, at={"a": 2.0, "b": -0.5})
    own = sj.model.make_effect("quadratic_damping", {"coefficient": 0.3})
    model = two_masses(spring(2.0, "b"), drag, own, spring(4.0, "a"))
    q, v = jnp.array([[0.3, -0.8], [1.1, 0.7]]), jnp.array([[0.5, 0.2], [-0.4, 0.9]])
    stiffness, damping = model.slopes(q, v)
    for given, argument in ((stiffness, 0), (damping, 1)):
        wanted = jax.vmap(
            jax.jacfwd(lambda q, v: model.nonlinear_force(q[None], v[None])[0], argument)
        )
        np.testing.assert_allclose(given, wanted(q, v), rtol=1e-12, atol=1e-14)


def test_a_mass_on_a_spring_is_the_same_at_a_point_as_by_its_mode():
    """A slider at a point is the whole force, on the mode what slip takes from the linear part."""
    slip = {"stiffness": 0.25, "slip_displacement": 0.8}
    point = sj.model.from_matrices(
        [[1.0]],
        0.01,
        [[0.75]],
        force="x1",
        effects=sj.model.make_effect("jenkins_slider", slip, at="x1"),
    )
    modes = sj.model.linear_modes([1.0], [0.01 * 0.75**0.5], [[1.0]], [1.0])
    mode = sj.model.structure(modes, effects=sj.model.make_effect("jenkins_slider", slip))
    q = 1.7 * np.cos(2 * np.pi * np.arange(64) / 64)[:, None]
    q, v = jnp.asarray(q), jnp.zeros((64, 1))
    left = [m.modes.natural_frequency**2 * q + m.nonlinear_force(q, v) for m in (point, mode)]
    np.testing.assert_allclose(*left, rtol=0, atol=1e-14)


def test_the_energy_that_an_iwan_joint_loses_is_segalmans():
    """4 R u^(χ+3)/((χ+2)(χ+3)), with R from the four parameters by hand."""
    joint = sj.model.make_effect(
        "four_parameter_iwan",
        {"slip_force": 10.0, "stiffness": 0.6, "exponent": -0.5, "ratio": 0.5},
        at="x1",
    )
    end = 10 * 1.5 / (0.6 * (0.5 + 0.5 / 1.5))
    density = 10 * 0.5 / (end**1.5 * (0.5 + 0.5 / 1.5))
    assert float(joint.end) == pytest.approx(end)
    angle = 2 * np.pi * np.arange(4096) / 4096
    for u in (0.1, 1.0, 0.9 * end):
        x = u * np.cos(angle)
        force = np.asarray(joint.cycle_force(jnp.asarray(x), jnp.zeros(4096)))
        loss = np.sum(force * u * -np.sin(angle)) * angle[1]
        assert loss == pytest.approx(4 * density * u**2.5 / (1.5 * 2.5), rel=1e-4)
    far = np.asarray(joint.cycle_force(jnp.asarray(3 * end * np.cos(angle)), jnp.zeros(4096)))
    assert abs(far[1024]) == pytest.approx(10.0, rel=1e-9)  # all sliders slip


@pytest.mark.parametrize("kind", ELEMENTS)
def test_elements_are_no_candidates_of_a_diagnosis_but_printed_below_them(kind):
    assert kind not in sj.model.EFFECTS
    candidates, elements = str(sj.model.EFFECTS).split("\n\n")
    assert f"\n{kind} " in elements
    assert kind not in candidates


def test_a_preload_at_a_point_pushes_in_the_positive_direction():
    # As a weight: x = F/k on a spring k, and a stop 0.01 m away is reached by 0.33 of its force.
    push = sj.model.make_effect("static_preload", {"constant_force": 4.0}, at="x1")
    stop = sj.model.make_effect("one_sided_stop", {"stiffness": 300.0, "gap": 0.01}, at="x1")
    one = sj.model.builders.matrices.from_matrices(
        [[1.0]], 0.01, [[100.0]], force="x1", effects=[push, stop]
    )
    (rest,) = sj.model.equilibria(one)
    assert rest.displacement[0] == pytest.approx((4.0 + 3.0) / 400.0)  # m, as the mass is 1 kg


@pytest.mark.parametrize(
    ("former", "given", "kind", "named"),
    [
        ("static_load", {"load": 4.0}, "static_preload", {"constant_force": 4.0}),
        (
            *("regularised_friction", {"force_limit": 2.0, "velocity": 0.1}),
            *("regularised_friction", {"slip_force": 2.0, "velocity": 0.1}),
        ),
        ("coulomb_friction", {"slip_force": 2.0}, "coulomb_friction", {"force": 2.0}),
    ],
)
def test_former_and_further_names_are_accepted(former, given, kind, named, tmp_path):
    made = sj.model.make_effect(former, given, at="a")
    lines = [
        "[[effect]]",
        f'kind = "{former}"',
        'at = "a"',
        *(f"{k} = {v}" for k, v in given.items()),
    ]
    model = tmp_path / "model.toml"
    model.write_text(RIG + "\n".join(lines))
    for effect in (made, sj.read_model(model).effects[0]):
        assert effect.kind == kind
        assert {name: float(getattr(effect, name)) for name in effect.parameters()} == named


RIG = """[structure]
points = ["a"]
mass = [[1.0]]
stiffness = [[2.0]]
damping = [[0.01]]
[force]
at = "a"
"""


def test_names_that_contradict_are_refused(tmp_path):
    with pytest.raises(ValueError, match="static_load acts at points only"):
        sj.model.make_effect("static_load", {"load": 1.0})
    with pytest.raises(ValueError, match="two names of one parameter"):
        sj.model.make_effect("coulomb_friction", {"force": 1.0, "slip_force": 1.0})
    model = tmp_path / "model.toml"
    model.write_text(RIG + '[[effect]]\nkind = "static_load"\nload = 1.0\n')
    with pytest.raises(ValueError, match=r"model\.toml: static_load acts at points"):
        sj.read_model(model)


def test_a_linkage_is_a_spring_that_turns():
    link = sj.model.make_effect(
        "spring_linkage", {"stiffness": 3.0, "length": 0.4, "free_length": 0.5}, at="a"
    )
    x = 0.3  # 0.5 is then its length: no force; at −0.3 likewise, and in between it pushes out
    assert float(link.force(x, 0.0)) == pytest.approx(0.0, abs=1e-15)
    assert float(link.force(0.1, 0.0)) == pytest.approx(3 * 0.1 * (1 - 0.5 / np.hypot(0.1, 0.4)))


def test_rows_in_words():
    assert influence_text(influence_vector({"tip": 2.0, "root": -1.0})) == "2 tip - root"
    assert "cubic_stiffness at a - b: coefficient 2" in repr(
        two_masses(spring(2.0, between("a", "b")))
    )


@pytest.mark.parametrize(
    ("at", "message"),
    [
        ((), "at least one point"),
        ({"a": 0.0}, "must be a number"),
        ({"a": float("nan")}, "must be a number"),
        ({"a": "1"}, "must be a number"),
        ([("a", 1.0), ("a", 2.0)], "'a' twice"),
        ("c", r"acts at 'c', where the modes have no shape|'c', which does not exist"),
    ],
)
def test_places_that_do_not_exist_are_refused(at, message):
    with pytest.raises(ValueError, match=message):
        two_masses(spring(1.0, at))


def test_a_force_between_a_point_and_itself_is_refused():
    with pytest.raises(ValueError, match="'a' twice"):
        between("a", "a")


def test_what_is_no_force_acts_at_no_point():
    with pytest.raises(ValueError, match="frequency_drift is not a force"):
        sj.model.make_effect("frequency_drift", {"relative_drift": 0.1}, at="a")
