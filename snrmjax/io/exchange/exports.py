"""Writing imported data: steady states, records as CSV or netCDF 4, and the map."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from snrmjax.io.exchange.import_map import map_text
from snrmjax.io.exchange.importing import Imported
from snrmjax.io.exchange.record_import import record_columns
from snrmjax.io.files import FilePath, write_atomically, written_whole
from snrmjax.io.laboratory.libraries import library
from snrmjax.io.tables import write_steady_states
from snrmjax.measure.recordings.time_recording import TimeRecording

_MOST_ROWS = 2**20  # values of a record written as text, at most
_BLOCK = 2**20  # samples of all channels written at once
_CHUNK = 2**15  # numbers in a chunk of the file


def write_netcdf(path: FilePath, record: TimeRecording) -> None:
    """Write a record as netCDF 4 in SI units, block by block, so that it need not fit into memory.

    Variables: `sampling_rate_hz`, `start_time_s`, `channels` with their metadata, and `values`,
    one row a channel. `read_laboratory_file` restores all numbers bit for bit.
    """
    h5netcdf, h5py = library("h5netcdf", "writing netCDF"), library("h5py", "writing netCDF")
    width = len(record.channels)
    texts_by_name = {
        "channels": record.channel_names,
        "quantity": [channel.quantity for channel in record.channels],
        "unit": [channel.si_unit for channel in record.channels],
        "point": [channel.point for channel in record.channels],
        "direction": [channel.direction for channel in record.channels],
    }
    numbers = {"sampling_rate_hz": record.sampling_rate, "start_time_s": record.start_time}
    with written_whole(path) as new, h5netcdf.File(new, "w") as target:
        target.dimensions.update({"channel": width, "sample": record.n_samples})
        for name, number in numbers.items():
            target.create_variable(name, (), dtype="<f8")[...] = number
        for name, texts in texts_by_name.items():
            column = target.create_variable(name, ("channel",), dtype=h5py.string_dtype())
            column[...] = np.array(texts, dtype=object)
        chunk = (width, max(1, min(record.n_samples, _CHUNK // width)))
        values = target.create_variable("values", ("channel", "sample"), dtype="<f8", chunks=chunk)
        for block in record.blocks(max(1, _BLOCK // width)):
            values[:, block.start : block.start + block.values.shape[1]] = block.values


def write_import(folder: Path, imported: Imported, files: Sequence[str] = ()) -> list[str]:
    """Write `measured.csv` (or `record.csv`, `record_2.csv`, …, or `.nc` of long ones), `map.toml`.

    Records have the columns `time_s`, `force_n` or `drive_v`, and one motion a sensor
    (`tip.velocity_m_s`), in SI units. The map lists the imported `files`.
    Returns the names of the files.
    """
    written = []
    if imported.states is not None:
        write_steady_states(folder / "measured.csv", imported.states)
        written.append("measured.csv")
    for k, record in enumerate(imported.records):
        stem = "record" if k == 0 else f"record_{k + 1}"
        columns = record_columns(record, imported.used)
        if record.n_samples * len(columns) > _MOST_ROWS:
            write_netcdf(folder / f"{stem}.nc", record)
            written.append(f"{stem}.nc")
            continue
        values = np.vstack(
            [record.time(), record.values([channel.name for channel in columns.values()])]
        )
        lines = [",".join(("time_s", *columns))]
        lines += [",".join(map(repr, row)) for row in values.T.tolist()]
        write_atomically(folder / f"{stem}.csv", "\n".join(lines) + "\n")
        written.append(f"{stem}.csv")
    notes = tuple(dict.fromkeys(imported.notes))
    text = map_text(imported.used, imported.assumed, notes, files, imported.steps)
    write_atomically(folder / "map.toml", text)
    return [*written, "map.toml"]
