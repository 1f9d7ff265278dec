"""The model's mode in every free decay of a record, apart from its company, or why it is not."""

import dataclasses
from collections.abc import Callable

import numpy as np

from snrmjax.measure.decays.isolated_decay import (
    MOST_INTERFERING,
    NOT_KNOWN,
    IsolatedDecay,
    isolate_decay,
)
from snrmjax.methods.records.recorded_test import RecordedDecay, RecordedTest
from snrmjax.methods.records.recorded_velocity import recorded_velocity
from snrmjax.methods.records.resonant_decay import decay_of_mode
from snrmjax.methods.records.restoring_force import restoring_force
from snrmjax.methods.records.ssm import curves_of_submanifold, fit_submanifold
from snrmjax.methods.result import MethodResult
from snrmjax.model.modes import LinearModes
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.units import HERTZ


def recorded_decays(test: RecordedTest, modes: LinearModes) -> tuple[RecordedDecay, ...]:
    """The mode of interest in every free decay of a record (`isolate_decay`)."""
    if test.decays:
        return test.decays
    rest = modes.natural_frequency.item(modes.mode_of_interest)
    found = []
    for part in test.free:
        try:
            seen = recorded_velocity(test.recording, test.channels.reference, rest, part)
            decay = isolate_decay(seen.time, seen.velocity, rest)
        except ValueError as error:
            # Of a single decay it is the reason why the methods of decays did not run.
            why = (Fact("decay_left_out", why=str(error)),) if len(test.free) > 1 else ()
            found.append(RecordedDecay(None, why, str(error)))
        else:
            found.append(RecordedDecay(decay, (*decay.notes(), *seen.notes)))
    return tuple(found)


def read_decays(
    method: Callable[[IsolatedDecay], MethodResult], decays: tuple[RecordedDecay, ...]
) -> list[MethodResult]:
    """What a method finds in the decays whose mode could be isolated.

    Raises `ValueError` where none could, and where a
    method's frequencies lie outside the band of the mode: it follows another motion.
    """
    found = []
    for one in decays:
        if one.decay is None:
            continue
        result = method(one.decay)
        _require_mode(result, one.decay)
        found.append(result)
    if not found:
        raise ValueError(decays[0].why if decays else "the record has no free decay.")
    return found


def restoring_force_of_mode(decay: IsolatedDecay) -> MethodResult:
    """`restoring_force` of a mode apart from its company.

    1σ, which the method does not give, is how far its curves are off the decay's own reading, with
    the 1σ of that. Raises `ValueError` as the method does, and where its forces leave 1 % of the
    acceleration's power: nothing else is in the record.
    """
    found = restoring_force(decay.time, decay.velocity, most_left=MOST_INTERFERING)
    (omega, omega_std), (ratio, ratio_std) = _reading_at(decay, np.asarray(found.velocity))
    return dataclasses.replace(
        found,
        natural_frequency_std=np.hypot(found.natural_frequency - omega, omega_std),
        damping_ratio_std=np.hypot(found.damping_ratio - ratio, ratio_std),
    )


def ssm_of_mode(decay: IsolatedDecay) -> MethodResult:
    """`ssm` of a mode apart from its company.

    Its 1σ, which knows white noise, grows as that of the decay's own reading does where company
    disturbs it, and by the ratio by which the curves are off this reading beyond both (R. T. Birge,
    Phys. Rev. 40 (1932) 207). Raises `ValueError` as the method does.
    """
    manifold = fit_submanifold(decay.time, decay.velocity, noise_std=decay.noise_std)
    found = curves_of_submanifold(manifold)
    rows = np.argsort(decay.level.real)
    size = np.asarray(found.velocity)
    read = decay_of_mode(decay)
    inside = read.found & (read.velocity >= np.nanmin(size)) & (read.velocity <= np.nanmax(size))
    spread = {}
    for name, excess in (
        ("natural_frequency", decay.excess.imag),
        ("damping_ratio", decay.excess.real),
    ):
        value, std, other, other_std = (
            np.asarray(getattr(one, f"{name}{end}"))
            for one in (found, read)
            for end in ("", "_std")
        )
        grown = np.interp(np.log(size), decay.level.real[rows], excess[rows])
        std = std * np.maximum(1.0, grown * decay.noise_std / manifold.slow_std)
        here, here_std = (
            np.interp(np.asarray(read.velocity)[inside], size[found.found], one[found.found])
            for one in (value, std)
        )
        away = (other[inside] - here) / np.hypot(other_std[inside], here_std)
        spread[f"{name}_std"] = std * np.sqrt(max(1.0, float(np.mean(away**2))))
    return dataclasses.replace(found, **spread)


def _reading_at(decay: IsolatedDecay, velocity: np.ndarray) -> list[list[np.ndarray]]:
    """Frequency and damping with their 1σ as the decay itself is read, at some amplitudes."""
    read = decay_of_mode(decay)
    known, at = np.log(np.asarray(read.velocity)[read.found]), np.log(velocity)
    return [
        [np.interp(at, known, np.asarray(getattr(read, f"{name}{end}"))[read.found])
         for end in ("", "_std")]
        for name in ("natural_frequency", "damping_ratio")
    ]  # fmt: skip


def _require_mode(result: MethodResult, decay: IsolatedDecay) -> None:
    omega = np.asarray(result.natural_frequency)[result.found]
    low, high = decay.band
    if omega.size and (omega.min() < low or omega.max() > high):
        raise ValueError(
            f"what was found, {omega.min() / HERTZ:.4g} to {omega.max() / HERTZ:.4g} Hz, lies "
            f"outside the mode's own band of {low / HERTZ:.4g} to {high / HERTZ:.4g} Hz: it "
            "follows another motion."
        )
    ratio, std = (
        np.asarray(one)[result.found] for one in (result.damping_ratio, result.damping_ratio_std)
    )
    if ratio.size and np.nanmedian(std / ratio) > NOT_KNOWN:
        raise ValueError(
            f"the 1σ of its damping is {100 * np.nanmedian(std / ratio):.2g} % of the damping "
            "(median): it does not tell how the mode decays."
        )
