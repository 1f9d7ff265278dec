"""Uncertainty by derivatives and by members, against closed forms and the roots of polynomials."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize, stats

from snrmjax.model.modes import linear_modes
from snrmjax.model.parameters import parameter_values, with_parameters
from snrmjax.model.potential import polynomial_potential
from snrmjax.model.structures import structure
from snrmjax.study.uncertainty.followed_motions import response_quantities
from snrmjax.study.uncertainty.moments import (
    first_order,
    first_order_error,
    members_statistics,
    monte_carlo,
    normal_members,
    quasi_monte_carlo,
    scatter_limit,
    second_order,
    sobol_members,
)
from snrmjax.study.uncertainty.propagation import PropagationSettings, propagate_uncertainty
from snrmjax.study.uncertainty.quantities import Expansion, FunctionQuantities, MemberStatus
from snrmjax.study.uncertainty.uncertain_inputs import correlated_inputs, uncertain_inputs

OMEGA, RATIO, SHAPE, LOAD, FORCE, CUBIC = 2.0, 0.02, 1.2, 1.5, 0.12, 1.2
HERTZ = 2 * np.pi
PEAK_INPUTS = ("mode_1.natural_frequency", "mode_1.damping_ratio", "force_n")


def oscillator(cubic=0.0):
    """One mode with the restoring force ω²q + `cubic` q³."""
    modes = linear_modes([OMEGA], [RATIO], [[SHAPE]], [LOAD])
    return structure(modes, polynomial_potential({"1111": cubic / 4} if cubic else {}, 1))


def lognormal_inputs(stds, correlation=0.0):
    """ω, ζ and force with relative standard deviations, the first two correlated."""
    mean = np.array([OMEGA, RATIO, FORCE])
    spread = np.diag((mean * stds) ** 2)
    spread[0, 1] = spread[1, 0] = correlation * np.sqrt(spread[0, 0] * spread[1, 1])
    return correlated_inputs(PEAK_INPUTS, mean, spread, ["lognormal"] * 3)


def quadratic(linear, curved):
    return Expansion(np.zeros(1), np.array([[linear]]), np.array([[[curved]]]))


@pytest.mark.long
def test_a_linear_peak_is_lognormal_by_every_method():
    # |V| is largest at Ω = ω, exactly, and there F φ b/(2ζω): a product of lognormal numbers.
    inputs = lognormal_inputs(np.array([0.02, 0.2, 0.1]), correlation=-0.5)
    peak = response_quantities(oscillator(), inputs, 1.0, 4.0, kinds=("peak",), harmonic_order=1)
    relative = inputs.covariance / np.outer(inputs.mean, inputs.mean)
    of_logs = np.log1p(relative)
    power = np.array([-1.0, -1.0, 1.0])
    std = np.sqrt(power @ of_logs @ power)
    median = np.exp(np.log(inputs.mean) - 0.5 * np.diag(of_logs))
    nominal = SHAPE * LOAD * median[2] / (2 * median[0] * median[1])
    expansion, slope = peak.expansion(), power @ np.linalg.cholesky(of_logs)
    assert peak.names == ("peak_frequency_hz", "peak_velocity_m_s")
    # Newton's method to 1e-12, and the derivatives of a peak, whose |V| is flat: 1e-8.
    assert expansion.value[1] == pytest.approx(nominal, rel=1e-10)
    np.testing.assert_allclose(expansion.gradient[1], nominal * slope, rtol=1e-8)
    np.testing.assert_allclose(expansion.hessian[1], nominal * np.outer(slope, slope), rtol=1e-7)
    found = propagate_uncertainty(peak, PropagationSettings(members=512, traced=8))
    assert found.status_counts[int(MemberStatus.FOUND)].tolist() == [1024] * 2
    assert (found.traced.members, found.traced.differ.tolist()) == (8, [0] * 2)
    exact = stats.lognorm(s=std, scale=nominal)
    truth = np.array([exact.mean(), exact.std(), *exact.ppf([0.025, 0.975])])
    for method in (0, 1):
        miss = (found.statistics[2 + method, :, 1] - truth) / found.standard_error[method, :, 1]
        # Four independent statistics within 4 standard errors; of 8 scramblings Student's t is
        # wider: 4 of it is beyond its 99 % range. The percentage points of few members are biased.
        assert np.abs(miss).max() < 4.0
    # First order: mean and deviation are those of its own formula, and it says that it is wrong.
    assert found.statistics[0, 1, 1] == pytest.approx(nominal * std, rel=1e-8)
    assert found.statistics[1, 0, 1] == pytest.approx(nominal * (1 + std**2 / 2), rel=1e-7)
    assert any("first order is wrong for peak_velocity_m_s by" in note for note in found.notes)
    assert not any("peak_frequency_hz by" in note for note in found.notes)


def backbone(values):
    """Ω (Hz) and |V| at phase resonance of one harmonic: ω² + ¾γ(v/Ω)² = Ω², v = F b/(2ζω)."""
    omega, ratio, cubic, force = values
    speed = force * LOAD / (2 * ratio * omega)
    square = 0.5 * (omega**2 + jnp.sqrt(omega**4 + 3 * cubic * speed**2))
    return jnp.stack([jnp.sqrt(square) / HERTZ, SHAPE * speed])


def duffing_inputs(relative):
    """All four numbers of the oscillator, normally distributed; `potential.1111` is γ/4."""
    model = oscillator(CUBIC)
    own = parameter_values(model)
    names = ["mode_1.natural_frequency", "mode_1.damping_ratio", "potential.1111"]
    std = {name: relative * own[name] for name in names} | {"force_n": relative * FORCE}
    return model, uncertain_inputs(model, std, force=FORCE)


@pytest.mark.long
def test_gradient_and_hessian_of_a_duffing_resonance_are_those_of_its_backbone():
    model, inputs = duffing_inputs(0.03)
    found = response_quantities(
        model, inputs, 1.0, 8.0, kinds=("phase_resonance",), harmonic_order=1
    )

    def truth(z):
        own = inputs.values(z)
        return backbone(own * jnp.array([1.0, 1.0, 4.0, 1.0]))

    expansion, zero = found.expansion(), jnp.zeros(4)
    # Newton's method to 1e-12, scaled; each derivative of a well-posed root keeps 1e-9 of it.
    np.testing.assert_allclose(expansion.value, truth(zero), rtol=1e-11)
    np.testing.assert_allclose(expansion.gradient, jax.jacobian(truth)(zero), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(expansion.hessian, jax.hessian(truth)(zero), rtol=1e-8, atol=1e-11)
    z = normal_members(16, 4, seed=1)
    np.testing.assert_allclose(found.members(z).values, jax.vmap(truth)(z), rtol=1e-10)


def duffing_folds(values):
    """Frequencies (rad/s) of the folds of one harmonic, the upper one first, by polynomials.

    With u the squared amplitude and w = Ω², G = u((ω² − w + κu)² + 4ζ²ω²w) − (F b)² and ∂G/∂u
    vanish at folds: the second is a quadratic in u.
    """
    omega, ratio, quarter, force = values
    k, drag, square = 3 * quarter, 4 * ratio**2 * omega**2, omega**2

    def amplitude(w, sign):
        inside = 4 * (square - w) ** 2 - 3 * ((square - w) ** 2 + drag * w)
        return np.where(
            inside > 0, (2 * (w - square) + sign * np.sqrt(np.abs(inside))) / (3 * k), np.nan
        )

    def left(w, sign):
        u = amplitude(w, sign)
        return u * ((square - w + k * u) ** 2 + drag * w) - (force * LOAD) ** 2

    found, grid = [], np.linspace(square, 16 * square, 40001)
    for sign in (1, -1):
        rest = left(grid, sign)
        for k_ in np.flatnonzero(rest[:-1] * rest[1:] <= 0):
            found.append(optimize.brentq(left, grid[k_], grid[k_ + 1], args=(sign,), xtol=1e-14))
    return np.sqrt(sorted(found, reverse=True))


@pytest.mark.long
def test_folds_are_followed_to_where_they_merge_and_no_further():
    model, inputs = duffing_inputs(0.25)
    found = response_quantities(model, inputs, 1.0, 8.0, kinds=("fold",), harmonic_order=1)
    assert found.names[0::2] == ("fold_1_frequency_hz", "fold_2_frequency_hz")
    z = normal_members(160, 4, seed=3)
    values = np.asarray(jax.vmap(inputs.values)(z))
    members, possible = found.members(z), np.all(values[:, [0, 1, 3]] > 0, axis=1)
    ceased = 0
    for row, own, theirs, status in zip(
        values, members.values, possible, members.status, strict=True
    ):
        if row[2] <= 0:  # a softening member has other folds: below ω
            continue
        truth = duffing_folds(row) if theirs else np.zeros(0)
        ceased += theirs and len(truth) == 0
        kind = MemberStatus.FOUND if len(truth) else MemberStatus.CEASED
        assert set(status.tolist()) == {int(kind if theirs else MemberStatus.IMPOSSIBLE)}
        if len(truth):
            # brentq to 1e-14 of w, Newton's method to 1e-12.
            np.testing.assert_allclose(own[0::2] * HERTZ, truth, rtol=1e-9)
    assert ceased > 10


@pytest.mark.long
def test_another_highest_peak_is_seen_by_whole_curves():
    modes = linear_modes([2.0, 5.0], [0.02, 0.02], [[1.0, 1.0]], [1.0, 2.2])
    model = structure(modes, polynomial_potential({}, 2))
    inputs = uncertain_inputs(
        model, {"mode_1.damping_ratio": 0.2 * RATIO}, marginals={"mode_1.damping_ratio": "uniform"}
    )
    peak = response_quantities(
        model, inputs, 1.0, 8.0, force=1.0, kinds=("peak",), harmonic_order=1
    )
    found = propagate_uncertainty(peak, PropagationSettings(members=64, traced=24))
    ratios = np.asarray(jax.vmap(inputs.values)(normal_members(64, 1, seed=0)[:24]))[:, 0]

    def highest(ratio):
        omega = np.linspace(1.8, 5.4, 20001)
        lines = zip((2.0, 5.0), (ratio, 0.02), (1.0, 2.2), strict=True)
        total = sum(b * 1j * omega / (w**2 - omega**2 + 2j * r * w * omega) for w, r, b in lines)
        return omega[np.argmax(np.abs(total))]

    other = sum(highest(ratio) > 3.0 for ratio in ratios)
    assert 3 < other < 21
    assert found.traced.differ.tolist() == [other, other]
    assert any(f"{other} have another event in place of peak" in note for note in found.notes)


@pytest.mark.long
def test_a_peak_that_merges_is_replaced_by_the_one_that_is_left():
    # Two modes in opposite phase have no antiresonance between them: with much damping of the
    # first one its peak becomes a shoulder of the second one's.
    rates, gains, first, second = np.array([2.0, 2.2]), np.array([1.0, -0.7]), 0.04, 0.03
    modes = linear_modes(rates, [first, second], [gains], [1.0, 1.0])
    model = structure(modes, polynomial_potential({}, 2))
    name = "mode_1.damping_ratio"
    inputs = uncertain_inputs(model, {name: first}, marginals={name: "lognormal"})
    peak = response_quantities(
        model, inputs, 1.0, 8.0, force=1.0, kinds=("peak",), harmonic_order=1
    )
    z = normal_members(48, 1, seed=0)
    found = peak.members(z)
    omega = np.linspace(1.8, 2.6, 80001)
    replaced = 0
    for (ratio,), values, status in zip(
        np.asarray(jax.vmap(inputs.values)(z)), found.values, found.status, strict=True
    ):
        damping = np.array([ratio, second])[:, None]
        apart = rates[:, None] ** 2 - omega**2 + 2j * damping * rates[:, None] * omega
        height = np.abs(np.sum(gains[:, None] * 1j * omega / apart, axis=0))
        inside = height[1:-1]
        tops = np.flatnonzero((inside > height[:-2]) & (inside > height[2:])) + 1
        alone = len(tops) == 1 and omega[tops[0]] > 2.1
        replaced += alone
        kind = MemberStatus.REPLACED if alone else MemberStatus.FOUND
        assert set(status.tolist()) == {int(kind)}
        # The grid's step is 1e-5 rad/s; a top of half width 2e-3 is lower beside by (1e-5/2e-3)²/2.
        assert values[0] * HERTZ == pytest.approx(omega[tops[0]], abs=2e-5)
        assert values[1] == pytest.approx(height[tops[0]], rel=2e-5)
    assert 3 < replaced < 45


def test_second_order_is_exact_for_a_quadratic():
    # z + ½rz² = ½r((z + 1/r)² − 1/r²): a noncentral χ² of one degree of freedom.
    r = 0.6
    exact = stats.ncx2(1, 1 / r**2, scale=r / 2, loc=-0.5 / r)
    mean, std, lower, upper = second_order(quadratic(1.0, r))[:, 0]
    assert (mean, std) == pytest.approx((exact.mean(), exact.std()), rel=1e-12)
    # The percentage points of 2^14 members of a sequence: 1/members over the density there.
    assert (lower, upper) == pytest.approx(exact.ppf([0.025, 0.975]), abs=5e-3)
    assert first_order(quadratic(1.0, r))[:, 0] == pytest.approx(
        [0.0, 1.0, *stats.norm.ppf([0.025, 0.975])], abs=1e-12
    )


def test_the_scatter_of_a_ten_per_cent_error_is_that_of_the_noncentral_chi_square():
    r = 0.6

    def excess(s, row):
        exact = stats.ncx2(1, 1 / (r * s) ** 2, scale=r * s / 2, loc=-0.5 / (r * s))
        mine = np.array([0.0, 1.0, *stats.norm.ppf([0.025, 0.975])])[:, None]
        theirs = np.array([exact.mean(), exact.std(), *exact.ppf([0.025, 0.975])])[:, None]
        return first_order_error(mine, theirs)[row, 0] - 0.1

    truth = [optimize.brentq(excess, 0.02, 3.0, args=(row,)) for row in range(3)]
    # Mean and deviation are exact; the range's end moves with the members' 1e-3.
    limit = scatter_limit(quadratic(1.0, r))[:, 0]
    assert limit[:2] == pytest.approx(truth[:2], rel=1e-3)
    assert limit[2] == pytest.approx(truth[2], rel=2e-2)
    assert np.all(np.isinf(scatter_limit(quadratic(1.0, 0.0))))


def test_standard_errors_are_those_of_repeated_studies():
    exact = stats.lognorm(s=0.5)
    truth = np.array([exact.mean(), exact.std(), *exact.ppf([0.025, 0.975])])
    runs = np.exp(0.5 * np.random.default_rng(5).standard_normal((200, 1600, 1)))
    found = [monte_carlo(run) for run in runs]
    spread = np.std([one.statistics[:, 0] for one in found], axis=0)
    stated = np.sqrt(np.mean([one.standard_error[:, 0] ** 2 for one in found], axis=0))
    # 200 runs know a deviation to 5 %; three of them, and the bias of Maritz and Jarrett's error
    # of the upper point, which 40 members are beyond.
    assert stated == pytest.approx(spread, rel=0.2)
    sobol = [np.exp(0.5 * sobol_members(64, 1, 8, seed)) for seed in range(60)]
    found = [quasi_monte_carlo(run) for run in sobol]
    miss = np.array([one.statistics[:, 0] - truth for one in found])
    stated = np.sqrt(np.mean([one.standard_error[:, 0] ** 2 for one in found], axis=0))
    rms = np.sqrt(np.mean(miss**2, axis=0))
    # 60 studies know their rms to 9 %, each states an error from 8 values; and a percentage point
    # of 64 members between two strata has some bias.
    assert rms == pytest.approx(stated, rel=0.35)
    # Far below Monte Carlo's error of the mean, as the sequence is for.
    assert stated[0] < 0.2 * truth[1] / np.sqrt(512)


def test_members_without_a_value_are_counted_and_left_out():
    inputs = correlated_inputs(["x"], [1.0], [[1.0]])
    root = FunctionQuantities(lambda x: jnp.sqrt(x), inputs, ("root",), ("",))
    found = propagate_uncertainty(root, PropagationSettings(members=256, seed=4))
    z = np.concatenate([normal_members(256, 1, 4), sobol_members(32, 1, 8, 4).reshape(-1, 1)])
    bad = int(np.sum(z < -1))
    assert found.status_counts[:, 0].tolist() == [512 - bad, 0, 0, 0, bad]
    kept = np.sqrt(1 + z[256:][z[256:] >= -1])
    assert found.statistics[3, 0, 0] == pytest.approx(kept.mean(), rel=1e-12)
    assert any(f"{bad} of 512 members" in note for note in found.notes)
    data = found.to_xarray()
    assert data["value"].sel(approach="quasi_monte_carlo", statistic="mean", quantity="root") == (
        pytest.approx(kept.mean(), rel=1e-12)
    )
    assert "members: 512, found of each quantity at least" in repr(found)
    assert np.all(np.isnan(members_statistics(np.full((9, 1), np.nan))))


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        (PropagationSettings(members=100), "a power of two"),
        (PropagationSettings(members=32), "64 or more"),
        (PropagationSettings(members=128, scramblings=1), "two or more"),
    ],
)
def test_members_that_make_no_sequence_are_refused(settings, complaint):
    inputs = correlated_inputs(["x"], [1.0], [[1.0]])
    with pytest.raises(ValueError, match=complaint):
        propagate_uncertainty(FunctionQuantities(jnp.sin, inputs, ("y",), ("",)), settings)


def of_loss_factor(values):
    """The oscillator with half the loss factor as its damping ratio."""
    return with_parameters(oscillator(), ["mode_1.damping_ratio"], values["loss_factor"][None] / 2)


@pytest.mark.long
def test_inputs_may_be_other_numbers_than_the_model_has():
    # |V| is largest at Ω = ω, there F φ b/(2ζω) = F φ b/(ηω): by 1/η, whose derivatives are known.
    inputs = correlated_inputs(["loss_factor"], [2 * RATIO], [[(0.1 * RATIO) ** 2]])
    model, ends = oscillator(), (1.0, 4.0)
    own = {"force": FORCE, "kinds": ("peak",), "harmonic_order": 1}
    found = response_quantities(model, inputs, *ends, **own, model_of=of_loss_factor)
    value, gradient, hessian = found.expansion()
    relative = np.array([gradient[1, 0], hessian[1, 0, 0]]) / value[1]
    # Relative 1σ of 0.05: −0.05 and 2 · 0.05². Rounding of a solved motion's second derivative.
    np.testing.assert_allclose(relative, [-0.05, 2 * 0.05**2], rtol=1e-7)
    np.testing.assert_allclose(gradient[0] / value[0], 0.0, atol=1e-9)
    z = np.array([[-2.0], [2.0]])
    peaks = found.members(z).values[:, 1]
    np.testing.assert_allclose(peaks / value[1], 1 / (1 + 0.05 * z[:, 0]), rtol=1e-9)


def test_what_cannot_be_followed_is_refused():
    model = oscillator()
    inputs = uncertain_inputs(model, {"mode_1.damping_ratio": 0.002})
    ends = (1.0, 4.0)
    with pytest.raises(ValueError, match="`force` must be given once"):
        response_quantities(model, inputs, *ends)
    with pytest.raises(ValueError, match="must be out of"):
        response_quantities(model, inputs, *ends, force=FORCE, kinds=("summit",))
    with pytest.raises(ValueError, match="the nominal response has no fold from"):
        response_quantities(model, inputs, *ends, force=FORCE, kinds=("fold",), harmonic_order=1)
    strange = correlated_inputs(["mode_9.damping_ratio"], [0.1], [[1e-4]])
    with pytest.raises(ValueError, match="mode_9"):
        response_quantities(model, strange, *ends, force=FORCE)
