"""Files of linear modes: the model, a table of modes, a report."""

from pathlib import Path

import numpy as np

from snrmjax.identify.modal.free_decay import DecayModes
from snrmjax.identify.modal.modal_fit import LinearModalFit
from snrmjax.identify.scaling.scaled_modes import ScaledModes
from snrmjax.io.models import write_model
from snrmjax.io.tables import write_table
from snrmjax.numerics.units import HERTZ, unit_in_print
from snrmjax.pipelines.modes import LinearModesFound
from snrmjax.report.figures.modes import (
    decay_figure,
    modal_responses_figure,
    stabilisation_figure,
)
from snrmjax.report.html import (
    Report,
    ReportFigure,
    ReportTable,
    Section,
    number,
    with_error,
    write_report,
)

_BAND = 1.96  # standard deviations of a 95 % band
_ORDERS = (
    "Poles of every model order. A pole that persists over many orders (blue) is "
    "physical; others come and go with the order. Vertical lines are the selected modes."
)
_RESPONSES = (
    "Receptance as measured, and synthesised from the modes with their residual terms. A peak in "
    "the measured curve only is a missed mode."
)
_DECAY = "The recorded decay and the sum of decaying oscillations that was fitted to it."


def write(folder: Path, found: LinearModesFound, *, file: str = "model.toml") -> Report:
    """Write the model under the name `file`, modes.csv and report.html.

    Raises `ValueError` for a mode of interest that is not there.
    """
    write_tables(folder, found, file=file)
    report = modal_report(found)
    write_report(folder / "report.html", report)
    return report


def write_tables(folder: Path, found: LinearModesFound, *, file: str = "model.toml") -> None:
    """Write the model under the name `file`, and modes.csv."""
    write_model(folder / file, found.structure)
    write_table(folder / "modes.csv", _columns(found.scaled))


def headline(found: LinearModesFound) -> list[str]:
    """The modes in one sentence."""
    return [modes_sentence(found.scaled)]


def modal_report(of: LinearModesFound) -> Report:
    """The page of linear modes."""
    modes, found, interest = of.scaled, of.fitted, of.interest
    figures = [ReportFigure(stabilisation_figure(found), _ORDERS)]
    if isinstance(found, LinearModalFit):
        figures.append(ReportFigure(modal_responses_figure(found), _RESPONSES))
        omega = found.curves.omega / HERTZ
        done = [
            ("reference", str(found.reference)),
            ("lines", f"{len(omega)} from {omega[0]:.6g} to {omega[-1]:.6g} Hz"),
            ("weights", _WEIGHTS[found.source]),
        ]
    else:
        figures.append(ReportFigure(decay_figure(found), _DECAY))
        time = found.curves.time
        done = [("decay", f"{len(time)} samples, {time[-1] - time[0]:.4g} s")]
    return Report(
        title=f"Linear modes: {of.name}",
        done=[*done, ("sensors", ", ".join(modes.sensors)), ("scale", str(modes.scaled_by))],
        result=modes_sentence(modes),
        summary=_headline(modes, interest),
        notes=[str(note) for note in of.notes],
        sections=[
            Section("Modes", (), (), [_table(modes, found), _shapes(modes)]),
            Section("Fit", (), figures),
        ],
    )


_WEIGHTS = {
    "stated": "stated errors",
    "coherence": "coherence",
    "residuals": "errors estimated from the residuals",
}


def modes_sentence(modes: ScaledModes) -> str:
    """The result in a plain sentence."""
    listed = "; ".join(
        f"{_frequency(modes, k)} Hz with {_damping(modes, k)} %"
        for k in range(min(modes.n_modes, 6))
    )
    more = f" and {modes.n_modes - 6} more" if modes.n_modes > 6 else ""
    count = f"{modes.n_modes} mode{'s' if modes.n_modes > 1 else ''}"
    return f"{count}, {modes.scaled_by}: {listed}{more} (95 %)."


def _frequency(modes: ScaledModes, k: int) -> str:
    spread = _BAND * modes.natural_frequency_std[k] / HERTZ
    return with_error(modes.natural_frequency[k] / HERTZ, spread)


def _damping(modes: ScaledModes, k: int) -> str:
    return with_error(100 * modes.damping_ratio[k], _BAND * 100 * modes.damping_ratio_std[k])


def _headline(modes: ScaledModes, interest: int) -> list[tuple[str, str]]:
    k = interest
    rows = [
        ("mode of interest", str(k + 1)),
        ("natural frequency", f"{_frequency(modes, k)} Hz"),
        ("damping", f"{_damping(modes, k)} %"),
    ]
    if modes.mass_normalised and modes.per == "N":
        top = int(np.argmax(np.abs(modes.shape[:, k])))
        mass = 1 / (modes.shape[top, k] * modes.participation[k])
        error = _BAND * abs(mass) * modes.modal_mass_std[k]
        rows.append((f"modal mass at {modes.sensors[top]}", f"{with_error(mass, error)} kg"))
    return rows


def _table(modes: ScaledModes, found: LinearModalFit | DecayModes) -> ReportTable:
    rows = []
    for k in range(modes.n_modes):
        same = int(np.argmin(np.abs(found.natural_frequency - modes.natural_frequency[k])))
        collinear = found.collinearity[same]
        lines = found.lines_in_band[same] if isinstance(found, LinearModalFit) else np.nan
        rows.append(
            (
                str(k + 1),
                _frequency(modes, k),
                _damping(modes, k),
                with_error(modes.participation[k], _BAND * modes.participation_std[k]),
                f"± {number(100 * _BAND * modes.modal_mass_std[k], 2)} %"
                if np.isfinite(modes.modal_mass_std[k])
                else "unknown",
                number(collinear, 3) if np.isfinite(collinear) else "one sensor",
                number(lines, 2) if np.isfinite(lines) else "",
            )
        )
    header = (
        *("mode", "frequency (Hz)", "damping (%)", f"participation per {modes.per}"),
        *("modal mass", "phase collinearity", "lines in the half-power band"),
    )
    return ReportTable(header, rows, "Bands are 95 %.")


def _shapes(modes: ScaledModes) -> ReportTable:
    unit = unit_in_print("kg^-1/2") if modes.mass_normalised else "relative"
    rows = [
        (
            name,
            *(
                with_error(modes.shape[s, k], _BAND * modes.shape_std[s, k])
                for k in range(modes.n_modes)
            ),
        )
        for s, name in enumerate(modes.sensors)
    ]
    header = ("sensor", *(f"mode {k + 1} ({unit})" for k in range(modes.n_modes)))
    return ReportTable(header, rows, "Shapes at the sensors, with 95 % bands.")


def _columns(modes: ScaledModes) -> dict[str, np.ndarray]:
    n, sensors = modes.n_modes, len(modes.sensors)

    def each(values: np.ndarray) -> np.ndarray:
        return np.repeat(values, sensors)

    return {
        "mode": each(np.arange(1, n + 1)),
        "sensor": np.array(list(modes.sensors) * n),
        "frequency_hz": each(modes.natural_frequency / HERTZ),
        "frequency_std_hz": each(modes.natural_frequency_std / HERTZ),
        "damping_ratio": each(modes.damping_ratio),
        "damping_ratio_std": each(modes.damping_ratio_std),
        "participation": each(modes.participation),
        "participation_std": each(modes.participation_std),
        "shape": modes.shape.T.reshape(-1),
        "shape_std": modes.shape_std.T.reshape(-1),
        "modal_mass_std": each(modes.modal_mass_std),
    }
