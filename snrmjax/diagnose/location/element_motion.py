"""The motion of a nonlinear element in a linear structure, at measured fundamentals.

The relative displacement along an element's influence vector is, at every order h but the
fundamental, the response to its force f: X_h = −R(hΩ) F_h(X). With the fundamental X_1 measured,
this harmonic balance has the mean and the other harmonics, recorded or not, as its only unknowns.
Reference: Krack & Gross, Harmonic Balance for Nonlinear Vibration Problems (2019), section 3.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from snrmjax.model.effect_base import AbstractForce, AbstractMemoryless, AbstractNonsmooth
from snrmjax.model.library.friction import CoulombFriction
from snrmjax.numerics.blocks import by_blocks
from snrmjax.numerics.compiled import compiled
from snrmjax.simulate.balance.harmonics import HarmonicBasis, harmonic_basis, tangent_blocks

OWN_ORDERS = 13  # orders of an element's motion
JUMP_ORDERS = 31  # for forces with jumps
_SAMPLES = 256  # a cycle
_FINE = 1024  # a cycle with force jumps
_WIDTHS = (0.2, 0.1, 0.05, 0.02)  # smoothing of jumps over the rms velocity, by continuation
_ROUNDS = 16  # most iterations of Newton's method
_SETTLED = 1e-5  # tolerated residual over the fundamental
_LEAST_STEP = 1 / 64  # fraction of a Newton step below which a state is given up
_BLOCK = 32  # states a program: a fixed number avoids recompilation
_QUICK = 0.2  # ratio of residuals above which the slopes are recomputed


class SurroundedElement(NamedTuple):
    """Data of an element's harmonic balance: by state, for orders 0 to H of its own motion."""

    frequency: Float[np.ndarray, " state"]  # rad/s
    receptance: Complex[np.ndarray, "state order"]  # m/N, of the structure without the element
    motion: Complex[np.ndarray, "state order"]  # m, initial guess; order 1 is measured
    # Of the force by the free parts of the motion, from a nearby motion; None: not known.
    slopes: Float[np.ndarray, "state part free"] | None = None

    def of(self, states: Bool[np.ndarray, " state"]) -> "SurroundedElement":
        """The data of some of the states."""
        slopes = None if self.slopes is None else self.slopes[states]
        given = self.frequency[states], self.receptance[states], self.motion[states]
        return SurroundedElement(*given, slopes)


class ElementForces(NamedTuple):
    """Harmonics of an element's force at its solved motion, orders 0 to H, with derivatives.

    By the parameters, and by the cosine and the sine of the fundamental motion.
    """

    force: Complex[np.ndarray, "state order"]
    motion: Complex[np.ndarray, "state order"]
    by_parameter: Complex[np.ndarray, "state order parameter"]
    by_motion: Complex[np.ndarray, "state order 2"]
    slopes: Float[np.ndarray, "state part free"]  # see `SurroundedElement`
    settled: Bool[np.ndarray, " state"]

    def with_states(
        self, states: Bool[np.ndarray, " state"], others: "ElementForces"
    ) -> "ElementForces":
        """These forces, with those of some states replaced by others, in order."""
        whole = ElementForces(*(part.copy() for part in self))
        for part, other in zip(whole, others, strict=True):
            part[states] = other
        return whole


class _Formula(NamedTuple):
    """A law with separate parameters, and how its force over a cycle is evaluated."""

    effect: Any
    at_samples: bool = False  # without exact contact times, which take long to compile

    def law(self, values: Array) -> Any:
        """The law with these parameters."""
        names = self.effect.parameters()
        return dataclasses.replace(self.effect, **dict(zip(names, values, strict=True)))

    def basis(self, motion: Array) -> HarmonicBasis:
        """The harmonics of a motion, at samples that resolve the force."""
        n_samples = _FINE if isinstance(self.effect, CoulombFriction) else _SAMPLES
        return harmonic_basis((len(motion) - 1) // 2, n_samples)

    def parts(
        self, values: Array, motion: Float[Array, " part"], omega: Float[Array, ""]
    ) -> Float[Array, " part"]:
        """Real Fourier coefficients of the force along a motion."""
        law, basis = self.law(values), self.basis(motion)
        x, v = _motion(basis, motion, omega)
        force = jax.vmap(law.force)(x, v) if self.at_samples else law.cycle_force(x, v)
        return jnp.asarray(basis.analysis) @ force


def element_forces(
    effect: AbstractForce,
    values: Float[np.ndarray, " parameter"],
    element: SurroundedElement,
    *,
    rough: bool = False,
    exact: bool = False,
) -> ElementForces:
    """The forces of a law at the element's motion in every state, by Newton's method.

    Arguments: `effect`: the law; `values`: its parameters; `rough`: smoother jumps and no exact
    contact times; `exact`: slopes at the solution, in place of possibly nearby ones. States that
    did not converge are not `settled`: their forces are those of the last iterate.
    """
    if isinstance(effect, CoulombFriction):
        *far, last = _WIDTHS[:-1] if rough else _WIDTHS
        for width in far if element.slopes is None else ():
            nearby = _solved_motion(_Formula(_with_width(effect, width)), values, element)
            element = element._replace(motion=nearby.motion)
        effect = _with_width(effect, last)
    formula = _Formula(effect, at_samples=rough and isinstance(effect, AbstractNonsmooth))
    return _solved_motion(formula, values, element, exact=exact)


def _with_width(effect: CoulombFriction, width: float) -> CoulombFriction:
    return dataclasses.replace(effect, smoothing=jnp.asarray(width))


def _solved_motion(
    formula: _Formula,
    values: Float[np.ndarray, " parameter"],
    element: SurroundedElement,
    *,
    exact: bool = False,
) -> ElementForces:
    n_parts = 2 * element.motion.shape[1] - 1
    free = np.delete(np.arange(n_parts), [1, 2])
    receptance = _products(element.receptance)[:, free]
    amplitude = np.abs(element.motion[:, 1, None])
    motion = _real_parts(element.motion)

    def along(motion: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Force, its slopes, and the residual over the fundamental."""
        force, slopes = _force_and_slopes(formula, values, motion, element.frequency)
        residual = motion[:, free] + np.einsum("sij,sj->si", receptance, force)
        return force, slopes, np.nan_to_num(residual / amplitude, nan=1e9, posinf=1e9, neginf=-1e9)

    def by_free(motion: np.ndarray) -> np.ndarray:
        return np.nan_to_num(_slopes_by_free(formula, values, motion, element.frequency))

    force, slopes, residual = along(motion)
    tangent, fresh = element.slopes, False
    step, fraction = np.zeros_like(residual), np.ones(len(motion))
    for iteration in range(_ROUNDS):
        if iteration:
            trial = motion.copy()
            trial[:, free] += fraction[:, None] * step
            tried = along(trial)
            ratio = np.linalg.norm(tried[2], axis=1) / np.linalg.norm(residual, axis=1).clip(1e-300)
            going = _largest(residual) > _SETTLED
            taken = going & (ratio < 1 - 1e-4)
            for kept, new in zip((motion, force, slopes, residual), (trial, *tried), strict=True):
                kept[taken] = new[taken]
            if not fresh and np.any(ratio[going] > _QUICK):
                tangent = None
            elif fresh:
                # Sufficient decrease for the step fraction: double it, else take a quarter.
                longer = np.minimum(2 * fraction, 1.0)
                fraction = np.where(ratio < 1 - 0.5 * fraction, longer, fraction)
                fraction = np.where(taken | ~going, fraction, 0.25 * fraction)
                tangent = None if np.any(ratio[taken] > _QUICK) else tangent
        going = (_largest(residual) > _SETTLED) & (fraction >= _LEAST_STEP)
        if not going.any():
            break
        fresh = tangent is None
        if tangent is None:
            tangent = by_free(motion)
        step = -_solved(receptance, tangent, residual[..., None] * amplitude[..., None])[..., 0]
        step[~going] = 0.0
    if tangent is None or exact:
        tangent = by_free(motion)
    follows = -_solved(receptance, tangent, receptance @ np.nan_to_num(slopes))
    whole = (slopes + tangent @ follows).swapaxes(1, 2)
    by = _complex(whole).swapaxes(1, 2)
    settled = _largest(residual) <= _SETTLED
    return ElementForces(
        _complex(force), _complex(motion), by[..., 2:], by[..., :2], tangent, settled
    )


def force_along(
    effect: AbstractForce, values: Float[np.ndarray, " parameter"], element: SurroundedElement
) -> Complex[np.ndarray, "state order"]:
    """Harmonics of a law's force along given motions."""
    motion = _real_parts(element.motion)
    formula = _Formula(effect, at_samples=isinstance(effect, AbstractNonsmooth))
    return _complex(_force_and_slopes(formula, values, motion, element.frequency)[0])


def _largest(residual: np.ndarray) -> np.ndarray:
    return np.max(np.abs(residual), axis=1)


def _solved(receptance: np.ndarray, slopes: np.ndarray, right: np.ndarray) -> np.ndarray:
    return np.linalg.solve(np.eye(receptance.shape[1]) + receptance @ slopes, right)


def _real_parts(phasors: Complex[np.ndarray, "state order"]) -> Float[np.ndarray, "state part"]:
    """Mean, cosine and sine of each order, as a `HarmonicBasis` has them: Re Z e^{ihτ}."""
    parts = np.stack([phasors.real, -phasors.imag], axis=2).reshape(len(phasors), -1)
    return np.delete(parts, 1, axis=1)


def _complex(parts: Float[np.ndarray, "*batch part"]) -> Complex[np.ndarray, "*batch order"]:
    higher = parts[..., 1::2] - 1j * parts[..., 2::2]
    return np.concatenate([parts[..., :1] + 0j, higher], axis=-1)


def _products(phasors: Complex[np.ndarray, "state order"]) -> Float[np.ndarray, "state part part"]:
    """Multiplication by phasors, as matrices on the real Fourier coefficients."""
    n_states, n_orders = phasors.shape
    matrices = np.zeros((n_states, 2 * n_orders - 1, 2 * n_orders - 1))
    matrices[:, 0, 0] = phasors[:, 0].real
    a = 2 * np.arange(1, n_orders) - 1
    matrices[:, a, a] = matrices[:, a + 1, a + 1] = phasors[:, 1:].real
    matrices[:, a, a + 1], matrices[:, a + 1, a] = phasors[:, 1:].imag, -phasors[:, 1:].imag
    return matrices


def _force_and_slopes(
    formula: _Formula, values: np.ndarray, motion: np.ndarray, frequency: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Fourier coefficients of the force, with derivatives by X_1 (cos, sin) and by parameters."""
    force, slopes = by_blocks(
        lambda *some: _some_slopes(formula, values, *some), _BLOCK, motion, frequency
    )
    return force, slopes


def _slopes_by_free(
    formula: _Formula, values: np.ndarray, motion: np.ndarray, frequency: np.ndarray
) -> np.ndarray:
    """Derivatives of the force by the mean and the other harmonics of the motion."""
    # The same with and without exact contact times: one program for both.
    formula = formula._replace(at_samples=False)
    return by_blocks(
        lambda *some: _other_slopes(formula, values, *some), _BLOCK, motion, frequency
    )[0]


@compiled
def _some_slopes(
    formula: _Formula,
    values: Float[Array, " parameter"],
    motion: Float[Array, "state part"],
    frequency: Float[Array, " state"],
) -> tuple[Float[Array, "state part"], Float[Array, "state part argument"]]:
    # Derivatives need no exact contact times.
    by_samples = formula._replace(at_samples=isinstance(formula.effect, AbstractNonsmooth))

    def one(motion: Array, omega: Array) -> tuple[Array, Array]:
        def force(given: Array) -> tuple[Array, Array]:
            x, of = jnp.split(given, [2])
            parts = by_samples.parts(of, motion.at[1:3].set(x), omega)
            return parts, parts

        slopes, parts = jax.jacfwd(force, has_aux=True)(jnp.concatenate([motion[1:3], values]))
        if by_samples.at_samples and not formula.at_samples:
            parts = formula.parts(values, motion, omega)
        return parts, slopes

    return jax.vmap(one)(motion, frequency)


@compiled
def _other_slopes(
    formula: _Formula,
    values: Float[Array, " parameter"],
    motion: Float[Array, "state part"],
    frequency: Float[Array, " state"],
) -> tuple[Float[Array, "state part free"]]:
    """From tangents at samples for forces that have them, else by differentiating the cycle."""
    free = np.delete(np.arange(motion.shape[1]), [1, 2])

    def of_samples(motion: Array, omega: Array) -> Array:
        law, basis = formula.law(values), formula.basis(motion)
        x, v = _motion(basis, motion, omega)
        if isinstance(law, CoulombFriction):
            law = law.scaled_for(jnp.max(x), jnp.sqrt(jnp.mean(v**2)))

        def force(x: Array, v: Array) -> Array:
            if isinstance(law, AbstractMemoryless):
                return law.force(x, v)
            return law.state_force(x, v, law.initial_states())

        by_x, by_v = jax.vmap(jax.grad(force, argnums=(0, 1)))(x, v)
        stiffness, damping = (tangent_blocks(basis, part) for part in (by_x, by_v))
        return (stiffness + damping @ (omega * basis.derivative))[:, free]

    def of_cycle(motion: Array, omega: Array) -> Array:
        def force(x: Array) -> Array:
            return formula.parts(values, motion.at[free].set(x), omega)

        return jax.jacfwd(force)(motion[free])

    has_slopes = isinstance(formula.effect, AbstractMemoryless | CoulombFriction)
    return (jax.vmap(of_samples if has_slopes else of_cycle)(motion, frequency),)


def _motion(basis: HarmonicBasis, motion: Array, omega: Array) -> tuple[Array, Array]:
    """x and ẋ at samples of a cycle."""
    rate = jnp.asarray(basis.synthesis @ basis.derivative)
    return jnp.asarray(basis.synthesis) @ motion, omega * (rate @ motion)
