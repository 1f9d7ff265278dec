"""A clamped beam with a small rise, from its dimensions: modes and potential by Galerkin's method.

Reference: A. H. Nayfeh & P. F. Pai, Linear and Nonlinear Structural Mechanics, Wiley 2004,
doi:10.1002/9783527617562; for the arch S. Krylov, B. R. Ilic, D. Schreiber, S. Seretensky &
H. Craighead, J. Micromech. Microeng. 18 (2008) 055026, doi:10.1088/0960-1317/18/5/055026.
"""

import itertools
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.model.modes import LinearModes, have_values
from snrmjax.model.potential import Monomial, PolynomialPotential
from snrmjax.model.structures import Structure
from snrmjax.numerics.rules import (
    BELOW_ONE,
    BETWEEN_ZERO_AND_ONE,
    NOT_NEGATIVE,
    POSITIVE,
    require,
)

_STEEPEST = 0.1  # rise over length: the strain of a shallow arch is wrong by some per cent there
_MOST = 20  # number of a beam function
_NUMBERS = ("length", "width", "thickness", "rise", "young", "density")
_POINTS = 200  # of Gauss's rule; exact to rounding for the highest beam function

Number = float | Float[Array, ""]


class ArchSettings(eqx.Module):
    """What of an arch is computed: its beam functions, where it is driven and where it is seen.

    `beam_functions` are numbers of the clamped-clamped beam's modes from 1 on, the odd ones
    symmetric; the structure has as many modes. Positions are shares of the length.
    `force_position` None: a force that is distributed uniformly, whose total is the force.
    """

    beam_functions: tuple[int, ...] = eqx.field(static=True, default=(1, 3))
    sensor_position: float = eqx.field(static=True, default=0.5)
    force_position: float | None = eqx.field(static=True, default=None)
    name: str = eqx.field(static=True, default="clamped shallow arch")

    def __check_init__(self) -> None:
        """Raises `ValueError` for unknown or repeated beam functions and places off the beam."""
        numbers = self.beam_functions
        if not numbers or len(set(numbers)) < len(numbers):
            raise ValueError(f"`beam_functions` must be distinct numbers, but are {numbers}.")
        if min(numbers) < 1 or max(numbers) > _MOST:
            raise ValueError(f"`beam_functions` must be from 1 to {_MOST}, but are {numbers}.")
        for name in ("sensor_position", "force_position"):
            place = getattr(self, name)
            if place is not None:
                require(f"`{name}`", place, BETWEEN_ZERO_AND_ONE)


DEFAULT_ARCH = ArchSettings()


def shallow_arch(
    length: Number,
    width: Number,
    thickness: Number,
    rise: Number,
    *,
    young: Number,
    density: Number,
    damping_ratio: Number | Float[Array, " mode"],
    settings: ArchSettings = DEFAULT_ARCH,
) -> Structure:
    """A clamped-clamped beam, straight or with a small rise, as a `Structure` of its dimensions.

    With the displacement w from the stress-free shape w₀ = 4 h x (L − x)/L² (a circular arc of
    radius L²/8h), EI and EA of the rectangular section, its energy is

        V = EI/2 ∫ w''² dx + N² L/(2 EA),   N = EA/(2L) ∫ (w'² + 2 w' w₀') dx,

    bending of a slender beam and one axial force along the whole of it (the axial motion follows
    without inertia). With w = Σ aᵢ φᵢ(x) in modes φᵢ of the straight beam the terms of degree two
    give the arch's own modes, which are mass-normalised and in order of frequency; the others are
    its potential, quadratic and cubic in the force. Positive displacement is away from the centre
    of curvature. Differentiable in every number (not where two natural frequencies are equal).

    Arguments: `length` L (of the chord), `width`, `thickness` and `rise` h at midspan in m,
    `young` in Pa, `density` in kg/m³, `damping_ratio` one for all modes or one each, `settings` as
    `ArchSettings`. Within `jax.jit` the numbers are not checked.
    Returns a `Structure` with one sensor; the recorded force is the total one.
    Raises `ValueError` for numbers that no arch has and for a rise beyond a tenth of the length.
    Validity: thickness well below the length, displacements of a few thicknesses or rises and
    small slopes, ends that do not move; symmetric beam functions alone cannot show that a steep
    arch escapes sideways (rise of more than about three thicknesses): take even ones too.
    Of the method paper's curved beam (rise of two thicknesses; beam functions 1, 3 and 5) it gives
    64.6 Hz (printed: 64.78), a quadratic coefficient smaller by 2 % and a cubic one 3.2 times that
    printed; of its flat beam a cubic one 2.9 times that printed, as finite elements do.
    Reference: Nayfeh & Pai (2004); Krylov et al. (2008), with their voltage left out.

    >>> beam = shallow_arch(0.2286, 0.0127, 0.787e-3, 0.0, young=204.8e9, density=7870.0,
    ...     damping_ratio=0.05)
    >>> (beam.modes.natural_frequency / (2 * np.pi)).round(2).tolist()
    [78.97, 426.74]
    """
    numbers = [length, width, thickness, rise, young, density]
    given = [jnp.asarray(number, dtype=jnp.float64) for number in (*numbers, damping_ratio)]
    if have_values(given):
        _check(given, len(settings.beam_functions))
    return _arch(jnp.stack(given[:6]), given[6], settings)


@eqx.filter_jit
def _arch(numbers: Float[Array, " 6"], damping_ratio: Array, settings: ArchSettings) -> Structure:
    length, width, thickness, rise, young, density = numbers
    beam, area = _beam_integrals(settings), width * thickness
    mass, bending = density * area * length, young * area * thickness**2 / (12 * length**3)
    stretching = young * area / length
    # ∫ φ' w₀' dx = −∫ φ w₀'' dx, for the clamped ends φ = 0.
    slope = 8 * rise / length * beam.mean
    linear = bending * jnp.diag(beam.eigenvalue**4) + stretching * jnp.outer(slope, slope)
    squared, vectors = jnp.linalg.eigh(linear / mass)
    largest = jnp.take_along_axis(vectors, jnp.argmax(jnp.abs(vectors), axis=0)[None], axis=0)
    shapes = vectors * jnp.sign(largest) / jnp.sqrt(mass)
    slope, shortening = slope @ shapes, shapes.T @ (beam.slopes / length) @ shapes
    n = len(settings.beam_functions)
    zero = jnp.zeros(n)
    modes = LinearModes(
        natural_frequency=jnp.sqrt(squared),
        damping_ratio=jnp.broadcast_to(damping_ratio, (n,)),
        mode_shape=(beam.at_sensor @ shapes)[None],
        participation=beam.under_force @ shapes,
        rigid_body_shape=jnp.zeros((1, 0)),
        rigid_body_participation=jnp.zeros(0),
        natural_frequency_std=zero,
        damping_ratio_std=zero,
        sensors=("midspan" if settings.sensor_position == 0.5 else "sensor",),
    )
    cubic = 0.5 * stretching * jnp.einsum("i,jk->ijk", slope, shortening)
    quartic = 0.125 * stretching * jnp.einsum("ij,kl->ijkl", shortening, shortening)
    parts = [_gathered(form) for form in (cubic, quartic)]
    coefficient = jnp.concatenate([values for values, _ in parts])
    potential = PolynomialPotential(
        coefficient, jnp.zeros(coefficient.shape), parts[0][1] + parts[1][1], n
    )
    return Structure(modes=modes, potential=potential, name=settings.name)


def _gathered(tensor: Float[Array, "..."]) -> tuple[Float[Array, " monomial"], tuple]:
    """The coefficients of a form by its monomials, permutations of the same modes summed."""
    places = list(itertools.product(*(range(n) for n in tensor.shape)))
    monomials: tuple[Monomial, ...] = tuple(sorted({tuple(sorted(place)) for place in places}))
    row = {monomial: k for k, monomial in enumerate(monomials)}
    sums = np.zeros((len(monomials), len(places)))
    for k, place in enumerate(places):
        sums[row[tuple(sorted(place))], k] = 1.0
    return jnp.asarray(sums) @ tensor.ravel(), monomials


class _BeamIntegrals(NamedTuple):
    """Clamped-clamped beam functions φ(ξ) with mean square 1, ξ = x/L."""

    eigenvalue: Float[np.ndarray, " mode"]  # βL
    mean: Float[np.ndarray, " mode"]  # ∫ φ dξ
    slopes: Float[np.ndarray, "mode mode"]  # ∫ φᵢ' φⱼ' dξ
    at_sensor: Float[np.ndarray, " mode"]
    under_force: Float[np.ndarray, " mode"]


def _beam_integrals(settings: ArchSettings) -> _BeamIntegrals:
    node, weight = np.polynomial.legendre.leggauss(_POINTS)
    place, weight = 0.5 * (node + 1), 0.5 * weight
    eigenvalue = np.array([_eigenvalue(number) for number in settings.beam_functions])
    value, slope = _beam_functions(eigenvalue, place)
    mean = value @ weight
    seen = _beam_functions(eigenvalue, np.array([settings.sensor_position]))[0][:, 0]
    driven = mean
    if settings.force_position is not None:
        driven = _beam_functions(eigenvalue, np.array([settings.force_position]))[0][:, 0]
    return _BeamIntegrals(eigenvalue, mean, (slope * weight) @ slope.T, seen, driven)


def _eigenvalue(number: int) -> float:
    """The root βL of cos βL cosh βL = 1, by Newton's method on cos βL − 1/cosh βL."""
    root = (number + 0.5) * np.pi
    for _ in range(8):
        residual = np.cos(root) - 1 / np.cosh(root)
        root -= residual / (np.tanh(root) / np.cosh(root) - np.sin(root))
    return float(root)


def _beam_functions(
    eigenvalue: Float[np.ndarray, " mode"], place: Float[np.ndarray, " place"]
) -> tuple[Float[np.ndarray, "mode place"], Float[np.ndarray, "mode place"]]:
    """φ = cosh βx − cos βx − σ (sinh βx − sin βx) and its slope dφ/dξ.

    Written by decaying exponentials from both ends: the hyperbolic functions cancel.
    """
    root = eigenvalue[:, None]
    below = np.sinh(root) - np.sin(root)
    sigma = (np.cosh(root) - np.cos(root)) / below
    # (1 − σ)/2 e^{βx} without cancellation, and with e^{βx} divided by e^{βL}.
    growing = 0.5 * (np.cos(root) - np.sin(root) - np.exp(-root)) * np.exp(root) / below
    from_right = growing * np.exp(-root * (1 - place))
    from_left = 0.5 * (1 + sigma) * np.exp(-root * place)
    cosine, sine = np.cos(root * place), np.sin(root * place)
    value = from_right + from_left - cosine + sigma * sine
    return value, root * (from_right - from_left + sine + sigma * cosine)


def _check(given: list[Array], n_modes: int) -> None:
    for name, number in zip(_NUMBERS, given, strict=False):
        if number.ndim:
            raise ValueError(f"`{name}` must be one number, but has shape {number.shape}.")
        require(f"`{name}`", number, NOT_NEGATIVE if name == "rise" else POSITIVE)
    length, rise = float(given[0]), float(given[3])
    if rise > _STEEPEST * length:
        raise ValueError(
            f"`rise` must be at most a tenth of the length, {_STEEPEST * length:g} m, for a shallow"
            f" arch, but is {rise:g} m."
        )
    damping = given[6]
    if damping.shape not in ((), (n_modes,)):
        raise ValueError(
            f"`damping_ratio` must be one number or {n_modes}, but has shape {damping.shape}."
        )
    require("`damping_ratio`", damping, BELOW_ONE)
