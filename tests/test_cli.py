"""The commands as a user runs them: files out, exit codes, one sentence for wrong input."""

import csv
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

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
# Linear states by Eq. (23), rounded: 1e-5 N, 62, 63, 64, 65, 66 and 67 Hz; level after level.
ROWS = "".join(
    f"{level},{hz},{force},{force * re_},{force * im}\n"
    for level, force in ((1, 1e-5), (2, 2e-5))
    for hz, re_, im in (
        (62, 856.0, 384.0),
        (63, 972.0, 274.0),
        (64, 1037.0, 125.0),
        (65, 1046.0, -35.0),
        (66, 1001.0, -187.0),
    )
)


def run(*arguments: str) -> subprocess.CompletedProcess:
    """One command in a process of its own."""
    return subprocess.run(
        [sys.executable, "-c", "from snrmjax.cli import main; main()", *arguments],
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
    assert columns(out / "points.csv") == (
        "level,frequency_hz,force_n,velocity_m_s,phase_deg,nnmai,natural_frequency_hz,"
        "natural_frequency_std_hz,damping_ratio,damping_ratio_std,backbone_velocity_m_s,status"
    ).split(",")
    assert columns(out / "backbone.csv") == (
        "velocity_m_s,natural_frequency_hz,natural_frequency_std_hz,damping_ratio,damping_ratio_std"
    ).split(",")
    assert columns(out / "prediction.csv") == (
        "force_n,point,frequency_hz,velocity_re_m_s,velocity_im_m_s,stable"
    ).split(",")
    summary = json.loads((out / "summary.json").read_text())
    (resonance,) = summary["resonances"]
    # Table values are rounded to three digits and linear: 64.78 Hz within their rounding.
    assert resonance["frequency_hz"] == pytest.approx(64.78, abs=0.1)
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
    assert columns(out / "response.csv") == (
        "force_n,point,frequency_hz,velocity_h1_re_m_s,velocity_h1_im_m_s,velocity_peak_m_s,"
        "stable,event"
    ).split(",")
    done = run(
        *("nnm", str(model), "--to-hz", "60", "--harmonics", "3", "--out", str(out)),
    )
    assert done.returncode == 0, done.stderr
    assert columns(out / "nnm.csv") == (
        "point,frequency_hz,velocity_h1_m_s,velocity_peak_m_s,energy_j"
    ).split(",")


BAD_DATA = {
    "missing column": (HEADER.replace("force_n,", ""), "force_n"),
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
    done = run("identify", str(data), "--model", str(model), "--out", str(out))
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    (line,) = [one for one in done.stderr.splitlines() if one.startswith("error: ")]
    assert "data.csv" in line
    assert named in line
    assert not out.exists()


def test_wrong_model_and_wrong_range_end_with_two(files, tmp_path):
    model, data = files
    model.write_text(MODEL.replace("damping_ratio", "dampng_ratio"))
    out = tmp_path / "out"
    done = run("identify", str(data), "--model", str(model), "--out", str(out))
    assert done.returncode == 2
    assert re.search(r"dampng_ratio.*damping_ratio", done.stderr)
    model.write_text(MODEL)
    done = run(
        "simulate",
        str(model),
        "--force",
        "1e-4",
        "--from-hz",
        "80",
        "--to-hz",
        "50",
        "--out",
        str(out),
    )
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert not out.exists()
