"""Universal files: written by hand from the specification, by pyuff, and by ourselves."""

import shlex
import subprocess
import sys

import numpy as np
import pytest
from truths.import_runs import run_import
from truths.uff_writing import write_uff

from snrmjax.io.laboratory import read_laboratory_file
from snrmjax.io.tables import read_steady_states
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.frequency_responses import frequency_responses
from snrmjax.measure.recordings.time_recording import time_recording

# By the definition of the format (SDRC, "Universal Dataset Number: 58" and "164"), column by
# column: an FRF of an accelerometer in inches per second squared over pounds, at 3 frequencies.
HAND = """    -1
   164
         7IN: Inch (pound f)           2
  3.93700787401574800D+01  2.24808943099710500D-01  1.79999999999999990D+00
  4.59670000000000020D+02
    -1
    -1
    58
Measured FRF
NONE
24-NOV-26 10:00:00
NONE
NONE
    4         1    0         0       NONE        12   3       NONE         7  -1
         5         3         1  7.90000E+01  5.00000E-01  2.50000E+00
        18    0    0    0                 NONE                 NONE
        12    0    0    0                 NONE                 NONE
        13    0    0    0                 NONE                 NONE
         0    0    0    0                 NONE                 NONE
  1.00000E+00  2.00000E+00 -3.00000E+00  4.00000E+00  5.00000E-01 -6.00000E+00
    -1
"""


# pyuff leaves the handle of a 58b open, which is a warning: it writes in a process of its own.
BY_PYUFF = """
import sys, numpy as np, pyuff
common = dict(binary=1, rsp_node=1, rsp_dir=3, ref_node=1, ref_dir=3, id1="by pyuff")
frf = dict(func_type=4, abscissa_spacing=0, abscissa_spec_data_type=18,
    ordinate_spec_data_type=12, orddenom_spec_data_type=13, ordinate_axis_units_lab="g")
record = dict(func_type=1, abscissa_spacing=1, abscissa_spec_data_type=17,
    ordinate_spec_data_type=13, orddenom_spec_data_type=0)
x = np.array([79.0, 79.3, 80.0])
sets = [pyuff.prepare_58(x=x, data=np.full(3, z + 1j), z_axis_value=float(z), **common, **frf)
    for z in (1, 2)]
sets.append(pyuff.prepare_58(x=np.arange(9) / 2048, data=np.arange(9.0), **common, **record))
pyuff.UFF(sys.argv[1]).write_sets(sets, "add")
"""


@pytest.fixture(scope="module")
def by_pyuff(tmp_path_factory):
    path = tmp_path_factory.mktemp("pyuff") / "levels.uff"
    subprocess.run([sys.executable, "-c", BY_PYUFF, path], check=True)
    return read_laboratory_file(path)


def test_a_file_by_hand_in_inches_and_pounds(tmp_path):
    path = tmp_path / "inches.unv"
    path.write_text(HAND)
    contents = read_laboratory_file(path)
    (one,) = contents.responses
    assert contents.levels == (2.5,)
    assert one.responses[0].point == "12"
    assert one.responses[0].direction == "+z"
    assert one.references[0].direction == "-x"
    np.testing.assert_allclose(one.frequency / 2 / np.pi, [79, 79.5, 80], rtol=1e-15)
    # 1 in = 0.0254 m and 1 lbf = 4.4482216152605 N exactly
    expected = np.array([1 + 2j, -3 + 4j, 0.5 - 6j]) * 0.0254 / 4.4482216152605
    np.testing.assert_allclose(one.values[0, 0], expected, rtol=1e-12)


# Data sets that programs add: a header, nodes in two forms, elements, qualifiers.
AROUND = """    -1
   151
frame
    -1
    -1
  2411
        12         1         1        11
   1.0000000000000000D+01   0.0000000000000000D+00  -2.5000000000000000D+00
    -1
    -1
    15
        13         0         0        11  2.00000E+01  0.00000E+00  5.00000E+00
    -1
    -1
  2412
         1        11         2         1         7         2
         0         1         1
        12        13
    -1
    -1
  1858
           1           3           1           0           0           0
    -1
"""


def test_other_data_sets_are_listed_and_do_not_interfere(tmp_path):
    path = tmp_path / "whole.unv"
    path.write_text(AROUND + HAND)
    contents = read_laboratory_file(path)
    assert len(contents.responses) == 1
    assert contents.tables == ()
    left_out = {note["type"] for note in contents.notes if note.kind == "data_sets_not_read"}
    assert {2411, 2412, 1858} <= left_out
    words = ("--response", "12+z:acceleration", "--force-amplitude", "0.5", "--sensor", "tip")
    code, output = run_import(path, *words, "--out", tmp_path / "out")
    assert code == 0, output
    path.write_text(AROUND)
    with pytest.raises(ValueError, match=r"type 2412 \(elements\) not read"):
        read_laboratory_file(path)


def test_labels_of_windows_and_records_without_a_point(tmp_path):
    path = tmp_path / "western.unv"
    label = "(1/N)*(mm/s²)"
    text = HAND.replace(
        "        12    0    0    0                 NONE                 NONE",
        "        12    0    0    0 Acceleration         " + f"{label:<20}",
        1,
    )
    path.write_bytes(text.encode("cp1252"))
    (one,) = read_laboratory_file(path).responses
    assert one.responses[0].unit == label
    record = [
        *("    -1", "    58", "NONE", "made", "NONE", "NONE", "NONE"),
        "    1         0    0         0 NONE               0   0 NONE               0   0",
        "         2         3         1 0.00000E+000 5.00000E-005 0.00000E+000",
        "        17    0    0    0 Time                 s",
        "         1    0    0    0 strain 1x            m/s²",
        *["         0    0    0    0 NONE                 NONE"] * 2,
        " -3.81956E+00 -3.56616E+00 -2.98987E+00",
        "    -1",
        "",
    ]
    path.write_bytes("\n".join(record).encode("cp1252"))
    (back,) = read_laboratory_file(path).recordings
    assert back.channel_names == ("strain 1x",)
    assert back.channels[0].quantity == "acceleration"
    assert back.sampling_rate == 20000
    np.testing.assert_array_equal(back.values()[0], [-3.81956, -3.56616, -2.98987])


def test_levels_on_the_z_axis_and_labels_before_units(by_pyuff):
    assert by_pyuff.levels == (1.0, 2.0)
    one = by_pyuff.responses[1]
    np.testing.assert_array_equal(one.frequency, np.array([79.0, 79.3, 80.0]) * 2 * np.pi)
    np.testing.assert_allclose(one.values[0, 0], (2 + 1j) * 9.80665, rtol=1e-15)
    assert one.responses[0].unit == "g"
    assert one.responses[0].quantity == "acceleration"


def test_steps_of_six_digits_that_mean_a_whole_rate(by_pyuff):
    (record,) = by_pyuff.recordings
    assert record.sampling_rate == 2048  # the header has 4.88281e-04 s: 2048.002 Hz
    assert record.notes[0]["rate"] == 2048
    np.testing.assert_array_equal(record.values()[0], np.arange(9.0))


@pytest.mark.parametrize("binary", [True, False])
def test_round_trip_of_records_and_responses(tmp_path, binary):
    rng = np.random.default_rng(1)
    channels = [
        Channel("force", "force", "N"),
        Channel("3-y", "acceleration", "m/s^2", point="3", direction="-y"),
    ]
    record = time_recording(rng.normal(size=(2, 65)), channels, 51200, start_time=-0.25)
    hertz = np.array([42.70541, 42.70544, 42.8])  # two of them alike in six digits
    responses = frequency_responses(
        hertz * 2 * np.pi,
        rng.normal(size=(1, 1, 3)) + 1j,
        channels[1:],
        channels[:1],
        coherence=np.full((1, 1, 3), 0.875),
    )
    path = tmp_path / "mine.uff"
    write_uff(path, recordings=[record], responses=[responses], levels=[0.5], binary=binary)
    contents = read_laboratory_file(path)
    (back,) = contents.recordings
    assert (back.sampling_rate, back.start_time) == (51200, -0.25)
    assert back.channels == tuple(channels)
    if binary:
        np.testing.assert_array_equal(back.values(), record.values())
        np.testing.assert_array_equal(contents.responses[0].frequency, responses.frequency)
        np.testing.assert_array_equal(contents.responses[0].values, responses.values)
        np.testing.assert_array_equal(contents.responses[0].coherence, responses.coherence)
        assert contents.levels == (0.5,)
    else:  # twelve digits of values, six of uneven abscissae: the format's own precision
        np.testing.assert_allclose(back.values(), record.values(), rtol=6e-12)
        assert "frequencies_do_not_rise" in [note.kind for note in contents.notes]
        (table,) = contents.tables
        np.testing.assert_allclose(table.columns["frequency"], hertz, atol=5.1e-5)
        np.testing.assert_allclose(
            table.columns["3-y over force"], responses.values[0, 0], rtol=6e-12
        )


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda text: text[:-40], "within a data set"),
        (lambda text: text.replace("         5         3", "         5999999999"), "cannot hold"),
        (lambda text: text.replace("         5         3", "         5         9"), "has 3"),
        (lambda text: text.replace("         5         3", "         7         3"), "type 7"),
        (lambda text: text.replace("  1.00000E+00", "  one        "), "damaged"),
        (lambda text: text.replace("3.93700787401574800D+01", "0.00000000000000000D+00"), "posit"),
        (lambda text: text.replace("         1  7.9", "         1  NaN"), "damaged|finite"),
    ],
)
def test_damaged_files_are_refused(tmp_path, change, complaint):
    path = tmp_path / "hurt.unv"
    path.write_text(change(HAND))
    with pytest.raises(ValueError, match=complaint):
        read_laboratory_file(path)


ABSCISSA = "        18    0    0    0                 NONE                 NONE"


@pytest.mark.parametrize(
    ("label", "factor"), [("kHz", 1e3), ("rad/s", 0.5 / np.pi), ("rpm", 1 / 60), ("Hz", 1.0)]
)
def test_the_unit_of_the_abscissa_is_obeyed(tmp_path, label, factor):
    path = tmp_path / "a.uff"
    path.write_text(HAND.replace(ABSCISSA, ABSCISSA[:-20] + f"{label:>20}"))
    contents = read_laboratory_file(path)
    (responses,) = contents.responses
    hertz = factor * np.array([79.0, 79.5, 80.0])
    np.testing.assert_allclose(responses.frequency, 2 * np.pi * hertz, rtol=1e-12)
    notes = [note.kind for note in contents.notes]
    assert ("abscissa_converted" in notes) == (label != "Hz")


@pytest.mark.parametrize(("kind", "what"), [(19, "a rotation speed"), (20, "an order")])
def test_responses_over_another_abscissa_are_a_table(tmp_path, kind, what):
    path = tmp_path / "a.uff"
    path.write_text(HAND.replace(ABSCISSA, ABSCISSA.replace("18", str(kind))))
    contents = read_laboratory_file(path)
    assert not contents.responses
    assert "frequency" not in contents.tables[0].columns
    assert any(what in str(note) for note in contents.notes)


def test_responses_of_falling_frequencies_are_responses(tmp_path):
    path = tmp_path / "a.uff"
    path.write_text(HAND.replace("  7.90000E+01  5.00000E-01", "  8.00000E+01 -5.00000E-01"))
    rising, falling = tmp_path / "b.uff", read_laboratory_file(path).responses[0]
    rising.write_text(HAND)
    expected = read_laboratory_file(rising).responses[0]
    np.testing.assert_array_equal(falling.frequency, expected.frequency)
    np.testing.assert_array_equal(falling.values, expected.values[..., ::-1])


def test_a_table_of_responses_is_imported_per_newton(tmp_path):
    """Doubled frequencies make a table: its numbers are per newton, as those of responses."""
    path, out = tmp_path / "a.uff", tmp_path / "out"
    path.write_text(HAND.replace("  7.90000E+01  5.00000E-01", "  7.90000E+01  0.00000E+00"))
    code, output = run_import(path)
    assert code == 0
    command = next(line for line in output.splitlines() if "snrmjax import" in line)
    assert "--over-force" in command
    words = shlex.split(command.replace("NEWTONS", "2"))[2:-2]
    code, output = run_import(*words, "--out", out)
    assert code == 0, output
    velocity = np.asarray(read_steady_states(out / "measured.csv").velocity)[:, 0]
    # Inches per second squared over pounds: 1 − 2j at 79 Hz, for 2 N.
    acceleration = 2 * 0.0254 / 4.4482216152605 * (1 + 2j)
    np.testing.assert_allclose(abs(velocity[0]), abs(acceleration) / (2 * np.pi * 79), rtol=1e-5)
