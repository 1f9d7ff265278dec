"""The SNRM function against a structure solved in physical coordinates and the paper's Eq. (10)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg

from snrmjax.identify.pointwise.snrm import nonlinear_mode_velocity, reference_sensor, snrm_velocity
from snrmjax.model.modes import RigidBodyModes, linear_modes, linear_response, residual_velocity

# A free-free chain of four masses: one rigid-body mode, three flexible ones.
MASS = np.diag([1.3, 0.7, 2.1, 0.9])
STIFFNESS = 1e6 * np.array(
    [[2.0, -2.0, 0.0, 0.0], [-2.0, 5.0, -3.0, 0.0], [0.0, -3.0, 4.5, -1.5], [0.0, 0.0, -1.5, 1.5]]
)
PATTERN = np.array([0.0, 1.0, 0.4, 0.0])  # force at every mass per newton of the recorded force
DAMPING = np.array([0.01, 0.03, 0.2])
SENSORS = [3, 0]  # masses that carry a sensor
SQUARES, SHAPES = scipy.linalg.eigh(STIFFNESS, MASS)  # mass-normalised, the rigid body first
NATURAL = np.sqrt(SQUARES[1:])

snrm = eqx.filter_jit(snrm_velocity)  # compiled as a whole: the tests have many shapes

FREQUENCY = np.geomspace(0.2, 3.0, 40) * NATURAL[1]
FORCE = np.linspace(0.5, 7.0, 40)


def chain(mode_of_interest=1):
    return linear_modes(
        NATURAL,
        DAMPING,
        SHAPES[SENSORS, 1:],
        SHAPES[:, 1:].T @ PATTERN,
        sensors=("tip", "root"),
        mode_of_interest=mode_of_interest,
        rigid_body=RigidBodyModes(SHAPES[SENSORS, :1], SHAPES[:, :1].T @ PATTERN),
    )


def chain_velocity(frequency, force):
    """(K − Ω²M + iΩC) X = F in physical coordinates, V = iΩX at the sensors."""
    modal = MASS @ SHAPES[:, 1:]
    damping = modal @ np.diag(2 * DAMPING * NATURAL) @ modal.T
    dynamic = STIFFNESS - frequency**2 * MASS + 1j * frequency * damping
    return 1j * frequency * np.linalg.solve(dynamic, PATTERN * force)[SENSORS]


def paper_mode(constant, natural, damping, frequency):
    """V_j^nl of Eq. (10b), as printed: the force is a sine."""
    return constant * frequency / (natural**2 - frequency**2 + 2j * damping * natural * frequency)


@pytest.mark.parametrize("mode_of_interest", [0, 1, 2])
def test_with_linear_properties_it_is_the_response_of_the_structure(mode_of_interest):
    modes = chain(mode_of_interest)
    natural = jnp.full(40, NATURAL[mode_of_interest])
    damping = jnp.full(40, DAMPING[mode_of_interest])
    actual = snrm(modes, natural, damping, jnp.asarray(FREQUENCY), jnp.asarray(FORCE))
    truth = np.array([chain_velocity(w, f) for w, f in zip(FREQUENCY, FORCE, strict=True)])
    # Rounding (2e-16) times the condition of the dynamic stiffness, up to 1e3 near resonance.
    np.testing.assert_allclose(actual, truth, rtol=1e-12, atol=1e-12 * np.abs(truth).max())
    # The same sum in another order.
    linear = linear_response(modes, jnp.asarray(FREQUENCY), jnp.asarray(FORCE))
    np.testing.assert_allclose(actual, linear, rtol=1e-13, atol=1e-13 * np.abs(truth).max())


def test_the_phase_is_the_papers_plus_90_degrees():
    rng = np.random.default_rng(0)
    natural, frequency = 500 * 2 ** rng.uniform(-1, 1, (2, 200))
    damping, constant = 10 ** rng.uniform(-5, -0.5, 200), rng.uniform(0.1, 9, 200)
    ours = np.asarray(nonlinear_mode_velocity(constant, natural, damping, frequency))
    paper = paper_mode(constant, natural, damping, frequency)
    # A few roundings of one division; ω̃² − Ω² is formed from the same two numbers.
    np.testing.assert_allclose(-1j * ours, paper, rtol=1e-14)
    # Eq. (13), its angle between −180° and 0°: arctangent and arctan2 agree to their rounding.
    squares, cross = natural**2 - frequency**2, 2 * damping * natural * frequency
    angle = np.arctan(-cross / squares) - np.pi * (squares < 0)
    np.testing.assert_allclose(np.angle(-1j * ours), angle, atol=1e-14)


def test_resonance_is_at_zero_and_the_velocity_leads_below():
    at, below, above = nonlinear_mode_velocity(6.0, 500.0, 0.01, jnp.array([500.0, 490.0, 510.0]))
    # v = A / (2ζω), exactly representable up to one rounding.
    np.testing.assert_allclose(at, 6.0 / (2 * 0.01 * 500.0), rtol=1e-15)
    assert np.angle(below) > 0 > np.angle(above)


def test_a_negative_modal_constant_shifts_the_phase_by_180_degrees():
    frequency = jnp.linspace(300.0, 700.0, 21)
    positive = nonlinear_mode_velocity(3.0, 500.0, 0.02, frequency)
    negative = nonlinear_mode_velocity(-3.0, 500.0, 0.02, frequency)
    np.testing.assert_array_equal(negative, -positive)  # a sign has no rounding
    modes = linear_modes([500.0], [0.02], [[2.0], [-2.0]], [1.5])
    both = snrm(modes, 480.0, 0.03, jnp.array(470.0), jnp.array(1.0))
    assert both[0] == -both[1]


def test_the_rigid_body_term_is_that_of_a_free_mass_and_of_the_paper():
    mass, force, omega = 2.5, 3.0, 40.0
    shape = np.array([[mass**-0.5]])
    modes = linear_modes(
        [500.0],
        [0.01],
        [[0.0]],  # the flexible mode is not seen
        [1.0],
        rigid_body=RigidBodyModes(shape, shape[0]),
    )
    actual = complex(snrm(modes, 500.0, 0.01, jnp.array(omega), jnp.array(force))[0])
    # Eq. (10b), as printed: −Φ Φᵀ F / Ω. One product and one quotient.
    np.testing.assert_allclose(-1j * actual, -(shape[0, 0] ** 2) * force / omega, rtol=1e-15)
    # Newton's law, m dv/dt = F cos Ωt from the velocity that has no mean.
    steady = scipy.integrate.solve_ivp(
        lambda t, v: [force * np.cos(omega * t) / mass],
        (0.0, 0.5),
        [actual.real],
        t_eval=np.linspace(0, 0.5, 30),
        rtol=1e-10,
        atol=1e-12,
    )
    signal = (actual * np.exp(1j * omega * steady.t)).real
    np.testing.assert_allclose(steady.y[0], signal, atol=1e-9)  # the integrator's tolerance


def test_only_the_mode_of_interest_changes_with_its_properties():
    modes, frequency, force = chain(), jnp.asarray(FREQUENCY), jnp.asarray(FORCE)
    natural, damping = 1.1 * NATURAL[1], 0.07
    own = snrm(modes, natural, damping, frequency, force) - residual_velocity(
        modes, frequency, force
    )
    constant = SHAPES[SENSORS, 2] * (SHAPES[:, 2] @ PATTERN)
    truth = 1j * paper_mode(constant * FORCE[:, None], natural, damping, FREQUENCY[:, None])
    # Rounding of the subtracted residual, which is up to 100 times as large.
    np.testing.assert_allclose(own, truth, rtol=1e-12, atol=1e-13 * np.abs(truth).max())


def test_scaling_of_units():
    modes, natural, frequency = chain(), 900.0, jnp.asarray(FREQUENCY)
    base = snrm(modes, natural, 0.02, frequency, jnp.asarray(FORCE))
    twice = snrm(modes, natural, 0.02, frequency, 2 * jnp.asarray(FORCE))
    np.testing.assert_array_equal(twice, 2 * base)  # powers of two are exact
    # Another unit of time: all frequencies times 8, a force that is the same number.
    fast = linear_modes(
        8 * NATURAL,
        DAMPING,
        modes.mode_shape,
        modes.participation,
        mode_of_interest=1,
        rigid_body=RigidBodyModes(modes.rigid_body_shape, modes.rigid_body_participation),
    )
    scaled = snrm(fast, 8 * natural, 0.02, 8 * frequency, jnp.asarray(FORCE))
    np.testing.assert_array_equal(scaled, base / 8)


def test_batches_scalars_and_transformations_agree():
    modes, frequency, force = chain(), jnp.asarray(FREQUENCY), jnp.asarray(FORCE)
    natural, damping = jnp.linspace(800.0, 1200.0, 40), jnp.linspace(0.001, 0.1, 40)
    plain = snrm_velocity(modes, natural, damping, frequency, force)
    assert plain.shape == (40, 2)
    one = snrm_velocity(modes, 800.0, 0.001, float(FREQUENCY[0]), float(FORCE[0]))
    assert one.shape == (2,)
    traces = []

    @jax.jit
    def counted(*args):
        traces.append(1)
        return snrm_velocity(modes, *args)

    mapped = jax.vmap(lambda *args: snrm_velocity(modes, *args))
    args = (natural, damping, frequency, force)
    # The compiler may contract a multiplication and an addition: a few roundings.
    for other in (counted(*args), counted(*args), mapped(*args)):
        np.testing.assert_allclose(other, plain, rtol=1e-13, atol=1e-13 * np.abs(plain).max())
    np.testing.assert_allclose(one, plain[0], rtol=1e-13, atol=1e-13 * np.abs(plain).max())
    assert len(traces) == 1
    matrix = snrm_velocity(modes, natural[:, None], damping, frequency[:, None], force[:, None])
    assert matrix.shape == (40, 40, 2)
    np.testing.assert_allclose(
        matrix[np.arange(40), np.arange(40)],
        plain,
        rtol=1e-13,
        atol=1e-13 * np.abs(plain).max(),
    )


def test_derivatives_against_central_differences():
    modes = chain()

    def parts(inputs):
        velocity = snrm_velocity(modes, *inputs)
        return jnp.stack([velocity.real, velocity.imag])

    def printed(inputs):
        natural, damping, frequency, force = inputs
        constant = SHAPES[SENSORS, 1:] * (SHAPES[:, 1:].T @ PATTERN) * force
        own = paper_mode(constant[:, 1], natural, damping, frequency)
        for k in (0, 2):
            own = own + paper_mode(constant[:, k], NATURAL[k], DAMPING[k], frequency)
        rigid = -SHAPES[SENSORS, 0] * (SHAPES[:, 0] @ PATTERN) * force / frequency
        return 1j * (own + rigid)

    at = np.array([950.0, 0.03, 930.0, 2.0])
    forward, reverse = jax.jit(lambda x: (jax.jacfwd(parts)(x), jax.jacrev(parts)(x)))(at)
    np.testing.assert_allclose(reverse, forward, rtol=1e-12)  # the same sums in another order
    derivative = np.asarray(forward[0] + 1j * forward[1])
    for k, step in enumerate(1e-5 * at):
        moved = np.eye(4)[k] * step
        slope = (printed(at + moved) - printed(at - moved)) / (2 * step)
        # Error of the difference: h²/6 times the third derivative, (1e-5/ζ)² = 1e-7 of it.
        np.testing.assert_allclose(derivative[:, k], slope, rtol=1e-6)


def test_the_reference_sensor_has_the_largest_shape():
    shape = [[9.0, 1.0], [0.1, -3.0], [0.2, 2.0]]
    for mode, sensor in ((0, 0), (1, 1)):
        modes = linear_modes([1.0, 2.0], [0.1, 0.1], shape, [1.0, 1.0], mode_of_interest=mode)
        assert reference_sensor(modes) == sensor
