"""MATLAB, HDF5 and netCDF files written by scipy, h5py and xarray."""

import struct
import zlib

import h5py
import numpy as np
import pytest
import scipy.io
import xarray
from truths.import_runs import run_import

from snrmjax.io.laboratory import read_laboratory_file

HERTZ = np.array([79.0, 79.5, 80.0])


def level(k):
    return {
        "frequency": HERTZ + k,
        "force": np.full(3, 0.1 * k),
        "amplitude": np.array([1.0, 2.0, 3.0]) * k,
        "phase": np.array([10.0, 20.0, 30.0]),
        "drive": 0.5 * k,
    }


def write_v73(path, fill):
    """A file in the layout of MATLAB v7.3: a user block of 512 bytes, then HDF5."""
    with h5py.File(path, "w", userblock_size=512) as file:
        fill(file)
    with open(path, "r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116) + bytes(8) + b"\x00\x02IM")


def put(group, name, value, matlab_class=b"double"):
    """A matrix in MATLAB's layout: its columns are rows of the file."""
    one = group.create_dataset(name, data=np.atleast_2d(value).T)
    one.attrs["MATLAB_class"] = np.bytes_(matlab_class)
    return one


def struct_array(file, structs):
    """A struct array: each field a data set of references."""
    refs = file.create_group("#refs#")
    group = file.create_group("data")
    group.attrs["MATLAB_class"] = np.bytes_(b"struct")
    for key in structs[0]:
        inner = [put(refs, f"{key}{k}", one[key]).ref for k, one in enumerate(structs)]
        group.create_dataset(key, data=np.array([inner], dtype=h5py.ref_dtype).T)


def cells(file, structs):
    """A cell array of structs."""
    refs = file.create_group("#refs#")
    inner = []
    for k, one in enumerate(structs):
        group = refs.create_group(f"s{k}")
        group.attrs["MATLAB_class"] = np.bytes_(b"struct")
        for key, value in one.items():
            put(group, key, value)
        inner.append(group.ref)
    one = file.create_dataset("data", data=np.array([inner], dtype=h5py.ref_dtype).T)
    one.attrs["MATLAB_class"] = np.bytes_(b"cell")


@pytest.mark.parametrize("version", ["v5", "v5 compressed", "v5 cells", "v7.3", "v7.3 cells"])
def test_one_list_entry_a_level(tmp_path, version):
    path = tmp_path / "levels.mat"
    structs = [level(1), level(2)]
    if version.startswith("v5"):
        data = np.empty(2, dtype=object)
        data[:] = structs
        if "cells" not in version:
            kinds = [(key, object) for key in structs[0]]
            data = np.array([tuple(one.values()) for one in structs], dtype=kinds)
        scipy.io.savemat(path, {"data": data}, do_compression="comp" in version)
    else:
        write_v73(path, lambda file: (cells if "cells" in version else struct_array)(file, structs))
    contents = read_laboratory_file(path)
    assert contents.kind == "matlab"
    (table,) = contents.tables
    assert table.name == "data"
    np.testing.assert_array_equal(table.columns["entry"], [1, 1, 1, 2, 2, 2])
    np.testing.assert_array_equal(table.columns["frequency"], [*(HERTZ + 1), *(HERTZ + 2)])
    np.testing.assert_array_equal(table.columns["amplitude"], [1, 2, 3, 2, 4, 6])
    np.testing.assert_array_equal(table.columns["drive"], [0.5, 0.5, 0.5, 1.0, 1.0, 1.0])


def test_matrices_of_states_by_levels(tmp_path):
    path = tmp_path / "matrices.mat"
    force = np.array([[0.1, 0.2], [0.1, 0.2], [0.1, 0.2]])
    h = np.arange(6.0).reshape(3, 2) + 1j
    scipy.io.savemat(path, {"freq": HERTZ, "Force": force, "X": h.real, "Y": h.imag})
    (table,) = read_laboratory_file(path).tables
    np.testing.assert_array_equal(table.columns["entry"], [1, 1, 1, 2, 2, 2])
    np.testing.assert_array_equal(table.columns["X"], [0, 2, 4, 1, 3, 5])
    np.testing.assert_array_equal(table.columns["freq"], [*HERTZ, *HERTZ])


def test_columns_of_sensors_stay_columns(tmp_path):
    path = tmp_path / "sensors.mat"
    scipy.io.savemat(
        path,
        {"freq": HERTZ, "force": np.ones(3), "amp": np.arange(6.0).reshape(3, 2), "ph": HERTZ},
    )
    (table,) = read_laboratory_file(path).tables
    assert set(table.columns) == {"freq", "force", "ph", "amp_1", "amp_2"}
    np.testing.assert_array_equal(table.columns["amp_2"], [1, 3, 5])


def test_complex_columns_and_matrices_of_responses(tmp_path):
    path = tmp_path / "frf.mat"
    h = np.arange(6).reshape(2, 3) * (1 + 1j)
    scipy.io.savemat(path, {"f": HERTZ, "H": h, "H1": h[0]})
    contents = read_laboratory_file(path)
    (one,) = contents.responses
    np.testing.assert_array_equal(one.values[:, 0], h)
    np.testing.assert_array_equal(one.frequency, HERTZ * 2 * np.pi)
    np.testing.assert_array_equal(contents.tables[0].columns["H1"], h[0])


@pytest.mark.parametrize("version", ["v5", "v7.3", "hdf5", "netcdf"])
def test_a_time_record_with_a_table_of_steps(tmp_path, version):
    rng = np.random.default_rng(2)
    time, force, response = np.arange(500) / 2048 + 0.25, rng.normal(size=500), rng.normal(size=500)
    steps = {"frequency": HERTZ, "start": np.array([0.0, 0.1, 0.2]), "level": np.array([1.0, 1, 2])}
    path = (
        tmp_path / f"record.{'mat' if version[0] == 'v' else 'h5' if version[0] == 'h' else 'nc'}"
    )
    if version == "v5":
        scipy.io.savemat(path, {"time": time, "F": force, "acc": response, "steps": steps})
    elif version == "v7.3":

        def fill(file):
            for key, values in {"time": time, "F": force, "acc": response}.items():
                put(file, key, values)
            group = file.create_group("steps")
            group.attrs["MATLAB_class"] = np.bytes_(b"struct")
            for key, values in steps.items():
                put(group, key, values)

        write_v73(path, fill)
    elif version == "hdf5":
        with h5py.File(path, "w") as file:
            both = file.create_dataset("run/channels", data=np.stack([force, response], axis=1))
            both.attrs["sampling_rate"], both.attrs["unit"] = 2048.0, "g"
            file.create_dataset("run/names", data=["F", "acc"])
            for key, values in steps.items():
                file.create_dataset(f"steps/{key}", data=values)
    else:
        steps = {key: ("step", values) for key, values in steps.items()}
        units = {"units": "N"}
        records = {"F": ("time", force, units), "acc": ("time", response)}
        xarray.Dataset({**records, **steps}, coords={"time": time}).to_netcdf(
            path, engine="h5netcdf"
        )
    contents = read_laboratory_file(path)
    (record,) = contents.recordings
    assert record.channel_names == ("F", "acc")
    assert record.sampling_rate == 2048
    assert record.start_time == (0.0 if version == "hdf5" else 0.25)
    values = record.values() / (9.80665 if version == "hdf5" else 1)
    np.testing.assert_allclose(values, [force, response], rtol=1e-15)
    np.testing.assert_array_equal(record.values(["acc"], 3, 7), record.values()[1:, 3:7])
    assert record.channels[0].quantity == {"hdf5": "acceleration", "netcdf": "force"}.get(
        version, "unknown"
    )
    (table,) = contents.tables
    np.testing.assert_array_equal(table.columns["frequency"], HERTZ)


def test_packed_netcdf_numbers_are_unpacked(tmp_path):
    path = tmp_path / "packed.nc"
    packing = {"dtype": "int16", "scale_factor": 0.25, "add_offset": 1.0, "_FillValue": -99}
    xarray.Dataset({"force": ("n", [1.5, np.nan, 2.0])}).to_netcdf(
        path, engine="h5netcdf", encoding={"force": packing}
    )
    (table,) = read_laboratory_file(path).tables
    np.testing.assert_array_equal(table.columns["force"], [1.5, np.nan, 2.0])


def test_an_uneven_time_is_a_column(tmp_path):
    path = tmp_path / "uneven.mat"
    time = np.cumsum(1 + 0.01 * np.random.default_rng(0).normal(size=100))
    scipy.io.savemat(path, {"t": time, "x": time})
    contents = read_laboratory_file(path)
    assert not contents.recordings
    assert contents.notes[0].kind == "uneven_time"
    assert set(contents.tables[0].columns) == {"t", "x"}


def test_function_handles_and_objects_are_named(tmp_path):
    path = tmp_path / "handle.mat"

    def fill(file):
        put(file, "x", HERTZ)
        put(file, "f", [[1.0]], b"function_handle")
        one = put(file, "s", [[1.0, 2.0]], b"string")
        one.attrs["MATLAB_object_decode"] = 3

    write_v73(path, fill)
    contents = read_laboratory_file(path)
    named = [(note["name"], note["kind"]) for note in contents.notes]
    assert named == [("f", "function_handle"), ("s", "string")]
    assert set(contents.tables[0].columns) == {"x"}


def object_of_matlab(name, kind):
    """A variable of level 5 that is an object, as MATLAB writes tables, strings and datetimes."""

    def element(number, data):
        return struct.pack("<II", number, len(data)) + data + bytes(-len(data) % 8)

    marks = np.array([3707764736, 2, 1, 1, 1, 1], dtype="<u4")
    flags = element(6, struct.pack("<II", 13, 0))
    inner = flags + element(5, struct.pack("<ii", 6, 1)) + element(1, b"")
    inner = element(14, inner + element(6, marks.tobytes()))
    texts = b"".join(element(1, word.encode()) for word in (name, "MCOS", kind))
    return element(14, element(6, struct.pack("<II", 17, 0)) + texts + inner)


@pytest.mark.parametrize("is_compressed", [False, True])
@pytest.mark.parametrize("kinds", [("table",), ("string", "datetime", "containers.Map")])
def test_objects_next_to_plain_arrays_are_named(tmp_path, kinds, is_compressed):
    path = tmp_path / "objects.mat"
    scipy.io.savemat(path, {"frequency": HERTZ, "s": {"force": 1.0}}, do_compression=is_compressed)
    for kind in kinds:
        packed = object_of_matlab(f"a_{kind[:3]}", kind)
        if is_compressed:
            packed = zlib.compress(packed)
            packed = struct.pack("<II", 15, len(packed)) + packed
        path.write_bytes(path.read_bytes() + packed)
    contents = read_laboratory_file(path)
    np.testing.assert_array_equal(contents.tables[0].columns["frequency"], HERTZ)
    named = [(note["name"], note["kind"]) for note in contents.notes]
    assert named == [(f"a_{kind[:3]}", kind) for kind in kinds]
    path.write_bytes(path.read_bytes()[:128] + object_of_matlab("T", "timetable"))
    with pytest.raises(ValueError, match=r"could be read: T is of the class timetable"):
        read_laboratory_file(path)


def test_links_to_other_files_are_not_followed(tmp_path):
    with h5py.File(tmp_path / "secret.h5", "w") as file:
        file["x"] = HERTZ
    path = tmp_path / "links.h5"
    with h5py.File(path, "w") as file:
        file["a"] = h5py.ExternalLink(tmp_path / "secret.h5", "x")
        file["again"] = h5py.SoftLink("/")
        layout = h5py.VirtualLayout((3,), float)
        layout[:] = h5py.VirtualSource(tmp_path / "secret.h5", "x", (3,))
        file.create_virtual_dataset("v", layout)
        file["gone"] = h5py.SoftLink("/nowhere")
    with pytest.raises(ValueError, match="nothing that could be read"):
        read_laboratory_file(path)


def test_more_numbers_than_the_file_can_hold(tmp_path):
    path = tmp_path / "empty.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("x", shape=(10**12,), dtype="f8", chunks=(1024,))
        file.create_dataset("y", shape=(10**9,), dtype="f8")
    with pytest.raises(ValueError, match="never written"):
        read_laboratory_file(path)


def test_texts_after_a_user_block(tmp_path):
    path = tmp_path / "texts.h5"
    words = ["load cell", "", "µm/s", "x" * 3000]
    with h5py.File(path, "w", userblock_size=1024) as file:
        file.create_dataset("channels", data=words, dtype=h5py.string_dtype())
        file.create_dataset("values", data=np.arange(400.0).reshape(4, 100))
        file.attrs["fs"] = 100.0
    contents = read_laboratory_file(path)
    assert list(contents.recordings[0].channel_names) == [words[0], "values_2", *words[2:]]


def v4_matrix(name, values, order, kind, code, imaginary=None):
    """A matrix of level 4 by the format's description: five whole numbers, name, columns."""
    text = name.encode() + b"\0"
    rows, columns = values.shape
    head = struct.pack(f"{order}5i", code, rows, columns, imaginary is not None, len(text))
    parts = [values] if imaginary is None else [values, imaginary]
    return head + text + b"".join(one.T.astype(order + kind).tobytes() for one in parts)


def test_level_4_of_both_orders_of_bytes(tmp_path):
    rng = np.random.default_rng(6)
    path = tmp_path / "old.mat"
    curve = rng.normal(size=(3, 1)) + 1j * rng.normal(size=(3, 1))
    scipy.io.savemat(path, {"frequency": HERTZ[:, None], "H": curve, "title": "test 4"}, format="4")
    (table,) = read_laboratory_file(path).tables
    np.testing.assert_array_equal(table.columns["frequency"], HERTZ)
    np.testing.assert_array_equal(table.columns["H"], curve[:, 0])
    counts = rng.integers(-99, 99, size=(5, 2))
    big = v4_matrix("frequency", np.arange(5.0)[:, None], ">", "f8", 1000)
    big += v4_matrix("counts", counts, ">", "i2", 1030)
    big += v4_matrix("z", counts[:, :1], ">", "f4", 1010, counts[:, 1:])
    path.write_bytes(big)
    (table,) = read_laboratory_file(path).tables
    np.testing.assert_array_equal(table.columns["counts_2"], counts[:, 1])
    np.testing.assert_array_equal(table.columns["z"], counts[:, 0] + 1j * counts[:, 1])
    path.write_bytes(big[:-1])
    with pytest.raises(ValueError, match=r"old.mat is damaged .*Not enough bytes to read matrix"):
        read_laboratory_file(path)
    path.write_bytes(big + b"rest")
    with pytest.raises(ValueError, match=r"old\.mat is damaged or is not a MATLAB file"):
        read_laboratory_file(path)


def test_a_file_of_texts_alone_is_refused(tmp_path):
    path = tmp_path / "words.mat"
    scipy.io.savemat(path, {"title": "beam", "n": 3.0, "none": np.zeros((0, 2))})
    with pytest.raises(ValueError, match=r"only text, single numbers and empty arrays \(title, n"):
        read_laboratory_file(path)


def test_blanks_without_their_bytes(tmp_path):
    """A text of one blank as MATLAB may write it: a dimension of 1, and no byte."""
    path = tmp_path / "blank.mat"
    scipy.io.savemat(path, {"note": "q", "frequency": HERTZ}, format="5")
    content = bytearray(path.read_bytes())
    at = content.index(struct.pack("<HHc", 16, 1, b"q"))  # a small element: one byte of text
    content[at : at + 5] = struct.pack("<HHc", 16, 0, b"\0")
    path.write_bytes(content)
    assert scipy.io.loadmat(path)["note"].tolist() == [" "]
    (table,) = read_laboratory_file(path).tables
    np.testing.assert_array_equal(table.columns["frequency"], HERTZ)


def test_elements_of_no_type_are_refused(tmp_path):
    """Zeros at the start of an element crash scipy."""
    path = tmp_path / "zeros.mat"
    scipy.io.savemat(path, {"frequency": HERTZ, "H": HERTZ + 1j})
    content = bytearray(path.read_bytes())
    at = content.index(HERTZ.tobytes()) - 8
    content[at : at + 8] = bytes(8)
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"zeros\.mat is damaged .*type 0"):
        read_laboratory_file(path)


OCTAVE = """# Created by Octave 6.4.0, Mon Jan 05 10:00:00 2026 UTC <user@host>
# name: test
# type: scalar struct
# ndims: 2
 1 1
# length: 7
# name: frequency
# type: range
# base, limit, increment
79 80 0.5


# name: force
# type: int32 matrix
# ndims: 2
 3 1
  1
  2
  4


# name: velocity
# type: float complex matrix
# rows: 1
# columns: 3
 (1,0.5) (NaN,-2) (-3e-2,0)


# name: ok
# type: bool matrix
# rows: 3
# columns: 1
 1
 0
 1


# name: title
# type: string
# elements: 1
# length: 5
a tip


# name: f
# type: function handle
@<anonymous>
@ (x) x .^ 2


# name: gain
# type: scalar
2.5




# name: levels
# type: cell
# rows: 1
# columns: 2
# name: <cell-element>
# type: scalar struct
# ndims: 2
 1 1
# length: 2
# name: frequency
# type: matrix
# rows: 2
# columns: 1
 10
 11


# name: force
# type: scalar
0.1




# name: <cell-element>
# type: scalar struct
# ndims: 2
 1 1
# length: 2
# name: frequency
# type: matrix
# rows: 2
# columns: 1
 10
 12


# name: force
# type: scalar
0.2







# name: S
# type: sparse matrix
# nnz: 1
# rows: 2
# columns: 2
1 1 3


"""


def test_the_text_format_of_octave(tmp_path):
    path = tmp_path / "a.mat"
    path.write_text(OCTAVE)
    contents = read_laboratory_file(path)
    assert contents.kind == "octave"
    named = {table.name: table for table in contents.tables}
    columns = named["test"].columns
    np.testing.assert_array_equal(columns["frequency"], HERTZ)
    np.testing.assert_array_equal(columns["force"], [1, 2, 4])
    np.testing.assert_array_equal(columns["velocity"], [1 + 0.5j, np.nan - 2j, -0.03])
    assert columns["ok"].dtype == bool
    levels = named["levels"].columns
    assert levels["force"].tolist() == [0.1, 0.1, 0.2, 0.2]
    assert levels["frequency"].tolist() == [10, 11, 10, 12]
    notes = [(note.kind, note["name"]) for note in contents.notes]
    assert ("object_not_read", "test.f") in notes
    assert ("not_read", "S") in notes


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("# columns: 3", "# columns: 4", "have 3 numbers, but 4 are stated"),
        ("# rows: 2", "# rows: 200", "it ends within a variable"),
        ("# rows: 2", "# rows: -2", "line 69 must be a number of rows, but is '-2'"),
        ("79 80 0.5", "79 80 0", "must be base, limit and increment of test.frequency"),
        ("79 80 0.5", "79 80 1e-12", "a range of less than"),
        (" 10\n", " 1x\n", "must be numbers"),
        ("# type: bool", "# kind: bool", "must be # type: …, but is '# kind: bool matrix'"),
    ],
)
def test_damaged_text_of_octave_is_refused(tmp_path, old, new, complaint):
    path = tmp_path / "a.mat"
    path.write_text(OCTAVE.replace(old, new))
    with pytest.raises(ValueError, match=rf"a\.mat is (truncated|damaged): .*{complaint}"):
        read_laboratory_file(path)


@pytest.mark.parametrize("version", ["v5", "v7.3"])
@pytest.mark.parametrize(
    ("names", "unit", "is_vector"),
    [(("fstart", "df"), 1.0, False), (("freq_start_kHz", "f_step_kHz"), 1e3, True)],
)
def test_a_start_and_a_step_are_the_axis_of_responses(tmp_path, version, names, unit, is_vector):
    h = np.arange(1, 41).reshape(2, 20) * (1 + 2j)
    single = {names[0]: 10.0 / unit, names[1]: 0.25 / unit}
    arrays = {"H": h[0] if is_vector else h.T, "flags": (np.arange(20) % 2).astype(np.int16)}
    path = tmp_path / "frf.mat"
    if version == "v5":
        scipy.io.savemat(path, {**single, **arrays})
    else:

        def fill(file):
            for key, value in {**single, **arrays}.items():
                put(file, key, np.atleast_2d(value))

        write_v73(path, fill)
    contents = read_laboratory_file(path)
    (one,) = contents.responses
    np.testing.assert_allclose(one.frequency, 2 * np.pi * (10 + 0.25 * np.arange(20)), rtol=1e-13)
    np.testing.assert_array_equal(one.values[:, 0], h[:1] if is_vector else h)
    assert not contents.tables
    assert [note.kind for note in contents.notes if note.kind != "responses_along_first_side"] == [
        *("even_axis", "not_read")
    ]
    assert any(note.get("why") == "marks" for note in contents.notes)


def test_a_stated_axis_and_marks_with_responses(tmp_path):
    path, out = tmp_path / "frf.mat", tmp_path / "out"
    h, valid = np.arange(1, 41).reshape(2, 20) * (1 + 2j), np.arange(20) > 3
    scipy.io.savemat(path, {"H": h, "valid": valid})
    code, output = run_import(path)
    assert code == 0
    assert "snrmjax import" in output
    assert "--frequency-start HZ --frequency-step HZ" in output
    words = ("--response", "H.2:velocity:m/s", "--force-amplitude", 2, "--out", out)
    axis = ("--frequency-start", 10, "--frequency-step", 0.25)
    code, output = run_import(path, *axis, *words)
    assert code == 0, output
    table = np.genfromtxt(out / "measured.csv", delimiter=",", names=True)
    np.testing.assert_allclose(table["frequency_hz"], 10 + 0.25 * np.arange(20), rtol=1e-13)
    np.testing.assert_allclose(table["velocity_im_m_s"], 2 * h[1].imag, rtol=1e-13)
    # The map of that import reads the next file the same way.
    code, output = run_import(path, "--map", out / "map.toml", "--out", tmp_path / "again")
    assert (tmp_path / "again" / "measured.csv").read_text() == (out / "measured.csv").read_text()
    assert "needs --frequency-step" in run_import(path, *axis[:2], *words)[1]
    scipy.io.savemat(path, {"H": h, "f": 10 + np.arange(20), "valid": valid})
    assert "--frequency-step has no effect" in run_import(path, *axis, *words)[1]
    contents = read_laboratory_file(path)
    assert not contents.tables
    assert len(contents.responses) == 1
    # A boolean column is never proposed as the response of a table.
    scipy.io.savemat(path, {"f": 10 + np.arange(20), "good": valid, "v": h[0].real})
    assert "--response v:" in run_import(path)[1]


def test_an_array_without_its_imaginary_part_is_refused(tmp_path):
    """A damaged flag marks a field as complex, which crashes scipy."""
    path = tmp_path / "flag.mat"
    scipy.io.savemat(path, {"s": {"frequency": HERTZ, "v": HERTZ**2}})
    content = bytearray(path.read_bytes())
    at = content.index(struct.pack("<III", 6, 8, 6), 300) + 9
    content[at] |= 8
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"flag\.mat is damaged .*without its numbers"):
        read_laboratory_file(path)


def test_a_heap_of_texts_without_an_end_is_refused(tmp_path):
    """With a zero size of its free space, reading a text within HDF5 never ends."""
    path = tmp_path / "heap.h5"
    with h5py.File(path, "w") as file:
        file["x"] = HERTZ
        file["x"].attrs["unit"] = "mm/s"
        file["names"] = ["one", "two"]
    assert read_laboratory_file(path).tables[0].units == {"x": "mm/s"}
    content = bytearray(path.read_bytes())
    start = content.index(b"GCOL")
    at = start + 16
    while int.from_bytes(content[at : at + 2], "little"):
        at += 16 + -(-int.from_bytes(content[at + 8 : at + 16], "little") // 8) * 8
    content[at : at + 16] = bytes(16)
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"heap\.h5 is damaged .*global heap without an end"):
        read_laboratory_file(path)


@pytest.mark.parametrize("chunks", [None, (1,)])
def test_a_text_longer_than_its_file_is_refused(tmp_path, chunks):
    """The HDF5 library allocates the declared length of a variable-length string."""
    path = tmp_path / "long.h5"
    with h5py.File(path, "w", userblock_size=512) as file:
        file["x"] = HERTZ
        kind = h5py.string_dtype()
        names = np.array(["one", "three"], dtype=object)
        file.create_dataset("names", data=names, dtype=kind, chunks=chunks)
    assert read_laboratory_file(path).tables[0].columns.keys() == {"x"}
    content = bytearray(path.read_bytes())
    heap = content.index(b"GCOL") - 512
    at = content.index(struct.pack("<IQ", 5, heap))
    content[at : at + 4] = struct.pack("<I", 2**26)
    path.write_bytes(content)
    with pytest.raises(
        ValueError, match=rf"long\.h5 is damaged .*names has a string of {2**26} cha"
    ):
        read_laboratory_file(path)


@pytest.mark.parametrize("rows", [(-1, 1), (1, -1)])
def test_a_force_stated_by_one_number_holds_for_all_rows(tmp_path, rows):
    path = tmp_path / "a.mat"
    velocity = (HERTZ + 1j).reshape(rows)
    scipy.io.savemat(path, {"freq": HERTZ.reshape(rows), "v": velocity, "F": 0.4, "fs": 5120.0})
    (table,) = read_laboratory_file(path).tables
    assert set(table.columns) == {"freq", "v", "F"}
    np.testing.assert_array_equal(table.columns["F"], np.full(len(HERTZ), 0.4))


def test_one_force_a_column_makes_levels_of_a_complex_matrix(tmp_path):
    path = tmp_path / "a.mat"
    velocity = np.column_stack([HERTZ + 1j, 2 * HERTZ + 3j])
    scipy.io.savemat(path, {"freq": HERTZ, "v": velocity, "F": [[0.4, 0.8]]})
    contents = read_laboratory_file(path)
    (table,) = contents.tables
    assert not contents.responses
    np.testing.assert_array_equal(table.columns["v"], velocity.T.ravel())
    np.testing.assert_array_equal(table.columns["F"], np.repeat([0.4, 0.8], len(HERTZ)))


@pytest.mark.parametrize("name", ["a.npy", "a.npz"])
def test_a_numpy_file_is_refused_with_the_formats_that_are_read(tmp_path, name):
    path = tmp_path / name
    (np.save if name == "a.npy" else np.savez)(path, np.arange(9.0))
    with pytest.raises(ValueError, match=r"NumPy file: .*savemat.* UFF, MATLAB, .* text\.$"):
        read_laboratory_file(path)
