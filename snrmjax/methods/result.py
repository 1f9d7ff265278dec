"""What every method answers with: a backbone and damping by points, with what failed and why."""

from collections.abc import Sequence
from enum import IntEnum
from typing import ClassVar, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from snrmjax.numerics.result import AbstractResult, Variable

_HERTZ = 2 * np.pi


class MethodStatus(IntEnum):
    """Why a method has, or has not, an answer at an amplitude."""

    FOUND = 0
    NO_RESONANCE = 1  # the phase does not pass through resonance: a premature jump
    ONE_SIDE = 2  # measured on one side of resonance only at this amplitude
    TOO_FEW_STATES = 3
    NOT_A_MODE = 4  # numbers came out that no damped mode has
    AMPLITUDE_HELD = 5  # the displacement was controlled: all states are of equal amplitude
    NOT_LOCKED = 6  # the controller did not hold its target


METHOD_MESSAGE: dict[MethodStatus, str] = {
    MethodStatus.FOUND: "found",
    MethodStatus.NO_RESONANCE: (
        "the phase does not pass through resonance: the motion jumped before it, or the level "
        "ends early"
    ),
    MethodStatus.ONE_SIDE: "no states of equal amplitude on both sides of resonance",
    MethodStatus.TOO_FEW_STATES: "too few states of this amplitude",
    MethodStatus.NOT_A_MODE: "a stiffness or damping came out that is not positive",
    MethodStatus.AMPLITUDE_HELD: (
        "the displacement was held, so that states of equal amplitude are not a pair"
    ),
    MethodStatus.NOT_LOCKED: (
        "the controller did not hold its target: other gains, smaller steps or more time"
    ),
}


class MethodPoint(NamedTuple):
    """One amplitude at which a method was asked: its answer, or why there is none."""

    status: MethodStatus
    level: int  # of the test; -1 where it comes from several levels
    velocity: float = np.nan  # m/s, fundamental at resonance, at the reference sensor
    natural_frequency: float = np.nan  # rad/s
    natural_frequency_std: float = np.nan
    damping_ratio: float = np.nan
    damping_ratio_std: float = np.nan


class MethodResult(AbstractResult):
    """Natural frequency and damping against amplitude as one method finds them.

    Where `status` is not `FOUND` the numbers are NaN. A 1σ that a method does not give, or that
    the data do not state, is NaN. `damping_ratio` is relative to the natural frequency at the
    same amplitude: modal damping / (2 ω̃).
    """

    coordinates: ClassVar[tuple[str, ...]] = ("velocity_m_s",)

    method: str = eqx.field(static=True)
    velocity: Float[Array | np.ndarray, " point"]  # m/s, fundamental, at the reference sensor
    natural_frequency: Float[Array | np.ndarray, " point"]  # rad/s
    natural_frequency_std: Float[Array | np.ndarray, " point"]
    damping_ratio: Float[Array | np.ndarray, " point"]
    damping_ratio_std: Float[Array | np.ndarray, " point"]
    status: Int[Array | np.ndarray, " point"]  # a `MethodStatus`
    level: Int[Array | np.ndarray, " point"]  # of the test; -1 from several levels
    n_states: int = eqx.field(static=True)  # steady states that it used
    test_seconds: float = eqx.field(static=True, default=np.nan)  # of a test that it ran itself
    notes: tuple[str, ...] = eqx.field(static=True, default=())

    @property
    def found(self) -> Bool[np.ndarray, " point"]:
        """Where there is an answer."""
        return np.asarray(self.status) == int(MethodStatus.FOUND)

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`."""
        found = self.found
        lines = [
            f"MethodResult: {self.method}, {found.sum()} of {found.size} points, from "
            f"{self.n_states} states"
        ]
        if np.isfinite(self.test_seconds):
            lines.append(f"{self.test_seconds:.4g} s of test")
        if found.any():
            hertz = np.asarray(self.natural_frequency)[found] / _HERTZ
            ratio = 100 * np.asarray(self.damping_ratio)[found]
            velocity = np.asarray(self.velocity)[found]
            lines += [
                f"velocity {velocity.min():.4g} to {velocity.max():.4g} m/s",
                f"natural frequency {hertz.min():.6g} to {hertz.max():.6g} Hz",
                f"damping ratio {ratio.min():.4g} to {ratio.max():.4g} %",
            ]
        return (*lines, *_failures(self), *(f"note: {note}" for note in self.notes))

    def variables(self) -> dict[str, Variable]:
        """See `AbstractResult`; the columns of `compare.csv`."""
        texts = [MethodStatus(int(k)).name.lower() for k in np.asarray(self.status)]
        at = ("velocity_m_s",)
        return {
            "velocity_m_s": Variable(at, self.velocity, "m/s", "velocity at resonance"),
            "frequency_hz": Variable(
                at, np.asarray(self.natural_frequency) / _HERTZ, "Hz", "natural frequency"
            ),
            "frequency_std_hz": Variable(
                at, np.asarray(self.natural_frequency_std) / _HERTZ, "Hz", "its 1σ"
            ),
            "damping_ratio": Variable(at, self.damping_ratio, "1", "modal damping / 2ω̃"),
            "damping_ratio_std": Variable(at, self.damping_ratio_std, "1", "its 1σ"),
            "level": Variable(at, self.level, "1", "level of the test, -1 from several"),
            "status": Variable(at, np.array(texts, dtype=str), "", "answer or why there is none"),
        }

    def attributes(self) -> dict[str, str | float | int]:
        """See `AbstractResult`."""
        own: dict[str, str | float | int] = {"method": self.method, "n_states": self.n_states}
        return {**own, "test_seconds": self.test_seconds, "notes": "\n".join(self.notes)}


def method_result(
    method: str,
    points: Sequence[MethodPoint],
    n_states: int,
    notes: Sequence[str] = (),
    *,
    test_seconds: float = np.nan,
) -> MethodResult:
    """A method's points as one result, by rising velocity, those without an answer last."""
    kept = sorted(points, key=lambda one: (one.status != MethodStatus.FOUND, one.velocity))

    def column(name: str) -> np.ndarray:
        return np.array([getattr(one, name) for one in kept], dtype=float)

    return MethodResult(
        method,
        column("velocity"),
        column("natural_frequency"),
        column("natural_frequency_std"),
        column("damping_ratio"),
        column("damping_ratio_std"),
        np.array([int(one.status) for one in kept], dtype=int),
        np.array([one.level for one in kept], dtype=int),
        n_states,
        test_seconds,
        tuple(notes),
    )


def _failures(result: MethodResult) -> list[str]:
    """How many points failed, by reason."""
    status, level = np.asarray(result.status), np.asarray(result.level)
    lines = []
    for kind in MethodStatus:
        lost = status == int(kind)
        if kind is MethodStatus.FOUND or not lost.any():
            continue
        levels = sorted({int(k) for k in level[lost] if k >= 0})
        where = f" (level {', '.join(map(str, levels))})" if levels else ""
        lines.append(f"{lost.sum()} not found{where}: {METHOD_MESSAGE[kind]}")
    return lines
