"""Decay methods with interfering modes: right, or refused with a reason."""

import json
import sys

import numpy as np
import pytest

import snrmjax as sj
from snrmjax.cli import main
from snrmjax.measure import Channel, time_recording

HERTZ, RATE = 2 * np.pi, 2000.0
TIME = np.arange(0, 2.0, 1 / RATE)
HZ, RATIO = 40.0, 0.005
MODES = sj.model.linear_modes([HZ * HERTZ], [RATIO], [[1.0]], [1.0], sensors=("tip",))
METHODS = ("resonant_decay", "ssm", "restoring_force")


def ringing(hertz, ratio, amplitude):
    """A linear mode's decay: all of its numbers are known."""
    omega = HERTZ * hertz
    return amplitude * np.exp(-ratio * omega * TIME) * np.cos(omega * np.sqrt(1 - ratio**2) * TIME)


def record(*others):
    noise = 1e-3 * np.random.default_rng(5).standard_normal(len(TIME))
    motion = ringing(HZ, RATIO, 0.2) + sum(ringing(*one) for one in others) + 0.2 * noise
    return time_recording(motion[None], [Channel("tip", "velocity")], RATE, name="ring.csv")


FAR = ((140.0, 0.003, 0.1), (22.0, 0.01, 0.04))


@pytest.fixture(scope="module")
def compared():
    return sj.methods.compare_methods([record(*FAR)], MODES, METHODS)


def test_all_methods_follow_the_mode(compared):
    assert {result.method for result in compared.results} == set(METHODS)
    for result in compared.results:
        omega, ratio = result.natural_frequency / HERTZ, result.damping_ratio
        # Two strong neighbours: within 0.1 % and 5 % in the median, and inside stated bands.
        assert np.median(np.abs(omega / HZ - 1)) < 1e-3
        assert np.median(np.abs(ratio / RATIO - 1)) < 0.05
        for found, std, true in (
            (omega, result.natural_frequency_std / HERTZ, HZ),
            (ratio, result.damping_ratio_std, RATIO),
        ):
            assert np.mean(np.abs(found - true) < 1.96 * std) > 0.8


def test_interfering_modes_are_reported(compared):
    kinds = [note["note"].kind for note in compared.decays]
    assert kinds[:3] == ["mode_isolated", "interfering_modes_of_decay", "bias_of_mode_filter"]
    (interfering,) = [
        n["note"] for n in compared.decays if n["note"].kind == "interfering_modes_of_decay"
    ]
    assert interfering["frequency_hz"] == pytest.approx(140, abs=1.5)
    assert "other motion" in str(interfering)


def run(tmp_path, monkeypatch, capsys, data):
    (tmp_path / "model.toml").write_text(
        f"[[mode]]\nfrequency_hz = {HZ}\ndamping_ratio = {RATIO}\nshape = {{ tip = 1.0 }}\n"
        "participation = 1.0\n"
    )
    rows = np.stack([data.time(), data.values(["tip"])[0]], axis=1)
    text = "\n".join(",".join(f"{value:.9g}" for value in row) for row in rows)
    (tmp_path / "ring.csv").write_text(f"time_s,velocity_m_s\n{text}\n")
    files = [str(tmp_path / name) for name in ("ring.csv", "model.toml", "out")]
    given = ["snrmjax", "compare", files[0], "--model", files[1], "--out", files[2]]
    monkeypatch.setattr(sys, "argv", [*given, *(f"--method={name}" for name in METHODS)])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code or 0, " ".join(capsys.readouterr().err.split())


def test_the_command_reports_interfering_modes(tmp_path, monkeypatch, capsys):
    code, printed = run(tmp_path, monkeypatch, capsys, record(*FAR))
    assert code == 0
    assert "of the decay's energy is other motion" in printed
    notes = json.loads((tmp_path / "out" / "summary.json").read_text())["decays"]
    assert any("near 140 Hz" in line or "near 139.9 Hz" in line for line in notes)


def test_a_close_mode_is_refused_in_one_sentence(tmp_path, monkeypatch, capsys):
    code, printed = run(tmp_path, monkeypatch, capsys, record((43.0, 0.004, 0.12)))
    assert code == 2
    assert "the mode cannot be isolated: inside its band" in printed
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("method", [sj.methods.ssm, sj.methods.restoring_force])
def test_functions_refuse_a_record_of_several_modes(method):
    motion = record((210.0, 0.002, 0.3), (97.0, 0.003, 0.2)).values(["tip"])[0]
    with pytest.raises(ValueError, match=r"isolate_decay` before|no oscillation"):
        method(TIME, motion)
