"""Steady states as a user builds, joins, writes and reads them."""

import numpy as np
import pytest
from matplotlib.figure import Figure

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

    def test_harmonics_that_a_test_lacks_are_not_measured_and_others_kept(self):
        (one,) = parts_of(1)
        third = {"harmonics": np.array([[[0.3j]]]), "harmonic_order": (3,)}
        both = {"harmonics": np.array([[[0.2, 0.5j]]]), "harmonic_order": (2, 3)}
        two, three = (
            sj.measure.steady_states([k], [500.0 + k], [1.0], [0.6], **columns)
            for k, columns in ((1, third), (2, both))
        )
        joined = sj.measure.join_steady_states(one, two, three)
        assert joined.harmonic_order == (2, 3)
        expected = [[np.nan, np.nan], [np.nan, 0.3j], [0.2, 0.5j]]
        np.testing.assert_array_equal(np.abs(joined.harmonics[:, 0]), np.abs(expected))

    @pytest.mark.parametrize("nothing", [(), ([],), ((),)])
    def test_nothing_is_refused(self, nothing):
        with pytest.raises(ValueError, match="nothing to join"):
            sj.measure.join_steady_states(*nothing)

    @pytest.mark.parametrize("wrong", ["ab", 3, None, [1.0], {"a": 1}, [["a"]]])
    def test_anything_else_is_refused_by_its_type(self, wrong):
        with pytest.raises(ValueError, match="joins `SteadyStates`, but got a"):
            sj.measure.join_steady_states(parts_of(1)[0], wrong)


@pytest.mark.parametrize("rows", [np.array([True, False, True]), np.array([0, 2]), [0, 2]])
def test_some_states_by_mask_and_by_rows(rows):
    some = sj.measure.join_steady_states(parts_of(3)).select(rows)
    assert some.n_states == 2
    assert some.sensors == parts_of(1)[0].sensors
    np.testing.assert_array_equal(some.frequency, [500.0, 502.0])
    np.testing.assert_array_equal(some.velocity, [[0.6], [0.6 + 0.2j]])


def test_records_written_and_read_back(tmp_path):
    """What was recorded is what a file gives back: V = Ae^{iφ} at every level, known exactly."""
    rate, dwell = 4000.0, 2000  # samples a level: two steps
    truth = {1: 0.2 * np.exp(0.1j), 2: 0.4 * np.exp(-0.3j), 3: 0.5 * np.exp(0.05j)}
    third = {level: 0.01 * level * np.exp(0.7j) for level in truth}
    turn = np.exp(1j * (OMEGA * np.arange(3 * dwell) / rate + 0.4))
    level = np.repeat(list(truth), dwell)
    velocity = np.repeat(list(truth.values()), dwell) * turn
    velocity = velocity + np.repeat(list(third.values()), dwell) * turn**3
    channels = [sj.measure.Channel("CH1", "force"), sj.measure.Channel("CH2", "velocity")]
    record = sj.measure.time_recording(np.stack([level * turn, velocity]).real, channels, rate)
    result = sj.measure.stepped_sine_states(
        *(record, "CH1", ["CH2"]),
        harmonic_order=(1, 3),
        sensors=["tip"],
        frequencies=[(0.25 * k, 0.25 * (k + 1), OMEGA) for k in range(6)],
        settle=0.0,
    )
    sj.io.write_steady_states(tmp_path / "measured.csv", result.states)
    again = sj.io.read_steady_states(tmp_path / "measured.csv")
    assert again.sensors == ("tip",)
    assert again.harmonic_order == (3,)
    np.testing.assert_array_equal(again.level, [1, 1, 2, 2, 3, 3])
    np.testing.assert_allclose(again.frequency, OMEGA, rtol=1e-14)
    # The fit of records free of noise ends at rounding of Ωt, about 1e-12.
    np.testing.assert_allclose(again.force, again.level, rtol=1e-10)
    np.testing.assert_allclose(again.velocity[::2, 0], list(truth.values()), rtol=1e-10)
    np.testing.assert_allclose(again.harmonics[::2, 0, 0], list(third.values()), rtol=1e-9)


class TestSaying:
    def data(self):
        nothing = np.full((3, 2, 1), np.nan + 0j)
        return sj.measure.steady_states(
            [1, 1, 2],
            OMEGA + np.arange(3.0),
            [1.0, 1.0, 2.0],
            [[0.1, 0.2], [0.1j, 0.0], [0.3, 0.4]],
            sensors=["tip", "root"],
            measured=[[True, True], [True, False], [True, True]],
            velocity_std=np.full((3, 2), 0.01),
            harmonics=nothing,
            harmonic_order=[3],
        )

    def test_one_screen(self):
        lines = repr(self.data()).splitlines()
        assert lines[0] == "SteadyStates: 3 states of 2 levels at tip, root"
        assert "force 1 to 2 N" in lines[1]
        assert lines[2].strip() == "velocity 0.1 to 0.4 m/s"
        assert lines[3].strip() == "errors stated of velocity"
        assert lines[4].strip() == "1 velocities not measured"

    def test_a_drive_alone(self):
        data = sj.measure.steady_states([1], [OMEGA], [np.nan], [0.1], drive=[0.5])
        assert "force 0.5 to 0.5 V (force unknown)" in repr(data)

    def test_labelled(self):
        data = self.data().to_xarray()
        assert data.frequency_hz.attrs["units"] == "Hz"
        np.testing.assert_allclose(data.frequency_hz[0], 80.0)
        assert data.velocity_re_m_s.sel(sensor="root").isnull().sum() == 1
        assert data.harmonic_re_m_s.sizes == {"state": 3, "sensor": 2, "harmonic": 1}

    def test_drawn(self):
        assert isinstance(self.data().plot(sensor="root"), Figure)
        with pytest.raises(ValueError, match="`sensor` must be one of"):
            self.data().plot(sensor="middle")


def test_a_column_that_does_not_exist_is_refused():
    with pytest.raises(TypeError, match=r"no column 'phase_error', but measured, velocity_std"):
        sj.measure.steady_states([1], [OMEGA], [1.0], [0.1], phase_error=[0.1])


def test_lists_and_arrays_are_alike():
    amplitudes, orders = [1.0 + 1.0j, 0.1j], (1, 2)
    for given in ([1, 2], np.array([1, 2])):
        for verb in (sj.measure.peak_amplitude, sj.measure.nnm_appropriation):
            as_list, as_array = verb(amplitudes, given), verb(np.array(amplitudes), orders)
            np.testing.assert_array_equal(as_list, as_array)
    points = sj.identify.invert_phasor([6.0], [500.0], [0.6 + 0.0j], [0.0])
    np.testing.assert_allclose(points.natural_frequency, [500.0])
    np.testing.assert_allclose(sj.identify.closed_form([6.0], [500.0], [0.6 + 0.0j])[1], [0.01])
