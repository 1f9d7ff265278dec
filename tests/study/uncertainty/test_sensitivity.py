"""Sobol' indices of a study's members, against closed forms."""

import json

import numpy as np
import pytest
import xarray as xr

from snrmjax.study.sampling import Sampling, drawn_members
from snrmjax.study.uncertainty.sensitivity import sobol_indices
from snrmjax.study.variations import LogNormal, MultivariateNormal, Normal, Uniform

A, B = 7.0, 0.1  # of Ishigami's function
PI4 = np.pi**4
VARIANCE = A**2 / 8 + B * PI4 / 5 + B**2 * PI4**2 / 18 + 0.5
FIRST = np.array([0.5 * (1 + B * PI4 / 5) ** 2, A**2 / 8, 0.0]) / VARIANCE
TOTAL = FIRST + np.array([1.0, 0.0, 1.0]) * B**2 * PI4**2 * 8 / 225 / VARIANCE
X = tuple(Uniform(name, -np.pi, np.pi) for name in ("x1", "x2", "x3"))


def studied(varied, members, *functions, seed=1, method="saltelli"):
    """The data set of a study whose outputs are functions of the varied quantities."""
    table = drawn_members(varied, Sampling(method, members), seed)
    outputs = {f"y{k}": (("member",), one(table)) for k, one in enumerate(functions)}
    names = [{"names": one.names} for one in varied]
    described = {"study": {"variations": names, "sampling": {"method": method}}}
    return xr.Dataset(outputs, attrs={"study": json.dumps(described)})


def ishigami(x):
    """sin x₁ + a sin² x₂ + b x₃⁴ sin x₁, x uniform from −π to π."""
    return np.sin(x[:, 0]) * (1 + B * x[:, 2] ** 4) + A * np.sin(x[:, 1]) ** 2


def test_sobol_indices_of_ishigamis_function():
    data = studied(X, 5 * 2048, ishigami, lambda x: 0.0 * x[:, 0])
    found = sobol_indices(data, seed=1)
    # The intervals are of random members; those of a sequence are well inside them. Exact indices:
    # Ishigami & Homma (1990), 0.3139, 0.4424, 0.
    assert pytest.approx([0.3139, 0.4424, 0.0], abs=5e-5) == FIRST
    assert np.all(np.abs(found.first[0] - FIRST) < found.first_half_width[0] + 1e-12)
    assert np.all(np.abs(found.total[0] - TOTAL) < found.total_half_width[0])
    assert np.all(found.total_half_width[0] < 0.07)
    assert found.variance[0] == pytest.approx(VARIANCE, rel=0.02)
    assert np.all(np.isnan(found.first[1]))
    assert found.to_xarray()["total"].sel(quantity="y0", input="x3") == pytest.approx(
        TOTAL[2], abs=0.02
    )
    assert "first" in repr(found)


def test_fractions_of_a_product_of_lognormal_numbers():
    # With s² the variance of the logarithms the first index of input i is
    # (e^s_i² − 1)/(e^Σs² − 1).
    std = np.array([0.05, 0.2, 0.1])
    varied = [LogNormal(name, 1.0, one) for name, one in zip("abc", std, strict=True)]
    found = sobol_indices(studied(varied, 5 * 256, lambda x: np.prod(x, axis=1)))
    square = np.log1p(std**2)
    first = np.expm1(square) / (np.exp(square.sum()) - 1)
    assert np.all(np.abs(found.first[0] - first) < found.first_half_width[0])
    assert found.rows.tolist() == [256]


def test_quantities_that_vary_together_are_one_input():
    pair = MultivariateNormal(["a", "b"], [0.0, 0.0], [[1.0, 0.8], [0.8, 1.0]])
    found = sobol_indices(studied((pair, Normal("c", 0.0, 1.0)), 4 * 1024, lambda x: x.sum(axis=1)))
    # Var(a + b) = 3.6, Var(c) = 1.
    assert found.input_names == ("a, b", "c")
    np.testing.assert_allclose(found.first[0], [3.6 / 4.6, 1 / 4.6], atol=0.02)
    np.testing.assert_allclose(found.total[0], found.first[0], atol=0.02)


def test_rows_without_a_value_are_left_out_whole():
    varied = (Normal("x", 1.0, 1.0), Normal("y", 0.0, 1.0))
    with np.errstate(invalid="ignore"):
        data = studied(varied, 4 * 256, lambda x: np.sqrt(x[:, 0]) + x[:, 1])
    found = sobol_indices(data)
    # x is drawn twice in a row, P(x < 0) = 0.1587: (1 − 0.1587)² of the rows stay.
    assert found.rows[0] / 256 == pytest.approx(0.708, abs=0.02)
    (note,) = found.notes
    assert (note.kind, note["output"]) == ("rows_without_value", "y0")
    assert note["fraction"] == pytest.approx(1 - found.rows[0] / 256)


def test_other_members_are_refused():
    with pytest.raises(ValueError, match="the study's sampling is random"):
        sobol_indices(studied(X, 100, ishigami, method="random"))
    for members in (100, 5 * 24, 5 * 8):
        with pytest.raises(ValueError, match=r"5 times a power of two of members .* 80 at least"):
            studied(X, members, ishigami)
