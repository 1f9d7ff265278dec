"""Result of an inversion: natural frequency and damping ratio, or the reason for none."""

from typing import ClassVar

import numpy as np
from jaxtyping import Array, Float, Int

from snrmjax.numerics.result import AbstractResult, Variable, quantity
from snrmjax.numerics.status import Status


class PointStatus(Status):
    """Outcome of one inversion."""

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


def reasons_in_words(status: Int[np.ndarray | Array, " state"]) -> str:
    """Why states have no point, the most frequent reason first with its usual cause."""
    kinds, counts = np.unique(np.asarray(status), return_counts=True)
    order = [k for k in np.argsort(-counts, kind="stable") if kinds[k] != PointStatus.OK]
    reasons = [(PointStatus(int(kinds[k])), int(counts[k])) for k in order]
    listed = "; ".join(f"{count} have {kind.message}" for kind, count in reasons)
    causes = [_USUAL_CAUSE[kind] for kind, _ in reasons[:1] if kind in _USUAL_CAUSE]
    return ". ".join([listed, *causes])


class SnrmPoints(AbstractResult):
    """ω̃ and ζ̃ of a batch of steady states; NaN where the inversion failed (see `status`).

    `alternative_…` is the second root that amplitude and phase alone would allow, NaN where there
    is none.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("member",)

    natural_frequency: Float[Array, "*batch"] = quantity("member", "Hz", "natural frequency")
    damping_ratio: Float[Array, "*batch"] = quantity("member", "1", "damping ratio")
    alternative_natural_frequency: Float[Array, "*batch"] = quantity("member", "Hz", "other root")
    alternative_damping_ratio: Float[Array, "*batch"] = quantity("member", "1", "other root")
    status: Int[Array, "*batch"] = quantity("member", "", "outcome", of=PointStatus)

    def variables(self) -> dict[str, Variable]:
        """Those of the fields, the batch in one row."""
        number = np.arange(np.size(self.status))
        rows = super().variables().items()
        return {
            "member": Variable(("member",), number, "1", "member of the batch"),
            **{name: row._replace(values=np.ravel(row.values)) for name, row in rows},
        }
