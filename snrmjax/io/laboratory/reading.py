"""One reader for all laboratory files: the format follows from content, then extension."""

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Literal, NamedTuple

from snrmjax.io.files import FilePath, file_name, read_bytes
from snrmjax.io.laboratory.arrays.even_axis import EvenAxis
from snrmjax.io.laboratory.arrays.matlab_files import is_old_matlab
from snrmjax.io.laboratory.arrays.octave_text import is_octave_text
from snrmjax.io.laboratory.contents import LaboratoryFile, TextFormat
from snrmjax.io.laboratory.record_tables import with_named_channels
from snrmjax.numerics.rules import InputError

_ROOM = "snrmjax.io.laboratory"
_HDF5 = b"\x89HDF\r\n\x1a\n"
_NETCDF = (".nc", ".nc4", ".cdf")


class _Format(NamedTuple):
    """A file format: its reader, with the option that it takes, and how it is recognised."""

    reader: str
    suffixes: tuple[str, ...]
    recognised: Callable[[bytes, str], bool]  # by the first bytes and the suffix
    option: Literal["axis", "text_format"] | None = None


def _is_hdf5(head: bytes) -> bool:
    return any(head[at : at + 8] == _HDF5 for at in (0, 512, 1024, 2048))  # after a user block


def _is_netcdf(head: bytes, suffix: str) -> bool:
    return _is_hdf5(head) and suffix in _NETCDF


def _is_matlab(head: bytes, suffix: str) -> bool:
    new = _is_hdf5(head) and (head.startswith(b"MATLAB 7.3") or suffix == ".mat")
    return new or is_old_matlab(head, suffix)


_READERS: dict[str, _Format] = {
    "matlab": _Format("arrays.matlab_files.read_matlab", (".mat",), _is_matlab, "axis"),
    "netcdf": _Format("arrays.hdf5_tree.read_hdf5", _NETCDF, _is_netcdf, "axis"),
    "hdf5": _Format(
        "arrays.hdf5_tree.read_hdf5", (".h5", ".hdf5"), lambda head, _: _is_hdf5(head), "axis"
    ),
    "tdms": _Format("tdms_files.read_tdms", (".tdms",), lambda head, _: head.startswith(b"TDSm")),
    "octave": _Format(
        "arrays.octave_text.read_octave", (), lambda head, _: is_octave_text(head), "axis"
    ),
    "lvm": _Format(
        "text.labview_text.read_labview_text",
        (".lvm",),
        lambda head, _: head.lstrip(b"\xef\xbb\xbf\r\n ").startswith(b"LabVIEW Measurement"),
    ),
    "uff": _Format(
        "uff.functions.read_uff",
        (".uff", ".unv", ".unv58", ".58"),
        lambda head, _: head.lstrip(b"\r\n").split(b"\n", 1)[0].rstrip() == b"    -1",
    ),
    "csv": _Format(
        "text.separated_text.read_separated_text",
        (".csv", ".tsv", ".dat", ".asc"),
        lambda head, _: b"\0" not in head or head.startswith((b"\xff\xfe", b"\xfe\xff")),  # UTF-16
        "text_format",
    ),
}
"""By kind, in the order in which they are tried: any text is a CSV."""

SUFFIXES = tuple(suffix for one in _READERS.values() for suffix in one.suffixes)
"""Suffixes of laboratory files, in small letters; content decides."""

NOT_SEPARATED_TEXT = tuple(suffix for suffix in SUFFIXES if suffix not in _READERS["csv"].suffixes)
"""Those of other formats than separated text."""

_HEAD = 4096
_MOST_REASONS = 6  # notes listed where nothing was read
_FORMATS = (
    "Formats read: UFF, MATLAB, Octave's text, HDF5, netCDF 4, TDMS, LabVIEW measurement files, "
    "CSV and other separated text."
)
_NUMPY = "it is a NumPy file: save its arrays as MATLAB, `scipy.io.savemat`, or as CSV"
_EXCEL = "it is an Excel workbook: save its sheet as CSV"


def read_laboratory_file(
    path: FilePath, text_format: TextFormat | None = None, axis: EvenAxis | None = None
) -> LaboratoryFile:
    """All recordings, frequency responses and tables of a file.

    Formats: UFF/UNV (58, 58b), MATLAB v4 to v7.3, Octave's text, HDF5, netCDF 4, TDMS, LabVIEW
    measurement files, and CSV or other separated text. Long records are read on demand
    (HDF5, netCDF, MATLAB v7.3, TDMS).
    Arguments: `text_format` of a CSV where detection fails; `axis` is that of matrices of responses
    (MATLAB, Octave, HDF5) without a frequency vector.
    Returns `LaboratoryFile`. Raises `ValueError`, in one sentence that names the file, for a file
    that is missing, empty, of another format, damaged, or that declares more data than it can hold;
    and where the reader needs a package that is not installed.
    """
    kind = _kind(path)
    form = _READERS[kind]
    module, _, function = f"{_ROOM}.{form.reader}".rpartition(".")
    read = getattr(importlib.import_module(module), function)
    given = {"axis": axis, "text_format": text_format}
    contents: LaboratoryFile = read(Path(path), *(given[form.option],) if form.option else ())
    if contents.is_empty:
        why = f": {' '.join(map(str, contents.notes[:_MOST_REASONS]))}" if contents.notes else "."
        raise InputError(f"{contents.name} holds nothing that could be read{why}")
    return contents._replace(
        kind=kind,
        recordings=tuple(map(with_named_channels, contents.recordings)),
        tables=tuple(table.with_named_units() for table in contents.tables),
    )


def _kind(path: FilePath) -> str:
    """The format of a file."""
    name, head = file_name(path), read_bytes(path, _HEAD)
    if not head:
        raise InputError(f"{name} is empty.")
    suffix = Path(path).suffix.lower()
    for kind, form in _READERS.items():
        if form.recognised(head, suffix):
            return kind
    raise InputError(f"{name} is of no known format ({_description(head)}). {_FORMATS}")


def _description(head: bytes) -> str:
    """Description of a file of unknown format."""
    if head.startswith(b"PK"):
        for entry, meaning in ((b".npy", _NUMPY), (b"[Content_Types]", _EXCEL), (b"xl/", _EXCEL)):
            if entry in head:
                return meaning
    for start, meaning in (
        (b"\x93NUMPY", _NUMPY),
        (b"\xd0\xcf\x11\xe0", _EXCEL),
        (b"PK", "it is a zip archive: unpack it first"),
        (b"\x1f\x8b", "it is a gzip archive: unpack it first"),
        (b"7z\xbc\xaf", "it is a 7z archive: unpack it first"),
        (b"CDF", "it is a classic netCDF 3 file: convert it by `nccopy -k netCDF-4`"),
        (b"TDSh", "it is the index of a TDMS file: give the .tdms file itself"),
    ):
        if head.startswith(start):
            return meaning
    return f"it begins with the bytes {head[:8].hex(' ')}"
