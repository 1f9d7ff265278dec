"""The motion of a base that was or was not taken away, and phases in radians of accelerations."""

import numpy as np
import pytest
from truths.one_mode import OMEGA, SHAPE, ZETA, model, noisy, states, table

import snrmjax as sj
from snrmjax.measure.base_excitation import seen_from_base
from snrmjax.model.modes import Beside
from snrmjax.model.moving_base import base_motion


def on_a_base(recorded, said, seed=0):
    """States of three levels on a base, absolute or relative as they were recorded.

    The exact states of `truths.one_mode` with the base's acceleration in the place of −F: the
    absolute motion is that relative to the base and the base's own.
    """
    level, w, force, v = states()
    acceleration, relative = force, -v  # Γ is the participation
    own = acceleration / (1j * w)
    seen = noisy(relative + own if recorded == "absolute" else relative, seed)
    data = table(level, w, acceleration, seen)
    modes = sj.model.linear_modes(
        [OMEGA],
        [ZETA],
        [[SHAPE]],
        [-SHAPE],
        sensors=("tip",),
        beside=Beside(base=base_motion(said)),
    )
    return seen_from_base(data, modes.base), sj.model.structure(modes)


@pytest.mark.parametrize(
    ("recorded", "said", "kinds"),
    [
        ("absolute", "absolute", ()),
        ("relative", "relative", ()),
        ("absolute", "relative", ("motion_of_base",)),
        ("relative", "absolute", ("motion_of_base",)),
    ],
)
def test_a_base_whose_motion_was_not_taken_away_is_found(recorded, said, kinds):
    found = sj.doctor.check_test(*on_a_base(recorded, said))
    assert found.kinds == kinds
    if kinds:
        assert f'motion = "{recorded}"' in str(found.findings[0].advice)


@pytest.mark.parametrize(
    "lead", [0.0, *(pytest.param(k * np.pi, marks=pytest.mark.long) for k in (0.5, -0.5))]
)
def test_phases_in_radians_of_any_motion_that_were_read_as_degrees(lead):
    level, w, force, exact = states()
    v = noisy(exact)
    stated = np.angle(v * np.exp(1j * lead))
    read = np.abs(v) * np.exp(1j * (np.radians(stated) - lead))
    found = sj.doctor.check_test(table(level, w, force, read), model())
    assert found.kinds == ("degrees_for_radians",)
    assert found.findings[0].corrections[0].phase_unit == "rad"
