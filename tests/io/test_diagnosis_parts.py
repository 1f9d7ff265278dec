"""What a diagnosis writes of its parts: an entry of the file for each, and the table of remainders.

The states are those of `truths.growing_damping` with harmonics 2 and 3 of cubic damping.
"""

import json

import numpy as np
import pytest
from truths.growing_damping import OMEGA, SHAPE, TIPS, linear_model, measured

import snrmjax as sj
from snrmjax.io.diagnosis_results import remainder_columns, summarise_diagnosis

STD = 1e-5  # m/s, of harmonics: the third goes up to 2 mm/s
PARTS = ["stiffness", "damping", "harmonic_2", "harmonic_3"]


@pytest.fixture(scope="module")
def found():
    return sj.diagnose_model(linear_model(), measured("cubic_damping", STD, range(5)))


def test_the_file_has_an_entry_for_every_part(found):
    parts = json.loads(json.dumps(summarise_diagnosis(found)))["parts"]
    assert [one["part"] for one in parts] == [*PARTS, "instrument"]
    keys = ["part", "verdict", "effects", "candidates", "probability", "explained", "remainder"]
    assert all(list(one) == keys for one in parts)
    told = {one["part"]: one for one in parts}
    for name in ("damping", "harmonic_3"):
        assert told[name]["effects"] == ["cubic_damping"]
        assert told[name]["candidates"] == [["cubic_damping"]]
        assert told[name]["explained"]["low"] <= told[name]["explained"]["value"] <= 1.0
        assert set(told[name]["explained"]) == {"value", "low", "high"}
    for name in ("stiffness", "harmonic_2", "instrument"):
        assert (told[name]["verdict"], told[name]["effects"]) == ("none", [])
        assert told[name]["explained"] is None
    assert told["instrument"]["remainder"] is None
    for name in PARTS:
        assert set(told[name]["remainder"]) == {"rms", "significant"}


def test_the_table_of_remainders_has_a_curve_for_every_part(found):
    columns = remainder_columns(found.parts)
    assert list(columns) == ["part", "velocity_m_s", "value", "std"]
    part, velocity, value, std = (np.array(column) for column in columns.values())
    assert list(dict.fromkeys(part.tolist())) == PARTS
    # Velocities of the mode at its natural frequency, from the least to the largest of the states:
    # off resonance by 55° the amplitude is cos 55° of the tip's.
    ends = np.array([TIPS[0] * np.cos(np.radians(55)), TIPS[-1]]) * OMEGA * SHAPE
    for name in PARTS:
        own = velocity[part == name]
        assert np.all(np.diff(own) > 0)
        np.testing.assert_allclose(own[[0, -1]], ends, rtol=0.06)
    assert np.all(np.isfinite(value))
    assert np.all(std >= 0)
