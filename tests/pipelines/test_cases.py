"""Small inputs of former errors, each by its command, if the folder of cases exists."""

import json
from pathlib import Path

import numpy as np
import pytest
from truths.import_runs import run_import
from typer.testing import CliRunner

from snrmjax.cli import app
from snrmjax.io.laboratory import read_laboratory_file
from snrmjax.io.tables import read_steady_states

CASES = Path(__file__).resolve().parents[3] / "shared" / "cases"
pytestmark = pytest.mark.skipif(not CASES.exists(), reason="no folder of cases")
POUND = 4.4482216152605


def run(*words):
    result = CliRunner().invoke(app, list(map(str, words)))
    if result.exception is not None and not isinstance(result.exception, ValueError | SystemExit):
        raise result.exception
    return result


@pytest.mark.parametrize(
    ("unit", "newtons"), [("lbf", 0.4 * POUND), ("kN", 400), ("mN", 4e-4), ("g", 0), ("banana", 0)]
)
def test_a_stated_unit_is_obeyed_or_refused(tmp_path, unit, newtons):
    words = "--frequency frequency --response velocity:velocity:m/s --phase phase --phase-unit deg"
    words += f" --phase-sign lead --amplitude peak --force-amplitude 0.4 --force-unit {unit}"
    table = CASES / "force_unit_dropped" / "table.csv"
    code, _ = run_import(table, *words.split(), "--out", tmp_path / "o")
    assert code == (0 if newtons else 2)
    if newtons:
        np.testing.assert_allclose(
            read_steady_states(tmp_path / "o" / "measured.csv").force, newtons
        )


@pytest.mark.parametrize("name", ["run.txt", "one_run.txt", "run_without_trailing_tab.txt"])
def test_a_trailing_tab(name):
    (table,) = read_laboratory_file(CASES / "header_trailing_tab" / name).tables
    assert sorted(table.units.values()) == ["Deg", "Hz", "m/s"]
    assert table.n_rows == (41 if name == "one_run.txt" else 82)


def test_a_labview_file_with_decimal_commas():
    (record,) = read_laboratory_file(CASES / "lvm_decimal_comma" / "test.lvm").recordings
    assert (record.sampling_rate, record.channel_names) == (1000.0, ("Force", "Response"))
    assert np.abs(record.values()).max() <= 1.0


def test_radians_of_a_list_of_units_and_ratios(tmp_path):
    code, printed = run_import(CASES / "mat_units_field_rad" / "fr.mat")
    assert code == 0
    assert "--force force --response amplitude --out" in printed
    found = run(
        "modes",
        CASES / "compound_unit_label" / "ratio_g.uff",
        "--drive-point",
        "1+z",
        "--out",
        tmp_path / "model.toml",
    )
    assert found.exit_code == 0, found.exception
    assert "59.999" in found.output


def test_channels_of_two_files_and_of_two_clocks(tmp_path):
    folder = CASES / "polytec_one_channel_a_file"
    files = folder / "force.txt", folder / "velocity.txt"
    words = ["--force", "Ref1 Force", "--response", "Vib Velocity", "--record", "broadband"]
    code, printed = run_import(*files, *words, "--out", tmp_path / "o")
    assert code == 0, printed
    head = (tmp_path / "o" / "record.csv").read_text().splitlines()[0]
    assert head == "time_s,force_n,velocity_m_s"
    words = ["--force", "Force", "--response", "Acc:acceleration", "--record", "steps"]
    code, printed = run_import(
        CASES / "tdms_start_times" / "skew.tdms", *words, "--out", tmp_path / "t"
    )
    assert code == 0, printed
    states = read_steady_states(tmp_path / "t" / "measured.csv")
    at_50 = int(np.argmin(np.abs(np.asarray(states.frequency) - 100 * np.pi)))
    assert np.angle(np.asarray(states.velocity)[0, 0], deg=True) == pytest.approx(72, abs=0.5)
    assert abs(np.angle(np.asarray(states.velocity)[at_50, 0], deg=True)) < 1


def test_the_sign_of_a_residue_is_kept(tmp_path):
    measured = CASES / "unscaled_sign" / "measured.csv"
    assert run("modes", measured, "--unscaled", "--out", tmp_path / "m.toml").exit_code == 0
    assert (
        run("check", measured, "--model", tmp_path / "m.toml", "--out", tmp_path / "c").exit_code
        == 0
    )
    assert json.loads((tmp_path / "c" / "check.json").read_text()) == []


def test_a_force_gain_that_fits_with_negative_damping_only_is_refused_in_one_sentence(tmp_path):
    folder, out = CASES / "drive_negative_gain", tmp_path / "o"
    words = ["--fit", "auto", "--free", "force_gain,instrument_phase", "--out", out]
    found = run("identify", folder / "measured.csv", "--model", folder / "model.toml", *words)
    assert "the force gain cannot be determined from these data" in str(found.exception)
    assert not out.exists()


def test_forces_with_phases_and_coupled_damping_are_the_models_own(tmp_path):
    """1.75757 Hz and 0.47434 % are the eigenvalue of the matrices, at every amplitude."""
    folder = CASES / "force_with_phases"
    words = [folder / "measured.csv", "--model", folder / "model.toml", "--out", tmp_path / "o"]
    found = run("identify", *words)
    assert found.exit_code == 0
    assert "instrument phase" not in found.output
    points = np.genfromtxt(tmp_path / "o" / "points.csv", delimiter=",", names=True, dtype=None)
    assert set(points["status"]) == {"ok"}
    # The table has eleven digits of Hz, and was solved to 1e-8.
    np.testing.assert_allclose(points["natural_frequency_hz"], 1.75757, rtol=5e-6)
    np.testing.assert_allclose(points["damping_ratio"], 0.0047434, rtol=2e-5)
    run("diagnose", *words[:-1], tmp_path / "d")
    diagnosis = json.loads((tmp_path / "d" / "diagnosis.json").read_text())
    assert (diagnosis["verdict"], diagnosis["effects"]) == ("none", [])


@pytest.mark.parametrize(
    ("name", "force", "ratio", "frequency", "velocity"),
    [("", 0.980665, 2, 188.61, 1.2597), ("tank", 17.302, 2, 1.1703, 38.9)],
)
def test_a_left_out_level_is_predicted_with_its_probability(
    tmp_path, name, force, ratio, frequency, velocity
):
    folder, table = CASES / "prediction_no_resonance", name or "measured"
    words = ["--predict-force", force, "--extrapolate", ratio, "--out", tmp_path / "o"]
    model = folder / f"{name or 'model'}.toml"
    run("identify", folder / f"{table}.csv", "--model", model, "--fit", "auto", *words)
    summary = json.loads((tmp_path / "o" / "summary.json").read_text())
    (one,) = summary["resonance_distributions"]
    assert 0.5 < one["probability"] < 0.95  # not as a fact, and never denied
    assert one["frequency_hz"][0] < frequency < one["frequency_hz"][-1]
    assert one["velocity_m_s"][0] < velocity < one["velocity_m_s"][-1]
    (tip,) = summary["joint_fit"]["resonances"]
    assert tip["frequency_std_hz"] == one["frequency_std_hz"]
    assert tip["velocity_std_m_s"] == one["velocity_std_m_s"]
    assert all(each["damping_ratio"] > 0 for each in summary["resonances"])
