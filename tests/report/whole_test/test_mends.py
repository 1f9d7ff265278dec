"""Commands that mend what the check finds, run as they are printed."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from truths.one_mode import OMEGA, SHAPE, ZETA, model, noisy, states, table
from typer.testing import CliRunner

import snrmjax as sj
from snrmjax.cli import app
from snrmjax.doctor.findings import Checkup, Finding, Repair
from snrmjax.io.exchange.import_map import ImportMap, ResponseMap
from snrmjax.report.whole_test import mends
from snrmjax.report.whole_test.folder_contents import read_test_files

RAW = "Freq [Hz],Load [N],Amp [{}],Phase [deg]\n"
TOLD = ("--force", "Load", "--frequency", "Freq", "--phase", "Phase", "--sensor", "tip")


def run(*words):
    done = CliRunner().invoke(app, [str(one) for one in words])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    assert done.exit_code == 0, done.output
    return done.output


def pasted(mend, k=0):
    """Run the k-th command of a mend, each step of it."""
    command = re.findall(r"`(snrmjax [^`]+)`", mend)[k]
    for step in command.split(" && "):
        name, *words = shlex.split(step)
        assert name == "snrmjax"
        run(*words)
    return command


def kinds(folder):
    return [one["kind"] for one in json.loads((folder / "check.json").read_text())]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder, of whose files the commands speak, with the model of the mode."""
    monkeypatch.chdir(tmp_path)
    sj.io.write_model("model.toml", model())
    return tmp_path


def checked(data, folder, *words):
    """What the check says of a table of our own."""
    sj.io.write_steady_states("measured.csv", data)
    run("check", "measured.csv", "--model", "model.toml", *words, "--out", "checked")
    return json.loads((folder / "checked" / "check.json").read_text())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda w, f, v: (f, v / 9.80665), '--unit "9.80665 m/s"'),
        (lambda w, f, v: (f / 4.4482216, v), '--force-unit "4.4482216 N"'),
        (lambda w, f, v: (f, v / np.sqrt(2)), '--unit "1.4142136 m/s"'),
        (lambda w, f, v: (f, v.conj()), "--phase-sign lag"),
        (lambda w, f, v: (f, v * 1j * w), "--unit m/s2"),
        (lambda w, f, v: (f, v / (1j * w)), "--unit m "),
    ],
)
def test_a_table_of_our_own_is_mended(folder, change, words):
    level, w, f, v = states()
    first, *_ = checked(table(level, w, *change(w, f, noisy(v))), folder)
    assert words in pasted(first["mend"])
    assert kinds(folder / "mended") == []
    found = sj.read_steady_states("mended/measured.csv")
    np.testing.assert_allclose(found.velocity[:, 0], noisy(v), rtol=1e-6)
    np.testing.assert_allclose(found.force, f, rtol=1e-6)


def written(unit, amplitudes, phases):
    """Amplitudes and phases as a lock-in lists them, the unit in the header or not."""
    _, w, f, _ = states()
    rows = zip(w / 2 / np.pi, f, amplitudes, phases, strict=True)
    text = RAW.format(unit).replace("[]", "") + "\n".join(",".join(map(repr, r)) for r in rows)
    with open("lock in.csv", "w") as file:
        file.write(text.replace("np.float64(", "").replace(")", "") + "\n")


@pytest.mark.parametrize(
    ("size", "read", "option"),
    [
        (1 / 9.80665, "acceleration:m/s^2", "--unit g"),
        (1.0, "acceleration:g", "--unit m/s2"),
        (1e3, "acceleration:m/s^2", "--unit mm/s2"),
    ],
)
def test_the_laboratorys_file_is_imported_again(folder, size, read, option):
    _, w, _, v = states()
    a = noisy(v) * 1j * w * size
    written("", np.abs(a), np.degrees(np.angle(a)))
    run("import", "lock in.csv", *TOLD, "--response", f"Amp:{read}", "--out", "taken")
    run("check", "taken/measured.csv", "--model", "model.toml", "--out", "checked")
    first = json.loads((folder / "checked" / "check.json").read_text())[0]
    assert first["kind"] == "wrong_unit"
    command = pasted(first["mend"])
    assert command.startswith(
        f'snrmjax import "lock in.csv" --map taken/map.toml {option} --out taken/mended && '
    )
    assert kinds(folder / "taken" / "mended") == []
    found = sj.read_steady_states("taken/mended/measured.csv")
    np.testing.assert_allclose(found.velocity[:, 0], noisy(v), rtol=1e-6)


def test_several_units_of_one_factor_are_a_command_each(folder):
    level, w, f, v = states()
    first, *_ = checked(table(level, w, f, 1e3 * noisy(v)), folder)
    commands = re.findall(r'--(?:force-)?unit "([^"]+)"', first["mend"])
    assert commands == ["0.001 m/s", "1000 N", "1000 N"]
    pasted(first["mend"], 1)
    assert kinds(folder / "mended") == []


def test_a_shape_of_another_scale_is_found_anew(folder):
    """At 0.05 of the amplitude the mode is linear: its modes are those of the model."""
    w = OMEGA * np.linspace(0.9, 1.1, 60)
    v = 1j * w * SHAPE**2 / (OMEGA**2 - w**2 + 2j * ZETA * OMEGA * w)
    sj.io.write_model("model.toml", model(1.0))
    one, *_ = checked(table(np.zeros(60, int), w, np.ones(60), noisy(v)), folder)
    assert one["kind"] == "shape_not_mass_normalised"
    assert one["where"] == "1 level at tip"
    assert "--drive-point tip" in pasted(one["mend"])
    assert kinds(folder / "mended") == []
    found = sj.read_model("mended/model.toml").modes
    assert abs(float(found.mode_shape[0, 0])) == pytest.approx(SHAPE, rel=0.02)


def test_modes_found_here_are_found_again_beside_what_is_mended(tmp_path):
    """Their table would be one more file of measurements in the folder that is tested."""
    place = mends.FilesOfTest(
        tmp_path / "mended",
        sources=(tmp_path / "run1.mat",),
        options=("--force", "F"),
        first=(told := ImportMap((ResponseMap("a", "acceleration"),))),
        told=told,
        folder=tmp_path,
        out=tmp_path / "out",
        responses=(tmp_path / "frf.uff",),
    )
    finding = Finding(
        "wrong_unit", "error", "1 level at tip", "", "Again.", (), (Repair(unit="g"),)
    )
    (told,) = mends.with_commands(Checkup((finding,)), place).findings
    steps = [shlex.split(one) for one in re.findall("`(.+)`", told.mend)[0].split(" && ")]
    assert [one[1] for one in steps] == ["import", "modes", "test"]
    assert steps[0][2:] == [
        *(f"{tmp_path}/run1.mat", "--force", "F", "--unit", "g", "--out", f"{tmp_path}/mended"),
    ]
    model = steps[1][steps[1].index("--out") + 1]
    assert steps[2][steps[2].index("--model") + 1] == model
    assert f"{tmp_path}/mended/" not in model


def lock_in_of_g():
    """A lock-in's amplitudes in g, that an import has taken for velocities in m/s."""
    _, w, _, v = states()
    a = noisy(v) * 1j * w / 9.80665
    written("", np.abs(a), np.degrees(np.angle(a)))
    run("import", "lock in.csv", *TOLD, "--response", "Amp:velocity:m/s", "--out", "taken")
    return noisy(v)


def test_a_table_that_was_restated_is_mended_from_the_laboratorys_file(folder):
    """One error was mended in our own table: the next mend says both to the first import."""
    truth = lock_in_of_g()
    run("import", "taken/measured.csv", "--unit", "m/s2", "--out", "once")
    run("check", "once/measured.csv", "--model", "model.toml", "--out", "checked")
    first = json.loads((folder / "checked" / "check.json").read_text())[0]
    assert first["kind"] == "wrong_unit"
    command = pasted(first["mend"])
    assert command.startswith(
        'snrmjax import "lock in.csv" --map taken/map.toml --response Amp:acceleration '
        "--sensor tip --phase Phase --unit g --out once/mended && "
    )
    found = sj.read_steady_states("once/mended/measured.csv")
    np.testing.assert_allclose(found.velocity[:, 0], truth, rtol=1e-6)


def test_two_errors_are_mended_by_one_command(folder):
    """Amplitudes in g that were taken for velocities: one import says quantity and unit."""
    truth = lock_in_of_g()
    run("check", "taken/measured.csv", "--model", "model.toml", "--out", "checked")
    found = json.loads((folder / "checked" / "check.json").read_text())
    assert [one["kind"] for one in found[:2]] == ["acceleration_as_velocity", "wrong_unit"]
    command = pasted(found[0]["mend"])
    assert "--response Amp:acceleration --sensor tip --phase Phase --unit g --out" in command
    assert kinds(folder / "taken" / "mended") == []
    mended = sj.read_steady_states("taken/mended/measured.csv")
    np.testing.assert_allclose(mended.velocity[:, 0], truth, rtol=1e-6)


def test_two_errors_of_our_own_table_are_mended_by_one_command(folder):
    level, w, f, v = states()
    first, *_ = checked(table(level, w, f, noisy(v).conj() / 9.80665), folder)
    assert first["kind"] == "conjugated_response"
    assert '--unit "9.80665 m/s" --phase-sign lag' in pasted(first["mend"])
    assert kinds(folder / "mended") == []


def test_the_file_of_a_level_whose_force_is_off_is_named(tmp_path):
    """No import changes the force of one level alone: the column and its file are said."""
    level, w, f, v = states()
    parts = [table(level[mine], w[mine], f[mine], v[mine]) for mine in (level < 2, level == 2)]
    place = mends.FilesOfTest(
        tmp_path / "mended",
        sources=(tmp_path / "low.mat", tmp_path / "high.mat"),
        first=ImportMap(force="cell"),
        of_levels=mends.file_of_each_level(["low.mat", "high.mat"], parts),
    )
    repair = Repair(force=0.8, levels=(3,))
    finding = Finding("volts_as_force", "error", "", "", "Divide it by 1.25.", (), (repair,))
    (told,) = mends.with_commands(Checkup((finding,)), place).findings
    assert told.mend == "Divide it by 1.25 (`cell` in high.mat)."


def test_what_is_mended_never_takes_the_place_of_its_input(folder):
    """Pasted twice, a command that writes where it reads would scale twice."""
    level, w, f, v = states()
    for name in ("out_mended", "out_mended_2"):
        (folder / name).mkdir()
        sj.io.write_steady_states(f"{name}/measured.csv", table(level, w, f, noisy(v)))
    linear = Path("out_mended_2/model.toml")
    sj.io.write_model(linear, model())
    place = mends.tested_files(
        *(Path("out_mended"), read_test_files(Path("out_mended"), linear), linear, None),
        Path("out"),
    )
    assert place.mended == Path("out_mended_3")
    finding = Finding("wrong_unit", "error", "", "", "", (), (Repair(response=9.80665),))
    (told,) = mends.with_commands(Checkup((finding,)), place).findings
    assert (
        'import out_mended/measured.csv --unit "9.80665 m/s" --out out_mended_3 && '
        "snrmjax test out_mended_3 --model out_mended_2/model.toml --out out"
    ) in told.mend


@pytest.mark.long
def test_volts_for_newtons_are_left_to_the_identification(folder):
    level, w, f, v = states()
    first, *_ = checked(table(level, w, 0.55 * f, noisy(v)), folder)
    assert first["kind"] == "volts_as_force"
    assert "--free force_gain,instrument_phase" in pasted(first["mend"])
    assert (folder / "mended" / "identify" / "backbone.csv").is_file()


@pytest.mark.long
def test_the_whole_test_goes_on_with_what_is_mended(folder):
    _, w, _, v = states()
    (folder / "raw").mkdir()
    sj.io.write_model("raw/model.toml", model())
    a = noisy(v) * 1j * w / 9.80665
    written("", np.abs(a), np.degrees(np.angle(a)))
    run("import", "lock in.csv", *TOLD, "--response", "Amp:acceleration:m/s^2", "--out", "taken")
    (folder / "lock in.csv").rename(folder / "raw" / "lock in.csv")
    (folder / "taken" / "map.toml").rename(folder / "raw" / "map.toml")
    with pytest.raises(ValueError, match="wrong unit") as stopped:
        run("test", "raw", "--out", "done", "--no-diagnose")
    command = pasted(str(stopped.value))
    assert "--unit g" in command
    assert command.endswith("snrmjax test done_mended --model raw/model.toml --out done")
    assert kinds(folder / "done") == []
