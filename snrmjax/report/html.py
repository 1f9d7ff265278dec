"""Reports: one HTML file that holds its figures, to be read on a screen, a phone or on paper."""

import base64
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from snrmjax.io.files import FilePath, write_atomically
from snrmjax.report.style import png_bytes

Rows = Sequence[tuple[str, str]]

_REM_PER_INCH = 8.0  # of figures on the page: their letters are then as large as the text's


class ReportFigure(NamedTuple):
    """A figure with the words that explain how to read it."""

    figure: Figure
    caption: str
    png: bytes | None = None  # the file to show, where it is drawn already


class ReportTable(NamedTuple):
    """A table of texts."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""


class Section(NamedTuple):
    """A part of a report: paragraphs, then figures, then tables."""

    heading: str
    text: Sequence[str] = ()
    figures: Sequence[ReportFigure] = ()
    tables: Sequence[ReportTable] = ()


class Report(NamedTuple):
    """What a report tells, in the order in which it is read."""

    title: str
    done: Rows = ()  # what was done: name and value
    summary: Rows = ()  # the headline numbers
    notes: Sequence[str] = ()
    sections: Sequence[Section] = ()


def write_report(path: FilePath, report: Report) -> None:
    """Write a report as one HTML file that needs nothing else, whole or not at all.

    Raises `ValueError` when `path` cannot be written.
    """
    write_atomically(path, report_html(report))


def report_html(report: Report) -> str:
    """A report as the text of one HTML file: figures inside, all words escaped."""
    environment = Environment(
        loader=PackageLoader("snrmjax.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    sections = [
        {**section._asdict(), "figures": [_embedded(one) for one in section.figures]}
        for section in report.sections
    ]
    template = environment.get_template("report.html.j2")
    notes = [_sentence(note) for note in report.notes]
    return template.render(report=report._replace(notes=notes), sections=sections)


def _embedded(one: ReportFigure) -> dict[str, str]:
    drawn = one.png or png_bytes(one.figure)
    png = base64.b64encode(drawn).decode("ascii")
    width = f"{_REM_PER_INCH * one.figure.get_figwidth():g}"
    return {"png": png, "width": width, "alt": one.caption.split(". ")[0], "caption": one.caption}


def with_error(value: float, spread: float) -> str:
    """A value with its error, to two digits of the error."""
    if not spread >= 1e-6 or not np.isfinite(spread):
        return f"{value:.4g}"
    digits = max(0, int(1 - np.floor(np.log10(spread))))
    return f"{value:.{digits}f} ± {spread:.{digits}f}"


def minus(text: str) -> str:
    """The text with true minus signs."""
    return text.replace("-", "−")


def _sentence(text: str) -> str:
    """A note as a sentence: a capital first, a full stop last."""
    text = text.strip()
    return text[:1].upper() + text[1:] + ("" if text.endswith((".", "!", "?")) else ".")
