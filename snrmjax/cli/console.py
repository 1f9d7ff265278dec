"""Messages of the commands on standard error, and their exit codes."""

import logging
import os
import signal
import socket
import threading
import time
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console

from snrmjax.report.writing import discard_unfinished, page_of

SITE_PAGES = "notebooks/site/pages"  # of the repository; the site has no public address yet
_FORMATS, _IMPORT = ("File formats", "formats"), ("Import a laboratory's files", "how-to/import")
_ELEMENT = ("Place an element at a point", "how-to/element")
_OWN = ("Add an effect of your own", "how-to/own-effect")
_REDUCED = ("Make a reduced model", "how-to/reduced-model")
# Helpful page (title and path) by the part of the package that refused an input.
PAGES = {
    "io.files": None,  # no such file, or no text
    "io.tables.check_driven_alike": ("Use a shaker table", "how-to/shaker-table"),
    "io.structure_matrices.moving_base": ("Use a shaker table", "how-to/shaker-table"),
    "model.moving_base": ("Use a shaker table", "how-to/shaker-table"),
    "io.tables": _FORMATS,
    "io.models": _FORMATS,
    "io.programs.effect_files": _OWN,
    "io.exchange": _IMPORT,
    "io.laboratory": _IMPORT,
    "pipelines.folder_contents": _IMPORT,
    "io.structure_matrices": _ELEMENT,
    "model.builders": _ELEMENT,
    "identify.checks.instruments": ("Work with an uncertain force", "how-to/uncertain-force"),
    "diagnose": ("Find the missing physics", "how-to/diagnose"),
    "condense": _REDUCED,
    "io.reduction": _REDUCED,
    "io.calculix": _REDUCED,
    "study": ("Run a study of 1 000 members", "how-to/study"),
}

INTERRUPTED = 130  # the exit code of a process that ended on Ctrl-C, as shells have it
_PATIENCE = 0.5  # s after Ctrl-C for a command to end by itself
_STILL = 30.0  # s after which the same stage is reported again
_QUIET = 5.0  # s before the first line, and at least between two lines

console = Console(stderr=True, highlight=False, soft_wrap=True)


def print_line(message: str) -> None:
    """Print a line on progress or a result."""
    console.print(message, markup=False)


def warn(message: object) -> None:
    """Print a note on the results."""
    console.print(f"note: {message}", style="yellow", markup=False)


def refuse(message: str) -> None:
    """Print the error of the input."""
    console.print(f"error: {message}", style="red", markup=False)


def read_more(error: Exception) -> str | None:
    """The page of the site that explains why an input was refused, if there is one.

    The innermost call with an entry in `PAGES` decides, by its longest entry.
    """
    for frame, _ in reversed(list(traceback.walk_tb(error.__traceback__))):
        package, _, module = frame.f_globals.get("__name__", "").partition(".")
        name = f"{module}.{frame.f_code.co_qualname}."
        known = [part for part in PAGES if package == "snrmjax" and name.startswith(f"{part}.")]
        if known:
            page = PAGES[max(known, key=len)]
            return page and f'read more: the page "{page[0]}" ({SITE_PAGES}/{page[1]}.md)'
    return None


def print_result(result: Any, notes: Iterable[object] | None = None) -> None:
    """Print the notes of a pipeline's result, and its headline."""
    for note in result.notes if notes is None else notes:
        warn(note)
    for line in page_of(result).headline(result):
        print_line(line)


def written(out: Path, page: str = "report.html") -> None:
    """Print the path of the results."""
    print_line(f"written to {out}: open {out / page}" if page else f"written to {out}")


class _Latest(logging.Handler):
    """The last message that the package logged."""

    message = ""

    def emit(self, record: logging.LogRecord) -> None:
        self.message = record.getMessage()


@contextmanager
def supervised() -> Iterator[None]:
    """Report the stage of a command every few seconds, and end it soon after Ctrl-C.

    Python raises `KeyboardInterrupt` only after the main thread returns from a compiled program,
    which may take minutes, and then waits for the other threads' programs. So a separate thread
    receives the signal and, if the command has not ended by itself, removes its unfinished output
    and ends the process.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # signals reach only the main thread
        return
    logger, latest = logging.getLogger("snrmjax"), _Latest(logging.INFO)
    logger.addHandler(latest)
    logger.setLevel(logging.INFO)
    logger.propagate = False  # JAX's handlers would print the stages again
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    previous = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=_supervise, args=(reader, latest), daemon=True).start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(previous)
        writer.close()
        logger.removeHandler(latest)


def _supervise(reader: socket.socket, latest: _Latest) -> None:
    reader.settimeout(_QUIET)
    began = last = time.monotonic()
    reported, received = "", b"\0"
    with reader:
        while received and received[0] != signal.SIGINT:
            try:
                received = reader.recv(1)
            except TimeoutError:
                now = time.monotonic()
                if latest.message != reported or now - last > _STILL:
                    last, reported = now, latest.message
                    print_line(f"{now - began:.0f} s: {reported or 'at work'} …")
    if not received:  # the command has ended
        return
    time.sleep(_PATIENCE)
    try:
        discard_unfinished()
        console.show_cursor(True)
        print_line("stopped.")
    finally:
        os._exit(INTERRUPTED)
