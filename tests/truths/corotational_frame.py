"""A plane frame of corotational beam elements, by its strain energy: finite elements for tests.

Each element keeps its small deformation in a frame that turns with its ends: stretching
½ EA/L e², e = l − L + L (2θ₁² − θ₁θ₂ + 2θ₂²)/30, and bending 2EI/L (θ₁² + θ₁θ₂ + θ₂²), with the end
rotations θ relative to the chord. Forces and tangents are derivatives of the energy. Reference:
M. A. Crisfield, Non-linear Finite Element Analysis of Solids and Structures, vol. 1 (1991), ch. 7.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg


class Frame(NamedTuple):
    nodes: np.ndarray  # (node, 2), m
    elements: np.ndarray  # (element, 2), node numbers
    axial: float  # EA, N
    bending: float  # EI, N m²
    mass: float  # per length, kg/m
    fixed: tuple[int, ...]  # degrees of freedom, 3 node + (0: x, 1: y, 2: rotation)
    springs: dict[int, float] | None = None  # to ground, N/m or N m/rad

    @property
    def free(self):
        return np.setdiff1d(np.arange(3 * len(self.nodes)), self.fixed)


def rectangle(width, thickness, young, density):
    """EA, EI and mass per length of a rectangular section."""
    area = width * thickness
    return young * area, young * area * thickness**2 / 12, density * area


def energy(u, frame):
    """Strain energy (J) of displacements of all degrees of freedom."""
    first, second = frame.elements.T
    d0 = jnp.asarray(frame.nodes[second] - frame.nodes[first])
    v = u.reshape(-1, 3)
    du = v[second, :2] - v[first, :2]
    length = jnp.sqrt(jnp.sum(d0**2, axis=1))
    now = jnp.sqrt(jnp.sum((d0 + du) ** 2, axis=1))
    stretch = (2 * jnp.sum(d0 * du, axis=1) + jnp.sum(du**2, axis=1)) / (now + length)
    across = d0[:, 0] * du[:, 1] - d0[:, 1] * du[:, 0]
    turn = jnp.arctan2(across, length**2 + jnp.sum(d0 * du, axis=1))
    a, b = v[first, 2] - turn, v[second, 2] - turn
    # Ends that turn against the chord bow the element: its line is longer than the chord.
    stretch = stretch + length / 30 * (2 * a**2 - a * b + 2 * b**2)
    bent = 2 * frame.bending / length * (a**2 + a * b + b**2)
    held = sum(0.5 * k * u[dof] ** 2 for dof, k in (frame.springs or {}).items())
    return jnp.sum(0.5 * frame.axial / length * stretch**2 + bent) + held


def mass_matrix(frame):
    """Consistent mass of straight elements, all degrees of freedom."""
    m = np.zeros((3 * len(frame.nodes),) * 2)
    for first, second in frame.elements:
        d = frame.nodes[second] - frame.nodes[first]
        length = np.hypot(*d)
        c, s = d / length
        own = np.zeros((6, 6))
        own[np.ix_([0, 3], [0, 3])] = np.array([[140, 70], [70, 140]])
        h = length
        own[np.ix_([1, 2, 4, 5], [1, 2, 4, 5])] = [
            [156, 22 * h, 54, -13 * h],
            [22 * h, 4 * h * h, 13 * h, -3 * h * h],
            [54, 13 * h, 156, -22 * h],
            [-13 * h, -3 * h * h, -22 * h, 4 * h * h],
        ]
        turn = np.kron(np.eye(2), np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]))
        dofs = np.r_[3 * first : 3 * first + 3, 3 * second : 3 * second + 3]
        m[np.ix_(dofs, dofs)] += frame.mass * length / 420 * turn.T @ own @ turn
    return m


class Model:
    """A frame with its linear modes and its statics; all at the free degrees of freedom."""

    def __init__(self, frame, modes):
        self.frame, self.free = frame, frame.free
        size = 3 * len(frame.nodes)

        def of_free(x):
            return energy(jnp.zeros(size).at[self.free].set(x), frame)

        self.energy = of_free
        self.mass = mass_matrix(frame)[np.ix_(self.free, self.free)]
        stiffness = np.asarray(jax.hessian(of_free)(jnp.zeros(self.free.size)))
        squared, shapes = scipy.linalg.eigh(stiffness, self.mass)
        keep = [number - 1 for number in modes]
        self.frequency, self.shapes = np.sqrt(squared[keep]), shapes[:, keep]
        self.translations = self.free % 3 != 2
        largest = np.argmax(np.abs(self.shapes) * self.translations[:, None], axis=0)
        self.shapes = self.shapes * np.sign(self.shapes[largest, np.arange(len(keep))])
        self.filter = self.shapes.T @ self.mass
        self._solve = jax.jit(jax.vmap(partial(self._case, 10, 8)))

    def _case(self, steps, iterations, load):
        def step(x, fraction):
            for _ in range(iterations):
                rest = jax.grad(self.energy)(x) - fraction * load
                x = x - jnp.linalg.solve(jax.hessian(self.energy)(x), rest)
            return x, None

        x, _ = jax.lax.scan(step, jnp.zeros_like(load), jnp.arange(1, steps + 1) / steps)
        left = jnp.max(jnp.abs(jax.grad(self.energy)(x) - load)) / jnp.max(jnp.abs(load))
        return x, left, self.energy(x)

    def solve(self, force):
        """(u, residual over load, energy) of load cases with modal forces f: loads M Φ f."""
        return tuple(np.asarray(part) for part in self._solve(np.asarray(force) @ self.filter))
