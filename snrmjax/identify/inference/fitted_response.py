"""Forced responses of a joint fit, with their resonances and folds, all with bands."""

from typing import Any

import numpy as np
from jaxtyping import Float

from snrmjax.identify.inference.fitted_curves import as_backbone, values_at_displacement
from snrmjax.identify.inference.forced_motion import (
    FittedPoint,
    InitialPoint,
    banded_curve,
    located,
    turning_points,
)
from snrmjax.identify.joint.force_balance import with_deviations
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.pointwise.prediction import (
    LARGEST_AMPLITUDE_RATIO,
    PredictedResponse,
    predict_response,
    resonances,
)
from snrmjax.identify.pointwise.snrm import is_single, sensed_mode
from snrmjax.identify.prediction.new_level import NewLevel, new_level
from snrmjax.identify.prediction.resonance_distribution import (
    KnownCurves,
    ResonanceDistribution,
    amplitudes_to,
    covariance_root,
    other_modes,
    resonance_distribution,
)
from snrmjax.numerics.compiled import on_numbers
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.result import quantity
from snrmjax.numerics.units import HERTZ


class FittedResponse(PredictedResponse):
    """A response curve, in order along the branch, with 1σ.

    `resonances` and `folds` are those located by Newton's method; `not_located` are the others, at
    their approximate location on the interpolated curve, without a band.
    """

    frequency_std: Float[np.ndarray, " point"] = quantity("point", "Hz", "1σ at fixed amplitude")
    # Of the magnitude; large at folds.
    velocity_std: Float[np.ndarray, " point"] = quantity("point", "m/s", "1σ at fixed frequency")
    resonances: tuple[FittedPoint, ...]
    folds: tuple[FittedPoint, ...]
    not_located: tuple[FittedPoint, ...]
    sensor: str

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`."""
        hertz, speed = self.frequency / HERTZ, np.abs(self.velocity)
        return (
            f"FittedResponse to {self.force:.4g} N: {len(hertz)} points from {hertz.min():.6g} to "
            f"{hertz.max():.6g} Hz, up to {speed.max():.4g} m/s",
            *(
                f"{point.kind} at {point.frequency / HERTZ:.6g} ± "
                f"{point.frequency_std / HERTZ:.2g} Hz, {point.velocity:.4g} ± "
                f"{point.velocity_std:.2g} m/s"
                for point in (*self.resonances, *self.folds)
            ),
            f"{int(np.sum(~self.stable))} points unstable, {int(np.sum(self.continued))} beyond "
            f"the measured amplitudes, {len(self.not_located)} resonances or folds not located",
            *((f"note: {self.note}",) if self.note else ()),
        )

    def attributes(self) -> dict[str, str | float | int]:
        """See `AbstractResult`."""
        extra: dict[str, str | float | int] = {
            "sensor": self.sensor,
            "n_not_located": len(self.not_located),
        }
        return super().attributes() | extra


@on_numbers("Differentiate `sj.identify.refit`.")
def fitted_response(
    fit: JointFit,
    force: float,
    *,
    from_frequency: float = 0.0,
    to_frequency: float = np.inf,
    largest_amplitude_ratio: float = LARGEST_AMPLITUDE_RATIO,
    of: NewLevel | None = None,
) -> list[FittedResponse]:
    """Response curves under a force, with their resonances and folds, all with bands.

    Bands come from the implicit function theorem on |(ω̃² − Ω²) + iΩδ| X = |A|F: at fixed amplitude
    for the frequency, at fixed frequency for the velocity, and on both equations of a resonance or
    a fold. They are predictive for a new level: they include level-to-level variation.

    Arguments: `force` in N, frequencies in rad/s; curves end at `largest_amplitude_ratio` times
    the largest measured amplitude, extrapolated beyond the data; `of` the predicted level, by
    default `new_level`'s (`WITHOUT_LEVEL_ERRORS`: the fitted mode itself).
    Returns the connected curves, the main one first; resonances and folds are listed with the first
    curve that has them; `note` reports extrapolation.
    Raises `ValueError` for a force or a ratio that is not positive.
    Not differentiable: differentiate `snrmjax.identify.refit`.
    """
    ratio = {"largest_amplitude_ratio": largest_amplitude_ratio}
    level = new_level(fit, force) if of is None else of
    modes = level.modes(fit)
    interpolated = as_backbone(fit, reach=largest_amplitude_ratio).moved_by(level.over_test(fit))
    curves = predict_response(
        interpolated,
        modes,
        force,
        from_frequency=from_frequency,
        to_frequency=to_frequency,
        largest_amplitude_ratio=largest_amplitude_ratio,
    )
    peaks = [
        InitialPoint("resonance", r.amplitude, r.frequency)
        for r in resonances(interpolated, modes, force, **ratio)
        if from_frequency <= r.frequency <= to_frequency
    ]
    responses = []
    for number, curve in enumerate(curves):
        band = banded_curve(fit, force, curve.amplitude, curve.frequency, level)
        amplitude, frequency, velocity, frequency_std, velocity_std = band
        starts = [
            *(peaks if number == 0 else ()),
            *turning_points(curve.frequency, curve.amplitude),
        ]
        points = [located(fit, force, start, level) for start in starts]
        located_points = [point for point in points if point.located]
        missing = tuple(point for point in points if not point.located)
        responses.append(
            FittedResponse(
                force=force,
                frequency=frequency,
                velocity=velocity,
                amplitude=amplitude,
                stable=curve.stable,
                branch=curve.branch,
                continued=curve.continued,
                isolated=curve.isolated,
                notes=(*curve.notes, *_notes_on(missing, force)),
                frequency_std=frequency_std,
                velocity_std=velocity_std,
                resonances=tuple(point for point in located_points if point.kind == "resonance"),
                folds=tuple(point for point in located_points if point.kind == "fold"),
                not_located=missing,
                sensor=fit.modes.sensors[fit.data.sensor],
            )
        )
    return responses


def _notes_on(missing: tuple[FittedPoint, ...], force: float) -> tuple[Fact, ...]:
    points = tuple((point.kind, float(point.frequency) / HERTZ) for point in missing)
    return (Fact("points_not_located", points=points, force=force),) if points else ()


@on_numbers("Differentiate `sj.identify.refit`.")
def predicted_resonance(
    fit: JointFit,
    force: float,
    *,
    largest_amplitude_ratio: float = LARGEST_AMPLITUDE_RATIO,
    of: NewLevel | None = None,
    self_excited: bool = False,
) -> ResonanceDistribution:
    """Probability and distribution of a new level's resonance within an amplitude range.

    Curves are sampled from the fit's posterior with the errors of a new level (`new_level`). Beyond
    the data the bands widen as the curves are extrapolated.

    Arguments: `force` in N; the range ends at `largest_amplitude_ratio` times the largest measured
    amplitude; `of` the level, by default `new_level`'s; `self_excited` allows negative damping.
    Not differentiable: differentiate `snrmjax.identify.refit`.
    """
    new = new_level(fit, force) if of is None else of
    amplitude = amplitudes_to(fit.largest[0], largest_amplitude_ratio)

    values, slopes, *_ = values_at_displacement(fit, amplitude)
    root = covariance_root(fit.covariance)
    load: Any = force
    names = fit.names()
    by_load = -float(fit.prior.linear[-1]) * root[-1]
    if new.drive is not None:
        load = float(fit.force_of_drive(np.array(new.drive)))
        smallest = float(np.min(np.asarray(fit.data.force)))
        by = {"force_gain": 1 - float(fit.unknowns.force_offset) * smallest / load}
        by["force_offset"] = smallest / load
        by_load = by_load + sum(by[n] * root[names.index(n)] for n in by if n in names)
    constant = abs(float(fit.problem.constant_of(fit.unknowns)) * new.over_test(fit))
    modes = with_deviations(new.modes(fit), fit.unknowns.linear, fit.prior.linear)
    natural = np.sqrt(np.maximum(np.asarray(values)[:, 0], 0.0))
    if not is_single(modes):
        load = load * np.asarray(sensed_mode(modes, natural).ratio)
    return resonance_distribution(
        force,
        amplitude,
        KnownCurves(values, slopes @ root, constant * load, by_load),
        new,
        other_modes(modes, fit.data.sensor, force),
        ratio=largest_amplitude_ratio,
        gain_of_force=bool(fit.prior.gain_of_force > 0),
        self_excited=self_excited,
    )
