"""A joint fit from the posterior of a test: unknowns, covariance, noise and level errors."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Complex, Float
from scipy.optimize import nnls

from snrmjax.identify.checks.instruments import require_passive
from snrmjax.identify.curves.families import ARGUMENTS, FAMILIES, Choice
from snrmjax.identify.curves.family_base import AbstractFamily, Scattered
from snrmjax.identify.curves.splines import SmoothingSpline, WithRemainder
from snrmjax.identify.joint.force_balance import (
    EXPONENTS,
    STATE_ERRORS,
    BalanceProblem,
    Unknowns,
    velocity_of_others,
)
from snrmjax.identify.joint.notes import NoiseEstimate
from snrmjax.identify.test_model.balance import off_resonance
from snrmjax.identify.test_model.curve_basis import MOST_KNOTS, CurveBasis
from snrmjax.identify.test_model.curve_terms import CurveTerms
from snrmjax.identify.test_model.gauss_newton import Rounds
from snrmjax.identify.test_model.hyper import MASS, OFFSET, PHASE, WITH_FREQUENCY
from snrmjax.identify.test_model.posterior import TestPosterior, fit_test, students_factor
from snrmjax.identify.test_model.priors import OFF_RESONANCE
from snrmjax.identify.test_model.states import TestStates
from snrmjax.numerics.rules import InputError

_FREE = 3.0  # 1σ of unknown instrument errors about their initial guess
LEAST_LEFT = 0.25
"""Lower bound of the residual degrees of freedom, as a fraction of the rows."""

SMOOTH = ("auto", SmoothingSpline.kind)
"""Families that are the posterior's smooth curves."""

_ASKED = 3.0  # standard deviations from which a modal mass of unstated error is not the model's


class View(NamedTuple):
    """The posterior of a joint fit's states, and the problem with its estimates."""

    posterior: TestPosterior
    problem: BalanceProblem  # with the posterior's noise, level errors and corrections
    gain: complex  # initial guess: gain of the force, phase of the velocity
    free: tuple[str, ...]
    noise: NoiseEstimate


def view_of(
    problem: BalanceProblem,
    choices: tuple[Choice, Choice],
    free: tuple[str, ...],
    stated: bool,
    *,
    robust: bool | None,
    knots: int | None = None,
) -> View:
    """The posterior of a joint fit's states, with curves of the chosen families.

    Smooth curves are fitted first; a family starts from its member nearest to them.

    Residuals above the stated noise widen the bands accordingly. A modal mass of unstated error is
    the model's, unless the states contradict it, which those at a controlled phase cannot;
    frequency scatter is added to every state's errors where the states show it.

    Arguments: `free` the unknown instrument errors; `stated` whether the noise is; `robust` whether
    it has outliers (Student's t), None: where that is more probable; `knots` the largest number of
    each curve.
    """
    guess = _complex_gain(problem) if {"force_gain", "instrument_phase"} & set(free) else 1.0 + 0j
    gain = abs(guess) if "force_gain" in free else 1.0
    guess = gain * np.exp(1j * np.angle(guess)) if "instrument_phase" in free else gain + 0j
    assumed = "force_gain" not in free and problem.modes.modal_mass_std is None
    states = _test_states(problem, free, stated, guess)
    rounds = Rounds(most_knots=MOST_KNOTS if knots is None else knots)
    fit = functools.partial(fit_test, power_likelihood=True)
    first = functools.partial(fit, compare_levels=False, parts_of_noise=True)
    posterior = first(states, rounds=rounds, robust=robust)
    robust = bool(np.any(posterior.weight != 1))
    fit, first = (functools.partial(one, robust=robust) for one in (fit, first))
    if _noise_of(posterior, stated).exceeded:  # the curves may be steeper than the knots resolve
        posterior = first(states, rounds=rounds._replace(crowded=True))
    mass, std = posterior.modal_mass
    if assumed and (posterior.phase_is_controlled or abs(mass - 1) <= _ASKED * std):
        linear = np.append(np.asarray(problem.prior.linear)[:-1], 0.0)
        known = dataclasses.replace(problem.prior, linear=jax.device_put(linear))
        problem = dataclasses.replace(problem, prior=known)
        states = states._replace(mass_std=0.0)
        posterior = first(states, rounds=rounds._replace(start=posterior))
    states = posterior.states
    named = any(choice.kind not in SMOOTH or choice.argument == "velocity" for choice in choices)
    start = rounds._replace(start=posterior)
    if named:
        terms = _terms(posterior, choices, 0), _terms(posterior, choices, 1)
        # A family with remainder fits as well as smooth curves: keep the independent fraction.
        start = start._replace(start=posterior.beginning(terms=terms), same_fraction=True)
        with_remainder = fit(states, compare_levels=False, rounds=start)
        terms = _kept(with_remainder, 0), _kept(with_remainder, 1)
        start = start._replace(start=with_remainder.beginning(terms=terms))
    posterior = fit(states, average_roughness=True, rounds=start)
    require_passive(free, posterior.modal_mass[0])
    if "force_gain" in free:
        posterior = _with_common_gain_in_the_force(posterior)
    noise = _noise_of(posterior, stated)
    # The prior of a stated noise may keep the posterior's noise below that of the residuals.
    wider = max(noise.scale / posterior.hyper.noise, 1.0) if noise.exceeded else 1.0
    scale = wider * posterior.hyper.noise / np.sqrt(posterior.fraction)
    errors = np.zeros((len(states.level), len(STATE_ERRORS)))
    corrections = np.zeros_like(errors)
    n_inputs = posterior.corrections.shape[1]
    errors[:, :n_inputs], corrections[:, :n_inputs] = (
        scale * posterior.states.errors,
        posterior.corrections,
    )
    ratio = posterior.level_std / noise.level_std
    new_level = np.where(
        np.array(states.level_std) > 0,
        states.level_std,
        students_factor(states.n_levels - 1) * noise.level_std,
    )
    of_levels = map(jax.device_put, (posterior.level_std, ratio, new_level))
    z = 1j * states.frequency * states.constant * states.force / states.velocity
    problem = dataclasses.replace(
        problem.with_data(
            std=jax.device_put(errors),
            weight=jax.device_put(posterior.weight),
            correction=jax.device_put(corrections),
            detuning=jax.device_put(off_resonance(z, states.frequency)),
        ),
        prior=dataclasses.replace(
            problem.prior,
            **dict(zip(("level", "level_ratio", "new_level"), of_levels, strict=True)),
        ),
    )
    posterior = posterior._replace(covariance=wider**2 * posterior.covariance)
    return View(posterior, problem, guess, free, noise)


def _with_common_gain_in_the_force(posterior: TestPosterior) -> TestPosterior:
    """The posterior with the mean of the level gains moved to the free force gain.

    Both act identically on every state. The split is left to the priors, and the roughness prior
    of the curves prefers small forces.
    """
    layout, mean = posterior.layout, posterior.mean.copy()
    common = float(np.mean(posterior.level_errors[:, 0]))
    mean[layout.levels[:, 0]] -= common
    mean[MASS] = (1 + mean[MASS]) * np.exp(common) - 1
    mean[OFFSET] *= np.exp(common)
    for terms, functions in zip(posterior.terms, (layout.stiffness, layout.damping), strict=True):
        mean[functions] *= np.where(terms.scaled, np.exp(common), 1.0)
    return posterior._replace(mean=mean)


def _test_states(
    problem: BalanceProblem, free: tuple[str, ...], stated: bool, guess: complex
) -> TestStates:
    """The states for the model of a test, corrected for the initial guess of the instruments."""
    data, prior = problem.data, problem.prior
    force = abs(guess) * np.asarray(data.force)
    spread = np.asarray(prior.linear)
    others = spread[: EXPONENTS.start]

    def velocity_at(deviation: np.ndarray) -> Complex[np.ndarray, " state"]:
        return velocity_of_others(problem, np.append(deviation, np.zeros(3)), force)

    constant = float(problem.modal_constant)
    sign = np.sign(constant)
    known = np.zeros(len(others))
    velocity = np.asarray(data.velocity) * np.exp(-1j * np.angle(guess)) - velocity_at(known)
    moved = [velocity_at(unit) - velocity_at(known) for unit in np.eye(len(known))[others > 0]]
    return TestStates(
        level=np.asarray(data.level),
        frequency=np.asarray(data.frequency),
        force=force,
        velocity=sign * velocity,
        errors=np.asarray(data.std)[:, :3],
        stated=stated,
        constant=abs(constant) * np.asarray(data.participation),
        level_std=tuple(np.asarray(prior.level).tolist()),
        mass_std=_FREE if "force_gain" in free else float(spread[-1]),
        force_is_free="force_gain" in free,
        phase_std=_FREE if "instrument_phase" in free else 0.0,
        offset_std=_FREE if "force_offset" in free else 0.0,
        off_resonance_std=OFF_RESONANCE,
        other_modes=sign * np.stack(moved, axis=1) if moved else None,
    )


def viewed_unknowns(view: View) -> Unknowns:
    """Unknowns of a joint fit at the posterior mean."""
    posterior, prior = view.posterior, view.problem.prior
    level, spread = np.asarray(prior.level), np.asarray(prior.linear)
    mass = posterior.modal_mass[0]
    gain, is_free = abs(view.gain), "force_gain" in view.free
    linear = np.zeros(len(spread))
    linear[np.flatnonzero(spread[: EXPONENTS.start] > 0)] = posterior.mean[posterior.layout.others]
    linear[EXPONENTS] = posterior.mean[WITH_FREQUENCY] / spread[EXPONENTS]
    if spread[-1] > 0:
        linear[-1] = np.log(mass) / spread[-1]
    return Unknowns(
        squared_frequency=_curve(posterior, 0),
        modal_damping=_curve(posterior, 1),
        log_force_gain=jax.device_put(np.log(gain / mass) if is_free else 0.0),
        force_offset=jax.device_put(posterior.force_offset * (gain / mass if is_free else 1.0)),
        instrument_phase=jax.device_put(float(np.angle(view.gain)) + posterior.instrument_phase),
        level=jax.device_put(posterior.level_errors * _sign_of_gain(view) / level),
        linear=jax.device_put(linear),
    )


def _sign_of_gain(view: View) -> Float[np.ndarray, " error"]:
    """Sign of level errors: gains divide the recorded velocity, free ones multiply the force."""
    return np.array([-1.0 if "force_gain" in view.free else 1.0, 1.0, 1.0, 1.0])


def viewed_covariance(view: View) -> Float[np.ndarray, "unknown unknown"]:
    """Covariance of the free unknowns of a fit."""
    posterior, prior = view.posterior, view.problem.prior
    layout, mass = posterior.layout, posterior.modal_mass[0]
    n = len(posterior.mean)

    def by(**unknowns_and_slopes: float) -> np.ndarray:
        row = np.zeros(n)
        for name, slope in unknowns_and_slopes.items():
            row[{"mass": MASS, "phase": PHASE, "offset": OFFSET}[name]] = slope
        return row

    scale = abs(view.gain) / mass if "force_gain" in view.free else 1.0
    of_mass = -scale * posterior.force_offset / mass if "force_gain" in view.free else 0.0
    measurement = {
        "force_gain": by(mass=-1 / mass),
        "force_offset": by(offset=scale, mass=of_mass),
        "instrument_phase": by(phase=1.0),
    }
    unit = _sign_of_gain(view) / np.asarray(prior.level)
    levels = np.zeros((layout.levels.size, n))
    levels[np.arange(layout.levels.size), layout.levels.reshape(-1)] = np.tile(
        unit, len(layout.levels)
    )
    spread = np.asarray(prior.linear)
    linear = np.zeros((len(spread), n))
    others = np.flatnonzero(spread[: EXPONENTS.start] > 0)
    linear[others, np.arange(n)[layout.others]] = 1.0
    linear[EXPONENTS, WITH_FREQUENCY] = np.diag(1 / spread[EXPONENTS])
    if spread[-1] > 0:
        linear[-1] = by(mass=1 / (mass * spread[-1]))
    rows = [_slopes(posterior, 0), _slopes(posterior, 1)]
    rows += [row[None] for name, row in measurement.items() if name in view.free]
    slopes = np.concatenate([*rows, levels, linear])
    covariance = slopes @ posterior.covariance @ slopes.T
    # Parameters without uncertainty keep their prior: unit variance in their own 1σ.
    certain = len(covariance) - len(spread) + np.flatnonzero(spread == 0)
    covariance[certain, certain] = 1.0
    return covariance


def _noise_of(posterior: TestPosterior, stated: bool) -> NoiseEstimate:
    """The noise from the residuals, and the posterior's 1σ of level errors."""
    rows = posterior.residuals.size
    freedom = max(rows - posterior.effective_unknowns, LEAST_LEFT * rows)
    noise = posterior.hyper.noise * float(np.sqrt(np.sum(posterior.residuals**2) / freedom))
    std = noise / np.sqrt(2 * posterior.fraction * freedom)
    return NoiseEstimate(noise, std, np.array(posterior.hyper.level_std), stated)


def _terms(posterior: TestPosterior, choices: tuple[Choice, Choice], which: int) -> CurveTerms:
    """The terms of the chosen family, starting near the smooth posterior."""
    terms, choice = posterior.terms[which], choices[which]
    family = None
    if choice.kind not in SMOOTH:
        family = _nearest(posterior, choice, which)
    argument = choice.argument or "displacement" if family is None else family.argument
    basis = terms.basis
    if argument == "velocity":
        displacement = basis.largest * np.sqrt(basis.knots)
        speed = displacement * np.sqrt(posterior.curves(displacement).squared_frequency)
        largest = float(np.max(np.abs(posterior.states.velocity)))
        basis = CurveBasis.at(largest, (speed / largest) ** 2)
    return CurveTerms(basis, terms.unit, argument, family)


def _kept(with_remainder: TestPosterior, which: int) -> CurveTerms:
    """The terms of a curve, a family without remainder where noise explains it."""
    terms = with_remainder.terms[which]
    if terms.family is None:
        return terms
    family = terms.family.at(_parameters(with_remainder, which)[: terms.n_own])
    return terms._replace(family=family, smooth=with_remainder.remainders[which])


def _nearest(posterior: TestPosterior, choice: Choice, which: int) -> AbstractFamily:
    """The simplest member of the family within the band of the smooth curve, else the nearest."""
    x = posterior.states.amplitude
    curves = posterior.curves(x)
    values = (curves.squared_frequency, curves.modal_damping)[which]
    std = np.sqrt(curves.covariance[:, which, which])
    family, n = FAMILIES[choice.kind], len(x)
    orders = family.orders if choice.size is None else (choice.size,)
    tried: list[tuple[float, int, AbstractFamily]] = []
    for order in orders:
        for argument in (choice.argument,) if choice.argument else ARGUMENTS:
            at = x if argument == "displacement" else np.abs(posterior.states.velocity)
            for member in family.starts(order, Scattered(argument, at, values, 1 / std)):
                if member.parameters.shape[0] >= n:
                    raise InputError(
                        f"{choice.kind}:{order} has {member.parameters.shape[0]} parameters, but "
                        f"there are only {n} states: choose a smaller family."
                    )
                misfit = np.sqrt(np.mean(((member.linearised(at).value - values) / std) ** 2))
                tried.append((float(misfit), member.parameters.shape[0], member))
    # Within the band: rms misfit below 1σ.
    inside = [row for row in tried if row[0] < 1.0]
    if inside:
        return min(inside, key=lambda row: (row[1], row[0]))[2]
    return min(tried, key=lambda row: row[0])[2]


def _of_curve(posterior: TestPosterior, which: int) -> tuple[CurveTerms, slice]:
    layout = posterior.layout
    return posterior.terms[which], (layout.stiffness, layout.damping)[which]


def _parameters(posterior: TestPosterior, which: int) -> Float[np.ndarray, " parameter"]:
    """A curve's parameters: a family's and its remainder's, or values at knots."""
    terms, functions = _of_curve(posterior, which)
    own, mass = posterior.mean[functions], posterior.modal_mass[0]
    if terms.family is not None:
        return terms.units * own / np.where(terms.scaled, mass, 1.0)
    reference = posterior.layout.reference if which == 0 else 0.0
    return terms.curve(terms.basis.largest * np.sqrt(terms.basis.knots), own)[0] / mass + reference


def _slopes(posterior: TestPosterior, which: int) -> Float[np.ndarray, "parameter unknown"]:
    """Derivatives of `_parameters` by all unknowns."""
    terms, functions = _of_curve(posterior, which)
    own, mass = posterior.mean[functions], posterior.modal_mass[0]
    columns = np.diag(terms.units)
    if terms.family is None:
        columns = terms.columns(terms.basis.largest * np.sqrt(terms.basis.knots), own)
    scaled = terms.scaled if terms.family is not None else np.ones(len(columns), dtype=bool)
    columns = columns / np.where(scaled, mass, 1.0)[:, None]
    rows = np.zeros((len(columns), len(posterior.mean)))
    rows[:, functions] = columns
    rows[:, MASS] = -np.where(scaled, columns @ own, 0.0) / mass
    return rows


def _curve(posterior: TestPosterior, which: int) -> AbstractFamily:
    """A curve of the posterior, with its estimated roughness as prior."""
    terms, hyper = posterior.terms[which], posterior.hyper
    basis, parameters = terms.basis, _parameters(posterior, which)
    roughness_std = terms.unit * hyper.roughness[which] / posterior.modal_mass[0]
    roughness = roughness_std * np.exp(basis.directions @ hyper.along)
    if terms.family is None:
        scale = jax.device_put(basis.largest)
        return SmoothingSpline.through(basis.knots, parameters, scale, terms.argument, roughness)
    n = terms.n_own
    family = terms.family.at(parameters[:n])
    if not terms.smooth:
        return family
    functions = basis.values(basis.largest * np.sqrt(basis.knots))[0][:, 1:]
    std = np.append(roughness_std * basis.reach, roughness)
    return WithRemainder.of(family, basis.knots, functions, parameters[n:], std)


def _complex_gain(problem: BalanceProblem) -> complex:
    """G of K X/A = G F with K polynomial in the amplitude, by linear least squares.

    Where that gives negative damping, a real G with the sign of a passive structure is fitted.
    """
    data, constant = problem.data, float(problem.modal_constant)
    omega, velocity, force = (
        np.asarray(part) for part in (data.frequency, data.velocity, data.force)
    )
    x = velocity / (1j * omega) / (constant * np.asarray(data.participation))
    a = np.abs(x) / np.abs(x).max()
    columns = [x, x * a**2, x * a**4, 1j * omega * x, 1j * omega * x * a, 1j * omega * x * a**2]
    columns += [-force + 0j, -1j * force]
    right = omega**2 * x
    matrix = np.stack([np.concatenate([c.real, c.imag]) for c in columns], axis=1)
    target = np.concatenate([right.real, right.imag])
    weight = np.tile(1.0 / np.maximum(np.abs(x), 1e-300), 2)
    norm = np.linalg.norm(matrix * weight[:, None], axis=0)
    weighted, goal = matrix * weight[:, None] / norm, target * weight
    answer = np.linalg.lstsq(weighted, goal, rcond=1e-13)[0]
    gain = complex(*(answer / norm)[6:])
    damping = np.stack([np.ones_like(a), a, a**2], axis=1) @ (answer / norm)[3:6]
    if gain != 0 and np.median(damping) > 0:
        return gain
    # States on one side of resonance are fitted as well with a phase of 180° and negative damping.
    # The power input to a passive structure is positive: it gives the sign of the gain.
    sign = np.sign(np.sum(np.sign(np.real(velocity * constant)))) or 1.0
    weighted[:, 6] *= sign
    answer = np.append(nnls(weighted[:, :7], goal)[0], 0.0)
    gain = sign * float((answer / norm)[6])
    return complex(gain if gain != 0 else sign)
