"""What mkdocstrings shows of the package's docstrings and of the fields of its records."""

import re
from typing import Any

import griffe

DOCTEST = re.compile(r"^>>> .*?(?=\n\s*\n|\Z)", re.MULTILINE | re.DOTALL)


class Docstrings(griffe.Extension):
    """Doctests are code, not Markdown's quotations; the comment beside a field is its docstring."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = DOCTEST.sub(r"```pycon\n\g<0>\n```", obj.docstring.value)

    def on_attribute_instance(self, *, attr: griffe.Attribute, **_: Any) -> None:
        if attr.docstring is None and attr.source:
            _, mark, comment = attr.source.rpartition("  # ")
            if mark and "\n" not in comment:
                attr.docstring = griffe.Docstring(comment, parent=attr)
