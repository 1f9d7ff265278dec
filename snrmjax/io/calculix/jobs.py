"""Running CalculiX: one job in its own folder, on one thread, and its printed output."""

import hashlib
import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from snrmjax.io.files import FilePath, write_atomically
from snrmjax.numerics.rules import InputError

_HEADER = re.compile(
    r"^ (displacements|forces) \(.*\) for set \S+ and time\s+(\S+)\s*$", re.MULTILINE
)
_ENERGY = re.compile(r"total internal energy .* and time\s+(\S+)\s*$", re.MULTILINE)
_EIGENVALUE = re.compile(r"^\s*(\d+)\s+(\S+)\s+(\S+)\s+(\S+)\s+(\S+)\s*$")
_E_DROPPED = re.compile(r"(\d)([+-]\d{3})$")  # Fortran drops the E of three-digit exponents
_ERROR = re.compile(r"\*ERROR[^\n]*(?:\n(?!\s*\n|\s*\*)[^\n]*)*")
INSTALL = (
    "CalculiX is needed and its program {program} is not on the search path: install it (Debian, "
    "Ubuntu: apt install calculix-ccx; conda-forge: calculix) or name its program."
)
# Environment variables that set CalculiX's number of threads; a job here has one.
_THREADS = (
    *("OMP_NUM_THREADS", "CCX_NPROC_STIFFNESS", "CCX_NPROC_EQUATION_SOLVER", "CCX_NPROC_RESULTS"),
    *("OPENBLAS_NUM_THREADS", "CCX_NPROC_CFD", "CCX_NPROC_VIEWFACTOR"),
)
_BEGUN = "increment 1 attempt 1"  # in the log, once the deck is read and a static step begins


class PrintedTable(NamedTuple):
    """One table of *NODE PRINT: displacements (m) or forces (N) at a time."""

    quantity: str
    time: float
    values: Float[np.ndarray, "node 3"]


def printed_tables(text: str, nodes: Int[np.ndarray, " node"]) -> Iterator[PrintedTable]:
    """Tables of displacements and forces in a `.dat` file, rows in the order of `nodes`.

    Raises `ValueError` where a table does not have each node once or a number is malformed.
    """
    heads = list(_HEADER.finditer(text))
    for head in heads:
        rows = []
        for line in text[head.end() :].lstrip("\n").splitlines():
            parts = line.split()
            if len(parts) != 4 or not parts[0].isdigit():
                break
            rows.append([_E_DROPPED.sub(r"\1e\2", part) for part in parts])
        table = np.array(rows, dtype=float).reshape(-1, 4)
        order = np.argsort(table[:, 0])
        if not np.array_equal(table[order, 0], nodes):
            raise InputError(
                f"a table of {head[1]} has {len(table)} rows for {len(nodes)} nodes: "
                "it is incomplete."
            )
        yield PrintedTable(head[1], float(head[2]), table[order, 1:])


def eigenvalues(text: str) -> Float[np.ndarray, " mode"]:
    """Eigenvalues ω² (rad²/s²) of a `.dat` file's first table, negative ones included."""
    begin = text.find("E I G E N V A L U E   O U T P U T")
    if begin < 0:
        return np.zeros(0)
    squares: list[float] = []
    for line in text[begin:].splitlines()[1:]:
        row = _EIGENVALUE.match(line)
        if row and int(row[1]) == len(squares) + 1:
            squares.append(float(row[2]))
        elif squares and line.strip():
            break
    return np.array(squares)


def last_energy(text: str) -> float | None:
    """The total internal energy (J) at the last time of a `.dat` file, or None."""
    heads = list(_ENERGY.finditer(text))
    if not heads:
        return None
    parts = text[heads[-1].end() :].split()
    return float(parts[0]) if parts else None


def first_error(log: str) -> str:
    """The first *ERROR of CalculiX's log on one line, or an empty text."""
    match = _ERROR.search(log)
    return " ".join(match[0].split()) if match else ""


class JobOutcome(NamedTuple):
    """Outcome of a job."""

    started: bool  # a static step began, or the program printed results
    finished: bool  # the program ended by itself, with or without an error
    dat: str  # the results it printed
    error: str  # its first error, or how it ended
    seconds: float


class Calculix(NamedTuple):
    """The program and the time limit of a job."""

    program: str
    time_limit: float  # s


def find_calculix(program: str, time_limit: float) -> Calculix:
    """The program on this machine. Raises `ValueError` where it is missing."""
    path = shutil.which(program)
    if path is None:
        raise InputError(INSTALL.format(program=program))
    if not time_limit > 0:
        raise InputError(f"`time_limit` must be positive seconds, but is {time_limit}.")
    return Calculix(path, float(time_limit))


def model_file(text: str, folder: FilePath) -> Path:
    """Write a deck's model, for jobs to include, into a folder (created if missing).

    Returns its path; the name contains a digest of the text, so that two models never share a file.
    """
    target = Path(folder)
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"the folder {target} cannot be made: {error.strerror}.") from error
    path = target / f"model-{deck_digest(text)}.inp"
    if not path.is_file() or path.read_text(encoding="utf-8") != text:
        write_atomically(path, text)
    return path


def deck_digest(text: str) -> str:
    """Identifier of a deck: sixteen hexadecimal digits of its SHA-256."""
    return hashlib.sha256(text.encode("utf-8")).hexdigest()[:16]


def run_job(calculix: Calculix, model: Path, step: str) -> JobOutcome:
    """Run one job: a model file, included, and the steps below it.

    The job's files are in a temporary folder next to the model, removed afterwards.
    """
    with tempfile.TemporaryDirectory(dir=model.parent, prefix="job-") as folder:
        Path(folder, "job.inp").write_text(
            f"*INCLUDE, INPUT=../{model.name}\n{step}", encoding="utf-8"
        )
        begin = time.perf_counter()
        with open(Path(folder, "job.log"), "wb") as log:
            process = subprocess.Popen(
                [calculix.program, "job"],
                cwd=folder,
                env={**os.environ, **dict.fromkeys(_THREADS, "1")},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
            )
            try:
                process.wait(calculix.time_limit)
                stopped = ""
            except subprocess.TimeoutExpired:
                stopped = f"stopped after the time limit of {calculix.time_limit:g} s"
            finally:
                if process.poll() is None:  # the time limit, or the user's Ctrl-C
                    process.kill()
                    process.wait()
        seconds = time.perf_counter() - begin
        dat = Path(folder, "job.dat")
        printed = dat.read_text(encoding="utf-8", errors="replace") if dat.is_file() else ""
        log_text = Path(folder, "job.log").read_text(encoding="utf-8", errors="replace")
    if not stopped and process.returncode < 0:
        stopped = f"killed by {signal.Signals(-process.returncode).name}"
    error = stopped or first_error(log_text)
    if not error and process.returncode:
        error = f"it ended with code {process.returncode}"
    return JobOutcome(bool(printed) or _BEGUN in log_text, not stopped, printed, error, seconds)
