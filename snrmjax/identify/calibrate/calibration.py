"""Parameters of a model fitted to measured steady states, by inverse harmonic balance.

A steady state is not simulated at its force and frequency, where near a fold there are several
answers or none. Its frequency and the fundamental of its velocity are prescribed as measured, and
the harmonic balance is solved for the rest of the motion and for the force: single-valued through
folds. The residual is the difference of that force from the measured one.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from snrmjax.identify.calibrate.calibrated_model import CalibratedModel
from snrmjax.identify.calibrate.calibration_states import (
    CalibrationStates,
    ComparedColumns,
    calibration_states,
    state_whitener,
    whitened_columns,
)
from snrmjax.identify.calibrate.held_modes import (
    HeldModes,
    HeldMotion,
    columns_of_held,
    held_at_orders,
    held_columns,
    held_motion,
)
from snrmjax.identify.calibrate.inverse_force import StateWithErrors, residual_columns
from snrmjax.measure.states import SteadyStates, check_phases
from snrmjax.model.parameters import (
    checked_names,
    parameter_value,
    stated_std,
    with_parameters,
    with_stated_std,
)
from snrmjax.model.structures import Structure
from snrmjax.numerics.blocks import mapped
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.least_squares import inverse_of
from snrmjax.numerics.levenberg_marquardt import (
    MinimisationStatus,
    Minimum,
    StepRule,
    minimise,
)
from snrmjax.simulate.balance.prescribed_motion import PrescribedMotion


class _Round(NamedTuple):
    """One round of fitting and whitening anew.

    In the first rounds, far from the truth, what the data say little about stays within a relative
    step of about `step`, and harmonics, which mislead there, have a relative error of
    `harmonic_error`. A round ends with a step that lowers χ² by less than `settled`.
    """

    step: float
    harmonic_error: float
    settled: float


_ROUNDS = (
    _Round(0.1, 1.0, 1e-3),
    _Round(0.3, 0.1, 1e-3),
    _Round(np.inf, 0.0, 1e-3),
    _Round(np.inf, 0.0, 1e-12),
)
_RULE = StepRule(steps=60)


class _Settings(NamedTuple):
    """What is compiled into a program."""

    names: tuple[str, ...]
    sensors: tuple[int, ...]  # rows of the mode shapes, the reference sensor first
    orders: tuple[int, ...]  # harmonics that are compared
    harmonic_order: int
    shared: tuple[str, ...]  # errors that a level shares
    n_levels: int
    held_modes: tuple[tuple[int, ...], ...] = ()  # whose motion is held as measured, an order each

    def motion(
        self, model: Structure, erring: StateWithErrors
    ) -> tuple[PrescribedMotion | HeldMotion, Callable[[Array], Array]]:
        """The equations of a state, and its columns of a solution."""
        if not self.held_modes:
            given = erring.motion(model, self.sensors[0], self.harmonic_order)
            seen = self.sensors, self.orders
            return given, lambda point: residual_columns(erring, given, point, *seen)
        held = HeldModes(self.held_modes, self.sensors, (1, *self.orders))
        motion = held_motion(erring, model, held, self.harmonic_order)
        return motion, lambda point: columns_of_held(motion, erring.state, point)


class _Aim(NamedTuple):
    """What unknowns mean, and what holds them near zero, where they all begin.

    An unknown is a parameter's change relative to its start, or its value where that is zero, or
    what a level shares in units of 1σ.
    """

    values: Float[Array, " parameter"]
    weight: Float[Array, " parameter"]  # 1/σ, 0 where there is none
    level_std: Float[Array, " error"]

    def parameters(self, unknowns: Float[Array, " unknown"]) -> Float[Array, " parameter"]:
        """The parameters themselves."""
        changes = unknowns[: self.values.shape[0]]
        return jnp.where(self.values != 0, self.values * (1 + changes), changes)

    def misses(self, unknowns: Float[Array, " unknown"]) -> Float[Array, " unknown"]:
        """Residuals of the unknowns themselves."""
        off = (self.parameters(unknowns) - self.values) * self.weight
        return jnp.append(off, unknowns[off.shape[0] :])


class _Slopes(NamedTuple):
    """All states at some unknowns, and their derivatives."""

    points: Float[Array, "state entry"]
    columns: Float[Array, "state column"]
    by_unknown: Float[Array, "state column unknown"]
    by_error: Float[Array, "state column input"]
    points_by_unknown: Float[Array, "state entry unknown"]


def calibrate_model(
    model: Structure,
    data: SteadyStates,
    parameters: Sequence[str],
    *,
    harmonic_order: int = 9,
    level_gain_std: float = 0.0,
    level_phase_std: float = 0.0,
    priors: bool = False,
    held_modes: Sequence[int] = (),
) -> CalibratedModel:
    """Fit parameters of a model to measured steady states of all levels at once.

    Minimises the whitened sum of squares of (F_model − F)/F over the states, F_model being the
    complex force with which the model has the measured frequency and fundamental velocity
    (`inverse_force`), and of the differences at other sensors and of harmonics with a stated
    error. The covariance of a state's residuals follows from the stated errors of force, velocity
    and phase; it is taken anew where a fit ended. Levenberg–Marquardt, with the balance's exact
    derivatives.

    Arguments: `model` gives the start and all that is not fitted; `parameters` are out of
    `parameter_names`. `level_gain_std` (relative) and `level_phase_std` (rad) are 1σ of errors
    that all velocities of a level share: they become unknowns. With `priors` the standard
    deviations that the model states for fitted parameters hold them near their start.
    Returns a `CalibratedModel`: a fit that did not converge says so in its status and notes. A
    state for which no balanced motion is found has no weight and is named there too. Where errors
    of velocity are not stated for all states, equal relative ones are taken for all and their size
    found from the residuals.
    `held_modes` (counted from 0) are modes that may exchange energy: their motions at all recorded
    orders are held as the sensors have them, of as many modes as there are sensors, and the forces
    that are left on each are the residual. Inside an internal resonance no branch has then to be
    chosen. Every state needs all sensors.
    Raises `ValueError` for unknown or repeated names, for sensors other than the model's, for an
    unknown force or phase, for levels' errors below zero and for too few data.
    Validity: motions with the period of the force. Errors of velocity enter to first order. Inside
    an internal resonance several motions have one fundamental; without `held_modes` the one that
    grows from small amplitudes is taken.
    Not differentiable: differentiate `inverse_force`.
    Reference: the formulation is this package's own.
    """
    names = checked_names(model, parameters)
    level_std = {"gain": level_gain_std, "phase": level_phase_std}
    for name, value in level_std.items():
        if not 0 <= value < np.inf:
            raise ValueError(f"`level_{name}_std` must be zero or positive, but is {value}.")
    check_phases(data, "a calibration")
    chosen = calibration_states(model, data, harmonic_order)
    held: tuple[tuple[int, ...], ...] = ()
    if held_modes:
        _check_held(model, tuple(held_modes))
        chosen = held_columns(chosen)
        typical = float(np.median(np.asarray(chosen.states.frequency)))
        orders = (1, *chosen.orders)
        held = held_at_orders(model, held_modes, typical, orders, len(chosen.sensors))
    shared = tuple(name for name, value in level_std.items() if value > 0)
    picked = (chosen.sensors, chosen.orders, harmonic_order, shared, chosen.n_levels)
    settings = _Settings(names, *picked, held)
    prior_std = np.array([stated_std(model, name) if priors else 0.0 for name in names])
    weight = np.divide(1.0, prior_std, out=np.zeros(len(names)), where=prior_std > 0)
    n_rows = int(chosen.states.known.sum()) + int(np.sum(weight > 0))
    if n_rows <= len(names):
        raise ValueError(
            f"{len(names)} parameters need more than {len(names)} data, but {len(chosen.rows)} "
            f"usable states give {n_rows}."
        )
    aim = _Aim(
        values=jnp.stack([parameter_value(model, name) for name in names]),
        weight=jnp.asarray(weight),
        level_std=jnp.array([level_std[name] for name in shared]),
    )
    return _result(model, data.n_states, chosen, settings, aim)


def _check_held(model: Structure, modes: tuple[int, ...]) -> None:
    if len(set(modes)) < len(modes) or not set(modes) <= set(range(model.n_modes)):
        raise ValueError(
            f"`held_modes` must be different modes from 0 to {model.n_modes - 1}, but is {modes}."
        )


@compiled
def _grown(
    model: Structure,
    states: CalibrationStates,
    settings: _Settings,
    parameters: Float[Array, " parameter"],
) -> Float[Array, "state entry"]:
    """Solutions for the measured velocities, grown from small amplitudes."""
    model = with_parameters(model, settings.names, parameters)

    def one(state: CalibrationStates) -> Array:
        exact = StateWithErrors(state, 1.0, jnp.zeros_like(state.error))
        return settings.motion(model, exact)[0].grown()

    return mapped(one, states)


def _columns(
    model: Structure,
    state: CalibrationStates,
    settings: _Settings,
    aim: _Aim,
    unknowns: Float[Array, " unknown"],
    error: Float[Array, " input"],
    near: Float[Array, " entry"],
) -> tuple[Float[Array, " column"], Float[Array, " entry"]]:
    """Columns of one state, and the solution behind them.

    `error` adds to the logarithms of force and velocities and to the phases: for derivatives.
    """
    p = len(settings.names)
    model = with_parameters(model, settings.names, aim.parameters(unknowns))
    level = unknowns[p:].reshape(settings.n_levels, len(settings.shared))[state.level]
    shared = dict(zip(settings.shared, level * aim.level_std, strict=True))
    factor = jnp.exp(-shared.get("gain", 0.0) - 1j * shared.get("phase", 0.0))
    erring = StateWithErrors(state, factor, error)
    motion, columns = settings.motion(model, erring)
    point = motion.solved(near)
    return columns(point), point


@compiled
def _slopes(
    model: Structure,
    states: CalibrationStates,
    settings: _Settings,
    aim: _Aim,
    unknowns: Float[Array, " unknown"],
    near: Float[Array, "state entry"],
) -> _Slopes:
    def one(state: CalibrationStates, start: Array) -> _Slopes:
        def both(unknowns: Array, error: Array) -> tuple:
            columns_and_point = _columns(model, state, settings, aim, unknowns, error, start)
            return columns_and_point, columns_and_point

        slopes = jax.jacfwd(both, argnums=(0, 1), has_aux=True)
        (columns, points), (value, point) = slopes(unknowns, jnp.zeros_like(state.error))
        return _Slopes(point, value, columns[0], columns[1], points[0])

    return mapped(one, states, near)


class _Linear(NamedTuple):
    """The whitened problem at some unknowns."""

    residuals: Float[np.ndarray, " row"]
    jacobian: Float[np.ndarray, "row unknown"]
    slopes: _Slopes


class _Fitted(NamedTuple):
    unknowns: np.ndarray
    residuals: Float[np.ndarray, "state column"]
    jacobian: Float[np.ndarray, "row unknown"]
    usable: Bool[np.ndarray, " state"]
    status: MinimisationStatus


def _fitted(model: Structure, states: CalibrationStates, settings: _Settings, aim: _Aim) -> _Fitted:
    """Fit, whiten anew where the fit ended, and fit again."""
    subject = (model, states, settings)
    unknowns = np.zeros(len(settings.names) + settings.n_levels * len(settings.shared))
    status, relative = MinimisationStatus.NOT_FITTED, np.asarray(aim.values) != 0
    slopes = _slopes(*subject, aim, jnp.asarray(unknowns), _grown(*subject, aim.values))
    for turn, (step, harmonic_error, settled) in enumerate(_ROUNDS):
        lost = ~np.isfinite(np.asarray(slopes.points[:, -1]))
        if turn and lost.any():
            grown = _grown(*subject, aim.parameters(jnp.asarray(unknowns)))
            again = jnp.where(lost[:, None], grown, slopes.points)
            slopes = _slopes(*subject, aim, jnp.asarray(unknowns), again)
        whiten = np.asarray(state_whitener(states, slopes.by_error, jnp.asarray(harmonic_error)))
        hold = np.append(relative / step, np.zeros(len(unknowns) - len(relative)))
        end = _settled(subject, aim, unknowns, slopes, whiten, hold, settled)
        unknowns, slopes, status = end.point, end.linearised.slopes, end.status
    if not np.any(whiten):
        status = MinimisationStatus.NOT_FINITE
    return _Fitted(
        unknowns=unknowns,
        residuals=whitened_columns(whiten, np.asarray(slopes.columns)),
        jacobian=_jacobian(whiten, slopes, aim),
        usable=np.any(whiten != 0, axis=(1, 2)),
        status=status,
    )


def _settled(
    subject: tuple[Structure, CalibrationStates, _Settings],
    aim: _Aim,
    begin: Float[np.ndarray, " unknown"],
    slopes: _Slopes,
    whiten: Float[np.ndarray, "state column column"],
    hold: Float[np.ndarray, " unknown"],
    settled: float,
) -> Minimum[_Linear]:
    """The best unknowns with states whitened like this, held near where they begin."""

    def linear(unknowns: np.ndarray, at: _Slopes) -> _Linear:
        columns = whitened_columns(whiten, np.asarray(at.columns)).reshape(-1)
        misses = np.asarray(aim.misses(jnp.asarray(unknowns)))
        jacobian = np.concatenate([_jacobian(whiten, at, aim), np.diag(hold)])
        return _Linear(np.concatenate([columns, misses, hold * (unknowns - begin)]), jacobian, at)

    def evaluate(trials: np.ndarray) -> list[_Linear]:
        # A state that is lost on the way is NaN: a smaller step is then taken.
        near = [slopes.points + slopes.points_by_unknown @ (trial - begin) for trial in trials]
        return [
            linear(trial, _slopes(*subject, aim, jnp.asarray(trial), start))
            for trial, start in zip(trials, near, strict=True)
        ]

    anywhere = np.full(len(begin), -np.inf), np.full(len(begin), np.inf)
    rule = dataclasses.replace(_RULE, settled=settled)
    return minimise(evaluate, begin[None], [linear(begin, slopes)], anywhere, rule)[0]


def _jacobian(whitener: np.ndarray, slopes: _Slopes, aim: _Aim) -> np.ndarray:
    by_unknown = np.asarray(slopes.by_unknown)
    of_states = whitened_columns(whitener, by_unknown).reshape(-1, by_unknown.shape[-1])
    values, weight = np.asarray(aim.values), np.asarray(aim.weight)
    of_parameters = np.where(values != 0, values, 1.0) * weight
    shared = np.ones(by_unknown.shape[-1] - len(values))
    return np.concatenate([of_states, np.diag(np.append(of_parameters, shared))])


def _result(
    model: Structure, n_states: int, chosen: ComparedColumns, settings: _Settings, aim: _Aim
) -> CalibratedModel:
    fit = _fitted(model, chosen.states, settings, aim)
    names, p, usable = settings.names, len(settings.names), fit.usable
    known = np.asarray(chosen.states.known) & usable[:, None]
    freedom = int(known.sum()) + int(np.sum(np.asarray(aim.weight) > 0)) - p
    square = np.sum(fit.residuals**2) + np.sum(
        np.asarray(aim.misses(jnp.asarray(fit.unknowns))) ** 2
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
    chosen: ComparedColumns, names: tuple[str, ...], fit: _Fitted, reduced: float, margin: float
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
    blind = tuple(name for name, slope in slopes if not slope.any())
    if blind:
        notes.append(Fact("parameters_without_data", names=blind))
    return notes


def _inverse_of_square(jacobian: np.ndarray) -> np.ndarray:
    """(JᵀJ)⁻¹; infinite for what has no influence."""
    seen = np.any(jacobian != 0, axis=0)
    inverse = np.diag(np.where(seen, 0.0, np.inf))
    inverse[np.ix_(seen, seen)] = inverse_of(jacobian[:, seen])
    return inverse
