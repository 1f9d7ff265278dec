"""Channels on separate clocks, responses per force in many units, proposed commands that run."""

import shlex

import numpy as np
import pytest
import pyuff
import scipy.io
from nptdms import ChannelObject, TdmsWriter
from truths.import_runs import run_import

from snrmjax.io.laboratory import read_laboratory_file
from snrmjax.io.tables import read_steady_states

G, POUND = 9.80665, 4.4482216152605
RATE, N = 1000.0, 400
START = np.datetime64("2026-01-05T10:00:00.000000", "us")
TIME = np.arange(N + 100) / RATE
WAVE = np.cos(2 * np.pi * 37 * TIME)


def tdms(path, *channels):
    """Channels of one waveform: the first sample and the number of samples, and what is stated."""
    with TdmsWriter(path) as writer:
        for k, (first, count, stated) in enumerate(channels):
            wave = {"wf_increment": 1 / RATE, "unit_string": "N"} | stated
            values = (k + 1) * WAVE[first : first + count]
            writer.write_segment([ChannelObject("DAQ", f"CH{k}", values, wave)])
    return read_laboratory_file(path)


def at(milliseconds):
    return {"wf_start_time": START + np.timedelta64(round(1000 * milliseconds), "us")}


@pytest.mark.parametrize(
    ("channels", "first", "count"),
    [
        ([(0, N, at(0)), (5, N - 5, at(5))], 5, N - 5),
        ([(5, N, at(5)), (0, N, at(0))], 5, N - 5),
        ([(0, N, at(0)), (20, N, at(20)), (7, N, at(7))], 20, N - 20),
        ([(0, N, {"wf_start_offset": 0.5}), (4, N, {"wf_start_offset": 0.504})], 4, N - 4),
        ([(0, N, at(3)), (0, N, at(3))], 0, N),
    ],
)
def test_channels_are_shifted_by_the_starts_that_they_state(tmp_path, channels, first, count):
    contents = tdms(tmp_path / "a.tdms", *channels)
    (record,) = contents.recordings
    assert record.n_samples == count
    for k, values in enumerate(record.values()):
        np.testing.assert_array_equal(values, (k + 1) * WAVE[first : first + count])
    is_shifted = len({one[0] for one in channels}) > 1
    assert ("earlier" in " ".join(map(str, contents.notes))) == is_shifted


@pytest.mark.parametrize("late", [at(5.4), at(300), {"wf_increment": 1.5 / RATE}])
def test_channels_that_share_no_instants_stay_apart(tmp_path, late):
    contents = tdms(tmp_path / "a.tdms", (0, N, at(0)), (0, N, late))
    assert len(contents.recordings) == 2


RATIOS = {
    "g/N": G,
    "(1/N)*(m/s^2)": 1.0,
    "(m/s2)/N": 1.0,
    "g/lbf": G / POUND,
    "mm/s/N": 1e-3,
    "m/N": 1.0,
    "(in/s)/lbf": 0.0254 / POUND,
}


@pytest.mark.parametrize("label", RATIOS)
def test_a_motion_per_force_has_both_units(tmp_path, label):
    """Written by pyuff; only its label states the units."""
    hertz = np.linspace(79, 81, 9)
    values = (1 + 0.2j) * np.linspace(1, 2, 9)
    nodes = {"rsp_node": 1, "rsp_dir": 3, "ref_node": 1, "ref_dir": 3}
    kind = {"func_type": 4, "abscissa_spacing": 0, "abscissa_spec_data_type": 18}
    kind |= {"ordinate_spec_data_type": 0, "orddenom_spec_data_type": 0}
    kind |= {"ordinate_axis_units_lab": label}
    one = pyuff.prepare_58(x=hertz, data=values, binary=0, **nodes, **kind)
    pyuff.UFF(str(tmp_path / "a.uff")).write_sets([one], "add")
    (sets,) = read_laboratory_file(tmp_path / "a.uff").responses
    assert sets.references[0].quantity == "force"
    np.testing.assert_allclose(sets.values[0, 0], RATIOS[label] * values, rtol=1e-11)
    words = ["--force-amplitude", "2", "--response", "1+z", "--out", tmp_path / "out"]
    code, output = run_import(tmp_path / "a.uff", *words)
    assert code == 0, output
    states = read_steady_states(tmp_path / "out" / "measured.csv")
    order = {"acceleration": 2, "velocity": 1, "displacement": 0}[sets.responses[0].quantity]
    wanted = 2 * RATIOS[label] * values * (2j * np.pi * hertz) ** (1 - order)
    np.testing.assert_allclose(np.asarray(states.velocity)[:, 0], wanted, rtol=1e-6)


F = np.array([79.0, 79.5, 80.0, 80.5])
PHASE = np.array([-0.2, -1.0, -2.0, -2.7])


def written(folder, kind):
    """A table of four states, and the velocities that it has."""
    path = folder / f"a.{kind}"
    rows = [F, np.full(4, 0.7), np.array([3.0, 9.0, 20.0, 8.0]), PHASE]
    wanted = rows[2] * np.exp(1j * PHASE) / (2j * np.pi * F)
    if kind == "mat":  # units in a list
        names = ["frequency", "force", "amplitude", "phase"]
        units = np.array(["Hz", "N", "m/s^2", "rad"], dtype=object)
        scipy.io.savemat(path, {"FR": dict(zip(names, rows, strict=True)) | {"units": units}})
        return path, wanted
    heads = {
        "csv": "Drive freq [Hz],Load cell [N],Pt 3 [m/s²],Angle [rad]",
        "txt": "Drive freq;Load cell;Pt 3;Angle\nHz;N;m/s^2;rad",
        "dat": "f\tF (N)\ta (m/s^2)\ttheta",  # radians by their magnitude alone
        "asc": "# f[HZ]  F[N]  a[m/s2]  ph[RAD]",
    }
    by = {"csv": ",", "txt": ";", "dat": "\t", "asc": "  "}[kind]
    lines = [by.join(f"{value!r}" for value in row) for row in np.array(rows).T.tolist()]
    path.write_text("\n".join([heads[kind], *lines]))
    return path, wanted


@pytest.mark.parametrize("kind", ["mat", "csv", "txt", "dat", "asc"])
def test_the_command_that_is_proposed_runs_and_is_right(tmp_path, kind):
    path, wanted = written(tmp_path, kind)
    code, listed = run_import(path)
    assert code == 0
    (line,) = [line for line in listed.splitlines() if line.startswith("  snrmjax import")]
    words = shlex.split(line)[2:]
    code, output = run_import(*words[: words.index("--out")], "--out", tmp_path / "out")
    assert code == 0, output
    states = read_steady_states(tmp_path / "out" / "measured.csv")
    np.testing.assert_allclose(np.asarray(states.velocity)[:, 0], wanted, rtol=1e-12)
    np.testing.assert_allclose(states.force, 0.7)


def test_sibling_structs_are_one_record_or_one_table(tmp_path):
    time = np.arange(200) / 500
    one = {"t": time, "y": np.cos(time), "unit": "N"}
    two = {"t": time, "y": np.sin(time), "unit": "g"}
    scipy.io.savemat(tmp_path / "a.mat", {"force": one, "response": two})
    (record,) = read_laboratory_file(tmp_path / "a.mat").recordings
    assert record.channel_names == ("force", "response")
    np.testing.assert_allclose(record.values(), [np.cos(time), G * np.sin(time)])
    scipy.io.savemat(tmp_path / "b.mat", {"run1": one, "run2": two})
    assert len(read_laboratory_file(tmp_path / "b.mat").recordings) == 2
    levels = {
        f"level_{k}": {"freq": F, "F": np.full(4, 0.1 * k), "v": k * F, "ph": PHASE} for k in (1, 2)
    }
    scipy.io.savemat(tmp_path / "c.mat", levels)
    (table,) = read_laboratory_file(tmp_path / "c.mat").tables
    assert table.columns["entry"].tolist() == [1.0] * 4 + [2.0] * 4
    np.testing.assert_array_equal(table.columns["v"], np.concatenate([F, 2 * F]))


@pytest.mark.parametrize(
    ("microseconds", "why"), [(30, "Only whole samples"), (7_200_000_000, "less than half")]
)
def test_channels_that_no_whole_shift_aligns_are_separate_records(tmp_path, microseconds, why):
    path, start = tmp_path / "a.tdms", np.datetime64("2026-01-05T10:00:00.000000")
    with TdmsWriter(path) as writer:
        for name, late in (("Force", 0), ("Acc", microseconds)):
            wave = {"wf_increment": 1e-3, "wf_start_time": start + np.timedelta64(late, "us")}
            writer.write_segment([ChannelObject("g", name, np.arange(300.0), wave)])
    contents = read_laboratory_file(path)
    assert [record.name for record in contents.recordings] == ["g Force", "g Acc"]
    (note,) = (note for note in contents.notes if note.kind == "clocks_apart")
    assert why in str(note)
    assert note["samples"] == pytest.approx(microseconds / 1e3, abs=1.1e-3)  # stored to 1 µs
