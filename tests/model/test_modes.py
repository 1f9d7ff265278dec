"""Linear modes against masses, springs and dashpots solved in physical coordinates."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import eigh

from snrmjax.model.modes import (
    LinearModesStd,
    RigidBodyModes,
    linear_modes,
    linear_response,
    residual_velocity,
)

# Both sides are a few dozen roundings of well-conditioned sums (the dynamic stiffness is
# inverted at least 0.1 % away from the undamped poles, where it loses three digits).
ROUNDING = 1e-11

response = eqx.filter_jit(linear_response)


def chain(*, free):
    """Masses in a row: matrices M, C, K with modal damping, and its linear modes.

    A free chain has one rigid-body mode; a fixed one is tied to the ground at both ends.
    """
    mass = np.diag([1.2, 0.7, 1.9, 0.4])
    spring = np.array([4e4, 9e4, 2e4, 7e4, 3e4])
    if free:
        spring[[0, -1]] = 0.0
    stiffness = np.diag(spring[:-1] + spring[1:])
    stiffness -= np.diag(spring[1:-1], 1) + np.diag(spring[1:-1], -1)
    squared, shape = eigh(stiffness, mass)
    rigid = 1 if free else 0
    frequency = np.sqrt(squared[rigid:])
    ratio = np.array([0.004, 0.02, 0.01, 0.05])[rigid:]
    through = mass @ shape[:, rigid:]
    damping = through @ np.diag(2 * ratio * frequency) @ through.T
    pattern = np.array([0.3, -1.0, 0.5, 2.0])
    modes = linear_modes(
        frequency,
        ratio,
        shape[:, rigid:],
        shape[:, rigid:].T @ pattern,
        rigid_body=RigidBodyModes(shape[:, :rigid], shape[:, :rigid].T @ pattern),
        mode_of_interest=1,
    )
    return mass, damping, stiffness, pattern, modes


@pytest.mark.parametrize("free", [False, True])
def test_linear_response_solves_the_equations_of_motion(free):
    mass, damping, stiffness, pattern, modes = chain(free=free)
    frequency, force = np.array([35.0, 180.0, 300.0, 641.0]), np.array([0.5, 2.0, 1e-3, 7.0])
    for omega, amplitude in zip(frequency, force, strict=True):
        dynamic = stiffness - omega**2 * mass + 1j * omega * damping
        wanted = 1j * omega * np.linalg.solve(dynamic, pattern * amplitude)
        got = response(modes, jnp.asarray(omega), jnp.asarray(amplitude))
        np.testing.assert_allclose(got, wanted, rtol=0, atol=ROUNDING * np.abs(wanted).max())
    together = response(modes, jnp.asarray(frequency), jnp.asarray(force))
    assert together.shape == (4, 4)
    np.testing.assert_allclose(together[-1], wanted, rtol=0, atol=ROUNDING * np.abs(wanted).max())


@pytest.mark.parametrize("free", [False, True])
def test_residual_is_the_response_without_the_mode_of_interest(free):
    *_, pattern, modes = chain(free=free)
    omega, force, j = 180.0, 2.0, modes.mode_of_interest
    assert modes.residual_modes == tuple(k for k in range(modes.n_modes) if k != j)
    shape, w = np.asarray(modes.mode_shape[:, j]), float(modes.natural_frequency[j])
    zeta = float(modes.damping_ratio[j])
    # The mode itself: q̈ + 2ζωq̇ + ω²q = Φᵀb F, with Φᵀb from the physical force pattern.
    own = 1j * omega * (shape @ pattern) * force / (w**2 - omega**2 + 2j * zeta * w * omega)
    whole = response(modes, jnp.asarray(omega), jnp.asarray(force))
    rest = eqx.filter_jit(residual_velocity)(modes, jnp.asarray(omega), jnp.asarray(force))
    scale = float(jnp.abs(whole).max())
    np.testing.assert_allclose(whole - rest, own * shape, rtol=0, atol=ROUNDING * scale)


def test_phase_is_zero_at_resonance_of_a_single_mode():
    modes = linear_modes([500.0], [0.01], [[2.0]], [3.0])
    velocity = linear_response(modes, jnp.array(500.0), jnp.array(0.7))[0]
    # |v| = Φ p F / 2ζω₀; the phase convention: velocity and force in phase (DESIGN, conventions).
    assert complex(velocity) == pytest.approx(2 * 3 * 0.7 / (2 * 0.01 * 500), rel=1e-13)
    below = linear_response(modes, jnp.array(400.0), jnp.array(0.7))[0]
    assert jnp.angle(below) > 0  # a spring: the velocity leads


def test_response_is_invariant_under_signs_order_and_units():
    *_, modes = chain(free=True)
    omega, force = jnp.array([180.0, 333.0]), jnp.array([2.0, 0.1])
    wanted = response(modes, omega, force)

    def rebuilt(order=(0, 1, 2), sign=1.0, time=1.0, length=1.0):
        """The same chain with its modes reordered, with other signs and units (kg unchanged)."""
        order = np.array(order)
        return linear_modes(
            np.asarray(modes.natural_frequency)[order] / time,
            np.asarray(modes.damping_ratio)[order],
            np.asarray(modes.mode_shape)[:, order] * sign,
            np.asarray(modes.participation)[order] * sign,
            rigid_body=RigidBodyModes(
                modes.rigid_body_shape * sign, modes.rigid_body_participation * sign
            ),
        )

    for same in (rebuilt(order=(2, 0, 1)), rebuilt(sign=-1.0)):
        got = response(same, omega, force)
        np.testing.assert_allclose(got, wanted, rtol=ROUNDING)
    # Time in milliseconds, length in millimetres: 1 N = 1e-3 kg mm/ms², 1 m/s = 1 mm/ms.
    got = response(rebuilt(time=1e3), omega / 1e3, force * 1e-3)
    np.testing.assert_allclose(got, wanted, rtol=ROUNDING)


def test_response_by_jit_and_vmap_agrees_and_traces_once():
    *_, modes = chain(free=True)
    omega, force = jnp.array([180.0, 333.0, 20.0]), jnp.array([2.0, 0.1, 1.0])
    wanted = linear_response(modes, omega, force)
    traces = []

    @eqx.filter_jit
    def compiled(modes, omega, force):
        traces.append(1)
        return jax.vmap(lambda o, f: linear_response(modes, o, f))(omega, force)

    np.testing.assert_allclose(compiled(modes, omega, force), wanted, rtol=ROUNDING)
    np.testing.assert_allclose(compiled(modes, 2 * omega / 2, force), wanted, rtol=ROUNDING)
    assert len(traces) == 1


def test_gradient_against_central_differences():
    *_, modes = chain(free=True)

    @eqx.filter_jit
    def amplitude(modes, omega):
        return jnp.abs(linear_response(modes, omega, jnp.array(2.0))[1])

    omega = jnp.array(333.0)
    by_modes = eqx.filter_grad(amplitude)(modes, omega)
    cases = {
        "natural_frequency": lambda m: m.natural_frequency,
        "damping_ratio": lambda m: m.damping_ratio,
        "mode_shape": lambda m: m.mode_shape,
        "rigid_body_participation": lambda m: m.rigid_body_participation,
    }
    # Central differences with a relative step of 1e-5 near a resonance: truncation about
    # (1e-5 · 333/Δω)² and rounding 1e-16/1e-5, together below 1e-6.
    for name, part in cases.items():
        leaf = part(modes)
        index = (1,) * leaf.ndim if name != "rigid_body_participation" else (0,)
        step = 1e-5 * abs(float(leaf[index]))
        ends = [
            float(amplitude(eqx.tree_at(part, modes, leaf.at[index].add(s)), omega))
            for s in (step, -step)
        ]
        slope = (ends[0] - ends[1]) / (2 * step)
        assert float(part(by_modes)[index]) == pytest.approx(slope, rel=1e-6), name
    slope = float(amplitude(modes, omega + 1e-3) - amplitude(modes, omega - 1e-3)) / 2e-3
    assert float(jax.grad(lambda o: amplitude(modes, o))(omega)) == pytest.approx(slope, rel=1e-6)


GOOD = {
    "natural_frequency": [500.0, 900.0],
    "damping_ratio": [0.01, 0.0],
    "mode_shape": [[2.0, 1.0]],
    "participation": [3.0, -1.0],
}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"natural_frequency": [500.0, -1.0]},
            "`natural_frequency` must be zero or pos.*entry 1 is",
        ),
        (
            {"natural_frequency": [0.0, 1.0]},
            "`natural_frequency` of the mode of interest must be p",
        ),
        ({"natural_frequency": [500.0, np.nan]}, "`natural_frequency` must be finite.*entry 1"),
        ({"natural_frequency": [[500.0, 1.0]]}, r"`natural_frequency` must be a vector.*\(1, 2\)"),
        ({"natural_frequency": []}, "`natural_frequency` must have at least one mode"),
        ({"damping_ratio": [0.01, 1.0]}, "`damping_ratio` must be from 0 to below 1.*entry 1 is 1"),
        ({"damping_ratio": [-0.01, 0.0]}, "`damping_ratio`.*entry 0 is -0.01"),
        ({"damping_ratio": [0.01]}, r"`damping_ratio` must be a vector of 2.*\(1,\)"),
        ({"mode_shape": [[2.0]]}, r"`mode_shape` must have shape \(sensors, 2 modes\).*\(1, 1\)"),
        ({"mode_shape": np.zeros((0, 2))}, "`mode_shape`"),
        ({"mode_shape": [[2.0, np.nan]]}, "`mode_shape` must be finite, but entry .0, 1. is nan"),
        (
            {"rigid_body": RigidBodyModes([[np.inf]], [1.0])},
            "`rigid_body.shape` must be finite, but entry .0, 0.",
        ),
        ({"participation": [3.0]}, "`participation` must be a vector of 2"),
        ({"participation": [3.0, np.inf]}, "`participation` must be finite.*entry 1 is inf"),
        ({"sensors": ("a", "b")}, "`sensors` names 2 sensors, but `mode_shape` has 1"),
        ({"mode_of_interest": 2}, "`mode_of_interest` must lie between 0 and 1, but is 2"),
        ({"mode_of_interest": -1}, "`mode_of_interest`"),
        (
            {"rigid_body": RigidBodyModes([[1.0], [1.0]], [1.0])},
            r"`rigid_body.shape`.*\(2, 1\)",
        ),
        ({"rigid_body": RigidBodyModes([[1.0]], [])}, "`rigid_body.participation` .* vector of 1"),
        ({"rigid_body": RigidBodyModes([[]], [1.0])}, "`rigid_body.participation` .* vector of 0"),
        ({"std": LinearModesStd([1.0])}, "`std.natural_frequency` must be a vector of 2"),
        ({"std": LinearModesStd(None, [1.0] * 3)}, "`std.damping_ratio` must be a vector of 2"),
    ],
)
def test_wrong_arguments_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        linear_modes(**(GOOD | changes))


def test_what_is_not_said_takes_neutral_values():
    modes = linear_modes(**GOOD)
    assert modes.sensors == ("sensor 1",)
    assert (modes.n_modes, modes.mode_of_interest, modes.residual_modes) == (2, 0, (1,))
    assert modes.rigid_body_shape.shape == (1, 0)
    assert not np.any(modes.natural_frequency_std)
    assert not np.any(modes.damping_ratio_std)
    assert {leaf.dtype for leaf in jax.tree.leaves(modes)} == {jnp.dtype("float64")}
