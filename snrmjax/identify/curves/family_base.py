"""What every family of smooth curves of amplitude has, for the joint fit.

Every member is ω̃²(amplitude) in rad²/s² or 2ζ̃ω̃(amplitude) in 1/s. Its parameters are what its
terms contribute at the largest measured amplitude, so that all have the unit of the value.
"""

from abc import abstractmethod
from typing import ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Argument = Literal["displacement", "velocity"]


_KIND_WORDS = {
    "polynomial": "even polynomial",
    "power_law": "power law",
    "smoothing_spline": "smoothing spline",
    "viscous_quadratic": "viscous and quadratic damping",
    "viscous_coulomb": "viscous and Coulomb damping",
    "viscous_microslip": "viscous and microslip damping",
}


class Coefficient(NamedTuple):
    """A parameter as an engineer writes it: coefficient·amplitude^power, or a bare number."""

    name: str
    power: float  # of the amplitude that the coefficient multiplies
    is_value: bool  # False: a number without unit, such as an exponent


class AbstractCurve(eqx.Module):
    """A curve of amplitude with parameters that a fit may move."""

    parameters: Float[Array, " parameter"]
    scale: Float[Array, ""]  # the largest measured amplitude, m or m/s

    @abstractmethod
    def __call__(self, amplitude: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Value at the amplitude that is its own, exact in the limit of zero."""

    def values_and_slopes(
        self, amplitude: Float[np.ndarray, " point"]
    ) -> tuple[Float[np.ndarray, " point"], Float[np.ndarray, "point parameter"]]:
        """Values and their derivatives by the parameters, on the host.

        What `jax.jacfwd` says, which is taken where a curve has nothing of its own: programs of
        many curves that are drawn once each would take longer to compile than all else.
        """
        at = jnp.asarray(amplitude)

        def of(parameters: Array) -> Array:
            return eqx.tree_at(lambda f: f.parameters, self, parameters)(at)

        return np.asarray(self(at)), np.asarray(jax.jacfwd(of)(self.parameters))

    def prior_residuals(self) -> Float[Array, " row"]:
        """What is expected to be near zero of a curve, in its own 1σ; of most curves nothing."""
        return jnp.zeros(0)

    @abstractmethod
    def amplitude(self, displacement: Array, velocity: Array) -> Array:
        """The one of the two amplitudes that this curve is a function of."""


class AbstractFamily(AbstractCurve):
    """A curve of amplitude by name; `argument` says of which amplitude."""

    kind: ClassVar[str]
    orders: ClassVar[tuple[int, ...]]  # sizes that a selection by data tries, simplest first
    argument: Argument = eqx.field(static=True)

    @property
    def label(self) -> str:
        """Family, size and amplitude as the joint fit takes them: "polynomial:2@velocity"."""
        size = "" if self.size is None else f":{self.size}"
        return f"{self.kind}{size}@{self.argument}"

    @property
    def words(self) -> str:
        """Family, size and amplitude in words: "power law of velocity"."""
        if self.kind == "constant" or (self.kind == "polynomial" and self.size == 0):
            return "constant"
        sized = ""
        if "spline" in self.kind:
            sized = f", {self.size} knots"
        elif self.kind == "polynomial":
            sized = f", {self.size} {'term' if self.size == 1 else 'terms'} beside the constant"
        return f"{_KIND_WORDS.get(self.kind, self.kind)} of {self.argument}{sized}"

    @property
    def size(self) -> int | None:
        """The size that is said beside the family's name; None where there is but one."""
        return None

    def amplitude(self, displacement: Array, velocity: Array) -> Array:
        """See `AbstractCurve`."""
        return displacement if self.argument == "displacement" else velocity

    @abstractmethod
    def coefficients(self) -> tuple[Coefficient, ...]:
        """What the parameters are called and the power of amplitude that each belongs to."""

    @classmethod
    @abstractmethod
    def starts(
        cls,
        order: int,
        argument: Argument,
        amplitude: Float[np.ndarray, " point"],
        values: Float[np.ndarray, " point"],
        weight: Float[np.ndarray, " point"],
    ) -> list["AbstractFamily"]:
        """Members near scattered points: one where the family is linear, several elsewhere."""


def linear_start(
    columns: np.ndarray, values: np.ndarray, weight: np.ndarray
) -> Float[np.ndarray, " parameter"]:
    """Parameters of a family that is linear in them, nearest to weighted values."""
    solution = np.linalg.lstsq(columns * weight[:, None], values * weight, rcond=1e-10)[0]
    return np.asarray(solution)
