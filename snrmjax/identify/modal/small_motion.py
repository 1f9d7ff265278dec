"""Modes of a free decay at zero amplitude, where frequency or damping change with amplitude.

The decay is fitted from several first samples, each where the motion has halved again, starting
with the last one: there the motion is most nearly linear, and each fit starts the next earlier one.
In each, Schwarz' criterion selects the powers of the amplitude of the strongest mode on which its
rates depend. The result is the earliest part that leaves only noise in the samples it adds and
agrees with the zero-amplitude limit of the next later part.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from snrmjax.identify.modal.decay_fit import (
    DecayFit,
    WaveForm,
    decaying_columns,
    fit_waves,
    significant,
    with_harmonics,
    with_modes,
    without_mode,
)
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

Candidates = Callable[[Float[np.ndarray, "channel sample"]], list[complex]]
"""Candidate poles of a part of the record."""

_MEDIAN_OF_POWER = float(np.log(2))  # median over mean of the power in a spectrum's bins
_NOISE_BANDS = 16
# Dry friction: the last halvings of the amplitude take less and less time.
_FALLS, _SHORTER, _MUCH_LONGER = 3, 0.93, 1.5
_DRY = "its damping grows as the motion falls, as dry friction has it"
_HALVINGS = 10  # of the amplitude, from the first part to the last
_FEWEST_SAMPLES, _FEWEST_CYCLES = 60, 8
_MOST_MODES, _MORE_MODES = 6, 2  # of linear modes, and added to an amplitude-dependent mode
_STRENGTH = 150.0  # signal-to-noise ratio of a part, all samples together
_SMOOTHED = 4  # cycles over which the envelope is smoothed
# Powers of the amplitude on which rates may depend, in the order of trial.
_POWERS: tuple[tuple[int, ...], ...] = (
    *((), (2,), (1, 2), (2, 4), (1, 2, 4), (2, 4, 6), (1, 2, 4, 6)),
)
_FRICTION: tuple[tuple[int, ...], ...] = ((-1,), (-1, 2))
_BETTER = 6.0  # significant increase of Schwarz' criterion
_MOST_GROWN = 2.0  # of a log amplitude, from one part to the next earlier one
_SIGNIFICANT_CHANGE = 30.0  # χ² of the amplitude dependence
_LEFT = 1.05  # residuals over noise, to which three standard errors are added
_LEFT_OF_MOTION = 1e-5  # of the motion: floor of the noise estimate
_CYCLES_OF_LINE = 10
_NOT_KNOWN = (0.01, 0.5)  # largest relative 1σ of ω and of ζ
_CLOSE = 0.1  # of a frequency: a mode this close may be an artefact of amplitude dependence
_SAME = 0.02  # of a frequency, for the same mode in two parts
_LARGEST_CHANGE = (0.02, 0.25)  # relative change of ω and of ζ from the end of the record to rest


class PartFit(NamedTuple):
    """A decay fitted from one sample on."""

    first: int  # sample
    seconds: float  # from there to the end
    fitted: DecayFit
    settled: bool  # only noise is left in the samples before the next later part
    spread: Float[np.ndarray, "2 mode"]  # 1σ of ω and ζ from the choice of powers

    @property
    def depends_on_amplitude(self) -> bool:
        """Whether rates depend significantly on the amplitude."""
        return self.fitted.change > _SIGNIFICANT_CHANGE

    def values(self) -> tuple[np.ndarray, np.ndarray]:
        """ω and ζ of all modes at zero amplitude, and their 1σ; both of shape (2, mode)."""
        n = self.fitted.form.n_modes
        std = np.sqrt(np.diag(self.fitted.fit.covariance)[: 2 * n].reshape(2, n))
        return self.fitted.unknowns[: 2 * n].reshape(2, n), np.hypot(std, self.spread)

    def limit(self) -> tuple[np.ndarray, np.ndarray]:
        """ω and ζ of the leading mode at zero amplitude, and their 1σ."""
        value, std = self.values()
        return value[:, self.fitted.form.leading], std[:, self.fitted.form.leading]


def noise_of_channels(values: Float[np.ndarray, "channel sample"]) -> Float[np.ndarray, " channel"]:
    """1σ of white noise, possibly low-passed, from medians of the spectrum.

    Bands far below the median level are filtered; bands above it contain modes.
    """
    window = np.hanning(values.shape[1])
    spectrum = np.fft.rfft((values - values.mean(axis=1, keepdims=True)) * window, axis=1)
    power = np.abs(spectrum) ** 2 / np.sum(window**2) / _MEDIAN_OF_POWER
    density = np.stack(
        [np.median(band, axis=1) for band in np.array_split(power, _NOISE_BANDS, axis=1)]
    )
    level = np.median(density, axis=0)
    density = np.where(density < level / 2, density, level)
    motion = np.mean(values**2, axis=1)
    return np.sqrt(density.mean(axis=0) + _LEFT_OF_MOTION**2 * motion)


def envelope(
    values: Float[np.ndarray, "channel sample"], noise: Float[np.ndarray, " channel"], rate: float
) -> tuple[Float[np.ndarray, " sample"], float]:
    """Monotonic envelope over the noise, and the strongest frequency in rad/s."""
    from scipy.ndimage import uniform_filter1d

    away = values - np.median(values, axis=1, keepdims=True)
    away = away / np.maximum(noise, 1e-12 * np.abs(away).max())[:, None]
    power = np.sum(np.abs(np.fft.rfft(away * np.hanning(away.shape[1]), axis=1)) ** 2, axis=0)
    omega = HERTZ * rate * np.argmax(power[1:] + 0.0) / away.shape[1] + HERTZ * rate / away.shape[1]
    width = int(np.clip(_SMOOTHED * HERTZ / omega * rate, 8, away.shape[1] // 4))
    square = 2 * uniform_filter1d(np.mean(away**2, axis=0) - 1, width, mode="nearest")
    return np.sqrt(np.maximum(np.maximum.accumulate(square[::-1])[::-1], 0.0)), float(omega)


def is_linear(
    values: Float[np.ndarray, "channel sample"],
    time: Float[np.ndarray, " sample"],
    fitted: DecayFit,
    noise: Float[np.ndarray, " channel"],
) -> bool:
    """Whether linear modes leave only noise, and amplitude-dependent rates fit no better."""
    if not _settled(fitted, noise):
        return False
    fitted = _leading(fitted, time)
    trials = [
        one
        for base in (fitted, *_without_close(fitted, values, time))
        for one in _with_better_powers(base, values, time)
    ]
    return max(one.information for one in trials) < fitted.information + _BETTER


def nonlinear_before_last_part(
    parts: list[PartFit], fitted: DecayFit, noise: Float[np.ndarray, " channel"]
) -> bool:
    """Whether linear modes explain a later part within noise, but not the whole record."""
    return parts[-1].settled and not parts[0].settled and not _settled(fitted, noise)


def parts_of_decay(
    values: Float[np.ndarray, "channel sample"],
    rate: float,
    candidates: Candidates,
    noise: Float[np.ndarray, " channel"],
    progress: Callable[[int, int], None] | None = None,
) -> list[PartFit]:
    """Fits of all parts, the earliest first.

    They stop at the first part with more than noise left where the next later one left only noise.
    `progress` is called with the number of finished parts and their total.
    """
    amplitude, omega = envelope(values, noise, rate)
    begins = _begins(amplitude, omega, rate)
    if _halving_accelerates(begins):
        last = begins[-_FALLS], omega  # the motion may have stopped afterwards
        raise InputError(_refusal([], last, values, rate, _DRY))
    parts: list[PartFit] = []
    for number, first in enumerate(reversed(begins), 1):
        part = values[:, first:]
        time = np.arange(part.shape[1]) / rate
        later = parts[-1] if parts else None
        fit_and_spread = _of_part(part, time, candidates, later, noise)
        if progress is not None:
            progress(number, len(begins))
        if fit_and_spread is None:
            continue
        fitted, spread = fit_and_spread
        added = fitted.residuals[:, : None if later is None else later.first - first]
        settled = _of_noise(added, noise)
        parts.append(PartFit(first, float(time[-1]), fitted, settled, spread))
        if later is not None and later.settled and not settled:
            break
    return parts[::-1]


def _halving_accelerates(begins: list[int]) -> bool:
    """Whether the last halvings take less and less time, unlike viscously damped motion."""
    times = np.diff(begins)
    return len(times) >= _FALLS and bool(
        np.all(times[1 - _FALLS :] < _SHORTER * times[-_FALLS:-1])
        and times.max() > _MUCH_LONGER * times[-1]
    )


def _begins(amplitude: np.ndarray, omega: float, rate: float) -> list[int]:
    begins, fewest = [0], max(_FEWEST_SAMPLES, _FEWEST_CYCLES * HERTZ / omega * rate)
    for k in range(1, _HALVINGS + 1):
        low = amplitude <= amplitude[0] * 0.5**k
        first = int(np.argmax(low)) if low[-1] else 0
        rest = amplitude[first:]
        if not first or len(rest) < fewest or np.sqrt(np.sum(rest**2) / 2) < _STRENGTH:
            break
        if first > begins[-1]:
            begins.append(first)
    return begins


def _earlier(later: DecayFit, seconds: float) -> np.ndarray:
    """Its unknowns, in units of the leading mode's amplitude at a time `seconds` earlier."""
    form, n, k = later.form, later.form.n_modes, later.form.leading
    unknowns, powers = later.unknowns.copy(), np.array(form.powers)
    decay, grown, steps = unknowns[2 * n : 2 * n + len(powers)], 0.0, 200
    for _ in range(steps):
        rate = unknowns[k] * unknowns[n + k] + float(decay @ np.exp(powers * grown))
        grown = float(np.clip(grown + rate * seconds / steps, 0.0, _MOST_GROWN))
    unknowns[2 * n :] *= np.tile(np.exp(powers * grown), 2)
    return unknowns


def _of_part(
    part: np.ndarray,
    time: np.ndarray,
    candidates: Candidates,
    later: PartFit | None,
    noise: np.ndarray,
) -> tuple[DecayFit, np.ndarray] | None:
    """The fit of a part, and the effect of the choice of powers on its limit."""
    plain = None
    if later is not None and later.depends_on_amplitude:
        # Rates that depend on a smaller amplitude do so here.
        start = _earlier(later.fitted, time[-1] - later.seconds)
        base = with_harmonics(part, time, fit_waves(part, time, start, later.fitted.form))
    else:
        plain = with_modes(part, time, candidates(part), most=_MOST_MODES)
        if plain is None:
            return None
        plain = _leading(plain, time)
        base = _leading_mode_only(plain, part, time)
    trials = _with_better_powers(base, part, time)
    if plain is not None and plain.form.n_modes > 1 and _settled(plain, noise):
        trials += _with_better_powers(plain, part, time)
    fitted = max(trials, key=lambda one: one.information)
    if not _settled(fitted, noise):
        most = fitted.form.n_modes + _MORE_MODES
        fitted = with_modes(part, time, candidates(fitted.residuals), fitted, most) or fitted
    fitted = _without_needless(fitted, part, time)
    if plain is not None and (
        plain.information + _BETTER > fitted.information or not fitted.form.powers
    ):
        fitted = plain
    return fitted, _spread_of(trials, fitted)


def _without_needless(fitted: DecayFit, part: np.ndarray, time: np.ndarray) -> DecayFit:
    """Without linear modes next to an amplitude-dependent one that do not improve the fit."""
    lead = fitted.natural_frequency[fitted.form.leading]
    for omega in fitted.natural_frequency[np.argsort(fitted.energy(time))]:
        mode = int(np.argmin(np.abs(fitted.natural_frequency - omega)))
        if omega == lead or mode == fitted.form.leading or not fitted.form.powers:
            continue
        less = without_mode(part, time, fitted, mode)
        if less.information > fitted.information:
            fitted = less
    return fitted


def _settled(fitted: DecayFit, noise: np.ndarray) -> bool:
    """Whether only noise is left."""
    return _of_noise(fitted.residuals, noise)


def _of_noise(residuals: np.ndarray, noise: np.ndarray) -> bool:
    allowed = _LEFT + 3 / np.sqrt(2 * residuals.size)
    return bool(np.mean((residuals / noise[:, None]) ** 2) < allowed**2)


def _with_better_powers(base: DecayFit, part: np.ndarray, time: np.ndarray) -> list[DecayFit]:
    """Fits of more and more powers of the amplitude, until two in a row are no better."""
    trials, since = [base], 0
    for powers in _POWERS[_POWERS.index(base.form.powers) + 1 :]:
        better = max(one.information for one in trials) + _BETTER
        tried = with_harmonics(part, time, _with_powers(base, powers, part, time))
        trials.append(tried)
        since = 0 if tried.information > better else since + 1
        if since == 2:
            break
    return trials


def _spread_of(trials: list[DecayFit], fitted: DecayFit) -> np.ndarray:
    """1σ of ω and ζ of the modes over fits of other powers, weighted by probability."""
    k, n = fitted.form.leading, fitted.form.n_modes
    total, square = 1.0, np.zeros(2 * n)
    for one in trials:
        if one.form.n_modes == n and one.form.leading == k and one is not fitted:
            weight = float(np.exp(min((one.information - fitted.information) / 2, 0.0)))
            square = square + weight * (one.unknowns[: 2 * n] - fitted.unknowns[: 2 * n]) ** 2
            total += weight
    return np.sqrt(square / total).reshape(2, n)


def _leading_mode_only(fitted: DecayFit, part: np.ndarray, time: np.ndarray) -> DecayFit:
    """The leading mode without the others."""
    k, n = fitted.form.leading, fitted.form.n_modes
    if n == 1:
        return fitted
    return fit_waves(part, time, fitted.unknowns[[k, n + k]], WaveForm(1))


def _without_close(fitted: DecayFit, part: np.ndarray, time: np.ndarray) -> list[DecayFit]:
    """The fit without modes close to the leading one and its harmonics, if there are any.

    Several close linear modes can mimic one whose rates depend on its amplitude.
    """
    n, k = fitted.form.n_modes, fitted.form.leading
    ratio = fitted.natural_frequency / fitted.natural_frequency[k]
    order = np.clip(np.round(ratio), 1, 3)
    kept = (np.abs(ratio / order - 1) > _CLOSE) | (np.arange(n) == k)
    if kept.all():
        return []
    form = WaveForm(int(kept.sum()), leading=int(kept[:k].sum()))
    return [fit_waves(part, time, fitted.unknowns[: 2 * n][np.tile(kept, 2)], form, fitted.scale)]


def _leading(fitted: DecayFit, time: np.ndarray) -> DecayFit:
    """With the strongest mode as the one that may depend on its amplitude."""
    strongest = int(np.argmax(fitted.energy(time)))
    return fitted._replace(form=fitted.form._replace(leading=strongest))


def _with_powers(
    base: DecayFit, powers: tuple[int, ...], part: np.ndarray, time: np.ndarray
) -> DecayFit:
    n, count = base.form.n_modes, len(base.form.powers)
    terms = np.zeros((2, len(powers)))
    for column, power in enumerate(powers):
        if power in base.form.powers:
            index = 2 * n + base.form.powers.index(power)
            terms[:, column] = base.unknowns[index], base.unknowns[index + count]
    form = base.form._replace(powers=powers)
    unknowns = np.concatenate([base.unknowns[: 2 * n], terms.ravel()])
    return fit_waves(part, time, unknowns, form, base.scale)


def small_motion(
    parts: list[PartFit], values: Float[np.ndarray, "channel sample"], rate: float
) -> tuple[PartFit, Bool[np.ndarray, " mode"]]:
    """The part whose fit gives the limit of small motion, and which of its modes are accepted.

    Accepted are the leading mode and those also present in the next later part: residuals of an
    amplitude-dependent mode can appear as modes. The 1σ includes the choice of powers and the
    difference from the next later part, of all modes.
    Raises `ValueError` if rates depend on the amplitude and the limit is not in the record.
    """
    dependent = [part for part in parts if part.depends_on_amplitude]
    last = parts[-1].first, float(parts[-1].limit()[0][0])
    chosen: PartFit | None = None
    before: PartFit | None = None
    for part in reversed(parts):
        if not part.settled:
            break
        if chosen is not None:
            part = part._replace(spread=np.hypot(part.spread, _beyond(part, chosen)))
        chosen, before = part, chosen
    if chosen is None:
        raise InputError(_refusal(parts, last, values, rate, "no part of it is explained"))
    here = values[:, chosen.first :]
    time = np.arange(here.shape[1]) / rate
    if dependent and not chosen.fitted.form.powers:
        # Rates that depend on larger amplitudes may do so slightly here: powers are kept.
        refit = _with_powers(chosen.fitted, dependent[-1].fitted.form.powers, here, time)
        chosen = chosen._replace(fitted=refit)
    fitted = chosen.fitted
    with_friction = [_with_powers(fitted, powers, here, time) for powers in _FRICTION]
    if max(one.information for one in with_friction) > fitted.information + _BETTER:
        raise InputError(_refusal(parts, last, values, rate, _DRY))
    value, std = chosen.limit()
    change = np.abs(_at_the_end(fitted, time) / value - 1)
    if value[1] <= 0 or np.any(change > _LARGEST_CHANGE) or np.any(std / value > _NOT_KNOWN):
        why = "they are still changing where it ends or disappears in noise"
        raise InputError(_refusal(parts, last, values, rate, why))
    kept = significant(fitted) & (fitted.damping_ratio > 0)
    if before is not None:
        later = before.fitted.natural_frequency
        kept &= np.abs(fitted.natural_frequency[:, None] / later - 1).min(axis=1) < _SAME
    kept[fitted.form.leading] = True
    return chosen, kept


def _beyond(part: PartFit, later: PartFit) -> np.ndarray:
    """Differences of ω and ζ of all modes from a later part, beyond its larger errors.

    Rates of other modes may also depend on the amplitude of the leading one.
    """
    (here, std), (there, there_std) = part.values(), later.values()
    same = np.argmin(np.abs(here[0][:, None] / there[0] - 1), axis=1)
    wider = np.maximum(there_std[:, same] ** 2 - std**2, 0.0)
    return np.sqrt(np.maximum((here - there[:, same]) ** 2 - wider, 0.0))


def _refusal(
    parts: list[PartFit],
    last_begin: tuple[int, float],
    values: Float[np.ndarray, "channel sample"],
    rate: float,
    why: str,
) -> str:
    """Message: the decay is not linear, why its limit is not known, and which part is linear.

    `last_begin` is the first sample of the last part and a frequency in rad/s near the mode's.
    """
    begin, omega = last_begin
    begin = begin or max(values.shape[1] - int(_CYCLES_OF_LINE * HERTZ / omega * rate), 0)
    first, last = (frequency_at(values, at, rate, omega) for at in (0, begin))
    words = "no part of the record is linear within noise"
    linear = [part for part in parts if not part.depends_on_amplitude and part.settled]
    if linear:
        (natural, ratio), (std, ratio_std) = linear[0].limit()
        words = (
            f"only from {linear[0].first / rate:.4g} s after the largest value on is it linear "
            f"within noise ({natural / HERTZ:.5g} ± {1.96 * std / HERTZ:.1g} Hz, "
            f"{100 * ratio:.3g} ± {196 * ratio_std:.1g} % there): cut the record to that part if "
            "it is small enough a motion"
        )
    return (
        "the decay is not that of linear modes: frequency or damping change as the motion falls "
        f"({first:.5g} Hz at the largest value, {last:.5g} Hz {begin / rate:.4g} s later), and "
        f"{why}, so that their values at zero amplitude are not known. {words[0].upper()}"
        f"{words[1:]}. "
        + ("" if why == _DRY else "A longer record with less noise reaches smaller motion; ")
        + "`snrmjax compare` gives frequency and damping over the amplitude."
    )


def frequency_at(
    values: Float[np.ndarray, "channel sample"], first: int, rate: float, omega: float
) -> float:
    """Frequency (Hz) of the strongest line over some cycles of `omega` from a sample on."""
    length = int(_CYCLES_OF_LINE * HERTZ / omega * rate)
    part = values[:, first : first + length]
    padded = 16 * part.shape[1]
    spectrum = np.fft.rfft(part * np.hanning(part.shape[1]), padded, axis=1)
    power = np.sum(np.abs(spectrum) ** 2, axis=0)
    lowest = int(0.5 * omega / HERTZ / rate * padded)  # below are offsets of a motion that stopped
    return float(lowest + np.argmax(power[lowest:])) * rate / padded


def _at_the_end(fitted: DecayFit, time: np.ndarray) -> np.ndarray:
    """ω and ζ of the leading mode at the last sample."""
    n, k, n_powers = fitted.form.n_modes, fitted.form.leading, len(fitted.form.powers)
    column = decaying_columns(time, fitted.unknowns, fitted.form).columns[:, [k, n + k]]
    amplitude = float(np.hypot(*column[-1]))
    by_power = amplitude ** np.array(fitted.form.powers, dtype=float)
    decay, rotation = fitted.unknowns[2 * n :].reshape(2, n_powers) @ by_power
    omega, ratio = fitted.unknowns[[k, n + k]]
    rate, damped = omega * ratio + decay, omega * np.sqrt(1 - ratio**2) + rotation
    return np.array([np.hypot(damped, rate), rate / np.hypot(damped, rate)])
