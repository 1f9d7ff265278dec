"""A moving base in laboratories' files: its acceleration takes the place of the force, exactly."""

import numpy as np
import pytest
from truths.import_runs import run_import
from truths.matlab_writing import write_matlab
from truths.uff_writing import write_uff

from snrmjax.io.tables import read_steady_states
from snrmjax.measure import Channel, frequency_responses, time_recording

HERTZ, G = 2 * np.pi, 9.80665
F = np.array([30.0, 31.0, 32.0, 33.0])
OMEGA = HERTZ * F
ACCELERATION = np.array([0.5, 0.6, 0.5, 0.6]) * np.exp(1j * np.array([0.3, -0.2, 1.0, 2.0]))  # m/s²
VELOCITY = np.array([0.1 - 0.1j, 0.2j, 0.3 + 0.2j, -0.1 + 0.3j])  # m/s, of the sensor
RELATIVE = VELOCITY * np.exp(-1j * np.angle(ACCELERATION))  # to the phase of the acceleration
MOTIONS = {
    "acceleration:g": ACCELERATION / G,
    "acceleration:m/s^2": ACCELERATION,
    "velocity:mm/s": 1e3 * ACCELERATION / (1j * OMEGA),
    "displacement:mm": -1e3 * ACCELERATION / OMEGA**2,
}


def imported(folder, *words):
    code, output = run_import(*words, "--out", folder / "out")
    assert code == 0, output
    return read_steady_states(folder / "out" / "measured.csv")


def same(states, rtol=1e-13):
    assert states.base is not None
    np.testing.assert_allclose(states.force, np.abs(ACCELERATION), rtol=rtol)
    np.testing.assert_allclose(np.asarray(states.velocity)[:, 0], RELATIVE, rtol=0, atol=rtol)


def polar(values):
    return np.abs(values), np.degrees(np.angle(values))


def table(path, *columns):
    names = "f [Hz],table,table phase [deg],v [m/s],v phase [deg]"
    rows = np.column_stack(columns).tolist()
    path.write_text("\n".join([names, *(",".join(map(repr, row)) for row in rows)]))
    return path


@pytest.mark.parametrize("motion", MOTIONS)
def test_any_motion_of_the_table_in_a_table(tmp_path, motion):
    path = table(tmp_path / "t.csv", F, *polar(MOTIONS[motion]), *polar(VELOCITY))
    words = [path, "--base", f"table:{motion}", "--force-phase", "table phase", "--response", "v"]
    same(imported(tmp_path, *words, "--phase", "v phase"))


def test_a_stated_amplitude_and_responses_over_the_base(tmp_path):
    relative = polar(VELOCITY / MOTIONS["acceleration:g"])
    path = table(tmp_path / "t.csv", F, *polar(MOTIONS["acceleration:g"]), *relative)
    words = [path, "--base", "table:acceleration:g", "--over-force", "--response", "v"]
    same(imported(tmp_path, *words, "--phase", "v phase"))
    path = table(tmp_path / "t.csv", F, np.zeros(4), np.zeros(4), *polar(0.05 * RELATIVE))
    words = [path, "--base", "0.05:acceleration:g", "--response", "v", "--phase", "v phase"]
    states = imported(tmp_path, *words)
    np.testing.assert_allclose(states.force, 0.05 * G, rtol=1e-14)
    np.testing.assert_allclose(np.asarray(states.velocity)[:, 0], 0.05 * RELATIVE, atol=1e-15)


@pytest.mark.parametrize("motion", ["acceleration:g", "displacement:mm"])
def test_frequency_responses_over_the_base(tmp_path, motion):
    quantity, unit = motion.split(":")
    factor = {"g": G, "mm": 1e-3}[unit]
    over = VELOCITY / MOTIONS[motion]  # m/s per g or mm
    one = frequency_responses(
        OMEGA,
        over[None, None],
        [Channel("tip", "velocity", "m/s", 1.0, "1", "+z")],
        [Channel("table", quantity, unit, factor, "2", "+z")],
    )
    write_uff(tmp_path / "frf.uff", responses=[one])
    words = [tmp_path / "frf.uff", "--response", "tip:1+z", "--base"]
    states = imported(tmp_path, *words, f"0.5:{quantity}:{unit}")
    lead = (1j * OMEGA) ** (0 if quantity == "acceleration" else 2)
    size = 0.5 * factor * np.abs(lead)
    wanted = over * 0.5 * np.exp(-1j * np.angle(lead))
    np.testing.assert_allclose(states.force, size, rtol=1e-6)  # UFF has single steps
    np.testing.assert_allclose(np.asarray(states.velocity)[:, 0], wanted, rtol=1e-6)
    other = "velocity:m/s" if quantity == "acceleration" else "acceleration:g"
    code, output = run_import(*words, f"0.5:{other}", "--out", tmp_path / "other")
    assert code == 2
    assert "which of both is right" in output


@pytest.mark.parametrize("motion", ["acceleration:m/s^2", "velocity:mm/s"])
def test_a_record_of_steps_on_a_table(tmp_path, motion):
    """Three steps of 4 s, without transients; harmonic 2 turns by twice the angle."""
    rate, kind = 1000.0, motion.split(":")[0]
    time = np.arange(12_000) / rate
    step = np.repeat([0, 1, 2], 4000)
    omega = OMEGA[step]
    base = MOTIONS[motion][step]
    second = 0.02 * np.exp(0.4j)
    tip = np.real(VELOCITY[step] * np.exp(1j * omega * time) + second * np.exp(2j * omega * time))
    both = np.stack([np.real(base * np.exp(1j * omega * time)), tip])
    channels = [Channel("control", kind, motion.split(":")[1]), Channel("tip", "velocity", "m/s")]
    write_matlab(tmp_path / "r.mat", recordings=[time_recording(both, channels, rate)])
    words = [tmp_path / "r.mat", "--base", f"control:{motion}", "--response", "tip"]
    states = imported(tmp_path, *words, "--record", "steps")
    assert states.base is not None
    np.testing.assert_allclose(states.force, np.abs(ACCELERATION[:3]), rtol=2e-6)
    np.testing.assert_allclose(np.asarray(states.velocity)[:, 0], RELATIVE[:3], atol=2e-6)
    turned = second * np.exp(-2j * np.angle(ACCELERATION[:3]))
    np.testing.assert_allclose(np.asarray(states.harmonics)[:, 0, 0], turned, atol=2e-6)
    code, output = run_import(*words, "--record", "broadband", "--out", tmp_path / "record")
    assert code == 0, output
    head = (tmp_path / "record" / "record.csv").read_text().splitlines()[0]
    assert f"base_{kind}_" in head


def test_our_own_table_of_a_base_in_another_unit(tmp_path):
    head = "level,frequency_hz,base_acceleration_re_m_s2,base_acceleration_im_m_s2"
    rows = "\n".join(f"1,{f},{0.1},0,0.2,0.1" for f in F)
    (tmp_path / "own.csv").write_text(f"{head},velocity_re_m_s,velocity_im_m_s\n{rows}\n")
    states = imported(tmp_path, tmp_path / "own.csv", "--force-unit", "g")
    np.testing.assert_allclose(states.force, 0.1 * G, rtol=1e-14)
    code, output = run_import(tmp_path / "own.csv", "--force-unit", "N", "--out", tmp_path / "no")
    assert code == 2
    assert "must be a displacement, velocity or acceleration" in output
