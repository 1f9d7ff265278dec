"""The whole inverse method in one call: steady states in, backbone and damping out."""

from typing import ClassVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from snrmjax.identify.checks.modal_mass import ScatteredFrequencies, mass_of_states
from snrmjax.identify.pointwise.backbone import BackboneFit, CurveFamily, fit_backbone
from snrmjax.identify.pointwise.backbone_points import (
    AmplitudeArgument,
    AmplitudeMeasure,
    BackbonePoints,
    identify_points,
    moved_by_modal_mass,
    off_resonance_error_factor,
    own_errors,
)
from snrmjax.identify.pointwise.curve_fit import linearised_on_host, log_slope, values_on_host
from snrmjax.identify.pointwise.inversion_result import STATUS_MESSAGE, PointStatus
from snrmjax.measure.phase_convention import naming_wrong_phases
from snrmjax.measure.states import SteadyStates
from snrmjax.model.modes import LinearModes
from snrmjax.model.structures import Structure, modes_of
from snrmjax.numerics.blocks import on_one_core
from snrmjax.numerics.result import AbstractResult, Variable


class Identification(AbstractResult):
    """Points, curves and everything that a reader of them should know."""

    coordinates: ClassVar[tuple[str, ...]] = ("state", "level", "backbone_amplitude_m_s")

    points: BackbonePoints
    fit: BackboneFit
    notes: tuple[str, ...]

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`."""
        states, *_ = self.points.summary()
        _, *curves = self.fit.summary()
        return (
            states.replace("BackbonePoints", "Identification", 1),
            *curves,
            *(f"note: {note}" for note in self.notes),
        )

    def variables(self) -> dict[str, Variable]:
        """See `AbstractResult`; those of the points, and of the curves under `backbone_…`."""
        own = dict(self.points.variables())
        for name, variable in self.fit.variables().items():
            at = "backbone_amplitude_m_s"
            key = at if name == "velocity_m_s" else f"backbone_{name}"
            own[key] = variable._replace(dimensions=(at,))
        return own

    def attributes(self) -> dict[str, str | float | int]:
        """See `AbstractResult`."""
        return {**self.fit.attributes(), "notes": "\n".join(self.notes)}


@on_one_core
@naming_wrong_phases
def identify_backbone(
    data: SteadyStates,
    modes: LinearModes | Structure,
    *,
    amplitude: AmplitudeArgument = "displacement",
    measure: AmplitudeMeasure = "fundamental",
    family: CurveFamily = "spline",
    n_knots: int | None = None,
    anchor: bool = False,
) -> Identification:
    """Backbone and damping of the mode of interest from near-resonant steady states.

    `identify_points`, then `fit_backbone`; their arguments are described there. `modes` may also be
    the structure that has them: the errors of levels that it states then enter the bands. Where no
    noise is stated, the standard deviations of the points come from the scatter about the curves.
    Returns an `Identification` whose `notes` say in words what the reader of the file did not use,
    what was left out, what the noise turned out to be and how far an anchor moved the curves.
    Not differentiable, since curves are chosen: differentiate `identify_points`.
    Reference: Kwarta & Allen, section 2.2.
    """
    stds = modes.level_stds if isinstance(modes, Structure) else (0.0, 0.0, 0.0, 0.0)
    modes = modes_of(modes)
    points = identify_points(data, modes, amplitude=amplitude, measure=measure)
    fit = fit_backbone(
        points, modes, family=family, n_knots=n_knots, anchor=anchor, level_stds=stds
    )
    if not fit.noise_stated:
        points = errors_from_scatter(
            points,
            fit,
            level_gain=stds[0],
            level_phase=stds[1],
            frequency_std=stds[2],
            modal_mass_std=modes.own_modal_mass_std,
        )
    notes = (*_notes(points, fit, modes), *_notes_on_modal_mass(points, fit, stds))
    return Identification(points, fit, (*data.notes, *notes))


def errors_from_scatter(
    points: BackbonePoints,
    fit: BackboneFit,
    *,
    level_gain: float = 0.0,
    level_phase: float = 0.0,
    frequency_std: float = 0.0,
    modal_mass_std: float | Float[Array, ""] | None = None,
) -> BackbonePoints:
    """Points whose standard deviations come from the scatter, shared by level or not.

    Arguments: `level_gain` (relative) and `level_phase` (rad), where known, are 1σ of the errors of
    velocity and phase that all states of a level share; `frequency_std` (rad/s) is how far the
    natural frequency wanders from state to state; `modal_mass_std` (relative) is 1σ of the modal
    mass, an error that all points share.
    """
    sensitivity = np.asarray(points.sensitivity)
    scale = off_resonance_error_factor(np.asarray(points.mode_velocity))[:, None] * np.array(
        fit.noise_scale
    )
    shared = np.array([0.0, level_gain, level_phase])
    spread = np.hypot(scale[:, :, None] * np.array([0.0, 1.0, 1.0]), shared)
    own = np.sum((sensitivity[:, :2] * spread) ** 2, axis=2)
    natural, damping = np.asarray(points.natural_frequency), np.asarray(points.damping_ratio)
    moving = np.hypot(fit.level_frequency_std, frequency_std)
    natural_std = np.hypot(np.sqrt(own[:, 0]) / (2 * natural), moving)
    damping_std = np.hypot(np.sqrt(own[:, 1]) / (2 * natural), fit.level_damping_std)
    damping_std = np.hypot(damping_std, damping * natural_std / natural)
    if modal_mass_std is not None:
        of_mass = moved_by_modal_mass(natural, damping, np.asarray(points.frequency))
        natural_std = np.hypot(natural_std, of_mass[0] * float(modal_mass_std))
        damping_std = np.hypot(damping_std, of_mass[1] * float(modal_mass_std))
    return eqx.tree_at(
        lambda p: (p.natural_frequency_std, p.damping_ratio_std),
        points,
        jax.device_put((natural_std, damping_std)),
    )


def _notes(points: BackbonePoints, fit: BackboneFit, modes: LinearModes) -> tuple[str, ...]:
    notes = notes_on_points(points, modes, "are left out of the curves")
    scale = max(fit.noise_scale)
    if fit.noise_stated and scale > 1.5:
        notes.append(
            f"points scatter {scale:.1f} times as much as the stated noise: the bands are too "
            "narrow, or something other than noise is at work."
        )
    if not fit.noise_stated:
        notes.append(
            "no noise is stated: it was estimated from the scatter of left-out levels, "
            f"{100 * fit.noise_scale[0]:.2g} % (frequency) and {100 * fit.noise_scale[1]:.2g} % "
            "(damping) of the measured phasor at resonance, more off it."
        )
    level_hz = fit.level_frequency_std / (2 * np.pi)
    shared = [f"{level_hz:.2g} Hz"] if level_hz > 0 else []
    if fit.level_damping_std > 0:
        shared.append(f"{100 * fit.level_damping_std:.2g} % of critical damping")
    if shared:
        notes.append(
            f"levels differ from one another by {' and '.join(shared)} (1σ); the bands include it."
        )
    notes += notes_on_phases(points, fit)
    if fit.anchor is not None:
        anchor = fit.anchor
        hz = 1 / (2 * np.pi)
        notes.append(
            f"anchored at the linear mode: the free curves miss it at zero amplitude by "
            f"{anchor.frequency_gap * hz:+.3g} ± {anchor.frequency_gap_std * hz:.2g} Hz and "
            f"{100 * anchor.damping_gap:+.3g} ± {100 * anchor.damping_gap_std:.2g} % damping; the "
            f"measured points were moved by up to {anchor.largest_frequency_shift * hz:+.2g} Hz "
            f"and {100 * anchor.largest_damping_shift:+.2g} %."
        )
    return tuple(notes)


def notes_on_points(points: BackbonePoints, modes: LinearModes, consequence: str) -> list[str]:
    """Sentences on states without a point (`consequence` says what follows), roots and sensors."""
    notes = []
    status = np.asarray(points.status)
    for kind in PointStatus:
        count = int(np.sum(status == kind))
        if kind != PointStatus.OK and count:
            notes.append(
                f"{count} of {len(status)} steady states {consequence}: {STATUS_MESSAGE[kind]}."
            )
    other = int(np.sum(np.isfinite(np.asarray(points.alternative_natural_frequency))))
    if other:
        notes.append(
            f"{other} steady states have a second solution that amplitude and phase alone would "
            "also allow."
        )
    if np.asarray(points.filter_residual).max(initial=0.0) > 0.1 and len(modes.sensors) > 1:
        notes.append(
            "the sensors do not move as the mode shape says (residual up to "
            f"{100 * np.nanmax(np.asarray(points.filter_residual)):.0f} %): check the shape, or "
            "the mode's shape changes with amplitude."
        )
    return notes


def _notes_on_modal_mass(
    points: BackbonePoints, fit: BackboneFit, level_stds: tuple[float, float, float, float]
) -> tuple[str, ...]:
    """Another modal mass than the model's, where states away from resonance ask for it."""
    points = jax.tree.map(np.asarray, points)
    use = np.asarray(points.usable & np.isfinite(points.amplitude))
    points = jax.tree.map(lambda values: values[use], points)
    curve = fit.backbone.squared_frequency
    amplitude, natural = np.asarray(points.amplitude), np.asarray(points.natural_frequency)
    slope = log_slope(curve, amplitude)
    moved, std = own_errors(points, 0, slope, stated=fit.noise_stated)
    gain, phase, frequency, _ = level_stds
    own = 2 * natural * np.hypot(frequency, fit.level_frequency_std)
    states = ScatteredFrequencies(
        level=np.asarray(points.level),
        frequency=np.asarray(points.frequency),
        squared=natural**2,
        std=np.maximum(std, 1e-12 * np.max(natural**2)),
        shared=np.column_stack([gain * moved[:, 1], phase * moved[:, 2], own]),
    )
    start = linearised_on_host(curve, amplitude)
    found = mass_of_states(states, *start, stated=fit.noise_stated)
    if found is None or not found.contradicts:
        return ()
    model = 1 / abs(float(fit.backbone.modal_constant))
    ratio = np.exp(found.log_ratio)
    change = 100 * (1 / ratio - 1)
    return (
        f"the states away from resonance ask for a modal mass of {model * ratio:.4g} ± "
        f"{model * ratio * found.std:.2g} kg; the model has {model:.4g} kg. Damping in per cent is "
        f"relative to the model's: relative to {model * ratio:.4g} kg it is {abs(change):.2g} % "
        f"{'larger' if change > 0 else 'smaller'}. A gain of the force or of the sensor does the "
        "same: check both and the linear test; a joint fit (`--fit auto`) takes what it finds.",
    )


FREE_PHASE = (
    "let a joint fit estimate it (`--fit auto --free instrument_phase`; in Python "
    '`fit_jointly(…, free=["instrument_phase"])`)'
)


def notes_on_phases(
    points: BackbonePoints, fit: BackboneFit, advice: str = FREE_PHASE
) -> list[str]:
    """A sentence when damping changes with the phase inside the levels, which it should not.

    Arguments: `advice` what to do about it.
    """
    points = jax.tree.map(np.asarray, points)
    use = points.usable
    level = points.level[use]
    sign = np.sign(float(fit.backbone.modal_constant))  # negative: the mode moves against force
    sine = sign * np.sin(np.angle(np.asarray(points.mode_velocity)))[use]
    curve = values_on_host(fit.backbone.modal_damping, np.asarray(points.amplitude)[use])
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
    across = slope * 2 * np.sin(np.pi / 4)
    if explained < 0.3 or abs(across) < 0.1:
        return []
    sides = ["45° below resonance (velocity leads)", "45° above it (velocity lags)"]
    if across < 0:
        sides = ["45° above resonance (velocity lags)", "45° below it (velocity leads)"]
    return [
        f"damping comes out {100 * abs(across):.0f} % higher from points {sides[0]} than from "
        f"points {sides[1]}, which a damping that depends on amplitude alone does not do; an error "
        f"of the instrument's phase does: {advice}."
    ]
