"""Misread columns, and causes of a modal mass other than the model's.

Causes are rms values, units, volts, and another shape.
"""

from collections.abc import Iterator
from typing import NamedTuple

import jax
import numpy as np

from snrmjax.doctor.findings import Finding, ImportCorrection
from snrmjax.doctor.fitted_hypothesis import (
    FittedHypothesis,
    Scale,
    checked_states,
    fit_hypothesis,
    leading_sensor,
    usable_rows,
)
from snrmjax.doctor.interpretations import best_interpretation, misread
from snrmjax.doctor.priors import (
    BAND,
    CERTAIN,
    FAR_DAMPING,
    FAR_FREQUENCY,
    FEWEST_STATES,
    MODAL_MASS,
    MORE_DAMPING,
    OTHER_SCALE,
)
from snrmjax.identify.inference.fitted_curves import fitted_values
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.pointwise.backbone_points import BackbonePoints
from snrmjax.identify.pointwise.snrm import linear_mode
from snrmjax.identify.test_model.states import TestStates
from snrmjax.measure.phase_convention import wrong_phases
from snrmjax.measure.states import SteadyStates
from snrmjax.model.structures import Structure
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

_VOLTS = (ImportCorrection(force_unit="V"),)


def is_other_scale(scale: Scale, as_modelled: FittedHypothesis) -> bool:
    """Whether the states determine a modal mass that contradicts the linear test."""
    controlled = as_modelled.posterior.phase_is_controlled
    if controlled or abs(np.log(scale.mass)) < OTHER_SCALE + BAND * scale.std:
        return False
    jacobian = as_modelled.evidence - as_modelled.posterior.log_evidence
    modelled = fit_hypothesis(as_modelled.states._replace(mass_std=0.0), jacobian)
    # The misfit of one mode off resonance is some per cent of its damping, no other modal mass.
    return scale.fit.beats(modelled, discrepancy=False)


def scale_findings(
    scale: Scale, as_modelled: FittedHypothesis, model: Structure, where: str
) -> list[Finding]:
    """Possible causes of another modal mass.

    κ is recorded over true F/V: an rms force makes it 1/√2, an rms response √2. Other factors are
    mixed units, a force in volts or a shape of another scale.
    """
    kappa = scale.mass
    asked = {"ratio": kappa, "ratio_std": kappa * scale.std}
    evidence_of_scale = Fact(
        "other_scale", **asked, misfit=scale.fit.misfit, misfit_as_modelled=as_modelled.misfit
    )
    off, near = float(np.log(kappa)), float(np.hypot(MODAL_MASS, 3 * scale.std))
    if abs(abs(off) - 0.5 * np.log(2)) < near:
        column = "response" if off > 0 else "force"
        evidence, advice = (
            Fact("rms", scale=evidence_of_scale, column=column),
            Fact("advice_rms", column=column),
        )
        correction = (
            ImportCorrection(response=2**0.5) if off > 0 else ImportCorrection(force=2**0.5)
        )
        return [Finding("rms_for_peak", where, evidence, advice, corrections=(correction,))]
    stiffening = _stiffening_ratio(scale.fit.states, scale.fit.stiffness, model)
    agrees = stiffening is not None and abs(np.log(stiffening)) < OTHER_SCALE * 3
    units = [unit for unit in _mixed_units() if abs(off - np.log(unit.mass)) < near]
    units = [unit for unit in units if not (agrees and unit.column == "response")]
    findings, unsure = [], bool(units)
    if units:
        evidence_of_scale = Fact("if_units_are_right")
        names = tuple(unit[:3] for unit in units)
        evidence = Fact("mixed_units", **asked, factor=units[0].mass, units=names)
        corrections = tuple(unit.correction for unit in units)
        advice = Fact("advice_units", units=names)
        findings.append(Finding("wrong_unit", where, evidence, advice, corrections=corrections))
    of_force, of_shape = _signs(scale.fit, model, stiffening, agrees=agrees)
    if of_force >= of_shape:
        evidence, advice = (
            Fact("voltage_for_force", scale=evidence_of_scale, gain=kappa),
            Fact("advice_voltage"),
        )
        findings.append(
            Finding("volts_as_force", where, evidence, advice, corrections=_VOLTS, unsure=unsure)
        )
    if of_shape >= of_force:
        evidence, advice = (
            Fact("shape_scale", scale=evidence_of_scale),
            Fact("advice_shape", factor=kappa**0.5),
        )
        findings.append(
            Finding("shape_not_mass_normalised", where, evidence, advice, unsure=unsure)
        )
    return findings


class _MixedUnit(NamedTuple):
    """Values of one unit read as another, and the resulting modal mass."""

    column: str  # "response" or "force"
    unit: str  # of the values
    taken_for: str
    mass: float  # over the model's

    @property
    def correction(self) -> ImportCorrection:
        """The import with the right unit."""
        written = {"m/s²": "m/s2", "µm": "um", "inches": "in", "pounds": "lbf"}
        unit = written.get(self.unit, self.unit)
        if self.column == "force":
            return ImportCorrection(force=1 / self.mass, force_unit=unit)
        return ImportCorrection(response=self.mass, unit=unit)


def _mixed_units() -> Iterator[_MixedUnit]:
    """κ for pairs of units; it is inverted for a force and where both units are exchanged.

    The more likely first: values in the small unit read as the large one, then the reverse.
    """
    pairs = (
        *(("response", "g", "m/s²", 9.80665), ("response", "mm", "m", 1e-3)),
        *(("response", "µm", "m", 1e-6), ("response", "inches", "m", 0.0254)),
        *(("force", "mN", "N", 1e3), ("force", "kN", "N", 1e-3)),
        ("force", "pounds", "N", 1 / 4.4482216),
    )
    yield from (_MixedUnit(*pair) for pair in pairs)
    yield from (_MixedUnit(of, other, unit, 1 / mass) for of, unit, other, mass in pairs)


def _signs(
    fit: FittedHypothesis, model: Structure, stiffening: float | None, *, agrees: bool
) -> tuple[int, int]:
    """Further signs of a voltage as force, and of a shape of another scale."""
    modes = model.modes
    j = modes.mode_of_interest
    column = np.abs(np.asarray(modes.mode_shape)[:, j])
    plain = abs(column.max() - 1) < 1e-6 or abs(np.linalg.norm(column) - 1) < 1e-6
    rate = 2 * float(np.prod(linear_mode(modes)))
    damped = rate > 0 and float(np.min(fit.damping)) > (1 + MORE_DAMPING) * rate
    return int(agrees) + int(damped), int(plain) + int(stiffening is not None and not agrees)


def _stiffening_ratio(states: TestStates, stiffness: np.ndarray, model: Structure) -> float | None:
    """Measured stiffening over that of the model's potential; None if either is too small.

    K(a) − ω² = (2/π) ∫ f(a cos β) cos β dβ / a of the potential's own force, a = |V|/(Ω Φ).
    """
    modes = model.modes
    one = modes.mode_of_interest
    terms = [
        (len(m), float(c))
        for m, c in zip(model.potential.monomials, model.potential.coefficient, strict=True)
        if set(m) == {one}
    ]
    if not terms:
        return None
    q = states.amplitude / float(np.max(np.abs(np.asarray(modes.mode_shape)[:, one])))
    beta = 2 * np.pi * (np.arange(64) + 0.5) / 64
    x = q[:, None] * np.cos(beta)
    force = sum(degree * c * x ** (degree - 1) for degree, c in terms)
    natural_square = float(linear_mode(modes)[0]) ** 2
    predicted = 2 * np.mean(force * np.cos(beta), axis=1) / q / natural_square
    measured = stiffness / natural_square - 1
    if np.ptp(measured) < 0.01 or np.ptp(predicted) < 1e-6:
        return None
    slope = float(np.polyfit(predicted, measured, 1)[0])
    return slope if slope > 0 else None


def shaker_damping(fit: FittedHypothesis, model: Structure, where: str) -> list[Finding]:
    """Damping above the linear test's by a constant amount, at the same natural frequency.

    A shaker adds (Bl)²/R of its coil if the drive voltage is taken as force; damping of structures
    changes with amplitude. Nothing where the model states no error of its damping.
    """
    modes = model.modes
    one = modes.mode_of_interest
    natural, ratio = map(float, linear_mode(modes))
    std = modes.damping_ratio_std.item(one)
    amplitude = fit.states.amplitude
    if not std > 0 or not ratio > 0 or np.ptp(np.log(amplitude)) < 1.0:
        return []
    times = fit.damping / (2 * natural * ratio)
    excess = float(times.min()) - 1
    away = float(np.sqrt(max(fit.stiffness[np.argmin(amplitude)], 0.0))) / natural - 1
    certain = CERTAIN * times.min() * std / ratio
    if excess < max(MORE_DAMPING, certain) or np.ptp(times) > 0.5 * excess or abs(away) > ratio:
        return []
    evidence = Fact("shaker_damping", ratio=float(times.min()), frequency_off=abs(away))
    advice = Fact("advice_shaker_damping")
    return [Finding("volts_as_force", where, evidence, advice, corrections=_VOLTS, unsure=True)]


def caveat(
    data: SteadyStates, model: Structure, points: BackbonePoints | None = None
) -> tuple[Fact, ...]:
    """Columns that seem to be misread, or a lowest level that seems to be of another mode.

    Checks the interpretations of phasors and the modal mass of `check_test`, without its slower
    corrections; if these are fine, whether natural frequency and damping of the lowest level are
    farther from the model's than they change with amplitude.

    Arguments: `data` and `model` as for identification; `points` identified, None if there are
    none. Returns no fact or one.
    Validity: that of `check_test`; forces known as a voltage only are not checked.
    """
    # NumPy arrays: nothing is compiled for the table's number of states.
    data, points = jax.tree.map(np.asarray, (data, points))
    sensor = leading_sensor(data)
    rows = usable_rows(data, sensor)
    if rows.sum() < FEWEST_STATES or np.all(np.isnan(np.asarray(data.force)[rows])):
        return ()
    checked = checked_states(data, model, sensor, rows)
    recorded, best = best_interpretation(checked, known_mass=True)
    if best is not recorded:
        # Wrong phases that identification reports need not be reported twice.
        return () if wrong_phases(data, model) else (_fact(misread(recorded.fit, best, "")),)
    scale, as_modelled = best.scale, best.as_modelled
    if scale is not None and as_modelled is not None and is_other_scale(scale, as_modelled):
        findings = scale_findings(scale, as_modelled, model, data.sensors[sensor])
        errors = [one for one in findings if one.severity == "error"]
        if errors:
            return (_fact(errors[0]),)
    return () if points is None else _far(points, model)


def _fact(one: Finding) -> Fact:
    return Fact(
        "column_misread", evidence=one.evidence, advice=one.advice, importable=bool(one.corrections)
    )


def _far(points: BackbonePoints, model: Structure) -> tuple[Fact, ...]:
    """A lowest level far from the linear mode, beyond the range of the curves."""
    good = np.asarray(points.usable) & np.isfinite(np.asarray(points.amplitude))
    columns = (points.amplitude, points.natural_frequency, points.damping_ratio)
    rows, level = np.column_stack([np.asarray(c) for c in columns]), np.asarray(points.level)
    medians = [np.median(rows[good & (level == k)], axis=0) for k in np.unique(level[good])]
    # One row for each level, the smallest amplitude first.
    identified = np.array(sorted(map(tuple, medians))).reshape(-1, 3)[:, 1:]
    linear = np.array(linear_mode(model.modes), dtype=float)
    if not len(identified) or linear[1] <= 0 or identified[:, 1].min() <= 0:
        return ()
    off = np.log(identified / linear)
    least = np.maximum([FAR_FREQUENCY, np.log(FAR_DAMPING)], np.ptp(off, axis=0))
    far = np.abs(off[0]) > least
    if not far.any():
        return ()
    names = tuple(np.array(["natural frequency", "damping"])[far].tolist())
    lowest, mode = ((w / HERTZ, ratio) for w, ratio in (identified[0].tolist(), linear.tolist()))
    return (Fact("far_from_linear_mode", quantities=names, lowest=lowest, linear=mode),)


def linear_damping_note(fit: JointFit, model: Structure) -> tuple[Fact, ...]:
    """Note on damping at zero amplitude that differs between a joint fit and the linear test.

    Where the difference exceeds both 95 % bands. Nothing without a stated error of the model's
    damping.
    """
    modes = model.modes
    j = modes.mode_of_interest
    linear, linear_std = float(linear_mode(modes)[1]), modes.damping_ratio_std.item(j)
    at_rest = fitted_values(fit, displacement=np.zeros(1))
    fitted, std = float(at_rest.damping_ratio[0]), float(at_rest.damping_ratio_std[0])
    both = float(np.hypot(std, linear_std))
    if not linear_std > 0 or not abs(fitted - linear) > BAND * both:  # False for NaN
        return ()
    return (
        Fact(
            "damping_at_rest",
            fitted=fitted,
            fitted_std=std,
            linear=linear,
            linear_std=linear_std,
            apart=abs(fitted - linear) / both,
        ),
    )


def with_caveat(error: InputError, data: SteadyStates, model: Structure) -> InputError:
    """The error of an identification, with the misread column as its probable cause."""
    notes = caveat(data, model)
    return InputError(" ".join((str(error), *map(str, notes)))) if notes else error
