"""Where a joint fit begins: instruments' gain and phase, then rough curves, by least squares."""

import itertools
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from snrmjax.identify.curves.families import Polynomial, values_and_slopes
from snrmjax.identify.curves.family_base import AbstractFamily
from snrmjax.identify.curves.splines import Spline
from snrmjax.identify.joint.force_balance import (
    LEVEL_ERRORS,
    BalanceProblem,
    Unknowns,
)
from snrmjax.identify.joint.free_unknowns import recorded_motion_of

_LARGEST_POLYNOMIAL, _MOST_KNOTS = 4, 10
_APART = 1.5  # ratio of amplitudes that tells one more term of a curve


class _Point(NamedTuple):
    """What one state says with the linear parameters of the initial guess."""

    displacement: np.ndarray
    speed: np.ndarray
    squared: np.ndarray
    damping: np.ndarray
    weight: np.ndarray


def initial_guess(problem: BalanceProblem, free: tuple[str, ...]) -> Unknowns:
    """Rough unknowns from linear least squares: gain and phase first, then curves."""
    data = problem.data
    gain, phase = 0.0, 0.0
    if "force_gain" in free or "instrument_phase" in free:
        factor = _complex_gain(problem, complex_too="instrument_phase" in free)
        gain = float(np.log(abs(factor))) if "force_gain" in free else 0.0
        phase = float(np.angle(factor)) if "instrument_phase" in free else 0.0
    flat = Polynomial(jnp.ones(1), jnp.ones(()), "displacement")
    start = Unknowns(
        squared_frequency=flat,
        modal_damping=flat,
        log_force_gain=jnp.asarray(gain),
        force_offset=jnp.asarray(0.0),
        instrument_phase=jnp.asarray(phase),
        level=jnp.zeros((data.n_levels, len(LEVEL_ERRORS))),
        linear=jnp.zeros(problem.prior.linear.shape[0]),
    )
    point = _points(start, problem)
    most = most_parameters(point.speed, data.n_levels)
    sizes: list[tuple[type[AbstractFamily], int]] = []
    sizes += [(Polynomial, k) for k in range(min(_LARGEST_POLYNOMIAL, most - 1) + 1)]
    sizes += [(Spline, k) for k in range(3, min(_MOST_KNOTS, most) + 1)]
    n = len(point.speed)

    def curve(values: np.ndarray) -> AbstractFamily:
        tried = []
        for kind, size in sizes:
            own = (point.displacement, values, point.weight)
            family = kind.starts(size, "displacement", *own)[0]
            left = (values_and_slopes(family, point.displacement)[0] - values) * point.weight
            parameters = family.parameters.shape[0]
            tried.append((n * np.log(np.sum(left**2)) + parameters * np.log(n), family))
        return min(tried, key=lambda pair: pair[0])[1]

    return eqx.tree_at(
        lambda u: (u.squared_frequency, u.modal_damping),
        start,
        (curve(point.squared), curve(point.damping)),
    )


def _complex_gain(problem: BalanceProblem, *, complex_too: bool) -> complex:
    """G of K X/A = G F with K polynomial in the amplitude, by linear least squares."""
    data, constant = problem.data, float(problem.modal_constant)
    omega, velocity, force = (
        np.asarray(part) for part in (data.frequency, data.velocity, data.force)
    )
    x = velocity / (1j * omega) / constant
    a = np.abs(x) / np.abs(x).max()
    columns = [x, x * a**2, x * a**4, 1j * omega * x, 1j * omega * x * a, 1j * omega * x * a**2]
    columns += [-force + 0j, -1j * force][: 2 if complex_too else 1]
    right = omega**2 * x
    matrix = np.stack([np.concatenate([c.real, c.imag]) for c in columns], axis=1)
    target = np.concatenate([right.real, right.imag])
    weight = np.tile(1.0 / np.maximum(np.abs(x), 1e-300), 2)
    size = np.linalg.norm(matrix * weight[:, None], axis=0)
    answer = np.linalg.lstsq(matrix * weight[:, None] / size, target * weight, rcond=1e-13)[0]
    gain = complex(*(answer / size)[6:]) if complex_too else complex((answer / size)[6])
    return gain if gain != 0 else 1.0 + 0.0j


def _points(start: Unknowns, problem: BalanceProblem) -> _Point:
    motion = recorded_motion_of(start, problem)
    own, force = np.asarray(motion.velocity), np.asarray(motion.force)
    data, constant = problem.data, float(problem.modal_constant)
    omega, std = np.asarray(data.frequency), np.asarray(data.std)
    stiffness = constant * force * 1j * omega / own
    return _Point(
        displacement=np.asarray(motion.displacement),
        speed=np.abs(own),
        squared=omega**2 + stiffness.real,
        damping=stiffness.imag / omega,
        weight=1.0 / (np.abs(stiffness) * np.mean(std[:, 1:3], axis=1)),
    )


def most_parameters(amplitude: Float[np.ndarray, " state"], n_levels: int) -> int:
    """How many parameters of a curve the spread of amplitudes, or the levels, can tell apart."""
    apart = np.log(np.max(amplitude) / np.min(amplitude)) / np.log(_APART)
    return int(np.clip(max(apart, n_levels - 2), 1, max(len(amplitude) // 4, 1)))


def levels_apart(amplitude: Float[np.ndarray, " state"], level: Int[np.ndarray, " state"]) -> bool:
    """Whether no level shares half of its amplitudes, or of its neighbour's, with the next."""
    size = np.log(amplitude)
    ends = sorted((size[level == k].min(), size[level == k].max()) for k in np.unique(level))
    return all(
        below[1] - above[0] < 0.5 * min(below[1] - below[0], above[1] - above[0])
        for below, above in itertools.pairwise(ends)
    )
