"""The built-in beam against closed forms and published large deflections."""

import jax.numpy as jnp
import numpy as np
import pytest

import snrmjax as sj
from snrmjax.condense.corotational_beam import (
    CLAMPED,
    FREE,
    PINNED,
    RectangularSection,
    SupportStiffness,
    beam_static_cases,
    corotational_beam,
    line_load,
    transverse_row,
)

SECTION = RectangularSection(0.0127, 0.000508, 204.8e9, 7870.0)
LENGTH = 0.2286
FIRST = 4.730040744862704  # root of cos k cosh k = 1


@pytest.fixture(scope="module")
def clamped():
    beam = corotational_beam(LENGTH, SECTION, elements=20)
    return beam, beam.modes((1,))


def bending_wave(beam):
    """√(EI/m)/L², rad/s."""
    return float(np.sqrt(beam.bending / beam.mass)) / LENGTH**2


@pytest.mark.long
def test_large_deflections_of_a_cantilever_are_those_of_the_elastica():
    # K. Mattiasson, Int. J. Numer. Methods Eng. 17 (1981) 145, doi:10.1002/nme.1620170113: tip of
    # a cantilever under P = EI/L² and 10 EI/L², over its length.
    beam = corotational_beam(1.0, RectangularSection(0.01, 0.001, 2e11, 7800.0), (CLAMPED, FREE))
    tip = transverse_row(beam, 1.0)
    basis = sj.condense.ReductionBasis(jnp.ones(1), tip[:, None], tip[None], (1,))
    cases = beam_static_cases(beam, basis, float(beam.bending) * np.array([[1.0], [10.0]]))
    np.testing.assert_allclose(cases.modal_displacement[:, 0], [0.30172, 0.81061], rtol=3e-5)
    shortened = -np.asarray(cases.displacement) @ np.roll(tip, -1)  # x of the last node
    np.testing.assert_allclose(shortened, [0.05643, 0.55500], rtol=1e-4)


def test_the_quartic_coefficient_is_that_of_the_von_karman_beam(clamped):
    beam, basis = clamped
    ratio = basis.frequency[0] / (FIRST**2 * bending_wave(beam))
    assert ratio == pytest.approx(1.0, abs=1e-5)  # 20 cubic elements: k⁴/(720·20⁴) of ω²
    x = np.linspace(0, 1, 20001)
    share = (np.cosh(FIRST) - np.cos(FIRST)) / (np.sinh(FIRST) - np.sin(FIRST))
    shape = np.cosh(FIRST * x) - np.cos(FIRST * x)
    shape -= share * (np.sinh(FIRST * x) - np.sin(FIRST * x))
    slope = np.gradient(shape, x)
    squares = np.trapezoid(slope**2, x) / np.trapezoid(shape**2, x) / (beam.mass * LENGTH**2)
    known = beam.axial / (8 * LENGTH) * squares**2  # V = EA/(8L) (∫φ'² dx)² q⁴

    def solve(force):
        return beam_static_cases(beam, basis, force)

    loads = sj.condense.modal_loads(basis, 0.05 * 0.000508)
    found = sj.condense.condense(basis, solve(loads.force))
    quartic = float(found.potential.coefficient[1])
    # The modes that are left out take (0.05 thickness)² of it, finite strain as much.
    assert quartic == pytest.approx(float(known), rel=3e-4)
    assert abs(found.potential.coefficient[0]) * 1e-9 < quartic * 1e-12  # no cubic term
    assert np.max(np.abs(found.quality.energy_error)) < 1e-6


def test_springs_go_from_free_to_held_and_loads_are_those_of_one_newton(clamped):
    _, basis = clamped
    stiff = SupportStiffness(1e13, 1e13, 1e9)
    sprung = corotational_beam(LENGTH, SECTION, (stiff, stiff), elements=20)
    np.testing.assert_allclose(sprung.modes((1,)).frequency, basis.frequency, rtol=1e-6)
    pinned = corotational_beam(LENGTH, SECTION, (PINNED, PINNED), elements=20)
    first = pinned.modes((1, 2))
    known = np.pi**2 * bending_wave(pinned) * np.array([1.0, 4.0])
    np.testing.assert_allclose(first.frequency, known, rtol=1e-5)
    # A sine of mass one: φ = √(2/(mL)) sin, its mean 2/π of the largest.
    largest = np.sqrt(2 / (float(pinned.mass) * LENGTH))
    assert float(first.largest[0]) == pytest.approx(largest, rel=1e-5)
    participation = np.asarray(line_load(pinned)) @ np.asarray(first.shapes)
    np.testing.assert_allclose(participation, [2 / np.pi * largest, 0.0], atol=1e-6 * largest)
    assert transverse_row(pinned, 0.5) @ first.shapes[:, 0] == pytest.approx(largest, rel=1e-5)
    mechanism = corotational_beam(LENGTH, SECTION, (PINNED, FREE), elements=4)
    assert np.all(np.isnan(np.asarray(mechanism.modes((1,)).frequency)))


def test_loads_beyond_small_strain_and_beyond_a_limit_point_are_not_solved(clamped):
    beam, basis = clamped
    stiffness = float(basis.frequency[0]) ** 2
    huge = beam_static_cases(beam, basis, stiffness * np.array([[1.0], [2.0], [3.0], [1e9]]) * 1e-5)
    assert huge.usable.tolist() == [True, True, True, False]
    assert np.all(np.isnan(np.asarray(huge.displacement)[3]))
    arch = corotational_beam(LENGTH, SECTION, elements=20, radius=2.0)  # rise 6.4 thicknesses
    own = arch.modes((2,))  # the first is antisymmetric
    loads = sj.condense.modal_loads(own, 10 * 0.000508, levels=(0.01, 1.0))
    cases = beam_static_cases(arch, own, loads.force)
    # Pushed down it snaps through, for which the linear ten thicknesses are far more than enough.
    assert cases.usable.tolist() == [True, True, True, False]
