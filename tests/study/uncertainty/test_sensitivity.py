"""Sobol' indices against closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest

from snrmjax.model.modes import linear_modes
from snrmjax.model.potential import polynomial_potential
from snrmjax.model.structures import structure
from snrmjax.study.uncertainty.followed_motions import response_quantities
from snrmjax.study.uncertainty.quantities import FunctionQuantities
from snrmjax.study.uncertainty.sensitivity import sobol_indices
from snrmjax.study.uncertainty.uncertain_inputs import correlated_inputs, uncertain_inputs

A, B = 7.0, 0.1  # of Ishigami's function


def ishigami():
    """sin x₁ + a sin² x₂ + b x₃⁴ sin x₁, x uniform from −π to π; and a constant."""
    inputs = correlated_inputs(
        ["x1", "x2", "x3"], np.zeros(3), np.eye(3) * np.pi**2 / 3, ["uniform"] * 3
    )

    def function(x):
        first = jnp.sin(x[0])
        return jnp.stack([first + A * jnp.sin(x[1]) ** 2 + B * x[2] ** 4 * first, 0.0 * x[0]])

    return FunctionQuantities(function, inputs, ("ishigami", "constant"), ("", ""))


PI4 = np.pi**4
VARIANCE = A**2 / 8 + B * PI4 / 5 + B**2 * PI4**2 / 18 + 0.5
FIRST = np.array([0.5 * (1 + B * PI4 / 5) ** 2, A**2 / 8, 0.0]) / VARIANCE
TOTAL = FIRST + np.array([1.0, 0.0, 1.0]) * B**2 * PI4**2 * 8 / 225 / VARIANCE


def test_sobol_indices_of_ishigamis_function():
    found = sobol_indices(ishigami(), base_rows=2048, seed=1)
    # The intervals are of random members; those of a sequence are well inside them. Exact indices:
    # Ishigami & Homma (1990), 0.3139, 0.4424, 0.
    assert pytest.approx([0.3139, 0.4424, 0.0], abs=5e-5) == FIRST
    assert np.all(np.abs(found.first[0] - FIRST) < found.first_half_width[0] + 1e-12)
    assert np.all(np.abs(found.total[0] - TOTAL) < found.total_half_width[0])
    assert np.all(found.total_half_width[0] < 0.07)
    assert found.variance[0] == pytest.approx(VARIANCE, rel=0.02)
    assert np.all(np.isnan(found.first[1]))
    assert found.to_xarray()["total"].sel(quantity="ishigami", input="x3") == pytest.approx(
        TOTAL[2], abs=0.02
    )
    assert "first" in repr(found)


def test_shares_of_a_linear_peak_are_those_of_a_product_of_lognormal_numbers():
    # |V| = F φ b/(2ζω): with s² the variance of the logarithms, Var = (e^Σs² − 1) E², the first
    # index of input i is (e^s_i² − 1)/(e^Σs² − 1).
    model = structure(linear_modes([2.0], [0.02], [[1.2]], [1.5]), polynomial_potential({}, 1))
    std = {"mode_1.natural_frequency": 0.1, "mode_1.damping_ratio": 0.004, "force_n": 0.012}
    inputs = uncertain_inputs(model, std, force=0.12, marginals=dict.fromkeys(std, "lognormal"))
    peak = response_quantities(
        model, inputs, 0.5, 8.0, kinds=("phase_resonance",), harmonic_order=1
    )
    square = np.log1p((inputs.std / inputs.mean) ** 2)
    whole = np.exp(square.sum())
    found = sobol_indices(peak, base_rows=256)
    first = np.expm1(square) / (whole - 1)
    assert np.all(np.abs(found.first[1] - first) < found.first_half_width[1])
    assert found.rows.tolist() == [256, 256]
    # The frequency is ω alone.
    assert found.total[0] == pytest.approx([1.0, 0.0, 0.0], abs=0.02)


def test_rows_without_a_value_are_left_out_whole():
    inputs = correlated_inputs(["x", "y"], [1.0, 0.0], np.eye(2))
    root = FunctionQuantities(lambda x: jnp.sqrt(x[:1]) + x[1], inputs, ("root",), ("",))
    found = sobol_indices(root, base_rows=256)
    # x is drawn twice in a row, P(x < 0) = 0.1587: (1 − 0.1587)² of the rows stay.
    assert found.rows[0] / 256 == pytest.approx(0.708, abs=0.02)
    assert any("29 % of the base rows are left out" in note for note in found.notes)


def test_correlated_inputs_and_wrong_numbers_are_refused():
    both = correlated_inputs(["x", "y"], [0, 0], [[1, 0.5], [0.5, 1]])
    total = FunctionQuantities(lambda x: x[:1] + x[1], both, ("sum",), ("",))
    with pytest.raises(ValueError, match="independent inputs only"):
        sobol_indices(total)
    with pytest.raises(ValueError, match="a power of two from 16 on, but is 100"):
        sobol_indices(ishigami(), base_rows=100)
