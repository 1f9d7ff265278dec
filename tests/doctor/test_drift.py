"""Drifts and confounders: exact states of a softening mode that is swept up, then down."""

import numpy as np
import pytest

import snrmjax as sj
from snrmjax.doctor.corrections import sweeps
from snrmjax.measure import steady_states

OMEGA, ZETA, SHAPE = 2 * np.pi * 1600.0, 4e-4, 2.0
LEVELS, EACH = 5, 9
BANDWIDTH = 2 * ZETA


def model():
    modes = sj.model.linear_modes([OMEGA], [ZETA], [[SHAPE]], [SHAPE], sensors=("wire",))
    return sj.model.structure(modes)


def swept(lower=0.0, drift=0.0, again=False, shift=1.0, seed=0):
    """Levels of rising force, each swept up and then down: level, Ω, F, V.

    ω̃ falls by `shift` bandwidths with a², in all down-sweeps by `lower`, from the first sweep to
    the last by `drift`, both in bandwidths. With `again` down-sweeps are measured upwards, too.
    """
    rows, n = [], 2 * LEVELS
    for k in range(n):
        phase = np.radians(np.linspace(-65, 65, EACH))  # of the velocity: falling, upwards
        phase = -phase if k % 2 == 0 or again else phase
        top = np.geomspace(0.2, 1.0, LEVELS)[k // 2]
        a = top * np.cos(phase)
        time = (k + np.linspace(0, 1, EACH)) / n
        own = OMEGA * (1 - BANDWIDTH * (shift * a**2 + lower * (k % 2) - drift * time))
        # tan φ = (K − Ω²)/(2ζωΩ), and a second time for Ω itself in the damping.
        w = own
        for _ in range(20):
            w = np.sqrt(own**2 - np.tan(phase) * BANDWIDTH * OMEGA * w)
        z = own**2 - w**2 + 1j * BANDWIDTH * OMEGA * w
        force = a * np.abs(z)
        rows.append(np.stack([np.full(EACH, k // 2 + 1), w, force, 1j * w * force / z]))
    level, w, force, v = np.concatenate(rows, axis=1)
    rng = np.random.default_rng(seed)
    v = SHAPE * v * np.exp(0.004 * (rng.normal(size=len(v)) + 1j * rng.normal(size=len(v))))
    return level.real.astype(int), w.real, force.real / SHAPE, v


def table(level, w, force, v):
    return steady_states(level, w, force, v, sensors=("wire",))


@pytest.mark.parametrize("again", [False, True])
def test_a_change_that_restarts_with_each_level_is_no_drift(again):
    """Down-sweeps lower by 5 % of a bandwidth in every level: 0.5 % of it is the noise of one."""
    checkup = sj.doctor.check_test(table(*swept(lower=0.05, again=again)), model())
    assert checkup.kinds == ()


def test_softening_with_rising_levels_is_no_drift():
    assert sj.doctor.check_test(table(*swept(shift=3.0)), model()).kinds == ()


@pytest.mark.parametrize("drift", [2.0, -2.0])
def test_a_drift_through_all_sweeps_is_reported_with_its_magnitude(drift):
    (one,) = sj.doctor.check_test(table(*swept(drift=drift)), model()).findings
    assert one.kind == "drift"
    # Levels' own mean is free: ten sweeps determine the change to a tenth.
    assert one.evidence["change"] == pytest.approx(drift * BANDWIDTH, rel=0.15)


def test_sweeps_are_separated_by_the_direction_of_frequency():
    level = np.repeat([0, 1, 2], 8)
    frequency = np.array([1, 2, 3, 4, 4, 3, 2, 1.0, *range(4), *range(4), 1, 5, 2, 6, 3, 7, 4, 8])
    sweep, rising = sweeps(level, frequency, np.arange(24.0))
    assert sweep.tolist() == [0] * 4 + [1] * 4 + [2] * 4 + [3] * 4 + [4] * 8
    assert rising.tolist() == [0.5] * 4 + [-0.5] * 4 + [0.5] * 8 + [0.0] * 8
