"""Linear modes from measurements: frequency responses, low-level states or free decays."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, get_args

import numpy as np
from jaxtyping import Float

from snrmjax.identify.modal.amplitude_fit import (
    amplitude_dependent_modes,
    over_reference,
    pole_of_states,
    rows_of_levels,
)
from snrmjax.identify.modal.free_decay import DecayModes, fit_free_decay
from snrmjax.identify.modal.linear_fit import fit_linear_modes
from snrmjax.identify.modal.modal_fit import LinearModalFit
from snrmjax.identify.modal.response_data import POWERS, coherence_std
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses, frequency_responses
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.measure.states import SteadyStates
from snrmjax.model.moving_base import SensorMotion
from snrmjax.numerics.compiled import on_numbers
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

_CHANGE_STDS = 2.0  # standard errors of a difference between levels
_OF_DECAYS = ("to_frequency", "poles", "highest_order")


@on_numbers("Differentiate `sj.model.linear_response`.")
def find_modes(
    source: FrequencyResponses | SteadyStates | Sequence[TimeRecording],
    *,
    level: int | None = None,
    base: SensorMotion | None = None,
    progress: Callable[[int, int], None] | None = None,
    **settings: Any,
) -> tuple[LinearModalFit | DecayModes, tuple[Fact, ...]]:
    """Linear modes of a measurement, and notes.

    Of steady states the lowest level is used, and the next one checks whether it was low enough. If
    the levels show a mode that depends on its amplitude, they are fitted together and the modes are
    those at zero amplitude (see `amplitude_dependent_modes`).

    Arguments: `level` of steady states in place of the lowest; `base` "absolute" or "relative"
    responses where the reference is the motion of a base; `progress` as for `fit_free_decay`;
    `settings` those of `fit_linear_modes`; free decays use the poles, the highest order and the
    upper end of the band.
    Raises `ValueError` as the fits do.
    Not differentiable: differentiate `snrmjax.model.linear_response`.
    """
    if isinstance(source, FrequencyResponses):
        return _of_responses(source, base, settings), ()
    if not isinstance(source, SteadyStates):
        of_decays = {name: settings[name] for name in _OF_DECAYS if name in settings}
        return fit_free_decay(source, **of_decays, progress=progress), ()
    if source.base is not None and source.base.motion == "absolute":
        base = "relative"  # the base motion is subtracted already
    elif source.base is not None and base is None:
        raise InputError(
            "these states are of a moving base: state what the sensors record, `--base absolute` "
            "or `--base relative`."
        )
    levels = levels_by_velocity(source)
    chosen = levels[0] if level is None else level
    lowest = responses_of_states(source, chosen)
    onward = levels[levels.index(chosen) :]
    band = settings.get("from_frequency"), settings.get("to_frequency")
    rows = rows_of_levels(source, onward, base=base, band=band)
    asked = {**settings, "std": lowest.std}
    try:
        modes = _of_responses(lowest.responses, base, asked)
    except InputError:
        given = settings.get("poles") is not None or settings.get("order") is not None
        start = None if given else pole_of_states(rows)
        if start is None:
            raise
        # Few states about one resonance, or a skewed one: no pole is stable over the order.
        modes = _of_responses(lowest.responses, base, {**asked, "poles": (start,)})
    above = onward[1:]
    phase = settings.get("instrument_phase")
    dependent = amplitude_dependent_modes(
        rows,
        modes,
        residual_terms=settings.get("residual_terms") or "auto",
        instrument_phase=rows.data.reference.quantity == "voltage" if phase is None else phase,
    )
    if dependent is not None:
        return dependent[0], (dependent[1],)
    if not above:
        return modes, (Fact("one_level_for_modes"),)
    other = responses_of_states(source, above[0])
    by_hand = {"poles": tuple(modes.natural_frequency), "order": None, "std": other.std}
    try:
        second = _of_responses(other.responses, base, {**settings, **by_hand})
    except InputError as error:
        pair = {"level": chosen, "other": above[0]}
        return modes, (Fact("levels_not_compared", **pair, reason=str(error)),)
    return amplitude_dependence(modes, second, (lowest.velocity, other.velocity))


def _of_responses(
    responses: FrequencyResponses, base: SensorMotion | None, settings: Mapping[str, Any]
) -> LinearModalFit:
    if base is None:
        return fit_linear_modes(responses, **settings)
    relative = relative_to_base(responses, base)
    return fit_linear_modes(relative.responses, **{**settings, "std": relative.std})


class StateResponses(NamedTuple):
    """Velocity over force of one level."""

    responses: FrequencyResponses
    std: Float[np.ndarray, "response frequency"] | None  # of real and of imaginary part
    velocity: float  # m/s, the largest


def levels_by_velocity(data: SteadyStates) -> list[int]:
    """The levels of a test in order of their largest velocity."""
    speed = np.where(np.asarray(data.measured), np.abs(np.asarray(data.velocity)), 0.0).max(axis=1)
    level = np.asarray(data.level)
    return sorted(np.unique(level).tolist(), key=lambda number: speed[level == number].max())


def responses_of_states(data: SteadyStates, level: int) -> StateResponses:
    """The mobilities of one level; states of one frequency are averaged.

    Raises `ValueError` for an unknown level, for phases that were not measured and for states with
    neither a force nor a drive voltage.
    """
    rows = np.asarray(data.level) == level
    if not rows.any():
        listed = ", ".join(map(str, np.unique(np.asarray(data.level)).tolist()))
        raise InputError(f"there is no level {level}; there are {listed}.")
    if np.any(np.asarray(data.phase_unknown)[rows]):
        raise InputError("modes need phases, but only amplitudes of velocities were measured.")
    reference, load, velocity, std, known = over_reference(data, rows)
    measured, mobility, parts = (
        np.isfinite(velocity),
        velocity / load[:, None],
        std / np.abs(load[:, None]),
    )
    omega, line = np.unique(np.asarray(data.frequency)[rows], return_inverse=True)
    shape = (velocity.shape[1], len(omega))
    total, count, variance = np.zeros(shape, dtype=complex), np.zeros(shape), np.zeros(shape)
    for k, row in enumerate(line):
        total[:, row] += np.where(measured[k], mobility[k], 0.0)
        count[:, row] += measured[k]
        variance[:, row] += np.where(measured[k], parts[k] ** 2, 0.0)
    values = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    std = np.sqrt(variance) / np.maximum(count, 1)
    responses = frequency_responses(
        omega,
        values[:, None],
        [Channel(name, "velocity", "m/s") for name in data.sensors],
        [reference],
        name=f"level {level}",
    )
    largest = float(np.nanmax(np.abs(velocity)))
    return StateResponses(responses, std if known else None, largest)


def amplitude_dependence(
    lowest: LinearModalFit, next_level: LinearModalFit, velocities: tuple[float, float]
) -> tuple[LinearModalFit, tuple[Fact, ...]]:
    """Whether modes differ between the two lowest levels by more than their errors.

    If so, the change times v₁/(v₂ − v₁), a linear extrapolation to zero amplitude, is added to the
    error of the lower level.

    Arguments: the largest velocity of each level, m/s, the lower first.
    Returns the fit at the lower level with these errors, and notes.
    """
    low, high = velocities
    rest = low / (high - low) if high > 1.01 * low else 1.0
    added, notes = np.zeros((2, lowest.n_modes)), []
    pairs = (
        (lowest.natural_frequency, next_level.natural_frequency),
        (lowest.damping_ratio, next_level.damping_ratio),
    )
    stds = (
        (lowest.natural_frequency_std, next_level.natural_frequency_std),
        (lowest.damping_ratio_std, next_level.damping_ratio_std),
    )
    for k, omega in enumerate(lowest.natural_frequency.tolist()):
        other = int(np.argmin(np.abs(next_level.natural_frequency - omega)))
        for row, (values, errors) in enumerate(zip(pairs, stds, strict=True)):
            change = float(values[1][other] - values[0][k])
            allowed = _CHANGE_STDS * float(np.hypot(errors[1][other], errors[0][k]))
            if abs(change) > allowed:
                added[row, k] = abs(change) * rest
                at = {"mode": k + 1, "frequency_hz": omega / HERTZ, "of_damping": row == 1}
                changes = {"change": change, "allowed": allowed, "left": float(added[row, k])}
                notes.append(Fact("amplitude_dependence", **at, **changes, velocities=velocities))
    if not notes:
        notes.append(Fact("levels_agree"))
    covariance = lowest.mode_covariance.copy()
    covariance[:, (0, 1), (0, 1)] += added.T**2
    return dataclasses.replace(lowest, mode_covariance=covariance), tuple(notes)


class BaseResponses(NamedTuple):
    """Relative accelerations over the base's, and their 1σ from the coherence if stated."""

    responses: FrequencyResponses
    std: Float[np.ndarray, "response frequency"] | None  # of real and of imaginary part


def relative_to_base(
    responses: FrequencyResponses, motion: SensorMotion, *, along: Mapping[str, float] | None = None
) -> BaseResponses:
    """Acceleration relative to a moving base over the base's acceleration.

    A structure on a base with acceleration a has z̈ + … = −Γ a in each mode: relative to the base
    it is driven by the force −m a at every mass, and z/a = −Σ φΓ/(ω² − Ω² + 2iζωΩ). An absolute
    motion is that plus the base's own, −1/Ω² times the sensor's direction cosine.

    Arguments: one reference that is a displacement, velocity or acceleration; `motion` states
    whether the responses are absolute; `along` the cosine between a sensor and the base's motion, 1
    where not named.
    Raises `ValueError` for another number or kind of references, for responses that are not a
    motion and for unknown sensors.
    """
    if motion not in get_args(SensorMotion):
        raise InputError(f"the motion must be 'absolute' or 'relative', but is {motion!r}.")
    if len(responses.references) != 1 or responses.references[0].quantity not in POWERS:
        listed = ", ".join(str(channel) for channel in responses.references)
        raise InputError(
            "motion over a base needs one reference that is a displacement, velocity or "
            f"acceleration, but has {listed}."
        )
    names = [channel.name for channel in responses.responses]
    for name in along or {}:
        if name not in names:
            raise InputError(f"there is no sensor {name!r}; there are {', '.join(names)}.")
    reference = responses.references[0]
    keep = responses.frequency > 0
    s = 1j * responses.frequency[keep]
    relative_values, spread = [], []
    for channel, row, known in zip(
        responses.responses, responses.values[:, 0], responses.coherence[:, 0], strict=True
    ):
        if channel.quantity not in POWERS:
            raise InputError(f"{channel.name} must be a motion, but is {channel.quantity}.")
        over = row[keep] * s ** (POWERS[reference.quantity] - POWERS[channel.quantity])
        spread.append(coherence_std(np.abs(over), known[keep], responses.averages))
        of_base = (along or {}).get(channel.name, 1.0) if motion == "absolute" else 0.0
        relative_values.append(over - of_base)
    std = np.array(spread)
    relative = dataclasses.replace(
        responses,
        frequency=responses.frequency[keep],
        values=np.array(relative_values)[:, None],
        coherence=np.full((len(names), 1, int(keep.sum())), np.nan),
        responses=tuple(
            channel._replace(quantity="acceleration", unit="m/s^2", calibration=1.0)
            for channel in responses.responses
        ),
        references=(Channel(reference.name, "acceleration", "m/s^2", 1.0, *reference[4:]),),
    )
    return BaseResponses(relative, std if np.isfinite(std).all() and np.all(std > 0) else None)
