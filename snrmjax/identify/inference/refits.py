"""The unknowns of a joint fit as a function of its inputs, with implicit derivatives.

At the optimum the gradient of half the sum of squares (states' errors and priors) is zero: s(θ, y)
= 0. By the implicit function theorem dθ/dy = −(∂s/∂θ)⁻¹ ∂s/∂y for an input y.
Hyperparameters (1σ of noise, level errors and roughness, weights of outliers) are the fit's, and
are held constant.
Reference: Griewank & Walther, Evaluating Derivatives (2008), ch. 15, doi:10.1137/1.9780898717761.
"""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from snrmjax.identify.joint.force_balance import BalanceProblem, Unknowns, filled, force_balance
from snrmjax.identify.joint.free_unknowns import Unravel, padded_problem, prior_residuals
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.numerics.compiled import compiled, on_numbers

_MOST_STEPS = 50  # Gauss–Newton iterations of a refit
_NO_WEIGHT = 1e-10  # of padding states, against division by zero
_ARRIVED = 1e-9  # standard deviations: step at convergence


class FitInputs(eqx.Module):
    """Changes of the inputs of a joint fit: relative, or in rad for phases.

    Standard deviations of noise and priors change by their logarithm.
    """

    amplitude: Float[Array, " state"]  # of the recorded velocities
    phase: Float[Array, " state"]  # of the recorded velocities, rad
    force: Float[Array, " state"]
    natural_frequency: Float[Array, " mode"]  # of the linear modes
    damping_ratio: Float[Array, " mode"]
    participation: Float[Array, " mode"]
    noise: Float[Array, " input"]  # 1σ of force, velocity, phase and stiffness scatter
    level: Float[Array, " error"]  # 1σ of level errors: gain, phase, stiffness and damping
    linear: Float[Array, " deviation"]  # 1σ as `PriorStd.linear`
    roughness: Float[Array, " curve"]  # prior 1σ of the roughness of ω̃² and of 2ζ̃ω̃

    @classmethod
    def none(cls, fit: JointFit) -> "FitInputs":
        """No change."""
        states, modes = jnp.zeros(len(fit.data.level)), jnp.zeros(fit.modes.n_modes)
        linear, four = jnp.zeros(len(fit.prior.linear)), jnp.zeros(4)
        return cls(states, states, states, modes, modes, modes, four, four, linear, jnp.zeros(2))


class _Refit(eqx.Module):
    """Objective of a fit in its own unknowns, in 1σ from their fitted values."""

    vector: Float[Array, " entry"]
    unit: Float[Array, " entry"]
    unravel: Unravel
    problem: BalanceProblem
    own: tuple[int, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, fit: JointFit) -> "_Refit":
        """Padded states and parameters, so that few sizes compile."""
        program = fit.packed()
        std = np.sqrt(np.diag(program.padded_covariance(fit.covariance)))
        unit = jax.device_put(np.where(std > 0, std, 1.0))
        own = tuple(program.own.tolist())
        return cls(program.vector, unit, program.unravel, padded_problem(fit.problem), own)

    def changed(self, by: FitInputs) -> "_Refit":
        """The problem with changed inputs."""
        data, modes, prior = self.problem.data, self.problem.modes, self.problem.prior
        room = (0, len(data.level) - len(by.force))
        phasor = jnp.exp(jnp.pad(by.amplitude + 1j * by.phase, room))
        data = dataclasses.replace(
            data,
            velocity=data.velocity * phasor,
            force=data.force * jnp.exp(jnp.pad(by.force, room)),
            std=data.std * jnp.exp(by.noise),
        )
        modes = dataclasses.replace(
            modes,
            natural_frequency=modes.natural_frequency * jnp.exp(by.natural_frequency),
            damping_ratio=modes.damping_ratio * jnp.exp(by.damping_ratio),
            participation=modes.participation * jnp.exp(by.participation),
        )
        prior = dataclasses.replace(
            prior,
            level_ratio=prior.level_ratio * jnp.exp(-by.level),
            linear_ratio=prior.linear_ratio * jnp.exp(-by.linear),
        )
        unravel = self.unravel
        for k, curve in enumerate(("squared_frequency", "modal_damping")):

            def expected(unravel: Unravel, curve: str = curve) -> Array:
                return getattr(unravel.unknowns, curve).made_of.prior

            rows = expected(unravel) * jnp.exp(-by.roughness[k])
            unravel = eqx.tree_at(expected, unravel, rows)
        problem = BalanceProblem(data, modes, prior)
        return dataclasses.replace(self, problem=problem, unravel=unravel)

    def entries(self, point: Float[Array, " unknown"]) -> Float[Array, " entry"]:
        """The full padded vector at a point given in 1σ from the fit."""
        own = jnp.array(self.own)
        return self.vector.at[own].add(point * self.unit[own])

    def solved(
        self, start: Float[Array, " unknown"]
    ) -> tuple[Float[Array, " unknown"], Float[Array, "state input"], Bool[Array, ""]]:
        """The optimum, the states' errors there in their 1σ, and whether it converged.

        Gauss–Newton with all errors as unknowns, eliminated state by state: the linearised balances
        b have multipliers λ = (SSᵀ)⁻¹(b − Se + J dθ), and the errors are −Sᵀλ.
        """
        expected = jax.jacfwd(self.expected)

        def step(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
            point, errors, _, count = state
            slopes = self.by_error(point, errors)
            by_unknown = jax.jacfwd(lambda p: self.balances(p, errors))(point)
            residual = self.balances(point, errors) - jnp.einsum("sie,se->si", slopes, errors)
            both = jnp.concatenate([residual[:, :, None], by_unknown], axis=2)
            weighted = jnp.linalg.solve(slopes @ slopes.mT, both)
            prior = expected(point)
            normal = jnp.einsum("sie,sif->ef", by_unknown, weighted[:, :, 1:]) + prior.T @ prior
            gradient = jnp.einsum("sie,si->e", by_unknown, weighted[:, :, 0])
            change = jnp.linalg.solve(normal, gradient + prior.T @ self.expected(point))
            errors = jnp.einsum(
                "sie,si->se", slopes, weighted[:, :, 1:] @ change - weighted[:, :, 0]
            )
            return point - change, errors, jnp.max(jnp.abs(change)), count + 1

        def goes_on(state: tuple[Array, Array, Array, Array]) -> Array:
            return (state[2] > _ARRIVED) & (state[3] < _MOST_STEPS)

        exact = jnp.zeros_like(self.problem.data.std)
        first = (start, exact, jnp.array(jnp.inf), jnp.array(0))
        point, errors, change, _ = jax.lax.while_loop(goes_on, step, first)
        return point, errors, change <= _ARRIVED

    def expected(self, point: Float[Array, " unknown"]) -> Float[Array, " row"]:
        """Prior residuals, in units of their 1σ."""
        return prior_residuals(self.unravel(self.entries(point)), self.problem.prior)

    def by_error(
        self, point: Float[Array, " unknown"], errors: Float[Array, "state input"]
    ) -> Float[Array, "state part input"]:
        """Derivatives of the balances by each state's own errors, in their 1σ."""
        return _state_by_state(lambda errors: self.balances(point, errors), errors)

    def balances(
        self, point: Float[Array, " unknown"], errors: Float[Array, "state input"]
    ) -> Float[Array, "state part"]:
        """Residuals of the states' balances, errors in their 1σ."""
        data = self.problem.data
        unit = data.std / jnp.sqrt(jnp.maximum(data.weight, _NO_WEIGHT))[:, None]
        unknowns = self.unravel(self.entries(point))
        return force_balance(unknowns, self.problem, unit * errors)

    def stationary(
        self,
        point: Float[Array, " unknown"],
        errors: Float[Array, "state input"],
        multipliers: Float[Array, "state part"],
    ) -> tuple[Array, Array, Array]:
        """Optimality conditions: gradient of the Lagrangian ½ (errors² + priors²) + λ · balances by
        the unknowns and by the errors, and the balances.
        """

        def lagrangian(point: Array, errors: Array) -> tuple[Array, Array]:
            residual = self.balances(point, errors)
            squares = jnp.sum(self.expected(point) ** 2) + jnp.sum(errors**2)
            return 0.5 * squares + jnp.sum(multipliers * residual), residual

        by, residual = jax.grad(lagrangian, argnums=(0, 1), has_aux=True)(point, errors)
        return *by, residual


def _state_by_state(
    function: Callable[[Array], Array], errors: Float[Array, "state input"]
) -> Float[Array, "state row input"]:
    """Derivatives by each state's own errors: one forward-mode product per kind of error."""
    kinds = jnp.broadcast_to(jnp.eye(errors.shape[1])[:, None], (errors.shape[1], *errors.shape))
    along = jax.vmap(lambda direction: jax.jvp(function, (errors,), (direction,))[1])
    return jnp.moveaxis(along(kinds), 0, 2)


def _optimum(problem: _Refit) -> Float[Array, " unknown"]:
    """The unknowns at the optimum, in 1σ from their start; NaN without convergence.

    A final Newton step on the optimality conditions, with errors and multipliers eliminated state
    by state, carries the implicit derivatives by all inputs.
    """
    fixed = jax.lax.stop_gradient(problem)
    point, errors, converged = fixed.solved(jnp.zeros(len(problem.own)))
    slopes = fixed.by_error(point, errors)
    square = slopes @ slopes.mT
    multipliers = -jnp.linalg.solve(square, (slopes @ errors[:, :, None]))[:, :, 0]
    inner = _state_by_state(lambda e: fixed.stationary(point, e, multipliers)[1], errors)
    none = jnp.zeros((len(errors), 2, 2))
    blocks = jnp.block([[inner, slopes.mT], [slopes, none]])
    by_point = jax.jacfwd(lambda p: fixed.stationary(p, errors, multipliers))
    hessian, *sensitivities = by_point(point)
    by_unknown = jnp.concatenate(sensitivities, axis=1)  # (state, input and part, unknown)
    solved = jnp.linalg.solve(blocks, by_unknown)
    whole = hessian - jnp.einsum("sie,sif->ef", by_unknown, solved)
    of_point, *of_states = problem.stationary(point, errors, multipliers)
    residual = of_point - jnp.einsum("sie,si->e", solved, jnp.concatenate(of_states, axis=1))
    return jnp.where(converged, point - jnp.linalg.solve(whole, residual), jnp.nan)


def refit(fit: JointFit, changes: FitInputs) -> Unknowns:
    """The unknowns of a joint fit with changed inputs, at the fit's hyperparameters.

    Solves s(θ, y) = 0, the gradient of half the sum of squares, by Gauss–Newton iterations from the
    fitted unknowns; derivatives are implicit, dθ/dy = −(∂s/∂θ)⁻¹ ∂s/∂y, of first order, forward and
    reverse. Works inside `jax.jit` and `jax.vmap`.

    Arguments: `changes` as `FitInputs.none(fit)`, with other numbers.
    Returns both curves and all other unknowns; NaN where 50 iterations do not converge: make the
    changes smaller.
    Validity: hyperparameters and the weights of several sensors stay as in the fit, where
    `fit_jointly` would estimate them again.
    Reference: Griewank & Walther, Evaluating Derivatives (2008), ch. 15,
    doi:10.1137/1.9780898717761.
    """
    return Unravel(fit.unknowns, fit.free)(_own(fit, _refitted(_Refit.of(fit), changes)))


@compiled
def _refitted(refit: _Refit, changes: FitInputs) -> Array:
    return _optimum(refit.changed(changes))


def _own(fit: JointFit, point: Array | np.ndarray) -> Array:
    vector, std = fit.vector()[0], np.sqrt(np.diag(fit.covariance))
    return vector + point * np.where(std > 0, std, 1.0)


class Influence(eqx.Module):
    """Derivatives of a fit's free unknowns by its inputs, at fixed hyperparameters."""

    names: tuple[str, ...] = eqx.field(static=True)  # of the unknowns
    by: FitInputs  # with a leading axis of unknowns


@on_numbers("Differentiate `sj.identify.refit`.")
def influence(fit: JointFit) -> Influence:
    """Sensitivity of a joint fit to every measured state, linear parameter and prior.

    Implicit derivatives at the optimum, as those of `refit`. Those of the curves follow from
    `values_at_displacement(fit, x).slopes @ influence(fit).by.amplitude` and so on.

    Returns derivatives of the free unknowns, in their units (`fit.names`, `fit.units`), by relative
    changes of the inputs and by phases in rad.
    Not differentiable: differentiate `sj.identify.refit`.
    """
    none = FitInputs.none(fit)
    slopes = _slopes(_Refit.of(fit), none)
    std = np.sqrt(np.diag(fit.covariance))
    unit = np.where(std > 0, std, 1.0)[:, None]
    return Influence(fit.names(), jax.tree.map(lambda rows: np.asarray(rows) * unit, slopes))


@compiled
def _slopes(refit: _Refit, none: FitInputs) -> FitInputs:
    return jax.jacrev(lambda changes: _optimum(refit.changed(changes)))(none)


@on_numbers("Differentiate `sj.identify.refit`.")
def bootstrap(
    fit: JointFit, n_samples: int = 200, *, seed: int = 0
) -> Float[np.ndarray, "sample unknown"]:
    """Unknowns of refits to states resampled with replacement within every level.

    A refit that does not converge is a row of NaN. Level errors are not resampled.

    Not differentiable: differentiate `sj.identify.refit`.
    """
    rng = np.random.default_rng(seed)
    level = np.asarray(fit.data.level)
    weights = np.zeros((n_samples, len(level)))
    for row in weights:
        for number in range(fit.data.n_levels):
            mine = np.flatnonzero(level == number)
            np.add.at(row, rng.choice(mine, size=mine.size), 1.0)
    refit = _Refit.of(fit)
    room, weights = len(refit.problem.data.level), weights * np.asarray(fit.data.weight)
    rows = jax.device_put(np.stack([filled(row, room, 0.0) for row in weights]))
    points = np.asarray(_resampled(refit, rows))
    return np.asarray(_own(fit, points))


@compiled
def _resampled(refit: _Refit, weights: Array) -> Float[Array, "sample unknown"]:
    def again(weight: Array) -> Array:
        weighted = dataclasses.replace(refit, problem=refit.problem.with_data(weight=weight))
        point, _, converged = weighted.solved(jnp.zeros(len(refit.own)))
        return jnp.where(converged, point, jnp.nan)

    return jax.lax.map(again, weights)
