"""Levels in dB: amplitudes over a stated reference, and refused without one."""

import numpy as np
import pytest
import pyuff
import scipy.io
from truths.import_runs import run_import

HERTZ = np.array([79.0, 79.5, 80.0])
FORCE, SPEED, PHASE = np.full(3, 0.5), np.array([0.1, 0.2, 0.15]), np.array([30.0, 0.0, -30.0])
PHASOR = SPEED * np.exp(1j * np.radians(PHASE))
OVER_N = ("--force-amplitude", 0.5, "--over-force")


def level(values, reference=1.0):
    return 20 * np.log10(values / reference)


def write(path, head, *columns, unit_row=""):
    rows = [",".join(map(repr, row)) for row in np.transpose(columns).tolist()]
    path.write_text("\n".join([head, *([unit_row] if unit_row else []), *rows]))
    return path


def velocity(folder):
    table = np.genfromtxt(folder / "measured.csv", delimiter=",", names=True)
    return table["force_n"], table["velocity_re_m_s"] + 1j * table["velocity_im_m_s"]


@pytest.mark.parametrize(
    ("name", "values", "words"),
    [
        ("v [dB re 1 m/s]", level(SPEED), ("v",)),
        ("v (dB ref 1e-9 m/s)", level(SPEED, 1e-9), ("v",)),
        ("v dB re. 1 µm/s", level(SPEED, 1e-6), ("v dB re. 1 µm/s",)),
        ("v_dB", level(SPEED, 1e-9), ("v_dB:velocity:dB re 1e-9 m/s",)),
        ("Mag [dB]", level(SPEED, 1e-3), ("Mag:velocity", "--unit", "dB re 1 mm/s")),
        ("a [dB re 10^-6 m/s²]", level(SPEED * 2 * np.pi * HERTZ, 1e-6), ("a",)),
        ("H (dB re 1 (m/s)/N)", level(SPEED / FORCE), ("H", *OVER_N)),
        ("v [dB re 1 m/s rms]", level(SPEED / 2**0.5), ("v",)),
    ],
)
def test_levels_over_a_reference_are_amplitudes(tmp_path, name, values, words):
    path = write(
        tmp_path / "a.csv", f"f [Hz],F [N],{name},phase [deg]", HERTZ, FORCE, values, PHASE
    )
    load = () if "--over-force" in words else ("--force", "F")
    size = ("--amplitude", "rms") if "rms" in name else ()
    code, output = run_import(path, *load, "--response", *words, *size, "--out", tmp_path / "o")
    assert code == 0, output
    assert "is a level in dB" in output
    root = 2**0.5 if size else 1.0  # which the force has, too
    found = velocity(tmp_path / "o")
    np.testing.assert_allclose(found[0], FORCE * root, rtol=1e-12)
    wanted = PHASOR / 1j if name.startswith("a ") else PHASOR
    np.testing.assert_allclose(found[1], wanted, rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "unit_row", "word", "complaint"),
    [
        ("v_dB", "", "v_dB:velocity:m/s", r"in dB, not in m/s: state the reference"),
        ("v", "Hz,N,dB,deg", "v:velocity:m/s", r"in dB, not in m/s"),
        ("v_dB", "Hz,N,m/s,deg", "v_dB", r"a level in dB without a reference"),
        ("v [dB re 1 m/s]", "", "v:velocity:m/s", "in dB re 1 m/s, not in m/s"),
        ("magdB", "", "magdB:velocity:mm/s", "in dB, not in mm/s"),
        ("Amplitude_dB [m/s]", "", "Amplitude_dB [m/s]:velocity:m/s", "not in m/s"),
        ("20*log10(v)", "", "20*log10(v):velocity:m/s", "not in m/s"),
        ("v [mm/s]", "", "v:velocity:dB re 1 m/s", "in mm/s by the file, but dB re 1 m/s is"),
        ("v [dB re 1 g²/Hz]", "", "v", "is of other"),
        ("v [dBm]", "", "v:velocity:m/s", "not in m/s"),
    ],
)
def test_levels_are_never_taken_for_amplitudes(tmp_path, name, unit_row, word, complaint):
    head = f"f,F,{name},phase" if unit_row else f"f [Hz],F [N],{name},phase [deg]"
    path = write(
        tmp_path / "a.csv", head, HERTZ, FORCE, level(SPEED, 1e-9), PHASE, unit_row=unit_row
    )
    code, output = run_import(path, "--force", "F", "--response", word, "--out", tmp_path / "o")
    assert code == 2
    assert complaint in output


@pytest.mark.parametrize("name", ["v_std", "v_dB_std", "v_std [dB]"])
def test_errors_of_levels_are_in_db(tmp_path, name):
    head = f"f [Hz],F [N],v [dB re 1 m/s],{name},phase [deg]"
    path = write(tmp_path / "a.csv", head, HERTZ, FORCE, level(SPEED), FORCE, PHASE)
    words = ("--force", "F", "--response", "v", "--amplitude-std", name, "--out", tmp_path / "o")
    code, output = run_import(path, *words)
    assert code == 0, output
    table = np.genfromtxt(tmp_path / "o" / "measured.csv", delimiter=",", names=True)
    step = 1e-5  # of dB, a difference
    wanted = 0.5 * (SPEED * 10 ** (step / 20) - SPEED * 10 ** (-step / 20)) / (2 * step)
    np.testing.assert_allclose(table["velocity_std_m_s"], wanted, rtol=1e-9)
    path.write_text(path.read_text().replace("v [dB re 1 m/s]", "v [m/s]").replace("-", ""))
    if name != "v_std":
        assert "one of both is in dB" in run_import(path, *words)[1]


def test_levels_of_structs_records_and_universal_files(tmp_path):
    units = np.array(["Hz", "N", "dB re 1 m/s", "deg"], dtype=object)
    test = {"f": HERTZ, "F": FORCE, "v": level(SPEED), "phase": PHASE, "units": units}
    scipy.io.savemat(tmp_path / "a.mat", {"test": test})
    words = ("--force", "F", "--response")
    code, output = run_import(tmp_path / "a.mat", *words, "v", "--out", tmp_path / "o")
    assert code == 0, output
    np.testing.assert_allclose(velocity(tmp_path / "o")[1], PHASOR, rtol=1e-12)
    record = {"fs": 1000.0, "v_dB": np.linspace(0, 60, 200)}
    scipy.io.savemat(tmp_path / "b.mat", record)
    decay = ("--record", "decay", "--out", tmp_path / "p")
    code, output = run_import(tmp_path / "b.mat", "--response", "v_dB:velocity:m/s", *decay)
    assert (code, "is a level in dB, not in m/s" in output) == (2, True)
    curve = pyuff.prepare_58(
        **{"x": HERTZ, "data": level(SPEED) + 0j, "binary": 0, "rsp_node": 1, "rsp_dir": 3},
        **{"ref_node": 1, "ref_dir": 3, "func_type": 4, "abscissa_spacing": 0},
        **{"abscissa_spec_data_type": 18, "ordinate_spec_data_type": 11},
        **{"ordinate_axis_units_lab": "dB", "orddenom_spec_data_type": 13},
    )
    pyuff.UFF(str(tmp_path / "c.uff")).write_sets([curve], "add")
    known = ("--force-amplitude", 1, "--out", tmp_path / "q")
    for word in ("1+z", "1+z:velocity:m/s", "1+z:velocity:dB re 1 m/s"):
        code, output = run_import(tmp_path / "c.uff", "--response", word, *known)
        assert code == 2, output
        assert "level" in output
