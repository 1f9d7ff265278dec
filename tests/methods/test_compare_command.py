"""The command `compare`: its files, and its messages on methods that cannot run."""

import csv
import json

import numpy as np
import pytest

import snrmjax as sj
from snrmjax.cli import app

HERTZ = 2 * np.pi


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A linear oscillator of 50 Hz and 0.5 %, modal mass 2 kg, at two forces."""
    at = tmp_path_factory.mktemp("compare")
    frequency = np.tile(HERTZ * np.linspace(49.4, 50.6, 25), 2)
    force = np.repeat([1.0, 2.0], 25)
    mobility = (
        1j * frequency / (2 * ((50 * HERTZ) ** 2 - frequency**2 + 50j * HERTZ * frequency / 100))
    )
    data = sj.measure.steady_states(
        np.repeat([1, 2], 25), frequency, force, (force * mobility)[:, None], sensors=("tip",)
    )
    sj.io.write_steady_states(at / "measured.csv", data)
    shape = 1 / np.sqrt(2.0)
    (at / "model.toml").write_text(
        f"[[mode]]\nfrequency_hz = 50.0\ndamping_ratio = 0.005\nshape = {{ tip = {shape} }}\n"
        f"participation = {shape}\n"
    )
    return at


def run(*arguments):
    from typer.testing import CliRunner

    return CliRunner().invoke(app, ["compare", *map(str, arguments)])


def test_all_methods_find_a_linear_oscillator(folder):
    done = run(folder / "measured.csv", "--model", folder / "model.toml", "--out", folder / "out")
    assert done.exit_code == 0, done.output
    assert "6 of 10 methods ran" in done.output
    with (folder / "out" / "compare.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [
        *("method", "velocity_m_s", "frequency_hz", "frequency_std_hz"),
        *("damping_ratio", "damping_ratio_std", "status"),
    ]
    found = [row for row in rows if row["status"] == "found"]
    assert {row["method"] for row in found} == {
        *("snrm", "concerto", "arslan_ozguven", "rct", "harmonic_force_surface"),
        "phase_resonance",
    }
    np.testing.assert_allclose([float(row["frequency_hz"]) for row in found], 50, rtol=1e-4)
    np.testing.assert_allclose([float(row["damping_ratio"]) for row in found], 0.005, rtol=0.03)
    summary = json.loads((folder / "out" / "summary.json").read_text())
    assert set(summary["stopped"]) == {"resonant_decay", "restoring_force", "ssm", "pnlss"}
    assert "ssm: a time record (free decay) is needed, and the data have none." in done.output
    # Without stated noise only the scatter about a line gives a band.
    band = summary["bands"][0]
    assert band.startswith("the bands of response-controlled modal fit include noise")
    assert band[1:] in (folder / "out" / "report.html").read_text()
    assert (folder / "out" / "report.html").exists()


def test_an_unknown_method_is_refused_and_leaves_nothing(folder):
    with pytest.raises(ValueError, match=r"must be among snrm.*but has hilbert"):
        app(
            [
                *("compare", str(folder / "measured.csv"), "--model", str(folder / "model.toml")),
                *("--out", str(folder / "none"), "--method", "hilbert"),
            ],
            standalone_mode=False,
        )
    assert not (folder / "none").exists()
