"""The motion of a nonlinear element in a linear structure, at measured fundamentals.

An element with the force f moves along its row, at every order h but the fundamental, as the
structure answers to that force: X_h = −R(hΩ) F_h(X). Where the fundamental X_1 is measured, these
are its own harmonics and its mean, recorded or not: a harmonic balance whose unknowns are those of
the element alone.
Reference: Krack & Gross, Harmonic Balance for Nonlinear Vibration Problems (2019), section 3.
"""

import dataclasses
from collections.abc import Callable
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

OWN_ORDERS = 13  # of an element's motion
JUMP_ORDERS = 31  # where the force jumps
_SAMPLES = 256  # of a cycle
_FINE = 1024  # of one in which the force jumps
_WIDTHS = (0.2, 0.1, 0.05, 0.02)  # of a jump, over the rms velocity, from far off to the last
_ROUNDS = 16  # of Newton's method, at most
_SETTLED = 1e-5  # of the fundamental, that a motion may still miss
_LEAST_STEP = 1 / 64  # of Newton's, below which a state is given up
_BLOCK = 32  # states in one program, so that their number compiles none anew
_QUICK = 0.2  # of what a motion missed, that a step with earlier slopes may leave


class SurroundedElement(NamedTuple):
    """What an element's motion follows from: per state, orders 0 to H along the row."""

    frequency: Float[np.ndarray, " state"]  # rad/s
    receptance: Complex[np.ndarray, "state order"]  # m/N, of the structure without the element
    motion: Complex[np.ndarray, "state order"]  # m, a first guess; its order 1 is measured
    # Of the force by the motion's other parts, from a motion nearby; None: not known.
    slopes: Float[np.ndarray, "state part free"] | None = None

    def of(self, states: Bool[np.ndarray, " state"]) -> "SurroundedElement":
        """What belongs to some of the states."""
        slopes = None if self.slopes is None else self.slopes[states]
        given = self.frequency[states], self.receptance[states], self.motion[states]
        return SurroundedElement(*given, slopes)


class ElementForces(NamedTuple):
    """Harmonics of an element's force with its own motion, orders 0 to H, and their slopes.

    The slopes are by the parameters, and by the cosine and the sine of the fundamental motion.
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
        """These forces, but those of some states as others have them, one after the other."""
        whole = ElementForces(*(part.copy() for part in self))
        for part, other in zip(whole, others, strict=True):
            part[states] = other
        return whole


class _Formula(NamedTuple):
    """A law, whose parameters are given apart, and how its force along a cycle is found."""

    effect: Any
    quick: bool = False
    at_samples: bool = False  # without exact times of contact, which take long to compile

    def law(self, values: Array) -> Any:
        """The law with its parameters."""
        names = self.effect.parameters()
        return dataclasses.replace(self.effect, **dict(zip(names, values, strict=True)))

    def basis(self, motion: Array) -> HarmonicBasis:
        """The harmonics of a motion, at samples that resolve the force."""
        n_samples = _FINE if isinstance(self.effect, CoulombFriction) else _SAMPLES
        return harmonic_basis((len(motion) - 1) // 2, n_samples)

    def parts(
        self, values: Array, motion: Float[Array, " part"], omega: Float[Array, ""]
    ) -> Float[Array, " part"]:
        """Parts of the force along a motion."""
        law, basis = self.law(values), self.basis(motion)
        x, v = _motion(basis, motion, omega)
        if self.at_samples:
            force = jax.vmap(law.force)(x, v)
        else:
            force = law.quick_cycle_force(x, v) if self.quick else law.cycle_force(x, v)
        return jnp.asarray(basis.analysis) @ force


def element_forces(
    effect: AbstractForce,
    values: Float[np.ndarray, " parameter"],
    element: SurroundedElement,
    *,
    rough: bool = False,
    exact: bool = False,
) -> ElementForces:
    """The forces of a law with its own motion at every state, by Newton's method.

    Arguments: `effect` says which law, `values` its parameters; a `rough` force has wider jumps and
    no exact times of contact; `exact` slopes are those at the motion found, others may be from
    nearby. States whose motion was not found are not `settled`: their forces are those of the
    nearest motion that was.
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
    size = np.abs(element.motion[:, 1, None])
    motion = _real_parts(element.motion)

    def along(motion: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Force, its slopes, and what the motion misses, over the fundamental."""
        force, slopes = _force_and_slopes(formula, values, motion, element.frequency)
        missed = motion[:, free] + np.einsum("sij,sj->si", receptance, force)
        return force, slopes, np.nan_to_num(missed / size, nan=1e9, posinf=1e9, neginf=-1e9)

    def by_free(motion: np.ndarray) -> np.ndarray:
        return np.nan_to_num(_slopes_by_free(formula, values, motion, element.frequency))

    force, slopes, missed = along(motion)
    steep, fresh = element.slopes, False
    step, fraction = np.zeros_like(missed), np.ones(len(motion))
    for turn in range(_ROUNDS):
        if turn:
            trial = motion.copy()
            trial[:, free] += fraction[:, None] * step
            found = along(trial)
            ratio = np.linalg.norm(found[2], axis=1) / np.linalg.norm(missed, axis=1).clip(1e-300)
            going = _misses(missed) > _SETTLED
            taken = going & (ratio < 1 - 1e-4)
            for kept, new in zip((motion, force, slopes, missed), (trial, *found), strict=True):
                kept[taken] = new[taken]
            if not fresh and np.any(ratio[going] > _QUICK):
                steep = None
            elif fresh:
                # As much less as the step promises: the next one may be twice as long.
                longer = np.minimum(2 * fraction, 1.0)
                fraction = np.where(ratio < 1 - 0.5 * fraction, longer, fraction)
                fraction = np.where(taken | ~going, fraction, 0.25 * fraction)
                steep = None if np.any(ratio[taken] > _QUICK) else steep
        going = (_misses(missed) > _SETTLED) & (fraction >= _LEAST_STEP)
        if not going.any():
            break
        fresh = steep is None
        if steep is None:
            steep = by_free(motion)
        step = -_solved(receptance, steep, missed[..., None] * size[..., None])[..., 0]
        step[~going] = 0.0
    if steep is None or exact:
        steep = by_free(motion)
    follows = -_solved(receptance, steep, receptance @ np.nan_to_num(slopes))
    whole = (slopes + steep @ follows).swapaxes(1, 2)
    by = _complex(whole).swapaxes(1, 2)
    settled = _misses(missed) <= _SETTLED
    return ElementForces(
        _complex(force), _complex(motion), by[..., 2:], by[..., :2], steep, settled
    )


def force_along(
    effect: AbstractForce, values: Float[np.ndarray, " parameter"], element: SurroundedElement
) -> Complex[np.ndarray, "state order"]:
    """Harmonics of a law's force along the motions as they are given."""
    motion = _real_parts(element.motion)
    formula = _Formula(effect, at_samples=isinstance(effect, AbstractNonsmooth))
    return _complex(_force_and_slopes(formula, values, motion, element.frequency)[0])


def _misses(missed: np.ndarray) -> np.ndarray:
    return np.max(np.abs(missed), axis=1)


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
    """Multiplication by phasors as matrices on the real parts."""
    n_states, n_orders = phasors.shape
    found = np.zeros((n_states, 2 * n_orders - 1, 2 * n_orders - 1))
    found[:, 0, 0] = phasors[:, 0].real
    a = 2 * np.arange(1, n_orders) - 1
    found[:, a, a] = found[:, a + 1, a + 1] = phasors[:, 1:].real
    found[:, a, a + 1], found[:, a + 1, a] = phasors[:, 1:].imag, -phasors[:, 1:].imag
    return found


def _force_and_slopes(
    formula: _Formula, values: np.ndarray, motion: np.ndarray, frequency: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Parts of the force, and their slopes by cosine and sine of the fundamental and by values."""
    force, slopes = _by_formulas(_some_slopes, formula, values, motion, frequency)
    return force, slopes


def _slopes_by_free(
    formula: _Formula, values: np.ndarray, motion: np.ndarray, frequency: np.ndarray
) -> np.ndarray:
    """Slopes of the force's parts by the mean and the other harmonics of the motion."""
    # Exact times of contact do not count: one program for both.
    formula = formula._replace(at_samples=False)
    return _by_formulas(_other_slopes, formula, values, motion, frequency)[0]


def _by_formulas(
    program: Callable[..., tuple], formula: _Formula, values: np.ndarray, *states: np.ndarray
) -> tuple[np.ndarray, ...]:
    """By the shorter formula where there is one; NaN of it say where it does not hold."""
    quick = formula._replace(quick=True)
    if type(formula.effect).has_quick_formula():
        found = by_blocks(lambda *some: program(quick, values, *some), _BLOCK, *states)
        if all(np.all(np.isfinite(part)) for part in found):
            return found
    return by_blocks(lambda *some: program(formula, values, *some), _BLOCK, *states)


@compiled
def _some_slopes(
    formula: _Formula,
    values: Float[Array, " parameter"],
    motion: Float[Array, "state part"],
    frequency: Float[Array, " state"],
) -> tuple[Float[Array, "state part"], Float[Array, "state part argument"]]:
    # Slopes need no exact times of contact.
    by_samples = formula._replace(at_samples=isinstance(formula.effect, AbstractNonsmooth))

    def one(motion: Array, omega: Array) -> tuple[Array, Array]:
        def force(given: Array) -> tuple[Array, Array]:
            x, of = jnp.split(given, [2])
            found = by_samples.parts(of, motion.at[1:3].set(x), omega)
            return found, found

        slopes, found = jax.jacfwd(force, has_aux=True)(jnp.concatenate([motion[1:3], values]))
        if by_samples.at_samples and not formula.at_samples:
            found = formula.parts(values, motion, omega)
        return found, slopes

    return jax.vmap(one)(motion, frequency)


@compiled
def _other_slopes(
    formula: _Formula,
    values: Float[Array, " parameter"],
    motion: Float[Array, "state part"],
    frequency: Float[Array, " state"],
) -> tuple[Float[Array, "state part free"]]:
    """By slopes at samples of forces that have them there; else by derivatives of the cycle."""
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
