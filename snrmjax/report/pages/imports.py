"""Results of an import: measured.csv or records, map.toml, and the printed lines."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from snrmjax.io.exchange.exports import write_import
from snrmjax.io.exchange.importing import Imported
from snrmjax.numerics.units import HERTZ
from snrmjax.report.sentences import number_of


def write(folder: Path, found: Imported, *, files: Sequence[str] = ()) -> list[str]:
    """Write measured.csv (or record.csv) and map.toml, which names the `files`.

    Returns the names of what was written.
    """
    return write_import(folder, found, files)


def headline(found: Imported) -> list[str]:
    """Assumptions, and the number of states."""
    lines = [f"assumed {key}: {why}" for key, why in found.assumed.items()]
    if found.states is not None:
        data = found.states
        hertz = np.asarray(data.frequency) / HERTZ
        levels = number_of(len(np.unique(np.asarray(data.level))), "level")
        lines.append(
            f"{data.n_states} steady states on {levels}, {hertz.min():.5g} to "
            f"{hertz.max():.5g} Hz, of {', '.join(data.sensors)}"
        )
        if data.base is not None:
            lines.append(
                "the base moves, and velocities are as recorded: state whether they include the "
                "base motion by `--base absolute` (or relative) of modes and test, or by [base] in "
                "a model"
            )
    return lines
