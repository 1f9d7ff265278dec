"""Parameters of a model fitted to measured steady states, by inverse harmonic balance.

Simulating a steady state at its force and frequency can give several responses, or none, near a
fold. Instead, its frequency and the fundamental of its velocity are prescribed as measured, and the
harmonic balance is solved for the rest of the motion and for the force: single-valued through
folds. The residual is the difference between that force and the measured one.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from snrmjax.identify.calibrate.calibrated_model import CalibratedModel
from snrmjax.identify.calibrate.calibration_states import ComparedColumns, calibration_states
from snrmjax.identify.calibrate.prescribed_modes import (
    prescribed_at_orders,
    prescribed_mode_columns,
)
from snrmjax.identify.calibrate.state_fit import (
    FitAim,
    FitSettings,
    FittedStates,
    FittedSubject,
    fitted_states,
)
from snrmjax.measure.states import SteadyStates, check_phases
from snrmjax.model.parameters import (
    checked_names,
    parameter_value,
    stated_std,
    with_parameters,
    with_stated_std,
)
from snrmjax.model.structures import Structure
from snrmjax.numerics.compiled import on_numbers
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.levenberg_marquardt import MinimisationStatus, inverse_of
from snrmjax.numerics.names import with_former_arguments
from snrmjax.numerics.rules import InputError


@with_former_arguments({"held_modes": "prescribed_modes"})
@on_numbers("Differentiate the force that a motion needs: `sj.identify.inverse_force`.")
def calibrate_model(
    model: Structure,
    data: SteadyStates,
    parameters: Sequence[str],
    *,
    harmonic_order: int = 9,
    level_gain_std: float = 0.0,
    level_phase_std: float = 0.0,
    priors: bool = False,
    prescribed_modes: Sequence[int] = (),
) -> CalibratedModel:
    """Fit parameters of a model to measured steady states of all levels at once.

    Minimises the whitened sum of squares of (F_model − F)/F over the states, F_model being the
    complex force that the model needs for the measured frequency and fundamental velocity
    (`inverse_force`), and of the differences at other sensors and of harmonics with a stated
    error. The covariance of a state's residuals follows from the stated errors of force, velocity
    and phase and is updated after each fit. Levenberg–Marquardt, with exact derivatives of the
    harmonic balance.

    Arguments: `model` has the starting values and all that is not fitted; `parameters` are chosen
    from `parameter_names`. `level_gain_std` (relative) and `level_phase_std` (rad) are 1σ of errors
    common to all velocities of a level, which become unknowns. With `priors` the model's stated
    standard deviations of fitted parameters act as Gaussian priors. `prescribed_modes` (counted
    from 0) are modes that may exchange energy: their motions at all recorded orders are prescribed
    as measured, for as many modes as there are sensors, and the force residuals of these modes are
    minimised. Inside an internal resonance no branch has to be chosen. Every state needs all
    sensors.
    Returns a `CalibratedModel`; its status and notes report a fit that did not converge and states
    without a solution of the harmonic balance, which have no weight. Where errors of velocity are
    not stated for all states, equal relative errors are assumed and scaled by the residuals.
    Raises `ValueError` for unknown or repeated names, for sensors other than the model's, for an
    unknown force or phase, for levels' errors below zero and for too few data.
    Validity: motions with the period of the force. Errors of velocity enter to first order. Inside
    an internal resonance several motions have the same fundamental; without `prescribed_modes` the
    one that continues from small amplitudes is taken.
    Not differentiable: differentiate `inverse_force`.
    Reference: the formulation is this package's own.
    """
    names = checked_names(model, parameters)
    level_std = {"gain": level_gain_std, "phase": level_phase_std}
    for name, value in level_std.items():
        if not 0 <= value < np.inf:
            raise InputError(f"`level_{name}_std` must be zero or positive, but is {value}.")
    check_phases(data, "a calibration")
    chosen = calibration_states(model, data, harmonic_order)
    prescribed: tuple[tuple[int, ...], ...] = ()
    if prescribed_modes:
        _check_prescribed(model, tuple(prescribed_modes))
        chosen = prescribed_mode_columns(chosen)
        typical = float(np.median(np.asarray(chosen.states.frequency)))
        orders = (1, *chosen.orders)
        prescribed = prescribed_at_orders(
            model, prescribed_modes, typical, orders, len(chosen.sensors)
        )
    shared = tuple(name for name, value in level_std.items() if value > 0)
    picked = (chosen.sensors, chosen.orders, harmonic_order, shared, chosen.n_levels)
    settings = FitSettings(names, *picked, prescribed)
    prior_std = np.array([stated_std(model, name) if priors else 0.0 for name in names])
    weight = np.divide(1.0, prior_std, out=np.zeros(len(names)), where=prior_std > 0)
    n_rows = int(chosen.states.known.sum()) + int(np.sum(weight > 0))
    if n_rows <= len(names):
        raise InputError(
            f"{len(names)} parameters need more than {len(names)} data, but {len(chosen.rows)} "
            f"usable states give {n_rows}."
        )
    aim = FitAim(
        values=jnp.stack([parameter_value(model, name) for name in names]),
        weight=jnp.asarray(weight),
        level_std=jnp.array([level_std[name] for name in shared]),
    )
    return _result(model, data.n_states, chosen, settings, aim)


def _check_prescribed(model: Structure, modes: tuple[int, ...]) -> None:
    if len(set(modes)) < len(modes) or not set(modes) <= set(range(model.n_modes)):
        raise InputError(
            f"`prescribed_modes` must be different modes from 0 to {model.n_modes - 1}, but is "
            f"{modes}."
        )


def _result(
    model: Structure, n_states: int, chosen: ComparedColumns, settings: FitSettings, aim: FitAim
) -> CalibratedModel:
    fit = fitted_states(FittedSubject(model, chosen.states, settings, aim))
    names, p, usable = settings.names, len(settings.names), fit.usable
    known = np.asarray(chosen.states.known) & usable[:, None]
    freedom = int(known.sum()) + int(np.sum(np.asarray(aim.weight) > 0)) - p
    square = np.sum(fit.residuals**2) + np.sum(
        np.asarray(aim.prior_residuals(jnp.asarray(fit.unknowns))) ** 2
    )
    reduced = float(square) / freedom if freedom > 0 else np.nan
    values = np.asarray(aim.parameters(jnp.asarray(fit.unknowns)))
    unit = np.where(np.asarray(aim.values) != 0, np.asarray(aim.values), 1.0)
    covariance = _inverse_of_square(fit.jacobian)[:p, :p] * unit * unit[:, None]
    scatter = float(np.sqrt(2 / max(freedom, 1)))  # 1σ of the reduced χ²
    if not chosen.noise_stated or not reduced <= 1 + 3 * scatter:
        covariance = covariance * reduced
    std = np.sqrt(np.diag(covariance))
    level = fit.unknowns[p:].reshape(settings.n_levels, -1) * np.asarray(aim.level_std)
    shared = dict(zip(settings.shared, level.T, strict=True))
    nothing = np.zeros(settings.n_levels)
    residuals = np.full((n_states, known.shape[1]), np.nan)
    residuals[chosen.rows] = np.where(known, fit.residuals, np.nan)
    converged = np.zeros(n_states, dtype=bool)
    converged[chosen.rows] = usable
    fitted = with_parameters(model, names, jnp.asarray(values))
    return CalibratedModel(
        model=with_stated_std(fitted, names, jnp.asarray(std)),
        values=values,
        covariance=covariance,
        residuals=residuals,
        state_converged=converged,
        level_gain=shared.get("gain", nothing),
        level_phase=shared.get("phase", nothing),
        reduced_chi_square=reduced,
        names=names,
        noise_stated=chosen.noise_stated,
        status=fit.status,
        notes=(*chosen.notes, *_notes(chosen, names, fit, reduced, 3 * scatter)),
    )


def _notes(
    chosen: ComparedColumns,
    names: tuple[str, ...],
    fit: FittedStates,
    reduced: float,
    margin: float,
) -> list[Fact]:
    notes = []
    if fit.status == MinimisationStatus.NOT_FINITE:
        notes.append(Fact("no_motion_for_calibration"))
    elif not fit.status.found_minimum:
        notes.append(Fact("calibration_not_converged"))
    if not fit.usable.all():
        notes.append(Fact("states_without_motion", states=tuple(chosen.rows[~fit.usable].tolist())))
    if chosen.noise_stated and not abs(reduced - 1) <= margin:
        notes.append(Fact("calibration_noise", scale=float(np.sqrt(reduced))))
    slopes = zip(names, fit.jacobian.T, strict=False)
    without_data = tuple(name for name, slope in slopes if not slope.any())
    if without_data:
        notes.append(Fact("parameters_without_data", names=without_data))
    return notes


def _inverse_of_square(jacobian: np.ndarray) -> np.ndarray:
    """(JᵀJ)⁻¹; infinite for unknowns without influence."""
    seen = np.any(jacobian != 0, axis=0)
    inverse = np.diag(np.where(seen, 0.0, np.inf))
    inverse[np.ix_(seen, seen)] = inverse_of(jacobian[:, seen])
    return inverse
