"""How well one mode with any smooth curves explains states, as recorded or as they may be meant.

A table is looked at as one mode at the sensor that moves most. Every hypothesis is fitted by the
one model of a test (`identify.test_model`): its evidence is the density of what was recorded,
however it is read, so that hypotheses compare directly.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from snrmjax.doctor.priors import ANY_MASS, CLEARLY, FITS_WELL, MODAL_MASS, NO_MODE, SCATTER
from snrmjax.identify.checks.residual_autocorrelation import fraction_told_by
from snrmjax.identify.pointwise.snrm import participation_of, sensed_mode
from snrmjax.identify.test_model.posterior import TestPosterior, fit_test
from snrmjax.identify.test_model.priors import LEAST_FRACTION
from snrmjax.identify.test_model.states import RECORDED, TestStates, state_errors
from snrmjax.identify.test_model.walk import Rounds
from snrmjax.measure.states import SteadyStates, relative_errors
from snrmjax.model.modes import residual_velocity
from snrmjax.model.structures import Structure

_GUESSED = 1e3  # 1σ of a modal mass of which a first fit knows nothing


class FittedHypothesis(NamedTuple):
    """A hypothesis and how it fits."""

    states: TestStates  # as it reads them
    posterior: TestPosterior
    evidence: float  # ln of the density of the recorded phasors' logarithms

    @property
    def misfit(self) -> float:
        """Relative error of independent states as likely as these, curves and levels paid.

        n states with an error σ of amplitude and phase have ln p = −n(2 ln σ + ln 2π + 1).
        """
        each = self.posterior.log_evidence / len(self.states.level)
        return float(np.exp(min(-0.5 * (each + np.log(2 * np.pi) + 1), 99.0)))

    @property
    def noise(self) -> float:
        """What is left of single states, relative."""
        return self.posterior.hyper.noise

    @property
    def damping(self) -> Float[np.ndarray, " state"]:
        """δ at the states, 1/s."""
        return self.posterior.curves(self.states.amplitude).modal_damping

    @property
    def stiffness(self) -> Float[np.ndarray, " state"]:
        """ω̃² at the states, rad²/s²."""
        return self.posterior.curves(self.states.amplitude).squared_frequency

    @property
    def fits(self) -> bool:
        """Whether it fits in itself, with energy lost and not gained."""
        return self.misfit < FITS_WELL and self.damped

    @property
    def damped(self) -> bool:
        """Whether the mode loses energy, but for a tenth of the states and their noise."""
        return bool(np.quantile(self.damping, 0.1) > 0)

    def gain(self, recorded: "FittedHypothesis") -> float:
        """ln of the odds against the table as recorded; an undamped mode has no odds."""
        if not self.damped:
            return -np.inf
        return self.evidence - recorded.evidence if recorded.damped else np.inf

    def leaves_less(self, recorded: "FittedHypothesis") -> bool:
        """Whether one mode misses states by less, once they are read so.

        Where an error is steep in what was recorded, stretched errors alone may be likelier.
        """
        return self.misfit < recorded.misfit or not recorded.damped

    def is_likelier(self, other: "FittedHypothesis") -> bool:
        """Whether it is the likelier of two that explain a table, and fits in itself."""
        here, there = (one._from(one) for one in (self, other))
        return self.fits and here.leaves_less(there) and here.gain(there) > 0

    def beats(self, recorded: "FittedHypothesis", *, beside: bool = True) -> bool:
        """Whether it fits in itself, and the table as recorded clearly less.

        What states say counts by the share of them that tell something of their own: where
        neighbours still miss the curves alike, what was undone is not what is wrong. What levels
        say, of which each is one, counts whole.
        """
        return self.fits and self.explains(recorded, beside=beside)

    def explains(self, recorded: "FittedHypothesis", *, beside: bool = True) -> bool:
        """Whether the table as recorded is clearly less likely, and misses its states by more.

        Also with what one mode leaves off resonance `beside` it: then nothing else need be wrong.
        And each also from where the other has curves and levels: of two fits that might both go
        there none is less likely for having stopped on the way.
        """

        def clearly(here: "FittedHypothesis", there: "FittedHypothesis") -> bool:
            gain, of_states = here.gain(there), max(here.told - there.told, 0.0)
            # Where levels and curves are no gain but a cost, fewer states pay less of it.
            odds = max(here.fraction * gain, gain - (1 - here.fraction) * of_states)
            return here.leaves_less(there) and odds > CLEARLY

        if not clearly(self, recorded):
            return False
        here, there = self._from(self), recorded._from(recorded)
        there = there._from(here)
        here = here._from(there)
        if beside:
            here, there = (one._from(None, discrepancy=True) for one in (here, there))
        return clearly(here, there)

    @property
    def told(self) -> float:
        """What states alone say of it: ln of their density about its curves and levels."""
        return self.evidence - self.posterior.log_evidence + self.posterior.log_likelihood

    @property
    def fraction(self) -> float:
        """Of independent states."""
        left = self.posterior.residuals
        return max(fraction_told_by(left, self.states.level, self.states.frequency), LEAST_FRACTION)

    def _from(
        self, start: "FittedHypothesis | None", *, discrepancy: bool = False
    ) -> "FittedHypothesis":
        """The likelier of this fit and one with as many rounds as the steepest curves need, from
        another of nearly these amplitudes on.
        """
        if start is not None and start is not self:
            amplitude, other = self.states.amplitude, start.states.amplitude
            if not (start.damped and np.allclose(amplitude, other, rtol=1.0)):
                return self
        jacobian = self.evidence - self.posterior.log_evidence
        fit = fit_hypothesis(self.states, jacobian, 16, start, discrepancy=discrepancy)
        return likelier((self, fit))


def likelier(fits: Iterable[FittedHypothesis]) -> FittedHypothesis:
    """The likeliest of fits, those before all that lose energy."""
    return max(fits, key=lambda one: (one.damped, one.evidence))


class Scale(NamedTuple):
    """The most likely modal mass over the model's."""

    judged: FittedHypothesis  # with forces divided by it
    mass: float
    std: float  # of its logarithm


def fit_hypothesis(
    states: TestStates,
    log_jacobian: float = 0.0,
    rounds: int = 6,
    start: FittedHypothesis | None = None,
    *,
    discrepancy: bool = False,
) -> FittedHypothesis:
    """Fit states by the model of a test.

    Arguments: `log_jacobian` of the recorded to these phasors, both as logarithms;
    `rounds` of the fit, which go on from `start` where that is of nearly these states;
    with `discrepancy` beside what one mode leaves off resonance.
    """
    for fewer in (rounds, 2, 1):
        first = None if start is None else start.posterior
        walked = Rounds(fewer, 24, states.n_levels > 1, first)
        try:
            posterior = fit_test(
                states, discrepancy=discrepancy, compare_levels=False, rounds=walked
            )
            break
        except np.linalg.LinAlgError:  # of phasors that are no mode's
            if fewer == 1:
                raise
    return FittedHypothesis(states, posterior, posterior.log_evidence + log_jacobian)


def any_mass(states: TestStates, log_jacobian: float = 0.0, *, far: bool = False) -> Scale:
    """The fit with the likeliest modal mass, whatever the model's is.

    From where a first fit that knows nothing of it puts it; or where its best fit leaves more than
    instruments do, and so was no good guide, from other orders of magnitude (`far`).
    """
    first = fit_hypothesis(states._replace(mass_std=_GUESSED), log_jacobian)
    mass, std = first.posterior.modal_mass
    found = _about(states, max(abs(mass), 1e-3 * std, 1e-12), log_jacobian)
    if not (far and SCATTER < found.judged.misfit < NO_MODE):
        return found
    tried = [found, *(_about(states, one, log_jacobian, 1) for one in (8.0, 1 / 8, 64.0, 1 / 64))]
    best = max(tried, key=lambda one: one.judged.evidence)
    return best if best is found else _about(states, best.mass, log_jacobian)


def _about(states: TestStates, start: float, log_jacobian: float, steps: int = 3) -> Scale:
    """The likeliest modal mass from some on: forces are divided by it until it stays."""
    mass, std, reach = start, np.inf, 0.3  # of ln κ, within which it is linear
    for _ in range(steps):
        scale = mass
        judged = fit_hypothesis(with_mass(states, scale)._replace(mass_std=ANY_MASS), log_jacobian)
        step, std = judged.posterior.modal_mass
        mass = scale * max(step, 1 / _GUESSED)
        if abs(np.log(mass / scale)) < reach:
            break
    return Scale(judged, mass, std / step if step > 0 else np.inf)


def with_mass(states: TestStates, mass: float) -> TestStates:
    """Forces divided by κ."""
    return states._replace(force=states.force / mass)


class CheckedStates(NamedTuple):
    """States of one sensor, and what an error of import or of the test may depend on."""

    test: TestStates  # as recorded, without what moves beside the mode
    row: Int[np.ndarray, " state"]  # in the table
    beside: Complex[np.ndarray, " state"]  # m/s, of the other modes
    order: Float[np.ndarray, " state"]  # of the test, 0 to 1
    noise: float  # stated 1σ of velocities, relative; NaN where none is
    files: tuple[tuple[int, ...], ...]  # levels of each table, where there are several
    # m/s, of a base itself, and whether velocities are as recorded: its motion may be in them.
    own: tuple[Complex[np.ndarray, " state"], bool] | None = None
    to_mode: Complex[np.ndarray, " state"] | float = 1.0  # `SensedMode.to_mode`

    @property
    def recorded(self) -> Complex[np.ndarray, " state"]:
        """Phasors as they stand in the table, with the sign of the mode."""
        return self.test.velocity / self.to_mode + self.beside

    @property
    def mobility(self) -> Float[np.ndarray, " state"]:
        """|V|/F."""
        return np.abs(self.test.velocity / self.to_mode) / self.test.force

    def read(self, velocity: Complex[np.ndarray, " state"]) -> TestStates:
        """The states with other phasors in the place of the recorded ones."""
        return self.test._replace(velocity=self.to_mode * (velocity - self.beside))


def checked_states(
    data: SteadyStates,
    model: Structure | None,
    sensor: int,
    rows: Bool[np.ndarray, " state"],
    files: tuple[tuple[int, ...], ...] = (),
) -> CheckedStates:
    """Some rows of a table at one sensor, with what the model says of its mode.

    Without a model the modal constant is one and the other modes are taken to be still. Errors
    count by their proportions: their common size is always found from the states.
    """
    at = np.flatnonzero(rows)
    # As NumPy's: nothing compiles for the table's own number of states.
    some: SteadyStates = jax.tree.map(lambda column: np.asarray(column)[at], data)
    drive = np.isnan(np.asarray(some.force))
    force = np.where(drive, np.asarray(some.drive), np.asarray(some.force))
    omega = np.asarray(some.frequency)
    velocity = np.asarray(some.velocity)[:, sensor]
    constant, beside = 1.0, np.zeros(len(at), dtype=complex)
    to_mode: np.ndarray | float = 1.0
    ratio_of_drive: np.ndarray | float = 1.0
    stds = (0.0, 0.0, 0.0, 0.0)
    linear = None
    if model is not None:
        modes = model.modes
        one = modes.mode_of_interest
        constant = modes.mode_shape.item(sensor, one) * float(participation_of(modes))
        sensed = sensed_mode(modes, omega)
        to_mode, ratio_of_drive = np.asarray(sensed.to_mode(sensor)), np.asarray(sensed.ratio)
        if not drive.any() and (modes.n_modes > 1 or modes.rigid_body_participation.size):
            beside = np.asarray(residual_velocity(modes, omega, force))[:, sensor]
        gain, phase, frequency, damping = model.level_stds
        natural, ratio = (
            float(np.asarray(a)[one]) for a in (modes.natural_frequency, modes.damping_ratio)
        )
        rate = 2 * ratio * natural
        linear = (natural**2, rate) if natural > 0 and rate > 0 else None
        stds = (gain, phase, 2 * frequency / natural, damping / max(ratio, 1e-6))
    sign = -1.0 if constant < 0 else 1.0
    errors, stated = state_errors(np.asarray(relative_errors(some))[:, sensor])
    noise = float(np.median(errors[:, 1:])) if stated else np.nan
    if stated:
        errors = errors / noise
    order = np.asarray(some.order)
    if not np.all(np.isfinite(order)):
        order = np.linspace(0.0, 1.0, len(at))
    level = np.unique(np.asarray(some.level), return_inverse=True)[1]
    test = TestStates(
        *(level, omega, force, sign * to_mode * (velocity - beside), errors, False),
        *((abs(constant) or 1.0) * ratio_of_drive, stds, MODAL_MASS),
        linear=linear,
    )
    own = None
    if data.base is not None and model is not None:
        moving = data.base._replace(motion="absolute").own_velocity(data.sensors, omega, force)
        own = sign * moving[:, sensor], data.base.motion == "relative"
    return CheckedStates(
        _with_scattering_frequency(test),
        at,
        sign * beside,
        order,
        noise,
        files,
        own,
        to_mode,
    )


def _with_scattering_frequency(test: TestStates) -> TestStates:
    """The states with a scatter of the natural frequency, where their phase may be controlled.

    Of sweeps through the half-power points it stays out: there, such scatter is how a wrong column
    shows.
    """
    if not test.near_one_phase:
        return test
    found = fit_test(
        test, power_likelihood=True, compare_levels=False, parts_of_noise=True, rounds=Rounds(6, 24)
    )
    errors = found.states.errors[:, RECORDED:]
    return test._replace(errors=np.column_stack([test.errors, errors]))


def usable_rows(data: SteadyStates, sensor: int) -> Bool[np.ndarray, " state"]:
    """States that this sensor measured, with a phase and with a force or a drive voltage."""
    force = np.where(np.isnan(np.asarray(data.force)), np.asarray(data.drive), data.force)
    velocity = np.asarray(data.velocity)[:, sensor]
    known = np.asarray(data.measured)[:, sensor] & ~np.asarray(data.phase_unknown)[:, sensor]
    return known & (np.abs(velocity) > 0) & np.isfinite(force) & (force > 0)


def leading_sensor(data: SteadyStates) -> int:
    """The sensor with most usable states; of several, the one that moves most."""
    size = np.where(np.asarray(data.measured), np.abs(np.asarray(data.velocity)), 0.0)
    ranks = [
        (int(usable_rows(data, k).sum()), float(size[:, k].mean())) for k in range(size.shape[1])
    ]
    return ranks.index(max(ranks))


def files_of_levels(
    tables: Sequence[SteadyStates],
) -> tuple[list[SteadyStates], tuple[tuple[int, ...], ...]]:
    """The tables with levels of their own, counted from 0, and the levels of each table."""
    renumbered, groups, first = [], [], 0
    for given in tables:
        one: SteadyStates = jax.tree.map(np.asarray, given)
        numbers = np.unique(np.asarray(one.level))
        levels = np.searchsorted(numbers, np.asarray(one.level)) + first
        renumbered.append(one.renumbered(levels - np.asarray(one.level)))
        groups.append(tuple(range(first, first + len(numbers))))
        first += len(numbers)
    return renumbered, tuple(groups)
