"""Modes of a free decay at no amplitude, where frequency or damping change as the motion falls.

The decay is fitted from later and later beginnings, each time from where the motion has fallen to
half, and from the last one backwards: there the motion is most nearly linear, and what a fit finds
starts the next earlier one. In each, Schwarz' criterion chooses on which powers of the amplitude
of the strongest mode its rates depend. The earliest beginning counts that leaves no more than
noise in what it adds, and whose limit agrees with that of the next later one.
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
from snrmjax.numerics.units import HERTZ

Candidates = Callable[[Float[np.ndarray, "channel sample"]], list[complex]]
"""Poles of a part of the record."""

_MEDIAN_OF_POWER = float(np.log(2))  # over the mean, of a spectrum's bins
_NOISE_BANDS = 16
# Halvings of the amplitude of which each takes less time than the one before: of friction.
_FALLS, _SHORTER, _MUCH_LONGER = 3, 0.93, 1.5
_HALVINGS = 10  # of the amplitude, from the first beginning to the last
_FEWEST_SAMPLES, _FEWEST_CYCLES = 60, 8
_MOST_MODES, _MORE_MODES = 6, 2  # of linear modes, and with a mode that moves
_STRENGTH = 150.0  # amplitude over 1σ of the noise, of a part's samples together
_SMOOTHED = 4  # cycles, of the envelope
# Powers of the amplitude that rates may depend on, in the order in which they are tried.
_POWERS: tuple[tuple[int, ...], ...] = (
    *((), (2,), (1, 2), (2, 4), (1, 2, 4), (2, 4, 6), (1, 2, 4, 6)),
)
_FRICTION: tuple[tuple[int, ...], ...] = ((-1,), (-1, 2))
_BETTER = 6.0  # of Schwarz' criterion
_MOST_GROWN = 2.0  # of an amplitude's logarithm, from one beginning to an earlier one
_MOVES = 30.0  # χ² of all that moves with the amplitude, from which on it is not chance
_LEFT = 1.05  # residuals over the noise, that few samples exceed by three of its standard errors
_LEFT_OF_MOTION = 1e-5  # of the motion: no less noise is looked for
_CYCLES_OF_LINE = 10
_NOT_KNOWN = (0.01, 0.5)  # 1σ over ω and ζ
_CLOSE = 0.1  # of a frequency, between modes of which one may stand for a change of the other
_SAME = 0.02  # of a frequency, between a mode of two parts
_FURTHEST = (0.02, 0.25)  # relative change of ω and of ζ from the last motion recorded to none


class PartFit(NamedTuple):
    """A decay fitted from one beginning on."""

    first: int  # sample
    seconds: float  # from there to the end
    found: DecayFit
    settled: bool  # noise alone is left in what the next later part does not have
    moves: float  # χ² of what moves with the amplitude
    spread: Float[np.ndarray, "2"]  # 1σ of ω and ζ of the leading mode by the choice of powers

    @property
    def bent(self) -> bool:
        """Whether rates move with the amplitude."""
        return self.moves > _MOVES

    def limit(self) -> tuple[np.ndarray, np.ndarray]:
        """ω and ζ of the leading mode at no amplitude, and their 1σ."""
        k, n = self.found.form.leading, self.found.form.n_modes
        rows = [k, n + k]
        std = np.sqrt(np.diag(self.found.fit.covariance)[rows])
        return self.found.unknowns[rows], np.hypot(std, self.spread)


def noise_of_channels(values: Float[np.ndarray, "channel sample"]) -> Float[np.ndarray, " channel"]:
    """1σ of noise that is white but for what a filter took out of it, by medians of the spectrum.

    In bands far below the others a filter has taken it; bands above them hold modes.
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
    """Amplitude over the noise that is not exceeded later, and the strongest frequency in rad/s."""
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
    found: DecayFit,
    noise: Float[np.ndarray, " channel"],
) -> bool:
    """Whether linear modes leave noise alone, and rates that move with the amplitude no less."""
    if not _settled(found, noise):
        return False
    found = _leading(found, time)
    moved = [
        one
        for base in (found, *_without_close(found, values, time))
        for one in _with_better_powers(base, values, time)
    ]
    return max(one.information for one in moved) < found.information + _BETTER


def left_by_linear_modes(
    parts: list[PartFit], found: DecayFit, noise: Float[np.ndarray, " channel"]
) -> bool:
    """Whether linear modes leave noise alone of a later part, but not of the whole record."""
    return parts[-1].settled and not parts[0].settled and not _settled(found, noise)


def parts_of_decay(
    values: Float[np.ndarray, "channel sample"],
    rate: float,
    candidates: Candidates,
    noise: Float[np.ndarray, " channel"],
    progress: Callable[[int, int], None] | None = None,
) -> list[PartFit]:
    """Fits from all beginnings, the earliest first.

    They end at the first part that leaves more than noise where a later one left noise alone.
    `progress` is called with how many beginnings of how many are done.
    """
    size, omega = envelope(values, noise, rate)
    begins = _begins(size, omega, rate)
    if _halves_faster_and_faster(begins):
        last = begins[-_FALLS], omega  # the motion may have stopped since
        why = "its damping grows as the motion falls, as dry friction has it"
        raise ValueError(_refusal([], last, values, rate, why))
    parts: list[PartFit] = []
    for number, first in enumerate(reversed(begins), 1):
        part = values[:, first:]
        time = np.arange(part.shape[1]) / rate
        later = parts[-1] if parts else None
        fitted = _of_part(part, time, candidates, later, noise)
        if progress is not None:
            progress(number, len(begins))
        if fitted is None:
            continue
        found, spread = fitted
        added = found.residuals[:, : None if later is None else later.first - first]
        settled = _of_noise(added, noise)
        parts.append(PartFit(first, float(time[-1]), found, settled, _moves(found), spread))
        if later is not None and later.settled and not settled:
            break
    return parts[::-1]


def _halves_faster_and_faster(begins: list[int]) -> bool:
    """Whether the last halvings take less and less time, which small motion does not."""
    times = np.diff(begins)
    if len(times) < _FALLS:
        return False
    return bool(
        np.all(times[1 - _FALLS :] < _SHORTER * times[-_FALLS:-1])
        and times.max() > _MUCH_LONGER * times[-1]
    )


def _begins(size: np.ndarray, omega: float, rate: float) -> list[int]:
    begins = [0]
    fewest = max(_FEWEST_SAMPLES, _FEWEST_CYCLES * HERTZ / omega * rate)
    for k in range(1, _HALVINGS + 1):
        first = int(np.argmax(size <= size[0] * 0.5**k)) if size[-1] <= size[0] * 0.5**k else 0
        rest = size[first:]
        if not first or len(rest) < fewest or np.sqrt(np.sum(rest**2) / 2) < _STRENGTH:
            break
        if first > begins[-1]:
            begins.append(first)
    return begins


def _earlier(later: DecayFit, seconds: float) -> np.ndarray:
    """Its unknowns, in units of the amplitude that its leading mode had some time before."""
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
    """The fit of a part, and how far the choice of powers moves its limit."""
    plain = None
    if later is not None and later.bent:
        # What moves at a smaller amplitude moves here.
        start = _earlier(later.found, time[-1] - later.seconds)
        base = with_harmonics(part, time, fit_waves(part, time, start, later.found.form))
    else:
        plain = with_modes(part, time, candidates(part), most=_MOST_MODES)
        if plain is None:
            return None
        plain = _leading(plain, time)
        base = _alone(plain, part, time)
    moved = _with_better_powers(base, part, time)
    if plain is not None and plain.form.n_modes > 1 and _settled(plain, noise):
        moved += _with_better_powers(plain, part, time)
    found = max(moved, key=lambda one: one.information)
    if not _settled(found, noise):
        most = found.form.n_modes + _MORE_MODES
        found = with_modes(part, time, candidates(found.residuals), found, most) or found
    found = _without_needless(found, part, time)
    if plain is not None and (
        plain.information + _BETTER > found.information or not found.form.powers
    ):
        found = plain
    return found, _spread_of(moved, found)


def _without_needless(found: DecayFit, part: np.ndarray, time: np.ndarray) -> DecayFit:
    """Without linear modes beside one that moves, where that loses nothing."""
    lead = found.natural_frequency[found.form.leading]
    for omega in found.natural_frequency[np.argsort(found.energy(time))]:
        mode = int(np.argmin(np.abs(found.natural_frequency - omega)))
        if omega == lead or mode == found.form.leading or not found.form.powers:
            continue
        less = without_mode(part, time, found, mode)
        if less.information > found.information:
            found = less
    return found


def _settled(found: DecayFit, noise: np.ndarray) -> bool:
    """Whether noise alone is left."""
    return _of_noise(found.residuals, noise)


def _of_noise(residuals: np.ndarray, noise: np.ndarray) -> bool:
    allowed = _LEFT + 3 / np.sqrt(2 * residuals.size)
    return bool(np.mean((residuals / noise[:, None]) ** 2) < allowed**2)


def _with_better_powers(base: DecayFit, part: np.ndarray, time: np.ndarray) -> list[DecayFit]:
    """Fits of more and more powers of the amplitude, until two in a row are not better."""
    moved, since = [base], 0
    for powers in _POWERS[_POWERS.index(base.form.powers) + 1 :]:
        better = max(one.information for one in moved) + _BETTER
        tried = with_harmonics(part, time, _with_powers(base, powers, part, time))
        moved.append(tried)
        since = 0 if tried.information > better else since + 1
        if since == 2:
            break
    return moved


def _spread_of(moved: list[DecayFit], found: DecayFit) -> np.ndarray:
    """1σ of ω and ζ of the leading mode over fits of other powers, as probable as they are."""
    k, n = found.form.leading, found.form.n_modes
    rows, total, square = [k, n + k], 1.0, np.zeros(2)
    for one in moved:
        if one.form.n_modes == n and one.form.leading == k and one is not found:
            weight = float(np.exp(min((one.information - found.information) / 2, 0.0)))
            square = square + weight * (one.unknowns[rows] - found.unknowns[rows]) ** 2
            total += weight
    return np.sqrt(square / total)


def _alone(found: DecayFit, part: np.ndarray, time: np.ndarray) -> DecayFit:
    """The leading mode without the others."""
    k, n = found.form.leading, found.form.n_modes
    if n == 1:
        return found
    return fit_waves(part, time, found.unknowns[[k, n + k]], WaveForm(1))


def _without_close(found: DecayFit, part: np.ndarray, time: np.ndarray) -> list[DecayFit]:
    """The fit without modes close to the leading one and its harmonics, where there are some.

    Several linear modes beside each other can stand for one whose rates move.
    """
    n, k = found.form.n_modes, found.form.leading
    ratio = found.natural_frequency / found.natural_frequency[k]
    order = np.clip(np.round(ratio), 1, 3)
    kept = (np.abs(ratio / order - 1) > _CLOSE) | (np.arange(n) == k)
    if kept.all():
        return []
    form = WaveForm(int(kept.sum()), leading=int(kept[:k].sum()))
    return [fit_waves(part, time, found.unknowns[: 2 * n][np.tile(kept, 2)], form, found.scale)]


def _leading(found: DecayFit, time: np.ndarray) -> DecayFit:
    """With the strongest mode as the one that may move."""
    strongest = int(np.argmax(found.energy(time)))
    return found._replace(form=found.form._replace(leading=strongest))


def _with_powers(
    base: DecayFit, powers: tuple[int, ...], part: np.ndarray, time: np.ndarray
) -> DecayFit:
    n, count = base.form.n_modes, len(base.form.powers)
    terms = np.zeros((2, len(powers)))
    for column, power in enumerate(powers):
        if power in base.form.powers:
            place = 2 * n + base.form.powers.index(power)
            terms[:, column] = base.unknowns[place], base.unknowns[place + count]
    form = base.form._replace(powers=powers)
    unknowns = np.concatenate([base.unknowns[: 2 * n], terms.ravel()])
    return fit_waves(part, time, unknowns, form, base.scale)


def small_motion(
    parts: list[PartFit], values: Float[np.ndarray, "channel sample"], rate: float
) -> tuple[PartFit, Bool[np.ndarray, " mode"]]:
    """The part and fit whose limit of small motion counts, and which of its modes are modes.

    Beside the leading one those that the next later part has too: what a mode that moves leaves
    unexplained is no mode.

    Its 1σ holds the choice of powers and what the next later part says.
    Raises `ValueError` where rates move with the amplitude and the limit is not in the record.
    """
    moving = [part for part in parts if part.bent]
    last = parts[-1].first, float(parts[-1].limit()[0][0])
    chosen: PartFit | None = None
    before: PartFit | None = None
    for part in reversed(parts):
        if not part.settled:
            break
        if chosen is not None:
            (here, std), (there, there_std) = part.limit(), chosen.limit()
            off = np.abs(here - there)
            beyond = np.sqrt(np.maximum(off**2 - np.maximum(there_std**2 - std**2, 0.0), 0.0))
            part = part._replace(spread=np.hypot(part.spread, beyond))
        chosen, before = part, chosen
    if chosen is None:
        raise ValueError(_refusal(parts, last, values, rate, "no part of it is explained"))
    here = values[:, chosen.first :]
    time = np.arange(here.shape[1]) / rate
    if moving and not chosen.found.form.powers:
        # What moves at larger amplitudes may move a little here: no power at all is no choice.
        moved = _with_powers(chosen.found, moving[-1].found.form.powers, here, time)
        chosen = chosen._replace(found=moved)
    found = chosen.found
    rubbing = [_with_powers(found, powers, here, time) for powers in _FRICTION]
    if max(one.information for one in rubbing) > found.information + _BETTER:
        why = "its damping grows as the motion falls, as dry friction has it"
        raise ValueError(_refusal(parts, last, values, rate, why))
    value, std = chosen.limit()
    change = np.abs(_at_the_end(found, time) / value - 1)
    if value[1] <= 0 or np.any(change > _FURTHEST) or np.any(std / value > _NOT_KNOWN):
        why = "they are still changing where it ends or drowns in noise"
        raise ValueError(_refusal(parts, last, values, rate, why))
    kept = significant(found) & (found.damping_ratio > 0)
    if before is not None:
        later = before.found.natural_frequency
        kept &= np.abs(found.natural_frequency[:, None] / later - 1).min(axis=1) < _SAME
    kept[found.form.leading] = True
    return chosen, kept


def _refusal(
    parts: list[PartFit],
    last_begin: tuple[int, float],
    values: Float[np.ndarray, "channel sample"],
    rate: float,
    why: str,
) -> str:
    """That the decay is not linear, why its limit is not known, and what part is linear.

    `last_begin` is the sample of the last beginning and a frequency in rad/s near the mode's.
    """
    begin, omega = last_begin
    first, last = (frequency_at(values, at, rate, omega) for at in (0, begin))
    linear = [part for part in parts if not part.bent and part.settled]
    words = "no part of the record is linear within noise"
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
        f"({first:.5g} Hz at the largest value, {last:.5g} Hz "
        f"{begin / rate:.4g} s later), and {why}, so that their values at no amplitude "
        f"are not known. {words[0].upper()}{words[1:]}. A longer record with less noise reaches "
        "smaller motion; `snrmjax compare` gives frequency and damping over the amplitude."
    )


def frequency_at(
    values: Float[np.ndarray, "channel sample"], first: int, rate: float, omega: float
) -> float:
    """The strongest line of some cycles of `omega` from a sample on, in Hz."""
    length = int(_CYCLES_OF_LINE * HERTZ / omega * rate)
    part = values[:, first : first + length]
    part = part - part.mean(axis=1, keepdims=True)
    size = 16 * part.shape[1]
    power = np.sum(np.abs(np.fft.rfft(part * np.hanning(part.shape[1]), size, axis=1)) ** 2, axis=0)
    return float(np.argmax(power)) * rate / size


def _at_the_end(found: DecayFit, time: np.ndarray) -> np.ndarray:
    """ω and ζ of the leading mode at the last sample."""
    n, k, moving = found.form.n_modes, found.form.leading, len(found.form.powers)
    column = decaying_columns(time, found.unknowns, found.form).columns[:, [k, n + k]]
    size = float(np.hypot(*column[-1]))
    by_power = size ** np.array(found.form.powers, dtype=float)
    decay, turn = found.unknowns[2 * n :].reshape(2, moving) @ by_power
    omega, ratio = found.unknowns[[k, n + k]]
    rate = omega * ratio + decay
    natural = float(np.hypot(omega * np.sqrt(1 - ratio**2) + turn, rate))
    return np.array([natural, rate / natural])


def _moves(found: DecayFit) -> float:
    rows = slice(2 * found.form.n_modes, None)
    terms = found.unknowns[rows]
    if not terms.size:
        return 0.0
    covariance = found.fit.covariance[rows, rows]
    scale = np.sqrt(np.diag(covariance))
    scaled = np.linalg.pinv(covariance / np.outer(scale, scale), rcond=1e-8, hermitian=True)
    return float(terms / scale @ scaled @ (terms / scale))
