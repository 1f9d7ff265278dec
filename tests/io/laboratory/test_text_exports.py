"""Self-describing texts as written by controllers, LabVIEW and vibrometers."""

import numpy as np
import pytest
from truths.import_runs import run_import

from snrmjax.io.laboratory import read_laboratory_file
from snrmjax.io.laboratory.contents import TextFormat
from snrmjax.io.laboratory.record_tables import read_record_table

RATE = 1000
TIME = np.arange(80) / RATE
FORCE, MOTION = np.cos(300 * TIME), 0.5 * np.sin(300 * TIME)
END = "***End_of_Header***"


def lvm(separator="\t", decimal=".", x_columns="No", *, step="1.000000E-3", rows=None, **header):
    """A LabVIEW measurement file with one or more segments, by its specification."""
    sides = 1 if x_columns != "Multi" else 2

    def line(*fields):
        return separator.join(str(field).replace(".", decimal) for field in fields)

    def spread(*fields):
        return [
            word for k, field in enumerate(fields) for word in ([""] * (k and sides - 1), field)
        ]

    general = [
        *(("Writer_Version", 2), ("Reader_Version", 2)),
        ("Separator", "Tab" if separator == "\t" else "Comma"),
        *(("Multi_Headings", "Yes"), ("X_Columns", x_columns), ("Time_Pref", "Relative")),
    ]
    lines = [f"LabVIEW Measurement{separator}"]
    lines += [f"{key}{separator}{value}" for key, value in general]
    lines += [f"Decimal_Separator{separator}{decimal}", f"{END}{separator}"]
    for values in rows or [[FORCE, MOTION]]:
        names, units = ["Force", "Tip velocity"][: len(values)], ["Newtons", "mm/s"][: len(values)]

        def stated(key, *fields):
            gap = [""] if sides == 2 else []
            return line(key, *[w for k, f in enumerate(fields) for w in [*(gap if k else []), f]])

        n = len(values)
        lines += ["", line("Channels", n), stated("Samples", *map(len, values))]
        lines += [stated("Y_Unit_Label", *units), stated("X_Dimension", *["Time"] * n)]
        lines += [stated(key, *given) for key, given in header.items()]
        lines += [stated("X0", *["0.0000000000000000E+0"] * n), stated("Delta_X", *[step] * n)]
        lines += [f"{END}{separator * n}"]
        heads = [w for name in names for w in (["X_Value", name] if sides == 2 else [name])]
        lines += [line(*([] if sides == 2 else ["X_Value"]), *heads, "Comment")]
        for k in range(max(map(len, values))):
            fields = [f"{one[k]:.9f}" if k < len(one) else "" for one in values]
            x = f"{TIME[k]:.6f}"
            if sides == 2:
                lines.append(line(*[word for field in fields for word in (x, field)]))
            else:
                lines.append(line(x if x_columns == "One" else "", *fields))
    return "\n".join(lines) + "\n"


def read(tmp_path, text, name="test.lvm", encoding="utf-8", **text_format):
    (tmp_path / name).write_bytes(text.encode(encoding))
    return read_laboratory_file(tmp_path / name, TextFormat(**text_format) if text_format else None)


@pytest.mark.parametrize(
    ("separator", "decimal", "x_columns"),
    [
        ("\t", ",", "No"),
        ("\t", ".", "One"),
        ("\t", ",", "Multi"),
        (",", ".", "No"),
        (",", ".", "One"),
    ],
)
def test_labview_measurement_files(tmp_path, separator, decimal, x_columns):
    contents = read(tmp_path, lvm(separator, decimal, x_columns))
    (record,) = contents.recordings
    assert (contents.kind, record.sampling_rate, record.start_time) == ("lvm", 1000.0, 0.0)
    assert [one.quantity for one in record.channels] == ["force", "velocity"]
    np.testing.assert_allclose(record.values(["Force"])[0], FORCE, rtol=0, atol=5.1e-10)
    np.testing.assert_allclose(record.values(["Tip velocity"])[0], 1e-3 * MOTION, atol=5.1e-13)


def test_segments_ragged_ends_and_few_digits_of_labview(tmp_path):
    text = lvm(rows=[[FORCE, MOTION[:70]], [FORCE, MOTION]], step="0.000977")
    contents = read(tmp_path, text)
    assert [one.n_samples for one in contents.recordings] == [70, 80]
    assert "Force has more samples than the 70" in " ".join(map(str, contents.notes))
    assert {one.sampling_rate for one in contents.recordings} == {1024.0}
    assert any("only integer rate" in str(note) for note in contents.notes)
    late = {"Date": ["2026/01/05"] * 2, "Time": ["10:00:00.000", "10:00:00.020"]}
    contents = read(tmp_path, lvm(**late))
    (record,) = contents.recordings
    assert record.n_samples == 60  # of 80, where both are
    np.testing.assert_allclose(record.values(["Force"])[0], FORCE[20:], atol=5.1e-10)
    np.testing.assert_allclose(record.values(["Tip velocity"])[0], 1e-3 * MOTION[:60], atol=1e-12)
    assert "Force began 20 ms earlier" in " ".join(map(str, contents.notes))


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("Separator\tTab", "Separator\tPipe", "states the separator 'Pipe'"),
        ("Channels\t2", "Channels\t3", "states 3 channels, but its row of names has 2"),
        (f"{END}\t", "", "header has no end"),
        ("1.000000000", "one", "must be numbers with a decimal point"),
        ("Delta_X\t1.000000E-3\t1.000000E-3", "Delta_X\t0\t0", "states no step"),
        ("\t0.955336489", "\t0.955336489\t1\t2\t3", "has 6 fields"),
    ],
)
def test_a_labview_file_that_contradicts_itself_is_refused(tmp_path, old, new, complaint):
    text = lvm()
    assert old in text
    with pytest.raises(ValueError, match=complaint):
        read(tmp_path, text.replace(old, new))


HERTZ = [31.0, 31.05, 31.1, 31.15]
SPEED = [0.04678, 0.04926, 0.05201, 0.05508]
PHASE = [-95.4, -95.7, -96.0, -96.4]


def runs(separator, decimal, head, labels, *, shared=True, end=""):
    """Two adjacent runs, the second backwards."""

    def line(*fields):
        return separator.join(str(field).replace(".", decimal) for field in fields) + end

    lines = [line(*head), *([line(*labels)] if labels else [])]
    for k in range(4):
        other = 3 - k if not shared else k
        second = [SPEED[other] * 2, PHASE[other] - 1]
        second = second if shared else [HERTZ[other], *second]
        lines.append(line(HERTZ[k], SPEED[k], PHASE[k], *second))
    return "\n".join(lines) + "\n"


ONE = ["X-Data [Hz]", "Vib (Filtered) [m/s]", "Phase [Deg]"]
LABELS = ["", "002: [01-05-26 09:28]", "", "003: [01-05-26 09:35]", ""]


@pytest.mark.parametrize(
    ("separator", "decimal", "head", "labels", "shared", "end"),
    [
        ("\t", ",", [*ONE, *ONE[1:]], LABELS, True, ""),
        ("\t", ",", [*ONE, *ONE[1:], ""], LABELS, True, "\t"),
        (";", ",", [*ONE, *ONE[1:]], [], True, ";"),
        (",", ".", [*ONE, *ONE], [], False, ""),
        (";", ".", [*ONE, *ONE], ["up", "", "", "down", "", ""], False, ""),
    ],
)
def test_runs_side_by_side_are_one_table(tmp_path, separator, decimal, head, labels, shared, end):
    text = runs(separator, decimal, head, labels, shared=shared, end=end)
    (table,) = read(tmp_path, text, "run.txt", "cp1252").tables
    assert table.units == {"X-Data": "Hz", "Vib (Filtered)": "m/s", "Phase": "Deg"}
    assert table.columns["run"].tolist() == [1.0] * 4 + [2.0] * 4
    second = HERTZ if shared else HERTZ[::-1]
    assert table.columns["X-Data"].tolist() == HERTZ + second
    speeds = [2 * one for one in (SPEED if shared else SPEED[::-1])]
    np.testing.assert_allclose(table.columns["Vib (Filtered)"], SPEED + speeds, rtol=1e-15)
    if labels is LABELS:
        assert set(table.words["run label"]) == {LABELS[1], LABELS[3]}


def test_a_trailing_separator_adds_no_column_and_a_row_of_names_is_obeyed(tmp_path):
    text = "f [Hz]\tv [mm/s]\tph [deg]\t\n1,5\t2,5\t-3\t\n2,5\t3,5\t-4\t\n"
    (table,) = read(tmp_path, text, "a.txt").tables
    assert list(table.columns) == ["f", "v", "ph"]
    (stated,) = read(tmp_path, text, "a.txt", header_row=1).tables
    assert stated.units == table.units == {"f": "Hz", "v": "mm/s", "ph": "deg"}
    below = "title\tof a test\n" + text
    with pytest.raises(ValueError, match=r"--header-row 1 of a\.txt has 2 names, but .* 3 columns"):
        read(tmp_path, below, "a.txt", header_row=1)


@pytest.mark.parametrize("line", ["Sampling rate:\t1000 Hz", "dt = 0.001 s", "# fs\t1 kHz"])
def test_a_rate_that_is_stated_above_the_numbers(tmp_path, line):
    rows = "\n".join(f"{a!r}\t{b!r}" for a, b in zip(FORCE.tolist(), MOTION.tolist(), strict=True))
    (record,) = read(tmp_path, f"{line}\nF [N]\tv [mm/s]\n{rows}\n", "a.txt").recordings
    assert record.sampling_rate == pytest.approx(1000, rel=1e-15)
    np.testing.assert_array_equal(record.values(["F"])[0], FORCE)


def vibrometer(signal, unit, values):
    head = f"Source File Name:\thit1\nComponent:\tRoot\nSignal:\tTime - {signal} - Samples\n\n"
    rows = "\n".join(f"{t:.3f}\t{v!r}" for t, v in zip(TIME, values.tolist(), strict=True))
    return f"{head}Time\tTime Signal\n[ s ]\t[ {unit} ]\n{rows}\n"


def test_channels_in_several_files_are_one_record(tmp_path):
    (tmp_path / "force.txt").write_text(vibrometer("Ref1 Force", "N", FORCE))
    (tmp_path / "velocity.txt").write_text(vibrometer("Vib Velocity", "mm/s", MOTION))
    files = tmp_path / "force.txt", tmp_path / "velocity.txt"
    words = ["--force", "Ref1 Force", "--response", "Vib Velocity", "--record", "broadband"]
    code, output = run_import(*files, *words, "--out", tmp_path / "out")
    assert code == 0, output
    record = np.loadtxt(tmp_path / "out" / "record.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(record[:, 1:], np.stack([FORCE, 1e-3 * MOTION], axis=1), rtol=1e-15)
    code, output = run_import(files[0], *words[:3], "Ref1 Force:velocity:m/s", "--out", tmp_path)
    assert code == 2
    assert "as the response and as the excitation" in output


def test_a_number_of_very_many_digits_is_a_number(tmp_path):
    rows = "\n".join(f"{k},{10**25 + k}" for k in range(5))
    (table,) = read(tmp_path, f"f [Hz],v [m/s]\n{rows}\n", "a.csv").tables
    assert table.columns["v"].tolist() == [1e25] * 5


@pytest.mark.parametrize(
    ("separator", "mark", "decimal"),
    [
        *((";", ".", ","), (";", " ", ","), ("\t", " ", ","), ("\t", "\u2009", ".")),
        *((";", "'", "."), (",", ".", ","), (",", ",", "."), ("\t", "\u202f", ",")),
    ],
)
def test_separators_of_thousands(tmp_path, separator, mark, decimal):
    def row(*fields):
        words = [f"{one:,}".replace(",", "T").replace(".", decimal) for one in fields]
        words = [word.replace("T", mark) for word in words]
        quoted = [f'"{word}"' if separator in word else word for word in words]
        return separator.join(quoted)

    truth = [(998, 0.5, 1250.25, 12), (1000, 0.5, 1391, 1234567), (1001, 0.5, 1.25, -40)]
    head = separator.join(["f [Hz]", "F [N]", "v [mm/s]", "n"])
    contents = read(tmp_path, "\n".join([head, *(row(*one) for one in truth)]), "a.csv")
    np.testing.assert_array_equal(np.transpose(list(contents.tables[0].columns.values())), truth)
    assert sum(note.kind == "thousands" for note in contents.notes) == 3


@pytest.mark.parametrize(
    ("rows", "complaint", "by_point", "by_comma"),
    [
        ("998;5\n1.000;5", r"is 1\.000 in row 3 of a\.csv 1 or 1000\?", [998, 1], [998, 1000]),
        ("998;5\n1,001;5", r"1,001 in row 3 of a\.csv 1\.001 or 1001", [998, 1001], [998, 1.001]),
        ("998;0.5\n1.000;0.5", "Column f has 998, too", [998, 1], [998, 1000]),
        ("998;0,5\n1,000;0,5", "Column f has 998, too", [998, 1000], [998, 1]),
    ],
)
def test_thousands_that_may_be_decimals_are_asked_about(
    tmp_path, rows, complaint, by_point, by_comma
):
    text = f"f;F\n{rows}\n"
    with pytest.raises(ValueError, match=f"{complaint}.*--decimal point or comma"):
        read(tmp_path, text, "a.csv")
    for decimal, wanted in (("point", by_point), ("comma", by_comma)):
        text_format = {"separator": "semicolon", "decimal": decimal}
        (table,) = read(tmp_path, text, "a.csv", **text_format).tables
        assert table.columns["f"].tolist() == wanted


def test_decimals_of_three_digits_and_columns_of_another_mark(tmp_path):
    (table,) = read(tmp_path, "f v\n79.125 1.250\n80.000 1.391\n", "a.csv").tables
    assert table.columns["v"].tolist() == [1.25, 1.391]
    contents = read(tmp_path, "f;F;v\n998;0,5;1.25\n1.000;0,5;1.391\n", "a.csv")
    assert [one.tolist() for one in contents.tables[0].columns.values()] == [
        *([998, 1000], [0.5, 0.5], [1.25, 1.391])
    ]
    assert [note.kind for note in contents.notes][:2] == ["thousands", "other_decimal"]
    with pytest.raises(ValueError, match=r"v of a\.csv has decimal commas and decimal points"):
        read(tmp_path, "f;F;v\n998;0,5;1.25\n1.000;0,5;12,3911\n", "a.csv")


@pytest.mark.parametrize(
    ("rate", "digits", "n", "start", "unit"),
    [
        *((5120, ".4g", 2000, 0.0, 1.0), (5120, ".5g", 2000, 12.5, 1.0)),
        *((51200, ".5g", 8000, 0.0, 1e-3), (2048, ".4f", 900, -0.1, 1.0)),
        *((1 / 0.00023, ".4g", 2000, 0.0, 1.0), (1024, ".3e", 700, 0.0, 1.0)),
    ],
)
@pytest.mark.parametrize("cut", [False, True])
def test_times_of_few_digits_are_even(tmp_path, rate, digits, n, start, unit, cut):
    times = (start + np.arange(n) / rate) / unit
    words = [f"{one:{digits}}" for one in times]
    if cut:  # truncated, as by programs that do not round
        words = [repr(float(np.floor(one * 1e5 + 1e-6)) / 1e5) for one in times]
    name = "t [ms]" if unit == 1e-3 else "t [s]"
    rows = [f"{word},{0.1 * k!r}" for k, word in enumerate(words)]
    contents = read(tmp_path, "\n".join([f"{name},v [m/s]", *rows]), "a.csv")
    (record,) = contents.recordings
    tolerance = 1e-4 if cut else 1e-12
    assert record.sampling_rate == pytest.approx(rate, rel=tolerance)
    assert record.start_time == pytest.approx(start, abs=1e-4 * unit)


def test_uneven_times_of_few_digits_stay_a_column_and_an_open_rate_is_stated(tmp_path):
    times = np.round(np.arange(300) / 5120, 3)
    rows = [f"{one:.3f},{k / 8!r}" for k, one in enumerate(times)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["t [s],v [m/s]", *rows]))
    (note,) = (n for n in read_laboratory_file(path).notes if n.kind == "rate_left_open")
    assert note["rate"] == 5120
    words = (path, "--rate", 5120, "--record", "decay", "--response", "v", "--out", tmp_path / "o")
    code, output = run_import(*words)
    assert code == 0
    assert "few digits" not in output
    record = read_record_table(tmp_path / "o" / "record.csv")
    assert record.sampling_rate == pytest.approx(5120, rel=1e-12)
    # The same times in a table of our own, then with a gap of two samples.
    path.write_text("\n".join(["time_s,velocity_m_s", *rows]))
    assert read_record_table(path).sampling_rate == pytest.approx(5120, rel=1e-2)
    gap = [f"{float(row.split(',')[0]) + 0.01 * (k > 150):.3f},1" for k, row in enumerate(rows)]
    path.write_text("\n".join(["t [s],v [m/s]", *gap]))
    assert "uneven_time" in [note.kind for note in read_laboratory_file(path).notes]


def test_a_proposed_command_repeats_the_stated_format(tmp_path):
    """The mark is ambiguous without --decimal: the proposal states it and asks for nothing."""
    path = tmp_path / "a.csv"
    rows = [f"{f};5;{v};40" for f, v in (("998", "990"), ("1.000", "1.046"), ("1.001", "1.201"))]
    path.write_text("\n".join(["f [Hz];F [N];v [mm/s];phase [deg]", *rows]))
    code, output = run_import(path, "--decimal", "comma")
    assert code == 0
    assert "--decimal comma" in output
    assert "it will ask" not in output
