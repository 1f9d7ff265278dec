"""From a folder to one report: questions on the way, and the whole chain on known truth."""

import json

import numpy as np
import pytest
from truths.import_runs import run_import
from truths.matlab_writing import write_matlab
from truths.uff_writing import write_uff
from typer.testing import CliRunner

import snrmjax as sj
from snrmjax.cli import app
from snrmjax.io.exchange.import_map import steps_of_map
from snrmjax.measure import Channel, frequency_responses, time_recording
from snrmjax.measure.recordings.step_counts import StepCounts, joined_counts
from snrmjax.pipelines.folder_contents import NamedRecord, read_test_files
from snrmjax.pipelines.whole_test import (
    _refuse_doubled,
    _sorted,
    _Stages,
    _taken_sensors,
    _used_steps,
)

HERTZ = 2 * np.pi
OWN, RATIO = 50 * HERTZ, 0.01
HEADER = "level,frequency_hz,force_n,velocity_re_m_s,velocity_im_m_s\n"
RATE = 1024.0


def mobility(omega):
    """Velocity over force of 1 kg on a spring, at the drive point."""
    return 1j * omega / (OWN**2 - omega**2 + 2j * RATIO * OWN * omega)


def write_responses(path, response_at="1", lines=400):
    omega = HERTZ * np.linspace(40, 60, lines)
    rng = np.random.default_rng(1)
    values = mobility(omega)
    noise = rng.standard_normal((2, omega.size)) * 1e-3 * np.abs(values).max() * 0.1
    responses = frequency_responses(
        omega,
        (values + noise[0] + 1j * noise[1])[None, None],
        [Channel("tip", "velocity", "m/s", point=response_at, direction="+z")],
        [Channel("force", "force", "N", point="1", direction="+z")],
    )
    write_uff(path, responses=[responses])


def write_states(path, change=lambda v: v):
    rows = []
    for level, force in enumerate((0.5, 1.0, 2.0), start=1):
        for hertz in np.linspace(49, 51, 12):
            v = complex(change(force * mobility(HERTZ * hertz)))
            rows.append(f"{level},{float(hertz)!r},{force},{v.real!r},{v.imag!r}")
    path.write_text(HEADER + "\n".join(rows) + "\n")


def test_shapes_without_a_scale_are_a_question(tmp_path):
    write_responses(tmp_path / "frf.uff", response_at="7", lines=60)
    write_states(tmp_path / "states.csv")
    done = CliRunner().invoke(app, ["test", str(tmp_path), "--out", str(tmp_path / "out")])
    assert isinstance(done.exception, ValueError)
    assert "how are the mode shapes scaled?" in str(done.exception)
    assert "--drive-point" in str(done.exception)
    assert not (tmp_path / "out").exists()
    given = ["test", str(tmp_path), "--drive-point", "7", "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(app, given)
    assert isinstance(done.exception, ValueError)
    assert "Name another sensor than 7, or write the model" in str(done.exception)
    assert "--drive-point" not in str(done.exception)


def test_what_the_check_finds_is_a_question(tmp_path):
    (tmp_path / "model.toml").write_text(
        'name = "one"\n[[mode]]\nfrequency_hz = 50.0\ndamping_ratio = 0.01\n'
        "shape = { tip = 1.0 }\nparticipation = 1.0\n"
    )
    write_states(tmp_path / "states.csv", np.conj)
    done = CliRunner().invoke(app, ["test", str(tmp_path), "--out", str(tmp_path / "out")])
    assert "is this intended? conjugated response" in str(done.exception)
    correction = f"snrmjax import {tmp_path}/states.csv --phase-sign lag --out {tmp_path}/mended"
    assert f"`{correction}`" in str(done.exception)
    assert "To continue nevertheless: `--go-on`." in str(done.exception)
    assert not (tmp_path / "out").exists()


def test_states_that_two_files_hold_are_a_question(tmp_path):
    """An import written into the folder of the raw files: its states would count twice."""
    (tmp_path / "model.toml").write_text(
        'name = "one"\n[[mode]]\nfrequency_hz = 50.0\ndamping_ratio = 0.01\n'
        "shape = { tip = 1.0 }\nparticipation = 1.0\n"
    )
    write_states(tmp_path / "measured.csv")
    write_states(tmp_path / "states.csv")
    done = CliRunner().invoke(app, ["test", str(tmp_path), "--out", str(tmp_path / "out")])
    printed = str(done.exception)
    assert "which of measured.csv and states.csv is the test? Both hold the same 36" in printed
    names = [one.file for one in read_test_files(tmp_path).states]
    # A repetition has other noise: 0.1 % of it is enough.
    write_states(tmp_path / "states.csv", lambda v: 1.001 * v)
    _refuse_doubled(names, [one.states for one in read_test_files(tmp_path).states])


def test_a_file_without_a_sensor_is_assigned_to_the_models_only_one(tmp_path):
    (tmp_path / "model.toml").write_text(
        'name = "one"\n[[mode]]\nfrequency_hz = 50.0\ndamping_ratio = 0.01\n'
        "shape = { tip = 1.0 }\nparticipation = 1.0\n"
    )
    write_states(tmp_path / "states.csv")
    files = read_test_files(tmp_path)
    (note,) = _taken_sensors(files, files.model)
    assert (note.kind, note["files"], note["sensor"]) == (
        "sensor_not_named",
        ("states.csv",),
        "tip",
    )
    lines = (tmp_path / "states.csv").read_text().splitlines()
    named = [f"{one},{'tip' if k else 'sensor'}" for k, one in enumerate(lines)]
    (tmp_path / "states.csv").write_text("\n".join(named) + "\n")
    assert _taken_sensors(read_test_files(tmp_path), files.model) == ()


@pytest.mark.parametrize(("quantity", "moves"), [("velocity", True), ("unknown", False)])
def test_a_record_that_is_no_test_is_named_by_its_file(quantity, moves):
    record = time_recording(np.zeros((1, 64)), [Channel("tip", quantity)], RATE)  # without a name
    modes = sj.model.linear_modes([OWN], [RATIO], [[1.0]], [1.0], sensors=("tip",))
    with pytest.raises(ValueError, match=r"^run\.mat[: ]") as raised:
        _sorted(NamedRecord("run.mat", record), sj.model.structure(modes))
    assert ("`snrmjax import run.mat`" not in str(raised.value)) == moves


STEPS, DWELL = 10, 6.0
MOVING = (2, 3, 7)  # of the steps: their response still grows by a third


def test_steps_left_out_at_import_are_counted(tmp_path):
    rate = 200.0
    time = np.arange(round(DWELL * rate)) / rate
    pieces = []
    for k in range(STEPS):
        wave = np.cos(2 * np.pi * (9.5 + 0.1 * k) * time)
        grown = 1 + time / DWELL / 3 if k in MOVING else 1.0
        pieces.append([2 * wave, 0.1 * (1 + 0.1 * k) * grown * wave])
    channels = [Channel("load", "force", "N"), Channel("tip", "velocity", "m/s")]
    steps = time_recording(np.concatenate(pieces, axis=1), channels, rate)
    write_matlab(tmp_path / "run1.mat", recordings=[steps])
    folder = tmp_path / "test"
    assigned = ("--force", "load", "--response", "tip", "--sensor", "tip", "--record", "steps")
    code, printed = run_import(tmp_path / "run1.mat", *assigned, "--out", folder)
    assert code == 0, printed
    assert "7 of 10 steps used; left out: 3 unsettled" in " ".join(printed.split())
    files = read_test_files(folder)
    assert _used_steps(files, []) == StepCounts(7, {"unsettled": 3})
    assert steps_of_map(folder / "map.toml") == files.steps_at_import
    some = StepCounts(44, {"unsettled": 58, "too short": 2})
    assert joined_counts([some, StepCounts(1, {"unsettled": 1})]) == StepCounts(
        45, {"unsettled": 59, "too short": 2}
    )


def test_each_stage_is_reported_with_its_seconds():
    reported = []
    stage = _Stages(lambda name, seconds: reported.append((name, seconds)))
    stage.ends("check")
    stage.ends("diagnosis")
    assert [name for name, _ in reported] == ["check", "diagnosis"]
    assert all(seconds >= 0 for _, seconds in reported)


def duffing_record(force, rng):
    """Steps of frequency of an oscillator with a cubic spring, by SciPy, with a little noise."""
    from scipy.integrate import solve_ivp

    steps = HERTZ * np.linspace(48.5, 52.5, 11)
    dwell = 4.0
    count = int(dwell * RATE)
    state, phase, values = np.zeros(2), 0.0, []
    for omega in steps:

        def equations(t, y, omega=omega, phase=phase):
            load = force * np.cos(omega * t + phase)
            return y[1], load - 2 * RATIO * OWN * y[1] - OWN**2 * y[0] - 1e9 * y[0] ** 3

        time = np.arange(count) / RATE
        found = solve_ivp(
            equations,
            (0, dwell),
            state,
            t_eval=time,
            method="DOP853",
            rtol=1e-8,
            atol=1e-12,
            dense_output=True,
        )
        values.append([force * np.cos(omega * time + phase), found.y[1]])
        state, phase = found.sol(dwell), phase + omega * dwell
    both = np.concatenate(values, axis=1)
    both += 1e-3 * np.abs(both).max(axis=1)[:, None] * rng.standard_normal(both.shape)
    attachment = {"point": "1", "direction": "+z"}
    channels = [
        Channel("force", "force", "N", **attachment),
        Channel("tip", "velocity", "m/s", **attachment),
    ]
    return time_recording(both, channels, RATE)


@pytest.mark.long
def test_a_folder_of_raw_files_gives_the_backbone_of_its_oscillator(tmp_path):
    folder = tmp_path / "raw"
    folder.mkdir()
    write_responses(folder / "frf.uff")
    rng = np.random.default_rng(2)
    records = [duffing_record(force, rng) for force in (1.0, 2.5, 5.0)]
    write_matlab(folder / "steps.mat", recordings=records)
    out = tmp_path / "out"
    done = CliRunner().invoke(app, ["test", str(folder), "--out", str(out)])
    assert done.exit_code == 0, done.exception
    model = sj.read_model(out / "model.toml")
    assert float(model.modes.natural_frequency[0]) == pytest.approx(OWN, rel=2e-4)
    assert json.loads((out / "check.json").read_text()) == []
    page = (out / "report.html").read_text()
    assert "mode of interest" in page
    assert "linear mode<" not in page  # not a second one without errors
    for heading in ("Files", "Check", "States", "Backbone: ", "Diagnosis: "):
        assert f">{heading}" in page
    rows = np.genfromtxt(out / "identify" / "backbone.csv", delimiter=",", names=True)
    speed, hertz = rows["velocity_m_s"], rows["natural_frequency_hz"]
    # Duffing's backbone: ω̃² = ω² + ¾γa², v = aω̃.
    amplitude = speed / (hertz * HERTZ)
    true = np.sqrt(OWN**2 + 0.75e9 * amplitude**2) / HERTZ
    inside = speed > 0.3 * speed.max()
    assert np.max(np.abs(hertz[inside] / true[inside] - 1)) < 3e-4  # its third harmonic: 1e-4
    answer = json.loads((out / "diagnose" / "diagnosis.json").read_text())
    assert "cubic_stiffness" in answer["effects"]
