"""Phase resonances bracketed by states, and the message where states have no points."""

import dataclasses

import numpy as np
import pytest
from truths.exact_states import CONSTANT, OMEGA, SHAPE, damping, exact, modes, squared, stated

import snrmjax as sj
from snrmjax.identify.pointwise.missing_resonance import level_in_resonance, measured_resonances
from snrmjax.identify.pointwise.prediction import resonances

TIP = 2e-3  # m, the largest displacement at resonance


@pytest.fixture(scope="module")
def identified():
    """States whose top level is recorded with four times the force, and their true curves."""
    level, omega, force, velocity = exact(per_level=9)
    identification = sj.identify_backbone(stated(level, omega, force, velocity), modes())
    return identification.backbone, stated(
        level, omega, np.where(level == 4, 4, 1) * force, velocity
    )


def needed(displacement):
    """Force of a phase resonance, N."""
    omega = np.sqrt(squared(displacement))
    return displacement * omega * damping(displacement * omega) / CONSTANT


def test_a_measured_resonance_missing_on_the_curves(identified):
    backbone, data = identified
    recorded = 4 * needed(TIP)
    assert resonances(backbone, modes(), recorded) == []
    near = level_in_resonance(data, backbone, 1.03 * recorded)
    assert near.level == 4
    assert near.force == pytest.approx(recorded, rel=1e-9)  # a state lies there
    assert near.frequency == pytest.approx(np.sqrt(squared(TIP)) / (2 * np.pi), rel=1e-9)
    assert level_in_resonance(data, backbone, 2 * recorded) is None


def test_levels_on_one_side_have_no_resonance():
    level, omega, force, velocity = exact(per_level=9)
    data = stated(level, omega, force, velocity)
    measured = measured_resonances(data, 0, 1.0)
    assert [one.level for one in measured] == [0, 1, 2, 3, 4]
    assert measured[-1].force == pytest.approx(needed(TIP), rel=1e-9)  # a state lies there
    assert measured_resonances(data.select(np.angle(velocity) > 0.05), 0, 1.0) == []
    assert measured_resonances(data, 0, -1.0) == []


@pytest.mark.parametrize(
    ("participation", "force", "message"),
    [
        (-3.0, 1.0, r"only 0 of 5 are: 5 have negative damping.*`participation`.*wrong sign"),
        (3.0, 1e7, r"no real natural frequency\..*in newtons"),
    ],
)
def test_the_reason_for_states_without_points_is_reported(participation, force, message):
    """Too few states to name wrong phases or units by themselves."""
    level, omega, forces, velocity = (a[20:25] for a in exact(per_level=9, widest=50))
    data = stated(level, omega, forces * force, velocity)
    one = sj.model.linear_modes([OMEGA], [0.012], [[SHAPE]], [participation])
    if force > 1:  # where it leads, a force far too large asks for a negative stiffness
        data = dataclasses.replace(data, velocity=np.abs(data.velocity) * np.exp(-1.4j))
    with pytest.raises(ValueError, match=message):
        sj.identify_backbone(data, one)
