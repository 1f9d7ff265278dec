"""netCDF: what was written comes back bit for bit, and other programs read it."""

import h5py
import numpy as np
import pytest
from truths.uff_writing import write_uff

from snrmjax.io.exchange.exports import write_netcdf
from snrmjax.io.laboratory import read_laboratory_file
from snrmjax.measure import Channel, time_recording
from snrmjax.measure.recordings.frequency_responses import frequency_responses

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


def test_all_comes_back_bit_for_bit(tmp_path):
    for one in (record(), record(64)):
        write_netcdf(tmp_path / "all.nc", one)
        (back,) = read_laboratory_file(tmp_path / "all.nc").recordings
        np.testing.assert_array_equal(back.values(), one.values())
        assert (back.sampling_rate, back.start_time) == (one.sampling_rate, one.start_time)
        for old, new in zip(one.channels, back.channels, strict=True):
            assert (new.name, new.quantity) == (old.name, old.quantity)
            assert (new.point, new.direction) == (old.point, old.direction)
            assert (new.unit, new.calibration) == (old.si_unit, 1.0)


def test_other_programs_read_it(tmp_path):
    one = record()
    write_netcdf(tmp_path / "a.nc", one)
    with h5py.File(tmp_path / "a.nc") as file:
        np.testing.assert_array_equal(file["values"][()], one.values())
    import xarray

    with xarray.open_dataset(tmp_path / "a.nc", engine="h5netcdf") as data:
        assert data["values"].dims == ("channel", "sample")


def test_a_folder_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(ValueError, match="folder does not exist"):
        write_netcdf(tmp_path / "no" / "a.nc", record())
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
