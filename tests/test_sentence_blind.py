"""Numbers, verdicts and exit codes do not hang on how anything is worded."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from truths.one_mode import model, noisy, states, table
from typer.testing import CliRunner

import snrmjax as sj
from snrmjax.cli import app
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.status import Status

COMMANDS = {
    "points": ("identify", "states.csv", "--model", "model.toml", "--predict-force", "1"),
    "joint": ("identify", "states.csv", "--model", "model.toml", "--fit", "auto", "--next", "2"),
    "wrong": ("check", "conjugated.csv", "--model", "model.toml"),
    "diagnose": ("diagnose", "states.csv", "--model", "model.toml", "--no-responses"),
    "compare": ("compare", "states.csv", "--model", "model.toml"),
    "modes": ("modes", "states.csv", "--unscaled", "--poles", "60"),
    "simulate": ("simulate", "model.toml", "--force", "1", "--from-hz", "45", "--to-hz", "55"),
    "test": ("test", "raw", "--no-diagnose"),
    "stopped": ("test", "stopped"),
}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("blind")
    level, w, f, v = states()
    data = table(level, w, f, noisy(v))
    for name in ("raw", "stopped"):
        (folder / name).mkdir()
        sj.io.write_model(folder / name / "model.toml", model())
    sj.io.write_model(folder / "model.toml", model())
    sj.io.write_steady_states(folder / "states.csv", data)
    sj.io.write_steady_states(folder / "raw" / "states.csv", data)
    for name in ("conjugated.csv", "stopped/states.csv"):
        sj.io.write_steady_states(folder / name, table(level, w, f, np.conj(noisy(v))))
    return folder


def results(files, out, name):
    """Exit code, and the numbers in all files but for their texts."""
    command, first, *others = COMMANDS[name]
    model_file = str(files / "model.toml")
    others = [model_file if word == "model.toml" else word for word in others]
    place = out / "model.toml" if name == "modes" else out
    out.mkdir()
    words = [command, str(files / first), *others, "--out", str(place)]
    done = CliRunner().invoke(app, words)
    found = {path.relative_to(out): numbers(path) for path in sorted(out.rglob("*.*"))}
    return found | {"exit": (done.exit_code, type(done.exception))}


def numbers(path: Path):
    """All numbers and keys of a JSON or CSV file."""
    if path.suffix == ".json":
        return without_texts(json.loads(path.read_text()))
    if path.suffix == ".csv":
        return [
            [one for one in row if is_number(one)]
            for row in csv.reader(path.read_text().splitlines())
        ]
    return ""


def without_texts(of):
    if isinstance(of, dict):
        return {key: without_texts(value) for key, value in of.items()}
    if isinstance(of, list):
        return [without_texts(one) for one in of if not isinstance(one, str)]
    return "" if isinstance(of, str) else of


def is_number(text):
    try:
        float(text)
    except ValueError:
        return False
    return True


LIGHT = ("wrong", "diagnose", "stopped")
pytestmark = pytest.mark.usefixtures("optimised")  # whole searches, of which each runs twice


@pytest.mark.parametrize(
    "name", [one if one in LIGHT else pytest.param(one, marks=pytest.mark.long) for one in COMMANDS]
)
def test_results_are_the_same_where_every_sentence_is_x(files, tmp_path, monkeypatch, name):
    read = results(files, tmp_path / "read", name)
    assert read["exit"] == ((1, InputError) if name == "stopped" else (0, type(None)))
    assert (len(read) > 1) == (name != "stopped")
    monkeypatch.setattr("snrmjax.report.sentences.sentence", lambda fact: "x")
    monkeypatch.setattr("snrmjax.report.printed.screen_of", lambda result: "x")
    for kind in Status.__subclasses__():
        for member in kind:
            monkeypatch.setattr(member, "message", "x")
    assert results(files, tmp_path / "blind", name) == read
