"""The figures of the validation pages, each drawn for a light and for a dark page."""

import io
from collections.abc import Callable
from itertools import groupby
from typing import Any

import matplotlib as mpl
import numpy as np
import validation_results as of
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from snrmjax.report.style import SERIES

_, _, GREEN, PINK, AMBER, SKY = SERIES
ORANGE = {"light": SERIES[0], "dark": "#f0803c"}
BLUE = {"light": SERIES[1], "dark": "#4ba3e3"}
INK = {"light": "#1a1a1a", "dark": "#e4e4e4"}
FAINT = {"light": "#9a9a9a", "dark": "#8a8a8a"}
GRID = {"light": "#e3e3e3", "dark": "#3d3f4a"}
WIDE = 7.4  # inches


def drawn(draw: Callable[["Pen"], Figure], mode: str) -> str:
    """A figure as SVG, the same to the byte at every run."""
    ink, grid = INK[mode], GRID[mode]
    settings = {
        **{"svg.hashsalt": "validation", "font.size": 10, "axes.grid": True, "grid.color": grid},
        **dict.fromkeys(("text.color", "axes.labelcolor", "xtick.color", "ytick.color"), ink),
        **{"axes.edgecolor": ink, "axes.spines.top": False, "axes.spines.right": False},
        **{"axes.titlesize": 10.5, "axes.titlelocation": "left", "legend.frameon": False},
        **{"figure.facecolor": "none", "axes.facecolor": "none", "axes.axisbelow": True},
        **{"figure.constrained_layout.use": True, "lines.linewidth": 1.3, "grid.linewidth": 0.7},
    }
    with mpl.rc_context(settings):
        figure = draw(Pen(ink, FAINT[mode], ORANGE[mode], BLUE[mode]))
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()


class Pen:
    """The colours that differ between a light and a dark page."""

    def __init__(self, ink: str, faint: str, orange: str, blue: str) -> None:
        self.ink, self.faint, self.orange, self.blue = ink, faint, orange, blue


def _panels(rows: int, columns: int, height: float, **kwargs: Any) -> tuple[Figure, np.ndarray]:
    figure = Figure(figsize=(WIDE, height))
    return figure, figure.subplots(rows, columns, squeeze=False, **kwargs)


def _name(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set(title=title, xlabel=x, ylabel=y)


def _legend(figure: Figure, axes: Axes, columns: int) -> None:
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=columns)


def _curve(beam: str, name: str, **wanted: Any) -> dict[str, np.ndarray]:
    row = of.chosen("paper_figures", beam=beam, curve=name, **wanted)[0]
    return {k: np.asarray(v) for k, v in row.items()}


def identified(beam: str) -> Callable[[Pen], Figure]:
    """Figures 7 and 10: states, points on the backbone and their damping."""

    def draw(pen: Pen) -> Figure:
        figure, ((a, b, c),) = _panels(1, 3, 3.5)
        states, points = _curve(beam, "states"), _curve(beam, "points")
        mode = _curve(beam, "mode")
        dot = {"color": pen.blue, "linestyle": "none", "marker": "o", "markersize": 3}
        star = {"color": pen.orange, "linestyle": "none", "marker": "*", "markersize": 5}
        a.plot(mode["frequency_hz"], mode["velocity"], "--", color=pen.ink, label="true mode")
        a.plot(states["frequency_hz"], states["velocity"], **dot, label="recorded state")
        a.plot(points["natural_frequency_hz"], points["velocity"], **star, label="identified")
        b.axhline(-90, color=pen.ink, linestyle="--")
        b.plot(states["frequency_hz"], states["phase_deg"] - 90, **dot)
        linear = of.chosen("paper_figures", beam=beam, damping="fundamental")[0]["linear"]
        order = np.argsort(points["velocity"] / points["natural_frequency_hz"])
        natural = points["natural_frequency_hz"][order]
        constant = linear / (4 * np.pi * natural)  # ζ̃ of constant damping
        c.plot(points["velocity"][order], 100 * constant, "--", color=pen.ink)
        c.plot(points["velocity"], 100 * points["damping_ratio"], **star)
        _name(a, "(a)", "Frequency (Hz)", "Velocity amplitude (m/s)")
        _name(b, "(b)", "Frequency (Hz)", "Phase, as in the paper (°)")
        b.set_ylim(-185, 5)
        b.set_yticks([-180, -135, -90, -45, 0])
        _name(c, "(c)", "Velocity amplitude (m/s)", "Damping ratio (%)")
        _legend(figure, a, 3)
        return figure

    return draw


def responses(beam: str) -> Callable[[Pen], Figure]:
    """Figures 8 and 11: predicted responses on those of harmonic balance."""

    def draw(pen: Pen) -> Figure:
        forces = sorted(
            {r["force"] for r in of.chosen("paper_figures", beam=beam, curve="response")}
        )
        figure, grid = _panels(len(forces), 2, 2.0 * len(forces) + 0.6, sharex=True)
        mode = _curve(beam, "mode")
        for (left, right), force in zip(grid, forces, strict=True):
            exact = _curve(beam, "response", force=force)
            left.plot(mode["frequency_hz"], mode["velocity"], color=pen.faint, linewidth=0.8)
            broad = {"color": pen.faint, "linewidth": 4, "alpha": 0.6}
            left.plot(exact["frequency_hz"], exact["velocity"], **broad, label="harmonic balance")
            right.plot(exact["frequency_hz"], exact["phase_deg"] - 90, **broad)
            for k, row in enumerate(
                of.chosen("paper_figures", beam=beam, curve="predicted", force=force)
            ):
                hertz, stable = np.asarray(row["frequency_hz"]), np.asarray(row["stable"])
                for kept, line, name in ((stable, "-", "predicted"), (~stable, ":", "unstable")):
                    # With the neighbours, so that no gap is where a branch turns unstable.
                    near = kept | np.roll(kept, 1) & (np.arange(len(kept)) > 0)
                    style = {"color": pen.orange, "linestyle": line, "label": None if k else name}
                    left.plot(hertz, np.where(near, row["velocity"], np.nan), **style)
                    phase = np.where(near, np.asarray(row["phase_deg"]) - 90, np.nan)
                    right.plot(hertz, phase, **style)
            peak = of.only("paper_figures", beam=beam, resonance=force)
            left.plot(
                peak["frequency_hz"][0], peak["velocity"][0], "*", color=pen.blue, markersize=9
            )
            for rest in of.chosen("paper_figures", beam=beam, from_rest=force):
                hollow = {"marker": "o", "markersize": 6, "color": pen.ink, "fillstyle": "none"}
                left.plot(rest["frequency_hz"], rest["velocity"][0], **hollow)
            left.set_title(f"{1e3 * force:.4g} mN")
            left.set_ylim(0, 1.15 * np.max(exact["velocity"]))
            left.set_ylabel("Velocity (m/s)")
            right.set_ylabel("Phase (°)")
            right.set_yticks([-180, -90, 0])
            right.set_ylim(-185, 5)
        for axes in grid[-1]:
            axes.set_xlabel("Frequency (Hz)")
        low, high = exact["frequency_hz"].min(), exact["frequency_hz"].max()
        grid[0, 0].set_xlim(low, high)
        _legend(figure, grid[0, 0], 3)
        return figure

    return draw


def curved_beam(pen: Pen) -> Figure:
    """Figure 9: the curved beam of Tab. 3 and its force, heights twenty times enlarged."""
    figure, ((axes,),) = _panels(1, 1, 2.2)
    paper = of.sources()["paper"]["curved"]
    length, thickness, radius = (paper[k] for k in ("length_mm", "thickness_mm", "radius_m"))
    x = np.linspace(-length / 2, length / 2, 101)
    y = np.sqrt((1e3 * radius) ** 2 - x**2) - np.sqrt((1e3 * radius) ** 2 - (length / 2) ** 2)
    axes.fill_between(
        x, y - thickness / 2, y + thickness / 2, color=pen.blue, alpha=0.5, linewidth=0
    )
    axes.plot(x, np.zeros_like(x), ":", color=pen.faint)
    for place in np.linspace(-length / 2, length / 2, 13)[1:-1]:
        arrow = {"arrowstyle": "->", "color": pen.orange}
        axes.annotate("", (place, np.interp(place, x, y) + 0.35), (place, 2.1), arrowprops=arrow)
    for end in (-1, 1):
        axes.plot([end * length / 2] * 2, [-0.7, 0.7], color=pen.ink, linewidth=4)
    axes.text(0, 2.2, "uniform harmonic force", ha="center", color=pen.ink)
    axes.text(0, y.max() - 0.8, f"rise {y.max():.3f} mm", ha="center", color=pen.ink)
    axes.set_ylim(-0.9, 2.7)
    _name(axes, "", "Along the beam (mm)", "Height (mm)")
    return figure


def programs(pen: Pen) -> Figure:
    """Seconds of a whole curve by program and problem."""
    figure, ((axes,),) = _panels(1, 1, 3.6)
    problems = of.speeds()
    look = {
        "snrmjax": (pen.orange, "o"),
        "snrmjax, bare": (pen.orange, "|"),
        "pyHarm-os": (pen.blue, "s"),
        "NLvib-py": (GREEN, "D"),
        "tmdsimpy": (PINK, "^"),
        "jaxcont": (AMBER, "v"),
        "NumPy/SciPy": (SKY, "P"),
    }
    seen = set()
    for height, (_, programs) in enumerate(reversed(problems.items())):
        for name, seconds in programs.items():
            colour, marker = look[name]
            label = name if name not in seen else None
            seen.add(name)
            style = {"color": colour, "marker": marker, "linestyle": "none", "markersize": 8}
            axes.plot(
                seconds, height, **style, markeredgewidth=2 if marker == "|" else 0, label=label
            )
    axes.set_xscale("log")
    axes.set_yticks(range(len(problems)), list(reversed(problems)))
    axes.set_ylim(-0.6, len(problems) - 0.4)
    _name(axes, "", "Seconds of one forced response, warm run", "")
    _legend(figure, axes, 4)
    return figure


def measured(pen: Pen) -> Figure:
    """Backbones and damping of the two measured beams with their bands."""
    figure, grid = _panels(2, 2, 5.0)
    for (left, right), beam in zip(grid, ("brake_reuss", "suspended"), strict=True):
        row = of.only("joint_fit_measured", measurement="fit", beam=beam)
        velocity = 1e3 * np.asarray(row["velocity"])
        for axes, value, std in (
            (left, "natural_frequency_hz", "natural_frequency_std_hz"),
            (right, "damping_per_cent", "damping_std_per_cent"),
        ):
            middle, error = np.asarray(row[value]), of.BAND * np.asarray(row[std])
            band = {"color": pen.orange, "alpha": 0.25, "linewidth": 0, "label": "95 % band"}
            axes.fill_between(velocity, middle - error, middle + error, **band)
            axes.plot(velocity, middle, "o-", color=pen.orange, markersize=3.5, label="joint fit")
        name = {"brake_reuss": "Brake-Reuss beam", "suspended": "Suspended beam"}[beam]
        _name(left, name, "Velocity amplitude (mm/s)", "Natural frequency (Hz)")
        _name(right, "", "Velocity amplitude (mm/s)", "Damping ratio (%)")
        left.ticklabel_format(useOffset=False)
    _legend(figure, grid[0, 0], 2)
    return figure


def reliability(pen: Pen) -> Figure:
    """Share of right answers over the probability that they stated."""
    sets = of.reliability()
    series = (pen.orange, pen.blue, GREEN, PINK, AMBER)
    figure, grid = _panels(2, 3, 5.4, sharex=True, sharey=True)
    for axes, (name, bins), colour in zip(grid.flat, sets.items(), series, strict=False):
        axes.plot([0, 1], [0, 1], "--", color=pen.faint, linewidth=1)
        for one in bins:
            fraction = one.right / one.answers
            low, high = of.binomial(one.right, one.answers)
            middle = (one.low + one.high) / 2
            axes.plot([one.low, one.high], [fraction, fraction], color=colour, linewidth=3)
            axes.plot([middle, middle], [low, high], color=colour, linewidth=1)
            x, y, side = middle, (high + 0.03 if fraction < 0.25 else low - 0.03), "center"
            if not 0.1 < y < 0.9:  # beside the line where its end is at the edge
                x, y, side = middle + 0.03, np.clip(y, 0.1, 0.9), "left"
            va = "bottom" if fraction < 0.25 else "top"
            axes.annotate(str(one.answers), (x, y), ha=side, va=va, fontsize=8, color=pen.ink)
        axes.set_title(name.replace(", ", ",\n").replace(" (", "\n("), fontsize=9.5)
        axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02), xticks=[0, 0.5, 1], yticks=[0, 0.5, 1])
    for axes in grid.flat[len(sets) :]:
        axes.set_visible(False)
    for axes in (*grid[-1], grid[0, -1]):
        axes.set_xlabel("Stated probability")
        axes.tick_params(labelbottom=True)
    for axes in grid[:, 0]:
        axes.set_ylabel("Share that is right")
    return figure


def coverage(pen: Pen) -> Figure:
    """Share of tests whose 95 % band holds the truth, with binomial intervals."""
    groups = {k: list(rows) for k, rows in groupby(of.coverages(), key=lambda row: row.what)}
    lines = sum(len(rows) + 1 for rows in groups.values())
    figure, ((axes,),) = _panels(1, 1, 0.21 * lines + 0.8)
    axes.axvline(95, color=pen.ink, linestyle="--", linewidth=1)
    height, ticks = 0, {}
    for title, rows in groups.items():
        axes.text(15, height, title, fontsize=9, va="center", weight="bold", color=pen.ink)
        for row in rows:
            height -= 1
            ticks[height] = row.about
            low, high = row.interval
            colour = pen.orange if row.says == "too narrow" else pen.blue
            colour = colour if row.ours else pen.faint
            axes.plot([100 * low, 100 * high], [height] * 2, color=colour)
            axes.plot(100 * row.fraction, height, "o", color=colour, markersize=4.5)
        height -= 1
    axes.set_yticks(list(ticks), list(ticks.values()), fontsize=9)
    axes.set_ylim(height + 0.3, 0.7)
    axes.set_xlim(14, 101)
    axes.set_xlabel("Bands that hold the truth (%)")
    return figure


FIGURES: dict[str, Callable[[Pen], Figure]] = {
    "figure_7": identified("flat"),
    "figure_8": responses("flat"),
    "figure_9": curved_beam,
    "figure_10": identified("curved"),
    "figure_11": responses("curved"),
    "programs": programs,
    "measured": measured,
    "reliability": reliability,
    "coverage": coverage,
}
