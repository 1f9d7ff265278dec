"""Results as tables and summaries, as the commands write them."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from snrmjax.identify.pointwise.inversion import PointStatus
from snrmjax.io.files import FilePath
from snrmjax.io.tables import write_table
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ
from snrmjax.simulate.balance.labelled import velocity_peaks
from snrmjax.simulate.continuation.response_curve import (
    ResponseCurve,
    velocity_at_sensors,
)
from snrmjax.simulate.continuation.stability import Stability
from snrmjax.simulate.solutions.event_curves import EventCurve
from snrmjax.simulate.solutions.normal_modes import NormalModeBranch
from snrmjax.simulate.solutions.quasi_periodic import QuasiPeriodicBranch

if TYPE_CHECKING:  # keeps a simulation from importing the identification
    from snrmjax.identify.inference.fitted_response import FittedResponse
    from snrmjax.identify.inference.identification import Identification
    from snrmjax.identify.pointwise.backbone import BackboneValues
    from snrmjax.identify.pointwise.prediction import Resonance
    from snrmjax.identify.prediction.resonance_distribution import ResonanceDistribution

BACKBONE_POINTS = 200
# Fixed interface: the columns of backbone.csv and points.csv, in order.
_CURVES = (
    *("natural_frequency_hz", "natural_frequency_std_hz", "damping_ratio", "damping_ratio_std"),
)
_VALUES = ("velocity_m_s", *_CURVES)
_POINTS = (
    *("level", "frequency_hz", "force_n", "velocity_m_s", "phase_deg", "nnmai", *_CURVES),
    *("backbone_velocity_m_s", "status"),
)


def write_response(
    path: FilePath, curves: Sequence[ResponseCurve], *, sensor: str | None = None
) -> None:
    """Write simulated responses: frequency, velocity at one sensor, stability and events.

    `stable` is 1 where a motion is known to be stable and else 0; where stability was not
    computed, `event` contains "stability_not_computed". On branches of motions that repeat after
    three periods of the force it contains "subharmonic_3", and the fundamental is that of a third
    of the frequency. Several sensors have further columns of their fundamentals. For base
    excitation the velocities are those recorded by the sensors, and `base_acceleration_m_s2`
    replaces `force_n`.

    Arguments: `sensor` is the name of one, by default the first.
    Raises `ValueError` when there is no such sensor or the file cannot be written.
    """
    r = _sensor_index(curves[0].sensors, sensor) if curves else 0
    force = np.concatenate([np.full(len(c.frequency), c.force) for c in curves])
    recorded = [velocity_at_sensors(c, c.force) for c in curves]
    first = np.concatenate([v[:, 1, r] for v in recorded])
    named = {}
    if curves and len(curves[0].sensors) > 1:
        for index, name in enumerate(curves[0].sensors):
            fundamental = np.concatenate([v[:, 1, index] for v in recorded])
            named[f"velocity_h1_{name}_re_m_s"] = fundamental.real
            named[f"velocity_h1_{name}_im_m_s"] = fundamental.imag
    columns = {
        "force_n": force,
        "point": _numbered(force),
        "frequency_hz": np.concatenate([c.frequency for c in curves]) / HERTZ,
        "velocity_h1_re_m_s": first.real,
        "velocity_h1_im_m_s": first.imag,
        "velocity_peak_m_s": np.concatenate([velocity_peaks(v[:, :, r]) for v in recorded]),
        "stable": np.concatenate([c.is_stable for c in curves]),
        "event": [event for c in curves for event in _events(c)],
        **named,
    }
    driven = (curves[0].force_unit, curves[0].unbalance) if curves else ("N",)
    write_table(path, load_named(columns, *driven))


def write_event_curves(
    path: FilePath, curves: Sequence[EventCurve], *, sensor: str | None = None
) -> None:
    """Write events followed over a parameter: its values, frequency and velocity at one sensor.

    Arguments: `sensor` is the name of one, by default the first.
    Raises `ValueError` without a curve, when there is no such sensor or the file cannot be written.
    """
    if not curves:
        raise InputError("there is no curve of events to write.")
    r = _sensor_index(curves[0].sensors, sensor)
    n_points = [len(c.frequency) for c in curves]
    velocity = np.concatenate([velocity_at_sensors(c, c.force)[:, :, r] for c in curves])
    fundamental = velocity[:, 1]
    columns = {
        "curve": np.repeat(np.arange(len(curves)), n_points),
        "kind": [c.kind for c, n in zip(curves, n_points, strict=True) for _ in range(n)],
        "parameter": [c.parameter for c, n in zip(curves, n_points, strict=True) for _ in range(n)],
        "value": np.concatenate([c.value for c in curves]),
        "force_n": np.concatenate([c.force for c in curves]),
        "frequency_hz": np.concatenate([c.frequency for c in curves]) / HERTZ,
        "velocity_h1_re_m_s": fundamental.real,
        "velocity_h1_im_m_s": fundamental.imag,
        "velocity_peak_m_s": velocity_peaks(velocity),
        "event": [event for c in curves for event in c.event],
    }
    write_table(path, load_named(columns, curves[0].force_unit, curves[0].unbalance))


def write_quasi_periodic(
    path: FilePath, branches: Sequence[QuasiPeriodicBranch], *, sensor: str | None = None
) -> None:
    """Write branches of quasi-periodic motions: both frequencies, velocity at one sensor.

    The amplitude of the fundamental varies between `velocity_h1_least_m_s` and
    `velocity_h1_largest_m_s` with the period `slow_period_s`.

    Arguments: `sensor` is the name of one, by default the first.
    Raises `ValueError` without a branch, when there is no such sensor or the file cannot be
    written.
    """
    if not branches:
        raise InputError("there is no branch of quasi-periodic motions to write.")
    r = _sensor_index(branches[0].sensors, sensor)

    def joined(values: str) -> np.ndarray:
        return np.concatenate([getattr(b, values) for b in branches])

    n_points, velocity = [len(b.frequency) for b in branches], joined("velocity")[:, r]
    columns = {
        "branch": np.repeat(np.arange(len(branches)), n_points),
        "force_n": np.repeat([b.force for b in branches], n_points),
        "frequency_hz": joined("frequency") / HERTZ,
        "slow_frequency_hz": joined("slow_frequency") / HERTZ,
        "slow_period_s": joined("slow_period"),
        "velocity_h1_re_m_s": velocity.real,
        "velocity_h1_im_m_s": velocity.imag,
        "velocity_h1_least_m_s": joined("least_amplitude")[:, r],
        "velocity_h1_largest_m_s": joined("largest_amplitude")[:, r],
        "velocity_peak_m_s": joined("largest_velocity")[:, r],
        "modulation": joined("modulation"),
    }
    write_table(path, load_named(columns, branches[0].force_unit, branches[0].unbalance))


def _events(curve: ResponseCurve) -> list[str]:
    """Events at every point, including unknown stability and the period of subharmonics."""
    unknown = curve.stability == int(Stability.NOT_COMPUTED)
    period = "" if curve.subharmonic == 1 else f"subharmonic_{curve.subharmonic}"
    return [
        "+".join(filter(None, [event, period, "stability_not_computed" if missing else ""]))
        for event, missing in zip(curve.event, unknown.tolist(), strict=True)
    ]


def write_normal_mode(
    path: FilePath, branch: NormalModeBranch, *, sensor: str | None = None
) -> None:
    """Write a nonlinear normal mode: frequency, velocity at one sensor, energy, and its shape.

    `stable` is 1 or 0, and empty where not computed; `internal_resonance` names the tongue of a
    point. Several modes have columns of their fractions of the mean kinetic energy, several sensors
    of their fundamentals, signed relative to the first one.

    Arguments: `sensor` is the name of one, by default the first.
    Raises `ValueError` when there is no such sensor or the file cannot be written.
    """
    r = _sensor_index(branch.sensors, sensor)
    known = branch.stability != int(Stability.NOT_COMPUTED)
    columns: dict[str, Any] = {
        "point": np.arange(len(branch.frequency)),
        "frequency_hz": branch.frequency / HERTZ,
        "velocity_h1_m_s": np.abs(branch.velocity[:, 1, r]),
        "velocity_peak_m_s": velocity_peaks(branch.velocity[:, :, r]),
        "energy_j": branch.energy,
        "stable": [
            str(value) if is_known else ""
            for value, is_known in zip(branch.stability.tolist(), known.tolist(), strict=True)
        ],
        "internal_resonance": list(branch.resonance),
    }
    n_modes = branch.mode_fraction.shape[1]
    if n_modes > 1:
        columns |= {
            f"energy_share_mode_{k + 1}": branch.mode_fraction[:, k] for k in range(n_modes)
        }
    if len(branch.sensors) > 1:
        shape = branch.shape()
        columns |= {
            f"velocity_h1_{name}_m_s": shape[:, index] for index, name in enumerate(branch.sensors)
        }
    write_table(path, columns)


def load_named(
    columns: Mapping[str, Any], unit: str, unbalance: float | None = None
) -> dict[str, Any]:
    """Columns, or entries of a summary, with the excitation named by its kind.

    Arguments: `unit` of the excitation: for m/s² (base excitation) `force_n` is renamed to
    `base_acceleration_m_s2`. With `unbalance` U (kg m) the forces are multiples of U Ω²: `force_n`
    is then the force at each frequency, and `unbalance_kg_m` the unbalance.
    """
    if unbalance is not None:
        kg_m = unbalance * columns["force_n"]
        force = kg_m * (HERTZ * columns["frequency_hz"]) ** 2
        return {**columns, "force_n": force, "unbalance_kg_m": kg_m}
    name = "force_n" if unit == "N" else "base_acceleration_m_s2"
    return {name if key == "force_n" else key: value for key, value in columns.items()}


def write_points(
    path: FilePath,
    identification: "Identification",
    *,
    added: tuple[str, int] | None = None,
    force_unit: str = "N",
) -> None:
    """Write the identified points, one row a steady state.

    Arguments: `added` as for `write_values`; `force_unit` as for `load_named`.
    """
    variables = identification.points.variables()
    columns = load_named({name: variables[name].values for name in _POINTS}, force_unit)
    write_table(path, _with_amplitude(columns, "backbone_velocity_m_s", added))


def write_backbone(
    path: FilePath, identification: "Identification", *, added: tuple[str, int] | None = None
) -> None:
    """Write the backbone with its 1σ between the smallest and the largest point used.

    Arguments: `added` as for `write_values`.
    """
    write_values(path, identification.backbone.sampled(BACKBONE_POINTS), added=added)


def write_values(
    path: FilePath, values: "BackboneValues", *, added: tuple[str, int] | None = None
) -> None:
    """Write natural frequency and damping against velocity, with 1σ.

    Arguments: `added` is one more column with another amplitude of the motion: its name in place of
    "velocity_m_s", and the power of the natural angular frequency that multiplies the velocity.
    """
    variables = values.variables()
    columns = {name: variables[name].values for name in _VALUES}
    write_table(path, _with_amplitude(columns, "velocity_m_s", added))


def _with_amplitude(
    columns: dict[str, np.ndarray], of: str, added: tuple[str, int] | None
) -> dict[str, np.ndarray]:
    if added is None or not added[1]:
        return columns
    name, power = added
    omega = columns["natural_frequency_hz"] * HERTZ
    return columns | {of.replace("velocity_m_s", name): columns[of] * omega**power}


def write_prediction(
    path: FilePath,
    responses: "Sequence[FittedResponse]",
    *,
    drives: Sequence[float | None] = (),
    bands: bool = False,
    force_unit: str = "N",
) -> None:
    """Write predicted responses at the backbone's sensor; isolated parts follow the main curve.

    Arguments: `drives` are the drive voltages of the responses in V, for a force known only as a
    voltage (column `drive_v`); with `bands` 1σ of the velocity amplitude at fixed frequency, for a
    further level (column `velocity_std_m_s`); `force_unit` as for `load_named`.
    Raises `ValueError` when the file cannot be written.
    """
    force = np.concatenate([np.full(len(c.frequency), c.force) for c in responses])
    velocity = np.concatenate([c.velocity for c in responses])
    volts = [d for d, c in zip(drives, responses, strict=False) for _ in c.frequency if d]
    columns = {
        "force_n": force,
        "point": _numbered(force),
        "frequency_hz": np.concatenate([c.frequency for c in responses]) / HERTZ,
        "velocity_re_m_s": velocity.real,
        "velocity_im_m_s": velocity.imag,
        "stable": np.concatenate([c.stable for c in responses]),
    }
    columns = load_named(columns, force_unit) | ({"drive_v": volts} if volts else {})
    if bands:
        columns["velocity_std_m_s"] = np.concatenate([c.velocity_std for c in responses])
    write_table(path, columns)


def write_coupled_prediction(
    path: FilePath, curves: Sequence[ResponseCurve], *, sensor: str
) -> None:
    """Write responses of coupled modes as `write_prediction` writes those of one mode.

    Arguments: `sensor` is the one of the backbone.
    Raises `ValueError` when the file cannot be written.
    """
    force = np.concatenate([np.full(len(c.frequency), c.force) for c in curves])
    velocity = np.concatenate([c.velocity[:, 1, _sensor_index(c.sensors, sensor)] for c in curves])
    columns = {
        "force_n": force,
        "point": _numbered(force),
        "frequency_hz": np.concatenate([c.frequency for c in curves]) / HERTZ,
        "velocity_re_m_s": velocity.real,
        "velocity_im_m_s": velocity.imag,
        "stable": np.concatenate([c.is_stable for c in curves]),
    }
    driven = (curves[0].force_unit, curves[0].unbalance) if curves else ("N",)
    write_table(path, load_named(columns, *driven))


def summarise(identification: "Identification", values: "BackboneValues") -> dict:
    """The headline numbers of an identification, by name, in the units of the files.

    Arguments: `values` of the curves from the smallest to the largest measured amplitude.
    """
    points, noise = identification.points, identification.fit.noise
    frequency = np.asarray(values.natural_frequency) / HERTZ
    damping, velocity = np.asarray(values.damping_ratio), np.asarray(values.velocity)
    status = np.asarray(points.status)
    return {
        "sensor": points.sensor,
        "amplitude": points.argument,
        "points": {
            kind.name.lower(): int(np.sum(status == kind))
            for kind in PointStatus
            if np.any(status == kind)
        },
        "backbone": {
            "velocity_m_s": [float(velocity[0]), float(velocity[-1])],
            "natural_frequency_hz": [float(frequency[0]), float(frequency[-1])],
            "natural_frequency_min_hz": float(frequency.min()),
            "natural_frequency_max_hz": float(frequency.max()),
            "damping_ratio": [float(damping[0]), float(damping[-1])],
            "damping_ratio_min": float(np.min(damping)),
            "damping_ratio_max": float(np.max(damping)),
        },
        "noise": {
            "stated": noise.stated,
            "scale": noise.scale,
            "level_frequency_std_hz": identification.level_frequency_std / HERTZ,
            "level_damping_ratio_std": identification.level_damping_std,
        },
        "notes": [str(note) for note in identification.notes],
    }


def summarise_resonance(resonance: "Resonance") -> dict:
    """A predicted resonance by name, in the units of the files."""
    return {
        "force_n": resonance.force,
        "velocity_m_s": resonance.velocity,
        "frequency_hz": resonance.frequency / HERTZ,
        "damping_ratio": resonance.damping_ratio,
        "beyond_the_data": resonance.continued,
    }


def summarise_distribution(distribution: "ResonanceDistribution") -> dict:
    """Whether a further level has its resonance in a range, and where, in units of the files."""
    from snrmjax.identify.prediction.resonance_distribution import QUANTILES

    return {
        "force_n": distribution.force,
        "largest_amplitude_ratio": distribution.largest_amplitude_ratio,
        "probability": distribution.probability,
        "quantiles": list(QUANTILES),
        "frequency_hz": (distribution.frequency / HERTZ).tolist(),
        "frequency_std_hz": distribution.frequency_std / HERTZ,
        "velocity_m_s": distribution.velocity.tolist(),
        "velocity_std_m_s": distribution.velocity_std,
        "negative_damping": distribution.negative_damping,
        "holds": distribution.holds,
    }


def _sensor_index(sensors: tuple[str, ...], name: str | None) -> int:
    """Index of a sensor; the first without a name."""
    if name is not None and name not in sensors:
        raise InputError(f"`sensor` must be one of {', '.join(sensors)}, but is {name!r}.")
    return 0 if name is None else sensors.index(name)


def _numbered(force: np.ndarray) -> np.ndarray:
    """Point numbers that start again at 0 with every force."""
    starts = np.flatnonzero(np.concatenate([[True], np.diff(force) != 0]))
    return np.arange(len(force)) - np.repeat(starts, np.diff(np.append(starts, len(force))))
