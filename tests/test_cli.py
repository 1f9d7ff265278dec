"""The commands as a user runs them: files out, exit codes, one sentence for wrong input."""

import csv
import inspect
import io
import json
import math
import os
import re
import subprocess
import sys
from contextlib import redirect_stderr
from pathlib import Path
from typing import NamedTuple, get_args
from unittest import mock

import numpy as np
import pytest
import typer
from matplotlib.figure import Figure
from truths.exact_states import CONSTANT, TRUE, damping, exact, modes, noisy, squared

import snrmjax as sj
from snrmjax import cli
from snrmjax.cli import app, main, simulate_commands
from snrmjax.io import tables
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ
from snrmjax.report.style import png_bytes
from snrmjax.simulate.continuation import event_equations

COMMANDS = ("demo", "simulate", "nnm", "identify", "diagnose")
FAMILIES = f"{TRUE['backbone']},{TRUE['damping']}"
MODEL = """name = "test mode"
[[mode]]
frequency_hz = 64.78
damping_ratio = 0.05
shape = { midspan = 12.77433 }
participation = 3341.536
[potential]
"111" = -1.146e9
"1111" = 4.6637e12
"""
HEADER = "level,frequency_hz,force_n,velocity_re_m_s,velocity_im_m_s\n"


def linear_row(level: int, force: float, hertz: float) -> str:
    """A state of the linear mode by Eq. (23), in plain Python."""
    omega, natural = 2 * math.pi * hertz, 2 * math.pi * 64.78
    dynamic = natural**2 - omega**2 + 2j * 0.05 * natural * omega
    velocity = 1j * omega * 12.77433 * 3341.536 * force / dynamic
    return f"{level},{hertz},{force},{velocity.real!r},{velocity.imag!r}\n"


ROWS = "".join(
    linear_row(level, force, hertz)
    for level, force in ((1, 1e-5), (2, 2e-5))
    for hertz in (62, 63, 64, 65, 66)
)


class Ended(NamedTuple):
    """How a command ended."""

    code: int
    stderr: str


def run(*arguments: object) -> Ended:
    """A command in this process, which saves the import."""
    words = ["snrmjax", *map(str, arguments)]
    with (
        redirect_stderr(io.StringIO()) as stderr,
        mock.patch.object(sys, "argv", words),
        pytest.raises(SystemExit) as ended,
    ):
        main()
    return Ended(ended.value.code or 0, stderr.getvalue())


def run_in_a_process(*arguments: object) -> Ended:
    """A command as a shell starts it."""
    done = subprocess.run(
        [sys.executable, "-m", "snrmjax", *map(str, arguments)],
        env=os.environ | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    return Ended(done.returncode, done.stderr)


@pytest.fixture(autouse=True, scope="module")
def drawn():
    """Figures are drawn in the tests of figures: here every file is the same small one."""
    dot = png_bytes(Figure(figsize=(1, 1)))
    with mock.patch.object(Figure, "savefig", lambda _, buffer, **__: buffer.write(dot)):
        yield


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    model, data = tmp_path / "model.toml", tmp_path / "data.csv"
    model.write_text(MODEL)
    data.write_text(HEADER + ROWS)
    return model, data


def columns(path: Path) -> list[str]:
    with path.open() as file:
        return next(csv.reader(file))


def test_identify_writes_the_files_of_the_contract(files, tmp_path):
    model, data = files
    out = tmp_path / "out"
    done = run(
        "identify", str(data), "--model", str(model), "--out", str(out), "--predict-force", "1e-5"
    )
    assert done.code == 0, done.stderr
    assert columns(out / "points.csv") == [
        "level",
        "frequency_hz",
        "force_n",
        "velocity_m_s",
        "phase_deg",
        "nnmai",
        "natural_frequency_hz",
        "natural_frequency_std_hz",
        "damping_ratio",
        "damping_ratio_std",
        "backbone_velocity_m_s",
        "status",
    ]
    assert columns(out / "backbone.csv") == [
        "velocity_m_s",
        "natural_frequency_hz",
        "natural_frequency_std_hz",
        "damping_ratio",
        "damping_ratio_std",
    ]
    assert columns(out / "prediction.csv") == [
        "force_n",
        "point",
        "frequency_hz",
        "velocity_re_m_s",
        "velocity_im_m_s",
        "stable",
    ]
    summary = json.loads((out / "summary.json").read_text())
    (resonance,) = summary["resonances"]
    # The states are exact and linear; noise is taken to be 1e-5 at least.
    assert resonance["frequency_hz"] == pytest.approx(64.78, rel=1e-7)
    assert resonance["damping_ratio"] == pytest.approx(0.05, rel=3e-5)
    assert (out / "report.html").exists()
    assert (out / "backbone.png").read_bytes()[:4] == b"\x89PNG"
    ends = re.search(r"backbone: (\S+) ± (\S+) Hz and (\S+) ± (\S+) % of critical", done.stderr)
    assert ends is not None, done.stderr
    assert abs(float(ends[1]) - 64.78) <= float(ends[2])
    assert abs(float(ends[3]) - 5) <= float(ends[4])
    assert "resonance at 1e-05 N: 64.78 Hz, " in done.stderr


def test_simulate_and_nnm_write_the_files_of_the_contract(files, tmp_path):
    model, _ = files
    out = tmp_path / "out"
    done = run(
        *("simulate", str(model), "--force", "1e-4", "--from-hz", "50", "--to-hz", "80"),
        *("--harmonics", "3", "--out", str(out)),
    )
    assert done.code == 0, done.stderr
    assert columns(out / "response.csv") == [
        "force_n",
        "point",
        "frequency_hz",
        "velocity_h1_re_m_s",
        "velocity_h1_im_m_s",
        "velocity_peak_m_s",
        "stable",
        "event",
    ]
    assert not (out / "events.csv").exists()
    assert get_args(simulate_commands.EventKind) == get_args(event_equations.EventKind)
    done = run(
        *("simulate", str(model), "--force", "1e-4", "--from-hz", "50", "--to-hz", "80"),
        *("--follow", "peak", "--to", "2e-4"),
        *("--harmonics", "3", "--out", str(out)),
    )
    assert done.code == 0, done.stderr
    assert "peak over force: " in done.stderr
    assert columns(out / "events.csv") == [
        *("curve", "kind", "parameter", "value", "force_n", "frequency_hz"),
        *("velocity_h1_re_m_s", "velocity_h1_im_m_s", "velocity_peak_m_s", "event"),
    ]
    assert (out / "events.png").read_bytes()[:4] == b"\x89PNG"
    done = run(
        *("nnm", str(model), "--to-hz", "60", "--harmonics", "3", "--out", str(out)),
    )
    assert done.code == 0, done.stderr
    assert columns(out / "nnm.csv") == [
        "point",
        "frequency_hz",
        "velocity_h1_m_s",
        "velocity_peak_m_s",
        "energy_j",
        "stable",
        "internal_resonance",
    ]


BAD_DATA = {
    "missing column": (HEADER.replace("force_n,", "") + "1,60.0,0.1,0.0\n", "force_n"),
    "text in a number": (HEADER + "1,64,abc,0.01,0\n", "abc"),
    "negative frequency": (HEADER + "1,-64,1e-5,0.01,0\n", "-64"),
    "empty file": ("", "empty"),
    "thousands separator": (HEADER + '1,"1,064",1e-5,0.01,0\n', "1,064"),
}


@pytest.mark.parametrize("name", BAD_DATA)
def test_wrong_data_ends_with_two_and_one_sentence(files, tmp_path, name):
    model, data = files
    text, named = BAD_DATA[name]
    data.write_text(text)
    out = tmp_path / "out"
    code, stderr = run("identify", str(data), "--model", str(model), "--out", str(out))
    assert code == 2
    assert "Traceback" not in stderr
    (line,) = [one for one in stderr.splitlines() if one.startswith("error: ")]
    assert "data.csv" in line
    assert named in line
    assert not out.exists()


EFFECT = '[[effect]]\nkind = "{kind}"\n{entries}\n'
WRONG_MODELS = {
    "unknown kind": EFFECT.format(kind="coulomb", entries="force = 1.0"),
    "missing parameter": EFFECT.format(kind="one_sided_stop", entries="gap = 1.0"),
    "wrong number": EFFECT.format(kind="one_sided_stop", entries="gap = 1.0\nstiffness = 'stiff'"),
    "unknown point": EFFECT.format(
        kind="one_sided_stop", entries='gap = 1.0\nstiffness_n_per_m = 1.0\nat = "tip"'
    ),
    "other name": EFFECT.format(
        kind="one_sided_stop", entries='gap_m = 1.0\nstiffness = 1.0\nat = "midspan"'
    ),
    "unknown mode": '[[vary]]\nparameter = "mode_1.damping_ratio"',
}


@pytest.mark.parametrize("name", WRONG_MODELS)
def test_a_refusal_names_the_file_once(files, tmp_path, name):
    model, _ = files
    model.write_text(MODEL + WRONG_MODELS[name])
    code, stderr = run("nnm", model, "--to-hz", 80, "--out", tmp_path / "out")
    assert code == 2
    (line,) = [one for one in stderr.splitlines() if one.startswith("error: ")]
    assert line.count("model.toml") == 1
    assert line.count("error") == 1


def test_a_refusal_is_located_once():
    first = InputError.located("beam.toml", "the mesh has 3 modes.")
    assert str(first) == "beam.toml: the mesh has 3 modes."
    assert str(InputError.located("beam.toml", first)) == str(first)
    assert str(InputError.located("beam.toml", "row 3 of beam.toml is empty.")).count("beam") == 1


def test_a_wrong_model_ends_with_two(files, tmp_path):
    model, data = files
    model.write_text(MODEL.replace("damping_ratio", "dampng_ratio"))
    out = tmp_path / "out"
    code, stderr = run("identify", str(data), "--model", str(model), "--out", str(out))
    assert code == 2
    assert re.search(r"dampng_ratio.*damping_ratio", stderr)
    assert not out.exists()


@pytest.mark.parametrize(
    ("command", "named"),
    [
        (("simulate", "--force", 1, "--from-hz", 80, "--to-hz", 50), ("--from-hz", "80 and 50 Hz")),
        (("simulate", "--force", -1, "--from-hz", 50, "--to-hz", 80), ("--force", "-1 N")),
        (
            ("simulate", "--force", 1, "--from-hz", 50, "--to-hz", 80, "--follow", "fold"),
            ("--follow", "--to"),
        ),
        (
            ("simulate", "--force", 1, "--from-hz", 50, "--to-hz", 80, "--to", 2),
            ("--parameter", "--follow"),
        ),
        (("nnm", "--to-hz", -5), ("--to-hz", "-5 Hz")),
        (("nnm", "--to-hz", 64.78), ("--to-hz", "64.78 Hz")),
        (("identify", "--predict-force", 0), ("--predict-force", "0 N")),
    ],
    ids=lambda value: " ".join(map(str, value)),
)
def test_a_wrong_number_ends_with_two_in_the_units_of_the_option(files, tmp_path, command, named):
    model, data = files
    name, *options = command
    where = [data, "--model", model] if name == "identify" else [model]
    done = run(name, *where, *options, "--out", tmp_path / "out")
    assert done.code == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ")
    assert all(word in line for word in named)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("option", "named"),
    [
        (("--fit", "cubic"), "cubic"),
        (("--fit", "spline,spline,spline"), "3"),
        (("--free", "phase"), "instrument_phase"),
        (("--free", "force_gain,phase"), "'phase'"),
    ],
)
def test_a_wrong_joint_fit_ends_with_two(files, tmp_path, option, named):
    model, data = files
    out = tmp_path / "out"
    code, stderr = run("identify", str(data), "--model", str(model), "--out", str(out), *option)
    assert code == 2
    assert "Traceback" not in stderr
    assert named in stderr
    assert not out.exists()


def test_diagnose_writes_the_verdict_the_model_and_the_report(tmp_path):
    blind = Path(__file__).parent / "diagnose" / "blind" / "blind_03"
    out = tmp_path / "out"
    table, model = (str(blind.with_suffix(suffix)) for suffix in (".csv", ".toml"))
    done = run("diagnose", table, "--model", model, "--out", out)
    assert done.code == 0
    answer = json.loads((out / "diagnosis.json").read_text())
    assert answer["verdict"] == "none"
    assert answer["effects"] == answer["candidates"] == []
    assert answer["decide_by"] is None
    assert set(answer["gap"]) >= {
        "before",
        "after",
        "held_out_before",
        "held_out_after",
        "noise_floor",
    }
    assert (out / "model.toml").read_text().startswith("name")
    assert (out / "report.html").stat().st_size > 1000
    assert list(out.glob("*.png"))
    assert "blind_03.csv: none\n" in done.stderr
    assert "No missing effect is detected in these data" in done.stderr


def test_diagnose_refuses_too_few_states(files, tmp_path):
    model, data = files
    data.write_text(HEADER + "".join(ROWS.splitlines(keepends=True)[:4]))
    out = tmp_path / "out"
    code, stderr = run("diagnose", str(data), "--model", str(model), "--out", str(out))
    assert code == 2
    assert "at least 6" in stderr


@pytest.mark.parametrize("load", ["force_n", "drive_v"])
@pytest.mark.parametrize("options", [(), ("--fit", "auto"), ("--free", "force_gain")])
def test_identify_sends_amplitudes_alone_to_diagnose(files, tmp_path, load, options):
    model, data = files
    data.write_text(f"level,frequency_hz,{load},velocity_m_s\n1,62,1e-5,0.01\n1,63,1e-5,0.02\n")
    out = tmp_path / "out"
    code, stderr = run("identify", data, "--model", model, "--out", out, *options)
    assert code == 2
    assert "needs the phases" in stderr
    assert "velocity_m_s" in stderr
    assert "snrmjax diagnose" in stderr
    assert not out.exists()


# ------------------------------------------------------------------------------ smoke


@pytest.mark.parametrize(
    ("command", "written"),
    [
        pytest.param(
            ("simulate", "--force", "1e-4", "--from-hz", "60", "--to-hz", "70"),
            "response.csv",
            marks=pytest.mark.long,
        ),
        pytest.param(("nnm", "--help"), None, marks=pytest.mark.long),
        (("identify", "--help"), None),
        pytest.param(("diagnose",), None, marks=pytest.mark.long),
        pytest.param(("demo", "--help"), None, marks=pytest.mark.long),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_each_command_starts_in_a_process_of_its_own(files, tmp_path, command, written):
    model, data = files
    name, *options = command
    out = tmp_path / "out"
    if name == "simulate":
        options = [model, *options, "--harmonics", "1", "--out", out]
    elif options != ["--help"]:
        options = [data, "--model", model, "--out", out]
    if name == "diagnose":  # whose whole run is a test of its own: here it refuses
        data.write_text(HEADER + "".join(ROWS.splitlines(keepends=True)[:4]))
    done = run_in_a_process(name, *options)
    assert done.code == (2 if name == "diagnose" else 0), done.stderr
    assert "Traceback" not in done.stderr
    assert written is None or (out / written).stat().st_size > 100


# ------------------------------------------------------------------------------ options


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--robust",), ("--robust", "--fit auto")),
        (("--fit", "auto", "--knots", "5"), ("--knots", "--fit spline:5")),
        (("--free", "force_gain", "--knots", "5"), ("--knots", "--free", "--fit spline:5")),
        (("--next", "2", "--amplitude", "velocity"), ("--amplitude", "--next", "@velocity")),
        (("--fit", "auto", "--measure", "peak"), ("--measure", "--fit", "fundamental")),
        (("--extrapolate", "2"), ("--extrapolate", "--predict-force")),
        (("--day-std", "0.1"), ("--day-std", "--predict-force")),
        (("--self-excited",), ("--self-excited", "--predict-force")),
        (("--day-std", "5 %", "--predict-force", "1e-5"), ("--day-std", "FREQUENCY", "'5 %'")),
        (("--predict-drive", "0.1"), ("--predict-drive", "--predict-force", "force_n")),
    ],
    ids=lambda value: " ".join(value),
)
def test_an_option_without_effect_is_refused(files, tmp_path, options, named):
    model, data = files
    done = run("identify", data, "--model", model, "--out", tmp_path / "out", *options)
    assert done.code == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ")
    for word in named:
        assert word in line
    assert not (tmp_path / "out").exists()


def test_every_option_of_identify_is_joined_to_the_others_or_tried_here(files, tmp_path):
    """A new option must be assigned to one way of identification, or to both."""
    command = typer.main.get_command(app).commands["identify"]
    both = {"data", "model", "out", "predict_force", "predict_drive", "extrapolate", "help_all"}
    both |= {"axis", "day_std", "self_excited", "predict_at", "modes", "effects"}
    points = {"amplitude", "measure", "knots"}
    joint = {"fit", "free", "robust", "further"}
    assert {one.name for one in command.params} == both | points | joint


# ------------------------------------------------------------------------------ joint fits


@pytest.fixture(scope="module")
def beam(tmp_path_factory) -> tuple[Path, Path, Path]:
    """A model, states on its known curves, and the same with the drive voltage alone."""
    folder = tmp_path_factory.mktemp("beam")
    files = folder / "model.toml", folder / "data.csv", folder / "driven.csv"
    sj.io.write_model(files[0], sj.model.structure(modes()))
    sj.io.write_steady_states(files[1], noisy())
    level, omega, force, velocity = exact()
    driven = sj.measure.steady_states(
        *(level, omega, np.full(len(level), np.nan), velocity),
        velocity_std=0.01 * np.abs(velocity),
        phase_std=np.full((len(level), 1), 0.012),
        drive=force / GAIN,
    )
    sj.io.write_steady_states(files[2], driven)
    return files


GAIN = 0.4  # N/V


@pytest.fixture(scope="module")
def fitted(beam, tmp_path_factory):
    """What a joint fit writes: the folder, every table."""
    model, data, _ = beam
    out = tmp_path_factory.mktemp("fitted")
    written = []
    with pytest.MonkeyPatch.context() as patch:
        kept = tables.write_atomically

        def counted(path, content):
            written.append(Path(path).name)
            kept(path, content)

        patch.setattr(tables, "write_atomically", counted)
        options = ("--fit", FAMILIES, "--predict-force", "1", "--predict-force", "4", "--next", "2")
        done = run("identify", data, "--model", model, "--out", out, *options)
    assert done.code == 0, done.stderr
    return out, written


def rows(path: Path) -> dict[str, np.ndarray]:
    """Columns of numbers of a table."""
    with path.open() as file:
        table = list(csv.DictReader(file))
    names = [name for name in table[0] if name not in ("status", "reason")]
    return {name: np.array([float(row[name]) for row in table]) for name in names}


def test_a_joint_fit_writes_the_files_of_the_contract(fitted):
    out, _ = fitted
    assert columns(out / "next.csv") == [
        "rank",
        "force_n",
        "frequency_hz",
        "expected_band_ratio",
        "reason",
    ]
    table = rows(out / "backbone.csv")
    speed, omega = table["velocity_m_s"], HERTZ * table["natural_frequency_hz"]
    assert len(speed) == 200
    assert speed[0] == 0
    # The states are exact; what is left is the end of the solver.
    np.testing.assert_allclose(omega**2, squared(speed / omega), rtol=1e-6)
    np.testing.assert_allclose(
        2 * table["damping_ratio"][1:] * omega[1:], damping(speed[1:]), rtol=1e-6
    )
    fit = json.loads((out / "summary.json").read_text())["joint_fit"]
    assert set(fit["parameters"]) == {
        *("backbone.at_zero", "backbone.power_2"),
        *("damping.viscous", "damping.quadratic"),
    }
    assert fit["parameters"]["damping.viscous"]["value"] == pytest.approx(damping(0.0), rel=1e-6)
    assert len(fit["covariance"]) == 4
    assert (out / "fit.json").exists()
    for name in ("joint_fit", "residuals", "contributions", "next"):
        assert (out / f"{name}.png").exists()
    for fraction in ("frequency_fraction", "damping_fraction"):
        assert sum(row[fraction] for row in fit["contributions"]) == pytest.approx(1, rel=1e-9)
    html = (out / "report.html").read_text()
    for heading in ("Joint fit", "Contributions to the bands", "What to measure next"):
        assert f"<h2>{heading}</h2>" in html
    with (out / "next.csv").open() as file:
        reasons = [row["reason"] for row in csv.DictReader(file)]
    for reason in reasons:
        # The report has the expected velocity and phase in columns of their own.
        expected, _, gain = reason.partition(": ")
        assert re.fullmatch(r"expected \S+ m/s, (\d+° (lead|lag)|resonance)", expected)
        assert re.fullmatch(r"the (natural frequency|damping) band becomes \S+ % narrower", gain)
        assert gain in html


def test_each_table_of_a_joint_fit_is_written_once(fitted):
    _, written = fitted
    assert sorted(written) == ["backbone.csv", "next.csv", "points.csv", "prediction.csv"]


def test_a_prediction_gives_the_resonance_of_a_new_level(fitted):
    out, _ = fitted
    summary = json.loads((out / "summary.json").read_text())
    for tip, one in zip(summary["resonances"], summary["resonance_distributions"], strict=True):
        assert one["force_n"] == tip["force_n"]
        assert (one["probability"], one["negative_damping"]) == (1.0, 0.0)
        assert one["quantiles"] == [0.025, 0.16, 0.5, 0.84, 0.975]
        assert one["holds"] == "a further level's errors"
        for name in ("frequency_hz", "velocity_m_s"):
            low, *_, high = one[name]
            # Exact states: the curves, drawn at 200 amplitudes, are known to their ripple.
            assert low * (1 - 1e-4) <= tip[name] <= high * (1 + 1e-4)
    assert "95 % " in (out / "report.html").read_text()
    table = rows(out / "prediction.csv")
    assert np.all(table["velocity_std_m_s"] >= 0)


def test_predictions_of_a_joint_fit_lie_on_its_own_curves(fitted):
    out, _ = fitted
    found = rows(out / "prediction.csv")
    omega, force = HERTZ * found["frequency_hz"], found["force_n"]
    velocity = found["velocity_re_m_s"] + 1j * found["velocity_im_m_s"]
    x = np.abs(velocity) / omega
    needed = squared(x) - omega**2 + 1j * omega * damping(np.abs(velocity))
    left = np.abs(needed * velocity / (1j * omega * CONSTANT) - force) / force
    # The states are exact, and the table has 12 digits; curves drawn anew through knots miss by
    # a hundred times as much. Relative to a force at resonance ω̃²/(Ωδ) is about 40.
    assert set(force) == {1.0, 4.0}
    assert left.max() < 1e-6
    summary = json.loads((out / "summary.json").read_text())
    for one, with_band in zip(
        summary["resonances"], summary["joint_fit"]["resonances"], strict=True
    ):
        assert one["frequency_hz"] == with_band["frequency_hz"]
        omega = HERTZ * one["frequency_hz"]
        x = one["velocity_m_s"] / omega
        assert omega**2 == pytest.approx(squared(x), rel=1e-8)
        ratio = damping(one["velocity_m_s"]) / (2 * omega)
        assert one["damping_ratio"] == pytest.approx(ratio, rel=1e-7)
    backbone = summary["backbone"]
    x = 2e-3 * np.array([0, 1])
    largest = np.sqrt(squared(x[1])) / HERTZ
    assert backbone["natural_frequency_hz"][1] == pytest.approx(largest, rel=1e-9)


@pytest.mark.long
def test_notes_on_single_states_reach_the_reader_of_a_joint_fit(files, tmp_path):
    model, data = files
    # Far above resonance a degree of phase makes damping negative: that state has no point.
    level, *others = linear_row(2, 2e-5, 100.0).split(",")
    omega, force, real, imaginary = map(float, others)
    rotated = complex(complex(real, imaginary) * np.exp(-0.2j))
    data.write_text(HEADER + ROWS + f"{level},{omega},{force},{rotated.real!r},{rotated.imag!r}\n")
    out = tmp_path / "out"
    done = run("identify", data, "--model", model, "--out", out, "--fit", "polynomial:1,constant")
    assert done.code == 0, done.stderr
    notes = json.loads((out / "summary.json").read_text())["notes"]
    for text in (done.stderr, " ".join(notes), (out / "report.html").read_text()):
        assert "1 of 11 steady states give no point of their own" in text


@pytest.mark.long
def test_a_fit_without_a_state_to_advise_is_written_all_the_same(files, tmp_path):
    model, data = files
    # 80° from resonance on either side: closer states have amplitudes beyond the measured ones.
    data.write_text(
        HEADER
        + "".join(
            linear_row(level, 1e-5, hertz) for level in (1, 2) for hertz in (48, 49, 50, 80, 82, 84)
        )
    )
    out = tmp_path / "out"
    options = ("--fit", "polynomial:1,constant", "--next", "2")
    done = run("identify", data, "--model", model, "--out", out, *options)
    assert done.code == 0, done.stderr
    assert (out / "next.csv").read_text().splitlines() == [
        "rank,force_n,frequency_hz,expected_band_ratio,reason"
    ]
    assert "0 of 2 further measurements" in done.stderr
    assert "0 of 2 further measurements" in (out / "report.html").read_text()
    assert rows(out / "backbone.csv")["natural_frequency_hz"][-1] == pytest.approx(64.78, rel=1e-5)


# ------------------------------------------------------------------------------ drive voltage


def test_without_a_joint_fit_a_drive_voltage_is_refused_with_the_remedy(beam, tmp_path):
    model, _, driven = beam
    done = run("identify", driven, "--model", model, "--out", tmp_path / "out")
    assert done.code == 2
    assert "--free force_gain" in done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_with_a_drive_voltage_predictions_and_advice_are_in_volts(beam, tmp_path):
    model, _, driven = beam
    options = ["--fit", FAMILIES, "--next", "2", "--predict-drive", "4", "--predict-force", "2"]
    options += ["--predict-drive", "30", "--extrapolate", "2.5"]
    done = run("identify", driven, "--model", model, "--out", tmp_path, *options)
    assert done.code == 0, done.stderr
    found = rows(tmp_path / "prediction.csv")
    assert set(found["drive_v"].round(5)) == {2 / GAIN, 4.0, 30.0}
    np.testing.assert_allclose(found["force_n"], GAIN * found["drive_v"], rtol=1e-6)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert [one["beyond_the_data"] for one in summary["resonances"]] == [False, False, True]
    for one in summary["resonances"]:
        speed = one["velocity_m_s"]
        # At resonance the force is the damping's: F = 2ζ̃ω̃ v/A.
        assert GAIN * one["drive_v"] == pytest.approx(damping(speed) * speed / CONSTANT, rel=1e-6)
    advised = rows(tmp_path / "next.csv")
    np.testing.assert_allclose(advised["force_n"], GAIN * advised["drive_v"], rtol=1e-6)
    advice = [line for line in done.stderr.splitlines() if line.startswith("measure next, ")]
    assert len(advice) == 2
    assert all(
        re.match(r"measure next, \d: drive \S+ V, \S+ Hz \(expected ", line) for line in advice
    )
    assert "0.4 N/V" in done.stderr


# ------------------------------------------------------------------------------ extrapolation


@pytest.mark.long
def test_predictions_extend_as_far_as_requested(files, tmp_path):
    model, data = files
    command = ("identify", data, "--model", model, "--out", tmp_path)
    options = ("--predict-force", "8e-5")  # four times the largest, like a linear resonance
    done = run(*command, *options)
    assert done.code == 0, done.stderr
    assert json.loads((tmp_path / "summary.json").read_text())["resonances"] == []
    assert "--extrapolate" in done.stderr
    done = run(*command, *options, "--extrapolate", "5")
    (one,) = json.loads((tmp_path / "summary.json").read_text())["resonances"]
    assert one["frequency_hz"] == pytest.approx(64.78, rel=1e-6)
    assert one["beyond_the_data"]
    assert "extrapolate" in done.stderr


# ------------------------------------------------------------------------------ writers


def test_every_writer_takes_the_path_first():
    writers = [getattr(sj.io, name) for name in sj.io.__all__ if name.startswith("write_")]
    writers.append(sj.plot.save_figure)
    assert len(writers) >= 4
    for writer in writers:
        first, second, *others = inspect.signature(writer).parameters.values()
        assert first.name == "path", writer
        assert second.default is inspect.Parameter.empty
        assert all(other.kind is inspect.Parameter.KEYWORD_ONLY for other in others), writer


def phases_changed(data: Path, change) -> Path:
    """Writes the rows again with real and imaginary part of the velocity changed."""
    rows = [line.split(",") for line in data.read_text().splitlines()[1:]]
    lines = [[*row[:3], *map(repr, change(float(row[3]), float(row[4])))] for row in rows]
    data.write_text(HEADER + "".join(",".join(line) + "\n" for line in lines))
    return data


CONJUGATED = (
    "seem to be conjugated (time dependence e^(-iΩt)); change the sign of `velocity_im_m_s`"
)


@pytest.mark.parametrize("command", ["identify", pytest.param("diagnose", marks=pytest.mark.long)])
def test_conjugated_phases_are_named_in_a_note(files, tmp_path, command):
    model, data = files
    phases_changed(data, lambda re, im: (re, -im))
    settings = ["--no-responses"] if command == "diagnose" else []
    done = run(command, data, "--model", model, "--out", tmp_path / "out", *settings)
    assert done.code == 0, done.stderr
    name = "summary.json" if command == "identify" else "diagnosis.json"
    assert CONJUGATED in json.loads((tmp_path / "out" / name).read_text())["notes"][0]
    assert CONJUGATED in " ".join(done.stderr.split())


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda re, im: (-re, -im), "shift the phases by 180°"),
        (lambda re, im: (im / 402, -re / 402), "displacements seem to be given as velocities"),
    ],
)
def test_phases_with_which_nothing_can_be_solved_are_named_in_the_error(
    files, tmp_path, change, named
):
    model, data = files
    done = run("identify", phases_changed(data, change), "--model", model, "--out", tmp_path / "o")
    assert done.code == 2
    assert named in " ".join(done.stderr.split())
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    ("error", "code", "printed"),
    [
        (InputError("`force_n` is missing."), 2, "error: `force_n` is missing."),
        (ValueError("operands could not be broadcast together"), 1, "an error of snrmjax"),
        (KeyError("mode"), 1, "an error of snrmjax"),
    ],
)
def test_only_refusals_blame_the_input(error, code, printed, monkeypatch, capsys):
    def command(**_):
        raise error

    monkeypatch.setattr(cli, "app", command)
    monkeypatch.setattr(sys, "argv", ["snrmjax", "--help"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    out = "".join(capsys.readouterr())
    assert ended.value.code == code
    assert printed in " ".join(out.split())
    assert ("Traceback" in out) == (code == 1)
