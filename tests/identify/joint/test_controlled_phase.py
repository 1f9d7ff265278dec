"""States at controlled phase: exact phase resonances of a mode, whose frequency scatters."""

import numpy as np
import pytest

import snrmjax as sj

HZ, RATIO, MASS = 80.0, 0.002, 1.0


def softer(x):
    """Natural frequency over the linear one, by the amplitude over the largest."""
    return 1 - 0.003 * x**2


def lossier(x):
    """Damping ratio over the linear one."""
    return 1 + 1.5 * x


def at_resonance(scatter, damped=0.01, levels=3, seed=1):
    """A model, and states with F = 2ζωmV in phase; the frequency scatters by a relative 1σ."""
    rng = np.random.default_rng(seed)
    x = np.tile(np.geomspace(0.03, 1.0, 40), levels) * np.repeat(rng.uniform(0.97, 1.0, levels), 40)
    velocity = 0.064 * x
    omega = 2 * np.pi * HZ * softer(x)
    ratio = RATIO * lossier(x) * (1 + damped * rng.normal(size=x.size))
    force = 2 * ratio * omega * MASS * velocity
    recorded = omega * (1 + scatter * rng.normal(size=x.size))
    level = np.repeat(np.arange(levels) + 1, 40)
    modes = sj.model.linear_modes([2 * np.pi * HZ], [RATIO], [[1.0]], [1.0])
    return sj.model.structure(modes), sj.measure.steady_states(
        level, recorded, force, velocity + 0j
    )


@pytest.mark.parametrize("scatter", [2e-5, 1e-4, 1e-3])
def test_scatter_of_the_frequency_changes_neither_mass_nor_damping(scatter):
    """Up to a quarter of the half-power bandwidth, 4e-3."""
    model, data = at_resonance(scatter)
    fit = sj.fit_jointly(data, model)
    assert fit.modes_found.participation == pytest.approx(model.modes.participation)
    x = np.geomspace(0.05, 0.95, 20)
    speed = 0.064 * x
    squared, modal = fit.unknowns.squared_frequency, fit.unknowns.modal_damping
    omega = 2 * np.pi * HZ * softer(x)
    frequency, lost = np.sqrt(squared(speed / omega)), np.asarray(modal(speed / omega))
    # 1 % of damping scatter over 120 states, a curve of some six numbers: 0.3 %.
    np.testing.assert_allclose(lost / (2 * frequency), RATIO * lossier(x), rtol=0.02)
    np.testing.assert_allclose(
        frequency / (2 * np.pi), HZ * softer(x), atol=HZ * (0.6 * scatter + 1e-5)
    )


def test_what_is_missing_is_found_from_phase_resonances():
    model, data = at_resonance(2e-5)
    found = sj.diagnose_model(model, data)
    named = {part.part: part for part in found.parts}
    assert "quadratic_damping" in named["damping"].effects
    assert named["instrument"].effects == ()


def test_phase_resonances_are_no_error_of_units():
    model, data = at_resonance(1e-4)
    assert not sj.doctor.check_test(data, model).findings
