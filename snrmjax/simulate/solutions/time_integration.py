"""Settled motions by time integration.

Needs diffrax: pip install 'snrmjax[integrate]'.
"""

from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from snrmjax.model.moving_base import newtons
from snrmjax.model.structures import Structure, simulated_structure
from snrmjax.numerics.compiled import jitted
from snrmjax.numerics.result import AbstractResult, Variable
from snrmjax.numerics.status import Status
from snrmjax.simulate.balance.given_numbers import positive
from snrmjax.simulate.balance.harmonics import harmonic_basis, velocity_phasors
from snrmjax.simulate.balance.labelled import HERTZ, batch_variables
from snrmjax.simulate.solutions.hysteresis_cycles import (
    CyclePoint,
    integrated_cycle,
    memory_at_rest,
    scaled_friction,
)

_WINDOW = 4  # cycles over which the decay of a transient is judged
LEAST_CYCLES = 2 * _WINDOW  # fewer cannot show that a motion has settled
_SLOWEST = 0.9995  # decay per cycle that a transient is credited with at least


class MotionStatus(Status):
    """How an integration towards a steady motion ended."""

    SETTLED = 0, "settled: repeats from cycle to cycle"
    STILL_SETTLING = 1, "still settling; allow more cycles"
    NOT_PERIODIC = (
        2,
        "does not repeat after one cycle of the force: a quasi-periodic, subharmonic or chaotic "
        "motion, or one that is about to jump; allow more cycles to be sure",
    )
    FAILED = 3, "grew without bound, or friction holds it so fast that too many steps are needed"


class IntegratedMotion(AbstractResult):
    """Motions at the end of an integration in time, over the last cycle of the force."""

    coordinates: ClassVar[tuple[str, ...]] = ("frequency_hz",)

    force: Float[Array, "*batch"]  # N
    frequency: Float[Array, "*batch"]  # rad/s
    coefficients: Float[Array, "*batch coefficient mode"]  # kg^1/2 m, as in `ResponseCurve`
    velocity: Complex[Array, "*batch harmonic sensor"]  # m/s, h = 0…H
    state: Float[Array, "*batch 2 mode"]  # q (kg^1/2 m) and q̇ (kg^1/2 m/s) at its end
    status: Int[Array, "*batch"]  # a `MotionStatus`
    distance: Float[Array, "*batch"]  # estimated, from the settled motion, relative
    n_cycles: Int[Array, "*batch"]

    def variables(self) -> dict[str, Variable]:
        """Force, frequency, velocities and how every motion ended."""
        names = [MotionStatus(int(k)).name.lower() for k in np.ravel(self.status)]
        status = np.array(names, dtype=str).reshape(np.shape(self.status))
        hertz = np.asarray(self.frequency) / HERTZ
        return batch_variables(
            self.velocity,
            force_n=(self.force, "N", "force amplitude"),
            frequency_hz=(hertz, "Hz", "frequency"),
            status=(status, "", "how the integration ended"),
            distance=(self.distance, "1", "estimated, from the settled motion"),
            n_cycles=(self.n_cycles, "1", "cycles of the force"),
        )

    @property
    def converged(self) -> Bool[Array, "*batch"]:
        """Whether the motion settled: repeats from cycle to cycle."""
        return self.status == int(MotionStatus.SETTLED)


class IntegrationAccuracy(NamedTuple):
    """How accurately motions are integrated, and when they count as settled."""

    settled: float = 1e-5  # estimated distance from the settled motion, relative
    step: float = 1e-8  # error of a step, relative to the size of the motion


SETTLED_ACCURACY = IntegrationAccuracy()


def settled_motion(
    model: Structure,
    force: Float[Array, ""] | float,
    frequency: Float[Array, ""] | float,
    *,
    start: Float[Array, "..."] | np.ndarray | None = None,
    harmonic_order: int = 9,
    max_cycles: int = 2000,
    accuracy: IntegrationAccuracy = SETTLED_ACCURACY,
) -> IntegratedMotion:
    """Integrate the equations of motion under a cosine force until the motion repeats.

    m q̈ + d q̇ + k q + ∂V/∂q + Σ effects = Φᵀb F Σ s_h cos hΩt, by the method of Tsitouras of
    order 5 with error control, and at least 128 steps a cycle. Contacts have their sharp kinks.
    Sliders are moved exactly after each step, turning points included; Coulomb's force is
    smoothed as over a cycle, with the last cycle's velocity.

    Arguments: `force` in N, `frequency` Ω in rad/s; `start` is q (kg^1/2 m) at rest, with shape
    (mode,), or q and q̇ (kg^1/2 m/s), with shape (2, mode), of the model's modes or of those of
    `simulated_structure`; from rest where it is missing. `accuracy` says which distance of the
    Fourier coefficients from those of the settled motion is small enough. Traceable: `jit` and
    `vmap` over forces, frequencies and starts; other numbers do not compile anew.
    Returns an `IntegratedMotion`: where `converged`, a stable periodic motion, which is a start
    for other solvers and a seed of isolated branches. Its `status` says why not: see
    `MotionStatus.message`. Which of several stable motions is found depends on `start`.
    Raises `ValueError` for a force or a frequency that is not positive, fewer than eight cycles
    and a start of another shape, `ImportError` without diffrax.
    Validity: a transient e^(−ζωt) takes about 2/ζ cycles to fall to 1e-5. Motions that friction
    brings to a stop creep at its smoothing velocity. Its loops are not differentiable
    by `jax.grad`: use `periodic_motion`.
    Reference: Tsitouras, Comput. Math. Appl. 62 (2011) 770, doi:10.1016/j.camwa.2011.06.002.

    >>> from snrmjax.model import flat_beam, linear_response
    >>> motion = settled_motion(flat_beam(), 1e-6, 500.0, harmonic_order=1)
    >>> exact = linear_response(flat_beam().modes, 500.0, 1e-6)
    >>> bool(motion.converged), bool(abs(motion.velocity[1] / exact - 1).max() < 1e-4)
    (True, True)
    """
    positive("force", force)
    positive("frequency", frequency)
    if max_cycles < LEAST_CYCLES:
        raise ValueError(
            f"a motion needs {LEAST_CYCLES} cycles or more to settle, but gets {max_cycles}."
        )
    return _settled(
        simulated_structure(model),
        jnp.asarray(force, dtype=jnp.float64),
        jnp.asarray(frequency, dtype=jnp.float64),
        _start_state(model, start),
        harmonic_order,
        _Settings(jnp.asarray(max_cycles), *(jnp.asarray(part) for part in accuracy)),
    )


class _Settings(NamedTuple):
    max_cycles: Int[Array, ""]
    tolerance: Float[Array, ""]
    rtol: Float[Array, ""]


def _start_state(model: Structure, start: Any) -> Float[Array, "2 mode"]:
    """Displacement and velocity of every simulated mode; further modes are at rest."""
    n = simulated_structure(model).n_modes
    if start is None:
        return jnp.zeros((2, n))
    state = jnp.asarray(start, dtype=jnp.float64)
    if state.ndim == 1:
        state = jnp.stack([state, jnp.zeros_like(state)])
    if state.ndim != 2 or state.shape[0] != 2 or state.shape[1] not in (model.n_modes, n):
        raise ValueError(
            f"`start` must have shape ({n},) or (2, {n}), for {n} modes, but has {np.shape(start)}."
        )
    return jnp.pad(state, ((0, 0), (0, n - state.shape[1])))


class _Settling(NamedTuple):
    """A settling motion: the last cycle's coefficients and how much they still change."""

    point: CyclePoint
    coefficients: Float[Array, "coefficient mode"]
    changes: Float[Array, " cycle"]  # relative, the last ones, newest first
    marks: Float[Array, " mark"]  # the change when the cycles were the last two powers of two
    distance: Float[Array, ""]
    n_cycles: Int[Array, ""]


@jitted
def _settled(
    model: Structure,
    force: Float[Array, ""],
    frequency: Float[Array, ""],
    start: Float[Array, "2 mode"],
    harmonic_order: int,
    settings: _Settings,
) -> IntegratedMotion:
    """The motion of the structure as simulated."""
    q, v = start
    unscaled = jnp.ones(len(model.hysteretic))
    memory = memory_at_rest(model, scaled_friction(model, unscaled, unscaled), q)
    begin = CyclePoint(q, v, memory, jnp.asarray(0.01), jnp.zeros(()), 0 * unscaled, 0 * unscaled)
    acting = newtons(model.modes.unbalance, frequency, force)
    settled = _settle(model, acting, frequency, begin, harmonic_order, settings)
    end = settled.point
    return IntegratedMotion(
        force=force,
        frequency=frequency,
        coefficients=settled.coefficients,
        velocity=velocity_phasors(settled.coefficients, frequency, model.modes.mode_shape),
        state=jnp.stack([end.q, end.v]),
        status=_status(model, frequency, settled, settings),
        distance=settled.distance,
        n_cycles=settled.n_cycles,
    )


def _settle(
    model: Structure,
    force: Array,
    frequency: Array,
    point: CyclePoint,
    harmonic_order: int,
    settings: _Settings,
) -> _Settling:
    """Cycle after cycle until the motion repeats."""
    n_samples = max(256 if model.hysteretic else 128, 8 * harmonic_order)
    analysis = jnp.asarray(harmonic_basis(harmonic_order, n_samples).analysis)
    begin = _Settling(
        point=point,
        coefficients=jnp.zeros((2 * harmonic_order + 1, model.n_modes)),
        changes=jnp.full(2 * _WINDOW, jnp.inf),
        marks=jnp.full(2, jnp.inf),
        distance=jnp.asarray(jnp.inf),
        n_cycles=jnp.asarray(0),
    )

    def going(now: _Settling) -> Array:
        more = (now.n_cycles < settings.max_cycles) & ~(now.distance <= settings.tolerance)
        return more & jnp.all(jnp.isfinite(now.coefficients))

    def cycle(now: _Settling) -> _Settling:
        point, samples = integrated_cycle(
            model, force, frequency, now.point, n_samples, settings.rtol
        )
        coefficients = analysis @ samples
        largest = jnp.maximum(jnp.max(jnp.abs(coefficients)), jnp.finfo(jnp.float64).tiny)
        change = jnp.max(jnp.abs(coefficients - now.coefficients)) / largest
        changes = jnp.concatenate([change[None], now.changes[:-1]])
        n_cycles = now.n_cycles + 1
        recent, before = jnp.max(changes[:_WINDOW]), jnp.max(changes[_WINDOW:])
        # A change d that shrinks by ρ in every cycle has dρ/(1 − ρ) still to go.
        decay = (recent / jnp.maximum(before, jnp.finfo(jnp.float64).tiny)) ** (1 / _WINDOW)
        decay = jnp.minimum(decay, _SLOWEST)
        # The first change is that from nothing.
        known = n_cycles > 2 * _WINDOW - 1
        distance = jnp.where(known, recent / (1 - decay), jnp.inf)
        marked = (n_cycles & (n_cycles - 1)) == 0
        return _Settling(
            point=point,
            coefficients=coefficients,
            changes=changes,
            marks=jnp.where(marked, jnp.stack([recent, now.marks[0]]), now.marks),
            distance=distance,
            n_cycles=n_cycles,
        )

    return jax.lax.while_loop(going, cycle, begin)


def _status(
    model: Structure, frequency: Array, settled: _Settling, settings: _Settings
) -> Int[Array, ""]:
    recent, before = jnp.max(settled.changes[:_WINDOW]), settled.marks[1]
    # Linear modes alone would take a quarter of the cycles or more to shrink it by this much.
    terms = model.linear_terms()
    slowest = jnp.min(terms.damping / (2 * terms.mass)) * 2 * jnp.pi / frequency
    shrinks = recent < before * jnp.maximum(0.5, jnp.exp(-0.25 * slowest * settled.n_cycles))
    running = jnp.where(shrinks, int(MotionStatus.STILL_SETTLING), int(MotionStatus.NOT_PERIODIC))
    done = settled.distance <= settings.tolerance
    status = jnp.where(done, int(MotionStatus.SETTLED), running)
    finite = jnp.all(jnp.isfinite(settled.coefficients))
    return jnp.where(finite, status, int(MotionStatus.FAILED))
