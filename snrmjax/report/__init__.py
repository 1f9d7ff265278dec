"""Figures, and reports in HTML that hold them.

Imported with the package, this registers how facts and results are shown; the modules that show
them are imported at first use.
"""

from typing import Any

from snrmjax.numerics.facts import show_by


class _Report:
    """Shows facts and results by the modules of this room."""

    def sentence(self, fact: Any) -> str:
        from snrmjax.report.sentences import sentence

        return sentence(fact)

    def screen(self, result: Any) -> str:
        from snrmjax.report.printed import screen_of

        return screen_of(result)

    def html(self, result: Any) -> str:
        from snrmjax.report.printed import html_of

        return html_of(result)

    def figure(self, result: Any, **settings: Any) -> Any:
        from snrmjax.report.plots import plot_result

        return plot_result(result, **settings)


show_by(_Report())
