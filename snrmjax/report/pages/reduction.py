"""A reduced-order model: model.toml, load_cases.csv, summary.json, figures and its page."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from snrmjax.condense.case_checks import case_names
from snrmjax.condense.condensation import Condensation
from snrmjax.condense.load_cases import StaticCases
from snrmjax.condense.load_set import NONLINEAR_RATIO
from snrmjax.condense.scale_study import (
    TOLERANCE,
)
from snrmjax.io.files import write_atomically, write_summary
from snrmjax.io.models import write_model
from snrmjax.io.reduction.load_tables import write_load_cases
from snrmjax.model.potential import monomial_key
from snrmjax.numerics.units import HERTZ
from snrmjax.pipelines.reduce import Reduction
from snrmjax.report.figures.reduction import (
    quality_figure,
    scale_figure,
    shapes_figure,
    static_figure,
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
from snrmjax.report.style import printed, with_unit

SHAPES = "Shapes of the modes kept in the reduced model."
STATIC = (
    "Static load along one mode, expressed as the displacement it would cause in the linear "
    "structure, against the displacement of that mode where its shape is largest. "
    "Dots: finite elements; filled ones are load cases of the fit, hollow ones larger loads not "
    "used in the fit: they show how far the model is valid. Lines: the reduced model with all its "
    "modes, from rest; a line ends where the path becomes unstable."
)
QUALITY = (
    "Each load case is left out of the fit and predicted from the others. Errors that grow with "
    "the nonlinear force are missing terms of the polynomial; errors that grow as it falls are "
    "round-off."
)
SCALE = (
    "The condensation repeated at many load scales. Left: deviation of the leading coefficients "
    "from those of the model. Small loads show the round-off of displacements, large ones the "
    "missing terms of the polynomial; between them the coefficients do not depend on the loads, "
    "and the model's own load scale should lie there. The plateau is where they stay within "
    f"{100 * TOLERANCE:g} %."
)


def write(folder: Path, reduction: Reduction) -> Report:
    """Write model.toml, load_cases.csv, summary.json, figures (PNG) and report.html."""
    found = reduction.condensation
    write_model(folder / "model.toml", reduction.structure)
    write_load_cases(folder / "load_cases.csv", found.cases)
    write_summary(folder / "summary.json", reduction_summary(reduction))
    sections = [_shapes(folder, reduction), _static(folder, reduction), _fit(folder, reduction)]
    if reduction.study is not None:
        figure = _saved(folder, "load_scale", scale_figure(reduction.study), SCALE)
        text = "; ".join(reduction.study.summary()[1:])
        sections.append(Section("Load scale", (text.capitalize() + ".",), [figure]))
    sections.append(Section("Coefficients", (), (), [_coefficients(found)]))
    report = Report(
        title=f"Reduced model: {reduction.source.name}",
        done=_done(reduction),
        result=reduction_sentence(reduction),
        notes=[str(note) for note in reduction.notes],
        sections=[section for section in sections if section is not None],
    )
    write_report(folder / "report.html", report)
    return report


def headline(reduction: Reduction) -> list[str]:
    """The load scale, its study, and the result."""
    lines = []
    if reduction.load_scale is not None:
        scale = f"{reduction.load_scale:.3g} thicknesses"
        lines.append(f"loads displace single modes linearly by up to {scale}")
    if reduction.study is not None:
        lines.append("; ".join(reduction.study.summary()[1:]))
    return [*lines, reduction_sentence(reduction)]


def reduction_sentence(reduction: Reduction) -> str:
    """The result in one or two plain sentences."""
    found = reduction.condensation
    quality, used = found.quality, int(found.cases.usable.sum())
    modes = ", ".join(reduction.mode_names)
    text = (
        f"{modes[:1].upper()}{modes[1:]}: one potential with {len(found.potential.monomials)} "
        f"coefficients fits {used} load cases to {number(100 * quality.misfit, 2)} % of their "
        "nonlinear force"
    )
    if np.isfinite(quality.cross_validated):
        text += f" (cross-validated {number(100 * quality.cross_validated, 2)} %)"
    return text + "."


def reduction_summary(reduction: Reduction) -> dict:
    """The content of summary.json."""
    found, study = reduction.condensation, reduction.study
    quality, potential = found.quality, found.potential
    keys = [monomial_key(m) for m in potential.monomials]
    values, spread = np.asarray(potential.coefficient), np.asarray(potential.coefficient_std)
    moved = reduction.displacement
    summary: dict = {
        "name": reduction.source.name,
        "modes": list(found.basis.numbers),
        "frequency_hz": _numbers(np.asarray(found.basis.frequency) / HERTZ),
        "damping_ratio": _numbers(reduction.source.damping_ratio),
        "degree": found.degree,
        "coefficients": {
            key: {"value": float(value), "std": float(std)}
            for key, value, std in zip(keys, values, spread, strict=True)
        },
        "load_cases": {
            "run": len(found.cases.force),
            "used": int(found.cases.usable.sum()),
            "displacement_m": None if moved is None else _numbers(moved),
            "load_scale": reduction.load_scale,
        },
        "fit": {
            "misfit": quality.misfit,
            "cross_validated": quality.cross_validated,
            "equation_residual": _numbers(quality.equation_residual),
            "equation_cross_validated": _numbers(quality.equation_cross_validated),
            "linear_stiffness_ratio": _numbers(quality.linear_stiffness_ratio),
            "nonlinear_ratio": float(np.nanmax(quality.nonlinear_ratio)),
            "condition": quality.condition,
            "energy_error": None
            if quality.energy_error is None
            else float(np.nanmax(np.abs(quality.energy_error))),
        },
        "load_scale_study": None,
        "warnings": [
            {"kind": f.kind, "message": str(f), "cases": case_list(found.cases, f.get("cases", ()))}
            for f in found.warnings
        ],
        "notes": [str(note) for note in reduction.notes],
    }
    if study is not None:
        summary["load_scale_study"] = {
            "scale": _numbers(study.scale),
            "coefficients": {
                key: _numbers(study.coefficient[:, k])
                for k, key in enumerate(keys)
                if study.leading[k]
            },
            "misfit": _numbers(study.misfit),
            "plateau": None if study.plateau is None else list(study.plateau),
            "plateau_decades": study.decades,
            "scale_of_the_model_inside": study.holds_default,
        }
    return summary


def case_list(cases: StaticCases, rows: tuple[int, ...]) -> list[str]:
    """Load cases by name, one entry each."""
    return [case_names(cases, (row,)) for row in rows]


def _numbers(values: np.ndarray) -> list[float]:
    return [float(value) for value in np.asarray(values)]


def _saved(folder: Path, name: str, figure: Figure, caption: str) -> ReportFigure:
    done = printed(figure)
    write_atomically(folder / f"{name}.png", done.png)
    return ReportFigure(done, caption)


def _done(reduction: Reduction) -> list[tuple[str, str]]:
    found = reduction.condensation
    numbers = ", ".join(str(n) for n in found.basis.numbers)
    done = [("modes", numbers), ("force of degree", str(found.degree))]
    if reduction.displacement is not None:
        low, high = (with_unit(f(reduction.displacement), "m", 3) for f in (np.min, np.max))
        span = low if low == high else f"{low} to {high}"
        if reduction.load_scale is not None:
            span += f" (up to {reduction.load_scale:.3g} thicknesses)"
        stated = reduction.source.load_scale is not None
        why = "as stated" if stated else f"nonlinear force {NONLINEAR_RATIO:g} of the linear"
        done.append(("loads displace single modes linearly by", f"{span}: {why}"))
    return done


def _shapes(folder: Path, reduction: Reduction) -> Section | None:
    if reduction.source.lines is None:
        return None
    figure = shapes_figure(reduction.source.lines, reduction.mode_names)
    return Section("Modes", (), [_saved(folder, "mode_shapes", figure, SHAPES)])


def _static(folder: Path, reduction: Reduction) -> Section:
    figure = static_figure(reduction.condensation, reduction.mode_names, reduction.sweep)
    saved = _saved(folder, "force_displacement", figure, STATIC)
    return Section("Force and displacement", (), [saved])


def _fit(folder: Path, reduction: Reduction) -> Section:
    quality = reduction.condensation.quality
    rows = [
        (name, *(f"{100 * one:.2g} %" for one in pair), number(ratio, 6))
        for name, *pair, ratio in zip(
            reduction.mode_names,
            quality.equation_residual,
            quality.equation_cross_validated,
            quality.linear_stiffness_ratio,
            strict=True,
        )
    ]
    table = ReportTable(
        ("equation", "residual", "cross-validated", "linear stiffness / ω²"),
        rows,
        "Residuals of each modal equation relative to the rms force on that mode, and the linear "
        f"stiffness fitted to the load cases. Condition of the fit: {quality.condition:.2g}.",
    )
    figure = _saved(folder, "fit_quality", quality_figure(reduction.condensation), QUALITY)
    text = []
    if quality.energy_error is not None:
        worst = float(np.nanmax(np.abs(quality.energy_error)))
        text.append(
            "The strain energy of the reduced model, which was not used in the fit, differs from "
            f"that of the finite elements by at most {number(100 * worst, 2)} %."
        )
    return Section("Fit", text, [figure], [table])


def _coefficients(found: Condensation) -> ReportTable:
    potential = found.potential
    rows = [
        (monomial_key(m), with_error(float(value), float(std)))
        for m, value, std in zip(
            potential.monomials,
            np.asarray(potential.coefficient),
            np.asarray(potential.coefficient_std),
            strict=True,
        )
    ]
    caption = (
        "Coefficients of the potential V in kg, m, s; the restoring force is ∂V/∂q. Digits are the "
        "modes of the monomial, in the order of the reduced model. ±: 1σ over load cases."
    )
    return ReportTable(
        ("monomial", "coefficient"), rows, caption, folded=f"All {len(rows)} coefficients"
    )
