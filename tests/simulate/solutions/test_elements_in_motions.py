"""Motions of structures with elements at points: published numbers, and time integration."""

import itertools

import equinox as eqx
import jax
import numpy as np
import pytest
import scipy.linalg

import snrmjax as sj


def element(kind, at, **parameters):
    return sj.model.make_effect(kind, parameters, at=at)


def amplitudes(model, motions, point):
    x = motions.coefficients[:, 1:3] @ np.asarray(model.modes.shape_at(point))
    return np.hypot(x[:, 0], x[:, 1])


def test_two_masses_on_cubic_springs_lose_their_period_where_published():
    """NLvib's example 2, by an independent harmonic balance of 7 harmonics."""
    effects = (
        element("cubic_stiffness", "x1", coefficient=1.0),
        element("cubic_stiffness", sj.model.between("x1", "x2"), coefficient=0.0042),
    )
    chain = sj.model.chain([1.0, 0.05], [1.0, 0.0453, 0.0], [0.002, 0.013, 0.0])
    model = sj.model.from_matrices(*chain, force="x1", effects=effects)
    curve = sj.forced_response(model, 0.11, 0.8, 1.4, harmonic_order=7)[0]
    folds = np.sort(curve.frequency[curve.at_events("fold")])
    np.testing.assert_allclose(folds, [1.20622, 1.21463], rtol=5e-6)
    second = np.sort(curve.frequency[curve.at_events("neimark_sacker")])
    np.testing.assert_allclose(second, [1.11271, 1.19574], rtol=5e-6)
    assert amplitudes(model, curve, "x1").max() == pytest.approx(0.5918, rel=1e-3)


def test_a_stop_grazes_where_the_linear_amplitude_is_the_gap():
    """NLvib's example 3: there the curve of sharp contacts turns at its first and last contact."""
    chain = sj.model.chain([1.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.03, 0.03])
    stop = element("one_sided_stop", "x1", stiffness=100.0, gap=1.0)
    model = sj.model.from_matrices(*chain, force="x2", effects=stop)
    curve = sj.forced_response(model, 0.1, 0.55, 0.8, harmonic_order=15, stability=False)[0]
    np.testing.assert_allclose(curve.frequency[curve.at_events("fold")][-1], 0.6534401, rtol=1e-6)
    assert len(curve.at_events("fold")) == 2  # a contact that jumps between samples makes dozens
    over = np.flatnonzero(np.diff(np.sign(amplitudes(model, curve, "x1") - 1)))
    assert curve.frequency[over[0]] == pytest.approx(0.5818996, rel=0.02)


def test_friction_and_springs_between_points_move_as_integrated_in_time():
    effects = (
        element("cubic_stiffness", "x1", coefficient=1e9),
        element(
            *("jenkins_slider", sj.model.between("x2", "x1")),
            stiffness=800.0,
            slip_displacement=2e-4,
        ),
        element("one_sided_stop", "x2", stiffness=3e3, gap=2e-3),
    )
    chain = sj.model.chain([1.0, 1.0], [1e4, 1e4, 1e4])
    model = sj.model.from_matrices(
        chain.mass, 0.01, chain.stiffness, force={"x1": 1.0, "x2": 0.3j}, effects=effects
    )
    curve = sj.forced_response(model, 4.0, 80.0, 150.0, stability=False)[0]
    k_of_curve = int(np.argmax(amplitudes(model, curve, "x1"))) - 6
    x, omega = curve.coefficients[k_of_curve], curve.frequency[k_of_curve]
    # The same in time: the slider is dragged at its limit, 4 000 steps a cycle of Heun's method.
    shape = np.asarray(model.modes.mode_shape).T
    q, orders = x @ shape, np.arange(1, (len(x) - 1) // 2 + 1)
    modal = sum((phi[:, None] * phi for phi in shape), np.zeros((2, 2)))  # Σ φφᵀ = M⁻¹ = 1
    np.testing.assert_allclose(modal, np.eye(2), atol=1e-12)
    damping = sum(
        2 * 0.01 * w * phi[:, None] * phi
        for w, phi in zip(np.asarray(model.modes.natural_frequency), shape, strict=True)
    )
    stiffness, steps = np.asarray(chain.stiffness), 4000
    load = 4.0 * np.array([np.ones(steps + 1), np.zeros(steps + 1)]) * np.cos(
        2 * np.pi * np.arange(steps + 1) / steps
    ) - 4.0 * np.outer([0, 0.3], np.sin(2 * np.pi * np.arange(steps + 1) / steps))
    h = 2 * np.pi / omega / steps

    (k11, k12), (k21, k22) = stiffness.tolist()
    (d11, d12), (d21, d22) = damping.tolist()

    # Python's own numbers: NumPy takes ten times longer for arrays of two.
    def rate(y1, y2, v1, v2, stretch, force):
        slide = 800.0 * stretch
        stop = 3e3 * max(y2 - 2e-3, 0.0)
        first = force[0] - k11 * y1 - k12 * y2 - d11 * v1 - d12 * v2 - 1e9 * y1**3 + slide
        return first, force[1] - k21 * y1 - k22 * y2 - d21 * v1 - d22 * v2 - slide - stop

    def limited(stretch):
        return min(max(stretch, -2e-4), 2e-4)

    y1, y2 = (q[0] + q[1::2].sum(axis=0)).tolist()
    (v1, v2), stretch, forces = (omega * orders @ q[2::2]).tolist(), 0.0, load.T.tolist()
    for _ in range(8):
        motion = []
        for now, then in itertools.pairwise(forces):
            motion.append((v1, v2))
            a1, a2 = rate(y1, y2, v1, v2, stretch, now)
            fast1, fast2 = v1 + h * a1, v2 + h * a2
            further = limited(stretch + h * (v2 - v1))
            b1, b2 = rate(y1 + h * v1, y2 + h * v2, fast1, fast2, further, then)
            middle1, middle2 = 0.5 * (v1 + fast1), 0.5 * (v2 + fast2)
            y1, y2 = y1 + h * middle1, y2 + h * middle2
            v1, v2 = v1 + 0.5 * h * (a1 + b1), v2 + 0.5 * h * (a2 + b2)
            stretch = limited(stretch + h * (middle2 - middle1))
    assert np.abs(q).sum(axis=0)[1] > 2e-3
    fundamental = 2 * np.mean(
        np.array(motion) * np.exp(-1j * omega * h * np.arange(steps))[:, None], axis=0
    )
    wanted = curve.velocity[k_of_curve, 1]
    np.testing.assert_allclose(fundamental, wanted, rtol=5e-4)


def test_a_damped_mode_goes_from_stuck_to_free():
    """NLvib's example 5: the linear frequencies of both structures are its ends."""
    mass, stiffness = np.diag([0.02, 1.0]), np.array([[40.0, -40.0], [-40.0, 640.0]])
    friction = element("regularised_friction", "x1", slip_force=5.0, velocity=0.05)
    model = sj.model.from_matrices(mass, None, stiffness, force="x1", effects=friction)
    mode = sj.simulate.damped_normal_mode(model, 24.156 * 10 * 1.3846, harmonic_order=9)
    free = np.sqrt(scipy.linalg.eigh(stiffness, mass, eigvals_only=True)[0])
    assert mode.frequency[0] == pytest.approx(np.sqrt(640.0), rel=2e-4)  # x1 does not move
    assert mode.frequency[-1] == pytest.approx(free, rel=3e-5)
    assert mode.damping_ratio.max() > 10 * mode.damping_ratio[-1]


def test_springs_at_points_are_polynomials_of_the_modes():
    """k/4 (wᵀq)⁴ by the multinomial theorem, in the potential and as an element."""
    chain = sj.model.chain([1.0, 2.0], [1.0, 1.5, 0.5])
    spring = element("cubic_stiffness", "x2", coefficient=0.5)
    model = sj.model.from_matrices(*chain, force="x1", effects=spring)
    w = np.asarray(model.modes.shape_at("x2"))
    terms = {
        "".join("12"[i] for i in monomial): 0.125
        * np.prod(w[list(monomial)])
        * sum(sorted(p) == list(monomial) for p in itertools.product(range(2), repeat=4))
        for monomial in itertools.combinations_with_replacement(range(2), 4)
    }
    other = sj.model.structure(model.modes, sj.model.polynomial_potential(terms, 2))
    modes = [sj.nonlinear_normal_mode(m, 1.2, harmonic_order=3) for m in (model, other)]
    energies = [np.interp(1.1, mode.frequency, mode.energy) for mode in modes]
    assert energies[0] == pytest.approx(energies[1], rel=1e-4)
    assert energies[0] > 0.1


@pytest.mark.long
def test_derivatives_by_the_numbers_of_elements():
    chain = sj.model.chain([1.0, 1.0], [1.0, 1.0, 1.0], [0.02, 0.01, 0.02])
    spring = element("cubic_stiffness", sj.model.between("x1", "x2"), coefficient=0.7)
    stop = element("one_sided_stop", "x1", stiffness=2.0, gap=0.4)
    model = sj.model.from_matrices(*chain, force="x1", effects=(spring, stop))
    curve = sj.forced_response(model, 0.1, 0.6, 1.3, harmonic_order=5, stability=False)[0]
    point = curve.point(len(curve.frequency) // 3)

    def amplitude(values):
        changed = eqx.tree_at(
            lambda m: [m.effects[0].coefficient, m.effects[1].stiffness, m.effects[1].gap],
            *(model, list(values)),
        )
        return sj.simulate.periodic_motion(changed, 0.1, point, value=point[1]).amplitude

    values = np.array([0.7, 2.0, 0.4])
    found = np.asarray(jax.grad(lambda v: amplitude(v))(jax.numpy.asarray(values)))
    for k, step in enumerate((1e-4, 1e-4, 1e-5)):
        there = [float(amplitude(values + sign * step * np.eye(3)[k])) for sign in (1, -1)]
        assert found[k] == pytest.approx((there[0] - there[1]) / (2 * step), rel=1e-4, abs=1e-8)
    assert abs(found[0]) > 1e-6
