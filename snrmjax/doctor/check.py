"""The import doctor: checks tables, model and time records before identification."""

from collections.abc import Sequence

import numpy as np

from snrmjax.doctor.column_misreadings import is_other_scale, scale_findings, shaker_damping
from snrmjax.doctor.corrections import TestCorrection, corrections, sweeps_apart
from snrmjax.doctor.findings import Checkup, Finding, gravest_first
from snrmjax.doctor.fitted_hypothesis import (
    CheckedStates,
    FittedHypothesis,
    checked_states,
    files_of_levels,
    leading_sensor,
    usable_rows,
)
from snrmjax.doctor.force_checks import deepest_fall, dropout_findings, harmonic_findings
from snrmjax.doctor.interpretations import OPPOSITE, best_interpretation, misread
from snrmjax.doctor.priors import (
    FEWEST_STATES,
    FITS_WELL,
    GAIN_MATTERS,
    MOST_OF_MISFIT,
    MOVED_MATTERS,
    OTHER_RANGE,
)
from snrmjax.doctor.record_checks import record_findings
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.measure.states import SteadyStates, join_steady_states
from snrmjax.model.structures import Structure
from snrmjax.numerics.compiled import on_numbers
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError


@on_numbers("Differentiate `sj.identify.identify_points`.")
def check_test(
    tables: SteadyStates | Sequence[SteadyStates],
    model: Structure | None = None,
    recordings: Sequence[TimeRecording] = (),
) -> Checkup:
    """Find errors of import and of the test in tables and records, before identification.

    Near resonance a single mode obeys iΩAF/V = κ(K(a) − Ω² + iΩδ(a)) with any smooth curves of
    the displacement amplitude. Each possible misreading of a column or error of the test is
    corrected, and the corrected table is fitted with the same posterior as the recorded one
    (`identify.test_model`): it is reported only if one mode fits then, and clearly not as recorded.
    Records are checked step by step: clipping, transients, harmonics, aliases.

    Arguments: `tables` of one structure, each a separate test (in order of time); `model` as
    for identification, without which scales and the model's frequency are not checked;
    `recordings` of the same test.
    Returns `Checkup`: `.findings`, each with kind, severity ("error", "warning", "info"), where,
    evidence and remedy; none where all is well; `.notes` on what could not be checked.
    Raises `ValueError` without tables and recordings, and for tables of different sensors.
    Validity: one well-separated mode and tests near its resonance; at least eight states. A
    factor of the force and the same factor of the modal mass are equivalent in one table: both are
    reported then.
    Not differentiable: differentiate `snrmjax.identify.identify_points`.

    >>> from snrmjax.measure import steady_states
    >>> w = np.linspace(480.0, 520.0, 30)
    >>> v = 1j * w / (500.0**2 - w**2 + 10j * w)
    >>> check_test(steady_states(np.ones(30), w, np.ones(30), v.conj())).kinds
    ('conjugated_response',)
    """
    given = [tables] if isinstance(tables, SteadyStates) else list(tables)
    if not given and not recordings:
        raise InputError("there is nothing to check: give a table or a recording.")
    findings: list[Finding] = []
    notes: list[Fact] = []
    if given:
        parts, groups = files_of_levels(given)
        data = parts[0] if len(parts) == 1 else join_steady_states(parts)
        findings += _of_table(data, model, groups if len(parts) > 1 else (), notes)
        if model is None:
            notes.append(Fact("no_model"))
    else:
        notes.append(Fact("no_table"))
    for recording in recordings:
        of_record, unseen = record_findings(recording)
        findings += of_record
        notes += unseen
    return Checkup(gravest_first(findings), tuple(dict.fromkeys(notes)))


def _of_table(
    data: SteadyStates,
    model: Structure | None,
    groups: tuple[tuple[int, ...], ...],
    notes: list[Fact],
) -> list[Finding]:
    sensor = leading_sensor(data)
    rows = usable_rows(data, sensor)
    name, n_levels = data.sensors[sensor], len(np.unique(np.asarray(data.level)))
    where = f"{n_levels} level{'s' if n_levels != 1 else ''} at {name}"
    n_states = int(rows.sum())
    if n_states < FEWEST_STATES:
        notes.append(Fact("too_few_states", n_states=n_states, sensor=name, needed=FEWEST_STATES))
        return []
    drive = bool(np.all(np.isnan(np.asarray(data.force)[rows])))
    if drive:
        notes.append(Fact("drive_not_scaled"))
    checked = checked_states(data, model, sensor, rows, groups)
    findings, fit = mode_findings(checked, model, where, drive)
    findings += dropout_findings(checked, where)
    if data.harmonic_order and not any(one.severity == "error" for one in findings):
        findings += harmonic_findings(data, checked, fit, model, sensor, where)
    return findings


def mode_findings(
    checked: CheckedStates, model: Structure | None, where: str, drive: bool
) -> tuple[list[Finding], FittedHypothesis]:
    """Findings of one sensor's states, and the fit with these errors corrected.

    `drive`: the force column is declared as volts, so that its scale and phase are unknown.
    """
    scaled = model is not None and not drive  # whether the modal mass is known
    recorded, best = best_interpretation(checked, scaled)
    findings: list[Finding] = []
    # Without a model the sign of the sensor relative to the force is unknown.
    unsigned = model is None and best.meaning is OPPOSITE
    if best is not recorded and not drive and not unsigned:
        findings.append(misread(recorded.fit, best, where))
        if best.meaning.kind == "degrees_for_radians":
            return findings, best.fit
    base, scale, first = best.as_modelled or best.fit, best.scale, None
    if model is not None and scaled and scale is not None and is_other_scale(scale, base):
        # An error of the test may also appear as another modal mass.
        first = _likeliest(checked, base)
        if first is None or not first.fit.is_likelier(scale.fit):
            findings += scale_findings(scale, base, model, where)
            base, first = scale.fit, None
    if first is None:
        first = _likeliest(checked, base)
        first = first if first is not None and _beats(checked, first, base) else None
    plain = all(one.kind in ("rms_for_peak", "shape_not_mass_normalised") for one in findings)
    if first is not None:
        findings.append(_finding(checked, base, first, where))
        base = first.fit
    if model is not None and not drive and plain:
        findings += shaker_damping(base, model, where)
    return findings, base


def _likeliest(checked: CheckedStates, base: FittedHypothesis) -> TestCorrection | None:
    """The most likely correction, if it is relevant."""
    tried = (one for one in corrections(checked, base.states, base) if one.fit.leaves_less(base))
    best = max(tried, key=lambda one: one.fit.evidence, default=None)
    return best if best is not None and _matters(best, base) else None


def _beats(checked: CheckedStates, one: TestCorrection, base: FittedHypothesis) -> bool:
    """Whether a correction is clearly more likely than the table as it is interpreted."""
    if one.kind == "force_dropout":  # noise of a force cell is no misfit
        return one.fit.noise < FITS_WELL and one.fit.explains(base)
    most = not base.damped or one.fit.misfit**2 < MOST_OF_MISFIT * base.misfit**2
    if not (most and one.fit.beats(base)):
        return False
    other = sweeps_apart(checked, base.states, base) if one.kind == "drift" else None
    return other is None or one.fit.is_likelier(other)


def _matters(one: TestCorrection, base: FittedHypothesis) -> bool:
    """Whether a correction is large enough to be reported."""
    if one.kind in ("drift", "different_structures"):
        width = float(np.median(one.fit.damping / base.states.frequency))
        return abs(one.value) > MOVED_MATTERS * width
    if one.kind == "volts_as_force":
        gains = np.array(one.gains)
        off = np.sort(np.abs(gains - np.median(gains)))
        flattened = base.fits and off[-2] > OTHER_RANGE
        return float(np.ptp(gains)) > GAIN_MATTERS and not flattened
    # A force below the noise of its cell cannot be corrected.
    return one.kind != "force_dropout" or one.value < base.states.force.min()


def _finding(
    checked: CheckedStates, base: FittedHypothesis, one: TestCorrection, where: str
) -> Finding:
    """The error that a correction removes, as a finding."""
    states = base.states
    misfits = {"misfit": one.fit.misfit, "misfit_before": base.misfit}
    rows: tuple[int, ...] = ()
    title = None
    match one.kind:
        case "drift":
            evidence, advice = Fact("drift", change=one.value, **misfits), Fact("advice_drift")
        case "different_structures":
            n = len(checked.files)
            evidence = Fact(
                "structures_differ", file=one.file, change=one.value, n_files=n, **misfits
            )
            advice = Fact("advice_structures")
        case "volts_as_force":
            evidence, advice, title = _of_gains(one, misfits, checked.files)
        case "force_dropout":
            advice = Fact("advice_force_in_noise")
            evidence = Fact(
                "force_in_noise",
                fall=deepest_fall(states),
                floor=one.value,
                smallest=float(states.force.min()),
            )
        case "unsettled_steps":
            evidence = Fact("states_unsettled", fraction=one.value, **misfits)
            advice = Fact("advice_unsettled")
        case _:
            amplitude = states.force if one.column == "force" else np.abs(states.velocity)
            rows = tuple(int(checked.row[k]) for k in np.flatnonzero(amplitude > one.value * 0.999))
            advice, limited = Fact("advice_clipped_states"), {"column": one.column, "rows": rows}
            evidence = Fact("states_clipped", limit=one.value, **limited, **misfits)
    return Finding(one.kind, where, evidence, advice, rows, title=title)


def _of_gains(
    one: TestCorrection, misfits: dict[str, float], files: tuple[tuple[int, ...], ...]
) -> tuple[Fact, Fact, Fact | None]:
    """Levels whose force scales differ; listed by number where only a few are off."""
    gains = np.array(one.gains)
    few = np.flatnonzero(np.abs(gains - np.median(gains)) > 0.5 * GAIN_MATTERS)
    if not len(few) or 2 * len(few) >= len(gains):
        factors = tuple(np.exp(gains[1:] - gains[0]).tolist())
        return (
            Fact("force_gains_differ", gains=factors, **misfits),
            Fact("advice_force_gains"),
            None,
        )
    factors = np.exp(gains - np.median(np.delete(gains, few))).tolist()
    levels = tuple(
        (k + 1, files.index((k,)) + 1 if (k,) in files else None, factors[k]) for k in few.tolist()
    )
    return (
        Fact("level_gains", gains=levels, **misfits),
        Fact("advice_level_gains", gains=levels),
        Fact("levels_on_another_scale", levels=tuple(level for level, *_ in levels)),
    )
