"""The result of every method: points of backbone and damping, with the reasons of failures."""

from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from snrmjax.numerics.facts import Fact
from snrmjax.numerics.names import with_former_attributes
from snrmjax.numerics.result import AbstractResult, quantity, setting
from snrmjax.numerics.status import Status

Numbers = Float[Array | np.ndarray, " point"]


class MethodStatus(Status):
    """Whether a method has a result at an amplitude, or why not."""

    FOUND = 0, "found"
    NO_RESONANCE = (
        1,
        "the phase does not pass through resonance: the response jumped before it, or the level "
        "ends early",
    )
    ONE_SIDE = 2, "no states of equal amplitude on both sides of resonance"
    TOO_FEW_STATES = 3, "too few states of this amplitude"
    NOT_A_MODE = 4, "the identified stiffness or damping is not positive"
    AMPLITUDE_CONTROLLED = (
        5,
        "the displacement was controlled, so that states of equal amplitude are not a pair",
    )
    NOT_LOCKED = (
        6,
        "the controller did not reach its target: try other gains, smaller steps or more time",
    )


class MethodPoint(NamedTuple):
    """Result of a method at one amplitude, or why there is none."""

    status: MethodStatus
    level: int  # of the test; -1 where the point comes from several levels
    velocity: float = np.nan  # m/s, fundamental at resonance, at the reference sensor
    natural_frequency: float = np.nan  # rad/s
    natural_frequency_std: float = np.nan
    damping_ratio: float = np.nan
    damping_ratio_std: float = np.nan


@with_former_attributes({"found": "has_result"})
class MethodResult(AbstractResult):
    """Natural frequency and damping against amplitude by one method.

    Where `status` is not `FOUND` the numbers are NaN. A 1σ that the method does not give, or that
    the data do not state, is NaN. `damping_ratio` is relative to the natural frequency at the
    same amplitude: modal damping / (2 ω̃).
    """

    coordinates: ClassVar[tuple[str, ...]] = ("velocity_m_s",)

    method: str = setting()
    velocity: Numbers = quantity("velocity_m_s", "m/s", "velocity at resonance")
    natural_frequency: Numbers = quantity(
        "velocity_m_s", "Hz", "natural frequency", name="frequency_hz"
    )
    natural_frequency_std: Numbers = quantity(
        "velocity_m_s", "Hz", "its 1σ", name="frequency_std_hz"
    )
    damping_ratio: Numbers = quantity("velocity_m_s", "1", "modal damping / 2ω̃")
    damping_ratio_std: Numbers = quantity("velocity_m_s", "1", "its 1σ")
    level: Int[Array | np.ndarray, " point"] = quantity(
        "velocity_m_s", "1", "level of the test, -1 from several"
    )
    status: Int[Array | np.ndarray, " point"] = quantity(
        "velocity_m_s", "", "answer or why there is none", of=MethodStatus
    )
    n_states: int = setting()  # steady states used
    test_seconds: float = setting(default=np.nan)  # duration of the records or virtual test
    notes: tuple[Fact | str, ...] = setting(default=())

    def points(self) -> list[MethodPoint]:
        """The points one by one."""
        rows = zip(
            self.status,
            self.level,
            self.velocity,
            self.natural_frequency,
            self.natural_frequency_std,
            self.damping_ratio,
            self.damping_ratio_std,
            strict=True,
        )
        return [
            MethodPoint(MethodStatus(int(status)), int(level), *map(float, numbers))
            for status, level, *numbers in rows
        ]

    @property
    def has_result(self) -> Bool[np.ndarray, " point"]:
        """Points with a result."""
        return np.asarray(self.status) == int(MethodStatus.FOUND)


def points_of_curves(
    velocity: Numbers,
    natural_frequency: Numbers,
    natural_frequency_std: Numbers,
    damping_ratio: Numbers,
    damping_ratio_std: Numbers,
) -> list[MethodPoint]:
    """Points of curves over velocity; `NOT_A_MODE` where the damping is not positive."""
    columns = (velocity, natural_frequency, natural_frequency_std, damping_ratio, damping_ratio_std)
    return [
        MethodPoint(MethodStatus.FOUND, -1, *map(float, row))
        if row[3] > 0
        else MethodPoint(MethodStatus.NOT_A_MODE, -1)
        for row in np.stack([np.asarray(column) for column in columns], axis=1)
    ]


def method_result(
    method: str,
    points: Sequence[MethodPoint],
    n_states: int,
    notes: Sequence[Fact | str] = (),
    *,
    test_seconds: float = np.nan,
) -> MethodResult:
    """A method's points as one result, by rising velocity, those without a result last."""
    kept = sorted(points, key=lambda point: (point.status != MethodStatus.FOUND, point.velocity))
    kinds = {"status": int, "level": int}
    columns = {
        name: np.array([getattr(point, name) for point in kept], dtype=kinds.get(name, float))
        for name in MethodPoint._fields
    }
    return MethodResult(
        method=method, n_states=n_states, test_seconds=test_seconds, notes=tuple(notes), **columns
    )
