"""The motion of an element at measured fundamentals; truth from a harmonic balance of a chain."""

import numpy as np
import pytest
from truths.chain_states import DAMPING, FIRST, MASS, ORDER, STIFFNESS, displacement

import snrmjax as sj
from snrmjax.diagnose.location.element_motion import (
    SurroundedElement,
    element_forces,
    force_along,
)

INFLUENCE = np.array([0.0, 0.0, -1.0, 1.0])  # x4 less x3
CUBIC = 3e9


def spring(x, v):
    return CUBIC * x**3


@pytest.fixture(scope="module")
def states():
    """Motions along the influence vector, with up to 9 % third harmonic, and receptances."""
    found, x = [], None
    for omega in np.array([0.72, 0.78, 0.84]) * FIRST:
        x = displacement(45.0, INFLUENCE, spring, omega, x)
        orders = omega * np.arange(ORDER + 1)
        stiffness = [STIFFNESS - w**2 * np.diag(MASS) + 1j * w * DAMPING for w in orders]
        receptance = [INFLUENCE @ np.linalg.solve(s, INFLUENCE) for s in stiffness]
        found.append((omega, np.array(receptance), INFLUENCE @ x))
    omega, receptance, motion = map(np.array, zip(*found, strict=True))
    assert np.max(abs(motion[:, 3] / motion[:, 1])) > 0.09
    fundamental = np.where(np.arange(ORDER + 1) == 1, motion, 0.0)
    return SurroundedElement(omega, receptance, fundamental), motion


def test_an_element_moves_with_its_own_harmonics(states):
    element, motion = states
    law = sj.model.make_effect("cubic_stiffness", {"coefficient": 1.0})
    found = element_forces(law, np.array([CUBIC]), element)
    assert found.settled.all()
    amplitude = abs(motion[:, 1:2])
    # Newton's method ends below 1e-5 of the fundamental.
    np.testing.assert_allclose(found.motion / amplitude, motion / amplitude, rtol=0, atol=1e-5)
    # The motion is the response to the force, at orders without load.
    answer = -(element.receptance * found.force)[:, 2:]
    np.testing.assert_allclose(answer / amplitude, motion[:, 2:] / amplitude, rtol=0, atol=2e-5)
    along = force_along(law, np.array([CUBIC]), element)
    assert np.all(abs(found.force - along)[:, 1] > 0.02 * abs(along[:, 1]))


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        ("cubic_stiffness", [CUBIC]),
        ("one_sided_stop", [3e3, 3e-4]),
        ("coulomb_friction", [2.0]),
        ("jenkins_slider", [3e3, 3e-4]),
    ],
)
def test_slopes_are_those_of_differences(states, kind, values):
    element, values = states[0], np.array(values)
    names = sj.model.EFFECTS[kind].parameters()
    law = sj.model.make_effect(kind, dict(zip(names, values, strict=True)))
    found = element_forces(law, values, element, exact=True)
    assert found.settled.all()
    near = element._replace(motion=found.motion)
    for k, value in enumerate(values):
        step = 1e-3 * value * np.eye(len(values))[k]
        more, less = (element_forces(law, values + s, near).force for s in (step, -step))
        scale = np.max(abs(found.by_parameter[..., k]))
        slope = (more - less) / (2e-3 * value)
        # Motions are found to 1e-5, differences have steps of 1e-3; sliders reverse at samples.
        np.testing.assert_allclose(found.by_parameter[..., k], slope, rtol=0, atol=0.03 * scale)
