"""Simulation of a model: responses and nonlinear normal mode, with notes on their limits."""

import dataclasses
import logging
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from snrmjax.identify.pointwise.snrm import reference_sensor
from snrmjax.model.parameters import checked_names, parameter_values
from snrmjax.model.structures import Structure, equilibria, simulated_structure
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ
from snrmjax.simulate.balance.harmonic_balance import resonant_modes
from snrmjax.simulate.continuation.continuation import CurveStatus
from snrmjax.simulate.continuation.event_equations import FORCE, EventKind
from snrmjax.simulate.continuation.response_curve import (
    Branch,
    ResponseCurve,
    period_doublings,
    without_stable_response,
)
from snrmjax.simulate.continuation.stability import Stability
from snrmjax.simulate.solutions.elements_at_work import Hold, friction_hold, idle_elements
from snrmjax.simulate.solutions.event_curves import EventCurve, follow_event
from snrmjax.simulate.solutions.forced_response import ResponseSettings, forced_response
from snrmjax.simulate.solutions.isolated_responses import isolated_responses
from snrmjax.simulate.solutions.normal_modes import NormalModeBranch, nonlinear_normal_mode
from snrmjax.simulate.solutions.quasi_periodic import (
    QuasiPeriodicBranch,
    check_quasi_periodic,
    quasi_periodic_branch,
)

_log = logging.getLogger(__name__)

_TRUNCATED = 0.02  # fraction of the velocity in truncated harmonics above which a note is given
_KNOWN_DAMPING = 1e-5  # relative 1σ of a damping ratio above which a note is given
_SAME_GAP = 1e-4  # relative frequency difference between a gap in stability and its event
_SAME_EVENT = 1e-6  # relative frequency difference between an event and a curve of events
_SUPERHARMONIC = 0.1  # least velocity of a harmonic that is reported to resonate, over the first
_RESONATES = 0.25  # relative distance of its frequency from that of the mode: resonances shift


class SimulatedResponses(NamedTuple):
    """Forced responses of a model; isolated ones follow the main one of their force."""

    curves: tuple[ResponseCurve, ...]
    sensor: str  # of figures and tables
    notes: tuple[Fact, ...]
    events: tuple[EventCurve, ...] = ()  # followed over a parameter
    quasi_periodic: tuple[QuasiPeriodicBranch, ...] = ()


class SimulatedMode(NamedTuple):
    """The nonlinear normal mode of a model."""

    branch: NormalModeBranch
    sensor: str  # of figures and tables
    notes: tuple[Fact, ...]


def simulate_responses(
    model: Structure,
    forces: Sequence[float],
    from_hz: float,
    to_hz: float,
    *,
    harmonics: int = 9,
    isolated: bool = False,
    subharmonic: Sequence[int] = (),
    follow: Sequence[EventKind] = (),
    parameter: str = FORCE,
    to: float | None = None,
    quasi_periodic: bool = False,
    progress: Callable[[float], None] = lambda force: None,
) -> SimulatedResponses:
    """Responses to harmonic forces, around folds and with unstable parts.

    Arguments: `forces` in N, or multiples of the model's unbalance; highest balanced harmonic
    `harmonics`; `isolated` also searches for curves that are not connected to the main one,
    `subharmonic` for motions that repeat after these numbers of periods of the force;
    `follow` kinds of events that are continued as the `parameter` goes from its value to `to`,
    and back after a turning point (see `follow_event`); `quasi_periodic` continues the motions
    with two frequencies from every Neimark-Sacker point; `progress` is called with each force when
    it starts.
    Raises `ValueError` as `forced_response` and `follow_event` do, where no curve has a point,
    for `follow` without `to` or vice versa, and as `check_quasi_periodic` does.
    """
    if follow and to is None:
        raise InputError("`to` must be given with `follow`: the value that the parameter goes to.")
    if not follow and (to is not None or parameter != FORCE):
        raise InputError("`parameter` and `to` must be given with `follow`, the kinds of events.")
    if quasi_periodic:
        check_quasi_periodic(simulated_structure(model))
    if follow and parameter != FORCE:
        checked_names(model, [parameter], "parameter")
    # Events are located on the response of the sensor of files and figures.
    ends, settings = (from_hz * HERTZ, to_hz * HERTZ), ResponseSettings(harmonic_order=harmonics)
    sensor = _most_moved(model, ends)
    model = dataclasses.replace(model, modes=model.modes.with_first_sensor(sensor))
    hold = friction_hold(model, *ends)
    curves: list[ResponseCurve] = []
    notes = [*_notes_on_equilibria(model), *_notes_on_damping(model, ends)]
    for force in forces:
        progress(force)
        every = forced_response(
            model, [force], *ends, harmonic_order=harmonics, subharmonic=subharmonic
        )
        main = [curve for curve in every if curve.subharmonic == 1]
        notes += _superharmonic_resonances(model, main)
        of_force = [*main]
        if isolated:
            _log.info("searches for isolated responses at %g %s", force, model.modes.force_unit)
            further = isolated_responses(model, force, *ends, known=main, settings=settings)
            of_force += further
            notes.append(
                Fact(
                    "isolated_searched",
                    force=force,
                    n=len(further),
                    n_starts=further.n_starts,
                    n_failed=further.n_failed,
                )
            )
        for order in dict.fromkeys(subharmonic):
            longer = [curve for curve in every if curve.subharmonic == order]
            notes.append(_subharmonics_found(force, model.modes.force_unit, order, longer))
            of_force += longer
        notes += list(dict.fromkeys(n for curve in of_force for n in _notes_on_curve(curve, hold)))
        notes += _notes_on_force(model, of_force, ends, isolated)
        curves += of_force
    if not any(len(curve.frequency) for curve in curves):
        stuck = [str(note) for note in notes if note.kind == "held_by_friction"]
        why = f": {stuck[0]}" if stuck else "; start farther from resonance."
        raise InputError(f"no response was computed in this range{why}")
    estimates = [np.max(c.truncation, initial=0.0) for c in curves if c.truncation is not None]
    fraction = float(max(estimates, default=0.0))
    if fraction > _TRUNCATED:
        notes.append(Fact("harmonics_left_out", harmonics=harmonics, fraction=fraction))
    events: list[EventCurve] = []
    of_period = [curve for curve in curves if curve.subharmonic == 1]
    if to is not None:
        for kind in follow:
            _log.info("follows the events %s over %s", kind, parameter)
            followed = _followed(model, of_period, kind, parameter, to)
            notes += [] if followed else [Fact("no_event_to_follow", event=kind)]
            events += followed
    tori: list[QuasiPeriodicBranch] = []
    if quasi_periodic:
        tori, torus_notes = _tori(model, of_period, ends)
        notes += torus_notes
    return SimulatedResponses(tuple(curves), sensor, tuple(notes), tuple(events), tuple(tori))


def _tori(
    model: Structure, curves: Sequence[ResponseCurve], ends: tuple[float, float]
) -> tuple[list[QuasiPeriodicBranch], list[Fact]]:
    """Quasi-periodic branches from every Neimark-Sacker point, each once, and notes on failures."""
    branches: list[QuasiPeriodicBranch] = []
    notes: list[Fact] = []
    starts = [(curve, k) for curve in curves for k in curve.at_events("neimark_sacker")]
    _log.info("follows quasi-periodic motions from %d Neimark-Sacker points", len(starts))
    for curve, k in starts:
        frequency = float(curve.frequency[k])
        if any(b.force == curve.force and b.ends_at(frequency) for b in branches):
            continue
        where = {"force": curve.force, "frequency_hz": frequency / HERTZ}
        try:
            branch = quasi_periodic_branch(model, curve, int(k), within=ends)
        except InputError as error:  # of this point alone
            notes.append(Fact("torus_not_followed", **where, why=str(error)))
            continue
        if len(branch.frequency) < 2:
            why = f"the branch ended {branch.status.message}."
            notes.append(Fact("torus_not_followed", **where, why=why))
            continue
        branches.append(branch)
    return branches, notes if starts else [Fact("no_event_to_follow", event="Neimark-Sacker point")]


def _followed(
    model: Structure, curves: Sequence[ResponseCurve], kind: EventKind, parameter: str, to: float
) -> list[EventCurve]:
    """The curves through all events of one kind on the responses, each once."""
    event_curves: list[EventCurve] = []
    for curve in curves:
        start = curve.force if parameter == FORCE else parameter_values(model)[parameter]
        for k in curve.at_events(kind):
            motion = curve.point(k)
            known = [c for c in event_curves if parameter == FORCE or c.force[0] == curve.force]
            passed = [frequency for c in known for _, frequency in c.near(start)]
            if np.any(np.abs(np.array(passed) / motion[1] - 1) < _SAME_EVENT):
                continue
            between = (min(start, to), max(start, to))
            event_curves.append(
                follow_event(model, curve.force, motion, kind=kind, parameter=parameter, to=between)
            )
    return event_curves


def simulate_mode(
    model: Structure,
    to_hz: float,
    *,
    harmonics: int = 9,
    tongues: Literal["follow", "skip"] = "follow",
) -> SimulatedMode:
    """The undamped nonlinear normal mode of interest, from its linear frequency to `to_hz`.

    Raises `ValueError` as `nonlinear_normal_mode` does.
    """
    linear = model.modes.natural_frequency.item(model.modes.mode_of_interest) / HERTZ
    if np.isclose(to_hz, linear, rtol=1e-12):
        raise InputError(f"`--to-hz` must differ from the linear frequency, {linear:g} Hz.")
    branch = nonlinear_normal_mode(model, to_hz * HERTZ, harmonic_order=harmonics, tongues=tongues)
    notes = [
        *_notes_on_equilibria(model),
        *(
            Fact(
                "internal_resonance",
                harmonic=tongue.harmonic,
                mode=tongue.mode + 1,
                from_hz=tongue.from_frequency / HERTZ,
                to_hz=tongue.to_frequency / HERTZ,
                fraction=tongue.energy_fraction,
            )
            for tongue in branch.tongues
        ),
        *_notes_on_instability(branch),
    ]
    if branch.status != (CurveStatus.UPPER_END if to_hz > linear else CurveStatus.LOWER_END):
        ends_hz = float(branch.frequency[-1]) / HERTZ
        notes.append(Fact("mode_not_followed", to_hz=to_hz, ends_hz=ends_hz, status=branch.status))
    sensor = model.modes.sensors[reference_sensor(model.modes)]
    return SimulatedMode(branch, sensor, tuple(notes))


def _notes_on_instability(branch: NormalModeBranch) -> Iterator[Fact]:
    """Stretches of a normal mode on which it is unstable."""
    unstable = np.pad(branch.stability == int(Stability.UNSTABLE), 1).astype(int)
    edges = np.flatnonzero(np.diff(unstable))
    for first, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        hertz = branch.frequency[first:stop] / HERTZ
        ends = {"from_hz": float(hertz.min()), "to_hz": float(hertz.max())}
        yield Fact("mode_unstable", n=stop - first, **ends)


def _most_moved(model: Structure, ends: tuple[float, float]) -> str:
    """The sensor with the largest shape of the mode of interest, or of one resonant in a range."""
    modes = model.modes
    (leading, *_) = [*resonant_modes(model, ends), modes.mode_of_interest]
    return modes.sensors[reference_sensor(dataclasses.replace(modes, mode_of_interest=leading))]


def _notes_on_force(
    model: Structure, curves: Sequence[ResponseCurve], ends: tuple[float, float], isolated: bool
) -> Iterator[Fact]:
    """Ranges without a known stable response to one force, and idle elements."""
    shown = [c for c in curves if len(c.frequency) and c.subharmonic == 1]
    searched, unit = any(c.subharmonic == 2 for c in curves), model.modes.force_unit
    if not shown:
        return
    at = {"force": curves[0].force, "unit": unit}
    for first, last in without_stable_response(shown, *ends):
        hertz = {"from_hz": first / HERTZ, "to_hz": last / HERTZ}
        doublings = tuple(
            event / HERTZ
            for event in period_doublings(shown)
            if min(abs(event / first - 1), abs(event / last - 1)) < _SAME_GAP
        )
        yield Fact(
            "no_stable_response",
            **(at | hertz),
            isolated=isolated,
            wells=sum(bool(state.stable) for state in equilibria(model)),
            doublings_hz=() if searched else doublings,
        )
    for idle in idle_elements(model, shown):
        yield Fact("element_idle", **at, **idle._asdict())


def _notes_on_curve(curve: ResponseCurve, hold: Hold | None) -> Iterator[Fact]:
    at: dict[str, Any] = {"force": curve.force, "unit": curve.force_unit}
    if hold is not None and curve.status == CurveStatus.NO_START:
        yield Fact("held_by_friction", **at, **hold._asdict())
    elif curve.branch == Branch.MAIN and curve.status != CurveStatus.UPPER_END:
        yield Fact("curve_ended", **at, status=curve.status)
    if curve.not_located:
        yield Fact("curve_events_not_located", **at, kinds=curve.not_located)
    unknown = int(np.sum(curve.stability == int(Stability.NOT_COMPUTED)))
    if unknown:
        yield Fact("stability_not_computed", **at, n=unknown)


def _subharmonics_found(
    force: float, unit: str, order: int, curves: Sequence[ResponseCurve]
) -> Fact:
    """The ranges of frequency of subharmonic branches, and whether any part of each is stable."""
    branches = tuple(
        (
            *(float(edge(c.frequency)) / HERTZ for edge in (np.min, np.max)),
            bool(np.any(c.is_stable)),
        )
        for c in curves
    )
    return Fact("subharmonic_searched", force=force, unit=unit, order=order, branches=branches)


def _superharmonic_resonances(model: Structure, curves: Sequence[ResponseCurve]) -> Iterator[Fact]:
    """Harmonics of the responses to one force that resonate with a mode, where they are highest.

    The mode has the largest part of the harmonic at the first sensor, and a natural frequency
    within a quarter of the harmonic's.
    """
    shape, natural = model.modes.mode_shape[0], np.asarray(model.modes.natural_frequency)
    highest: dict[tuple[int, int], tuple[float, float, float]] = {}
    for curve in curves:
        speed = np.abs(curve.velocity[:, :, 0])
        for h in range(2, speed.shape[1]):
            rises = np.diff(speed[:, h]) > 0
            peaks = 1 + np.flatnonzero(rises[:-1] & ~rises[1:])
            parts = np.hypot(*np.moveaxis(curve.coefficients[peaks, 2 * h - 1 : 2 * h + 1], 1, 0))
            modes = np.argmax(parts * np.abs(shape), axis=1)
            for k, mode in zip(peaks.tolist(), modes.tolist(), strict=True):
                ratio, frequency = speed[k, h] / speed[k, 1], curve.frequency[k]
                near = abs(h * frequency / natural[mode] - 1) < _RESONATES
                if near and ratio > _SUPERHARMONIC:
                    here = float(speed[k, h]), float(frequency), float(ratio)
                    highest[h, mode] = max(here, highest.get((h, mode), here))
    for (h, mode), (_, frequency, ratio) in highest.items():
        at = {"force": curves[0].force, "unit": curves[0].force_unit, "mode": mode + 1}
        where = {"harmonic": h, "frequency_hz": frequency / HERTZ, "ratio": ratio}
        yield Fact("superharmonic_resonance", **at, **where)


def _notes_on_damping(model: Structure, ends: tuple[float, float]) -> Iterator[Fact]:
    """Modes in a range with uncertain damping."""
    modes = model.modes
    for k in range(modes.n_modes):
        std, ratio = modes.damping_ratio_std.item(k), modes.damping_ratio.item(k)
        inside = ends[0] <= modes.natural_frequency.item(k) <= ends[1]
        if inside and std > _KNOWN_DAMPING * ratio and not np.any(modes.natural_frequency_std):
            yield Fact("damping_not_known", mode=k + 1, relative_std=std / ratio if ratio else 1.0)


def _notes_on_equilibria(model: Structure) -> tuple[Fact, ...]:
    """Note on equilibria other than the one of the smallest displacement."""
    states = equilibria(model)
    if len(states) < 2:
        return ()
    shape = np.asarray(model.modes.mode_shape)
    rest, *others = (float((shape @ one.displacement)[0]) for one in states)  # m
    stable = tuple(bool(other.stable) for other in states[1:])
    at = {"sensor": model.modes.sensors[0], "rest": rest}
    return (Fact("further_equilibria", **at, displacement=tuple(others), stable=stable),)
