"""Damped backbones: extended periodic motions, and tests with controlled phase or response."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.model.elements import elements_of
from snrmjax.model.structures import Structure, linear_terms_of, simulated_structure
from snrmjax.numerics.blocks import on_one_core
from snrmjax.numerics.compiled import compiled, on_numbers
from snrmjax.numerics.result import quantity
from snrmjax.numerics.rules import InputError
from snrmjax.simulate.balance.given_numbers import frequency_range, positive
from snrmjax.simulate.balance.harmonic_balance import (
    HarmonicBalance,
    averaged_at_attachments,
    harmonic_balance,
    linear_coefficients,
    resonance_displacement,
)
from snrmjax.simulate.balance.harmonics import harmonic_basis, velocity_phasors
from snrmjax.simulate.continuation.continuation import (
    Curve,
    CurveRange,
    CurveStatus,
    StepControl,
    on_host,
    trace_curve,
)
from snrmjax.simulate.continuation.event_equations import FORCE, EventEquations
from snrmjax.simulate.continuation.response_curve import MotionCurve, motions_of
from snrmjax.simulate.solutions.event_curves import trace_events

DEFAULT_STEPS = StepControl(max_points=2000)
_SMALL = 0.01  # start of a curve, as a fraction of the largest amplitude or force
_PASSES = 8  # iterations between mode shape and averaged forces of a small motion


class DampedModeBranch(MotionCurve):
    """A damped nonlinear mode as a curve of extended periodic motions."""

    coordinates: ClassVar[tuple[str, ...]] = ("sensor",)

    frequency: Float[np.ndarray, " point"] = quantity(
        "point", "Hz", "natural frequency", name="natural_frequency_hz"
    )
    damping_ratio: Float[np.ndarray, " point"] = quantity(
        "point", "1", "damping ratio, as a fraction of critical"
    )


class ControlledCurve(MotionCurve):
    """Steady states under a controller: the force is an unknown."""

    force: Float[np.ndarray, " point"] = quantity("point", "N", "force amplitude")


@on_numbers(
    "Differentiate single motions: `sj.simulate.periodic_motion` with "
    '`condition="phase_resonance"`.'
)
@on_one_core
def damped_normal_mode(
    model: Structure,
    largest_velocity: float,
    *,
    harmonic_order: int = 9,
    steps: StepControl = DEFAULT_STEPS,
    n_samples: int | None = None,
) -> DampedModeBranch:
    """The damped nonlinear mode by the extended periodic motion concept.

    Solves m q̈ + (C − ξ m) q̇ + K q + f(q, q̇) = 0 for periodic motions: a negative damping ξ,
    proportional to mass, compensates the dissipation over a cycle, so that the damping ratio of
    the mode is ξ/(2Ω). Friction and all other nonlinear elements are included.

    Arguments: `largest_velocity` in m/s, of the linear mode of interest at the sensor where it is
    largest; the curve starts at a hundredth of it and ends beyond it.
    Returns a `DampedModeBranch` whose `status` is how it ended.
    Raises `ValueError` for a velocity that is not positive and finite.
    Not differentiable: differentiate single motions: `snrmjax.simulate.periodic_motion` with
    `condition="phase_resonance"`.
    Reference: Krack, Comput. Struct. 154 (2015) 59, doi:10.1016/j.compstruc.2015.03.008.
    """
    positive("largest_velocity", largest_velocity)
    model = simulated_structure(model)
    j = model.modes.mode_of_interest
    omega = model.modes.natural_frequency.item(j)
    scale = largest_velocity / (omega * float(np.max(np.abs(model.modes.mode_shape[:, j]))))
    balance = harmonic_balance(
        model, 0.0, scale, harmonic_order=harmonic_order, n_samples=n_samples
    )
    start = _quasi_linear_motion(balance, _SMALL)
    curve = on_host(_trace_damped(balance, start, steps))
    # ξ/(2Ω), both scaled by the same natural frequency.
    return DampedModeBranch(
        **motions_of(balance, np.delete(curve.points, -2, axis=1)),
        status=curve.status,
        damping_ratio=curve.points[:, -2] / (2 * curve.points[:, -1]),
    )


def _quasi_linear_motion(
    balance: HarmonicBalance, fraction: float
) -> Float[np.ndarray, " unknown"]:
    """The mode of the structure with its nonlinear elements averaged over a small motion.

    Stuck friction changes its shape, frequency and damping. Arguments: `fraction`, the amplitude
    of the mode of interest over the balance's scale. Returns the unknowns of `_trace_damped`.
    """
    model, j = balance.model, balance.model.modes.mode_of_interest
    terms, n = linear_terms_of(model), model.n_modes
    mass, coupled = np.asarray(terms.mass)[:, None], terms.coupling
    damping = np.diag(np.asarray(terms.damping)) + (0 if coupled is None else np.asarray(coupled))
    stiffness = np.diag(np.asarray(terms.stiffness))
    elements = elements_of(model.forces, model.modes)
    influence, amplitude = (
        np.asarray(elements.influence),
        fraction * float(balance.displacement_scale),
    )
    shape, value = np.eye(n)[j].astype(complex), 1j * float(balance.frequency_scale)
    for _ in range(_PASSES if model.forces else 1):
        local = amplitude * np.abs(influence @ shape)
        added = averaged_at_attachments(model, local, value.imag)
        k = stiffness + influence.T @ (np.asarray(added.stiffness)[:, None] * influence)
        c = damping + influence.T @ (np.asarray(added.damping)[:, None] * influence)
        values, shapes = np.linalg.eig(
            np.block([[np.zeros((n, n)), np.eye(n)], [-k / mass, -c / mass]])
        )
        oscillating = np.flatnonzero(values.imag > 0)
        if not oscillating.size:
            break
        parts = np.abs(shapes[:n, oscillating])
        best = oscillating[np.argmax(parts[j] / np.linalg.norm(parts, axis=0))]
        value, shape = values[best], shapes[:n, best] / shapes[j, best]
    frequency, unit = abs(value), float(balance.frequency_scale)
    x = np.zeros((balance.n_coefficients, n))
    x[1], x[2] = fraction * shape.real, -fraction * shape.imag
    return np.concatenate([x.ravel(), [-2 * value.real / unit, frequency / unit]])


@compiled
def _trace_damped(
    balance: HarmonicBalance, start: Float[Array, " unknown"], steps: StepControl
) -> Curve:
    model, j, n = balance.model, balance.model.modes.mode_of_interest, balance.model.n_modes
    terms = model.linear_terms()
    basis = harmonic_basis(balance.harmonic_order, balance.n_samples)
    derivative = jnp.kron(jnp.asarray(basis.derivative), jnp.diag(terms.mass))
    sine = 2 * n + j

    def linearised(point: Array) -> tuple[Array, Array]:
        """Unknowns x, ξ/ω₀ and Ω/ω₀; the last equation is the phase condition."""
        x, excitation, omega = point[:-2], point[-2], point[-1]
        residual, jacobian = balance.linearised(jnp.append(x, omega))
        slope = derivative @ x
        by_x = jacobian[:, :-1] - excitation * omega * derivative
        by_omega = jacobian[:, -1] - excitation * slope
        top = jnp.concatenate([by_x, (-omega * slope)[:, None], by_omega[:, None]], axis=1)
        phase = jnp.zeros(point.shape[0]).at[sine].set(1.0)
        equations = jnp.append(residual - excitation * omega * slope, x[sine])
        return equations, jnp.concatenate([top, phase[None]])

    outward = jnp.zeros_like(start).at[n + j].set(1.0)
    within = CurveRange(lower=0.0, upper=np.inf, largest_amplitude=1.0)
    return trace_curve(linearised, start, outward, within, steps, start_across=outward)


@on_numbers("Differentiate single motions: `sj.simulate.periodic_motion`.")
@on_one_core
def phase_controlled(
    model: Structure,
    largest_force: float,
    *,
    harmonic_order: int = 9,
    steps: StepControl = DEFAULT_STEPS,
    n_samples: int | None = None,
) -> ControlledCurve:
    """Phase resonances of the mode of interest under a rising force.

    The velocity is in phase with the force: the force-appropriated backbone that a phase-locked
    loop tracks, including states that are unstable in open loop. It is the curve that
    `follow_event` traces from a phase resonance, started at a small force.

    Arguments: `largest_force` in N; the curve starts at a hundredth of it.
    Returns a `ControlledCurve`; its `status` is UPPER_END when the largest force was reached.
    Raises `ValueError` for a force that is not positive or does not drive the mode of interest.
    Not differentiable: differentiate single motions: `snrmjax.simulate.periodic_motion`.
    Reference: Peeters, Kerschen & Golinval, J. Sound Vib. 330 (2011) 486,
    doi:10.1016/j.jsv.2010.08.028.
    """
    positive("largest_force", largest_force)
    model = simulated_structure(model)
    if not model.modes.driven()[model.modes.mode_of_interest]:
        raise InputError(
            "the force does not drive the mode of interest, which has no phase to control."
        )
    balance = harmonic_balance(
        model,
        largest_force,
        resonance_displacement(model, largest_force),
        harmonic_order=harmonic_order,
        n_samples=n_samples,
    )
    equations = EventEquations(
        model,
        balance,
        jnp.asarray(float(largest_force)),
        kind="phase_resonance",
        parameter=FORCE,
    )
    terms, j = model.linear_terms(), model.modes.mode_of_interest
    natural = jnp.sqrt(terms.stiffness[j] / terms.mass[j])
    x = linear_coefficients(model, _SMALL * balance.force, natural, harmonic_order)
    start = jnp.append(balance.point(x, natural), _SMALL)
    ends = np.array([0.0, 1.0])
    curve = on_host(trace_events(equations, start, ends, steps, np.array(1.0)))
    return ControlledCurve(
        **motions_of(balance, curve.points[:, :-1]),
        status=curve.status,
        force=curve.points[:, -1] * largest_force,
    )


@on_numbers(
    'Differentiate single motions: `sj.simulate.periodic_motion` with `condition="velocity"`.'
)
@on_one_core
def response_controlled(
    model: Structure,
    velocity: float,
    from_frequency: float,
    to_frequency: float,
    *,
    harmonic_order: int = 9,
    steps: StepControl = DEFAULT_STEPS,
    n_samples: int | None = None,
) -> ControlledCurve:
    """Steady states of a given velocity amplitude through a frequency range.

    The controller keeps |V₁| at the first sensor constant by adjusting the force, which removes
    the folds of the open loop. Solves the harmonic balance with |V₁| = `velocity`.

    Arguments: `velocity` in m/s, frequencies in rad/s.
    Returns a `ControlledCurve` from the lower to the upper frequency, traced from the upper one
    if the lower one gives no start; its `status` is UPPER_END when it spans the range.
    Raises `ValueError` for a velocity that is not positive and for an empty range.
    Not differentiable: differentiate single motions: `snrmjax.simulate.periodic_motion` with
    `condition="velocity"`.
    Reference: Karaağaçlı & Özgüven, Mech. Syst. Signal Process. 144 (2020) 107023,
    doi:10.1016/j.ymssp.2020.107023.
    """
    positive("velocity", velocity)
    ends = frequency_range(from_frequency, to_frequency)
    model = simulated_structure(model)
    shape = np.asarray(model.modes.mode_shape[0])
    j = model.modes.mode_of_interest
    if shape[j] == 0:
        raise InputError("the first sensor does not see the mode of interest.")
    middle = 0.5 * (from_frequency + to_frequency)
    scale = velocity / (abs(shape[j]) * middle)
    # Unit of the unknown force: a tenth of the static force for this displacement.
    terms = model.linear_terms()
    unit = float(terms.stiffness[j] * scale / np.abs(model.modes.participation[j])) * 0.1
    balance = harmonic_balance(
        model, unit, scale, harmonic_order=harmonic_order, n_samples=n_samples
    )
    curve = on_host(_trace_response(balance, float(velocity), ends, np.array(False), steps))
    if curve.status == CurveStatus.NO_START:
        # The linear response may be no start far below a resonance, but one far above it.
        downward = _trace_response(balance, float(velocity), ends, np.array(True), steps)
        curve = on_host(downward).reversed()
    return ControlledCurve(
        **motions_of(balance, np.delete(curve.points, -2, axis=1)),
        status=curve.status,
        force=curve.points[:, -2] * unit,
    )


@compiled
def _trace_response(
    balance: HarmonicBalance,
    velocity: Float[Array, ""] | float,
    ends: Array,
    downward: Array,
    steps: StepControl,
) -> Curve:
    model, n = balance.model, balance.model.n_modes
    shape = model.modes.mode_shape[0]
    unit = velocity / (balance.frequency_scale * balance.displacement_scale)

    def height(point: Array) -> Array:
        x = point[:-2].reshape(-1, n) @ shape
        return point[-1] ** 2 * (x[1] ** 2 + x[2] ** 2) / unit**2 - 1.0

    def linearised(point: Array) -> tuple[Array, Array]:
        """Unknowns x, the force over its unit, and Ω/ω₀."""
        residual, jacobian = _with_force(balance, jnp.delete(point, -2), point[-2])
        jacobian = jnp.concatenate([jacobian[:, :-2], jacobian[:, -1:], jacobian[:, -2:-1]], axis=1)
        value, slope = jax.value_and_grad(height)(point)
        return jnp.append(residual, value), jnp.concatenate([jacobian, slope[None]])

    begin = jnp.where(downward, ends[1], ends[0])
    per_unit = linear_coefficients(model, balance.force, begin, balance.harmonic_order)
    linear = jnp.abs(velocity_phasors(per_unit, begin, model.modes.mode_shape)[1, 0])
    fraction = velocity / linear
    start = balance.point(fraction * per_unit, begin)
    start = jnp.concatenate([start[:-1], jnp.stack([fraction, start[-1]])])
    onward = jnp.zeros_like(start).at[-1].set(jnp.where(downward, -1.0, 1.0))
    lower, upper = ends / balance.frequency_scale
    return trace_curve(linearised, start, onward, CurveRange(lower, upper), steps)


def _with_force(
    balance: HarmonicBalance, point: Array, fraction: Array
) -> tuple[Float[Array, " equation"], Float[Array, "equation unknown"]]:
    """Residual and Jacobian under a fraction of the force, with its derivative as last column."""
    now = eqx.tree_at(lambda b: b.force, balance, balance.force * fraction)
    residual, jacobian = now.linearised(point)
    column = -balance.newtons(point[-1]) * balance.load()
    return residual, jnp.concatenate([jacobian, column[:, None]], axis=1)
