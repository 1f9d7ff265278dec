"""States at controlled phase: exact phase resonances of a mode, whose frequency scatters."""

import numpy as np
import pytest

import snrmjax as sj

HZ, RATIO, MASS = 80.0, 0.002, 1.0


def frequency_ratio(x):
    """Natural frequency over the linear one; x is the amplitude over the largest."""
    return 1 - 0.003 * x**2


def damping_ratio_factor(x):
    """Damping ratio over the linear one."""
    return 1 + 1.5 * x


def about_resonance(scatter, spread, seed, noise=3e-4):
    """A model, and states of one level whose phases lie within `spread` (rad) of resonance.

    ω̃² scatters by twice `scatter`, relative, at fixed phase: Ω solves K − Ω² = Ωδ tan φ.
    """
    rng, n = np.random.default_rng(seed), 30
    x = np.geomspace(0.1, 1.0, n)
    own = 2 * np.pi * HZ * frequency_ratio(x)
    stiffness = own**2 * (1 + 2 * scatter * rng.normal(size=n))
    damping = 2 * RATIO * damping_ratio_factor(x) * own
    half = 0.5 * damping * np.tan(spread * rng.uniform(-1, 1, n))
    omega = np.sqrt(stiffness + half**2) - half
    amplitude = 1e-4 * x
    needed = MASS * (stiffness - omega**2 + 1j * omega * damping)
    velocity = 1j * omega * amplitude * np.abs(needed) / needed
    velocity *= np.exp(noise * (rng.normal(size=(n, 2)) @ [1.0, 1j]))
    modes = sj.model.linear_modes([2 * np.pi * HZ], [RATIO], [[1.0]], [1.0])
    data = sj.measure.steady_states(np.ones(n, int), omega, np.abs(needed) * amplitude, velocity)
    return sj.model.structure(modes), data


def at_resonance(scatter, damped=0.01, levels=3, seed=1):
    """A model, and states with F = 2ζωmV in phase; the frequency scatters by a relative 1σ."""
    rng = np.random.default_rng(seed)
    x = np.tile(np.geomspace(0.03, 1.0, 40), levels) * np.repeat(rng.uniform(0.97, 1.0, levels), 40)
    velocity = 0.064 * x
    omega = 2 * np.pi * HZ * frequency_ratio(x)
    ratio = RATIO * damping_ratio_factor(x) * (1 + damped * rng.normal(size=x.size))
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
    assert fit.identified_modes.participation == pytest.approx(model.modes.participation)
    x = np.geomspace(0.05, 0.95, 20)
    speed = 0.064 * x
    squared, modal = fit.unknowns.squared_frequency, fit.unknowns.modal_damping
    omega = 2 * np.pi * HZ * frequency_ratio(x)
    frequency, modal_damping = np.sqrt(squared(speed / omega)), np.asarray(modal(speed / omega))
    # 1 % of damping scatter, 120 states, a curve with some six degrees of freedom: 0.3 %.
    np.testing.assert_allclose(
        modal_damping / (2 * frequency), RATIO * damping_ratio_factor(x), rtol=0.02
    )
    np.testing.assert_allclose(
        frequency / (2 * np.pi), HZ * frequency_ratio(x), atol=HZ * (0.6 * scatter + 1e-5)
    )


@pytest.mark.parametrize(
    ("scatter", "spread", "seed"),
    [(1e-4, 3, 0), (1e-4, 3, 2), (1e-3, 5, 2), (1e-3, 5, 4), (1e-3, 20, 1), (0.0, 20, 1)],
)
def test_loosely_controlled_phases_change_neither_mass_nor_damping(scatter, spread, seed):
    """Scatter treated as phase noise made ζ 9 to 700 % too large.

    The check then named rms amplitudes, other units or volts.
    """
    model, data = about_resonance(scatter, np.radians(spread), seed)
    fit = sj.fit_jointly(data, model)
    assert fit.identified_modes.participation == pytest.approx(model.modes.participation)
    x = np.geomspace(0.12, 0.95, 20)
    omega = 2 * np.pi * HZ * frequency_ratio(x)
    found = sj.identify.fitted_values(fit, 1e-4 * x * omega)
    # 3e-4, 30 states, some six degrees of freedom: 1.3e-4; and ω̃ scatters by `scatter`.
    np.testing.assert_allclose(
        found.damping_ratio, RATIO * damping_ratio_factor(x), rtol=2e-3 + 4 * scatter
    )
    np.testing.assert_allclose(found.natural_frequency, omega, rtol=1e-5 + scatter)
    assert not sj.doctor.check_test(data, model).findings


def test_a_missing_effect_is_diagnosed_from_phase_resonances():
    model, data = at_resonance(2e-5)
    found = sj.diagnose_model(model, data)
    named = {part.part: part for part in found.parts}
    assert "quadratic_damping" in named["damping"].effects
    assert named["instrument"].effects == ()


def test_phase_resonances_raise_no_unit_finding():
    model, data = at_resonance(1e-4)
    assert not sj.doctor.check_test(data, model).findings
