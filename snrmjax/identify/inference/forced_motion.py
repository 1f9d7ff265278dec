"""Forced response of the fitted mode: curve, resonances and folds with bands, by implicit
differentiation.
"""

from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float
from scipy.linalg import block_diag

from snrmjax.identify.joint.force_balance import Unknowns, log_modal_mass, with_deviations
from snrmjax.identify.joint.free_unknowns import Unravel
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.pointwise.prediction import Resonance
from snrmjax.identify.pointwise.snrm import is_single, sensed_mode
from snrmjax.identify.prediction.new_level import WITHOUT_LEVEL_ERRORS, NewLevel
from snrmjax.identify.test_model.states import LEVEL_ERRORS
from snrmjax.model.modes import LinearModes, residual_velocity
from snrmjax.numerics.blocks import by_blocks
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.newton import ROUNDING, newton
from snrmjax.numerics.result import quantity, setting

_BLOCK = 256  # points per compiled call
_ONTO_THE_CURVE = 4  # Newton steps


class ForcedMotion(eqx.Module):
    """Response equation of a fit under one force, in amplitude X and frequency Ω.

    The response curve satisfies |(ω̃² − Ω²) + iΩδ| X = |A|F. The unknowns are the fit's, then the
    level errors (`LEVEL_ERRORS`) of the predicted level: zero, with `level_std` as their 1σ.
    """

    unravel: Unravel
    modes: LinearModes
    linear_std: Float[Array, " deviation"]
    constant: Float[Array, ""]  # A, 1/kg, with the model's modal mass
    force: Float[Array, ""]  # N, or its record
    recorded: Float[Array, ""]  # 1 where `force` is a record, which has a gain error; else 0
    smallest: Float[Array, ""]  # smallest recorded force, unit of the offset
    gain_of_force: Float[Array, ""]  # see `PriorStd`
    level_std: Float[Array, " error"]
    sensor: int = eqx.field(static=True)

    @classmethod
    def of(
        cls, fit: JointFit, force: float, new: NewLevel = WITHOUT_LEVEL_ERRORS
    ) -> "ForcedMotion":
        """A fit under a force in N, or under the record of `new`."""
        return cls(
            unravel=fit.packed().unravel,
            modes=new.modes(fit),
            linear_std=fit.prior.linear,
            constant=fit.problem.modal_constant * new.over_test(fit),
            force=jnp.asarray(float(force) if new.drive is None else new.drive),
            recorded=jnp.asarray(float(new.drive is not None)),
            smallest=jnp.min(fit.data.force),
            gain_of_force=fit.prior.gain_of_force,
            level_std=jnp.asarray(new.std),
            sensor=fit.data.sensor,
        )

    def with_level(self, vector: Array) -> Array:
        """The fit's unknowns, followed by the level's errors."""
        return jnp.append(vector, jnp.zeros_like(self.level_std))

    def split(self, vector: Array) -> tuple[Unknowns, Array]:
        """All unknowns of the fit, and the level's errors."""
        return self.unravel(vector[: -len(LEVEL_ERRORS)]), vector[-len(LEVEL_ERRORS) :]

    def excess(self, vector: Array, x: Array, omega: Array) -> Float[Array, "*batch"]:
        """|(ω̃² − Ω²) + iΩδ|² X²/load² − 1."""
        squared, damping = self.curves(vector, x, omega)
        square = (squared - omega**2) ** 2 + (omega * damping) ** 2
        return square * (x / self.load_of(vector, omega)) ** 2 - 1.0

    def load_of(self, vector: Array, omega: Array) -> Float[Array, "*batch"]:
        """|A|F in m/s² at a frequency, with the fit's modal mass."""
        constant = jnp.abs(self._constant_of(self.split(vector)[0]))
        return constant * sensed_mode(self.modes, omega).ratio * self.force_of(vector)

    def force_of(self, vector: Array) -> Float[Array, ""]:
        """The force in N."""
        unknowns, level = self.split(vector)
        gain = jnp.exp(unknowns.log_force_gain + self.gain_of_force * level[0])
        true = self.force * gain + unknowns.force_offset * self.smallest
        return jnp.where(self.recorded > 0, true, self.force)

    def curves(self, vector: Array, x: Array, omega: Array) -> tuple[Array, Array]:
        """The level's ω̃² and 2ζ̃ω̃ at displacement x and a frequency."""
        unknowns, level = self.split(vector)
        squared, damping = unknowns.squared_frequency, unknowns.modal_damping
        speed = x * omega
        return (
            squared(squared.amplitude(x, speed)) * (1 + level[2]),
            damping(damping.amplitude(x, speed)) * (1 + level[3]),
        )

    def _constant_of(self, unknowns: Unknowns) -> Float[Array, ""]:
        """A in 1/kg with the fit's modal mass."""
        return self.constant * jnp.exp(-log_modal_mass(unknowns, self.linear_std))

    def velocity(self, vector: Array, x: Array, omega: Array) -> Complex[Array, "*batch"]:
        """Velocity at the fit's sensor as recorded in the level, residual modes included."""
        (unknowns, level), force = self.split(vector), self.force_of(vector)
        squared, damping = self.curves(vector, x, omega)
        constant = self._constant_of(unknowns)
        sensed = sensed_mode(self.modes, omega)
        own = 1j * omega * constant * force / (squared - omega**2 + 1j * omega * damping)
        if not is_single(self.modes):
            own = own * sensed.ratio / sensed.to_mode(self.sensor)
        linear = with_deviations(self.modes, unknowns.linear, self.linear_std)
        rest = residual_velocity(linear, omega, jnp.broadcast_to(force, omega.shape))
        return (own + rest[..., self.sensor]) * jnp.exp((1 - self.gain_of_force) * level[0])


def banded_curve(
    fit: JointFit, force: float, amplitude: np.ndarray, frequency: np.ndarray, new: NewLevel
) -> tuple[np.ndarray, ...]:
    """Points of a response curve, corrected onto the fit's own curve, with bands.

    Returns displacement (m), frequency (rad/s) and velocity (m/s) of every point, 1σ of the
    frequency at fixed amplitude and of the velocity's magnitude at fixed frequency.
    """
    program, motion = fit.packed(), ForcedMotion.of(fit, force, new)
    of_fit, level = program.padded_covariance(fit.covariance), np.diag(new.std**2)
    covariance = jnp.asarray(block_diag(of_fit, level))
    count, vector = np.array(_ONTO_THE_CURVE), motion.with_level(program.vector)
    # The points come from interpolated curves: Newton steps move them onto the fit's own.
    return by_blocks(
        lambda x, omega: _bands(motion, vector, covariance, x, omega, count),
        _BLOCK,
        np.asarray(amplitude),
        np.asarray(frequency),
    )


@compiled
def _bands(
    motion: ForcedMotion, vector: Array, covariance: Array, x: Array, omega: Array, steps: Array
) -> tuple[Array, ...]:
    """The values of `banded_curve`, after this many minimum-norm Newton steps onto the curve."""
    ones, excess = jnp.ones_like(x), motion.excess

    def by(position: int, x: Array, omega: Array) -> Array:
        direction = [jnp.zeros_like(vector), 0 * ones, 0 * ones]
        direction[position] = ones
        return jax.jvp(excess, (vector, x, omega), tuple(direction))[1]

    def step(_: int, point: tuple[Array, Array]) -> tuple[Array, Array]:
        x, omega = point
        first, second = by(1, x, omega) * x, by(2, x, omega) * omega
        fraction = excess(vector, x, omega) / (first**2 + second**2)
        return x - fraction * first * x, omega - fraction * second * omega

    x, omega = jax.lax.fori_loop(0, steps, step, (x, omega))
    by_x, by_omega = by(1, x, omega), by(2, x, omega)
    by_vector = jax.jacfwd(excess)(vector, x, omega)

    def speed(vector: Array, x: Array) -> Array:
        return jnp.abs(motion.velocity(vector, x, omega))

    direct = jax.jacfwd(speed)(vector, x)
    through = jax.jvp(lambda x: speed(vector, x), (x,), (ones,))[1]
    moved = direct - (through / by_x)[:, None] * by_vector
    frequency_std = jnp.sqrt(jnp.einsum("op,pq,oq->o", by_vector, covariance, by_vector))
    velocity_std = jnp.sqrt(jnp.einsum("op,pq,oq->o", moved, covariance, moved))
    velocity = motion.velocity(vector, x, omega)
    return x, omega, velocity, frequency_std / jnp.abs(by_omega), velocity_std


_ITERATIONS = 12
_FARTHEST = 0.2  # relative, from the initial point

Kind = Literal["resonance", "fold"]


class FittedPoint(Resonance):
    """A resonance or a fold of a fitted response, with 1σ; a fold has no damping ratio (NaN).

    One that was not located has its approximate location on the interpolated curve, and NaN for 1σ.
    """

    frequency_std: float = quantity("", "Hz", "1σ of the frequency")
    velocity_std: float = quantity("", "m/s", "1σ of the velocity")
    kind: Kind = setting()
    located: bool  # False: Newton's method found no root near the initial point

    def attributes(self) -> dict[str, str | float | int]:
        """Kind and status."""
        return {"kind": self.kind, "status": "located" if self.located else "not_located"}


class InitialPoint(NamedTuple):
    """Initial point of Newton's method for a resonance or a fold."""

    kind: Kind
    amplitude: float  # m
    frequency: float  # rad/s


class SolvedPoint(NamedTuple):
    """A resonance or fold solved for, with its derivatives."""

    values: np.ndarray  # frequency, velocity, displacement
    slopes: np.ndarray  # by the fit's unknowns
    by_level: np.ndarray  # by the level's errors

    def variance(self, fit: JointFit) -> np.ndarray:
        """Variance due to the fit's unknowns."""
        return np.einsum("op,pq,oq->o", self.slopes, fit.covariance, self.slopes)


def located(
    fit: JointFit, force: float, start: InitialPoint, new: NewLevel = WITHOUT_LEVEL_ERRORS
) -> FittedPoint:
    """The resonance or fold near an initial point.

    At phase resonance the velocity is in phase with the force: 2ζ̃ω̃ = |A|F/v.
    """
    solved = solved_point(fit, force, start, new)
    (_, x, omega), nan = start, float("nan")
    values, std, ratio = np.array([omega, omega * x, x]), np.full(3, nan), nan
    if solved is not None:
        values = solved.values
        std = np.sqrt(solved.variance(fit) + solved.by_level**2 @ new.std**2)
    omega, speed, x = map(float, values)
    if solved is not None and start.kind == "resonance":
        constant = float(fit.problem.constant_of(fit.unknowns)) * new.over_test(fit)
        load = abs(constant) * force * float(sensed_mode(new.modes(fit), omega).ratio)
        ratio = load / (2 * omega**2 * x)
    return FittedPoint(
        force=force,
        amplitude=x,
        frequency=omega,
        damping_ratio=ratio,
        velocity=speed,
        continued=x > fit.largest[0] * (1 + 1e-9),
        frequency_std=float(std[0]),
        velocity_std=float(std[1]),
        kind=start.kind,
        located=solved is not None,
    )


def turning_points(frequency: np.ndarray, amplitude: np.ndarray) -> list[InitialPoint]:
    """Folds of a curve: where its frequency reverses."""
    steps = np.sign(np.diff(frequency))
    at = np.flatnonzero(steps[:-1] * steps[1:] < 0) + 1
    return [InitialPoint("fold", float(amplitude[k]), float(frequency[k])) for k in at]


def solved_point(
    fit: JointFit, force: float, start: InitialPoint, new: NewLevel = WITHOUT_LEVEL_ERRORS
) -> SolvedPoint | None:
    """Frequency, velocity and displacement of a point, and their derivatives by the unknowns."""
    program, motion = fit.packed(), ForcedMotion.of(fit, force, new)
    unit = jnp.array([start.amplitude, start.frequency])
    vector, is_fold = motion.with_level(program.vector), np.array(start.kind == "fold")
    values, slopes, converged = map(np.asarray, _point_with_slopes(motion, vector, unit, is_fold))
    if not converged:
        return None
    return SolvedPoint(values, slopes[:, program.own], slopes[:, len(program.vector) :])


@compiled
def _point_with_slopes(
    motion: ForcedMotion, vector: Array, unit: Array, is_fold: Array
) -> tuple[Array, Array, Array]:
    def equations(point: Array, vector: Array) -> Array:
        x, omega = point * unit
        excess, slope = jax.jvp(
            lambda x: motion.excess(vector, x, omega), (x,), (jnp.ones_like(x),)
        )
        squared, damping = motion.curves(vector, x, omega)
        # Where the record is in phase with the force, the motion lags by the phase error.
        phase = motion.split(vector)[1][1]
        resonance = [
            squared / omega**2 - 1 + damping / omega * jnp.tan(phase),
            omega * damping * x / (jnp.cos(phase) * motion.load_of(vector, omega)) - 1,
        ]
        return jnp.where(is_fold, jnp.stack([excess, slope * x]), jnp.stack(resonance))

    def linearised(point: Array) -> tuple[Array, Array]:
        return equations(point, vector), jax.jacfwd(equations)(point, vector)

    # Convergence by the last step: residuals scale with the steep slopes of light damping.
    root = newton(linearised, jnp.ones(2), most=_ITERATIONS)
    point, settled = root.one_more(within=ROUNDING)
    converged = settled & jnp.all(jnp.abs(point - 1.0) < _FARTHEST)
    along = -jnp.linalg.solve(root.jacobian, jax.jacfwd(equations, argnums=1)(root.point, vector))

    def outputs(point: Array, vector: Array) -> Array:
        x, omega = point * unit
        return jnp.stack([omega, jnp.abs(motion.velocity(vector, x, omega)), x])

    by_point, direct = jax.jacfwd(outputs, argnums=(0, 1))(point, vector)
    return outputs(point, vector), by_point @ along + direct, converged
