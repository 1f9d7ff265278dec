"""The measurement that a diagnosis asks for, of the same structure, beside the states it has.

The states of a set keep their errors. Harmonics are those that the same states had; further states
come from a new sweep after the test, as a level of its own with its own gain and phase error and
new noise. A request of harmonics states the noise that they need: they get that, or the noise of
the set's instruments if it is less.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from plans import Case
from records import table
from sweep import run_sweeps
from truth import Truth, assembled, lane_table, system_of

SERVED = ("harmonics", "off_resonance", "lower_level", "higher_level")
"""Kinds of requests that can be answered."""


def answered(
    case: Case, truth: Truth, request: Mapping, steps: int | None = None
) -> tuple[dict[str, np.ndarray], Truth]:
    """The table with what was asked for, and the truth of all its states."""
    if request["kind"] not in SERVED:
        raise ValueError(f"a request of the kind {request['kind']!r} cannot be answered.")
    if request["kind"] == "harmonics":
        return _with_harmonics(case, truth, request), truth
    return _with_states(case, truth, request, steps)


def _as_asked(case: Case, request: Mapping) -> Case:
    """The case with harmonics and their noise as a request wants them."""
    if not request["harmonics"]:
        return case
    speed = 2 * np.pi * case.natural_frequency_hz * case.displacement * case.shape
    floor = min(case.errors.harmonic, request["harmonic_std_m_s"] / speed)
    errors = replace(case.errors, harmonic=floor)
    return replace(case, plan=replace(case.plan, harmonics=True), errors=errors)


def _with_harmonics(case: Case, truth: Truth, request: Mapping) -> dict[str, np.ndarray]:
    before, after = table(case, truth), table(_as_asked(case, request), truth)
    asked = before["level"] == request["level"]
    columns = {}
    for name, values in after.items():
        columns[name] = values
        if "_h" in name or name == "harmonic_std_m_s":
            columns[name] = np.where(asked, values, before.get(name, np.full(len(values), np.nan)))
    return columns


def _with_states(
    case: Case, truth: Truth, request: Mapping, steps: int | None
) -> tuple[dict[str, np.ndarray], Truth]:
    omega, peaks = 2 * np.pi * case.natural_frequency_hz, case.base.peaks
    unit = omega**2 * case.displacement / case.participation * 2 * case.base.damping
    off = request["kind"] == "off_resonance"
    peak = peaks[request["level"] - 1] if off else request["force_n"] / unit
    low, high = request["phase_deg"]
    sides = np.linspace(low, high, request["states"] // 2)
    more = replace(
        _as_asked(case, request),
        base=replace(case.base, peaks=(*peaks, peak)),
        sequence=(len(peaks),),
        step_deg=case.step_deg[:2],
        begin=1.0,
        sweeps=2 * len(case.sequence),
        noise_seed=np.random.SeedSequence([*case.seed, 11]),
    )
    system = system_of(more)
    sweeps = run_sweeps(
        system if steps is None else system._replace(steps=steps), lane_table([more])
    )
    added = assembled(more, sweeps, [*-sides, *sides])
    whole = _joined(truth, added)
    columns, own = table(case, truth), table(more, added)
    if case.with_order:
        columns["order"], own["order"] = np.split(whole.order, [len(truth.order)])
    empty = {name: np.full(len(truth.level), np.nan) for name in own if name not in columns}
    nothing = np.full(len(added.level), np.nan)
    both = {**columns, **empty}
    return {n: np.concatenate([v, own.get(n, nothing)]) for n, v in both.items()}, whole


def _joined(truth: Truth, added: Truth) -> Truth:
    """One truth of both; the order counts from the first state to the last of all."""
    parts = [part.first_clock + part.span * part.order for part in (truth, added)]
    clock = np.concatenate(parts)
    span = float(clock[-1] - clock[0])
    return Truth(
        level=np.concatenate([truth.level, added.level]),
        frequency=np.concatenate([truth.frequency, added.frequency]),
        force=np.concatenate([truth.force, added.force]),
        velocity=np.concatenate([truth.velocity, added.velocity], axis=1),
        order=(clock - clock[0]) / span,
        first_clock=truth.first_clock,
        span=span,
        jumps=truth.jumps + added.jumps,
        left_out=truth.left_out + added.left_out,
        residual=max(truth.residual, added.residual),
        units=truth.units,
    )
