"""Distributions of a resonance, against closed forms and quadrature."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm
from truths.exact_states import exact, modes, stated
from truths.levels_with_errors import Level

import snrmjax as sj
from snrmjax.identify.pointwise.backbone import BackboneValues
from snrmjax.identify.prediction.new_level import WITHOUT_LEVEL_ERRORS, NewLevel
from snrmjax.identify.prediction.resonance_distribution import (
    QUANTILES,
    KnownCurves,
    amplitudes_to,
    covariance_root,
    notes_on_negative_damping,
    notes_on_resonance,
    resonance_distribution,
    where_in_words,
)

OMEGA, DELTA = 500.0, 12.0
AMPLITUDE = amplitudes_to(1.0, 2.0)
# 4000 draws determine a quantile at 2.5 % to sqrt(0.025·0.975/4000)/pdf = 0.042σ: three times that.
DRAWN = 0.13
_TESTS = 120


def no_other(frequency):
    """One mode alone."""
    return np.zeros(len(frequency), dtype=complex)


def curves(damping, errors=None, load=OMEGA * DELTA * 0.5):
    """A constant natural frequency and some damping along `AMPLITUDE`, under |A|F."""
    values = np.column_stack([np.full(len(AMPLITUDE), OMEGA**2), damping])
    shape = np.zeros((len(AMPLITUDE), 2, 1))
    shape[:, 1, 0] = 0.0 if errors is None else errors
    return KnownCurves(values, shape, load, np.zeros(1))


def found(given, *, new=WITHOUT_LEVEL_ERRORS, **settings):
    """The distribution for these curves up to twice the largest amplitude."""
    return resonance_distribution(
        2.0, AMPLITUDE, given, new, no_other, **{"ratio": 2.0, **settings}
    )


def test_without_errors_it_is_the_resonance_itself():
    one = found(curves(np.full(len(AMPLITUDE), DELTA)))
    assert one.probability == 1.0
    np.testing.assert_allclose(one.frequency, OMEGA, rtol=1e-12)
    # Linear interpolation of a proportional force: exact.
    np.testing.assert_allclose(one.velocity, 0.5 * OMEGA, rtol=1e-12)
    assert where_in_words(one)["sure"]


@pytest.mark.parametrize(
    ("kind", "drive", "of_frequency", "of_velocity"),
    [
        # ln of frequency and velocity by each error: v = |A|F/δ, Ω = ω̃ + δ tan ψ/2.
        (0, None, 0.0, 1.0),
        (0, 3.0, 0.0, 1.0),
        (1, None, 0.5 * DELTA / OMEGA, 0.0),
        (2, None, 0.5, 0.0),
        (3, None, 0.0, -1.0),
    ],
)
def test_level_errors_are_included(kind, drive, of_frequency, of_velocity):
    std = 0.05 * (np.arange(4) == kind)
    new = NewLevel(std, drive)
    one = found(curves(np.full(len(AMPLITUDE), DELTA)), new=new, gain_of_force=drive is not None)
    sigma = norm.ppf(QUANTILES) * 0.05
    atol = DRAWN * 0.05
    frequency, velocity = np.log(one.frequency / OMEGA), np.log(one.velocity / (0.5 * OMEGA))
    np.testing.assert_allclose(
        frequency, of_frequency * sigma, atol=atol * max(of_frequency, 1e-9) + 1e-9
    )
    # A phase of 0.05 makes 1 − cos ψ of the velocity.
    np.testing.assert_allclose(
        velocity,
        abs(of_velocity) * sigma,
        atol=atol * abs(of_velocity) + (8e-3 if kind == 1 else 1e-9),
    )


def test_a_force_gain_does_not_affect_a_given_force():
    std = np.array([0.05, 0, 0, 0])
    one = found(curves(np.full(len(AMPLITUDE), DELTA)), new=NewLevel(std), gain_of_force=True)
    assert np.ptp(one.velocity) < 1e-9


def falling(slope):
    """Damping that falls in a straight line from rest, at slopes per amplitude."""
    return DELTA * (1 - np.multiply.outer(slope, AMPLITUDE))


def test_rejecting_negative_damping_keeps_the_probability():
    """δ = δ₀(1 − s x), s = 0.6 ± 0.2: by quadrature over s, with the root in closed form."""
    load = 0.55  # in units of ω̃δ₀ at an amplitude of one
    one = found(
        curves(falling(0.6), errors=-0.2 * DELTA * AMPLITUDE, load=load * OMEGA * DELTA),
    )
    s = 0.6 + 0.2 * norm.ppf((np.arange(200_000) + 0.5) / 200_000)
    # x(1 − s x) = load: the smaller root, within twice the data; else positive damping up to there.
    inner = 1 - 4 * s * load
    root = np.where(inner >= 0, 2 * load / (1 + np.sqrt(np.maximum(inner, 0))), np.inf)
    has = root <= 2.0
    passive = has | (1 - 2.0 * s > 0)
    # The twentieth with constant damping beyond x = 1: x(1 − s) = load there.
    late = np.where(root <= 1, root, load / (1 - s))
    late_has = (late <= 2.0) & (late > 0)
    late_passive = late_has | (s < 1)
    fraction = 0.95 * np.mean(passive) + 0.05 * np.mean(late_passive)
    expected = (0.95 * np.mean(has) + 0.05 * np.mean(late_has)) / fraction
    assert one.probability == pytest.approx(expected, abs=0.02)  # 3·sqrt(p(1−p)/n) of 4000
    assert one.negative_damping == pytest.approx(1 - fraction, abs=0.025)
    assert one.negative_damping > 0.2
    low, high = np.quantile(root[has], [0.1, 0.9]) * OMEGA
    assert low < one.velocity[2] < high
    assert notes_on_resonance(one, "2 N")[0]["fraction"] == one.negative_damping


def test_constant_damping_remains_where_extrapolation_is_negative():
    """Every extrapolated draw becomes negative first: only those with constant damping remain."""
    one = found(curves(falling(0.9), load=0.5 * OMEGA * DELTA), ratio=2.0)
    edge = np.searchsorted(AMPLITUDE, 1.0)
    assert one.probability == 0.0  # 0.5/0.1 times the largest amplitude is beyond twice it
    assert one.negative_damping == pytest.approx(0.95, abs=1e-3)
    near = found(curves(falling(0.6), load=0.43 * OMEGA * DELTA), ratio=2.0)
    constant = 1 - 0.6 * AMPLITUDE[edge]
    assert near.probability == 1.0
    np.testing.assert_allclose(near.velocity, 0.43 / constant * OMEGA, rtol=1e-9)


def test_a_self_excited_structure_may_have_negative_damping():
    one = found(curves(falling(0.9), load=0.5 * OMEGA * DELTA), self_excited=True)
    assert (one.probability, one.negative_damping) == (0.0, 0.0)
    assert not where_in_words(one)["sure"]


def test_a_singular_covariance_has_a_root():
    some = np.array([[1.0, 2.0], [2.0, 4.0]])
    root = covariance_root(some)
    np.testing.assert_allclose(root @ root.T, some, atol=1e-12)


def test_curves_through_points_predict_their_own_resonances():
    level, omega, force, velocity = exact(per_level=9)
    fit = sj.identify_backbone(stated(level, omega, force, velocity), modes())
    plain, day = (
        sj.identify.predicted_resonance(
            fit.fit, 2.2, of=sj.identify.new_level(fit.fit, 2.2, day=day)
        )
        for day in (None, sj.identify.DayToDay(frequency=0.01))
    )
    (tip,) = sj.identify.resonances(fit.backbone, modes(), 2.2)
    # 300 amplitudes and a spline between them.
    assert plain.frequency[2] == pytest.approx(tip.frequency, rel=2e-3)
    assert plain.velocity[2] == pytest.approx(tip.velocity, rel=1e-2)
    assert day.another_day
    assert where_in_words(day)["another_day"]
    widened, before = (np.diff(np.log(d.frequency[[1, 3]]))[0] / 2 for d in (day, plain))
    # 1 % of frequency is 2 % of stiffness; the smaller displacement then hardens less.
    stiff, soft = (Level(2.2, 0.0, 0.02 * sign, 0.0).resonance()[0] for sign in (0.5, -0.5))
    expected = np.log(stiff / soft)
    # 4000 draws determine half a 68 % range to 2 %.
    assert np.sqrt(widened**2 - before**2) == pytest.approx(expected, rel=0.06)


def test_the_95_per_cent_interval_covers_a_withheld_level():
    """Levels with known 1σ of stiffness and damping, predicted by a line through the others."""
    rng, std = np.random.default_rng(1), np.array([0.0, 0.0, 0.004, 0.08])
    at, inside = np.array([0.3, 0.5, 0.7, 0.85, 1.0]), np.zeros(2)
    columns = np.column_stack([np.ones(5), at])
    along = np.column_stack([np.ones(len(AMPLITUDE)), AMPLITUDE])
    for _ in range(_TESTS):
        errors = std[2:] * rng.normal(size=(5, 2))
        truth = columns @ np.array([[OMEGA**2, DELTA], [0.3 * OMEGA**2, 0.8 * DELTA]])
        measured = truth * np.exp(errors)
        keep = np.arange(5) != 4
        values, shape = np.zeros((len(AMPLITUDE), 2)), np.zeros((len(AMPLITUDE), 2, 4))
        for k in range(2):  # least squares weighted by the levels' own errors
            weighted = columns[keep] / (std[2 + k] * measured[keep, k])[:, None]
            root = np.linalg.cholesky(np.linalg.inv(weighted.T @ weighted))
            best = root @ root.T @ weighted.T @ np.full(4, 1 / std[2 + k])
            values[:, k], shape[:, k, 2 * k : 2 * k + 2] = along @ best, along @ root
        squared, damping = measured[4]
        speed = at[4] * np.sqrt(squared)
        known = KnownCurves(values, shape, speed * damping, np.zeros(4))
        one = found(known, new=NewLevel(std))
        pair = ((one.frequency, np.sqrt(squared)), (one.velocity, speed))
        inside += [each[0] < value < each[-1] for each, value in pair]
    # Binomial: 120 of 0.95 scatter by 2 %.
    assert np.all((inside >= 0.90 * _TESTS) & (inside <= 0.99 * _TESTS))


def values_of(ratio, std):
    """A backbone at three amplitudes with some damping."""
    one, ratio = np.ones(3), np.array(ratio)
    columns = (np.array([0.0, 1.0, 2.0]), 100 * one, one, ratio, np.array(std), ratio, one)
    return BackboneValues(*map(jnp.asarray, columns))


def test_negative_damping_is_noted_once_with_its_probability():
    assert notes_on_negative_damping(values_of([0.01, 0.02, 0.03], [0.001] * 3)) == []
    (note,) = notes_on_negative_damping(values_of([-6.6e-5, 1e-3, 1e-5], [1.9e-4] * 3))
    assert (note["velocity"], note["ratio"], note["ratio_std"]) == (0.0, -6.6e-5, 1.9e-4)
    # Φ(6.6/19) by a table of the normal distribution.
    assert note["probability"] == pytest.approx(0.636, abs=1e-3)
    (note,) = notes_on_negative_damping(values_of([0.1, -0.1, 0.1], [0.0] * 3))
    assert note["probability"] == 1


def test_a_distribution_is_a_table():
    one = found(curves(np.full(len(AMPLITUDE), DELTA)))
    table = one.to_pandas()
    assert list(table["quantile"]) == list(QUANTILES)
    assert table["frequency_hz"][2] == pytest.approx(OMEGA / (2 * np.pi))
    assert repr(one).startswith("ResonanceDistribution: 5 quantiles")
