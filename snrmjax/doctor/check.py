"""The import doctor: looks at tables, model and time records before anything is identified."""

from collections.abc import Sequence

import numpy as np

from snrmjax.doctor.corrections import TestCorrection, corrections
from snrmjax.doctor.findings import Checkup, Finding, gravest_first, percent, rows_in_words
from snrmjax.doctor.force_checks import deepest_fall, dropout_findings, harmonic_findings
from snrmjax.doctor.judgement import (
    CheckedStates,
    Judged,
    checked_states,
    files_of_levels,
    leading_sensor,
    usable_rows,
)
from snrmjax.doctor.priors import FEWEST_STATES, FITS_WELL, GAIN_MATTERS, MOVED_MATTERS, NO_MODE
from snrmjax.doctor.readings import OPPOSITE, best_reading, misread
from snrmjax.doctor.record_checks import record_findings
from snrmjax.doctor.scale_findings import is_other_scale, scale_findings, shaker_damping
from snrmjax.identify.test_model.states import TestStates
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.measure.states import SteadyStates, join_steady_states
from snrmjax.model.structures import Structure


def check_test(
    tables: SteadyStates | Sequence[SteadyStates],
    model: Structure | None = None,
    recordings: Sequence[TimeRecording] = (),
) -> Checkup:
    """Find errors of import and of the test in tables and records, before identification.

    Near resonance a single mode obeys iΩAF/V = κ(K(a) − Ω² + iΩδ(a)) with smooth curves of the
    displacement amplitude, whatever they are. Each thing that the columns may be taken for, or that
    may have gone wrong with the test, is undone and judged by the same posterior as the table as it
    is (`identify.test_model`): it is named only where one mode fits then, and clearly not as
    recorded. Records are looked at step by step: limits, transients, harmonics, folded frequencies.

    Arguments: `tables` of one structure, each a test of its own (in the order of time); `model` as
    for identification, without which scales and the model's frequency are not looked at;
    `recordings` of the same test.
    Returns `Checkup`: `.findings`, each with kind, severity ("error", "warning", "info"), where,
    evidence and what mends it; none where all is well; `.notes` on what could not be looked at.
    Raises `ValueError` for nothing to look at and for tables of different sensors.
    Validity: one well-separated mode and tests near its resonance; at least eight states. A
    factor of the force and the same one of the modal mass look alike in one table: both are named
    then.

    >>> from snrmjax.measure import steady_states
    >>> w = np.linspace(480.0, 520.0, 30)
    >>> v = 1j * w / (500.0**2 - w**2 + 10j * w)
    >>> check_test(steady_states(np.ones(30), w, np.ones(30), v.conj())).kinds
    ('conjugated_response',)
    """
    given = [tables] if isinstance(tables, SteadyStates) else list(tables)
    if not given and not recordings:
        raise ValueError("there is nothing to check: give a table or a recording.")
    found: list[Finding] = []
    notes: list[str] = []
    if given:
        parts, groups = files_of_levels(given)
        data = parts[0] if len(parts) == 1 else join_steady_states(parts)
        found += _of_table(data, model, groups if len(parts) > 1 else (), notes)
    else:
        notes.append("no table of steady states: columns and scales were not looked at.")
    if given and model is None:
        notes.append("no model: the scale of force, response and shape was not looked at.")
    for one in recordings:
        own, said = record_findings(one)
        found += own
        notes += said
    return Checkup(gravest_first(_once(found)), tuple(dict.fromkeys(notes)))


def _of_table(
    data: SteadyStates,
    model: Structure | None,
    groups: tuple[tuple[int, ...], ...],
    notes: list[str],
) -> list[Finding]:
    sensor = leading_sensor(data)
    rows = usable_rows(data, sensor)
    name = data.sensors[sensor]
    n_levels = len(given_levels(data))
    where = f"{n_levels} level{'s' if n_levels != 1 else ''} at {name}"
    if rows.sum() < FEWEST_STATES:
        notes.append(
            f"{int(rows.sum())} states with force and phase at {name} are too few to look at: "
            f"{FEWEST_STATES} are needed."
        )
        return []
    drive = bool(np.all(np.isnan(np.asarray(data.force)[rows])))
    if drive:
        notes.append("the force is declared as a drive voltage: its scale was not looked at.")
    seen = checked_states(data, model, sensor, rows, groups)
    found, fit = mode_findings(seen, model, where, drive)
    found += dropout_findings(seen, where)
    if data.harmonic_order and not any(one.severity == "error" for one in found):
        found += harmonic_findings(data, seen, fit, model, sensor, where)
    return found


def given_levels(data: SteadyStates) -> tuple[int, ...]:
    """Numbers of the levels of a table."""
    return tuple(int(k) for k in np.unique(np.asarray(data.level)))


def _once(found: Sequence[Finding]) -> list[Finding]:
    """One finding of each kind and place."""
    return list({(one.kind, one.where): one for one in reversed(found)}.values())[::-1]


def mode_findings(
    seen: CheckedStates, model: Structure | None, where: str, drive: bool
) -> tuple[list[Finding], Judged]:
    """Findings of one sensor's states, and how they fit with those undone.

    `drive` says that forces are declared to be volts: then their scale and phase say nothing.
    """
    scaled = model is not None and not drive  # whether the modal mass is known
    recorded, best = best_reading(seen, scaled)
    found: list[Finding] = []
    # Without a model nobody said which way the sensor moves for a force.
    unsigned = model is None and best.meaning is OPPOSITE
    if best is not recorded and not drive and not unsigned:
        found.append(misread(recorded.judged, best, where))
        if best.meaning.kind == "degrees_for_radians":
            return found, best.judged
    base, scale, first = best.as_modelled or best.judged, best.scale, None
    if model is not None and scaled and scale is not None and is_other_scale(scale, base):
        # Something is wrong; what bends a test may pass for another modal mass.
        first = _likeliest(seen, base)
        if first is None or not first.judged.is_likelier(scale.judged):
            found += scale_findings(scale, base, model, where)
            base, first = scale.judged, None
    if first is None:
        first = _likeliest(seen, base)
        first = first if first is not None and _told(first, base) else None
    plain = all(one.kind in ("rms_for_peak", "shape_not_mass_normalised") for one in found)
    if first is not None:
        found.append(_mended(seen, base, first, where))
        base = first.judged
    if model is not None and not drive and plain:
        found += shaker_damping(base, model, where)
    return found, base


def _likeliest(seen: CheckedStates, base: Judged) -> TestCorrection | None:
    """The likeliest correction that matters."""
    if base.misfit > NO_MODE:
        return None
    mattering = (
        one
        for one in corrections(seen, base.states, base)
        if _matters(one, base) and one.judged.leaves_less(base)
    )
    return max(mattering, key=lambda one: one.judged.evidence, default=None)


def _told(one: TestCorrection, base: Judged) -> bool:
    """Whether a correction beats the table as it is read."""
    if one.kind == "force_dropout":  # the noise of a cell is no misfit
        return one.judged.noise < FITS_WELL and one.judged.explains(base)
    return one.judged.beats(base)


def _matters(one: TestCorrection, base: Judged) -> bool:
    """Whether a correction is large enough to be spoken of."""
    if one.kind in ("drift", "different_structures"):
        width = float(np.median(one.judged.damping / base.states.frequency))
        return abs(one.value) > MOVED_MATTERS * width
    if one.kind == "volts_as_force":
        return float(np.ptp(one.gains)) > GAIN_MATTERS
    # A force that lies within the noise of its cell is none.
    return one.kind != "force_dropout" or one.value < base.states.force.min()


def _mended(seen: CheckedStates, base: Judged, one: TestCorrection, where: str) -> Finding:
    states = base.states
    left = (
        f"; so read a state is missed by {percent(one.judged.misfit)}, not {percent(base.misfit)}."
    )
    if one.kind == "drift":
        return Finding(
            *("drift", "warning", where),
            f"from the first to the last state the natural frequency changes by "
            f"{100 * one.value:.3g} %{left}",
            "repeat a level at the end of the test, let the temperature settle, or correct along "
            "`order`.",
        )
    if one.kind == "different_structures":
        return Finding(
            *("different_structures", "error", where),
            f"at equal amplitude the natural frequency of {one.name} is {100 * one.value:.3g} % "
            f"from {'file 1' if len(seen.files) == 2 else 'the others'}'s{left}",
            "identify them apart: one call and one model for each structure or assembly.",
        )
    if one.kind == "volts_as_force":
        return _of_gains(one, where, left, seen.files)
    if one.kind == "force_dropout":
        return Finding(
            *("force_dropout", "warning", where),
            f"at resonance the force falls by {percent(deepest_fall(states))} into the noise of "
            f"its cell, about {one.value:.2g} N, {percent(one.value / states.force.min())} of the "
            "smallest.",
            "drive harder at resonance, average longer or use a more sensitive cell.",
        )
    if one.kind == "unsettled_steps":
        return Finding(
            *("unsettled_steps", "error", where),
            f"about {percent(one.value)} of a change is left at the end of a step{left}",
            "dwell longer, 5/(ζω) a step; or import the time record, whose unsettled steps are "
            "left out.",
        )
    return _clipping(seen, states, one, where, left)


def _of_gains(
    one: TestCorrection, where: str, left: str, files: tuple[tuple[int, ...], ...]
) -> Finding:
    """Forces whose scale is not the same at all levels; by name where a few of them are off."""
    gains = np.array(one.gains)
    away = np.abs(gains - np.median(gains))
    few = np.flatnonzero(away > 0.5 * GAIN_MATTERS)
    if not len(few) or 2 * len(few) >= len(gains):
        listed = ", ".join(f"{factor:.3g}" for factor in np.exp(gains[1:] - gains[0]))
        return Finding(
            *("volts_as_force", "error", where),
            f"the force over that of the first level is off by the factors {listed} at levels 2 "
            f"and on{left}",
            "measure the force, or calibrate the drive at each level.",
        )
    factors = np.exp(gains - np.median(np.delete(gains, few)))
    names = [
        f"level {k + 1}" + (f" (file {files.index((k,)) + 1})" if (k,) in files else "")
        for k in few
    ]
    said = [
        f"the force of {name} is {factors[k]:.3g} times" for name, k in zip(names, few, strict=True)
    ]
    numbers = [f"level {k + 1} by {factors[k]:.3g}" for k in few]
    return Finding(
        *("volts_as_force", "error", where),
        f"{' and '.join(said)} what the other levels ask for{left}",
        "if the column is a voltage, measure the force; else another range or calibration was set "
        f"there: divide the force of {' and of '.join(numbers)} in the file that it comes from.",
        title=f"force on another scale at level {' and '.join(str(k + 1) for k in few)}",
    )


def _clipping(
    seen: CheckedStates, states: TestStates, one: TestCorrection, where: str, left: str
) -> Finding:
    force = one.name == "force"
    size = states.force if force else np.abs(states.velocity)
    rows = tuple(int(seen.row[k]) for k in np.flatnonzero(size > one.value * 0.999))
    return Finding(
        *("clipped_channel", "error", where),
        f"the {'force' if force else 'response'} is cut off at about {one.value:.4g} "
        f"{'N' if force else 'm/s'} in {len(rows)} states ({rows_in_words(rows)}){left}",
        "lower the channel's gain or range and measure these states again; leave them out until "
        "then.",
        rows,
    )
