"""Uncertainty by derivatives, against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize, stats

from snrmjax.model.modes import linear_modes
from snrmjax.model.parameters import parameter_values, with_parameters
from snrmjax.model.potential import polynomial_potential
from snrmjax.model.structures import structure
from snrmjax.study.uncertainty.propagation import (
    first_order,
    first_order_error,
    propagate_uncertainty,
    scatter_limit,
    second_order,
)
from snrmjax.study.uncertainty.quantities import (
    Quantities,
    function_quantities,
    response_quantities,
)
from snrmjax.study.variations import Discrete, LogNormal, MultivariateNormal, Normal

OMEGA, RATIO, SHAPE, LOAD, FORCE, CUBIC = 2.0, 0.02, 1.2, 1.5, 0.12, 1.2
HERTZ = 2 * np.pi
PEAK_INPUTS = ("mode_1.natural_frequency", "mode_1.damping_ratio", "force_n")


def oscillator(cubic=0.0):
    """One mode with the restoring force ω²q + `cubic` q³."""
    modes = linear_modes([OMEGA], [RATIO], [[SHAPE]], [LOAD])
    return structure(modes, polynomial_potential({"1111": cubic / 4} if cubic else {}, 1))


def quadratic(linear, curved):
    return Quantities(np.zeros(1), [[linear]], [[[curved]]], ("y",))


@pytest.mark.long
def test_a_linear_peak_is_that_of_a_lognormal_number():
    # |V| is largest at Ω = ω, exactly, and there F φ b/(2ζω): a product of lognormal numbers.
    mean, relative = np.array([OMEGA, RATIO, FORCE]), np.array([0.02, 0.2, 0.1])
    each = zip(PEAK_INPUTS, mean.tolist(), (relative * mean).tolist(), strict=True)
    varied = [LogNormal(*one) for one in each]
    peak = response_quantities(oscillator(), varied, 1.0, 4.0, kinds=("peak",), harmonic_order=1)
    of_logs = np.log1p(relative**2)
    std = np.sqrt(of_logs.sum())
    median = mean * np.exp(-0.5 * of_logs)
    nominal = SHAPE * LOAD * median[2] / (2 * median[0] * median[1])
    slope = np.array([-1.0, -1.0, 1.0]) * np.sqrt(of_logs)
    assert peak.names == ("peak_frequency_hz", "peak_velocity_m_s")
    # Newton's method to 1e-12, and the derivatives of a peak, whose |V| is flat: 1e-8.
    assert peak.value[1] == pytest.approx(nominal, rel=1e-10)
    np.testing.assert_allclose(peak.gradient[1], nominal * slope, rtol=1e-8)
    np.testing.assert_allclose(peak.hessian[1], nominal * np.outer(slope, slope), rtol=1e-7)
    found = propagate_uncertainty(peak)
    # Mean and deviation are those of the formulas, and a note reports the first-order error.
    assert found.statistics[0, 1, 1] == pytest.approx(nominal * std, rel=1e-8)
    assert found.statistics[1, 0, 1] == pytest.approx(nominal * (1 + std**2 / 2), rel=1e-7)
    assert [(one.kind, one["quantity"]) for one in found.notes] == [
        ("first_order_wrong", "peak_velocity_m_s")
    ]
    data = found.to_xarray()["value"]
    own = data.sel(approach="first_order", statistic="std", quantity="peak_velocity_m_s")
    assert own == pytest.approx(nominal * std, rel=1e-8)
    assert "uncertainty of 2 quantities by 3 numbers" in repr(found)


def backbone(values):
    """Ω (Hz) and |V| at phase resonance of one harmonic: ω² + ¾γ(v/Ω)² = Ω², v = F b/(2ζω)."""
    omega, ratio, cubic, force = values
    speed = force * LOAD / (2 * ratio * omega)
    square = 0.5 * (omega**2 + jnp.sqrt(omega**4 + 3 * cubic * speed**2))
    return jnp.stack([jnp.sqrt(square) / HERTZ, SHAPE * speed])


@pytest.mark.long
def test_gradient_and_hessian_of_a_duffing_resonance_are_those_of_its_backbone():
    model = oscillator(CUBIC)
    own = parameter_values(model)
    names = ["mode_1.natural_frequency", "mode_1.damping_ratio", "potential.1111", "force_n"]
    mean = np.array([*(own[name] for name in names[:3]), FORCE])
    # The first two vary together; `potential.1111` is γ/4.
    correlation = np.eye(4)
    correlation[0, 1] = correlation[1, 0] = 0.6
    pair = MultivariateNormal(
        names[:2], mean[:2], (0.03**2 * np.outer(mean, mean) * correlation)[:2, :2]
    )
    varied = [pair, *(Normal(n, m, 0.03 * m) for n, m in zip(names[2:], mean[2:], strict=True))]
    found = response_quantities(
        model, varied, 1.0, 8.0, kinds=("phase_resonance",), harmonic_order=1
    )

    def truth(z):
        values = jnp.concatenate([pair.at(z[:2]), mean[2:] * (1 + 0.03 * z[2:])])
        return backbone(values * jnp.array([1.0, 1.0, 4.0, 1.0]))

    zero = jnp.zeros(4)
    # Newton's method to 1e-12, scaled; each derivative of a well-posed root keeps 1e-9 of it.
    np.testing.assert_allclose(found.value, truth(zero), rtol=1e-11)
    np.testing.assert_allclose(found.gradient, jax.jacobian(truth)(zero), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.hessian, jax.hessian(truth)(zero), rtol=1e-8, atol=1e-11)


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
    assert scatter_limit(quadratic(0.0, 1.0))[0, 0] == 0.0


def test_a_function_is_propagated_by_its_own_derivatives():
    varied = [Normal("x", 1.0, 0.2), Normal("y", 2.0, 0.1)]
    found = function_quantities(lambda x: jnp.stack([x[0] * x[1], x[0] ** 2]), varied, ["a", "b"])
    # By z with 1σ of 0.2 and 0.1.
    np.testing.assert_allclose(found.value, [2.0, 1.0], rtol=1e-15)
    np.testing.assert_allclose(found.gradient, [[0.4, 0.1], [0.4, 0.0]], atol=1e-15)
    np.testing.assert_allclose(found.hessian[0], [[0.0, 0.02], [0.02, 0.0]], atol=1e-15)
    np.testing.assert_allclose(found.hessian[1], [[0.08, 0.0], [0.0, 0.0]], atol=1e-15)


def of_loss_factor(values):
    """The oscillator with half the loss factor as its damping ratio."""
    return with_parameters(oscillator(), ["mode_1.damping_ratio"], values["loss_factor"][None] / 2)


@pytest.mark.long
def test_inputs_may_be_other_numbers_than_the_model_has():
    # |V| is largest at Ω = ω, there F φ b/(2ζω) = F φ b/(ηω): by 1/η, whose derivatives are known.
    varied = [Normal("loss_factor", 2 * RATIO, 0.1 * RATIO)]
    model, ends = oscillator(), (1.0, 4.0)
    own = {"force": FORCE, "kinds": ("peak",), "harmonic_order": 1}
    found = response_quantities(model, varied, *ends, **own, model_of=of_loss_factor)
    relative = np.array([found.gradient[1, 0], found.hessian[1, 0, 0]]) / found.value[1]
    # Relative 1σ of 0.05: −0.05 and 2 · 0.05². Rounding of a solved motion's second derivative.
    np.testing.assert_allclose(relative, [-0.05, 2 * 0.05**2], rtol=1e-7)
    np.testing.assert_allclose(found.gradient[0] / found.value[0], 0.0, atol=1e-9)


def test_what_cannot_be_followed_is_refused():
    model, ends = oscillator(), (1.0, 4.0)
    varied = [Normal("mode_1.damping_ratio", RATIO, 0.002)]
    with pytest.raises(ValueError, match="`force` must be given once"):
        response_quantities(model, varied, *ends)
    with pytest.raises(ValueError, match="must be out of"):
        response_quantities(model, varied, *ends, force=FORCE, kinds=("summit",))
    with pytest.raises(ValueError, match="the nominal response has no fold from"):
        response_quantities(model, varied, *ends, force=FORCE, kinds=("fold",), harmonic_order=1)
    with pytest.raises(ValueError, match="mode_9"):
        response_quantities(model, [Normal("mode_9.damping_ratio", 0.1, 0.01)], *ends, force=FORCE)
    with pytest.raises(ValueError, match="varies twice"):
        response_quantities(model, varied * 2, *ends, force=FORCE)
    with pytest.raises(ValueError, match="derivatives need a distribution"):
        response_quantities(model, [Discrete("mode_1.damping_ratio", [0.1])], *ends, force=FORCE)
