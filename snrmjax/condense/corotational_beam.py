"""A plane beam or arch of corotational finite elements: modes, static load cases, participation.

Each straight two-node element keeps its deformation in a frame that turns with its ends: stretching
½ EA/L e² with the elongation e = l − L + L (2θ₁² − θ₁θ₂ + 2θ₂²)/30, and bending
2EI/L (θ₁² + θ₁θ₂ + θ₂²), with the end rotations θ relative to the chord. Rotations may be large,
strains are small; shear is neglected. Forces and tangents are derivatives of that energy. Curved
beams are chains of straight elements.

Reference: M. A. Crisfield, Non-linear Finite Element Analysis of Solids and Structures, vol. 1
(Wiley 1991), ch. 7.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from snrmjax.condense.load_cases import ReductionBasis, StaticCases

_FEW_STEPS, _MANY_STEPS = 8, 64
_ITERATIONS = 8  # of one step: more are a sign that it went astray
_CONVERGED = 1e-9  # largest unbalanced force over the largest load
_ROUNDING = 30 * float(np.finfo(float).eps)  # of a membrane strain over displacement and length
_JUMP = 2.5  # times what the tangent predicts: a step that went to another equilibrium path
_STRAIN = 0.05  # beyond which small-strain elements no longer hold


class SupportStiffness(NamedTuple):
    """Springs at an end; infinite is held, zero free."""

    axial: float  # N/m, along the chord
    transverse: float  # N/m, across it
    rotation: float  # N m/rad


CLAMPED = SupportStiffness(np.inf, np.inf, np.inf)
PINNED = SupportStiffness(np.inf, np.inf, 0.0)
FREE = SupportStiffness(0.0, 0.0, 0.0)


class RectangularSection(NamedTuple):
    """A rectangular section and its material."""

    width: float | Array  # m
    thickness: float | Array  # m, in the plane of motion
    young: float | Array  # Pa
    density: float | Array  # kg/m³


class CorotationalBeam(eqx.Module):
    """The elements of a beam; degrees of freedom are x, y and rotation of node after node."""

    nodes: Float[Array, "node 2"]  # m; x along the chord, y across it
    axial: Float[Array, ""]  # EA, N
    bending: Float[Array, ""]  # EI, N m²
    mass: Float[Array, ""]  # per length, kg/m
    springs: Float[Array, " dof"]  # to ground at all degrees of freedom, N/m and N m/rad
    free: tuple[int, ...] = eqx.field(static=True)  # degrees of freedom that are not held

    @property
    def translations(self) -> Bool[np.ndarray, " free"]:
        """Which of the free degrees of freedom are translations."""
        return np.array(self.free) % 3 != 2

    def energy(self, displacement: Float[Array, " free"]) -> Float[Array, ""]:
        """Strain energy (J), springs included, at displacements of the free degrees of freedom."""
        every = self._every(displacement)
        v = every.reshape(-1, 3)
        ends = jnp.concatenate([v[:-1], v[1:]], axis=1)
        elements = jax.vmap(self._element)(ends, jnp.diff(self.nodes, axis=0))
        return jnp.sum(elements) + 0.5 * jnp.sum(self.springs * every**2)

    def force(self, displacement: Float[Array, " free"]) -> Float[Array, " free"]:
        """Internal forces (N, N m): the gradient of the energy."""
        return jax.grad(self.energy)(displacement)

    def tangent(self, displacement: Float[Array, " free"]) -> Float[Array, "free free"]:
        """Tangent stiffness, assembled from the elements' second derivatives."""
        v = self._every(displacement).reshape(-1, 3)
        ends = jnp.concatenate([v[:-1], v[1:]], axis=1)
        own = jax.vmap(jax.hessian(self._element))(ends, jnp.diff(self.nodes, axis=0))
        return self._assembled(own) + jnp.diag(self.springs[np.array(self.free)])

    def mass_matrix(self) -> Float[Array, "free free"]:
        """Consistent mass of the elements; rotation has none of its own (thin beams)."""
        span = jnp.diff(self.nodes, axis=0)
        return self._assembled(jax.vmap(self._element_mass)(span))

    def strain(self, displacement: Float[Array, " free"]) -> Float[Array, " element"]:
        """Membrane strain of each element."""
        v = self._every(displacement).reshape(-1, 3)
        span, stretch, _ = _deformation(
            jnp.concatenate([v[:-1], v[1:]], axis=1).T, jnp.diff(self.nodes, axis=0).T
        )
        return stretch / span

    def modes(self, numbers: Sequence[int]) -> ReductionBasis:
        """Linear modes by number, from one: mass-normalised, largest translation positive.

        Differentiable where the frequencies differ. NaN where the supports leave a mechanism.
        """
        frequency, shapes, modal = _modes(self, tuple(int(number) for number in numbers))
        moving = jnp.asarray(self.translations)
        return ReductionBasis(frequency, shapes, modal, tuple(map(int, numbers)), moving)

    def _every(self, displacement: Float[Array, " free"]) -> Float[Array, " dof"]:
        return jnp.zeros(3 * len(self.nodes)).at[np.array(self.free)].set(displacement)

    def _element(self, ends: Float[Array, " six"], span: Float[Array, " two"]) -> Float[Array, ""]:
        length, stretch, turn = _deformation(ends, span)
        first, second = ends[2] - turn, ends[5] - turn
        bent = 2 * self.bending / length * (first**2 + first * second + second**2)
        # Ends that turn against the chord bow the element: its line is longer than the chord.
        stretch = stretch + length / 30 * (2 * first**2 - first * second + 2 * second**2)
        return 0.5 * self.axial / length * stretch**2 + bent

    def _element_mass(self, span: Float[Array, " two"]) -> Float[Array, "six six"]:
        h = jnp.sqrt(jnp.sum(span**2))
        c, s = span / h
        along = jnp.array([[140.0, 70.0], [70.0, 140.0]])
        across = jnp.array(
            [
                [156.0 + 0 * h, 22 * h, 54.0 + 0 * h, -13 * h],
                [22 * h, 4 * h**2, 13 * h, -3 * h**2],
                [54.0 + 0 * h, 13 * h, 156.0 + 0 * h, -22 * h],
                [-13 * h, -3 * h**2, -22 * h, 4 * h**2],
            ]
        )
        own = jnp.zeros((6, 6)).at[np.ix_([0, 3], [0, 3])].set(along)
        own = own.at[np.ix_([1, 2, 4, 5], [1, 2, 4, 5])].set(across)
        one = jnp.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        turn = jnp.kron(jnp.eye(2), one)
        return self.mass * h / 420 * turn.T @ own @ turn

    def _assembled(self, own: Float[Array, "element six six"]) -> Float[Array, "free free"]:
        n = len(self.nodes)
        place = 3 * np.arange(n - 1)[:, None] + np.arange(6)
        matrix = jnp.zeros((3 * n, 3 * n))
        matrix = matrix.at[place[:, :, None], place[:, None, :]].add(own)
        return matrix[np.ix_(self.free, self.free)]


def _deformation(ends: Array, span: Array) -> tuple[Array, Array, Array]:
    """Length, elongation (m) and turn of the chord (rad), free of cancellation."""
    moved = ends[3:5] - ends[:2]
    length = jnp.sqrt(jnp.sum(span**2, axis=0))
    along = jnp.sum(span * moved, axis=0)
    now = jnp.sqrt(jnp.sum((span + moved) ** 2, axis=0))
    stretch = (2 * along + jnp.sum(moved**2, axis=0)) / (now + length)
    turn = jnp.arctan2(span[0] * moved[1] - span[1] * moved[0], length**2 + along)
    return length, stretch, turn


def corotational_beam(
    length: float | Array,
    section: RectangularSection,
    supports: tuple[SupportStiffness, SupportStiffness] = (CLAMPED, CLAMPED),
    *,
    elements: int = 40,
    radius: float | Array | None = None,
) -> CorotationalBeam:
    """A straight beam, or a circular arch with its crown up, of equal elements.

    Arguments: `length` of the chord in m; `supports` at x = 0 and at x = length; `radius` in m, of
    an arch below a half circle.
    Raises `ValueError` for fewer than two elements and for supports that hold nothing.

    >>> section = RectangularSection(0.01, 0.001, 2e11, 7800.0)
    >>> basis = corotational_beam(0.3, section, elements=10).modes((1, 2))
    >>> [round(float(one) / (2 * np.pi), 2) for one in basis.frequency]
    [57.84, 159.46]
    """
    if elements < 2:
        raise ValueError(f"`elements` must be at least 2, but is {elements}.")
    along = jnp.linspace(0.0, 1.0, elements + 1)
    if radius is None:
        nodes = jnp.stack([along * length, jnp.zeros(elements + 1)], axis=1)
    else:
        half = jnp.arcsin(jnp.asarray(length) / (2 * radius))
        angle = (2 * along - 1) * half
        x = radius * jnp.sin(angle) + 0.5 * length
        nodes = jnp.stack([x, radius * (jnp.cos(angle) - jnp.cos(half))], axis=1)
    springs, held = jnp.zeros(3 * (elements + 1)), []
    for end, support in ((0, supports[0]), (3 * elements, supports[1])):
        for k, stiffness in enumerate(support):
            if isinstance(stiffness, float | int) and np.isinf(stiffness):
                held.append(end + k)
            else:
                springs = springs.at[end + k].set(stiffness)
    area = jnp.asarray(section.width, dtype=float) * section.thickness
    return CorotationalBeam(
        nodes=nodes,
        axial=jnp.asarray(section.young * area),
        bending=section.young * area * jnp.asarray(section.thickness) ** 2 / 12,
        mass=section.density * area,
        springs=springs,
        free=tuple(k for k in range(3 * (elements + 1)) if k not in held),
    )


def beam_static_cases(
    beam: CorotationalBeam, basis: ReductionBasis, force: Float[Array | np.ndarray, "case mode"]
) -> StaticCases:
    """Static solutions under F = M Φ f, by Newton's method in load steps from rest.

    Cases that a few steps do not solve get many more; those that still do not converge, whose
    path snaps through on the way, or whose strain passes 5 %, are marked.

    Arguments: `force` f in kg^1/2 m/s², one row a case. Returns modal and nodal displacements and
    strain energies.
    """
    loads = jnp.asarray(force) @ basis.filter
    found = [np.array(part) for part in _solved(beam, loads, jnp.asarray(_FEW_STEPS))]
    missing = np.flatnonzero(~found[1])
    if missing.size:
        # As many rows as before: nothing is compiled for their number.
        rows = np.resize(missing, len(loads))
        again = [np.array(part) for part in _solved(beam, loads[rows], jnp.asarray(_MANY_STEPS))]
        for part, better in zip(found, again, strict=True):
            part[rows] = better
    displacement, good, energy = found
    displacement[~good] = np.nan
    return StaticCases(
        force=jnp.asarray(force),
        modal_displacement=jnp.asarray(displacement) @ basis.filter.T,
        converged=jnp.asarray(good),
        energy=jnp.asarray(np.where(good, energy, np.nan)),
        displacement=jnp.asarray(displacement),
    )


def transverse_row(beam: CorotationalBeam, fraction: float) -> Float[np.ndarray, " free"]:
    """What of a displacement is the one across the beam at a fraction of its length."""
    n = len(beam.nodes) - 1
    first = min(int(fraction * n), n - 1)
    share = fraction * n - first
    every = np.zeros(3 * (n + 1))
    every[3 * first + 1], every[3 * first + 4] = 1 - share, share
    return every[np.array(beam.free)]


def line_load(beam: CorotationalBeam) -> Float[Array, " free"]:
    """One newton across the beam, spread evenly over its length, as nodal forces."""
    span = jnp.diff(beam.nodes, axis=0)
    whole = jnp.sum(jnp.sqrt(jnp.sum(span**2, axis=1)))
    across = np.zeros(3 * len(beam.nodes))
    across[1::3] = 1.0
    # Mass times a unit acceleration of everything, supports included, is such a load.
    every = tuple(range(len(across)))
    loose = CorotationalBeam(beam.nodes, beam.axial, beam.bending, beam.mass, beam.springs, every)
    load = loose.mass_matrix() @ jnp.asarray(across) / (beam.mass * whole)
    return load[np.array(beam.free)]


@eqx.filter_jit
def _modes(beam: CorotationalBeam, numbers: tuple[int, ...]) -> tuple[Array, Array, Array]:
    """Angular frequencies, shapes and modal filter of some modes."""
    root = jnp.linalg.cholesky(beam.tangent(jnp.zeros(len(beam.free))))
    mass = beam.mass_matrix()
    reduced = jax.scipy.linalg.solve_triangular(root, jnp.linalg.cholesky(mass), lower=True)
    # Of the inverse problem, whose largest eigenvalues are the lowest modes: no round-off of the
    # stiff axial modes gets into them.
    values, vectors = jnp.linalg.eigh(reduced @ reduced.T)
    keep = -np.asarray(numbers)
    squared = 1.0 / values[keep]
    shapes = jax.scipy.linalg.solve_triangular(root.T, vectors[:, keep], lower=False)
    shapes = shapes * jnp.sqrt(squared)
    moving = jnp.where(jnp.asarray(beam.translations)[:, None], jnp.abs(shapes), 0.0)
    largest = jnp.argmax(moving, axis=0)
    shapes = shapes * jnp.sign(jnp.take_along_axis(shapes, largest[None], axis=0))
    return jnp.sqrt(squared), shapes, shapes.T @ mass


@eqx.filter_jit
def _solved(
    beam: CorotationalBeam, loads: Float[Array, "case free"], steps: Float[Array, ""]
) -> tuple[Float[Array, "case free"], Bool[Array, " case"], Float[Array, " case"]]:
    """Displacements, whether a case is solved on a stable path, and energies."""
    return jax.lax.map(partial(_one, beam, steps), loads)


def _one(
    beam: CorotationalBeam, steps: Float[Array, ""], load: Float[Array, " free"]
) -> tuple[Float[Array, " free"], Bool[Array, ""], Float[Array, ""]]:
    size = jnp.max(jnp.abs(load))

    span = jnp.sqrt(jnp.sum(jnp.diff(beam.nodes, axis=0) ** 2, axis=1))
    rounding = _ROUNDING * beam.axial / jnp.min(span)

    def allowed(x: Array) -> Array:
        return _CONVERGED * size + rounding * jnp.max(jnp.abs(x))

    def unbalanced(x: Array, fraction: Array) -> Array:
        return beam.force(x) - fraction * load

    def newton(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        x, fraction, k, _ = state
        x = x - jnp.linalg.solve(beam.tangent(x), unbalanced(x, fraction))
        return x, fraction, k + 1, jnp.max(jnp.abs(unbalanced(x, fraction)))

    def going(state: tuple[Array, Array, Array, Array]) -> Array:
        return (state[3] > allowed(state[0])) & (state[2] < _ITERATIONS) & jnp.isfinite(state[3])

    def step(k: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        before, good = carry
        fraction = (k + 1) / steps
        start = newton((before, fraction, jnp.array(0), size))
        expected = jnp.max(jnp.abs(start[0] - before))
        x, _, count, left = jax.lax.while_loop(going, newton, start)
        # One more iteration takes the round-off that the tolerance leaves.
        x = newton((x, fraction, count, left))[0]
        stable = jnp.isfinite(jnp.linalg.cholesky(beam.tangent(x))[-1, -1])
        near = jnp.max(jnp.abs(x - before)) <= _JUMP * expected
        return x, good & stable & near & (left <= allowed(x))

    x, good = jax.lax.fori_loop(0, steps, step, (jnp.zeros_like(load), jnp.array(True)))
    good = good & (jnp.max(jnp.abs(beam.strain(x))) < _STRAIN)
    return x, good, beam.energy(x)
