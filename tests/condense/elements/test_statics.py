"""Static solutions against the elastica, limit loads and stiffnesses known in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ellipk, ellipkinc

from snrmjax.condense.elements.beam import Beam, Support
from snrmjax.condense.elements.statics import StaticStatus, static_solutions

_YOUNG, _WIDTH, _THICKNESS = 2e11, 0.02, 0.002
_BENDING = _YOUNG * _WIDTH * _THICKNESS**3 / 12


def _beam(**given):
    return Beam(1.0, _WIDTH, _THICKNESS, young=_YOUNG, density=7800.0, **given)


def _elastica(load):
    """Tip angle and deflection of a cantilever of unit length and EI under a dead tip load."""

    # p² = (1 + sin φ)/2: L √P = K(p) − F(asin 1/(p √2), p).
    def excess(angle):
        m = 0.5 * (1 + np.sin(angle))
        return ellipk(m) - ellipkinc(np.arcsin(np.sqrt(0.5 / m)), m) - np.sqrt(load)

    angle = brentq(excess, 1e-6, 0.5 * np.pi - 1e-9, xtol=1e-14)
    node, weight = np.polynomial.legendre.leggauss(80)
    # ds = dθ/√(2P (sin φ − sin θ)), with θ = φ − t² against the pole at the tip.
    t = 0.5 * np.sqrt(angle) * (node + 1)
    theta = angle - t**2
    ds = weight * np.sqrt(angle) * t / np.sqrt(2 * load * (np.sin(angle) - np.sin(theta)))
    assert abs(np.sum(ds) - 1) < 1e-9
    return angle, np.sum(ds * np.cos(theta)), np.sum(ds * np.sin(theta))


def test_a_cantilever_is_the_elastica():
    # Reference: Bisshopp & Drucker, Q. Appl. Math. 3 (1945) 272, doi:10.1090/qam/13360. Stretching
    # of the slender section moves the tip by (t/L)²/12 · P: 3e-6 of the length at most.
    loads = np.array([1.0, 10.0])
    beam = _beam(right="free")
    force = np.zeros((2, beam.n_dof))
    force[:, -2] = loads * _BENDING
    result = static_solutions(beam, jnp.asarray(force))
    assert result.converged.all()
    for row, load in enumerate(loads):
        x, y, rotation = result.displacement[row, -3:]
        angle, along, across = _elastica(load)
        np.testing.assert_allclose([rotation, 1 + x, y], [angle, along, across], rtol=2e-5)


def test_a_deep_arch_loses_its_stability_at_the_published_load():
    # Clamped and pinned arc of 215°, point load at the crown, EI and R of one: 8.97. The arch is
    # inextensible there; here (h/R)²/12 = 1e-7. Reference: D. A. DaDeppo & R. Schmidt, J. Appl.
    # Mech. 42 (1975) 894, doi:10.1115/1.3423734.
    half, width, thickness = np.deg2rad(107.5), 1.0, 1e-3
    beam = Beam(
        *(2 * np.sin(half), width, thickness),
        rise=1 - np.cos(half),
        young=12 / (width * thickness**3),
        density=1.0,
        right="pinned",
    )
    load = jnp.zeros((1, beam.n_dof)).at[0, 3 * 20 + 1].set(-10.0)
    result = static_solutions(beam, load)
    assert result.status.tolist() == [StaticStatus.SNAPPED_THROUGH]
    assert np.isnan(result.displacement).all()
    assert abs(10 * result.load_fraction[0] - 8.97) < 0.01


@pytest.mark.long
def test_displacement_has_right_derivatives():
    load = jnp.zeros((1, 3 * 9)).at[0, 3 * 4 + 1].set(30.0)

    def middle(numbers):
        thickness, rise, spring = numbers
        beam = Beam(
            *(1.0, _WIDTH, thickness),
            rise=rise,
            young=_YOUNG,
            density=7800.0,
            elements=8,
            left=Support(rotation=spring),
        )
        return static_solutions(beam, load).displacement[0, 3 * 4 + 1]

    at, middle = jnp.array([0.002, 0.004, 50.0]), jax.jit(middle)
    exact = jax.grad(middle)(at)
    for k in range(3):
        step = 1e-4 * at[k]
        # Fourth-order differences: truncation 1e-12, rounding 1e-16/1e-4 · condition.
        values = [middle(at.at[k].add(n * step)) for n in (-2, -1, 1, 2)]
        slope = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * step)
        assert abs(slope / exact[k] - 1) < 1e-6


@pytest.mark.parametrize(
    "given", [{"elements": 1}, {"poisson": 0.6}, {"rise": -1e-3}, {"left": "glued"}]
)
def test_wrong_numbers_are_refused_by_name(given):
    with pytest.raises(ValueError, match="support" if "left" in given else next(iter(given))):
        _beam(**given)
