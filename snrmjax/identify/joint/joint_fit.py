"""Smooth curves of ω̃² and 2ζ̃ω̃ fitted jointly to all states, levels and sensors."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from snrmjax.identify.checks.instruments import notes_on_instruments, require_passive
from snrmjax.identify.checks.residual_autocorrelation import (
    residual_autocorrelation,
    states_of_levels,
)
from snrmjax.identify.curves.families import parse_family
from snrmjax.identify.curves.splines import SmoothingSpline
from snrmjax.identify.joint.force_balance import (
    BalanceData,
    BalanceProblem,
    Motion,
    PriorStd,
    Unknowns,
    balance_data,
    recorded_motion,
    stated_level_std,
    stated_prior,
)
from snrmjax.identify.joint.free_unknowns import (
    FREE,
    PackedUnknowns,
    Unravel,
    named_unknowns,
    packed_unknowns,
    padded_levels,
)
from snrmjax.identify.joint.notes import (
    NoiseEstimate,
    notes_on_autocorrelation,
    notes_on_families,
    notes_on_level_errors,
    notes_on_modal_mass,
    notes_on_noise,
    notes_on_reach,
    notes_on_stated_errors,
)
from snrmjax.identify.joint.posterior_view import view_of, viewed_covariance, viewed_unknowns
from snrmjax.measure.phase_convention import naming_wrong_phases
from snrmjax.measure.states import SteadyStates
from snrmjax.model.modes import LinearModes
from snrmjax.model.structures import Structure, modes_of
from snrmjax.numerics.blocks import on_one_core
from snrmjax.numerics.compiled import on_numbers
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.names import with_former_attributes
from snrmjax.numerics.result import AbstractResult, Variable, quantity, setting
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

_MOVED = 2.0  # standard deviations from which a level error is reported


@with_former_attributes({"modes_found": "identified_modes"})
class JointFit(AbstractResult):
    """Both fitted curves, all other unknowns, and their covariance.

    `covariance` is of the free unknowns in the order of `names`, and allows for the correlation of
    neighbouring states' residuals. `noise.level_std` is of `LEVEL_ERRORS`, stated or estimated;
    estimates from few levels are widened in `prior` and in the covariance, as by Student's t.
    """

    coordinates = ("parameter",)

    unknowns: Unknowns
    covariance: Float[np.ndarray, "unknown unknown"]
    problem: BalanceProblem
    noise: NoiseEstimate
    # Unit variance if the model holds.
    residuals: Float[np.ndarray, "state part"] = quantity(
        "state part", "1", "whitened residual", name="residual"
    )
    drive_known_only: bool = eqx.field(static=True)
    free: tuple[str, ...] = eqx.field(static=True)
    notes: tuple[Fact, ...] = setting()
    converged: bool = eqx.field(static=True)
    level_numbers: tuple[int, ...] = eqx.field(static=True)  # in the file; `data` counts from 0

    @property
    def status(self) -> str:
        """Convergence of the fit, in words."""
        more = "not converged: fit and noise estimate still changed one another in the last round"
        return "converged" if self.converged else more

    @property
    def data(self) -> BalanceData:
        """The states as the fit uses them."""
        return self.problem.data

    @property
    def modes(self) -> LinearModes:
        """The linear modes of the structure."""
        return self.problem.modes

    @property
    def prior(self) -> PriorStd:
        """Prior standard deviations, including those estimated from the levels."""
        return self.problem.prior

    @property
    def largest(self) -> tuple[float, float]:
        """Largest measured displacement (m) and velocity (m/s), without level-gain correction."""
        motion = self.motion()
        level = np.asarray(self.unknowns.level) * np.asarray(self.prior.level)
        of_velocity = 1 - float(self.prior.gain_of_force)
        recorded = np.exp(of_velocity * level[np.asarray(self.data.level), 0])
        pair = (np.asarray(motion.displacement), np.abs(np.asarray(motion.velocity)))
        displacement, velocity = (float(np.max(recorded * amplitude)) for amplitude in pair)
        return displacement, velocity

    @property
    def identified_modes(self) -> LinearModes:
        """The linear modes with the fitted modal mass of the mode of interest.

        Its 1σ, where one was stated, is the fit's.
        """
        fraction = self.problem.constant_of(self.unknowns) / self.problem.modal_constant
        j, modes = self.modes.mode_of_interest, self.modes
        factor = np.ones(modes.n_modes)
        factor[j] = fraction
        of_force = jax.device_put(modes.participation * factor)
        scaled = dataclasses.replace(modes, participation=of_force)
        if modes.participation_lag is not None:
            lag = jax.device_put(modes.participation_lag * factor)
            scaled = dataclasses.replace(scaled, participation_lag=lag)
        if modes.modal_mass_std is None:
            return scaled
        std = np.array(modes.modal_mass_std)
        std[j] = np.asarray(self.prior.linear)[-1] * np.sqrt(self.covariance[-1, -1])
        return eqx.tree_at(lambda m: m.modal_mass_std, scaled, jax.device_put(std))

    def motion(self) -> Motion:
        """Motion of the nonlinear mode in all states, by the fitted unknowns."""
        return recorded_motion(self.unknowns, self.problem)

    def recorded_force(self, force: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        """The record of a force in N: in N, or in V where only the drive is known."""
        gain, offset = self._force_line()
        return (np.asarray(force) - offset) / gain

    def force_of_drive(self, drive: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        """The force in N of a record (inverse of `recorded_force`)."""
        gain, offset = self._force_line()
        return np.asarray(drive) * gain + offset

    def _force_line(self) -> tuple[float, float]:
        smallest = float(np.min(np.asarray(self.data.force)))
        offset = float(self.unknowns.force_offset) * smallest
        return float(np.exp(float(self.unknowns.log_force_gain))), offset

    def vector(self) -> tuple[Float[Array, " unknown"], Unravel]:
        """The free unknowns as a vector, and the map back to all unknowns."""
        unravel = Unravel(self.unknowns, self.free)
        return unravel.vector(), unravel

    def packed(self) -> PackedUnknowns:
        """The free unknowns padded for compiled programs."""
        return packed_unknowns(self.unknowns, self.free, padded_levels(self.data.n_levels))

    def names(self) -> tuple[str, ...]:
        """Names of the free unknowns."""
        return tuple(name for name, _ in named_unknowns(self.unknowns, self.data, self.free))

    def units(self) -> tuple[str, ...]:
        """Units of the free unknowns; a curve's terms are their values at the largest amplitude."""
        return tuple(unit for _, unit in named_unknowns(self.unknowns, self.data, self.free))

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`."""
        squared, damping = self.unknowns.squared_frequency, self.unknowns.modal_damping
        motion = self.motion()
        omega = np.sqrt(np.asarray(squared(motion.amplitude(squared))))
        ratio = np.asarray(damping(motion.amplitude(damping))) / (2 * omega)
        speed = np.abs(np.asarray(motion.velocity))
        scale = f"{self.noise.scale:.3g} ± {self.noise.scale_std:.1g}"
        noise = f"{scale} times the stated noise"
        if not self.noise.stated:
            noise = f"noise {100 * self.noise.scale:.2g} % of the velocity (estimated)"
        return (
            f"JointFit: natural frequency: {squared.words}; damping: {damping.words}",
            f"{len(self.data.level)} steady states of {self.data.n_levels} levels at "
            f"{self.modes.sensors[self.data.sensor]!r}, {speed.min():.3g} to {speed.max():.3g} m/s",
            f"natural frequency {omega.min() / HERTZ:.6g} to {omega.max() / HERTZ:.6g} Hz, "
            f"damping ratio {100 * ratio.min():.3g} to {100 * ratio.max():.3g} %",
            f"residuals: {noise}",
            f"status: {self.status}",
            *(f"note: {note}" for note in self.notes),
        )

    def variables(self) -> dict[str, Variable]:
        """See `AbstractResult`."""
        std, data, per = np.sqrt(np.diag(self.covariance)), self.data, ("parameter",)
        state, force = ("state",), "V" if self.drive_known_only else "N"
        measured, numbers = np.asarray(data.force), np.array(self.level_numbers)
        # With the level numbers of the file.
        named = named_unknowns(self.unknowns, data, self.free, self.level_numbers)
        labels = [name for name, _ in named]
        return {
            "parameter": Variable(per, np.array(labels), "", "free unknown"),
            "value": Variable(per, np.asarray(self.vector()[0]), "", "value, in `unit`"),
            "std": Variable(per, std, "", "1σ, in `unit`"),
            "unit": Variable(per, np.array(self.units()), "", "unit of the parameter"),
            "level": Variable(state, numbers[np.asarray(data.level)], "1", "level"),
            "frequency_hz": Variable(state, np.asarray(data.frequency) / HERTZ, "Hz", "frequency"),
            "drive_v" if force == "V" else "force_n": Variable(state, measured, force, "force"),
            "velocity_m_s": Variable(
                state, np.abs(np.asarray(self.motion().velocity)), "m/s", "velocity of the mode"
            ),
            **super().variables(),
        }

    def attributes(self) -> dict[str, str | float | int]:
        """See `AbstractResult`."""
        return {
            "backbone": self.unknowns.squared_frequency.label,
            "damping": self.unknowns.modal_damping.label,
            "noise_scale": self.noise.scale,
            "status": self.status,
            **super().attributes(),
        }


@on_numbers("Differentiate `sj.identify.refit`.")
@on_one_core
@naming_wrong_phases(data="data", modes="modes")
def fit_jointly(
    data: SteadyStates,
    modes: LinearModes | Structure,
    *,
    backbone: str = "auto",
    damping: str = "auto",
    free: Sequence[str] = (),
    level_gain_std: float | None = None,
    level_phase_std: float | None = None,
    robust: bool | None = None,
) -> JointFit:
    """Fit both curves to the complex force balance of all states at once.

    The model of a test (`identify.test_model`) estimates the smoothness of the curves, the noise,
    and by how much levels differ in gain, phase, stiffness and damping, by empirical Bayes with
    stated priors; smooth curves, bands and all other unknowns are its posterior. A family by name
    replaces the smooth curve, with a smooth remainder that is exactly zero where noise explains it;
    elsewhere the notes contain `family_leaves`, and the bands include the remainder.
    States are corrected for their most likely errors (orthogonal distance regression). The other
    modes' frequencies and dampings, and the dependence of both curves on the forcing frequency at
    equal amplitude, are unknowns too. Residuals above the stated noise widen the bands. The modal
    mass is an unknown with its stated 1σ (`LinearModesStd.modal_mass`); where none is stated it is
    the model's, unless states off resonance contradict it. A free force gain cannot be
    distinguished from it.

    Arguments: `backbone` and `damping` name a family of `FAMILIES`, optionally with its order
    ("polynomial:2", "spline:5") and amplitude ("polynomial:2@velocity"); by default the simplest
    that lies within the band of the smooth curve. "auto" is that curve itself, a smoothing spline.
    `free` may name "force_gain", "force_offset" and "instrument_phase"; the gain is always free
    where only the drive is known. `modes` may be a structure, which also states the 1σ of level
    errors: gain, phase, natural frequency and damping ratio. `level_gain_std` (relative) and
    `level_phase_std` (rad), where given, replace the first two.
    `robust` gives outliers little weight (Student's t); by default where that noise is the more
    probable one.
    Returns a `JointFit`; its `status` reports convergence.
    Raises `ValueError` for too few states, an unknown family or name, a family with more parameters
    than data, a gain, offset or phase that the data do not determine, and a fit with negative modal
    mass or damping.
    Validity: one nonlinear mode whose ω̃ and 2ζ̃ω̃ are functions of amplitude alone.
    Not differentiable: differentiate `snrmjax.identify.refit`.
    """
    level_std = stated_level_std(modes)
    for k, std in enumerate((level_gain_std, level_phase_std)):
        level_std[k] = level_std[k] if std is None else std
    modes = modes_of(modes)
    unknown = [name for name in free if name not in FREE]
    if unknown:
        raise InputError(f"`free` knows {', '.join(FREE)}, not {unknown[0]!r}.")
    if data.sensors != modes.sensors:
        raise InputError(
            f"`data` has the sensors {list(data.sensors)}, but `modes` has {list(modes.sensors)}."
        )
    choices = parse_family(backbone), parse_family(damping)
    measured, stated, numbers = balance_data(data, modes)
    n = len(measured.level)
    if n < 3:
        raise InputError(f"a joint fit needs at least 3 steady states, but only {n} are usable.")
    driven = not np.any(np.isfinite(np.asarray(data.force)))
    released = tuple(name for name in FREE if name in free or (driven and name == "force_gain"))
    knots = {
        choice.size for choice in choices if choice.kind == SmoothingSpline.kind and choice.size
    }
    if len(knots) > 1:
        raise InputError(
            f"both smooth curves share their knots: give both the same number, not {min(knots)} "
            f"and {max(knots)}."
        )
    problem = BalanceProblem(measured, modes, stated_prior(modes, level_std, released))
    most_knots = max(knots, default=None)
    view = view_of(problem, choices, released, stated, robust=robust, knots=most_knots)
    posterior, unknowns = view.posterior, viewed_unknowns(view)
    covariance = viewed_covariance(view)
    level, frequency = np.asarray(measured.level), np.asarray(measured.frequency)
    autocorrelation = residual_autocorrelation(
        posterior.residuals, states_of_levels(level, frequency)
    )
    # Level errors are reported where they are significant or the fit used them; the prior allows
    # for them elsewhere too.
    differ = np.array(posterior.differing) | _moved(unknowns, covariance)
    reported = np.where(level_std > 0, level_std, np.where(differ, view.noise.level_std, 0.0))
    fit = JointFit(
        unknowns=unknowns,
        covariance=covariance,
        problem=view.problem,
        noise=dataclasses.replace(view.noise, level_std=reported, autocorrelation=autocorrelation),
        residuals=posterior.residuals,
        drive_known_only=driven,
        free=released,
        notes=(),
        converged=bool(posterior.converged),
        level_numbers=numbers,
    )
    notes = notes_on_instruments(fit)
    curve, mass = fit.unknowns.modal_damping, fit.problem.constant_of(fit.unknowns)
    require_passive(
        released,
        float(fit.problem.modal_constant / mass),
        curve.linearised(np.asarray(fit.motion().amplitude(curve))).value,
    )
    named = any(choice.kind != SmoothingSpline.kind for choice in choices)
    notes += _notes(fit, posterior.frequency_scatter, level_std, named)
    return dataclasses.replace(fit, notes=tuple(notes))


@on_numbers("Differentiate `sj.identify.refit`.")
def corrected_states(data: SteadyStates, fit: JointFit) -> SteadyStates:
    """The states with force and phase corrected by a joint fit's instrument errors.

    Where only a drive voltage is known, the force in N is that voltage times the fitted gain.

    Not differentiable: differentiate `snrmjax.identify.refit`.
    """
    unknowns = fit.unknowns
    nominal = np.asarray(data.drive if fit.drive_known_only else data.force)
    offset = float(unknowns.force_offset) * np.min(np.asarray(fit.data.force))
    corrected = (
        nominal * np.exp(float(unknowns.log_force_gain)) + offset,
        np.asarray(data.velocity) * np.exp(-1j * float(unknowns.instrument_phase)),
    )
    return eqx.tree_at(lambda d: (d.force, d.velocity), data, jax.device_put(corrected))


def _notes(
    fit: JointFit, frequency_jitter_std: float, stated: Float[np.ndarray, " error"], named: bool
) -> list[Fact]:
    """Notes of a joint fit.

    Arguments: `frequency_jitter_std` 1σ of the natural frequency from state to state, relative;
    `stated` 1σ of levels' errors; `named` whether a family was requested for a curve.
    """
    notes = []
    if not fit.converged:
        is_stated = {"noise_stated": fit.noise.stated, "levels_stated": bool(np.all(stated > 0))}
        reason = fit.status
        notes.append(Fact("fit_not_converged", reason=reason, named=named, **is_stated))
    level, n_levels = np.asarray(fit.data.level), fit.data.n_levels
    notes += notes_on_noise(
        fit.noise, frequency_jitter_std, stated, np.asarray(fit.prior.new_level), n_levels
    )
    if np.any((stated == 0) & (fit.noise.level_std > 0)):
        shifts = np.asarray(fit.unknowns.level) * np.asarray(fit.prior.level)
        force = [np.median(np.asarray(fit.data.force)[level == k]) for k in range(n_levels)]
        of_force = bool(fit.prior.gain_of_force > 0)
        notes += notes_on_level_errors(
            shifts, fit.level_numbers, np.array(force), of_force=of_force
        )
    return [
        *notes,
        *notes_on_stated_errors(np.asarray(fit.unknowns.level), stated),
        *notes_on_modal_mass(fit.unknowns, fit.problem, fit.covariance),
        *notes_on_families(fit.unknowns),
        *notes_on_autocorrelation(fit.noise.autocorrelation),
        *notes_on_reach(fit.motion(), level),
    ]


def _moved(
    unknowns: Unknowns, covariance: Float[np.ndarray, "unknown unknown"]
) -> Bool[np.ndarray, " error"]:
    """Kinds of level errors that are significant for any level."""
    level, end = np.asarray(unknowns.level), len(covariance) - len(unknowns.linear)
    std = np.sqrt(np.diag(covariance))[end - level.size : end].reshape(level.shape)
    beyond = np.abs(level) > _MOVED * np.where(std > 0, std, np.inf)
    return np.any(beyond, axis=0)
