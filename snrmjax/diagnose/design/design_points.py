"""Steady states of a possible further test, and how well they would separate two models."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from snrmjax.diagnose.misfit.effect_fit import EffectFit, with_propagated_errors
from snrmjax.diagnose.misfit.noise_model import SharedCovariance, shared_covariance, unit_columns
from snrmjax.diagnose.misfit.predictions import Predicted, Predictions, predictions_of
from snrmjax.diagnose.misfit.programs import COMPARED
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit, weighted_misfit
from snrmjax.measure.states import SteadyStates, steady_states


class DesignPoints(NamedTuple):
    """States of a further test: scaled motions of a measured level."""

    level: int  # index, from zero
    scale: float  # of its velocities
    phase: Float[np.ndarray, " state"]  # rad


class PredictedTest(NamedTuple):
    """The states of a further test as one model predicts them, without noise."""

    misfit: WeightedMisfit
    members: tuple[Bool[np.ndarray, " state"], ...]  # the states of each set of design points
    force: tuple[float, ...]  # N at resonance, of each set
    frequency: tuple[float, ...]  # rad/s at resonance
    floor: float  # m/s, noise of harmonics

    def with_floor(self, floor: float) -> "PredictedTest":
        """The same test with another noise of the harmonics."""
        chosen = self.misfit.predictions.chosen
        std = chosen.states.own_std * (floor / self.floor)
        chosen = chosen._replace(states=chosen.states._replace(own_std=std))
        return self._replace(misfit=self.misfit.with_states(chosen), floor=floor)


def predicted_test(
    misfit: WeightedMisfit, fit: EffectFit, points: tuple[DesignPoints, ...], floor: float
) -> PredictedTest:
    """The states of a further test, predicted by a fitted model.

    The motion is prescribed and the force follows: velocities of a level are scaled, and the
    frequencies shifted to the wanted phases. The noise is the median of the measured states';
    `floor` is that of harmonics, m/s.
    """
    states = misfit.predictions.chosen.states
    level, velocity = np.asarray(states.level), np.asarray(states.velocity)[:, 0]
    speed, omega, member = [], [], []
    for number, one in enumerate(points):
        mine = level == one.level
        phase = np.angle(velocity[mine])
        order = np.argsort(phase)
        tip = np.abs(velocity[mine]) / np.maximum(np.cos(phase), 0.1)
        speed.append(one.scale * np.interp(one.phase, phase[order], tip[order]) * np.cos(one.phase))
        omega.append(np.interp(one.phase, phase[order], np.asarray(states.frequency)[mine][order]))
        member.append(np.full(len(one.phase), number))
    wanted = np.concatenate([point.phase for point in points])
    speeds, at, member_of = (np.concatenate(parts) for parts in (speed, omega, member))
    modes, j = misfit.model.modes, misfit.model.modes.mode_of_interest
    sensor = misfit.predictions.chosen.sensors[0]
    unit = float(modes.mode_shape[sensor, j] * modes.participation[j])
    data = _states(
        misfit, member_of, at, np.exp(1j * wanted) * speeds, np.ones(len(at)), None, floor
    )
    force, _ = _needed(misfit, fit, data)
    # Dynamic stiffness ω̃² − Ω² + iΩδ of the prescribed motion: Ω from tan φ = (ω̃² − Ω²)/(Ωδ).
    stiffness = unit * force / (np.exp(1j * wanted) * speeds / (1j * at))
    half = 0.5 * stiffness.imag / at * np.tan(wanted)
    square = stiffness.real + at**2 + half**2
    shifted = np.sqrt(np.maximum(square, 0.0)) - half
    at = np.where(np.isfinite(shifted) & (np.abs(shifted / at - 1) < 0.5), shifted, at)
    data = _states(
        misfit, member_of, at, np.exp(1j * wanted) * speeds, np.ones(len(at)), None, floor
    )
    force, harmonics = _needed(misfit, fit, data)
    valid = np.isfinite(np.abs(force)) & np.all(np.isfinite(harmonics), axis=1)
    rotation = np.exp(-1j * np.angle(force))
    seen = harmonics * rotation[:, None] ** np.array(COMPARED)
    own = np.exp(1j * wanted) * speeds * rotation
    predicted = _states(
        misfit, member_of[valid], at[valid], own[valid], np.abs(force)[valid], seen[valid], floor
    )
    before = misfit.predictions
    predictions = predictions_of(misfit.model, predicted, before.force_gain_std, kinds=before.kinds)
    rows = tuple(member_of[valid] == number for number in range(len(points)))
    phases = np.angle(np.asarray(predicted.velocity)[:, sensor])
    at_resonance = []
    # At zero phase; on the host, as on the device every number of states would compile.
    for column in map(np.asarray, (predicted.force, predicted.frequency)):
        own = []
        for mine in rows:
            order = np.flatnonzero(mine)[np.argsort(phases[mine])]
            known = order.size > 0
            own.append(float(np.interp(0.0, phases[order], column[order])) if known else np.nan)
        at_resonance.append(tuple(own))
    propagated = with_propagated_errors(weighted_misfit(predictions), fit)
    return PredictedTest(propagated, rows, at_resonance[0], at_resonance[1], floor)


def _states(
    misfit: WeightedMisfit,
    member_of: Int[np.ndarray, " state"],
    omega: Float[np.ndarray, " state"],
    velocity: Complex[np.ndarray, " state"],
    force: Float[np.ndarray, " state"],
    harmonics: Complex[np.ndarray, "state harmonic"] | None,
    floor: float,
) -> SteadyStates:
    """States of the reference sensor with the noise of the measured ones."""
    chosen, sensors = misfit.predictions.chosen, misfit.model.modes.sensors
    n, sensor = len(omega), chosen.sensors[0]
    error = np.median(np.asarray(chosen.states.error), axis=0)
    alone = np.zeros((n, len(sensors)))
    alone[:, sensor] = 1.0
    seen = np.zeros((n, len(COMPARED))) if harmonics is None else harmonics
    return steady_states(
        member_of,
        omega,
        force,
        alone * velocity[:, None],
        sensors=sensors,
        measured=alone > 0,
        velocity_std=error[1] * np.abs(velocity)[:, None] * alone,
        phase_std=error[1 + len(sensors)] * alone,
        force_std=error[0] * force,
        order=np.ones(n),  # after the former test
        harmonics=alone[:, :, None] * seen[:, None, :],
        harmonic_std=np.full((n, len(sensors)), floor),
        harmonic_order=COMPARED,
        base=misfit.model.modes.base,
    )


def _needed(
    misfit: WeightedMisfit, fit: EffectFit, data: SteadyStates
) -> tuple[Complex[np.ndarray, " state"], Complex[np.ndarray, "state harmonic"]]:
    """The force that a fit requires for motions, per newton recorded, and their harmonics."""
    predictions = predictions_of(misfit.model, data, kinds=misfit.predictions.kinds)
    linear = misfit.baseline_parameters(fit.rows)
    values = np.append(list(linear.values()), fit.values)
    columns = predictions.of(predictions.group.at((*linear, *fit.labels), values)[None]).columns[0]
    parts = columns[:, 0::2] + 1j * columns[:, 1::2]
    first = len(predictions.chosen.sensors)  # the reference sensor's harmonics come first
    higher = parts[:, first : first + len(COMPARED)]
    velocity = np.asarray(predictions.chosen.states.velocity)[:, 0]
    return 1.0 + parts[:, 0], higher * np.abs(velocity)[:, None]


def columns_of(predictions: Predictions, fit: EffectFit) -> Predicted | None:
    """Columns of all states for a fit's parameters; None where the group lacks an effect of it."""
    if not set(fit.labels) <= set(predictions.group.names):
        return None
    return predictions.of(predictions.group.at(fit.labels, fit.values)[None], fit.labels)


class Rows(NamedTuple):
    """Misfits in units of noise, and their slopes by the parameters of a fit."""

    left: Float[np.ndarray, " row"]
    slopes: Float[np.ndarray, "row parameter"]


class ModelRows(NamedTuple):
    """Rows of one model: measured states, their χ² after the fit, and a further test."""

    measured: Rows
    least: float
    further: Rows


def in_noise_units(misfit: WeightedMisfit, predicted: Predicted) -> Rows:
    """Predictions of one trial in units of noise."""
    slopes = misfit.noise.noise_units(np.moveaxis(predicted.slopes[0], 2, 0))
    return Rows(misfit.noise.noise_units(predicted.columns)[0], slopes.T)


def shared_by_both(
    old: WeightedMisfit, new: WeightedMisfit, kept: Bool[np.ndarray, " row"]
) -> Float[np.ndarray, "row shared"]:
    """Sensitivities to shared errors: the baseline's are common to both tests, the levels' not."""
    parts = old.noise.shared, new.noise.shared[kept]
    n = old.predictions.n_baseline_errors
    common, apart = [part[:, :n] for part in parts], [part[:, n:] for part in parts]
    widths = [part.shape[1] for part in apart]
    blank = np.zeros((len(parts[0]), widths[1])), np.zeros((len(parts[1]), widths[0]))
    return np.concatenate(
        [
            np.concatenate([common[0], apart[0], blank[0]], axis=1),
            np.concatenate([common[1], blank[1], apart[1]], axis=1),
        ]
    )


def refitted_chi_square(rows: Rows, covariance: SharedCovariance) -> float:
    """χ² after a refit of the parameters to all rows, to first order."""
    sensitivities, left = unit_columns(rows.slopes)[0], covariance.decorrelated(rows.left)
    sensitivities = covariance.decorrelated(sensitivities.T).T
    along, values, _ = np.linalg.svd(sensitivities, full_matrices=False)
    # Directions that no state determines are left out.
    along = along[:, values > 1e-12 * max(values.max(initial=0.0), 1.0)]
    return float(np.sum((left - along @ (along.T @ left)) ** 2))


def separation(
    old: WeightedMisfit,
    new: WeightedMisfit,
    truth: ModelRows,
    rival: ModelRows,
    kept: Bool[np.ndarray, " row"],
) -> float:
    """The gain in χ² of a rival over the assumed truth by some rows of a further test.

    Each is refitted to the measured and the further rows, with their shared errors. Rows for which
    one of the two has no motion are left out.
    """
    for _, _, rows in (truth, rival):
        kept = kept & np.isfinite(rows.left) & np.all(np.isfinite(rows.slopes), axis=1)
    covariance = shared_covariance(shared_by_both(old, new, kept))
    gains = []
    for before, least, after in (truth, rival):
        both = Rows(*(np.concatenate([a, b[kept]]) for a, b in zip(before, after, strict=True)))
        gains.append(refitted_chi_square(both, covariance) - least)
    return gains[1] - gains[0]
