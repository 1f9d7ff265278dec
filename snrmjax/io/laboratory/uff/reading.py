"""Universal files: functions become recordings, frequency responses and tables."""

from pathlib import Path

from snrmjax.io.laboratory.contents import LaboratoryFile
from snrmjax.io.laboratory.uff.axis_units import unit_system
from snrmjax.io.laboratory.uff.data_sets import read_data_sets, stated
from snrmjax.io.laboratory.uff.functions import read_functions


def read_uff(path: Path) -> LaboratoryFile:
    """A universal file. Raises `ValueError` as `read_laboratory_file` does."""
    sets = read_data_sets(path)
    units = unit_system(sets.of_type(164))
    measured = sets.of_type(58)
    functions = read_functions(measured, units, path.name)
    names = [stated(one.get("model_name", "")) for one in sets.of_type(151)]
    notes = [*sets.notes, *(units.notes if measured else ()), *functions.notes]
    notes += [f"model {name}." for name in names if name]
    return LaboratoryFile(
        *(path.name, "uff", functions.recordings, functions.responses, functions.tables),
        tuple(dict.fromkeys(notes)),
        functions.levels,
    )
