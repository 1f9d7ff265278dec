"""Check: errors of import and of a test, and the import commands that correct them."""

import math
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from snrmjax.doctor.check import check_test
from snrmjax.doctor.findings import Checkup, Finding, ImportCorrection
from snrmjax.io.exchange.import_map import ImportMap, read_import_map
from snrmjax.io.files import FilePath
from snrmjax.io.laboratory.checkups import read_recordings
from snrmjax.io.models import read_model
from snrmjax.io.tables import read_steady_states
from snrmjax.numerics.facts import Fact
from snrmjax.pipelines.folder_contents import MAP, TestFiles

_SI = {"": "m/s", "acceleration": "m/s2", "displacement": "m"}
_PER_SECOND = {"displacement": "", "velocity": "/s"}


class FilesRead(NamedTuple):
    """The files of all states: our own tables, or laboratory files with an import map."""

    files: tuple[Path, ...]
    map_file: Path | None = None
    mapping: ImportMap = ImportMap()
    is_base: bool = False  # driven by a base motion instead of a force


def check_files(
    data: Sequence[FilePath],
    model: FilePath | None = None,
    records: Sequence[FilePath] = (),
) -> Checkup:
    """Look for errors in tables of steady states and in records of the same test.

    Arguments: without a `model` scales are not checked.
    Returns findings, each with the import command that corrects it, where there is one.
    Raises `ValueError` as the readers do.
    """
    structure = None if model is None else read_model(model)
    tables = [read_steady_states(path, structure) for path in data]
    recordings = [record for path in records for record in read_recordings(path)]
    is_base = any(table.base is not None for table in tables)
    read = FilesRead(tuple(map(Path, data)), is_base=is_base)
    return with_imports(check_test(tables, structure, recordings), read)


def files_of_test(folder: Path, files: TestFiles, map_file: Path | None = None) -> FilesRead | None:
    """The files of a folder's states; None without a map, or where both kinds are present.

    Arguments: `map_file` replaces the folder's map.toml.
    """
    tables = tuple(state.table for state in files.states if state.table is not None)
    records = [record.file.partition(": ")[0] for record in files.records]
    read = [*(state.file for state in files.states if state.table is None), *records]
    if tables and not read:
        is_base = any(state.states.base is not None for state in files.states)
        return FilesRead(tables, is_base=is_base)
    map_path = map_file or folder / MAP
    if tables or not map_path.is_file():
        return None
    return FilesRead(
        tuple(folder / name for name in dict.fromkeys(read)), map_path, read_import_map(map_path)
    )


def with_imports(checkup: Checkup, read: FilesRead | None) -> Checkup:
    """Findings with the import that corrects each; the first certain one with that for all."""
    if read is None:
        return checkup
    certain = [finding for finding in checkup.findings if is_certain(finding)]
    advised = []
    for finding in checkup.findings:
        lines = [line for correction in finding.corrections if (line := _command(correction, read))]
        advice = finding.advice
        if lines:
            advice = Fact("advice_by_import", advice=advice, commands=tuple(lines))
        if (
            len(certain) > 1
            and finding is certain[0]
            and (line := _command(_joined(certain), read))
        ):
            names = tuple(each.name for each in certain)
            advice = Fact("advice_at_once", names=names, command=line, alone=advice)
        advised.append(finding._replace(advice=advice))
    return Checkup(tuple(advised), checkup.notes)


def is_certain(one: Finding) -> bool:
    """Whether a finding has a single interpretation that import options can express."""
    if one.severity != "error" or len(one.corrections) != 1:
        return False
    (correction,) = one.corrections
    return bool(_options_of_own(correction)) and correction.force_unit != "V"


def _joined(findings: Sequence[Finding]) -> ImportCorrection:
    """Several findings' corrections as one; each assumes that the others are corrected."""
    every = [finding.corrections[0] for finding in findings]
    return ImportCorrection(
        response=math.prod(one.response for one in every),
        force=math.prod(one.force for one in every),
        unit="".join(one.unit for one in every),
        force_unit="".join(one.force_unit for one in every),
        quantity="".join(one.quantity for one in every),
        conjugate=any(one.conjugate for one in every),
    )


def _command(correction: ImportCorrection, read: FilesRead) -> str:
    """The import command for a correction; empty where no options express it."""
    own = read.map_file is None
    options = (
        _options_of_own(correction, is_base=read.is_base)
        if own
        else _options_of_laboratory(correction, read.mapping)
    )
    if not options:
        return ""
    by_map = () if own else ("--map", str(read.map_file))
    to = ("--out", str(read.files[0].parent / "mended"))
    words = ("snrmjax", "import", *map(str, read.files), *by_map, *options, *to)
    # Double quotes, which every shell knows.
    quoted = [word if shlex.quote(word) == word else f'"{word}"' for word in words]
    return f"`{' '.join(quoted)}`"


def _options_of_own(correction: ImportCorrection, *, is_base: bool = False) -> list[str]:
    """Options that correct our own table; none where the table lacks the information."""
    if correction.force_unit == "V":
        return ["--force-unit", "V"]
    words = []
    if correction.quantity or correction.response != 1:
        factor = f"{correction.response:.8g} " if correction.response != 1 else ""
        words += ["--unit", f"{factor}{_SI[correction.quantity]}"]
    if correction.force != 1:
        words += ["--force-unit", f"{correction.force:.8g} {'m/s^2' if is_base else 'N'}"]
    return [*words, *(["--phase-sign", "lag"] if correction.conjugate else [])]


def _options_of_laboratory(correction: ImportCorrection, mapping: ImportMap) -> list[str]:
    """Options for laboratory files with a map; none where new units alone do not correct it."""
    kinds = {response.quantity for response in mapping.responses}
    named = correction.response == 1 or correction.unit
    named = named and (correction.force == 1 or correction.force_unit)
    of_base = bool(mapping.base) and correction.force != 1
    if correction.quantity or not named or len(kinds) != 1 or of_base:
        return []
    if correction.conjugate and mapping.record:
        return []
    words = []
    if correction.unit:
        (kind,) = kinds
        if (correction.unit in ("g", "m/s2")) != (kind == "acceleration"):
            return []
        words += ["--unit", f"{correction.unit}{_PER_SECOND.get(kind, '')}"]
    words += ["--force-unit", correction.force_unit] if correction.force_unit else []
    words += ["--phase-unit", correction.phase_unit] if correction.phase_unit else []
    sign = "lead" if mapping.phase_sign == "lag" else "lag"
    return [*words, *(["--phase-sign", sign] if correction.conjugate else [])]
