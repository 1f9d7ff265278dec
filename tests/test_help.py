"""Help that fits a screen, with an example that runs; completion; where to read more."""

import dataclasses
import os
import pkgutil
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import get_args
from unittest import mock

import numpy as np
import pytest
import typer
from truths.uff_writing import write_uff

import snrmjax as sj
from snrmjax.cli import app, main
from snrmjax.cli.compare_command import METHOD_NAMES
from snrmjax.cli.console import PAGES, SITE_PAGES
from snrmjax.identify.joint.free_unknowns import FREE
from snrmjax.identify.modal.linear_fit import ResidualTerms
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.frequency_responses import frequency_responses
from snrmjax.methods.comparison import METHODS, RECORD_METHODS
from snrmjax.model.moving_base import SensorMotion
from snrmjax.pipelines.options import FAMILY_NAMES, IdentifyOptions, ModesOptions

ROOT = Path(__file__).resolve().parents[1]
NAVIGATION = (ROOT / "notebooks/site/mkdocs.yml").read_text("utf-8").partition("\nnav:")[2]
TITLES = {path: title for title, path in re.findall(r"- (.+): (\S+)\.md", NAVIGATION)}
LINES, COLUMNS = 40, 80
HERTZ = 2 * np.pi
MODEL = """name = "one mode"
[[mode]]
frequency_hz = 79.02
damping_ratio = 0.05
shape = { tip = 11.84338 }
participation = 247.841
[potential]
"1111" = 3.4375e12
"""
BEAM = """name = "beam"
[material]
young_pa = 70e9
density_kg_m3 = 2700
poisson = 0.3
[section]
width_m = 0.02
thickness_m = 0.002
[geometry]
length_m = 0.4
elements = 8
[supports]
left = "clamped"
right = "clamped"
[condense]
modes = [1]
[sensors]
midspan = 0.5
[force]
distribution = "uniform"
"""
STUDY = """name = "damping"
model = "model.toml"
compute = "peaks"
forces_n = [0.001]
from_hz = 60
to_hz = 110
harmonics = 1
vary = [{ parameter = "mode_1.damping_ratio", values = [0.04, 0.05] }]
"""


def leaves(command, words=()):
    """Every command that does something, with the words that call it."""
    if not hasattr(command, "commands"):
        return {words: command}
    return {
        key: leaf
        for name, one in command.commands.items()
        for key, leaf in leaves(one, (*words, name)).items()
    }


COMMANDS = leaves(typer.main.get_command(app))
GROUPS = [(), ("study",)]
# The chain on a whole beam, and a diagnosis, take half a minute.
SLOW = {("demo",), ("test",), ("diagnose",)}


def run(*words):
    with (
        mock.patch.object(sys, "argv", ["snrmjax", *words]),
        pytest.raises(SystemExit) as ended,
    ):
        main()
    return ended.value.code or 0


@pytest.fixture
def printed(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", str(COLUMNS))
    monkeypatch.setenv("NO_COLOR", "1")

    def text(*words):
        assert run(*words) == 0
        return capsys.readouterr().out

    return text


def options_of(text):
    return set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", text))


@pytest.mark.parametrize("words", [*GROUPS, *COMMANDS], ids=" ".join)
def test_help_fits_a_screen(words, printed):
    lines = printed(*words, "--help").splitlines()
    assert len(lines) <= LINES
    assert max(map(len, lines)) <= COLUMNS


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_every_option_is_in_the_long_help_and_what_must_be_stated_in_the_usage(words, printed):
    short, long = (printed(*words, option) for option in ("--help", "--help-all"))
    parameters = COMMANDS[words].params
    for one in parameters:
        assert len(one.help) > 15, one.name
        # A number's unit is said; those of an import name channels.
        if words != ("import",) and one.name.endswith(("_hz", "force")):
            assert re.search(r"\bHz\b|\bN\b", one.help), one.name
    every = {flag for one in parameters for flag in (*one.opts, *one.secondary_opts)}
    assert options_of(long) >= {flag for flag in every if flag.startswith("--")}
    (usage,) = re.findall(r"Usage: (snrmjax [^\n]*\n?[^\n]*?)\s*\n\s*\n", short)
    for one in parameters:
        if one.required:
            assert (one.opts[0] if one.opts[0].startswith("--") else one.metavar) in usage
    shown = options_of(short.replace("help-all", ""))
    left = [one for one in parameters if one.opts[0] in every and not {*one.opts} & shown]
    hidden = [one for one in left if one.opts[0].startswith("--") and one.name != "help_all"]
    assert re.findall(r"(\d+) more options?", short) == ([str(len(hidden))] if hidden else [])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What the examples name: a model and a test of it, a record, responses, a beam, a study."""
    folder = tmp_path_factory.mktemp("examples")
    (folder / "model.toml").write_text(MODEL)
    (folder / "beam.toml").write_text(BEAM)
    (folder / "study.toml").write_text(STUDY)
    modes = sj.read_model(folder / "model.toml").modes
    force = np.repeat([1e-4, 2e-4, 3e-4], 8)
    hertz = np.tile(np.linspace(75.0, 83.0, 8), 3)
    velocity = sj.model.linear_response(modes, HERTZ * hertz, force)[:, 0]
    rows = zip(np.repeat([1, 2, 3], 8), hertz, force, velocity.real, velocity.imag, strict=True)
    lines = ["level,frequency_hz,force_n,velocity_re_m_s,velocity_im_m_s"]
    table = "\n".join(lines + [",".join(map(str, row)) for row in rows])
    (folder / "measured.csv").write_text(table)
    (folder / "measurements").mkdir()
    for name in ("measured.csv", "model.toml"):
        (folder / "measurements" / name).write_text((folder / name).read_text())
    acceleration = 1j * HERTZ * hertz * velocity / 9.80665
    lines = ["frequency_Hz,force_N,acc,phase_deg"]
    columns = (hertz, force, abs(acceleration), np.degrees(np.angle(acceleration)))
    lines += [",".join(map(str, row)) for row in zip(*columns, strict=True)]
    (folder / "test.csv").write_text("\n".join(lines))
    force, sensor = (
        Channel(*of, point="1", direction="+z")
        for of in (("F", "force", "N"), ("A", "acceleration", "m/s^2"))
    )
    lines = HERTZ * np.arange(60.0, 100.0, 0.25)
    mobility = sj.model.linear_response(modes, lines, np.ones(lines.size))[:, 0]
    found = frequency_responses(lines, (1j * lines * mobility)[None, None], [sensor], [force])
    write_uff(folder / "frf.uff", responses=[found])
    return folder


@pytest.mark.parametrize(
    "words",
    [pytest.param(one, marks=pytest.mark.long) if one in SLOW else one for one in COMMANDS],
    ids=" ".join,
)
def test_the_example_of_the_help_runs(words, printed, folder, tmp_path, monkeypatch, capsys):
    (example,) = re.findall(r"Example:\s*\n\s*\n (snrmjax .*)", printed(*words, "--help"))
    work = tmp_path / "work"
    shutil.copytree(folder, work)
    monkeypatch.chdir(work)
    if words == ("study", "report"):
        assert run("study", "run", "study.toml", "--out", "study.zarr") == 0
    program, *arguments = shlex.split(example)
    before = {*work.rglob("*")} - {work / arguments[-1]}
    assert program == "snrmjax"
    assert arguments[: len(words)] == [*words]
    assert run(*arguments) == 0
    assert {*work.rglob("*")} > before
    if words == ("import",):  # which lists what the file holds, and how it becomes measured.csv
        assert "snrmjax import test.csv --force force_N" in capsys.readouterr().out


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_further_examples_are_commands_with_all_that_is_needed(words, printed):
    command = COMMANDS[words]
    for example in command.epilog.split("\n\n"):
        arguments = shlex.split(example)[1 + len(words) :]
        command.make_context(words[-1], arguments, resilient_parsing=False).close()


# ------------------------------------------------------------------------------ completion


def line_to_complete(*words):
    """What a shell sets to ask for the last of these words."""
    line = {"COMP_WORDS": shlex.join(["snrmjax", *words]), "COMP_CWORD": str(len(words))}
    return line | {"_SNRMJAX_COMPLETE": "complete_bash"}


def test_a_shell_completes_commands_options_and_words(monkeypatch, capsys):
    done = subprocess.run(
        [sys.executable, "-m", "snrmjax"],
        env=os.environ | line_to_complete("dia"),
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split() == ["diagnose"]

    def completed(*words):  # in this process, which saves the start of another
        for name, value in line_to_complete(*words).items():
            monkeypatch.setenv(name, value)
        assert run() == 0
        return capsys.readouterr().out.split()

    assert completed("dia") == ["diagnose"]
    assert completed("study", "re") == ["report"]
    assert completed("identify", "--predict-f") == ["--predict-force"]
    assert completed("simulate", "--follow", "p") == [
        *("peak", "phase_resonance", "period_doubling"),
    ]
    assert completed("identify", "--fit", "polynomial,visc") == [
        f"polynomial,viscous_{name}" for name in ("quadratic", "coulomb", "microslip")
    ]
    assert completed("compare", "--method", "con") == ["concerto"]
    assert completed("import", "--phase-sign", "l") == ["lead", "lag"]


def test_the_words_to_complete_are_those_that_are_taken():
    assert {*FAMILY_NAMES} == {"auto", *sj.identify.FAMILIES}
    assert (*METHODS, *RECORD_METHODS) == METHOD_NAMES
    choices = {
        (kind, field.name): field.metadata["option"].choices
        for kind in (IdentifyOptions, ModesOptions)
        for field in dataclasses.fields(kind)
    }
    assert choices[IdentifyOptions, "free"] == FREE
    assert choices[ModesOptions, "residual_terms"] == get_args(ResidualTerms)
    assert choices[ModesOptions, "base"] == get_args(SensorMotion)


@pytest.mark.parametrize(
    ("shell", "file"),
    [
        ("bash", ".bash_completions/snrmjax.sh"),
        ("zsh", ".zfunc/_snrmjax"),
        ("fish", ".config/fish/completions/snrmjax.fish"),
    ],
)
def test_completion_is_installed_in_a_fresh_home(shell, file, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("HOME", str(tmp_path))
    # Of typer: a shell is named in place of that which started the program.
    monkeypatch.setenv("_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION", "1")
    assert run("--install-completion", shell) == 0
    capsys.readouterr()
    assert run("--show-completion", shell) == 0
    shown = capsys.readouterr().out
    assert shown.strip() == (tmp_path / file).read_text().strip()
    assert f"_SNRMJAX_COMPLETE=complete_{shell}" in shown


# ------------------------------------------------------------------------------ read more

REFUSED = {
    "formats": "identify lacking.csv --model model.toml --out out",
    "how-to/import": "import test.csv --force load --response acc:acceleration:g --out out",
    "how-to/element": "nnm matrices.toml --to-hz 90 --out out",
    "how-to/shaker-table": "identify measured.csv --model base.toml --out out",
    "how-to/uncertain-force": "identify peaks.csv --model model.toml --free force_gain --out out",
    "how-to/diagnose": "diagnose few.csv --model model.toml --out out",
    "how-to/reduced-model": "rom model.toml --out out",
    "how-to/study": "study run model.toml --out out",
    "how-to/own-effect": "nnm model.toml --to-hz 90 --effects model.toml --out out",
    "": "identify absent.csv --model model.toml --out out",
}


@pytest.mark.parametrize("page", REFUSED, ids=str)
def test_a_refusal_names_the_page_that_says_more(page, folder, tmp_path, monkeypatch, capsys):
    work = tmp_path / "work"
    shutil.copytree(folder, work)
    monkeypatch.chdir(work)
    header, *rows = (work / "measured.csv").read_text().splitlines()
    (work / "lacking.csv").write_text("\n".join(row.rpartition(",")[0] for row in (header, *rows)))
    (work / "few.csv").write_text("\n".join((header, *rows[:2])))
    peaks = [row for row in rows if 78.5 < float(row.split(",")[1]) < 80.0]
    (work / "peaks.csv").write_text("\n".join((header, *peaks)))
    (work / "base.toml").write_text(f'{MODEL}[base]\nmotion = "absolute"\n')
    (work / "matrices.toml").write_text('name = "m"\n[structure]\npoints = ["a"]\nmass = [[1.0]]\n')
    before = {*work.rglob("*")}
    assert run(*REFUSED[page].split()) == 2
    first, *others = capsys.readouterr().err.splitlines()
    assert first.startswith("error: ")
    assert others == (
        [f'read more: the page "{TITLES[page]}" ({SITE_PAGES}/{page}.md)'] if page else []
    )
    assert {*work.rglob("*")} == before


def test_every_page_that_refusals_name_is_in_the_navigation():
    named = {page for page in PAGES.values() if page is not None}
    assert named <= {(title, path) for path, title in TITLES.items()}
    assert all((ROOT / SITE_PAGES / f"{path}.md").is_file() for _, path in named)
    for part in PAGES:  # none is left over from a part that has moved
        pkgutil.resolve_name(f"snrmjax.{part}")
