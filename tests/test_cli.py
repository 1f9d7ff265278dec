"""The commands as a user runs them: files out, exit codes, one sentence for wrong input."""

import csv
import json
import math
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from snrmjax.cli import main

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


def run(*arguments: str) -> subprocess.CompletedProcess:
    """One command in a process of its own."""
    return subprocess.run(
        [sys.executable, "-c", "from snrmjax.cli import main; main()", *arguments],
        env=os.environ | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    model, data = tmp_path / "model.toml", tmp_path / "data.csv"
    model.write_text(MODEL)
    data.write_text(HEADER + ROWS)
    return model, data


def columns(path: Path) -> list[str]:
    with path.open() as file:
        return next(csv.reader(file))


def test_identify_writes_what_the_contract_says(files, tmp_path):
    model, data = files
    out = tmp_path / "out"
    done = run(
        "identify", str(data), "--model", str(model), "--out", str(out), "--predict-force", "1e-5"
    )
    assert done.returncode == 0, done.stderr
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
    # The states are exact and linear: curves through them are constant to solver tolerance.
    assert resonance["frequency_hz"] == pytest.approx(64.78, rel=1e-8)
    assert resonance["damping_ratio"] == pytest.approx(0.05, rel=1e-8)
    assert (out / "report.html").exists()
    assert (out / "backbone.png").read_bytes()[:4] == b"\x89PNG"


def test_simulate_and_nnm_write_what_the_contract_says(files, tmp_path):
    model, _ = files
    out = tmp_path / "out"
    done = run(
        *("simulate", str(model), "--force", "1e-4", "--from-hz", "50", "--to-hz", "80"),
        *("--harmonics", "3", "--out", str(out)),
    )
    assert done.returncode == 0, done.stderr
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
    done = run(
        *("nnm", str(model), "--to-hz", "60", "--harmonics", "3", "--out", str(out)),
    )
    assert done.returncode == 0, done.stderr
    assert columns(out / "nnm.csv") == [
        "point",
        "frequency_hz",
        "velocity_h1_m_s",
        "velocity_peak_m_s",
        "energy_j",
    ]


BAD_DATA = {
    "missing column": (HEADER.replace("force_n,", ""), "force_n"),
    "text in a number": (HEADER + "1,64,abc,0.01,0\n", "abc"),
    "negative frequency": (HEADER + "1,-64,1e-5,0.01,0\n", "-64"),
    "empty file": ("", "empty"),
    "thousands separator": (HEADER + '1,"1,064",1e-5,0.01,0\n', "1,064"),
}


@pytest.fixture
def run_here(monkeypatch, capsys):
    """A command in this process, which saves the import: exit code and stderr."""

    def call(*arguments: str) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["snrmjax", *arguments])
        with pytest.raises(SystemExit) as ended:
            main()
        return ended.value.code, capsys.readouterr().err

    return call


@pytest.mark.parametrize("name", BAD_DATA)
def test_wrong_data_ends_with_two_and_one_sentence(files, tmp_path, run_here, name):
    model, data = files
    text, named = BAD_DATA[name]
    data.write_text(text)
    out = tmp_path / "out"
    code, stderr = run_here("identify", str(data), "--model", str(model), "--out", str(out))
    assert code == 2
    assert "Traceback" not in stderr
    (line,) = [one for one in stderr.splitlines() if one.startswith("error: ")]
    assert "data.csv" in line
    assert named in line
    assert not out.exists()


def test_a_wrong_model_ends_with_two(files, tmp_path, run_here):
    model, data = files
    model.write_text(MODEL.replace("damping_ratio", "dampng_ratio"))
    out = tmp_path / "out"
    code, stderr = run_here("identify", str(data), "--model", str(model), "--out", str(out))
    assert code == 2
    assert re.search(r"dampng_ratio.*damping_ratio", stderr)
    assert not out.exists()


def test_a_wrong_range_ends_with_two(files, tmp_path):
    model, _ = files
    out = tmp_path / "out"
    done = run(
        *("simulate", str(model), "--force", "1e-4", "--from-hz", "80", "--to-hz", "50"),
        *("--out", str(out)),
    )
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert not out.exists()


def test_a_joint_fit_writes_what_the_contract_says(files, tmp_path):
    model, data = files
    out = tmp_path / "out"
    done = run(
        *("identify", str(data), "--model", str(model), "--out", str(out)),
        *("--fit", "polynomial:1,constant", "--next", "2", "--predict-force", "1.5e-5"),
    )
    assert done.returncode == 0, done.stderr
    assert columns(out / "next.csv") == [
        "rank",
        "force_n",
        "frequency_hz",
        "expected_band_ratio",
        "reason",
    ]
    with (out / "backbone.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 200
    assert float(rows[0]["velocity_m_s"]) == 0
    # The states are exact and linear; what is left is the end of the solver.
    assert float(rows[-1]["natural_frequency_hz"]) == pytest.approx(64.78, rel=1e-6)
    assert float(rows[-1]["damping_ratio"]) == pytest.approx(0.05, rel=1e-6)
    fit = json.loads((out / "summary.json").read_text())["joint_fit"]
    assert set(fit["parameters"]) == {"backbone.at_zero", "backbone.power_2", "damping.constant"}
    assert fit["parameters"]["damping.constant"]["value"] == pytest.approx(40.706, rel=1e-4)
    assert len(fit["covariance"]) == 3
    (resonance,) = fit["resonances"]
    assert resonance["frequency_hz"] == pytest.approx(64.78, rel=1e-6)
    assert (out / "fit.json").exists()
    for name in ("joint_fit", "residuals", "contributions", "next"):
        assert (out / f"{name}.png").stat().st_size > 10_000
    for share in ("frequency_share", "damping_share"):
        assert sum(row[share] for row in fit["contributions"]) == pytest.approx(1, rel=1e-9)
    html = (out / "report.html").read_text()
    for heading in ("Joint fit", "What the bands are made of", "What to measure next"):
        assert f"<h2>{heading}</h2>" in html
    with (out / "next.csv").open() as file:
        assert all(row["reason"] in html for row in csv.DictReader(file))


@pytest.mark.parametrize(
    ("option", "named"),
    [
        (("--fit", "cubic"), "cubic"),
        (("--fit", "spline,spline,spline"), "3"),
        (("--free", "phase"), "instrument_phase"),
        (("--free", "force_gain,phase"), "'phase'"),
    ],
)
def test_a_wrong_joint_fit_ends_with_two(files, tmp_path, run_here, option, named):
    model, data = files
    out = tmp_path / "out"
    code, stderr = run_here(
        "identify", str(data), "--model", str(model), "--out", str(out), *option
    )
    assert code == 2
    assert "Traceback" not in stderr
    assert named in stderr
    assert not out.exists()


def test_diagnose_writes_the_verdict_the_model_and_the_report(tmp_path, monkeypatch, capsys):
    blind = Path(__file__).parent / "diagnose" / "blind" / "blind_03"
    out = tmp_path / "out"
    table, model = (str(blind.with_suffix(suffix)) for suffix in (".csv", ".toml"))
    command = ["snrmjax", "diagnose", table, "--model", model, "--out", str(out)]
    monkeypatch.setattr(sys, "argv", command)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code in (0, None)
    told = json.loads((out / "diagnosis.json").read_text())
    assert told["verdict"] == "none"
    assert told["effects"] == told["candidates"] == []
    assert told["decide_by"] is None
    assert set(told["gap"]) >= {
        "before",
        "after",
        "held_out_before",
        "held_out_after",
        "noise_floor",
    }
    assert (out / "model.toml").read_text().startswith("name")
    assert (out / "report.html").stat().st_size > 1000
    assert list(out.glob("*.png"))
    assert "blind_03.csv: none\n" in capsys.readouterr().err


def test_diagnose_refuses_too_few_states(files, tmp_path, run_here):
    model, data = files
    data.write_text(HEADER + "".join(ROWS.splitlines(keepends=True)[:4]))
    out = tmp_path / "out"
    code, stderr = run_here("diagnose", str(data), "--model", str(model), "--out", str(out))
    assert code == 2
    assert "at least 6" in stderr


def test_identify_refuses_amplitudes_alone(files, tmp_path, run_here):
    model, data = files
    data.write_text("level,frequency_hz,force_n,velocity_m_s\n1,62,1e-5,0.01\n1,63,1e-5,0.02\n")
    out = tmp_path / "out"
    for options in ((), ("--fit", "auto")):
        command = ("identify", str(data), "--model", str(model), "--out", str(out), *options)
        code, stderr = run_here(*command)
        assert code == 2
        assert "needs the phases" in stderr
        assert "velocity_m_s" in stderr
        assert not out.exists()
