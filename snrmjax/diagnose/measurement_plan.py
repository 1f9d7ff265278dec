"""The measurement that a diagnosis recommends, as steady states to be measured."""

from typing import NamedTuple

import numpy as np

from snrmjax.diagnose.diagnosis_result import Diagnosis
from snrmjax.diagnose.misfit.programs import COMPARED
from snrmjax.diagnose.verdict import Verdict
from snrmjax.measure.states import PHASE_UNKNOWN, SteadyStates, relative_errors, steady_states


class MeasurementPlan(NamedTuple):
    """Steady states to be measured: prescribed frequencies and forces, expected velocities.

    `states` have new levels, since gain and phase errors belong to a session, and the errors of
    the former test where these were stated.
    """

    states: SteadyStates
    harmonics: tuple[int, ...]  # to be recorded
    harmonic_std: float | None  # m/s, noise of harmonics that the plan requires


def measurement_plan(diagnosis: Diagnosis) -> MeasurementPlan | None:
    """Steady states that would decide an open diagnosis; None where none can.

    The test of `decide_by`, if one was computed. Otherwise, if the answer is open, the largest
    level again with the harmonics that were not recorded or, if they were, a smaller and a larger
    level. None if nothing is open, and where only a calibration decides.
    """
    test, data = diagnosis.discriminating_test, diagnosis.data
    known = tuple(order for order in data.harmonic_order if order in COMPARED)
    if test is not None and test.planned is not None:
        orders = test.harmonics or known
        parts = [(test.planned.frequency, test.planned.force, test.planned.velocity)]
        return MeasurementPlan(_states(diagnosis, parts), orders, test.harmonic_std)
    is_open = diagnosis.verdict in (Verdict.AMBIGUOUS, Verdict.UNKNOWN)
    if not is_open or diagnosis.decide_by is None or test is not None:
        return None
    level = np.asarray(data.level)
    speed = np.abs(np.asarray(data.velocity)[:, diagnosis.force_misfit.sensor])
    levels = sorted(set(level.tolist()), key=lambda number: speed[level == number].max())
    if set(known) != set(COMPARED):
        return MeasurementPlan(
            _states(diagnosis, [_of_level(diagnosis, levels[-1])]), COMPARED, None
        )
    parts = [
        _of_level(diagnosis, level, scale)
        for level, scale in zip((levels[0], levels[-1]), (0.5, 1.5), strict=True)
    ]
    return MeasurementPlan(_states(diagnosis, parts), known, None)


_Part = tuple[np.ndarray, np.ndarray, np.ndarray]  # frequency, force, velocity


def _of_level(diagnosis: Diagnosis, number: int, scale: float = 1.0) -> _Part:
    """Up to 24 states of a level by increasing frequency, with force and velocity scaled."""
    data, sensor = diagnosis.data, diagnosis.force_misfit.sensor
    rows = np.flatnonzero(np.asarray(data.level) == number)
    rows = rows[np.argsort(np.asarray(data.frequency)[rows], kind="stable")]
    rows = rows[:: -(-len(rows) // 24)]
    speed = np.abs(np.asarray(data.velocity)[rows, sensor])
    return np.asarray(data.frequency)[rows], scale * np.asarray(data.force)[rows], scale * speed


def _states(diagnosis: Diagnosis, parts: list[_Part]) -> SteadyStates:
    """Planned states, each part a level of its own, with the errors of the former test."""
    data, sensor = diagnosis.data, diagnosis.force_misfit.sensor
    frequency, force, speed = (np.concatenate(column) for column in zip(*parts, strict=True))
    first = int(np.asarray(data.level).max()) + 1
    level = np.concatenate([np.full(len(part[0]), first + k) for k, part in enumerate(parts)])
    seen = np.asarray(data.measured)
    errors = np.asarray(relative_errors(data))[seen[:, sensor], sensor]
    stated_errors = (column[np.isfinite(column)] for column in errors.T)
    force_std, velocity_std, phase_std = (
        float(np.median(some)) if some.size else np.nan for some in stated_errors
    )
    n, wide = len(frequency), (len(frequency), len(data.sensors))
    alone = np.broadcast_to(seen.any(axis=0), wide)
    velocity = np.where(np.arange(wide[1]) == sensor, speed[:, None], 0.0)
    stated = np.isfinite(np.asarray(data.order)).any()
    volts = np.asarray(data.drive) / np.asarray(data.force)
    return steady_states(
        level,
        frequency,
        force,
        velocity,
        sensors=data.sensors,
        measured=alone,
        velocity_std=np.where(velocity > 0, velocity_std * velocity, np.nan),
        phase_std=np.where(alone & (phase_std < PHASE_UNKNOWN), phase_std, np.nan),
        force_std=force_std * force,
        drive=np.median(volts) * force if np.isfinite(volts).all() else None,
        order=np.ones(n) if stated else None,
        base=data.base,
    )
