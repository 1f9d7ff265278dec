"""Fits of effects to a weighted misfit, linearised about the corrected records.

A gain error of 15 % acts on a stop or a steep curve beyond first order, and so may the error of a
single state. The model is therefore evaluated at the records less their estimated errors, and the
misfit is linearised from there to the records, so that the errors keep their priors (orthogonal
distance regression: Boggs, Byrd & Schnabel, doi:10.1137/0908085).
"""

import dataclasses
import logging
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.diagnose.misfit.candidates import EffectCandidate, coordinates, parameter_labels
from snrmjax.diagnose.misfit.noise_model import chi_square_p_value
from snrmjax.diagnose.misfit.predictions import Predictions, scales_of
from snrmjax.diagnose.misfit.weighted_misfit import ErrorPropagation, WeightedMisfit, by_baseline
from snrmjax.measure.states import SteadyStates
from snrmjax.numerics.levenberg_marquardt import MinimisationStatus, StepRule, minimise

_log = logging.getLogger(__name__)

# An evaluation costs many motions, and poor fits need no precision.
_RULE = StepRule(
    steps=9,
    settled=0.02,
    damping=1e-2,
    eased=0.1,
    stiffened=20.0,
    largest_damping=1e4,
    screened=2,
    kept=2,
    trust_short_steps=True,
)


class EffectFit(NamedTuple):
    """One effect, or several together, fitted."""

    kinds: tuple[str, ...]
    labels: tuple[str, ...]
    values: Float[np.ndarray, " parameter"]
    chi_square: float
    rows: Float[np.ndarray, " row"]  # remaining misfits, in units of noise
    slopes: Float[np.ndarray, "row parameter"]
    lower: Float[np.ndarray, " parameter"]
    upper: Float[np.ndarray, " parameter"]
    status: MinimisationStatus = MinimisationStatus.NOT_FITTED

    def of_kind(self, kind: str) -> tuple[float, ...]:
        """The parameters of one of its effects."""
        pairs = zip(self.labels, self.values.tolist(), strict=True)
        return tuple(value for label, value in pairs if label.startswith(f"{kind}."))

    @property
    def criterion(self) -> float:
        """Schwarz's Bayesian information criterion, χ² + p ln n."""
        return self.chi_square + len(self.values) * float(np.log(max(len(self.rows), 1)))

    @property
    def p_value(self) -> float:
        """p-value of the remaining misfit."""
        return chi_square_p_value(self.chi_square, len(self.rows) - len(self.values))


class _Evaluated(NamedTuple):
    """The problem at one point: a `Linearisation` in fit coordinates."""

    values: Float[np.ndarray, " parameter"]
    rows: Float[np.ndarray, " row"]
    slopes: Float[np.ndarray, "row parameter"]
    by_coordinate: Float[np.ndarray, "row parameter"]
    residuals: Float[np.ndarray, " row"]  # of unit variance
    jacobian: Float[np.ndarray, "row parameter"]


def baseline_fit(misfit: WeightedMisfit) -> EffectFit:
    """The baseline without any effect."""
    empty, none = np.zeros((misfit.n_rows, 0)), np.zeros(0)
    square = misfit.chi_square(misfit.base)
    return EffectFit((), (), none, square, misfit.base, empty, none, none)


def fit_effect(
    misfit: WeightedMisfit,
    candidate: EffectCandidate,
    earlier: EffectFit | None = None,
) -> EffectFit:
    """The best fit of a candidate from all its starts, in addition to an earlier fit.

    All parameters are free, also those of `earlier`; `status` shows whether it is a minimum.
    """
    before = earlier or baseline_fit(misfit)
    labels = (*parameter_labels(candidate.kind), *before.labels)
    transform = coordinates(labels, scales_of(misfit.predictions).amplitude)
    n, m = len(candidate.unit), len(before.values)
    magnitude = np.where(before.values, np.abs(before.values), 1)
    unit = transform.inward(np.concatenate([candidate.unit, magnitude]))
    # Scaled coordinates have bounds zero and infinity: no transformation needed.
    lower = np.concatenate([candidate.lower, before.lower])
    upper = np.concatenate([candidate.upper, before.upper])

    def evaluated(values: np.ndarray) -> list[_Evaluated]:
        points = []
        together = misfit.evaluated(labels, values)
        for parameters, rows, slopes in zip(values, *together, strict=True):
            by = transform.slopes(parameters, slopes) * unit
            left, sensitivities = misfit.noise.decorrelated(rows), misfit.noise.decorrelated(by.T).T
            points.append(_Evaluated(parameters, rows, slopes, by, left, sensitivities))
        return points

    def linearised(points: np.ndarray) -> list[_Evaluated]:
        return evaluated(transform.outward(points * unit))

    starts = np.array(candidate.starts)
    all_starts = np.concatenate([starts, np.tile(before.values, (len(starts), 1))], axis=1)
    points, at_points = transform.inward(all_starts) / unit, evaluated(all_starts)
    for _ in range(3):
        lost = [t for t, one in enumerate(at_points) if not np.all(np.isfinite(one.residuals))]
        if not lost:
            break
        points[lost, 0] *= 0.3  # too strong: no motion of this amplitude
        for t, one in zip(lost, linearised(points[lost]), strict=True):
            at_points[t] = one
    ends = minimise(linearised, points, at_points, (lower / unit, upper / unit), _RULE)
    best = min(ends, key=lambda end: end.sum_of_squares)
    at, values = best.linearised, best.linearised.values
    if np.any(best.last_step):
        values = transform.outward(best.point * unit)
    order = [*range(n, n + m), *range(n)]
    return EffectFit(
        kinds=(*before.kinds, candidate.kind),
        labels=(*before.labels, *parameter_labels(candidate.kind)),
        values=values[order],
        chi_square=best.sum_of_squares,
        rows=at.rows + at.by_coordinate @ best.last_step,
        slopes=at.slopes[:, order],
        lower=lower[order],
        upper=upper[order],
        status=best.status,
    )


def with_propagated_errors(misfit: WeightedMisfit, fit: EffectFit) -> WeightedMisfit:
    """The misfit with errors propagated through the fitted model, also those of the baseline.

    An effect that scales or rotates a phasor also scales or rotates its errors.
    """
    predictions, known, values = misfit.predictions, misfit.errors, values_of(misfit, fit)
    if not fit.kinds:
        return misfit.reweighted(known)
    slopes = by_baseline(predictions, values).slopes[0]
    fitted = ErrorPropagation(*predictions.by_error(values), slopes)
    changes = (np.where(np.isfinite(a - b), a - b, 0.0) for a, b in zip(fitted, known, strict=True))
    return misfit.reweighted(
        ErrorPropagation(*(a + b for a, b in zip(known, changes, strict=True)))
    )


def at_phases_of(misfit: WeightedMisfit, fit: EffectFit) -> WeightedMisfit:
    """The misfit with unknown phases set to those of a fit."""
    force = misfit.baseline.force
    if fit.kinds:
        force = misfit.predictions.of(values_of(misfit, fit)[None]).phasors[0, :, 0]
    return dataclasses.replace(misfit, predictions=misfit.predictions.with_phases(-np.angle(force)))


def values_of(misfit: WeightedMisfit, fit: EffectFit) -> Float[np.ndarray, " parameter"]:
    """The group's parameters with the values of a fit."""
    return misfit.predictions.group.at(fit.labels, fit.values)


def without_errors(
    misfit: WeightedMisfit,
    fit: EffectFit,
    data: SteadyStates,
    added: Float[np.ndarray, "state input"],
) -> WeightedMisfit:
    """The misfit linearised about the records with `added` corrections, for the values of a fit.

    `data`: the records as measured.
    """
    return misfit.about(misfit.predictions.of_records(data, added), values_of(misfit, fit))


def at_reference(old: Predictions, data: SteadyStates) -> Predictions:
    """Predictions at the records less the errors estimated by smooth curves, whatever the law.

    Fits of effects start from these.
    """
    reference = old.reference
    if reference is None or reference.posterior.states.force_is_free:
        return old
    posterior, error = reference.posterior, np.asarray(old.chosen.states.error)
    n_sensors = (error.shape[1] - 1) // 2
    added, level = np.zeros_like(error), posterior.states.level
    errors = posterior.corrections[:, 1:3] - posterior.level_errors[level][:, :2]
    added[reference.rows, 1 : n_sensors + 1] = errors[:, [0]]
    added[reference.rows, n_sensors + 1 :] = errors[:, [1]]
    return old.of_records(data, added)


def likely_errors(
    misfit: WeightedMisfit, rows: Float[np.ndarray, " row"]
) -> Float[np.ndarray, "state input"]:
    """Corrections of log velocities and phases estimated by a fit, of levels and of states."""
    noise, states = misfit.noise, misfit.predictions.chosen.states
    level, error = np.asarray(states.level), np.asarray(states.error)
    n_inputs = error.shape[1]
    n_sensors = (n_inputs - 1) // 2
    score = np.zeros(noise.known.shape)
    score[noise.known] = noise.without_shared(rows)
    score = np.einsum("sij,si->sj", noise.whiten, score)
    added = -np.einsum("sci,sc->si", misfit.propagated.by_error, score) * error**2
    added[:, 0] = 0.0  # force errors act linearly: no correction
    shared_errors = noise.shared_errors(rows)
    ends = slice(1, 1 + n_sensors), slice(1 + n_sensors, n_inputs)
    for std, kind, own in zip(misfit.predictions.model.level_stds[:2], (0, 1), ends, strict=True):
        shared = shared_errors[noise.shared_kind == kind]
        if shared.size:
            added[:, own] += (std * shared[level])[:, None]
    unknown = np.asarray(misfit.predictions.chosen.phase_unknown)[:, 0]
    added[unknown] = 0.0  # magnitudes alone: no correction
    return np.where(np.isfinite(added), added, 0.0)
