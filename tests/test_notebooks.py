"""Every notebook runs to its end as a script and writes figures; it checks its own headline."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"
LONG = (
    "01_backbone_from_near_resonance",
    "03_joint_fit_and_error_bars",
    "04_the_missing_effect",
    "05_the_papers_open_ends",
    "06_uncertain_curved_beam",
    "07_models_from_finite_elements",
    "08_from_laboratory_files",
    "09_the_fields_other_methods",
    "10_joints_and_coupled_modes",
)  # a minute and more
PATHS = [
    pytest.param(path, marks=[pytest.mark.long] if path.stem in LONG else [], id=path.stem)
    for path in sorted(NOTEBOOKS.glob("*.py"))
]


@pytest.mark.parametrize("path", PATHS)
def test_it_runs_to_its_end(path, tmp_path):
    # In a process of its own: warnings there are its readers' business, not errors of ours.
    done = subprocess.run(
        [sys.executable, str(path), str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=600,
        env={**os.environ, "MPLBACKEND": "agg", "STUDY_MEMBERS": "128"},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "\nyes  " in done.stdout, "the notebook checks nothing"
    assert "\nNO   " not in done.stdout
    assert done.stderr == ""
    assert all(figure.stat().st_size > 10_000 for figure in tmp_path.glob("*.png"))
    assert list(tmp_path.glob("*.png")), "the notebook draws nothing"


def test_there_are_notebooks():
    assert list(NOTEBOOKS.glob("*.py"))
