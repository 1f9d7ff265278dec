"""Every effect that makes a force: harmonic balance against independent time integration.

The equations of motion and the laws are written here again, in NumPy. Smooth and nonsmooth forces
are integrated by SciPy's Dormand-Prince of order 8, Coulomb's oscillator from one stop to the
next in closed form, sliders marched in small steps with their exact return map.
"""

import dataclasses
from functools import lru_cache, partial

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from truths.kinds import KINDS, MEMORYLESS, in_units, of_class, silent

from snrmjax.model.effect_base import AbstractAddedMode, AbstractHysteresis, AbstractNonsmooth
from snrmjax.model.effects import make_effect
from snrmjax.model.modes import linear_modes
from snrmjax.model.structures import simulated_structure, structure
from snrmjax.simulate.continuation.stability import Stability, floquet_multipliers, stability_of
from snrmjax.simulate.solutions.forced_response import solve_at_frequency

OMEGA, RATIO, PARTICIPATION = 500.0, 0.03, 3.0  # rad/s, -, kg^-1/2
STATIC = PARTICIPATION / OMEGA**2  # kg^1/2 m, of 1 N
SIZE = STATIC / (2 * RATIO)  # kg^1/2 m, at resonance under 1 N
SQUARED, VISCOUS = OMEGA**2, 2 * RATIO * OMEGA
FREQUENCIES = np.array([0.97, 1.0, 1.03]) * OMEGA
CYCLES = 64  # e^{−2π·0.03·64} = 6e-6 is left of the transient of a linear mode
TRANSIENT = 24  # cycles before Newton's method, after which 1 % is left
NEWTON_STEPS, STEP = 12, 1e-4  # at most, and of differences, over the motion's magnitude
SAMPLES = 256  # of the last cycle


# -------------------------------------------------------------------------- truth from outside


def phasors(samples, highest=3):
    """Phasors of harmonics 0…`highest` of samples (time, row) over one cycle."""
    spectrum = np.fft.rfft(samples, axis=0)[: highest + 1] * (2 / len(samples))
    spectrum[0] *= 0.5
    return spectrum.T


def settled(law, omega, *, orders=(0.0, 1.0), linear=None, added=None, close=1e-6):
    """Samples (time, row, mode) of the settled motion for each frequency, by Dormand & Prince.

    `law(q, v)` is the force on the mode of interest, `linear` its mass, damping and stiffness.
    `added` is a further mode: its ω, ζ and the coupling (q, r) ↦ (∂V/∂q, ∂V/∂r).
    What is left of the transient after some cycles is taken away by Newton's method on the map
    over a cycle, until it is as `close`, in `SIZE`. All its multipliers are within the unit circle:
    it is where the transient ends.
    """
    mass, viscous, squared = linear or (1.0, VISCOUS, SQUARED)

    def integrated(states, omega, times):
        """States (time, quantity, row) from those at phase zero."""

        def slope(phase, flat):
            x, u, *other = flat.reshape(states.shape)
            q, v = SIZE * x, SIZE * omega * u
            drive = PARTICIPATION * sum(s * np.cos(h * phase) for h, s in enumerate(orders))
            force = drive - viscous * v - squared * q - law(q, v)
            if added is None:
                return np.concatenate([u, force / (mass * SIZE * omega**2)])
            own, ratio, coupling = added
            y, w = other
            r, s = SIZE * y, SIZE * omega * w
            coupling_force, back = coupling(q, r)
            further = -2 * ratio * own * s - own**2 * r - back
            rates = (
                u,
                (force - coupling_force) / (mass * SIZE * omega**2),
                w,
                further / (SIZE * omega**2),
            )
            return np.concatenate(rates)

        solved = solve_ivp(
            *(slope, (0.0, times[-1]), states.ravel()),
            method="DOP853",
            rtol=1e-7,
            atol=1e-8,
            t_eval=times,
        )
        assert solved.success
        return np.moveaxis(solved.y.reshape(*states.shape, len(times)), -1, 0)

    size, n = 2 if added is None else 4, len(omega)
    cycle = np.array([2 * np.pi])
    state = integrated(np.zeros((size, n)), omega, TRANSIENT * cycle)[0]
    for _ in range(NEWTON_STEPS):
        # The motion, and a neighbour of it in every direction, for its multipliers.
        begin = state[:, None] + STEP * np.eye(size, size + 1, 1)[:, :, None]
        end = integrated(begin.reshape(size, -1), np.tile(omega, size + 1), cycle)[0]
        end = end.reshape(size, size + 1, n)
        by_begin = np.moveaxis(end[:, 1:] - end[:, :1], 2, 0) / STEP
        left = (end[:, 0] - state).T[:, :, None]
        change = np.linalg.solve(np.eye(size) - by_begin, left)[:, :, 0].T
        state = state + change
        if np.max(np.abs(change)) < close:
            break
    else:
        raise AssertionError("no closed orbit was found")
    assert np.max(np.abs(np.linalg.eigvals(by_begin))) < 1
    samples = integrated(state, omega, 2 * np.pi * np.arange(SAMPLES + 1) / SAMPLES)
    np.testing.assert_allclose(samples[-1], state, atol=3 * close)  # it closes
    return np.moveaxis(samples[:-1, ::2] * SIZE, 2, 1)


def coulomb_oscillator(friction, omega):
    """Samples of the settled motion with sgn q̇, from stop to stop in closed form."""
    root = OMEGA * (-RATIO + 1j * np.sqrt(1 - RATIO**2))
    steady = PARTICIPATION / (SQUARED - omega**2 + 1j * VISCOUS * omega)

    def piece(time, q, v, sign):
        """q(t) and q̇(t) from `time` on while q̇ has one sign."""
        forced = steady * np.exp(1j * omega * time)
        shift = -sign * friction / SQUARED
        free = np.array([q - shift - forced.real, v - (1j * omega * forced).real])
        weight = np.linalg.solve(np.array([[1.0, 0.0], [root.real, -root.imag]]), free)
        weight = weight[0] + 1j * weight[1]

        def motion(t):
            wave = steady * np.exp(1j * omega * t)
            rest = weight * np.exp(root * (t - time))
            return shift + (wave + rest).real, (1j * omega * wave + root * rest).real

        return motion

    end, period = CYCLES * 2 * np.pi / omega, 2 * np.pi / omega
    wanted = end - period + period * np.arange(SAMPLES) / SAMPLES
    samples = np.zeros(SAMPLES)
    time, q = 0.0, 0.0
    while time < end:
        net_force = PARTICIPATION * np.cos(omega * time) - SQUARED * q
        assert abs(net_force) > friction, "it sticks, which is not provided for here"
        sign = np.sign(net_force)
        motion = piece(time, q, 0.0, sign)
        grid = time + period * np.arange(1, 200) / 200
        reversal = grid[np.argmax(sign * motion(grid)[1] < 0)]
        stop = brentq(
            lambda t, motion=motion: motion(t)[1], reversal - period / 200, reversal, xtol=1e-14
        )
        here = (wanted >= time) & (wanted < stop)
        samples[here] = motion(wanted[here])[0]
        time, q = stop, motion(stop)[0]
    return samples


def marched(stiffness, slip, omega, *, cycles=CYCLES, steps=512):
    """Samples of the settled motion with sliders, by Runge & Kutta of order 4 in fixed steps.

    A slider's block follows the spring that would be stretched beyond its slip displacement.
    """
    n = len(omega)
    q, v, blocks = np.zeros(n), np.zeros(n), np.zeros((n, len(slip)))
    step = 2 * np.pi / steps / omega
    tau = 2 * np.pi * np.arange(2 * steps + 1) / (2 * steps)
    drive = PARTICIPATION * np.cos(tau)

    def moved(q):
        return np.minimum(np.maximum(blocks, q[:, None] - slip), q[:, None] + slip)

    def acceleration(load, q, v):
        return load - VISCOUS * v - SQUARED * q + moved(q) @ stiffness

    samples = np.zeros((steps, n))
    for _ in range(cycles):
        for k in range(steps):
            samples[k] = q
            a1 = acceleration(drive[2 * k], q, v)
            v2 = v + 0.5 * step * a1
            a2 = acceleration(drive[2 * k + 1], q + 0.5 * step * v, v2)
            v3 = v + 0.5 * step * a2
            a3 = acceleration(drive[2 * k + 1], q + 0.5 * step * v2, v3)
            v4 = v + step * a3
            a4 = acceleration(drive[2 * k + 2], q + step * v3, v4)
            before = q
            q = q + step * (v + 2 * v2 + 2 * v3 + v4) / 6
            new = v + step * (a1 + 2 * a2 + 2 * a3 + a4) / 6
            # Where q reversed within the step, the sliders moved with it up to the turning point.
            reversed_ = v * new < 0
            until = v / np.where(reversed_, v - new, 1.0)
            blocks = moved(np.where(reversed_, before + 0.5 * step * until * v, before))
            blocks, v = moved(q), new
    return samples


# -------------------------------------------------------------------------------- the effects

GROUPS = {
    "nonsmooth": of_class(AbstractNonsmooth),
    "friction": of_class(AbstractHysteresis),
    "coupled": of_class(AbstractAddedMode),
}
GROUPS["smooth"] = [
    kind
    for kind, of in KINDS.items()
    if of.weak is not None and not any(kind in kinds for kinds in GROUPS.values())
]


def weak(kind):
    """The parameters that change the resonance clearly, but not greatly."""
    return in_units(kind, KINDS[kind].weak, SIZE, 1 / OMEGA)


ORDER = 0.6  # test order, for drift
HARMONICS = {"smooth": 11, "nonsmooth": 15, "friction": 15, "coupled": 11}
# Difference of the two, relative to the fundamental. Smooth laws: SciPy's 1e-7 per step,
# accumulated. Contacts: rounding over 2 % of half the range, which changes their stiffness by up
# to 1e-4. Coulomb: smoothing takes 5.1e-4 of 4F/π. Sliders: turning points between 256 samples,
# 1e-4.
TOLERANCE = {"smooth": 1e-5, "nonsmooth": 1e-4, "friction": 1e-4, "coupled": 1e-5}
COULOMB = 5e-4


def law_of(kind):
    """Force of a memoryless effect, from its definition."""
    if kind in MEMORYLESS:
        return partial(MEMORYLESS[kind].force, p=weak(kind))
    return lambda q, v: 0.0 * q


def linear_terms_of(kind, p):
    """Mass, damping and stiffness with a linear change."""
    shift = p.get("relative_shift", ORDER * p.get("relative_drift", 0.0))
    moved, ratio = OMEGA * (1 + shift), RATIO + p.get("damping_ratio_change", 0.0)
    return 1.0 + p.get("mass", 0.0), 2 * ratio * moved, moved**2


def coupling_of(kind, p):
    """The further mode and the slopes of V = b qⁿ r."""
    n, b = int(kind[-1]), p["coefficient"]
    own = 2 * np.pi * p["frequency_hz"]
    return own, p["damping_ratio"], lambda q, r: (n * b * q ** (n - 1) * r, b * q**n)


@lru_cache
def truth(kind):
    """Phasors (frequency, harmonic) of the mode of interest in the settled motion."""
    parameters = weak(kind)
    if kind == "coulomb_friction":
        rows = [coulomb_oscillator(parameters["force"], omega) for omega in FREQUENCIES]
        return phasors(np.stack(rows, axis=1))
    if kind == "jenkins_slider":
        # k(q − z) − kq: the linear frequency holds the stuck spring.
        sliders = np.array([parameters["stiffness"]]), np.array([parameters["slip_displacement"]])
        return phasors(marched(*sliders, FREQUENCIES, cycles=40))
    if kind == "iwan_microslip":
        # Density c p (p − 1) s^{p−2}, summed up over cells of a grid that is finer at small s.
        c, p = parameters["coefficient"], parameters["exponent"]
        edges = SIZE * np.linspace(0.0, 1.0, 201) ** 2
        cells = c * p * np.diff(edges ** (p - 1))
        return phasors(marched(cells, 0.5 * (edges[1:] + edges[:-1]), FREQUENCIES, cycles=40))
    if kind in GROUPS["coupled"]:
        added = coupling_of(kind, parameters)
        found = settled(lambda q, v: 0.0 * q, FREQUENCIES, added=added)
        return phasors(found[:, :, 0])
    laws = [law_of(one) for one in (kind, *KINDS[kind].only_with)]
    orders = (0.0, 1.0, parameters.get("second", 0.0), parameters.get("third", 0.0))
    found = settled(
        lambda q, v: sum(law(q, v) for law in laws),
        FREQUENCIES,
        orders=orders,
        linear=linear_terms_of(kind, parameters),
        # A corner within a step makes errors that change from one integration to the next.
        close=1e-5 if kind in GROUPS["nonsmooth"] else 1e-6,
    )
    return phasors(found[:, :, 0])


def model_with(group, kind, *, without=False):
    """All effects of a group, so that one program serves them, all but one of them at zero."""
    acting = {*KINDS[kind].only_with, *([] if without else [kind])}
    effects = []
    for name in GROUPS[group]:
        values = weak(name) if name in acting else silent(name, weak(name))
        effects.append(make_effect(name, values))
    modes = linear_modes([OMEGA], [RATIO], [[1.0]], [PARTICIPATION])
    made = structure(modes, effects=tuple(effects))
    return dataclasses.replace(made, test_order=jnp.asarray(ORDER))


def balanced(model, guess, order):
    """Harmonic balance at all frequencies from phasors (frequency, harmonic) of the first mode."""
    simulated = simulated_structure(model)
    start = np.zeros((len(FREQUENCIES), 2 * order + 1, simulated.n_modes))
    start[:, 0, 0] = guess[:, 0].real
    start[:, 1:7:2, 0], start[:, 2:8:2, 0] = guess[:, 1:].real, -guess[:, 1:].imag
    return solve_at_frequency(
        simulated, jnp.ones(len(FREQUENCIES)), jnp.asarray(FREQUENCIES), jnp.asarray(start)
    )


def as_phasors(coefficients):
    """Phasors of harmonics 0…3 of the mode of interest from the package's coefficients."""
    x = np.asarray(coefficients)[:, :, 0]
    return np.concatenate([x[:, :1], x[:, 1:7:2] - 1j * x[:, 2:8:2]], axis=1)


def tolerance(group, kind):
    return COULOMB if kind == "coulomb_friction" else TOLERANCE[group]


SLOW = ("bilinear_stiffness", "iwan_microslip", "internal_resonance_1_3")  # to compile
ALL = [
    pytest.param(group, kind, id=kind, marks=[pytest.mark.long] * (kind in SLOW))
    for group, kinds in GROUPS.items()
    for kind in kinds
]


@pytest.mark.parametrize(("group", "kind"), ALL)
def test_harmonic_balance_is_the_settled_motion(group, kind):
    wanted = truth(kind)
    model = model_with(group, kind)
    coefficients, converged = balanced(model, wanted, HARMONICS[group])
    assert np.all(converged)
    found = as_phasors(coefficients)
    scale = np.abs(wanted[:, 1:2])
    # The mean and the second and third harmonic to the same fraction of the fundamental.
    np.testing.assert_allclose(found / scale, wanted / scale, atol=tolerance(group, kind))
    # The effect is not small.
    without, _ = balanced(model_with(group, kind, without=True), wanted, HARMONICS[group])
    change = np.abs(as_phasors(without)[:, 1] / wanted[:, 1] - 1)
    assert change.max() > 0.05
    # A settled motion is stable.
    multipliers = floquet_multipliers(simulated_structure(model), coefficients, FREQUENCIES)
    assert np.all(stability_of(multipliers) == Stability.STABLE)
