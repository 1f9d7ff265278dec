"""Quasi-periodic motions: the branch that leaves a response at a Neimark-Sacker bifurcation."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from snrmjax.model.moving_base import BaseMotion, drive_unit
from snrmjax.model.structures import Structure, simulated_structure
from snrmjax.numerics.blocks import on_one_core
from snrmjax.numerics.compiled import compiled, on_numbers
from snrmjax.numerics.result import AbstractResult, quantity, setting
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.status import Status
from snrmjax.numerics.units import HERTZ
from snrmjax.simulate.balance.given_numbers import frequency_range
from snrmjax.simulate.balance.harmonic_balance import (
    HarmonicBalance,
    harmonic_balance,
    resonance_displacement,
)
from snrmjax.simulate.balance.torus_balance import TorusBalance
from snrmjax.simulate.continuation.continuation import (
    RUNNING,
    CurveRange,
    CurveTracer,
    StepControl,
    Tracing,
)
from snrmjax.simulate.continuation.response_curve import ResponseCurve

DEFAULT_STEPS = StepControl(first=0.02, smallest=1e-6, largest=0.1, angle=0.2, max_points=300)
_MOST_MODES = 20
_FIRST_MODULATION = 1e-3  # amplitude at the first point, in scaled unknowns
_SLOW_SAMPLES = 64  # over a slow period, for its least and largest amplitude
_ON_CIRCLE = 0.02  # largest distance of the crossing multipliers from the unit circle


class TorusEnd(Status):
    """How a branch of quasi-periodic motions ended."""

    UPPER_END = 0, "the upper end of the frequency range"
    LOWER_END = 1, "the lower end of the frequency range"
    POINT_LIMIT = 2, "the largest number of points (in Python: raise `max_points`)"
    STEP_TOO_SMALL = 3, "where Newton's method fails at the smallest step; raise `slow_order`"
    NO_START = 4, "at its start: there is no quasi-periodic motion near it with these harmonics"
    CLOSED = 6, "where it started: a closed branch"
    PERIODIC = 9, "at another Neimark-Sacker bifurcation: the motion is periodic there"


class QuasiPeriodicBranch(AbstractResult):
    """Motions with two base frequencies along a branch, stable or not.

    The first point is the Neimark-Sacker bifurcation itself. Velocities are those that the sensors
    record, including that of the base where they record it.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("sensor",)

    frequency: Float[np.ndarray, " point"] = quantity("point", "Hz", "frequency of the force")
    slow_frequency: Float[np.ndarray, " point"] = quantity(
        "point", "Hz", "second base frequency, of the modulation"
    )
    velocity: Complex[np.ndarray, "point sensor"] = quantity(
        "point sensor", "m/s", "velocity at the frequency of the force"
    )
    largest_velocity: Float[np.ndarray, "point sensor"] = quantity(
        "point sensor", "m/s", "largest velocity over the whole motion"
    )
    least_amplitude: Float[np.ndarray, "point sensor"] = quantity(
        "point sensor", "m/s", "least amplitude of the fundamental over the slow period"
    )
    largest_amplitude: Float[np.ndarray, "point sensor"] = quantity(
        "point sensor", "m/s", "largest amplitude of the fundamental over the slow period"
    )
    modulation: Float[np.ndarray, " point"] = quantity(
        "point", "1", "rms of the modulated part of the displacement, over the whole"
    )
    coefficients: Float[np.ndarray, "point coefficient mode"]  # kg^1/2 m, of `torus_basis`
    force: float = setting()  # N
    slow_order: int = setting()
    status: TorusEnd = setting()
    sensors: tuple[str, ...] = quantity("sensor", "", "sensor", name="sensor", static=True)
    base: BaseMotion | None = eqx.field(static=True, default=None)
    unbalance: float | None = eqx.field(static=True, default=None)  # kg m

    @property
    def force_unit(self) -> str:
        """Unit of the excitation: newtons, m/s² of a base, or a number of unbalances."""
        return drive_unit(self.base, self.unbalance)

    @property
    def slow_period(self) -> Float[np.ndarray, " point"]:
        """Period of the modulation in s."""
        return 2 * np.pi / self.slow_frequency

    def ends_at(self, frequency: float) -> bool:
        """Whether it ends at a Neimark-Sacker point of this frequency (rad/s), within a step."""
        if self.status != TorusEnd.PERIODIC:
            return False
        step = abs(float(self.frequency[-1] - self.frequency[-2]))
        if len(self.frequency) > 2:  # the last point lies within a step
            step = max(step, abs(float(self.frequency[-2] - self.frequency[-3])))
        return abs(float(self.frequency[-1]) - frequency) <= step

    def summary(self) -> tuple[str, ...]:
        """Force, range, slow period, modulation and how it ended."""
        hertz, period = self.frequency / HERTZ, self.slow_period
        return (
            f"quasi-periodic motions at {self.force:.4g} {self.force_unit}: {len(hertz)} points",
            f"frequency {hertz[0]:.5g} to {hertz[-1]:.5g} Hz",
            f"period of the modulation {period.min():.4g} to {period.max():.4g} s",
            f"ended {self.status.message}",
        )


@on_numbers(
    "Nothing that is quasi-periodic is differentiable; periodic motions are: "
    "`sj.simulate.periodic_motion`."
)
@on_one_core
def quasi_periodic_branch(
    model: Structure,
    response: ResponseCurve,
    event: int | None = None,
    *,
    within: tuple[float, float] | None = None,
    slow_order: int = 3,
    steps: StepControl = DEFAULT_STEPS,
) -> QuasiPeriodicBranch:
    """Trace the quasi-periodic motions that bifurcate at a Neimark-Sacker point of a response.

    A motion with two phases, Ωt and ωt, branches off there. It is continued in the frequency of
    the force by a harmonic balance in both frequencies, with the response's harmonics of Ω and
    `slow_order` of ω, until the modulation vanishes at another such point. Phase locking (ω a
    simple fraction of Ω) is ignored. Stability is not computed; as a rule the motions are stable
    where the branch leaves towards frequencies at which the response is unstable.

    Arguments: the `model` of the response; the index of the `event` in it, by default its first
    Neimark-Sacker point; `within`, frequencies in rad/s where the branch ends, by default those of
    the response. At most 20 modes, no friction with internal variables.
    Raises `ValueError` for a response without such a point and for models beyond these limits.
    Not differentiable; periodic motions are: `snrmjax.simulate.periodic_motion`.
    Reference: Guillot, Cochelin & Vergez, Nonlinear Dyn. 97 (2019) 1711 (two base frequencies);
    Schilder, Osinga & Vogt, SIAM J. Appl. Dyn. Syst. 4 (2005) 459, doi:10.1137/040611240.
    """
    model = simulated_structure(model)
    check_quasi_periodic(model)
    if slow_order < 1:
        raise InputError(f"`slow_order` must be 1 or more, but is {slow_order}.")
    ns_points = response.at_events("neimark_sacker")
    index = event if event is not None else (int(ns_points[0]) if len(ns_points) else None)
    if index is None or index not in ns_points or response.multipliers is None:
        raise InputError("`response` has no Neimark-Sacker point there: see `at_events`.")
    ends = within or (float(response.frequency.min()), float(response.frequency.max()))
    lower, upper = frequency_range(*ends)

    order = (response.coefficients.shape[1] - 1) // 2
    balance = harmonic_balance(
        model,
        response.force,
        resonance_displacement(model, response.force),
        harmonic_order=order,
    )
    start, direction, phase = _beginning(balance, response, index, slow_order)
    torus = TorusBalance(balance, jnp.asarray(phase), slow_order)
    scale = float(balance.frequency_scale)
    points, status = _traced(torus, start, direction, (lower / scale, upper / scale), steps)
    return _as_result(torus, points, status)


def check_quasi_periodic(model: Structure) -> None:
    """Raise `ValueError` for a model whose quasi-periodic motions cannot be traced.

    At most 20 modes, no friction with internal variables.
    """
    if model.n_modes > _MOST_MODES:
        raise InputError(
            f"quasi-periodic motions are followed in at most {_MOST_MODES} modes, not "
            f"{model.n_modes}: leave modes out (`n_modes` of `from_matrices`)."
        )
    if model.hysteretic:
        kinds = ", ".join(effect.kind for effect in model.hysteretic)
        raise InputError(
            f"quasi-periodic motions with internal variables ({kinds}) cannot be followed."
        )


def _beginning(
    balance: HarmonicBalance, response: ResponseCurve, index: int, slow_order: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The bifurcation point, the direction onto the branch, and the second phase condition.

    At the second frequency of the multipliers the equations of k₂ = 1 have two null vectors, a
    quarter of its period apart: either one is the direction.
    """
    multipliers = np.asarray(response.multipliers)[index]
    oscillating = multipliers[np.abs(multipliers.imag) > 1e-9]
    if not len(oscillating) or np.min(np.abs(np.abs(oscillating) - 1)) > _ON_CIRCLE:
        raise InputError("the multipliers of this point do not cross the unit circle in a pair.")
    crossing = oscillating[np.argmin(np.abs(np.abs(oscillating) - 1))]
    unit = float(balance.frequency_scale)
    fast = float(response.frequency[index]) / unit
    slow = abs(np.angle(crossing)) / (2 * np.pi) * fast
    blank = TorusBalance(balance, jnp.zeros(1), slow_order)
    size, n = blank.size, balance.model.n_modes
    x = np.zeros(size)
    x[: balance.size] = response.coefficients[index].reshape(-1) / float(balance.displacement_scale)
    start = np.concatenate([x, [slow, fast]])
    torus = TorusBalance(balance, jnp.zeros(size), slow_order)
    jacobian = np.asarray(_linearised(torus, jnp.asarray(start))[1])[:size, :size]
    block = np.flatnonzero(np.repeat(blank.basis.slow, n) == 1)
    way = np.zeros(size)
    way[block] = np.linalg.svd(jacobian[np.ix_(block, block)])[2][-1]
    phase = (np.asarray(blank.basis.by_slow) @ way.reshape(-1, n)).reshape(-1)
    direction = np.concatenate([way, [0.0, 0.0]])
    return start, direction, phase / np.linalg.norm(phase)


@compiled
def _linearised(torus: TorusBalance, point: Array) -> tuple[Array, Array]:
    return torus.linearised(point)


def _tracer(torus: TorusBalance, within: CurveRange, steps: StepControl) -> CurveTracer:
    return CurveTracer(torus.linearised, within, steps)


@compiled
def _initial(
    torus: TorusBalance, within: CurveRange, steps: StepControl, start: Array, direction: Array
) -> Tracing:
    return _tracer(torus, within, steps).initial(start, direction, direction)


@compiled
def _corrected(
    torus: TorusBalance, within: CurveRange, steps: StepControl, state: Tracing
) -> tuple[Tracing, Array]:
    return _tracer(torus, within, steps).corrected(state)


def _traced(
    torus: TorusBalance,
    start: np.ndarray,
    direction: np.ndarray,
    ends: tuple[float, float],
    steps: StepControl,
) -> tuple[np.ndarray, TorusEnd]:
    """Points of the branch, one by one: the host checks whether the modulation vanished."""
    within = CurveRange(*ends)
    slow = np.flatnonzero(np.repeat(torus.basis.slow, torus.balance.model.n_modes))
    begin = jnp.asarray(start + _FIRST_MODULATION * direction)
    state, points = _initial(torus, within, steps, begin, jnp.asarray(direction)), [start]
    while int(state.status) == RUNNING:
        state, kept = _corrected(torus, within, steps, state)
        if not bool(kept):
            continue
        new, last = np.asarray(state.here), points[-1]
        if len(points) > 2 and new[slow] @ last[slow] < 0:
            # Beyond it the same motions recur, half a slow period later.
            norms = [np.linalg.norm(part[slow]) for part in (last, new)]
            fraction = norms[0] / sum(norms)
            points.append(last + fraction * (new - last))
            return np.stack(points), TorusEnd.PERIODIC
        points.append(new)
    return np.stack(points), TorusEnd(int(state.status))


def _as_result(torus: TorusBalance, points: np.ndarray, status: TorusEnd) -> QuasiPeriodicBranch:
    balance, basis = torus.balance, torus.basis
    modes, n = balance.model.modes, balance.model.n_modes
    shape, unit = np.asarray(modes.mode_shape), float(balance.frequency_scale)
    slow, fast = points[:, -2] * unit, points[:, -1] * unit
    scale = float(balance.displacement_scale)
    x = scale * points[:, :-2].reshape(len(points), -1, n)
    fundamental = (x[:, 1] - 1j * x[:, 2]) @ shape.T
    force = float(balance.force)
    own = np.zeros_like(fundamental)
    if modes.base is not None:
        own = modes.base.own_velocity(modes.sensors, fast, force)
    phasors = 1j * fast[:, None] * fundamental + own
    largest, amplitudes = [], []
    for k, (coefficients, one, two) in enumerate(zip(x, fast, slow, strict=True)):
        rate = (one * basis.by_fast + two * basis.by_slow) @ coefficients @ shape.T
        rate[1:3] += [own[k].real, -own[k].imag]
        largest.append(np.max(np.abs(basis.synthesis @ rate), axis=0))
        amplitudes.append(_amplitudes(torus, rate))
    least, most = (np.stack(part) for part in zip(*amplitudes, strict=True))
    moving = (x[:, 1:] ** 2).sum(axis=2)
    fraction = moving[:, basis.slow[1:] > 0].sum(axis=1) / moving.sum(axis=1)
    return QuasiPeriodicBranch(
        frequency=fast,
        slow_frequency=slow,
        velocity=phasors,
        largest_velocity=np.stack(largest),
        least_amplitude=least,
        largest_amplitude=most,
        modulation=np.sqrt(fraction),
        coefficients=x,
        force=force,
        slow_order=torus.slow_order,
        status=status,
        sensors=modes.sensors,
        base=modes.base,
        unbalance=None if modes.unbalance is None else float(modes.unbalance),
    )


def _amplitudes(
    torus: TorusBalance, velocity: Float[np.ndarray, "coefficient sensor"]
) -> tuple[np.ndarray, np.ndarray]:
    """The least and the largest amplitude of the fundamental in τ₁ over τ₂."""
    basis = torus.basis
    fast, slow = basis.fast[1::2], basis.slow[1::2]
    phasor = velocity[1::2] - 1j * velocity[2::2]
    ahead, behind = fast == 1, fast == -1
    tau = 2 * np.pi * np.arange(_SLOW_SAMPLES)[:, None] / _SLOW_SAMPLES
    # cos(−τ₁ + k₂τ₂ + φ) is cos(τ₁ − k₂τ₂ − φ).
    envelope = np.exp(1j * tau * slow[ahead]) @ phasor[ahead]
    envelope = envelope + np.exp(-1j * tau * slow[behind]) @ phasor[behind].conj()
    amplitude = np.abs(envelope)
    return amplitude.min(axis=0), amplitude.max(axis=0)
