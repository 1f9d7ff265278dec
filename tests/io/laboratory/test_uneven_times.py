"""Records with odd time steps: resampled to the motion they sample, or the place named."""

import numpy as np
import pytest
import pyuff
import scipy.io
from truths.import_runs import run_import

from snrmjax.io.laboratory.reading import read_laboratory_file
from snrmjax.io.laboratory.record_tables import read_record_table

RATE, FREQUENCY = 2000.0, 2 * np.pi * 80
EVEN = np.arange(3000) / RATE


def motion(time):
    """A decay whose values at any time are known."""
    return np.exp(-5 * time) * np.cos(FREQUENCY * time)


def lost(n):
    """Times without `n` samples from the 1201st on."""
    return np.delete(EVEN, np.arange(1200, 1200 + n))


def late(seconds):
    """Times that continue later from the 1201st sample on."""
    return np.where(np.arange(3000) < 1200, EVEN, EVEN + seconds)


def write(kind, folder, time):
    """A record at these times in a file of this kind."""
    path = folder / f"a.{kind}"
    if kind == "csv":
        rows = [f"{t:.6f},{v:.8f}" for t, v in zip(time, motion(time), strict=True)]
        path.write_text("\n".join(["Time [s],Velocity [m/s]", *rows]))
    elif kind == "mat":
        scipy.io.savemat(path, {"t": time, "velocity_m_s": motion(time)})
    else:
        axes = {"abscissa_spacing": 0, "abscissa_spec_data_type": 17, "orddenom_spec_data_type": 0}
        place = {"rsp_node": 1, "rsp_dir": 3, "ref_node": 1, "ref_dir": 3}
        wave = pyuff.prepare_58(
            x=time,
            data=motion(time),
            binary=0,
            func_type=1,
            ordinate_spec_data_type=11,
            **axes,
            **place,
        )
        pyuff.UFF(str(path)).write_sets(wave, "overwrite")
    return path


@pytest.mark.parametrize("kind", ["csv", "mat", "uff"])
@pytest.mark.parametrize("time", [lost(1), lost(2), late(3e-4)])
def test_a_record_with_an_odd_step_is_resampled(tmp_path, kind, time):
    contents = read_laboratory_file(write(kind, tmp_path, time))
    (record,) = contents.recordings
    assert record.sampling_rate == RATE
    (note,) = (note for note in contents.notes if note.kind == "time_resampled")
    assert (note["n"], note["sample"]) == (1, 1201)
    expected = motion(np.arange(record.n_samples) / RATE)
    assert record.n_samples in (3000, 3001)
    # A cubic spline's error is about (Ωh)⁴/384 · 1/16, but for the gap of three steps.
    np.testing.assert_allclose(record.values()[0], expected, atol=1e-3)


DOUBLED = np.where(np.arange(3000) == 1500, EVEN - 1 / RATE, EVEN)
JITTER = EVEN + 2e-5 * np.sin(np.arange(3000.0))


@pytest.mark.parametrize("kind", ["csv", "mat", "uff"])
@pytest.mark.parametrize(
    ("time", "sample"), [(late(5.0), 1201), (lost(5), 1201), (DOUBLED, 1501), (JITTER, None)]
)
def test_other_uneven_times_are_named(tmp_path, kind, time, sample):
    contents = read_laboratory_file(write(kind, tmp_path, time))
    assert not contents.recordings
    (note,) = (note for note in contents.notes if note.kind == "uneven_time")
    assert sample in (None, note["sample"])


def test_the_listing_of_an_uneven_record_proposes_no_steady_states(tmp_path):
    code, output = run_import(write("csv", tmp_path, late(5.0)))
    assert code == 0
    assert "NEWTONS" not in output
    assert "sample 1201, at 5.6 s" in output


def test_times_of_steady_states_are_a_column_without_a_note(tmp_path):
    path = tmp_path / "a.mat"
    time = np.cumsum(1 + 0.3 * np.sin(np.arange(100.0)))
    scipy.io.savemat(path, {"t": time, "freq": 50 + time / 100, "v": time})
    contents = read_laboratory_file(path)
    assert "uneven_time" not in [note.kind for note in contents.notes]
    assert set(contents.tables[0].columns) == {"t", "freq", "v"}


def test_our_own_record_is_resampled_or_its_row_named(tmp_path):
    path = tmp_path / "record.csv"

    def put(time):
        rows = [f"{t:.6f},{v:.8f}" for t, v in zip(time, motion(time), strict=True)]
        path.write_text("\n".join(["time_s,velocity_m_s", *rows]))

    put(lost(1))
    record = read_record_table(path)
    np.testing.assert_allclose(record.values()[0], motion(EVEN), atol=1e-4)
    assert [note.kind for note in record.notes] == ["time_resampled"]
    put(late(5.0))
    with pytest.raises(ValueError, match=r"row 1202 of record.csv it steps by 5\.0005 s"):
        read_record_table(path)
