"""Forced responses by harmonic balance: whole curves, folds and resonances included."""

from collections.abc import Iterable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from snrmjax.model.structure import Structure
from snrmjax.simulate.continuation import (
    Curve,
    CurveStatus,
    StepControl,
    correct,
    follow_curve,
    locate_event,
)
from snrmjax.simulate.harmonic_balance import (
    HarmonicBalance,
    harmonic_balance,
    linear_coefficients,
    resonance_displacement,
)
from snrmjax.simulate.harmonics import velocity_phasors
from snrmjax.simulate.stability import floquet_multipliers, is_stable, steps_per_period

DEFAULT_STEPS = StepControl()


class ResponseCurve(NamedTuple):
    """One forced response in order along the curve, unstable parts included."""

    force: float  # N
    frequency: Float[np.ndarray, " point"]  # rad/s
    coefficients: Float[np.ndarray, "point coefficient mode"]  # kg^1/2 m
    velocity: Complex[np.ndarray, "point harmonic sensor"]  # m/s, h = 0…H
    stable: Bool[np.ndarray, " point"]
    event: tuple[str, ...]  # "", "fold", "peak" or "phase_resonance" for every point
    status: CurveStatus
    sensors: tuple[str, ...]

    def at_events(self, kind: str) -> np.ndarray:
        """Indices of the points at which an event of this kind was located."""
        return np.array([k for k, e in enumerate(self.event) if kind in e.split("+")], dtype=int)


def forced_response(
    model: Structure,
    forces: Iterable[float],
    from_frequency: float,
    to_frequency: float,
    *,
    harmonic_order: int = 9,
    steps: StepControl = DEFAULT_STEPS,
    max_points: int = 4000,
    n_samples: int | None = None,
) -> list[ResponseCurve]:
    """Follow the response to a cosine force through a frequency range, once for every force.

    Starts from the linear response at `from_frequency` and follows the curve around its folds
    by pseudo-arclength continuation until it leaves the range. Folds, peaks of the velocity
    fundamental at the first sensor and phase resonances of the mode of interest are located
    between the steps and inserted with a name in `event`.

    Arguments: `forces` in N, frequencies in rad/s.
    Returns one `ResponseCurve` for every force; its `status` says how it ended. When the curve
    from the lower end does not reach the upper one, it is followed from the upper end instead,
    and when that does not reach the lower end either, both parts are returned, a part without a
    start being empty. Isolated branches and second wells are not searched for.
    Raises `ValueError` for a force that is not positive and for an empty or endless frequency
    range.
    """
    if not 0 < from_frequency < to_frequency < np.inf:
        raise ValueError(
            "`from_frequency` must be positive and below a finite `to_frequency`, but they are "
            f"{from_frequency:g} and {to_frequency:g} rad/s."
        )
    curves = []
    for force in forces:
        if not force > 0 or not np.isfinite(force):
            raise ValueError(f"every force must be positive, but one is {force!r} N.")
        scale = resonance_displacement(model, force)
        balance = harmonic_balance(
            model, force, scale, harmonic_order=harmonic_order, n_samples=n_samples
        )
        ends = jnp.asarray([from_frequency, to_frequency])
        upward = _follow(balance, ends, steps, max_points, jnp.array(False))
        if int(upward.status) == CurveStatus.UPPER_END:
            curves.append(_assemble(balance, upward, float(force), steps))
            continue
        # Below a strong softening the lower end has several solutions; the upper end has one.
        downward = _follow(balance, ends, steps, max_points, jnp.array(True))
        if int(downward.status) == CurveStatus.LOWER_END:
            curves.append(_assemble(balance, _reversed(downward), float(force), steps))
            continue
        curves += [
            _assemble(balance, part, float(force), steps) for part in (upward, _reversed(downward))
        ]
    return curves


def solve_at_frequency(
    model: Structure,
    force: Float[Array, " state"],
    frequency: Float[Array, " state"],
    start: Float[Array, "state coefficient mode"],
) -> tuple[Float[Array, "state coefficient mode"], Bool[Array, " state"]]:
    """Periodic motions at given forces (N) and frequencies (rad/s), each from its own guess.

    Returns the Fourier coefficients (kg^1/2 m), NaN where Newton's method did not converge, and
    whether it did.
    """
    coefficients, converged = _solve_batch(model, force, frequency, start)
    return jnp.where(converged[:, None, None], coefficients, jnp.nan), converged


@eqx.filter_jit
def _solve_batch(model: Structure, force: Array, frequency: Array, start: Array) -> tuple:
    harmonic_order = (start.shape[1] - 1) // 2

    def one(force: Array, frequency: Array, start: Array) -> tuple[Array, Array]:
        # A guess of zero is allowed: the static displacement keeps the unknowns of order one.
        static = force * model.modes.participation / model.modes.natural_frequency**2
        scale = jnp.maximum(jnp.max(jnp.abs(start)), jnp.max(jnp.abs(static)))
        balance = harmonic_balance(model, force, scale, harmonic_order=harmonic_order)
        guess = balance.point(start, frequency)
        fixed = jnp.zeros_like(guess).at[-1].set(1.0)
        point, _, _, converged = correct(balance.linearised, guess, fixed, 1e-10, 30)
        return balance.coefficients(point), converged

    return jax.lax.map(lambda args: one(*args), (force, frequency, start))


@eqx.filter_jit
def _follow(
    balance: HarmonicBalance,
    ends: Array,
    steps: StepControl,
    max_points: int,
    downward: Bool[Array, ""],
) -> Curve:
    model, order = balance.model, balance.harmonic_order
    begin = jnp.where(downward, ends[1], ends[0])
    start = balance.point(linear_coefficients(model, balance.force, begin, order), begin)
    direction = jnp.zeros_like(start).at[-1].set(jnp.where(downward, -1.0, 1.0))
    return follow_curve(
        balance.linearised,
        start,
        direction,
        ends[0] / balance.frequency_scale,
        ends[1] / balance.frequency_scale,
        jnp.array(jnp.inf),
        steps,
        max_points,
    )


def _reversed(curve: Curve) -> Curve:
    """The same curve in the opposite order."""
    n = curve.n_points
    order = jnp.where(jnp.arange(len(curve.points)) < n, n - 1 - jnp.arange(len(curve.points)), -1)
    end = {
        int(CurveStatus.LOWER_END): CurveStatus.UPPER_END,
        int(CurveStatus.UPPER_END): CurveStatus.LOWER_END,
    }.get(int(curve.status), CurveStatus(int(curve.status)))
    return Curve(curve.points[order], -curve.tangents[order], n, jnp.array(int(end)))


def _mode_velocity(balance: HarmonicBalance, point: Array) -> Array:
    """Phasor of the velocity fundamental of the mode of interest, scaled."""
    modes = balance.model.modes
    x = balance.coefficients(point)[:, modes.mode_of_interest] / balance.displacement_scale
    return (
        1j * point[-1] * (x[1] - 1j * x[2]) * jnp.sign(modes.participation[modes.mode_of_interest])
    )


def _sensor_velocity(balance: HarmonicBalance, point: Array) -> Array:
    """|velocity fundamental|² at the first sensor, scaled."""
    shape = balance.model.modes.mode_shape[0]
    x = balance.coefficients(point) @ shape / balance.displacement_scale
    return point[-1] ** 2 * (x[1] ** 2 + x[2] ** 2)


def _test_values(balance: HarmonicBalance, point: Array, tangent: Array) -> Array:
    """Functions that vanish at a fold, at a peak and at a phase resonance."""
    slope = jax.jvp(lambda p: _sensor_velocity(balance, p), (point,), (tangent,))[1]
    return jnp.stack([tangent[-1], slope, _mode_velocity(balance, point).imag])


EVENT_KINDS = ("fold", "peak", "phase_resonance")


@eqx.filter_jit
def _all_test_values(balance: HarmonicBalance, points: Array, tangents: Array) -> tuple:
    values = jax.vmap(lambda p, t: _test_values(balance, p, t))(points, tangents)
    in_phase = jax.vmap(lambda p: _mode_velocity(balance, p).real)(points)
    return values, in_phase


@eqx.filter_jit
def _locate(
    balance: HarmonicBalance,
    kind: Array,
    here: Array,
    tangent: Array,
    there: Array,
    steps: StepControl,
) -> tuple:
    def one(args: tuple) -> tuple:
        kind, here, tangent, there = args
        return locate_event(
            balance.linearised,
            lambda p, t: _test_values(balance, p, t)[kind],
            here,
            tangent,
            there,
            steps,
        )

    return jax.lax.map(one, (kind, here, tangent, there))


def _assemble(
    balance: HarmonicBalance, curve: Curve, force: float, steps: StepControl
) -> ResponseCurve:
    """Trim a curve, insert its events, add velocities and stability."""
    n = int(curve.n_points)
    size = balance.n_coefficients
    model = balance.model
    if n == 0:
        n_sensors = len(model.modes.sensors)
        return ResponseCurve(
            force,
            np.zeros(0),
            np.zeros((0, size, model.n_modes)),
            np.zeros((0, balance.harmonic_order + 1, n_sensors), dtype=np.complex128),
            np.zeros(0, dtype=bool),
            (),
            CurveStatus(int(curve.status)),
            model.modes.sensors,
        )
    points, labels = _insert_events(balance, curve, n, steps)
    slowest = float(np.min(points[:, -1])) * float(balance.frequency_scale)
    motion = _motion(balance, jnp.asarray(padded(points)), steps_per_period(model, slowest))
    frequency, coefficients, velocity, stable = (np.asarray(a)[: len(points)] for a in motion)
    return ResponseCurve(
        force=force,
        frequency=frequency,
        coefficients=coefficients,
        velocity=velocity,
        stable=stable,
        event=labels,
        status=CurveStatus(int(curve.status)),
        sensors=model.modes.sensors,
    )


@eqx.filter_jit
def _motion(
    balance: HarmonicBalance, points: Array, n_steps: int
) -> tuple[Array, Array, Array, Array]:
    """Frequency, coefficients, velocity and stability along a curve."""
    model = balance.model
    coefficients = jax.vmap(balance.coefficients)(points)
    frequency = points[:, -1] * balance.frequency_scale
    velocity = velocity_phasors(coefficients, frequency, model.modes.mode_shape)
    stable = is_stable(floquet_multipliers(model, coefficients, frequency, n_steps))
    return frequency, coefficients, velocity, stable


def padded(rows: np.ndarray, at_least: int = 128) -> np.ndarray:
    """Rows with copies of the last up to a power of two of them, so that few shapes compile."""
    missing = max(at_least, 1 << (len(rows) - 1).bit_length()) - len(rows)
    return np.concatenate([rows, np.repeat(rows[-1:], missing, axis=0)])


def _insert_events(
    balance: HarmonicBalance, curve: Curve, n: int, steps: StepControl
) -> tuple[np.ndarray, tuple[str, ...]]:
    values, in_phase = (
        np.asarray(v)[:n] for v in _all_test_values(balance, curve.points, curve.tangents)
    )
    points = np.asarray(curve.points)[:n]
    labels = [""] * n
    change = np.signbit(values[:-1]) != np.signbit(values[1:])
    # A peak is a maximum: the slope falls through zero. A phase resonance has Re V > 0.
    change[:, 1] &= values[:-1, 1] > 0
    change[:, 2] &= (in_phase[:-1] > 0) & (in_phase[1:] > 0)
    where, kind = np.nonzero(change)
    if not where.size:
        return points, tuple(labels)
    pad = -len(where) % 8
    index, what = np.append(where, [where[0]] * pad), np.append(kind, [kind[0]] * pad)
    found, _, resolved = _locate(
        balance,
        jnp.asarray(what),
        curve.points[index],
        curve.tangents[index],
        curve.points[index + 1],
        steps,
    )
    found, resolved = np.asarray(found), np.asarray(resolved)
    here, tangent = points[where], np.asarray(curve.tangents)[where]
    along = np.einsum("ku,ku->k", found[: len(where)] - here, tangent)
    rows = [(k, 0.0, points[k], "") for k in range(n)]
    rows += [
        (int(where[e]), float(along[e]), found[e], EVENT_KINDS[kind[e]])
        for e in range(len(where))
        if resolved[e]
    ]
    rows.sort(key=lambda row: (row[0], row[1]))
    return np.array([row[2] for row in rows]), tuple(row[3] for row in rows)
