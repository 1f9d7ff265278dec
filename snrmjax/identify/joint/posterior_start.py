"""Where a joint fit starts by the model of a test: its curves, its noise and its levels."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

from snrmjax.identify.checks.residual_autocorrelation import share_told_by
from snrmjax.identify.curves.families import ARGUMENTS, FAMILIES, Choice, values_and_slopes
from snrmjax.identify.curves.family_base import AbstractFamily, Argument
from snrmjax.identify.curves.splines import SmoothingSpline, bends_of
from snrmjax.identify.joint.fitting import NoiseAndLevels
from snrmjax.identify.joint.force_balance import BalanceProblem, PriorStd, Unknowns
from snrmjax.identify.test_model.posterior import TestPosterior, few_levels_factor, fit_test
from snrmjax.identify.test_model.states import TestStates
from snrmjax.model.modes import residual_velocity

_FREE = 1.0  # 1σ of what nobody knows of the instruments, once its size is guessed
_CLEARLY = 20.0  # of −2 ln p, to believe in a frequency that wanders though nobody stated it
_SMOOTH = "smoothing_spline"


class Beginning(NamedTuple):
    """The posterior of the states, and what of the instruments was guessed beforehand."""

    posterior: TestPosterior
    gain: complex  # of the force, and phase of the velocity


def posterior_of(
    problem: BalanceProblem,
    free: tuple[str, ...],
    stated: bool,
    *,
    robust: bool,
    knots: int | None = None,
) -> Beginning:
    """The posterior of a joint fit's states.

    Arguments: `free` what of the instruments nobody knows; `stated` whether noise is; `knots` how
    many the curves have at most.
    """
    data, prior = problem.data, problem.prior
    guess = _complex_gain(problem) if {"force_gain", "instrument_phase"} & set(free) else 1.0 + 0j
    gain = abs(guess) if "force_gain" in free else 1.0
    phase = float(np.angle(guess)) if "instrument_phase" in free else 0.0
    force = gain * np.asarray(data.force)
    beside = residual_velocity(problem.modes, data.frequency, jnp.asarray(force))
    velocity = np.asarray(data.velocity) * np.exp(-1j * phase)
    velocity = velocity - np.sum(np.asarray(data.share) * np.asarray(beside), axis=1)
    constant = float(problem.modal_constant)
    states = TestStates(
        level=np.asarray(data.level),
        frequency=np.asarray(data.frequency),
        force=force,
        velocity=np.sign(constant) * velocity,
        errors=np.asarray(data.std)[:, :3],
        stated=stated,
        constant=abs(constant),
        level_std=tuple(np.asarray(prior.level).tolist()),
        mass_std=_FREE if "force_gain" in free else float(prior.linear[-1]),
        force_is_free="force_gain" in free,
        phase_std=_FREE if "instrument_phase" in free else 0.0,
        offset_std=_FREE if "force_offset" in free else 0.0,
    )
    found = fit_test(states, robust=robust, most_knots=knots, tempered=True)
    return Beginning(found, complex(gain * np.exp(1j * phase)))


def unknowns_at(
    start: Beginning, problem: BalanceProblem, free: tuple[str, ...], choices: tuple[Choice, Choice]
) -> Unknowns:
    """Unknowns of a joint fit at the posterior's mean, with curves of the families asked for."""
    found, level = start.posterior, np.asarray(problem.prior.level)
    mass = found.modal_mass[0]
    gain = start.gain / mass if "force_gain" in free else complex(1.0)
    linear = np.zeros(problem.prior.linear.shape[0])
    if float(problem.prior.linear[-1]) > 0:
        linear[-1] = np.log(mass) / float(problem.prior.linear[-1])
    errors = found.level_errors
    unit = np.where(level > 0, level, 1.0)
    return Unknowns(
        squared_frequency=_curve(start.posterior, choices[0], 0),
        modal_damping=_curve(start.posterior, choices[1], 1),
        log_force_gain=jnp.asarray(np.log(abs(gain))),
        force_offset=jnp.asarray(found.force_offset),
        instrument_phase=jnp.asarray(float(np.angle(start.gain)) + found.instrument_phase),
        level=jnp.asarray(np.where(level > 0, errors / unit, 0.0)),
        linear=jnp.asarray(linear),
    )


def noise_and_levels(found: TestPosterior) -> NoiseAndLevels:
    """The noise, and 1σ of what levels share, as the posterior has them."""
    states, n = found.states, len(found.states.level)
    share, noise = 1.0, found.hyper.noise
    noise_std = noise / np.sqrt(2 * max(2 * n - found.effective_unknowns, 0.5 * n))
    if not states.stated or noise - 3 * noise_std > 1:
        share = share_told_by(found.residuals, states.level, states.frequency)
    return NoiseAndLevels(noise, float(noise_std), found.hyper.level_std, share)


def with_levels(prior: PriorStd, components: NoiseAndLevels, n_levels: int) -> PriorStd:
    """Levels' errors as stated, or as found and as much wider as few levels leave open."""
    found = few_levels_factor(n_levels) * jnp.array(components.level)
    return dataclasses.replace(prior, level=jnp.where(prior.level > 0, prior.level, found))


def wandering_stiffness(found: TestPosterior) -> float:
    """1σ of relative stiffness from state to state, zero unless the residuals ask for it.

    Errors of force and phase move the balance alike along a response; a natural frequency that
    wanders moves it most where the mode is driven hardest.
    """
    arm = found.arms_of_stiffness / found.hyper.noise
    length = np.sum(arm**2, axis=1)
    along = np.sum(arm * found.residuals, axis=1) ** 2
    size = np.sum(found.residuals**2, axis=1)

    def criterion(point: np.ndarray) -> float:
        noise, extra = np.exp(2 * point)
        inner = noise + extra * length
        squares = (size - along * extra / inner) / noise
        return float(np.sum(squares + np.log(noise) + np.log(inner)))

    start = np.log([0.5, 0.5 / np.sqrt(np.median(length))])
    best = minimize(criterion, start, method="Nelder-Mead")
    alone = 2 * len(size) * (np.log(np.sum(size) / (2 * len(size))) + 1)
    return float(np.exp(best.x[1])) if best.fun < alone - _CLEARLY else 0.0


def _curve(found: TestPosterior, choice: Choice, which: int) -> AbstractFamily:
    """A curve of the family asked for, near what the posterior has."""
    if choice.kind in ("auto", _SMOOTH):
        return _smooth(found, choice.argument or "displacement", which)
    x = found.states.amplitude
    curves = found.curves(x)
    values = (curves.squared_frequency, curves.modal_damping)[which]
    std = np.sqrt(curves.covariance[:, which, which])
    family, n = FAMILIES[choice.kind], len(x)
    sizes = family.sizes(n, found.states.n_levels) if choice.size is None else (choice.size,)
    tried: list[tuple[float, int, AbstractFamily]] = []
    for size in sizes:
        for argument in (choice.argument,) if choice.argument else ARGUMENTS:
            at = x if argument == "displacement" else np.abs(found.states.velocity)
            for one in family.starts(size, argument, at, values, 1 / std):
                if one.parameters.shape[0] >= n:
                    raise ValueError(
                        f"{choice.kind}:{size} has {one.parameters.shape[0]} parameters, but "
                        f"there are {n} states only: choose a smaller family."
                    )
                off = np.sqrt(np.mean(((values_and_slopes(one, at)[0] - values) / std) ** 2))
                tried.append((float(off), one.parameters.shape[0], one))
    # The simplest that lies in the band of the smooth curve, or else the nearest to it.
    inside = [row for row in tried if row[0] < 1.0]
    if inside:
        return min(inside, key=lambda row: (row[1], row[0]))[2]
    return min(tried, key=lambda row: row[0])[2]


def _smooth(found: TestPosterior, argument: Argument, which: int) -> SmoothingSpline:
    """The posterior's own curve, with bends of the sizes that it found."""
    basis = found.basis
    displacement = basis.largest * np.sqrt(basis.knots)
    curves = found.curves(displacement)
    values = (curves.squared_frequency, curves.modal_damping)[which]
    knots, scale = basis.knots, basis.largest
    if argument == "velocity":
        speed = displacement * np.sqrt(curves.squared_frequency)
        knots, scale = (speed / speed[-1]) ** 2, float(speed[-1])
    blank = SmoothingSpline.through(knots, values, jnp.asarray(scale), argument)
    size = found.units[which] * found.hyper.bends[which] / found.modal_mass[0]
    std = size * np.exp(basis.directions @ found.hyper.along)
    return eqx.tree_at(
        lambda one: (one.bends, one.bend_std),
        blank,
        (jnp.asarray(bends_of(knots)), jnp.asarray(std)),
    )


def _complex_gain(problem: BalanceProblem) -> complex:
    """G of K X/A = G F with K polynomial in the amplitude, by linear least squares."""
    data, constant = problem.data, float(problem.modal_constant)
    omega, velocity, force = (
        np.asarray(part) for part in (data.frequency, data.velocity, data.force)
    )
    x = velocity / (1j * omega) / constant
    a = np.abs(x) / np.abs(x).max()
    columns = [x, x * a**2, x * a**4, 1j * omega * x, 1j * omega * x * a, 1j * omega * x * a**2]
    columns += [-force + 0j, -1j * force]
    right = omega**2 * x
    matrix = np.stack([np.concatenate([c.real, c.imag]) for c in columns], axis=1)
    target = np.concatenate([right.real, right.imag])
    weight = np.tile(1.0 / np.maximum(np.abs(x), 1e-300), 2)
    size = np.linalg.norm(matrix * weight[:, None], axis=0)
    answer = np.linalg.lstsq(matrix * weight[:, None] / size, target * weight, rcond=1e-13)[0]
    gain = complex(*(answer / size)[6:])
    return gain if gain != 0 else 1.0 + 0.0j
