"""How the validation pages write numbers and tables."""

import re
from collections.abc import Iterable

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float | None, digits: int = 3) -> str:
    """A number as it is read: 0.0123, 1.2·10⁻⁶, and counts as they are."""
    if value is None:
        return "–"
    if isinstance(value, int):
        return str(value)
    text = f"{value:.{digits}g}"
    if "e+" in text:
        text = f"{float(text):.0f}"
    if "e" in text:
        mantissa, power = text.split("e")
        text = f"{mantissa}·10{str(int(power)).translate(_RAISED)}"
    return text.replace("-", "−")


def per_cent(fraction: float | None, digits: int = 2) -> str:
    """A share or a relative error in per cent."""
    return "–" if fraction is None else f"{number(100 * fraction, digits)}\N{NO-BREAK SPACE}%"


def table(head: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """A table; columns of numbers are on the right, those with words in a row on the left."""
    head, rows = list(head), [[str(c).replace("|", "\\|") for c in row] for row in rows]
    if not rows:
        raise ValueError(f"A table of validation is empty: {', '.join(head)}.")
    words = [
        any(re.match(r"[^\W\d]{3}", cell) for cell in column) for column in zip(*rows, strict=True)
    ]
    lines = [head, ["---" if is_text else "--:" for is_text in words], *rows]
    text = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return f'<div class="results" markdown>\n\n{text}\n\n</div>'
