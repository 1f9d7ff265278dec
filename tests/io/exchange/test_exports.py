"""MATLAB and netCDF: what was written comes back bit for bit, and other programs read it."""

import h5py
import numpy as np
import pytest
import scipy.io

from snrmjax.io.exchange.exports import write_matlab, write_netcdf
from snrmjax.io.exchange.layouts import is_own_table, states_of_own_table
from snrmjax.io.laboratory import read_laboratory_file
from snrmjax.io.laboratory.uff.writing import write_uff
from snrmjax.measure import Channel, steady_states, time_recording
from snrmjax.measure.recordings.frequency_responses import frequency_responses

WRITERS = {"mat": write_matlab, "nc": write_netcdf}
RNG = np.random.default_rng(7)


def record(n=100):
    samples = np.round(RNG.normal(size=(2, n)) * 1e6).astype(np.int32)
    return time_recording(
        samples,
        [
            Channel("load cell", "force", "kN", 0.1, "3", "+z"),
            Channel("tip/a", "acceleration", "g", 9.80665, "7", "-x"),
        ],
        1e4 / 3,
        start_time=0.1,
    )


def responses(n=5):
    values = RNG.normal(size=(2, 1, n)) + 1j * RNG.normal(size=(2, 1, n))
    values[1, 0, 2:3] = np.nan
    return frequency_responses(
        2 * np.pi * np.array([79.02 + k / 7 for k in range(n)]),
        values,
        [Channel("a", "velocity", "mm/s", 1e-3, "1", "+z"), Channel("b", "acceleration", "g", 9.8)],
        [Channel("f", "force", "N")],
        coherence=np.ones((2, 1, n)) / 3,
    )


def states():
    return steady_states(
        [1, 1, 2],
        2 * np.pi * np.array([79.02, 79.1, 80.3]),
        [0.1, 0.3, 1 / 3],
        RNG.normal(size=(3, 2)) + 1j * RNG.normal(size=(3, 2)),
        sensors=("midspan", "sensor 2"),
        measured=[[True, True], [True, False], [True, True]],
        velocity_std=np.full((3, 2), 1e-3) / 7,
        phase_std=np.radians([[0.1, 0.2], [0.3, np.nan], [0.5, 0.6]]),
        harmonics=RNG.normal(size=(3, 2, 1)) * (1 + 1j),
        harmonic_order=(3,),
    )


@pytest.mark.parametrize("kind", WRITERS)
def test_all_comes_back_bit_for_bit(tmp_path, kind):
    path = tmp_path / f"all.{kind}"
    ours = [record(), record(64)]
    curves, table = [responses(), responses(1)], states()
    WRITERS[kind](path, recordings=ours, responses=curves, levels=[0.5, np.nan], states=table)
    found = read_laboratory_file(path)
    for one, back in zip(ours, found.recordings, strict=True):
        np.testing.assert_array_equal(back.values(), one.values())
        assert (back.sampling_rate, back.start_time) == (one.sampling_rate, one.start_time)
        for old, new in zip(one.channels, back.channels, strict=True):
            assert (new.name, new.quantity) == (old.name, old.quantity)
            assert (new.point, new.direction) == (old.point, old.direction)
            assert (new.unit, new.calibration) == (old.si_unit, 1.0)
    for one, back in zip(curves, found.responses, strict=True):
        np.testing.assert_array_equal(back.values, one.values)
        np.testing.assert_array_equal(back.frequency, one.frequency)
        np.testing.assert_array_equal(back.coherence, one.coherence)
        assert [c.quantity for c in back.responses] == ["velocity", "acceleration"]
        assert back.responses[0].direction == "+z"
    np.testing.assert_array_equal(found.levels, [0.5, np.nan])
    (read,) = found.tables
    assert is_own_table(read)
    back = states_of_own_table(read, "all")
    assert back.sensors == table.sensors
    for name in ("level", "frequency", "force", "velocity_std", "measured", "harmonics"):
        mask = np.asarray(table.measured)
        old, new = np.asarray(getattr(table, name)), np.asarray(getattr(back, name))
        if old.ndim > 1 and name != "measured":
            old, new = old[mask], new[mask]
        np.testing.assert_array_equal(new, old, err_msg=name)
    mask = np.asarray(table.measured)
    np.testing.assert_array_equal(np.asarray(back.velocity)[mask], np.asarray(table.velocity)[mask])


def test_other_programs_read_it(tmp_path):
    one, table = record(), states()
    write_matlab(tmp_path / "a.mat", recordings=[one], states=table)
    loaded = scipy.io.loadmat(tmp_path / "a.mat", simplify_cells=True)
    np.testing.assert_array_equal(loaded["records"]["values"].T, one.values())
    assert loaded["states"]["sensor"][1] == "sensor 2"
    write_netcdf(tmp_path / "a.nc", recordings=[one], states=table)
    with h5py.File(tmp_path / "a.nc") as file:
        np.testing.assert_array_equal(file["record_1/values"][()], one.values())
        assert file["states/sensor"].asstr()[1] == "sensor 2"
    import xarray

    with xarray.open_dataset(tmp_path / "a.nc", group="record_1", engine="h5netcdf") as data:
        assert data["values"].dims == ("channel", "sample")


@pytest.mark.parametrize("kind", WRITERS)
def test_nothing_and_too_short_is_refused_and_leaves_nothing(tmp_path, kind):
    path = tmp_path / f"none.{kind}"
    with pytest.raises(ValueError, match="nothing to write"):
        WRITERS[kind](path)
    with pytest.raises(ValueError, match="64 samples at least"):
        WRITERS[kind](path, recordings=[record(63)])
    with pytest.raises(ValueError, match="one number for each"):
        WRITERS[kind](path, responses=[responses()], levels=[1.0, 2.0])
    with pytest.raises(ValueError, match="folder does not exist"):
        WRITERS[kind](tmp_path / "no" / "a", recordings=[record()])
    assert list(tmp_path.iterdir()) == []


def test_a_response_of_one_level_of_uff_keeps_its_level(tmp_path):
    values = np.array([[[1 + 1j, 2 - 1j]]])
    one = frequency_responses(
        np.array([500.0, 510.0]),
        values,
        [Channel("a", "velocity", "", 1.0, "1", "+z")],
        [Channel("f", "force", "", 1.0, "1", "+z")],
    )
    write_uff(tmp_path / "a.uff", responses=[one, one], levels=[0.1, 0.2])
    assert read_laboratory_file(tmp_path / "a.uff").levels == (0.1, 0.2)
