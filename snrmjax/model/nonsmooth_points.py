"""Kinks of a force over a cycle: when they are passed, and what they do to sums over samples."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

Samples = Float[Array, " time"]


class NonsmoothPoints(NamedTuple):
    """Displacements at which the slope of a force jumps, and by how much from below to above."""

    displacement: Float[Array, " kink"]
    slope: Float[Array, " kink"]


class Crossings(NamedTuple):
    """Where a periodic motion passes a displacement: the first times of a period."""

    passes: Bool[Array, " crossing"]  # false of entries without use
    interval: Int[Array, " crossing"]  # the sample before
    fraction: Float[Array, " crossing"]  # of the interval between two samples
    rate: Float[Array, " crossing"]  # derivatives there, over samples
    curvature: Float[Array, " crossing"]


_MOST = 16  # passings of one displacement in a period


def crossings(displacement: Samples, place: Float[Array, ""]) -> Crossings:
    """Passings of a displacement, by a cubic through the four samples around each interval.

    There may be two within one interval, where a contact just closes; no more than 16 in a period.
    """
    n = displacement.shape[0]
    passes, fractions = _passings(jax.lax.stop_gradient(displacement - place))
    (slot,) = jnp.nonzero(passes.reshape(-1), size=_MOST, fill_value=0)
    interval, fraction = slot // 2, fractions.reshape(-1)[slot]
    known = jnp.arange(_MOST) < jnp.sum(passes)
    around = displacement[(interval + np.arange(-1, 3)[:, None]) % n] - place
    first, c1, c2, c3 = _cubic(around)
    slope = jax.lax.stop_gradient(c1 + fraction * (2 * c2 + fraction * 3 * c3))
    good = known & (slope != 0)
    # Each further step of Newton's method with this slope carries one more order of derivatives.
    for _ in range(2):
        value = first + fraction * (c1 + fraction * (c2 + fraction * c3))
        fraction = fraction - jnp.where(good, value / jnp.where(good, slope, 1.0), 0.0)
    rate = c1 + fraction * (2 * c2 + fraction * 3 * c3)
    return Crossings(known, interval, fraction, rate, 2 * c2 + 6 * fraction * c3)


def _passings(x: Samples) -> tuple[Bool[Array, "time 2"], Float[Array, "time 2"]]:
    """Where x vanishes within every interval, up to twice, and at which shares of it."""
    first, c1, c2, c3 = _cubic(jnp.stack([jnp.roll(x, -k) for k in (-1, 0, 1, 2)]))
    second = jnp.roll(x, -1)
    once = (first < 0) != (second < 0)
    # A turn between two samples of one sign that reaches beyond.
    turn = jnp.where(c2 != 0, -0.5 * c1 / jnp.where(c2 != 0, c2, 1.0), -1.0)
    for _ in range(2):
        bend = 2 * c2 + 6 * turn * c3
        turn = turn - jnp.where(
            bend != 0, (c1 + turn * (2 * c2 + turn * 3 * c3)) / jnp.where(bend != 0, bend, 1.0), 0.0
        )
    there, bend = first + turn * (c1 + turn * (c2 + turn * c3)), 2 * c2 + 6 * turn * c3
    twice = ~once & (turn > 0) & (turn < 1) & ((there < 0) != (first < 0)) & (bend * there < 0)
    aside = jnp.sqrt(jnp.where(twice, -2 * there / jnp.where(twice, bend, 1.0), 0.0))
    # By the parabola through both ends with the slope at the first, of which one root is between.
    root = jnp.sqrt(jnp.maximum(c1**2 - 4 * (second - first - c1) * first, 0.0))
    below = jnp.where(once, -c1 - jnp.sign(second - first) * root, 1.0)
    single = 2 * first / jnp.where(below != 0, below, 1.0)
    fraction = jnp.stack([jnp.where(once, single, turn - aside), turn + aside])
    for _ in range(3):
        rate = c1 + fraction * (2 * c2 + fraction * 3 * c3)
        value = first + fraction * (c1 + fraction * (c2 + fraction * c3))
        step = jnp.where(rate != 0, value / jnp.where(rate != 0, rate, 1.0), 0.0)
        fraction = jnp.clip(fraction - step, 0.0, 1.0)
    return jnp.stack([once | twice, twice], axis=1), fraction.T


def _cubic(x: Float[Array, "4 crossing"]) -> tuple[Array, Array, Array, Array]:
    """The cubic through four samples, by powers of the share of the middle interval."""
    before, first, second, behind = x
    linear = second - first / 2 - before / 3 - behind / 6
    square = 0.5 * (before + second) - first
    return first, linear, square, (behind - before) / 6 + 0.5 * (first - second)


def with_nonsmooth_points(
    force: Samples, displacement: Samples, nonsmooth_points: NonsmoothPoints
) -> Samples:
    """Samples of a force over a period, changed so that sums over them are integrals.

    The trapezoidal rule errs at a kink between two samples, at θ of their interval, by
    −J₁B₂(θ)/2 + J₂B₃(θ)/6 (Euler and Maclaurin, with Bernoulli's polynomials and the jumps of the
    first and second derivative over samples). What makes up for it, for every smooth weight, is
    added to the two samples: sums then err with the fourth power of the interval and do not jump
    when a kink goes from one interval to the next.
    Reference: Abramowitz & Stegun, Handbook of Mathematical Functions (1964), 23.1.30.
    """
    n = force.shape[0]
    for place, slope in zip(nonsmooth_points.displacement, nonsmooth_points.slope, strict=True):
        passes, interval, theta, rate, curvature = crossings(displacement, place)
        first_jump = jnp.where(passes, slope * jnp.abs(rate), 0.0)
        second_jump = jnp.where(passes, slope * jnp.sign(rate) * curvature, 0.0)
        square = theta * (theta - 1) + 1 / 6
        cube = theta * (theta - 0.5) * (theta - 1)
        whole = first_jump * square / 2 - second_jump * cube / 6
        later = theta * whole - first_jump * cube / 3
        # A product is faster than writing to entries, of which derivatives make loops.
        samples = (interval[:, None] + np.arange(2)) % n
        spread = (samples[..., None] == np.arange(n)).astype(force.dtype)
        force = force + jnp.stack([whole - later, later], 1).reshape(-1) @ spread.reshape(-1, n)
    return force
