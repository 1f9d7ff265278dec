"""Start models for the fit of a nonlinear state-space model to a multisine test.

Two starts: poles of the best linear approximation by a subspace method, with all coefficients then
fitted to it; and, for one mode, a regression of each sample on the one before.

References: T. McKelvey, H. Akçay & L. Ljung, IEEE Trans. Autom. Control 41 (1996) 960,
doi:10.1109/9.508900, algorithm 2 (frequencies need not be even); J. Paduart et al., Automatica 46
(2010) 647, doi:10.1016/j.automatica.2010.01.001, section 4.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Complex, Float

from snrmjax.measure.recordings.multisine import MultisineResponses
from snrmjax.methods.records.state_space import Exponents, StateSpace, hold, response
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.levenberg_marquardt import Minimum, StepRule, minimise
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

HIGHEST = 4.0
"""Times the mode's frequency: highest fitted line, beyond the third harmonic."""

_FLOOR = 1e-4  # of a line's magnitude: least error of a best linear approximation
_RULE = StepRule(steps=40, settled=0.5, damping=1e-2)


class Periods(NamedTuple):
    """Mean periods at the model's rate, scaled, and the noise of their lines."""

    force: Float[np.ndarray, "realisation sample"]  # over the sampling's hold, see `hold`
    velocity: Float[np.ndarray, "realisation sample"]
    noise: Float[np.ndarray, " line"]  # variance of a line of the mean period, peak amplitudes
    rate: float
    units: tuple[float, float]


class StateSpaceTrial(NamedTuple):
    """A least-squares problem at one point."""

    residuals: Float[np.ndarray, " row"]
    jacobian: Float[np.ndarray, "row unknown"]


class Start(NamedTuple):
    """A model and the states of its motion at every sample."""

    model: StateSpace
    states: Float[np.ndarray, "realisation sample state"]


def least_squares(
    evaluate: Callable[[np.ndarray], list[StateSpaceTrial]], point: Float[np.ndarray, " unknown"]
) -> Minimum[StateSpaceTrial]:
    """The minimum nearest to a start point."""
    unlimited = np.full(len(point), np.inf)
    [best] = minimise(evaluate, point[None], evaluate(point[None]), (-unlimited, unlimited), _RULE)
    return best


def linear_model(
    linear: MultisineResponses, periods: Periods, order: int, terms: int
) -> StateSpace:
    """The linear model that fits the best linear approximation, with a zero polynomial.

    Raises `ValueError` where it has fewer or more oscillating modes than `order` requires.
    """
    scale = periods.units[0] / periods.units[1]
    values = linear.responses.values[0, 0] * scale
    known = linear.total_std if np.isfinite(linear.total_std).all() else linear.noise_std
    std = np.maximum(known[0] * scale, _FLOOR * np.abs(values))
    z = np.exp(1j * linear.responses.frequency / periods.rate)
    in_band = linear.responses.frequency < np.pi * periods.rate
    z, values, weight = z[in_band], values[in_band], 1 / std[in_band]
    hold_gain = hold(np.angle(z))  # the model's force is the recorded one divided by it
    values, weight = values * hold_gain, weight / hold_gain
    multipliers = subspace_poles(z, values, weight, order)
    oscillating = np.sort_complex(multipliers[multipliers.imag > 1e-6])[::-1]
    if len(oscillating) != order // 2:
        raise InputError(
            f"the best linear approximation does not have {order // 2} oscillating modes: "
            "excite a band around them, or take another `order`."
        )
    oscillating *= np.minimum(1.0, (1 - 1e-6) / np.abs(oscillating))
    poles = np.stack([oscillating.real, oscillating.imag], axis=1)
    drive, through = linear_terms(z, values, weight, poles)
    none = jnp.zeros((order, terms))
    model = StateSpace(jnp.asarray(poles), jnp.asarray(drive), jnp.asarray(through), none)
    flat, rebuild = ravel_pytree(model)
    free = len(flat) - none.size

    def evaluate(points: np.ndarray) -> list[StateSpaceTrial]:
        trials = []
        for point in points:
            full = jnp.concatenate([jnp.asarray(point), flat[free:]])
            value, slope = _response_slopes(rebuild(full), jnp.asarray(z))
            residual = (np.asarray(value) - values) * weight
            jacobian = np.asarray(slope)[:, :free] * weight[:, None]
            trials.append(StateSpaceTrial(as_real(residual), as_real(jacobian)))
        return trials

    point = np.asarray(flat[:free])
    best = least_squares(evaluate, point)
    return rebuild(jnp.concatenate([jnp.asarray(best.point), flat[free:]]))


def linear_states(
    model: StateSpace, periods: Periods
) -> Float[np.ndarray, "realisation sample state"]:
    """States of the linear model's periodic motion."""
    spectra = np.fft.rfft(periods.force, axis=1)
    count = periods.force.shape[1]
    z = np.exp(2j * np.pi * np.arange(spectra.shape[1]) / count)
    states = []
    for (p, q), (b1, b2) in zip(np.asarray(model.poles), np.asarray(model.drive), strict=True):
        denominator = (z - p) ** 2 + q**2
        for top in ((z - p) * b1 + q * b2, (z - p) * b2 - q * b1):
            states.append(np.fft.irfft(spectra * top / denominator, count, axis=1))
    return np.stack(states, axis=2)


def regressed(periods: Periods, natural: float, exponents: Exponents) -> Start | None:
    """A model of one mode and its states by regression of each sample on the one before.

    With displacement (from the velocity's spectrum) and velocity as states the next sample is
    linear in all coefficients. Noise biases them: only a start. None without an oscillating mode.
    """
    count = periods.force.shape[1]
    spectra = np.fft.rfft(periods.velocity, axis=1)
    line = np.arange(spectra.shape[1])
    highest = HIGHEST * natural / HERTZ / periods.rate * count
    spectra[:, (line == 0) | (line > highest)] = 0
    angular_rate = np.where(line == 0, 1.0, HERTZ * line / count * periods.rate / natural)
    signals = [
        np.fft.irfft(spectrum, count, axis=1)
        for spectrum in (spectra, spectra / (1j * angular_rate))
    ]
    states = np.stack(signals, axis=-1)
    basis = np.eye(2)
    for _ in range(2):  # in these coordinates, then in those of the model
        now = states @ basis.T
        terms = [np.prod(now**powers, axis=-1) for powers in exponents]
        design = np.stack([now[..., 0], now[..., 1], periods.force, *terms], axis=-1)
        following = np.roll(now, -1, axis=1)
        table = design.reshape(-1, design.shape[-1])
        scale = np.linalg.norm(table, axis=0)
        solved = np.linalg.lstsq(table / scale, following.reshape(-1, 2), rcond=None)[0].T / scale
        matrix = solved[:, :2]
        multiplier = np.linalg.eigvals(matrix)[0]
        p, q = float(multiplier.real), float(abs(multiplier.imag))
        if not q > 0:
            return None
        basis = np.array([[1.0, 0.0], [(matrix[0, 0] - p) / q, matrix[0, 1] / q]]) @ basis
    model = StateSpace(
        jnp.array([[p, q]]),
        jnp.asarray(solved[None, :, 2]),
        jnp.zeros(()),
        jnp.asarray(solved[:, 3:]),
    )
    return Start(model, now)


@compiled
def _response_slopes(model: StateSpace, z: Array) -> tuple[Array, Array]:
    flat, rebuild = ravel_pytree(model)

    def of(coefficients: Array) -> Array:
        return response(rebuild(coefficients), z)

    return of(flat), jax.jacfwd(of)(flat)


def subspace_poles(
    z: Complex[np.ndarray, " frequency"],
    values: Complex[np.ndarray, " frequency"],
    weight: Float[np.ndarray, " frequency"],
    states: int,
) -> Complex[np.ndarray, " state"]:
    """Eigenvalues of A, with G(z) = C (z I − A)⁻¹ B + D near the given values.

    Arguments: `z` = e^{iΩ/rate}; `weight` multiplies each line's equations.
    """
    count = max(10, states + 2)  # rows of the extended observability matrix
    powers = z ** np.arange(count)[:, None] * weight
    stacked = [_real(powers), _real(powers * values)]
    _, triangle = np.linalg.qr(np.concatenate(stacked).T)
    upper = triangle.T
    left, _, _ = np.linalg.svd(upper[count:, count:])
    observability = left[:, :states]
    return np.linalg.eigvals(np.linalg.lstsq(observability[:-1], observability[1:], rcond=None)[0])


def linear_terms(
    z: Complex[np.ndarray, " frequency"],
    values: Complex[np.ndarray, " frequency"],
    weight: Float[np.ndarray, " frequency"],
    poles: Float[np.ndarray, "mode 2"],
) -> tuple[Float[np.ndarray, "mode 2"], float]:
    """Least-squares input of each mode and feedthrough for given poles, C = (1, 0) per mode."""
    columns = []
    for p, q in poles:
        denominator = (z - p) ** 2 + q**2
        columns += [(z - p) / denominator, q / denominator]
    design = _real(np.stack([*columns, np.ones_like(z)]) * weight).T
    solved = np.linalg.lstsq(design, _real((values * weight)[None])[0], rcond=None)[0]
    return solved[:-1].reshape(-1, 2), float(solved[-1])


def _real(values: np.ndarray) -> np.ndarray:
    """Real and imaginary parts, joined along the columns."""
    return np.concatenate([values.real, values.imag], axis=1)


def as_real(values: np.ndarray) -> np.ndarray:
    """Real and imaginary parts, joined along the rows."""
    return np.concatenate([values.real, values.imag])
