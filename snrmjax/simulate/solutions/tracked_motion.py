"""A periodic motion continued as the model and the force change, for optimisations."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from snrmjax.model.modes import have_values
from snrmjax.model.structures import Structure
from snrmjax.numerics.compiled import compiled, numbers_as_arrays
from snrmjax.numerics.rules import InputError
from snrmjax.simulate.solutions.periodic_motion import (
    Condition,
    PeriodicMotion,
    motion_near,
    periodic_motion,
)

_ITERATIONS = 12  # of Newton's method, started from a prediction
_LATE = 0.3  # largest correction over step: beyond it another motion may have been reached
_ROUNDING = 1e-6  # relative correction that is negligible
_LARGEST_SHIFT = 0.1  # relative change of the frequency in one step
_SHORTEST = 2.0**-12  # step, as a fraction of the path
_TRIALS = 400


class TrackedMotion(eqx.Module):
    """A periodic motion at known parameters, from which it is continued to others.

    `periodic_motion` needs a start near the wanted motion. In an optimisation the parameters move
    away from those of the start, from where Newton's method may fail or converge to another motion.
    `at` continues the motion from the known parameters to the new ones along a straight line, in as
    many steps as needed: the derivative along the line predicts, Newton's method corrects. The
    result depends on the new parameters alone, not on earlier calls, and is differentiable like
    that of `periodic_motion`: in `jax.jit`, `jax.grad` and `jax.vmap`, in the loops of
    scipy.optimize and of optimistix.

    Arguments: `model`, `force` in N, `start`, `condition` and `value` as in `periodic_motion`;
    `start` is corrected.
    Raises `ValueError` if there is no such motion near `start`, and as `periodic_motion` does.

    >>> import jax
    >>> from snrmjax import forced_response
    >>> from snrmjax.model import flat_beam
    >>> beam = flat_beam()
    >>> curve = forced_response(beam, [2e-4], 480.0, 520.0, harmonic_order=1)[0]
    >>> peak = TrackedMotion(beam, 2e-4, curve.point(curve.at_events("peak")[0]), condition="peak")
    >>> slope = jax.grad(lambda force: peak.at(beam, force).amplitude)
    >>> bool(slope(8e-4) > 0)  # at four times the force
    True
    """

    model: Structure
    force: Float[Array, ""]  # N
    motion: PeriodicMotion
    condition: Condition = eqx.field(static=True)
    value: Float[Array, ""] | None = None  # rad/s or m/s

    def __init__(
        self,
        model: Structure,
        force: float | Float[ArrayLike, ""],
        start: tuple[Float[ArrayLike, "coefficient mode"], float | Float[ArrayLike, ""]],
        *,
        condition: Condition = "frequency",
        value: float | Float[ArrayLike, ""] | None = None,
    ) -> None:
        self.motion = periodic_motion(model, force, start, condition=condition, value=value)
        if have_values(self.motion.converged) and not bool(self.motion.converged):
            raise InputError(
                f'no motion with `condition="{condition}"` was found near `start`: take a point of '
                "a response to this force, such as `curve.point(curve.at_events(…)[0])`."
            )
        self.model, self.condition = model, condition
        self.force = jnp.asarray(force, dtype=jnp.float64)
        self.value = None if value is None else jnp.asarray(value, dtype=jnp.float64)

    def at(
        self,
        model: Structure | None = None,
        force: float | Float[ArrayLike, ""] | None = None,
        *,
        value: float | Float[ArrayLike, ""] | None = None,
    ) -> PeriodicMotion:
        """The motion at other parameters, differentiable by them; by default the known ones.

        Returns a `PeriodicMotion`; NaN, with NaN derivatives, if the motion ceases to exist on the
        path, as a pair of folds does at a cusp: `follow_event` shows where.
        Raises `ValueError` for a model with other modes, monomials or effects and for a
        superfluous `value`.
        """
        if value is not None and self.value is None:
            raise InputError(f'`condition="{self.condition}"` takes no `value`.')
        known = self.model, self.force, self.value
        new = (
            self.model if model is None else model,
            self.force if force is None else jnp.asarray(force, dtype=jnp.float64),
            self.value if value is None else jnp.asarray(value, dtype=jnp.float64),
        )
        _check_alike(known[0], new[0])
        return _continued(known, numbers_as_arrays(new), self.motion, self.condition)


def _check_alike(known: Structure, new: Structure) -> None:
    def kind(model: Structure) -> tuple:
        effects = tuple(type(effect) for effect in model.effects)
        return model.n_modes, model.potential.monomials, effects, _shapes(model)

    parts = ("modes", "monomials", "effects", "numbers")
    for what, one, other in zip(parts, kind(known), kind(new), strict=True):
        if one != other:
            raise InputError(f"`model` has other {what} than the one that the motion is known of.")


def _shapes(model: Structure) -> list[tuple[int, ...]]:
    return [np.shape(leaf) for leaf in jax.tree.leaves(model)]


class _Path(NamedTuple):
    """State of the continuation along the line: position, motion and its derivatives."""

    fraction: Float[Array, ""]  # of the line
    motion: tuple[Array, Array]  # coefficients and frequency
    slope: tuple[Array, Array]
    step: Float[Array, ""]
    trials: Int[Array, ""]
    known: Bool[Array, ""]


@compiled
def _continued(
    known: tuple, new: tuple, motion: PeriodicMotion, condition: Condition
) -> PeriodicMotion:
    here, there, begin = jax.lax.stop_gradient((known, new, motion))
    # Leaf by leaf: what is not a number, such as a name, is taken from the new parameters.
    (begins, _), (ends, kind) = jax.tree.flatten(here), jax.tree.flatten(there)

    def solved(fraction: Array, start: tuple[Array, Array]) -> tuple[tuple, tuple, Array]:
        """The motion at a fraction of the line, its derivatives by it, and whether it converged."""

        def at(fraction: Array) -> tuple[tuple[Array, Array], Array]:
            moved = [a + fraction * (b - a) for a, b in zip(begins, ends, strict=True)]
            model, force, value = jax.tree.unflatten(kind, moved)
            solution = motion_near(model, force, start, condition, value, _ITERATIONS)
            return (solution.coefficients, solution.frequency), solution.converged

        point, slope, good = jax.jvp(at, (fraction,), (jnp.ones_like(fraction),), has_aux=True)
        return point, slope, good

    def body(path: _Path) -> _Path:
        fraction = jnp.minimum(path.fraction + path.step, 1.0)
        ahead = fraction - path.fraction
        guess = jax.tree.map(lambda a, b: a + ahead * b, path.motion, path.slope)
        point, slope, good = solved(fraction, guess)
        back = point[0] - ahead * slope[0] - path.motion[0]  # mismatch of the backward prediction
        moves = point[0] - path.motion[0], point[0] - guess[0], back
        far, *misses = (jnp.max(jnp.abs(move)) for move in moves)
        off, amplitude = jnp.maximum(*misses), jnp.max(jnp.abs(path.motion[0]))
        near = (off <= _LATE * far) | (off <= _ROUNDING * amplitude)
        near &= jnp.abs(point[1] - path.motion[1]) <= _LARGEST_SHIFT * path.motion[1]
        good &= near
        longer = jnp.where(off <= 0.3 * _LATE * far, 2.0, 1.0)
        onward = _Path(
            fraction, point, slope, jnp.where(good, longer, 0.5) * path.step, path.trials + 1, good
        )
        kept = path._replace(step=0.5 * path.step, trials=path.trials + 1)
        return jax.tree.map(lambda a, b: jnp.where(good, a, b), onward, kept)

    def going(path: _Path) -> Array:
        unfinished = path.known & (path.fraction < 1.0)
        return unfinished & (path.step >= _SHORTEST) & (path.trials < _TRIALS)

    zero = jnp.zeros(())
    start, slope, good = solved(zero, (begin.coefficients, begin.frequency))
    path = _Path(zero, start, slope, jnp.ones(()), jnp.zeros((), dtype=int), good)
    path = jax.lax.while_loop(going, body, path)
    arrived = path.known & (path.fraction >= 1.0)
    end = jax.tree.map(lambda a: jnp.where(arrived, a, jnp.nan), path.motion)
    model, force, value = new
    return motion_near(model, force, end, condition, value, _ITERATIONS)
