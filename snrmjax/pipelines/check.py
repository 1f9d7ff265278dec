"""Check: errors of import and of a test, and the imports that mend them."""

from collections.abc import Sequence
from pathlib import Path

from snrmjax.doctor.check import check_test
from snrmjax.doctor.findings import Checkup
from snrmjax.io.laboratory.checkups import read_recordings
from snrmjax.io.models import read_model
from snrmjax.io.tables import read_steady_states
from snrmjax.pipelines.corrections import FilesRead, with_imports


def check_files(
    data: Sequence[Path], model: Path | None = None, records: Sequence[Path] = ()
) -> Checkup:
    """Look for errors in tables of steady states and in records of the same test.

    Arguments: without a `model` scales are not looked at.
    Returns findings, each with the import that mends it where one does.
    Raises `ValueError` as the readers do.
    """
    structure = None if model is None else read_model(model)
    tables = [read_steady_states(path, structure) for path in data]
    recordings = [record for path in records for record in read_recordings(path)]
    return with_imports(check_test(tables, structure, recordings), FilesRead(tuple(data)))
