"""`snrmjax import`: raw laboratory files give back the numbers they were made from."""

from pathlib import Path

import numpy as np
import pytest
import scipy.io
from truths.import_runs import run_import as run
from truths.uff_writing import write_uff

from snrmjax.io import read_steady_states, write_steady_states
from snrmjax.io.exchange.exports import write_netcdf
from snrmjax.io.exchange.import_map import read_import_map
from snrmjax.measure import Channel, steady_states, time_recording
from snrmjax.measure.recordings.frequency_responses import frequency_responses

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
HERTZ = 2 * np.pi
F = np.array([79.0, 79.5, 80.0, 79.0, 79.5, 80.0])  # Hz
LEVEL = np.array([1, 1, 1, 2, 2, 2])
FORCE = np.array([0.1, 0.11, 0.12, 0.4, 0.41, 0.42])  # N
VELOCITY = np.array([0.1 + 0.2j, 0.3, 0.2 - 0.2j, 0.4 + 0.8j, 1.2, 0.8 - 0.8j])  # m/s


def imported(tmp_path, *words):
    code, output = run(*words, "--out", tmp_path / "out")
    assert code == 0, output
    return read_steady_states(tmp_path / "out" / "measured.csv")


def same(states, rtol):
    """The states are those of the table above: `rtol` is the rounding of the unit conversions."""
    np.testing.assert_array_equal(states.level, LEVEL)
    np.testing.assert_allclose(states.frequency, F * HERTZ, rtol=1e-15)
    np.testing.assert_allclose(states.force, FORCE, rtol=rtol)
    np.testing.assert_allclose(np.asarray(states.velocity)[:, 0], VELOCITY, rtol=rtol)


def amplitude_and_phase():
    """An acceleration in g rms with a lagging phase, as some programs write it."""
    acceleration = VELOCITY * 1j * HERTZ * F / 9.80665 / np.sqrt(2)
    return np.abs(acceleration), -np.degrees(np.angle(acceleration))


@pytest.fixture
def mat(tmp_path):
    amplitude, phase = amplitude_and_phase()
    kinds = [(key, object) for key in ("frequency", "force", "amplitude", "phase")]
    rows = [
        (F[at], FORCE[at] / np.sqrt(2), amplitude[at], phase[at])
        for at in (slice(0, 3), slice(3, 6))
    ]
    path = tmp_path / "test.mat"
    scipy.io.savemat(path, {"data": np.array(rows, dtype=kinds)})
    return path


MAT = (
    *("--force", "force", "--force-unit", "N", "--response", "amplitude:acceleration"),
    *("--unit", "g", "--phase-unit", "deg", "--phase-sign", "lag", "--amplitude", "rms"),
)


def test_a_struct_of_matlab_with_one_entry_a_level(tmp_path, mat):
    same(imported(tmp_path, mat, *MAT, "--sensor", "tip"), 1e-14)
    assert imported(tmp_path, mat, *MAT, "--sensor", "tip").sensors == ("tip",)


def test_the_map_takes_the_next_test(tmp_path, mat):
    imported(tmp_path, mat, *MAT)
    first = (tmp_path / "out" / "measured.csv").read_bytes()
    map_path = tmp_path / "out" / "map.toml"
    text = map_path.read_text()
    assert 'level = "entry"  # assumed: from the name of the column' in text
    assert read_import_map(map_path).level == "entry"
    code, output = run(mat, "--map", map_path, "--out", tmp_path / "next")
    assert code == 0, output
    assert (tmp_path / "next" / "measured.csv").read_bytes() == first
    assert read_import_map(tmp_path / "next" / "map.toml") == read_import_map(map_path)
    code, output = run(mat, "--map", map_path, "--unit", "m/s^2", "--out", tmp_path / "other")
    assert code == 0, output
    other = read_steady_states(tmp_path / "other" / "measured.csv")
    np.testing.assert_allclose(np.asarray(other.velocity)[:, 0] * 9.80665, VELOCITY, rtol=1e-14)


def test_a_lock_in_of_another_country(tmp_path):
    path = tmp_path / "lockin.csv"
    rows = zip(F, FORCE * 1e3, VELOCITY.real * 1e3, VELOCITY.imag * 1e3, strict=True)
    lines = [";".join(f"{value!r}".replace(".", ",") for value in map(float, row)) for row in rows]
    path.write_text("\n".join(["Frequenz;Kraft;X;Y", "Hz;mN;mm/s;mm/s", *lines]), "cp1252")
    same(imported(tmp_path, path, "--force", "Kraft", "--response", "X:velocity"), 1e-14)


def test_responses_over_the_force_and_a_force_of_its_own_phase(tmp_path):
    path = tmp_path / "over.csv"
    ratio = VELOCITY / FORCE * np.exp(1j * 0.0)
    rows = np.column_stack([F, FORCE, ratio.real, ratio.imag])
    lines = "\n".join(",".join(map(repr, row)) for row in rows.tolist())
    path.write_text(f"f (Hz),F (N),re (m/s/N),im (m/s/N)\n{lines}\n")
    words = ("--force", "F", "--response", "re", "--over-force")
    same(imported(tmp_path, path, *words, "--imaginary", "im"), 1e-14)
    rotation = np.exp(1j * np.radians(100 + 3 * np.arange(6)))
    rows = np.column_stack(
        [
            *(F, FORCE, np.degrees(np.angle(rotation)), np.abs(VELOCITY)),
            np.degrees(np.angle(VELOCITY * rotation)),
        ]
    )
    lines = "\n".join(",".join(map(repr, row)) for row in rows.tolist())
    path.write_text(f"f (Hz),F (N),fp (deg),v (m/s),vp (deg)\n{lines}\n")
    words = ("--force", "F", "--force-phase", "fp", "--response", "v", "--phase", "vp")
    states = imported(tmp_path, path, *words)
    np.testing.assert_allclose(np.asarray(states.velocity)[:, 0], VELOCITY, rtol=0, atol=2e-15)


@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_complex_phasors_of_the_other_sign_are_conjugated(tmp_path, angle):
    """e^(-iwt), of a force with a phase of its own: both are conjugated."""
    phase = np.exp(1j * angle)
    columns = {"freq": F, "F": (FORCE * phase).conj(), "v": (VELOCITY * phase).conj()}
    scipy.io.savemat(tmp_path / "test.mat", columns)
    words = ("--force", "F", "--force-unit", "N", "--response", "v:velocity:m/s")
    # Modulus and angle of the force: three roundings.
    same(imported(tmp_path, tmp_path / "test.mat", *words, "--phase-sign", "lag"), 1e-14)


def sets():
    """Spectra of force and acceleration relative to a generator signal, one set a level."""
    spectra = []
    for at in (slice(0, 3), slice(3, 6)):
        rotation = np.exp(0.7j)  # of the amplifier
        values = np.stack([FORCE[at] * rotation, VELOCITY[at] * 1j * HERTZ * F[at] * rotation])
        spectra.append(
            frequency_responses(
                HERTZ * F[at],
                values[:, None, :],
                [
                    Channel("CH1", "force", "N", 1.0, "1", "+z"),
                    Channel("CH2", "acceleration", "m/s^2", 1.0, "2", "+z"),
                ],
                [Channel("out", "voltage", "V", 1.0, "3", "+z")],
            )
        )
    return spectra


def test_spectra_of_uff(tmp_path):
    path = tmp_path / "test.uff"
    write_uff(path, responses=sets(), levels=[1.0, 2.0])
    code, output = run(path)
    assert code == 0
    assert "z axis 2" in output
    from snrmjax.io.laboratory import read_laboratory_file

    names = [c.name for c in read_laboratory_file(path).responses[0].responses]
    # 1/(iΩ) and the division by the force's phase: three roundings.
    same(imported(tmp_path, path, "--force", names[0], "--response", names[1]), 1e-14)


def test_responses_of_uff_with_the_force_on_the_z_axis(tmp_path):
    path = tmp_path / "frf.uff"
    one = frequency_responses(
        HERTZ * F[:3],
        (VELOCITY[:3] / 0.1)[None, None],
        [Channel("v", "velocity")],
        [Channel("f", "force")],
    )
    write_uff(path, responses=[one, one], levels=[0.1, 0.2])
    words = ("--response", "1", "--force-amplitude")
    from snrmjax.io.laboratory import read_laboratory_file

    name = read_laboratory_file(path).responses[0].responses[0].name
    states = imported(tmp_path, path, "--response", name, "--force-amplitude", "z")
    np.testing.assert_array_equal(states.force, np.repeat([0.1, 0.2], 3))
    expected = np.concatenate([VELOCITY[:3], 2 * VELOCITY[:3]])
    np.testing.assert_allclose(np.asarray(states.velocity)[:, 0], expected, rtol=1e-15)
    del words


def stepped(n_steps=4):
    """A record of steps, in volts of a load cell and of an accelerometer of 100 mV/g."""
    rate, dwell = 1000, 2.0
    t = np.arange(int(n_steps * dwell * rate)) / rate
    step = (t / dwell).astype(int)
    hertz = 20.0 + step
    phase = np.cumsum(HERTZ * hertz / rate)
    force = 2 * np.cos(phase)
    acceleration = 0.1 * HERTZ * hertz * np.cos(phase + 0.2 + np.pi / 2)  # velocity of 0.1 m/s
    return time_recording(
        np.stack([force / 50, acceleration / 98.0665]),
        [Channel("CH1", "voltage", "V"), Channel("CH2", "voltage", "V")],
        rate,
    )


def test_a_record_of_steps_in_volts(tmp_path):
    path = tmp_path / "steps.nc"
    write_netcdf(path, stepped())
    words = ("--force", "CH1", "--force-unit", "50 N", "--response", "CH2:acceleration")
    states = imported(tmp_path, path, *words, "--unit", "10 g", "--level", "force")
    np.testing.assert_allclose(states.frequency, HERTZ * np.arange(20, 24), rtol=1e-5)
    np.testing.assert_allclose(states.force, 2.0, rtol=1e-4)
    velocity = np.asarray(states.velocity)[:, 0]
    np.testing.assert_allclose(velocity, 0.1 * np.exp(0.2j), rtol=1e-3)
    assert read_import_map(tmp_path / "out" / "map.toml").record == "steps"


def test_options_without_effect_are_refused(tmp_path):
    path = tmp_path / "steps.nc"
    write_netcdf(path, stepped())
    words = (path, "--force", "CH1", "--force-unit", "50 N", "--out", tmp_path / "out")
    code, output = run(*words, "--response", "CH2:acceleration:10 g", "--unit", "g")
    assert code == 2
    assert "--unit g is for responses without a stated unit" in output
    code, output = run(*words, "--response", "CH2:acceleration:10 g", "--phase-sign", "lag")
    assert code == 2
    assert "--phase-sign must be left out of the time records of steps.nc" in output


def test_our_own_table_is_conjugated(tmp_path):
    states = steady_states(LEVEL, F * HERTZ, FORCE, VELOCITY.conj())
    write_steady_states(tmp_path / "measured.csv", states)
    same(imported(tmp_path, tmp_path / "measured.csv", "--phase-sign", "lag"), 1e-15)


def test_a_decay_becomes_a_record(tmp_path):
    path = tmp_path / "decay.mat"
    t = np.arange(500) / 1000
    decay = np.exp(-3 * t) * np.cos(HERTZ * 40 * t)
    scipy.io.savemat(path, {"fs": 1000.0, "laser": decay})
    words = ("--response", "laser:velocity", "--unit", "mm/s", "--record", "decay")
    code, output = run(path, *words, "--out", tmp_path / "out")
    assert code == 0, output
    lines = (tmp_path / "out" / "record.csv").read_text().splitlines()
    assert lines[0] == "time_s,velocity_m_s"
    values = np.array([line.split(",") for line in lines[1:]], dtype=float)
    np.testing.assert_array_equal(values[:, 0], t)
    np.testing.assert_array_equal(values[:, 1], decay * 1e-3)


@pytest.mark.skipif(not DATA.is_dir(), reason="the measured data are not next to the clone")
@pytest.mark.parametrize("name", ["brake_reuss_beam/force_controlled.csv"])
def test_measured_tables_by_uff_and_by_matlab(tmp_path, name):
    states = read_steady_states(DATA / name)
    level, omega = np.asarray(states.level), np.asarray(states.frequency)
    velocity, force = np.asarray(states.velocity)[:, 0], np.asarray(states.force)
    curves = []
    for k in np.unique(level):
        at = np.flatnonzero(level == k)
        at = at[np.argsort(omega[at], kind="stable")]
        at = at[np.concatenate([[True], np.diff(omega[at]) > 0])]
        curves.append((at, k))
    kept = np.concatenate([at for at, _ in curves])
    responses = [
        frequency_responses(
            omega[at],
            np.stack([force[at] + 0j, velocity[at] * 1j * omega[at]])[:, None],
            [
                Channel("F", "force", "N", 1.0, "1", "+z"),
                Channel("A", "acceleration", "m/s^2", 1.0, "2", "+z"),
            ],
            [Channel("out", "voltage", "V", 1.0, "3", "+z")],
        )
        for at, _ in curves
    ]
    write_uff(tmp_path / "raw.uff", responses=responses, levels=[float(k) for _, k in curves])
    from snrmjax.io.laboratory import read_laboratory_file

    names = [c.name for c in read_laboratory_file(tmp_path / "raw.uff").responses[0].responses]
    back = imported(
        tmp_path, tmp_path / "raw.uff", "--force", names[0], "--response", names[1], "--level", "z"
    )
    entries = [
        (
            omega[at] / HERTZ,
            force[at],
            np.abs(velocity[at]) * omega[at] / 9.80665,
            np.degrees(np.angle(velocity[at])) + 90,
        )
        for at, _ in curves
    ]
    kinds = [(key, object) for key in ("freq", "force", "acc", "phase")]
    scipy.io.savemat(tmp_path / "raw.mat", {"d": np.array(entries, dtype=kinds)})
    also = imported(
        tmp_path,
        tmp_path / "raw.mat",
        "--force",
        "force",
        "--force-unit",
        "N",
        "--response",
        "acc:acceleration:g",
        "--phase-unit",
        "deg",
    )
    for states in (back, also):
        np.testing.assert_array_equal(states.level, level[kept])
        np.testing.assert_array_equal(states.force, force[kept])
        np.testing.assert_allclose(states.frequency, omega[kept], rtol=1e-15)
        # Magnitude and degrees and back: a few roundings of the number's magnitude.
        np.testing.assert_allclose(
            np.asarray(states.velocity)[:, 0], velocity[kept], rtol=2e-15 * 8, atol=0
        )


LOCK_IN = (
    "f,F,R [mm/s],Theta [deg],R_std,Theta_dev\n49,1,111.8,26.565,0.5,0.2\n50,1,150,0,0.6,0.1\n"
)


@pytest.mark.parametrize("asked", [(), ("--amplitude-std", "R_std", "--phase-std", "Theta_dev")])
def test_deviations_of_a_lock_in_are_propagated(tmp_path, asked):
    """Amplitudes in mm/s rms: √2 on both; phase errors in degrees, as the phases."""
    (tmp_path / "log.csv").write_text(LOCK_IN)
    words = ["--force", "F", "--force-unit", "N", "--response", "R:velocity:mm/s"]
    code, output = run(
        *(tmp_path / "log.csv", *words, "--amplitude", "rms", *asked, "--out", tmp_path / "out")
    )
    assert code == 0, output
    assert ("√N" in output) == (not asked)
    data = read_steady_states(tmp_path / "out" / "measured.csv")
    np.testing.assert_allclose(data.velocity_std[:, 0], np.sqrt(2) * np.array([5e-4, 6e-4]))
    np.testing.assert_allclose(np.degrees(data.phase_std[:, 0]), [0.2, 0.1])
    assert 'amplitude_std = "R_std"' in (tmp_path / "out" / "map.toml").read_text()
    again = run(
        *(tmp_path / "log.csv", "--map", tmp_path / "out" / "map.toml", "--out", tmp_path / "two")
    )
    assert again[0] == 0
    first, second = (tmp_path / one / "measured.csv" for one in ("out", "two"))
    assert first.read_text() == second.read_text()


@pytest.mark.parametrize(
    ("asked", "row", "complaint"),
    [
        (("--amplitude-std", "Rstd"), "", "did you mean R_std"),
        (("--phase-std", "Theta_dev"), "51,1,100,-30,0.5,-1\n", "row 3 has -1"),
    ],
)
def test_deviations_that_are_none_are_refused(tmp_path, asked, row, complaint):
    (tmp_path / "log.csv").write_text(LOCK_IN + row)
    words = ["--force", "F", "--force-unit", "N", "--response", "R:velocity:mm/s", *asked]
    code, output = run(tmp_path / "log.csv", *words, "--out", tmp_path / "out")
    assert code == 2
    assert complaint in output


def test_responses_of_an_impact_test_point_to_modes(tmp_path):
    omega = 2 * np.pi * np.linspace(10, 200, 80)
    tip = Channel("tip", "acceleration", "m/s^2", point="1", direction="+z")
    hammer = Channel("hammer", "force", "N", point="1", direction="-z")
    values = np.ones((1, 1, 80)) * (1 + 1j * omega)
    path = tmp_path / "impact.uff"
    write_uff(path, responses=[frequency_responses(omega, values, [tip], [hammer])])
    code, output = run(path)
    assert code == 0
    assert f"snrmjax modes {path} --drive-point SENSOR" in output
    assert "--force-amplitude NEWTONS --response tip:1+z" in output


def test_a_map_states_what_was_assumed(tmp_path):
    (tmp_path / "log.csv").write_text(LOCK_IN)
    words = ["--force", "F", "--force-unit", "N", "--response", "R:velocity:mm/s"]
    assert run(tmp_path / "log.csv", *words, "--out", tmp_path)[0] == 0
    lines = (tmp_path / "map.toml").read_text().splitlines()[1:]
    comments = dict(line.split("  # ", 1) for line in lines if "  # assumed: " in line)
    assert comments['amplitude = "peak"'] == "assumed: not stated (else rms, peak_to_peak)"
    assert comments['phase_unit = "deg"'] == "assumed: as stated in the file (else rad)"
    assert "leads the force" in comments['phase_sign = "lead"']
    assert comments['phase_sign = "lead"'].endswith("(else lag)")
    assert comments['frequency = "f"'] == "assumed: from the name of the column"
    assert "√N" in comments['amplitude_std = "R_std"']
    assert comments['sensor = "sensor 1"'].startswith("assumed: not stated")
    for line in lines:
        assert len(line.partition("# ")[2]) < 80, line


OWN = """level,frequency_hz,force_n,velocity_re_m_s,velocity_im_m_s,velocity_std_m_s,\
velocity_h3_re_m_s,velocity_h3_im_m_s,harmonic_std_m_s
1,49,2,0.3,0.4,0.01,0.03,0.06,0.003
2,50,4,0.6,0,0.02,0,0.09,0.005
"""


@pytest.mark.parametrize(
    ("words", "velocity", "third", "force"),
    [
        (["--unit", "g"], 9.80665 / (2j * np.pi), 9.80665 / (6j * np.pi), 1),
        (["--unit", "mm"], 2e-3j * np.pi, 6e-3j * np.pi, 1),
        (["--unit", "1.5 m/s", "--force-unit", "kN"], 1.5, 1.5, 1e3),
        (["--amplitude", "rms"], np.sqrt(2), np.sqrt(2), np.sqrt(2)),
    ],
)
def test_our_own_table_in_other_units_is_restated(tmp_path, words, velocity, third, force):
    """1/(ikΩ) of order k for accelerations, ikΩ for displacements."""
    (tmp_path / "measured.csv").write_text(OWN)
    code, output = run(tmp_path / "measured.csv", *words, "--out", tmp_path / "out")
    assert code == 0, output
    states = read_steady_states(tmp_path / "out" / "measured.csv")
    power = -1 if "g" in words else 1 if "mm" in words else 0
    factor = np.array([49.0, 50.0]) ** power
    np.testing.assert_allclose(states.velocity[:, 0], velocity * factor * [0.3 + 0.4j, 0.6])
    np.testing.assert_allclose(states.velocity_std[:, 0], abs(velocity) * factor * [0.01, 0.02])
    np.testing.assert_allclose(states.harmonics[:, 0, 0], third * factor * [0.03 + 0.06j, 0.09j])
    np.testing.assert_allclose(states.harmonic_std[:, 0], abs(third) * factor * [0.003, 0.005])
    np.testing.assert_allclose(states.force, np.array([2, 4]) * force)


def test_our_own_tables_force_may_be_a_voltage(tmp_path):
    (tmp_path / "measured.csv").write_text(OWN)
    words = ("--force-unit", "V", "--out", tmp_path / "out")
    assert run(tmp_path / "measured.csv", *words)[0] == 0
    states = read_steady_states(tmp_path / "out" / "measured.csv")
    np.testing.assert_allclose(states.drive, [2, 4])
    assert np.isnan(states.force).all()
    code, output = run(tmp_path / "measured.csv", "--force-unit", "g", "--out", tmp_path / "out")
    assert code == 2
    assert "must be a force or a voltage" in output


def test_a_map_states_which_files_were_read(tmp_path):
    (tmp_path / "our test.csv").write_text(OWN)
    out = tmp_path / "two" / "out"
    assert run(tmp_path / "our test.csv", "--out", out)[0] == 0
    assert "# files: '../../our test.csv'" in (out / "map.toml").read_text()
