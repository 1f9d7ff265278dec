"""Interactive figures: their embedding in a page, and their common panels.

Bokeh (BSD-3) draws them. Its script, 1.3 MB, is embedded in the page: nothing is loaded.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from snrmjax.numerics.rules import InputError
from snrmjax.report.html import LiveFigures
from snrmjax.report.style import SERIES

if TYPE_CHECKING:
    from bokeh.models import ColumnDataSource, Legend, UIElement
    from bokeh.plotting import figure

_TOOLS = "pan,box_zoom,wheel_zoom,tap,box_select,reset,save"
_TEXT = "11px"
NEEDED = "interactive figures need Bokeh: pip install 'snrmjax[lab]'"


def live_figures(layout: "UIElement") -> LiveFigures:
    """A Bokeh layout as parts of a self-contained page."""
    from bokeh.embed import components
    from bokeh.resources import Resources

    script, container = components(layout)
    return LiveFigures(Resources(mode="inline", components=["bokeh"]).render(), container + script)


def has_bokeh() -> bool:
    """Whether Bokeh is installed."""
    from importlib.util import find_spec

    return find_spec("bokeh") is not None


def require_bokeh() -> None:
    """Raises `ValueError` with what to install where Bokeh is missing."""
    if not has_bokeh():
        raise InputError(f"{NEEDED}.")


def panel(title: str, x: str, y: str, *, x_range: Any = None, height: int = 240) -> "figure":
    """One panel: title and axes named, zoom and selection on, stretched to the page's width."""
    from bokeh.plotting import figure

    ranged = {} if x_range is None else {"x_range": x_range}
    made = figure(
        title=title,
        x_axis_label=x,
        y_axis_label=y,
        height=height,
        sizing_mode="stretch_width",
        tools=_TOOLS,
        active_drag="box_zoom",
        active_tap="tap",
        output_backend="canvas",
        **ranged,
    )
    made.toolbar.logo = None
    made.toolbar.autohide = True
    made.xgrid.grid_line_color = made.ygrid.grid_line_color = "#e5e5e5"
    for axis in (*made.xaxis, *made.yaxis):
        axis.axis_label_text_font_style = "normal"
        axis.axis_label_text_font_size = axis.major_label_text_font_size = _TEXT
        axis.minor_tick_line_color = None
    return made


def level_colours(levels: Sequence[int]) -> dict[int, str]:
    """A colour for every level, repeated where there are more levels than colours."""
    return {level: SERIES[k % len(SERIES)] for k, level in enumerate(levels)}


def points_by_level(
    panels: Sequence[tuple["figure", str, str]],
    source: "ColumnDataSource",
    level: np.ndarray,
    hover: Sequence[tuple[str, str]],
) -> None:
    """Draw the same states in several panels, in the colour of their level.

    A state that is tapped or boxed in one panel is marked in all; a level that is clicked in the
    legend of the first disappears from all.

    Arguments: `panels` with the columns of `source` that are x and y of each; `level` of each row;
    `hover` pairs of a word and the column it shows, as Bokeh writes them.
    """
    from bokeh.models import CDSView, HoverTool, IndexFilter

    names = np.unique(level)
    colours = level_colours([int(name) for name in names])
    drawn: list[list[Any]] = [[] for _ in panels]
    for name in names:
        view = CDSView(filter=IndexFilter(np.flatnonzero(level == name).tolist()))
        first = None
        for k, (figure, x, y) in enumerate(panels):
            label = {"legend_label": f"level {name}"} if k == 0 else {}
            renderer = figure.scatter(
                x,
                y,
                source=source,
                view=view,
                size=6,
                color=colours[int(name)],
                line_color="white",
                line_width=0.4,
                nonselection_fill_alpha=0.25,
                nonselection_line_alpha=0.25,
                selection_line_color="black",
                selection_line_width=1.5,
                **label,
            )
            drawn[k].append(renderer)
            if first is None:
                first = renderer
            else:
                first.js_link("visible", renderer, "visible")
    for (figure, _, _), renderers in zip(panels, drawn, strict=True):
        figure.add_tools(HoverTool(tooltips=list(hover), renderers=renderers))
    legend_at_right(panels[0][0]).click_policy = "hide"


def legend_at_right(figure: "figure") -> "Legend":
    """Put the legend to the right of its panel; returns it."""
    legend = figure.legend[0]
    legend.label_text_font_size = _TEXT
    legend.spacing, legend.padding = 0, 4
    figure.add_layout(legend, "right")
    return legend
