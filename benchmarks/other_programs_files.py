"""Files that other programs wrote: what is read of them, beside what the formats' own readers read.

Run: python benchmarks/other_programs_files.py FOLDER [FOLDER …] [--scenarios]

Every file of the folders (UFF, MATLAB, HDF5, netCDF, TDMS) is listed as `snrmjax import FILE` does,
and all numbers that were read are compared bit for bit with those of pyuff, nptdms, scipy, h5py or
xarray. Such folders are `data` of pyuff, `nptdms/test/data` of npTDMS, `scipy/io/matlab/tests/data`
of an installed scipy. `--scenarios` also writes the files that the tests of the installed npTDMS
describe byte by byte (`nptdms.test.scenarios`), and compares with the numbers that stand there.

One JSON line a file: what it is, `outcome` (read, refused, crashed), the arrays that agree and
those that do not, the arrays of the peer that are `unsaid` (neither read nor named in a note or
refusal), and what was said. The last line counts.
"""

import argparse
import collections
import importlib
import json
import tempfile
import warnings
from pathlib import Path

import numpy as np

ENDINGS = {".uff", ".unv", ".mat", ".h5", ".hdf5", ".nc", ".nc4", ".tdms"}
COUNTERS = ("entry", "entry number", "z_axis_value")


def ours(path):
    """Arrays that we read, as they stand in the file, and what is said of the rest."""
    from snrmjax.io.exchange.listing import listed_contents, suggested_command
    from snrmjax.io.laboratory import read_laboratory_file

    held = read_laboratory_file(path)
    lines = [*listed_contents(held), *suggested_command([path], held)]
    found = []
    for one in held.recordings:
        rows = one.samples.read(range(len(one.channels)), 0, one.n_samples)
        found += list(zip(one.channel_names, rows, strict=True))
    for one in held.tables:
        found += [
            (f"{one.name}.{key}", column)
            for key, column in one.columns.items()
            if key not in COUNTERS and not (held.kind == "uff" and key in ("time", "frequency"))
        ]
    for one in held.responses:
        for k, output in enumerate(one.responses):
            for m, given in enumerate(one.references):
                values = one.values[k, m] / (output.calibration / given.calibration)
                if not np.isnan(values).all():
                    found.append((f"{output.name} over {given.name}", values, True))
                if not np.isnan(one.coherence[k, m]).all():
                    found.append((f"coherence of {output.name}", one.coherence[k, m]))
    return held, found, "\n".join((*lines, *held.notes))


def of_uff(path):
    """Arrays of a universal file by pyuff."""
    import pyuff

    source = pyuff.UFF(str(path))
    types = [int(number) for number in source.get_set_types()]
    for k, number in enumerate(types):
        name = f"type {number}"
        if number == 58:
            yield name, source.read_sets(k)["data"]
        elif number not in (151, 164):
            yield name, None


def of_tdms(path):
    """Channels of a TDMS file by nptdms."""
    from nptdms import TdmsFile

    for group in TdmsFile.read(path).groups():
        for channel in group.channels():
            numbers = len(channel) and channel.dtype.kind in "biufc"
            yield channel.name, channel[:] if numbers else None


def of_matlab(path):
    """Arrays of a MATLAB file by scipy, of v7.3 by h5py."""
    import h5py
    import scipy.io

    if h5py.is_hdf5(path):
        yield from of_hdf5(path)
        return
    for key, value in scipy.io.loadmat(path).items():
        if not key.startswith("__"):
            yield from inside(key, value)


def inside(name, value):
    """Arrays inside of structs and cells."""
    if not isinstance(value, np.ndarray) or type(value) is not np.ndarray:
        yield name, None
    elif value.dtype.names:
        for record in value.reshape(-1):
            for key in value.dtype.names:
                yield from inside(f"{name}.{key}", record[key])
    elif value.dtype == object:
        for one in value.reshape(-1):
            yield from inside(name, one)
    elif value.dtype.kind in "biufc":  # texts are names of channels and sensors
        yield name, value


def of_hdf5(path):
    """Arrays of an HDF5 file by h5py."""
    import h5py

    found = []

    def visit(name, one):
        if isinstance(one, h5py.Dataset) and not name.startswith("#"):
            numbers = one.dtype.kind in "biufc" and one.shape is not None
            found.append((name.split("/")[-1], one[()] if numbers else None))

    with h5py.File(path, "r") as file:
        file.visititems(visit)
    yield from found


def of_netcdf(path):
    """Variables of a netCDF file by xarray, fill values, scales and offsets applied."""
    import xarray

    with xarray.open_datatree(path, engine="h5netcdf", decode_times=False) as tree:
        for node in tree.subtree:
            for name, one in node.variables.items():
                yield str(name), one.values if one.dtype.kind in "biufc" else None


PEERS = {
    **{"uff": of_uff, "tdms": of_tdms, "matlab": of_matlab, "hdf5": of_hdf5},
    "netcdf": of_netcdf,
}


def atoms(arrays):
    """Pieces of which a column may be put together: arrays, rows and columns of matrices."""
    for value in arrays:
        plain = np.squeeze(np.asarray(value))
        flat = plain.reshape(-1)
        if flat.size:
            yield flat.astype(complex)
        if plain.ndim == 2 and min(plain.shape) > 1:
            yield from plain.astype(complex)
            yield from plain.T.astype(complex)


def agrees(values, pieces, scaled):
    """Whether a column is pieces under one another, bit for bit (a scaled one: its last bit)."""
    wanted, at = np.asarray(values).astype(complex), 0
    slack = 4 * np.finfo(float).eps if scaled else 0.0
    used = set()
    while at < len(wanted):
        for k, piece in enumerate(pieces):
            part = wanted[at : at + len(piece)]
            if len(part) == len(piece) and np.allclose(part, piece, slack, 0, equal_nan=True):
                used.add(k)
                at += len(piece)
                break
        else:
            if not np.isnan(wanted[at]):  # an entry of a list lacks this column
                return set()
            at += 1
    return used


def judged(path, peer_arrays=None):
    """The line of a file."""
    line = {"file": path.name}
    try:
        held, found, said = ours(path)
        line |= {"kind": held.kind, "outcome": "read"}
    except ValueError as error:
        held, found, said = None, [], str(error)
        line |= {"outcome": "refused"}
    except Exception as error:
        return line | {"outcome": "crashed", "says": repr(error)[:300]}
    endings = {".mat": "matlab", ".tdms": "tdms", ".uff": "uff", ".unv": "uff", ".nc": "netcdf"}
    kind = held.kind if held else endings.get(path.suffix.lower(), "hdf5")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            peer = list(PEERS[kind](path) if peer_arrays is None else peer_arrays)
    except Exception as error:
        return line | {"peer": f"refuses: {' '.join(str(error).split())[:120]}", "says": said}
    # Longest first: a piece of one number would match before the vector that begins with it.
    pieces = sorted(atoms(value for _, value in peer if value is not None), key=len, reverse=True)
    used, wrong = set(), []
    for name, values, *scaled in found:
        at = agrees(values, pieces, bool(scaled and scaled[0]))
        used |= at
        if not at:
            wrong.append(name)
    seen = {pieces[k].tobytes() for k in used}
    unsaid = [
        name
        for name, value in peer
        if (
            value is None
            or (np.size(value) > 1 and not seen & {p.tobytes() for p in atoms([value])})
        )
        and name not in said
        and "data set" not in said
    ]
    line |= {"agree": len(found) - len(wrong), "differ": wrong, "unsaid": unsaid}
    return line | ({"says": said} if held is None else {"notes": list(held.notes)})


def described(into):
    """The files of npTDMS' scenarios, with the numbers that stand beside them."""
    scenarios = importlib.import_module("nptdms.test.scenarios")
    for parameter in scenarios.get_scenarios():
        file, expected = parameter.values
        path = into / f"{parameter.id}.tdms"
        path.write_bytes(file._get_contents())
        yield (
            path,
            [
                (name, values if np.asarray(values).dtype.kind in "biufc" else None)
                for (_, name), values in expected.items()
            ],
        )


def main():
    """Every file of the folders."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--scenarios", action="store_true")
    options = parser.parse_args()
    lines = []
    for folder in options.folders:
        for path in sorted(folder.rglob("*")):
            if path.is_file() and path.suffix.lower() in ENDINGS:
                lines.append(judged(path))
                print(json.dumps(lines[-1], ensure_ascii=False), flush=True)
    if options.scenarios:
        with tempfile.TemporaryDirectory() as into:
            for path, arrays in described(Path(into)):
                lines.append(judged(path, arrays))
                print(json.dumps(lines[-1], ensure_ascii=False), flush=True)
    counts = {
        "files": len(lines),
        "outcomes": dict(collections.Counter(one["outcome"] for one in lines)),
        "arrays_that_agree": sum(one.get("agree", 0) for one in lines),
        "arrays_that_differ": sum(len(one.get("differ", ())) for one in lines),
        "unsaid": sum(len(one.get("unsaid", ())) for one in lines),
    }
    print(json.dumps({"benchmark": "other_programs_files", **counts}))


if __name__ == "__main__":
    main()
