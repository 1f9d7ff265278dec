"""Forces that a model needs to hold the velocity of a level, as tests that control it record."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from snrmjax.diagnose import priors
from snrmjax.diagnose.response_prediction import LevelResponse
from snrmjax.identify.calibrate.inverse_force import inverse_force
from snrmjax.measure.states import SteadyStates, steady_states
from snrmjax.model.structures import Structure


class HeldCurve(NamedTuple):
    """The force that holds one velocity amplitude, over frequency."""

    level: int
    velocity: float  # m/s
    frequency: np.ndarray  # rad/s
    force: np.ndarray  # N; NaN where no motion was found


def held_curves(
    model: Structure, data: SteadyStates, sensor: int, force_gain: float = 1.0
) -> list[HeldCurve]:
    """Forces with which a model holds every level's median velocity, by inverse harmonic balance.

    Arguments: `sensor` whose velocity is held; `force_gain` is acting over recorded force, where
    the answer is the recorded one.
    """
    level, omega = np.asarray(data.level), np.asarray(data.frequency)
    speed, force = np.abs(np.asarray(data.velocity))[:, sensor], np.asarray(data.force)
    good = np.asarray(data.measured)[:, sensor] & np.isfinite(force) & (speed > 0)
    numbers = np.unique(level[good])
    rows = []
    for number in numbers:
        mine = good & (level == number)
        held = float(np.median(speed[mine]))
        for one in np.linspace(omega[mine].min(), omega[mine].max(), 81):
            rows.append((number, one, float(np.median(force[mine])), held))
    of, at, load, held_speed = (np.array(column) for column in zip(*rows, strict=True))
    seen = np.arange(len(data.sensors)) == sensor
    states = steady_states(
        of.astype(int),
        at,
        load,
        held_speed[:, None] * seen + 0j,
        sensors=data.sensors,
        measured=np.tile(seen, (len(of), 1)),
    )
    needed = np.abs(np.asarray(inverse_force(model, states, harmonic_order=5).force))
    return [
        HeldCurve(int(k), float(held_speed[of == k][0]), at[of == k], needed[of == k] / force_gain)
        for k in numbers
    ]


def at_curve_force(data: SteadyStates, forces: Iterable[float]) -> np.ndarray:
    """Which steady states were measured within 5 % of one of some forces (N), or of none known."""
    force, each = np.asarray(data.force), np.asarray(list(forces))
    away = np.min(np.abs(force[:, None] / each - 1.0), axis=1)
    return ~(away > priors.SAME_FORCE)


def holds_response(data: SteadyStates, predicted: Sequence[LevelResponse]) -> bool:
    """Whether the levels of a test hold the response: its force changes, more than velocity.

    A shaker's force that drops at resonance changes too, but the velocity does far more.
    """
    if not predicted:
        return False
    same = at_curve_force(data, [one.force for one in predicted])
    return bool(np.mean(~same) > priors.HELD_RESPONSE) and _velocity_is_steadier(data)


def _velocity_is_steadier(data: SteadyStates) -> bool:
    """Whether velocities spread less than forces within most levels, at the sensor that moves most.

    Spreads are ranges of the logarithm between the first and last tenth.
    """
    size = np.abs(np.asarray(data.velocity)) * np.asarray(data.measured)
    speed, force = size[:, int(np.argmax(size.mean(axis=0)))], np.asarray(data.force)
    good, level = (speed > 0) & (force > 0), np.asarray(data.level)
    spreads = [
        float(np.ptp(np.quantile(np.log(one[good & (level == k)]), (0.1, 0.9))))
        for k in np.unique(level[good])
        for one in (speed, force)
    ]
    pairs = np.reshape(spreads, (-1, 2))
    return bool(np.median(pairs[:, 0] - pairs[:, 1]) < 0)
