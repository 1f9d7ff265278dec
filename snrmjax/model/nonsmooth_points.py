"""Nonsmooth points of a force over a cycle: crossing times, and corrections of sampled sums."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from snrmjax.numerics.compiled import compiled

Samples = Float[Array, " time"]


class NonsmoothPoints(NamedTuple):
    """Displacements at which the slope of a force jumps, and by how much from below to above."""

    displacement: Float[Array, " point"]
    slope: Float[Array, " point"]


class Crossings(NamedTuple):
    """Crossings of a displacement by a periodic motion, in a table of fixed length."""

    valid: Bool[Array, " crossing"]  # false for unused entries
    interval: Int[Array, " crossing"]  # the sample before
    fraction: Float[Array, " crossing"]  # of the interval between two samples
    rate: Float[Array, " crossing"]  # derivatives extremum, per sample
    curvature: Float[Array, " crossing"]


Cubic = tuple[Array, Array, Array, Array]  # its coefficients, of rising order

_MAX_CROSSINGS = 16  # of one displacement in a period


def crossings(displacement: Samples, threshold: Float[Array, ""]) -> Crossings:
    """Crossings of a threshold, by a cubic through the four samples around each interval.

    At most two per interval, where a contact just closes, and 16 per period.
    """
    n = displacement.shape[0]
    valid, fractions = _sign_changes(jax.lax.stop_gradient(displacement - threshold))
    (slot,) = jnp.nonzero(valid.reshape(-1), size=_MAX_CROSSINGS, fill_value=0)
    interval, fraction = slot // 2, fractions.reshape(-1)[slot]
    known = jnp.arange(_MAX_CROSSINGS) < jnp.sum(valid)
    around = displacement[(interval + np.arange(-1, 3)[:, None]) % n] - threshold
    cubic = _cubic(around)
    fraction = _differentiable(fraction, cubic, known)
    return Crossings(known, interval, fraction, *_slopes(fraction, cubic))


def _slopes(fraction: Array, cubic: Cubic) -> tuple[Array, Array]:
    """First and second derivative of a cubic."""
    _, c1, c2, c3 = cubic
    return c1 + fraction * (2 * c2 + fraction * 3 * c3), 2 * c2 + 6 * fraction * c3


def _derivative(cubic: Cubic) -> Cubic:
    _, c1, c2, c3 = cubic
    return c1, 2 * c2, 3 * c3, jnp.zeros_like(c3)


def _value(fraction: Array, cubic: Cubic) -> Array:
    first, c1, c2, c3 = cubic
    return first + fraction * (c1 + fraction * (c2 + fraction * c3))


def _differentiable(fraction: Array, cubic: Cubic, known: Array) -> Array:
    """Known roots of cubics with their derivatives."""
    slope = jax.lax.stop_gradient(_slopes(fraction, cubic)[0])
    good = known & (slope != 0)
    # Each Newton step with this frozen slope makes one more order of derivatives exact.
    for _ in range(2):
        value = _value(fraction, cubic)
        fraction = fraction - jnp.where(good, value / jnp.where(good, slope, 1.0), 0.0)
    return fraction


def _sign_changes(x: Samples) -> tuple[Bool[Array, "time 2"], Float[Array, "time 2"]]:
    """Zeros of x within every interval, up to two, as fractions of it."""
    cubic = _cubic(_around(x))
    first, second = cubic[0], jnp.roll(x, -1)
    once = (first < 0) != (second < 0)
    # A turning point between two samples of one sign may cross zero: then there are two zeros.
    turn = _turning_point(cubic)
    extremum, curvature = _value(turn, cubic), _slopes(turn, cubic)[1]
    twice = ~once & (turn > 0) & ((extremum < 0) != (first < 0)) & (curvature * extremum < 0)
    half_distance = jnp.sqrt(
        jnp.where(twice, -2 * extremum / jnp.where(twice, curvature, 1.0), 0.0)
    )
    single = _first_root(cubic, second, once)
    fraction = jnp.stack([jnp.where(once, single, turn - half_distance), turn + half_distance])
    return jnp.stack([once | twice, twice], axis=1), _improved(fraction, cubic).T


def _around(x: Samples) -> Float[Array, "4 time"]:
    """Every sample with the one before and the two after it."""
    return jnp.stack([jnp.roll(x, -k) for k in (-1, 0, 1, 2)])


def _turning_point(cubic: Cubic) -> Array:
    """Where a cubic turns within its interval, as a fraction of it; -1 where it does not."""
    _, c1, c2, c3 = jax.lax.stop_gradient(cubic)
    square = c2**2 - 3 * c1 * c3
    root = jnp.sqrt(jnp.where(square > 0, square, 1.0))
    below = jnp.where(c2 < 0, c2 - root, c2 + root)
    turns = -c1 / jnp.where(below != 0, below, 1.0), -below / jnp.where(c3 != 0, 3 * c3, 1.0)
    first, second = (jnp.where((square > 0) & (t > 0) & (t < 1), t, -1.0) for t in turns)
    return jnp.where(first > 0, first, second)


def _first_root(cubic: Cubic, second: Array, wanted: Array) -> Array:
    """First root of the parabola through both ends of an interval with the slope at the first."""
    first, c1, _, _ = cubic
    root = jnp.sqrt(jnp.maximum(c1**2 - 4 * (second - first - c1) * first, 0.0))
    below = jnp.where(wanted, -c1 + jnp.sign(first) * root, 1.0)
    return 2 * first / jnp.where(below != 0, below, 1.0)


def _improved(fraction: Array, cubic: Cubic) -> Array:
    """Roots of cubics in their intervals by three steps of Newton's method."""
    for _ in range(3):
        rate = _slopes(fraction, cubic)[0]
        step = jnp.where(rate != 0, _value(fraction, cubic) / jnp.where(rate != 0, rate, 1.0), 0.0)
        fraction = jnp.clip(fraction - step, 0.0, 1.0)
    return fraction


def _cubic(x: Float[Array, "4 crossing"]) -> Cubic:
    """Coefficients of the cubic through four samples, in fractions of the middle interval."""
    before, first, second, after = x
    linear = second - first / 2 - before / 3 - after / 6
    square = 0.5 * (before + second) - first
    return first, linear, square, (after - before) / 6 + 0.5 * (first - second)


@compiled  # traced once for the force, its Jacobian and each derivative of them
def with_nonsmooth_points(
    force: Samples, displacement: Samples, nonsmooth_points: NonsmoothPoints
) -> Samples:
    """Samples of a force over a period, corrected so that sums over them are integrals.

    The error of the trapezoidal rule for a corner at the fraction θ of an interval is
    −J₁B₂(θ)/2 + J₂B₃(θ)/6 (Euler–Maclaurin, with Bernoulli polynomials and the jumps of the
    first and second derivative per sample). Its correction, for every smooth weight, is added to
    the two samples: the error is then of fourth order in the interval, and sums do not jump when a
    corner moves from one interval to the next.
    Reference: Abramowitz & Stegun, Handbook of Mathematical Functions (1964), 23.1.30.
    """
    for threshold, slope in zip(nonsmooth_points.displacement, nonsmooth_points.slope, strict=True):
        valid, interval, theta, rate, curvature = crossings(displacement, threshold)
        first_jump = jnp.where(valid, slope * jnp.abs(rate), 0.0)
        second_jump = jnp.where(valid, slope * jnp.sign(rate) * curvature, 0.0)
        force = _corrected(force, interval, theta, first_jump, second_jump)
    return force


def _corrected(
    force: Samples, interval: Array, theta: Array, first_jump: Array, second_jump: Array
) -> Samples:
    """Samples with the correction of corners: see `with_nonsmooth_points`."""
    n = force.shape[0]
    square = theta * (theta - 1) + 1 / 6
    cube = theta * (theta - 0.5) * (theta - 1)
    whole = first_jump * square / 2 - second_jump * cube / 6
    later = theta * whole - first_jump * cube / 3
    # A matrix product is faster than scattered writes, whose derivatives become loops.
    samples = (interval[:, None] + np.arange(2)) % n
    spread = (samples[..., None] == np.arange(n)).astype(force.dtype)
    return force + jnp.stack([whole - later, later], 1).reshape(-1) @ spread.reshape(-1, n)


def with_extremes(displacement: Samples) -> Float[Array, "time 2"]:
    """For each sample: the extreme value in the interval before it, and the sample.

    By the cubic through the four samples around each interval; where it does not turn in between
    the sample stands twice.
    """
    cubic = _cubic(_around(displacement))
    turn = _turning_point(cubic)
    turn, turns = _differentiable(turn, _derivative(cubic), turn > 0), turn > 0
    between = jnp.where(turns, _value(turn, cubic), jnp.roll(displacement, -1))
    return jnp.stack([jnp.roll(between, 1), displacement], axis=1)


@compiled
def with_slip_corners(
    position: Samples, displacement: Samples, slip_displacement: Float[Array, ""]
) -> Samples:
    """Positions of a slider over a period, corrected so that sums over them are integrals.

    A slider at z starts to move where |q − z| reaches x_s, and stops where q turns: corners of z,
    whose first and second derivatives jump by those of q. With more than 16 in a period, as of four
    and more oscillations, nothing is corrected. See `with_nonsmooth_points`.
    """
    n, (z, q, slip) = len(position), (position, displacement, slip_displacement)
    kind, side, fraction = _slip_corners(*jax.lax.stop_gradient((z, q, slip)))
    (slot,) = jnp.nonzero(kind.reshape(-1), size=_MAX_CROSSINGS, fill_value=0)
    interval, starts, total = slot // 2, slot % 2 == 0, jnp.sum(kind)
    known = (jnp.arange(_MAX_CROSSINGS) < total) & (total <= _MAX_CROSSINGS)
    cubic = _cubic(q[(interval + np.arange(-1, 3)[:, None]) % n])
    beyond = cubic[0] - z[interval] - side[interval] * slip
    # A slider starts at a root of the displacement beyond slip, and stops at one of its slope.
    start, stop = (beyond, *cubic[1:]), _derivative(cubic)
    equation: Cubic = jax.tree.map(lambda *of: jnp.where(starts, *of), start, stop)
    theta = _differentiable(fraction.reshape(-1)[slot], equation, known)
    rate, curvature = _slopes(theta, cubic)
    first_jump = jnp.where(known & starts, rate, 0.0)
    second_jump = jnp.where(known, jnp.where(starts, curvature, -curvature), 0.0)
    return _corrected(z, interval, theta, first_jump, second_jump)


def _slip_corners(z: Samples, q: Samples, slip: Array) -> tuple[Array, Array, Array]:
    """Whether slip starts and stops in each interval, its direction, and where (0…1)."""
    cubic, second = _cubic(_around(q)), jnp.roll(q, -1)
    turn = _turning_point(cubic)
    extremum = jnp.where(turn > 0, _value(turn, cubic), second)
    rises = jnp.maximum(extremum, second) > z + slip
    side = jnp.where(rises, 1.0, jnp.where(jnp.minimum(extremum, second) < z - slip, -1.0, 0.0))
    # Within rounding of the slip limit: already slipping.
    slips = slip - jnp.abs(q - z) <= 1e-12 * (slip + jnp.abs(q))
    starts = (side != 0) & ~slips
    beyond: Cubic = side * (q - z) - slip, side * cubic[1], side * cubic[2], side * cubic[3]
    root = _first_root(beyond, side * (second - z) - slip, starts)
    root = _improved(jnp.clip(root, 0.0, 1.0), beyond)
    stops = (turn > 0) & (side * (extremum - z) > slip)
    return jnp.stack([starts, stops], 1), side, jnp.stack([root, turn], 1)
