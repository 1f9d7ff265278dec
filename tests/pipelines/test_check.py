"""Import commands that correct findings of the check, run as printed."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from truths.one_mode import model, noisy, states, table
from typer.testing import CliRunner

import snrmjax as sj
from snrmjax.cli import app
from snrmjax.doctor.findings import Checkup, Finding, ImportCorrection
from snrmjax.io.exchange.import_map import ImportMap, ResponseMap
from snrmjax.pipelines import check as pipeline

RAW = "Freq [Hz],Load [N],Amp [{}],Phase [deg]\n"
TOLD = ("--force", "Load", "--frequency", "Freq", "--phase", "Phase", "--sensor", "tip")


def run(*words):
    done = CliRunner().invoke(app, [str(one) for one in words])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    assert done.exit_code == 0, done.output
    return done.output


def pasted(correction, k=0):
    """Run the k-th command of a correction."""
    command = re.findall(r"`(snrmjax [^`]+)`", correction)[k]
    name, *words = shlex.split(command)
    assert name == "snrmjax"
    run(*words)
    return command


def kinds_of(data, folder):
    run("check", data, "--model", "model.toml", "--out", "again")
    return [one["kind"] for one in json.loads((folder / "again" / "check.json").read_text())]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder, of whose files the commands speak, with the model of the mode."""
    monkeypatch.chdir(tmp_path)
    sj.io.write_model("model.toml", model())
    return tmp_path


def checked(data, folder, *words):
    """Findings of the check for a table of our own."""
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
def test_a_table_of_our_own_is_corrected(folder, change, words):
    level, w, f, v = states()
    first, *_ = checked(table(level, w, *change(w, f, noisy(v))), folder)
    assert words in pasted(first["mend"])
    assert kinds_of("mended/measured.csv", folder) == []
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
    ("size", "read"),
    [
        (1 / 9.80665, "acceleration:m/s^2"),
        (1.0, "acceleration:g"),
        (1e3, "acceleration:m/s^2"),
    ],
)
def test_the_table_of_a_laboratorys_file_is_restated(folder, size, read):
    _, w, _, v = states()
    a = noisy(v) * 1j * w * size
    written("", np.abs(a), np.degrees(np.angle(a)))
    run("import", "lock in.csv", *TOLD, "--response", f"Amp:{read}", "--out", "taken")
    run("check", "taken/measured.csv", "--model", "model.toml", "--out", "checked")
    first = json.loads((folder / "checked" / "check.json").read_text())[0]
    assert first["kind"] == "wrong_unit"
    command = pasted(first["mend"])
    assert command.startswith("snrmjax import taken/measured.csv --unit ")
    assert command.endswith(" --out taken/mended")
    found = sj.read_steady_states("taken/mended/measured.csv")
    np.testing.assert_allclose(found.velocity[:, 0], noisy(v), rtol=1e-6)


def test_several_units_of_one_factor_are_a_command_each(folder):
    level, w, f, v = states()
    first, *_ = checked(table(level, w, f, 1e3 * noisy(v)), folder)
    commands = re.findall(r'--(?:force-)?unit "([^"]+)"', first["mend"])
    assert commands == ["0.001 m/s", "1000 N", "1000 N"]
    pasted(first["mend"], 1)
    assert kinds_of("mended/measured.csv", folder) == []


def test_two_errors_of_our_own_table_are_corrected_by_one_command(folder):
    level, w, f, v = states()
    first, *_ = checked(table(level, w, f, noisy(v).conj() / 9.80665), folder)
    assert first["kind"] == "conjugated_response"
    assert '--unit "9.80665 m/s" --phase-sign lag' in pasted(first["mend"])
    assert kinds_of("mended/measured.csv", folder) == []


def test_two_errors_of_which_one_needs_the_other_are_corrected_at_once(folder):
    """Amplitudes in g that an import has taken for velocities in m/s."""
    _, w, _, v = states()
    a = noisy(v) * 1j * w / 9.80665
    written("", np.abs(a), np.degrees(np.angle(a)))
    run("import", "lock in.csv", *TOLD, "--response", "Amp:velocity:m/s", "--out", "taken")
    run("check", "taken/measured.csv", "--model", "model.toml", "--out", "checked")
    found = json.loads((folder / "checked" / "check.json").read_text())
    assert [one["kind"] for one in found[:2]] == ["acceleration_as_velocity", "wrong_unit"]
    assert '--unit "9.80665 m/s2" --out' in pasted(found[0]["mend"])
    corrected = sj.read_steady_states("taken/mended/measured.csv")
    np.testing.assert_allclose(corrected.velocity[:, 0], noisy(v), rtol=1e-6)


@pytest.mark.parametrize(
    ("correction", "options"),
    [
        (ImportCorrection(response=9.80665, unit="g"), "--unit g"),
        (ImportCorrection(force=4.4482216, force_unit="lbf"), "--force-unit lbf"),
        (ImportCorrection(force_unit="V"), "--force-unit V"),
        (ImportCorrection(conjugate=True), "--phase-sign lag"),
        (ImportCorrection(phase_unit="rad"), "--phase-unit rad"),
        (ImportCorrection(response=1e-3, unit="mm"), ""),  # no unit of an acceleration
        (ImportCorrection(response=2**0.5), ""),  # nor one by name
        (ImportCorrection(quantity="displacement"), ""),  # which its columns state
    ],
)
def test_options_of_a_laboratorys_files_are_those_of_their_map(correction, options):
    read = pipeline.FilesRead(
        (Path("raw/a.csv"),), Path("raw/map.toml"), ImportMap((ResponseMap("a", "acceleration"),))
    )
    finding = Finding("wrong_unit", "", "", "Again.", (), (correction,))
    (advised,) = pipeline.with_imports(Checkup((finding,)), read).findings
    line = f"snrmjax import raw/a.csv --map raw/map.toml {options} --out raw/mended"
    assert str(advised.advice) == (f"Again: `{line}`." if options else "Again.")


@pytest.mark.long
def test_the_whole_test_runs_on_the_corrected_data(folder):
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
    assert (
        command == 'snrmjax import "raw/lock in.csv" --map raw/map.toml --unit g --out raw/mended'
    )
    assert kinds_of("raw/mended/measured.csv", folder) == []
    run("test", "raw/mended", "--model", "raw/model.toml", "--out", "done", "--no-diagnose")
