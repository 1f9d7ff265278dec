"""Normal modes against elliptic integrals, quadrature and integrated motions."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq
from scipy.special import ellipk

from snrmjax.model.builders.beams import curved_beam, flat_beam
from snrmjax.model.builders.matrices import from_matrices
from snrmjax.model.effects import make_effect
from snrmjax.model.modes import linear_modes
from snrmjax.model.potential import polynomial_potential
from snrmjax.model.structures import structure
from snrmjax.simulate.balance.harmonics import with_sines
from snrmjax.simulate.continuation.continuation import CurveStatus, StepControl
from snrmjax.simulate.solutions.normal_modes import DEFAULT_STEPS, nonlinear_normal_mode

HZ = 2 * np.pi
W, QUARTIC = 2.0, 0.3  # q̈ + 4q + 1.2q³ = 0


def duffing(quartic=QUARTIC, cubic=0.0, effects=()):
    """Damped as ever: a normal mode leaves the damping out."""
    modes = linear_modes([W], [0.05], [[3.0]], [-1.0])
    return structure(
        modes, polynomial_potential({"111": cubic, "1111": quartic}, 1), effects=effects
    )


def nome(amplitude, quartic=QUARTIC):
    """q = e^{−πK'/K}: the harmonics of the Duffing oscillator's motion fall as q^{h/2}."""
    squared = W**2 + 4 * quartic * amplitude**2
    m = 2 * quartic * amplitude**2 / squared
    return np.exp(-np.pi * ellipk(1 - m) / ellipk(m))


def exact_frequency(amplitude, quartic=QUARTIC):
    """Ω = π√(ω² + 4cA²)/2K(m), m = 4cA²/2(ω² + 4cA²): the Duffing oscillator's exact frequency."""
    squared = W**2 + 4 * quartic * amplitude**2
    return np.pi * np.sqrt(squared) / (2 * ellipk(2 * quartic * amplitude**2 / squared))


@pytest.fixture(scope="module")
def duffing_branch():
    # To rounding, so that only the harmonics that are left out make a difference.
    return nonlinear_normal_mode(
        duffing(), 9.0, steps=dataclasses.replace(DEFAULT_STEPS, tolerance=1e-13)
    )


def test_duffing_oscillator_has_its_exact_frequency_and_energy(duffing_branch):
    branch = duffing_branch
    assert branch.status == CurveStatus.UPPER_END
    assert branch.frequency[0] == pytest.approx(W, rel=1e-5)
    assert branch.frequency[-1] == 9.0
    amplitude = branch.coefficients[:, :, 0].sum(axis=1)  # q(0), the turning point
    assert 4 * QUARTIC * amplitude[-1] ** 2 / W**2 > 25  # far beyond a small correction
    # What nine harmonics leave out is the eleventh: q⁵ of the first, at most 2e-7 here.
    error = np.abs(branch.frequency / exact_frequency(amplitude) - 1)
    assert np.all(error < 3 * nome(amplitude) ** 5 + 1e-13)
    assert error.max() < 2e-7
    energy = W**2 * amplitude**2 / 2 + QUARTIC * amplitude**4
    np.testing.assert_allclose(branch.energy, energy, rtol=1e-12)  # the same sum: rounding
    assert np.all(np.diff(branch.energy) > 0)
    # At rest at the turning point, and the velocity that the sensor sees: Φ = 3.
    shape = branch.velocity[:, :, 0]
    orders = np.arange(10)
    wanted = 3j * orders * branch.frequency[:, None] * branch.coefficients[:, :, 0]
    np.testing.assert_allclose(shape, wanted, rtol=1e-13, atol=1e-13)


@pytest.fixture(scope="module")
def effect_branch():
    """The same oscillator with its cubic stiffness as an effect, and three harmonics."""
    effect = make_effect("cubic_stiffness", {"coefficient": 4 * QUARTIC})
    return nonlinear_normal_mode(duffing(quartic=0.0, effects=(effect,)), 9.0, harmonic_order=3)


def test_frequency_converges_with_the_harmonics(duffing_branch, effect_branch):
    errors = {}
    for order, branch in ((3, effect_branch), (9, duffing_branch)):
        amplitude = branch.coefficients[:, :, 0].sum(axis=1)
        at_three = np.argmin(np.abs(amplitude - 3.0))
        exact = exact_frequency(amplitude[at_three])
        errors[order] = abs(branch.frequency[at_three] / exact - 1)
        # The first odd harmonic that is left out, of the order of the error but not far below.
        left_out = nome(amplitude[at_three]) ** ((order + 1) // 2)
        assert left_out / 20 < errors[order] < 3 * left_out
    assert errors[9] < errors[3] / 1000


@pytest.mark.parametrize("cubic", [0.25, -0.25])
def test_asymmetric_oscillator_has_the_period_of_its_quadrature(cubic):
    """Softening: V = 2q² ± q³/4 + q⁴/50 has T = 2∫dq/√(2(E − V)) between its turning points."""
    model = duffing(quartic=0.02, cubic=cubic)
    branch = nonlinear_normal_mode(model, 1.95)
    assert branch.status == CurveStatus.LOWER_END
    assert branch.frequency[-1] == 1.95

    def potential(q):
        return W**2 * q**2 / 2 + cubic * q**3 + 0.02 * q**4

    for k in (len(branch.frequency) // 3, -1):
        energy = branch.energy[k]
        right = brentq(lambda q, e=energy: potential(q) - e, 0, 5, xtol=1e-14)
        left = brentq(lambda q, e=energy: potential(q) - e, -5, 0, xtol=1e-14)
        # The branch starts its motion at one turning point, whose energy it reports.
        start = branch.coefficients[k, :, 0].sum()
        assert min(abs(start - right), abs(start - left)) < 1e-12
        # q = m + h sin θ takes the square-root ends out of the integral.
        m, h = (right + left) / 2, (right - left) / 2

        def time(theta, e=energy, m=m, h=h):
            return h * np.cos(theta) / np.sqrt(2 * (e - potential(m + h * np.sin(theta))))

        edge = (
            np.pi / 2 - 1e-7
        )  # 0/0 at the very ends; what is left out is 1e-7 of a flat integrand
        period = 2 * quad(time, -edge, edge, epsrel=1e-10, limit=200)[0] * (np.pi / 2 / edge)
        assert branch.frequency[k] == pytest.approx(2 * np.pi / period, rel=1e-6)


def test_curved_beam_softens_then_stiffens():
    beam = curved_beam()
    # Its numbers in the structure above, which is compiled already (a name is not a number).
    model = eqx.tree_at(
        lambda m: (m.modes.natural_frequency, m.potential.coefficient),
        duffing(),
        (beam.modes.natural_frequency, beam.potential.coefficient),
    )
    assert model.potential.monomials == beam.potential.monomials
    branch = nonlinear_normal_mode(model, 80 * HZ)
    assert branch.status == CurveStatus.UPPER_END
    assert branch.frequency.min() < 0.75 * branch.frequency[0]
    fold = int(np.argmin(branch.frequency))
    assert np.all(np.diff(branch.frequency[:fold]) < 0)
    assert np.all(np.diff(branch.frequency[fold:]) > 0)


def test_an_effect_that_stores_energy_counts(effect_branch):
    assert effect_branch.status == CurveStatus.UPPER_END
    amplitude = effect_branch.coefficients[:, :, 0].sum(axis=1)
    energy = W**2 * amplitude**2 / 2 + QUARTIC * amplitude**4
    np.testing.assert_allclose(effect_branch.energy, energy, rtol=1e-12)  # rounding


# ------------------------------------------------------------------------------- the flat beam


@pytest.fixture(scope="module")
def flat_branch():
    return nonlinear_normal_mode(flat_beam(), 100 * HZ, harmonic_order=15)


def test_flat_beam_carries_a_tongue(flat_branch):
    # DESIGN.md item 8: a 1:5 tongue with mode 3 between about 87.5 and 90.2 Hz; the fundamental
    # of q₁ passes through zero at its tip.
    branch = flat_branch
    assert branch.status == CurveStatus.UPPER_END
    hz = branch.frequency / HZ
    folds = np.flatnonzero(np.diff(np.sign(np.diff(hz))) != 0) + 1
    assert len(folds) == 2
    tip, root = folds
    assert hz[tip] == pytest.approx(90.2, abs=0.05)
    assert hz[root] == pytest.approx(87.5, abs=0.05)
    fundamental = branch.coefficients[:, 1, 0]
    crossing = np.flatnonzero(np.diff(np.sign(fundamental)) != 0)
    assert len(crossing) == 1
    assert abs(int(crossing[0]) - int(tip)) <= 3
    # Along the tongue the fifth harmonic of the model's second mode grows and shrinks again.
    fifth = np.abs(branch.coefficients[:, 5, 1])
    assert fifth[tip] > 0.5 * np.abs(branch.coefficients[tip]).max()
    assert fifth[-1] < 0.02 * np.abs(branch.coefficients[-1]).max()


def test_flat_beam_motions_close_and_keep_their_energy(flat_branch, time_domain):
    branch = flat_branch
    model = eqx.tree_at(lambda m: m.modes.damping_ratio, flat_beam(), jnp.zeros(4))
    hz = branch.frequency / HZ
    squared = np.asarray(model.modes.natural_frequency) ** 2
    monomials = [np.array(m) for m in model.potential.monomials]
    value = np.asarray(model.potential.coefficient)

    def energy(state):  # written out: ½v² + ½ω²q² + Σ c Πq
        q, v = state[:4], state[4:]
        return (
            v @ v / 2
            + squared @ q**2 / 2
            + sum(c * q[m].prod() for c, m in zip(value, monomials, strict=True))
        )

    worst = {"backbone": 0.0, "tongue": 0.0}
    for k in range(5, len(hz), 20):
        truth = time_domain(model, 0.0, branch.frequency[k])
        state = np.concatenate([branch.coefficients[k].sum(axis=0), np.zeros(4)])
        assert energy(state) == pytest.approx(branch.energy[k], rel=1e-12)
        later = truth.integrate(state, 0.37 * 2 * np.pi / branch.frequency[k])[-1][0]
        # What the integrator makes of it has the same energy: 1e-12 a step over 500 steps.
        assert energy(later) == pytest.approx(branch.energy[k], rel=1e-9)
        where = "backbone" if hz[k] < 87.3 or (k > len(hz) / 2 and hz[k] > 90.3) else "tongue"
        worst[where] = max(worst[where], truth.closure(state))
    # 15 harmonics: 2e-8 on the backbone; on the tongue, where the fifteenth harmonic is the third
    # of mode 3's own, 1e-3 (6e-6 with 25).
    assert worst["backbone"] < 1e-6
    assert worst["tongue"] < 3e-3


def test_stability_along_the_tongue_is_that_of_integrated_motions(
    flat_branch, time_domain, state_of
):
    """Two of the multipliers are one: a motion may be shifted in time and in energy."""
    branch = flat_branch
    model = eqx.tree_at(lambda m: m.modes.damping_ratio, flat_beam(), jnp.zeros(4))
    assert np.all(branch.stability[branch.frequency < 87.4 * HZ] == 1)
    (unstable,) = (np.flatnonzero(branch.stability == 0),)
    assert np.all(np.diff(unstable) == 1)  # one section, from one fold of the tongue to the other
    for k in (unstable[0] - 10, unstable[len(unstable) // 2], unstable[-1] + 10):
        motion = with_sines(branch.coefficients[k])
        state = state_of(motion, branch.frequency[k])
        truth = time_domain(model, 0.0, branch.frequency[k]).multipliers(state)
        # The balance leaves up to 1e-3 of a motion on the tongue out, which parts the two that are
        # one by its square root: the others stay.
        nearest = np.abs(branch.multipliers[k][:, None] - truth).min(axis=1)
        assert nearest.max() < 5e-3 * np.abs(truth).max(), k


def test_two_masses_have_a_tongue_of_three_and_lose_stability_as_by_scipy():
    """Kerschen et al. 2009: in phase, mode 2 in its third harmonic near √2 rad/s."""
    spring = make_effect("cubic_stiffness", {"coefficient": 0.5}, at="x1")
    stiffness = np.array([[2.0, -1.0], [-1.0, 2.0]])
    model = from_matrices(np.eye(2), 0.1 * stiffness, stiffness, force="x1", effects=spring)
    wide = StepControl(first=1e-3, largest=0.2, angle=0.1, max_points=1500)
    branch = nonlinear_normal_mode(model, 1.41, largest_amplitude=300.0, steps=wide)
    assert branch.tongues[0].name == "1:3 with mode 2"
    # Published: there mode 2's third harmonic has it all, at ω 1.4072 and log E 2.455.
    tip = np.argmin(np.abs(branch.coefficients[:, 1]).max(axis=1) + (branch.energy < 200) * 1e3)
    assert branch.frequency[tip] == pytest.approx(1.4072, abs=5e-4)
    assert np.log10(branch.energy[tip]) == pytest.approx(2.45, abs=0.02)

    def map_of(k):
        def rate(t, y):
            x, v, map_ = y[:2], y[2:4], y[4:].reshape(4, 4)
            tangent = stiffness + 1.5 * x[0] ** 2 * np.diag([1.0, 0.0])
            swing = np.concatenate([map_[2:], -tangent @ map_[:2]])
            return np.concatenate([v, -stiffness @ x - [0.5 * x[0] ** 3, 0.0], swing.ravel()])

        start = np.asarray(model.modes.mode_shape) @ branch.coefficients[k].sum(axis=0)
        begin = np.concatenate([start, np.zeros(2), np.eye(4).ravel()])
        period = (0.0, 2 * np.pi / branch.frequency[k])
        end = solve_ivp(rate, period, begin, method="DOP853", rtol=1e-11, atol=1e-11).y[4:, -1]
        return np.linalg.eigvals(end.reshape(4, 4))

    first = int(np.argmin(branch.stability))  # from here on unstable
    assert branch.energy[first] == pytest.approx(41.0, rel=0.1)
    for k, stable in ((first - 4, True), (first + 4, False)):
        largest = np.abs(map_of(k)).max()
        assert np.abs(branch.multipliers[k]).max() == pytest.approx(largest, abs=1e-4)
        assert (largest < 1 + 1e-4) == stable == bool(branch.stability[k])


# -------------------------------------------------------------------------------- failing well


def test_a_curve_that_never_arrives_ends_at_its_largest_amplitude():
    branch = nonlinear_normal_mode(duffing(), 1.5, largest_amplitude=1.0)  # it stiffens
    assert branch.status == CurveStatus.AMPLITUDE_LIMIT
    largest = np.abs(branch.coefficients[:, 1, 0])
    assert largest[-2] <= 1.0 < largest[-1] < 1.1


def test_a_structure_of_nan_has_no_start():
    model = duffing()
    model = eqx.tree_at(lambda m: m.potential.coefficient, model, jnp.array([0.0, jnp.nan]))
    branch = nonlinear_normal_mode(model, 9.0)
    assert branch.status == CurveStatus.NO_START
    assert branch.frequency.shape == branch.energy.shape == (0,)
    assert branch.coefficients.shape == (0, 10, 1)
    assert branch.velocity.shape == (0, 10, 1)


@pytest.mark.parametrize("frequency", [0.0, -1.0, np.nan, W])
def test_an_impossible_frequency_is_refused(frequency):
    with pytest.raises(ValueError, match="`to_frequency` must be positive and differ from"):
        nonlinear_normal_mode(duffing(), frequency)


def test_the_tongue_is_reported_and_can_be_skipped(flat_branch):
    model, branch = flat_beam(), flat_branch
    (tongue,) = branch.tongues
    assert (tongue.mode, tongue.harmonic) == (1, 5)
    # DESIGN: between about 87.5 and 90.2 Hz, and at its tip the fifth harmonic has it all.
    assert tongue.from_frequency / HZ == pytest.approx(87.5, abs=0.1)
    assert tongue.to_frequency / HZ == pytest.approx(90.2, abs=0.1)
    assert tongue.energy_fraction > 0.99
    assert tongue.name == "1:5 with mode 2"
    assert branch.resonance[tongue.first] == tongue.name
    assert branch.resonance[tongue.first - 1] == ""
    np.testing.assert_allclose(branch.mode_fraction.sum(axis=1), 1.0, rtol=1e-13)
    # Where five times the frequency is about that of the second mode, stiffened as it is.
    assert 5 * tongue.from_frequency > float(model.modes.natural_frequency[1])
    skipped = nonlinear_normal_mode(
        model, float(branch.frequency[-1]), harmonic_order=15, tongues="skip"
    )
    (gap,) = skipped.tongues
    assert gap[:5] == tongue[:5]
    kept = np.r_[0 : tongue.first, tongue.last + 1 : len(branch.frequency)]
    np.testing.assert_array_equal(skipped.frequency, branch.frequency[kept])
    np.testing.assert_array_equal(skipped.energy, branch.energy[kept])
    assert np.all(np.diff(skipped.frequency) > 0)  # a function of frequency again
    assert (gap.first, gap.last) == (tongue.first, tongue.first - 1)
    # The main branch passes the gap nearly straight: across it the amplitude rises as around it.
    velocity = np.abs(skipped.velocity[:, 1, 0])
    slopes = [
        (velocity[gap.first + k] - velocity[gap.last - k])
        / (skipped.frequency[gap.first + k] - skipped.frequency[gap.last - k])
        for k in (0, 15)
    ]
    assert slopes[0] == pytest.approx(slopes[1], rel=0.25)


def test_friction_is_left_out_of_a_conservative_mode(duffing_branch):
    sliders = make_effect("jenkins_slider", {"stiffness": 1.0, "slip_displacement": 0.1})
    rubbing = make_effect("coulomb_friction", {"force": 0.1})
    fine = dataclasses.replace(DEFAULT_STEPS, tolerance=1e-13)
    branch = nonlinear_normal_mode(duffing(effects=(sliders, rubbing)), 9.0, steps=fine)
    np.testing.assert_array_equal(branch.frequency, duffing_branch.frequency)
    np.testing.assert_array_equal(branch.energy, duffing_branch.energy)
