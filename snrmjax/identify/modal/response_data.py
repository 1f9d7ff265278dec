"""Data of a modal fit from frequency responses: one reference, one band, errors of each line."""

import dataclasses
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int
from scipy.optimize import minimize

from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

ErrorSource = Literal["stated", "coherence", "residuals"]
"""Source of the weights: stated 1σ, coherence, or the residuals themselves."""

_FEWEST_LINES = 6
POWERS = {"displacement": 0, "velocity": 1, "acceleration": 2}
"""Powers of iΩ of a motion relative to the displacement."""

_LEAST_MISSING_COHERENCE = 1e-7  # 1 − γ² below which it is rounding of the file
_FEWEST_NUMBERS = 12  # of values of a channel, below which its errors have one standard deviation
_SPREAD = 1e-4  # of the rms residual: floor of the error model
_SMALLEST = 1e-12  # relative floor of errors, for noise-free responses
_SAME_FREQUENCY = 1e-9  # relative


class ResponseData(NamedTuple):
    """Receptances over one reference, with the 1σ of real and imaginary part of each."""

    omega: Float[np.ndarray, " line"]  # rad/s
    receptance: Complex[np.ndarray, "channel line"]  # NaN where not measured
    std: Float[np.ndarray, "channel line"]  # 1σ of each part; NaN where the source is residuals
    powers: tuple[int, ...]  # of iΩ in the quantity that each channel measured
    channels: tuple[Channel, ...]
    reference: Channel
    source: ErrorSource
    averages: int | None
    notes: tuple[Fact | str, ...]
    load: Float[np.ndarray, " line"] | float = 1.0  # of the reference, where motions were measured

    @property
    def measured_factor(self) -> Float[np.ndarray, "channel line"]:
        """|iΩ|^power of each channel times the load: factor from receptance to measured value."""
        return self.load * self.omega ** np.array(self.powers)[:, None]

    @property
    def coherence(self) -> Float[np.ndarray, "channel line"]:
        """The coherence equivalent to the 1σ at the measured magnitudes."""
        return 1 / (1 + 2 * (self.averages or 1) * (self.std / np.abs(self.receptance)) ** 2)

    def bases(self, *, windowed: bool) -> tuple[tuple[int, ...], Int[np.ndarray, " channel"]]:
        """Powers of iΩ with separate bases (under a window), and the basis of each channel."""
        if not windowed:
            return (0,), np.zeros(len(self.powers), dtype=int)
        powers = tuple(dict.fromkeys(self.powers))
        return powers, np.array([powers.index(power) for power in self.powers])


def response_data(
    responses: FrequencyResponses,
    *,
    std: Float[np.ndarray, "response frequency"] | None = None,
    reference: str | None = None,
    from_frequency: float | None = None,
    to_frequency: float | None = None,
) -> ResponseData:
    """The lines of a band over one reference, as receptances.

    Arguments: `std` 1σ of real and of imaginary part of each value, SI units of the measurement;
    `reference` the name of a channel where there are several; the band in rad/s.
    Raises `ValueError` for several references without a name, responses that are not a
    motion, a coherence outside 0 to 1, fewer than six lines in the band, and responses of zeros.
    """
    column = _reference(responses, reference)
    _check_quantities(responses)
    low = 0.0 if from_frequency is None else from_frequency
    high = np.inf if to_frequency is None else to_frequency
    if not low < high:
        raise InputError(
            f"the band must rise, but is from {low / HERTZ:.6g} to {high / HERTZ:.6g} Hz."
        )
    omega = responses.frequency
    keep = (omega > 0) & (omega >= low * (1 - 1e-12)) & (omega <= high * (1 + 1e-12))
    keep &= np.isfinite(responses.values[:, column]).any(axis=0)
    if keep.sum() < _FEWEST_LINES:
        raise InputError(
            f"modes need {_FEWEST_LINES} lines at least, but {int(keep.sum())} of "
            f"{len(omega)} lie in the band and were measured."
        )
    raw = responses.values[:, column][:, keep]
    for channel, row in zip(responses.responses, raw, strict=True):
        if not np.any(np.nan_to_num(row)):
            raise InputError(f"the response {channel.name} is zero or missing throughout the band.")
    coherence = responses.coherence[:, column][:, keep]
    bad = np.argwhere((coherence < 0) | (coherence > 1 + 1e-9))
    if bad.size:
        k, line = bad[0]
        raise InputError(
            f"a coherence must be from 0 to 1, but that of {responses.responses[k].name} at "
            f"{omega[keep][line] / HERTZ:.6g} Hz is {coherence[k, line]:.6g}."
        )
    powers = tuple(POWERS[channel.quantity] for channel in responses.responses)
    factor = omega[keep] ** np.array(powers)[:, None]
    receptance = raw / (1j * omega[keep]) ** np.array(powers)[:, None]
    spread, source, notes = _errors(responses, raw, coherence, std, keep)
    return ResponseData(
        omega[keep],
        receptance,
        spread / factor,
        powers,
        responses.responses,
        responses.references[column],
        source,
        responses.averages,
        (*responses.notes, *notes),
    )


def joined_responses(parts: Sequence[FrequencyResponses]) -> FrequencyResponses:
    """Responses of several files of one test, over the same reference.

    Raises `ValueError` if frequencies or references differ or a channel is repeated.
    """
    first = parts[0]
    for part in parts[1:]:
        file = part.name or "one file"
        if part.frequency.shape != first.frequency.shape or np.any(
            np.abs(part.frequency - first.frequency) > _SAME_FREQUENCY * first.frequency[-1]
        ):
            raise InputError(
                f"responses of one test must share their frequencies, but {file} has "
                f"{len(part.frequency)} lines to {part.frequency[-1] / HERTZ:.6g} Hz and "
                f"{first.name or 'the first'} {len(first.frequency)} to "
                f"{first.frequency[-1] / HERTZ:.6g} Hz."
            )
        if [r.name for r in part.references] != [r.name for r in first.references]:
            raise InputError(
                f"responses of one test must share their references, but {file} has "
                f"{', '.join(r.name for r in part.references)} and {first.name or 'the first'} "
                f"{', '.join(r.name for r in first.references)}."
            )
    channels = tuple(c for part in parts for c in part.responses)
    names = [c.name for c in channels]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"the response {name} comes {names.count(name)} times in the files.")
    return dataclasses.replace(
        first,
        values=np.concatenate([part.values for part in parts]),
        coherence=np.concatenate([part.coherence for part in parts]),
        responses=channels,
        notes=tuple(dict.fromkeys(note for part in parts for note in part.notes)),
    )


def _reference(responses: FrequencyResponses, name: str | None) -> int:
    names = [channel.name for channel in responses.references]
    if name is None and len(names) == 1:
        return 0
    if name is None:
        raise InputError(
            f"modes are fitted over one reference, but there are {len(names)} "
            f"({', '.join(names)}): name one as the reference."
        )
    if name not in names:
        raise InputError(f"there is no reference {name!r}; there are {', '.join(names)}.")
    return names.index(name)


def _check_quantities(responses: FrequencyResponses) -> None:
    for channel in responses.responses:
        if channel.quantity not in POWERS:
            named = channel.quantity if channel.quantity != "unknown" else "of no stated quantity"
            raise InputError(
                "a response must be a displacement, velocity or acceleration, but "
                f"{channel.name} is {named}."
            )


def _errors(
    responses: FrequencyResponses,
    raw: np.ndarray,
    coherence: np.ndarray,
    std: np.ndarray | None,
    keep: np.ndarray,
) -> tuple[np.ndarray, ErrorSource, list[Fact]]:
    """1σ of real and imaginary part, in the measured unit."""
    unknown = np.full(raw.shape, np.nan)
    if std is not None:
        given = np.asarray(std, dtype=float)
        if given.shape != (len(responses.responses), len(responses.frequency)):
            raise InputError(
                f"`std` must have one value a response and line, "
                f"{(len(responses.responses), len(responses.frequency))}, but has {given.shape}."
            )
        inside = given[:, keep]
        if not np.all(inside[np.isfinite(raw)] > 0):
            raise InputError("`std` must be positive wherever a response was measured.")
        return inside, "stated", []
    stated = np.isfinite(coherence) & np.isfinite(raw)
    if not stated.any():
        return unknown, "residuals", []
    if np.any(~stated & np.isfinite(raw)):
        return unknown, "residuals", [Fact("coherence_in_part")]
    if np.median(coherence[stated]) > 1 - _LEAST_MISSING_COHERENCE:
        return unknown, "residuals", [Fact("coherence_is_one")]
    if np.median(coherence[stated]) <= 0:
        raise InputError("the coherence is zero at most lines: no response follows the reference.")
    return coherence_std(np.abs(raw), coherence, responses.averages), "coherence", []


def coherence_std(
    magnitude: Float[np.ndarray, "channel line"],
    coherence: Float[np.ndarray, "channel line"],
    averages: int | None,
) -> Float[np.ndarray, "channel line"]:
    """1σ of real and imaginary part of an H1 estimate, |H| √((1 − γ²)/(2 γ² n)).

    Up to a factor if the number n of averages is not stated (one is assumed).
    Reference: Bendat & Piersol, Random Data, 4th ed. (2010), section 9.2,
    doi:10.1002/9781118032428.
    """
    kept = np.clip(coherence, 1e-6, 1 - _LEAST_MISSING_COHERENCE)
    return magnitude * np.sqrt((1 - kept) / kept / 2 / (averages or 1))


def std_from_residuals(
    data: ResponseData,
    residuals: Float[np.ndarray, "channel line"],
    fitted: Float[np.ndarray, "channel line"],
) -> Float[np.ndarray, "channel line"]:
    """1σ of each part by σ² = a² + b²|H|² of the measured values, a and b by maximum likelihood.

    Arguments: complex residuals and fitted receptances; NaN where not measured.
    """
    factor = data.measured_factor
    std = np.full(residuals.shape, np.nan)
    for k in range(len(residuals)):
        good = np.isfinite(residuals[k])
        left = 0.5 * np.abs(residuals[k][good] * factor[k][good]) ** 2
        model = (np.abs(fitted[k]) * factor[k]) ** 2
        floor = max(_SMALLEST**2 * float(model[good].max()), float(np.mean(left)) * _SMALLEST)
        scale = float(np.mean(left)) + floor
        if 2 * good.sum() < _FEWEST_NUMBERS:
            std[k] = np.sqrt(scale) / factor[k]
            continue
        relative = model / np.mean(model[good])

        def negative_log_likelihood(logs: np.ndarray, of: np.ndarray, at: np.ndarray) -> float:
            variance = np.exp(logs[0]) + np.exp(logs[1]) * at + _SPREAD**2
            return float(np.sum(np.log(variance) + of / variance))

        best = minimize(
            negative_log_likelihood,
            np.log([0.5, 0.5]),
            args=(left / scale, relative[good]),
            method="L-BFGS-B",
            bounds=[(-20.0, 10.0)] * 2,
        )
        variance = np.exp(best.x[0]) + np.exp(best.x[1]) * relative + _SPREAD**2
        std[k] = np.sqrt(variance * scale) / factor[k]
    return std
