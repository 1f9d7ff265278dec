"""Every notebook runs to its end as a script and writes figures; it checks its own headline."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"
LONG = ("03_joint_fit_and_error_bars",)  # minutes: run with SNRMJAX_LONG_TESTS=1


@pytest.mark.parametrize("path", sorted(NOTEBOOKS.glob("*.py")), ids=lambda path: path.stem)
def test_it_runs_to_its_end(path, tmp_path):
    if path.stem in LONG and not os.environ.get("SNRMJAX_LONG_TESTS"):
        pytest.skip("takes minutes; set SNRMJAX_LONG_TESTS=1")
    # In a process of its own: warnings there are its readers' business, not errors of ours.
    done = subprocess.run(
        [sys.executable, str(path), str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=600,
        env={**os.environ, "MPLBACKEND": "agg"},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "\nyes  " in done.stdout, "the notebook checks nothing"
    assert "\nNO   " not in done.stdout
    assert done.stderr == ""
    assert all(figure.stat().st_size > 10_000 for figure in tmp_path.glob("*.png"))
    assert list(tmp_path.glob("*.png")), "the notebook draws nothing"


def test_there_are_notebooks():
    assert list(NOTEBOOKS.glob("*.py"))
