"""Resonances and folds of fitted responses, located by Newton's method, with bands."""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from snrmjax.identify.inference.forced_motion import ForcedMotion
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.pointwise.prediction_result import Resonance
from snrmjax.identify.pointwise.snrm import sensed_mode
from snrmjax.identify.prediction.new_level import ON_THE_CURVES, NewLevel
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.result import quantity, setting

_ITERATIONS = 12
_SETTLED = 1e-9  # relative step, below which a point is a root
_FARTHEST = 0.2  # relative, from where the drawn curve has it

Kind = Literal["resonance", "fold"]


class FittedPoint(Resonance):
    """A resonance or a fold of a fitted response, with 1σ; a fold has no damping ratio (NaN).

    One that was not located has the place that the drawn curve has, and NaN for 1σ.
    """

    frequency_std: float = quantity("", "Hz", "1σ of the frequency")
    velocity_std: float = quantity("", "m/s", "1σ of the velocity")
    kind: Kind = setting()
    located: bool  # False: no root of Newton's method near where the drawn curve has it

    def attributes(self) -> dict[str, str | float | int]:
        """What it is, and whether it was located."""
        return {"kind": self.kind, "status": "located" if self.located else "not_located"}


class Place(NamedTuple):
    """Where a resonance or a fold is looked for."""

    kind: Kind
    amplitude: float  # m
    frequency: float  # rad/s


class SolvedPoint(NamedTuple):
    """A root of the equations of a resonance or fold, and its derivatives."""

    values: np.ndarray  # frequency, velocity, displacement
    slopes: np.ndarray  # of them by the fit's unknowns
    by_level: np.ndarray  # and by the level's errors

    def variance(self, fit: JointFit) -> np.ndarray:
        """That of the fit's unknowns."""
        return np.einsum("op,pq,oq->o", self.slopes, fit.covariance, self.slopes)


def located(
    fit: JointFit, force: float, place: Place, new: NewLevel = ON_THE_CURVES
) -> FittedPoint:
    """The resonance or fold near a place.

    At a phase resonance the mode moves in phase with the force: 2ζ̃ω̃ = |A|F/v.
    """
    solved = solved_point(fit, force, place, new)
    (_, x, omega), nan = place, float("nan")
    values, std, ratio = np.array([omega, omega * x, x]), np.full(3, nan), nan
    if solved is not None:
        values = solved.values
        std = np.sqrt(solved.variance(fit) + solved.by_level**2 @ new.std**2)
    omega, speed, x = map(float, values)
    if solved is not None and place.kind == "resonance":
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
        kind=place.kind,
        located=solved is not None,
    )


def turns(frequency: np.ndarray, amplitude: np.ndarray) -> list[Place]:
    """Where a curve turns back in frequency."""
    steps = np.sign(np.diff(frequency))
    at = np.flatnonzero(steps[:-1] * steps[1:] < 0) + 1
    return [Place("fold", float(amplitude[k]), float(frequency[k])) for k in at]


def solved_point(
    fit: JointFit, force: float, place: Place, new: NewLevel = ON_THE_CURVES
) -> SolvedPoint | None:
    """Frequency, velocity and displacement of a point, and their slopes by the unknowns."""
    program, motion = fit.packed(), ForcedMotion.of(fit, force, new)
    unit = jnp.array([place.amplitude, place.frequency])
    vector, is_fold = motion.with_level(program.vector), np.array(place.kind == "fold")
    values, slopes, good = map(np.asarray, _point_with_slopes(motion, vector, unit, is_fold))
    if not good:
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
        # Where the level's record is in phase, the motion itself lags by the error of its phase.
        phase = motion.split(vector)[1][1]
        resonance = [
            squared / omega**2 - 1 + damping / omega * jnp.tan(phase),
            omega * damping * x / (jnp.cos(phase) * motion.load_of(vector, omega)) - 1,
        ]
        return jnp.where(is_fold, jnp.stack([excess, slope * x]), jnp.stack(resonance))

    def step(_: int, point: Array) -> Array:
        jacobian = jax.jacfwd(equations)(point, vector)
        return point - jnp.linalg.solve(jacobian, equations(point, vector))

    point = jax.lax.fori_loop(0, _ITERATIONS, step, jnp.ones(2))
    # What a further step would move: what the equations leave grows with lightly damped slopes.
    jacobian, by_vector = jax.jacfwd(equations, argnums=(0, 1))(point, vector)
    left = jnp.linalg.solve(jacobian, equations(point, vector))
    good = jnp.all(jnp.abs(left) < _SETTLED) & jnp.all(jnp.abs(point - 1.0) < _FARTHEST)
    along = -jnp.linalg.solve(jacobian, by_vector)

    def outputs(point: Array, vector: Array) -> Array:
        x, omega = point * unit
        return jnp.stack([omega, jnp.abs(motion.velocity(vector, x, omega)), x])

    by_point, direct = jax.jacfwd(outputs, argnums=(0, 1))(point, vector)
    return outputs(point, vector), by_point @ along + direct, good
