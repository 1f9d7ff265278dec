"""Reports: one self-contained HTML file with its figures, for screen, phone or paper."""

import base64
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from snrmjax import __version__
from snrmjax.io.files import FilePath, write_atomically
from snrmjax.report.style import COLUMN, PrintedFigure, printed

Rows = Sequence[tuple[str, str]]

PROGRAM = ("program", f"snrmjax {__version__}")  # among the inputs of a report

_REM_PER_INCH = 8.0  # of figures on the page: their letters are then as large as the text's


class LiveFigures(NamedTuple):
    """Interactive figures, as parts of a page."""

    program: str  # what the page's head needs, the same for every page
    body: str  # scripts and containers of the figures


class ReportFigure(NamedTuple):
    """A figure, rendered or not, with its caption."""

    figure: Figure | PrintedFigure
    caption: str


class ReportTable(NamedTuple):
    """A table of texts; with a line `folded` it shows that line, and its rows when opened."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    folded: str = ""


class Section(NamedTuple):
    """A section of a report: paragraphs, then live figures, then printed ones, then tables."""

    heading: str
    text: Sequence[str] = ()
    figures: Sequence[ReportFigure] = ()
    tables: Sequence[ReportTable] = ()
    live: LiveFigures | None = None


class Report(NamedTuple):
    """Content of a report: title, inputs and result fit the first screen, the rest follows."""

    title: str
    done: Rows = ()  # data, model and settings: name and value, in one line under the title
    summary: Rows = ()  # the headline numbers
    notes: Sequence[str] = ()
    sections: Sequence[Section] = ()
    result: str = ""  # the result in one plain sentence


def write_report(path: FilePath, report: Report) -> None:
    """Write a report as one self-contained HTML file, complete or not at all.

    Raises `ValueError` when `path` cannot be written.
    """
    write_atomically(path, report_html(report))


def report_html(report: Report) -> str:
    """A report as the text of one HTML file: figures embedded, all text escaped."""
    environment = Environment(
        loader=PackageLoader("snrmjax.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    sections = [
        {**section._asdict(), "figures": [_embedded(figure) for figure in section.figures]}
        for section in report.sections
    ]
    template = environment.get_template("report.html.j2")
    notes = [_sentence(note) for note in report.notes]
    live = [section.live for section in report.sections if section.live is not None]
    program = live[0].program if live else ""
    return template.render(report=report._replace(notes=notes), sections=sections, program=program)


def _embedded(one: ReportFigure) -> dict[str, str | bool]:
    png, width = one.figure if isinstance(one.figure, PrintedFigure) else printed(one.figure)
    return {
        "png": base64.b64encode(png).decode("ascii"),
        "width": f"{_REM_PER_INCH * width:g}",
        "wide": width > COLUMN,
        "alt": one.caption.split(". ")[0],
        "caption": one.caption,
    }


# A word with an ending, or anything with one before a colon: names of files may have spaces.
_FILE_FIRST = re.compile(r"\S+\.[A-Za-z]\w{0,9}[:,]?\s|[^:]+\.[A-Za-z]\w{0,9}:")
_PLAIN = (-4, 5)  # powers of ten between which numbers are written without one
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def with_error(value: float, spread: float) -> str:
    """A value with its error, to two digits of the error; the value alone where there is none.

    >>> with_error(79.1234, 0.0841), with_error(2.4731e9, 6.2e7)
    ('79.123 ± 0.084', '(2.473 ± 0.062) × 10⁹')
    """
    if not np.isfinite(spread) or not spread > 1e-7 * abs(value):
        return number(value)
    power = int(np.floor(np.log10(max(abs(value), spread))))
    ten = 0 if _PLAIN[0] <= power <= _PLAIN[1] else power
    value, spread = value / 10.0**ten, spread / 10.0**ten
    digits = max(0, int(1 - np.floor(np.log10(spread))))
    text = minus(f"{value:.{digits}f} ± {spread:.{digits}f}")
    return f"({text}) × {ten_to(ten)}" if ten else text


def number(value: float, digits: int = 4) -> str:
    """A number to some digits, with a power of ten where it is very large or very small.

    >>> number(0.25), number(-1.2345e-9, 2)
    ('0.25', '−1.2 × 10⁻⁹')
    """
    if not value or not np.isfinite(value):
        return f"{value:.{digits}g}"
    power = int(np.floor(np.log10(abs(value))))
    if _PLAIN[0] <= power <= _PLAIN[1]:
        return minus(f"{float(f'{value:.{digits}g}'):.{max(digits, power + 1)}g}")
    return f"{minus(f'{value / 10.0**power:.{digits}g}')} × {ten_to(power)}"


def ten_to(power: int) -> str:
    """A power of ten as text."""
    return "10" + str(power).translate(_SUPERSCRIPT)


def minus(text: str) -> str:
    """The text with true minus signs."""
    return text.replace("-", "−")


def _sentence(text: object) -> str:
    """A note as a sentence: a capital first but for a file's name, a full stop last.

    >>> _sentence("two rows are incomplete"), _sentence("run1.mat: two rows are incomplete.")
    ('Two rows are incomplete.', 'run1.mat: two rows are incomplete.')
    """
    text = str(text).strip()
    first = text[:1] if _FILE_FIRST.match(text) else text[:1].upper()
    return first + text[1:] + ("" if text.endswith((".", "!", "?")) else ".")
