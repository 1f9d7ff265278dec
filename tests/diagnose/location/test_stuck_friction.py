"""Stuck friction; truth from the matrices of a chain with two points locked together."""

import numpy as np
import pytest
from truths.chain_states import DAMPING, FIRST, MASS, POINTS, STIFFNESS, structure

import snrmjax as sj
from snrmjax.diagnose.location.laws_at_points import LawAtPoint
from snrmjax.diagnose.location.source_patterns import sensor_records, source_fit, source_pattern
from snrmjax.identify.calibrate.calibration_states import calibration_states

INFLUENCE = np.array([0.0, -1.0, 1.0, 0.0])  # x3 less x2
FORCES = (0.5, 1.0, 1.5)  # N, at x1
NOISE = 2e-3


@pytest.fixture(scope="module")
def stuck():
    """Frequencies, forces, motions of the points, and the reaction that locks two of them."""
    rows = []
    for force in FORCES:
        for omega in np.linspace(0.97, 1.03, 6) * FIRST:
            stiffness = STIFFNESS - omega**2 * np.diag(MASS) + 1j * omega * DAMPING
            loads = np.stack([[force, 0, 0, 0], INFLUENCE], axis=1)
            by_load, by_force = np.linalg.solve(stiffness, loads).T
            reaction = (INFLUENCE @ by_load) / (INFLUENCE @ by_force)
            rows.append((omega, force, by_load - reaction * by_force, reaction))
    return tuple(map(np.array, zip(*rows, strict=True)))


@pytest.fixture(scope="module")
def seen(stuck):
    """Records of these states, and responses to a force between the points."""
    omega, force, motion, _ = stuck
    rng = np.random.default_rng(5)
    velocity = 1j * omega[:, None] * motion
    velocity = velocity * np.exp(NOISE * (rng.normal(size=velocity.shape)))
    velocity = velocity * np.exp(1j * NOISE * rng.normal(size=velocity.shape))
    floor = 0.05 * NOISE * np.abs(velocity).max()
    white = rng.normal(size=(2, *velocity.shape, 2)) * floor / np.sqrt(2)
    level = np.repeat(np.arange(1, len(FORCES) + 1), 6)
    data = sj.measure.steady_states(
        *(level, omega, force, velocity),
        velocity_std=NOISE * np.abs(velocity),
        phase_std=np.full(velocity.shape, NOISE),
        harmonics=white[0] + 1j * white[1],
        harmonic_std=np.full(velocity.shape, floor),
        harmonic_order=(2, 3),
        sensors=POINTS,
    )
    model = structure(POINTS)
    chosen = calibration_states(model, data, 3)
    records = sensor_records(chosen)
    vector = INFLUENCE @ np.array([np.asarray(model.modes.shape_at(p)) for p in POINTS])
    response = source_pattern(records, chosen, model.modes, vector)
    return records, response, source_fit(records, response)


@pytest.fixture(scope="module")
def reaction(stuck):
    """The reaction that locks the two points."""
    return stuck[3]


def test_stuck_friction_provides_the_reaction(seen, reaction):
    law = LawAtPoint("coulomb_friction", *seen, rough=False)
    limit = np.array([2 * np.max(np.abs(reaction))])
    found = law.forces(limit, exact=True)
    assert found.settled.all()
    # Four sensors determine the force to about half their noise of 2e-3.
    np.testing.assert_allclose(found.force[:, 1], reaction, rtol=0.02)
    assert not np.any(found.force[:, 2:])
    # The residual is noise: 18 states of 3 orders and 4 sensors.
    assert 0.7 < law.chi_square(limit, None) / law.used.sum() < 1.2


def test_friction_is_limited_by_full_sliding(seen, reaction):
    law = LawAtPoint("coulomb_friction", *seen, rough=False)
    limit = 0.4 * np.max(np.abs(reaction))
    found = law.forces(np.array([limit]))
    most = 4 / np.pi * limit  # of a square wave
    over = np.abs(reaction) > 1.05 * most
    assert over.any()
    np.testing.assert_allclose(np.abs(found.force[over, 1]), most, rtol=1e-12)
    assert np.all(np.abs(found.force[:, 1]) <= most * (1 + 1e-12))
    slope = found.by_parameter[over, 1, 0] * limit
    np.testing.assert_allclose(slope, found.force[over, 1], rtol=1e-12)


def test_a_damper_does_not_stick(seen, reaction):
    law = LawAtPoint("quadratic_damping", *seen, rough=False)
    assert np.all(np.abs(law.forces(np.array([1.0])).force[:, 1]) < 1e-3 * np.abs(reaction))
