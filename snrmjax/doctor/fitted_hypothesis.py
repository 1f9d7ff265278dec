"""Fits of one mode with smooth curves to states, as recorded or under another interpretation.

A table is treated as one mode at the sensor that moves most. Every hypothesis is fitted with the
same model of a test (`identify.test_model`); its evidence is the density of the recorded data under
any interpretation, so that hypotheses compare directly.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from snrmjax.doctor.priors import ANY_MASS, CLEARLY, FITS_WELL, MODAL_MASS, NO_MODE, SCATTER
from snrmjax.identify.checks.residual_autocorrelation import independent_fraction
from snrmjax.identify.pointwise.snrm import participation_of, sensed_mode
from snrmjax.identify.test_model.gauss_newton import Rounds
from snrmjax.identify.test_model.posterior import TestPosterior, fit_test
from snrmjax.identify.test_model.priors import LEAST_FRACTION
from snrmjax.identify.test_model.states import RECORDED, TestStates, state_errors
from snrmjax.measure.states import SteadyStates, relative_errors
from snrmjax.model.modes import residual_velocity
from snrmjax.model.structures import Structure

_GUESSED = 1e3  # 1σ of the unknown modal mass in a first fit


class FittedHypothesis(NamedTuple):
    """A hypothesis and its fit."""

    states: TestStates  # as interpreted
    posterior: TestPosterior
    evidence: float  # ln of the density of the recorded phasors' logarithms

    @property
    def misfit(self) -> float:
        """Relative error of independent states of equal evidence, including the cost of curves.

        n states with an error σ of amplitude and phase have ln p = −n(2 ln σ + ln 2π + 1).
        """
        each = self.posterior.log_evidence / len(self.states.level)
        return float(np.exp(min(-0.5 * (each + np.log(2 * np.pi) + 1), 99.0)))

    @property
    def noise(self) -> float:
        """Relative scatter of single states."""
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
        """Whether the misfit is small and the mode dissipates energy."""
        return self.misfit < FITS_WELL and self.damped

    @property
    def damped(self) -> bool:
        """Whether the mode dissipates energy, allowing for noise in a tenth of the states."""
        return bool(np.quantile(self.damping, 0.1) > 0)

    def gain(self, recorded: "FittedHypothesis") -> float:
        """ln of the Bayes factor over the table as recorded; an undamped mode is excluded."""
        if not self.damped:
            return -np.inf
        return self.evidence - recorded.evidence if recorded.damped else np.inf

    def leaves_less(self, recorded: "FittedHypothesis") -> bool:
        """Whether the misfit is smaller under this interpretation.

        Evidence alone can prefer corrections that only stretch the errors.
        """
        return self.misfit < recorded.misfit or not recorded.damped

    def is_likelier(self, other: "FittedHypothesis") -> bool:
        """Whether it fits and is the more likely of two explanations of a table."""
        here, there = (one._from(one) for one in (self, other))
        return self.fits and here.leaves_less(there) and here.gain(there) > 0

    def beats(self, recorded: "FittedHypothesis", *, discrepancy: bool = True) -> bool:
        """Whether it fits, and the table as recorded is clearly less likely.

        The likelihood of states is weighted with the fraction of independent ones: if the residuals
        of neighbours are still correlated, the corrected error is not the real one. Levels are
        independent and have full weight.
        """
        return self.fits and self.explains(recorded, discrepancy=discrepancy)

    def explains(self, recorded: "FittedHypothesis", *, discrepancy: bool = True) -> bool:
        """Whether the table as recorded is clearly less likely, with a larger misfit.

        With `discrepancy` also if the misfit of one mode off resonance is modelled, which can
        explain a table without any error. Each fit is repeated from the curves and levels of the
        other, so that neither is less likely because its iterations stopped early.
        """

        def clearly(here: "FittedHypothesis", there: "FittedHypothesis") -> bool:
            gain, of_states = (
                here.gain(there),
                max(here.state_log_likelihood - there.state_log_likelihood, 0.0),
            )
            # If levels and curves only cost evidence, fewer independent states reduce that cost.
            odds = max(here.fraction * gain, gain - (1 - here.fraction) * of_states)
            return here.leaves_less(there) and odds > CLEARLY

        if not clearly(self, recorded):
            return False
        here, there = self._from(self), recorded._from(recorded)
        there = there._from(here)
        here = here._from(there)
        if discrepancy:
            here, there = (one._from(None, discrepancy=True) for one in (here, there))
        return clearly(here, there)

    @property
    def state_log_likelihood(self) -> float:
        """ln of the density of states about the fitted curves and levels."""
        return self.evidence - self.posterior.log_evidence + self.posterior.log_likelihood

    @property
    def fraction(self) -> float:
        """Fraction of independent states."""
        left = self.posterior.residuals
        return max(
            independent_fraction(left, self.states.level, self.states.frequency), LEAST_FRACTION
        )

    def _from(
        self, start: "FittedHypothesis | None", *, discrepancy: bool = False
    ) -> "FittedHypothesis":
        """The more likely of this fit and one with more iterations, started from another fit of
        similar amplitudes.
        """
        if start is not None and start is not self:
            amplitude, other = self.states.amplitude, start.states.amplitude
            if not (start.damped and np.allclose(amplitude, other, rtol=1.0)):
                return self
        jacobian = self.evidence - self.posterior.log_evidence
        fit = fit_hypothesis(self.states, jacobian, 16, start, discrepancy=discrepancy)
        return likelier((self, fit))


def likelier(fits: Iterable[FittedHypothesis]) -> FittedHypothesis:
    """The most likely of fits; damped ones take precedence."""
    return max(fits, key=lambda one: (one.damped, one.evidence))


class Scale(NamedTuple):
    """The most likely ratio κ of the modal mass to the model's."""

    fit: FittedHypothesis  # with forces divided by κ
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
    """Fit states with the model of a test.

    Arguments: `log_jacobian` from the logarithms of the recorded phasors to those of `states`;
    `rounds` of iterations, from `start` if that fit is of similar states; `discrepancy` adds the
    misfit of one mode off resonance.
    """
    for fewer in (rounds, 2, 1):
        first = None if start is None else start.posterior
        iterations = Rounds(fewer, 24, states.n_levels > 1, first)
        try:
            posterior = fit_test(
                states, discrepancy=discrepancy, compare_levels=False, rounds=iterations
            )
            break
        except np.linalg.LinAlgError:  # phasors that are not those of a mode
            if fewer == 1:
                raise
    return FittedHypothesis(states, posterior, posterior.log_evidence + log_jacobian)


def any_mass(states: TestStates, log_jacobian: float = 0.0, *, far: bool = False) -> Scale:
    """The fit with the most likely modal mass, independent of the model's.

    Started from a first fit with unknown mass; with `far` also from other orders of magnitude if
    that fit leaves more than the scatter of instruments.
    """
    first = fit_hypothesis(states._replace(mass_std=_GUESSED), log_jacobian)
    mass, std = first.posterior.modal_mass
    near = _mass_near(states, max(abs(mass), 1e-3 * std, 1e-12), log_jacobian)
    if not (far and SCATTER < near.fit.misfit < NO_MODE):
        return near
    tried = [
        near,
        *(_mass_near(states, one, log_jacobian, 1) for one in (8.0, 1 / 8, 64.0, 1 / 64)),
    ]
    best = max(tried, key=lambda one: one.fit.evidence)
    return best if best is near else _mass_near(states, best.mass, log_jacobian)


def _mass_near(states: TestStates, start: float, log_jacobian: float, steps: int = 3) -> Scale:
    """The most likely modal mass near a start, iterated by scaling the forces."""
    mass, std, reach = start, np.inf, 0.3  # of ln κ, within which the fit is linear in it
    for _ in range(steps):
        scale = mass
        fit = fit_hypothesis(with_mass(states, scale)._replace(mass_std=ANY_MASS), log_jacobian)
        step, std = fit.posterior.modal_mass
        mass = scale * max(step, 1 / _GUESSED)
        if abs(np.log(mass / scale)) < reach:
            break
    return Scale(fit, mass, std / step if step > 0 else np.inf)


def with_mass(states: TestStates, mass: float) -> TestStates:
    """Forces divided by κ."""
    return states._replace(force=states.force / mass)


class CheckedStates(NamedTuple):
    """States of one sensor, with the columns that errors of import or test may depend on."""

    test: TestStates  # as recorded, without the residual modes
    row: Int[np.ndarray, " state"]  # in the table
    residual: Complex[np.ndarray, " state"]  # m/s, velocity of the other modes
    order: Float[np.ndarray, " state"]  # of the test, 0 to 1
    noise: float  # stated 1σ of velocities, relative; NaN where none is
    files: tuple[tuple[int, ...], ...]  # levels of each table, if there are several
    # Velocity of the base, m/s, and whether its motion may still be in the recorded velocities.
    base: tuple[Complex[np.ndarray, " state"], bool] | None = None
    to_mode: Complex[np.ndarray, " state"] | float = 1.0  # `SensedMode.to_mode`

    @property
    def recorded(self) -> Complex[np.ndarray, " state"]:
        """Phasors as in the table, with the sign of the mode."""
        return self.test.velocity / self.to_mode + self.residual

    @property
    def mobility(self) -> Float[np.ndarray, " state"]:
        """|V|/F."""
        return np.abs(self.test.velocity / self.to_mode) / self.test.force

    def read(self, velocity: Complex[np.ndarray, " state"]) -> TestStates:
        """The states with other phasors in place of the recorded ones."""
        return self.test._replace(velocity=self.to_mode * (velocity - self.residual))


def checked_states(
    data: SteadyStates,
    model: Structure | None,
    sensor: int,
    rows: Bool[np.ndarray, " state"],
    files: tuple[tuple[int, ...], ...] = (),
) -> CheckedStates:
    """Selected rows of a table at one sensor, with the model's data of its mode.

    Without a model the modal constant is one and the other modes are neglected. Only ratios of
    stated errors matter: their common scale is estimated from the states.
    """
    at = np.flatnonzero(rows)
    # NumPy arrays: nothing is compiled for the table's number of states.
    some: SteadyStates = jax.tree.map(lambda column: np.asarray(column)[at], data)
    drive = np.isnan(np.asarray(some.force))
    force = np.where(drive, np.asarray(some.drive), np.asarray(some.force))
    omega = np.asarray(some.frequency)
    velocity = np.asarray(some.velocity)[:, sensor]
    constant, residual = 1.0, np.zeros(len(at), dtype=complex)
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
            residual = np.asarray(residual_velocity(modes, omega, force))[:, sensor]
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
        level,
        omega,
        force,
        sign * to_mode * (velocity - residual),
        errors,
        False,
        (abs(constant) or 1.0) * ratio_of_drive,
        stds,
        MODAL_MASS,
        linear=linear,
    )
    base = None
    if data.base is not None and model is not None:
        moving = data.base._replace(motion="absolute").own_velocity(data.sensors, omega, force)
        base = sign * moving[:, sensor], data.base.motion == "relative"
    return CheckedStates(
        _with_scattering_frequency(test),
        at,
        sign * residual,
        order,
        noise,
        files,
        base,
        to_mode,
    )


def _with_scattering_frequency(test: TestStates) -> TestStates:
    """The states with a scatter of the natural frequency, where the phase may be controlled.

    Not for sweeps through the half-power points, where such scatter indicates a wrong column.
    """
    if not test.near_one_phase:
        return test
    fit = fit_test(
        test, power_likelihood=True, compare_levels=False, parts_of_noise=True, rounds=Rounds(6, 24)
    )
    errors = fit.states.errors[:, RECORDED:]
    return test._replace(errors=np.column_stack([test.errors, errors]))


def usable_rows(data: SteadyStates, sensor: int) -> Bool[np.ndarray, " state"]:
    """States measured by this sensor, with phase and with force or drive voltage."""
    force = np.where(np.isnan(np.asarray(data.force)), np.asarray(data.drive), data.force)
    velocity = np.asarray(data.velocity)[:, sensor]
    known = np.asarray(data.measured)[:, sensor] & ~np.asarray(data.phase_unknown)[:, sensor]
    return known & (np.abs(velocity) > 0) & np.isfinite(force) & (force > 0)


def leading_sensor(data: SteadyStates) -> int:
    """The sensor with most usable states; of several, the one that moves most."""
    speed = np.where(np.asarray(data.measured), np.abs(np.asarray(data.velocity)), 0.0)
    ranks = [
        (int(usable_rows(data, k).sum()), float(speed[:, k].mean())) for k in range(speed.shape[1])
    ]
    return ranks.index(max(ranks))


def files_of_levels(
    tables: Sequence[SteadyStates],
) -> tuple[list[SteadyStates], tuple[tuple[int, ...], ...]]:
    """The tables with levels numbered from 0 over all tables, and the levels of each table."""
    renumbered, groups, first = [], [], 0
    for given in tables:
        one: SteadyStates = jax.tree.map(np.asarray, given)
        numbers = np.unique(np.asarray(one.level))
        levels = np.searchsorted(numbers, np.asarray(one.level)) + first
        renumbered.append(one.renumbered(levels - np.asarray(one.level)))
        groups.append(tuple(range(first, first + len(numbers))))
        first += len(numbers)
    return renumbered, tuple(groups)
