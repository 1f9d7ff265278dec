"""A beam or arch: dimensions, supports and mesh geometry."""

from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.model.modes import have_values
from snrmjax.numerics.rules import NOT_NEGATIVE, POSITIVE, InputError, Rule

Number = float | Float[Array, ""]
SupportName = Literal["clamped", "pinned", "free"]
_POISSON = Rule("above -1 and below 0.5", lambda value: -1 < value < 0.5)


def _number(value: Number) -> Float[Array, ""]:
    # Arrays, not floats: a compiled program then serves all values.
    return jnp.asarray(value, dtype=jnp.float64)


def _stiffness(value: Number | None) -> Float[Array, ""] | None:
    if value is None or (isinstance(value, (int, float)) and value == np.inf):
        return None
    return _number(value)


def _check(part: eqx.Module, rule: Rule, *names: str) -> None:
    """Raises `ValueError` for a concrete number that breaks the rule."""
    for name in names:
        value = getattr(part, name)
        if value is None or not have_values(value):
            continue
        if np.ndim(value):
            raise InputError(f"`{name}` must be one number, but has shape {np.shape(value)}.")
        if not (np.isfinite(value) and rule.good(value)):
            raise InputError(f"`{name}` must be {rule.expected}, but is {float(value):g}.")


class Support(eqx.Module):
    """Springs between an end and the ground: None (or infinite) is fixed, zero is free.

    `axial` acts along the chord of the beam and `transverse` across it, both in N/m; `rotation`
    in N m/rad. A fixed direction has no derivative by its stiffness.
    """

    axial: Number | None = eqx.field(converter=_stiffness, default=None)
    transverse: Number | None = eqx.field(converter=_stiffness, default=None)
    rotation: Number | None = eqx.field(converter=_stiffness, default=None)

    def __check_init__(self) -> None:
        """Raises `ValueError` for a stiffness that is negative or not a number."""
        _check(self, NOT_NEGATIVE, "axial", "transverse", "rotation")

    @property
    def springs(self) -> tuple[Number | None, ...]:
        """Stiffnesses along the chord, across it and in rotation."""
        return self.axial, self.transverse, self.rotation


_NAMED = {
    "clamped": Support(),
    "pinned": Support(rotation=0.0),
    "free": Support(0.0, 0.0, 0.0),
}


def _support(value: Support | SupportName) -> Support:
    if isinstance(value, Support):
        return value
    if value not in _NAMED:
        raise InputError(f"a support must be one of {', '.join(_NAMED)}, but is {value!r}.")
    return _NAMED[value]


class PointMass(eqx.Module):
    """A mass (kg) attached to the beam at a fraction of its length, with its rotary inertia."""

    at: float = eqx.field(static=True)
    mass: Number = eqx.field(converter=_number)
    inertia: Number = eqx.field(converter=_number, default=0.0)  # kg m²

    def __check_init__(self) -> None:
        """Raises `ValueError` for a position off the beam or a negative mass."""
        if not 0 <= self.at <= 1:
            raise InputError(f"`at` must be a fraction of the length, but is {self.at:g}.")
        _check(self, NOT_NEGATIVE, "mass", "inertia")


class Beam(eqx.Module):
    """A beam of rectangular section, straight or a circular arc, as a chain of finite elements.

    `length` is that of the chord and `rise` the height of the arc over it (`rise_of_radius` gives
    it from a radius); the arc is stress-free. x runs along the chord, y away from the centre of
    curvature. `poisson` None: no shear deformation; else it is that of a rectangular section.
    Differentiable by all numbers but `elements`; SI units throughout.

    >>> Beam(0.2286, 0.0127, 0.787e-3, young=204.8e9, density=7870.0).nodes.shape
    (41, 2)
    """

    length: Number = eqx.field(converter=_number)  # m
    width: Number = eqx.field(converter=_number)  # m
    thickness: Number = eqx.field(converter=_number)  # m
    rise: Number = eqx.field(converter=_number, default=0.0, kw_only=True)  # m
    young: Number = eqx.field(converter=_number, kw_only=True)  # Pa
    density: Number = eqx.field(converter=_number, kw_only=True)  # kg/m³
    poisson: Number | None = eqx.field(
        converter=lambda value: None if value is None else _number(value),
        default=None,
        kw_only=True,
    )
    elements: int = eqx.field(static=True, default=40, kw_only=True)
    left: Support | SupportName = eqx.field(converter=_support, default="clamped", kw_only=True)
    right: Support | SupportName = eqx.field(converter=_support, default="clamped", kw_only=True)
    point_masses: tuple[PointMass, ...] = eqx.field(converter=tuple, default=(), kw_only=True)

    def __check_init__(self) -> None:
        """Raises `ValueError` for invalid dimensions."""
        if isinstance(self.elements, bool) or not isinstance(self.elements, int):
            raise InputError(f"`elements` must be a whole number, but is {self.elements!r}.")
        if self.elements < 2:
            raise InputError(f"`elements` must be at least 2, but is {self.elements}.")
        _check(self, POSITIVE, "length", "width", "thickness", "young", "density")
        _check(self, NOT_NEGATIVE, "rise")
        _check(self, _POISSON, "poisson")

    @property
    def half_angle(self) -> Float[Array, ""]:
        """Half of the angle that the arc spans, rad; zero for a straight beam."""
        return 2 * jnp.arctan2(2 * self.rise, self.length)

    @property
    def arc_length(self) -> Float[Array, ""]:
        """Length along the beam, m."""
        return self.length / jnp.sinc(self.half_angle / jnp.pi)

    @property
    def nodes(self) -> Float[Array, "node 2"]:
        """Coordinates (x, y) of the nodes, equally spaced along the beam, m."""
        half = self.half_angle
        t = jnp.linspace(-1.0, 1.0, self.elements + 1)

        def sinc(angle: Array) -> Array:
            return jnp.sinc(angle / jnp.pi)

        # R sin and R (cos − cos) without the radius, which is infinite for a straight beam.
        x = 0.5 * self.length * (1 + t * sinc(t * half) / sinc(half))
        bulge = sinc(0.5 * half * (1 + t)) * sinc(0.5 * half * (1 - t)) / sinc(half)
        return jnp.stack([x, 0.25 * self.length * half * (1 - t**2) * bulge], axis=1)

    @property
    def ends(self) -> tuple[tuple[int, Support], ...]:
        """Node and support of the left end, then of the right one."""
        return (0, _support(self.left)), (self.elements, _support(self.right))

    @property
    def free(self) -> np.ndarray:
        """The unconstrained degrees of freedom (x, y, rotation of each node in turn)."""
        fixed = [
            3 * node + k
            for node, end in self.ends
            for k, spring in enumerate(end.springs)
            if spring is None
        ]
        return np.setdiff1d(np.arange(self.n_dof), fixed)

    @property
    def n_dof(self) -> int:
        """Number of degrees of freedom, fixed ones included."""
        return 3 * (self.elements + 1)


class BeamSection(NamedTuple):
    """Stiffness and mass of the section."""

    axial: Number  # EA, N
    bending: Number  # EI, N m²
    shear: Number | None  # κGA, N
    mass: Number  # ρA, kg/m
    rotary: Number  # ρI, kg m


def section_of(beam: Beam) -> BeamSection:
    """The rectangular section; shear coefficient κ = 10(1+ν)/(12+11ν).

    Reference: G. R. Cowper, J. Appl. Mech. 33 (1966) 335, doi:10.1115/1.3625046.
    """
    area = beam.width * beam.thickness
    inertia = area * beam.thickness**2 / 12
    shear = None
    if beam.poisson is not None:
        kappa = 10 * (1 + beam.poisson) / (12 + 11 * beam.poisson)
        shear = kappa * beam.young / (2 * (1 + beam.poisson)) * area
    return BeamSection(
        beam.young * area, beam.young * inertia, shear, beam.density * area, beam.density * inertia
    )


def rise_of_radius(length: Number, radius: Number) -> Float[Array, ""]:
    """Rise (m) of an arc below a half circle over a chord of `length`, both in m.

    >>> round(float(rise_of_radius(0.3048, 11.43)), 9)
    0.001016045
    """
    half = 0.5 * jnp.asarray(length)
    return half**2 / (radius + jnp.sqrt(jnp.asarray(radius) ** 2 - half**2))
