"""The command `compare` on time records: classified by kind, and refused with a reason."""

import csv
import json
import sys

import numpy as np
import pytest

import snrmjax as sj
from snrmjax.cli import main
from snrmjax.measure import Channel, time_recording
from snrmjax.methods.records.recorded_decays import recorded_velocity
from snrmjax.methods.records.recorded_test import RecordKind, recorded_test
from snrmjax.pipelines.measured_files import read_measured_test

HERTZ = 2 * np.pi
RATE, SECONDS = 1000.0, 4.0
REST, RATIO = 40 * HERTZ, 0.004
TIME = np.arange(int(SECONDS * RATE)) / RATE
DECAY_RATE, TURNING = RATIO * REST, REST * np.sqrt(1 - RATIO**2)
DISPLACEMENT = 1e-3 * np.exp((-DECAY_RATE + 1j * TURNING) * TIME)
VELOCITY = ((-DECAY_RATE + 1j * TURNING) * DISPLACEMENT).real
ACCELERATION = ((-DECAY_RATE + 1j * TURNING) ** 2 * DISPLACEMENT).real
MODES = sj.model.linear_modes([REST], [RATIO], [[1.0]], [1.0], sensors=("tip",))
MODEL = "[[mode]]\nfrequency_hz = 40.0\ndamping_ratio = 0.004\nshape = { tip = 1.0 }\n"


def table(**columns):
    """A CSV of some columns."""
    names = [name.replace("__", ".") for name in columns]
    rows = np.stack(list(columns.values()), axis=1)
    lines = [",".join(f"{value:.9g}" for value in row) for row in rows]
    return "\n".join([",".join(names), *lines]) + "\n"


DECAY = table(time_s=TIME, velocity_m_s=VELOCITY)


@pytest.fixture
def compare(tmp_path, monkeypatch, capsys):
    """Run the command on texts of files: its exit code, its messages and its folder."""

    def run(files, *options):
        (tmp_path / "model.toml").write_text(MODEL + "participation = 1.0\n")
        for name, text in files.items():
            (tmp_path / name).write_text(text)
        out = tmp_path / "out"
        arguments = [*(str(tmp_path / name) for name in files), "--out", str(out), *options]
        given = ["snrmjax", "compare", *arguments, "--model", str(tmp_path / "model.toml")]
        monkeypatch.setattr(sys, "argv", given)
        with pytest.raises(SystemExit) as ended:
            main()
        return ended.value.code or 0, " ".join(capsys.readouterr().err.split()), out

    return run


def test_a_decay_goes_to_the_methods_of_decays(compare):
    names = ("snrm", "resonant_decay", "restoring_force")
    code, printed, out = compare({"ring.csv": DECAY}, *(f"--method={name}" for name in names))
    assert code == 0
    assert "ring.csv: free decay (no force or drive acts, and the motion decays)" in printed
    assert "did not run: snrm: steady states are needed, and the data have none." in printed
    with (out / "compare.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["status"] == "found"]
    assert {row["method"] for row in rows} == set(names[1:])
    hertz = np.array([float(row["frequency_hz"]) for row in rows])
    ratio = np.array([float(row["damping_ratio"]) for row in rows])
    # Parabolas through extremes at 25 samples a cycle: 1e-4 of the frequency.
    np.testing.assert_allclose(hertz, 40, rtol=2e-4)
    assert np.median(np.abs(ratio / RATIO - 1)) < 0.01
    summary = json.loads((out / "summary.json").read_text())
    assert set(summary["stopped"]) == {"snrm"}
    assert summary["methods"]["resonant_decay"]["record_s"] == SECONDS
    assert "ing.csv: free decay (no force" in (out / "report.html").read_text()


def test_what_some_data_do_not_allow_does_not_stop_the_others():
    good = _recording(tip=VELOCITY, force=0 * TIME)
    flat = _recording(tip=np.clip(VELOCITY, -0.1, 0.1))
    found = sj.methods.compare_methods([flat, good], MODES, ["concerto", "resonant_decay"])
    (result,) = found.results
    assert result.method == "resonant_decay"
    assert result.notes[0].kind == "record_left_out"
    assert "is clipped" in result.notes[0]["why"]
    assert set(found.stopped) == {"concerto"}
    assert [record["kind"] for record in found.records] == 2 * ["free decay"]


def _tone():
    phase = HERTZ * 40 * TIME
    return {"time_s": TIME, "force_n": np.cos(phase), "velocity_m_s": 0.1 * np.cos(phase)}


def _steps(below=True):
    """Ten steps of 16 cycles: of a spring (below resonance) or above it."""
    hertz = (36.0 if below else 44.0) + 0.3 * (TIME / 0.4).astype(int)
    phase = HERTZ * np.cumsum(hertz) / RATE
    lead = 1.5 if below else -1.5
    return {
        "time_s": TIME,
        "force_n": np.cos(phase),
        "velocity_m_s": 0.01 * (1 + 0.1 * (hertz - hertz[0])) * np.cos(phase + lead),
    }


def _changed(columns, **others):
    return {key: one for key, one in {**columns, **others}.items() if one is not None}


NOISE = np.random.default_rng(3).standard_normal(len(TIME))
FREE = {"time_s": TIME, "velocity_m_s": VELOCITY}
BAD = {
    "empty": ("", (), "bad.csv is empty"),
    "too short for a decay": (
        table(**{k: v[:200] for k, v in FREE.items()}),
        *(("resonant_decay",), "resonant_decay: bad.csv: 12 cycles are needed, or 5 in which"),
    ),
    "clipped": (
        table(**_changed(FREE, velocity_m_s=np.clip(VELOCITY, -0.1, 0.1))),
        *(("restoring_force",), "restoring_force: bad.csv: the record stays at its"),
    ),
    "milliseconds": (
        table(**_changed(FREE, time_s=1000 * TIME)),
        *((), "is at 0.04006 Hz, but the mode of interest is at 40 Hz: is its time in seconds"),
    ),
    "too slow sampling": (
        table(**{k: v[::8] for k, v in FREE.items()}),
        *(("resonant_decay",), "resonant_decay: bad.csv: 8 samples a cycle are needed"),
    ),
    "unknown sensor": (
        table(time_s=TIME, root__velocity_m_s=VELOCITY), (), "has no motion of the sensor tip",
    ),
    "nothing moves": (table(**_changed(FREE, velocity_m_s=0 * TIME)), (), "does not move"),
    "no force channel": (
        table(**_changed(_tone(), force_n=None)),
        *(("snrm", "concerto"), "snrm: bad.csv has no force or drive that acts, and its motion"),
    ),
    "single tone": (table(**_tone()), ("ssm",), "force_n is a single tone of 40 Hz"),
    "one side of resonance": (
        table(**_steps(below=False)),
        *(("concerto",), "concerto"),
    ),
    "steps for a method of decays": (
        table(**_steps()), ("ssm",), "ssm: a time record (free decay) is needed",
    ),
    "broadband for a method of states": (
        table(**_changed(FREE, velocity_m_s=np.cumsum(NOISE) / 100, force_n=NOISE)),
        *(("concerto",), "concerto: steady states are needed, and the data have none"),
    ),
    "broadband in volts": (
        table(**_changed(FREE, velocity_m_s=NOISE[::-1], drive_v=NOISE)),
        *(("restoring_force",), "restoring_force: bad.csv: a forced record needs its force in N"),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_records_are_refused_in_one_sentence(compare, name):
    text, methods, sentence = BAD[name]
    options = [f"--method={one}" for one in methods]
    code, printed, out = compare({"bad.csv": text}, *options)
    assert code == 2, printed
    assert sentence in printed
    assert not out.exists()


def test_a_laboratory_file_is_read_by_units_or_by_names(tmp_path):
    from scipy.io import savemat

    structure = sj.model.structure(MODES)
    (tmp_path / "lab.csv").write_text(
        DECAY.replace(",", ";").replace("time_s;velocity_m_s", "Time [s];tip [m/s]")
    )
    savemat(tmp_path / "lab.mat", {"time": TIME, "tip_velocity_m_s": VELOCITY})
    for name in ("lab.csv", "lab.mat"):
        (record,) = read_measured_test(tmp_path / name, structure)
        found = recorded_test(record, MODES)
        assert found.recording.name == name
        assert found.kind is RecordKind.FREE_DECAY
        np.testing.assert_allclose(record.values([found.channels.reference])[0], VELOCITY, 1e-7)


def _recording(**columns):
    kinds = {"force": "force", "drive": "voltage", "tip": "velocity", "turn": "acceleration"}
    channels = [Channel(name, kinds.get(name, name)) for name in columns]
    return time_recording(np.stack(list(columns.values())), channels, RATE, name="test")


def test_records_are_classified_by_kind():
    steps = _steps()
    sweep = np.cos(HERTZ * (36 * TIME + TIME**2))
    pulse = np.where(TIME < 0.005, 100.0, 0.0)
    burst = np.where(TIME < 1.0, np.cos(REST * TIME), 0.0)
    late = np.concatenate([VELOCITY[0] * np.cos(REST * (TIME[:1000] - 1)), VELOCITY[:-1000]])
    kinds = {
        RecordKind.STEPPED_SINE: {"force": steps["force_n"], "tip": steps["velocity_m_s"]},
        RecordKind.SLOW_SWEEP: {"force": sweep, "tip": sweep},
        RecordKind.BROADBAND: {"force": NOISE, "tip": np.roll(NOISE, 3)},
    }
    for kind, columns in kinds.items():
        assert recorded_test(_recording(**columns), MODES).kind is kind
    for columns, start in (
        ({"drive": burst, "tip": late}, 1025),  # a cycle after the drive has stopped
        ({"force": 1e-3 * NOISE, "tip": VELOCITY}, int(np.argmax(np.abs(VELOCITY)))),
        ({"force": pulse, "tip": VELOCITY}, 30),
    ):
        found = recorded_test(_recording(**columns), MODES)
        assert found.kind is RecordKind.FREE_DECAY
        assert found.free[0][0] == pytest.approx(start, abs=2)
        assert found.free[0][1] == len(TIME)


@pytest.mark.parametrize("quantity", ["acceleration", "displacement"])
def test_other_motions_become_velocities(quantity):
    measured = {"acceleration": ACCELERATION, "displacement": DISPLACEMENT.real}[quantity]
    found = recorded_velocity(_recording(**{quantity: measured}), quantity, REST, (0, len(TIME)))
    true = VELOCITY[found.start : found.start + len(found.time)]
    # Spline of degree 5 at 25 samples a cycle: 1e-4; ends of the high-pass after eight cycles.
    np.testing.assert_allclose(found.velocity[50:], true[50:], atol=2e-3 * np.abs(true).max())
