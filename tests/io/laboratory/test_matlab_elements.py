"""MATLAB 5 files with inconsistent elements: refused before scipy reads them."""

import struct
import zlib

import numpy as np
import pytest
import scipy.io
import scipy.sparse
from truths.import_runs import run_import

from snrmjax.io.laboratory import read_laboratory_file
from snrmjax.io.laboratory.arrays.matlab_files import checked_variables

HERTZ = np.array([79.0, 79.5, 80.0])
TEXT = struct.pack("<IIIIII", 6, 8, 4, 0, 5, 8)  # flags of a text, and the tag of its dimensions
STRUCT = struct.pack("<IIIIII", 6, 8, 2, 0, 5, 8)
CELL = struct.pack("<IIIIII", 6, 8, 1, 0, 5, 8)


def write_test(path):
    fields = {"frequency": HERTZ, "v": HERTZ**2, "names": np.array(["a", "b"], dtype=object)}
    scipy.io.savemat(path, {"test": fields})
    return bytearray(path.read_bytes())


def with_bytes(content, behind, at, new):
    """Replace bytes at an offset after a mark."""
    start = content.index(behind) + len(behind) + at
    content[start : start + len(new)] = new


def number_kind(content):
    at = content.index(HERTZ.tobytes()) - 8
    content[at : at + 4] = struct.pack("<I", 11)


def longer_array(content):
    """The array of the first field ends where the second one does."""
    at = content.index(HERTZ.tobytes()) - 8 - 40
    size = struct.unpack_from("<I", content, at - 4)[0]
    following = struct.unpack_from("<I", content, at + size + 4)[0]
    content[at - 4 : at] = struct.pack("<I", size + 8 + following)


DAMAGES = {
    "a text without dimensions": (
        lambda c: with_bytes(c, TEXT, -4, bytes(4)),
        r"the dimensions \(\)",
    ),
    "many structs": (
        lambda c: with_bytes(c, STRUCT, 4, b"nan\0"),
        "without its contents|fewer are left",
    ),
    "many cells": (
        lambda c: with_bytes(c, CELL, 4, struct.pack("<i", 2**20)),
        "without its contents",
    ),
    "a dimension below zero": (
        lambda c: with_bytes(c, CELL, 0, struct.pack("<i", -1)),
        r"the dimensions \(-1, 2\)",
    ),
    "numbers of no type": (number_kind, "type 11"),
    "an array within another": (longer_array, "more than its contents"),
    "names of no letter": (
        lambda c: with_bytes(c, struct.pack("<HHi", 5, 4, 10), -4, bytes(4)),
        "names have",
    ),
    "an unknown class": (lambda c: with_bytes(c, CELL, -16, b"\x13"), "of the class 19"),
    "flags of another size": (lambda c: with_bytes(c, CELL, -20, b"\x07"), "without its flags"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_what_does_not_fit_is_refused(tmp_path, damage):
    path = tmp_path / "test.mat"
    content = write_test(path)
    (table,) = read_laboratory_file(path).tables
    np.testing.assert_array_equal(table.columns["v"], HERTZ**2)
    change, complaint = DAMAGES[damage]
    change(content)
    path.write_bytes(content)
    with pytest.raises(ValueError, match=rf"^test\.mat is damaged .*({complaint}).*\)\.$"):
        read_laboratory_file(path)


def test_a_command_ends_with_one_sentence(tmp_path):
    """A text without sides ended the process within scipy."""
    content = write_test(tmp_path / "test.mat")
    DAMAGES["a text without dimensions"][0](content)
    (tmp_path / "test.mat").write_bytes(content)
    code, output = run_import(tmp_path / "test.mat")
    assert code == 2
    assert output.count("is damaged or is not a MATLAB file") == 1


def compressed(element, packed=None):
    packed = zlib.compress(element) if packed is None else packed
    return struct.pack("<II", 15, len(packed)) + packed


def test_compressed_variables_are_checked_too(tmp_path):
    path = tmp_path / "test.mat"
    content = write_test(path)
    head, element = bytes(content[:128]), bytes(content[128:])
    path.write_bytes(head + compressed(element))
    assert read_laboratory_file(path).tables[0].columns.keys() == {"frequency", "v"}
    DAMAGES["a text without dimensions"][0](content)
    checksum = zlib.compress(element)[:-1] + b"\0"
    for packed, complaint in (
        (compressed(bytes(content[128:])), r"the dimensions \(\)"),
        (compressed(b"", checksum), "incorrect data check"),
        (compressed(element[:-8]), "another size than stated"),
        (compressed(element[:4] + struct.pack("<I", 2**31) + bytes(99)), "cannot hold"),
    ):
        path.write_bytes(head + packed)
        with pytest.raises(ValueError, match=rf"test\.mat is damaged .*{complaint}"):
            read_laboratory_file(path)


def test_what_takes_no_byte_is_few(tmp_path):
    """Blanks and structs without fields: their number alone takes memory and time."""
    path = tmp_path / "test.mat"
    for value, complaint in (("", "characters and no byte"), ({}, "structs and no field")):
        scipy.io.savemat(path, {"frequency": HERTZ, "note": value})
        content = bytearray(path.read_bytes())
        mark = TEXT if value == "" else STRUCT
        with_bytes(content, mark, 0, struct.pack("<ii", 2**14, 2**14))
        path.write_bytes(content)
        with pytest.raises(ValueError, match=rf"test\.mat is damaged .*{complaint}"):
            read_laboratory_file(path)


@pytest.mark.parametrize("is_compressed", [False, True])
def test_what_is_whole_passes(tmp_path, is_compressed):
    values = {
        "z": HERTZ + 1j,
        "flags": HERTZ > 79,
        "small": np.arange(6, dtype=np.int8).reshape(1, 2, 3),
        "none": np.zeros((0, 4)),
        "blank": "",
        "lines": ["one", "four"],
        "nothing": {},
        "deep": {"a": {"b": [HERTZ, {"c": "Grüße"}]}},
        "matrix": scipy.sparse.csc_array(np.diag(HERTZ)),
        "wide": scipy.sparse.csc_array((10**5, 10**5)),
    }
    path = tmp_path / "test.mat"
    scipy.io.savemat(path, values, do_compression=is_compressed)
    names = [one.name for one in checked_variables(path.read_bytes())]
    assert names == list(values)
    read = read_laboratory_file(path)
    np.testing.assert_array_equal(read.tables[0].columns["z"], HERTZ + 1j)
