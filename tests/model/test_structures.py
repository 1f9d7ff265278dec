"""Structures: forces and tangents against differences, and equilibria against exact ones."""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.kinds import MEMORYLESS

from snrmjax.model.builders.beams import flat_beam
from snrmjax.model.effects import make_effect
from snrmjax.model.modes import linear_modes
from snrmjax.model.potential import polynomial_potential
from snrmjax.model.structures import displacement_scale, equilibria, structure


def modes_of(*frequency, mode_of_interest=0):
    n = len(frequency)
    return linear_modes(
        list(frequency), [0.01] * n, np.ones((1, n)), [1.0] * n, mode_of_interest=mode_of_interest
    )


def single(frequency=2.0, potential=None, **effects):
    made = tuple(make_effect(kind, parameters) for kind, parameters in effects.items())
    return structure(
        modes_of(frequency), polynomial_potential(potential or {}, 1), effects=made, name="one"
    )


# ------------------------------------------------------------------------- forces and tangents


def with_all_effects():
    """Two coupled modes; every memoryless effect acts on the second, which is of interest."""
    return structure(
        modes_of(2.0, 5.0, mode_of_interest=1),
        polynomial_potential({"111": 0.5, "1122": 0.7, "222": -0.2}, 2),
        effects=tuple(make_effect(k, of.parameters) for k, of in MEMORYLESS.items()),
    )


def test_effects_add_to_the_mode_of_interest_alone():
    model = with_all_effects()
    q = jnp.array([[0.3, -0.8], [1.1, 0.7], [-0.4, 0.1]])
    v = jnp.array([[2.0, 0.4], [-0.3, -1.2], [0.1, 0.9]])
    force = np.asarray(model.memoryless_force(q, v))
    # ∂V/∂q by hand.
    x, y = np.asarray(q).T
    by_hand = np.stack([1.5 * x**2 + 1.4 * x * y**2, 1.4 * x**2 * y - 0.6 * y**2], axis=1)
    added = force - by_hand
    np.testing.assert_allclose(added[:, 0], 0.0, atol=1e-15)  # rounding
    wanted = [
        sum(float(e.force(q[k, 1], v[k, 1])) for e in model.effects) for k in range(len(force))
    ]
    np.testing.assert_allclose(added[:, 1], wanted, rtol=1e-13)


def test_tangents_against_central_differences():
    model = with_all_effects()
    # Away from the corners of gap (0.3), stop (0.2) and the zeros of |q| and |q̇|.
    q = jnp.array([[0.3, -0.8], [1.1, 0.7], [-0.4, 0.1]])
    v = jnp.array([[2.0, 0.4], [-0.3, -1.2], [0.1, 0.9]])
    step = 1e-5
    force = partial(eqx.filter_jit(type(model).memoryless_force), model)
    stiffness, damping = map(np.asarray, eqx.filter_jit(type(model).slopes)(model, q, v))
    # h²/6·|f'''| ≤ 1e-10/6·120 and rounding 10·1e-16/1e-5.
    for mode in range(2):
        shift = step * jnp.eye(2)[mode]
        slope = (force(q + shift, v) - force(q - shift, v)) / (2 * step)
        np.testing.assert_allclose(stiffness[:, :, mode], slope, rtol=0, atol=3e-9)
        slope = (force(q, v + shift) - force(q, v - shift)) / (2 * step)
        np.testing.assert_allclose(damping[:, :, mode], slope, rtol=0, atol=3e-9)


def test_potential_energy_is_the_work_of_the_forces():
    model = with_all_effects()
    q = np.array([0.9, -0.8])
    # Work along the straight line from rest by the trapezoidal rule with 20001 samples, whose
    # error at the corners is below 1e-8; Gauss's 64 points leave about 1e-4 there.
    fraction = np.linspace(0, 1, 20001)[:, None]
    path = fraction * q
    forces = eqx.filter_jit(type(model).nonlinear_force)
    force = np.asarray(forces(model, jnp.asarray(path), jnp.zeros(path.shape)))
    force = force + np.asarray(model.modes.natural_frequency) ** 2 * path
    work = np.trapezoid(force @ q, fraction[:, 0])
    energy = eqx.filter_jit(type(model).potential_energy)(model, jnp.asarray([q, 0 * q]))
    assert float(energy[0]) == pytest.approx(work, rel=1e-4)
    assert float(energy[1]) == 0.0
    smooth = single(potential={"111": 1.0}, cubic_stiffness={"coefficient": 4.0})
    q = jnp.array([[0.5], [-2.0]])
    wanted = 0.5 * 4 * q**2 + q**3 + q**4
    np.testing.assert_allclose(smooth.potential_energy(q), wanted[:, 0], rtol=1e-13)


def with_friction():
    """Two modes with a potential and every sort of effect; the first mode is of interest."""
    kinds = {
        "coulomb_friction": {"force": 0.3},
        "cubic_stiffness": {"coefficient": 1.3},
        "jenkins_slider": {"stiffness": 9.0, "slip_displacement": 0.4},
        "added_mass": {"mass": 0.5},
        "iwan_microslip": {"coefficient": 2.0, "exponent": 1.5},
        "sensor_gain_error": {"gain": 0.1},
        "quadratic_damping": {"coefficient": 0.6},
        "linear_frequency_shift": {"relative_shift": 0.1},
        "force_harmonics": {"second": 0.1, "third": 0.2},
        "internal_resonance_1_3": {"coefficient": 5.0, "frequency_hz": 1.0, "damping_ratio": 0.1},
    }
    return structure(
        modes_of(2.0, 5.0),
        polynomial_potential({"1122": 0.7}, 2),
        effects=tuple(make_effect(kind, parameters) for kind, parameters in kinds.items()),
    )


def test_friction_acts_over_the_cycle_and_nowhere_else():
    model = with_friction()
    kinds = [[e.kind for e in part] for part in (model.memoryless, model.hysteretic)]
    assert kinds == [
        ["cubic_stiffness", "quadratic_damping"],
        ["coulomb_friction", "jenkins_slider", "iwan_microslip"],
    ]
    t = 2 * np.pi * np.arange(32)[:, None] / 32
    t = t + np.array([0.1, 0.7])
    q, v = jnp.asarray(np.cos(t)), jnp.asarray(-3 * np.sin(t))
    # Potential and memoryless effects by hand.
    x, y = np.asarray(q).T
    pace = np.asarray(v)[:, 0]
    smooth = np.stack([1.4 * x * y**2 + 1.3 * x**3 + 0.6 * pace * abs(pace), 1.4 * x**2 * y], 1)
    memoryless = eqx.filter_jit(type(model).memoryless_force)(model, q, v)
    np.testing.assert_allclose(memoryless, smooth, rtol=0, atol=1e-14)  # rounding
    added = np.asarray(eqx.filter_jit(type(model).nonlinear_force)(model, q, v)) - smooth
    np.testing.assert_allclose(added[:, 1], 0.0, atol=1e-14)
    wanted = sum(np.asarray(e.cycle_force(q[:, 0], v[:, 0])) for e in model.hysteretic)
    np.testing.assert_allclose(added[:, 0], wanted, rtol=0, atol=1e-14)
    assert np.max(np.abs(wanted)) > 1.0
    # Tangents: those of the part without friction.
    stiffness, damping = eqx.filter_jit(type(model).slopes)(model, q, v)
    np.testing.assert_allclose(stiffness[:, 0, 0], 1.4 * y**2 + 3.9 * x**2, rtol=1e-13)
    np.testing.assert_allclose(damping[:, 0, 0], 1.2 * abs(pace), rtol=1e-13)
    assert not np.any(damping[:, :, 1])
    assert not np.any(damping[:, 1])


def test_statics_know_linear_changes_and_no_friction():
    # k = ω²(1 + 0.1)² = 4.84; a q³ with a = −1.21 gives q = ±2, where the energy is kq²/4.
    effects = {
        "cubic_stiffness": {"coefficient": -1.21},
        "linear_frequency_shift": {"relative_shift": 0.1},
        "jenkins_slider": {"stiffness": 9.0, "slip_displacement": 0.01},
        "iwan_microslip": {"coefficient": 2.0, "exponent": 1.5},
        "coulomb_friction": {"force": 5.0},
    }
    result = equilibria(single(**effects))
    positions = sorted(float(e.displacement[0]) for e in result)
    np.testing.assert_allclose(positions, [-2, 0, 2], atol=1e-9)
    assert [e.stable for e in result] == [True, False, False]
    assert result[-1].energy == pytest.approx(4.84, rel=1e-9)
    # Where the force changes by a tenth of the linear one; the grid is 6 % wide.
    scale = displacement_scale(single(**effects))
    assert scale[0] == pytest.approx(np.sqrt(0.1 * 4.84 / 1.21), rel=0.06)
    # The same by the roots of the potential's polynomial, without memoryless effects.
    del effects["cubic_stiffness"]
    result = equilibria(single(potential={"1111": -1.21 / 4}, **effects))
    positions = sorted(float(e.displacement[0]) for e in result)
    np.testing.assert_allclose(positions, [-2, 0, 2], atol=1e-12)
    assert displacement_scale(single(**effects)) == [1e-3]
    # k = ω²(1 − 0.9)² = 0.04 and the force 0.02 q(q − 1)(q − 2): 1 is unstable, but only with k.
    shift = {"linear_frequency_shift": {"relative_shift": -0.9}}
    result = equilibria(single(potential={"111": -0.02, "1111": 0.005}, **shift))
    np.testing.assert_allclose([e.displacement[0] for e in result], [0, 1, 2], atol=1e-12)
    assert [e.stable for e in result] == [True, False, True]


# ----------------------------------------------------------------------------------- equilibria


def test_equilibria_of_one_mode_are_the_roots_of_its_force():
    # ω²q − 5q³ + q⁵ = 0 with ω² = 4: q² = 1 or 4.
    model = single(potential={"1111": -5 / 4, "111111": 1 / 6})
    result = equilibria(model)
    np.testing.assert_allclose(
        sorted(float(e.displacement[0]) for e in result), [-2, -1, 0, 1, 2], atol=1e-12
    )
    distance = [abs(float(e.displacement[0])) for e in result]
    assert distance == sorted(distance)
    assert {round(float(e.displacement[0])): e.stable for e in result} == {
        0: True,
        1: False,
        -1: False,
        2: True,
        -2: True,
    }
    # V = 2q² − (5/4)q⁴ + q⁶/6.
    assert result[-1].energy == pytest.approx(8 - 20 + 64 / 6, abs=1e-11)


def test_equilibria_of_two_modes_are_found_by_search():
    # Each mode like the one above with its own scale: 5 × 5 equilibria on a grid, exactly.
    scale = 3.0
    model = structure(
        modes_of(2.0, 2.0),
        polynomial_potential(
            {
                "1111": -5 / 4,
                "111111": 1 / 6,
                "2222": -5 / 4 / scale**2,
                "222222": 1 / 6 / scale**4,
            },
            2,
        ),
    )
    result = equilibria(model)
    positions = {tuple(np.rint(e.displacement / [1, scale]).astype(int)) for e in result}
    assert positions == {(a, b) for a in range(-2, 3) for b in range(-2, 3)}
    assert len(result) == 25
    for e in result:
        exact = np.rint(e.displacement / [1, scale]) * [1, scale]
        np.testing.assert_allclose(e.displacement, exact, atol=1e-8)  # Newton's own tolerance
        assert e.stable == all(abs(k) != 1 for k in np.rint(e.displacement / [1, scale]))


def test_flat_beam_has_one_equilibrium():
    only = equilibria(flat_beam())
    assert len(only) == 1
    np.testing.assert_allclose(only[0].displacement, 0.0, atol=1e-12)
    assert only[0].stable


def test_equilibria_with_effects():
    # A constant force on a linear spring: q = −f/ω², energy −f²/2ω² with the work of the force.
    (only,) = equilibria(single(static_preload={"constant_force": 0.6}))
    assert only.displacement[0] == pytest.approx(-0.15, rel=1e-9)
    assert only.energy == pytest.approx(-0.5 * 0.6**2 / 4, rel=1e-9)
    # ω²q + aq² = 0: q = −ω²/a is a saddle, with energy ω²q²/2 + aq³/3 = ω⁶/6a².
    rest, saddle = equilibria(single(quadratic_stiffness={"coefficient": 2.0}))
    assert rest.displacement[0] == pytest.approx(0.0, abs=1e-12)
    assert saddle.displacement[0] == pytest.approx(-2.0, rel=1e-9)
    assert not saddle.stable
    assert saddle.energy == pytest.approx(4.0**3 / (6 * 2.0**2), rel=1e-9)


# --------------------------------------------------------------------------------------- scales


def test_displacement_scale_is_where_the_nonlinearity_matters():
    # ω²q = 4c q³ at q = ω/√(4c).
    model = structure(modes_of(2.0, 6.0), polynomial_potential({"1111": 25.0, "1122": 9.0}, 2))
    np.testing.assert_allclose(displacement_scale(model), [0.2, 0.2], rtol=1e-13)
    np.testing.assert_allclose(displacement_scale(single()), [1e-3])  # linear: any will do
    # Effects: where the static force changes by a tenth of the linear one; the grid is 6 % wide.
    for effect, wanted in (
        ({"cubic_stiffness": {"coefficient": 100.0}}, np.sqrt(0.1 * 4 / 100)),
        ({"gap_stiffness": {"stiffness": 40.0, "gap": 0.3}}, 0.3 * 40 / (40 - 0.4)),
        ({"one_sided_stop": {"stiffness": 40.0, "gap": 0.3}}, 0.3 * 40 / (40 - 0.4)),
        ({"static_preload": {"constant_force": 5.0}}, 1e-3),
        ({"bilinear_stiffness": {"stiffness": 5.0}}, 1e-3),
        ({"cubic_damping": {"coefficient": 5.0}}, 1e-3),
    ):
        assert displacement_scale(single(**effect))[0] == pytest.approx(wanted, rel=0.06)


def test_a_structure_of_mismatched_parts_is_refused():
    with pytest.raises(ValueError, match="`potential` is for 2 modes, but `modes` has 1"):
        structure(modes_of(2.0), polynomial_potential({"12": 1.0}, 2))


def test_what_is_not_said_is_linear_and_exact():
    model = structure(modes_of(2.0, 3.0))
    q = jnp.ones((4, 2))
    assert not np.any(model.nonlinear_force(q, q))
    assert [not np.any(by) and by.shape == (4, 2, 2) for by in model.slopes(q, q)] == [True] * 2
    assert (float(model.level_gain_std), float(model.level_phase_std)) == (0.0, 0.0)
    assert float(model.test_order) == 0.0
    assert model.memoryless == model.hysteretic == model.measurement_effects == ()
    mass, damping, stiffness, _ = model.linear_terms()
    np.testing.assert_array_equal(mass, [1.0, 1.0])
    np.testing.assert_array_equal(damping, [0.04, 0.06])
    np.testing.assert_array_equal(stiffness, [4.0, 9.0])
    assert (model.n_modes, model.name, model.effects) == (2, "structure", ())


def test_a_structure_says_itself_on_one_screen():
    slider = make_effect("jenkins_slider", {"stiffness": 9.0, "slip_displacement": 2e-4})
    model = dataclasses.replace(flat_beam(), effects=(slider,), level_gain_std=jnp.asarray(0.01))
    text = repr(model)
    assert len(text.splitlines()) < 20
    for part in (
        "mode 1: 79.02 Hz, damping 5 %, of interest",
        "55 terms",
        "0.01",
        "stiffness 9 1/s²",
    ):
        assert part in text
    assert "slip_displacement 0.0002 √kg m" in text
    seen = []
    jax.jit(lambda m: seen.append(repr(m)) or m.modes.participation)(model)
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), model)
    for shapes in (seen[0], repr(batch), repr(batch.modes), repr(jax.tree.map(lambda _: 1, model))):
        assert "natural_frequency=" in shapes
