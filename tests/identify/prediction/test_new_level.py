"""Errors of a level that was not measured: finite differences, and withheld levels."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from truths import joint_fits
from truths.exact_states import (
    CONSTANT,
    GAIN,
    TRUE,
    damping,
    driven,
    exact,
    modes,
    squared,
    stated,
)
from truths.levels_with_errors import drawn_levels, measured

import snrmjax as sj
from snrmjax.identify.prediction.new_level import DayToDay, NewLevel, new_level
from snrmjax.model.modes import OptionalModalData

FORCE = 1.5  # N, below the folds


@pytest.fixture(scope="module")
def fit():
    """Known curves of five levels, which agree."""
    return joint_fits.exact_fit()


def with_levels(fit, std, deviations=None):
    """The fit with these 1σ and deviations of level errors."""
    of_levels = jnp.asarray(std)
    prior = dataclasses.replace(fit.prior, level=of_levels, new_level=of_levels)
    scattering = dataclasses.replace(fit, problem=dataclasses.replace(fit.problem, prior=prior))
    if deviations is None:
        return scattering
    return eqx.tree_at(lambda f: f.unknowns.level, scattering, jnp.asarray(deviations))


def bisected(force, stiffness=0.0, loss=0.0, phase=0.0):
    """Ω and velocity where a level with such errors records its resonance."""
    low, high = 0.0, 5e-3
    for _ in range(100):
        x = 0.5 * (low + high)
        omega, own = np.sqrt(squared(x) * (1 + stiffness)), squared(x) * (1 + stiffness)
        for _ in range(20):
            modal_damping = damping(x * omega) * (1 + loss)
            omega = np.sqrt(own + omega * modal_damping * np.tan(phase))
        needed = x * omega * modal_damping / np.cos(phase) / CONSTANT
        low, high = (x, high) if needed < force else (low, x)
    return np.array([omega, x * omega])


@pytest.mark.parametrize(
    ("kind", "error"), [(0, None), (1, "phase"), (2, "stiffness"), (3, "loss")]
)
def test_the_band_of_a_resonance_includes_level_errors(fit, kind, error):
    std = 0.02 * (np.arange(4) == kind)
    tip = sj.identify.fitted_response(fit, FORCE, of=NewLevel(std))[0].resonances[0]
    step = 1e-5
    if error is None:  # the gain of a record of the velocity
        slope = np.array([0.0, tip.velocity])
    else:
        ends = [bisected(FORCE, **{error: sign * step}) for sign in (1, -1)]
        slope = (ends[0] - ends[1]) / (2 * step)
    own = sj.identify.fitted_response(fit, FORCE, of=sj.identify.WITHOUT_LEVEL_ERRORS)[
        0
    ].resonances[0]
    expected = np.hypot(0.02 * slope, [own.frequency_std, own.velocity_std])
    # Bisection to 1e-15 over a step of 1e-5.
    np.testing.assert_allclose([tip.frequency_std, tip.velocity_std], expected, rtol=1e-6)


def test_a_distribution_of_small_errors_is_the_band(fit):
    level = NewLevel(np.array([0.01, 0.01, 0.004, 0.02]))
    tip = sj.identify.fitted_response(fit, FORCE, of=level)[0].resonances[0]
    one = sj.identify.predicted_resonance(fit, FORCE, of=level)
    for drawn, value, std in (
        (one.frequency, tip.frequency, tip.frequency_std),
        (one.velocity, tip.velocity, tip.velocity_std),
    ):
        assert drawn[2] == pytest.approx(value, abs=0.06 * std)  # 3·1.25/sqrt(4000)
        assert (drawn[3] - drawn[1]) / 1.989 == pytest.approx(std, rel=0.05)  # 2·0.9945
    assert one.probability == 1.0


def test_the_band_along_a_response_includes_level_errors(fit):
    std = np.array([0.0, 0.0, 0.0, 0.05])
    wide, plain = (
        sj.identify.fitted_response(fit, FORCE, of=NewLevel(one))[0] for one in (std, 0 * std)
    )
    tip = int(np.argmax(np.abs(plain.velocity)))
    extra = np.sqrt(wide.velocity_std**2 - plain.velocity_std**2) / np.abs(plain.velocity)
    # At resonance the velocity falls with the damping, far off resonance it does not.
    assert 0.03 < extra[tip] < 0.06
    assert extra[10] < 0.01


@pytest.mark.long
def test_a_recorded_force_adds_the_gain_error(fit):
    driven_fit = sj.fit_jointly(driven(60), modes(), **TRUE)
    force = 2.0
    given, recorded = (new_level(driven_fit, force, as_recorded=one) for one in (False, True))
    assert given.drive is None
    assert recorded.drive == pytest.approx(force / GAIN, rel=0.02)
    alone, wide = (
        sj.identify.fitted_response(driven_fit, force, of=one)[0].resonances[0]
        for one in (given, recorded)
    )
    assert wide.frequency == pytest.approx(alone.frequency, rel=1e-9)
    # Damping and gain are correlated: the drive leaves less uncertainty than the force.
    drawn = sj.identify.predicted_resonance(driven_fit, force, of=recorded)
    half = 0.5 * (drawn.velocity[3] - drawn.velocity[1])
    assert half == pytest.approx(wide.velocity_std, rel=0.06)
    assert wide.velocity_std != pytest.approx(alone.velocity_std, rel=0.01)


def test_another_day_adds_its_own_errors(fit):
    some = with_levels(fit, [0.01, 0.0, 0.004, 0.03])
    day = DayToDay(frequency=0.001, damping=0.04, gain=0.02)
    one = new_level(some, FORCE, day=day)
    expected = np.hypot([0.01, 0, 0.004, 0.03], [0.02, 0, 0.002, 0.04])
    np.testing.assert_allclose(one.std, expected, rtol=1e-12)
    assert one.another_day
    assert not new_level(some, FORCE).another_day
    assert sj.identify.predicted_resonance(some, FORCE, of=one).holds["another_day"]


def test_level_errors_correlated_with_force_are_a_trend(fit):
    level = np.asarray(fit.data.level)
    force = np.array([np.median(np.asarray(fit.data.force)[level == k]) for k in range(5)])
    rising = np.zeros((5, 4))
    rising[:, 0] = 2.0 * (force - force.mean()) + 0.01 * np.array([1, -1, 0, 1, -1])
    rising[:, 3] = [1, -1, 0.5, -0.5, 0.2]
    some = with_levels(fit, [0.02, 0.0, 0.0, 0.05], rising)
    one = new_level(some, 2 * force.max())
    (trend,) = one.trends
    line = np.polynomial.Polynomial.fit(force, 0.02 * rising[:, 0], 1)
    assert trend.kind == "gain"
    assert trend.there == pytest.approx(line(2 * force.max()), rel=1e-9)
    assert trend.last - trend.first == pytest.approx(0.02 * 2 * np.ptp(force), rel=0.02)
    assert trend.p_value < 1e-4
    assert one.std[0] == pytest.approx(np.hypot(0.02, trend.there), rel=1e-9)
    assert one.std[3] == pytest.approx(0.05)


@pytest.mark.long
def test_left_out_levels_lie_inside_their_bands():
    """One of six levels, the top one too, predicted by the others' fit: 100 tests."""
    inside = []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        levels = drawn_levels(rng)
        out, data = int(rng.integers(6)), measured(levels, rng)
        fit = sj.fit_jointly(data.select(np.asarray(data.level) != out), modes(), **TRUE)
        one = sj.identify.predicted_resonance(fit, levels[out].force)
        pair = zip((one.frequency, one.velocity), levels[out].resonance(), strict=True)
        inside.append([each[0] < value < each[-1] for each, value in pair])
    fraction = np.mean(inside, axis=0)
    # Binomial: 2 % of 100. Student's factor for five levels widens beyond 95 %.
    assert np.all((fraction >= 0.90) & (fraction <= 0.99))


@pytest.mark.long
def test_a_force_at_another_point_scales_the_participation():
    # A second linear mode at 900 rad/s; the test's force acts at `a`, where the modes' shapes are
    # those of the sensor, the predicted one at `b`.
    shape = {"a": [2.0, 1.1], "b": [-0.7, 3.0]}
    second, tested, force = (900.0, 0.01), np.prod(np.array([shape["a"]] * 2), axis=0), 6.0

    def second_mode(omega, constant):
        return 1j * omega * constant / (second[0] ** 2 - omega**2 + 2j * np.prod(second) * omega)

    level, omega, forces, own = exact()
    forces = forces * CONSTANT / tested[0]
    linear = sj.model.linear_modes(
        *([500.0, 900.0], [0.012, 0.01], [shape["a"]], shape["a"]),
        sensors=("a",),
        optional=OptionalModalData({"b": shape["b"]}),
    )
    velocity = own + forces * second_mode(omega, tested[1])
    data = stated(level, omega, forces, velocity, sensors=("a",))
    fit = sj.fit_jointly(data, linear, **TRUE)
    elsewhere = new_level(fit, force, at="b")
    curve = sj.identify.fitted_response(fit, force, of=elsewhere)[0]
    x, omega = np.asarray(curve.amplitude), np.asarray(curve.frequency)
    of_mode = -1.4 / (squared(x) - omega**2 + 1j * omega * damping(x * omega))
    np.testing.assert_allclose(force * np.abs(of_mode), x, rtol=1e-4)
    expected = force * (1j * omega * of_mode + second_mode(omega, 3.3))
    np.testing.assert_allclose(curve.velocity, expected, rtol=1e-3)
    (tip,) = curve.resonances
    np.testing.assert_allclose(
        [tip.frequency, tip.frequency * tip.amplitude], bisected(force * 1.4 / CONSTANT), rtol=1e-6
    )
    further = sj.identify.predicted_resonance(fit, force, of=elsewhere)
    np.testing.assert_allclose(further.frequency[2], tip.frequency, rtol=1e-4)
    with pytest.raises(ValueError, match="'c', where the modes have no shape"):
        new_level(fit, force, at="c")
