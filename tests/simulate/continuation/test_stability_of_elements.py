"""Multipliers of motions with friction and stops at several points, by an independent integration.

The points are integrated by Runge and Kutta, sliders clipped after each step; the map over a
period is differentiated by central differences, positions of the sliders included.
"""

import numpy as np
import pytest

import snrmjax as sj

MASSES, SPRINGS, DAMPERS = [1.0, 1.0, 1.0], [1e4, 1e4, 1e4, 0.0], [1.0, 1.0, 1.0, 0.0]
ROWS = np.array([[-1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])  # x2 − x1 and x3
STUCK, SLIP = np.array([2000.0, 1500.0]), np.array([2e-4, 3e-4])
CUBIC, STOP, GAP, FORCE = 1e9, 8e3, 3e-3, 3.0
STEPS = 4000


@pytest.fixture(scope="module")
def motion():
    """The structure, and a resonant motion: frequency, coefficients of the points, multipliers."""

    def element(kind, at, **parameters):
        return sj.model.make_effect(kind, parameters, at=at)

    between = sj.model.between("x2", "x1")
    effects = (
        element("jenkins_slider", between, stiffness=STUCK[0], slip_displacement=SLIP[0]),
        element("jenkins_slider", "x3", stiffness=STUCK[1], slip_displacement=SLIP[1]),
        element("cubic_stiffness", "x1", coefficient=CUBIC),
        element("one_sided_stop", "x3", stiffness=STOP, gap=GAP),
    )
    chain = sj.model.chain(MASSES, SPRINGS, DAMPERS)
    model = sj.model.from_matrices(*chain, force="x1", effects=effects)
    first = float(model.modes.natural_frequency[0])
    curve = sj.forced_response(model, FORCE, 0.9 * first, 1.3 * first)[0]
    large = np.argmax(np.linalg.norm(curve.coefficients[:, 1:3], axis=(1, 2)))
    k = int(large) - 4
    points = curve.coefficients[k] @ np.asarray(model.modes.mode_shape).T
    return curve.frequency[k], points, curve.multipliers[k]


def advanced(omega, x, v, z):
    """One period from columns of positions, velocities and sliders."""
    chain, dt = sj.model.chain(MASSES, SPRINGS, DAMPERS), 2 * np.pi / omega / STEPS

    def acceleration(x, v, t):
        force = -chain.stiffness @ x - chain.damping @ v
        force[0] += FORCE * np.cos(omega * t) - CUBIC * x[0] ** 3
        force[2] -= STOP * np.maximum(x[2] - GAP, 0.0)
        there = ROWS @ x
        held = np.clip(z, there - SLIP[:, None], there + SLIP[:, None])
        return force - ROWS.T @ (STUCK[:, None] * (there - held))

    for i in range(STEPS):
        t = i * dt
        one = acceleration(x, v, t)
        two = acceleration(x + dt / 2 * v, v + dt / 2 * one, t + dt / 2)
        three = acceleration(x + dt / 2 * v + dt**2 / 4 * one, v + dt / 2 * two, t + dt / 2)
        four = acceleration(x + dt * v + dt**2 / 2 * two, v + dt * three, t + dt)
        x = x + dt * v + dt**2 / 6 * (one + two + three)
        v = v + dt / 6 * (one + 2 * two + 2 * three + four)
        there = ROWS @ x
        z = np.clip(z, there - SLIP[:, None], there + SLIP[:, None])
    return x, v, z


@pytest.mark.long
def test_multipliers_with_friction_and_a_stop_at_several_points(motion):
    omega, points, found = motion
    orders = np.arange(1, (len(points) - 1) // 2 + 1)
    x = points[0] + points[1::2].sum(axis=0)
    v = omega * orders @ points[2::2]
    # Where the sliders are, from two periods of the motion itself.
    tau = 4 * np.pi * np.arange(8001) / 8000
    waves = [np.cos(np.outer(tau, orders)), np.sin(np.outer(tau, orders))]
    path = points[0] + waves[0] @ points[1::2] + waves[1] @ points[2::2]
    assert path[:, 2].max() > 1.05 * GAP
    z = np.zeros(2)
    for there in path @ ROWS.T:
        z = np.clip(z, there - SLIP, there + SLIP)
    state = np.concatenate([x, v, z])
    size = np.concatenate([np.full(3, 1e-7), np.full(3, 1e-7 * omega), np.full(2, 1e-8)])
    columns = state[:, None] + np.concatenate([np.diag(size), -np.diag(size)], axis=1)
    end = np.concatenate(advanced(omega, columns[:3], columns[3:6], columns[6:]))
    np.testing.assert_allclose(end[:6].mean(axis=1), state[:6], rtol=2e-3, atol=2e-3 * abs(x).max())
    values = np.linalg.eigvals((end[:, :8] - end[:, 8:]) / (2 * size))
    values = values[np.argsort(-np.abs(values))]
    assert np.all(np.abs(values[6:]) < 1e-9)  # sliders are reset in every period
    wanted, ours = (np.sort(np.abs(row)) for row in (values[:6], found))
    # Times of slip, from 512 samples, are off by up to 1e-4 of a period; those of 4 000 steps too.
    np.testing.assert_allclose(ours, wanted, rtol=0, atol=5e-4)


@pytest.mark.long
def test_a_multiplier_is_one_where_a_response_with_sliders_and_stops_turns():
    # At a fold two motions meet, so that a disturbance from one to the other persists.
    elements = (
        ("jenkins_slider", "x1", {"stiffness": 0.1655, "slip_displacement": 0.4998}),
        (
            *("jenkins_slider", sj.model.between("x2", "x1")),
            {"stiffness": 0.3583, "slip_displacement": 0.3066},
        ),
        ("one_sided_stop", "x3", {"stiffness": 0.5859, "gap": 0.4062}),
        ("cubic_stiffness", "x3", {"coefficient": 0.2867}),
        ("one_sided_stop", sj.model.between("x3", "x2"), {"stiffness": 0.8229, "gap": 0.4772}),
    )
    effects = tuple(sj.model.make_effect(kind, given, at=at) for kind, at, given in elements)
    chain = sj.model.chain(
        *([1.3601, 1.0579, 1.3834], [0.7566, 1.1251, 0.9635, 1.2613]),
        [0.0163, 0.01241, 0.01667, 0.01161],
    )
    model = sj.model.from_matrices(*chain, force="x1", effects=effects)
    curve = sj.forced_response(model, 0.5144, 0.75, 0.88)[0]
    folds = curve.at_events("fold")
    assert len(folds) == 2
    for k in folds:
        # Of the nine harmonics alone the upper fold's is 0.96: a stable motion there. With twice
        # as many the error is that of the next ones, 1e-3.
        assert np.abs(curve.multipliers[k] - 1).min() < 3e-3
