"""TDMS written by nptdms, and separated text as written in several countries."""

import struct

import numpy as np
import pytest
from nptdms import ChannelObject, GroupObject, RootObject, TdmsWriter

from snrmjax.io.laboratory import read_laboratory_file
from snrmjax.io.laboratory.contents import TextFormat


def test_a_waveform_of_labview(tmp_path):
    path = tmp_path / "record.tdms"
    rng = np.random.default_rng(3)
    force, response = rng.normal(size=300), rng.integers(-99, 99, size=300, dtype=np.int16)
    wave = {"wf_increment": 1 / 2048, "wf_start_offset": 0.5, "wf_samples": 100}
    frequency = np.array([79.0, 80.0])
    with TdmsWriter(path) as writer:
        for part in range(3):  # three segments, as a running measurement writes them
            at = slice(100 * part, 100 * part + 100)
            writer.write_segment(
                [
                    RootObject({"Operator": "nobody"}),
                    GroupObject("Test"),
                    ChannelObject("Test", "CH1", force[at], {**wave, "unit_string": "lbf"}),
                    ChannelObject("Test", "CH2", response[at], {**wave, "unit_string": "m/s^2"}),
                ]
            )
        writer.write_segment([ChannelObject("Steps", "frequency", frequency, {})])
    contents = read_laboratory_file(path)
    (record,) = contents.recordings
    assert (record.sampling_rate, record.start_time) == (2048.0, 0.5)
    assert [one.quantity for one in record.channels] == ["force", "acceleration"]
    np.testing.assert_array_equal(record.values()[0], force * 4.4482216152605)
    np.testing.assert_array_equal(record.values(["CH2"], 95, 205)[0], response[95:205])
    assert contents.tables[0].name == "Steps"
    np.testing.assert_array_equal(contents.tables[0].columns["frequency"], frequency)


def test_spectra_and_complex_channels(tmp_path):
    """An even abscissa in Hz is a frequency, not a time axis."""
    path = tmp_path / "spectra.tdms"
    lines = {"wf_increment": 0.25, "wf_start_offset": 20.0, "wf_xunit_string": "Hz"}
    values = np.random.default_rng(4).normal(size=(2, 80))
    response = (values[0] + 1j * values[1]).astype(np.complex64)
    stamps = np.arange(3).astype("datetime64[us]")
    with TdmsWriter(path) as writer:
        writer.write_segment(
            [
                ChannelObject("Spectra", "H1", response, {**lines, "unit_string": "g"}),
                ChannelObject("Spectra", "coherence", values[0], lines),
                ChannelObject("Spectra", "log", stamps, {}),
            ]
        )
    contents = read_laboratory_file(path)
    assert contents.recordings == ()
    (table,) = contents.tables
    np.testing.assert_array_equal(table.columns["frequency"], 20 + np.arange(80) / 4)
    np.testing.assert_array_equal(table.columns["H1"], response)
    assert table.units == {"frequency": "Hz", "H1": "g"}
    np.testing.assert_array_equal(table.columns["coherence"], values[0])
    assert [dict(note) for note in contents.notes] == [
        {"name": "channel log", "why": "times_of_day"}
    ]


def text_of_tdms(word):
    """A text as the format counts it."""
    return struct.pack("<I", len(word)) + word.encode()


def segment(objects, samples):
    """One segment of interleaved doubles, byte by byte as NI's white paper describes it."""
    meta = struct.pack("<I", len(objects))
    for path, properties in objects:
        meta += text_of_tdms(path)
        if path.count("/") < 2:
            meta += struct.pack("<I", 0xFFFFFFFF)  # no samples
        else:
            meta += struct.pack("<IIIQ", 20, 10, 1, len(samples))
        meta += struct.pack("<I", len(properties))
        for key, value in properties.items():
            meta += text_of_tdms(key)
            if isinstance(value, str):
                meta += struct.pack("<I", 0x20) + text_of_tdms(value)
            else:
                meta += struct.pack("<Id", 10, value)
    raw = np.ascontiguousarray(samples, dtype="<f8").tobytes()
    toc = 2 | 4 | 8 | 32  # metadata, new objects, samples, interleaved
    return b"TDSm" + struct.pack("<IIQQ", toc, 4713, len(meta) + len(raw), len(meta)) + meta + raw


def interleaved(samples):
    wave = {"wf_increment": 1 / 1000, "wf_start_offset": 0.0}
    return [
        ("/", {}),
        ("/'Log'", {}),
        ("/'Log'/'Force'", {**wave, "unit_string": "N"}),
        ("/'Log'/'Acceleration'", {**wave, "unit_string": "g"}),
    ], samples


def test_interleaved_segments_written_by_hand(tmp_path):
    path = tmp_path / "log.tdms"
    samples = np.random.default_rng(5).normal(size=(200, 2))
    path.write_bytes(
        segment(*interleaved(samples[:120])) + segment(*interleaved(samples[120:])),
    )
    (record,) = read_laboratory_file(path).recordings
    assert (record.sampling_rate, record.n_samples) == (1000.0, 200)
    np.testing.assert_array_equal(record.values(["Force"])[0], samples[:, 0])
    np.testing.assert_array_equal(
        record.values(["Acceleration"], 100, 140)[0], samples[100:140, 1] * 9.80665
    )


@pytest.mark.parametrize("index", ["of another record", "garbage"])
def test_an_index_next_to_a_tdms_file_is_ignored(tmp_path, index):
    samples = np.random.default_rng(6).normal(size=(200, 2))
    path = tmp_path / "log.tdms"
    path.write_bytes(segment(*interleaved(samples)))
    wrong = segment(*interleaved(samples[:50])).replace(b"TDSm", b"TDSh")
    (tmp_path / "log.tdms_index").write_bytes(
        wrong[: -50 * 16] if index == "of another record" else b"TDSh" + bytes(range(90))
    )
    (record,) = read_laboratory_file(path).recordings
    np.testing.assert_array_equal(record.values(["Force"])[0], samples[:, 0])


def test_a_tdms_that_states_more_than_it_has_is_refused(tmp_path):
    path = tmp_path / "log.tdms"
    samples = np.zeros((200, 2))
    honest = segment(*interleaved(samples))
    count = struct.pack("<IIIQ", 20, 10, 1, 200)
    assert honest.count(count) == 2
    path.write_bytes(honest.replace(count, struct.pack("<IIIQ", 20, 10, 1, 2**40)))
    with pytest.raises(ValueError, match=r"log\.tdms"):
        read_laboratory_file(path).recordings[0].values()


def test_a_word_among_numbers_and_lines_of_comment(tmp_path):
    path = tmp_path / "export.csv"
    path.write_text("f,F\n# one\n79,1\n80,2\n% two\n\n81,3\n# end\n")
    contents = read_laboratory_file(path)
    np.testing.assert_array_equal(contents.tables[0].columns["F"], [1, 2, 3])
    assert [note["n"] for note in contents.notes if note.kind == "comments_not_read"] == [2]
    path.write_text("f,F\n79,1\n80,-.-\n81,3\n")
    with pytest.raises(ValueError, match=r"column F must be numbers, but row 3 of export\.csv"):
        read_laboratory_file(path)


@pytest.mark.parametrize(
    ("text", "names", "units"),
    [
        ("f;F;a\n79,5;0,1;1e-3\n80,5;0,2;2e-3\n", ["f", "F", "a"], {}),
        ("f\tF\ta\n79,5\t0,1\t0,001\n80,5\t0,2\t0,002\n", ["f", "F", "a"], {}),
        (
            "Prüfung vom 24.11.2026\nBeam 3\n\nFreq [Hz],Force (N),acc [m/s²]\n"
            "79.5,0.1,1e-3\n80.5,.2,0.002\n",
            ["Freq", "Force", "acc"],
            {"Freq": "Hz", "Force": "N", "acc": "m/s²"},
        ),
        (
            "# Freq;Force;acc\n;N;g\n79,5;0,1;0,001\n80,5;0,2;0,002\n\n",
            ["Freq", "Force", "acc"],
            {"Force": "N", "acc": "g"},
        ),
        ("79.5 0.1 0.001\n80.5 0.2 0.002\n", ["column_1", "column_2", "column_3"], {}),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8-sig", "cp1252", "utf-16"])
def test_text_of_other_programs(tmp_path, text, names, units, encoding):
    path = tmp_path / "export.txt"
    path.write_text(text, encoding=encoding)
    (table,) = read_laboratory_file(path).tables
    assert list(table.columns) == names
    assert table.units == units
    np.testing.assert_array_equal(table.columns[names[0]], [79.5, 80.5])
    np.testing.assert_array_equal(table.columns[names[1]], [0.1, 0.2])
    np.testing.assert_array_equal(table.columns[names[2]], [1e-3, 2e-3])


def test_a_record_of_text_and_a_column_of_words(tmp_path):
    path = tmp_path / "record.csv"
    rows = "\n".join(f"{k / 1024!r},{k % 7},on" for k in range(100))
    path.write_text(f"Time (s),CH1 (mV),state\n{rows}\n")
    contents = read_laboratory_file(path)
    (record,) = contents.recordings
    assert record.sampling_rate == 1024
    np.testing.assert_allclose(record.values()[0], np.arange(100) % 7 * 1e-3, rtol=1e-15)
    assert [one.name for one in record.channels] == ["CH1"]


def test_stated_formats_take_precedence(tmp_path):
    path = tmp_path / "odd.csv"
    path.write_text("1,2\na,b\nHz,N\n79,1\n80,2\n")
    text_format = TextFormat("comma", "point", 2)
    (table,) = read_laboratory_file(path, text_format).tables
    assert table.units == {"a": "Hz", "b": "N"}
    np.testing.assert_array_equal(table.columns["b"], [1, 2])


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"", "empty"),
        (b"\n\n\n", "no row of numbers"),
        (b"only words\nand more\n", "no row of numbers"),
        (b"a,b\n1,2\n3\n", "row 3 of .* has 1 fields"),
        (b"a,b\n1,2\n" + b"x" * 5000 + b"\0", "NUL"),
        (b"PK\x03\x04rest\0", "zip archive"),
        (b"\x1f\x8b\x08\0rest", "gzip"),
        (b"CDF\x01\0\0", "nccopy"),
        (b"\x00\x01\x02\x03", "no known format"),
        (b"a,b\nnan,nan\nnan,nan\n", "nothing that could be read"),
    ],
)
@pytest.mark.parametrize("name", ["hostile.csv", "hostile.mat"])
def test_what_is_no_table_is_refused(tmp_path, name, content, complaint):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ValueError, match=complaint):
        read_laboratory_file(path)


def test_missing_files_folders_and_cut_ones(tmp_path):
    with pytest.raises(ValueError, match="does not exist"):
        read_laboratory_file(tmp_path / "none.uff")
    with pytest.raises(ValueError, match="folder"):
        read_laboratory_file(tmp_path)
    for head in (b"TDSm" + bytes(3), b"\x89HDF\r\n\x1a\n" + bytes(40), b"MATLAB 5" + bytes(140)):
        path = tmp_path / "cut"
        path.write_bytes(head)
        with pytest.raises(ValueError, match=r"damaged|nothing"):
            read_laboratory_file(path)
