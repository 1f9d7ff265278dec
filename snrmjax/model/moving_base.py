"""Excitation other than by a force: base motion or an unbalance."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Array, Complex, Float

from snrmjax.numerics.names import suggestion
from snrmjax.numerics.rules import InputError

SensorMotion = Literal["absolute", "relative"]
MOTIONS: tuple[SensorMotion, ...] = get_args(SensorMotion)


class BaseMotion(NamedTuple):
    """Base excitation: a rigid base whose acceleration along one axis drives the structure.

    With base acceleration a, a mode obeys q̈ + 2ζωq̇ + ω²q + … = −Γa, with q relative to the base
    and Γ = Σ m φ along its motion. All motion is then relative to the base, a (m/s²) replaces the
    force and −Γ (kg^1/2) the participation.
    """

    # Motion recorded by the sensors: absolute, or relative to the base.
    motion: SensorMotion = "absolute"
    # Rigid-body displacement of a point per unit base displacement; 1 where not named.
    along: tuple[tuple[str, float], ...] = ()

    def cosines(self, points: Sequence[str]) -> Float[np.ndarray, " point"]:
        """Rigid-body displacement of each point per unit base displacement."""
        named = dict(self.along)
        return np.array([named.get(point, 1.0) for point in points], dtype=float)

    def own_velocity(
        self,
        points: Sequence[str],
        frequency: Float[np.ndarray, "*batch"] | float,
        acceleration: Float[np.ndarray, "*batch"] | float,
    ) -> Complex[np.ndarray, "*batch point"]:
        """Contribution of the base motion to the recorded velocities, m/s, relative to its phase.

        Arguments: `frequency` in rad/s, `acceleration` the amplitude in m/s².
        """
        velocity = np.asarray(acceleration) / (1j * np.asarray(frequency))
        fraction = self.cosines(points) if self.motion == "absolute" else np.zeros(len(points))
        return velocity[..., None] * fraction


def base_motion(
    motion: SensorMotion = "absolute", along: Mapping[str, float] | None = None
) -> BaseMotion:
    """Base excitation, with the `motion` that the sensors record.

    Arguments: `along` has the direction cosine between the axis of a point and the motion of the
    base, 1 where not named, 0 for a rotation.
    Raises `ValueError` for another motion, or a number that is not finite.
    """
    if motion not in MOTIONS:
        near = suggestion(str(motion), MOTIONS)
        raise InputError(
            f"`motion` of a base must be 'absolute' or 'relative', but is {motion!r}{near}."
        )
    pairs = tuple((str(point), float(value)) for point, value in (along or {}).items())
    if not all(np.isfinite(value) for _, value in pairs):
        raise InputError("`along` of a base must have finite numbers.")
    return BaseMotion(motion, pairs)


def newtons(
    unbalance: Float[Array, ""] | None,
    frequency: Float[Array | np.ndarray, "*batch"] | float,
    force: Float[Array | np.ndarray, "*batch"] | float,
) -> Any:
    """The force (N) at a frequency Ω (rad/s): c U Ω² for a multiple c of an unbalance U.

    A force or a base acceleration is returned unchanged.
    """
    return force if unbalance is None else force * unbalance * frequency**2


def drive_unit(base: BaseMotion | None, unbalance: Any = None) -> str:
    """Unit of the excitation: newtons, m/s² of a base, or an unbalance (kg m)."""
    if unbalance is not None:
        return f"× {float(unbalance):.6g} kg m"
    return "N" if base is None else "m/s²"
