"""From what was measured to a fit and its scale, as someone asks for them in one go."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

from snrmjax.identify.modal.base_motion import relative_to_base
from snrmjax.identify.modal.free_decay import DecayModes, fit_free_decay
from snrmjax.identify.modal.linear_fit import fit_linear_modes
from snrmjax.identify.modal.modal_fit import LinearModalFit
from snrmjax.identify.modal.state_responses import (
    amplitude_dependence,
    levels_by_velocity,
    responses_of_states,
    widened,
)
from snrmjax.identify.scaling.scale import (
    AddedMassTest,
    Calibration,
    DrivePoint,
    Free,
    KnownShape,
    Scale,
    SensorMasses,
    decay_modes,
    scale_modes,
)
from snrmjax.identify.scaling.scaled_modes import ScaledModes
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.measure.states import SteadyStates


class ModesRequest(NamedTuple):
    """Settings of `find_modes` and `scale_of`; frequencies in rad/s, masses in kg."""

    reference: str | None = None
    level: int | None = None
    from_frequency: float | None = None
    to_frequency: float | None = None
    poles: Sequence[float] | None = None
    order: int | None = None
    highest_order: int | None = None
    residual_terms: str = "auto"
    window: str | None = None
    instrument_phase: bool | None = None
    base: str | None = None
    unscaled: bool = False
    drive_point: str | None = None
    turned: bool = False
    added_mass: float | None = None
    mass_at: str | None = None
    sensor_mass: Mapping[str, float] = {}
    fixture_mass: float | None = None
    known_shape: Mapping[str, float] = {}
    newtons_per_volt: float | None = None
    newtons_per_volt_std: float = 0.0
    calibration_std: float = 0.0
    free: bool = False
    mass: float | None = None


def find_modes(
    source: FrequencyResponses | SteadyStates | Sequence[TimeRecording], request: ModesRequest
) -> tuple[LinearModalFit | DecayModes, tuple[str, ...]]:
    """Modes of what was measured, and notes on it.

    Of steady states the lowest level counts, and the next one says whether it was low enough.
    Raises `ValueError` as the fits do.
    """
    if isinstance(source, FrequencyResponses):
        return _of_responses(source, request), ()
    if isinstance(source, SteadyStates):
        return _of_states(source, request)
    found = fit_free_decay(
        source,
        to_frequency=request.to_frequency,
        poles=request.poles,
        highest_order=request.highest_order,
    )
    return found, ()


def scale_of(
    found: LinearModalFit | DecayModes,
    request: ModesRequest,
    with_mass: LinearModalFit | DecayModes | None = None,
) -> ScaledModes:
    """The modes scaled as asked for; `with_mass` are those of a second test with an added mass.

    Raises `ValueError` where two ways were asked for, one lacks a part, or none is possible.
    """
    ways = {
        "unscaled shapes": request.unscaled,
        "a drive point": request.drive_point is not None,
        "an added mass": request.added_mass is not None or with_mass is not None,
        "sensor masses": bool(request.sensor_mass) or request.fixture_mass is not None,
        "a known shape": bool(request.known_shape),
    }
    asked = [name for name, used in ways.items() if used]
    if len(asked) > 1:
        raise ValueError(f"one scale of the shapes is wanted, but there are {' and '.join(asked)}.")
    if isinstance(found, DecayModes):
        if not request.unscaled:
            raise ValueError(
                "the shapes cannot be mass-normalised: a free decay has no force; take "
                "frequencies and damping alone (unscaled), or measure frequency responses."
            )
        return decay_modes(found)
    calibration = Calibration(
        request.newtons_per_volt, request.newtons_per_volt_std, request.calibration_std
    )
    free = Free(request.mass) if request.free else None
    return scale_modes(found, _scale(request, with_mass), calibration=calibration, free=free)


def _of_responses(
    responses: FrequencyResponses, request: ModesRequest, std: Any = None
) -> LinearModalFit:
    used = responses
    if request.base is not None:
        used, std = relative_to_base(responses, cast(Any, request.base))
    return fit_linear_modes(
        used,
        poles=request.poles,
        order=request.order,
        highest_order=request.highest_order,
        std=std,
        reference=request.reference,
        from_frequency=request.from_frequency,
        to_frequency=request.to_frequency,
        residual_terms=cast(Any, request.residual_terms),
        instrument_phase=request.instrument_phase,
        window=cast(Any, request.window),
    )


def _of_states(data: SteadyStates, request: ModesRequest) -> tuple[LinearModalFit, tuple[str, ...]]:
    levels = levels_by_velocity(data)
    chosen = levels[0] if request.level is None else request.level
    own = responses_of_states(data, chosen)
    found = _of_responses(own.responses, request, own.std)
    above = levels[levels.index(chosen) + 1 :]
    if not above:
        return found, ("one level alone: nothing says whether it was low enough to be linear",)
    other = responses_of_states(data, above[0])
    by_hand = request._replace(poles=tuple(found.natural_frequency), order=None)
    try:
        second = _of_responses(other.responses, by_hand, other.std)
    except ValueError as error:
        return found, (f"level {above[0]} cannot be compared with level {chosen}: {error}",)
    seen = amplitude_dependence(found, second, (own.velocity, other.velocity))
    return widened(found, seen), seen.notes


def _scale(request: ModesRequest, with_mass: LinearModalFit | DecayModes | None) -> Scale | None:
    if request.unscaled:
        return None
    if request.added_mass is not None or with_mass is not None:
        if (
            request.added_mass is None
            or request.mass_at is None
            or not isinstance(with_mass, LinearModalFit)
        ):
            raise ValueError(
                "an added mass needs its kilograms, the sensor where it is, and frequency "
                "responses of a second test with it."
            )
        return AddedMassTest(with_mass, request.mass_at, request.added_mass)
    if request.sensor_mass or request.fixture_mass is not None:
        if not request.sensor_mass:
            raise ValueError("a fixture's mass scales only with the masses at the sensors.")
        return SensorMasses(request.sensor_mass, request.fixture_mass)
    if request.known_shape:
        ((name, value),) = request.known_shape.items()
        return KnownShape(name, value)
    return DrivePoint(request.drive_point, request.turned)
