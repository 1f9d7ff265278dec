"""The README's examples run as they stand, one after the other, on files of a user's own."""

import re
from pathlib import Path

import numpy as np
import pytest

import snrmjax as sj
from snrmjax.model.effects import EFFECTS

README = (Path(__file__).resolve().parents[1] / "README.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
LINES = 120


@pytest.fixture
def own_files(tmp_path, monkeypatch):
    """`model.toml` of the README and `measured.csv`: a virtual test of that structure."""
    (model,) = re.findall(r"```toml\n(.*?)```", README, flags=re.DOTALL)
    (tmp_path / "model.toml").write_text(model, encoding="utf-8")
    structure = sj.read_model(tmp_path / "model.toml")
    hertz = 2 * np.pi
    errors = sj.simulate.MeasurementErrors(amplitude=0.005, phase=0.005, force=0.002)
    test = sj.phase_resonance_test(
        structure,
        [4e-3, 8e-3, 1.3e-2],
        60 * hertz,
        115 * hertz,
        recording=sj.simulate.Recording(errors),
    )
    sj.io.write_steady_states(tmp_path / "measured.csv", test.steady_states)
    monkeypatch.chdir(tmp_path)


def test_it_fits_on_a_page():
    assert len(README.splitlines()) <= LINES
    assert len(EXAMPLES) == 3


def test_examples_run_and_say_what_they_promise(own_files, capsys):
    names = {}
    try:
        for number, example in enumerate(EXAMPLES):
            exec(compile(example, f"README example {number + 1}", "exec"), names)
    finally:
        EFFECTS.pop("root_damping", None)
    told = capsys.readouterr().out
    assert Path("backbone.png").stat().st_size > 10_000
    # The beam's own backbone starts at its linear frequency, and its model lacks nothing.
    values = names["found"].backbone.values(np.zeros(1))
    start, std = (
        float(one[0]) / (2 * np.pi)
        for one in (values.natural_frequency, values.natural_frequency_std)
    )
    # Gains of three levels that nobody states move what lies below the lowest by as much.
    assert abs(start - 79.02) < 1.96 * std < 1.0
    assert names["answer"].verdict == "none"
    assert "root_damping.coefficient" in names["answer"].detection_limits
    assert "Identification: " in told
    assert "No missing effect" in told
