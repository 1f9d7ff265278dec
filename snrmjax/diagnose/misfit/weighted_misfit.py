"""The misfit of a model to measured states in units of noise, to which effects are fitted."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from snrmjax.diagnose.misfit.noise_model import NoiseModel, shared_covariance
from snrmjax.diagnose.misfit.predictions import Predicted, Predictions
from snrmjax.identify.calibrate.calibration_states import ComparedColumns, whitened_columns
from snrmjax.model.structures import Structure


class BaselinePrediction(NamedTuple):
    """The given model's prediction of the measured states."""

    columns: Float[np.ndarray, "state column"]
    force: Complex[np.ndarray, " state"]  # over the measured force


class ErrorPropagation(NamedTuple):
    """Derivatives of the misfit by errors, as propagated through some model.

    `slopes`: by the baseline's uncertain parameters, times their 1σ, and last by natural frequency
    and damping ratio of the mode of interest.
    """

    by_error: Float[np.ndarray, "state column input"]
    phasors: Complex[np.ndarray, "state part"]
    slopes: Float[np.ndarray, "state column direction"]


@dataclasses.dataclass(frozen=True, eq=False)
class WeightedMisfit:
    """Misfit of the baseline model to measured states, and the noise that weights it.

    Rows are the measured numbers, in units of their own noise: real and imaginary part of the
    force, of other sensors' velocities and of harmonics, state by state.
    """

    predictions: Predictions
    baseline: BaselinePrediction
    errors: ErrorPropagation  # of the baseline itself
    propagated: ErrorPropagation  # as used for the noise: of the baseline or of a fitted answer
    noise: NoiseModel
    base: Float[np.ndarray, " row"]
    by_linear: Float[np.ndarray, "row two"]  # by natural frequency and damping ratio

    @property
    def model(self) -> Structure:
        """The baseline."""
        return self.predictions.model

    @property
    def n_rows(self) -> int:
        """Number of measured values."""
        return len(self.base)

    @property
    def level_numbers(self) -> Int[np.ndarray, " level"]:
        """Numbers of the levels in the data."""
        return np.unique(self.predictions.level_numbers)

    def chi_square(self, rows: Float[np.ndarray, " row"]) -> float:
        """χ² of misfits in units of noise."""
        return float(np.sum(self.noise.decorrelated(rows) ** 2))

    def baseline_parameters(
        self, rows: Float[np.ndarray, " row"], kept: Bool[np.ndarray, " row"] | None = None
    ) -> dict[str, float]:
        """Most likely values of the baseline's uncertain parameters, from the misfits of a fit.

        From all rows, or from the rows `kept`.
        """
        shifts = self.noise.shared_errors(rows, kept)
        stated = self.predictions.stated
        return {
            name: value + std * step
            for (name, (value, std)), step in zip(
                stated.items(), shifts[: len(stated)].tolist(), strict=True
            )
        }

    def evaluated(
        self, labels: Sequence[str], values: Float[np.ndarray, "trial parameter"]
    ) -> tuple[Float[np.ndarray, "trial row"], Float[np.ndarray, "trial row parameter"]]:
        """Rows for trial values of some parameters, and derivatives by these."""
        predicted = self.predictions.of(self.predictions.group.at(labels, values), labels)
        rows = self.noise.noise_units(predicted.columns)
        slopes = self.noise.noise_units(np.moveaxis(predicted.slopes, 3, 0))
        return rows, np.moveaxis(slopes, 0, 2)

    def reweighted(self, propagated: ErrorPropagation) -> "WeightedMisfit":
        """The same misfit with another error propagation."""
        propagated = _by_reference(self.predictions, propagated)
        return _weighted(self.predictions, self.baseline, self.errors, propagated)

    def about(
        self, predictions: Predictions, values: Float[np.ndarray, " parameter"]
    ) -> "WeightedMisfit":
        """The misfit of the records, linearised about the corrected records of `predictions`.

        Errors are propagated through a model with the effects' `values` there.
        """
        plain = dataclasses.replace(predictions, offset=None)
        there = by_baseline(plain, values)
        by_error, phasors = plain.by_error(values)
        by_error = by_error + _of_missing_force(plain, there.columns[0], by_error)
        lost = ~np.isfinite(by_error).all(axis=(1, 2))
        by_error[lost] = self.propagated.by_error[lost]
        predictions = plain.referred_to_records(by_error)
        baseline, slopes = _baseline_of(predictions)
        slopes_there = np.where(np.isfinite(there.slopes[0]), there.slopes[0], slopes)
        errors = self.errors._replace(slopes=slopes)
        propagated = ErrorPropagation(by_error, phasors, slopes_there)
        return _weighted(predictions, baseline, errors, propagated)

    def with_states(self, chosen: ComparedColumns) -> "WeightedMisfit":
        """The same states with other errors."""
        predictions = dataclasses.replace(self.predictions, chosen=chosen)
        return _weighted(predictions, self.baseline, self.errors, self.propagated)


def weighted_misfit(predictions: Predictions) -> WeightedMisfit:
    """The baseline's misfit, weighted with the stated noise.

    Errors are propagated to the force through smooth curves (`misfit.reference`), to all else
    through the baseline.
    """
    plain = dataclasses.replace(predictions, offset=None)
    baseline, slopes = _baseline_of(plain)
    errors = ErrorPropagation(*plain.by_error(plain.group.values), slopes)
    missing = _of_missing_force(plain, baseline.columns, errors.by_error)
    propagated = _by_reference(plain, errors._replace(by_error=errors.by_error + missing))
    if np.any(plain.added):
        plain = plain.referred_to_records(propagated.by_error)
        baseline, _ = _baseline_of(plain)
    return _weighted(plain, baseline, errors, propagated)


def _baseline_of(
    predictions: Predictions,
) -> tuple[BaselinePrediction, Float[np.ndarray, "state column direction"]]:
    predicted = by_baseline(predictions, predictions.group.values)
    return BaselinePrediction(predicted.columns[0], predicted.phasors[0, :, 0]), predicted.slopes[0]


def by_baseline(predictions: Predictions, values: Float[np.ndarray, " parameter"]) -> Predicted:
    """Derivatives by the baseline's uncertain parameters, times 1σ, and by frequency and damping.

    The natural frequency varies by a change of stiffness: 2ζω is constant.
    """
    stated, modes = predictions.stated, predictions.model.modes
    j = modes.mode_of_interest
    two = (f"mode_{j + 1}.natural_frequency", f"mode_{j + 1}.damping_ratio")
    predicted = predictions.of(values[None], (*stated, *two))
    fraction = modes.damping_ratio.item(j) / modes.natural_frequency.item(j)
    predicted.slopes[..., -2] -= fraction * predicted.slopes[..., -1]
    std = np.array([*(std for _, std in stated.values()), 1.0, 1.0])
    return predicted._replace(slopes=predicted.slopes * std)


def _of_missing_force(
    predictions: Predictions,
    columns: Float[np.ndarray, "state column"],
    by_error: Float[np.ndarray, "state column input"],
) -> Float[np.ndarray, "state column input"]:
    """Derivatives, by velocity errors, of the part of the force that a model lacks.

    It is taken as proportional to the velocity phasor: otherwise a model that lacks most of the
    damping would propagate too little of the errors.
    """
    sensors = np.asarray(predictions.chosen.states.velocity).shape[1]
    missing = -(columns[:, 0] + 1j * columns[:, 1])
    change = np.zeros_like(by_error)
    for index, part in ((1, missing), (1 + sensors, 1j * missing)):
        change[:, 0, index], change[:, 1, index] = part.real, part.imag
    known = np.asarray(predictions.chosen.states.known)
    return np.where(known[:, :, None], change, 0.0)


def _by_reference(predictions: Predictions, propagated: ErrorPropagation) -> ErrorPropagation:
    """Errors propagated to the force through smooth curves, where these are known."""
    reference = predictions.reference
    if reference is None:
        return propagated
    n_sensors = np.asarray(predictions.chosen.states.velocity).shape[1]
    changed = propagated.by_error.copy()
    for index, slope in ((1, reference.by_velocity), (1 + n_sensors, reference.by_phase)):
        changed[reference.rows, 0, index] = slope.real
        changed[reference.rows, 1, index] = slope.imag
    return propagated._replace(by_error=changed)


def _weighted(
    predictions: Predictions,
    baseline: BaselinePrediction,
    errors: ErrorPropagation,
    propagated: ErrorPropagation,
) -> WeightedMisfit:
    """The misfit with the noise of the `propagated` errors."""
    noise = _noise(predictions, propagated)
    base = noise.noise_units(baseline.columns[None])[0]
    linear = noise.noise_units(np.moveaxis(propagated.slopes[:, :, -2:], 2, 0)).T
    return WeightedMisfit(predictions, baseline, errors, propagated, noise, base, linear)


def _noise(predictions: Predictions, propagated: ErrorPropagation) -> NoiseModel:
    """The noise of the states, with shared errors of the baseline model and of levels."""
    states, n_levels = predictions.chosen.states, predictions.chosen.n_levels
    level, n = np.asarray(states.level), np.asarray(states.velocity).shape[1]
    base, by_linear = propagated.slopes[:, :, :-2], propagated.slopes[:, :, -2:]
    by_error, force = propagated.by_error, propagated.by_error[:, :, :1]
    gain = predictions.force_gain_std * force
    shared = [
        base,
        *([gain] if np.any(gain) else []),
    ]
    of_no_level = sum(part.shape[2] for part in shared)
    member = (level[:, None] == np.arange(n_levels)).astype(float)
    inputs = (by_error[:, :, 1 : n + 1].sum(axis=2), by_error[:, :, n + 1 :].sum(axis=2))
    slopes, stds = (*inputs, *np.moveaxis(by_linear, 2, 0)), predictions.model.level_stds
    kinds = [k for k, std in enumerate(stds) if std > 0]
    shared += [stds[k] * slopes[k][:, :, None] * member[:, None, :] for k in kinds]
    whiten, known = predictions.whitened_for(by_error, propagated.phasors)
    rows = np.asarray(whitened_columns(whiten, np.concatenate(shared, axis=2)))[known]
    shared_kind = np.append(np.full(of_no_level, -1), np.repeat(kinds, n_levels)).astype(int)
    return NoiseModel(whiten, known, shared_covariance(rows), shared_kind, *np.nonzero(known))
