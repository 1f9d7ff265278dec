"""Base motion subtracted or not, and phases in radians of accelerations."""

import numpy as np
import pytest
from truths.one_mode import OMEGA, SHAPE, ZETA, model, noisy, states, table

import snrmjax as sj
from snrmjax.measure.base_excitation import states_relative_to_base
from snrmjax.model.modes import OptionalModalData
from snrmjax.model.moving_base import base_motion


def on_a_base(recorded, declared, seed=0):
    """States of three levels on a base, absolute or relative as they were recorded.

    The exact states of `truths.one_mode` with the base acceleration in place of −F: the
    absolute motion is the sum of relative and base motion.
    """
    level, w, force, v = states()
    acceleration, relative = force, -v  # Γ is the participation
    own = acceleration / (1j * w)
    measured = noisy(relative + own if recorded == "absolute" else relative, seed)
    data = table(level, w, acceleration, measured)
    modes = sj.model.linear_modes(
        [OMEGA],
        [ZETA],
        [[SHAPE]],
        [-SHAPE],
        sensors=("tip",),
        optional=OptionalModalData(base=base_motion(declared)),
    )
    return states_relative_to_base(data, modes.base), sj.model.structure(modes)


@pytest.mark.parametrize(
    ("recorded", "declared", "kinds"),
    [
        ("absolute", "absolute", ()),
        ("relative", "relative", ()),
        ("absolute", "relative", ("motion_of_base",)),
        ("relative", "absolute", ("motion_of_base",)),
    ],
)
def test_a_wrong_declaration_of_base_motion_is_reported(recorded, declared, kinds):
    checkup = sj.doctor.check_test(*on_a_base(recorded, declared))
    assert checkup.kinds == kinds
    if kinds:
        assert f'motion = "{recorded}"' in str(checkup.findings[0].advice)


@pytest.mark.parametrize(
    "lead", [0.0, *(pytest.param(k * np.pi, marks=pytest.mark.long) for k in (0.5, -0.5))]
)
def test_phases_in_radians_of_any_motion_that_were_read_as_degrees(lead):
    level, w, force, exact = states()
    v = noisy(exact)
    stated = np.angle(v * np.exp(1j * lead))
    read = np.abs(v) * np.exp(1j * (np.radians(stated) - lead))
    checkup = sj.doctor.check_test(table(level, w, force, read), model())
    assert checkup.kinds == ("degrees_for_radians",)
    assert checkup.findings[0].corrections[0].phase_unit == "rad"
