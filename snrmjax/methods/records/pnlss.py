"""Polynomial nonlinear state-space model of a multisine test, and the nonlinear mode it implies.

The best linear approximation, with its noise and its scatter between realisations, gives a linear
model: poles by a subspace method, then all coefficients by least squares weighted by that scatter.
From this start a model with all monomials of the chosen degrees in its state equation is fitted to
the mean periods, in the frequency domain, weighted by noise and model error. Phase resonances of
the fitted model by harmonic balance give natural frequency and, from force over velocity, damping
against amplitude.

References: J. Paduart, L. Lauwers, J. Swevers, K. Smolders, J. Schoukens & R. Pintelon, Automatica
46 (2010) 647, doi:10.1016/j.automatica.2010.01.001; for nonlinear modes of such models,
arXiv:2011.08520.
"""

from collections.abc import Sequence

import jax
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.methods.records.state_space import hold, is_balanced, modal_constant, model_resonances
from snrmjax.methods.records.state_space_fit import StateSpaceFit, fit_state_space
from snrmjax.methods.result import (
    MethodPoint,
    MethodResult,
    MethodStatus,
    method_result,
    points_of_curves,
)
from snrmjax.model.modes import LinearModes
from snrmjax.numerics.facts import Fact

_POINTS = 25
_SMALLEST = 0.04  # of the largest velocity: first amplitude of the curves
_BEYOND = 1.2  # times the noise: a larger residual indicates a wrong model form


def pnlss(
    recordings: TimeRecording | Sequence[TimeRecording],
    force: str,
    motion: str,
    modes: LinearModes | None = None,
    *,
    order: int | None = None,
    degrees: tuple[int, ...] = (2, 3),
    period: float | None = None,
    skip: int = 1,
) -> MethodResult:
    """Natural frequency and damping against amplitude from a state-space model of a multisine test.

    At phase resonance of the model force F and velocity V are in phase: the frequency is ω̃, and
    2ζ̃ω̃ = a F/V with the model's modal constant a.

    Arguments and errors as in `fit_state_space`. Returns a `MethodResult` of 25 amplitudes up to
    the records' largest velocity, 1σ from the covariance of the fit. Amplitudes at which the
    fitted model has no phase resonance are `NO_RESONANCE`.
    """
    fit = fit_state_space(
        recordings, force, motion, modes,
        order=order, degrees=degrees, period=period, skip=skip,
    )  # fmt: skip
    amplitude = np.linspace(_SMALLEST, 1.0, _POINTS) * fit.largest
    resonances = model_resonances(fit.model, amplitude / fit.velocity_unit, fit.exponents, fit.mode)
    balanced = np.cumprod(np.asarray(is_balanced(resonances))).astype(bool)
    omega, ratio, omega_std, ratio_std = _curves(
        fit, np.asarray(resonances.angle), np.asarray(resonances.force), resonances.slopes
    )
    points = [
        point if known else MethodPoint(MethodStatus.NO_RESONANCE, -1)
        for point, known in zip(
            points_of_curves(amplitude, omega, omega_std, ratio, ratio_std), balanced, strict=True
        )
    ]
    notes = [
        Fact(
            "state_space_fitted",
            n_monomials=len(fit.exponents),
            misfit=fit.misfit,
            linear_misfit=fit.linear_misfit,
            validation=None if np.isnan(fit.validation) else fit.validation,
        )
    ]
    if fit.excess > _BEYOND:
        notes.append(Fact("misfit_beyond_noise", times=fit.excess))
    return method_result("pnlss", points, 0, notes)


def _curves(
    fit: StateSpaceFit, angle: np.ndarray, force: np.ndarray, slopes: Array
) -> Float[np.ndarray, "4 amplitude"]:
    """Natural frequency (rad/s), damping ratio, and 1σ of each."""
    flat, rebuild = ravel_pytree(fit.model)
    constant, constant_slopes = jax.value_and_grad(
        lambda coefficients: modal_constant(rebuild(coefficients), fit.mode)
    )(flat)
    ratio = float(constant) * force * hold(angle) / (2 * angle)
    angle_slopes, force_slopes = np.asarray(slopes)
    relative = (
        np.asarray(constant_slopes) / float(constant)
        + force_slopes / force[:, None]
        - angle_slopes / angle[:, None]
    )
    angle_std, relative_std = (
        np.sqrt(np.maximum(np.einsum("ki,ij,kj->k", slope, fit.covariance, slope), 0))
        for slope in (angle_slopes, relative)
    )
    return np.stack([angle * fit.rate, ratio, angle_std * fit.rate, relative_std * np.abs(ratio)])
