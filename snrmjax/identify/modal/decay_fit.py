"""Decaying oscillations fitted to records by least squares, mode after mode."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float

from snrmjax.identify.modal.decay_waves import HARMONICS, WaveForm, decaying_columns
from snrmjax.identify.modal.separable_fit import ChannelRows, SeparableFit, fit_separable

_SIGNIFICANT = 4.0  # standard errors of a mode's largest amplitude, without which it is none
_MOST_DAMPED = 0.5
_MOST_GROWTH = 3.0  # of a mode's logarithm over the record
_MOST_MOVED = 0.5  # of ω_d, by every power of the amplitude
_MOST_SHIFT = 0.2  # of ω, above its value at no amplitude, that a harmonic is looked for at
_LEAST_DAMPED = 1e-5  # of a start
_ROUNDS = 3  # of weights by the residuals of the fit before
_MOST_MODES = 12
_SETTLED = 1e-3  # of the sum of squares: 0.03 of a standard error
_NEW = 1e-4  # of a wave, that the modes there are cannot follow: less is no mode of its own


class DecayFit(NamedTuple):
    """The least-squares fit of some waves; see `WaveForm` for the unknowns."""

    unknowns: Float[np.ndarray, " unknown"]
    form: WaveForm
    fit: SeparableFit
    scale: Float[np.ndarray, " channel"]  # 1σ of a sample by the residuals

    @property
    def natural_frequency(self) -> Float[np.ndarray, " mode"]:
        """rad/s; at no amplitude."""
        return self.unknowns[: self.form.n_modes]

    @property
    def damping_ratio(self) -> Float[np.ndarray, " mode"]:
        """At no amplitude."""
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
        """Schwarz' criterion: twice the logarithm of the likelihood, less what unknowns cost."""
        size = self.fit.residuals.shape
        square = np.mean(self.residuals**2, axis=1)
        likely = -size[1] * np.sum(np.log(np.maximum(square, 1e-300)))
        return float(likely - self.n_unknowns * np.log(size[0] * size[1]))

    @property
    def n_unknowns(self) -> int:
        """All that was fitted, coefficients of every channel among them."""
        return len(self.unknowns) + self.fit.coefficients.size

    @property
    def residuals(self) -> Float[np.ndarray, "channel sample"]:
        """Measured less fitted, in the channels' units."""
        return self.fit.residuals * self.scale[:, None]

    def energy(self, time: Float[np.ndarray, " sample"]) -> Float[np.ndarray, " mode"]:
        """Of every mode over the record, in units of the noise."""
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
    """The fit from given unknowns, each channel weighted by the size of its own residuals."""
    scale = 0.1 * np.sqrt(np.mean(values**2, axis=1)) if scale is None else scale
    scale = np.maximum(scale, 1e-12 * max(float(np.abs(values).max()), 1e-300))
    n, moving = form.n_modes, len(form.powers)
    for _ in range(_ROUNDS):
        omega = unknowns[:n]
        # A mode may grow a little over the record: hum, or one that is then left out for that.
        growth = -np.minimum(_MOST_GROWTH / (omega * time[-1]), _MOST_DAMPED)
        moved = np.full(2 * moving, _MOST_MOVED * omega[form.leading])
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
    """With less of what moves with the amplitude where the mode would not decay all along."""
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
    """The fit with those poles whose waves stand out of what the others leave, the largest first.

    Returns None where none does.
    """
    left = list(candidates)
    while left and (now is None or now.form.n_modes < most):
        gains = _gains(values, time, left, now)
        best = int(np.argmax(gains))
        if gains[best] < _SIGNIFICANT**2:
            break
        added = left.pop(best)
        now = fit_waves(values, time, *_added(now, added), None if now is None else now.scale)
    return now


def significant(found: DecayFit) -> Bool[np.ndarray, " mode"]:
    """Whether a mode's largest amplitude is four times its standard error."""
    sure = np.abs(found.amplitude) / found.amplitude_std
    return sure.max(axis=0) >= _SIGNIFICANT


def without_mode(
    values: Float[np.ndarray, "channel sample"],
    time: Float[np.ndarray, " sample"],
    found: DecayFit,
    mode: int,
) -> DecayFit:
    """The fit with one mode less, which is not the leading one of a form that moves."""
    n, form = found.form.n_modes, found.form
    unknowns = np.delete(found.unknowns, [mode, n + mode])
    form = form._replace(n_modes=n - 1, leading=form.leading - (mode < form.leading))
    return fit_waves(values, time, unknowns, form, found.scale)


def _added(now: DecayFit | None, pole: complex) -> tuple[np.ndarray, WaveForm]:
    omega, ratio = abs(pole), -pole.real / abs(pole)
    if now is None:
        return np.array([omega, ratio]), WaveForm(1)
    n = now.form.n_modes
    return np.insert(now.unknowns, [n, 2 * n], [omega, ratio]), now.form._replace(n_modes=n + 1)


def with_harmonics(
    values: Float[np.ndarray, "channel sample"],
    time: Float[np.ndarray, " sample"],
    now: DecayFit,
) -> DecayFit:
    """The fit with those harmonics of the leading mode that stand out of what is left."""
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
    places = np.repeat(
        np.arange(len(whole.harmonics)), [2 if order else 1 for order, _ in whole.harmonics]
    )
    known = np.concatenate(
        [np.arange(first), first + np.flatnonzero(places < len(now.form.harmonics))]
    )
    chosen = list(now.form.harmonics)
    space, left = _unit(columns[:, known]), now.fit.residuals
    while True:
        gains = np.zeros(len(whole.harmonics))
        for k, harmonic in enumerate(whole.harmonics):
            if harmonic not in chosen:
                gains[k], _ = _gain(columns[:, first + np.flatnonzero(places == k)], space, left)
        best = int(np.argmax(gains)) if gains.size else 0
        if not gains.size or gains[best] < _SIGNIFICANT**2:
            break
        chosen.append(whole.harmonics[best])
        _, new = _gain(columns[:, first + np.flatnonzero(places == best)], space, left)
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
    """By how much columns would lower the sum of squares of the channel that has most of them.

    And an orthonormal basis of what they have beyond `space`.
    """
    columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    new, size = np.linalg.qr(columns - space @ (space.T @ columns))
    new = new[:, np.abs(np.diag(size)) > _NEW]
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
