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
    first, c1, c2, c3 = _cubic(around)
    slope = jax.lax.stop_gradient(c1 + fraction * (2 * c2 + fraction * 3 * c3))
    good = known & (slope != 0)
    # Each Newton step with this frozen slope makes one more order of derivatives exact.
    for _ in range(2):
        value = first + fraction * (c1 + fraction * (c2 + fraction * c3))
        fraction = fraction - jnp.where(good, value / jnp.where(good, slope, 1.0), 0.0)
    rate = c1 + fraction * (2 * c2 + fraction * 3 * c3)
    return Crossings(known, interval, fraction, rate, 2 * c2 + 6 * fraction * c3)


def _sign_changes(x: Samples) -> tuple[Bool[Array, "time 2"], Float[Array, "time 2"]]:
    """Zeros of x within every interval, up to two, as fractions of it."""
    first, c1, c2, c3 = _cubic(jnp.stack([jnp.roll(x, -k) for k in (-1, 0, 1, 2)]))
    second = jnp.roll(x, -1)
    once = (first < 0) != (second < 0)
    # A turning point between two samples of one sign may cross zero: then extremum are two zeros.
    turn = jnp.where(c2 != 0, -0.5 * c1 / jnp.where(c2 != 0, c2, 1.0), -1.0)
    for _ in range(2):
        curvature = 2 * c2 + 6 * turn * c3
        turn = turn - jnp.where(
            curvature != 0,
            (c1 + turn * (2 * c2 + turn * 3 * c3)) / jnp.where(curvature != 0, curvature, 1.0),
            0.0,
        )
    extremum, curvature = first + turn * (c1 + turn * (c2 + turn * c3)), 2 * c2 + 6 * turn * c3
    twice = (
        ~once
        & (turn > 0)
        & (turn < 1)
        & ((extremum < 0) != (first < 0))
        & (curvature * extremum < 0)
    )
    half_distance = jnp.sqrt(
        jnp.where(twice, -2 * extremum / jnp.where(twice, curvature, 1.0), 0.0)
    )
    # The parabola through both ends with the slope at the first has one root in between.
    root = jnp.sqrt(jnp.maximum(c1**2 - 4 * (second - first - c1) * first, 0.0))
    below = jnp.where(once, -c1 - jnp.sign(second - first) * root, 1.0)
    single = 2 * first / jnp.where(below != 0, below, 1.0)
    fraction = jnp.stack([jnp.where(once, single, turn - half_distance), turn + half_distance])
    for _ in range(3):
        rate = c1 + fraction * (2 * c2 + fraction * 3 * c3)
        value = first + fraction * (c1 + fraction * (c2 + fraction * c3))
        step = jnp.where(rate != 0, value / jnp.where(rate != 0, rate, 1.0), 0.0)
        fraction = jnp.clip(fraction - step, 0.0, 1.0)
    return jnp.stack([once | twice, twice], axis=1), fraction.T


def _cubic(x: Float[Array, "4 crossing"]) -> tuple[Array, Array, Array, Array]:
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
    n = force.shape[0]
    for threshold, slope in zip(nonsmooth_points.displacement, nonsmooth_points.slope, strict=True):
        valid, interval, theta, rate, curvature = crossings(displacement, threshold)
        first_jump = jnp.where(valid, slope * jnp.abs(rate), 0.0)
        second_jump = jnp.where(valid, slope * jnp.sign(rate) * curvature, 0.0)
        square = theta * (theta - 1) + 1 / 6
        cube = theta * (theta - 0.5) * (theta - 1)
        whole = first_jump * square / 2 - second_jump * cube / 6
        later = theta * whole - first_jump * cube / 3
        # A matrix product is faster than scattered writes, whose derivatives become loops.
        samples = (interval[:, None] + np.arange(2)) % n
        spread = (samples[..., None] == np.arange(n)).astype(force.dtype)
        force = force + jnp.stack([whole - later, later], 1).reshape(-1) @ spread.reshape(-1, n)
    return force
