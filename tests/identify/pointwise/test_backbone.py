"""Backbones of a Duffing-like mode in closed form: exact values, bands, refusals."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import snrmjax as sj
from snrmjax.identify.curves.splines import Spline
from snrmjax.identify.pointwise.backbone import Backbone
from snrmjax.measure.states import steady_states
from snrmjax.model.modes import linear_modes

W0, RATE = 500.0, 10.0  # ω0 and 2ζ̃ω̃, constant: ζ = 1 %
CUBIC = 4 / 3 * 0.2 * W0**2  # ω̃² = ω0² + ¾ a Q² is 20 % up at Q = 1
SHAPE, PARTICIPATION = 2.0, 1.5
CONSTANT = SHAPE * PARTICIPATION
MODES = linear_modes([W0], [RATE / (2 * W0)], [[SHAPE]], [PARTICIPATION])
LEVELS, STATES = 6, 4
LEVEL = np.repeat(np.arange(LEVELS), STATES)
GRID = np.linspace(0.16, 0.99, 12)


def squared(amplitude):
    """ω̃² at a displacement amplitude of the sensor."""
    return W0**2 + 0.75 * CUBIC * np.asarray(amplitude) ** 2


def duffing_test(seed, *, amplitude=0.0, phase=0.0, force=0.0, levels=(0.0,) * 4, stated=True):
    """States of a force-controlled test: amplitudes fall with the distance from resonance.

    Errors are relative and 1σ; `levels` are scales of the half-normal 1σ of differences between
    levels: gain, phase, stiffness and damping.
    """
    rng = np.random.default_rng(seed)
    angle = np.radians(rng.uniform(-55, 55, LEVELS * STATES))
    amplitudes = np.linspace(0.16, 1.0, LEVELS)[LEVEL] * (0.7 + 0.3 * np.cos(angle))
    draw = rng.standard_normal((4, LEVELS * STATES))
    scales = levels * np.abs(rng.standard_normal(4))
    gain, lead, stiffer, lossier = (scales[:, None] * rng.standard_normal((4, LEVELS)))[:, LEVEL]
    own, rate = squared(amplitudes) * (1 + stiffer), RATE * (1 + lossier)
    # tan φ = (ω̃² − Ω²)/(δΩ), a quadratic for Ω; |ω̃² − Ω² + iδΩ| Q = |A|F.
    slope = rate * np.tan(angle)
    frequency = -slope / 2 + np.sqrt(slope**2 / 4 + own)
    stiffness = own - frequency**2 + 1j * rate * frequency
    applied = amplitudes * np.abs(stiffness) / CONSTANT
    velocity = 1j * frequency * CONSTANT * applied / stiffness
    measured = velocity * (1 + amplitude * draw[0]) * np.exp(1j * phase * draw[1])
    measured = measured * np.exp(gain + 1j * lead)
    recorded = applied * (1 + force * draw[2])
    return steady_states(
        LEVEL,
        frequency,
        recorded,
        measured,
        velocity_std=(amplitude * np.abs(measured))[:, None] if stated else None,
        phase_std=np.full((LEVELS * STATES, 1), phase) if stated else None,
        force_std=force * applied if stated else None,
    )


def fitted(data, modes=MODES, **settings):
    return sj.identify_backbone(data, modes, **settings)


class TestExactPoints:
    @pytest.mark.parametrize("seed", [0, 1])
    def test_a_duffing_backbone_is_recovered(self, seed):
        identification = fitted(duffing_test(seed, stated=False))
        values = identification.backbone.values(GRID)
        # Noise is taken to be 1e-5 at least, and to grow off resonance.
        np.testing.assert_allclose(values.natural_frequency, np.sqrt(squared(GRID)), rtol=1e-6)
        np.testing.assert_allclose(values.modal_damping, RATE, rtol=1e-4)
        assert not identification.fit.noise.stated
        assert identification.fit.noise.scale < 1e-5

    def test_the_backbone_itself(self):
        backbone = fitted(duffing_test(0, stated=False)).backbone
        at = jnp.linspace(float(backbone.smallest), 1.2 * float(backbone.largest), 20)
        omega = np.sqrt(squared(at))
        np.testing.assert_allclose(backbone.natural_frequency(at), omega, rtol=1e-6)
        np.testing.assert_allclose(backbone.damping_ratio(at), RATE / (2 * omega), rtol=1e-4)
        np.testing.assert_allclose(backbone.velocity(at), at * omega, rtol=1e-6)
        assert (backbone.argument, backbone.sensor) == ("displacement", "sensor 1")
        np.testing.assert_allclose(backbone.modal_constant, CONSTANT, rtol=1e-15)
        points = sj.identify.identify_points(duffing_test(0, stated=False), MODES)
        assert float(backbone.smallest) == pytest.approx(float(points.amplitude.min()), rel=1e-4)
        assert float(backbone.largest) == pytest.approx(float(points.amplitude.max()), rel=1e-12)

    def test_at_the_papers_argument(self):
        # Damping and stiffness that belong to the velocity: the same numbers, read at Q ω̃.
        backbone = fitted(duffing_test(0, stated=False), amplitude="velocity").backbone
        assert backbone.argument == "velocity"
        assert float(backbone.velocity(jnp.asarray(7.0))) == 7.0
        omega = np.sqrt(squared(GRID))
        values = backbone.values(GRID * omega)
        np.testing.assert_allclose(values.natural_frequency, omega, rtol=1e-4)  # between knots
        points = sj.identify.identify_points(
            duffing_test(0, stated=False), MODES, amplitude="velocity"
        )
        np.testing.assert_allclose(backbone.largest, points.amplitude.max(), rtol=1e-12)

    def test_a_joint_fit_of_smooth_curves_is_the_same(self):
        data = duffing_test(3, amplitude=0.01, phase=0.01)
        one = fitted(data).backbone.values(GRID)
        other = sj.identify.fitted_values(sj.fit_jointly(data, MODES), displacement=GRID)
        for first, second in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
            np.testing.assert_allclose(first, second, rtol=1e-12)

    def test_states_that_were_not_measured_are_left_out(self):
        data = duffing_test(3, amplitude=0.01, phase=0.01)
        spoilt = data.velocity.at[5].set(jnp.nan)
        lost = fitted(eqx.tree_at(lambda d: d.velocity, data, spoilt))
        without = fitted(data.select(np.arange(LEVELS * STATES) != 5))
        np.testing.assert_allclose(
            lost.backbone.modal_damping.parameters,
            without.backbone.modal_damping.parameters,
            rtol=1e-9,
        )


def study(seeds, modes=MODES, **errors):
    """Standardised errors of both curves on the grid, and the noise scale of the fits."""
    scores, scales = [], []
    for seed in range(seeds):
        identification = fitted(duffing_test(seed, **errors), modes)
        values = identification.backbone.values(GRID)
        off = np.asarray(values.natural_frequency) - np.sqrt(squared(GRID))
        lost = np.asarray(values.modal_damping) - RATE
        scores.append([off / values.natural_frequency_std, lost / values.modal_damping_std])
        scales.append(identification.fit.noise.scale)
    return np.array(scores), np.array(scales)


STATED = {"amplitude": 0.01, "phase": 0.01, "force": 0.005}
# Differences between levels of published tests: the prior of bands unless a structure states one.
PUBLISHED = (0.05, 0.02, 0.008, 0.05)
ALIKE = sj.model.structure(
    MODES,
    **{"level_gain_std": 1e-6, "level_phase_std": 1e-6},
    **{"level_frequency_std": 1e-6 * W0, "level_damping_std": 1e-8},
)


class TestBands:
    # Nominal coverage 95 %, known to 2 % from 100 seeds. A scale estimated from six levels is
    # uncertain (Student): coverage is higher where no level is an outlier.
    @pytest.mark.long
    @pytest.mark.parametrize(("modes", "levels"), [(MODES, PUBLISHED), (ALIKE, (0.0,) * 4)])
    def test_bands_of_stated_noise_cover_the_truth(self, modes, levels):
        scores, scales = study(100, modes, levels=levels, **STATED)
        covered = np.mean(np.abs(scores) < 1.96, axis=0)
        # The prior favours straight lines, which are right here.
        assert covered.min() >= 0.88
        assert 0.93 <= covered.mean() <= 0.995
        np.testing.assert_allclose(np.sqrt(np.mean(scales**2)), 1.0, atol=0.1)

    @pytest.mark.long
    def test_levels_not_stated_to_be_alike_may_differ(self):
        # Six levels with random scatter alone do not exclude a common error: bands include it and
        # cover more than 95 % without one.
        errors, errors_alike = (study(20, modes, **STATED)[0] for modes in (MODES, ALIKE))
        assert np.mean(np.abs(errors) < 1.96) >= np.mean(np.abs(errors_alike) < 1.96)
        assert np.sqrt(np.mean(errors**2)) < 0.7 * np.sqrt(np.mean(errors_alike**2))

    @pytest.mark.long
    def test_unstated_noise_is_estimated(self):
        scores, scales = study(100, amplitude=0.01, phase=0.01, levels=PUBLISHED, stated=False)
        # Relative noise 1 %; points off resonance have up to 3 times the error.
        assert 0.003 < np.sqrt(np.mean(scales**2)) < 0.012
        assert 0.85 <= np.mean(np.abs(scores) < 1.96) <= 0.995


class TestStd:
    def test_std_against_monte_carlo_of_both_curves(self):
        rng = np.random.default_rng(0)
        knots = np.array([0.0, 0.25, 1.0])
        values = np.concatenate([squared(np.sqrt(knots)), [10.0, 11.0, 14.0]])
        root = rng.normal(size=(6, 6)) * np.repeat([20.0, 0.1], 3)[:, None]

        def backbone(values, covariance):
            scale = jnp.asarray(1.0)
            pair = [Spline.through(knots, v, scale, "displacement") for v in np.split(values, 2)]
            return Backbone(
                *pair,
                covariance=jnp.asarray(covariance),
                modal_constant=jnp.asarray(CONSTANT),
                smallest=jnp.asarray(0.2),
                largest=jnp.asarray(1.0),
                argument="displacement",
                sensor="sensor 1",
            )

        at = np.linspace(0.2, 1.0, 9)
        one = backbone(values, np.eye(6))

        def at_knots(backbone):
            return backbone.squared_frequency.parameters, backbone.modal_damping.parameters

        draws = (values + root @ rng.normal(size=6) for _ in range(2000))
        drawn = [eqx.tree_at(at_knots, one, tuple(np.split(v, 2))).values(at) for v in draws]
        identification = backbone(values, root @ root.T)
        values = identification.values(at)
        # 2000 draws know a standard deviation to 1.6 %. Both curves err together here.
        for name in ("natural_frequency", "damping_ratio"):
            spread = np.std([np.asarray(getattr(one, name)) for one in drawn], axis=0)
            np.testing.assert_allclose(getattr(values, f"{name}_std"), spread, rtol=0.07)

    def test_a_squared_frequency_below_zero_has_no_frequency(self):
        line = Spline.through(
            np.array([0.0, 1.0]), np.array([1.0, -1.0]), jnp.asarray(1.0), "displacement"
        )
        identification = fitted(duffing_test(0, stated=False))
        broken = eqx.tree_at(lambda b: b.squared_frequency, identification.backbone, line)
        at = jnp.array([0.5, 0.9])
        assert np.isfinite(broken.natural_frequency(at)[0])
        assert np.isnan(broken.natural_frequency(at)[1])
        assert np.isnan(broken.damping_ratio(at)[1])


class TestRefusals:
    def test_too_few_points(self):
        data = duffing_test(0)
        velocity = jnp.where(jnp.arange(LEVELS * STATES)[:, None] < 1, data.velocity, jnp.nan)
        with pytest.raises(ValueError, match="at least 2 solved points, but only 1 of 24 are"):
            fitted(eqx.tree_at(lambda d: d.velocity, data, velocity))

    @pytest.mark.parametrize("levels", [1, 2])
    def test_few_levels_are_enough(self, levels):
        data = duffing_test(0, amplitude=0.01, phase=0.01)
        backbone = fitted(data.select(np.less(LEVEL, levels))).backbone
        ends = np.array([float(backbone.smallest), float(backbone.largest)])
        values = backbone.values(ends)
        assert np.isfinite(values.natural_frequency_std).all()
        np.testing.assert_allclose(values.natural_frequency, np.sqrt(squared(ends)), rtol=0.01)


def test_bands_cover_damping_that_changes_with_the_forcing_frequency():
    # Viscous damping of 0.25 % and a hysteretic one of 0.25 %, c(Ω) = c₁ + c₂ ω/Ω, measured below
    # resonance only: the curve of a one-sided test is off by up to c₂ ln(Ω/ω), which is known.
    natural, modal = 2 * np.pi * 50.0, 0.01 * 2 * np.pi * 50.0
    frequency = np.tile(natural * np.linspace(0.985, 0.999, 12), 4)
    force = np.repeat([1.0, 2.0, 3.0, 4.0], 12)
    damping = modal / 2 * (1 + natural / frequency)
    velocity = force / (damping + 1j * (frequency**2 - natural**2) / frequency)
    data = steady_states(
        np.repeat([1, 2, 3, 4], 12), frequency, force, velocity[:, None],
        **{"velocity_std": 1e-5 * np.abs(velocity)[:, None], "phase_std": np.full((48, 1), 1e-5)},
    )  # fmt: skip
    backbone = fitted(data, linear_modes([natural], [0.0025], [[1.0]], [1.0])).backbone
    ends = float(backbone.smallest), float(backbone.largest)
    identification = backbone.values(jnp.linspace(*ends, 21))
    off = np.abs(np.asarray(identification.modal_damping) - modal) / np.asarray(
        identification.modal_damping_std
    )
    assert np.mean(off < 1.96) > 0.9
