"""Names with units in them: the proposed command reads the numbers correctly."""

import shlex

import numpy as np
import pytest
from truths.import_runs import run_import

from snrmjax.io.laboratory import read_laboratory_file
from snrmjax.io.laboratory.names import label_of, role_of
from snrmjax.io.tables import read_steady_states

HERTZ = 2 * np.pi
F = np.array([78.5, 79.0, 79.5, 80.0, 80.5])  # Hz
FORCE = np.array([0.4, 0.41, 0.39, 0.4, 0.42])  # N
VELOCITY = np.array([0.05 + 0.1j, 0.1 + 0.2j, 0.3 + 0.1j, 0.2 - 0.2j, 0.1 - 0.1j])  # m/s
ORDER = {"displacement": -1, "velocity": 0, "acceleration": 1}
RMS = np.sqrt(2)


def written(path, names, motion="velocity", units=(1, 1, 1, 1)):
    """A table of frequency (Hz), force (N), motion (SI) and phase (degree), each times `units`."""
    phasor = VELOCITY * (1j * HERTZ * F) ** ORDER[motion]
    columns = np.array([F, FORCE, np.abs(phasor), np.degrees(np.angle(phasor))]).T * units
    path.write_text("\n".join([names, *(";".join(map(repr, row)) for row in columns.tolist())]))


def proposed(path, out):
    """The steady states by the command that is proposed, and its words."""
    code, listed = run_import(path)
    (line,) = [line for line in listed.splitlines() if line.startswith("  snrmjax import")]
    assert code == 0
    assert "import it (check the names):" in listed, listed
    assert "it will ask" not in listed, listed
    words = shlex.split(line)[2:-2]
    code, output = run_import(*words, "--out", out)
    assert code == 0, output
    return read_steady_states(out / "measured.csv"), words


def same(states):
    np.testing.assert_allclose(states.frequency, HERTZ * F, rtol=1e-12)
    np.testing.assert_allclose(states.force, FORCE, rtol=1e-12)
    np.testing.assert_allclose(np.asarray(states.velocity)[:, 0], VELOCITY, rtol=1e-12)


G, RAD, POUND, INCH = 9.80665, np.pi / 180, 4.4482216152605, 0.0254
# Names, the motion, and the factors from Hz, N, SI and degrees to the columns' units.
TABLES = [
    ("Hz;N;mm/s;deg", "velocity", (1, 1, 1e3, 1)),
    ("Hz;N;m/s²;°", "acceleration", (1, 1, 1, 1)),
    ("f_Hz;drive_mN;vel_mm_s;phase_deg", "velocity", (1, 1e3, 1e3, 1)),
    ("f_Hz;drive_mN;acc_g;phase_deg", "acceleration", (1, 1e3, 1 / G, 1)),
    ("freq_kHz;force_N;disp_um;phi_rad", "displacement", (1e-3, 1, 1e6, RAD)),
    ("Frequenz / Hz;Kraft / N;Geschw. / (mm/s);Phase / °", "velocity", (1, 1, 1e3, 1)),
    ("Erregerfrequenz in Hz;Kraft in N;Weg in µm;Phase in rad", "displacement", (1, 1, 1e6, RAD)),
    ("Fréquence (Hz);Force (N);Vitesse (mm/s);Phase (°)", "velocity", (1, 1, 1e3, 1)),
    ("Fréq. [Hz];Force [mN];Accél. [m/s²];Déphasage [deg]", "acceleration", (1, 1e3, 1, 1)),
    ("f/Hz;F/N;a/(m/s²);phi/rad", "acceleration", (1, 1, 1, RAD)),
    ("f/Hz;F/N;v/mm/s;phi/°", "velocity", (1, 1, 1e3, 1)),
    ("Freq, Hz;Force, lbf;Velocity, in/s;Phase, deg", "velocity", (1, 1 / POUND, 1 / INCH, 1)),
    ("freqHz;forceN;tip_mm;phaseDeg", "displacement", (1, 1, 1e3, 1)),
    ("frequency_hz;force_n;laser_mm_s;phase_deg", "velocity", (1, 1, 1e3, 1)),
    ("omega_rad_s;F_N;velocity_m_per_s;phase_deg", "velocity", (HERTZ, 1, 1, 1)),
    ("f (Hz);Kraft eff. (N);v eff. (mm/s);phi (°)", "velocity", (1, 1 / RMS, 1e3 / RMS, 1)),
    ("f_Hz;force_rms_N;acc_rms_g;phase_deg", "acceleration", (1, 1 / RMS, 1 / G / RMS, 1)),
    ("f [Hz];F [N] rms;v [m/s rms];phi [deg]", "velocity", (1, 1 / RMS, 1 / RMS, 1)),
    ("f [Hz];F_pp/N;v_pp_mm_s;phi [deg]", "velocity", (1, 2, 2e3, 1)),
]


@pytest.mark.parametrize(("names", "motion", "units"), TABLES)
def test_the_proposed_command_reads_units_in_names(tmp_path, names, motion, units):
    written(tmp_path / "sweep.csv", names, motion, units)
    states, words = proposed(tmp_path / "sweep.csv", tmp_path / "out")
    same(states)
    kind = "rms" if "rms" in names or "eff." in names else "peak_to_peak" if "pp" in names else ""
    assert ("--amplitude" in words) == bool(kind)
    assert not kind or words[words.index("--amplitude") + 1] == kind


def test_names_as_the_file_has_them_are_taken(tmp_path):
    names = "f [Hz];Kraft eff. (N);v eff. [mm/s];phi (°)"
    written(tmp_path / "sweep.csv", names, "velocity", (1, 1 / RMS, 1e3 / RMS, 1))
    columns = names.split(";")
    words = []
    for option, name in zip(("frequency", "force", "response", "phase"), columns, strict=True):
        words += [f"--{option}", name]
    out = tmp_path / "out"
    code, output = run_import(tmp_path / "sweep.csv", *words, "--out", out)
    assert code == 0, output
    assert "rms: from the names of the columns" in output
    same(read_steady_states(out / "measured.csv"))
    words[5] += ":velocity:m/s"  # stated options take precedence over the file
    words += ["--amplitude", "peak"]
    assert run_import(tmp_path / "sweep.csv", *words, "--out", out)[0] == 0
    velocity = np.asarray(read_steady_states(out / "measured.csv").velocity)[:, 0]
    np.testing.assert_allclose(velocity, VELOCITY * 1e3 / RMS, rtol=1e-12)


@pytest.mark.parametrize("response", ["F [m/s]", "F"])
def test_names_that_differ_only_in_their_units_are_distinguished(tmp_path, response):
    written(tmp_path / "sweep.csv", f"f [Hz];F [N];{response};phi [deg]")
    words = [
        "--force",
        "F [N]",
        "--response",
        f"{response}:velocity:m/s",
        "--out",
        tmp_path / "out",
    ]
    code, output = run_import(tmp_path / "sweep.csv", *words)
    assert code == 0, output
    same(read_steady_states(tmp_path / "out" / "measured.csv"))


def test_a_name_with_a_colon_is_taken(tmp_path):
    written(tmp_path / "sweep.csv", "f_Hz;Out:Force;In:velocity;phase_deg")
    words = ["--force", "Out:Force", "--force-unit", "N", "--response", "In:velocity"]
    code, output = run_import(
        tmp_path / "sweep.csv", *words, "--unit", "m/s", "--out", tmp_path / "o"
    )
    assert code == 0, output
    same(read_steady_states(tmp_path / "o" / "measured.csv"))


def test_one_column_rms_and_another_of_unknown_kind_are_asked_about(tmp_path):
    written(tmp_path / "sweep.csv", "f_Hz;Kraft eff. (N);v_mm_s;phase_deg")
    code, listed = run_import(tmp_path / "sweep.csv")
    assert code == 0
    assert "it will ask: names and units state rms for some columns but not for others" in listed


AMBIGUOUS = """m,g,s,A,V,in,min,ref_m,left_g,x_max_in,x_grad,v_rad,ch1_N,acc_mV,acc_mm_s,vel_ms,
f_n,torque_N_mm,torque_Nm,level 2 N,tip 10 g,ref_point"""


@pytest.mark.parametrize("name", AMBIGUOUS.replace("\n", "").split(","))
def test_an_ambiguous_ending_is_no_unit(name):
    assert label_of(name).unit == ""


@pytest.mark.parametrize("column", ["m", "left_g", "acc_mm_s"])
def test_what_a_name_leaves_open_is_asked_for(tmp_path, column):
    written(tmp_path / "sweep.csv", f"f_Hz;F_N;{column};phase_deg")
    code, listed = run_import(tmp_path / "sweep.csv")
    assert code == 0
    assert "UNIT, which the file does not state" in listed


TIME = np.arange(400) / 2000


@pytest.mark.parametrize(
    ("names", "units"),
    [
        ("t_s;force_N;velocity_m_s", (1, 1, 1)),
        ("Zeit / ms;Kraft / mN;Geschw. / (mm/s)", (1e3, 1e3, 1e3)),
        ("time_ms;drive_mN;vel_mm_s", (1e3, 1e3, 1e3)),
        ("Temps (s);N;mm/s", (1, 1, 1e3)),
        ("t/s;F/N;tip_mm_s", (1, 1, 1e3)),
        ("Zeit (ms);Kraft [mN];v (mm/s)", (1e3, 1e3, 1e3)),
    ],
)
def test_records_have_the_units_of_their_names(tmp_path, names, units):
    force, velocity = np.cos(300 * TIME), 0.5 * np.exp(-9 * TIME) * np.sin(300 * TIME)
    columns = np.array([TIME, force, velocity]).T * units
    rows = [";".join(map(repr, row)) for row in columns.tolist()]
    (tmp_path / "run.csv").write_text("\n".join([names, *rows]))
    (record,) = read_laboratory_file(tmp_path / "run.csv").recordings
    assert [channel.quantity for channel in record.channels] == ["force", "velocity"]
    assert record.sampling_rate == pytest.approx(2000, rel=1e-12)
    np.testing.assert_allclose(record.values(), [force, velocity], rtol=1e-12, atol=1e-15)
    code, listed = run_import(tmp_path / "run.csv")
    assert code == 0
    (line,) = [line for line in listed.splitlines() if line.startswith("  snrmjax import")]
    words = [*shlex.split(line)[2:-2], *([] if "--record" in line else ["--record", "broadband"])]
    code, output = run_import(*words, "--out", tmp_path / "out")
    assert code == 0, output
    written_names = ["--force", names.split(";")[1], "--response", names.split(";")[2]]
    more = [*written_names, "--record", "broadband", "--out", tmp_path / "as_written"]
    code, output = run_import(tmp_path / "run.csv", *more)
    assert code == 0, output
    wanted = np.array([TIME, force, velocity]).T
    for folder in ("out", "as_written"):
        imported = np.loadtxt(tmp_path / folder / "record.csv", delimiter=",", skiprows=1)
        np.testing.assert_allclose(imported, wanted, rtol=1e-12, atol=1e-15)


def test_a_rate_in_the_unit_of_its_name_and_roles_by_unit():
    roles = {
        "N": "force",
        "Hz": "frequency",
        "mm/s": "velocity",
        "time_ms": "time",
        "dt_us": "step",
    }
    assert {name: role_of(name) for name in roles} == roles
