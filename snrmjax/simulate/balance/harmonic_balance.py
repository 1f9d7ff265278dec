"""Harmonic balance of a structure: residual and analytic Jacobian.

Unknowns are scaled to order one: displacement coefficients by a displacement, the frequency by
the natural frequency of the mode of interest, and the residual accordingly.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from snrmjax.model.effect_base import AbstractHysteresis, AbstractNonsmooth
from snrmjax.model.effect_shape import AveragedForce
from snrmjax.model.elements import ForceGroup, elements_of
from snrmjax.model.modes import phasor_of_load
from snrmjax.model.moving_base import newtons
from snrmjax.model.structures import Structure, linear_terms_of
from snrmjax.numerics.compiled import as_numpy, compiled
from snrmjax.numerics.rules import InputError
from snrmjax.simulate.balance.harmonics import (
    alias_free_samples,
    harmonic_basis,
    squared_orders,
    tangent_blocks,
)

BY_CYCLE = (AbstractHysteresis, AbstractNonsmooth)  # evaluated over a whole cycle


class HarmonicBalance(eqx.Module):
    """The balance R(x, λ) = 0 of one structure under one force, or of its normal modes.

    `x` holds the (coefficient, mode) displacements divided by `displacement_scale`, flattened;
    λ is the frequency divided by `frequency_scale`. Without a force and with `cosine_only` the
    solutions are the conservative normal modes (without damping and velocity-dependent forces).
    With `subharmonic` = n the force acts on harmonic n of the motion, whose period is n times that
    of the force: λ is then Ω/n divided by `frequency_scale`.
    """

    model: Structure
    force: Float[Array, ""]  # N, amplitude of a cosine; or a multiple of the unbalance
    displacement_scale: Float[Array, ""]  # kg^1/2 m
    frequency_scale: Float[Array, ""]  # rad/s
    harmonic_order: int = eqx.field(static=True)
    n_samples: int = eqx.field(static=True)
    cosine_only: bool = eqx.field(static=True, default=False)
    subharmonic: int = eqx.field(static=True, default=1)  # periods of the force in the motion's

    @property
    def n_coefficients(self) -> int:
        """Fourier coefficients of one mode."""
        return self.harmonic_order + 1 if self.cosine_only else 2 * self.harmonic_order + 1

    @property
    def size(self) -> int:
        """Number of equations."""
        return self.n_coefficients * self.model.n_modes

    def coefficients(self, point: Float[Array, " unknown"]) -> Float[Array, "coefficient mode"]:
        """Unscaled displacement coefficients of a point (x, λ), in kg^1/2 m."""
        flat = point[: self.size] * self.displacement_scale
        return flat.reshape(self.n_coefficients, self.model.n_modes)

    def point(
        self, coefficients: Float[Array, "coefficient mode"], frequency: Float[Array, ""]
    ) -> Float[Array, " unknown"]:
        """The scaled point (x, λ) of unscaled coefficients and a frequency in rad/s."""
        scaled = coefficients.reshape(-1) / self.displacement_scale
        return jnp.append(scaled, frequency / self.frequency_scale)

    def motions(
        self,
        points: Float[np.ndarray, "point unknown"],
        owner: Int[np.ndarray, " point"] | None = None,
    ) -> tuple[Float[np.ndarray, "point coefficient mode"], Float[np.ndarray, " point"]]:
        """Coefficients (kg^1/2 m) and frequencies (rad/s) of scaled points (x, λ), on the host.

        For a stacked balance `owner` is the index of each point's balance.
        """
        scale, unit = np.asarray(self.displacement_scale), np.asarray(self.frequency_scale)
        if owner is not None:
            scale, unit = scale[owner], unit[owner]
        rows = points[:, :-1] * scale[..., None]
        shape = (len(points), self.n_coefficients, self.model.n_modes)
        return rows.reshape(shape), points[:, -1] * unit

    def newtons(self, omega: Float[Array, ""]) -> Any:
        """The force (N) at a scaled frequency; see `newtons` of modes."""
        drive = self.subharmonic * omega * self.frequency_scale
        return newtons(self.model.modes.unbalance, drive, self.force)

    def load(self) -> Float[Array, " equation"]:
        """Scaled load of a force of one newton: the right-hand side for `newtons` = 1."""
        model = self.model
        if self.cosine_only:
            return jnp.zeros(self.size)
        spectrum, n = model.load_orders(), self.subharmonic
        orders = np.arange(min(len(spectrum), self.harmonic_order // n + 1))
        cosines = np.eye(self.n_coefficients)[:, np.maximum(2 * n * orders - 1, 0)]
        load = jnp.outer(cosines @ spectrum[: len(orders)], model.modes.participation)
        if model.modes.participation_lag is not None:
            sine = np.eye(self.n_coefficients)[2 * n] * spectrum[1]
            load = load + jnp.outer(sine, model.modes.participation_lag)
        return load.reshape(-1) / (self.frequency_scale**2 * self.displacement_scale)

    def residual(self, point: Float[Array, " unknown"]) -> Float[Array, " equation"]:
        """R(x, λ): force balance of every coefficient over ω²·displacement scale."""
        return _balanced(self, point, with_jacobian=False)[0]

    def linearised(
        self, point: Float[Array, " unknown"]
    ) -> tuple[Float[Array, " equation"], Float[Array, "equation unknown"]]:
        """R(x, λ) and its Jacobian with respect to (x, λ), the last column for λ."""
        return _balanced(self, point, with_jacobian=True)

    def _balance(self, point: Array, *, with_jacobian: bool) -> tuple[Array, Array]:
        model, fs = self.model, self.frequency_scale
        n, size = model.n_modes, self.n_coefficients
        basis = harmonic_basis(self.harmonic_order, self.n_samples, cosine_only=self.cosine_only)
        terms = model.linear_terms()
        stiffness = terms.stiffness / fs**2
        h2 = squared_orders(self.harmonic_order, cosine_only=self.cosine_only)[:, None]
        inertia = h2 * terms.mass
        x, omega = point[:-1].reshape(size, n), point[-1]
        slope = jnp.asarray(basis.derivative) @ x
        samples = jnp.asarray(basis.synthesis) @ (x * self.displacement_scale)
        by_omega = jnp.asarray(basis.synthesis) @ (slope * (fs * self.displacement_scale))
        rate = omega * by_omega
        unit = fs**2 * self.displacement_scale
        internal = jnp.asarray(basis.analysis) @ (model.nonlinear_force(samples, rate) / unit)
        damped = terms.damped(slope) / fs
        balance = (stiffness - omega**2 * inertia) * x + omega * damped + internal
        residual = balance.reshape(-1) - self.newtons(omega) * self.load()
        if not with_jacobian:
            return residual, jnp.zeros((0,))
        # Adding zeros off the diagonal is faster than updating its entries in place.
        of_inertia = np.diag(h2[:, 0])[..., None, None]
        of_damping = basis.derivative[..., None, None]
        if model.potential.monomials:
            tangent = model.potential.stiffness(samples) / fs**2 + jnp.diag(stiffness)
            blocks = tangent_blocks(basis, tangent)
        else:
            blocks = jnp.eye(size)[..., None, None] * jnp.diag(stiffness)
        blocks = blocks - of_inertia * (omega**2 * jnp.diag(terms.mass))
        blocks = blocks + of_damping * (omega * terms.damping_matrix() / fs)
        column = damped - 2 * omega * inertia * x
        if model.modes.unbalance is not None:
            column = column - (2 / omega * self.newtons(omega) * self.load()).reshape(size, n)
        if model.forces:
            added, by_omega = self._elements(samples, by_omega, omega)
            blocks, column = blocks + added, column + by_omega
        blocks = blocks.transpose(0, 2, 1, 3)
        by_x = blocks.reshape(size * n, size * n)
        return residual, jnp.concatenate([by_x.T, column.reshape(1, -1)]).T

    def _elements(
        self, samples: Array, by_omega: Array, omega: Array
    ) -> tuple[Float[Array, "coefficient coefficient mode mode"], Float[Array, "coefficient mode"]]:
        """Contributions of the nonlinear elements to the blocks and to the column of λ."""
        model, fs = self.model, self.frequency_scale
        basis = harmonic_basis(self.harmonic_order, self.n_samples, cosine_only=self.cosine_only)
        unit = fs**2 * self.displacement_scale
        elements = elements_of(model.forces, model.modes)
        x, v_omega = elements.displacement(samples), elements.displacement(by_omega)
        v = omega * v_omega
        slopes = elements.without(BY_CYCLE).slopes(x, v)
        block = tangent_blocks(basis, slopes.stiffness / fs**2)
        viscous = tangent_blocks(basis, slopes.damping / fs)
        block = block + omega * jnp.einsum("cep,ed->cdp", viscous, basis.derivative)
        change = slopes.damping * v_omega / unit
        shapes = jnp.asarray(basis.synthesis.T) * self.displacement_scale
        rates = jnp.asarray((basis.synthesis @ basis.derivative).T)
        rates = rates * (omega * fs * self.displacement_scale)
        by_cycle, across = elements.only(BY_CYCLE).apart()
        if by_cycle.groups:

            def along(direction: Array, direction_rate: Array) -> Array:
                return jax.jvp(by_cycle.cycle_force, (x, v), (direction, direction_rate))[1] / unit

            # One direction moves all attachment points at once: a force depends on its own alone.
            every = jnp.ones(elements.n_attachments)
            by_shape = jax.vmap(along)(shapes[..., None] * every, rates[..., None] * every)
            block = block + jnp.einsum("ct,dtp->cdp", basis.analysis, by_shape)
            change = change + along(jnp.zeros_like(x), v_omega)
        blocks = elements.matrix(block)
        for group in across.groups:
            pair = group.gathered(x), group.gathered(v)
            added, values = _across(group, pair, (shapes, rates), group.gathered(v_omega))
            local = jnp.einsum("ct,djtfi->cdfij", basis.analysis, added / unit)
            influence = elements.influence[group.attachments]
            blocks = blocks + jnp.einsum("cdfij,fim,fjn->cdmn", local, influence, influence)
            change = change + elements.summed(group, values / unit)
        return blocks, elements.on_modes(jnp.asarray(basis.analysis) @ change)


@compiled
def _balanced(balance: HarmonicBalance, point: Array, *, with_jacobian: bool) -> tuple:
    """`HarmonicBalance._balance`, traced once for all programs that solve it.

    Each step of Newton's method has it twice, each curve several programs: tracing took longer
    than compiling.
    """
    return balance._balance(point, with_jacobian=with_jacobian)


def _across(
    group: ForceGroup,
    pair: tuple[Array, Array],
    directions: tuple[Array, Array],
    v_omega: Float[Array, "time force row"],
) -> tuple[Float[Array, "direction moved time force row"], Float[Array, "time force row"]]:
    """Derivatives of forces with several displacements: by every direction of each, and by Ω.

    Arguments: displacement and velocity `pair` (time, force, row) of the forces, the `directions`
    of displacements and of velocities (direction, time), and the derivative of velocity by Ω.
    """

    def along(moved: Array, rate: Array) -> Float[Array, "time force row"]:
        return jax.jvp(group.cycle_force, pair, (moved, rate))[1]

    def of_row(direction: Array, rate: Array, row: Array) -> Array:
        # One direction moves one displacement of every force of the group.
        every = jnp.ones(group.attachments.shape) * row
        return along(direction[:, None, None] * every, rate[:, None, None] * every)

    of_rows = jax.vmap(jax.vmap(of_row, (None, None, 0)), (0, 0, None))
    by_row = of_rows(*directions, jnp.eye(group.attachments.shape[1]))
    return by_row, along(jnp.zeros_like(v_omega), v_omega)


def harmonic_balance(
    model: Structure,
    force: Float[Array, ""] | float,
    displacement_scale: Float[Array, ""] | float,
    *,
    harmonic_order: int,
    n_samples: int | None = None,
    cosine_only: bool = False,
) -> HarmonicBalance:
    """The balance of `model` under a cosine force of amplitude `force` (N).

    `n_samples` defaults to the alias-free number for a polynomial potential and to at least
    128 with nonlinear elements, which need not be polynomial.
    Raises `ValueError` when `harmonic_order` is below 1 or the samples are too few to resolve
    the harmonics.
    """
    n_samples = samples_for(model, harmonic_order, n_samples)
    modes = model.modes
    return HarmonicBalance(
        model=model,
        force=jnp.asarray(force, dtype=jnp.float64),
        displacement_scale=jnp.asarray(displacement_scale, dtype=jnp.float64),
        frequency_scale=jnp.asarray(as_numpy(modes.natural_frequency)[modes.mode_of_interest]),
        harmonic_order=harmonic_order,
        n_samples=n_samples,
        cosine_only=cosine_only,
    )


def samples_for(model: Structure, harmonic_order: int, n_samples: int | None) -> int:
    """Time samples over a period: as requested, or as many as the model's forces need.

    Raises `ValueError` as `harmonic_balance` does.
    """
    if harmonic_order < 1:
        raise InputError(f"`harmonic_order` must be 1 or more, but is {harmonic_order}.")
    if n_samples is not None and n_samples <= 2 * harmonic_order:
        raise InputError(
            f"`n_samples` must be above {2 * harmonic_order}, twice the harmonic order, "
            f"but is {n_samples}."
        )
    if n_samples is None:
        n_samples = alias_free_samples(harmonic_order, max(model.potential.degree - 1, 1))
        if model.forces:
            n_samples = max(n_samples, 128, 16 * harmonic_order)
        if any(isinstance(force, BY_CYCLE) for force in model.forces):
            n_samples = max(n_samples, 256)
    return n_samples


def truncation_error(
    balance: HarmonicBalance,
    coefficients: Float[Array, "point coefficient mode"],
    frequency: Float[Array, " point"],
) -> Float[Array, " point"]:
    """Estimated relative velocity of the truncated harmonics H + 1 to 2H.

    The nonlinear forces of the motion at those harmonics, over the linear dynamic stiffness there:
    the first step of a Newton iteration with twice the harmonics. Root mean square over the
    period and the modes, relative to that of the motion; frequency in rad/s.
    """
    model, order, n = balance.model, balance.harmonic_order, balance.model.n_modes
    basis = harmonic_basis(2 * order, samples_for(model, 2 * order, None))
    x = jnp.moveaxis(coefficients, 0, 2)
    synthesis = basis.synthesis[:, : 2 * order + 1]
    samples = jnp.tensordot(synthesis, x, axes=1)  # (time, mode, point)
    if model.forces:
        slopes = (basis.synthesis @ basis.derivative)[:, : 2 * order + 1]
        rate = frequency * jnp.tensordot(slopes, x, axes=1)
        values = jax.vmap(model.nonlinear_force, in_axes=2, out_axes=2)(samples, rate)
    else:
        rows = jnp.moveaxis(samples, 1, 0)
        values = model.potential.force_of_rows(rows.reshape(n, -1)).reshape(rows.shape)
        values = jnp.moveaxis(values, 0, 1)
    force = jnp.tensordot(basis.analysis[2 * order + 1 :], values, axes=1)
    terms, h = model.linear_terms(), np.arange(order + 1, 2 * order + 1)[:, None, None]
    stiffness = terms.stiffness[:, None] - terms.mass[:, None] * (h * frequency) ** 2
    square = (force[0::2] ** 2 + force[1::2] ** 2) / (
        stiffness**2 + (terms.damping[:, None] * h * frequency) ** 2
    )
    truncated = jnp.sum(h**2 * square, axis=(0, 1))
    repeated = np.repeat(np.arange(1, order + 1), 2)[:, None, None]
    return jnp.sqrt(truncated / jnp.sum((repeated * x[1:]) ** 2, axis=(0, 1)))


def linear_coefficients(
    model: Structure, force: Float[Array, ""], frequency: Float[Array, ""], harmonic_order: int
) -> Float[Array, "coefficient mode"]:
    """Displacement coefficients of the linear response, the start of a forced response."""
    terms = model.linear_terms()
    load = newtons(model.modes.unbalance, frequency, force) * phasor_of_load(model.modes)
    stiffness = terms.stiffness - terms.mass * frequency**2 + 1j * terms.damping * frequency
    if terms.coupling is None:
        phasor = load / stiffness
    else:
        phasor = jnp.linalg.solve(jnp.diag(stiffness) + 1j * frequency * terms.coupling, load)
    start = jnp.zeros((2 * harmonic_order + 1, model.n_modes))
    return start.at[1].set(phasor.real).at[2].set(-phasor.imag)


def resonance_displacement(
    model: Structure, force: float, within: Sequence[float] | np.ndarray | None = None
) -> float:
    """Rough displacement (kg^1/2 m) of the resonant modes: a scale for unknowns, not a result.

    For each of `resonant_modes` it solves 2ζ̃ω̃ ω̃ Q = |P| with ω̃² = ω₀² + ¾·4c Q² from its own
    quartic term, and with the averages of the nonlinear elements. The damping is at least that of
    ζ = 5e-5, and the scale at least the static displacement of every mode, so that no scaled
    motion is small.
    """
    terms = linear_terms_of(model)
    mass, damping, stiffness = (np.asarray(part) for part in terms[:3])
    omega = np.sqrt(stiffness / mass)
    load = np.abs(
        newtons(model.modes.unbalance, omega, force) * np.asarray(phasor_of_load(model.modes))
    )
    springs = stiffness > 0
    scale = float(np.max(load[springs] / stiffness[springs], initial=0.0))
    for mode in resonant_modes(model, within):
        least_damping = 1e-4 * omega[mode]
        largest = load[mode] / (max(damping[mode], least_damping) * omega[mode])
        if largest > scale:
            amplitude = largest * np.logspace(-9, 0, 361)
            squared, viscous = _averaged(model, mode, amplitude, omega[mode])
            needed = np.maximum(damping[mode] + viscous, least_damping) * amplitude
            needed = needed * np.sqrt(stiffness[mode] + squared)
            risen = np.maximum.accumulate(needed)
            scale = max(scale, float(np.interp(load[mode], risen, amplitude)))
    return scale


def _averaged(
    model: Structure, mode: int, amplitude: Float[np.ndarray, " amplitude"], frequency: float
) -> tuple[Float[np.ndarray, " amplitude"], Float[np.ndarray, " amplitude"] | float]:
    """Equivalent stiffness and damping of a mode's quartic term and of the nonlinear elements."""
    values = dict(
        zip(model.potential.monomials, np.asarray(model.potential.coefficient), strict=True)
    )
    quartic = max(3.0 * float(values.get((mode,) * 4, 0.0)), 0.0)
    if not model.forces:
        return quartic * amplitude**2, 0.0
    influence = np.asarray(elements_of(model.forces, model.modes).influence)[:, mode]
    local = np.abs(influence) * amplitude[:, None]
    each = _at_amplitudes(model, local, frequency)
    stiffer, damped = (np.asarray(part) @ influence**2 for part in each)
    return quartic * amplitude**2 + np.maximum(stiffer, 0.0), damped


def resonant_modes(
    model: Structure, within: Sequence[float] | np.ndarray | None = None
) -> list[int]:
    """The modes that a force drives near resonance, the mode of interest first.

    Driven modes with natural frequencies `within` two frequencies (rad/s) or an octave of them,
    since nonlinear resonances shift; if there is none, all driven modes. Without frequencies the
    mode of interest, if it is driven.
    """
    modes, j = model.modes, model.modes.mode_of_interest
    driven = modes.driven() & (np.asarray(modes.natural_frequency) > 0)
    if within is None:
        near = np.arange(len(driven)) == j
    else:
        natural = np.asarray(modes.natural_frequency)
        near = (natural >= 0.5 * within[0]) & (natural <= 2 * within[-1])
    some = driven & near if np.any(driven & near) else driven
    return sorted(np.flatnonzero(some).tolist(), key=lambda mode: mode != j)


@compiled
def averaged_at_attachments(
    model: Structure, amplitude: Float[Array, " attachment"], frequency: Float[Array, ""]
) -> AveragedForce:
    """Equivalent stiffness and damping of the nonlinear elements at their attachment points.

    By averaging over a cycle (describing functions). Arguments: amplitudes of x at the attachment
    points, in the order of `elements_of`; `frequency` in rad/s. Zero for zero amplitude.
    """
    elements, beta = (
        elements_of(model.forces, model.modes),
        2 * np.pi * np.arange(128)[:, None] / 128,
    )
    x, v = amplitude * np.cos(beta), -amplitude * frequency * np.sin(beta)
    force = elements.cycle_force(x, v)
    moves = amplitude > 0
    divisor = jnp.where(moves, amplitude, 1.0)
    cosine, sine = 2 * jnp.mean(force * np.cos(beta), 0), 2 * jnp.mean(force * np.sin(beta), 0)
    return AveragedForce(
        jnp.where(moves, cosine / divisor, 0.0),
        jnp.where(moves, -sine / (divisor * frequency), 0.0),
    )


@compiled
def _at_amplitudes(
    model: Structure, amplitude: Float[Array, "amplitude attachment"], frequency: Float[Array, ""]
) -> AveragedForce:
    return jax.vmap(averaged_at_attachments, (None, 0, None))(model, amplitude, frequency)
