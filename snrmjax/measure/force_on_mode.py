"""The force of a low-level test that is known in volts only, from the linear response."""

import dataclasses
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Complex, Float, Int

from snrmjax.measure.states import SteadyStates
from snrmjax.model.modes import LinearModes, linear_response
from snrmjax.numerics.result import AbstractResult, Variable, quantity
from snrmjax.numerics.status import Status


class ForceStatus(Status):
    """How the search for the equivalent force of one level ended."""

    SUCCESSFUL = 0, "found"
    TOO_FEW = 1, "fewer measured numbers than unknowns; adjust less, or measure more"
    NOT_CONVERGED = (
        2,
        "the linear response does not fit, or the states do not determine what is adjusted; check "
        "the modes and the band, or adjust something else",
    )
    NEGATIVE = (
        3,
        "the best force is negative; turn the sign of the sensor or of its mode shape, or adjust "
        "the phase",
    )


ADJUSTABLE = ("natural_frequency", "damping_ratio", "phase")


class EquivalentForce(AbstractResult):
    """Force with which the linear structure answers as measured, one entry a level.

    NaN where `status` is not `ForceStatus.SUCCESSFUL`. `force_covariance` contains, besides the
    random errors, the error that all levels share because `damping_ratio_std` of the mode of
    interest scales every force; `force_std` is its diagonal's root.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("level",)

    force_covariance: Float[Array, "level level"]  # N²
    misfit: Float[Array, " level"]  # rms residual: in stated σ, or in m/s where none is stated
    level: Int[Array, " level"] = quantity("level", "1", "level of the test")
    drive: Float[Array, " level"] = quantity("level", "V", "drive voltage")
    force: Float[Array, " level"] = quantity("level", "N", "equivalent force")
    # Of the mode of interest; a 1σ is 0 where nothing was adjusted.
    natural_frequency: Float[Array, " level"] = quantity("level", "Hz", "natural frequency")
    natural_frequency_std: Float[Array, " level"] = quantity("level", "Hz", "its 1σ")
    damping_ratio: Float[Array, " level"] = quantity("level", "1", "damping ratio")
    damping_ratio_std: Float[Array, " level"] = quantity("level", "1", "its 1σ")
    phase: Float[Array, " level"] = quantity("level", "deg", "velocities lead the model's by")
    phase_std: Float[Array, " level"] = quantity("level", "deg", "its 1σ")
    status: Int[Array, " level"] = quantity("level", "", "what became of the level", of=ForceStatus)

    def variables(self) -> dict[str, Variable]:
        """By level, with the forces' errors."""
        std = Variable(("level",), np.asarray(self.force_std), "N", "1σ of the force")
        return {**super().variables(), "force_std_n": std}

    @property
    def force_std(self) -> Float[Array, " level"]:
        """1σ of the forces in N."""
        return jnp.sqrt(jnp.diagonal(self.force_covariance))


def equivalent_force(
    data: SteadyStates,
    modes: LinearModes,
    *,
    adjust: tuple[str, ...] = ("natural_frequency",),
) -> EquivalentForce:
    """Force magnitude of every level, from its measured low-amplitude response.

    Minimises Σ |V_meas − F e^{iψ} H(Ω; ω_j, ζ_j)|² over F > 0 and what `adjust` names, H the
    linear response to a unit force; weighted along and across V_meas with `velocity_std` and
    `phase_std` where every measured velocity states both, else with equal weights and the noise
    taken from the residual. By a scan and Levenberg–Marquardt over ω_j and ζ_j, with F and ψ
    eliminated. Stated errors too small for the misfit are enlarged by it.

    Arguments: `data`, whose `level` groups the states of equal `drive` (V); `modes`, the linear
    model; `adjust`, any of "natural_frequency" (ω_j), "damping_ratio" (ζ_j), both of the mode of
    interest, and "phase" (ψ, common to the level).
    Returns `EquivalentForce`, with a status per level: its `message` says what to try.
    Not differentiable: the starting point is scanned for and states are checked on the host.
    Raises `ValueError` for an unknown name in `adjust`, a sensor that the model lacks, or a level
    whose drives differ.
    Validity: levels so low that the response is linear; the force is what the given mode shapes,
    participations and (unless adjusted) damping make of the velocity.
    Reference: Kwarta & Allen, section 4.1 and Eq. (23).
    """
    unknown = [name for name in adjust if name not in ADJUSTABLE]
    if unknown:
        raise ValueError(f"`adjust` must name some of {ADJUSTABLE}, but names {unknown[0]!r}.")
    missing = [name for name in data.sensors if name not in modes.sensors]
    if missing:
        raise ValueError(
            f"`data` has sensor {missing[0]!r}, but `modes` has only {', '.join(modes.sensors)}."
        )
    rows = np.asarray([modes.sensors.index(name) for name in data.sensors])
    seen = dataclasses.replace(
        modes,
        mode_shape=modes.mode_shape[rows],
        rigid_body_shape=modes.rigid_body_shape[rows],
        sensors=data.sensors,
    )
    levels = np.unique(np.asarray(data.level))
    members = np.asarray(data.level)[None, :] == levels[:, None]
    drive = np.array([_common_drive(data, level) for level in levels])
    stated = data.measured & (data.velocity_std > 0) & (data.phase_std > 0)
    use_stated = jnp.all(stated == data.measured)
    adjusted = ("natural_frequency" in adjust, "damping_ratio" in adjust, "phase" in adjust)
    best, std, covariance, misfit, status = _fit_levels(
        seen, data, jnp.asarray(members), use_stated, adjusted
    )
    return EquivalentForce(
        level=jnp.asarray(levels),
        drive=jnp.asarray(drive),
        force=best[:, 0],
        force_covariance=covariance,
        natural_frequency=best[:, 1],
        natural_frequency_std=std[:, 1],
        damping_ratio=best[:, 2],
        damping_ratio_std=std[:, 2],
        phase=best[:, 3],
        phase_std=std[:, 3],
        misfit=misfit,
        status=status,
    )


def _common_drive(data: SteadyStates, level: int) -> float:
    drive = np.asarray(data.drive)[np.asarray(data.level) == level]
    if np.any(drive != drive[0]) and not np.all(np.isnan(drive)):
        different = drive[np.argmax(drive != drive[0])]
        raise ValueError(
            f"`drive` must be the same for all states of a level, but level {level} has "
            f"{drive[0]:g} V and {different:g} V."
        )
    return float(drive[0])


@eqx.filter_jit
def _fit_levels(
    modes: LinearModes,
    data: SteadyStates,
    members: Bool[Array, "level state"],
    use_stated: Bool[Array, ""],
    adjusted: tuple[bool, bool, bool],
) -> tuple[Array, Array, Array, Array, Array]:
    """Force, ω_j, ζ_j and ψ of every level, their std, the force covariance, misfit and status."""
    # One after the other: a batch would wait for its slowest level, and compile for longer.
    best, std, shared, misfit, status = jax.lax.map(
        lambda member: _fit_level(modes, data, member, use_stated, adjusted), members
    )
    good = status == int(ForceStatus.SUCCESSFUL)
    covariance = jnp.diag(std[:, 0] ** 2) + shared @ shared.T
    covariance = jnp.where(good[:, None] & good, covariance, jnp.nan)

    def masked(value: Array) -> Array:
        return jnp.where(good[:, None], value, jnp.nan)

    return masked(best), masked(std), covariance, jnp.where(good, misfit, jnp.nan), status


class _Level(NamedTuple):
    """The states of one level, and their velocities' deviations from those of the model."""

    modes: LinearModes
    data: SteadyStates
    used: Bool[Array, "state sensor"]
    measured: Complex[Array, "state sensor"]  # m/s, zero where not used
    along: Float[Array, "state sensor"]  # m/s, 1σ along the measured velocity
    across: Float[Array, "state sensor"]  # m/s, and across it
    phase_is_free: bool

    def weighted(self, velocity: Complex[Array, "state sensor"]) -> Float[Array, " number"]:
        """Velocities in 1σ, along and across those that were measured."""
        direction = jnp.where(jnp.abs(self.measured) > 0, self.measured, 1.0)
        turned = jnp.where(self.used, velocity / (direction / jnp.abs(direction)), 0.0)
        parts = (turned.real / self.along, turned.imag / self.across)
        return jnp.concatenate([part.ravel() for part in parts])

    def unit_response(self, mode: Float[Array, " 2"]) -> Complex[Array, "state sensor"]:
        """Velocities under 1 N with another ω_j and ζ_j."""
        j, frequency = self.modes.mode_of_interest, self.data.frequency
        adapted = dataclasses.replace(
            self.modes,
            natural_frequency=self.modes.natural_frequency.at[j].set(mode[0]),
            damping_ratio=self.modes.damping_ratio.at[j].set(mode[1]),
        )
        return linear_response(adapted, frequency, jnp.ones_like(frequency))

    def deviation(self, unknown: Float[Array, " 4"]) -> Float[Array, " number"]:
        """In 1σ, of F, ω_j, ζ_j and ψ."""
        force = unknown[0] * jnp.exp(1j * unknown[3])
        return self.weighted(force * self.unit_response(unknown[1:3]) - self.measured)

    def eliminated(
        self, mode: Float[Array, " 2"]
    ) -> tuple[Float[Array, " 4"], Float[Array, " number"]]:
        """The unknowns and deviations with the best F and ψ, as F e^{iψ} = a + ib."""
        unit, target = self.unit_response(mode), self.weighted(self.measured)
        real = self.weighted(unit)
        if not self.phase_is_free:
            a = real @ target / (real @ real)
            return jnp.stack([a, *mode, 0.0]), a * real - target
        imag = self.weighted(1j * unit)
        across_real = imag - (real @ imag / (real @ real)) * real
        b = across_real @ target / (across_real @ imag)
        a = real @ (target - b * imag) / (real @ real)
        best = jnp.stack([jnp.hypot(a, b), *mode, jnp.arctan2(b, a)])
        return best, a * real + b * imag - target


def _fit_level(
    modes: LinearModes,
    data: SteadyStates,
    member: Bool[Array, " state"],
    use_stated: Bool[Array, ""],
    adjusted: tuple[bool, bool, bool],
) -> tuple[Array, Array, Array, Array, Array]:
    """The unknowns are (F, ω_j, ζ_j, ψ); F and ψ are linear, so that only ω_j and ζ_j iterate."""
    used = member[:, None] & data.measured
    n_used = jnp.sum(used)
    measured = jnp.where(used, data.velocity, 0.0)
    size = jnp.sqrt(jnp.sum(jnp.abs(measured) ** 2) / jnp.maximum(n_used, 1))
    size = jnp.where(size > 0, size, 1.0)
    weigh = used & use_stated
    along = jnp.where(weigh, data.velocity_std, size)
    across = jnp.where(weigh, data.phase_std * jnp.abs(measured), size)
    level = _Level(modes, data, used, measured, along, across, adjusted[2])
    lowest = jnp.min(jnp.where(member, data.frequency, jnp.inf))
    highest = jnp.max(jnp.where(member, data.frequency, -jnp.inf))
    mode, solved = _best_mode(level, lowest, highest, adjusted)
    best, remaining = level.eliminated(mode)
    freedom = 2 * n_used - (1 + sum(adjusted))
    squares = jnp.sum(remaining**2)
    misfit = jnp.where(freedom > 0, jnp.sqrt(squares / jnp.maximum(freedom, 1)), jnp.nan)
    # Stated errors that do not explain the misfit are too small for the model: enlarge them.
    at_least_one = jnp.maximum(1.0, jnp.nan_to_num(misfit, nan=1.0))
    std, shared, determined = _errors(
        level, best, jnp.where(use_stated, at_least_one, misfit), adjusted
    )
    solved &= (mode[0] > 0.5 * lowest) & (mode[0] < 2 * highest) & jnp.all(jnp.isfinite(best))
    status = jnp.where(best[0] > 0, int(ForceStatus.SUCCESSFUL), int(ForceStatus.NEGATIVE))
    status = jnp.where(solved & determined, status, int(ForceStatus.NOT_CONVERGED))
    status = jnp.where(freedom >= 0, status, int(ForceStatus.TOO_FEW))
    return best, std, shared, misfit * jnp.where(use_stated, 1.0, size), status


def _best_mode(
    level: _Level, lowest: Array, highest: Array, adjusted: tuple[bool, bool, bool]
) -> tuple[Float[Array, " 2"], Bool[Array, ""]]:
    """ω_j and ζ_j of the least deviations, by a scan and steps from its best point, if found."""
    j = level.modes.mode_of_interest
    natural, damping = level.modes.natural_frequency[j], level.modes.damping_ratio[j]
    frequencies, ratios = natural[None], damping[None]
    if adjusted[0]:
        frequencies = jnp.append(jnp.linspace(lowest, highest, 128), natural)
    if adjusted[1]:
        ratios = jnp.maximum(damping, 1e-4) * 2.0 ** jnp.arange(-3.0, 4.0)
    grid = jnp.stack(jnp.meshgrid(frequencies, ratios), axis=-1).reshape(-1, 2)
    misfits = jax.lax.map(lambda mode: jnp.sum(level.eliminated(mode)[1] ** 2), grid)
    start = grid[jnp.nanargmin(misfits)]
    iterated = np.flatnonzero(adjusted[:2])
    finite = jnp.all(jnp.isfinite(level.measured))
    if not iterated.size:
        return start, finite

    def mode_of(step: Float[Array, " iterated"]) -> Float[Array, " 2"]:
        full = jnp.zeros(2).at[iterated].set(step)
        return start * jnp.stack([1 + start[1] * full[0], jnp.exp(full[1])])

    solution: optx.Solution = optx.least_squares(
        lambda step, _: level.eliminated(mode_of(step))[1],
        optx.LevenbergMarquardt(rtol=1e-6, atol=1e-7),
        jnp.zeros(iterated.size),
        max_steps=128,
        throw=False,
    )
    found = jnp.asarray(solution.result == optx.RESULTS.successful)
    return mode_of(solution.value), finite & found


def _errors(
    level: _Level, best: Float[Array, " 4"], enlarged: Array, adjusted: tuple[bool, bool, bool]
) -> tuple[Float[Array, " 4"], Float[Array, " 2"], Bool[Array, ""]]:
    """1σ of the unknowns, what stated errors of a held ω_j and ζ_j do to F, and if all is told."""
    scale = jnp.where(best == 0, 1.0, best).at[3].set(1.0)
    sensitivity = jax.jacfwd(level.deviation)(best) * scale
    free = np.array([True, *adjusted])
    orthogonal, upper = jnp.linalg.qr(sensitivity[:, free])
    singular = jnp.linalg.svd(upper, compute_uv=False)
    inverse = jax.scipy.linalg.solve_triangular(upper, jnp.eye(upper.shape[0]))
    spread = jnp.linalg.norm(inverse, axis=1) * enlarged
    std = jnp.zeros(4).at[free].set(jnp.abs(scale[free]) * spread)
    modes, j = level.modes, level.modes.mode_of_interest
    held = jnp.stack([modes.natural_frequency_std[j], modes.damping_ratio_std[j]])
    held = jnp.where(jnp.asarray(adjusted[:2]), 0.0, held) / scale[1:3]
    shared = -scale[0] * (inverse @ (orthogonal.T @ sensitivity[:, 1:3]))[0] * held
    return std, shared, singular[-1] > 1e-9 * singular[0]
