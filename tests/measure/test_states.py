"""Steady states as a user builds, joins, writes and reads them."""

import numpy as np
import pytest

import snrmjax as sj

OMEGA = 2 * np.pi * 80.0


def parts_of(n):
    """Tests of one structure, a level each."""
    return [sj.measure.steady_states([k], [500.0 + k], [1.0], [0.6 + 0.1j * k]) for k in range(n)]


class TestJoining:
    def test_a_list_is_as_good_as_separate_arguments(self):
        parts = parts_of(3)
        for joined in (
            sj.measure.join_steady_states(parts),
            sj.measure.join_steady_states(*parts),
            sj.measure.join_steady_states(tuple(parts)),
            sj.measure.join_steady_states(part for part in parts),
            sj.measure.join_steady_states(parts[:1], parts[1], parts[2:]),
        ):
            assert isinstance(joined, sj.measure.SteadyStates)
            np.testing.assert_array_equal(joined.level, [0, 1, 2])
            np.testing.assert_array_equal(joined.velocity[:, 0], [0.6, 0.6 + 0.1j, 0.6 + 0.2j])

    @pytest.mark.parametrize("nothing", [(), ([],), ((),)])
    def test_nothing_is_refused(self, nothing):
        with pytest.raises(ValueError, match="nothing to join"):
            sj.measure.join_steady_states(*nothing)

    @pytest.mark.parametrize("wrong", ["ab", 3, None, [1.0], {"a": 1}, [["a"]]])
    def test_anything_else_is_refused_by_its_type(self, wrong):
        with pytest.raises(ValueError, match="joins `SteadyStates`, but got a"):
            sj.measure.join_steady_states(parts_of(1)[0], wrong)


def test_records_joined_written_and_read_back(tmp_path):
    """What was recorded is what a file gives back: V = Ae^{iφ} at every level, known exactly."""
    time = np.linspace(0.0, 0.5, 2000)
    truth = {1: 0.2 * np.exp(0.1j), 2: 0.4 * np.exp(-0.3j), 3: 0.5 * np.exp(0.05j)}
    third = {level: 0.01 * level * np.exp(0.7j) for level in truth}
    parts = []
    for level, velocity in truth.items():
        force = level * np.cos(OMEGA * time + 0.4)
        record = np.real(
            velocity * np.exp(1j * (OMEGA * time + 0.4))
            + third[level] * np.exp(3j * (OMEGA * time + 0.4))
        )
        parts.append(
            sj.measure.steady_state_from_records(
                time, force, record, OMEGA, level=level, harmonic_order=(1, 3), sensors=("tip",)
            )
        )
    joined = sj.measure.join_steady_states(parts)
    sj.io.write_steady_states(tmp_path / "measured.csv", joined)
    again = sj.io.read_steady_states(tmp_path / "measured.csv")
    assert again.sensors == ("tip",)
    assert again.harmonic_order == (3,)
    np.testing.assert_array_equal(again.level, list(truth))
    np.testing.assert_allclose(again.frequency, OMEGA, rtol=1e-14)
    # The fit of records free of noise ends at rounding of Ωt, about 1e-12.
    np.testing.assert_allclose(again.force, [1.0, 2.0, 3.0], rtol=1e-10)
    np.testing.assert_allclose(again.velocity[:, 0], list(truth.values()), rtol=1e-10)
    np.testing.assert_allclose(again.harmonics[:, 0, 0], list(third.values()), rtol=1e-9)
