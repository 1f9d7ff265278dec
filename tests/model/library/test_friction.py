"""Friction against closed formulas, marches in plain Python, and finite differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

from snrmjax.model.effect_shape import averaged_effect
from snrmjax.model.effects import make_effect

AMPLITUDE = np.array([0.5, 0.99, 1.01, 1.3, 2.0, 5.0, 50.0])
FREQUENCY = 3.0
EXPONENTS = [1.05, 1.3, 1.5, 2.0, 2.5, 2.95]


def slider(stiffness=9.0, slip_displacement=1.0):
    return make_effect(
        "jenkins_slider", {"stiffness": stiffness, "slip_displacement": slip_displacement}
    )


def iwan(exponent=1.5, coefficient=2.0):
    return make_effect("iwan_microslip", {"coefficient": coefficient, "exponent": exponent})


def coulomb(force=1.3):
    return make_effect("coulomb_friction", {"force": force})


EFFECTS = {"slider": slider(), "iwan": iwan(), "iwan above 2": iwan(2.4), "coulomb": coulomb()}


# One program each: run eagerly, every operation of every shape compiles on its own.
averaged = eqx.filter_jit(averaged_effect)
cycle = eqx.filter_jit(lambda effect, q, v: effect.cycle_force(q, v))
settled_states = eqx.filter_jit(lambda effect, q, v: effect.settled_states(q, v))


def motion(n_samples=256, amplitude=1.0, mean=0.2, frequency=FREQUENCY):
    """A periodic motion of several harmonics with small loops inside the large one."""
    t = 2 * np.pi * np.arange(n_samples) / n_samples
    q = mean + 1.5 * np.cos(t + 0.3) + 0.8 * np.sin(3 * t) + 0.25 * np.cos(7 * t + 1.0)
    v = -1.5 * np.sin(t + 0.3) + 2.4 * np.cos(3 * t) - 1.75 * np.sin(7 * t + 1.0)
    return amplitude * q, amplitude * frequency * v


def march(displacement, stiffness, slip_displacement, cycles=2):
    """Force of sliders less their stuck springs over the last cycle: f ← clip(f + kΔq, −F, F)."""
    stiffness = np.atleast_1d(stiffness)
    limit = stiffness * slip_displacement
    force, before, last = np.zeros(stiffness.shape), 0.0, []
    for _ in range(cycles):
        last = []
        for q in np.asarray(displacement).tolist():
            force = np.minimum(np.maximum(force + stiffness * (q - before), -limit), limit)
            before = q
            last.append(np.sum(force - stiffness * q))
    return np.array(last)


# ------------------------------------------------------------------------- describing functions


def slider_stiffness(ratio):
    """Δ(ω̃²)/k_t of a slider with x_s/Q = ratio, as DIAGNOSIS.md has it."""
    theta = np.arccos(1 - 2 * np.minimum(ratio, 1.0))
    return (theta - np.sin(theta) * np.cos(theta)) / np.pi - 1


def test_average_of_a_slider_follows_the_closed_formulas():
    n = 512
    average = averaged(slider(), jnp.asarray(AMPLITUDE), jnp.array(FREQUENCY), n_samples=n)
    wanted = 9.0 * slider_stiffness(1 / AMPLITUDE)
    # A corner in the force: the square of the step, of the stuck stiffness.
    step = (2 * np.pi / n) ** 2
    np.testing.assert_allclose(average.stiffness, wanted, rtol=0, atol=9 * step)
    wanted = 4 * 9.0 * np.maximum(AMPLITUDE - 1, 0) / (np.pi * FREQUENCY * AMPLITUDE**2)
    np.testing.assert_allclose(average.damping, wanted, rtol=0, atol=9 / FREQUENCY * step)
    # Nothing at all before the first slip, and the peak of the damping at Q = 2x_s.
    np.testing.assert_array_equal(average.stiffness[:2], 0.0)
    np.testing.assert_array_equal(average.damping[:2], 0.0)
    assert np.argmax(np.asarray(average.damping)) == list(AMPLITUDE).index(2.0)


@pytest.mark.parametrize("p", EXPONENTS)
def test_average_of_an_iwan_element_follows_the_closed_formulas(p):
    average = averaged(iwan(p), jnp.asarray(AMPLITUDE), jnp.array(FREQUENCY), n_samples=256)
    wanted = 4 * 2.0 * (p - 1) * AMPLITUDE ** (p - 1) / (np.pi * (p + 1) * FREQUENCY)
    # 48 points and 256 samples; the docstring promises 1e-4.
    np.testing.assert_allclose(average.damping, wanted, rtol=1e-4)
    # All sliders by the formula of one, ∫₀^Q c p (p−1) s^(p−2) Δ(s/Q) ds, with w = (s/Q)^(p−1).
    whole = quad(lambda w: slider_stiffness(w ** (1 / (p - 1))), 0, 1, epsabs=1e-12)[0]
    wanted = 2.0 * p * AMPLITUDE ** (p - 1) * whole
    np.testing.assert_allclose(average.stiffness, wanted, rtol=1e-4)
    # "≈ −cQ^(p−1)": within 6 % over the range of exponents.
    np.testing.assert_allclose(average.stiffness, -2.0 * AMPLITUDE ** (p - 1), rtol=0.06)


@pytest.mark.parametrize("n_samples", [128, 256, 512])
def test_average_of_coulomb_friction_is_that_of_the_jump(n_samples):
    amplitude = jnp.array([[1e-6, 0.3], [2.0, 1e4]])
    average = averaged(coulomb(), amplitude, jnp.array([3.0, 0.1]), n_samples=n_samples)
    wanted = 4 * 1.3 / (np.pi * np.asarray(amplitude) * [3.0, 0.1])
    np.testing.assert_allclose(average.damping, wanted, rtol=1e-3)
    # The deficit that the docstring states: π²w²/48 with the width w over the rms velocity.
    np.testing.assert_allclose(average.damping / wanted - 1, -5.1e-4, atol=2e-5)
    scale = 1.3 / np.asarray(amplitude)
    np.testing.assert_allclose(average.stiffness / scale, 0.0, atol=1e-14)  # rounding


# --------------------------------------------------------------------------- motions in general


@pytest.mark.parametrize("amplitude", [0.3, 0.6, 1.0, 3.0])
@pytest.mark.parametrize("mean", [0.0, 0.7])
def test_slider_against_a_plain_march(amplitude, mean):
    q, v = motion(amplitude=amplitude, mean=mean)
    force = -9.0 * settled_states(slider(9.0, 0.7), q, v)[:, 0]
    # The second cycle and the fortieth alike; 512 clipped sums leave 512 roundings of 9·3.
    for cycles in (2, 40):
        wanted = march(q, 9.0, 0.7, cycles)
        np.testing.assert_allclose(force, wanted, rtol=0, atol=1e-15 * 27 * 256 * cycles)


@pytest.mark.parametrize("amplitude", [0.3, 1.0, 3.0])
def test_harmonics_of_a_slider_are_those_of_a_march_of_many_samples(amplitude):
    q, v = motion(amplitude=amplitude)
    order = np.arange(8)
    fine = np.fft.rfft(march(motion(256 * 256, amplitude)[0], 9.0, 0.4))[order] / 256**2
    sampled = np.fft.rfft(-9.0 * settled_states(slider(9.0, 0.4), q, v)[:, 0])[order] / 256
    force = np.fft.rfft(cycle(slider(9.0, 0.4), q, v))[order] / 256
    # Corners of 9·|q'| between samples: their correction leaves the fourth order of 7 harmonics
    # of the motion over 256 samples, (2π·7/256)⁴·9·2.5/(2π·8), and the march of many its second.
    np.testing.assert_allclose(force, fine, rtol=0, atol=4e-4 * amplitude)
    assert np.abs(force - fine).max() < 0.1 * np.abs(sampled - fine).max()


def test_the_fundamental_of_a_slider_has_no_corner_in_the_amplitude():
    phase = 2 * np.pi * np.arange(256) / 256 + 0.01

    @jax.jit
    @jax.vmap
    def slope(amplitude):
        def fundamental(a):
            force = slider().cycle_force(a * jnp.cos(phase), -a * jnp.sin(phase))
            return 2 * jnp.mean(force * np.cos(phase))

        return jax.grad(fundamental)(amplitude)

    amplitude = np.linspace(1.3, 1.5, 400)
    theta = np.arccos(1 - 2 / amplitude)
    # d/dA of A·Δ(A), Δ by the closed formula: (k/π)(θ − sin θ cos θ) − k + (k/π) 2 sin²θ A θ'.
    rate = -2 / amplitude**2 / np.sin(theta)
    wanted = 9 * ((theta - np.sin(theta) * np.cos(theta)) / np.pi - 1)
    wanted = wanted + 9 / np.pi * 2 * np.sin(theta) ** 2 * amplitude * rate
    np.testing.assert_allclose(slope(amplitude), wanted, rtol=0, atol=1e-4)


@pytest.mark.parametrize("p", EXPONENTS)
def test_iwan_element_follows_masing(p):
    t = 2 * np.pi * np.arange(200) / 200
    q = 1.7 * np.cos(t)
    force = cycle(iwan(p), jnp.asarray(q), jnp.asarray(-np.sin(t)))
    down = -2.0 * 1.7**p + 2 * 2.0 * ((1.7 - q) / 2) ** p
    up = 2.0 * 1.7**p - 2 * 2.0 * ((1.7 + q) / 2) ** p
    wanted = np.where(t <= np.pi, down, up)
    # One corner among 48 points of Gauss's rule: the square of their distance, π/2/48.
    np.testing.assert_allclose(force, wanted, rtol=0, atol=2.0 * 1.7**p * (np.pi / 96) ** 2)
    # At the tip there is no corner, but above p = 2 the thresholds w^(1/(p−1)) crowd towards 0.
    assert float(force[0]) == pytest.approx(-2.0 * 1.7**p, rel=1e-12 if p <= 2 else 1e-5)


def test_iwan_element_is_the_sum_of_many_sliders():
    q, v = motion()
    half = 0.5 * float(jnp.max(q) - jnp.min(q))
    # 4000 evenly spaced thresholds with the density of p = 2.4, at the middle of their cells.
    edge = half * np.linspace(0, 1, 4001)
    middle = 0.5 * (edge[1:] + edge[:-1])
    stiffness = np.diff(2.0 * 2.4 * edge**1.4)
    wanted = march(q, stiffness, middle)
    force = cycle(iwan(2.4), q, v)
    np.testing.assert_allclose(force, wanted, rtol=0, atol=2e-3 * np.max(np.abs(wanted)))


def test_a_slider_that_only_the_first_approach_moved_stays_there():
    t = 2 * np.pi * np.arange(64) / 64
    q = jnp.asarray(2.0 + 0.1 * np.cos(t))
    force = cycle(slider(9.0, 1.0), q, 0.0 * q)
    np.testing.assert_allclose(force, -9.0 * (2.1 - 1.0), rtol=1e-15)


@pytest.mark.parametrize("name", EFFECTS)
def test_mirrored_shifted_and_faster_motions(name):
    effect = EFFECTS[name]
    q, v = motion(amplitude=2.0)
    force = np.asarray(cycle(effect, q, v))
    scale = np.max(np.abs(force))
    close = {"rtol": 0, "atol": 1e-13 * scale}  # rounding of sums over 48 sliders
    np.testing.assert_allclose(cycle(effect, -q, -v), -force, **close)
    for shift in (1, 77, 200):
        rolled = cycle(effect, np.roll(q, shift), np.roll(v, shift))
        np.testing.assert_allclose(rolled, np.roll(force, shift), **close)
    np.testing.assert_allclose(cycle(effect, q, 7.0 * v), force, **close)
    assert np.mean(force * np.asarray(v)) > 0.05 * scale * float(jnp.sqrt(jnp.mean(v**2)))


# ---------------------------------------------------------------------------------- derivatives


def rebuilt(effect, values):
    """The effect with other values of its parameters."""
    return make_effect(effect.kind, values)


PARAMETERS = {
    "slider": {"stiffness": 9.0, "slip_displacement": 0.43},
    "iwan": {"coefficient": 2.0, "exponent": 1.5},
    "iwan above 2": {"coefficient": 2.0, "exponent": 2.4},
    "coulomb": {"force": 1.3},
}


@pytest.mark.parametrize("name", PARAMETERS)
def test_derivatives_against_central_differences(name):
    effect = EFFECTS[name]
    q, v = motion(n_samples=64)
    direction = np.random.default_rng(5).normal(size=(2, 64))
    parameters = {key: jnp.asarray(value) for key, value in PARAMETERS[name].items()}
    tangents = {key: jnp.asarray(0.3 * value) for key, value in PARAMETERS[name].items()}
    dq, dv = map(jnp.asarray, direction)

    def force(q, v, parameters):
        return rebuilt(effect, parameters).cycle_force(q, v)

    point, along = (q, v, parameters), (dq, dv, tangents)
    tangent = jax.jit(lambda p, a: jax.jvp(force, p, a)[1])(point, along)
    step = 1e-5

    def moved(steps):
        return jax.jit(force)(*jax.tree.map(lambda x, d: x + steps * step * d, point, along))

    slope = (moved(-2) - 8 * moved(-1) + 8 * moved(1) - moved(2)) / (12 * step)
    # Rounding 30·1e-16/h; the fourth order of h is below it.
    np.testing.assert_allclose(tangent, slope, rtol=0, atol=2e-9)
    # Reverse mode: the transposed of the same.
    weight = jnp.asarray(np.random.default_rng(6).normal(size=64))
    back = jax.jit(jax.grad(lambda *p: jnp.vdot(weight, force(*p)), argnums=(0, 1, 2)))(*point)
    inner = sum(
        float(jnp.vdot(a, b))
        for a, b in zip(jax.tree.leaves(back), jax.tree.leaves(along), strict=True)
    )
    assert inner == pytest.approx(float(jnp.vdot(weight, tangent)), rel=1e-11)


@pytest.mark.parametrize("p", [*EXPONENTS, None, "coulomb"])
def test_rest_has_no_force_and_finite_derivatives(p):
    effect = coulomb() if p == "coulomb" else slider() if p is None else iwan(p)
    still = jnp.zeros(16)

    @jax.jit
    def evaluated(q, v):
        def loss(effect, q, v):
            return jnp.sum(cycle(effect, q, v) * jnp.arange(1.0, 17.0))

        along = jnp.arange(16.0), jnp.ones(16)
        forward = jax.jvp(effect.cycle_force, (q, v), along)
        return forward, jax.grad(loss, argnums=(0, 1, 2))(effect, q, v)

    for at in (0.0, 0.3):  # at rest, and displaced from it
        for leaf in jax.tree.leaves(evaluated(still + at, still)):
            np.testing.assert_array_equal(leaf, 0.0)


def test_a_stuck_slider_adds_nothing_and_neither_do_its_derivatives():
    q, v = motion(amplitude=0.3, mean=0.0)
    effect = slider(9.0, 1.0)
    np.testing.assert_array_equal(cycle(effect, q, v), 0.0)
    np.testing.assert_array_equal(jax.jacfwd(effect.cycle_force)(q, v), 0.0)


# ------------------------------------------------------------------------- integration in time


def test_integrated_states_settle_to_the_steady_cycle():
    n = 4096
    q, v = motion(n)
    effect = slider(9.0, 0.4)
    rate = jax.jit(jax.vmap(lambda q, v, z: effect.state_rate(q, v, z[None])[0]))
    wanted = np.asarray(settled_states(effect, q, v))[:, 0]
    # Euler's rule in plain NumPy, as an integrator without a projection would do it.
    path, speed, states = np.tile(q, 2), np.tile(v, 2), [0.0]
    for at, pace in zip(path[:-1].tolist(), speed[:-1].tolist(), strict=True):
        dragged = at - states[-1] >= 0.4 if pace > 0 else at - states[-1] <= -0.4
        states.append(states[-1] + (pace / FREQUENCY * 2 * np.pi / n if dragged else 0.0))
    states = np.array(states)
    # The rate is that rule's own, and the rule is off by a step at the onset of each slip.
    own = np.where(np.where(speed > 0, path - states >= 0.4, path - states <= -0.4), speed, 0.0)
    np.testing.assert_array_equal(
        rate(jnp.asarray(path), jnp.asarray(speed), jnp.asarray(states)), own
    )
    force = jax.vmap(effect.state_force)(q, v, jnp.asarray(states[n:, None]))
    step = 2 * np.pi / n * 6.0
    np.testing.assert_allclose(force, -9.0 * wanted, rtol=0, atol=9 * 3 * step)
    assert np.max(np.abs(wanted)) > 1.0  # it slips far


@pytest.mark.parametrize("name", ["slider", "iwan", "iwan above 2"])
def test_states_moved_from_sample_to_sample_are_the_steady_ones(name):
    q, v = motion()
    half = 0.5 * (jnp.max(q) - jnp.min(q))
    effect = EFFECTS[name].scaled_for(half, jnp.array(1.0))
    n_states = 1 if name == "slider" else 48
    start = effect.initial_states()
    np.testing.assert_array_equal(start, np.zeros(n_states))

    def move(states, sample):
        states = effect.moved_states(sample[0], states)
        return states, (states, effect.state_force(*sample, states))

    settled, _ = jax.lax.scan(move, start, (q, v))
    _, (states, force) = jax.lax.scan(move, settled, (q, v))
    np.testing.assert_allclose(states, settled_states(effect, q, v), rtol=0, atol=1e-15)
    exact = settled_states(effect, q, v) @ -effect.sliders().stiffness
    np.testing.assert_allclose(force, exact, rtol=0, atol=1e-13)
    # The same thresholds as the cycle's own choice, which turns up to h²/8·21 beyond its samples.
    step = 9.0 * 7.6e-5 * 21
    harmonics = np.fft.rfft(force - cycle(EFFECTS[name], q, v))[:8] / 256
    np.testing.assert_allclose(harmonics, 0.0, atol=step)


def test_iwan_element_with_thresholds_above_the_motion():
    q, v = motion(mean=0.0)
    wide = iwan(1.5).with_thresholds(2.0 * jnp.max(jnp.abs(q)))
    assert wide.kind == "iwan_microslip"
    force = wide.settled_states(q, v) @ -wide.sliders().stiffness
    wanted = np.asarray(cycle(iwan(1.5), q, v))
    # Some points of the rule do not slip any more; the rest are fewer.
    np.testing.assert_allclose(force, wanted, rtol=0, atol=0.01 * np.max(np.abs(wanted)))
    with pytest.raises(ValueError, match="`scaled_for` or `with_thresholds`"):
        iwan(1.5).initial_states()


def test_coulomb_friction_in_time():
    effect, none = coulomb(), jnp.zeros(0)
    v = jnp.array([-2.0, 0.0, 1e-3])
    jump = jax.vmap(lambda v: effect.state_force(jnp.array(0.3), v, none))(v)
    np.testing.assert_array_equal(jump, [-1.3, 0.0, 1.3])
    smooth = effect.scaled_for(jnp.array(5.0), jnp.array(0.4))
    assert float(smooth.smoothing_velocity) == pytest.approx(0.05 * 0.4)
    values = jax.vmap(lambda v: smooth.state_force(jnp.array(0.3), v, none))(v)
    np.testing.assert_allclose(values, 1.3 * np.tanh(np.asarray(v) / 0.02), rtol=1e-14)
    for e in (effect, smooth):
        assert np.isfinite(jax.grad(lambda v, e=e: e.state_force(v, v, none))(jnp.array(0.0)))
        assert e.initial_states().shape == e.state_rate(v[0], v[0], none).shape == (0,)
        assert e.settled_states(v, v).shape == (3, 0)
        # A setting of the integration does not change the steady cycle.
        np.testing.assert_array_equal(e.cycle_force(*motion()), cycle(effect, *motion()))


# ------------------------------------------------------------------------------------ transforms


@pytest.mark.parametrize("name", EFFECTS)
def test_jit_and_vmap_agree_and_trace_once(name):
    effect = EFFECTS[name]
    traces = []

    @eqx.filter_jit
    def compiled(effect, q, v):
        traces.append(1)
        return jax.vmap(effect.cycle_force)(q, v)

    q, v = map(jnp.asarray, motion())
    amplitudes = jnp.array([0.1, 1.0, 4.0])[:, None]
    force = compiled(effect, amplitudes * q, amplitudes * v)
    alone = [cycle(effect, a * q, a * v) for a in amplitudes]
    rounding = 1e-14 * np.abs(alone).max()  # some of the last bits of the largest force
    np.testing.assert_allclose(force, alone, rtol=0, atol=rounding)
    compiled(jax.tree.map(lambda leaf: 1.1 * leaf, effect), amplitudes * q, amplitudes * v)
    assert len(traces) == 1
    # A batch of parameters.
    many = jax.tree.map(lambda leaf: leaf * jnp.array([1.0, 1.1]), effect)
    both = eqx.filter_vmap(lambda e: e.cycle_force(q, v))(many)
    np.testing.assert_allclose(both[0], cycle(effect, q, v), rtol=0, atol=rounding)
    assert not np.allclose(both[0], both[1])
