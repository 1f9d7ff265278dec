"""Parts of a diagnosis in the files: an entry for each, and the table of remainders.

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
def diagnosis():
    return sj.diagnose_model(linear_model(), measured("cubic_damping", STD, range(5)))


def test_the_file_has_an_entry_for_every_part(diagnosis):
    parts = json.loads(json.dumps(summarise_diagnosis(diagnosis)))["parts"]
    assert [one["part"] for one in parts] == [*PARTS, "instrument"]
    keys = ["part", "verdict", "effects", "candidates", "probability", "explained", "remainder"]
    assert all(list(one) == keys for one in parts)
    by_part = {one["part"]: one for one in parts}
    for name in ("damping", "harmonic_3"):
        assert by_part[name]["effects"] == ["cubic_damping"]
        assert by_part[name]["candidates"] == [["cubic_damping"]]
        assert by_part[name]["explained"]["low"] <= by_part[name]["explained"]["value"] <= 1.0
        assert set(by_part[name]["explained"]) == {"value", "low", "high"}
    for name in ("stiffness", "harmonic_2", "instrument"):
        assert (by_part[name]["verdict"], by_part[name]["effects"]) == ("none", [])
        assert by_part[name]["explained"] is None
    assert by_part["instrument"]["remainder"] is None
    for name in PARTS:
        assert set(by_part[name]["remainder"]) == {"rms", "significant"}


def test_the_table_of_remainders_has_a_curve_for_every_part(diagnosis):
    columns = remainder_columns(diagnosis.parts)
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
