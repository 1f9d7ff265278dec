"""Writing what an import gives: steady states, records as CSV or netCDF 4, and the map."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from snrmjax.io.exchange.import_map import map_text
from snrmjax.io.exchange.importing import Imported
from snrmjax.io.exchange.layouts import Field, record_fields
from snrmjax.io.exchange.record_import import record_columns
from snrmjax.io.files import FilePath, file_name, write_atomically, written_whole
from snrmjax.io.laboratory.libraries import library
from snrmjax.io.tables import write_steady_states
from snrmjax.measure.recordings.time_recording import TimeRecording

_MOST_ROWS = 2**20  # of a record that is written as text
_BLOCK = 2**20  # samples of all channels that are written at once
_PIECE = 2**15  # numbers of a piece of the file


def write_netcdf(path: FilePath, recordings: Sequence[TimeRecording]) -> None:
    """Write records as netCDF 4 in SI units, block by block: they need not fit into memory.

    Groups `record_1`, … with `sampling_rate_hz`, `start_time_s`, `channels` and what is known of
    them, and `values`, one row a channel. `read_laboratory_file` gives all numbers back bit for
    bit. Raises `ValueError` for records of fewer than 64 samples.
    """
    h5netcdf, file = library("h5netcdf", "writing netCDF"), file_name(path)
    fields = [record_fields(one, file) for one in recordings]
    with written_whole(path) as new, h5netcdf.File(new, "w") as target:
        for k, (record, told) in enumerate(zip(recordings, fields, strict=True)):
            group = target.create_group(f"record_{k + 1}")
            _put_fields(group, told)
            _put_samples(group, record)


def write_import(folder: Path, found: Imported, files: Sequence[str] = ()) -> list[str]:
    """Write `measured.csv` (or `record.csv`, `record_2.csv`, …, or `.nc` of long ones), `map.toml`.

    Records have the columns `time_s`, `force_n` or `drive_v`, and one motion a sensor
    (`tip.velocity_m_s`), in SI units. The map says of which `files` all is.
    Returns the names of the files.
    """
    written = []
    if found.states is not None:
        write_steady_states(folder / "measured.csv", found.states)
        written.append("measured.csv")
    for k, record in enumerate(found.records):
        stem = "record" if k == 0 else f"record_{k + 1}"
        columns = record_columns(record, found.used)
        if record.n_samples * len(columns) > _MOST_ROWS:
            write_netcdf(folder / f"{stem}.nc", [record])
            written.append(f"{stem}.nc")
            continue
        values = np.vstack([record.time(), record.values([one.name for one in columns.values()])])
        lines = [",".join(("time_s", *columns))]
        lines += [",".join(map(repr, row)) for row in values.T.tolist()]
        write_atomically(folder / f"{stem}.csv", "\n".join(lines) + "\n")
        written.append(f"{stem}.csv")
    notes = tuple(dict.fromkeys(found.notes))
    text = map_text(found.used, found.assumed, notes, files, found.steps)
    write_atomically(folder / "map.toml", text)
    return [*written, "map.toml"]


def _put_fields(group: Any, fields: Mapping[str, Field]) -> None:
    """Arrays and texts into a group of a netCDF file."""
    h5py = library("h5py", "writing netCDF")
    for name, one in fields.items():
        values = np.asarray(one.values, dtype=object if isinstance(one.values, list) else None)
        for side, length in zip(one.sides, values.shape, strict=True):
            if side not in group.dimensions:
                group.dimensions[side] = length
        kind = h5py.string_dtype() if isinstance(one.values, list) else values.dtype
        group.create_variable(name, one.sides, dtype=kind)[...] = values


def _put_samples(group: Any, record: TimeRecording) -> None:
    """Samples block by block."""
    width = len(record.channels)
    group.dimensions["sample"] = record.n_samples
    piece = (width, max(1, min(record.n_samples, _PIECE // width)))
    values = group.create_variable("values", ("channel", "sample"), dtype="<f8", chunks=piece)
    for block in record.blocks(max(1, _BLOCK // width)):
        values[:, block.start : block.start + block.values.shape[1]] = block.values
