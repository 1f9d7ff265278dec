"""The inverse method in one call: backbone and damping from steady states."""

import dataclasses
from typing import ClassVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from snrmjax.identify.curves.family_base import Argument
from snrmjax.identify.inference.fitted_curves import as_backbone
from snrmjax.identify.joint.joint_fit import JointFit, fit_jointly
from snrmjax.identify.pointwise.backbone import Backbone
from snrmjax.identify.pointwise.backbone_points import (
    AmplitudeMeasure,
    BackbonePoints,
    identify_points,
    moved_by_modal_mass,
    off_resonance_error_factor,
    peak_ratio,
)
from snrmjax.identify.pointwise.inversion import PointStatus, reasons_in_words
from snrmjax.measure.phase_convention import naming_wrong_phases
from snrmjax.measure.states import SteadyStates
from snrmjax.model.modes import LinearModes
from snrmjax.model.structures import Structure, modes_of
from snrmjax.numerics.blocks import on_one_core
from snrmjax.numerics.compiled import on_numbers
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.result import AbstractResult, Variable
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

_FEWEST = 2  # points for a curve
_SHAPE_MISSED = 0.1  # fraction of the motion outside the mode shape, worth a note
_EXPLAINED, _RELEVANT = (
    0.3,
    0.1,
)  # by the phase: fraction of the damping's variance; relative change


class Identification(AbstractResult):
    """Identified points, backbone and damping curves, and notes on their validity.

    The curves are those of `fit`, the joint fit of all states.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("state", "level", "backbone_amplitude_m_s")

    points: BackbonePoints
    backbone: Backbone
    fit: JointFit
    notes: tuple[Fact | str, ...] = eqx.field(static=True)

    @property
    def level_frequency_std(self) -> float:
        """Level-to-level 1σ of the natural frequency, rad/s."""
        j = self.fit.modes.mode_of_interest
        natural = self.fit.modes.natural_frequency.item(j)
        return 0.5 * float(self.fit.noise.level_std[2]) * natural

    @property
    def level_damping_std(self) -> float:
        """Level-to-level 1σ of the damping ratio."""
        j = self.fit.modes.mode_of_interest
        return float(self.fit.noise.level_std[3]) * self.fit.modes.damping_ratio.item(j)

    def summary(self) -> tuple[str, ...]:
        """Numbers of points, ranges of the curves, scatter of states and levels, notes."""
        points, ends = self.points, self.backbone.sampled()
        n_levels, noise = len(np.unique(np.asarray(points.level))), self.fit.noise
        scale = f"{noise.scale:.3g} times the stated noise"
        if not noise.stated:
            scale = f"{100 * noise.scale:.3g} % of the measured phasor (1σ)"
        hertz, ratio = np.asarray(ends.natural_frequency) / HERTZ, np.asarray(ends.damping_ratio)
        speed = np.asarray(ends.velocity)
        status, counts = np.unique(np.asarray(points.status), return_counts=True)
        outcomes = (PointStatus(int(kind)).message for kind in status)
        return (
            f"Identification: {len(points.status)} steady states of {n_levels} levels at "
            f"{points.sensor!r}",
            *(f"{n} {outcome}" for n, outcome in zip(counts, outcomes, strict=True)),
            f"natural frequency {np.nanmin(hertz):.6g} to {np.nanmax(hertz):.6g} Hz",
            f"damping ratio {100 * np.nanmin(ratio):.4g} to {100 * np.nanmax(ratio):.4g} %",
            f"velocity {np.nanmin(speed):.4g} to {np.nanmax(speed):.4g} m/s",
            f"scatter of states about the curves: {scale}",
            f"level to level: {self.level_frequency_std / HERTZ:.2g} Hz and "
            f"{100 * self.level_damping_std:.2g} % of critical damping (1σ)",
            *(f"note: {note}" for note in self.notes),
        )

    def variables(self) -> dict[str, Variable]:
        """See `AbstractResult`; those of the points, and of the curves under `backbone_…`."""
        variables = dict(self.points.variables())
        for name, variable in self.backbone.variables().items():
            at = "backbone_amplitude_m_s"
            key = at if name == "velocity_m_s" else f"backbone_{name}"
            variables[key] = variable._replace(dimensions=(at,))
        return variables

    def attributes(self) -> dict[str, str | float | int]:
        """See `AbstractResult`."""
        return {
            **self.backbone.attributes(),
            "noise_stated": int(self.fit.noise.stated),
            "level_frequency_std_hz": self.level_frequency_std / HERTZ,
            "level_damping_ratio_std": self.level_damping_std,
            "notes": "\n".join(map(str, self.notes)),
        }


@on_numbers("Differentiate `sj.identify.identify_points`.")
@on_one_core
@naming_wrong_phases(data="data", modes="modes")
def identify_backbone(
    data: SteadyStates,
    modes: LinearModes | Structure,
    *,
    amplitude: Argument = "displacement",
    measure: AmplitudeMeasure = "fundamental",
    n_knots: int | None = None,
) -> Identification:
    """Backbone and damping of the mode of interest from near-resonant steady states.

    Each state gives a point (`identify_points`); the curves and their bands are the smooth ones of
    `fit_jointly`. `modes` may also be a structure: its stated level errors then enter the bands.
    Where no noise is stated, the standard deviations of the points come from the scatter about the
    curves.

    Arguments: `amplitude` and `measure` as in `identify_points`; `n_knots` at most of each curve.
    Returns an `Identification` whose `notes` report unused input, states left out, and the noise.
    Raises `ValueError` where fewer than two states have a point, and what `fit_jointly` raises.
    Not differentiable, since curves are selected: differentiate `identify_points`.
    Reference: Kwarta & Allen, section 2.2.
    """
    points = identify_points(data, modes_of(modes), amplitude=amplitude, measure=measure)
    usable = np.asarray(points.usable) & np.isfinite(np.asarray(points.amplitude))
    if usable.sum() < _FEWEST:
        raise InputError(
            f"a backbone needs at least {_FEWEST} solved points, but only {int(usable.sum())} of "
            f"{usable.size} are: {reasons_in_words(points.status)}."
        )
    states = data
    if measure == "peak":
        ratio = peak_ratio(data)
        states = eqx.tree_at(
            lambda d: (d.velocity, d.velocity_std),
            data,
            (data.velocity * ratio, data.velocity_std * ratio),
        )
    family = "auto" if n_knots is None else f"smoothing_spline:{n_knots}"
    fit = fit_jointly(states, modes, backbone=family, damping=family)
    identified = identification_of_fit(data, fit, amplitude=amplitude, measure=measure)
    return dataclasses.replace(identified, notes=(*data.notes, *identified.notes))


def identification_of_fit(
    data: SteadyStates,
    fit: JointFit,
    *,
    amplitude: Argument = "displacement",
    measure: AmplitudeMeasure = "fundamental",
) -> Identification:
    """The points of all steady states, together with the curves of a joint fit.

    Points come from the inverse method with the fitted modal mass. Where no noise is stated, their
    1σ comes from the fit's noise and level errors of gain, phase, natural frequency and damping.

    Arguments: `data` are the steady states of the fit, with forces in newtons; the others as in
    `identify_backbone`.
    Returns an `Identification` whose `notes` are those of the fit and of the points.
    """
    points = identify_points(data, fit.identified_modes, amplitude=amplitude, measure=measure)
    curves = as_backbone(fit, argument=amplitude)
    identified = Identification(points, curves, fit, ())
    if not fit.noise.stated:
        gain, phase = map(float, fit.noise.level_std[:2])
        j = fit.modes.mode_of_interest
        natural = fit.modes.natural_frequency.item(j)
        frequency_jitter_std = 0.5 * natural * float(np.max(np.asarray(fit.data.std)[:, 3]))
        points = errors_from_scatter(
            points,
            fit.noise.scale,
            level_gain=gain,
            level_phase=phase,
            frequency_std=float(np.hypot(identified.level_frequency_std, frequency_jitter_std)),
            damping_std=identified.level_damping_std,
            modal_mass_std=fit.identified_modes.own_modal_mass_std,
        )
    notes = (
        *fit.notes,
        *notes_on_points(points, fit.modes),
        *notes_on_phases(points, curves, phase_was_free="instrument_phase" in fit.free),
    )
    return Identification(points, curves, fit, notes)


def errors_from_scatter(
    points: BackbonePoints,
    noise: float,
    *,
    level_gain: float = 0.0,
    level_phase: float = 0.0,
    frequency_std: float = 0.0,
    damping_std: float = 0.0,
    modal_mass_std: float | Float[Array, ""] | None = None,
) -> BackbonePoints:
    """Points with standard deviations from the scatter about the curves.

    Arguments: `noise` at resonance, relative, of each of force, amplitude and phase, as estimated
    by a joint fit (`balance_data`); `level_gain` (relative) and `level_phase` (rad) 1σ of the
    errors that all states of a level share; `frequency_std` (rad/s) and `damping_std` 1σ of the
    natural frequency and the damping ratio from state to state; `modal_mass_std` (relative) 1σ of
    the modal mass, common to all points.
    """
    sensitivity = np.asarray(points.sensitivity)
    scale = noise * off_resonance_error_factor(np.asarray(points.mode_velocity))
    shared = np.array([0.0, level_gain, level_phase])
    spread = np.hypot(scale[:, None, None], shared)
    variances = np.sum((sensitivity[:, :2] * spread) ** 2, axis=2)
    natural, damping = np.asarray(points.natural_frequency), np.asarray(points.damping_ratio)
    natural_std = np.hypot(np.sqrt(variances[:, 0]) / (2 * natural), frequency_std)
    of_damping = np.hypot(np.sqrt(variances[:, 1]) / (2 * natural), damping_std)
    of_damping = np.hypot(of_damping, damping * natural_std / natural)
    if modal_mass_std is not None:
        of_mass = moved_by_modal_mass(natural, damping, np.asarray(points.frequency))
        natural_std = np.hypot(natural_std, of_mass[0] * float(modal_mass_std))
        of_damping = np.hypot(of_damping, of_mass[1] * float(modal_mass_std))
    return eqx.tree_at(
        lambda p: (p.natural_frequency_std, p.damping_ratio_std),
        points,
        jax.device_put((natural_std, of_damping)),
    )


def notes_on_points(points: BackbonePoints, modes: LinearModes) -> list[Fact]:
    """States without a point or with two, and motion outside the mode shape."""
    status, notes = np.asarray(points.status), []
    for kind in PointStatus:
        count = int(np.sum(status == kind))
        if kind != PointStatus.OK and count:
            reason = {"of": len(status), "reason": kind.message}
            notes.append(Fact("states_without_point", n_states=count, **reason))
    other = int(np.sum(np.isfinite(np.asarray(points.alternative_natural_frequency))))
    if other:
        notes.append(Fact("second_solutions", n_states=other))
    residual = float(np.asarray(points.filter_residual).max(initial=0.0))
    if residual > _SHAPE_MISSED and len(modes.sensors) > 1:
        residual = float(np.nanmax(np.asarray(points.filter_residual)))
        notes.append(Fact("shape_not_followed", residual=residual))
    return notes


def notes_on_phases(
    points: BackbonePoints, curves: Backbone, *, phase_was_free: bool
) -> list[Fact]:
    """Whether damping correlates with phase within levels, which indicates a phase error."""
    points = jax.tree.map(np.asarray, points)
    use = points.usable
    level = points.level[use]
    sign = np.sign(float(curves.modal_constant))  # negative: the mode moves against force
    sine = sign * np.sin(np.angle(np.asarray(points.mode_velocity)))[use]
    curve = curves.modal_damping.linearised(np.asarray(points.amplitude)[use]).value
    excess = np.asarray(points.modal_damping)[use] / curve - 1
    _, member = np.unique(level, return_inverse=True)
    count = np.bincount(member)
    x, y = (
        values - (np.bincount(member, weights=values) / count)[member] for values in (sine, excess)
    )
    if not np.any(x != 0) or not np.any(y != 0):
        return []
    slope = float(x @ y / (x @ x))
    explained = slope**2 * float(x @ x) / float(y @ y)
    across = slope * 2 * np.sin(np.pi / 4)  # from 45° on one side to 45° on the other
    if explained < _EXPLAINED or abs(across) < _RELEVANT:
        return []
    return [Fact("damping_changes_with_phase", change=across, phase_was_free=phase_was_free)]
