"""Decaying oscillations whose rates may depend on an amplitude, as columns of a separable fit.

A linear mode decays as e^{(−ζω + iω_d) t}. If its rates depend on its amplitude
A = e^u, A = 1 at the first sample, du/dt = −d(A) and dφ/dt = w(A) with d = ζω + Σ d_j A^{p_j} and
w = ω_d + Σ w_j A^{p_j}: cubic and quintic forces have p = 2 and 4, damping by v|v| has p = 1, dry
friction p = −1. Time and phase are then quadratures over u, t = ∫ du/d and φ = ∫ w/d du. Harmonics
of such a mode are additional columns A^p e^{ihφ}.
Reference: Feldman, Mech. Syst. Signal Process. 25 (2011) 735, doi:10.1016/j.ymssp.2010.07.018.
Modes are fitted to records by least squares one after another, the strongest first.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float
from scipy.integrate import cumulative_simpson
from scipy.interpolate import CubicHermiteSpline

from snrmjax.identify.modal.separable_fit import (
    SIGNIFICANT,
    ChannelRows,
    SeparableFit,
    TermColumns,
    fit_separable,
)

_NODES = 401  # of the logarithm of the amplitude
_SLOWEST = 1e-3  # decay rate over the largest one, below which the motion would not decay
_DEEPEST = 60.0  # largest decrease of that logarithm
HARMONICS = ((0, 2), (2, 2), (3, 3), (3, 5), (4, 4), (5, 5), (5, 7), (1, 3))
"""Orders and powers of the amplitude: leading terms of quadratic, cubic and quintic forces.

The last is an amplitude-dependent mode shape, for several channels only.
"""
_MOST_DAMPED = 0.5
_MOST_GROWTH = 3.0  # of a mode's log amplitude over the record
_MOST_MOVED = 0.5  # of ω_d, per power of the amplitude
_MOST_SHIFT = 0.2  # of ω, above its value at zero amplitude, for the frequency of a harmonic
_LEAST_DAMPED = 1e-5  # of starting values
_ROUNDS = 3  # of weights from the residuals of the previous fit
_MOST_MODES = 12
_STEPS = 30
_SETTLED = 1e-3  # of the sum of squares: 0.03 standard errors
_NEW = 1e-4  # of a wave outside the space of the present modes, below which it is no separate mode


Waves = Complex[np.ndarray, "*batch sample"]


class WaveForm(NamedTuple):
    """Layout of the unknowns: ω and ζ of every mode, then all d_j and all w_j."""

    n_modes: int
    leading: int = 0  # the mode whose rates depend on its amplitude, if there are powers
    powers: tuple[int, ...] = ()
    harmonics: tuple[tuple[int, int], ...] = ()  # of the leading mode: order, power


class _Flow(NamedTuple):
    """Logarithm of the amplitude and phase at the samples, and their derivatives."""

    log_amplitude: Float[np.ndarray, " sample"]
    phase: Float[np.ndarray, " sample"]
    log_by: Float[np.ndarray, "rate sample"]  # with respect to d_0, d_j, then w_0, w_j
    phase_by: Float[np.ndarray, "rate sample"]


def decaying_columns(
    time: Float[np.ndarray, " sample"], unknowns: Float[np.ndarray, " unknown"], form: WaveForm
) -> TermColumns:
    """Columns Re and −Im of every mode's wave, an offset, then harmonics; not finite if a mode does
    not decay.
    """
    n, n_powers = form.n_modes, len(form.powers)
    omega, ratio = unknowns[:n], unknowns[n : 2 * n]
    root = np.sqrt(1 - ratio**2)
    pole = -ratio * omega + 1j * omega * root
    n_terms = 2 * n + 1 + sum(2 if order else 1 for order, _ in form.harmonics)
    # Term by term in memory: each is written, and weighted by the fit, in one stride.
    columns = np.ones((n_terms, len(time)))
    by = np.zeros((len(unknowns), n_terms, len(time)))

    def put(terms: Sequence[int], wave: Waves, rows: Sequence[int], slopes: Waves) -> None:
        columns[terms[0]], by[rows, terms[0]] = wave.real, slopes.real
        for term in terms[1:]:
            columns[term], by[rows, term] = -wave.imag, -slopes.imag

    depends = form.leading if n_powers or form.harmonics else None
    for k in set(range(n)) - {depends}:
        wave, rows = np.exp(time * pole[k]), (k, n + k)
        rates = np.array([pole[k] / omega[k], -omega[k] - 1j * omega[k] * ratio[k] / root[k]])
        put(rows, wave, rows, rates[:, None] * (time * wave))
    if depends is not None:
        k = depends
        flow = _flow(time, pole[k], unknowns[2 * n :], form.powers)
        # Derivatives of d_0 = ζω and w_0 = ω√(1 − ζ²) with respect to ω and ζ.
        chain = np.zeros((2 + 2 * n_powers, 2 + 2 * n_powers))
        chain[0, 0], chain[0, 1 + n_powers] = ratio[k], root[k]
        chain[1, 0], chain[1, 1 + n_powers] = omega[k], -omega[k] * ratio[k] / root[k]
        chain[2 : 2 + n_powers, 1 : 1 + n_powers] = np.eye(n_powers)
        chain[2 + n_powers :, 2 + n_powers :] = np.eye(n_powers)
        log_by, phase_by = chain @ flow.log_by, chain @ flow.phase_by
        terms: list[tuple[int, ...]] = [(k, n + k)]
        first = 2 * n + 1
        for order, _ in form.harmonics:
            terms.append((first, first + 1) if order else (first,))
            first += len(terms[-1])
        for at, (order, power) in zip(terms, ((1, 1), *form.harmonics), strict=True):
            wave = np.exp(power * flow.log_amplitude + 1j * order * flow.phase)
            slopes = (power * log_by + 1j * order * phase_by) * wave
            put(at, wave, (k, n + k, *range(2 * n, len(unknowns))), slopes)
    return TermColumns(columns.T, by.transpose(0, 2, 1))


def _flow(time: np.ndarray, pole: complex, terms: np.ndarray, powers: tuple[int, ...]) -> _Flow:
    """The decay of the amplitude-dependent mode; NaN if it stops before the record ends."""
    powered = np.array((0, *powers))
    decay = np.concatenate([[-pole.real], terms[: len(powers)]])
    rotation = np.concatenate([[pole.imag], terms[len(powers) :]])
    span, count = float(time[-1]), 2 * len(powered)
    depth = 1.0 + 1.5 * max(decay[0], 0.0) * span
    none = np.full((count, len(time)), np.nan)
    nothing = _Flow(none[0], none[0], none, none)
    while True:
        fall = np.linspace(0.0, depth, _NODES)
        by_power = np.exp(-powered[:, None] * fall)
        rate, omega = decay @ by_power, rotation @ by_power
        if not np.isfinite(rate).all() or rate.min() <= _SLOWEST * rate.max():
            return nothing
        when = cumulative_simpson(1 / rate, x=fall, initial=0)
        if np.any(np.diff(when) <= 0):
            return nothing
        if when[-1] >= span or depth > _DEEPEST:
            break
        depth = min(1.5 * depth * max(1.0, span / max(when[-1], span / 4)), 2 * _DEEPEST)
    over = cumulative_simpson(by_power / rate, x=fall, initial=0, axis=1)
    twice = cumulative_simpson(by_power / rate**2, x=fall, initial=0, axis=1)
    by_phase = cumulative_simpson(omega * by_power / rate**2, x=fall, initial=0, axis=1)
    inside = np.minimum(time, when[-1])

    def at_samples(values: np.ndarray, by_fall: np.ndarray) -> np.ndarray:
        return CubicHermiteSpline(when, values, by_fall * rate, axis=-1)(inside)

    slope = np.gradient(rate, fall)
    omega_slope = np.gradient(omega, fall)
    log_by = -twice * rate
    phase_by = -by_phase + omega * twice
    none = np.zeros_like(over)
    return _Flow(
        at_samples(-fall, -np.ones_like(fall)),
        at_samples(rotation @ over, omega / rate),
        at_samples(
            np.concatenate([log_by, none]), np.concatenate([-by_power / rate - twice * slope, none])
        ),
        at_samples(
            np.concatenate([phase_by, over]), np.concatenate([omega_slope * twice, by_power / rate])
        ),
    )


class DecayFit(NamedTuple):
    """The least-squares fit of decaying waves; see `WaveForm` for the unknowns."""

    unknowns: Float[np.ndarray, " unknown"]
    form: WaveForm
    fit: SeparableFit
    scale: Float[np.ndarray, " channel"]  # 1σ of a sample, from the residuals

    @property
    def natural_frequency(self) -> Float[np.ndarray, " mode"]:
        """rad/s; at zero amplitude."""
        return self.unknowns[: self.form.n_modes]

    @property
    def damping_ratio(self) -> Float[np.ndarray, " mode"]:
        """At zero amplitude."""
        return self.unknowns[self.form.n_modes : 2 * self.form.n_modes]

    @property
    def amplitude(self) -> Complex[np.ndarray, "channel mode"]:
        """At the first sample."""
        n = self.form.n_modes
        return self.fit.coefficients[:, :n] + 1j * self.fit.coefficients[:, n : 2 * n]

    @property
    def amplitude_std(self) -> Float[np.ndarray, "channel mode"]:
        """1σ of real and of imaginary part."""
        n = self.form.n_modes
        variance = [
            np.diag(self.fit.term_covariance(k)) + np.diag(self.fit.term_covariance(n + k))
            for k in range(n)
        ]
        return np.sqrt(np.maximum(np.stack(variance, axis=1), 1e-300) / 2)

    @property
    def information(self) -> float:
        """Schwarz' criterion: twice the log likelihood less the penalty for unknowns."""
        shape = self.fit.residuals.shape
        square = np.mean(self.residuals**2, axis=1)
        log_likelihood = -shape[1] * np.sum(np.log(np.maximum(square, 1e-300)))
        return float(log_likelihood - self.n_unknowns * np.log(shape[0] * shape[1]))

    @property
    def n_unknowns(self) -> int:
        """All fitted values, including the coefficients of every channel."""
        return len(self.unknowns) + self.fit.coefficients.size

    @property
    def residuals(self) -> Float[np.ndarray, "channel sample"]:
        """Measured less fitted, in the channels' units."""
        return self.fit.residuals * self.scale[:, None]

    @property
    def change(self) -> float:
        """χ² of the amplitude dependence."""
        rows = slice(2 * self.form.n_modes, None)
        terms, covariance = self.unknowns[rows], self.fit.covariance[rows, rows]
        if not terms.size:
            return 0.0
        scale = np.sqrt(np.diag(covariance))
        scaled = np.linalg.pinv(covariance / np.outer(scale, scale), rcond=1e-8, hermitian=True)
        return float(terms / scale @ scaled @ (terms / scale))

    def energy(self, time: Float[np.ndarray, " sample"]) -> Float[np.ndarray, " mode"]:
        """Energy of every mode over the record, in units of the noise."""
        falls = np.exp(-2 * time[:, None] * self.natural_frequency * self.damping_ratio)
        return np.sum(np.abs(self.amplitude / self.scale[:, None]) ** 2, axis=0) * falls.sum(axis=0)


def fit_waves(
    values: Float[np.ndarray, "channel sample"],
    time: Float[np.ndarray, " sample"],
    unknowns: Float[np.ndarray, " unknown"],
    form: WaveForm,
    scale: Float[np.ndarray, " channel"] | None = None,
    *,
    settled: float = _SETTLED,
) -> DecayFit:
    """The fit from given unknowns, each channel weighted by the rms of its residuals."""
    scale = 0.1 * np.sqrt(np.mean(values**2, axis=1)) if scale is None else scale
    scale = np.maximum(scale, 1e-12 * max(float(np.abs(values).max()), 1e-300))
    n, n_powers = form.n_modes, len(form.powers)
    for _ in range(_ROUNDS):
        omega = unknowns[:n]
        # A mode may grow slightly over the record: hum, or a mode that is left out later.
        growth = -np.minimum(_MOST_GROWTH / (omega * time[-1]), _MOST_DAMPED)
        moved = np.full(2 * n_powers, _MOST_MOVED * omega[form.leading])
        low = np.concatenate([0.8 * omega, growth, -moved])
        high = np.concatenate([1.25 * omega, np.full(n, _MOST_DAMPED), moved])
        unknowns = _feasible(time, np.clip(unknowns, low, high), form)
        weights = np.broadcast_to(1 / scale[:, None], values.shape)
        rows = ChannelRows(values, weights, np.zeros(len(values), dtype=int), 1)
        fit = fit_separable(
            lambda x: [decaying_columns(time, x, form)],
            rows,
            unknowns,
            (low, high),
            settled=settled,
        )
        unknowns = fit.unknowns
        free = values.shape[1] - fit.coefficients.shape[1] - len(unknowns) / len(values)
        rms = np.sqrt(np.sum(fit.residuals**2, axis=1) / max(free, 1.0))
        used, scale = scale, scale * np.maximum(rms, 1e-9 * max(float(rms.max()), 1e-300))
        if np.all(np.abs(rms - 1) < 0.05):
            break
    return DecayFit(unknowns, form, fit.with_variance(float(np.mean(rms**2))), used)


def _feasible(time: np.ndarray, unknowns: np.ndarray, form: WaveForm) -> np.ndarray:
    """Unknowns with a weaker amplitude dependence, if the mode would not decay throughout."""
    n, k, feasible = form.n_modes, form.leading, unknowns.copy()
    for part in (1.0, 0.5, 0.2, 0.0) if form.powers else ():
        feasible[2 * n :] = part * unknowns[2 * n :]
        if part == 0.0:
            feasible[n + k] = max(feasible[n + k], _LEAST_DAMPED)
        if np.isfinite(decaying_columns(time, feasible, form).columns).all():
            break
    return feasible


def with_modes(
    values: Float[np.ndarray, "channel sample"],
    time: Float[np.ndarray, " sample"],
    candidates: Iterable[complex],
    now: DecayFit | None = None,
    most: int = _MOST_MODES,
) -> DecayFit | None:
    """The fit with poles added whose waves are significant in the residuals, the largest first.

    Returns None if none is.
    """
    left = list(candidates)
    while left and (now is None or now.form.n_modes < most):
        gains = _gains(values, time, left, now)
        best = int(np.argmax(gains))
        if gains[best] < SIGNIFICANT**2:
            break
        added = left.pop(best)
        now = fit_waves(values, time, *_added(now, added), None if now is None else now.scale)
    return now


def significant(fit: DecayFit) -> Bool[np.ndarray, " mode"]:
    """Whether a mode's largest amplitude is at least four times its standard error."""
    ratio = np.abs(fit.amplitude) / fit.amplitude_std
    return ratio.max(axis=0) >= SIGNIFICANT


def without_mode(
    values: Float[np.ndarray, "channel sample"],
    time: Float[np.ndarray, " sample"],
    fit: DecayFit,
    mode: int,
) -> DecayFit:
    """The fit with one mode less, other than an amplitude-dependent leading mode."""
    n, form = fit.form.n_modes, fit.form
    unknowns = np.delete(fit.unknowns, [mode, n + mode])
    form = form._replace(n_modes=n - 1, leading=form.leading - (mode < form.leading))
    return fit_waves(values, time, unknowns, form, fit.scale)


def _added(now: DecayFit | None, pole: complex) -> tuple[np.ndarray, WaveForm]:
    omega, ratio = abs(pole), -pole.real / abs(pole)
    if now is None:
        return np.array([omega, ratio]), WaveForm(1)
    n = now.form.n_modes
    return np.insert(now.unknowns, [n, 2 * n], [omega, ratio]), now.form._replace(n_modes=n + 1)


def with_harmonics(
    values: Float[np.ndarray, "channel sample"], time: Float[np.ndarray, " sample"], now: DecayFit
) -> DecayFit:
    """The fit with harmonics of the leading mode added that are significant in the residuals."""
    step = time[1] - time[0]
    fastest = now.natural_frequency[now.form.leading] * (1 + _MOST_SHIFT)
    open_ones = [
        (order, power)
        for order, power in (HARMONICS if len(values) > 1 else HARMONICS[:-1])
        if (order, power) not in now.form.harmonics and order * fastest < np.pi / step
    ]
    whole = now.form._replace(harmonics=(*now.form.harmonics, *open_ones))
    columns = decaying_columns(time, now.unknowns, whole).columns
    first = 2 * now.form.n_modes + 1
    owner = np.repeat(
        np.arange(len(whole.harmonics)), [2 if order else 1 for order, _ in whole.harmonics]
    )
    known = np.concatenate(
        [np.arange(first), first + np.flatnonzero(owner < len(now.form.harmonics))]
    )
    chosen = list(now.form.harmonics)
    space, left = _unit(columns[:, known]), now.fit.residuals
    while True:
        gains = np.zeros(len(whole.harmonics))
        for k, harmonic in enumerate(whole.harmonics):
            if harmonic not in chosen:
                gains[k], _ = _gain(columns[:, first + np.flatnonzero(owner == k)], space, left)
        best = int(np.argmax(gains)) if gains.size else 0
        if not gains.size or gains[best] < SIGNIFICANT**2:
            break
        chosen.append(whole.harmonics[best])
        _, new = _gain(columns[:, first + np.flatnonzero(owner == best)], space, left)
        left = left - (left @ new) @ new.T
        left = left / np.maximum(np.std(left, axis=1, keepdims=True), 1e-300)
        space = np.concatenate([space, new], axis=1)
    if len(chosen) == len(now.form.harmonics):
        return now
    return fit_waves(
        values, time, now.unknowns, now.form._replace(harmonics=tuple(chosen)), now.scale
    )


def _unit(columns: np.ndarray) -> np.ndarray:
    """An orthonormal basis."""
    return np.linalg.qr(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300))[0]


def _gain(columns: np.ndarray, space: np.ndarray, left: np.ndarray) -> tuple[float, np.ndarray]:
    """Largest reduction of a channel's sum of squares by additional columns.

    And an orthonormal basis of their part outside `space`.
    """
    columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    new, triangle = np.linalg.qr(columns - space @ (space.T @ columns))
    new = new[:, np.abs(np.diag(triangle)) > _NEW]
    return float(np.max(np.sum((left @ new) ** 2, axis=1), initial=0.0)), new


def _gains(
    values: np.ndarray, time: np.ndarray, poles: list[complex], now: DecayFit | None
) -> np.ndarray:
    if now is None:
        basis = np.ones((len(time), 1))
        left = values - values.mean(axis=1, keepdims=True)
        left = left / np.maximum(np.std(left, axis=1, keepdims=True), 1e-300)
    else:
        basis, left = decaying_columns(time, now.unknowns, now.form).columns, now.fit.residuals
    space = _unit(basis)
    waves = (np.exp(time * pole) for pole in poles)
    return np.array(
        [_gain(np.column_stack([wave.real, wave.imag]), space, left)[0] for wave in waves]
    )
