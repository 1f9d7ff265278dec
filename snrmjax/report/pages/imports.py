"""What an import gave: measured.csv or records, map.toml, and its lines."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from snrmjax.io.exchange.exports import write_import
from snrmjax.io.exchange.importing import Imported
from snrmjax.io.units import HERTZ
from snrmjax.report.sentences import number_of


def write(folder: Path, found: Imported, *, files: Sequence[str] = ()) -> list[str]:
    """Write measured.csv (or record.csv) and map.toml, which names the `files`.

    Returns the names of what was written.
    """
    return write_import(folder, found, files)


def headline(found: Imported) -> list[str]:
    """What was assumed, and how many states."""
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
                "a base moves the structure, and velocities are as recorded: `--base absolute` of "
                "modes and test (or relative), or [base] in a model, says whether the base's "
                "motion is in them"
            )
    return lines
