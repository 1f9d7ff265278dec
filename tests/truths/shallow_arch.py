"""A clamped beam with a small rise by Galerkin's method: a truth for the beams of finite elements.

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

from snrmjax.model.modes import LinearModes
from snrmjax.model.potential import Monomial, PolynomialPotential
from snrmjax.model.structures import Structure

_POINTS = 200  # of Gauss's rule; exact to rounding for the highest beam function


class ArchSettings(eqx.Module):
    """Beam functions (numbers of the clamped-clamped beam's modes), and where it is seen."""

    beam_functions: tuple[int, ...] = eqx.field(static=True, default=(1, 3))
    sensor_position: float = eqx.field(static=True, default=0.5)
    force_position: float | None = eqx.field(static=True, default=None)  # None: uniform
    name: str = eqx.field(static=True, default="clamped shallow arch")


def shallow_arch(length, width, thickness, rise, *, young, density, damping_ratio, settings):
    """A clamped-clamped beam, straight or with a small rise, as a `Structure` of its dimensions.

    With the displacement w from the stress-free shape w₀ = 4 h x (L − x)/L², its energy is

        V = EI/2 ∫ w''² dx + N² L/(2 EA),   N = EA/(2L) ∫ (w'² + 2 w' w₀') dx,

    bending of a slender beam and one axial force along the whole of it.
    """
    numbers = jnp.asarray([length, width, thickness, rise, young, density], dtype=jnp.float64)
    return _arch(numbers, jnp.asarray(damping_ratio), settings)


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
