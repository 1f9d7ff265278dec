"""The misfit of a model to measured states, in units of noise: what effects are fitted to."""

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
    """What the model as given predicts of the measured states."""

    columns: Float[np.ndarray, "state column"]
    force: Complex[np.ndarray, " state"]  # over the measured one


class ErrorPropagation(NamedTuple):
    """What errors make of the misfit, as some model passes them on.

    `slopes` are those by the baseline's uncertain parameters, times their 1σ, and last by natural
    frequency and damping ratio of the mode of interest.
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
    passed_on: ErrorPropagation  # as the noise has it: of the baseline, or of a fitted answer
    noise: NoiseModel
    base: Float[np.ndarray, " row"]
    by_linear: Float[np.ndarray, "row two"]  # by natural frequency and damping ratio

    @property
    def model(self) -> Structure:
        """The baseline."""
        return self.predictions.model

    @property
    def n_rows(self) -> int:
        """How many numbers were measured."""
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
        """Most likely values of the baseline's uncertain parameters, from misfits of some fit.

        By all rows, or by the rows `kept`.
        """
        moved = self.noise.shared_errors(rows, kept)
        stated = self.predictions.stated
        return {
            name: value + std * step
            for (name, (value, std)), step in zip(
                stated.items(), moved[: len(stated)].tolist(), strict=True
            )
        }

    def evaluated(
        self, labels: Sequence[str], values: Float[np.ndarray, "trial parameter"]
    ) -> tuple[Float[np.ndarray, "trial row"], Float[np.ndarray, "trial row parameter"]]:
        """Rows for trial values of some parameters, and their slopes by them."""
        found = self.predictions.of(self.predictions.group.at(labels, values), labels)
        rows = self.noise.noise_units(found.columns)
        slopes = self.noise.noise_units(np.moveaxis(found.slopes, 3, 0))
        return rows, np.moveaxis(slopes, 0, 2)

    def reweighted(self, passed_on: ErrorPropagation) -> "WeightedMisfit":
        """The same misfit with errors passed on in another way."""
        passed_on = _by_reference(self.predictions, passed_on)
        return _weighted(self.predictions, self.baseline, self.errors, passed_on)

    def about(
        self, predictions: Predictions, values: Float[np.ndarray, " parameter"]
    ) -> "WeightedMisfit":
        """The misfit of the records made straight about corrected ones, which `predictions` are of.

        Errors are passed on as a model with effects of some `values` does there.
        """
        plain = dataclasses.replace(predictions, offset=None)
        there = by_baseline(plain, values)
        by_error, phasors = plain.by_error(values)
        by_error = by_error + _of_missing_force(plain, there.columns[0], by_error)
        lost = ~np.isfinite(by_error).all(axis=(1, 2))
        by_error[lost] = self.passed_on.by_error[lost]
        predictions = plain.carried_back(by_error)
        baseline, slopes = _baseline_of(predictions)
        slopes_there = np.where(np.isfinite(there.slopes[0]), there.slopes[0], slopes)
        errors = self.errors._replace(slopes=slopes)
        passed_on = ErrorPropagation(by_error, phasors, slopes_there)
        return _weighted(predictions, baseline, errors, passed_on)

    def with_states(self, chosen: ComparedColumns) -> "WeightedMisfit":
        """The same states under other errors."""
        predictions = dataclasses.replace(self.predictions, chosen=chosen)
        return _weighted(predictions, self.baseline, self.errors, self.passed_on)


def weighted_misfit(predictions: Predictions) -> WeightedMisfit:
    """The baseline's misfit, weighted with the stated noise.

    Errors of the force are passed on as smooth curves do (`misfit.reference`), all else as the
    baseline does.
    """
    plain = dataclasses.replace(predictions, offset=None)
    baseline, slopes = _baseline_of(plain)
    errors = ErrorPropagation(*plain.by_error(plain.group.values), slopes)
    missing = _of_missing_force(plain, baseline.columns, errors.by_error)
    passed_on = _by_reference(plain, errors._replace(by_error=errors.by_error + missing))
    if np.any(plain.added):
        plain = plain.carried_back(passed_on.by_error)
        baseline, _ = _baseline_of(plain)
    return _weighted(plain, baseline, errors, passed_on)


def _baseline_of(
    predictions: Predictions,
) -> tuple[BaselinePrediction, Float[np.ndarray, "state column direction"]]:
    found = by_baseline(predictions, predictions.group.values)
    return BaselinePrediction(found.columns[0], found.phasors[0, :, 0]), found.slopes[0]


def by_baseline(predictions: Predictions, values: Float[np.ndarray, " parameter"]) -> Predicted:
    """Slopes by the baseline's uncertain parameters, times 1σ, and by the linear mode's two.

    Of these by its natural frequency as stiffness changes it: 2ζω stays as it is.
    """
    stated, modes = predictions.stated, predictions.model.modes
    j = modes.mode_of_interest
    two = (f"mode_{j + 1}.natural_frequency", f"mode_{j + 1}.damping_ratio")
    found = predictions.of(values[None], (*stated, *two))
    fraction = modes.damping_ratio.item(j) / modes.natural_frequency.item(j)
    found.slopes[..., -2] -= fraction * found.slopes[..., -1]
    std = np.array([*(std for _, std in stated.values()), 1.0, 1.0])
    return found._replace(slopes=found.slopes * std)


def _of_missing_force(
    predictions: Predictions,
    columns: Float[np.ndarray, "state column"],
    by_error: Float[np.ndarray, "state column input"],
) -> Float[np.ndarray, "state column input"]:
    """What errors of the velocity do to the part of the force that a model lacks.

    That force turns with the velocity, and is taken to grow with it: a model that lacks most of the
    damping would otherwise pass on too little of the errors.
    """
    sensors = np.asarray(predictions.chosen.states.velocity).shape[1]
    missing = -(columns[:, 0] + 1j * columns[:, 1])
    change = np.zeros_like(by_error)
    for place, part in ((1, missing), (1 + sensors, 1j * missing)):
        change[:, 0, place], change[:, 1, place] = part.real, part.imag
    known = np.asarray(predictions.chosen.states.known)
    return np.where(known[:, :, None], change, 0.0)


def _by_reference(predictions: Predictions, passed_on: ErrorPropagation) -> ErrorPropagation:
    """Errors of the force passed on as smooth curves do, where these are known."""
    reference = predictions.reference
    if reference is None:
        return passed_on
    n_sensors = np.asarray(predictions.chosen.states.velocity).shape[1]
    changed = passed_on.by_error.copy()
    for place, slope in ((1, reference.by_velocity), (1 + n_sensors, reference.by_phase)):
        changed[reference.rows, 0, place] = slope.real
        changed[reference.rows, 1, place] = slope.imag
    return passed_on._replace(by_error=changed)


def _weighted(
    predictions: Predictions,
    baseline: BaselinePrediction,
    errors: ErrorPropagation,
    passed_on: ErrorPropagation,
) -> WeightedMisfit:
    """Weighted as errors are `passed_on`."""
    noise = _noise(predictions, passed_on)
    base = noise.noise_units(baseline.columns[None])[0]
    linear = noise.noise_units(np.moveaxis(passed_on.slopes[:, :, -2:], 2, 0)).T
    return WeightedMisfit(predictions, baseline, errors, passed_on, noise, base, linear)


def _noise(predictions: Predictions, passed_on: ErrorPropagation) -> NoiseModel:
    """The noise of states with errors of the baseline model and of whole levels."""
    states, n_levels = predictions.chosen.states, predictions.chosen.n_levels
    level, n = np.asarray(states.level), np.asarray(states.velocity).shape[1]
    base, by_linear = passed_on.slopes[:, :, :-2], passed_on.slopes[:, :, -2:]
    by_error, force = passed_on.by_error, passed_on.by_error[:, :, :1]
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
    whiten, known = predictions.whitened_for(by_error, passed_on.phasors)
    rows = np.asarray(whitened_columns(whiten, np.concatenate(shared, axis=2)))[known]
    shared_kind = np.append(np.full(of_no_level, -1), np.repeat(kinds, n_levels)).astype(int)
    return NoiseModel(whiten, known, shared_covariance(rows), shared_kind, *np.nonzero(known))
