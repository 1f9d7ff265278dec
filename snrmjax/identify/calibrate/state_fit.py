"""A model fitted to states by inverse harmonic balance: rounds of whitening and fitting."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from snrmjax.identify.calibrate.calibration_states import (
    CalibrationStates,
    state_whitener,
    whitened_columns,
)
from snrmjax.identify.calibrate.inverse_force import StateWithErrors, residual_columns
from snrmjax.identify.calibrate.prescribed_modes import (
    PrescribedModes,
    PrescribedModesState,
    columns_of_prescribed,
    prescribed_mode_motion,
)
from snrmjax.model.parameters import with_parameters
from snrmjax.model.structures import Structure
from snrmjax.numerics.blocks import mapped
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.levenberg_marquardt import MinimisationStatus, Minimum, StepRule, minimise
from snrmjax.simulate.balance.prescribed_motion import PrescribedMotion


class _Round(NamedTuple):
    """One round of fitting, before the residuals are whitened anew.

    In the first rounds, far from the solution, poorly determined parameters stay within a relative
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
_CORRECTIONS = 8  # largest number of corrections of the records for their errors
_UNMOVED = 1e-4  # relative change of χ² below which corrections stop
_RULE = StepRule(steps=60)


class FitSettings(NamedTuple):
    """Static settings of the compiled functions."""

    names: tuple[str, ...]
    sensors: tuple[int, ...]  # rows of the mode shapes, the reference sensor first
    orders: tuple[int, ...]  # harmonics that are compared
    harmonic_order: int
    shared: tuple[str, ...]  # errors common to all velocities of a level
    n_levels: int
    prescribed_modes: tuple[tuple[int, ...], ...] = ()  # with motions as measured, for each order

    def motion(
        self, model: Structure, erring: StateWithErrors
    ) -> tuple[PrescribedMotion | PrescribedModesState, Callable[[Array], Array]]:
        """The equations of a state, and the function from a solution to its columns."""
        if not self.prescribed_modes:
            given = erring.motion(model, self.sensors[0], self.harmonic_order)
            compared = self.sensors, self.orders
            return given, lambda point: residual_columns(erring, given, point, *compared)
        prescribed = PrescribedModes(self.prescribed_modes, self.sensors, (1, *self.orders))
        motion = prescribed_mode_motion(erring, model, prescribed, self.harmonic_order)
        return motion, lambda point: columns_of_prescribed(motion, erring.state, point)


class FitAim(NamedTuple):
    """Scaling and priors of the unknowns, which all start at zero.

    An unknown is a parameter's change relative to its start (its value where the start is zero) or
    an error common to a level in units of 1σ.
    """

    values: Float[Array, " parameter"]
    weight: Float[Array, " parameter"]  # 1/σ, 0 where there is none
    level_std: Float[Array, " error"]

    def parameters(self, unknowns: Float[Array, " unknown"]) -> Float[Array, " parameter"]:
        """The parameters themselves."""
        changes = unknowns[: self.values.shape[0]]
        return jnp.where(self.values != 0, self.values * (1 + changes), changes)

    def prior_residuals(self, unknowns: Float[Array, " unknown"]) -> Float[Array, " unknown"]:
        """Residuals of the priors."""
        off = (self.parameters(unknowns) - self.values) * self.weight
        return jnp.append(off, unknowns[off.shape[0] :])


class _Slopes(NamedTuple):
    """Solutions and columns of all states at given unknowns, and their derivatives."""

    points: Float[Array, "state entry"]
    columns: Float[Array, "state column"]
    by_unknown: Float[Array, "state column unknown"]
    by_error: Float[Array, "state column input"]
    points_by_unknown: Float[Array, "state entry unknown"]


@compiled
def _grown(
    model: Structure,
    states: CalibrationStates,
    settings: FitSettings,
    parameters: Float[Array, " parameter"],
) -> Float[Array, "state entry"]:
    """Solutions for the measured velocities, continued from small amplitudes."""
    model = with_parameters(model, settings.names, parameters)

    def one(state: CalibrationStates) -> Array:
        exact = StateWithErrors(state, 1.0, jnp.zeros_like(state.error))
        return settings.motion(model, exact)[0].grown()

    return mapped(one, states)


def _columns(
    model: Structure,
    state: CalibrationStates,
    settings: FitSettings,
    aim: FitAim,
    unknowns: Float[Array, " unknown"],
    error: Float[Array, " input"],
    near: Float[Array, " entry"],
) -> tuple[Float[Array, " column"], Float[Array, " entry"]]:
    """Columns of one state, and its solution.

    `error` adds to the logarithms of force and velocities and to the phases, for derivatives.
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
    settings: FitSettings,
    aim: FitAim,
    unknowns: Float[Array, " unknown"],
    near: Float[Array, "state entry"],
    errors: Float[Array, "state input"],
) -> _Slopes:
    def one(state: CalibrationStates, start: Array, error: Array) -> _Slopes:
        def both(unknowns: Array, error: Array) -> tuple:
            columns_and_point = _columns(model, state, settings, aim, unknowns, error, start)
            return columns_and_point, columns_and_point

        slopes = jax.jacfwd(both, argnums=(0, 1), has_aux=True)
        (columns, points), (value, point) = slopes(unknowns, error)
        return _Slopes(point, value, columns[0], columns[1], points[0])

    return mapped(one, states, near, errors)


class _Frame(NamedTuple):
    """Errors that the records are corrected for, their effect on the columns, and the whitening."""

    errors: Float[np.ndarray, "state input"]
    offset: Float[np.ndarray, "state column"]
    whiten: Float[np.ndarray, "state column column"]

    def whitened(self, columns: Float[np.ndarray, "state column"]) -> Float[np.ndarray, " row"]:
        """Columns without the effect of the errors, independent and of unit variance."""
        return whitened_columns(self.whiten, columns - self.offset)


class _Linear(NamedTuple):
    """The whitened problem, linearised at given unknowns."""

    residuals: Float[np.ndarray, " row"]
    jacobian: Float[np.ndarray, "row unknown"]
    slopes: _Slopes
    frame: _Frame


class FittedStates(NamedTuple):
    """End of a fit: unknowns, whitened residuals and their derivatives."""

    unknowns: np.ndarray
    residuals: Float[np.ndarray, "state column"]
    jacobian: Float[np.ndarray, "row unknown"]
    usable: Bool[np.ndarray, " state"]
    status: MinimisationStatus


class FittedSubject(NamedTuple):
    """A model and the states that it is fitted to."""

    model: Structure
    states: CalibrationStates
    settings: FitSettings
    aim: FitAim

    def grown(self, unknowns: np.ndarray) -> Float[Array, "state entry"]:
        """See `_grown`."""
        return _grown(*self[:3], self.aim.parameters(jnp.asarray(unknowns)))

    def slopes(self, unknowns: np.ndarray, near: Array, errors: np.ndarray) -> _Slopes:
        """See `_slopes`."""
        return _slopes(*self, jnp.asarray(unknowns), near, jnp.asarray(errors))

    def framed(self, slopes: _Slopes, errors: np.ndarray, harmonic_error: float = 0.0) -> _Frame:
        """The whitening from the sensitivities of the columns to errors of the records."""
        by_error = slopes.by_error
        whiten = np.asarray(state_whitener(self.states, by_error, jnp.asarray(harmonic_error)))
        offset = np.einsum("sci,si->sc", np.nan_to_num(np.asarray(by_error)), errors)
        return _Frame(errors, offset, whiten)

    def corrected(
        self, unknowns: np.ndarray, slopes: _Slopes, frame: _Frame
    ) -> tuple[_Slopes, _Frame]:
        """The records corrected for their most probable errors under these unknowns.

        Among all errors that leave no residual, those with the least weighted sum of squares
        (errors in variables). Otherwise a coefficient that multiplies a motion near the noise level
        is biased low.
        Reference: Boggs, Byrd & Schnabel, SIAM J. Sci. Stat. Comput. 8 (1987) 1052,
        doi:10.1137/0908085.
        """
        variance, before = np.asarray(self.states.error) ** 2, np.inf
        for _ in range(_CORRECTIONS):
            left = frame.whitened(np.asarray(slopes.columns))
            square = float(np.sum(left**2))
            if not abs(before - square) > _UNMOVED * square:
                break
            sensitivity = whitened_columns(frame.whiten, np.asarray(slopes.by_error))
            errors = -np.einsum("sci,sc->si", sensitivity, left) * variance
            slopes, before = self.slopes(unknowns, slopes.points, errors), square
            frame = self.framed(slopes, errors)
        return slopes, frame


def fitted_states(subject: FittedSubject) -> FittedStates:
    """Alternate fits and whitening; prescribed motions get a last round with corrected records."""
    settings, aim = subject.settings, subject.aim
    unknowns = np.zeros(len(settings.names) + settings.n_levels * len(settings.shared))
    status, relative = MinimisationStatus.NOT_FITTED, np.asarray(aim.values) != 0
    exact = np.zeros(subject.states.error.shape)
    slopes = subject.slopes(unknowns, subject.grown(unknowns), exact)
    frame = subject.framed(slopes, exact)
    rounds = (*_ROUNDS, *(_ROUNDS[-1:] if settings.prescribed_modes else ()))
    for number, (step, harmonic_error, settled) in enumerate(rounds):
        lost = ~np.isfinite(np.asarray(slopes.points[:, -1]))
        if number and lost.any():
            again = jnp.where(lost[:, None], subject.grown(unknowns), slopes.points)
            slopes = subject.slopes(unknowns, again, exact)
        frame = subject.framed(slopes, exact, harmonic_error)
        penalty = np.append(relative / step, np.zeros(len(unknowns) - len(relative)))
        correct = number >= len(_ROUNDS)
        end = _settled(subject, unknowns, slopes, frame, penalty, settled, correct=correct)
        unknowns, status = end.point, end.status
        _, _, slopes, frame = end.linearised
    if not np.any(frame.whiten):
        status = MinimisationStatus.NOT_FINITE
    return FittedStates(
        unknowns=unknowns,
        residuals=frame.whitened(np.asarray(slopes.columns)),
        jacobian=_jacobian(frame.whiten, slopes, aim),
        usable=np.any(frame.whiten != 0, axis=(1, 2)),
        status=status,
    )


def _settled(
    subject: FittedSubject,
    begin: Float[np.ndarray, " unknown"],
    slopes: _Slopes,
    frame: _Frame,
    penalty: Float[np.ndarray, " unknown"],
    settled: float,
    *,
    correct: bool,
) -> Minimum[_Linear]:
    """One minimisation; `penalty` weights the distance from `begin`.

    Arguments: `correct` re-estimates the records' errors at every trial.
    """
    aim = subject.aim

    def linear(unknowns: np.ndarray, at: _Slopes) -> _Linear:
        own = frame
        if correct:
            at, own = subject.corrected(unknowns, at, subject.framed(at, frame.errors))
        columns = own.whitened(np.asarray(at.columns)).reshape(-1)
        prior_residuals = np.asarray(aim.prior_residuals(jnp.asarray(unknowns)))
        jacobian = np.concatenate([_jacobian(own.whiten, at, aim), np.diag(penalty)])
        residuals = np.concatenate([columns, prior_residuals, penalty * (unknowns - begin)])
        return _Linear(residuals, jacobian, at, own)

    def evaluate(trials: np.ndarray) -> list[_Linear]:
        # A state whose solution is lost becomes NaN, which makes the minimiser shorten its step.
        near = [slopes.points + slopes.points_by_unknown @ (trial - begin) for trial in trials]
        return [
            linear(trial, subject.slopes(trial, start, frame.errors))
            for trial, start in zip(trials, near, strict=True)
        ]

    anywhere = np.full(len(begin), -np.inf), np.full(len(begin), np.inf)
    rule = dataclasses.replace(_RULE, settled=settled)
    return minimise(evaluate, begin[None], [linear(begin, slopes)], anywhere, rule)[0]


def _jacobian(whitener: np.ndarray, slopes: _Slopes, aim: FitAim) -> np.ndarray:
    by_unknown = np.asarray(slopes.by_unknown)
    of_states = whitened_columns(whitener, by_unknown).reshape(-1, by_unknown.shape[-1])
    values, weight = np.asarray(aim.values), np.asarray(aim.weight)
    of_parameters = np.where(values != 0, values, 1.0) * weight
    shared = np.ones(by_unknown.shape[-1] - len(values))
    return np.concatenate([of_states, np.diag(np.append(of_parameters, shared))])
