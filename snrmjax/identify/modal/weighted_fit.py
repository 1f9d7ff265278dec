"""Weighted fits of modes to responses: iterated weights, and the result with its errors."""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from snrmjax.identify.modal.modal_bases import (
    BasisSettings,
    real_and_imaginary,
    receptance_bases,
    unpacked,
)
from snrmjax.identify.modal.modal_fit import (
    REAL,
    LinearModalFit,
    ResponseCurves,
    phase_collinearity,
)
from snrmjax.identify.modal.pole_orders import PoleOrders
from snrmjax.identify.modal.response_data import ResponseData, coherence_std, std_from_residuals
from snrmjax.identify.modal.separable_fit import (
    ChannelRows,
    SeparableFit,
    TermColumns,
    fit_separable,
)
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.units import HERTZ

_FEW_LINES = 8.0  # in the half-power band, below which leakage may matter
_BIASED = 0.01  # relative bias of damping that gives a note
_LARGE_PHASE = np.radians(5.0)  # mean phase that gives a note
_PHASE_STDS = 3.0  # smallest significant mean phase, in standard errors
_MISFIT = 1.5  # rms residual over stated σ that gives a note


def complex_residues(
    data: ResponseData,
    settings: BasisSettings,
    fit: SeparableFit,
    std: Float[np.ndarray, "channel line"],
    rank: Int[np.ndarray, " mode"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Modal phase collinearity, mean phase (rad) of the residue and its 1σ, of every mode.

    Of residues A + iB from a linear fit with additional terms iΩB/ω, at the fitted poles.
    """
    natural = unpacked(fit.unknowns, settings)[0]
    n, lines = len(natural), len(data.omega)
    columns = receptance_bases(data.omega, fit.unknowns, settings)[0].columns
    whole = columns[:lines] + 1j * columns[lines:]
    more = 1j * data.omega[:, None] / natural * whole[:, :n]
    both = real_and_imaginary(np.column_stack([whole, more]), 0)
    good = np.isfinite(data.receptance)
    values = real_and_imaginary(np.where(good, data.receptance, 0.0))
    residue = np.zeros((len(values), n), dtype=complex)
    spread = np.zeros((len(values), n))
    for k, row in enumerate(values):
        weight = np.tile(np.where(good[k], 1 / std[k], 0.0), 2)
        weighted = both * weight[:, None]
        norm = np.linalg.norm(weighted, axis=0)
        inverse = np.linalg.pinv(weighted / norm, rcond=1e-10) / norm[:, None]
        both_parts = inverse @ (row * weight)
        residue[k] = both_parts[:n] + 1j * both_parts[-n:]
        spread[k] = np.linalg.norm(inverse[-n:], axis=1)
    collinearity, angle = phase_collinearity(residue)
    square = np.maximum(np.sum(np.abs(residue) ** 2, axis=0), 1e-300)
    angle_std = np.sqrt(np.sum((residue.real * spread) ** 2, axis=0)) / square
    return collinearity[rank], angle[rank], angle_std[rank]


def lines_in_half_power(
    omega: Float[np.ndarray, " line"],
    natural: Float[np.ndarray, " mode"],
    ratio: Float[np.ndarray, " mode"],
) -> Float[np.ndarray, " mode"]:
    """Width 2ζω of the half-power band over the spacing of the lines there."""
    spacing = np.interp(natural, (omega[1:] + omega[:-1]) / 2, np.diff(omega))
    return 2 * ratio * natural / spacing


def leakage_bias(
    data: ResponseData,
    settings: BasisSettings,
    fit: SeparableFit,
    std: Float[np.ndarray, "channel line"],
) -> Float[np.ndarray, " mode"]:
    """Relative errors of the damping ratios under Hann's window where leakage is not modelled.

    The fitted modes are windowed over one over the line spacing and fitted again with the same
    weights without a window. For averages of stationary random excitation.
    """
    spacing = float(np.median(np.diff(data.omega)))
    through = settings._replace(window_time=2 * np.pi / spacing)
    powers, groups = data.bases(windowed=True)
    bases = receptance_bases(data.omega, fit.unknowns, through, powers)
    values = np.stack(
        [bases[g].columns @ row for g, row in zip(groups, fit.coefficients, strict=True)]
    )
    weights = np.where(np.isfinite(data.receptance), 1 / std, 0.0)
    n = len(unpacked(fit.unknowns, settings)[0])
    low, high = fit.unknowns.copy(), fit.unknowns.copy()
    low[:n], high[:n] = 0.9 * low[:n], 1.1 * high[:n]
    low[n:], high[n:] = low[n:] - 0.5, high[n:] + 0.5
    refit = fit_separable(
        lambda point: receptance_bases(data.omega, point, settings),
        ChannelRows(values, np.tile(weights, (1, 2)), np.zeros(len(values), dtype=int), 2),
        fit.unknowns,
        (low, high),
    )
    return refit.unknowns[n : 2 * n] / fit.unknowns[n : 2 * n] - 1


def fit_notes(
    modes: LinearModalFit,
    data: ResponseData,
    settings: BasisSettings,
    fit: SeparableFit,
    rank: Int[np.ndarray, " mode"],
) -> list[Fact]:
    """Notes on violated assumptions of the fit."""
    notes = []
    averaged = data.source == "coherence" or data.averages is not None
    few = modes.lines_in_band < _FEW_LINES
    hertz = (modes.natural_frequency / HERTZ).tolist()
    if settings.window_time is None and averaged and few.any():
        bias = np.where(few, leakage_bias(data, settings, fit, modes.curves.std)[rank], 0.0)
        for k in np.flatnonzero(np.abs(bias) > _BIASED).tolist():
            lines, fraction = float(modes.lines_in_band[k]), float(bias[k])
            notes.append(
                Fact("leakage", mode=k + 1, frequency_hz=hertz[k], lines=lines, bias=fraction)
            )
    for k, (phase, std) in enumerate(zip(modes.mean_phase, modes.mean_phase_std, strict=True)):
        at = {"mode": k + 1, "frequency_hz": hertz[k]}
        if abs(phase) > max(_LARGE_PHASE, _PHASE_STDS * std):
            phases = {"phase_deg": float(np.degrees(phase)), "std_deg": float(np.degrees(std))}
            notes.append(Fact("residues_turned", **at, **phases, phase_was_free=settings.phase))
        if modes.collinearity[k] < REAL:
            notes.append(Fact("complex_mode", **at, collinearity=float(modes.collinearity[k])))
    notes += [
        Fact("misfit_of_sensor", sensor=name, times=float(value))
        for name, value in zip(modes.sensor_names, modes.misfit, strict=True)
        if value > _MISFIT
    ]
    if not modes.status.found_minimum:
        notes.append(Fact("modal_fit_not_settled"))
    if settings.window_time is not None:
        notes.append(Fact("leakage_modelled", window_s=settings.window_time))
    return notes


MOST_DAMPED = 0.9
"""Largest damping ratio of a fitted mode."""
_ROUNDS = 3  # of fits and weights


def line_weights(data: ResponseData) -> Float[np.ndarray, "channel line"]:
    """1/σ of receptances; one σ for all measured values of a channel where unknown."""
    good = np.isfinite(data.receptance)
    factor = data.measured_factor
    rough = np.sqrt(np.nanmean(np.abs(data.receptance * factor) ** 2, axis=1))[:, None] / factor
    std = np.where(np.isfinite(data.std), data.std, 1e-2 * rough)
    return np.where(good, 1 / std, 0.0)


def filled_receptance(data: ResponseData) -> Complex[np.ndarray, "channel line"]:
    """Receptances with 0 where they were not measured."""
    return np.where(np.isfinite(data.receptance), data.receptance, 0.0)


class FitSpread(NamedTuple):
    """Errors used as weights, and the rms residuals over the stated ones."""

    std: Float[np.ndarray, "channel line"]  # weights of the last fit
    misfit: Float[np.ndarray, " channel"]


def weighted_fit(
    data: ResponseData,
    settings: BasisSettings,
    unknowns: np.ndarray,
    std: np.ndarray,
    rounds: int = _ROUNDS,
) -> tuple[SeparableFit, FitSpread]:
    """The fit from given unknowns (see `receptance_bases`) and 1σ, with iterated weights.

    Each round scales the errors by the residuals of the previous one.
    """
    good = np.isfinite(data.receptance)
    values = real_and_imaginary(filled_receptance(data))
    powers, groups = data.bases(windowed=settings.window_time is not None)
    n, band = settings.modes_of(unknowns), (data.omega.min(), data.omega.max())
    most = np.ones(
        settings.n_terms
    )  # change of the squared natural frequency over the amplitudes, relative
    low = np.concatenate([np.full(n, 0.5 * band[0]), np.full(n, -MOST_DAMPED), -most])
    high = np.concatenate([np.full(n, 2 * band[1]), np.full(n, MOST_DAMPED), most])
    if settings.phase:
        low, high = np.append(low, -np.pi), np.append(high, np.pi)

    def basis_at(point: np.ndarray) -> list[TermColumns]:
        return receptance_bases(data.omega, point, settings, powers)

    coherence = data.coherence if data.source == "coherence" else None
    scale = np.ones(len(values))
    for number in range(rounds):
        weights = np.where(good, 1 / (std * scale[:, None]), 0.0)
        measured = ChannelRows(values, np.tile(weights, (1, 2)), groups, 2)
        fit = fit_separable(basis_at, measured, unknowns, (low, high))
        unknowns = fit.unknowns
        left = fit.residuals / np.maximum(np.tile(weights, (1, 2)), 1e-300)
        lines = len(data.omega)
        residuals = np.where(good, left[:, :lines] + 1j * left[:, lines:], np.nan)
        fitted = filled_receptance(data) - np.nan_to_num(residuals)
        if number == rounds - 1:
            break
        if data.source == "residuals":
            std, scale = std_from_residuals(data, residuals, fitted), np.ones(len(values))
        elif coherence is not None:
            # Fitted magnitudes: weights from measured ones favour lines too small by chance.
            std = coherence_std(np.abs(fitted), coherence, data.averages)
        # The residuals scale the errors of each channel.
        rms = _rms(residuals / std, fit, good)
        scale = np.maximum(rms, 1e-12 * rms.max()) if rms.max() > 0 else np.ones(len(rms))
    misfit = _rms(residuals / std, fit, good)
    # Covariances for the mean square of the last residuals, close to one.
    last = _rms(residuals / (std * scale[:, None]), fit, good)
    return fit.with_variance(float(np.mean(last**2))), FitSpread(std * scale[:, None], misfit)


def _rms(residuals: np.ndarray, fit: SeparableFit, good: np.ndarray) -> np.ndarray:
    """Root mean square of real and imaginary parts, per degree of freedom of each channel."""
    shared = len(fit.unknowns) / len(residuals)
    free = np.maximum(2 * good.sum(axis=1) - fit.coefficients.shape[1] - shared, 1.0)
    return np.sqrt(np.nansum(np.abs(residuals) ** 2, axis=1) / free)


def modal_result(
    data: ResponseData,
    settings: BasisSettings,
    fit: SeparableFit,
    spread: FitSpread,
    orders: PoleOrders,
) -> LinearModalFit:
    """A fit as modes in the order of their frequencies, with notes."""
    natural, ratio, angle = unpacked(fit.unknowns, settings)
    rank = np.argsort(natural)
    n, sensors = len(natural), len(data.channels)
    covariance = np.zeros((n, 2 + sensors, 2 + sensors))
    for position, k in enumerate(rank):
        pair = [k, n + k]
        covariance[position, :2, :2] = fit.covariance[np.ix_(pair, pair)]
        cross = fit.cross_covariance(k)[pair]
        covariance[position, :2, 2:], covariance[position, 2:, :2] = cross, cross.T
        covariance[position, 2:, 2:] = fit.term_covariance(k)
    terms = [k for k, used in enumerate((settings.lower, settings.upper)) if used]
    residual, residual_std = np.zeros((2, sensors)), np.zeros((2, sensors))
    for position, k in enumerate(terms):
        residual[k] = fit.coefficients[:, n + position]
        residual_std[k] = np.sqrt(np.diag(fit.term_covariance(n + position)))
    powers, groups = data.bases(windowed=settings.window_time is not None)
    bases = receptance_bases(data.omega, fit.unknowns, settings, powers)
    lines = len(data.omega)
    columns = np.stack([bases[group].columns for group in groups])
    fitted = np.einsum("srt,st->sr", columns, fit.coefficients)
    curves = ResponseCurves(
        data.omega, data.receptance, fitted[:, :lines] + 1j * fitted[:, lines:], spread.std
    )
    collinearity, mean_phase, mean_phase_std = complex_residues(
        data, settings, fit, spread.std, rank
    )
    modes = LinearModalFit(
        natural_frequency=natural[rank],
        damping_ratio=ratio[rank],
        mode_covariance=covariance,
        collinearity=collinearity,
        orders=orders,
        sensors=data.channels,
        status=fit.status,
        notes=(),
        residue=fit.coefficients[:, rank],
        lower=residual[0],
        lower_std=residual_std[0],
        upper=residual[1],
        upper_std=residual_std[1],
        phase=angle,
        phase_std=float(np.sqrt(fit.covariance[-1, -1])) if settings.phase else 0.0,
        mean_phase=mean_phase,
        mean_phase_std=mean_phase_std,
        lines_in_band=lines_in_half_power(data.omega, natural[rank], ratio[rank]),
        misfit=spread.misfit if data.source != "residuals" else np.full(sensors, np.nan),
        curves=curves,
        reference=data.reference,
        source=data.source,
    )
    notes = (*data.notes, *fit_notes(modes, data, settings, fit, rank))
    return dataclasses.replace(modes, notes=notes)
