"""Writing records, responses and steady states as MATLAB v5 and netCDF 4, and what imports give."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from snrmjax.io.exchange.import_map import map_text
from snrmjax.io.exchange.importing import Imported
from snrmjax.io.exchange.layouts import Field, record_fields, response_fields, state_fields
from snrmjax.io.exchange.record_import import record_columns
from snrmjax.io.files import FilePath, file_name, write_atomically, written_whole
from snrmjax.io.laboratory.libraries import MOST_HELD, library
from snrmjax.io.tables import write_steady_states
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.measure.states import SteadyStates

_MOST_ROWS = 2**20  # of a record that is written as text
_BLOCK = 2**20  # samples of all channels that are written at once
_PIECE = 2**15  # numbers of a piece of the file


def write_matlab(
    path: FilePath,
    *,
    recordings: Sequence[TimeRecording] = (),
    responses: Sequence[FrequencyResponses] = (),
    levels: Sequence[float] = (),
    states: SteadyStates | None = None,
) -> None:
    """Write a MATLAB v5 file in SI units: cells `records`, `responses`, and the struct `states`.

    A record has `sampling_rate_hz`, `start_time_s`, `channels` and `values`, one column a channel;
    responses have `frequency_hz`, `value_re`, `value_im` with sides response, reference,
    frequency; states have the columns of our CSV. `read_laboratory_file` gives all numbers back
    bit for bit.
    Arguments: `levels` has one number for each of `responses`, NaN where there is none.
    Raises `ValueError` for nothing to write, for records of more than 2^24 numbers (write them as
    netCDF) or fewer than 64 samples, and for states that no table could hold.
    """
    import scipy.io

    file = file_name(path)
    content: dict[str, Any] = {}
    if recordings:
        content["records"] = _cells([_matlab_record(one, file) for one in recordings])
    if responses:
        content["responses"] = _cells(
            [_matlab(response_fields(one, level)) for one, level in _pairs(responses, levels)]
        )
    if states is not None:
        content["states"] = _matlab(state_fields(states, file))
    if not content:
        raise ValueError(f"there is nothing to write to {file}.")
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, content, oned_as="column")
    write_atomically(path, buffer.getvalue())


def write_netcdf(
    path: FilePath,
    *,
    recordings: Sequence[TimeRecording] = (),
    responses: Sequence[FrequencyResponses] = (),
    levels: Sequence[float] = (),
    states: SteadyStates | None = None,
) -> None:
    """Write a netCDF 4 file in SI units, records block by block: they need not fit into memory.

    Groups `record_1`, …, `responses_1`, … and `states`, with the names of `write_matlab`; the
    samples of a record have one row a channel. `read_laboratory_file` gives all numbers back bit
    for bit.
    Arguments: `levels` has one number for each of `responses`, NaN where there is none.
    Raises `ValueError` for nothing to write, records of fewer than 64 samples, and states that no
    table could hold.
    """
    h5netcdf, file = library("h5netcdf", "writing netCDF"), file_name(path)
    parts = {f"record_{k + 1}": record_fields(one, file) for k, one in enumerate(recordings)} | {
        f"responses_{k + 1}": response_fields(one, level)
        for k, (one, level) in enumerate(_pairs(responses, levels))
    }
    if states is not None:
        parts["states"] = state_fields(states, file)
    if not parts:
        raise ValueError(f"there is nothing to write to {file}.")
    samples = {f"record_{k + 1}": one for k, one in enumerate(recordings)}
    with written_whole(path) as new, h5netcdf.File(new, "w") as target:
        for name, fields in parts.items():
            group = target.create_group(name)
            _put_fields(group, fields)
            if name in samples:
                _put_samples(group, samples[name])


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
            write_netcdf(folder / f"{stem}.nc", recordings=[record])
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


def _pairs(
    responses: Sequence[FrequencyResponses], levels: Sequence[float]
) -> list[tuple[FrequencyResponses, float]]:
    stated = list(levels) if levels else [np.nan] * len(responses)
    if len(stated) != len(responses):
        raise ValueError(
            f"`levels` must have one number for each of {len(responses)} responses, but has "
            f"{len(stated)}."
        )
    return list(zip(responses, stated, strict=True))


def _cells(structs: Sequence[dict[str, Any]]) -> np.ndarray:
    found = np.empty(len(structs), dtype=object)
    found[:] = list(structs)
    return found


def _matlab(fields: Mapping[str, Field]) -> dict[str, Any]:
    """A struct: vectors as columns, lists of texts as cells."""
    return {
        name: np.array(one.values, dtype=object) if isinstance(one.values, list) else one.values
        for name, one in fields.items()
    }


def _matlab_record(record: TimeRecording, file: str) -> dict[str, Any]:
    if record.n_samples * len(record.channels) > MOST_HELD:
        raise ValueError(
            f"a record in {file} must have at most {MOST_HELD} numbers, but has "
            f"{record.n_samples} of {len(record.channels)} channels: write it as netCDF."
        )
    return {**_matlab(record_fields(record, file)), "values": record.values().T}


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
