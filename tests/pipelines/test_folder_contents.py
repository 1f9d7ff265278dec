"""A folder of a test: what is found in it, and the questions that it raises."""

import numpy as np
import pytest
from truths.matlab_writing import write_matlab
from truths.uff_writing import write_uff

from snrmjax.measure import Channel, frequency_responses, time_recording
from snrmjax.measure.states import with_levels_apart
from snrmjax.pipelines.folder_contents import read_test_files

HERTZ = 2 * np.pi
OWN, RATIO = 50 * HERTZ, 0.01
MODEL = 'name = "beam"\n[[mode]]\nfrequency_hz = 50\ndamping_ratio = 0.01\n'
SENSOR = "shape = { tip = 1.0 }\nparticipation = 1.0\n"
STATES = "level,frequency_hz,force_n,velocity_re_m_s,velocity_im_m_s\n"
ROWS = "1,49.0,1.0,0.1,0.05\n1,50.0,1.0,0.15,0.0\n2,49.5,2.0,0.2,0.08\n"


def responses(scale=1.0):
    """Mobility of one mode at its drive point."""
    omega = HERTZ * np.linspace(45, 55, 60)
    values = scale * 1j * omega / (OWN**2 - omega**2 + 2j * RATIO * OWN * omega)
    attachment = {"point": "1", "direction": "+z"}
    return frequency_responses(
        omega,
        values[None, None],
        [Channel("tip", "velocity", "m/s", **attachment)],
        [Channel("force", "force", "N", **attachment)],
    )


def record():
    """A tone of 2 s."""
    time = np.arange(1000) / 500
    both = np.stack([np.cos(OWN * time), 0.1 * np.cos(OWN * time)])
    return time_recording(both, [Channel("force", "force"), Channel("tip", "velocity")], 500)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "model.toml").write_text(MODEL + SENSOR)
    (tmp_path / "a_states.csv").write_text(STATES + ROWS)
    write_uff(tmp_path / "frf.uff", responses=[responses()])
    write_matlab(tmp_path / "sines.mat", recordings=[record(), record()])
    (tmp_path / "notes.txt").write_text("warm day\n")
    (tmp_path / ".hidden").write_text("")
    (tmp_path / "older").mkdir()
    return tmp_path


def test_every_file_is_read_by_its_content(folder):
    found = read_test_files(folder)
    assert found.model is not None
    rows = dict(found.rows())
    assert rows["model.toml"] == "model with 1 mode"
    assert rows["a_states.csv"] == "3 steady states on 2 levels"
    assert rows["frf.uff"] == "1 × 1 frequency responses of 60 lines"
    assert rows["notes.txt"].startswith("not used")
    assert len([name for name in rows if name.startswith("sines.mat: ")]) == 2
    assert "record of 2 s at 500 Hz: force, tip" in rows.values()
    states = found.states[0].of_model(found.model)
    assert states.sensors == ("tip",)
    np.testing.assert_allclose(states.frequency / HERTZ, [49, 50, 49.5])
    assert [one.level.tolist() for one in with_levels_apart([states, states])] == [
        [1, 1, 2],
        [3, 3, 4],
    ]


def test_a_map_with_a_table_of_other_names_is_used(tmp_path):
    (tmp_path / "log.csv").write_text(
        "Freq [Hz],Load [N],V [mm/s],Phase [deg]\n49,1,111.8,26.565\n50,1,150,0\n51,1,100,-30\n"
    )
    with pytest.raises(ValueError, match=r"snrmjax import .*log\.csv.*--map imported/map\.toml"):
        read_test_files(tmp_path)
    (tmp_path / "map.toml").write_text(
        'force = "Load"\nfrequency = "Freq"\namplitude = "peak"\nphase_unit = "deg"\n'
        'phase_sign = "lead"\nlevel = "file"\n'
        '[[response]]\nchannel = "V"\nquantity = "velocity"\nunit = "mm/s"\nphase = "Phase"\n'
    )
    (found,) = read_test_files(tmp_path).states
    np.testing.assert_allclose(
        found.states.velocity[:, 0], [0.1 + 0.05j, 0.15, 0.1 * np.exp(-1j * np.pi / 6)], atol=1e-5
    )


def test_what_people_wrote_and_a_map_assumed_is_kept_for_the_report(folder):
    (folder / "technician.txt").write_text("sensor glued anew\n\n" + 70 * "x\n")
    (folder / "map.toml").write_text(
        '# note: 2 rows are incomplete.\nforce = "F"  # channel of the force\n'
        'phase_sign = "lead"  # assumed: lead: ahead (lead: ahead)\n'
    )
    (folder / "sines.mat").unlink()  # which the map does not assign
    texts = dict(read_test_files(folder).texts)
    assert texts["notes.txt"] == ("warm day",)
    assert texts["technician.txt"][0] == "sensor glued anew"
    assert texts["technician.txt"][-1] == "… 11 further lines"
    first, _, last = texts["map.toml"]
    assert first == "# note: 2 rows are incomplete."
    assert last.startswith('phase_sign = "lead"  # assumed: lead: ahead')


def broken(folder, name, content=b"\0garbage"):
    (folder / name).write_bytes(content)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda f: (f / "other.toml").write_text(MODEL + SENSOR), "which is the model"),
        (lambda f: (f / "model.toml").write_text(MODEL), "shape"),
        (lambda f: broken(f, "cut.mat"), "cut.mat is of no known format"),
        (lambda f: broken(f, "empty.uff", b""), "empty.uff is empty"),
        (lambda f: (f / "a_states.csv").write_text(STATES + "1,49,1,nan,0\n"), "row 2"),
        (
            lambda f: write_uff(
                f / "frf.uff", responses=[responses(), responses(0.9)], levels=[1.0, 2.0]
            ),
            "are the responses of frf.uff, of 2 levels, steady states",
        ),
    ],
)
def test_what_would_be_a_guess_is_a_question(folder, change, complaint):
    change(folder)
    with pytest.raises(ValueError, match=complaint):
        read_test_files(folder)


def test_a_folder_without_measurements_is_refused(tmp_path):
    with pytest.raises(ValueError, match="must be a folder"):
        read_test_files(tmp_path / "nowhere")
    (tmp_path / "model.toml").write_text(MODEL + SENSOR)
    with pytest.raises(ValueError, match="has no measurements"):
        read_test_files(tmp_path)


def test_another_model_may_be_named(folder, tmp_path_factory):
    other = tmp_path_factory.mktemp("elsewhere") / "linear.toml"
    other.write_text((MODEL + SENSOR).replace("beam", "other beam"))
    found = read_test_files(folder, other)
    assert found.model.name == "other beam"
    assert dict(found.passed)["model.toml"] == "not used: the model is linear.toml"


def test_a_rate_of_few_digits_must_be_stated(tmp_path):
    """0.000488 s may be any rate from 2048 to 2051 Hz."""
    head = ["LabVIEW Measurement", "Separator\tTab", "X_Columns\tNo", "***End_of_Header***", ""]
    head += ["Channels\t2", "Y_Unit_Label\tN\tm/s", "Delta_X\t0.000488\t0.000488"]
    head += ["***End_of_Header***", "X_Value\tforce\ttip"]
    both = record().values()
    rows = [f"\t{a!r}\t{b!r}" for a, b in both.T.tolist()]
    (tmp_path / "steps.lvm").write_text("\n".join([*head, *rows]))
    with pytest.raises(ValueError, match=r"which sampling rate has steps\.lvm.*--rate 2048"):
        read_test_files(tmp_path)
    (one,) = read_test_files(tmp_path, rate=2048.0).records
    assert one.record.sampling_rate == 2048.0
    with pytest.raises(ValueError, match="which is right"):
        read_test_files(tmp_path, rate=1000.0)
    (tmp_path / "map.toml").write_text("rate = 2050.0\n")
    (one,) = read_test_files(tmp_path).records
    assert one.record.sampling_rate == 2050.0


def test_a_map_that_does_not_fit_is_named_in_the_error(tmp_path):
    folder = tmp_path / "test"
    folder.mkdir()
    (folder / "log.csv").write_text("Freq [Hz],Load [N],V [mm/s]\n49,1,111.8\n50,1,150\n")
    (tmp_path / "told.toml").write_text('force = "Load"\n[[response]]\nchannel = "V"\n')
    with pytest.raises(ValueError, match="where is the phase of V") as error:
        read_test_files(folder, map_file=tmp_path / "told.toml")
    assert str(error.value).startswith("log.csv, read with told.toml: ")
    assert "--map" not in str(error.value)
    assert "Without a map" not in str(error.value)


def test_a_map_elsewhere_replaces_the_folders(tmp_path):
    folder = tmp_path / "test"
    folder.mkdir()
    (folder / "log.csv").write_text(
        "Freq [Hz],Load,V [mm/s],Phase [deg]\n49,1,111.8,26.565\n50,1,150,0\n51,1,100,-30\n"
    )
    (folder / "map.toml").write_text('force = "Nothing"\n')
    (tmp_path / "told.toml").write_text(
        'force = "Load"\nforce_unit = "mN"\nfrequency = "Freq"\n[[response]]\nchannel = "V"\n'
    )
    (found,) = read_test_files(folder, map_file=tmp_path / "told.toml").states
    np.testing.assert_allclose(found.states.force, 1e-3)
