"""What an import writes: measured.csv or records, and map.toml."""

from pathlib import Path

import numpy as np

from snrmjax.io.exchange.exports import write_netcdf
from snrmjax.io.exchange.import_map import map_text
from snrmjax.io.exchange.importing import Imported
from snrmjax.io.exchange.record_import import record_columns
from snrmjax.io.files import write_atomically
from snrmjax.io.tables import write_steady_states

_MOST_ROWS = 2**20  # of a record that is written as text


def write_import(folder: Path, found: Imported) -> list[str]:
    """Write `measured.csv` (or `record.csv`, `record_2.csv`, …, or `.nc` of long ones), `map.toml`.

    Records have the columns `time_s`, `force_n` or `drive_v`, and one motion a sensor
    (`tip.velocity_m_s`), in SI units.
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
    write_atomically(folder / "map.toml", map_text(found.used, found.assumed, notes))
    return [*written, "map.toml"]
