"""Parameters of a structure fitted to points of its backbone: dimensions, moduli, supports."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from snrmjax.identify.calibrate.calibrated_model import AbstractCalibration
from snrmjax.identify.pointwise.backbone_points import BackbonePoints
from snrmjax.identify.pointwise.inversion import PointStatus
from snrmjax.model.structures import Structure
from snrmjax.numerics.compiled import compiled, on_numbers
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.levenberg_marquardt import (
    MinimisationStatus,
    StepRule,
    minimise,
    root_of_inverse,
)
from snrmjax.numerics.result import Variable, quantity
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ
from snrmjax.simulate.solutions.mode_at_velocities import normal_mode_at_velocities

_LARGEST_LOG_CHANGE = np.log(10.0)  # of a parameter from its starting value, up or down
_RULE = StepRule(steps=200, settled=1e-6)
_ROUNDS = 3  # fits, each weighted with the slope dω/dv of the previous one

ModelOf = Callable[[dict[str, Any]], Structure]
"""Builds a model from parameter values by name, differentiable with respect to them."""


class MeasuredBackbone(NamedTuple):
    """Points of a backbone: natural frequency against velocity amplitude at the first sensor."""

    velocity: Float[np.ndarray, " point"]  # m/s
    frequency: Float[np.ndarray, " point"]  # rad/s
    frequency_std: Float[np.ndarray, " point"] | None = None  # rad/s; None: unknown, equal for all
    velocity_std: Float[np.ndarray, " point"] | None = None  # m/s; None: known exactly


class BackboneCalibration(AbstractCalibration):
    """Parameters of a structure fitted to a measured backbone; see `calibrate_to_backbone`.

    `residuals` are (measured − fitted frequency) over 1σ. `fitted_std` is 1σ of the fitted
    backbone, propagated from `covariance`.
    """

    measured: MeasuredBackbone
    # At the measured velocities.
    fitted: Float[np.ndarray, " point"] = quantity(
        "point", "Hz", "fitted", name="fitted_frequency_hz"
    )
    fitted_std: Float[np.ndarray, " point"] = quantity(
        "point", "Hz", "its 1σ", name="fitted_frequency_std_hz"
    )
    residuals: Float[np.ndarray, " point"] = quantity(
        "point", "1", "residual in units of 1σ", name="residual"
    )

    def data_in_words(self) -> str:
        """See `AbstractCalibration`."""
        return f"{len(self.fitted)} points of a backbone"

    def variables(self) -> dict[str, Variable]:
        """Those of the fields, with the measured backbone."""
        point, hertz = ("point",), self.measured.frequency / HERTZ
        return {
            **super().variables(),
            "velocity_m_s": Variable(point, self.measured.velocity, "m/s", "velocity amplitude"),
            "natural_frequency_hz": Variable(point, hertz, "Hz", "measured natural frequency"),
        }


class _Linear(NamedTuple):
    """The weighted least-squares problem, linearised at the current unknowns."""

    residuals: Float[np.ndarray, " row"]
    jacobian: Float[np.ndarray, "row unknown"]
    frequency: Float[np.ndarray, " point"]
    slope: Float[np.ndarray, " point"]  # dω/dv


@on_numbers("Differentiate `sj.simulate.normal_mode_at_velocities`.")
def calibrate_to_backbone(
    model_of: ModelOf,
    start: Mapping[str, float],
    measured: MeasuredBackbone | BackbonePoints,
    *,
    prior_std: Mapping[str, float] | None = None,
    harmonic_order: int = 5,
    steps: int = 4,
) -> BackboneCalibration:
    """Fit parameters of a structure, such as dimensions or support stiffnesses, to its backbone.

    Minimises Σ((ω_k − ω(v_k; p))/σ_k)² + Σ((p − p₀)/σ_p)², where ω(v; p) is the frequency of the
    nonlinear normal mode of `model_of(p)` at the velocity amplitude v, and σ_k² is the variance of
    the frequency plus (dω/dv)² times that of the velocity. Levenberg–Marquardt in log p, with exact
    derivatives through `model_of`.

    Arguments: `model_of` builds a model from parameter values by name, in JAX (for a beam file:
    `sj.io.read_beam_models`); `start` names the parameters to fit and their starting values
    (positive, SI units); `measured` backbone points, measured or identified; `prior_std` prior 1σ
    of starting values, for parameters that the backbone alone does not determine.
    Returns a `BackboneCalibration`; its status and notes report a fit that did not converge.
    Raises `ValueError` for a start that is not positive, for measured values that are not finite
    and positive, for fewer data than parameters and for an unknown name in `prior_std`.
    Validity: the model's first sensor is the measured one. Values stay within a factor of ten of
    their start. Standard deviations are linearised: with 1σ above 10 % the error may be several σ.
    The backbone of one mode determines its linear frequency, softening and hardening over the
    measured range: two or three parameters, not more.
    Not differentiable: differentiate `snrmjax.simulate.normal_mode_at_velocities`.
    Reference: errors in both coordinates ("effective variance"): J. Orear, Am. J. Phys. 50
    (1982) 912, doi:10.1119/1.12972.
    """
    names = tuple(start)
    begin = np.array([float(start[name]) for name in names])
    for name, value in zip(names, begin, strict=True):
        if not 0 < value < np.inf:
            raise InputError(f"`start` of {name} must be positive, but is {value:g}.")
    priors = dict(prior_std or {})
    for name, std in priors.items():
        if name not in names:
            raise InputError(f"`prior_std` names {name!r}, which `start` does not have.")
        if not 0 < std < np.inf:
            raise InputError(f"`prior_std` of {name} must be positive, but is {std:g}.")
    points = _checked(measured)
    n, freedom = len(points.velocity), len(points.velocity) + len(priors) - len(names)
    if not names or freedom < (1 if points.frequency_std is None else 0):
        raise InputError(f"{len(names)} parameters need more than the {n} points of a backbone.")
    prior = np.array([priors.get(name, np.inf) for name in names])
    settings = names, harmonic_order, steps

    def residual_std(slope: np.ndarray) -> np.ndarray:
        """1σ of every residual: frequency error and velocity error times slope."""
        frequency_std = np.ones(n) if points.frequency_std is None else points.frequency_std
        across = 0.0 if points.velocity_std is None else slope * points.velocity_std
        return np.hypot(frequency_std, across)

    def linear(unknown: np.ndarray, sigma: np.ndarray | None) -> _Linear:
        values = begin * np.exp(unknown)
        modal = _mode_frequencies(model_of, settings, values, points.velocity)
        frequency, by_value, slope = (np.asarray(part) for part in modal)
        sigma = residual_std(slope) if sigma is None else sigma
        rows = (frequency - points.frequency) / sigma, (values - begin) / prior
        slopes = by_value * values / sigma[:, None], np.diag(values / prior)
        return _Linear(np.concatenate(rows), np.concatenate(slopes), frequency, slope)

    unknown = np.zeros(len(names))
    limits = np.full(len(names), -_LARGEST_LOG_CHANGE), np.full(len(names), _LARGEST_LOG_CHANGE)
    for _ in range(_ROUNDS if points.velocity_std is not None else 1):
        sigma = residual_std(linear(unknown, None).slope)

        def evaluate(trials: np.ndarray, sigma: np.ndarray = sigma) -> list[_Linear]:
            return [linear(trial, sigma) for trial in trials]

        (end,) = minimise(evaluate, unknown[None], evaluate(unknown[None]), limits, _RULE)
        unknown = end.point
    return _outcome(model_of, names, points, begin * np.exp(unknown), end, sigma, freedom, prior)


@compiled
def _mode_frequencies(
    model_of: ModelOf,
    settings: tuple[tuple[str, ...], int, int],
    values: Float[Array, " parameter"],
    velocity: Float[Array, " point"],
) -> tuple[Array, Array, Array]:
    """Modal frequencies (rad/s), and their derivatives with respect to values and velocities."""
    names, harmonic_order, steps = settings

    def frequency(values: Array, shift: Array) -> tuple[Array, Array]:
        model = model_of(dict(zip(names, values, strict=True)))
        modes = normal_mode_at_velocities(
            model, velocity + shift, harmonic_order=harmonic_order, steps=steps
        )
        return modes.frequency, modes.frequency

    # Each frequency depends on its own velocity only: one common shift gives every dω/dv.
    by, frequencies = jax.jacfwd(frequency, argnums=(0, 1), has_aux=True)(values, jnp.zeros(()))
    return frequencies, *by


def _checked(measured: MeasuredBackbone | BackbonePoints) -> MeasuredBackbone:
    """The points as checked arrays, in their original order."""
    if isinstance(measured, BackbonePoints):
        solved = np.asarray(measured.status) == int(PointStatus.OK)
        std = np.asarray(measured.natural_frequency_std)[solved]
        points = MeasuredBackbone(
            np.asarray(measured.backbone_velocity)[solved],
            np.asarray(measured.natural_frequency)[solved],
            std if np.all(np.isfinite(std)) and std.size else None,
        )
    else:
        parts: Any = [None if part is None else _vector(part) for part in measured]
        points = MeasuredBackbone(*parts)
    n = len(points.velocity)
    for name, values in points._asdict().items():
        if values is None:
            continue
        if len(values) != n:
            raise InputError(f"`{name}` has {len(values)} values for {n} velocities.")
        least = 0.0 if name == "velocity_std" else np.finfo(float).tiny
        good: Bool[np.ndarray, " point"] = np.isfinite(values) & (values >= least)
        if not np.all(good):
            k = int(np.argmin(good))
            raise InputError(f"`{name}` must be positive, but point {k} has {values[k]:g}.")
    return points


def _vector(values: Float[ArrayLike, " point"]) -> Float[np.ndarray, " point"]:
    return np.atleast_1d(np.asarray(values, dtype=np.float64))


def _chosen(names: tuple[str, ...], which: np.ndarray) -> tuple[str, ...]:
    return tuple(name for name, there in zip(names, which, strict=True) if there)


def _of_parameters(
    names: tuple[str, ...], which: np.ndarray, prior: np.ndarray
) -> dict[str, tuple[str, ...] | bool]:
    """The selected parameters, and whether all of them have a prior."""
    stated = bool(np.all(np.isfinite(prior[which])))
    return {"names": _chosen(names, which), "prior_stated": stated}


def _outcome(
    model_of: ModelOf,
    names: tuple[str, ...],
    points: MeasuredBackbone,
    values: np.ndarray,
    end: Any,
    sigma: np.ndarray,
    freedom: int,
    prior: np.ndarray,
) -> BackboneCalibration:
    linear, n = end.linearised, len(sigma)
    reduced = end.sum_of_squares / freedom if freedom > 0 else np.nan
    finite = bool(np.all(np.isfinite(linear.jacobian)))
    root, notes = np.full((len(names),) * 2, np.nan), []
    relative = root
    if finite:
        root = root_of_inverse(linear.jacobian)
        margin = 3 * np.sqrt(2 / max(freedom, 1))
        stated = points.frequency_std is not None
        if freedom > 0 and (not stated or reduced > 1 + margin):
            root = root * np.sqrt(reduced)
        relative = root @ root.T
        if stated and reduced > 1 + margin:
            notes.append(Fact("calibration_noise", scale=float(np.sqrt(reduced))))
        vague = ~(np.diag(relative) < 1)
        if vague.any():
            notes.append(Fact("parameters_hardly_known", **_of_parameters(names, vague, prior)))
    if end.status == MinimisationStatus.NOT_FINITE:
        notes.append(Fact("no_mode_at_start"))
    elif not end.status.found_minimum:
        notes.append(Fact("calibration_not_converged"))
    at_limit = np.abs(np.abs(end.point) - _LARGEST_LOG_CHANGE) < 1e-9
    if at_limit.any():
        notes.append(Fact("parameters_at_limit", **_of_parameters(names, at_limit, prior)))
    return BackboneCalibration(
        model=model_of(dict(zip(names, values.tolist(), strict=True))),
        values=values,
        covariance=relative * values * values[:, None],
        measured=points,
        fitted=linear.frequency,
        fitted_std=np.linalg.norm(linear.jacobian[:n] @ root, axis=1) * sigma,
        residuals=-linear.residuals[:n],
        reduced_chi_square=float(reduced),
        names=names,
        noise_stated=points.frequency_std is not None,
        status=end.status,
        notes=tuple(notes),
    )
