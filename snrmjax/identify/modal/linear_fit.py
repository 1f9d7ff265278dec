"""Linear modes from frequency responses over one reference, with their errors."""

from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np
from jaxtyping import Complex, Float

from snrmjax.identify.modal.modal_bases import BasisSettings, unpacked
from snrmjax.identify.modal.modal_fit import LinearModalFit
from snrmjax.identify.modal.pole_orders import (
    LIGHTLY_DAMPED,
    PoleOrders,
    clusters,
    poles_of_responses,
)
from snrmjax.identify.modal.response_data import ResponseData, response_data
from snrmjax.identify.modal.separable_fit import SIGNIFICANT, SeparableFit
from snrmjax.identify.modal.weighted_fit import (
    MOST_DAMPED,
    FitSpread,
    filled_receptance,
    line_weights,
    modal_result,
    weighted_fit,
)
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses
from snrmjax.numerics.compiled import on_numbers
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

ResidualTerms = Literal["auto", "both", "lower", "upper", "none"]

_HIGHEST = 40  # largest model order, with enough lines
_LINES_PER_ORDER = 4
_USUAL = 0.01  # damping ratio assumed where no pole is near
_NEAR = 0.02  # of a frequency: largest distance of a pole from one given by hand
_NARROW = 1.1  # ratio of a band's ends below which one residual term suffices
_TWINS = 0.1  # of a decay rate: closer poles are one mode, split by the fit
_SIGNIFICANT_CURVATURE = 12.0  # least reduction of χ² per sensor by a further residual term
_EVEN = 1e-3  # of the line spacing


class GrowingModes(InputError):
    """All modes of the responses have negative damping, as for the convention e^(-iΩt)."""

    def __init__(self, modes: str) -> None:
        super().__init__(f"{modes}: the responses seem to be conjugated, of e^(-iΩt).")


@on_numbers("Differentiate `sj.model.linear_response`.")
def fit_linear_modes(
    responses: FrequencyResponses,
    *,
    poles: Sequence[float] | None = None,
    order: int | None = None,
    highest_order: int | None = None,
    std: Float[np.ndarray, "response frequency"] | None = None,
    reference: str | None = None,
    from_frequency: float | None = None,
    to_frequency: float | None = None,
    residual_terms: ResidualTerms = "auto",
    instrument_phase: bool | None = None,
    window: Literal["hann"] | None = None,
) -> LinearModalFit:
    """Natural frequencies, damping ratios and residues of real normal modes, with covariance.

    Poles of all model orders (least-squares complex frequency estimator) are grouped into clusters
    that are stable over the order; each starts a mode of H = e^{iψ} [Σ A_r/(ω_r² − Ω² + 2iζ_rω_rΩ)
    + L/Ω² + U], fitted to all responses together by weighted least squares. A mode whose residues
    are all within four standard errors of zero is left out. Weights: stated `std`, or coherence, or
    additive and relative errors estimated from the residuals. The rms of the residuals scales the
    errors of each response, and the correlation of neighbouring residuals widens them.

    Arguments: `poles` natural frequencies in rad/s in place of clusters; `order` uses all lightly
    damped poles of one model order; `std` 1σ of real and of imaginary part, SI;
    `reference` names one of several; the band in rad/s; `residual_terms` for modes outside the
    band (1/Ω² below, a constant above, and Ω² if significant); `instrument_phase` fits ψ, by
    default over a voltage only; `window` "hann" models the leakage of averages of random
    excitation, whose line spacing is one over the window's length.
    Raises `ValueError` as `response_data` does, without a stable pole, for poles outside the band
    and for responses that seem to be conjugated.
    Validity: real modes (see `collinearity` and `mean_phase`), linear and time-invariant.
    Not differentiable: differentiate `snrmjax.model.linear_response`.

    >>> w = 2 * np.pi * np.linspace(8, 12, 200)
    >>> h = 2.0 / ((2 * np.pi * 10) ** 2 - w**2 + 2j * 0.01 * 2 * np.pi * 10 * w)
    >>> from snrmjax.measure.recordings.channels import Channel
    >>> from snrmjax.measure.recordings.frequency_responses import frequency_responses
    >>> tip, force = Channel("tip", "displacement"), Channel("hammer", "force")
    >>> modes = fit_linear_modes(frequency_responses(w, h[None, None], [tip], [force]))
    >>> (modes.natural_frequency / 2 / np.pi).round(6), modes.residue.round(6)
    (array([10.]), array([[2.]]))
    """
    data = response_data(
        responses,
        std=std,
        reference=reference,
        from_frequency=from_frequency,
        to_frequency=to_frequency,
    )
    free = data.reference.quantity == "voltage" if instrument_phase is None else instrument_phase
    settings = basis_settings(data, residual_terms, free, window)
    orders = _orders(data, highest_order)
    start = _start(data, orders, poles, order)
    fit, spread = _fitted(data, settings, start, keep_all=poles is not None)
    if residual_terms == "auto" and settings.lower:
        settings, fit, spread = _with_curvature(data, settings, fit, spread)
    _check_modes(fit, settings)
    return modal_result(data, settings, fit, spread, orders)


def basis_settings(
    data: ResponseData, terms: ResidualTerms, phase: bool, window: str | None
) -> BasisSettings:
    """Residual terms, phase and window of the receptances of a band, see `fit_linear_modes`.

    Raises `ValueError` for unknown options, and for leakage between lines that are not on a grid.
    """
    if terms not in get_args(ResidualTerms):
        raise InputError(
            f"`residual_terms` must be one of {', '.join(get_args(ResidualTerms))}, but is "
            f"{terms!r}."
        )
    if terms == "auto":
        terms = "both" if data.omega[-1] > _NARROW * data.omega[0] else "upper"
    time = None
    if window is not None:
        if window != "hann":
            raise InputError(f"`window` must be 'hann' or not stated, but is {window!r}.")
        spacing = np.diff(data.omega)
        step = float(np.median(spacing))
        # Lines may be missing, but must lie on a grid.
        if np.any(np.abs(spacing / step - np.round(spacing / step)) > _EVEN):
            raise InputError("leakage is modelled for evenly spaced lines, but these are not.")
        time = 2 * np.pi / step
    return BasisSettings(
        lower=terms in ("both", "lower"),
        upper=terms in ("both", "upper"),
        phase=phase,
        window_time=time,
    )


def _orders(data: ResponseData, highest: int | None) -> PoleOrders:
    lines = len(data.omega)
    most = max(2, min(_HIGHEST, lines // _LINES_PER_ORDER))
    if highest is not None and not 1 <= highest <= lines // 2:
        raise InputError(
            f"the highest order must be from 1 to half the number of lines, {lines // 2}, but is "
            f"{highest}."
        )
    measured, weights = filled_receptance(data), line_weights(data)
    weights = weights / np.sqrt(np.mean(np.abs(measured * weights) ** 2, axis=1))[:, None]
    factor = data.measured_factor
    phase = (1j ** np.array(data.powers))[:, None]
    return poles_of_responses(
        data.omega, measured * factor * phase, weights / factor, highest or most
    )


def _start(
    data: ResponseData, orders: PoleOrders, poles: Sequence[float] | None, order: int | None
) -> Complex[np.ndarray, " mode"]:
    """Starting poles."""
    band = float(data.omega[0]), float(data.omega[-1])
    if poles is not None:
        return _by_hand(orders, np.asarray(poles, dtype=float), band)
    if order is not None:
        if not 1 <= order <= orders.highest:
            raise InputError(
                f"`order` must be from 1 to {orders.highest}, the highest that was computed, but "
                f"is {order}."
            )
        of_order = orders.pole[orders.order == order]
        inside = (np.abs(of_order) >= band[0]) & (np.abs(of_order) <= band[1])
        of_order = of_order[
            inside & (of_order.real < 0) & (-of_order.real < LIGHTLY_DAMPED * np.abs(of_order))
        ]
        if not of_order.size:
            raise InputError(
                f"model order {order} has no lightly damped pole in the band: state a higher "
                "`order`, or none."
            )
        return of_order[np.argsort(np.abs(of_order))]
    stable = clusters(orders, band)
    damped, growing = stable[stable.real < 0], stable[stable.real > 0]
    if damped.size:
        return damped
    where = f"between {band[0] / HERTZ:.6g} and {band[1] / HERTZ:.6g} Hz"
    if growing.size:
        listed = ", ".join(
            f"{100 * -p.real / abs(p):.3g} % at {abs(p) / HERTZ:.6g} Hz" for p in growing[:3]
        )
        raise GrowingModes(f"all modes {where} have negative damping ({listed})")
    raise InputError(
        f"no pole is stable over the model orders {where}: widen the band, raise the highest "
        "order, or give the natural frequencies by hand."
    )


def _by_hand(
    orders: PoleOrders, given: np.ndarray, band: tuple[float, float]
) -> Complex[np.ndarray, " mode"]:
    if not given.size or not np.isfinite(given).all():
        raise InputError("`poles` must be natural frequencies, at least one.")
    chosen = []
    for omega in np.sort(given):
        if not band[0] <= omega <= band[1]:
            raise InputError(
                f"a pole must lie in the band, {band[0] / HERTZ:.6g} to {band[1] / HERTZ:.6g} "
                f"Hz, but {omega / HERTZ:.6g} Hz was given."
            )
        damped = orders.pole[(orders.pole.real < 0) & (orders.damping_ratio < LIGHTLY_DAMPED)]
        distance = np.abs(np.abs(damped) - omega)
        near = damped[distance < _NEAR * omega]
        ratio = _USUAL
        if near.size:
            best = near[np.argmin(distance[distance < _NEAR * omega])]
            ratio = float(-best.real / abs(best))
        chosen.append(complex(-ratio * omega, omega * np.sqrt(1 - ratio**2)))
    return np.array(chosen)


def _fitted(
    data: ResponseData,
    settings: BasisSettings,
    start: Complex[np.ndarray, " mode"],
    *,
    keep_all: bool,
) -> tuple[SeparableFit, FitSpread]:
    """The fit with converged weights, without insignificant modes."""
    unknowns = np.concatenate(
        [np.abs(start), -start.real / np.abs(start), np.zeros(int(settings.phase))]
    )
    std = 1 / np.maximum(line_weights(data), 1e-300)
    while True:
        fit, spread = weighted_fit(data, settings, unknowns, std)
        worst = None if keep_all else _least_certain(fit, settings, data)
        if worst is None:
            break
        n = (len(unknowns) - settings.phase) // 2
        if n == 1:
            raise InputError(
                "no mode stands out of the errors of the responses: the residues of all are "
                "within four standard errors of zero."
            )
        unknowns, std = np.delete(fit.unknowns, [worst, n + worst]), spread.std
    return fit, spread


def _with_curvature(
    data: ResponseData, settings: BasisSettings, fit: SeparableFit, spread: FitSpread
) -> tuple[BasisSettings, SeparableFit, FitSpread]:
    """The fit with a residual term Ω² where it lowers the sum of squares significantly."""
    wider = settings._replace(curved=True)
    other, own = weighted_fit(data, wider, fit.unknowns, spread.std, rounds=1)
    before, after = np.sum(fit.residuals**2), np.sum(other.residuals**2)
    free = np.count_nonzero(np.isfinite(data.receptance)) * 2
    if (before - after) * free <= _SIGNIFICANT_CURVATURE * len(data.channels) * after:
        return settings, fit, spread
    return wider, *weighted_fit(data, wider, other.unknowns, own.std)


def _least_certain(fit: SeparableFit, settings: BasisSettings, data: ResponseData) -> int | None:
    """The least significant or an implausible mode; None where all are modes."""
    natural, ratio, _ = unpacked(fit.unknowns, settings)
    n = len(natural)
    certain = np.zeros(n)
    for k in range(n):
        std = np.sqrt(np.abs(np.diag(fit.term_covariance(k))))
        certain[k] = np.max(np.abs(fit.coefficients[:, k]) / np.maximum(std, 1e-300))
    pole = natural * (-ratio + 1j * np.sqrt(np.maximum(1 - ratio**2, 0.0)))
    gap = np.abs(pole[:, None] - pole) + np.diag(np.full(n, np.inf))
    twins = np.any(gap < _TWINS * np.abs(pole.real[:, None]), axis=1)
    if twins.any():
        return int(np.argmax(twins))
    outside = (natural < data.omega[0]) | (natural > data.omega[-1])
    odd = outside | (ratio <= 0) | (ratio > 0.5)
    if odd.any() and not odd.all():
        return int(np.flatnonzero(odd)[np.argmin(certain[odd])])
    worst = int(np.argmin(certain))
    return worst if certain[worst] < SIGNIFICANT else None


def _check_modes(fit: SeparableFit, settings: BasisSettings) -> None:
    natural, ratio, _ = unpacked(fit.unknowns, settings)
    if np.all(ratio < 0):
        raise GrowingModes(
            f"all modes have negative damping ({100 * ratio[0]:.3g} % at "
            f"{natural[0] / HERTZ:.6g} Hz)"
        )
    if np.any(ratio <= 0) or np.any(ratio >= MOST_DAMPED):
        k = int(np.argmax((ratio <= 0) | (ratio >= MOST_DAMPED)))
        raise InputError(
            f"the mode at {natural[k] / HERTZ:.6g} Hz has the damping ratio {ratio[k]:.3g}: the "
            "responses do not show such a mode; give other poles or another band."
        )
