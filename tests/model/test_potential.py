"""Polynomial potentials: derivatives against differences, and the paper's Tab. A.1 as printed."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from snrmjax.model.builders.beams import flat_beam
from snrmjax.model.potential import (
    monomial_key,
    parse_monomial,
    polynomial_potential,
)

# ---------------------------------------------------------------------- values and derivatives


MONOMIALS = {
    n: [m for d in range(2, 7) for m in itertools.combinations_with_replacement(range(n), d)]
    for n in (1, 2, 3, 4)
}
# Hypothesis draws numbers for 24 of the 205 monomials of four modes, always the same, spread over
# all degrees: one shape, which compiles once.
SOME = [*MONOMIALS[4][::9], (3,) * 6]
NUMBER = st.floats(-3, 3, allow_subnormal=False)
PLACE = st.floats(-1.5, 1.5, allow_subnormal=False)


def energy_by_hand(coefficients, q):
    """Σ c Π q_i, term by term."""
    return sum(c * np.prod([q[i] for i in monomial]) for monomial, c in coefficients.items())


def differences(function, q):
    """Central differences of fourth order: exact for degree 4, error h⁴/30·f⁽⁵⁾ beyond."""
    step, n = 1e-2, len(q)
    rows = []
    for direction in np.eye(n):
        near = function(q + step * direction) - function(q - step * direction)
        far = function(q + 2 * step * direction) - function(q - 2 * step * direction)
        rows.append((8 * near - far) / (12 * step))
    return np.stack(rows, axis=-1)


@eqx.filter_jit
def evaluated(potential, q):
    return potential.energy(q), potential.force(q), potential.stiffness(q)


def check_derivatives(coefficients, q):
    """Energy, force and stiffness against the definition and its differences."""
    potential = polynomial_potential(coefficients, len(q))
    assert potential.degree == max(len(m) for m in coefficients)
    # |V| ≤ 24·3·1.5⁶ ≈ 800 with |f⁽⁵⁾| ≤ 24·3·720·1.5 in the worst case: h⁴/30 of that is 3e-5;
    # rounding is 800·1e-16/1e-2. The energy itself is rounding only.
    energy, force, stiffness = map(np.asarray, evaluated(potential, q))
    assert float(energy) == pytest.approx(energy_by_hand(coefficients, q), rel=1e-12, abs=1e-12)
    wanted = differences(lambda x: energy_by_hand(coefficients, x), q)
    np.testing.assert_allclose(force, wanted, rtol=0, atol=3e-5)
    wanted = differences(lambda x: np.asarray(evaluated(potential, x)[1]), q)
    np.testing.assert_allclose(stiffness, wanted, rtol=0, atol=3e-5)
    np.testing.assert_allclose(stiffness, stiffness.T, rtol=0, atol=1e-12)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(st.tuples(*[NUMBER] * len(SOME)), st.tuples(*[PLACE] * 4))
def test_derivatives_agree_with_the_definition(numbers, place):
    check_derivatives(dict(zip(SOME, numbers, strict=True)), np.array(place))


@pytest.mark.parametrize("n_modes", [1, 2, 3])
def test_derivatives_for_fewer_modes(n_modes):
    draw = np.random.default_rng(n_modes)
    numbers = draw.uniform(-1, 1, size=len(MONOMIALS[n_modes]))
    coefficients = dict(zip(MONOMIALS[n_modes], numbers, strict=True))
    check_derivatives(coefficients, draw.uniform(-1.2, 1.2, size=n_modes))


def test_fast_derivatives_equal_automatic_ones_of_the_flat_beam():
    potential = flat_beam().potential
    q = jnp.array([[2e-5, -3e-6, 1e-6, 4e-7], [-1e-5, 2e-6, 5e-7, 1e-8], [0.0, 0.0, 0.0, 0.0]])
    # Sums of 34…100 terms of mixed sign: rounding of the largest term.
    _, force, stiffness = evaluated(potential, q)
    np.testing.assert_allclose(force, jax.jit(jax.vmap(jax.grad(potential.energy)))(q), atol=1e-11)
    slow = jax.jit(jax.vmap(jax.hessian(potential.energy)))(q)
    np.testing.assert_allclose(stiffness, slow, atol=1e-12 * float(jnp.abs(slow).max()))


def test_gradient_with_respect_to_coefficients_is_the_monomial():
    potential = polynomial_potential({"112": 2.0, "2222": -1.0}, 2)
    q = jnp.array([0.3, 0.7])
    slope = eqx.filter_grad(lambda p: p.energy(q))(potential)
    np.testing.assert_allclose(slope.coefficient, [0.3**2 * 0.7, 0.7**4], rtol=1e-14)


def test_jit_and_vmap_agree_and_trace_once():
    potential = flat_beam().potential
    q = 1e-5 * jnp.asarray(np.random.default_rng(0).normal(size=(5, 4)))
    traces = []

    @jax.jit
    def forces(q):
        traces.append(1)
        return jax.vmap(potential.force)(q)

    # The order of summation may differ between the compiled and the plain sum.
    np.testing.assert_allclose(forces(q), potential.force(q), rtol=1e-11)
    np.testing.assert_allclose(forces(-q), potential.force(-q), rtol=1e-11)
    assert len(traces) == 1
    assert potential.force(q[None]).shape == (1, 5, 4)


def test_an_empty_potential_is_no_force():
    potential = polynomial_potential({}, 3)
    q = jnp.ones((2, 3))
    assert potential.degree == 0
    assert not np.any(potential.energy(q))
    assert not np.any(potential.force(q))
    assert potential.stiffness(q).shape == (2, 3, 3)
    assert not np.any(potential.stiffness(q))


# ------------------------------------------------------------------------------------ monomials


@settings(max_examples=50, deadline=None, derandomize=True)
@given(st.lists(st.integers(0, 14), min_size=2, max_size=6))
def test_keys_read_back(monomial):
    assert parse_monomial(monomial_key(tuple(monomial)), 15) == tuple(sorted(monomial))
    assert parse_monomial(tuple(monomial), 15) == tuple(sorted(monomial))


@pytest.mark.parametrize(
    ("key", "n_modes", "message"),
    [
        ("1a2", 2, "monomial '1a2' must be mode numbers"),
        ("1²", 2, "must be mode numbers"),
        ("1.2", 2, "must be mode numbers"),
        ("1--2", 2, "must be mode numbers"),
        ("1 2", 2, "must be mode numbers"),
        ("", 2, "degree 2 or more"),
        ("1", 2, "degree 2 or more"),
        ((0,), 2, "degree 2 or more"),
        ("123", 2, r"names a mode that does not exist \(there are 2\)"),
        ("10", 2, "does not exist"),  # modes count from one
        ((0, -1), 2, "does not exist"),
        ((0, 2), 2, "does not exist"),
    ],
)
def test_monomials_that_mean_nothing_are_refused(key, n_modes, message):
    with pytest.raises(ValueError, match=message):
        parse_monomial(key, n_modes)


def test_a_fraction_of_a_mode_is_refused():
    with pytest.raises(TypeError):
        polynomial_potential({(0.9, 0.2): 1.0}, 1)


@pytest.mark.parametrize(
    ("coefficients", "std", "message"),
    [
        ({"12": 1.0, "21": 2.0}, {}, "monomial '21' is given twice"),
        ({"12": 1.0, "1-2": 2.0}, {}, "given twice"),
        ({"12": 1.0}, {"11": 1.0}, r"`coefficient_std` names \[\(0, 0\)\]"),
        ({"12": 1.0}, {"12": 1.0, "21": 1.0}, "given twice"),
        ({"12": np.nan}, {}, "must be finite, but is nan"),
        ({"12": 1.0}, {"12": np.inf}, "must be finite, but is inf"),
    ],
)
def test_potentials_that_contradict_themselves_are_refused(coefficients, std, message):
    with pytest.raises(ValueError, match=message):
        polynomial_potential(coefficients, 2, coefficient_std=std)


def test_standard_deviations_stay_with_their_monomials():
    potential = polynomial_potential({"221": 5.0, "11": 3.0}, 2, coefficient_std={"122": 0.5})
    assert potential.monomials == ((0, 0), (0, 1, 1))
    assert potential.coefficient.tolist() == [3.0, 5.0]
    assert potential.coefficient_std.tolist() == [0.0, 0.5]


# ------------------------------------------------------------------------------- force tables

# Tab. A.1 as printed: the coefficient of a force monomial in the equations of modes 1, 3, 5, 7.
# The labels of the cubic rows are read as DESIGN.md item 5 says: the row printed β_{i,jj}
# multiplies q_i² q_j, and the last four rows are 123, 124, 134 and 234.
TABLE_A1 = {
    "11": (1.858e07, 2.765e06, -2.593e06, 4.293e07),
    "22": (-2.454e07, 1.983e07, -7.412e06, 1.037e06),
    "33": (1.007e06, 3.689e07, -1.271e07, 5.892e06),
    "44": (2.685e07, -2.182e07, -5.087e06, 1.148e07),
    "12": (5.530e06, -4.908e07, -6.979e06, -5.048e07),
    "13": (-5.185e06, -6.979e06, 2.014e06, -1.954e07),
    "14": (8.585e07, -5.048e07, -1.954e07, 5.371e07),
    "23": (-6.979e06, -1.482e07, 7.377e07, 1.100e07),
    "24": (-5.048e07, 2.075e06, 1.100e07, -4.364e07),
    "34": (-1.954e07, 1.100e07, 1.178e07, -1.017e07),
    "111": (1.375e13, -1.107e13, -8.587e12, 5.968e12),
    "112": (-3.321e13, 1.268e14, -1.281e13, 1.183e13),  # printed 122
    "113": (-2.576e13, -1.281e13, 3.053e14, -2.231e12),  # printed 133
    "114": (1.790e13, 1.183e13, -2.231e12, 5.691e14),  # printed 144
    "221": (1.268e14, -2.670e14, -2.341e13, 1.601e13),  # printed 211
    "222": (-8.901e13, 8.956e14, -2.180e14, 1.975e14),
    "223": (-2.341e13, -6.541e14, 2.487e15, 2.230e14),  # printed 233
    "224": (1.601e13, 5.924e14, 2.230e14, 4.603e15),  # printed 244
    "331": (3.053e14, -2.073e14, -5.593e14, 9.317e13),  # printed 311
    "332": (-2.073e14, 2.487e15, -1.761e15, 3.681e14),  # printed 322
    "333": (-1.864e14, -5.868e14, 6.279e15, 8.698e14),
    "334": (9.317e13, 3.681e14, 2.609e15, 1.217e16),  # printed 344
    "441": (5.691e14, -4.317e14, -3.327e14, 8.486e14),  # printed 411
    "442": (-4.317e14, 4.603e15, -9.444e14, 3.119e15),  # printed 422
    "443": (-3.327e14, -9.444e14, 1.217e16, 5.109e15),  # printed 433
    "444": (2.829e14, 1.040e15, 1.703e15, 2.267e16),
    "123": (-2.561e13, -4.682e13, -4.147e14, -1.226e14),  # printed 133
    "124": (2.367e13, 3.202e13, -1.226e14, -8.634e14),  # printed 144
    "134": (-4.462e12, -1.226e14, 1.863e14, -6.655e14),  # printed 144
    "234": (-1.226e14, 4.460e14, 7.362e14, -1.889e15),  # printed 244
}


def test_shipped_flat_beam_is_the_mean_of_tab_a1():
    """A monomial is in the force of each of its modes, times how often it holds that mode."""
    rows = {tuple(int(c) - 1 for c in key): row for key, row in TABLE_A1.items()}
    rows = {tuple(sorted(key)): row for key, row in rows.items()}
    shipped = flat_beam().potential
    assert len(rows) == 30
    for monomial, coefficient in zip(shipped.monomials, shipped.coefficient, strict=True):
        estimates = []
        for mode in sorted(set(monomial)):
            rest = list(monomial)
            rest.remove(mode)
            estimates.append(rows[tuple(rest)][mode] / monomial.count(mode))
        # Five digits are shipped of a mean of numbers with four, which agree to 5e-4 (DESIGN.md).
        np.testing.assert_allclose(coefficient, np.mean(estimates), rtol=1e-4)
        np.testing.assert_allclose(estimates, np.mean(estimates), rtol=5e-4)


def test_many_modes_have_the_force_and_stiffness_of_a_stretched_string():
    """V = (qᵀGq)² of twelve modes: ∂V = 4 (qᵀGq) Gq, ∂²V = 4 (qᵀGq) G + 8 Gq (Gq)ᵀ."""
    n, random = 12, np.random.default_rng(1)
    half = random.normal(size=(n, n))
    g, q = half @ half.T, random.normal(size=n)
    terms = {}
    for i, j, k, m in itertools.product(range(n), repeat=4):
        key = tuple(sorted((i, j, k, m)))
        terms[key] = terms.get(key, 0.0) + g[i, j] * g[k, m]
    potential = polynomial_potential(terms, n)
    square, slope = q @ g @ q, g @ q
    np.testing.assert_allclose(potential.force(q), 4 * square * slope, rtol=1e-11)
    wanted = 4 * square * g + 8 * np.outer(slope, slope)
    np.testing.assert_allclose(potential.stiffness(q), wanted, rtol=1e-11, atol=1e-11 * square)
