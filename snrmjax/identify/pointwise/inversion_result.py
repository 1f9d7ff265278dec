"""What an inversion answers: a natural frequency and a damping ratio, or the reason for none."""

from typing import ClassVar

import numpy as np
from jaxtyping import Array, Float, Int

from snrmjax.numerics.result import AbstractResult, Variable
from snrmjax.numerics.status import Status

_HERTZ = 2 * np.pi


class PointStatus(Status):
    """What became of one inversion."""

    OK = 0, "ok"
    TWO_ROOTS = 1, "two roots: the residual response exceeds the measured one"
    NEGATIVE_DAMPING = 2, "negative damping: phase beyond 90° of resonance"
    NO_ROOT = 3, "no root: amplitude and phase contradict the residual modes"
    NO_REAL_FREQUENCY = 4, "no real natural frequency"
    ZERO_FORCE = 5, "zero force or participation"
    NOT_FINITE = 6, "measurement is zero or not finite"
    NOT_CONVERGED = 7, "Newton's method did not converge"


_TOO_LARGE = (
    "Where all states have it, the force or the other modes' participations are too large for the "
    "motion: is the force in newtons, and the velocity in m/s?"
)
_USUAL_CAUSE: dict[PointStatus, str] = {
    PointStatus.NEGATIVE_DAMPING: (
        "Where all states have it, `participation`, the shape at the sensor, the sensor or the "
        "force has the wrong sign, or the phases are not those of a velocity relative to the force"
    ),
    PointStatus.TWO_ROOTS: _TOO_LARGE,
    PointStatus.NO_ROOT: _TOO_LARGE,
    PointStatus.NO_REAL_FREQUENCY: _TOO_LARGE,
}


def statuses_in_words(status: Int[np.ndarray | Array, "*batch"]) -> str:
    """How many members have which status: "12 ok, 1 two_roots"."""
    kinds, counts = np.unique(np.asarray(status), return_counts=True)
    pairs = zip(kinds, counts, strict=True)
    return ", ".join(f"{n} {PointStatus(int(kind)).name.lower()}" for kind, n in pairs)


def reasons_in_words(status: Int[np.ndarray | Array, " state"]) -> str:
    """Why states have no point, the most frequent reason first, and what most often causes it."""
    kinds, counts = np.unique(np.asarray(status), return_counts=True)
    order = [k for k in np.argsort(-counts, kind="stable") if kinds[k] != PointStatus.OK]
    found = [(PointStatus(int(kinds[k])), int(counts[k])) for k in order]
    listed = "; ".join(f"{count} have {kind.message}" for kind, count in found)
    causes = [_USUAL_CAUSE[kind] for kind, _ in found[:1] if kind in _USUAL_CAUSE]
    return ". ".join([listed, *causes])


def status_names(status: Int[np.ndarray | Array, " state"]) -> np.ndarray:
    """The status of every member as text, as files have it."""
    return np.array([PointStatus(int(one)).name.lower() for one in np.asarray(status)], dtype=str)


def spans(values: Float[np.ndarray | Array, "*batch"]) -> str:
    """From the smallest to the largest finite number, in four digits."""
    finite = np.asarray(values)[np.isfinite(np.asarray(values))]
    if not finite.size:
        return "none"
    return f"{finite.min():.4g} to {finite.max():.4g}"


class SnrmPoints(AbstractResult):
    """ω̃ and ζ̃ of a batch of steady states; NaN wherever the status says that there is none."""

    coordinates: ClassVar[tuple[str, ...]] = ("member",)

    natural_frequency: Float[Array, "*batch"]  # rad/s
    damping_ratio: Float[Array, "*batch"]
    alternative_natural_frequency: Float[Array, "*batch"]  # rad/s, NaN = there is no other root
    alternative_damping_ratio: Float[Array, "*batch"]
    status: Int[Array, "*batch"]  # `PointStatus`

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`."""
        return (
            f"SnrmPoints: {np.size(self.status)} inversions ({statuses_in_words(self.status)})",
            f"natural frequency {spans(np.asarray(self.natural_frequency) / _HERTZ)} Hz",
            f"damping ratio {spans(100 * np.asarray(self.damping_ratio))} %",
        )

    def variables(self) -> dict[str, Variable]:
        """See `AbstractResult`; the batch in one row."""

        def column(values: Array | np.ndarray, unit: str, meaning: str) -> Variable:
            return Variable(("member",), np.asarray(values).reshape(-1), unit, meaning)

        other = self.alternative_natural_frequency, self.alternative_damping_ratio
        return {
            "member": column(np.arange(np.size(self.status)), "1", "member of the batch"),
            "natural_frequency_hz": column(
                np.asarray(self.natural_frequency) / _HERTZ, "Hz", "natural frequency"
            ),
            "damping_ratio": column(self.damping_ratio, "1", "damping ratio"),
            "alternative_natural_frequency_hz": column(
                np.asarray(other[0]) / _HERTZ, "Hz", "natural frequency of the other root"
            ),
            "alternative_damping_ratio": column(other[1], "1", "damping ratio of the other root"),
            "status": column(status_names(np.ravel(self.status)), "", "what became of it"),
        }
