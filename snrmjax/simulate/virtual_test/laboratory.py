"""A virtual laboratory: structure, shaker, instruments and a sampled controller, in time domain.

The structure is any model of this package: modes, potential, contacts, hysteretic friction. An
electrodynamic shaker drives it through a stinger, so that the force drops at resonance and
contains harmonics, as in a real test. Between samples of the controller the voltage follows, with
a delay of one sample, the cubic through the last four commands, as smooth as after a
reconstruction filter: linear interpolation or steps would have images about the sampling rate,
which alias into the sampled force. The equations of motion are integrated by the classical
Runge-Kutta method of order 4 in substeps of equal length; sliders are updated exactly after each
of them.

Reference: for the shaker, G. R. Tomlinson, J. Sound Vib. 63 (1979) 337,
doi:10.1016/0022-460X(79)90681-9.
"""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.model.effect_base import (
    AbstractForceSpectrum,
    AbstractHysteresis,
    AbstractMeasurementEffect,
    AbstractNonsmooth,
)
from snrmjax.model.elements import elements_of
from snrmjax.model.modes import reference_sensor
from snrmjax.model.structures import Structure, simulated_structure
from snrmjax.numerics.compiled import compiled, on_numbers
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ
from snrmjax.simulate.virtual_test.equipment import (
    Instruments,
    Shaker,
    check_instruments,
    check_shaker,
    filter_sections,
)
from snrmjax.simulate.virtual_test.friction_internal_variables import (
    friction_influence,
    inner_force,
    internal_variables_after_step,
    internal_variables_at_rest,
    scaled_friction,
)

_FEWEST_STEPS = 20  # per cycle of the highest linear frequency, for an accurate integration


class Sample(NamedTuple):
    """The input of the controller at a sample."""

    time: Float[Array, ""]
    force: Float[Array, ""]  # N
    velocity: Float[Array, ""]  # m/s, at the reference sensor


class AbstractController(eqx.Module):
    """A sampled controller: force and velocity in, shaker voltage out."""

    @abc.abstractmethod
    def initial(self) -> Any:
        """The state before the first sample."""

    @abc.abstractmethod
    def step(self, state: Any, sample: Sample, period: Float[Array, ""]) -> tuple[Any, Array, Any]:
        """The next state, the voltage until the next sample, and a report."""


class TestRecord(NamedTuple):
    """Channels of a test, one entry per sample."""

    time: Float[Array, " sample"]  # s
    voltage: Float[Array, " sample"]  # V, of the amplifier
    force: Float[Array, " sample"]  # N, as recorded
    velocity: Float[Array, " sample"]  # m/s, as recorded
    report: Any  # of the controller, arrays with the sample as first axis


class LabMotion(NamedTuple):
    """State variables of the equations of motion."""

    displacement: Float[Array, " mode"]  # kg^1/2 m
    velocity: Float[Array, " mode"]  # kg^1/2 m/s
    internal: tuple[Float[Array, " state"], ...]  # variables of friction, one entry per element


class LabState(NamedTuple):
    """The state that is passed from one run to the next."""

    motion: LabMotion
    controller: Any
    time: Float[Array, ""]
    voltage: Float[Array, "3"]  # of the amplifier at the last three samples, V
    seen: Float[Array, " channel"]  # force (N) and velocity (m/s) after the anti-alias filter
    filtered: Float[Array, "section 2 channel"]  # state of the anti-alias filter
    largest: Float[Array, ""]  # |q| of the mode of interest so far, kg^1/2 m


class Laboratory(eqx.Module):
    """A structure on a shaker with its instruments.

    `sampling_rate` in Hz is that of the controller and of the records; each sample is integrated
    in `substeps`, of which a cycle of the highest linear frequency (with closed contacts) needs 20.
    Friction needs `largest_displacement`, in m at the reference sensor: its sliders, and the width
    of a smoothed Coulomb force, are scaled for motions up to it. With `attached` False the shaker
    is disconnected and the structure moves freely. `Shaker(1e-6, 1e-6)` is an ideal force source of
    one newton per volt. The remaining images of the voltage alias into the force by about
    (ω period)⁴/38 of the shaker's own force, which near resonance may be several times the force
    on the structure.
    Raises `ValueError` for impossible parameters, a rate too low, a force at a node of the mode of
    interest, and effects of the measurement or of the force's spectrum, which shaker and
    instruments produce here.
    """

    structure: Structure
    shaker: Shaker
    instruments: Instruments
    sampling_rate: float = eqx.field(static=True)
    substeps: int = eqx.field(static=True, default=2)
    largest_displacement: float = eqx.field(static=True, default=np.nan)
    attached: bool = eqx.field(static=True, default=True)

    def __check_init__(self) -> None:
        check_shaker(self.shaker)
        check_instruments(self.instruments, self.sampling_rate)
        foreign = (AbstractMeasurementEffect, AbstractForceSpectrum)
        kinds = ", ".join(e.kind for e in self.structure.effects if isinstance(e, foreign))
        if kinds:
            raise InputError(
                f"the virtual laboratory has its own shaker and instruments, but the model has "
                f"{kinds}: state them in `shaker` and `instruments`."
            )
        if self.structure.modes.unbalance is not None:
            raise InputError(
                "the virtual laboratory drives by a shaker, but an unbalance drives the model."
            )
        modes = self.structure.modes
        if not modes.driven()[modes.mode_of_interest]:
            raise InputError("the shaker does not drive the mode of interest: move its force.")
        if self.structure.hysteretic and not self.largest_displacement > 0:
            kinds = ", ".join(effect.kind for effect in self.structure.hysteretic)
            raise InputError(
                f"{kinds} needs `largest_displacement`, in m at the reference sensor, but it is "
                f"{self.largest_displacement}."
            )
        if self.substeps < 1:
            raise InputError(f"`substeps` must be 1 or more, but is {self.substeps}.")
        fastest = _fastest(self.structure, self.shaker) / HERTZ
        if self.sampling_rate * self.substeps < _FEWEST_STEPS * fastest:
            raise InputError(
                f"`sampling_rate` times `substeps` must be {_FEWEST_STEPS} times the highest "
                f"frequency of structure and contacts, {fastest:.4g} Hz, or more, but is "
                f"{self.sampling_rate * self.substeps:g} Hz: "
                f"{int(np.ceil(_FEWEST_STEPS * fastest / self.sampling_rate))} substeps would do."
            )

    @property
    def frequency(self) -> float:
        """Natural frequency of the mode of interest, rad/s."""
        modes = self.structure.modes
        return modes.natural_frequency.item(modes.mode_of_interest)

    @property
    def decay(self) -> float:
        """ζω of the mode of interest, 1/s."""
        modes = self.structure.modes
        return modes.damping_ratio.item(modes.mode_of_interest) * self.frequency

    def samples(self, cycles: float) -> int:
        """Number of samples in so many cycles of the mode of interest."""
        return round(cycles * self.sampling_rate * HERTZ / self.frequency)

    def at_rest(self, controller: AbstractController) -> LabState:
        """The state of the structure at rest."""
        model = simulated_structure(self.structure)
        n = model.n_modes
        internal = internal_variables_at_rest(model, self.friction(), jnp.zeros(n))
        sections = len(filter_sections(self.instruments, self.sampling_rate * self.substeps))
        return LabState(
            LabMotion(jnp.zeros(n), jnp.zeros(n), internal),
            controller.initial(),
            jnp.zeros(()),
            jnp.zeros(3),
            jnp.zeros(2),
            jnp.zeros((sections, 2, 2)),
            jnp.zeros(()),
        )

    def reach(self) -> float:
        """`largest_displacement` as |q| of the mode of interest, kg^1/2 m."""
        modes = self.structure.modes
        shape = modes.mode_shape[reference_sensor(modes), modes.mode_of_interest]
        return self.largest_displacement / abs(float(shape))

    def friction(self) -> tuple[AbstractHysteresis, ...]:
        """The hysteretic elements, scaled for motions up to `largest_displacement`."""
        if not self.structure.hysteretic:
            return ()
        reach = self.reach() * jnp.sum(jnp.abs(friction_influence(self.structure)), axis=1)
        return scaled_friction(self.structure, reach, reach * self.frequency / np.sqrt(2))


@on_numbers("Differentiate the steady states of a model by `sj.simulate.periodic_motion`.")
def run_test(
    laboratory: Laboratory,
    controller: AbstractController,
    samples: int,
    *,
    start: LabState | None = None,
    seed: int = 0,
) -> tuple[TestRecord, LabState]:
    """Run the controller for a number of samples.

    Arguments: `start` is the final state of another run, by default rest; `seed` of the noise.
    Returns the record and the state at its end. Deterministic for a seed.
    Raises `ValueError` if a structure with friction exceeded `largest_displacement`.
    Not differentiable: differentiate the steady states of a model by
    `snrmjax.simulate.periodic_motion`.
    """
    begin = laboratory.at_rest(controller) if start is None else start
    noise = np.random.default_rng(seed).standard_normal((samples, 2))
    instruments = laboratory.instruments
    sections = filter_sections(instruments, laboratory.sampling_rate * laboratory.substeps)
    record, end = _run(laboratory, laboratory.friction(), controller, begin, sections, noise)
    if laboratory.structure.hysteretic and float(end.largest) > laboratory.reach():
        ratio = float(end.largest) / laboratory.reach()
        raise InputError(
            f"the motion reached {ratio * laboratory.largest_displacement:.4g} m at the reference "
            f"sensor, beyond `largest_displacement`, {laboratory.largest_displacement:g} m, up to "
            "which friction is resolved."
        )
    return record, end


@compiled
def _run(
    laboratory: Laboratory,
    friction: tuple[AbstractHysteresis, ...],
    controller: AbstractController,
    begin: LabState,
    sections: Float[np.ndarray, "section 6"],
    noise: Float[Array | np.ndarray, "sample channel"],
) -> tuple[TestRecord, LabState]:
    structure, ins = simulated_structure(laboratory.structure), laboratory.instruments
    modes, j = structure.modes, structure.modes.mode_of_interest
    shape = modes.mode_shape[reference_sensor(laboratory.structure.modes)]
    sign = jnp.sign(shape[j] * modes.participation[j])
    period = jnp.asarray(1 / laboratory.sampling_rate)
    steps, limit = laboratory.substeps, laboratory.shaker.largest_voltage
    slope = _equations(laboratory.shaker, laboratory.attached, structure, friction)
    step = _integrator(slope, structure, friction, period / steps)
    cubic = _between_samples(np.arange(2 * steps + 1) / (2 * steps))

    def channels(motion: LabMotion, voltage: Array) -> Array:
        return jnp.stack([slope(motion, voltage)[1], sign * (shape @ motion.velocity)])

    def sample(state: LabState, drawn: Array) -> tuple[LabState, tuple]:
        force = state.seen[0] + ins.force_noise * drawn[0]
        speed = state.seen[1] + ins.velocity_noise * drawn[1]
        control, command, report = controller.step(
            state.controller, Sample(state.time, force, speed), period
        )
        voltage = jnp.clip(command, -limit, limit)
        known = jnp.append(state.voltage, voltage)
        along = jnp.clip(cubic @ known, -limit, limit)

        def substep(now: tuple, volts: Array) -> tuple[tuple, None]:
            motion, filtered, seen = now
            motion = step(motion, volts)
            if len(sections):
                seen, filtered = _filtered(sections, filtered, channels(motion, volts[2]))
            return (motion, filtered, seen), None

        now = (state.motion, state.filtered, state.seen)
        volts_of_steps = jnp.stack([along[:-2:2], along[1::2], along[2::2]], axis=1)
        (motion, filtered, seen), _ = jax.lax.scan(substep, now, volts_of_steps, unroll=2)
        if not len(sections):
            seen = channels(motion, voltage)
        largest = jnp.maximum(state.largest, jnp.abs(motion.displacement[j]))
        after = LabState(
            motion,
            control,
            state.time + period,
            known[1:],
            seen,
            filtered,
            largest,
        )
        return after, (state.time, voltage, force, speed, report)

    end, columns = jax.lax.scan(sample, begin, jnp.asarray(noise))
    return TestRecord(*columns), end


def _equations(
    shaker: Shaker,
    attached: bool,
    structure: Structure,
    friction: tuple[AbstractHysteresis, ...],
) -> Callable[[LabMotion, Array], tuple[LabMotion, Array]]:
    """Rates of the state under a voltage, and the force at the force cell."""
    terms, drive = structure.linear_terms(), structure.modes.participation
    per_force = drive / terms.mass
    inertia = 1 + shaker.mass * (drive @ per_force)

    def armature_force(at: Array, speed: Array, voltage: Array) -> Array:
        """Force of coil and suspension on the armature."""
        current = (voltage - shaker.motor_constant * speed) / shaker.resistance
        current = jnp.clip(current, -shaker.largest_current, shaker.largest_current)
        return shaker.motor_constant * current - shaker.damping * speed - shaker.stiffness * at

    def slope(motion: LabMotion, voltage: Array) -> tuple[LabMotion, Array]:
        q, v = motion.displacement, motion.velocity
        inner, internal = inner_force(structure, friction, q, v, motion.internal)
        free = -inner / terms.mass
        force = jnp.zeros(())
        if attached:
            # The armature's inertia is part of the force: F = push − m (Γ·q̈), q̈ = free + Γ F.
            push = armature_force(drive @ q, drive @ v, voltage)
            force = (push - shaker.mass * (drive @ free)) / inertia
        return LabMotion(v, free + per_force * force, internal), force

    return slope


def _integrator(
    slope: Callable[[LabMotion, Array], tuple[LabMotion, Array]],
    structure: Structure,
    friction: tuple[AbstractHysteresis, ...],
    h: Array,
) -> Callable[[LabMotion, Float[Array, "3"]], LabMotion]:
    """One classical Runge-Kutta step of length h, with the sliders updated after it."""

    def step(motion: LabMotion, volts: Float[Array, "3"]) -> LabMotion:
        first, middle, last = volts

        def after(time: Array, rate: LabMotion) -> LabMotion:
            return jax.tree.map(lambda at, by: at + time * by, motion, rate)

        one = slope(motion, first)[0]
        two = slope(after(h / 2, one), middle)[0]
        three = slope(after(h / 2, two), middle)[0]
        four = slope(after(h, three), last)[0]
        mean = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, one, two, three, four)
        moved = after(h, mean)
        begin, end = ((at.displacement, at.velocity) for at in (motion, moved))
        internal = internal_variables_after_step(structure, friction, moved.internal, begin, end, h)
        return moved._replace(internal=internal)

    return step


def _between_samples(fraction: Float[np.ndarray, " time"]) -> Float[np.ndarray, "time 4"]:
    """Lagrange weights of the last four commands at fractions of the interval of the last two."""
    at = np.arange(-2.0, 2.0)
    others = [np.delete(at, k) for k in range(4)]
    return np.stack(
        [
            np.prod((fraction[:, None] - other) / (node - other), axis=1)
            for node, other in zip(at, others, strict=True)
        ],
        axis=1,
    )


def _filtered(
    sections: Float[np.ndarray, "section 6"],
    state: Float[Array, "section 2 channel"],
    value: Float[Array, " channel"],
) -> tuple[Float[Array, " channel"], Float[Array, "section 2 channel"]]:
    """Filter one sample through the sections, direct form II transposed."""
    kept = []
    for k, (b0, b1, b2, _, a1, a2) in enumerate(sections):
        out = b0 * value + state[k, 0]
        kept.append(jnp.stack([b1 * value - a1 * out + state[k, 1], b2 * value - a2 * out]))
        value = out
    return value, jnp.stack(kept)


def _fastest(structure: Structure, shaker: Shaker) -> float:
    """Largest |eigenvalue| (rad/s) of structure and shaker with closed contacts."""
    model = simulated_structure(structure)
    n, terms = model.n_modes, model.linear_terms()
    mass, stiffness = np.diag(np.asarray(terms.mass)), np.diag(np.asarray(terms.stiffness))
    damping = np.asarray(terms.damping_matrix())
    grid = np.logspace(-12, 3, 301)
    x = jnp.asarray(np.concatenate([-grid, grid]))
    for effect in model.forces:
        influence = np.asarray(elements_of([effect], model.modes).influence)
        if isinstance(effect, AbstractNonsmooth):
            slope = jax.vmap(jax.grad(effect.force))(x, jnp.zeros_like(x))
            stiffness = stiffness + float(jnp.max(slope)) * np.outer(influence[0], influence[0])
        elif isinstance(effect, AbstractHysteresis):
            most = np.asarray(effect.stuck_stiffness())
            stiffness = stiffness + influence.T @ (most[:, None] * influence)
    drive = np.asarray(model.modes.participation)
    coil = shaker.damping + shaker.motor_constant**2 / shaker.resistance
    coupling = np.outer(drive, drive)
    mass, damping = mass + shaker.mass * coupling, damping + coil * coupling
    stiffness = stiffness + shaker.stiffness * coupling
    state = np.block(
        [
            [np.zeros((n, n)), np.eye(n)],
            [-np.linalg.solve(mass, stiffness), -np.linalg.solve(mass, damping)],
        ]
    )
    return float(np.abs(np.linalg.eigvals(state)).max())
