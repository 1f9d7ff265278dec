"""How many steps of a test were used: by its record, by its map, on the page."""

from types import SimpleNamespace

import numpy as np
from truths.import_runs import run_import

from snrmjax.io.exchange.exports import write_matlab
from snrmjax.measure import Channel, time_recording
from snrmjax.measure.recordings.step_counts import StepCounts, counts_in, joined_counts
from snrmjax.report.whole_test.folder_contents import read_test_files
from snrmjax.report.whole_test.used_steps import used_steps, with_steps

RATE, DWELL = 200.0, 6.0
MOVING = (2, 3, 7)  # of ten steps: their response still grows by a third


def steps():
    """Force and velocity of ten steps, of which three do not settle."""
    time = np.arange(round(DWELL * RATE)) / RATE
    pieces = []
    for k in range(10):
        wave = np.cos(2 * np.pi * (9.5 + 0.1 * k) * time)
        grown = 1 + time / DWELL / 3 if k in MOVING else 1.0
        pieces.append([2 * wave, 0.1 * (1 + 0.1 * k) * grown * wave])
    channels = [Channel("load", "force", "N"), Channel("tip", "velocity", "m/s")]
    return time_recording(np.concatenate(pieces, axis=1), channels, RATE)


def test_steps_left_out_at_import_are_counted(tmp_path):
    write_matlab(tmp_path / "run1.mat", recordings=[steps()])
    folder = tmp_path / "test"
    told = ("--force", "load", "--response", "tip", "--sensor", "tip", "--record", "steps")
    code, said = run_import(tmp_path / "run1.mat", *told, "--out", folder)
    assert code == 0, said
    assert "7 of 10 steps used; left out: 3 unsettled." in " ".join(said.split())
    counts = used_steps(read_test_files(folder), [])
    assert counts == StepCounts(7, {"unsettled": 3})
    assert used_steps(read_test_files(folder), [StepCounts(2, {})]) is None  # not all are steps
    points = SimpleNamespace(usable=np.arange(7) > 0, sensor="tip")
    rows = [("noise", "stated"), ("steady states used", "6 of 7 at sensor tip")]
    assert with_steps(rows, None, points) == rows
    shown = dict(with_steps(rows, counts, points))
    assert shown["noise"] == "stated"
    assert shown["steady states used"] == "6 of 10 steps at sensor tip; left out: 3 unsettled"


def test_counts_in_words_are_read_again():
    some = StepCounts(44, {"unsettled": 58, "too short": 2})
    assert counts_in(f"note: run1.mat: {some.words}. More") == some
    assert counts_in("7 of 7 steps used.") == StepCounts(7, {})
    assert counts_in("44 of 104 rows") is None
    assert joined_counts([some, StepCounts(1, {"unsettled": 1})]) == StepCounts(
        45, {"unsettled": 59, "too short": 2}
    )
