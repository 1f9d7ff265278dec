"""Load cases of the built-in beams, condensed, against closed forms and an independent model."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.shallow_arch import ArchSettings, shallow_arch

from snrmjax.condense.elements.beam import Beam, PointMass, Support, rise_of_radius
from snrmjax.condense.elements.beam_modes import beam_modes
from snrmjax.condense.elements.statics import static_cases
from snrmjax.condense.load_set import modal_loads
from snrmjax.condense.potential_fit import fit_potential

_FLAT = {"young": 204.8e9, "density": 7870.0}


def _condensed(beam, modes, displacement):
    basis = beam_modes(beam, modes)
    cases = static_cases(beam, basis, modal_loads(basis, displacement).force)
    return basis, cases, fit_potential(basis, cases)


def test_flat_beam_has_the_cubic_coefficient_of_von_karman():
    # One clamped-clamped mode φ: V = EA/8L (∫φ'² dx)² q⁴ with ∫φ'² dx = σβ(σβ − 2)/(mL²).
    length, width, thickness = 0.2286, 0.0127, 0.787e-3
    root = 4.730040744862704  # cos β cosh β = 1
    sigma = (np.cosh(root) - np.cos(root)) / (np.sinh(root) - np.sin(root))
    slopes = sigma * root * (sigma * root - 2)
    mass = 7870.0 * width * thickness
    exact = 204.8e9 * width * thickness / (2 * length) * (slopes / (mass * length**2)) ** 2
    beam = Beam(length, width, thickness, **_FLAT)
    basis, cases, result = _condensed(beam, (1,), 0.1 * thickness)
    by_monomial = dict(zip(result.monomials, result.coefficient, strict=True))
    # Loads of a tenth of the thickness: the other modes hardly follow.
    assert abs(4 * by_monomial[(0, 0, 0, 0)] / exact - 1) < 2e-3
    # The strain energy is that of the potential: an independent output of the elements.
    q = np.asarray(cases.modal_displacement)
    energy = 0.5 * (q**2 * basis.frequency**2).sum(axis=1) + result.energy(jnp.asarray(q))
    np.testing.assert_allclose(energy, cases.energy, rtol=1e-6)


def test_curved_beam_softens_then_hardens_as_galerkins_arch():
    length, width, thickness = 0.3048, 0.0127, 0.508e-3
    rise = rise_of_radius(length, 11.43)
    beam = Beam(length, width, thickness, rise=rise, young=204e9, density=7860.0)
    basis, _, result = _condensed(beam, (1,), 0.02 * thickness)
    quadratic, cubic = result.coefficient * jnp.array([3.0, 4.0])
    # Towards the centre (q < 0) softer at first, and harder beyond; the backbone turns downwards.
    assert quadratic > 0
    assert 0 < 9 * cubic * basis.frequency[0] ** 2 < 10 * quadratic**2
    settings = ArchSettings(beam_functions=(1, 3, 5, 7, 9))
    arch = shallow_arch(
        *(length, width, thickness, rise),
        young=204e9,
        density=7860.0,
        damping_ratio=0.01,
        settings=settings,
    )
    np.testing.assert_allclose(basis.frequency[0], arch.modes.natural_frequency[0], rtol=1e-3)
    first = dict(zip(arch.potential.monomials, arch.potential.coefficient, strict=True))
    np.testing.assert_allclose(quadratic, 3 * first[(0, 0, 0)], rtol=1e-2)


def _check_derivatives(told, at, names):
    """Derivatives by relative changes against fourth-order differences, to 1e-6."""
    told = jax.jit(told)
    value = told(at)
    for k, name in enumerate(names):
        along = at * jnp.eye(len(names))[k]
        slope = jax.jvp(told, (at,), (along,))[1]
        values = [told(at + n * 2e-4 * along) for n in (-2, -1, 1, 2)]
        expected = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / 24e-4
        size = np.maximum(np.abs(expected), np.abs(value))
        assert np.all(np.abs(slope - expected) < 1e-6 * size), name


def _frequencies_and_coefficients(beam):
    basis = beam_modes(beam, (1, 3))
    force = jnp.array([[1.0, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [1, -1], [-1, 1], [-1, -1]])
    cases = static_cases(beam, basis, force * jnp.array([2.5, 45.0]))
    return jnp.concatenate([basis.frequency, fit_potential(basis, cases).coefficient])


@pytest.mark.long
def test_coefficients_have_right_derivatives_by_the_geometry():
    def told(numbers):
        thickness, rise, young = numbers
        size = (0.3, 0.0127, thickness)
        return _frequencies_and_coefficients(
            Beam(*size, rise=rise, young=young, density=7800.0, elements=8)
        )

    _check_derivatives(told, jnp.array([0.6e-3, 0.9e-3, 2e11]), ("thickness", "rise", "young"))


@pytest.mark.long
def test_coefficients_have_right_derivatives_by_supports_and_point_masses():
    def told(numbers):
        axial, transverse, rotation, mass, inertia = numbers
        return _frequencies_and_coefficients(
            Beam(
                *(0.3, 0.0127, 0.6e-3),
                rise=0.9e-3,
                young=2e11,
                density=7800.0,
                elements=8,
                left=Support(axial, transverse, rotation),
                point_masses=(PointMass(0.4, mass, inertia),),
            )
        )

    # Springs as stiff as the beam in each direction, a mass of a fifth of it.
    at = jnp.array([5e6, 3e3, 3.0, 3.5e-3, 2e-8])
    _check_derivatives(told, at, ("axial", "transverse", "rotation", "mass", "inertia"))
