"""One reader for all laboratory files: the format follows from content, then extension."""

import importlib
from pathlib import Path

from snrmjax.io.files import FilePath, file_name, read_bytes
from snrmjax.io.laboratory.arrays.even_axis import EvenAxis
from snrmjax.io.laboratory.arrays.matlab_files import is_old_matlab
from snrmjax.io.laboratory.arrays.octave_text import is_octave_text
from snrmjax.io.laboratory.contents import Kind, LaboratoryFile, TextFormat
from snrmjax.io.laboratory.record_tables import with_named_channels
from snrmjax.numerics.rules import InputError

_ROOM = "snrmjax.io.laboratory"
_READERS: dict[Kind, tuple[str, str]] = {
    "uff": ("uff.functions", "read_uff"),
    "matlab": ("arrays.matlab_files", "read_matlab"),
    "octave": ("arrays.octave_text", "read_octave"),
    "hdf5": ("arrays.hdf5_tree", "read_hdf5"),
    "tdms": ("tdms_files", "read_tdms"),
    "lvm": ("text.labview_text", "read_labview_text"),
    "csv": ("text.separated_text", "read_separated_text"),
}
_OF_ARRAYS = ("matlab", "octave", "hdf5")
_HEAD = 4096
_MOST_REASONS = 6  # notes listed where nothing was read
_FORMATS = (
    "Formats read: UFF, MATLAB, Octave's text, HDF5, netCDF 4, TDMS, LabVIEW measurement files, "
    "CSV and other separated text."
)
_NUMPY = "it is a NumPy file: save its arrays as MATLAB, `scipy.io.savemat`, or as CSV"
_EXCEL = "it is an Excel workbook: save its sheet as CSV"
_HDF5 = b"\x89HDF\r\n\x1a\n"


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
    module, function = _READERS[kind]
    read = getattr(importlib.import_module(f"{_ROOM}.{module}"), function)
    options = (text_format,) if kind == "csv" else (axis,) if kind in _OF_ARRAYS else ()
    contents: LaboratoryFile = read(Path(path), *options)
    if contents.is_empty:
        why = f": {' '.join(map(str, contents.notes[:_MOST_REASONS]))}" if contents.notes else "."
        raise InputError(f"{contents.name} holds nothing that could be read{why}")
    return contents._replace(
        recordings=tuple(map(with_named_channels, contents.recordings)),
        tables=tuple(table.with_named_units() for table in contents.tables),
    )


def _kind(path: FilePath) -> Kind:
    """The format of a file."""
    name, head = file_name(path), read_bytes(path, _HEAD)
    if not head:
        raise InputError(f"{name} is empty.")
    if any(head[at : at + 8] == _HDF5 for at in (0, 512, 1024, 2048)):  # after a user block
        matlab = head.startswith(b"MATLAB 7.3") or Path(path).suffix.lower() == ".mat"
        return "matlab" if matlab else "hdf5"
    if head.startswith(b"TDSm"):
        return "tdms"
    if is_old_matlab(head, Path(path).suffix):
        return "matlab"
    if is_octave_text(head):
        return "octave"
    if head.lstrip(b"\xef\xbb\xbf\r\n ").startswith(b"LabVIEW Measurement"):
        return "lvm"
    first = head.lstrip(b"\r\n").split(b"\n", 1)[0].rstrip()
    if first == b"    -1":
        return "uff"
    if b"\0" in head and not head.startswith((b"\xff\xfe", b"\xfe\xff")):  # UTF-16 text
        raise InputError(f"{name} is of no known format ({_description(head)}). {_FORMATS}")
    return "csv"


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
