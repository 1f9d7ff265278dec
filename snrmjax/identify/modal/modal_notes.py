"""What a reader of a modal fit must know: complex modes, leakage, misfit, doubtful residuals."""

import numpy as np
from jaxtyping import Float, Int

from snrmjax.identify.modal.modal_bases import (
    BasisSettings,
    real_and_imaginary,
    receptance_bases,
    unpacked,
)
from snrmjax.identify.modal.modal_fit import REAL, LinearModalFit, phase_collinearity
from snrmjax.identify.modal.response_data import ResponseData
from snrmjax.identify.modal.separable_fit import ChannelRows, SeparableFit, fit_separable
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.units import HERTZ

_FEW_LINES = 8.0  # in the half-power band, below which leakage may count
_BIASED = 0.01  # relative bias of damping that is worth a note
_TURNED = np.radians(5.0)  # mean phase that is worth a note
_PHASE_STDS = 3.0  # standard errors of a mean phase, below which it may be none
_MISFIT = 1.5  # rms residual over stated σ that is worth a note


def complex_residues(
    data: ResponseData,
    settings: BasisSettings,
    fit: SeparableFit,
    std: Float[np.ndarray, "channel line"],
    rank: Int[np.ndarray, " mode"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Modal phase collinearity, mean phase (rad) away from real and its 1σ, of every mode.

    Of residues A + iB from a linear fit with terms iΩB/ω beside A, at the fitted poles.
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
        size = np.linalg.norm(weighted, axis=0)
        inverse = np.linalg.pinv(weighted / size, rcond=1e-10) / size[:, None]
        both_parts = inverse @ (row * weight)
        residue[k] = both_parts[:n] + 1j * both_parts[-n:]
        spread[k] = np.linalg.norm(inverse[-n:], axis=1)
    collinearity, angle = phase_collinearity(residue)
    size = np.maximum(np.sum(np.abs(residue) ** 2, axis=0), 1e-300)
    angle_std = np.sqrt(np.sum((residue.real * spread) ** 2, axis=0)) / size
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

    The fitted modes are seen through a window of one over the line spacing, and fitted with the
    same weights without it. Of averages of stationary random excitation.
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
    """What the fit assumes and the data do not keep."""
    notes = []
    averaged = data.source == "coherence" or data.averages is not None
    few = modes.lines_in_band < _FEW_LINES
    hertz = (modes.natural_frequency / HERTZ).tolist()
    if settings.window_time is None and averaged and few.any():
        bias = np.where(few, leakage_bias(data, settings, fit, modes.curves.std)[rank], 0.0)
        for k in np.flatnonzero(np.abs(bias) > _BIASED).tolist():
            lines, share = float(modes.lines_in_band[k]), float(bias[k])
            notes.append(
                Fact("leakage", mode=k + 1, frequency_hz=hertz[k], lines=lines, bias=share)
            )
    for k, (phase, std) in enumerate(zip(modes.mean_phase, modes.mean_phase_std, strict=True)):
        at = {"mode": k + 1, "frequency_hz": hertz[k]}
        if abs(phase) > max(_TURNED, _PHASE_STDS * std):
            turn = {"phase_deg": float(np.degrees(phase)), "std_deg": float(np.degrees(std))}
            notes.append(Fact("residues_turned", **at, **turn, phase_was_free=settings.phase))
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
