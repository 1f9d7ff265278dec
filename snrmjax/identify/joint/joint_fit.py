"""Smooth curves of ω̃² and 2ζ̃ω̃ fitted jointly to all states, levels and sensors."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.identify.checks.instruments import saying_what_is_undetermined
from snrmjax.identify.checks.next_family import trying_the_next_family
from snrmjax.identify.curves.families import parse_family
from snrmjax.identify.curves.family_base import AbstractFamily
from snrmjax.identify.joint.fitting import (
    FIT_MESSAGE,
    FitSettings,
    FitStatus,
    Fitted,
    as_guess,
    finite_fit,
    fitted,
    started,
    with_components,
)
from snrmjax.identify.joint.force_balance import (
    LEVEL_ERRORS,
    BalanceData,
    BalanceProblem,
    Motion,
    PriorStd,
    Unknowns,
    balance_data,
    level_numbers,
    stated_level_std,
    stated_prior,
    with_known_mass,
)
from snrmjax.identify.joint.free_unknowns import (
    FREE,
    PackedUnknowns,
    Unravel,
    named_unknowns,
    packed_unknowns,
    padded_levels,
    recorded_motion_of,
)
from snrmjax.identify.joint.initial_guess import initial_guess
from snrmjax.identify.joint.notes import (
    notes_on_autocorrelation,
    notes_on_failed_rivals,
    notes_on_families,
    notes_on_level_errors,
    notes_on_modal_mass,
    notes_on_noise,
    notes_on_reach,
    notes_on_stated_errors,
)
from snrmjax.identify.joint.ranking import FamilyCandidate
from snrmjax.identify.joint.selection import (
    FamilyRequest,
    Selection,
    SelectionStatus,
    select_families,
)
from snrmjax.measure.phase_convention import naming_wrong_phases
from snrmjax.measure.states import SteadyStates
from snrmjax.model.modes import LinearModes
from snrmjax.model.structures import Structure, modes_of
from snrmjax.numerics.blocks import on_one_core
from snrmjax.numerics.result import AbstractResult, Variable

_HERTZ = 2 * np.pi  # rad/s
_ROUNDS = 2, 12  # of fitting and estimating the noise anew: at least, at most
_ROUGHLY = 2, 6  # the same, of a fit that another one starts from, and of rivals
_ASKED = 3.0  # standard deviations from the model's modal mass where nobody stated its error
_CLEARLY_LESS = 0.9  # of the noise, that a fit from another start must find


class Rival(NamedTuple):
    """The same data fitted with another family of one of the curves, that they could mean too."""

    curve: str  # "backbone" or "damping": the one of another family
    weight: float  # among all families tried, by how well they predict left-out levels
    fit: "JointFit"


class FailedRival(NamedTuple):
    """A family that the data could mean too, whose fit failed: the bands do not include it."""

    curve: str  # "backbone" or "damping"
    family: str  # with its size and amplitude
    weight: float
    status: FitStatus


class FamilyChoice(eqx.Module):
    """Which families were tried, how the choice among them ended, and what it leaves open.

    `rivals` are fits with other families that predict left-out levels about as well: bands of
    curves and responses include what is left open by the choice.
    """

    candidates: tuple[FamilyCandidate, ...] = eqx.field(static=True, default=())
    rivals: tuple[Rival, ...] = ()
    failed: tuple[FailedRival, ...] = eqx.field(static=True, default=())
    status: SelectionStatus = eqx.field(static=True, default=SelectionStatus.SETTLED)


class NoiseEstimate(eqx.Module):
    """The random errors of the states and the errors that the states of a level share."""

    scale: float  # by which residuals exceed the stated noise; the noise where none is stated
    scale_std: float
    level_std: Float[np.ndarray, " error"]  # gain, phase (rad), relative stiffness and damping
    autocorrelation: Float[np.ndarray, " part"]  # of successive residuals, 0 if it may be chance
    stated: bool = eqx.field(static=True)


class JointFit(AbstractResult):
    """Two curves, what else was unknown, and how well all of it is known.

    `covariance` belongs to the free unknowns in the order of `names`, and includes the correlation
    of neighbouring states' residuals, but not the choice among families. `noise.level_std` belongs
    to `LEVEL_ERRORS`, stated or estimated: what was estimated from few levels counts for more in
    `prior`, as Student's t does.
    """

    coordinates = ("parameter",)

    unknowns: Unknowns
    covariance: Float[np.ndarray, "unknown unknown"]
    problem: BalanceProblem
    noise: NoiseEstimate
    families: FamilyChoice
    residuals: Float[np.ndarray, "state part"]  # whitened, of unit variance if all is right
    drive_known_only: bool = eqx.field(static=True)
    free: tuple[str, ...] = eqx.field(static=True)
    notes: tuple[str, ...] = eqx.field(static=True)
    status: FitStatus = eqx.field(static=True)
    level_numbers: tuple[int, ...] = eqx.field(static=True)  # of the file; `data` counts from 0

    @property
    def converged(self) -> bool:
        """Whether the fit converged."""
        return self.status == FitStatus.CONVERGED

    @property
    def data(self) -> BalanceData:
        """The states as the fit sees them."""
        return self.problem.data

    @property
    def modes(self) -> LinearModes:
        """The linear modes of the structure."""
        return self.problem.modes

    @property
    def prior(self) -> PriorStd:
        """Prior standard deviations, those estimated from the levels included."""
        return self.problem.prior

    @property
    def largest(self) -> tuple[float, float]:
        """Largest displacement (m) and velocity (m/s), as measured: no gain moves them."""
        motion, level = self.motion(), np.asarray(self.unknowns.level * self.prior.level)
        of_velocity = 1 - float(self.prior.gain_of_force)
        recorded = np.exp(of_velocity * level[np.asarray(self.data.level), 0])
        pair = (np.asarray(motion.displacement), np.abs(np.asarray(motion.velocity)))
        displacement, velocity = (float(np.max(recorded * size)) for size in pair)
        return displacement, velocity

    @property
    def corrected(self) -> bool:
        """Whether states are corrected for their most likely errors, their noise believed."""
        return bool(np.any(np.asarray(self.data.correction) != 0))

    @property
    def modes_found(self) -> LinearModes:
        """The linear modes with the modal mass that the fit found for the mode of interest.

        Its 1σ, where one was stated, is then the fit's.
        """
        share = jnp.exp(-self.problem.log_modal_mass(self.unknowns))
        j, modes = self.modes.mode_of_interest, self.modes
        found = eqx.tree_at(
            lambda m: m.participation, modes, modes.participation.at[j].multiply(share)
        )
        if modes.modal_mass_std is None:
            return found
        left = self.prior.linear[-1] * jnp.sqrt(jnp.asarray(self.covariance)[-1, -1])
        return eqx.tree_at(lambda m: m.modal_mass_std, found, modes.modal_mass_std.at[j].set(left))

    def motion(self) -> Motion:
        """The nonlinear mode's motion in the states as the fit sees it."""
        return recorded_motion_of(self.unknowns, self.problem)

    def recorded_force(self, force: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        """What the test records of a force in N: in N, or in V where only the drive is known."""
        gain, offset = self._force_line()
        return (np.asarray(force) - offset) / gain

    def force_of_drive(self, drive: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        """The force in N that belongs to what a test records (`recorded_force`)."""
        gain, offset = self._force_line()
        return np.asarray(drive) * gain + offset

    def _force_line(self) -> tuple[float, float]:
        smallest = float(jnp.min(self.data.force))
        offset = float(self.unknowns.force_offset) * smallest
        return float(jnp.exp(self.unknowns.log_force_gain)), offset

    def vector(self) -> tuple[Float[Array, " unknown"], Unravel]:
        """The free unknowns as a vector, and the way back to all of them."""
        unravel = Unravel(self.unknowns, self.free)
        return unravel.vector(), unravel

    def packed(self) -> PackedUnknowns:
        """The free unknowns as compiled programs take them."""
        return packed_unknowns(self.unknowns, self.free, padded_levels(self.data.n_levels))

    def names(self) -> tuple[str, ...]:
        """What the free unknowns are called."""
        return tuple(name for name, _ in named_unknowns(self.unknowns, self.data, self.free))

    def labels(self) -> tuple[str, ...]:
        """`names` with the levels' own numbers, for readers."""
        own = named_unknowns(self.unknowns, self.data, self.free, self.level_numbers)
        return tuple(name for name, _ in own)

    def units(self) -> tuple[str, ...]:
        """Units of the free unknowns; a curve's terms count at the largest amplitude."""
        return tuple(unit for _, unit in named_unknowns(self.unknowns, self.data, self.free))

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`."""
        squared, damping = self.unknowns.squared_frequency, self.unknowns.modal_damping
        motion = self.motion()
        omega = np.sqrt(np.asarray(squared(motion.amplitude(squared))))
        ratio = np.asarray(damping(motion.amplitude(damping))) / (2 * omega)
        size = np.abs(np.asarray(motion.velocity))
        scale = f"{self.noise.scale:.3g} ± {self.noise.scale_std:.1g}"
        noise = f"{scale} times the stated noise"
        if not self.noise.stated:
            noise = f"noise {100 * self.noise.scale:.2g} % of the velocity (estimated)"
        rivals = len(self.families.rivals)
        return (
            f"JointFit: natural frequency: {squared.words}; damping: {damping.words}",
            f"{len(self.data.level)} steady states of {self.data.n_levels} levels at "
            f"{self.modes.sensors[self.data.sensor]!r}, {size.min():.3g} to {size.max():.3g} m/s",
            f"natural frequency {omega.min() / _HERTZ:.6g} to {omega.max() / _HERTZ:.6g} Hz, "
            f"damping ratio {100 * ratio.min():.3g} to {100 * ratio.max():.3g} %",
            f"residuals: {noise}; {rivals} competing families in the bands",
            f"status: {FIT_MESSAGE[self.status]}",
            *(f"note: {note}" for note in self.notes),
        )

    def variables(self) -> dict[str, Variable]:
        """See `AbstractResult`."""
        std, data, per = np.sqrt(np.diag(self.covariance)), self.data, ("parameter",)
        state, force = ("state",), "V" if self.drive_known_only else "N"
        measured, numbers = np.asarray(data.force), np.array(self.level_numbers)
        parts = Variable(("state", "part"), self.residuals, "1", "whitened residual")
        return {
            "parameter": Variable(per, np.array(self.labels()), "", "free unknown"),
            "value": Variable(per, np.asarray(self.vector()[0]), "", "value, in `unit`"),
            "std": Variable(per, std, "", "1σ, in `unit`"),
            "unit": Variable(per, np.array(self.units()), "", "unit of the parameter"),
            "level": Variable(state, numbers[np.asarray(data.level)], "1", "level"),
            "frequency_hz": Variable(state, np.asarray(data.frequency) / _HERTZ, "Hz", "frequency"),
            "drive_v" if force == "V" else "force_n": Variable(state, measured, force, "force"),
            "velocity_m_s": Variable(
                state, np.abs(np.asarray(self.motion().velocity)), "m/s", "velocity of the mode"
            ),
            "residual": parts,
        }

    def attributes(self) -> dict[str, str | float | int]:
        """See `AbstractResult`."""
        return {
            "backbone": self.unknowns.squared_frequency.label,
            "damping": self.unknowns.modal_damping.label,
            "noise_scale": self.noise.scale,
            "status": FIT_MESSAGE[self.status],
            "notes": "\n".join(self.notes),
        }


@on_one_core
@naming_wrong_phases
@saying_what_is_undetermined(LEVEL_ERRORS)
@trying_the_next_family
def fit_jointly(
    data: SteadyStates,
    modes: LinearModes | Structure,
    *,
    backbone: str = "auto",
    damping: str = "auto",
    free: Sequence[str] = (),
    level_gain_std: float | None = None,
    level_phase_std: float | None = None,
    robust: bool = False,
) -> JointFit:
    """Fit both curves to the complex force balance of all states at once.

    Levenberg–Marquardt on residuals whitened with the stated noise. Gain and phase errors that a
    level shares are unknowns with the stated 1σ. Where levels differ by more than that allows, the
    level-to-level variance of gain, phase, stiffness and damping is estimated (restricted maximum
    likelihood) and enters the bands. Families and level-to-level variance are chosen at a first fit
    without any, or at the initial guess where that leads to clearly less noise. Where the stated
    noise is believed, every step corrects the states for their most likely errors (orthogonal
    distance regression). The other modes' frequencies and dampings stay inside their stated errors.
    The modal mass is an unknown with its stated 1σ (`LinearModesStd.modal_mass`); where none is
    stated it is the model's, unless states away from resonance ask for another. A free force gain
    is one with it.

    Arguments: `backbone` and `damping` name a family of `FAMILIES`, with a size if wanted
    ("polynomial:2", "spline:5") and the amplitude ("polynomial:2@velocity"); what is left out is
    chosen by cross-validation over left-out levels, and so is the family itself for "auto". `free`
    may name "force_gain", "force_offset" and "instrument_phase"; the gain is always free where only
    the drive is known. `modes` may be a structure, which also states the 1σ of what the states of a
    level share: gain, phase, natural frequency and damping ratio. `level_gain_std` (relative) and
    `level_phase_std` (rad), where given, stand in place of the first two.
    Returns a `JointFit`, whose `status` says whether it converged; where families are chosen here,
    those of the next best fit that did.
    Raises `ValueError` for too few states, an unknown family or name, a family with more parameters
    than there are data, a gain, an offset or a phase that the data do not determine, and a fit
    whose residuals become infinite or undefined.
    Validity: one nonlinear mode whose ω̃ and 2ζ̃ω̃ are functions of amplitude alone.
    """
    level_std = stated_level_std(modes)
    for k, std in enumerate((level_gain_std, level_phase_std)):
        level_std[k] = level_std[k] if std is None else std
    modes = modes_of(modes)
    unknown = [name for name in free if name not in FREE]
    if unknown:
        raise ValueError(f"`free` knows {', '.join(FREE)}, not {unknown[0]!r}.")
    if data.sensors != modes.sensors:
        raise ValueError(
            f"`data` has the sensors {list(data.sensors)}, but `modes` has {list(modes.sensors)}."
        )
    measured, stated = balance_data(data, modes)
    numbers = level_numbers(data, modes)
    n = len(measured.level)
    if n < 3:
        raise ValueError(f"a joint fit needs at least 3 steady states, but only {n} are usable.")
    driven = not np.any(np.isfinite(np.asarray(data.force)))
    released = tuple(name for name in FREE if name in free or (driven and name == "force_gain"))
    problem = BalanceProblem(measured, modes, stated_prior(modes, level_std, released))
    request = FamilyRequest(parse_family(backbone), parse_family(damping), released, stated)

    def select(guess: Unknowns, problem: BalanceProblem, *, components_too: bool) -> Selection:
        # Where no noise is stated a smooth curve would bend for levels whose gains differ.
        smooth = stated or components_too
        given = (problem, guess, request)
        return select_families(*given, components_too=components_too, smooth=smooth)

    def fit_from(
        chosen: Selection, guess: Unknowns, problem: BalanceProblem, rounds: tuple[int, int]
    ) -> Fitted:
        level = with_components(problem.prior, chosen.components, measured.n_levels)
        std = problem.data.std.at[:, 3].set(chosen.jitter)
        noisy = BalanceProblem(problem.with_data(std=std).data, modes, level)
        start = started(guess, chosen, level)
        return fitted(
            start, noisy, chosen.components, FitSettings(released, stated, robust, rounds)
        )

    # What the initial guess misses would pass for levels that differ: a fit without level-to-level
    # variance comes first.
    first_guess = initial_guess(problem, released)
    chosen = select(first_guess, problem, components_too=False)
    first = finite_fit(fit_from(chosen, first_guess, problem, _ROUGHLY))
    if (
        modes.modal_mass_std is None
        and abs(first.unknowns.linear[-1]) < _ASKED * first.covariance[-1, -1] ** 0.5
    ):
        problem = with_known_mass(problem)
        chosen = select(first_guess, problem, components_too=False)
        first = finite_fit(fit_from(chosen, first_guess, problem, _ROUGHLY))
    prior = problem.prior
    guess, corrected = first_guess, problem
    if first.status != FitStatus.STEP_LIMIT:  # which may have ended anywhere
        guess, corrected = as_guess(first, problem)
    chosen = select(guess, corrected, components_too=True)
    best = fit_from(chosen, guess, corrected, _ROUNDS)
    if best.status != FitStatus.CONVERGED or (stated and best.components.contradicts_upward):
        # Where levels differ so much that no fit without that comes near, the guess is better.
        other = select(first_guess, problem, components_too=True)
        again = fit_from(other, first_guess, problem, _ROUNDS)
        better = again.components.noise < _CLEARLY_LESS * best.components.noise
        if best.status == FitStatus.NOT_FINITE or (better and again.status != FitStatus.NOT_FINITE):
            chosen, best = other, again
    finite_fit(best)

    def told(found: Fitted, families: FamilyChoice) -> JointFit:
        components, last = found.components, found.problem
        notes: tuple[str, ...] = ()
        if found.status != FitStatus.CONVERGED:
            notes = (f"the fit has {FIT_MESSAGE[found.status]}; try a simpler family.",)
        notes += notes_on_families(families.status, families.candidates)
        lost = [(one.family, one.curve, one.weight) for one in families.failed]
        notes += notes_on_failed_rivals(lost, len(families.rivals))
        wandering = 0.5 * float(last.data.std[0, 3])
        noise = (components, wandering, np.asarray(prior.level), measured.n_levels)
        notes += notes_on_noise(*noise, stated=stated, alike=bool(found.autocorrelation.any()))
        level = np.asarray(last.data.level)
        if np.any((np.asarray(prior.level) == 0) & (np.asarray(last.prior.level) > 0)):
            errors = np.asarray(found.unknowns.level * last.prior.level)
            force = [np.median(np.asarray(last.data.force)[level == k]) for k in np.unique(level)]
            of_force = bool(prior.gain_of_force > 0)
            notes += notes_on_level_errors(errors, numbers, np.array(force), of_force=of_force)
        notes += notes_on_stated_errors(np.asarray(found.unknowns.level), level_std)
        notes += notes_on_modal_mass(found.unknowns, last, found.covariance)
        notes += notes_on_autocorrelation(found.autocorrelation)
        motion = recorded_motion_of(found.unknowns, last)
        notes += notes_on_reach(motion, level)
        return JointFit(
            unknowns=found.unknowns,
            covariance=found.covariance,
            problem=last,
            noise=NoiseEstimate(
                scale=components.noise,
                scale_std=components.noise_std,
                level_std=np.asarray(components.level),
                autocorrelation=found.autocorrelation,
                stated=stated,
            ),
            families=families,
            residuals=found.residuals,
            drive_known_only=driven,
            free=released,
            notes=notes,
            status=found.status,
            level_numbers=numbers,
        )

    rivals, failed = [], []
    guess, corrected = as_guess(best, problem)
    for one in chosen.rivals:
        pair: list[AbstractFamily] = [best.unknowns.squared_frequency, best.unknowns.modal_damping]
        pair[one.curve == "damping"] = one.family
        other = chosen._replace(squared_frequency=pair[0], modal_damping=pair[1])
        found = fit_from(other, guess, corrected, _ROUGHLY)
        if found.status == FitStatus.CONVERGED:
            alone = FamilyChoice(chosen.table, status=chosen.status)
            rivals.append(Rival(one.curve, one.weight, told(found, alone)))
        else:
            failed.append(FailedRival(one.curve, one.family.label, one.weight, found.status))
    return told(best, FamilyChoice(chosen.table, tuple(rivals), tuple(failed), chosen.status))
