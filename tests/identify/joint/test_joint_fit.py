"""The joint fit against states on known curves, and its notes where data do not suffice."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares
from truths.exact_states import (
    CONSTANT,
    LEVELS,
    NOISE,
    OMEGA,
    PARTICIPATION,
    SHAPE,
    TRUE,
    damping,
    exact,
    modes,
    noisy,
    squared,
    stated,
    truth_at,
)
from truths.joint_fits import exact_fit, noisy_fit
from truths.sizes import repeats

import snrmjax as sj
from snrmjax.identify.curves.families import parse_family
from snrmjax.identify.joint.free_unknowns import (
    packed_unknowns,
    padded_problem,
    whitened_slopes,
)
from snrmjax.identify.joint.joint_fit import fit_jointly
from snrmjax.identify.test_model import priors
from snrmjax.io.joint_results import (
    read_joint_fit,
    summarise_fit,
    write_fitted_backbone,
    write_joint_fit,
    write_next,
)

SPEEDS = np.linspace(0.2, 0.9, 8)
# Level errors of the gain only.
ALIKE = {"level_phase_std": 1e-9, "level_frequency_std": 1e-7, "level_damping_std": 1e-11}


def kinds(fit):
    """The kinds of a fit's notes."""
    return {one.kind for one in fit.notes}


@pytest.fixture(scope="module")
def fit():
    """A fit of noisy states with level errors."""
    return noisy_fit()


def test_a_structure_states_the_errors_of_its_levels(fit):
    stated = sj.model.structure(modes(), level_gain_std=0.01)
    found = fit_jointly(noisy(1, gain=0.01), stated, **TRUE)
    np.testing.assert_array_equal(found.covariance, fit.covariance)


def test_stated_level_errors_of_frequency_and_damping_enter_the_fit():
    """At 500 rad/s, 1σ of 1 rad/s is 0.4 % of the stiffness; 0.0006 of 0.012 is 5 %."""
    model = sj.model.structure(modes(), level_frequency_std=1.0, level_damping_std=6e-4)
    found = fit_jointly(noisy(2), model, **TRUE)
    np.testing.assert_allclose(found.prior.new_level[2:], [0.004, 0.05], rtol=1e-12)
    plain = fit_jointly(noisy(2), modes(), **TRUE)
    wide, narrow = (sj.identify.fitted_values(f, SPEEDS) for f in (found, plain))
    # In mid-range the curve averages five levels of 1 rad/s each.
    middle = np.min(np.asarray(wide.natural_frequency_std))
    assert middle == pytest.approx(1 / np.sqrt(5), rel=0.1)
    # Unstated level errors are estimated from the states alone.
    assert np.all(np.asarray(narrow.natural_frequency_std) < 0.7 / np.sqrt(5))
    stiff = sj.model.linear_modes([OMEGA], [0.0], [[2.0]], [3.0])
    with pytest.raises(ValueError, match="level_damping_std"):
        fit_jointly(noisy(2), sj.model.structure(stiff, level_damping_std=1e-3), **TRUE)


def test_exact_states_reproduce_the_curves():
    found = exact_fit()
    values = sj.identify.fitted_values(found, SPEEDS)
    want = truth_at(SPEEDS)
    # The solver stops at 1e-10 of the whitened residuals, whose unit is a per cent.
    np.testing.assert_allclose(values.natural_frequency**2, want[0], rtol=1e-9)
    np.testing.assert_allclose(values.modal_damping, want[1], rtol=1e-8)
    assert found.converged
    assert float(jnp.max(jnp.abs(found.residuals))) < 1e-6


def test_the_curves_are_those_of_the_orthogonal_distance_fit():
    """SciPy on the records themselves: every state's true displacement is one more unknown."""
    data = noisy(1, gain=0.01)
    # Level errors of the gain only, as in the SciPy model.
    fit = fit_jointly(data, sj.model.structure(modes(), level_gain_std=0.01, **ALIKE), **TRUE)
    level, omega, force = (np.asarray(a) for a in (data.level, data.frequency, data.force))
    velocity = np.asarray(data.velocity)[:, 0]
    recorded, largest = np.abs(velocity) / omega, fit.unknowns.squared_frequency.scale
    fast = fit.unknowns.modal_damping.scale
    unit = np.concatenate([np.full(2, OMEGA**2), np.full(2, 10.0), np.full(LEVELS, 0.01)])
    # The frequency exponents are unknowns, and the noise is known to 10 %.
    exponents = np.array(priors.OFF_RESONANCE)
    natural = omega**2 + (1j * omega * CONSTANT * force / velocity).real
    detuning, of_noise = np.log(omega / np.sqrt(natural)), np.asarray(fit.data.std)[0, :3]
    assert of_noise / [NOISE[one] for one in ("force", "velocity", "phase")] == pytest.approx(
        of_noise[0] / NOISE["force"], rel=1e-9
    )
    force_std, velocity_std, phase_std = of_noise

    def errors(point):
        (a, b, c, d, *gain), x = unit * point[:9], recorded * np.exp(velocity_std * point[11:])
        stiffness_exponent, damping_exponent = exponents * point[9:11]
        stiffness = a + b * (x / largest) ** 2 * (1 + stiffness_exponent * detuning) - omega**2
        needed = stiffness + 1j * omega * (c + d * x * omega / fast) * (
            1 + damping_exponent * detuning
        )
        return np.concatenate(
            [
                point[11:] + np.array(gain)[level] / velocity_std,
                np.angle(1j * velocity.conj() / needed) / phase_std,
                np.log(np.abs(needed) * x / CONSTANT / force) / force_std,
                point[4:11],
            ]
        )

    own = [fit.unknowns.squared_frequency.parameters, fit.unknowns.modal_damping.parameters]
    found = np.concatenate([*map(np.asarray, own), 0.01 * np.asarray(fit.unknowns.level)[:, 0]])
    start = np.r_[found / unit, np.zeros(2 + len(level))]
    best = least_squares(errors, start, x_scale="jac")
    std = np.sqrt(np.diag(fit.covariance))[:4]
    assert best.success
    # With 1 % noise, slopes at the uncorrected records would be off by 0.2.
    assert np.max(np.abs(unit[:4] * best.x[:4] - found[:4]) / std) < 0.02


def test_gain_offset_and_phase_of_the_instruments_are_estimated():
    level, omega, force, velocity = exact()
    gain, offset, phase = 0.4, 0.02, np.radians(5.0)
    volts = (force - offset) / gain
    data = sj.measure.steady_states(
        level,
        omega,
        np.full(len(level), np.nan),
        velocity * np.exp(1j * phase),
        velocity_std=0.01 * np.abs(velocity),
        phase_std=np.full((len(level), 1), 0.01),
        drive=volts,
    )
    free = ("force_gain", "force_offset", "instrument_phase")
    found = fit_jointly(data, modes(), free=free, **TRUE)
    unknowns = found.unknowns
    assert float(jnp.exp(unknowns.log_force_gain)) == pytest.approx(gain, rel=1e-6)
    assert float(unknowns.force_offset) * volts.min() == pytest.approx(offset, rel=1e-5)
    assert float(unknowns.instrument_phase) == pytest.approx(phase, rel=1e-6)
    assert found.drive_known_only
    want = truth_at(SPEEDS)
    values = sj.identify.fitted_values(found, SPEEDS)
    np.testing.assert_allclose(values.modal_damping, want[1], rtol=1e-6)


def test_bands_are_as_wide_as_the_scatter_of_repeated_tests():
    want = truth_at(SPEEDS)
    z, tests = [], repeats(16, 40)
    for seed in range(tests):
        found = fit_jointly(noisy(seed, gain=0.01), modes(), level_gain_std=0.01, **TRUE)
        values = sj.identify.fitted_values(found, SPEEDS)
        first = (values.natural_frequency**2 - want[0]) / (
            2 * values.natural_frequency * values.natural_frequency_std
        )
        second = (values.modal_damping - want[1]) / values.modal_damping_std
        z.append(np.stack([first, second]))
    z = np.array(z)
    # Errors of neighbouring amplitudes are correlated: about three independent per curve.
    independent = 3 * tests
    assert np.all(np.abs(z.mean(axis=(0, 2))) < 3 / np.sqrt(independent))
    rms = np.sqrt(np.mean(z**2, axis=(0, 2)))
    assert np.all(np.abs(rms - 1) < 3 / np.sqrt(2 * independent))
    inside = np.mean(np.abs(z) < 1.96, axis=(0, 2))
    assert np.all(inside > 0.95 - 3 * np.sqrt(0.95 * 0.05 / independent))


def test_without_the_levels_error_bands_are_too_narrow():
    narrow, wide = (
        sj.identify.fitted_values(
            fit_jointly(
                noisy(1, gain=0.01),
                sj.model.structure(modes(), level_gain_std=gain, **ALIKE),
                **TRUE,
            ),
            SPEEDS,
        ).modal_damping_std
        for gain in (1e-9, 0.01)
    )
    assert np.all(np.asarray(narrow) < 0.9 * np.asarray(wide))


def test_padding_states_and_levels_carry_no_information(fit):
    n, room = len(fit.data.level), padded_problem(fit.problem)
    assert len(room.data.level) > n
    assert room.data.n_levels > fit.data.n_levels
    alone = packed_unknowns(fit.unknowns, fit.free, fit.data.n_levels)
    found = whitened_slopes(fit.packed(), room, n)
    for mine, own in zip(found, whitened_slopes(alone, fit.problem, n), strict=True):
        np.testing.assert_allclose(mine, own, atol=1e-12 * np.abs(own).max())
    assert found[0].shape == (n, 2, len(fit.names()))
    # Whitened by the states' errors.
    scaled = found[1] * np.asarray(fit.data.std)[:, None, :]
    unit = np.broadcast_to(np.eye(2), (n, 2, 2))
    np.testing.assert_allclose(scaled @ np.swapaxes(scaled, 1, 2), unit, atol=1e-9)


def test_order_of_rows_and_units_do_not_matter(fit):
    level, omega, force, velocity = (np.asarray(part) for part in _columns(noisy(1, gain=0.01)))
    order = np.random.default_rng(0).permutation(len(level))
    mixed = stated(level[order], omega[order], force[order], velocity[order])
    again = fit_jointly(mixed, modes(), level_gain_std=0.01, **TRUE)
    values, others = (sj.identify.fitted_values(f, SPEEDS) for f in (fit, again))
    # The stated noise is relative to the exact magnitudes in one and to the noisy in the other: the
    # same numbers here, so only rounding and convergence tolerance remain.
    np.testing.assert_allclose(others.natural_frequency, values.natural_frequency, rtol=1e-6)
    np.testing.assert_allclose(others.modal_damping_std, values.modal_damping_std, rtol=1e-2)
    in_mm = sj.model.linear_modes([500.0], [0.012], [[2000.0]], [3.0])
    thousand = stated(level, omega, force, 1e3 * velocity)
    scaled = fit_jointly(thousand, in_mm, level_gain_std=0.01, **TRUE)
    others = sj.identify.fitted_values(scaled, 1e3 * SPEEDS)
    np.testing.assert_allclose(others.natural_frequency, values.natural_frequency, rtol=1e-6)


def _columns(data):
    return data.level, data.frequency, data.force, data.velocity[:, 0]


def test_exceeded_noise_is_reported_and_widens_the_bands():
    quiet = fit_jointly(noisy(2), modes(), **TRUE)
    loud = fit_jointly(noisy(2, scale=3.0), modes(), **TRUE)
    assert abs(quiet.noise.scale - 1) < 3 * quiet.noise.scale_std
    assert "noise_exceeded" not in kinds(quiet)
    assert abs(loud.noise.scale - 3) < 3 * loud.noise.scale_std
    assert "noise_exceeded" in kinds(loud)
    ratio = sj.identify.fitted_values(loud, SPEEDS).modal_damping_std / (
        sj.identify.fitted_values(quiet, SPEEDS).modal_damping_std
    )
    # The noise is known to a tenth, and larger noise hides larger level errors.
    assert np.all((ratio > 3.0 * 0.75) & (ratio < 9.0))
    silent = fit_jointly(noisy(2, scale=0.3), modes(), **TRUE)
    assert "noise_overstated" in kinds(silent)


def test_unstated_noise_is_estimated():
    level, omega, force, velocity = (np.asarray(part) for part in _columns(noisy(4)))
    found = fit_jointly(sj.measure.steady_states(level, omega, force, velocity), modes(), **TRUE)
    # One relative error for velocity, phase and force, larger off resonance.
    assert 0.3 * NOISE["velocity"] < found.noise.scale < 1.5 * NOISE["velocity"]
    assert not found.noise.stated


@pytest.mark.long
def test_levels_without_scatter_are_not_reported():
    # Misfit of the initial curves must not be taken for level errors. Four kinds of error are
    # tested at 1 % each: three detections in ten tests have a probability of 1 in 150.
    found = 0
    for seed in range(10):
        fit = fit_jointly(noisy(seed, per_level=25), modes())
        found += bool(np.any(fit.noise.level_std > 0))
    assert found <= 2


def test_level_scatter_is_estimated_and_enters_the_bands():
    level, omega, _, velocity = exact()
    rng = np.random.default_rng(8)
    shift = 0.004 * rng.normal(size=LEVELS)[level]
    # A level error of the stiffness: the same motion needs another force at another phase.
    x = np.abs(velocity) / omega
    needed = squared(x) * (1 + shift) - omega**2 + 1j * omega * damping(np.abs(velocity))
    moved = np.abs(needed) * x / 6.0
    phasor = 1j * omega * 6.0 * moved / needed
    own = np.exp(0.01 * rng.normal(size=len(level)) + 0.012j * rng.normal(size=len(level)))
    found = fit_jointly(stated(level, omega, moved, phasor * own), modes(), **TRUE)
    # The 1σ of five levels is known to about a third.
    assert 0.4 < found.noise.level_std[2] / 0.004 < 2.0
    assert "levels_differ" in kinds(found)
    steady = fit_jointly(noisy(8), modes(), **TRUE)
    assert steady.noise.level_std[2] == 0
    wide, narrow = (
        sj.identify.fitted_values(f, SPEEDS).natural_frequency_std for f in (found, steady)
    )
    assert np.all(np.asarray(wide) > np.asarray(narrow))


def test_two_levels_with_different_gains_are_detected():
    level, omega, force, velocity = exact()
    two = level >= LEVELS - 2
    level, omega, force, velocity = (a[two] for a in (level, omega, force, velocity))
    rng = np.random.default_rng(3)
    gain = np.where(level == LEVELS - 1, 0.05, -0.05)
    own = 0.1 * (0.01 * rng.normal(size=len(level)) + 0.012j * rng.normal(size=len(level)))

    def fitted(shared):
        data = stated(level, omega, force, velocity * np.exp(shared + own))
        return fit_jointly(data, modes(), **TRUE)

    def largest_error(fit):
        values = sj.identify.fitted_values(fit, SPEEDS[3:])
        off = np.asarray(values.natural_frequency**2 - truth_at(SPEEDS[3:])[0])
        return np.max(np.abs(off / (2 * values.natural_frequency * values.natural_frequency_std)))

    found = fitted(gain)
    # Two gains 10 % apart have a sample standard deviation of 10 %/√2.
    assert found.noise.level_std[0] == pytest.approx(0.1 / np.sqrt(2), rel=0.3)
    assert "few_levels" in kinds(found)
    # Student's t of two degrees of freedom: 4.303 where a normal has 1.960.
    wider = 4.303 / 1.960 * found.noise.level_std[0]
    assert float(found.prior.new_level[0]) == pytest.approx(wider, rel=1e-3)
    assert largest_error(found) < 2
    np.testing.assert_array_equal(fitted(0.0).noise.level_std, 0.0)


@pytest.mark.long
def test_auto_is_smooth_and_holds_the_truth():
    found = fit_jointly(noisy(3, gain=0.002, per_level=15), modes(), level_gain_std=0.002)
    assert found.unknowns.squared_frequency.kind == "smoothing_spline"
    values = sj.identify.fitted_values(found, SPEEDS)
    off = np.asarray(values.natural_frequency) - np.sqrt(truth_at(SPEEDS)[0])
    assert np.max(np.abs(off / np.asarray(values.natural_frequency_std))) < 4


def test_the_simplest_order_in_the_band_is_selected():
    """ω̃² = ω²(1 + (x/x₀)²) takes one term plus a constant; damping grows with velocity."""
    named = {"backbone": "polynomial", "damping": "viscous_quadratic"}
    found = fit_jointly(noisy(3, gain=0.01), modes(), level_gain_std=0.01, **named)
    assert found.unknowns.squared_frequency.label == "polynomial:1@displacement"


def test_a_smooth_curve_has_the_requested_knots():
    found = fit_jointly(noisy(3), modes(), backbone="smoothing_spline:9", damping="auto")
    assert found.unknowns.squared_frequency.label == "smoothing_spline:9@displacement"
    again = fit_jointly(noisy(3), modes(), backbone=found.unknowns.squared_frequency.label)
    assert again.unknowns.squared_frequency.label == found.unknowns.squared_frequency.label
    with pytest.raises(ValueError, match="the same number, not 5 and 9"):
        fit_jointly(noisy(3), modes(), backbone="smoothing_spline:9", damping="smoothing_spline:5")


def test_an_exponent_at_its_bound_does_not_inflate_the_bands():
    # The true power is one, the upper bound of microslip; this noise favours a larger one.
    data = noisy(3, gain=0.01)
    free, fixed = (
        fit_jointly(data, modes(), level_gain_std=0.01, **{**TRUE, "damping": damping})
        for damping in ("viscous_microslip@velocity", "viscous_quadratic@velocity")
    )
    at = np.linspace(0.1, 1.0, 5) * fixed.largest[1]
    wide, narrow = (sj.identify.fitted_values(fit, at) for fit in (free, fixed))
    ratio = np.asarray(wide.natural_frequency_std / narrow.natural_frequency_std)
    assert np.all((ratio > 0.99) & (ratio < 1.1))
    ratio = np.asarray(wide.modal_damping_std / narrow.modal_damping_std)
    assert np.all((ratio > 0.99) & (ratio < 1.7))  # one more parameter where data are few
    off = (wide.modal_damping - narrow.modal_damping) / narrow.modal_damping_std
    assert np.max(np.abs(off)) < 0.5


def test_a_robust_loss_ignores_an_outlier():
    level, omega, force, velocity = (np.asarray(part) for part in _columns(noisy(5)))
    force = force.copy()
    force[13] *= 1.3
    data = stated(level, omega, force, velocity)
    plain, robust = (fit_jointly(data, modes(), robust=r, **TRUE) for r in (False, True))
    clean = fit_jointly(noisy(5), modes(), **TRUE)
    curves = [
        np.asarray(sj.identify.fitted_values(f, SPEEDS).modal_damping)
        for f in (plain, robust, clean)
    ]
    gaps = [np.max(np.abs(curve - curves[2])) for curve in curves]
    assert gaps[1] < 0.5 * gaps[0]
    assert robust.data.weight[13] < 0.3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"backbone": "cubic"}, "no family"),
        ({"backbone": "spline:x"}, "whole number"),
        ({"damping": "constant@force"}, "amplitude must be"),
        ({"free": ["gain"]}, "force_gain"),
        ({"backbone": "spline:60", "damping": "spline:60"}, "states"),
    ],
)
def test_wrong_settings_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        fit_jointly(noisy(1), modes(), **{**TRUE, **change})


def test_too_few_states_are_refused_and_one_level_is_noted():
    level, omega, force, velocity = (np.asarray(part) for part in _columns(noisy(1)))
    with pytest.raises(ValueError, match="at least 3"):
        fit_jointly(stated(level[:2], omega[:2], force[:2], velocity[:2]), modes(), **TRUE)
    one = level == 4
    data = stated(level[one], omega[one], force[one], velocity[one])
    found = fit_jointly(data, modes(), backbone="polynomial:1", damping="constant")
    (note,) = (one for one in found.notes if one.kind == "few_levels")
    # Student's t of two degrees of freedom, as for two levels, times the prior scale.
    assert note["assumed"] == pytest.approx(
        [4.303 / 1.960 * prior.scale for prior in priors.LEVELS], rel=1e-2
    )
    # The band includes the level error of damping, which one level cannot show.
    values = sj.identify.fitted_values(found, np.array([found.largest[1]]))
    assert values.damping_ratio_std / values.damping_ratio > 0.98 * note["assumed"][3]


def test_states_on_one_side_and_levels_of_one_amplitude_are_noted():
    level, omega, force, velocity = (np.asarray(part) for part in _columns(noisy(1)))
    families = {"backbone": "polynomial:1", "damping": "polynomial:1"}

    def notes(keep, index):
        data = stated(index, omega[keep], force[keep], velocity[keep])
        return kinds(fit_jointly(data, modes(), **families))

    one_side = np.flatnonzero(np.angle(velocity) > np.radians(10))
    assert "one_side_of_resonance" in notes(one_side, level[one_side])
    twice = np.concatenate([np.flatnonzero(level == 3)] * 2)
    both = {"one_side_of_resonance", "levels_of_one_amplitude"}
    assert both & notes(twice, np.repeat([0, 1], len(twice) // 2)) == {"levels_of_one_amplitude"}
    assert not both & notes(np.arange(len(level)), level)


@pytest.mark.parametrize("families", [TRUE, pytest.param({}, marks=pytest.mark.long)])
def test_noise_far_above_the_stated_one_does_not_bias_the_fit(families):
    """Errors of 8 % and 5°, stated as an eighth of that: records are corrected nevertheless."""
    understated = fit_jointly(noisy(2, scale=8.0), modes(), **families)
    values, want = sj.identify.fitted_values(understated, SPEEDS), truth_at(SPEEDS)
    off = np.asarray(values.natural_frequency - np.sqrt(want[0])) / values.natural_frequency_std
    assert np.max(np.abs(off)) < 3
    off = np.asarray(values.modal_damping - want[1]) / values.modal_damping_std
    assert np.max(np.abs(off)) < 3


def test_uncertain_other_modes_widen_the_bands_and_leave_exact_curves():
    """A second, linear mode, its frequency and damping with a stated 1σ."""

    def two(std):
        return sj.model.linear_modes(
            *([OMEGA, 3 * OMEGA], [0.012, 0.01], [[SHAPE, 2.0]], [PARTICIPATION, 3.0]), std=std
        )

    level, omega, force, velocity = exact()
    other = np.asarray(sj.model.residual_velocity(two(None), jnp.asarray(omega), force))[:, 0]
    data = stated(level, omega, force, velocity + other)
    known, uncertain = (
        fit_jointly(data, two(std), level_gain_std=0.01)
        for std in (None, sj.model.LinearModesStd([0.0, 300.0], [0.0, 0.0]))
    )
    alone = fit_jointly(stated(level, omega, force, velocity), modes(), level_gain_std=0.01)
    own, values, wide = (
        sj.identify.fitted_values(fit, SPEEDS) for fit in (alone, known, uncertain)
    )
    for name in ("natural_frequency", "modal_damping"):
        without = np.asarray(getattr(own, name))
        # Stated relative errors are of magnitudes that include the other mode.
        for found, most in ((values, 0.05), (wide, 0.3)):
            off = np.asarray(getattr(found, name)) - without
            assert np.max(np.abs(off / np.asarray(getattr(found, f"{name}_std")))) < most
    # An error of a fifth of its frequency changes its flexibility, and so the natural frequency.
    assert np.max(wide.natural_frequency_std / values.natural_frequency_std) > 1.02
    index = uncertain.names().index("linear_0")
    assert 0 < uncertain.covariance[index, index] <= 1 + 1e-9


def test_parse_family():
    assert parse_family("spline:5@velocity") == ("spline", 5, "velocity")
    assert parse_family("auto") == ("auto", None, None)


def test_a_fit_round_trips_through_its_file(fit, tmp_path):
    write_joint_fit(tmp_path / "fit.json", fit)
    again = read_joint_fit(tmp_path / "fit.json")
    assert again.names() == fit.names()
    assert [str(note) for note in again.notes] == [str(note) for note in fit.notes]
    np.testing.assert_array_equal(again.covariance, fit.covariance)
    one, other = (sj.identify.fitted_values(f, SPEEDS) for f in (fit, again))
    for first, second in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(first, second)
    other = json.loads((tmp_path / "fit.json").read_text())
    other["fit"]["class"] = "os:PathLike"  # a file can only construct the parts of a fit
    (tmp_path / "other.json").write_text(json.dumps(other))
    with pytest.raises(ValueError, match="not made of"):
        read_joint_fit(tmp_path / "other.json")
    (tmp_path / "no.json").write_text('{"format": 0}')
    with pytest.raises(ValueError, match="no joint fit"):
        read_joint_fit(tmp_path / "no.json")
    (tmp_path / "no.json").write_text("{")
    with pytest.raises(ValueError, match="no joint fit"):
        read_joint_fit(tmp_path / "no.json")


def test_tables_and_summary(fit, tmp_path):
    write_fitted_backbone(tmp_path / "backbone.csv", fit)
    rows = np.genfromtxt(tmp_path / "backbone.csv", delimiter=",", names=True)
    assert len(rows) == 200
    assert rows["velocity_m_s"][0] == 0
    assert rows["natural_frequency_hz"][0] == pytest.approx(500 / (2 * np.pi), rel=1e-2)
    advice = sj.next_measurements(fit, 2)
    write_next(tmp_path / "next.csv", advice)
    header, *lines = (tmp_path / "next.csv").read_text().splitlines()
    assert header == "rank,force_n,frequency_hz,expected_band_ratio,reason"
    assert len(lines) == 2
    summary = summarise_fit(fit, sj.identify.fitted_response(fit, 1.0))
    named = summary["parameters"]["damping.viscous"]
    assert named["unit"] == "1/s"
    assert abs(named["value"] - 12) < 4 * named["std"]
    assert len(summary["covariance"]) == len(summary["parameters"])
    assert summary["backbone"] == "polynomial:1@displacement"
    json.dumps(summary)
