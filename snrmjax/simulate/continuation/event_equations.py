"""Equations whose solutions are events of forced responses as a parameter of the model changes.

A fold, a peak, a period doubling and a Neimark-Sacker point are motions at which a matrix A is
singular. Bordered by a row and a column it is regular, and the last entry g of
[A b; cᵀ 0] (v; g) = (0; 1) vanishes where A is singular: one equation in addition to the balance,
with the gradient ∂g = −wᵀ(∂A)v, w being the solution of the transposed system.
Reference: Govaerts, Numerical Methods for Bifurcations of Dynamical Equilibria (2000), chapters 3
and 4, doi:10.1137/1.9780898719543; of harmonic balance: Detroux et al., Comput. Methods Appl. Mech.
Eng. 296 (2015) 18, doi:10.1016/j.cma.2015.07.017; Xie et al., Mech. Syst. Signal Process. (2017),
doi:10.1016/j.ymssp.2016.09.037.
"""

from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Inexact

from snrmjax.model.parameters import with_parameters
from snrmjax.model.structures import Structure, simulated_structure
from snrmjax.numerics.newton import Point
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance
from snrmjax.simulate.balance.harmonics import harmonic_basis, tangent_blocks
from snrmjax.simulate.continuation.events import height, quadrature, velocities_along

EventKind = Literal["fold", "peak", "phase_resonance", "period_doubling", "neimark_sacker"]
FORCE = "force"  # the parameter that is not one of the model


class Bordered(NamedTuple):
    """Solution of a bordered system of A: g, zero where A is singular, and v and w."""

    g: Inexact[Array, ""]
    right: Inexact[Array, " size"]
    left: Inexact[Array, " size"]


class EventEquations(eqx.Module):
    """Motions at an event of one kind, R(x, λ, μ) = 0 and g(x, λ, μ) = 0, as μ changes.

    The unknowns are those of the balance, for a Neimark-Sacker point the squared second frequency
    over `frequency_scale`, and last the scaled parameter. `balance` is that of `model` with its
    further modes, at any force.
    """

    model: Structure
    balance: HarmonicBalance
    parameter_scale: Float[Array, ""]
    kind: EventKind = eqx.field(static=True)
    parameter: str = eqx.field(static=True)  # a name of `parameter_names`, or "force"

    def at(self, value: Array) -> HarmonicBalance:
        """The balance at a scaled value of the parameter."""
        number = value * self.parameter_scale
        if self.parameter == FORCE:
            return eqx.tree_at(lambda b: b.force, self.balance, number)
        model = simulated_structure(with_parameters(self.model, [self.parameter], number[None]))
        return eqx.tree_at(lambda b: b.model, self.balance, model)

    def linearised(
        self, point: Point
    ) -> tuple[Float[Array, " equation"], Float[Array, "equation unknown"]]:
        """Balance and condition, and their Jacobian with respect to the unknowns."""
        motion, value = self._motion(point), point[-1]
        residual, jacobian = self.at(value).linearised(motion)
        by_value = jax.jvp(lambda m: self.at(m).residual(motion), (value,), (jnp.ones(()),))[1]
        between = jnp.zeros((residual.shape[0], point.shape[0] - motion.shape[0] - 1))
        rows = jnp.concatenate([jacobian, between, by_value[:, None]], axis=1)
        condition, slopes = self._condition(point, jacobian)
        return jnp.append(residual, condition), jnp.concatenate([rows, slopes])

    def _condition(self, point: Point, jacobian: Array) -> tuple[Array, Array]:
        if self.kind == "phase_resonance":
            value, slope = jax.value_and_grad(lambda p: quadrature(self.balance, self._motion(p)))(
                point
            )
            return value[None], slope[None]
        null = bordered(self.matrix(point, jacobian))

        def parts(point: Point) -> Array:
            value = -null.left @ self.image(point, null.right)
            return jnp.stack([value.real, value.imag]) if self._oscillates else value[None]

        slopes = jax.jacrev(parts)(point)
        if not self._oscillates:
            return null.g[None], slopes
        # At a second frequency of zero the imaginary part vanishes identically: divided by it, the
        # equation stays regular.
        second = jnp.sqrt(point[-2])
        fraction = jnp.array([1.0, 1.0 / second])
        values = jnp.stack([null.g.real, null.g.imag]) * fraction
        slopes = (slopes * fraction[:, None]).at[1, -2].add(-0.5 * values[1] / point[-2])
        return values, slopes

    @property
    def _oscillates(self) -> bool:
        return self.kind == "neimark_sacker"

    def _motion(self, point: Point) -> Point:
        return point[: self.balance.size + 1]

    def matrix(self, point: Point, jacobian: Array) -> Inexact[Array, "size size"]:
        """The matrix A that is singular at the event; `jacobian` is that of the balance."""
        size = self.balance.size
        motion = self._motion(point)
        if self.kind in ("fold", "peak"):
            return _singular(self.kind, self.balance, motion, jacobian)
        if self.kind == "period_doubling":
            doubled, index = self._doubled(point)
            return doubled.linearised(self._in_doubled(motion))[1][np.ix_(index, index)]
        second, balance = jnp.sqrt(point[-2]), self.at(point[-1])
        basis = harmonic_basis(balance.harmonic_order, balance.n_samples)
        terms, eye = balance.model.linear_terms(), jnp.eye(balance.n_coefficients)
        by_rate = 2 * motion[-1] * jnp.kron(jnp.asarray(basis.derivative), jnp.diag(terms.mass))
        by_rate = by_rate + jnp.kron(eye, terms.damping_matrix() / balance.frequency_scale)
        if balance.model.memoryless:
            # Coefficient, coefficient, mode, mode.
            blocks = tangent_blocks(basis, self._viscous(balance, motion))
            by_rate = by_rate + blocks.transpose(0, 2, 1, 3).reshape(by_rate.shape)
        inertia = jnp.diag(jnp.tile(terms.mass, balance.n_coefficients))
        return jacobian[:, :size] + 1j * second * by_rate - point[-2] * inertia

    def image(self, point: Point, vector: Inexact[Array, " size"]) -> Inexact[Array, " size"]:
        """A v, without forming A."""
        motion, balance = self._motion(point), self.at(point[-1])

        def along(direction: Array) -> Array:
            return jax.jvp(balance.residual, (motion,), (direction,))[1]

        if self.kind == "fold":
            return along(jnp.append(vector, 0.0))
        if self.kind == "peak":
            return jnp.append(along(vector), velocities_along(balance, motion, vector)[1][1])
        if self.kind == "period_doubling":
            doubled, index = self._doubled(point)
            begin = self._in_doubled(motion)
            direction = jnp.zeros_like(begin).at[index].set(vector)
            return jax.jvp(doubled.residual, (begin,), (direction,))[1][index]
        second = jnp.sqrt(point[-2])
        still = along(jnp.append(vector.real, 0.0)) + 1j * along(jnp.append(vector.imag, 0.0))
        basis = harmonic_basis(balance.harmonic_order, balance.n_samples)
        terms = balance.model.linear_terms()
        rows = vector.reshape(balance.n_coefficients, -1)
        rate = 2 * motion[-1] * terms.mass * (jnp.asarray(basis.derivative) @ rows)
        rate = rate + terms.damped(rows) / balance.frequency_scale
        if balance.model.memoryless:
            samples = jnp.asarray(basis.synthesis) @ rows
            forces = jnp.einsum("tmn,tn->tm", self._viscous(balance, motion), samples)
            rate = rate + jnp.asarray(basis.analysis) @ forces
        inertia = terms.mass * rows
        return still + (1j * second * rate - point[-2] * inertia).reshape(-1)

    def _viscous(self, balance: HarmonicBalance, motion: Point) -> Float[Array, "time mode mode"]:
        """∂(force)/∂q̇ over a period, divided by the frequency scale."""
        basis = harmonic_basis(balance.harmonic_order, balance.n_samples)
        x = balance.coefficients(motion)
        samples = jnp.asarray(basis.synthesis) @ x
        speed = motion[-1] * balance.frequency_scale
        rate = jnp.asarray(basis.synthesis @ basis.derivative) @ x * speed
        return balance.model.slopes(samples, rate)[1] / balance.frequency_scale

    def _doubled(self, point: Point) -> tuple[HarmonicBalance, np.ndarray]:
        """The balance over two periods, and the indices of its odd harmonics."""
        balance = self.at(point[-1])
        order, n = 2 * balance.harmonic_order, balance.model.n_modes
        doubled = HarmonicBalance(
            model=balance.model,
            force=balance.force,
            displacement_scale=balance.displacement_scale,
            frequency_scale=balance.frequency_scale,
            harmonic_order=order,
            n_samples=2 * balance.n_samples,
        )
        odd = np.arange(1, order, 2)
        rows = np.stack([2 * odd - 1, 2 * odd], axis=1).ravel()
        return doubled, (rows[:, None] * n + np.arange(n)).ravel()

    def _in_doubled(self, motion: Point) -> Point:
        """A motion as one of two periods: its harmonics are the even ones."""
        n, order = self.balance.model.n_modes, self.balance.harmonic_order
        rows = motion[:-1].reshape(self.balance.n_coefficients, n)
        even = 2 * np.arange(1, order + 1)
        index = np.concatenate([[0], np.stack([2 * even - 1, 2 * even], axis=1).ravel()])
        wide = jnp.zeros((4 * order + 1, n)).at[index].set(rows)
        return jnp.append(wide.reshape(-1), 0.5 * motion[-1])


def event_condition(kind: str, balance: HarmonicBalance, motion: Point) -> Float[Array, ""]:
    """What vanishes at a "fold", "peak" or "phase_resonance" of a response, differentiable."""
    if kind == "phase_resonance":
        return quadrature(balance, motion)
    return bordered(_singular(kind, balance, motion, balance.linearised(motion)[1])).g


def _singular(
    kind: str, balance: HarmonicBalance, motion: Point, jacobian: Array
) -> Float[Array, "size size"]:
    """The matrix that is singular at a fold or a peak."""
    if kind == "fold":
        return jacobian[:, : balance.size]
    return jnp.concatenate([jacobian, jax.grad(lambda p: height(balance, p))(motion)[None]])


def bordered(matrix: Inexact[Array, "size size"]) -> Bordered:
    """g of a matrix with borders near its null vectors, so that the system is well conditioned.

    The first borders are random. The second are b along A⁻ᵀ of the first row and c along A⁻¹b:
    then g = −1/|A⁻¹b| has no poles, to which Newton's method could converge as to zeros. Borders
    change g by a factor, which does not affect the equation g = 0.
    """
    size = matrix.shape[0]
    draw = np.random.default_rng(size).normal(size=(2, size)) / np.sqrt(size)
    column, row = jnp.asarray(draw, dtype=matrix.dtype)
    factors = _factorised(matrix, column, row)
    first = _null(factors)
    norm = jnp.linalg.norm(first.left)
    column = first.left.conj() / norm
    inside = jax.scipy.linalg.lu_solve(factors, jnp.append(column, 0.0))[:-1]
    row = first.g * inside - norm * first.right
    return _null(_factorised(matrix, column, row.conj() / jnp.linalg.norm(row)))


def _factorised(matrix: Array, column: Array, row: Array) -> tuple[Array, Array]:
    corner = jnp.zeros((1, 1), dtype=matrix.dtype)
    whole = jnp.block([[matrix, column[:, None]], [row[None], corner]])
    return jax.scipy.linalg.lu_factor(whole)


def _null(factors: tuple[Array, Array]) -> Bordered:
    last = jnp.zeros(factors[0].shape[0], dtype=factors[0].dtype).at[-1].set(1.0)
    right = jax.scipy.linalg.lu_solve(factors, last)
    left = jax.scipy.linalg.lu_solve(factors, last, trans=1)
    return Bordered(right[-1], right[:-1], left[:-1])
