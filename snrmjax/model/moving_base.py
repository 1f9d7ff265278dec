"""What drives a structure in the place of a force: a base that moves, or an unbalance."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Array, Complex, Float

from snrmjax.numerics.names import suggestion

SensorMotion = Literal["absolute", "relative"]
MOTIONS: tuple[SensorMotion, ...] = get_args(SensorMotion)


class BaseMotion(NamedTuple):
    """A rigid base that moves along one axis; its acceleration is what drives the structure.

    On a base with acceleration a a mode obeys q̈ + 2ζωq̇ + ω²q + … = −Γa, with q relative to the
    base and Γ = Σ m φ along its motion. Everything is then counted relative to the base, with a
    (m/s²) in the place of the force and −Γ (kg^1/2) in that of the participation.
    """

    # What the sensors record: their own motion, or that relative to the base.
    motion: SensorMotion = "absolute"
    # How far a point moves with the rigid structure when the base moves by one; 1 where not named.
    along: tuple[tuple[str, float], ...] = ()

    def cosines(self, points: Sequence[str]) -> Float[np.ndarray, " point"]:
        """How far each point moves with the base."""
        named = dict(self.along)
        return np.array([named.get(point, 1.0) for point in points], dtype=float)

    def own_velocity(
        self,
        points: Sequence[str],
        frequency: Float[np.ndarray, "*batch"] | float,
        acceleration: Float[np.ndarray, "*batch"] | float,
    ) -> Complex[np.ndarray, "*batch point"]:
        """What of the recorded velocities is the base's, m/s, relative to its acceleration.

        Arguments: `frequency` in rad/s, `acceleration` the amplitude in m/s².
        """
        moved = np.asarray(acceleration) / (1j * np.asarray(frequency))
        fraction = self.cosines(points) if self.motion == "absolute" else np.zeros(len(points))
        return moved[..., None] * fraction


def base_motion(
    motion: SensorMotion = "absolute", along: Mapping[str, float] | None = None
) -> BaseMotion:
    """A base that moves: `motion` is what the sensors record, `along` how far points go with it.

    Arguments: `along` has the cosine between the axis of a point and the motion of the base, 1
    where not named, 0 of a rotation.
    Raises `ValueError` for another motion, or a number that is not finite.
    """
    if motion not in MOTIONS:
        near = suggestion(str(motion), MOTIONS)
        raise ValueError(
            f"`motion` of a base must be 'absolute' or 'relative', but is {motion!r}{near}."
        )
    pairs = tuple((str(point), float(value)) for point, value in (along or {}).items())
    if not all(np.isfinite(value) for _, value in pairs):
        raise ValueError("`along` of a base must have finite numbers.")
    return BaseMotion(motion, pairs)


def newtons(
    unbalance: Float[Array, ""] | None,
    frequency: Float[Array | np.ndarray, "*batch"] | float,
    force: Float[Array | np.ndarray, "*batch"] | float,
) -> Any:
    """The force (N) at a frequency Ω (rad/s): of a multiple c of an unbalance U it is c U Ω².

    A force, and a base's acceleration in its place, is what it is at every frequency.
    """
    return force if unbalance is None else force * unbalance * frequency**2


def drive_unit(base: BaseMotion | None, unbalance: Any = None) -> str:
    """Unit of what drives a structure: newtons, m/s² of a base, or an unbalance (kg m)."""
    if unbalance is not None:
        return f"× {float(unbalance):.6g} kg m"
    return "N" if base is None else "m/s²"
