"""Mass-normalised shapes from residues: by drive point, added mass, masses or a known shape."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from snrmjax.identify.modal.free_decay import DecayModes
from snrmjax.identify.modal.modal_fit import LinearModalFit
from snrmjax.identify.scaling.added_mass import squared_shapes
from snrmjax.identify.scaling.scaled_modes import ScaledModes, rigid_body_mode
from snrmjax.numerics.compiled import on_numbers
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError

_PER = {"force": "N", "voltage": "V", "acceleration": "m/s²"}
_RESIDUE_STDS = 3.0  # smallest significant drive-point residue, in standard errors
_DRIVE_NAMES = ("drive_point", "drive point", "driving_point", "driving point")


class _Scaled(NamedTuple):
    """Participations and their sensitivity to the fitted residues."""

    participation: Float[np.ndarray, " mode"]
    relative_std: Float[np.ndarray, " mode"]  # of it, in addition to the residues' errors
    by_residues: Float[np.ndarray, "mode sensor"]  # d ln p / d residue
    keep: Bool[np.ndarray, " mode"]
    by: Fact
    notes: tuple[Fact, ...]
    # A relative error of response over force enters φ to this power, and p to one minus it.
    exponent: float


class DrivePoint(NamedTuple):
    """Scale by the sensor at the force: its residue is φ².

    `sensor` None: the one at the point and axis of the force. `turned`: the sensor points in the
    direction opposite to the force.
    """

    sensor: str | None = None
    turned: bool = False

    def scaled(self, fit: LinearModalFit, residue: Float[np.ndarray, "sensor mode"]) -> _Scaled:
        """p = √A of the drive point."""
        if fit.reference.quantity not in ("force", "voltage"):
            raise InputError(
                f"a drive point needs a force, but the reference {fit.reference.name} is the "
                f"{fit.reference.quantity} of a base: give sensor masses, an added mass or a known "
                "shape."
            )
        d, sign = self._sensor_and_sign(fit)
        drive_residue = sign * residue[d]
        std = fit.residue_std[d] * np.abs(residue[d] / fit.residue[d])
        sure = np.abs(drive_residue) > _RESIDUE_STDS * std
        hertz = fit.natural_frequency / 2 / np.pi
        if np.all(drive_residue[sure] < 0) and sure.any():
            advice = "leave out" if self.turned else "state"
            advice = f"{advice} that the sensor is turned"
            raise InputError(
                f"the residues at the drive point {fit.sensor_names[d]} are negative "
                f"({drive_residue[sure][0]:.4g} 1/kg at {hertz[sure][0]:.6g} Hz): sensor and force "
                f"have opposite directions; {advice}, or change a sign."
            )
        keep = sure & (drive_residue > 0)
        if not keep.any():
            raise InputError(
                f"the residues at the drive point {fit.sensor_names[d]} are within three standard "
                "errors of zero: it is at a node of all modes and gives no scale."
            )
        left_out = np.stack([hertz, drive_residue, std], axis=1)[~keep].tolist()
        notes = tuple(
            Fact("mode_not_scaled", frequency_hz=at, residue=value, std=spread)
            for at, value, spread in left_out
        )
        participation = np.sqrt(np.where(keep, drive_residue, 1.0))
        by = Fact("scaled_by_drive_point", sensor=fit.sensor_names[d])
        slopes = 0.5 * _by_one(residue, d)
        return _Scaled(participation, np.zeros(len(drive_residue)), slopes, keep, by, notes, 0.5)

    def _sensor_and_sign(self, fit: LinearModalFit) -> tuple[int, float]:
        """Index of the sensor, and its sign relative to the force."""
        sign = -1.0 if self.turned else 1.0
        if self.sensor is not None:
            return fit.sensor_number(self.sensor), sign
        drive = _drive_point_of(fit)
        if drive is None:
            raise InputError(
                "the shapes cannot be mass-normalised: no sensor is known to be where the force "
                f"acts (by points and axes of {', '.join(fit.sensor_names)}); name that sensor, or "
                "give an added mass, sensor masses or a known shape."
            )
        return drive[0], sign * drive[1]


class AddedMassTest(NamedTuple):
    """Scale by a second test of the same structure with a small mass at a sensor."""

    with_mass: LinearModalFit
    sensor: str
    mass: float  # kg
    mass_std: float = 0.0  # kg

    def scaled(self, fit: LinearModalFit, residue: Float[np.ndarray, "sensor mode"]) -> _Scaled:
        """p = A/φ with φ from the shift of the frequencies."""
        sensor = fit.sensor_number(self.sensor)
        squares = squared_shapes(fit, self.with_mass, self.mass, self.mass_std)
        shape = np.sqrt(squares.squared)
        return _Scaled(
            residue[sensor] / shape,
            0.5 * squares.squared_std / squares.squared,
            _by_one(residue, sensor),
            np.ones(len(shape), dtype=bool),
            Fact("scaled_by_added_mass", mass_kg=self.mass, sensor=self.sensor),
            squares.notes,
            0.0,
        )


class SensorMasses(NamedTuple):
    """Scale by the mass, kg, lumped at each sensor.

    Over a base acceleration Σ mφ = Γ. With `fixture_mass` the force acts on a free rigid fixture of
    that mass, whose motion in a mode balances that of the sensors: φ_f = −Σ mφ/m_f.
    """

    mass: Mapping[str, float]
    fixture_mass: float | None = None

    def scaled(self, fit: LinearModalFit, residue: Float[np.ndarray, "sensor mode"]) -> _Scaled:
        """p² = −Σ m A, divided by the mass of a forced fixture."""
        if not self.mass:
            raise InputError("a fixture mass needs the masses at the sensors as well.")
        mass = np.zeros(len(residue))
        for name, value in self.mass.items():
            if not (np.isfinite(value) and value >= 0):
                raise InputError(
                    f"the mass at {name} must not be below zero (kg), but is {value:g}."
                )
            mass[fit.sensor_number(name)] = value
        if not mass.any():
            raise InputError("sensor masses must not all be zero.")
        base = fit.reference.quantity == "acceleration"
        if not base and self.fixture_mass is None:
            raise InputError(
                "sensor masses scale the response to base motion or, with the mass of a free rigid "
                f"fixture, that to a force: the reference {fit.reference.name} is "
                f"{fit.reference.quantity}, and no fixture mass is stated."
            )
        if self.fixture_mass is not None and not self.fixture_mass > 0:
            raise InputError(
                f"a fixture's mass must be positive (kg), but is {self.fixture_mass:g}."
            )
        fixture = 1.0 if base else float(self.fixture_mass or 1.0)
        total = mass @ residue
        if np.any(total >= 0):
            k = int(np.argmax(total >= 0))
            raise InputError(
                f"Σ mass × residue must be negative for a structure moved by its base, but is "
                f"{total[k]:.3g} at {fit.natural_frequency[k] / 2 / np.pi:.6g} Hz: a sensor is "
                "turned, or the responses are absolute but were declared relative."
            )
        participation = np.sqrt(-total / fixture)
        note = Fact("forced_fixture", mass_kg=fixture)
        if base:
            masses = tuple((-total).tolist())
            note = Fact("effective_masses", masses_kg=masses, at_sensors_kg=float(mass.sum()))
        return _Scaled(
            -participation if base else participation,
            np.zeros(len(participation)),
            0.5 * mass[None] / total[:, None],
            np.ones(len(participation), dtype=bool),
            Fact("scaled_by_sensor_masses"),
            (note,),
            0.5,
        )


class KnownShape(NamedTuple):
    """Scale by a known mass-normalised shape at one sensor, for example from finite elements."""

    sensor: str
    value: float  # kg^-1/2, of every mode
    std: float = 0.0

    def scaled(self, fit: LinearModalFit, residue: Float[np.ndarray, "sensor mode"]) -> _Scaled:
        """p = A/φ."""
        sensor, n = fit.sensor_number(self.sensor), residue.shape[1]
        if not np.isfinite(self.value) or self.value == 0:
            raise InputError(
                f"the known shape at {self.sensor} must be finite and not zero, but is "
                f"{self.value:g}."
            )
        note = Fact("shape_for_all_modes", value=self.value, sensor=self.sensor)
        return _Scaled(
            residue[sensor] / self.value,
            np.full(n, abs(self.std / self.value)),
            _by_one(residue, sensor),
            np.ones(n, dtype=bool),
            Fact("scaled_by_known_shape", sensor=self.sensor),
            () if n == 1 else (note,),
            0.0,
        )


Scale = DrivePoint | AddedMassTest | SensorMasses | KnownShape


class Free(NamedTuple):
    """A structure free to move as a rigid body, with its mass in kg if known."""

    mass: float | None = None


class Calibration(NamedTuple):
    """Calibration of the measuring chain, in addition to the residues' errors."""

    newtons_per_volt: float | None = None
    newtons_per_volt_std: float = 0.0
    relative_std: float = 0.0  # of response over force, common to all modes


@on_numbers("Differentiate `sj.model.linear_response`.")
def scale_modes(
    fit: LinearModalFit | DecayModes,
    by: Scale | None,
    *,
    calibration: Calibration = Calibration(),  # noqa: B008
    free: Free | None = None,
) -> ScaledModes:
    """Mass-normalised shapes φ and participations p from residues A = φp.

    Drive point: p = √A_d, at the sensor where the force acts. Added mass Δm at a sensor:
    φ² = (ω₀²/ω₁² − 1)/Δm for one mode; several modes are solved together.
    Sensor masses over a base acceleration: p = −Γ with Γ² = −Σ m A; with a forced rigid fixture
    m_f: p² = −Σ m A/m_f. A known shape: p = A/φ.
    Signs: participations are positive, over a base acceleration negative (the force is −Γa).

    Arguments: `by` None gives relative shapes, ±1 at the largest sensor; p then is the magnitude of
    the residue there, so that φp = A at every sensor. Free decays have no residue: p is one.
    `calibration` has newtons per volt where the reference is a voltage; `free` adds the rigid-body
    mode from the low residuals, or that of a stated mass.
    Returns `ScaledModes`; modes that hardly move the drive point are left out, with a note.
    Raises `ValueError` where no scale can be derived: no sensor at the force, a voltage without
    newtons per volt, a free decay, a negative residue at the drive point (reversed sensor), an
    added mass that does not lower the frequencies, a mass below zero, an unknown
    sensor.
    Not differentiable: differentiate `snrmjax.model.linear_response`.
    Reference: Ewins, Modal Testing, 2nd ed. (2000), chapters 2 and 5; for the added mass Parloo,
    Verboven, Guillaume & Van Overmeire, MSSP 16 (2002) 757, doi:10.1006/mssp.2001.1461.
    """
    if isinstance(fit, DecayModes):
        if by is not None:
            raise InputError(
                "the shapes cannot be mass-normalised: a free decay has no force; take "
                "frequencies and damping alone (unscaled), or measure frequency responses."
            )
        unknown = np.full(fit.n_modes, np.nan)
        return _unscaled(fit, (fit.shape, fit.shape_std), (np.ones(fit.n_modes), unknown), "N")
    gain, gain_std = _newtons(fit, by, calibration)
    residue, covariance = fit.residue / gain, fit.mode_covariance[:, 2:, 2:] / gain**2
    top, at = np.argmax(np.abs(residue), axis=0), np.arange(fit.n_modes)
    largest = residue[top, at]
    per = _PER.get(fit.reference.quantity, fit.reference.quantity)
    chain = np.hypot(gain_std, calibration.relative_std)
    of_largest = np.sqrt(covariance[at, top, top]) / np.abs(largest)
    per = "N" if gain != 1.0 else per
    if by is None:
        slopes = np.eye(len(residue))[top] / largest[:, None]
        p = -np.abs(largest) if fit.reference.quantity == "acceleration" else np.abs(largest)
        participations = p, np.hypot(of_largest, chain)
        return _unscaled(fit, _shapes(residue, covariance, p, slopes), participations, per)
    scaled = by.scaled(fit, residue)
    p, slopes, keep = scaled.participation, scaled.by_residues, scaled.keep
    shape, spread = _shapes(residue, covariance, p, slopes)
    shared = np.hypot(scaled.relative_std, chain * scaled.exponent)
    of_participation = np.einsum("ki,kij,kj->k", slopes, covariance, slopes)
    relative = of_participation + scaled.relative_std**2 + (chain * (1 - scaled.exponent)) ** 2
    rigid = rigid_body_mode(
        fit, gain, None if free is None else free.mass or 0.0, _drive_point_of(fit), scaled.by
    )
    volts = (Fact("participations_per_volt"),) if per == "V" else ()
    return ScaledModes(
        natural_frequency=fit.natural_frequency[keep],
        natural_frequency_std=fit.natural_frequency_std[keep],
        damping_ratio=fit.damping_ratio[keep],
        damping_ratio_std=fit.damping_ratio_std[keep],
        shape=shape[:, keep],
        shape_std=np.hypot(spread, np.abs(shape) * shared)[:, keep],
        participation=p[keep],
        participation_std=(np.abs(p) * np.sqrt(relative))[keep],
        modal_mass_std=np.hypot(of_largest, chain)[keep],
        rigid_shape=rigid.shape,
        rigid_participation=rigid.participation,
        sensors=fit.sensor_names,
        scaled_by=scaled.by,
        per=per,
        notes=(*fit.notes, *scaled.notes, *rigid.notes, *volts),
    )


def _by_one(residue: np.ndarray, sensor: int) -> Float[np.ndarray, "mode sensor"]:
    """d ln p / d residue where p is proportional to one sensor's residue."""
    slopes = np.zeros(residue.T.shape)
    slopes[:, sensor] = 1 / residue[sensor]
    return slopes


def _shapes(
    residue: np.ndarray, covariance: np.ndarray, participation: np.ndarray, slopes: np.ndarray
) -> tuple[Float[np.ndarray, "sensor mode"], Float[np.ndarray, "sensor mode"]]:
    """φ = A/p and its 1σ from the residues' errors; `slopes` are d ln p / d residue."""
    shape = residue / participation
    sensitivities = np.eye(len(residue)) / participation[:, None, None]
    sensitivities = sensitivities - shape.T[:, :, None] * slopes[:, None, :]
    variance = np.einsum("kij,kjl,kil->ik", sensitivities, covariance, sensitivities)
    return shape, np.sqrt(np.maximum(variance, 0.0))


def _unscaled(
    modes: LinearModalFit | DecayModes,
    shapes: tuple[np.ndarray, np.ndarray],
    participations: tuple[np.ndarray, np.ndarray],
    per: str,
) -> ScaledModes:
    """Modes with relative shapes, without a scale.

    Arguments: shapes with their 1σ; participations with the relative 1σ of the residues.
    """
    (shape, shape_std), (participation, relative) = shapes, participations
    residues_known = bool(np.all(np.isfinite(relative)))
    return ScaledModes(
        natural_frequency=modes.natural_frequency,
        natural_frequency_std=modes.natural_frequency_std,
        damping_ratio=modes.damping_ratio,
        damping_ratio_std=modes.damping_ratio_std,
        shape=shape,
        shape_std=shape_std,
        participation=participation,
        participation_std=np.abs(participation) * relative,
        modal_mass_std=relative,
        rigid_shape=None,
        rigid_participation=0.0,
        sensors=modes.sensor_names,
        scaled_by=Fact("not_scaled"),
        per=per,
        mass_normalised=False,
        notes=(*modes.notes, Fact("shapes_not_scaled", residues_known=residues_known)),
    )


def _drive_point_of(fit: LinearModalFit) -> tuple[int, float] | None:
    """The sensor at the force, by point and axis or by its name, and its sign."""
    point, axis = fit.reference.point, fit.reference.direction
    for k, sensor in enumerate(fit.sensors):
        same_axis = sensor.direction.lstrip("+-") == axis.lstrip("+-")
        if point and sensor.point == point and same_axis:
            return k, 1.0 if sensor.direction.startswith("-") == axis.startswith("-") else -1.0
    named = [k for k, name in enumerate(fit.sensor_names) if name.lower() in _DRIVE_NAMES]
    return (named[0], 1.0) if named else None


def _newtons(
    fit: LinearModalFit, by: Scale | None, calibration: Calibration
) -> tuple[float, float]:
    """Newtons per unit of the reference and its relative 1σ."""
    gain = calibration.newtons_per_volt
    if calibration.relative_std < 0 or calibration.newtons_per_volt_std < 0:
        raise InputError("the 1σ of a calibration must not be below zero.")
    if fit.reference.quantity == "voltage":
        if gain is None and isinstance(by, DrivePoint | SensorMasses):
            raise InputError(
                "the shapes cannot be mass-normalised: the drive is known in volts only, and "
                "newtons per volt are not stated (an added mass or a known shape would also do)."
            )
        if gain is not None and not (np.isfinite(gain) and gain > 0):
            raise InputError(f"newtons per volt must be positive, but are {gain:g}.")
        return (1.0, 0.0) if gain is None else (gain, calibration.newtons_per_volt_std / gain)
    if gain is not None:
        raise InputError(
            f"newtons per volt are for a drive voltage, but the reference {fit.reference.name} is "
            f"{fit.reference.quantity}."
        )
    return 1.0, 0.0
