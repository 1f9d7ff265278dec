"""A polynomial nonlinear state-space model fitted to the mean periods of multisine records.

First over short stretches, each with its own initial state (multiple shooting: a poor model cannot
diverge from the record), then over whole periods, in the frequency domain, weighted by noise and
model error.

References: J. Paduart et al., Automatica 46 (2010) 647, doi:10.1016/j.automatica.2010.01.001,
section 4; for multiple shooting, H. G. Bock & K. J. Plitt, IFAC Proc. 17 (1984) 1603,
doi:10.1016/S1474-6670(17)61205-9.
"""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Complex, Float

from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.multisine import MultisineResponses, multisine_responses
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.measure.recordings.velocity_states import choose_channels, velocity_factors
from snrmjax.methods.records.resonant_decay import even_record
from snrmjax.methods.records.state_space import (
    Exponents,
    StateSpace,
    hold,
    monomials,
    simulated_output,
)
from snrmjax.methods.records.state_space_start import (
    HIGHEST,
    Periods,
    Start,
    StateSpaceTrial,
    as_real,
    least_squares,
    linear_model,
    linear_states,
    regressed,
)
from snrmjax.model.modes import LinearModes
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

_PER_CYCLE = 32.0  # samples of the model per cycle of the mode
_FEWEST_SAMPLES = 4.5  # of a record per cycle of the mode
_MOST_SAMPLES = 2**16  # of all fitted realisations
_MOST_RECORDED = 2**22  # samples of a record that is checked for clipping
_AWAY = 1e6  # times the record's rms velocity: the model diverges
_MUCH = 0.2  # largest relative residual of a fitted model
_WIDTH = 31  # lines over which the misfit's power is averaged for the weights
_ROUNDS = 3  # of fits, each weighted by the residual of the one before
_SETTLING = 12  # simulated periods until the motion is periodic
_MOST_MODES = 3  # of a model
_STRETCHES = 16  # of a period at most
_CYCLES = 6.0  # of the mode, least length of a stretch


class StateSpaceFit(NamedTuple):
    """A fitted model with its units, errors and checks."""

    model: StateSpace
    covariance: Float[np.ndarray, "coefficient coefficient"]  # order of `ravel_pytree`
    exponents: Exponents
    rate: float  # Hz, of the model's samples
    force_unit: float  # N
    velocity_unit: float  # m/s
    mode: int  # of the model, the one of interest
    largest: float  # m/s, velocity in the records
    linear: MultisineResponses
    misfit: float  # relative rms residual of the fitted records
    linear_misfit: float  # likewise of the linear model
    excess: float  # rms residual of the fitted lines over the noise from the scatter of periods
    validation: float  # relative error of a realisation left out of the fit; NaN where there is one


def fit_state_space(
    recordings: TimeRecording | Sequence[TimeRecording],
    force: str,
    motion: str,
    modes: LinearModes | None = None,
    *,
    order: int | None = None,
    degrees: tuple[int, ...] = (2, 3),
    period: float | None = None,
    skip: int = 1,
) -> StateSpaceFit:
    """Fit a polynomial nonlinear state-space model to multisine records.

    Arguments: `recordings`, one a realisation of random phases, of one rate and period; `force`
    (N) and `motion` (a velocity, or an acceleration or displacement, which are converted line by
    line) name their channels; `modes` give the frequency of the mode of interest, by default that
    of the highest response; `order` is the number of states, by default two for each of the
    `modes` in the excited band, six at most; `degrees` of the monomials; `period` in s, by default
    estimated; `skip` periods at the start are left out. Of two realisations or more the last is
    left out of the fit for validation.
    Returns a `StateSpaceFit`. Raises `ValueError` as `multisine_responses` does, for an `order`
    that is odd or too high, for fewer than 4.5 samples a cycle, a clipped motion, where the
    records do not have as many oscillating modes as `order` requires, and for a residual above
    20 % of the velocity.
    Validity: steady periodic records, little noise of the force, restoring and damping forces that
    are polynomials of these degrees over the amplitudes of the records: 1σ does not include the
    truncation error, and with v|v| damping the damping band is too narrow
    (`benchmarks/methods_loops_and_decays.py`).
    """
    if order not in (None, 2, 4, 6):
        raise InputError(f"`order` must be 2, 4 or 6 (two states a mode), but is {order}.")
    if not degrees or not all(2 <= degree <= 7 for degree in degrees):
        raise InputError(f"`degrees` must lie between 2 and 7, but are {degrees}.")
    records = (recordings,) if isinstance(recordings, TimeRecording) else tuple(recordings)
    channel = choose_channels(records[0], force, [motion]).responses[0]
    for record in records:
        if record.n_samples <= _MOST_RECORDED:
            even_record(record.time(), record.values([motion])[0])
    linear = _of_velocity(
        multisine_responses(records, force, [motion], period=period, skip=skip), channel
    )
    natural = _mode_frequency(linear, modes)
    order = _order(linear, modes) if order is None else order
    periods = _mean_periods(records, (force, channel), linear, skip, natural)
    validated = periods.force.shape[0] > 1
    fitted = periods._replace(
        force=periods.force[: -1 if validated else None],
        velocity=periods.velocity[: -1 if validated else None],
    )
    exponents = monomials(order, degrees)
    linear_part = linear_model(linear, periods, order, len(exponents))
    start = Start(linear_part, linear_states(linear_part, fitted))
    linear_misfit = _misfit(start, fitted, exponents)
    regression = regressed(fitted, natural, exponents) if order == 2 else None
    starts = [start] if regression is None else [start, regression]
    shot = [_over_stretches(start, fitted, exponents, natural) for start in starts]
    first = min([*starts, *shot], key=lambda start: _misfit(start, fitted, exponents))
    model, covariance, states = _fitted(first.model, first.states[:, 0], fitted, exponents, natural)
    simulated = _simulated(model, states, fitted, exponents)
    misfit = _relative(simulated, fitted.velocity)
    if not misfit < _MUCH:
        raise InputError(
            f"the residual of the best model of degree {max(degrees)} is "
            f"{100 * misfit:.3g} % of the velocity, more than {100 * _MUCH:g} %: a lower level, "
            "longer periods, more states or other degrees may help."
        )
    angles = np.angle(np.asarray(model.poles) @ [1, 1j])
    return StateSpaceFit(
        model,
        covariance,
        exponents,
        periods.rate,
        *periods.units,
        int(np.argmin(np.abs(angles * periods.rate - natural))),
        float(np.abs(periods.velocity).max() * periods.units[1]),
        linear,
        misfit,
        linear_misfit,
        _excess(simulated, fitted, natural),
        _validated(model, periods, exponents) if validated else np.nan,
    )


def _of_velocity(linear: MultisineResponses, channel: Channel) -> MultisineResponses:
    """The responses converted to the motion's velocity."""
    responses = linear.responses
    factor = velocity_factors([channel], [1], responses.frequency)[:, 0, 0]
    gain = np.abs(factor)
    return dataclasses.replace(
        linear,
        responses=dataclasses.replace(responses, values=responses.values * factor),
        noise_std=linear.noise_std * gain,
        total_std=linear.total_std * gain,
    )


def _mode_frequency(linear: MultisineResponses, modes: LinearModes | None) -> float:
    """Frequency of the mode of interest, rad/s, if the test excites it."""
    frequency = linear.responses.frequency
    if modes is None:
        return float(frequency[np.argmax(np.abs(linear.responses.values[0, 0]))])
    natural = modes.natural_frequency.item(modes.mode_of_interest)
    if not frequency[0] <= natural <= frequency[-1]:
        raise InputError(
            f"lines around the mode at {natural / HERTZ:.4g} Hz are needed, but the records "
            f"have them from {frequency[0] / HERTZ:.4g} to "
            f"{frequency[-1] / HERTZ:.4g} Hz."
        )
    return natural


def _order(linear: MultisineResponses, modes: LinearModes | None) -> int:
    """Two states for each mode that the test excites."""
    if modes is None:
        return 2
    frequency, natural = linear.responses.frequency, np.asarray(modes.natural_frequency)
    inside = np.count_nonzero((natural >= frequency[0]) & (natural <= frequency[-1]))
    return int(2 * np.clip(inside, 1, _MOST_MODES))


def _mean_periods(
    records: tuple[TimeRecording, ...],
    channels: tuple[str, Channel],
    linear: MultisineResponses,
    skip: int,
    natural: float,
) -> Periods:
    """Mean periods, resampled by their spectra (periodic records: exactly) and scaled."""
    rate = records[0].sampling_rate
    samples = round(linear.period * rate)
    if rate < _FEWEST_SAMPLES * natural / HERTZ:
        raise InputError(
            f"{_FEWEST_SAMPLES:g} samples a cycle of the mode at {natural / HERTZ:.4g} Hz "
            f"are needed, but the records have {rate:g} Hz: the sampling rate is too low."
        )
    # A multiple of the number of stretches, a power of two.
    cycles = linear.period * natural / HERTZ
    wanted = _STRETCHES * round(cycles * _PER_CYCLE / _STRETCHES)
    most = _MOST_SAMPLES // wanted
    if most < 1:
        raise InputError(
            f"{_MOST_SAMPLES} samples are fitted at most, but a period has {wanted} at "
            f"{_PER_CYCLE:g} a cycle: record shorter periods."
        )
    names = (channels[0], channels[1].name)
    line = HERTZ * np.arange(1, samples // 2 + 1) / linear.period
    factor = np.concatenate([[0.0], velocity_factors([channels[1]], [1], line)[:, 0, 0]])
    both = np.stack([np.ones_like(factor), factor])
    means, noise = [], []
    for record in records[: max(2, most)]:
        spectra = []
        for start in range(skip * samples, record.n_samples - samples + 1, samples):
            once = record.values(names, start, start + samples)
            spectra.append(np.fft.rfft(once, axis=1) * 2 / samples * both)
        means.append(np.mean(spectra, axis=0))
        scatter = np.var([spectrum[1] for spectrum in spectra], axis=0, ddof=1) / len(spectra)
        noise.append(scatter)
    lines = min(samples, wanted) // 2  # the line at half the rate is left out
    cut = np.zeros((len(means), 2, wanted // 2 + 1), dtype=complex)
    cut[..., :lines] = np.array(means)[..., :lines]
    cut[..., 0] = 0.0
    cut[:, 0] /= hold(2 * np.pi * np.arange(wanted // 2 + 1) / wanted)
    force, velocity = np.moveaxis(np.fft.irfft(cut * wanted / 2, wanted, axis=2), 1, 0)
    units = float(np.sqrt(np.mean(force**2))), float(np.sqrt(np.mean(velocity**2)))
    return Periods(
        force / units[0],
        velocity / units[1],
        np.mean(noise, axis=0)[:lines] / units[1] ** 2,
        wanted / linear.period,
        units,
    )


@compiled
def _outputs(model: StateSpace, starts: Array, force: Array, exponents: Exponents) -> Array:
    return jax.vmap(lambda x, u: simulated_output(model, x, u, exponents))(starts, force)


@compiled
def _output_slopes(
    model: StateSpace, starts: Array, force: Array, exponents: Exponents
) -> tuple[Array, Array]:
    """Outputs, and their derivatives over the coefficients and over their own first state."""
    flat, rebuild = ravel_pytree(model)

    def of(unknowns: Array, input_force: Array) -> Array:
        coefficients, start = unknowns[: len(flat)], unknowns[len(flat) :]
        return simulated_output(rebuild(coefficients), start, input_force, exponents)

    def both(start: Array, input_force: Array) -> tuple[Array, Array]:
        at = jnp.concatenate([flat, start])
        return of(at, input_force), jax.jacfwd(of)(at, input_force)

    return jax.vmap(both)(starts, force)


def _simulated(
    model: StateSpace, starts: np.ndarray, periods: Periods, exponents: Exponents
) -> Float[np.ndarray, "realisation sample"]:
    outputs = _outputs(model, jnp.asarray(starts), jnp.asarray(periods.force), exponents)
    return _in_bounds(outputs, outputs)[0]


def _in_bounds(outputs: Array, slopes: Array) -> tuple[np.ndarray, np.ndarray]:
    """Outputs and slopes unchanged, or all NaN where the model diverges."""
    values, jacobian = np.asarray(outputs), np.asarray(slopes)
    if np.all(np.abs(values) < _AWAY) and np.isfinite(jacobian).all():
        return values, jacobian
    return np.full_like(values, np.nan), np.full_like(jacobian, np.nan)


def _relative(simulated: np.ndarray, measured: np.ndarray) -> float:
    return float(np.sqrt(np.mean((simulated - measured) ** 2) / np.mean(measured**2)))


def _misfit(start: Start, periods: Periods, exponents: Exponents) -> float:
    """Relative rms error over whole periods; infinite where the model diverges."""
    error = _relative(
        _simulated(start.model, start.states[:, 0], periods, exponents), periods.velocity
    )
    return error if np.isfinite(error) else np.inf


def _over_stretches(start: Start, periods: Periods, exponents: Exponents, natural: float) -> Start:
    """The model refined over stretches of a few cycles, each from a state of its own."""
    count, samples = periods.force.shape
    cycles = samples / periods.rate * natural / HERTZ
    pieces = min(_STRETCHES, 2 ** max(0, int(np.log2(max(cycles / _CYCLES, 1.0)))))
    length, states = samples // pieces, start.states.shape[2]
    force = jnp.asarray(periods.force.reshape(-1, length))
    target = periods.velocity.reshape(-1, length)
    flat, rebuild = ravel_pytree(start.model)
    firsts = start.states[:, ::length].reshape(-1, states)

    def evaluate(points: np.ndarray, unit: float) -> list[StateSpaceTrial]:
        trials = []
        for point in points:
            first = jnp.asarray(point[len(flat) :].reshape(-1, states))
            model = rebuild(jnp.asarray(point[: len(flat)]))
            outputs, slopes = _in_bounds(*_output_slopes(model, first, force, exponents))
            jacobian = _with_own_states(slopes, len(flat)) / unit
            trials.append(StateSpaceTrial((outputs - target).ravel() / unit, jacobian))
        return trials

    point = np.concatenate([np.asarray(flat), firsts.ravel()])
    for _ in range(2):  # the unit is the rms residual of the fit before
        residuals = evaluate(point[None], 1.0)[0].residuals
        unit = float(np.sqrt(np.mean(residuals**2)))
        if not np.isfinite(unit):
            return start
        point = least_squares(partial(evaluate, unit=unit), point).point
    kept = start.states.copy()
    kept[:, ::length] = point[len(flat) :].reshape(count, pieces, states)
    return Start(rebuild(jnp.asarray(point[: len(flat)])), kept)


def _fitted(
    start: StateSpace,
    starts: np.ndarray,
    periods: Periods,
    exponents: Exponents,
    natural: float,
) -> tuple[StateSpace, Float[np.ndarray, "coefficient coefficient"], np.ndarray]:
    """The polynomial model, the covariance of its coefficients and the periods' first states."""
    flat, rebuild = ravel_pytree(start)
    count = len(periods.force)
    lines = _lines(periods, natural)
    target = _spectrum(periods.velocity, lines)
    force = jnp.asarray(periods.force)
    point = np.concatenate([np.asarray(flat), starts.ravel()])
    states = starts.shape[1]

    def evaluate(points: np.ndarray, std: np.ndarray) -> list[StateSpaceTrial]:
        trials = []
        for point in points:
            model = rebuild(jnp.asarray(point[: len(flat)]))
            first = jnp.asarray(point[len(flat) :].reshape(count, states))
            outputs, slopes = _in_bounds(*_output_slopes(model, first, force, exponents))
            residual = (_spectrum(outputs, lines) - target) / std
            spectra = _spectrum(np.moveaxis(slopes, 2, 1), lines) / std
            jacobian = _with_own_states(np.moveaxis(spectra, 1, 2), len(flat))
            trials.append(StateSpaceTrial(as_real(residual.ravel()), as_real(jacobian)))
        return trials

    residual = _spectrum(_simulated(start, starts, periods, exponents), lines) - target
    for _ in range(_ROUNDS):
        std = _error(residual, periods.noise[lines])
        best = least_squares(partial(evaluate, std=std), point)
        point = best.point
        linearised = best.linearised
        half = count * len(lines)
        residual = (linearised.residuals[:half] + 1j * linearised.residuals[half:]).reshape(
            count, len(lines)
        ) * std
    std = _error(residual, periods.noise[lines])
    [last] = evaluate(point[None], std)
    # A complex error of variance std² has half of it in each part.
    scale = np.linalg.norm(last.jacobian, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    normal = (last.jacobian / scale).T @ (last.jacobian / scale)
    inverse = np.linalg.pinv(normal, hermitian=True) / np.outer(scale, scale) / 2
    return (
        rebuild(jnp.asarray(point[: len(flat)])),
        inverse[: len(flat), : len(flat)],
        point[len(flat) :].reshape(count, states),
    )


def _with_own_states(slopes: np.ndarray, shared: int) -> np.ndarray:
    """Jacobian from slopes (stretch, row, …) over `shared` coefficients and own initial states."""
    count, rows, width = slopes.shape
    by_states = np.zeros((count, rows, count, width - shared), dtype=slopes.dtype)
    by_states[np.arange(count), :, np.arange(count)] = slopes[..., shared:]
    blocks = [slopes[..., :shared], by_states.reshape(count, rows, -1)]
    return np.concatenate(blocks, axis=2).reshape(count * rows, -1)


def _lines(periods: Periods, natural: float) -> np.ndarray:
    """Fitted lines."""
    highest = HIGHEST * natural / HERTZ / periods.rate * periods.force.shape[1]
    return np.arange(1, min(len(periods.noise), int(highest)))


def _excess(simulated: np.ndarray, periods: Periods, natural: float) -> float:
    """rms residual of the fitted lines over the noise."""
    lines = _lines(periods, natural)
    residual = _spectrum(simulated - periods.velocity, lines)
    noise = max(float(np.mean(periods.noise[lines])), np.finfo(float).tiny)
    return float(np.sqrt(np.mean(np.abs(residual) ** 2) / noise))


def _spectrum(signal: np.ndarray, lines: np.ndarray) -> Complex[np.ndarray, "*batch line"]:
    return np.fft.rfft(signal, axis=-1)[..., lines] * 2 / signal.shape[-1]


def _error(residual: np.ndarray, noise: np.ndarray) -> Float[np.ndarray, " line"]:
    """rms complex error of a line: the larger of noise and mean residual of lines around it."""
    window = np.ones(_WIDTH)
    around = np.convolve(np.ones(len(noise)), window, "same")
    misfit = np.convolve(np.mean(np.abs(residual) ** 2, axis=0), window, "same") / around
    smooth = np.convolve(noise, window, "same") / around
    return np.sqrt(np.maximum(misfit, smooth))


def _validated(model: StateSpace, periods: Periods, exponents: Exponents) -> float:
    """Relative error of the last realisation, simulated until the motion is periodic."""
    once = jnp.asarray(np.tile(periods.force[-1:], (1, _SETTLING)))
    none = jnp.zeros((1, 2 * len(model.poles)))
    outputs = np.asarray(_outputs(model, none, once, exponents)).reshape(_SETTLING, -1)
    return _relative(outputs[-1], periods.velocity[-1])
