"""Strong laws, whose harmonics change the fundamental force: states from a balance of our own."""

import numpy as np
import pytest
from truths.balanced_sets import OMEGA, PARTICIPATION, SHAPE, ZETA, linear_model

import snrmjax as sj
from snrmjax.diagnose.explained_parts import named_parts
from snrmjax.diagnose.misfit.predictions import predictions_of
from snrmjax.model.effects import EFFECTS

ORDERS = np.array([1, 0, 2, 3, 4, 5, 7])
ANGLE = 2 * np.pi * (np.arange(2048) + 0.5) / 2048
TURNING = np.exp(1j * np.outer(ORDERS, ANGLE))
LARGEST = 1e-3  # m, at the sensor


def needed_stiffness(law, x, omega):
    """Dynamic stiffness of the mode, 1/s², for q = x cos t + … with a mean and harmonics to 7."""
    driven = np.outer(omega, ORDERS)
    linear = OMEGA**2 - driven**2 + 2j * ZETA * OMEGA * driven
    c = np.outer(x, ORDERS == 1).astype(complex)
    for _ in range(12):  # linear springs of the other harmonics are far stiffer than the law
        before = c.copy()
        f = law((c @ TURNING).real, (1j * driven * c @ TURNING).real) @ TURNING.conj().T
        f = np.where(ORDERS, 2, 1) * f / len(ANGLE)
        c[:, 1:] = -f[:, 1:] / linear[:, 1:]
    assert np.max(np.abs(c - before) / x[:, None]) < 1e-5
    return linear[:, 0] + f[:, 0] / x


def states_with(law, smallest, noise=2e-3):
    """States of five levels at nine phases."""
    rng = np.random.default_rng(0)
    tips, phases = np.geomspace(smallest, LARGEST, 5), np.radians(np.linspace(-55, 55, 9))
    tip, phase = (part.ravel() for part in np.meshgrid(tips, phases, indexing="ij"))
    level, x = np.repeat(np.arange(5), 9), tip * np.cos(phase) / SHAPE
    omega = np.full(len(x), OMEGA)
    for _ in range(10):  # to Re Z = tan(phase) Im Z
        z = needed_stiffness(law, x, omega)
        omega = np.sqrt(omega**2 + z.real - np.tan(phase) * z.imag)
    z = needed_stiffness(law, x, omega)
    velocity = 1j * omega * x * SHAPE * np.exp(-1j * np.angle(z))
    own = noise * (rng.normal(size=len(x)) + 1j * rng.normal(size=len(x)))
    return sj.measure.steady_states(
        level,
        omega,
        np.abs(z) * x / PARTICIPATION,
        velocity * np.exp(own),
        velocity_std=noise * np.abs(velocity),
        phase_std=np.full((len(x), 1), noise),
        force_std=1e-4 * np.abs(z) * x,
    )


def spring(q, _):
    """0.6 of the linear stiffness at the largest amplitude."""
    return 0.8 * OMEGA**2 * (q * SHAPE / LARGEST) ** 2 * q


def friction(_, v):
    """Three quarters of the force at the smallest amplitude."""
    return 3 * ZETA * OMEGA**2 * 1e-4 / SHAPE * np.sign(v)


@pytest.mark.parametrize(
    ("law", "smallest", "kind", "part"),
    [
        (spring, 1e-4, "cubic_stiffness", "stiffness"),
        (friction, 4e-5, "coulomb_friction", "damping"),
    ],
)
def test_a_strong_law_is_named_without_a_remainder(law, smallest, kind, part):
    """Its own harmonics would be a remainder of the describing function."""
    model, data = linear_model(), states_with(law, smallest)
    named = named_parts(predictions_of(model, data, kinds=()), data, EFFECTS).naming
    found = {one.part: one for one in named.parts}
    assert named.effects == (kind,)
    assert found[part].verdict == "named"
    assert found[part].explained.low > 0.95
    assert all(one.verdict in ("none", "named") for one in named.parts)
    if kind == "cubic_stiffness":
        coefficient = named.parameters["cubic_stiffness.coefficient"]
        exact = 0.8 * OMEGA**2 * (SHAPE / LARGEST) ** 2
        assert coefficient.value == pytest.approx(exact, abs=4 * coefficient.std)
        assert coefficient.std < 0.01 * exact


def test_a_preload_on_a_known_cubic_spring_is_named_with_its_force():
    """The model's own spring; the mean displacement, 0.3 of the amplitude, is not recorded."""
    cubic = 0.04 * OMEGA**2 * (SHAPE / LARGEST) ** 2
    static = 0.3 * LARGEST / SHAPE
    preload = OMEGA**2 * static + cubic * static**3
    data = states_with(lambda q, _: cubic * q**3 + preload, 1e-4, noise=1e-3)
    potential = sj.model.polynomial_potential({"1111": cubic / 4}, 1)
    model = linear_model(potential=potential)
    named = named_parts(predictions_of(model, data, kinds=()), data, EFFECTS).naming
    assert named.effects == ("static_preload",)
    force = named.parameters["static_preload.constant_force"]
    # Without the second harmonic its direction is unknown.
    assert abs(force.value) == pytest.approx(preload, abs=4 * force.std)
    assert force.std < 0.05 * preload
