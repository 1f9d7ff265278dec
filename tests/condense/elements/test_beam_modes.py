"""Linear modes against beams and arches whose frequencies are known in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

from snrmjax.condense.elements.beam import Beam, PointMass, Support, rise_of_radius
from snrmjax.condense.elements.beam_modes import (
    beam_modes,
    participation,
    shape_at,
)

_L, _B, _H, _E, _RHO = 0.5, 0.02, 0.002, 2e11, 7800.0
_EI, _MASS = _E * _B * _H**3 / 12, _RHO * _B * _H


def _beam(**given):
    return Beam(_L, _B, _H, young=_E, density=_RHO, elements=12, **given)


def _root(function, low, high):
    return brentq(function, low, high, xtol=1e-14)


@pytest.mark.long
@pytest.mark.parametrize(
    ("left", "right", "root"),
    [
        ("pinned", "pinned", 2 * np.pi),
        ("clamped", "free", _root(lambda x: np.cos(x) * np.cosh(x) + 1, 4, 5)),
    ],
)
def test_second_frequency_of_slender_beams(left, right, root):
    # Rotary inertia lowers it by (βh/L)²/24: 4e-5 at most. Twelve cubic elements: 2e-5 high.
    exact = root**2 / _L**2 * np.sqrt(_EI / _MASS)
    result = beam_modes(_beam(left=left, right=right), (2,)).frequency[0]
    assert abs(result / exact - 1) < 8e-5


def test_a_mass_at_the_tip_lowers_the_frequency():
    ratio = 0.7  # of the beam's own mass

    def characteristic(x):
        own = 1 + np.cos(x) * np.cosh(x)
        return own + ratio * x * (np.cos(x) * np.sinh(x) - np.sin(x) * np.cosh(x))

    tip = PointMass(1.0, ratio * _MASS * _L)
    result = beam_modes(_beam(right="free", point_masses=[tip]), (1,)).frequency[0]
    exact = _root(characteristic, 0.5, 1.8) ** 2 / _L**2 * np.sqrt(_EI / _MASS)
    assert abs(result / exact - 1) < 8e-5


def test_participation_of_a_pinned_beam():
    # φ = √(2/m) sin πx/L: uniform force 2/π.
    beam = _beam(left="pinned", right="pinned")
    basis = beam_modes(beam, (1,))
    peak = np.sqrt(2 / (_MASS * _L))
    np.testing.assert_allclose(shape_at(beam, basis, 0.5), [peak], rtol=2e-5)
    np.testing.assert_allclose(participation(beam, basis), [2 / np.pi * peak], rtol=2e-5)
    np.testing.assert_allclose(participation(beam, basis, 0.25), [peak / 2**0.5], rtol=2e-5)
    np.testing.assert_allclose(basis.filter @ basis.shapes, [[1.0]], rtol=1e-12)


@pytest.mark.long
def test_frequencies_and_shapes_have_right_derivatives():
    def told(numbers):
        thickness, radius, spring = numbers
        beam = Beam(
            *(_L, _B, thickness),
            rise=rise_of_radius(_L, radius),
            young=_E,
            density=_RHO,
            elements=12,
            left=Support(rotation=spring),
        )
        basis = beam_modes(beam, (1, 2))
        return jnp.concatenate([basis.frequency, shape_at(beam, basis, 0.3)])

    at, told = jnp.array([_H, 20.0, 40.0]), jax.jit(told)
    exact = jax.jacrev(told)(at)
    for k in range(3):
        step = 1e-3 * at[k]
        values = [told(at.at[k].add(n * step)) for n in (-2, -1, 1, 2)]
        slope = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * step)
        size = np.abs(exact[:, k]).max()
        np.testing.assert_allclose(slope, exact[:, k], rtol=1e-6, atol=1e-8 * size)


@pytest.mark.long
def test_derivatives_by_springs_and_point_masses_are_rayleighs():
    # ∂ω²/∂k = (φ there)² and ∂ω²/∂m = −ω² (φ there)², by each direction's own shape.
    def told(numbers):
        axial, transverse, rotation, mass, inertia = numbers
        beam = _beam(
            rise=0.02,
            left=Support(axial, transverse, rotation),
            point_masses=(PointMass(0.5, mass, inertia),),
        )
        basis = beam_modes(beam, (1, 2))
        return basis.frequency**2, basis.shapes

    at = jnp.array([1e6, 3e3, 3.0, 3e-3, 1e-7])
    (slopes, _), (squared, shapes) = jax.jacfwd(told)(at), told(at)
    springs = shapes[:3].T ** 2
    x, y, turn = shapes[18:21] ** 2  # the middle node
    of_mass = -np.stack([(x + y) * squared, turn * squared], axis=1)
    np.testing.assert_allclose(slopes, np.concatenate([springs, of_mass], axis=1), rtol=1e-8)


@pytest.mark.long
def test_a_mechanism_is_refused():
    with pytest.raises(ValueError, match="mechanism"):
        beam_modes(_beam(left="pinned", right="free"), (1,))
