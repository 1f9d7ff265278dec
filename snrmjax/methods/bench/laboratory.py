"""A virtual laboratory: structure, shaker, instruments and a sampled controller, in time.

The shaker is an electrodynamic one, U = R i + G v, whose armature moves with the drive point
(stiff stinger): what the force cell reads is G i less what the armature takes, so that the force
drops at resonance and carries harmonics, as on a real shaker. From one sample of the controller
to the next the voltage goes straight from the last command to the new one (a reconstruction
filter's delay of one sample), and the equations of motion are integrated by the classical method
of Runge and Kutta.

Reference: for the shaker, G. R. Tomlinson, J. Sound Vib. 63 (1979) 337,
doi:10.1016/0022-460X(79)90681-9.
"""

import abc
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.identify.pointwise.snrm import reference_sensor
from snrmjax.model.structures import Structure

_SUBSTEPS = 2  # of a sample
_FEWEST_SAMPLES = 20  # a cycle of the highest mode's motion that the integration can follow


class Shaker(NamedTuple):
    """An electrodynamic shaker whose armature moves with the drive point."""

    resistance: float = 3.0  # ohm
    motor_constant: float = 15.0  # N/A, and V s/m
    mass: float = 0.0  # kg, armature and force cell beyond its sensing element
    damping: float = 0.0  # N s/m
    stiffness: float = 0.0  # N/m, of the armature's suspension


class Instruments(NamedTuple):
    """What the channels add to force and velocity."""

    force_noise: float = 0.0  # N, 1σ of a sample
    velocity_noise: float = 0.0  # m/s, 1σ of a sample
    force_range: float = np.inf  # N, beyond which the channel is clipped
    velocity_range: float = np.inf  # m/s
    bits: int = 0  # of the converter over both ranges; 0 for none


class Sample(NamedTuple):
    """What the controller sees at a sample."""

    time: Float[Array, ""]
    force: Float[Array, ""]  # N
    velocity: Float[Array, ""]  # m/s, at the reference sensor


class AbstractController(eqx.Module):
    """A sampled controller: it sees force and velocity and sets the shaker's voltage."""

    @abc.abstractmethod
    def initial(self) -> Any:
        """Its state before the first sample."""

    @abc.abstractmethod
    def step(self, state: Any, sample: Sample, period: Float[Array, ""]) -> tuple[Any, Array, Any]:
        """The next state, the voltage until the next sample, and what it reports."""


class TestRecord(NamedTuple):
    """Channels of a test, one entry a sample."""

    time: Float[Array, " sample"]  # s
    voltage: Float[Array, " sample"]
    force: Float[Array, " sample"]  # N, as recorded
    velocity: Float[Array, " sample"]  # m/s, as recorded
    report: Any  # of the controller, arrays that lead with the sample


class LabState(NamedTuple):
    """Everything that goes on from one run to the next."""

    displacement: Float[Array, " mode"]
    velocity: Float[Array, " mode"]
    controller: Any
    time: Float[Array, ""]
    force: Float[Array, ""]  # N, last
    voltage: Float[Array, ""]  # last command


class Laboratory(eqx.Module):
    """A structure on a shaker with its instruments.

    `sampling_rate` in Hz is that of the controller and of the records. Effects with memory
    (friction) are refused: they need their own integration. The corners of the voltage, which no
    filter removes here, alias into the force by (ω period)²/12 of the shaker's own force, which
    near resonance may be several times the force on the structure.
    """

    structure: Structure
    shaker: Shaker
    instruments: Instruments
    sampling_rate: float = eqx.field(static=True)

    def __check_init__(self) -> None:
        if self.structure.hysteretic:
            kinds = ", ".join(effect.kind for effect in self.structure.hysteretic)
            raise ValueError(
                f"the virtual laboratory cannot integrate effects with memory: {kinds}."
            )
        if not self.shaker.resistance > 0 or min(self.shaker[1:]) < 0:
            raise ValueError(f"a shaker's numbers must not be negative, but are {self.shaker}.")
        highest = float(np.max(np.asarray(self.structure.modes.natural_frequency))) / (2 * np.pi)
        if self.sampling_rate * _SUBSTEPS < _FEWEST_SAMPLES * highest:
            raise ValueError(
                f"`sampling_rate` must be {_FEWEST_SAMPLES / _SUBSTEPS:g} times the highest "
                f"natural frequency, {highest:.4g} Hz, or more, but is {self.sampling_rate:g} Hz."
            )

    def at_rest(self, controller: AbstractController) -> LabState:
        """The state before anything moves."""
        rest = jnp.zeros(self.structure.n_modes)
        return LabState(rest, rest, controller.initial(), *jnp.zeros((3,)))


def run_test(
    laboratory: Laboratory,
    controller: AbstractController,
    samples: int,
    *,
    start: LabState | None = None,
    seed: int = 0,
) -> tuple[TestRecord, LabState]:
    """Let the controller work for a number of samples.

    Arguments: `start` is where another run ended, by default rest; `seed` draws the noise.
    Returns the record and the state at its end. Deterministic for a seed.
    """
    begin = laboratory.at_rest(controller) if start is None else start
    noise = jax.random.normal(jax.random.key(seed), (samples, 2))
    return _run(laboratory, controller, begin, noise)


@eqx.filter_jit
def _run(
    laboratory: Laboratory,
    controller: AbstractController,
    begin: LabState,
    noise: Float[Array, "sample channel"],
) -> tuple[TestRecord, LabState]:
    structure, shaker = laboratory.structure, laboratory.shaker
    modes, terms = structure.modes, structure.linear_terms()
    drive, shape = modes.participation, modes.mode_shape[reference_sensor(modes)]
    turn = jnp.sign(shape[modes.mode_of_interest] * drive[modes.mode_of_interest])
    period = jnp.asarray(1 / laboratory.sampling_rate)
    inertia = 1 + shaker.mass * (drive @ drive)

    def accelerations(q: Array, v: Array, voltage: Array) -> tuple[Array, Array]:
        """Modal accelerations and the force that the cell reads."""
        own = structure.memoryless_force(q[None], v[None])[0]
        free = -(terms.damping * v + terms.stiffness * q + own) / terms.mass
        at, speed = drive @ q, drive @ v
        current = (voltage - shaker.motor_constant * speed) / shaker.resistance
        push = shaker.motor_constant * current - shaker.damping * speed - shaker.stiffness * at
        # The armature's inertia is part of the force: F = push − m (Γ·q̈), q̈ = free + Γ F.
        force = (push - shaker.mass * (drive @ free)) / inertia
        return free + drive * force, force

    def substep(q: Array, v: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        h, (first, last) = period / _SUBSTEPS, ends
        middle = (first + last) / 2
        a1, _ = accelerations(q, v, first)
        a2, _ = accelerations(q + h / 2 * v, v + h / 2 * a1, middle)
        a3, _ = accelerations(q + h / 2 * v + h**2 / 4 * a1, v + h / 2 * a2, middle)
        a4, _ = accelerations(q + h * v + h**2 / 2 * a2, v + h * a3, last)
        return q + h * v + h**2 / 6 * (a1 + a2 + a3), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)

    def sample(state: LabState, drawn: Array) -> tuple[LabState, tuple]:
        ins = laboratory.instruments
        force = _recorded(state.force + ins.force_noise * drawn[0], ins.force_range, ins.bits)
        speed = turn * (shape @ state.velocity) + ins.velocity_noise * drawn[1]
        speed = _recorded(speed, ins.velocity_range, ins.bits)
        seen = Sample(state.time, force, speed)
        control, voltage, report = controller.step(state.controller, seen, period)
        q, v = state.displacement, state.velocity
        rise = (voltage - state.voltage) / _SUBSTEPS
        for k in range(_SUBSTEPS):
            q, v = substep(q, v, (state.voltage + k * rise, state.voltage + (k + 1) * rise))
        _, read = accelerations(q, v, voltage)
        after = LabState(q, v, control, state.time + period, read, voltage)
        return after, (state.time, voltage, force, speed, report)

    end, columns = jax.lax.scan(sample, begin, noise)
    return TestRecord(*columns), end


def _recorded(value: Array, limit: float, bits: int) -> Array:
    """A value after clipping and the converter."""
    if not np.isfinite(limit):
        return value
    clipped = jnp.clip(value, -limit, limit)
    if not bits:
        return clipped
    step = 2 * limit / 2**bits
    return step * jnp.round(clipped / step)
