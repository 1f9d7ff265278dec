"""What the instruments write down, against the definitions of each error."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from snrmjax.model.effects import make_effect
from snrmjax.model.modes import linear_modes
from snrmjax.model.structures import structure

RANDOM = np.random.default_rng(3)
FREQUENCY = np.array([450.0, 500.0, 510.0])
FORCE = np.array([0.5, 2.0, 8.0])
VELOCITY = RANDOM.normal(size=(3, 4, 2)) + 1j * RANDOM.normal(size=(3, 4, 2))
DISPLACEMENT = np.array([1e-3, 0.02, 0.3])
TRUE = tuple(map(jnp.asarray, (FREQUENCY, FORCE, VELOCITY, DISPLACEMENT)))


def written(kind, **parameters):
    force, velocity = make_effect(kind, parameters).recorded(*TRUE)
    assert (force.shape, velocity.shape) == ((3,), (3, 4, 2))
    return np.asarray(force), np.asarray(velocity)


def residual(velocity, receptance, force):
    velocity = velocity.copy()
    velocity[:, 1] += (1j * FREQUENCY * receptance * force)[:, None]
    return velocity


def test_the_force_is_written_down_wrongly():
    force, velocity = written("force_gain_error", gain=0.25)
    np.testing.assert_allclose(force * 1.25, FORCE, rtol=1e-15)
    np.testing.assert_array_equal(velocity, VELOCITY)
    force, velocity = written("force_offset_error", offset=-0.4)
    np.testing.assert_allclose(force - 0.4, FORCE, rtol=1e-15)
    np.testing.assert_array_equal(velocity, VELOCITY)


def test_the_velocity_is_written_down_wrongly():
    force, velocity = written("sensor_gain_error", gain=-0.1)
    np.testing.assert_array_equal(force, FORCE)
    np.testing.assert_allclose(velocity, 0.9 * VELOCITY, rtol=1e-15)

    force, velocity = written("sensor_phase_error", phase_deg=30.0)
    np.testing.assert_array_equal(force, FORCE)
    # A shift in time: the velocity at the phases Ωt + 30° of the true one.
    phase, order = np.linspace(0, 2 * np.pi, 9), np.arange(4)
    samples = np.einsum("shx,ht->sxt", velocity, np.exp(1j * np.outer(order, phase)))
    shifted = np.exp(1j * np.outer(order, phase + np.pi / 6))
    np.testing.assert_allclose(samples, np.einsum("shx,ht->sxt", VELOCITY, shifted), rtol=1e-13)
    np.testing.assert_allclose(np.angle(velocity[:, 1] / VELOCITY[:, 1], deg=True), 30, rtol=1e-13)


def test_the_structure_shows_the_sensors_something_else():
    force, velocity = written("residual_mode", receptance=2e-3)
    np.testing.assert_array_equal(force, FORCE)
    np.testing.assert_allclose(velocity, residual(VELOCITY, 2e-3, FORCE), rtol=1e-15)
    # As a displacement: X + R F.
    added = (velocity - VELOCITY)[:, 1] / (1j * FREQUENCY)[:, None]
    np.testing.assert_allclose(added, np.outer(2e-3 * FORCE, [1, 1]), rtol=1e-12)

    force, velocity = written("mode_shape_change", coefficient=5.0)
    np.testing.assert_array_equal(force, FORCE)
    for k, q in enumerate(DISPLACEMENT):
        np.testing.assert_allclose(velocity[k], VELOCITY[k] * (1 + 5 * q**2), rtol=1e-15)


def test_a_close_mode_is_what_two_masses_have_beside_the_first_mode():
    """Two masses solved at once, against one of their modes and the other as `close_mode`."""
    stiffness = np.array([[260000.0, -9000.0], [-9000.0, 250000.0]])
    squares, shapes = np.linalg.eigh(stiffness)
    ratios, omega = np.array([0.01, 0.02]), np.sqrt(squares)
    damping = shapes @ np.diag(2 * ratios * omega) @ shapes.T
    own = np.array([480.0, 505.0, 530.0])
    both = [
        1j * w * np.linalg.solve(stiffness - w**2 * np.eye(2) + 1j * w * damping, [0.0, f])[0]
        for w, f in zip(own, FORCE, strict=True)
    ]
    constant = shapes[0] * shapes[1]
    first = squares[0] - own**2 + 2j * ratios[0] * omega[0] * own
    seen = np.zeros((3, 4, 1), dtype=complex)
    seen[:, 1, 0] = 1j * own * constant[0] * FORCE / first
    hz = omega[1] / (2 * np.pi)
    parameters = {"modal_constant": constant[1], "frequency_hz": hz, "damping_ratio": ratios[1]}
    effect = make_effect("close_mode", parameters)
    force, velocity = effect.recorded(*map(jnp.asarray, (own, FORCE, seen, DISPLACEMENT)))
    np.testing.assert_array_equal(force, FORCE)
    np.testing.assert_allclose(velocity[:, 1, 0], both, rtol=1e-12)
    np.testing.assert_array_equal(velocity[:, [0, 2, 3]], 0)


def single(*effects):
    modes = linear_modes([500.0], [0.01], [[1.0]], [1.0])
    return structure(modes, effects=effects)


def test_the_structure_comes_before_the_instruments_in_any_order():
    parts = [
        make_effect("force_gain_error", {"gain": 0.25}),
        make_effect("sensor_gain_error", {"gain": -0.1}),
        make_effect("residual_mode", {"receptance": 2e-3}),
        make_effect("mode_shape_change", {"coefficient": 5.0}),
    ]
    shape = VELOCITY * (1 + 5 * DISPLACEMENT**2)[:, None, None]
    wanted = 0.9 * residual(shape, 2e-3, FORCE)
    other = make_effect("cubic_stiffness", {"coefficient": 1.0})
    for order in itertools.permutations(parts):
        effects = single(*order[:2], other, *order[2:]).measurement_effects
        assert sorted(e.kind for e in effects) == sorted(e.kind for e in order)
        force, velocity = TRUE[1:3]
        for effect in effects:
            force, velocity = effect.recorded(TRUE[0], force, velocity, TRUE[3])
        np.testing.assert_allclose(force, FORCE / 1.25, rtol=1e-15)
        np.testing.assert_allclose(velocity, wanted, rtol=1e-14)


def test_instruments_of_one_kind_act_in_the_order_of_the_file():
    gain = make_effect("force_gain_error", {"gain": 0.25})
    offset = make_effect("force_offset_error", {"offset": 0.1})
    for order in ((gain, offset), (offset, gain)):
        result = single(*order).measurement_effects
        assert [e.kind for e in result] == [e.kind for e in order]


def test_force_harmonics():
    np.testing.assert_array_equal(single().load_orders(), [0, 1, 0, 0])
    one = make_effect("force_harmonics", {"second": 0.02, "third": -0.03})
    np.testing.assert_array_equal(one.load_orders(), [0, 1, 0.02, -0.03])
    np.testing.assert_array_equal(single(one).load_orders(), [0, 1, 0.02, -0.03])
    other = make_effect("force_harmonics", {"second": 0.5, "third": 0.0})
    np.testing.assert_array_equal(single(one, other).load_orders(), [0, 1, 0.52, -0.03])


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("force_gain_error", "gain"),
        ("force_offset_error", "offset"),
        ("sensor_gain_error", "gain"),
        ("sensor_phase_error", "phase_deg"),
        ("residual_mode", "receptance"),
        ("close_mode", "modal_constant"),
        ("mode_shape_change", "coefficient"),
    ],
)
def test_zero_is_no_error_and_slopes_are_exact(kind, name):
    others = {"frequency_hz": 80.0, "damping_ratio": 0.01} if kind == "close_mode" else {}
    force, velocity = written(kind, **{name: 0.0}, **others)
    np.testing.assert_array_equal(force, FORCE)
    np.testing.assert_array_equal(velocity, VELOCITY)

    @jax.jit
    def both(value):
        force, velocity = make_effect(kind, {name: value, **others}).recorded(*TRUE)
        flat = velocity.reshape(-1)
        return jnp.concatenate([force, flat.real, flat.imag])

    at, step = jnp.array(0.2), 1e-5
    slope = jax.jacfwd(both)(at)
    difference = (both(at + step) - both(at - step)) / (2 * step)
    # h²/6·|f'''| and rounding 1e-16·1e3/h.
    np.testing.assert_allclose(slope, difference, rtol=1e-9, atol=2e-8)
    assert np.any(slope != 0)
    many = jax.vmap(both)(jnp.array([0.2, 0.3]))
    np.testing.assert_allclose(many[0], both(at), rtol=1e-15)
