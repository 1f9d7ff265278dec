"""Residues into mass-normalised shapes: by drive point, added mass, masses or a known shape."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from snrmjax.identify.modal.free_decay import DecayModes
from snrmjax.identify.modal.modal_fit import LinearModalFit
from snrmjax.identify.scaling.added_mass import squared_shapes
from snrmjax.identify.scaling.rigid_body import rigid_body_mode
from snrmjax.identify.scaling.scaled_modes import ScaledModes

_PER = {"force": "N", "voltage": "V", "acceleration": "m/s²"}
_CERTAIN = 3.0  # standard errors of a drive point's residue, without which it gives no scale
_NOT_SCALED = (
    "shapes and participations are not mass-normalised: only frequencies, damping ratios and "
    "ratios of a shape hold; the gain of the force must be free in what follows"
)
_DRIVE_NAMES = ("drive_point", "drive point", "driving_point", "driving point")


class DrivePoint(NamedTuple):
    """Scale by the sensor at the force: its residue is φ².

    `sensor` None: the one whose point and axis are the force's. `turned` says that it points
    against the force.
    """

    sensor: str | None = None
    turned: bool = False


class AddedMassTest(NamedTuple):
    """Scale by a second test of the same structure with a small mass at a sensor."""

    with_mass: LinearModalFit
    sensor: str
    mass: float  # kg
    mass_std: float = 0.0  # kg


class SensorMasses(NamedTuple):
    """Scale by the mass, kg, that each sensor's motion stands for.

    Over a base's acceleration Σ mφ = Γ. With `fixture_mass` the force acts on a rigid free fixture
    of that mass, and its motion in a mode balances the sensors': φ_f = −Σ mφ/m_f.
    """

    mass: Mapping[str, float]
    fixture_mass: float | None = None


class KnownShape(NamedTuple):
    """Scale by a mass-normalised shape that is known, as from finite elements, at one sensor."""

    sensor: str
    value: float  # kg^-1/2, of every mode
    std: float = 0.0


Scale = DrivePoint | AddedMassTest | SensorMasses | KnownShape


class Free(NamedTuple):
    """A structure free to move as a rigid body; of a known mass, kg, if it is weighed."""

    mass: float | None = None


class Calibration(NamedTuple):
    """What is known of the measuring chain beside the residues' own errors."""

    newtons_per_volt: float | None = None
    newtons_per_volt_std: float = 0.0
    relative_std: float = 0.0  # of response over force, all modes alike


def decay_modes(found: DecayModes) -> ScaledModes:
    """Modes of free decays with relative shapes: nothing gives their scale."""
    ones, unknown = np.ones(found.n_modes), np.full(found.n_modes, np.nan)
    return ScaledModes(
        found.natural_frequency,
        found.natural_frequency_std,
        found.damping_ratio,
        found.damping_ratio_std,
        found.shape,
        found.shape_std,
        ones,
        unknown,
        unknown,
        None,
        0.0,
        found.sensor_names,
        "not scaled",
        "N",
        False,
        (*found.notes, _NOT_SCALED),
    )


class _Scaled(NamedTuple):
    """Participations and how they hang on what was fitted."""

    participation: Float[np.ndarray, " mode"]
    relative_std: Float[np.ndarray, " mode"]  # of it, beside the residues' errors
    by_residues: Float[np.ndarray, "mode sensor"]  # d ln p / d residue
    keep: Bool[np.ndarray, " mode"]
    by: str
    notes: tuple[str, ...] = ()


def scale_modes(
    fit: LinearModalFit,
    by: Scale | None,
    *,
    calibration: Calibration = Calibration(),  # noqa: B008
    free: Free | None = None,
) -> ScaledModes:
    """Mass-normalised shapes φ and participations p from residues A = φp.

    Drive point: p = √A_d, where the sensor moves with the force. Added mass Δm at a sensor:
    φ² = (ω₀²/ω₁² − 1)/Δm for one mode, and from the whole set of modes where there are more.
    Sensor masses over a base's acceleration: p = −Γ with Γ² = −Σ m A; under a free rigid fixture
    m_f that is forced: p² = −Σ m A/m_f. A known shape: p = A/φ.
    Signs: a participation is positive, over a base's acceleration negative (the force is −Γa).

    Arguments: `by` None gives relative shapes, one at the largest sensor; `calibration` newtons
    per volt where the reference is a voltage; `free` adds the rigid-body mode that the low
    residuals show, or that of a stated mass.
    Returns `ScaledModes`; modes that hardly move the drive point are left out, with a note.
    Raises `ValueError` in a sentence where a scale cannot be had: no sensor at the force, a
    voltage without newtons per volt, a negative residue at the drive point (a sensor turned), an
    added mass that does not lower the frequencies, a mass below zero, an unknown sensor.
    Reference: Ewins, Modal Testing, 2nd ed. (2000), chapters 2 and 5; for the added mass Parloo,
    Verboven, Guillaume & Van Overmeire, MSSP 16 (2002) 757, doi:10.1006/mssp.2001.1461.
    """
    gain, gain_std = _newtons(fit, by, calibration)
    residue = fit.residue / gain
    if by is None:
        return _relative(fit)
    if isinstance(by, DrivePoint):
        scaled = _by_drive_point(fit, residue, by)
    elif isinstance(by, AddedMassTest):
        scaled = _by_added_mass(fit, residue, by)
    elif isinstance(by, SensorMasses):
        scaled = _by_masses(fit, residue, by)
    else:
        scaled = _by_shape(fit, residue, by)
    chain = np.hypot(gain_std, calibration.relative_std)
    return _assembled(fit, residue, scaled, gain, chain, free)


def drive_point_of(fit: LinearModalFit) -> DrivePoint | None:
    """The sensor at the force, by point and axis, or by a name that says so; None without one."""
    point, way = fit.reference.point, fit.reference.direction
    for one in fit.sensors:
        same_axis = one.direction.lstrip("+-") == way.lstrip("+-")
        if point and one.point == point and same_axis:
            return DrivePoint(one.name, one.direction.startswith("-") != way.startswith("-"))
    for one in fit.sensors:
        if one.name.lower() in _DRIVE_NAMES:
            return DrivePoint(one.name)
    return None


def _newtons(
    fit: LinearModalFit, by: Scale | None, calibration: Calibration
) -> tuple[float, float]:
    """Newtons per unit of the reference and its relative 1σ."""
    gain = calibration.newtons_per_volt
    if calibration.relative_std < 0 or calibration.newtons_per_volt_std < 0:
        raise ValueError("the 1σ of a calibration must not be below zero.")
    if fit.reference.quantity == "voltage":
        if gain is None and isinstance(by, DrivePoint | SensorMasses):
            raise ValueError(
                "the shapes cannot be mass-normalised: the drive is known in volts only, and "
                "newtons per volt are not stated (an added mass or a known shape would do, too)."
            )
        if gain is not None and not (np.isfinite(gain) and gain > 0):
            raise ValueError(f"newtons per volt must be positive, but are {gain:g}.")
        return (1.0, 0.0) if gain is None else (gain, calibration.newtons_per_volt_std / gain)
    if gain is not None:
        raise ValueError(
            f"newtons per volt are for a drive voltage, but the reference {fit.reference.name} is "
            f"{fit.reference.quantity}."
        )
    return 1.0, 0.0


def _relative(fit: LinearModalFit) -> ScaledModes:
    top = np.argmax(np.abs(fit.residue), axis=0)
    at = np.arange(fit.n_modes)
    largest = fit.residue[top, at]
    shape = fit.residue / largest
    spread = np.stack(
        [
            _ratio_std(fit.mode_covariance[k, 2:, 2:], fit.residue[:, k], top[k])
            for k in range(fit.n_modes)
        ],
        axis=1,
    )
    return ScaledModes(
        fit.natural_frequency,
        fit.natural_frequency_std,
        fit.damping_ratio,
        fit.damping_ratio_std,
        shape,
        spread,
        np.sign(largest),
        np.full(fit.n_modes, np.nan),
        np.full(fit.n_modes, np.nan),
        None,
        0.0,
        fit.sensor_names,
        "not scaled",
        _PER.get(fit.reference.quantity, fit.reference.quantity),
        False,
        (*fit.notes, _NOT_SCALED),
    )


def _ratio_std(covariance: np.ndarray, residue: np.ndarray, top: int) -> np.ndarray:
    slope = np.eye(len(residue)) / residue[top]
    slope[:, top] -= residue / residue[top] ** 2
    return np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", slope, covariance, slope), 0.0))


def _by_drive_point(fit: LinearModalFit, residue: np.ndarray, by: DrivePoint) -> _Scaled:
    if fit.reference.quantity not in ("force", "voltage"):
        raise ValueError(
            f"a drive point needs a force, but the reference {fit.reference.name} is the "
            f"{fit.reference.quantity} of a base: give sensor masses, an added mass or a known "
            "shape."
        )
    if by.sensor is None:
        found = drive_point_of(fit)
        if found is None:
            raise ValueError(
                "the shapes cannot be mass-normalised: no sensor is at the force "
                f"{fit.reference.name} (point and axis of {', '.join(fit.sensor_names)} say none), "
                "and no added mass, sensor masses or known shape was given."
            )
        by = DrivePoint(found.sensor, found.turned != by.turned)
    d = fit.sensor_number(str(by.sensor))
    sign = -1.0 if by.turned else 1.0
    own = sign * residue[d]
    std = fit.residue_std[d] * np.abs(residue[d] / fit.residue[d])
    sure = np.abs(own) > _CERTAIN * std
    if np.all(own[sure] < 0) and sure.any():
        raise ValueError(
            f"the residues at the drive point {fit.sensor_names[d]} are negative "
            f"({own[sure][0]:.4g} 1/kg at {fit.natural_frequency[sure][0] / 2 / np.pi:.6g} Hz): "
            "sensor and force point against one another; say that the sensor is turned, or change "
            "a sign."
        )
    keep = sure & (own > 0)
    if not keep.any():
        raise ValueError(
            f"the residues at the drive point {fit.sensor_names[d]} are within three standard "
            "errors of zero: it lies at a node of all modes and gives no scale."
        )
    notes = tuple(
        f"mode at {fit.natural_frequency[k] / 2 / np.pi:.6g} Hz left out: its residue at the drive "
        f"point is {own[k]:.3g} ± {1.96 * std[k]:.2g} 1/kg (95 %), from which no shape follows"
        for k in np.flatnonzero(~keep)
    )
    slopes = np.zeros(residue.T.shape)
    slopes[:, d] = 0.5 / residue[d]
    participation = np.sqrt(np.where(keep, own, 1.0))
    by_name = f"scaled by the drive point {fit.sensor_names[d]}"
    return _Scaled(participation, np.zeros(len(own)), slopes, keep, by_name, notes)


def _by_added_mass(fit: LinearModalFit, residue: np.ndarray, by: AddedMassTest) -> _Scaled:
    place = fit.sensor_number(by.sensor)
    found = squared_shapes(fit, by.with_mass, by.mass, by.mass_std)
    shape = np.sqrt(found.squared)
    slopes = np.zeros(residue.T.shape)
    slopes[:, place] = 1 / residue[place]
    return _Scaled(
        residue[place] / shape,
        0.5 * found.squared_std / found.squared,
        slopes,
        np.ones(len(shape), dtype=bool),
        f"scaled by an added mass of {by.mass:.4g} kg at {by.sensor}",
        found.notes,
    )


def _by_masses(fit: LinearModalFit, residue: np.ndarray, by: SensorMasses) -> _Scaled:
    mass = np.zeros(len(residue))
    for name, value in by.mass.items():
        if not (np.isfinite(value) and value >= 0):
            raise ValueError(f"the mass at {name} must not be below zero (kg), but is {value:g}.")
        mass[fit.sensor_number(name)] = value
    if not mass.any():
        raise ValueError("sensor masses must not all be zero.")
    base = fit.reference.quantity == "acceleration"
    if not base and by.fixture_mass is None:
        raise ValueError(
            "sensor masses scale the response to a base's motion, or with the mass of a free rigid "
            f"fixture that to a force: the reference {fit.reference.name} is "
            f"{fit.reference.quantity}, and no fixture mass is stated."
        )
    if by.fixture_mass is not None and not by.fixture_mass > 0:
        raise ValueError(f"a fixture's mass must be positive (kg), but is {by.fixture_mass:g}.")
    fixture = 1.0 if base else float(by.fixture_mass or 1.0)
    total = mass @ residue
    if np.any(total >= 0):
        k = int(np.argmax(total >= 0))
        raise ValueError(
            f"Σ mass × residue must be negative for a structure moved by its base, but is "
            f"{total[k]:.3g} at {fit.natural_frequency[k] / 2 / np.pi:.6g} Hz: a sensor is turned, "
            "or the responses are absolute where relative ones were said."
        )
    size = np.sqrt(-total / fixture)
    slopes = 0.5 * mass[None] / total[:, None]
    note = (
        f"effective masses: {', '.join(f'{value:.4g}' for value in -total)} kg by modes, of "
        f"{mass.sum():.4g} kg at the sensors"
        if base
        else f"the forced fixture of {fixture:.4g} kg moves as the sensors' masses balance it"
    )
    return _Scaled(
        -size if base else size,
        np.zeros(len(size)),
        slopes,
        np.ones(len(size), dtype=bool),
        "scaled by the masses at the sensors",
        (note,),
    )


def _by_shape(fit: LinearModalFit, residue: np.ndarray, by: KnownShape) -> _Scaled:
    place = fit.sensor_number(by.sensor)
    if not np.isfinite(by.value) or by.value == 0:
        raise ValueError(
            f"the known shape at {by.sensor} must be finite and not zero, but is {by.value:g}."
        )
    slopes = np.zeros(residue.T.shape)
    slopes[:, place] = 1 / residue[place]
    n = residue.shape[1]
    note = () if n == 1 else (f"the shape {by.value:.6g} at {by.sensor} was taken for every mode",)
    return _Scaled(
        residue[place] / by.value,
        np.full(n, abs(by.std / by.value)),
        slopes,
        np.ones(n, dtype=bool),
        f"scaled by the shape stated at {by.sensor}",
        note,
    )


def _assembled(
    fit: LinearModalFit,
    residue: np.ndarray,
    scaled: _Scaled,
    gain: float,
    chain: float,
    free: Free | None,
) -> ScaledModes:
    shape = residue / scaled.participation
    n, sensors = fit.n_modes, len(fit.sensors)
    shape_std, own_std, mass_std = np.zeros((sensors, n)), np.zeros(n), np.zeros(n)
    fixed = scaled.by.startswith("scaled by the drive") or scaled.by.endswith("at the sensors")
    half = 0.5 if fixed else 0.0  # of an error of response over force, in ln φ and in ln p
    for k in range(n):
        covariance = fit.mode_covariance[k, 2:, 2:] / gain**2
        slope_p = scaled.by_residues[k]
        extra = scaled.relative_std[k] ** 2
        own = slope_p @ covariance @ slope_p + extra + (chain * (1 - half)) ** 2
        own_std[k] = abs(scaled.participation[k]) * np.sqrt(own)
        slope = np.eye(sensors) / scaled.participation[k] - np.outer(shape[:, k], slope_p)
        random = np.einsum("ij,jk,ik->i", slope, covariance, slope)
        shared = shape[:, k] ** 2 * (extra + (chain * half) ** 2)
        shape_std[:, k] = np.sqrt(np.maximum(random, 0.0) + shared)
        top = int(np.argmax(np.abs(residue[:, k])))
        mass_std[k] = np.hypot(np.sqrt(covariance[top, top]) / abs(residue[top, k]), chain)
    keep = scaled.keep
    rigid, rigid_participation, rigid_notes = rigid_body_mode(
        fit,
        gain,
        None if free is None else (free.mass or 0.0),
        drive_point_of(fit),
        scaled.by,
    )
    per = "N" if gain != 1.0 else _PER.get(fit.reference.quantity, fit.reference.quantity)
    volts = (
        (
            "participations are per volt: states with `drive_v` and the gain of the force in "
            "newtons per volt free, or fixed to one, fit this model",
        )
        if per == "V"
        else ()
    )
    return ScaledModes(
        fit.natural_frequency[keep],
        fit.natural_frequency_std[keep],
        fit.damping_ratio[keep],
        fit.damping_ratio_std[keep],
        shape[:, keep],
        shape_std[:, keep],
        scaled.participation[keep],
        own_std[keep],
        mass_std[keep],
        rigid,
        rigid_participation,
        fit.sensor_names,
        scaled.by,
        per,
        True,
        (*fit.notes, *scaled.notes, *rigid_notes, *volts),
    )
