"""A structure: linear modes, a polynomial potential and further effects."""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.model.effect_base import (
    AbstractAddedMode,
    AbstractEffect,
    AbstractForce,
    AbstractForceSpectrum,
    AbstractHysteresis,
    AbstractLinearChange,
    AbstractMeasurementEffect,
    AbstractMemoryless,
    checked_effects,
)
from snrmjax.model.elements import Elements, elements_of
from snrmjax.model.modes import LinearModes, have_values
from snrmjax.model.places import row_text, unit_at
from snrmjax.model.potential import PolynomialPotential, polynomial_potential
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.result import AbstractShown
from snrmjax.numerics.units import unit_in_print

_FLAT = 1e-9  # of the largest slope of a structure's force at rest, what counts as none


def _number(value: float = 0.0) -> Array:
    return jax.device_put(np.asarray(value, dtype=float))  # by `jnp.asarray` it would compile


class LinearTerms(NamedTuple):
    """The linear part m q̈ + d q̇ + k q of every modal equation, linear changes included."""

    mass: Float[Array, " mode"]  # relative to the modal mass
    damping: Float[Array, " mode"]  # 1/s
    stiffness: Float[Array, " mode"]  # 1/s²
    coupling: Float[Array, "mode mode"] | None = None  # further damping, between modes, 1/s

    def damped(self, rate: Float[Array, "*batch mode"]) -> Float[Array, "*batch mode"]:
        """The damping force of velocities."""
        own = self.damping * rate
        return own if self.coupling is None else own + rate @ self.coupling.T

    def damping_matrix(self) -> Float[Array, "mode mode"]:
        """The whole damping matrix."""
        own = jnp.diag(self.damping)
        return own if self.coupling is None else own + self.coupling


class Structure(AbstractShown):
    """q̈ + 2ζωq̇ + ω²q + ∂V/∂q + Σ effects = Φᵀb F(t), in modal coordinates q (kg^1/2 m).

    A force f at points acts on x = (bΦ)q and adds (bΦ)ᵀ f(x, ẋ); one on the mode of interest adds
    f(q, q̇) to that mode.

    `level_gain_std` (relative) and `level_phase_std` (rad) are 1σ errors that all measurements
    of one level share; `level_frequency_std` (rad/s) and `level_damping_std` (of the damping ratio)
    are the run-to-run variability of the mode of interest itself, as bolted joints have it. They
    belong to the test set-up and are kept in the model file. `test_order` is the place of the
    motion in the test, from 0 (first state) to 1 (last), for effects that drift.
    """

    modes: LinearModes
    potential: PolynomialPotential
    effects: tuple[AbstractEffect, ...] = eqx.field(default=(), converter=checked_effects)
    level_gain_std: Float[Array, ""] = eqx.field(default_factory=_number)
    level_phase_std: Float[Array, ""] = eqx.field(default_factory=_number)
    level_frequency_std: Float[Array, ""] = eqx.field(default_factory=_number)
    level_damping_std: Float[Array, ""] = eqx.field(default_factory=_number)
    test_order: Float[Array, ""] = eqx.field(default_factory=_number)
    name: str = eqx.field(static=True, default="structure")

    def has_screen(self) -> bool:
        """Whether this is one structure, with values."""
        return have_values(self) and not self.test_order.ndim

    def summary(self) -> tuple[str, ...]:
        """Name, modes, potential, effects, errors."""
        monomials = self.potential.monomials
        terms = f"{len(monomials)} terms to degree {self.potential.degree}" if monomials else "none"
        of_modes, *modes = self.modes.summary()
        lines = [f"Structure {self.name!r}", of_modes, *(f"  {mode}" for mode in modes)]
        lines.append(f"polynomial potential: {terms}")
        for effect in self.effects:
            rows = effect.rows if isinstance(effect, AbstractForce) else (None,)
            values = [
                f"{name} {_text(getattr(effect, name))} {unit}".rstrip()
                for name, of in effect.parameters().items()
                for unit in [unit_in_print(unit_at(rows[0], of.unit))]
            ]
            texts = [row_text(row) for row in rows if row is not None]
            where = f" at {', pressed at '.join(texts)}" if texts else ""
            lines.append(f"effect {effect.kind}{where}: {', '.join(values)}")
        names = ("relative gain", "phase (rad)", "natural frequency (rad/s)", "damping ratio")
        stated = [f"{n} {s:.3g}" for n, s in zip(names, self.level_stds, strict=True) if s > 0]
        if stated:
            lines.append(f"1σ between levels: {', '.join(stated)}")
        return tuple(lines)

    @property
    def level_stds(self) -> tuple[float, float, float, float]:
        """1σ that the states of a level share: of gain, phase, natural frequency and damping."""
        return (
            *(float(self.level_gain_std), float(self.level_phase_std)),
            *(float(self.level_frequency_std), float(self.level_damping_std)),
        )

    @property
    def n_modes(self) -> int:
        """Number of flexible modes."""
        return self.modes.n_modes

    @property
    def own_mode(self) -> Float[np.ndarray, " mode"]:
        """One for the mode of interest, zero for the others: adds a force to that mode alone."""
        # Multiplying is faster than writing to an entry, of which a `vmap` makes a loop.
        return np.eye(self.n_modes)[self.modes.mode_of_interest]

    @property
    def forces(self) -> tuple[AbstractForce, ...]:
        """The effects that are forces."""
        return tuple(e for e in self.effects if isinstance(e, AbstractForce))

    @property
    def memoryless(self) -> tuple[AbstractMemoryless, ...]:
        """The effects whose force depends on the present state alone."""
        return tuple(e for e in self.effects if isinstance(e, AbstractMemoryless))

    @property
    def hysteretic(self) -> tuple[AbstractHysteresis, ...]:
        """The effects whose force over a cycle needs the whole cycle: friction."""
        return tuple(e for e in self.effects if isinstance(e, AbstractHysteresis))

    @property
    def measurement_effects(self) -> tuple[AbstractMeasurementEffect, ...]:
        """The effects that change what is recorded, in the order in which they act."""
        effects = [e for e in self.effects if isinstance(e, AbstractMeasurementEffect)]
        return tuple(sorted(effects, key=lambda effect: effect.stage))

    def linear_terms(self) -> LinearTerms:
        """Mass 1, damping 2ζω and stiffness ω² of every mode, with the linear changes."""
        modes, j = self.modes, self.modes.mode_of_interest
        frequency, ratio, on_mode = modes.natural_frequency, modes.damping_ratio, self.own_mode
        mass, damping, stiffness = jnp.ones(self.n_modes), 2 * ratio * frequency, frequency**2
        for effect in self.effects:
            if isinstance(effect, AbstractLinearChange):
                added = effect.linear_terms(frequency[j], ratio[j], self.test_order)
                mass, damping, stiffness = (
                    mass + on_mode * added[0],
                    damping + on_mode * added[1],
                    stiffness + on_mode * added[2],
                )
        return LinearTerms(mass, damping, stiffness, modes.damping_coupling)

    def load_orders(self) -> Float[Array, " order"]:
        """Cosine amplitudes of the force's harmonics 0 to 3, relative to its fundamental."""
        fundamental = jnp.array([0.0, 1.0, 0.0, 0.0])
        orders = fundamental
        for effect in self.effects:
            if isinstance(effect, AbstractForceSpectrum):
                orders = orders + (effect.load_orders() - fundamental)
        return orders

    def nonlinear_force(
        self, displacement: Float[Array, "time mode"], velocity: Float[Array, "time mode"]
    ) -> Float[Array, "time mode"]:
        """Nonlinear modal force ∂V/∂q + Σ effects over a steady cycle, in kg^1/2 m/s².

        Arguments: equally spaced samples of one period.
        """
        force = self.potential.force(displacement)
        if not self.forces:
            return force
        elements, *motion = self._at_places(self.forces, displacement, velocity)
        return force + elements.on_modes(elements.cycle_force(*motion))

    def memoryless_force(
        self, displacement: Float[Array, "time mode"], velocity: Float[Array, "time mode"]
    ) -> Float[Array, "time mode"]:
        """The part of `nonlinear_force` without friction, at any samples, in kg^1/2 m/s²."""
        force = self.potential.force(displacement)
        if not self.memoryless:
            return force
        elements, *motion = self._at_places(self.memoryless, displacement, velocity)
        return force + elements.on_modes(elements.force(*motion))

    def _at_places(
        self, forces: Sequence[AbstractForce], displacement: Array, velocity: Array
    ) -> tuple[Elements, Array, Array]:
        """Forces where they act, and the displacements and velocities there."""
        elements = elements_of(forces, self.modes)
        return elements, elements.displacement(displacement), elements.displacement(velocity)

    def potential_energy(self, displacement: Float[Array, "*batch mode"]) -> Float[Array, "*batch"]:
        """Energy in J of a structure held at rest: linear, polynomial and of memoryless effects.

        The effects' part is the work ∫ f(s, 0) ds from zero, by Gauss's rule with 64 points:
        exact for a polynomial force, to about 1e-4 of it where the force has a kink. The elastic
        energy of friction elements is not included.
        """
        linear = 0.5 * (displacement**2 @ self.linear_terms().stiffness)
        energy = linear + self.potential.energy(displacement)
        if not self.memoryless:
            return energy
        node, weight = np.polynomial.legendre.leggauss(64)
        elements = elements_of(self.memoryless, self.modes)
        x = elements.displacement(displacement)
        path = (0.5 * (jnp.asarray(node) + 1))[:, None] * x[..., None, :]
        values = elements.force(flat := path.reshape(-1, elements.n_places), jnp.zeros_like(flat))
        mean = jnp.tensordot(values.reshape(path.shape), 0.5 * jnp.asarray(weight), ([-2], [0]))
        return energy + jnp.sum(x * mean, axis=-1)

    def slopes(
        self, displacement: Float[Array, "time mode"], velocity: Float[Array, "time mode"]
    ) -> tuple[Float[Array, "time mode mode"], Float[Array, "time mode mode"]]:
        """∂(force)/∂q in 1/s² and ∂(force)/∂q̇ in 1/s: potential and memoryless effects."""
        stiffness = self.potential.stiffness(displacement)
        if not self.memoryless:
            return stiffness, jnp.zeros_like(stiffness)
        elements, *motion = self._at_places(self.memoryless, displacement, velocity)
        by = elements.slopes(*motion)
        return stiffness + elements.matrix(by.stiffness), elements.matrix(by.damping)


@compiled
def linear_terms_of(model: Structure) -> LinearTerms:
    """`Structure.linear_terms` as one program, for the host."""
    return model.linear_terms()


def modes_of(model: Structure | LinearModes) -> LinearModes:
    """The linear modes of a structure; linear modes themselves as they are."""
    return model.modes if isinstance(model, Structure) else model


def _text(value: Array) -> str:
    return f"{float(value):.6g}" if value.ndim == 0 else f"of shape {value.shape}"


def structure(
    modes: LinearModes,
    potential: PolynomialPotential | None = None,
    *,
    effects: AbstractEffect | Iterable[AbstractEffect] = (),
    level_gain_std: float = 0.0,
    level_phase_std: float = 0.0,
    level_frequency_std: float = 0.0,
    level_damping_std: float = 0.0,
    name: str = "structure",
) -> Structure:
    """Build a `Structure`; without a potential it is linear but for its effects.

    Arguments: `effects` one or several, whose parameters may be plain numbers; `level_gain_std`
    relative, `level_phase_std` in rad, `level_frequency_std` in rad/s, `level_damping_std` of the
    damping ratio.
    Raises `ValueError` when potential and modes disagree about the number of modes, for what is no
    effect, such as a class whose parameters are not given, and for a force at an unknown point.
    """
    if potential is None:
        potential = polynomial_potential({}, modes.n_modes)
    if potential.n_modes != modes.n_modes:
        raise ValueError(
            f"`potential` is for {potential.n_modes} modes, but `modes` has {modes.n_modes}."
        )
    made = checked_effects(effects)
    for effect in made:
        for point, _ in getattr(effect, "at", None) or ():
            modes.shape_at(point)
    return Structure(
        modes=modes,
        potential=potential,
        effects=made,
        level_gain_std=_number(level_gain_std),
        level_phase_std=_number(level_phase_std),
        level_frequency_std=_number(level_frequency_std),
        level_damping_std=_number(level_damping_std),
        name=name,
    )


def simulated_structure(model: Structure) -> Structure:
    """The structure that is simulated: with the further modes of its internal resonances.

    A further mode comes after the others; no force drives it directly and no sensor sees it.
    Returns the model itself where no effect adds a mode.
    """
    adding = [e for e in model.effects if isinstance(e, AbstractAddedMode)]
    if not adding:
        return model
    modes, potential = model.modes, model.potential
    for effect in adding:
        modes, potential = effect.expanded(modes, potential)
    rest = tuple(e for e in model.effects if not isinstance(e, AbstractAddedMode))
    return dataclasses.replace(model, modes=modes, potential=potential, effects=rest)


def driven_in_newtons(model: Structure) -> Structure:
    """The structure as tests see it, whose states have forces in N: without an unbalance."""
    if model.modes.unbalance is None:
        return model
    return dataclasses.replace(model, modes=dataclasses.replace(model.modes, unbalance=None))


class Equilibrium(NamedTuple):
    """A static state: its displacement (kg^1/2 m), energy (J) and whether it is stable."""

    displacement: np.ndarray
    energy: float
    stable: bool


def equilibria(model: Structure, *, n_starts: int = 512, seed: int = 0) -> list[Equilibrium]:
    """Static equilibria of the structure, the one with the smallest displacement first.

    Solves ω²q + f(q, 0) = 0: for one mode and a polynomial restoring force by its roots,
    otherwise by Newton's method from many starts (a search, not a proof of completeness).
    A structure whose list has more than one stable entry is bistable: its forced response has
    wells that a curve followed from rest does not visit. Friction, which could hold a structure
    away from an equilibrium, is neglected, and so are further modes (see `simulated_structure`).

    Returns the distinct equilibria found, sorted by |q|.
    """
    n = model.n_modes
    squared = np.asarray(linear_terms_of(model).stiffness)
    if n == 1 and not model.memoryless:
        polynomial = np.zeros(max(model.potential.degree, 2))
        polynomial[1] = squared[0]
        for monomial, value in zip(
            model.potential.monomials, np.asarray(model.potential.coefficient), strict=True
        ):
            polynomial[len(monomial) - 1] += len(monomial) * value
        roots = np.polynomial.polynomial.polyroots(np.trim_zeros(polynomial, "b"))
        scale = max(1.0, float(np.max(np.abs(roots), initial=0.0)))
        real = np.abs(roots.imag) <= 1e-9 * np.abs(roots)
        candidates = np.unique(roots.real[real])[:, None]
        tolerance = 1e-12 * scale
    else:
        candidates, tolerance = _equilibria_by_newton(model, n_starts, seed)
    distinct: list[Equilibrium] = []
    free = bool(np.any(squared == 0))
    rest = jnp.zeros((1, n))
    if free and not np.any(np.asarray(model.memoryless_force(rest, rest))):
        # Newton's method creeps to a rest without a slope, and ends near it.
        candidates, tolerance = np.concatenate([np.zeros((1, n)), candidates]), 1e4 * tolerance
    for q in sorted(candidates, key=lambda row: float(np.linalg.norm(row))):
        if any(np.linalg.norm(q - e.displacement) <= tolerance for e in distinct):
            continue
        energy, tangent = _energy_and_tangent(model, q)
        slopes = np.linalg.eigvalsh(np.asarray(tangent))
        # What elements without a slope at rest hold has none there, and stays.
        stable = bool(np.all(slopes > (-_FLAT * slopes.max() if free else 0.0)))
        distinct.append(Equilibrium(q, float(energy), stable))
    return distinct


def _equilibria_by_newton(model: Structure, n_starts: int, seed: int) -> tuple[np.ndarray, float]:
    """Newton's method from random starts at the amplitudes where the potential matters."""
    n = model.n_modes
    scale = displacement_scale(model)
    drawn = np.random.default_rng(seed)
    radius = 10.0 ** drawn.uniform(-2, 1, (n_starts, 1))
    direction = drawn.normal(size=(n_starts, n))
    starts = np.concatenate([np.zeros((1, n)), radius * direction * scale])
    ends, residual = (np.asarray(part) for part in _newton(model, starts))
    good = np.all(np.isfinite(ends), axis=1) & (residual < 1e-9 * np.max(scale))
    return ends[good], 1e-6 * float(np.max(scale))


@compiled
def _newton(
    model: Structure, starts: Float[Array, "start mode"]
) -> tuple[Float[Array, "start mode"], Float[Array, " start"]]:
    """Ends of Newton's method for ω²q + f(q, 0) = 0, and what is left of the force over ω²."""
    squared = model.linear_terms().stiffness
    springs = jnp.where(squared > 0, squared, jnp.max(squared))

    def balance(q: Array) -> Array:
        return squared * q + model.memoryless_force(q[None], jnp.zeros((1, q.size)))[0]

    def step(_: int, q: Array) -> Array:
        return q - jnp.linalg.solve(_energy_and_tangent(model, q)[1], balance(q))

    ends = jax.vmap(lambda q: jax.lax.fori_loop(0, 60, step, q))(starts)
    return ends, jax.vmap(lambda q: jnp.max(jnp.abs(balance(q)) / springs))(ends)


@compiled
def _energy_and_tangent(
    model: Structure, q: Float[Array, " mode"]
) -> tuple[Float[Array, ""], Float[Array, "mode mode"]]:
    """Potential energy and tangent stiffness, the linear part included, at rest."""
    tangent = model.slopes(q[None], jnp.zeros((1, q.size)))[0][0]
    return model.potential_energy(q), jnp.diag(model.linear_terms().stiffness) + tangent


def displacement_scale(model: Structure) -> np.ndarray:
    """The displacement of each mode (kg^1/2 m) at which its own nonlinear force is not small.

    There a term of the potential is as large as the linear force, or memoryless effects change
    that by a tenth. It is the scale of searches and continuations; modes without terms of their
    own take the median of the others.
    """
    squared = np.asarray(linear_terms_of(model).stiffness)
    scale = np.full(model.n_modes, np.nan)
    for monomial, value in zip(
        model.potential.monomials, np.asarray(model.potential.coefficient), strict=True
    ):
        mode, degree = monomial[0], len(monomial)
        if set(monomial) == {mode} and degree > 2 and value != 0.0 and squared[mode] > 0:
            reached_at = (squared[mode] / (degree * abs(value))) ** (1.0 / (degree - 2))
            scale[mode] = np.fmin(scale[mode], reached_at)
    if model.memoryless:
        scale = np.fmin(scale, _scale_of_elements(model, squared))
    known = scale[np.isfinite(scale)]
    return np.where(np.isfinite(scale), scale, np.median(known) if known.size else 1e-3)


def _scale_of_elements(model: Structure, squared: np.ndarray) -> np.ndarray:
    """The displacement of each mode at which forces without memory change its own by a tenth."""
    elements = elements_of(model.memoryless, model.modes)
    rows, grid = np.asarray(elements.rows), np.logspace(-12, 3, 601)
    q = np.concatenate([[0.0], grid, -grid])
    scale = np.full(model.n_modes, np.nan)
    for mode in np.flatnonzero(np.any(rows, axis=0)):
        x = jnp.asarray(q[:, None] * rows[:, mode])
        values = np.asarray(elements.force(x, jnp.zeros_like(x))) @ rows[:, mode]
        change = np.abs(values[1:] - values[0]).reshape(2, -1).max(axis=0)
        reached = change > 0.1 * squared[mode] * grid
        # A bilinear stiffness is as strong at every displacement and sets no scale.
        if reached.any() and not reached[0]:
            scale[mode] = grid[np.argmax(reached)]
    return scale
