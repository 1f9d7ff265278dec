"""Linear modes of a beam, their shapes at sensors and participation of forces."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.condense.elements.beam import Beam
from snrmjax.condense.elements.strain_energy import (
    interpolation,
    mass_matrix,
    tangent_stiffness,
    uniform_load,
)
from snrmjax.condense.load_cases import ReductionBasis
from snrmjax.model.modes import have_values
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.rules import FRACTION, InputError, require

_MIDSPAN_NODE = 0.05  # of the largest displacement, below which midspan counts as a node
_MECHANISM = 1e-10  # of the largest squared frequency a beam of so many elements could have


def beam_modes(beam: Beam, modes: Sequence[int]) -> ReductionBasis:
    """Mass-normalised modes of small vibration about the stress-free shape: K φ = ω² M φ.

    Shapes have rows for all degrees of freedom (x, y, rotation of each node, zero where fixed).
    Their sign is positive upwards at midspan; if that is a node, at the first point from the left
    with at least 0.9 of the maximum. Frequencies and shapes are differentiable by everything in
    `beam` (first and second derivatives), for distinct natural frequencies.

    Arguments: `modes` numbers counted from one, in order of frequency (axial modes counted too).
    Raises `ValueError` for modes above one per element, which the mesh does not resolve, and for
    supports that leave a mechanism.

    >>> beam = Beam(0.2286, 0.0127, 0.787e-3, young=204.8e9, density=7870.0)
    >>> (beam_modes(beam, (1, 3)).frequency / (2 * np.pi)).round(2)
    Array([ 78.97, 426.73], dtype=float64)
    """
    numbers = tuple(modes)
    if not numbers or len(set(numbers)) < len(numbers):
        raise InputError(f"`modes` must be different numbers, at least one, but are {numbers}.")
    if min(numbers) < 1 or max(numbers) > beam.elements:
        raise InputError(
            f"`modes` must be numbers from 1 to {beam.elements}, which {beam.elements} elements "
            f"can show, but are {numbers}."
        )
    basis = _linear_modes(beam, numbers)
    if have_values(basis) and not np.all(np.isfinite(basis.frequency)):
        raise InputError("the supports leave a mechanism: the beam can move without deforming.")
    return basis


@compiled
def _linear_modes(beam: Beam, numbers: tuple[int, ...]) -> ReductionBasis:
    free = beam.free
    block = free[:, None], free
    whole_mass = mass_matrix(beam)
    stiffness = tangent_stiffness(beam, jnp.zeros(beam.n_dof))[block]
    mass = whole_mass[block]
    k, m = jax.lax.stop_gradient((stiffness, mass))
    # Eigenvalues of K⁻¹M: the lowest modes are the largest and keep all digits.
    scale = 1 / jnp.sqrt(jnp.diagonal(k))
    root = jnp.linalg.cholesky(k * scale[:, None] * scale)
    half = jax.scipy.linalg.solve_triangular(root, m * scale[:, None] * scale, lower=True)
    inverse = jax.scipy.linalg.solve_triangular(root, half.T, lower=True)
    values, vectors = jnp.linalg.eigh(0.5 * (inverse + inverse.T))
    chosen = values.size - np.asarray(numbers)
    mechanism = values[-1] > values[0] / _MECHANISM**2
    shapes = scale[:, None] * jax.scipy.linalg.solve_triangular(root.T, vectors[:, chosen])
    shapes = shapes * _sign(beam, shapes) / jnp.sqrt(values[chosen])

    def differentiable(value: Array, shape: Array) -> tuple[Array, Array]:
        # Newton steps on K φ = λ M φ, φᵀMφ = 1, with a fixed matrix (Nelson's, regularised along
        # the shape): the value changes by rounding only, and each step makes one more order of
        # derivatives exact.
        weighted = m @ shape
        regular = k - m / value + jnp.outer(weighted, weighted) / value
        factor = jax.scipy.linalg.lu_factor(regular)
        for _ in range(2):
            modal_mass = shape @ mass @ shape
            squared = shape @ stiffness @ shape / modal_mass
            residual = stiffness @ shape - squared * (mass @ shape)
            change = jax.scipy.linalg.lu_solve(factor, residual)
            shape = shape - change - 0.5 * shape * (modal_mass - 1)
        return squared, shape

    squared, shapes = jax.vmap(differentiable, (0, 1), (0, 1))(values[chosen], shapes)
    whole = jnp.zeros((beam.n_dof, len(numbers))).at[free].set(shapes)
    squared = jnp.where(mechanism, jnp.nan, squared)
    return ReductionBasis(
        frequency=jnp.sqrt(squared),
        shapes=whole,
        filter=whole.T @ whole_mass,
        numbers=numbers,
        translations=jnp.asarray(np.arange(beam.n_dof) % 3 != 2),
    )


def _sign(beam: Beam, shapes: Float[Array, "free mode"]) -> Float[Array, " mode"]:
    whole = jnp.zeros((beam.n_dof, shapes.shape[1])).at[beam.free].set(shapes)
    up = whole[1::3]
    midspan = jax.lax.stop_gradient(interpolation(beam, 0.5)[1]) @ whole
    largest = jnp.max(jnp.abs(up), axis=0)
    first = jnp.argmax(jnp.abs(up) >= 0.9 * largest, axis=0)
    at_first = jnp.take_along_axis(up, first[None], axis=0)[0]
    chosen = jnp.where(jnp.abs(midspan) > _MIDSPAN_NODE * largest, midspan, at_first)
    return jnp.where(chosen < 0, -1.0, 1.0)


def shape_at(beam: Beam, basis: ReductionBasis, fraction: float) -> Float[Array, " mode"]:
    """Transverse mode shapes at a fraction of the length, kg^-1/2, as for a sensor."""
    require("a position as a fraction of the length", fraction, FRACTION)
    return interpolation(beam, fraction)[1] @ basis.shapes


def participation(
    beam: Beam, basis: ReductionBasis, at: float | None = None
) -> Float[Array, " mode"]:
    """Φᵀb of a transverse force, per newton in total, kg^-1/2.

    Arguments: `at` is the fraction of the length where the force acts; None: uniform along the
    beam.
    """
    if at is None:
        return uniform_load(beam) @ basis.shapes
    return shape_at(beam, basis, at)
