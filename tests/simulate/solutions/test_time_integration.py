"""Integration in time against closed forms, SciPy's integrators and folds of harmonic balance."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from snrmjax.model.builders.beams import curved_beam, flat_beam
from snrmjax.model.effects import make_effect
from snrmjax.model.modes import linear_modes, linear_response
from snrmjax.model.potential import polynomial_potential
from snrmjax.model.structures import simulated_structure, structure
from snrmjax.simulate.solutions.forced_response import forced_response, solve_at_frequency
from snrmjax.simulate.solutions.time_integration import (
    IntegrationAccuracy,
    MotionStatus,
    settled_motion,
)

HZ = 2 * np.pi
OMEGA, RATIO, SHAPE, PARTICIPATION = 500.0, 0.02, 2.0, 3.0
STATIC = PARTICIPATION / OMEGA**2  # kg^1/2 m, of 1 N
RESONANT = STATIC / (2 * RATIO)


def oscillator(cubic=0.0, effects=(), ratio=RATIO):
    """One mode; `cubic` is the coefficient of q³ over ω²/Q² at the linear resonance of 1 N."""
    modes = linear_modes([OMEGA], [ratio], [[SHAPE]], [PARTICIPATION])
    value = cubic * OMEGA**2 / RESONANT**2 / 4
    return structure(modes, polynomial_potential({"1111": value}, 1), effects=effects)


@pytest.fixture(scope="module")
def stiffening():
    """A stiffening oscillator and its response to 1 N, with two folds."""
    model = oscillator(cubic=0.5)
    curve = forced_response(model, [1.0], 0.8 * OMEGA, 1.4 * OMEGA)[0]
    assert curve.at_events("fold").size == 2
    return model, curve


def fundamental(motion):
    return np.asarray(motion.velocity)[..., 1, 0]


# ------------------------------------------------------------------------------ settled motions


@pytest.mark.parametrize(
    "frequency",
    [
        pytest.param(300.0, marks=pytest.mark.long),
        495.0,
        pytest.param(2700.0, marks=pytest.mark.long),
    ],
)
def test_a_small_motion_is_the_linear_response(frequency):
    beam = flat_beam()
    motion = settled_motion(
        beam, 1e-7, frequency, accuracy=IntegrationAccuracy(settled=1e-6), max_cycles=4000
    )
    exact = linear_response(beam.modes, frequency, 1e-7)
    assert motion.converged
    # The tolerance is on an estimate of the distance: three of them.
    np.testing.assert_allclose(motion.velocity[1], exact, rtol=3e-6)


def test_a_transient_is_the_closed_form():
    """From rest, q = q_p − e^{−ζωt}(…): the state after eight cycles, not settled."""
    omega, force = 480.0, 0.7
    motion = settled_motion(
        oscillator(), force, omega, max_cycles=8, accuracy=IntegrationAccuracy(settled=0.0)
    )
    time = 8 * 2 * np.pi / omega
    steady = force * PARTICIPATION / (OMEGA**2 - omega**2 + 2j * RATIO * OMEGA * omega)
    roots = OMEGA * (-RATIO + np.array([1j, -1j]) * np.sqrt(1 - RATIO**2))
    at_rest = np.array([-steady.real, -(1j * omega * steady).real])
    weights = np.linalg.solve(np.array([[1, 1], roots]), at_rest)
    free = np.array([weights, weights * roots]) @ np.exp(roots * time)
    exact = free.real + np.array([steady.real, (1j * omega * steady).real])
    # 8 · 128 steps, each of them right to 1e-8 of the motion.
    scale = abs(steady) * np.array([1.0, omega])
    np.testing.assert_allclose(motion.state[:, 0] / scale, exact / scale, atol=1e-5)
    finer = IntegrationAccuracy(settled=0.0, step=1e-12)
    tight = settled_motion(oscillator(), force, omega, max_cycles=8, accuracy=finer)
    np.testing.assert_allclose(tight.state[:, 0] / scale, exact / scale, atol=1e-9)
    assert motion.n_cycles == 8
    assert not motion.converged


def test_a_strong_motion_is_what_scipy_finds(time_domain):
    model, force, omega = curved_beam(), 1.779e-3, 60 * HZ
    motion = settled_motion(model, force, omega, accuracy=IntegrationAccuracy(settled=1e-6))
    assert motion.converged
    truth = time_domain(model, force, omega)
    period = 2 * np.pi / omega
    # ζ = 0.05: forty periods leave e^{−12}; Dormand & Prince to 1e-10.
    end = truth.integrate([[1e-12, 0.0]], 40 * period, rtol=1e-10)[-1]
    times = np.arange(64) * period / 64
    orbit = truth.integrate(end, times[-1], rtol=1e-10, t_eval=times)[:, 0, 0]
    wanted = np.fft.rfft(orbit)[:10] / 32
    found = np.asarray(motion.coefficients)[:, 0]
    phasors = np.concatenate([[2 * found[0]], found[1::2] - 1j * found[2::2]])
    assert abs(wanted[2]) > 0.03 * abs(wanted[1])
    np.testing.assert_allclose(phasors, wanted, atol=2e-5 * abs(wanted[1]))
    # And it starts other solvers.
    exact, converged = solve_at_frequency(
        model, jnp.array([force]), jnp.array([omega]), motion.coefficients[None]
    )
    assert converged[0]
    np.testing.assert_allclose(
        exact[0, :, 0], found, atol=1e-4 * abs(wanted[1])
    )  # truncation after nine harmonics


def test_the_start_decides_between_stable_motions(stiffening):
    (model, curve), omega = stiffening, 1.12 * OMEGA
    low = settled_motion(model, 1.0, omega)
    high = settled_motion(model, 1.0, omega, start=[RESONANT])
    assert low.converged
    assert high.converged
    assert abs(fundamental(high)) > 3 * abs(fundamental(low))
    for motion in (low, high):
        near = np.abs(curve.frequency / omega - 1) + np.abs(
            curve.velocity[:, 1, 0] / fundamental(motion) - 1
        )
        k = np.argmin(near)
        assert near[k] < 0.05
        assert curve.is_stable[k]
        exact, _ = solve_at_frequency(
            model, jnp.array([1.0]), jnp.array([omega]), jnp.asarray(curve.coefficients[k])[None]
        )
        # The tolerance of 1e-5, three times, and nine harmonics.
        scale = np.abs(exact).max()
        np.testing.assert_allclose(motion.coefficients / scale, exact[0] / scale, atol=5e-5)
    # A state goes on where it stopped.
    again = settled_motion(model, 1.0, omega, start=high.state)
    assert again.n_cycles <= 12
    np.testing.assert_allclose(fundamental(again), fundamental(high), rtol=2e-5)


def test_a_start_of_the_model_is_one_of_the_simulated_structure():
    added = make_effect(
        "internal_resonance_1_3",
        {"coefficient": 0.0, "frequency_hz": 1500 / HZ, "damping_ratio": 0.02},
    )
    model = oscillator(effects=[added])
    assert simulated_structure(model).n_modes == 2
    options = {"max_cycles": 10, "accuracy": IntegrationAccuracy(settled=0.0)}
    short = settled_motion(model, 1.0, 480.0, start=[RESONANT], **options)
    whole = settled_motion(model, 1.0, 480.0, start=[RESONANT, 0.0], **options)
    np.testing.assert_array_equal(short.state, whole.state)
    assert short.coefficients.shape == (19, 2)


# ----------------------------------------------------------------------------------- stepping


# ------------------------------------------------------------------------------- how it ended


def test_a_motion_that_needs_more_cycles_says_so():
    motion = settled_motion(oscillator(), 1.0, OMEGA, max_cycles=20)
    assert motion.status == MotionStatus.STILL_SETTLING
    # e^{−ζω·20T} = e^{−2.5} is left of it.
    assert 0.05 < motion.distance < 0.3


def test_a_chaotic_motion_is_not_periodic():
    motions = [
        settled_motion(curved_beam(), 1.779e-3, 95 * HZ, max_cycles=300 + 50 * k) for k in range(5)
    ]
    # Whether one cycle of chaos is nearer to the next than another was is chance: of five looks
    # none may say that it settled, and most say that it does not.
    ends = [int(motion.status) for motion in motions]
    assert set(ends) <= {MotionStatus.STILL_SETTLING, MotionStatus.NOT_PERIODIC}
    assert ends.count(MotionStatus.NOT_PERIODIC) >= 3
    assert all(np.all(np.isfinite(motion.coefficients)) for motion in motions)


def test_a_motion_without_bounds_fails():
    motion = settled_motion(oscillator(cubic=-20.0), 1.0, OMEGA, max_cycles=300)
    assert motion.status == MotionStatus.FAILED
    assert motion.n_cycles < 300


# ------------------------------------------------------------------------------ transformations


def test_motions_are_mapped_over_forces_and_compile_once(compilations):
    model, forces = oscillator(cubic=0.5), jnp.array([0.2, 0.5, 0.9])

    def motion(force):
        return settled_motion(model, force, 1.02 * OMEGA)

    first = motion(0.2)
    del compilations[:]
    single = [first, *(motion(force) for force in (0.5, 0.9))]
    assert len(compilations) == 0
    many = jax.jit(jax.vmap(motion))(forces)
    assert np.all(many.converged)
    wanted = [fundamental(one) for one in single]
    # The lanes take the same steps.
    np.testing.assert_allclose(fundamental(many), wanted, rtol=1e-7)


def test_units_do_not_matter():
    """In millimetres and milliseconds the same numbers come out."""
    long, slow = 1e3, 1e3
    one = oscillator(cubic=0.5)
    modes = linear_modes([OMEGA / slow], [RATIO], [[SHAPE]], [PARTICIPATION])
    quartic = float(one.potential.coefficient[0]) / slow**2 / long**2
    other = structure(modes, polynomial_potential({"1111": quartic}, 1))
    first = settled_motion(one, 1.0, 1.02 * OMEGA)
    second = settled_motion(other, long / slow**2, 1.02 * OMEGA / slow)
    # Rounding, which may turn a step at the tolerance.
    np.testing.assert_allclose(
        first.coefficients * long, second.coefficients, atol=1e-6 * RESONANT * long
    )


# -------------------------------------------------------------------------------- failing well


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"force": 0.0}, "`force` must be positive and finite, but is"),
        ({"frequency": np.nan}, "`frequency` must be positive"),
        ({"max_cycles": 7}, "needs 8 cycles or more to settle, but gets 7"),
        ({"start": [1.0, 2.0]}, r"`start` must have shape \(1,\) or \(2, 1\)"),
        ({"start": np.zeros((3, 1))}, "`start` must have shape"),
    ],
)
def test_wrong_settings_of_a_settled_motion_are_named(options, message):
    given = {"force": 1.0, "frequency": OMEGA} | options
    with pytest.raises(ValueError, match=message):
        settled_motion(oscillator(), **given)


def test_without_diffrax_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "diffrax", None)
    with pytest.raises(ImportError, match=r"pip install 'snrmjax\[integrate\]'"):
        settled_motion(oscillator(), 1.0, OMEGA, harmonic_order=2)  # not compiled yet
