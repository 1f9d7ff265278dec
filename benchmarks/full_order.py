"""All finite elements of a beam in periodic motion: harmonic balance.

M ü + C u̇ + f(u) = p cos Ωt for u = Σ_h a_h cos hΩt + b_h sin hΩt, with f the elements' internal
force at samples of the period (alternating frequency-time). It shares the elements with a
condensation, but neither modes, potential nor solver. Used by `rom_forced_response.py`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import snrmjax as sj
from snrmjax.condense.elements.strain_energy import internal_force, mass_matrix, tangent_stiffness

ORDER, SAMPLES = 9, 40  # exact for a cubic force
FLAT = sj.condense.Beam(0.2286, 0.0127, 0.787e-3, young=204.8e9, density=7870.0, elements=20)
CURVED = sj.condense.Beam(
    *(0.3048, 0.0127, 0.508e-3),
    rise=sj.condense.rise_of_radius(0.3048, 11.43),
    young=204e9,
    density=7860.0,
    elements=20,
)
_ITERATIONS, _SETTLED = 12, 1e-9


class Waves(NamedTuple):
    """Functions of the period that a motion is made of, at samples of it."""

    value: np.ndarray  # (function, sample)
    weight: np.ndarray  # (function, sample): coefficients from samples
    first: np.ndarray  # (function, function): coefficients of the derivative by Ωt
    second: np.ndarray


class Motion(NamedTuple):
    """A balanced motion; `moved` is the last correction over the motion, NaN where it failed."""

    coefficients: jax.Array  # (function, free degree of freedom)
    frequency: jax.Array  # rad/s
    moved: jax.Array


def cosines_and_sines() -> Waves:
    """cos hΩt, h = 0…`ORDER`, then sin hΩt, h = 1…`ORDER`."""
    orders, h = np.arange(ORDER + 1), np.arange(1, ORDER + 1)
    phase = 2 * np.pi * np.arange(SAMPLES) / SAMPLES
    value = np.concatenate([np.cos(orders[:, None] * phase), np.sin(h[:, None] * phase)])
    weight = 2 * value / SAMPLES
    weight[0] /= 2
    first = np.zeros((2 * ORDER + 1, 2 * ORDER + 1))
    first[h, ORDER + h], first[ORDER + h, h] = h, -h
    return Waves(value, weight, first, first @ first)


class Closing(NamedTuple):
    """The equation that fixes the frequency: Σ row ∘ coefficients = value."""

    row: jax.Array  # (function, free degree of freedom)
    value: float


@eqx.filter_jit
def balanced(
    beam: sj.condense.Beam,
    damping: jax.Array,
    load: jax.Array,
    waves: Waves,
    start: tuple[jax.Array, jax.Array],
    closing: Closing,
) -> Motion:
    """Newton's method on all coefficients and the frequency.

    Arguments: `damping` C and `load` p of the degrees of freedom that are not held (kg/s, N);
    `start` coefficients (m, rad) and frequency (rad/s).
    """
    mass = free_mass(beam)
    n, count = mass.shape[0], len(waves.value)
    force = jnp.zeros((count, n)).at[1].set(load)

    def step(carry):
        c, omega, _, k = carry
        u = waves.value.T @ c
        internal = jax.vmap(lambda one: free_force(beam, one))(u)
        tangent = jax.vmap(lambda one: free_tangent(beam, one))(u)
        inertia, drag = waves.second @ c @ mass, waves.first @ c @ damping
        residual = waves.weight @ internal + omega**2 * inertia + omega * drag - force
        jacobian = jnp.einsum("hs,gs,sij->higj", waves.weight, waves.value, tangent)
        jacobian += jnp.einsum("hg,ij->higj", omega**2 * waves.second, mass)
        jacobian += jnp.einsum("hg,ij->higj", omega * waves.first, damping)
        size = n * count
        by_omega = (2 * omega * inertia + drag).reshape(size, 1)
        top = jnp.concatenate([jacobian.reshape(size, size), by_omega], axis=1)
        matrix = jnp.concatenate([top, jnp.append(closing.row.ravel(), 0.0)[None]])
        missing = jnp.sum(closing.row * c) - closing.value
        change = jnp.linalg.solve(matrix, jnp.append(residual.ravel(), missing))
        new = c - change[:-1].reshape(c.shape)
        moved = jnp.max(jnp.abs(change[:-1])) / jnp.max(jnp.abs(new))
        return new, omega - change[-1], moved, k + 1

    def goes_on(carry):
        return (carry[3] < _ITERATIONS) & ~(carry[2] < _SETTLED)

    begin = (*start, jnp.array(jnp.inf), jnp.array(0))
    return Motion(*jax.lax.while_loop(goes_on, step, begin)[:3])


def _all(beam: sj.condense.Beam, u: jax.Array) -> jax.Array:
    """All degrees of freedom from those that are not held."""
    return jnp.zeros(beam.n_dof).at[beam.free].set(u)


def free_force(beam: sj.condense.Beam, u: jax.Array) -> jax.Array:
    """Internal force on the degrees of freedom that are not held."""
    return internal_force(beam, _all(beam, u))[beam.free]


def free_tangent(beam: sj.condense.Beam, u: jax.Array) -> jax.Array:
    """Tangent stiffness of the degrees of freedom that are not held."""
    return tangent_stiffness(beam, _all(beam, u))[beam.free[:, None], beam.free]


def free_mass(beam: sj.condense.Beam) -> jax.Array:
    """Mass matrix of the degrees of freedom that are not held."""
    return mass_matrix(beam)[beam.free[:, None], beam.free]


def condensed(
    beam: sj.condense.Beam, modes: Sequence[int], damping_ratio: np.ndarray
) -> sj.model.Structure:
    """A beam condensed by the package's own rule, with a sensor at midspan and a uniform force."""
    basis = sj.condense.beam_modes(beam, modes)

    def solve(force):
        return sj.condense.static_cases(beam, basis, force)

    wanted = sj.condense.displacement_for_ratio(basis, solve, start=float(beam.thickness) / 4)
    found = sj.condense.condense(basis, solve(sj.condense.modal_loads(basis, wanted).force))
    return found.structure(
        damping_ratio,
        sensors={"midspan": sj.condense.shape_at(beam, basis, 0.5)},
        participation=np.asarray(sj.condense.participation(beam, basis)),
    )
