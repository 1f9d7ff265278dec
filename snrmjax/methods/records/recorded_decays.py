"""The mode of interest isolated in every free decay of a record, and the methods for it.

Records may be of velocity, acceleration or displacement.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.measure.decays.decay_record import even_record
from snrmjax.measure.decays.isolated_decay import (
    MAX_INTERFERING,
    UNDETERMINED,
    IsolatedDecay,
    isolate_decay,
)
from snrmjax.measure.recordings.channels import channel_number
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.methods.records.recorded_test import RecordedDecay, RecordedTest
from snrmjax.methods.records.resonant_decay import decay_of_mode
from snrmjax.methods.records.restoring_force import restoring_force
from snrmjax.methods.records.ssm import curves_of_submanifold, fit_submanifold
from snrmjax.methods.result import MethodResult
from snrmjax.model.modes import LinearModes
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

_CORNER = 0.25  # of the motion's frequency: below it an integrated signal is drift
_ORDER = 4  # at the motion's frequency the filter is then 1 within 2e-5
_ENDS = 8.0  # cycles at both ends until it has settled
_SPLINE = 5


class RecordedVelocity(NamedTuple):
    """A stretch of a record as velocity."""

    time: Float[np.ndarray, " sample"]  # s
    velocity: Float[np.ndarray, " sample"]  # m/s
    start: int  # sample of the record at which it begins
    notes: tuple[Fact, ...] = ()


def recorded_velocity(
    recording: TimeRecording,
    name: str,
    frequency: float,
    part: tuple[int, int],
) -> RecordedVelocity:
    """The velocity of a motion over `part` of a record.

    Arguments: `name` of a channel of velocity, acceleration or displacement; `frequency` of the
    motion (rad/s); `part` in samples. Accelerations are integrated and displacements
    differentiated by a spline of degree 5; drift of an integral, below a quarter of the frequency,
    is removed by a zero-phase high-pass, whose ends of eight cycles are left out.
    Returns a `RecordedVelocity`. Raises `ValueError` as `even_record` does (a clipped record, one
    that is not finite).
    """
    quantity = recording.channels[channel_number(recording.channels, name)].quantity
    start, stop = part
    values = recording.values([name], start, stop)[0]
    time, signal = even_record(recording.time(start, stop), values - values.mean())
    notes: tuple[Fact, ...] = ()
    cycle = max(1, int(np.ceil(HERTZ * recording.sampling_rate / frequency)))
    if quantity != "velocity":
        from scipy.interpolate import make_interp_spline

        curve = make_interp_spline(time, signal, k=_SPLINE)
        change = curve.derivative() if quantity == "displacement" else curve.antiderivative()
        signal = np.asarray(change(time))
        notes = (Fact("velocity_by_spline", quantity=quantity),)
    if quantity == "acceleration":
        from scipy.signal import butter, sosfiltfilt

        ends = int(_ENDS * cycle)
        if len(signal) < 4 * ends:
            raise InputError(
                f"an acceleration needs {4 * _ENDS:g} cycles to be integrated, but the record has "
                f"{len(signal) / cycle:.3g}."
            )
        sections = butter(
            _ORDER, _CORNER * frequency, "highpass", fs=HERTZ * recording.sampling_rate,
            output="sos",
        )  # fmt: skip
        signal = sosfiltfilt(sections, signal)[ends:-ends]
        time, start = time[ends:-ends], start + ends
    return RecordedVelocity(time, signal, start, notes)


def recorded_decays(test: RecordedTest, modes: LinearModes) -> tuple[RecordedDecay, ...]:
    """The mode of interest in every free decay of a record (`isolate_decay`)."""
    if test.decays:
        return test.decays
    rest = modes.natural_frequency.item(modes.mode_of_interest)
    decays = []
    for part in test.free:
        try:
            motion = recorded_velocity(test.recording, test.channels.reference, rest, part)
            decay = isolate_decay(motion.time, motion.velocity, rest)
        except InputError as error:
            # For a single decay this is the reason why no decay method ran.
            why = (Fact("decay_left_out", why=str(error)),) if len(test.free) > 1 else ()
            decays.append(RecordedDecay(None, why, str(error)))
        else:
            decays.append(RecordedDecay(decay, (*decay.notes(), *motion.notes)))
    return tuple(decays)


def read_decays(
    method: Callable[[IsolatedDecay], MethodResult], decays: tuple[RecordedDecay, ...]
) -> list[MethodResult]:
    """A method's results for the decays whose mode could be isolated.

    Raises `ValueError` where none could, and where a method's frequencies are outside the band of
    the mode: it follows another motion.
    """
    results = []
    for one in decays:
        if one.decay is None:
            continue
        result = method(one.decay)
        _require_mode(result, one.decay)
        results.append(result)
    if not results:
        raise InputError(decays[0].why if decays else "the record has no free decay.")
    return results


def restoring_force_of_mode(decay: IsolatedDecay) -> MethodResult:
    """`restoring_force` of an isolated mode.

    The method gives no 1σ: it is the deviation of its curves from those of `decay_of_mode`,
    combined with their 1σ. Raises `ValueError` as the method does, and where the residual exceeds
    1 % of the acceleration's power, as the record holds only this mode.
    """
    result = restoring_force(decay.time, decay.velocity, most_left=MAX_INTERFERING)
    (omega, omega_std), (ratio, ratio_std) = _curves_at(decay, np.asarray(result.velocity))
    return dataclasses.replace(
        result,
        natural_frequency_std=np.hypot(result.natural_frequency - omega, omega_std),
        damping_ratio_std=np.hypot(result.damping_ratio - ratio, ratio_std),
    )


def ssm_of_mode(decay: IsolatedDecay) -> MethodResult:
    """`ssm` of an isolated mode.

    Its 1σ assumes white noise; it is scaled up as that of `decay_of_mode` is by interfering modes,
    and by the Birge ratio of the deviation between both methods (R. T. Birge, Phys. Rev. 40 (1932)
    207). Raises `ValueError` as the method does.
    """
    manifold = fit_submanifold(decay.time, decay.velocity, noise_std=decay.noise_std)
    result = curves_of_submanifold(manifold)
    rows = np.argsort(decay.level.real)
    velocity = np.asarray(result.velocity)
    reference = decay_of_mode(decay)
    inside = (
        reference.has_result
        & (reference.velocity >= np.nanmin(velocity))
        & (reference.velocity <= np.nanmax(velocity))
    )
    spread = {}
    for name, excess in (
        ("natural_frequency", decay.excess.imag),
        ("damping_ratio", decay.excess.real),
    ):
        value, std, other, other_std = (
            np.asarray(getattr(one, f"{name}{end}"))
            for one in (result, reference)
            for end in ("", "_std")
        )
        growth = np.interp(np.log(velocity), decay.level.real[rows], excess[rows])
        std = std * np.maximum(1.0, growth * decay.noise_std / manifold.slow_std)
        here, here_std = (
            np.interp(
                np.asarray(reference.velocity)[inside],
                velocity[result.has_result],
                one[result.has_result],
            )
            for one in (value, std)
        )
        away = (other[inside] - here) / np.hypot(other_std[inside], here_std)
        spread[f"{name}_std"] = std * np.sqrt(max(1.0, float(np.mean(away**2))))
    return dataclasses.replace(result, **spread)


def _curves_at(decay: IsolatedDecay, velocity: np.ndarray) -> list[list[np.ndarray]]:
    """Frequency and damping of `decay_of_mode` with their 1σ, at some amplitudes."""
    read = decay_of_mode(decay)
    known, at = np.log(np.asarray(read.velocity)[read.has_result]), np.log(velocity)
    return [
        [np.interp(at, known, np.asarray(getattr(read, f"{name}{end}"))[read.has_result])
         for end in ("", "_std")]
        for name in ("natural_frequency", "damping_ratio")
    ]  # fmt: skip


def _require_mode(result: MethodResult, decay: IsolatedDecay) -> None:
    omega = np.asarray(result.natural_frequency)[result.has_result]
    low, high = decay.band
    if omega.size and (omega.min() < low or omega.max() > high):
        raise InputError(
            f"the natural frequency, {omega.min() / HERTZ:.4g} to {omega.max() / HERTZ:.4g} Hz, "
            f"is outside the mode's band of {low / HERTZ:.4g} to {high / HERTZ:.4g} Hz: the "
            "method follows another motion."
        )
    ratio, std = (
        np.asarray(one)[result.has_result]
        for one in (result.damping_ratio, result.damping_ratio_std)
    )
    if ratio.size and np.nanmedian(std / ratio) > UNDETERMINED:
        raise InputError(
            f"the 1σ of the damping is {100 * np.nanmedian(std / ratio):.2g} % of the damping "
            "(median): the method does not determine the damping."
        )
