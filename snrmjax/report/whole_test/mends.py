"""Mends of findings as commands that can be pasted, with the files of the test and its options."""

import math
import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from snrmjax.doctor.check import given_levels
from snrmjax.doctor.findings import Checkup, Finding, Repair
from snrmjax.io.exchange.import_map import ImportMap, ResponseMap, read_import_map
from snrmjax.io.files import FilePath
from snrmjax.measure.states import SteadyStates
from snrmjax.methods.records.recorded_test import RecordedTest
from snrmjax.model.structures import Structure
from snrmjax.report.whole_test.folder_contents import TestFiles
from snrmjax.report.whole_test.laboratory_files import (
    MAP,
    files_behind,
    force_unit_of_repair,
    options_of_repair,
    unit_of_repair,
)

_QUOTED = re.compile(r"[^\"$`\\!]+")  # what double quotes keep, in every shell

Words = Sequence[FilePath]


class FilesOfTest(NamedTuple):
    """Where the states of a test come from, and how it goes on once they are mended.

    `tables` have our own columns; `sources` are the laboratory's files, which an import with the
    words `options` reads; one of both is empty where the other is not known.
    """

    mended: Path  # folder of what the commands write
    tables: tuple[Path, ...] = ()
    sources: tuple[Path, ...] = ()
    options: tuple[FilePath, ...] = ()
    first: ImportMap = ImportMap()  # what the options say
    told: ImportMap = ImportMap()  # the same with how a table of these files was restated since
    model: Path | None = None
    sensors: tuple[str, ...] = ()
    records: tuple[Path, ...] = ()
    folder: Path | None = None  # of `snrmjax test`; None: of `snrmjax check`
    out: Path | None = None  # of `snrmjax test`
    drive_point: str | None = None
    responses: tuple[Path, ...] = ()  # of which the linear modes are found
    of_levels: tuple[str, ...] = ()  # the file of each level, where it is known


def with_sources(where: FilesOfTest, map_file: Path) -> FilesOfTest:
    """The same with the laboratory's files that a map was written of, where they are still there.

    Also with the map itself where the sources are known already.
    """
    if where.sources and map_file.is_file():
        told = read_import_map(map_file)
        return where._replace(options=("--map", map_file), first=told, told=told)
    found = None if where.sources else files_behind(map_file)
    if found is None:
        return where
    return where._replace(
        sources=found.files,
        options=("--map", found.map_file),
        first=found.first,
        told=found.told,
    )


def _beside_its_inputs(mended: Path, inputs: Sequence[Path | None]) -> Path:
    """A folder for what is mended that holds nothing of what it is mended from: name, name_2, …"""
    taken = {one.resolve() for one in inputs if one is not None}
    names = (mended.name, *(f"{mended.name}_{k}" for k in range(2, len(taken) + 3)))
    return next(one for one in map(mended.with_name, names) if one.resolve() not in taken)


def checked_files(
    tables: Sequence[Path],
    model: Path | None,
    sensors: Sequence[str],
    records: Sequence[Path],
) -> FilesOfTest:
    """The files of `snrmjax check`: the map beside a table says what it was imported from."""
    mended = tables[0].parent / "mended"
    where = FilesOfTest(
        mended, tuple(tables), model=model, sensors=tuple(sensors), records=tuple(records)
    )
    return where if len(tables) > 1 else with_sources(where, tables[0].parent / MAP)


def tested_files(
    folder: Path, files: TestFiles, model: Path | None, drive_point: str | None, out: Path
) -> FilesOfTest:
    """The files of `snrmjax test`; those of the laboratory are read by the folder's map."""
    tables = tuple(one.table for one in files.states if one.table is not None)
    read = [one.file for one in files.states if one.table is None]
    read += [one.file.partition(": ")[0] for one in files.records]
    own = None if files.model is None else model or folder / files.model_file
    given = (folder, *(None if one is None else one.parent for one in (model, *tables)))
    where = FilesOfTest(
        _beside_its_inputs(out.with_name(f"{out.name}_mended"), given),
        () if read else tables,
        () if tables else tuple(folder / one for one in dict.fromkeys(read)),
        model=own,
        records=tuple(folder / one.file.partition(": ")[0] for one in files.records),
        folder=folder,
        out=out,
        drive_point=drive_point,
        responses=() if own else tuple(folder / one.file for one in files.responses),
    )
    return with_sources(where, folder / MAP) if where.tables or where.sources else where


def with_channels(
    where: FilesOfTest, files: TestFiles, tests: Sequence[RecordedTest], model: Structure
) -> FilesOfTest:
    """With the model's sensors, and the channels of a record that no map tells."""
    where = where._replace(sensors=model.modes.sensors)
    if where.options or not where.sources or not tests:
        return where
    channels = tests[0].channels
    known = {one.name: one for one in files.records[0].record.channels}
    words: list[FilePath] = ["--force", channels.force or channels.drive or ""]
    for motion in channels.motions:
        words += ["--response", f"{motion}:{known[motion].quantity}"]
    for sensor in channels.sensors:
        words += ["--sensor", sensor]
    responses = [ResponseMap(one, known[one].quantity, known[one].unit) for one in channels.motions]
    force = known[channels.force].unit if channels.force else ""
    told = ImportMap(tuple(responses), force=channels.force or "", force_unit=force)
    return where._replace(options=tuple(words), first=told, told=told)


def with_commands(checkup: Checkup, where: FilesOfTest) -> Checkup:
    """The findings with the commands that mend them, each a line of its own."""
    told = [_told(one, where) for one in checkup.findings]
    certain = [one for one in checkup.findings if is_certain(one)]
    line = _command(_at_once(certain), where, "") if len(certain) > 1 else ""
    if line:
        k = checkup.findings.index(certain[0])
        names = " and ".join(one.name for one in certain)
        told[k] = told[k]._replace(mend=f"{names} at once: `{line}`. Alone, {told[k].mend}")
    return Checkup(tuple(told), checkup.notes)


def is_certain(one: Finding) -> bool:
    """Whether a finding leaves no choice of what all numbers are, and an import can say it."""
    if one.severity != "error" or len(one.repairs) != 1:
        return False
    (repair,) = one.repairs
    said = repair.quantity or repair.conjugate or repair.response != 1 or repair.force != 1
    return bool(said) and not repair.fit_gain and not repair.levels


def _at_once(findings: Sequence[Finding]) -> Repair:
    """Several findings' repairs as one; each was found with the others' errors mended."""
    every = [one.repairs[0] for one in findings]
    return Repair(
        response=math.prod(one.response for one in every),
        force=math.prod(one.force for one in every),
        quantity="".join(one.quantity for one in every),
        conjugate=any(one.conjugate for one in every),
    )


def file_of_each_level(names: Sequence[str], parts: Sequence[SteadyStates]) -> tuple[str, ...]:
    """The file of each level, of files with levels of their own."""
    both = zip(names, parts, strict=True)
    return tuple(name for name, part in both for _ in given_levels(part))


def _told(one: Finding, where: FilesOfTest) -> Finding:
    if any(repair.levels for repair in one.repairs):
        return one._replace(mend=f"{one.mend.rstrip('.')}{_column(one, where)}.")
    sensor = next((name for name in where.sensors if one.where.endswith(f" at {name}")), "")
    lines = [line for each in one.repairs if (line := _command(each, where, sensor))]
    if not lines:
        return one
    return one._replace(mend=f"{one.mend.rstrip('.')}: `{'`, or `'.join(lines)}`.")


def _column(one: Finding, where: FilesOfTest) -> str:
    """Where the forces of a finding's levels lie: no import changes those of some levels alone."""
    levels = [k for repair in one.repairs for k in repair.levels]
    if max(levels) > len(where.of_levels):
        return ""
    files = " and ".join(dict.fromkeys(where.of_levels[k - 1] for k in levels))
    column = "force_n" if where.tables else where.first.force
    return f" (`{column}` in {files})" if column else f" in {files}"


def _command(repair: Repair, where: FilesOfTest, sensor: str) -> str:
    """What does a repair, steps joined by &&; empty where no command can."""
    steps: list[Words]
    if repair.read_record:
        steps = [["import", one] for one in where.records]
    elif repair.apart:
        steps = _identified_apart(where)
    elif repair.scale_model:
        steps = _scaled(where, sensor)
    else:
        steps = _imported(repair, where)
    return " && ".join(map(command_line, steps))


def command_line(words: Words) -> str:
    """A command of this program with its words quoted."""
    return " ".join(map(_word, ("snrmjax", *words)))


def _word(one: FilePath) -> str:
    text = str(one)
    return (
        f'"{text}"' if shlex.quote(text) != text and _QUOTED.fullmatch(text) else shlex.quote(text)
    )


def _identified_apart(where: FilesOfTest) -> list[Words]:
    if where.model is None or where.folder is not None or len(where.tables) < 2:
        return []
    return [
        ["identify", one, "--model", where.model, "--out", where.mended / f"{k + 1}_{one.stem}"]
        for k, one in enumerate(where.tables)
    ]


def _scaled(where: FilesOfTest, sensor: str) -> list[Words]:
    """The modes anew, of the states themselves, and the test again with them."""
    first, tables = _as_tables(where)
    if len(tables) != 1 or not sensor:
        return []
    model = where.mended / "model.toml"
    modes: Words = ["modes", tables[0], "--drive-point", sensor, "--out", model]
    again = where._replace(model=model, responses=())
    return [*first, modes, *_again(again, tables, where.folder)]


def _imported(repair: Repair, where: FilesOfTest) -> list[Words]:
    """The laboratory's files with another unit, or else our own table read as what it is."""
    out: list[FilePath] = ["--out", where.mended]
    table = where.mended / "measured.csv"
    named = options_of_repair(repair, where.first, where.told) if where.sources else []
    if named:
        options = _without_responses(where.options) if "--response" in named else where.options
        steps: list[Words] = [["import", *where.sources, *options, *named, *out]]
    else:
        first, tables = _as_tables(where)
        own = _options_of_own(repair)
        if not own or not tables:
            return []
        steps = [*first, ["import", *tables, *own, *out]]
    if repair.fit_gain and where.folder is None and where.model is not None:
        free = ["--fit", "auto", "--free", "force_gain,instrument_phase"]
        to = where.mended / "identify"
        return [*steps, ["identify", table, "--model", where.model, *free, "--out", to]]
    return [*steps, *_again(where, (table,), where.mended)]


def _as_tables(where: FilesOfTest) -> tuple[list[Words], tuple[Path, ...]]:
    """Our own tables of the test, and the import that makes them where there are none yet."""
    if where.tables or not where.sources:
        return [], where.tables
    read = where.mended.with_name(f"{where.mended.name}_before")
    step: Words = ["import", *where.sources, *where.options, "--out", read]
    return [step], (read / "measured.csv",)


def _again(where: FilesOfTest, tables: Sequence[Path], folder: Path | None) -> list[Words]:
    """The check or the whole test of what is mended."""
    model: list[FilePath] = [] if where.model is None else ["--model", where.model]
    if where.folder is None or where.out is None or folder is None:
        return [["check", *tables, *model, "--out", where.mended]]
    point = [] if where.drive_point is None else ["--drive-point", where.drive_point]
    steps: list[Words] = []
    if where.responses:
        # Not into the folder that is tested: the table of modes beside it is no measurement.
        found = where.mended.with_name(f"{where.mended.name}_modes") / "model.toml"
        model = ["--model", found]
        steps = [["modes", *where.responses, *point, "--out", found]]
    scaled = point if not model else []
    return [*steps, ["test", folder, *model, *scaled, "--out", where.out]]


def command_to_go_on(where: FilesOfTest, *, diagnose: bool) -> str:
    """The same test in spite of what the check found."""
    words: list[FilePath] = [] if where.folder is None else [where.folder]
    words += [] if where.model is None else ["--model", where.model]
    words += [] if where.drive_point is None else ["--drive-point", where.drive_point]
    words += [] if diagnose else ["--no-diagnose"]
    words += [] if where.out is None else ["--out", where.out]
    return command_line(("test", *words, "--go-on"))


def _without_responses(options: Words) -> Words:
    """Options with their values, less those that name a response."""
    pairs = zip(options[::2], options[1::2], strict=True)
    return [word for pair in pairs if pair[0] != "--response" for word in pair]


def _options_of_own(repair: Repair) -> list[str]:
    """Options that read our own table as what it is; none where it does not hold enough."""
    if repair.fit_gain:
        return ["--force-unit", repair.force_unit]
    unit, force_unit = unit_of_repair(repair), force_unit_of_repair(repair)
    words = ["--unit", unit] if unit else []
    words += ["--force-unit", force_unit] if force_unit else []
    return [*words, *(["--phase-sign", "lag"] if repair.conjugate else [])]
