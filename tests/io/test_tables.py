"""Tables: round trips, accepted files, and refusals with their messages."""

import dataclasses
import os
import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from snrmjax.io.tables import group_states, read_steady_states, write_steady_states, write_table
from snrmjax.measure.states import SteadyStates, join_steady_states, steady_states
from snrmjax.model.builders.beams import flat_beam

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"

TABLE = """\
level,frequency_hz,force_n,velocity_re_m_s,velocity_im_m_s
1,79.0,0.1,0.01,0.002
1,80.0,0.1,0.02,-0.003
2,80.5,0.2,0.03,0.004
"""

COLUMNS = TABLE.splitlines()[0]


def read(tmp_path, content, sensors=None):
    path = tmp_path / "beam.csv"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_steady_states(path, sensors=sensors)


def same(one: SteadyStates, other: SteadyStates) -> bool:
    """Equal to the last bit, except for one rounding of numbers in Hz or degrees."""
    for name in (field.name for field in dataclasses.fields(SteadyStates)):
        a, b = getattr(one, name), getattr(other, name)
        if name == "notes":
            continue  # a note on the file
        if name in ("sensors", "harmonic_order", "base"):
            equal = a == b
        elif name in ("frequency", "phase_std"):
            # A quotient and a product, each correctly rounded: two units in the last place.
            equal = np.allclose(a, b, rtol=2 * np.finfo(float).eps, atol=5e-324, equal_nan=True)
        else:
            equal = np.array_equal(a, b, equal_nan=name != "sensors" and a.dtype != bool)
        if not equal:
            return False
    return True


def with_column(name, values, table=TABLE):
    """The table with one more column."""
    cells = [name, *values]
    return "".join(f"{line},{cell}\n" for line, cell in zip(table.splitlines(), cells, strict=True))


# ------------------------------------------------------------------------------ accepted


def test_reads_units_and_order(tmp_path):
    data = read(tmp_path, TABLE)
    assert data.notes == ()
    np.testing.assert_array_equal(data.level, [1, 1, 2])
    np.testing.assert_array_equal(data.frequency, np.array([79.0, 80.0, 80.5]) * 2 * np.pi)
    np.testing.assert_array_equal(data.force, [0.1, 0.1, 0.2])
    np.testing.assert_array_equal(
        data.velocity[:, 0], [0.01 + 0.002j, 0.02 - 0.003j, 0.03 + 0.004j]
    )
    assert data.sensors == ("sensor 1",)
    assert bool(jnp.all(data.measured))
    for unstated in (data.velocity_std, data.phase_std, data.force_std, data.drive, data.order):
        assert bool(jnp.all(jnp.isnan(unstated)))


def test_reads_every_optional_column(tmp_path):
    header = (
        "harmonic_std_m_s,velocity_h3_im_m_s,velocity_h3_re_m_s,velocity_h0_m_s,"
        "velocity_h12_re_m_s,velocity_h12_im_m_s,order,"
        "force_std_n,phase_std_deg,velocity_std_m_s,sensor,velocity_im_m_s,velocity_re_m_s,"
        "drive_v,frequency_hz,level"
    )
    row = "1e-5,2.,+1.5,-.5,7,8,0.25,0.01,90,1E-3,tip,0,.5,3,50,-2"
    data = read(tmp_path, f"{header}\n{row}\n", ("tip",))
    assert data.notes == ()
    assert data.harmonic_order == (0, 3, 12)
    np.testing.assert_array_equal(data.harmonics[0, 0], [-0.5 + 0j, 1.5 + 2j, 7 + 8j])
    np.testing.assert_array_equal(data.harmonic_std, [[1e-5]])
    np.testing.assert_array_equal(data.order, [0.25])
    np.testing.assert_array_equal(data.force_std, [0.01])
    np.testing.assert_array_equal(data.phase_std, [[90.0 * (np.pi / 180.0)]])
    np.testing.assert_array_equal(data.velocity_std, [[1e-3]])
    np.testing.assert_array_equal(data.drive, [3.0])
    np.testing.assert_array_equal(data.level, [-2])
    assert bool(jnp.isnan(data.force[0]))


ODDITIES = {
    "spaces around fields": TABLE.replace(",", " ,\t ").replace("\n", "  \n"),
    "Windows line ends": TABLE.replace("\n", "\r\n"),
    "old Macintosh line ends": TABLE.replace("\n", "\r"),
    "byte-order mark": "\ufeff" + TABLE,
    "byte-order mark and Windows line ends": "\ufeff" + TABLE.replace("\n", "\r\n"),
    "trailing blank lines": TABLE + "\n\n  \n\t\n",
    "trailing blank lines, Windows": (TABLE + "\n\n").replace("\n", "\r\n"),
    "no newline at the end": TABLE.rstrip("\n"),
    "quoted fields": re.sub(r"([^,\n]+)", r'"\1"', TABLE),
    "quoted fields with spaces around them": re.sub(r"([^,\n]+)", r' "\1" ', TABLE),
    "quoted fields with spaces in them": re.sub(r"([^,\n]+)", r'" \1 "', TABLE),
    "other column order": "".join(
        ",".join(reversed(line.split(","))) + "\n" for line in TABLE.splitlines()
    ),
    "levels with a point": re.sub(r"^(\d),", r"\1.0,", TABLE, flags=re.M),
    "exponents and signs": TABLE.replace("79.0", "+7.9E+01").replace("-0.003", "-3e-3"),
    "points without digits on one side": TABLE.replace("79.0", "79.").replace("0.1", ".1"),
}


@pytest.mark.parametrize("oddity", ODDITIES)
def test_accepts(tmp_path, oddity):
    reading = read(tmp_path, ODDITIES[oddity])
    assert reading.notes == ()
    assert same(reading, read(tmp_path, TABLE))


@pytest.mark.parametrize(
    ("content", "note"),
    [
        (with_column("comment", ["a", "", "°"]), r"column `comment` of beam\.csv is not used\."),
        (with_column("phase_st_deg", [1, 1, 1]), r"not used \(did you mean `phase_std_deg`\?\)"),
        (with_column("", ["", "", ""]), r"column 6 of beam\.csv has no name"),
        (with_column(",", [",", ",", ","]), r"column 7 of beam\.csv has no name"),
        (with_column("temperature_c", [1, 2, "nan"]), "`temperature_c`"),
        (with_column("velocity_m_s", [1, 2, 3]), "`velocity_m_s`"),
        (with_column("drive_mv", [1, 2, 3]), "`drive_mv`"),
        (
            f'{COLUMNS},"two\nlines"\n1,79.0,0.1,0.01,0.002,"a\nb"\n'
            "1,80.0,0.1,0.02,-0.003,c\n2,80.5,0.2,0.03,0.004,d\n",
            r"'two\\nlines'",
        ),
        (with_column("harmonic_std_m_s", [1, 1, 1]), "has no harmonics"),
        (with_column("velocity_std_m_s", [1, "", ""]), r"in 2 of 3 rows .*\(first in row 3\)"),
        (with_column("order", ["", " ", ""]), r"`order` is not stated in 3 of 3 rows"),
    ],
)
def test_accepts_with_a_note(tmp_path, content, note):
    reading = read(tmp_path, content)
    plain = read(tmp_path, TABLE)
    np.testing.assert_array_equal(reading.velocity, plain.velocity)
    assert any(re.search(note, text) for text in map(str, reading.notes))
    assert all("\n" not in text and text.endswith(".") for text in map(str, reading.notes))


def test_a_model_gives_the_sensors_and_is_all_that_an_identification_needs(tmp_path):
    beam = flat_beam()
    content = f"{COLUMNS},sensor,comment\n1,79.0,0.1,0.01,0.002,midspan,a\n"
    (tmp_path / "beam.csv").write_text(content)
    for model in (beam, beam.modes):
        assert read_steady_states(tmp_path / "beam.csv", model).sensors == beam.modes.sensors
    with pytest.raises(ValueError, match="must be one of the model's"):
        read(tmp_path, content, ("tip",))


def test_joined_states_keep_each_note_once(tmp_path):
    one = read(tmp_path, with_column("comment", ["a", "b", "c"]))
    two = read(tmp_path, TABLE)
    assert join_steady_states(one, two, one).notes == one.notes != ()


def test_an_empty_harmonic_is_not_measured(tmp_path):
    table = with_column("velocity_h2_re_m_s", [1, "", 3])
    table = with_column("velocity_h2_im_m_s", [4, "", 6], table)
    table = with_column("velocity_h0_m_s", ["", 8, 9], table)
    data = read(tmp_path, table)
    assert len(data.notes) == 3
    np.testing.assert_array_equal(
        data.harmonics[:, 0, 1], [1 + 4j, complex(np.nan, np.nan), 3 + 6j]
    )
    np.testing.assert_array_equal(data.harmonics[:, 0, 0], [complex(np.nan, np.nan), 8, 9])


# ------------------------------------------------------------------------------ several sensors

SENSORS = """\
level,frequency_hz,force_n,velocity_re_m_s,velocity_im_m_s,sensor
1,79.0,0.1,0.01,0,a
1,79.0,0.1,0.02,0,b
1,80.0,0.1,0.03,0,b
1,79.0,0.1,0.04,0,a
1,79.0,0.1,0.05,0,b
1,79.0,0.2,0.06,0,a
"""
GROUPED = [[0.01, 0.02], [0.0, 0.03], [0.04, 0.05], [0.06, 0.0]]


def test_an_amplitude_alone_has_no_phase(tmp_path):
    header = "level,frequency_hz,force_n,velocity_m_s,phase_std_deg"
    table = f"{header}\n1,79,0.1,0.2,1\n1,80,0.1,0.3,1\n"
    reading = read(tmp_path, table)
    states = reading
    np.testing.assert_array_equal(states.velocity[:, 0], [0.2, 0.3])
    assert np.all(states.phase_unknown)
    assert any("velocity amplitude only" in str(note) for note in reading.notes)
    assert any("`phase_std_deg`" in str(note) for note in reading.notes)
    # The written file reads back the same.
    write_steady_states(tmp_path / "again.csv", states)
    assert np.all(read_steady_states(tmp_path / "again.csv").phase_unknown)


def test_phases_that_are_hardly_known_are_unknown(tmp_path):
    states = read(tmp_path, with_column("phase_std_deg", [59.9, 60, ""]))
    np.testing.assert_array_equal(states.phase_unknown[:, 0], [False, True, False])


def test_sensors_of_one_state_share_it(tmp_path):
    data = read(tmp_path, SENSORS)
    assert data.sensors == ("a", "b")
    np.testing.assert_array_equal(data.velocity.real, GROUPED)
    np.testing.assert_array_equal(data.measured, np.array(GROUPED) != 0)
    np.testing.assert_array_equal(data.force, [0.1, 0.1, 0.1, 0.2])
    np.testing.assert_array_equal(data.frequency / (2 * np.pi), [79.0, 80.0, 79.0, 79.0])


def test_rows_may_be_sorted_by_sensor(tmp_path):
    header, *rows = SENSORS.splitlines()
    by_sensor = sorted(rows, key=lambda row: row[-1])
    data = read(tmp_path, "\n".join([header, *by_sensor]))
    order = np.argsort(np.asarray(data.velocity.real[:, 0]) + np.asarray(data.velocity.real[:, 1]))
    expected = np.array(GROUPED)[np.argsort(np.sum(GROUPED, axis=1))]
    np.testing.assert_array_equal(np.asarray(data.velocity.real)[order], expected)


def test_sensors_come_in_the_order_of_the_model(tmp_path):
    data = read(tmp_path, SENSORS, ("b", "unused", "a"))
    assert data.sensors == ("b", "unused", "a")
    np.testing.assert_array_equal(data.velocity.real, np.array([[b, 0.0, a] for a, b in GROUPED]))
    assert not np.any(data.measured[:, 1])


def test_test_order_distinguishes_repeats(tmp_path):
    table = with_column("order", [0, 0.5, 0.1, 0.5, 0, ""], SENSORS)
    data = read(tmp_path, table)
    expected = [[0.01, 0.05], [0.04, 0.02], [0.0, 0.03], [0.06, 0.0]]
    np.testing.assert_array_equal(data.velocity.real, expected)


def test_one_sensor_takes_the_name_of_the_model(tmp_path):
    assert read(tmp_path, TABLE, ("tip",)).sensors == ("tip",)


def test_force_std_belongs_to_the_state(tmp_path):
    table = with_column("force_std_n", [0.01, "", 0.02, "", 0.03, 0.04], SENSORS)
    data = read(tmp_path, table)
    np.testing.assert_array_equal(data.force_std, [0.01, 0.02, 0.03, 0.04])


def test_group_states_is_fast_for_many_repeats():
    n = 20_000  # quadratic work would take minutes
    assert group_states([(1.0,)] * n, [0] * n) == list(range(n))


# ------------------------------------------------------------------------------ refused


def swapped(old, new, table=TABLE):
    assert old in table
    return table.replace(old, new, 1)


# A misspelt column, and the one that is meant.
MISNAMED = {
    "frequency_hz": ["frequency_rad_s", "frequency_khz", "frequency", "Frequency [Hz]", "freq_hz"],
    "level": ["Level", "lvl"],
    "force_n": ["force_mn", "force", "load"],
    "velocity_re_m_s": ["velocity_re_mm_s", "velocity_re"],
    "velocity_im_m_s": ["velocity_im", "velocity_im_rms"],
}
FURTHER_MISNAMED = {
    "frequency_rad_s": "frequency_hz",
    "velocity_std_percent": "velocity_std_m_s",
    "phase_std_rad": "phase_std_deg",
    "force_std_mn": "force_std_n",
    "harmonic_std": "harmonic_std_m_s",
    "velocity_h0_re_m_s": "velocity_h0_m_s",
    "velocity_h2_m_s": "velocity_h2_re_m_s",
    "velocity_h2_im": "velocity_h2_im_m_s",
    "velocity_h2_re_mm_s": "velocity_h2_re_m_s",
    "velocity_h1_re_m_s": "velocity_re_m_s",
    "velocity_h02_re_m_s": "velocity_h2_re_m_s",
    "velocity_H2_re_m_s": "velocity_h2_re_m_s",
}


@pytest.mark.parametrize(
    ("content", "name", "expected"),
    [
        *(
            (TABLE.replace(column, name, 1), name, column)
            for column, names in MISNAMED.items()
            for name in names
        ),
        *((with_column(name, [1, 1, 1]), name, one) for name, one in FURTHER_MISNAMED.items()),
    ],
)
def test_refuses_a_misnamed_column_by_the_one_that_is_meant(
    tmp_path, content, name, expected, check_message
):
    with pytest.raises(ValueError, match=re.escape(f"`{expected}`")) as error:
        read(tmp_path, content)
    known_by_likeness = name not in ("load",)
    check_message(error, ["beam.csv", *([f"`{name}`"] * known_by_likeness)])


FINITE, POINT = "a finite number", "a number with a point as decimal sign and no thousands"
NO_FREQUENCIES = {
    **dict.fromkeys(['"80,5"', '"1,080.5"', "1 080.5", "1_000", "1.080.5"], POINT),
    **dict.fromkeys(["nan", "NaN", "inf", "-Infinity", "1e400"], FINITE),
    **dict.fromkeys(["abc", "80.5 Hz", "", "٨٠", "８０", "−3", "0x50", "8+1j", "True"], "a number"),
    **dict.fromkeys(["-3.2", "0", "1e-400"], "positive"),
    "1.7e308": "below 1e300 Hz",  # in rad/s it is no number
}


@pytest.mark.parametrize("field", NO_FREQUENCIES)
def test_refuses_what_is_no_frequency_by_its_row(tmp_path, field, check_message):
    content = TABLE.replace("80.5", field, 1)
    with pytest.raises(ValueError, match="`frequency_hz` must be") as error:
        read(tmp_path, content)
    shown = field.strip('"') or "an empty field"
    check_message(error, [f"must be {NO_FREQUENCIES[field]}", "row 4 of beam.csv has", shown])


BAD = {
    "empty file": ("", ["beam.csv", "empty"]),
    "only blank lines": ("\n \n", ["beam.csv", "empty"]),
    "header only": (COLUMNS + "\n", ["beam.csv", "no rows"]),
    "no header": (TABLE.split("\n", 1)[1], ["row 1", "header", "beam.csv", "'1'"]),
    "semicolons": (TABLE.replace(",", ";"), ["beam.csv", "commas", "semicolons"]),
    "tabs": (TABLE.replace(",", "\t"), ["beam.csv", "commas", "tabs"]),
    "frequency missing": (swapped("frequency_hz", "x"), ["beam.csv", "lacks", "`frequency_hz`"]),
    "drive in mV": (swapped("force_n", "drive_mv"), ["`drive_mv`", "expected `drive_v`"]),
    "force and drive": (
        with_column("drive_v", [1, 2, 3]),
        ["beam.csv", "either", "`force_n`", "`drive_v`"],
    ),
    "amplitude and real part": (
        "level,frequency_hz,force_n,velocity_m_s,velocity_re_m_s\n1,79,0.1,0.1,0.1\n",
        ["lacks", "`velocity_im_m_s`", "is it `velocity_m_s`"],
    ),
    "zero amplitude": (
        "level,frequency_hz,force_n,velocity_m_s\n1,79,0.1,0.1\n1,80,0.1,0\n",
        ["`velocity_m_s`", "positive", "row 3"],
    ),
    "doubled column": (
        with_column("level", [1, 1, 1]),
        ["`level`", "twice", "beam.csv", "1 and 6"],
    ),
    "doubled further column": (
        with_column("x", [1, 1, 1], with_column("x", [1, 1, 1])),
        ["`x`", "twice"],
    ),
    "half of a pair": (
        with_column("velocity_h2_re_m_s", [1, 1, 1]),
        ["`velocity_h2_re_m_s`", "lacks `velocity_h2_im_m_s`"],
    ),
    "other half of a pair": (
        with_column("velocity_h3_im_m_s", [1, 1, 1]),
        ["`velocity_h3_im_m_s`", "lacks `velocity_h3_re_m_s`"],
    ),
    "half of a pair in one row": (
        with_column("velocity_h2_im_m_s", [4, 5, ""], with_column("velocity_h2_re_m_s", [1, 2, 3])),
        ["`velocity_h2_im_m_s`", "`velocity_h2_re_m_s`", "row 4", "empty"],
    ),
    "field missing": (swapped(",-0.003", ""), ["row 3", "beam.csv", "5 fields", "has 4"]),
    "field too many": (swapped("-0.003", "-0.003,1"), ["row 3", "beam.csv", "5 fields", "has 6"]),
    "decimal commas": (swapped("80.5", "80,5"), ["row 4", "beam.csv", "has 6", "point"]),
    "blank line inside": (swapped("\n1,80.0", "\n\n1,80.0"), ["row 3", "beam.csv", "blank"]),
    "blank lines inside": (swapped("\n1,80.0", "\n\n \n1,80.0"), ["row 3", "beam.csv", "blank"]),
    "blank line first": ("\n" + TABLE, ["row 1", "beam.csv", "blank"]),
    "line of commas": (TABLE + ",,,,\n", ["`level`", "row 5", "beam.csv", "an empty field"]),
    "units row": (
        swapped("\n1,79", "\n-,Hz,N,m/s,m/s\n1,79"),
        ["`level`", "a number", "row 2", "'-'"],
    ),
    "infinite force": (swapped("0.2", "inf"), ["`force_n`", "row 4", "'inf'"]),
    "negative force": (swapped("0.2", "-0.2"), ["`force_n`", "positive", "row 4", "-0.2"]),
    "NaN velocity": (swapped("0.004", "NaN"), ["`velocity_im_m_s`", "row 4", "'NaN'"]),
    "zero drive": (
        swapped("0.2", "0.0", swapped("force_n", "drive_v")),
        ["`drive_v`", "positive", "row 4"],
    ),
    "negative std": (
        with_column("velocity_std_m_s", [1, -1e-9, 1]),
        ["`velocity_std_m_s`", "zero or positive", "row 3", "-1e-09"],
    ),
    "negative phase std": (with_column("phase_std_deg", [1, -1, 1]), ["`phase_std_deg`", "row 3"]),
    "negative force std": (with_column("force_std_n", [1, -1, 1]), ["`force_std_n`", "row 3"]),
    "negative harmonic std": (
        with_column("harmonic_std_m_s", [1, -1, 1]),
        ["`harmonic_std_m_s`", "row 3"],
    ),
    "nan as std": (with_column("velocity_std_m_s", [1, "nan", 1]), ["`velocity_std_m_s`", "'nan'"]),
    "order above 1": (
        with_column("order", [0, 1.5, 1]),
        ["`order`", "from 0 to 1", "row 3", "1.5"],
    ),
    "broken level": (swapped("\n2,", "\n2.5,"), ["`level`", "whole number", "row 4", "2.5"]),
    "endless level": (swapped("\n2,", "\n1e400,"), ["`level`", "row 4", "1e400"]),
    "enormous level": (swapped("\n2,", "\n99999999999999999999,"), ["`level`", "15 digits"]),
    "zero velocities": (
        COLUMNS + "\n1,79,0.1,0,0\n1,80,0.1,-0.0,0e5\n",
        ["beam.csv", "zero velocities"],
    ),
    "open quote": (TABLE + '"', ["row 5", "beam.csv", "not valid CSV"]),
    "text behind quotes": (swapped("80.5", '"80.5"x'), ["row 4", "beam.csv", "not valid CSV"]),
    "endless field": (
        with_column("x", ["1" * 200_000, 1, 1]),
        ["row 2", "beam.csv", "not valid CSV", "field larger"],
    ),
    "NUL bytes": (TABLE.encode() + b"\0", ["beam.csv", "not a UTF-8 text file"]),
    "UTF-16": (TABLE.encode("utf-16"), ["beam.csv", "not a UTF-8 text file"]),
    "Latin-1": (with_column("comment", ["ü", 1, 1]).encode("latin-1"), ["beam.csv", "not a UTF-8"]),
    "empty sensor": (swapped(",b\n", ",\n", SENSORS), ["`sensor`", "row 3", "an empty field"]),
    "two force stds": (
        with_column("force_std_n", [0.01, 0.02, 1, 1, 1, 1], SENSORS),
        ["`force_std_n`", "0.01", "row 3", "0.02"],
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_refuses(tmp_path, case, check_message):
    content, parts = BAD[case]
    with pytest.raises(ValueError, match=re.escape(parts[0])) as error:
        read(tmp_path, content)
    check_message(error, parts)


@pytest.mark.parametrize(
    ("content", "sensors", "parts"),
    [
        (TABLE, ("a", "b"), ["beam.csv", "`sensor`", "`a`, `b`"]),
        (SENSORS, ("a",), ["`sensor`", "`a`", "row 3", "beam.csv", "'b'"]),
        (SENSORS, ("a", "B"), ["`sensor`", "row 3", "'b'", "did you mean `B`"]),
        (swapped(",b", ",c", SENSORS), ("a", "b"), ["row 3", "'c'", "`a`, `b`"]),
    ],
)
def test_refuses_sensors_that_the_model_lacks(tmp_path, content, sensors, parts, check_message):
    with pytest.raises(ValueError, match=re.escape(parts[0])) as error:
        read(tmp_path, content, sensors)
    check_message(error, parts)


def test_refuses_a_missing_file_and_a_folder(tmp_path, check_message):
    with pytest.raises(ValueError, match="does not exist") as error:
        read_steady_states(tmp_path / "gone.csv")
    check_message(error, ["gone.csv"])
    with pytest.raises(ValueError, match="is a folder") as error:
        read_steady_states(tmp_path)
    check_message(error, [tmp_path.name])
    with pytest.raises(ValueError, match="cannot be read"):
        read_steady_states(tmp_path / ("x" * 300))


def test_names_the_line_that_an_editor_shows(tmp_path):
    content = swapped("0.002\n", '0.002,"a\nb"\n', swapped("_im_m_s\n", "_im_m_s,x\n"))
    content = swapped("-0.003", "bad,y", content).replace("0.004", "0.004,z")
    with pytest.raises(ValueError, match="row 4 of"):
        read(tmp_path, content)
    with pytest.raises(ValueError, match="row 2 of"):  # where the row of two lines starts
        read(tmp_path, content.replace("79.0", "worse"))


@settings(max_examples=150, deadline=None)
@given(content=st.one_of(st.text(), st.binary()))
def test_reads_or_refuses_anything(tmp_path_factory, content):
    path = tmp_path_factory.mktemp("any") / "beam.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8"))
    with pytest.raises(ValueError, match=r"beam\.csv") as error:
        read_steady_states(path)
    assert "\n" not in str(error.value)


FRAGMENTS = ["", " ", "\n", "\r", '"', ",", ";", "-", "1e999", "nan", "0", "\0", "é", "\u2028", "_"]


@settings(max_examples=200, deadline=None)
@given(data=st.data())
def test_reads_or_refuses_a_damaged_table(tmp_path_factory, data):
    start = data.draw(st.integers(0, len(SENSORS)))
    length = data.draw(st.integers(0, 3))
    content = SENSORS[:start] + data.draw(st.sampled_from(FRAGMENTS)) + SENSORS[start + length :]
    path = tmp_path_factory.mktemp("damaged") / "beam.csv"
    path.write_bytes(content.encode())
    try:
        states = read_steady_states(path)
    except ValueError as error:
        message = str(error)
        assert "beam.csv" in message
        assert "\n" not in message
    else:
        assert np.all(np.isfinite(states.frequency))
        assert np.all(np.isfinite(states.velocity))


# ------------------------------------------------------------------------------ round trips

positive = st.floats(1e-200, 1e200)
finite = st.floats(-1e200, 1e200)
NAMES = ("a", "b, c", 'quoted "x"')


@st.composite
def measured_states(draw):
    """Steady states as from a test, some with optional quantities missing."""
    n = draw(st.integers(1, 5))
    sensors = NAMES[: draw(st.integers(1, 3))]
    shape = (n, len(sensors))

    def array(of, size, *, optional=False):
        if optional and draw(st.booleans()):
            return np.full(size, np.nan)
        of = st.one_of(of, st.just(np.nan)) if optional else of
        count = int(np.prod(size))
        return np.array(draw(st.lists(of, min_size=count, max_size=count))).reshape(size)

    seen = array(st.booleans(), shape)
    seen[np.arange(n), draw(st.lists(st.integers(0, len(sensors) - 1), min_size=n, max_size=n))] = (
        True
    )
    velocity = (array(finite, shape) + 1j * array(finite, shape)) * seen
    velocity[0, np.argmax(seen[0])] = 1.0 + 0.5j
    orders = tuple(sorted(draw(st.sets(st.sampled_from([0, 2, 3, 5, 10]), max_size=2))))
    harmonics = np.full((*shape, len(orders)), complex(np.nan, np.nan))
    for k, order in enumerate(orders):
        real = array(finite, shape, optional=True)
        imag = array(finite, shape) if order else np.zeros(shape)
        stated = seen & ~np.isnan(real)
        harmonics[stated, k] = real[stated] + 1j * imag[stated]
    spread = st.floats(0, 1e200)
    voltage = draw(st.booleans())
    force = array(positive, (n,))
    nothing = np.full(n, np.nan)
    return steady_states(
        level=array(st.integers(-(10**14), 10**14), (n,)),
        # Distinct, so that states measured by different sensors stay apart.
        frequency=array(st.floats(1e-3, 1e6), (n,)) + 1e7 * np.arange(n),
        force=nothing if voltage else force,
        drive=force if voltage else nothing,
        velocity=velocity,
        sensors=sensors,
        measured=seen,
        velocity_std=np.where(seen, array(spread, shape, optional=True), np.nan),
        phase_std=np.where(seen, array(st.floats(0, 1e6), shape, optional=True), np.nan),
        force_std=array(spread, (n,), optional=True),
        order=array(st.floats(0, 1), (n,), optional=True),
        harmonics=harmonics,
        harmonic_std=np.where(seen, array(spread, shape, optional=True), np.nan),
        harmonic_order=orders,
    )


@settings(max_examples=80, deadline=None)
@given(data=measured_states())
def test_round_trip(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("round") / "beam.csv"
    write_steady_states(path, data)
    back = read_steady_states(path, sensors=data.sensors)
    assert same(back, data)
    # Numbers from a file are restored exactly.
    content = path.read_bytes()
    write_steady_states(path, back)
    assert path.read_bytes() == content


def test_numbers_of_a_file_stay_as_they_are(tmp_path):
    path = tmp_path / "copy.csv"
    frequencies = [f"{f:.2f}".rstrip("0") + "1" for f in np.linspace(10, 200, 300)]
    rows = [f"1,{f},0.1,0.01,0.02,0.7" for f in frequencies]
    data = read(tmp_path, "\n".join([COLUMNS + ",phase_std_deg", *rows]))
    write_steady_states(path, data)
    header, *lines = path.read_text().splitlines()
    assert header.split(",")[:2] == ["level", "frequency_hz"]  # nobody named the sensor
    assert [line.split(",")[1] for line in lines] == [repr(float(f)) for f in frequencies]
    assert {line.split(",")[5] for line in lines} == {"0.7"}


def test_a_known_force_is_written_in_place_of_its_drive_voltage(tmp_path):
    calibrated = one_state(drive=np.array([2.5]))
    write_steady_states(tmp_path / "beam.csv", calibrated)
    back = read_steady_states(tmp_path / "beam.csv")
    assert back.force.tolist() == [1.0]
    assert np.isnan(back.drive).all()


def one_state(**changes):
    arguments = {
        "level": np.array([1]),
        "frequency": np.array([500.0]),
        "force": np.array([1.0]),
        "velocity": np.array([[0.5 + 0.1j]]),
    }
    return steady_states(**(arguments | changes))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (one_state(force=np.array([np.nan])), "must have all forces or"),
        (
            join_steady_states(one_state(), one_state(force=[np.nan], drive=[1.0])),
            "must have all forces or",
        ),
        (one_state(measured=np.array([[False]])), "measured by a sensor"),
        (one_state(frequency=np.array([-1.0])), "`frequency_hz` must be positive"),
        (one_state(frequency=np.array([np.nan])), "`frequency_hz` must be a number"),
        (one_state(velocity=np.array([[0j]])), "zero velocities"),
        (one_state(sensors=(" a",)), "`sensor` must be one of the model's"),
        (
            one_state(harmonics=np.array([[[1j]]]), harmonic_order=(0,)),
            "harmonic 0 is a mean and must be real",
        ),
        (
            one_state(harmonics=np.array([[[complex(1, np.nan)]]]), harmonic_order=(2,)),
            "`velocity_h2_im_m_s` must be a number",
        ),
        (
            steady_states(
                np.array([1, 1]),
                np.array([500.0, 500.0]),
                np.array([1.0, 1.0]),
                np.array([[1.0 + 0j, 0], [0, 1.0]]),
                sensors=("a", "b"),
                measured=np.eye(2, dtype=bool),
            ),
            "distinguish some steady states",
        ),
    ],
)
def test_does_not_write_what_could_not_be_read(tmp_path, data, message, check_message):
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        write_steady_states(tmp_path / "beam.csv", data)
    check_message(error, [])
    assert os.listdir(tmp_path) == []


# ------------------------------------------------------------------------------ result tables


def test_write_table(tmp_path):
    path = tmp_path / "points.csv"
    write_table(
        path,
        {
            "level": np.array([1, 2]),
            "frequency_hz": [1 / 3, np.float64(-0.0)],
            "force_n": jnp.array([1e-300, np.nan]),
            "stable": np.array([True, False]),
            "status": ["ok", 'a, "b"'],
            "mixed": [jnp.asarray(2.5), 3],
        },
    )
    assert path.read_bytes() == (
        b"level,frequency_hz,force_n,stable,status,mixed\n"
        b"1,0.333333333333,1e-300,1,ok,2.5\n"
        b'2,0,nan,0,"a, ""b""",3\n'
    )
    assert os.listdir(tmp_path) == ["points.csv"]


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"a": [1], "b": [1, 2]}, "`a` 1, `b` 2"),
        ({"a": [1j]}, "`a` must hold real numbers"),
        ({"a": [None]}, "`a` must hold real numbers"),
        ({"a": np.zeros((2, 2))}, "`a` must hold real numbers"),
        ({"a": np.float64(1)}, "`a` must be a vector"),
        ({"a": jnp.zeros(())}, "`a` must be a vector"),
        ({"a": "text"}, "`a` must be a sequence"),
    ],
)
def test_write_table_refuses(tmp_path, columns, message, check_message):
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        write_table(tmp_path / "a.csv", columns)
    check_message(error, [])
    assert os.listdir(tmp_path) == []


def test_a_failed_write_leaves_nothing_behind(tmp_path, monkeypatch, check_message):
    path = tmp_path / "a.csv"
    path.write_text("old")

    def full_disk(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full_disk)
    with pytest.raises(ValueError, match="No space left") as error:
        write_table(path, {"a": [1]})
    check_message(error, ["a.csv"])
    assert os.listdir(tmp_path) == ["a.csv"]
    assert path.read_text() == "old"


def test_an_interrupted_write_leaves_nothing_behind(tmp_path, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_table(tmp_path / "a.csv", {"a": [1]})
    assert os.listdir(tmp_path) == []


def test_write_refuses_a_missing_folder_and_a_folder(tmp_path, check_message):
    with pytest.raises(ValueError, match="folder does not exist") as error:
        write_table(tmp_path / "gone" / "a.csv", {"a": [1]})
    check_message(error, ["a.csv"])
    (tmp_path / "taken").mkdir()
    with pytest.raises(ValueError, match="cannot be written"):
        write_table(tmp_path / "taken", {"a": [1]})
    assert os.listdir(tmp_path) == ["taken"]


def test_write_follows_a_link_and_keeps_usual_permissions(tmp_path):
    (tmp_path / "real").mkdir()
    target, link, plain = tmp_path / "real" / "a.csv", tmp_path / "a.csv", tmp_path / "b.csv"
    target.write_text("old")
    link.symlink_to(target)
    write_table(link, {"a": [1]})
    assert link.is_symlink()
    assert target.read_text() == "a\n1\n"
    plain.write_text("")
    assert target.stat().st_mode == plain.stat().st_mode


# ------------------------------------------------------------------------------ measured files


def measured(name):
    path = SHARED / name
    if not path.exists():
        pytest.skip(f"the measured file {path} is not there (it is kept outside the repository)")
    return path


def test_measured_brake_reuss_beam():
    data = read_steady_states(measured("brake_reuss_beam/response_controlled.csv"))
    assert data.notes == ()
    assert data.velocity.shape == (8 * 41, 1)
    np.testing.assert_array_equal(np.unique(data.level, return_counts=True)[1], [41] * 8)
    assert float(data.force[0]) == 0.36465208
    assert complex(data.velocity[0, 0]) == 0.0011100375 + 0.0099849542j
    assert not np.any(np.isnan(data.force))


def test_measured_suspended_beam():
    path = measured("suspended_beam/lock_in_stepped_sine.csv")
    data = read_steady_states(path, sensors=("laser",))
    assert data.notes == ()
    assert data.velocity.shape == (4 * 40, 1)
    np.testing.assert_array_equal(np.unique(data.level, return_counts=True)[1], [40] * 4)
    assert np.all(np.isnan(data.force))
    assert np.all(data.drive > 0)
    assert np.all(data.velocity_std > 0)
    assert data.sensors == ("laser",)
