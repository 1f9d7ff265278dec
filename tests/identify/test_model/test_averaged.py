"""Curves averaged over their roughness, where levels differ by unstated errors."""

import numpy as np
import pytest

from snrmjax.identify.test_model import posterior
from snrmjax.identify.test_model import states as measured
from snrmjax.identify.test_model.hyper import averaged, roughness_grid
from snrmjax.identify.test_model.posterior import fit_test
from snrmjax.numerics.blocks import on_one_core

AMPLITUDES = np.array([0.06, 0.25, 0.37, 0.5, 0.62, 0.75, 0.87, 1.0])
PER_LEVEL, NOISE = 9, 0.003


def stiffness(a):
    """A joint that opens and a beam that stiffens: ω̃² falls by 0.7 % and rises by as much."""
    return 500.0**2 * (1 - 0.010 * np.tanh(3 * a) + 0.012 * a**2)


def response_controlled(seed, scatter):
    """Levels of one amplitude each, whose stiffness differs by `scatter` (1σ), in closed form.

    The phase of every state is given, and (K − Ω²) = Ωδ tan φ solved for Ω.
    """
    rng = np.random.default_rng(seed)
    level = np.repeat(np.arange(len(AMPLITUDES)), PER_LEVEL)
    a = AMPLITUDES[level]
    phase = np.tile(np.radians(np.linspace(60, -60, PER_LEVEL)), len(AMPLITUDES))
    own = stiffness(a) * (1 + scatter * rng.normal(size=len(AMPLITUDES))[level])
    loss = 1.5 * (1 + 4 * a**2)
    b = 0.5 * np.tan(phase) * loss
    omega = -b + np.sqrt(b**2 + own)
    needed = own - omega**2 + 1j * omega * loss
    velocity = 1j * omega * a * np.abs(needed) / needed
    n = len(a)
    velocity = velocity * np.exp(NOISE * (rng.normal(size=n) + 1j * rng.normal(size=n)))
    errors = np.tile([1e-4, NOISE, NOISE], (n, 1))
    force = np.abs(needed) * a
    return measured.TestStates(level, omega, force, velocity, errors, True, 1.0, (0.0,) * 4, 0.0)


@on_one_core
def test_bands_allow_for_both_differing_levels_and_rough_curves():
    at = np.linspace(AMPLITUDES[0], AMPLITUDES[-1], 25)
    inside = {True: [], False: []}
    for seed in range(10):
        states = response_controlled(seed, 5e-4)
        for average_roughness, fractions in inside.items():
            found = fit_test(states, average_roughness=average_roughness, compare_levels=False)
            curves = found.curves(at)
            std = np.sqrt(curves.covariance[:, 0, 0])
            fractions.append(np.abs(curves.squared_frequency - stiffness(at)) < 1.96 * std)
    # 95 % nominal; ten tests of eight levels resolve some 5 %.
    assert np.mean(inside[True]) > 0.9
    # The most likely roughness alone mostly misses the lowest level, far from its neighbours.
    assert np.mean(inside[True], axis=0)[0] > np.mean(inside[False], axis=0)[0] + 0.3


def sampled(objective, point, bounds, draws, rng):
    """Hyperparameters by differential evolution Monte Carlo (ter Braak 2006), about a point."""
    low, high = np.transpose(bounds)
    free = high > low
    n = int(np.sum(free))
    crowd = np.clip(point + 0.3 * rng.normal(size=(3 * n, len(point))) * free, low, high)
    value = np.array([objective(one)[0] for one in crowd])
    kept = []
    for step_number in range(draws):
        for k in range(len(crowd)):
            first, second = crowd[rng.choice(len(crowd), 2, replace=False)]
            reach = 1.0 if step_number % 10 == 0 else 2.38 / np.sqrt(2 * n)
            step = reach * (first - second) + 1e-3 * rng.normal(size=len(point))
            moved = crowd[k] + step * free
            if np.any((moved < low) | (moved > high)):
                continue
            new = objective(moved)[0]
            if np.log(rng.random()) < new - value[k]:
                crowd[k], value[k] = moved, new
        if step_number >= draws // 3:
            kept.append(crowd.copy())
    return np.concatenate(kept)


@pytest.mark.long
@pytest.mark.parametrize(("seed", "scatter"), [(0, 5e-4), (1, 1.5e-3), (2, 5e-4)])
@on_one_core
def test_bands_are_those_of_sampled_hyperparameters(monkeypatch, seed, scatter):
    given = {}

    def record_grid(objective, point, bounds):
        given["problem"] = objective, point, bounds
        return roughness_grid(objective, point, bounds)

    def average(points, gaussian):
        given["gaussian"] = gaussian
        return averaged(points, gaussian)

    monkeypatch.setattr(posterior, "roughness_grid", record_grid)
    monkeypatch.setattr(posterior, "averaged", average)
    states = response_controlled(seed, scatter)
    found = fit_test(states, average_roughness=True, compare_levels=False)
    at = np.linspace(AMPLITUDES[0], AMPLITUDES[-1], 12)
    rng = np.random.default_rng(0)
    points = sampled(*given["problem"], 600, rng)
    means, variances = [], []
    for point in points[rng.choice(len(points), 400)]:
        one = given["gaussian"](point)
        curves = found._replace(mean=one.mean, covariance=one.covariance).curves(at)
        means.append(curves.squared_frequency)
        variances.append(curves.covariance[:, 0, 0])
    std = np.sqrt(np.mean(variances, axis=0) + np.var(means, axis=0))
    curves = found.curves(at)
    assert np.max(np.abs(curves.squared_frequency - np.mean(means, axis=0)) / std) < 0.3
    # 1σ of level errors is at its mode for each roughness.
    ratio = np.sqrt(curves.covariance[:, 0, 0]) / std
    assert ratio.min() > 0.75
    assert ratio.max() < 1.3
