"""Strain energy, forces, tangent stiffness and mass of a chain of plane beam elements.

The deformation of each element is described in a frame that rotates with its chord (corotational),
where it is a shallow arch: cubic deflection w with the end slopes a and b, and *one* membrane
strain, the mean over the element,

    e = (l − l₀)/s + mean of w'²/2 − mean of w₀'²/2,    mean of w'²/2 = (2a² − ab + 2b²)/30.

With the linear strain of the chord alone an element of a strongly bent beam is too long by θ²/24;
a pointwise w'²/2, which cubic and linear functions cannot balance, causes membrane locking. The
mean avoids both. Rigid-body rotations are exact, strains are small.

References: M. A. Crisfield, Non-linear Finite Element Analysis of Solids and Structures, vol. 1
(Wiley 1991), ch. 7 (corotational and shallow-arch elements); shear as in J. S. Przemieniecki,
Theory of Matrix Structural Analysis (McGraw-Hill 1968), ch. 5; mass as there, ch. 11.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.condense.elements.beam import Beam, section_of


def strain_energy(beam: Beam, displacement: Float[Array, " dof"]) -> Float[Array, ""]:
    """Energy (J) of elements and support springs, for displacements of all degrees of freedom.

    Displacements of each node in turn: x, y (m), rotation (rad), from the stress-free shape.
    """
    inside = jax.vmap(_element_energy, (None, 0, 0))(beam, _chords(beam), _relative(displacement))
    return jnp.sum(inside) + 0.5 * jnp.sum(_springs(beam) * displacement**2)


def internal_force(beam: Beam, displacement: Float[Array, " dof"]) -> Float[Array, " dof"]:
    """Gradient of the strain energy: N and N m, in order of the degrees of freedom."""
    moved = _relative(displacement)
    forces = jax.vmap(jax.grad(_element_energy, 2), (None, 0, 0))(beam, _chords(beam), moved)
    return _gathered(forces @ _RELATIVE) + _springs(beam) * displacement


def tangent_stiffness(beam: Beam, displacement: Float[Array, " dof"]) -> Float[Array, "dof dof"]:
    """Hessian of the strain energy."""
    moved = _relative(displacement)
    blocks = jax.vmap(jax.hessian(_element_energy, 2), (None, 0, 0))(beam, _chords(beam), moved)
    return _assembled(_RELATIVE.T @ blocks @ _RELATIVE) + jnp.diag(_springs(beam))


def mass_matrix(beam: Beam) -> Float[Array, "dof dof"]:
    """Consistent mass with rotary inertia of the section, and point masses."""
    n = beam.elements
    s, section = beam.arc_length / n, section_of(beam)
    along = jnp.array([[2.0, 1.0], [1.0, 2.0]]) * section.mass * s / 6
    across = _CUBIC_MASS * section.mass * s + _CUBIC_SLOPE * section.rotary / s
    unit = jnp.array([1.0, s, 1.0, s])
    across = across * unit[:, None] * unit
    local = jnp.zeros((6, 6))
    local = local.at[np.ix_([0, 3], [0, 3])].set(along)
    local = local.at[np.ix_([1, 2, 4, 5], [1, 2, 4, 5])].set(across)
    rotation = _rotations(beam)
    mass = _assembled(jnp.einsum("eki,kl,elj->eij", rotation, local, rotation))
    for point in beam.point_masses:
        rows = interpolation(beam, point.at)
        weight = jnp.stack([point.mass, point.mass, point.inertia])
        mass = mass + jnp.einsum("ki,k,kj->ij", rows, weight, rows)
    return mass


def interpolation(beam: Beam, fraction: float | Float[Array, ""]) -> Float[Array, "3 dof"]:
    """Matrix that interpolates x, y (m) and rotation (rad) at a fraction of the length."""
    n = beam.elements
    element = jnp.minimum(jnp.floor(fraction * n).astype(int), n - 1)
    t, s = fraction * n - element, beam.arc_length / n
    rows = jnp.zeros((3, 6))
    rows = rows.at[0, jnp.array([0, 3])].set(jnp.array([1 - t, t]))
    cubic = jnp.stack(
        [
            jnp.array([1 - 3 * t**2 + 2 * t**3, 3 * t**2 - 2 * t**3]),
            jnp.array([t - 2 * t**2 + t**3, t**3 - t**2]) * s,
        ]
    )
    slope = jnp.stack(
        [
            jnp.array([6 * t**2 - 6 * t, 6 * t - 6 * t**2]) / s,
            jnp.array([1 - 4 * t + 3 * t**2, 3 * t**2 - 2 * t]),
        ]
    )
    rows = rows.at[1, jnp.array([[1, 4], [2, 5]])].set(cubic)
    rows = rows.at[2, jnp.array([[1, 4], [2, 5]])].set(slope)
    rotation = _rotations(beam)[element]
    rows = rotation[:3, :3].T @ rows @ rotation
    return jnp.zeros((3, beam.n_dof)).at[:, 3 * element + np.arange(6)].set(rows)


def uniform_load(beam: Beam) -> Float[Array, " dof"]:
    """Consistent nodal forces of a uniform transverse load of one newton in total."""
    n, rotation = beam.elements, _rotations(beam)
    # Load of each element along and across its own chord; moments ± p s²/12.
    along, across = 0.5 * rotation[:, 0, 1], 0.5 * rotation[:, 0, 0]
    moment = across * beam.arc_length / (6 * n)
    local = jnp.stack([along, across, moment, along, across, -moment], axis=1) / n
    return _gathered(jnp.einsum("ek,ekj->ej", local, rotation))


# Deformation of an element: differences of displacements, mean and half difference of rotations.
_RELATIVE = np.array(
    [
        [-1.0, 0, 0, 1, 0, 0],
        [0, -1, 0, 0, 1, 0],
        [0, 0, 0.5, 0, 0, 0.5],
        [0, 0, 0.5, 0, 0, -0.5],
    ]
)
_CUBIC_MASS = (
    np.array(
        [[156, 22, 54, -13], [22, 4, 13, -3], [54, 13, 156, -22], [-13, -3, -22, 4]], dtype=float
    )
    / 420
)
_CUBIC_SLOPE = (
    np.array([[36, 3, -36, 3], [3, 4, -3, -1], [-36, -3, 36, -3], [3, -1, -3, 4]], dtype=float) / 30
)


def _connectivity(elements: int) -> np.ndarray:
    return 3 * np.arange(elements)[:, None] + np.arange(6)


def _chords(beam: Beam) -> Float[Array, "element 2"]:
    return jnp.diff(beam.nodes, axis=0)


def _springs(beam: Beam) -> Float[Array, " dof"]:
    """Stiffness to ground of every degree of freedom."""
    springs = jnp.zeros(beam.n_dof)
    for node, end in beam.ends:
        for k, spring in enumerate(end.springs):
            if spring is not None:
                springs = springs.at[3 * node + k].set(spring)
    return springs


def _rotations(beam: Beam) -> Float[Array, "element 6 6"]:
    """Rotation from x and y to along and across each chord, for both ends."""
    chord = _chords(beam)
    c, s = (chord / jnp.linalg.norm(chord, axis=1, keepdims=True)).T
    zero, one = jnp.zeros_like(c), jnp.ones_like(c)
    block = jnp.stack([c, s, zero, -s, c, zero, zero, zero, one], axis=1).reshape(-1, 3, 3)
    rotation = jnp.zeros((len(c), 6, 6))
    return rotation.at[:, :3, :3].set(block).at[:, 3:, 3:].set(block)


def _relative(displacement: Float[Array, " dof"]) -> Float[Array, "element 4"]:
    return displacement[_connectivity(displacement.size // 3 - 1)] @ _RELATIVE.T


def _element_energy(
    beam: Beam, chord: Float[Array, " 2"], relative: Float[Array, " 4"]
) -> Float[Array, ""]:
    section, s = section_of(beam), beam.arc_length / beam.elements
    initial = beam.half_angle / beam.elements  # end slopes of the stress-free arc: +, −
    moved = relative[:2]
    squared = jnp.sum(chord**2)
    ahead = jnp.sum(chord * moved)
    aside = chord[0] * moved[1] - chord[1] * moved[0]
    # Differences are formed before squares and roots, so that small motions keep all digits.
    before = jnp.sqrt(squared)
    now = jnp.sqrt(jnp.sum((chord + moved) ** 2))
    longer = (2 * ahead + jnp.sum(moved**2)) / (now + before)
    # The chord relative to the mean rotation of the ends, an angle below half a revolution for any
    # rotation of the beam.
    mean_rotation, difference = relative[2], relative[3]
    c, d = jnp.cos(mean_rotation), jnp.sin(mean_rotation)
    chord_rotation = jnp.arctan2(
        c * aside - d * (squared + ahead), c * (squared + ahead) + d * aside
    )
    a, b = difference - chord_rotation, -difference - chord_rotation
    mean = 2 * a * (a + 2 * initial) + 2 * b * (b - 2 * initial) - (a * b + initial * (b - a))
    strain = longer / s + mean / 30
    phi = 0.0 if section.shear is None else 12 * section.bending / (section.shear * s**2)
    # Bending by opposite end slopes (constant curvature) and by equal ones (shear force).
    bent = (a - b) ** 2 + 3 * (a + b) ** 2 / (1 + phi)
    return 0.5 * section.axial * s * strain**2 + 0.5 * section.bending / s * bent


def _gathered(rows: Float[Array, "element 6"]) -> Float[Array, " dof"]:
    elements = len(rows)
    return jnp.zeros(3 * (elements + 1)).at[_connectivity(elements)].add(rows)


def _assembled(blocks: Float[Array, "element 6 6"]) -> Float[Array, "dof dof"]:
    elements = len(blocks)
    dof = _connectivity(elements)
    size = 3 * (elements + 1)
    return jnp.zeros((size, size)).at[dof[:, :, None], dof[:, None, :]].add(blocks)
