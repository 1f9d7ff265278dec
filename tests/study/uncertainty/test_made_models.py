"""Models that a function makes of inputs: derivatives and members of closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest

from snrmjax.model.modes import linear_modes
from snrmjax.model.parameters import parameter_values, with_parameters
from snrmjax.model.potential import polynomial_potential
from snrmjax.model.structures import structure
from snrmjax.study.uncertainty.followed_motions import response_quantities
from snrmjax.study.uncertainty.made_models import made_models, with_numbers
from snrmjax.study.uncertainty.uncertain_inputs import correlated_inputs

OMEGA, LENGTH, DEPTH = 2.0, 1.5, 0.2
STD = np.array([0.1, 0.04])  # of the length and of the depth
NAMES = ["mode_1.natural_frequency", "mode_1.damping_ratio"]
INPUTS = correlated_inputs(["length", "depth"], [LENGTH, DEPTH], np.diag(STD**2))


def model_of(values):
    """ω = 1/length² and ζ = depth², which no straight line is."""
    modes = linear_modes([OMEGA], [0.02], [[1.2]], [1.5])
    bare = structure(modes, polynomial_potential({"1111": 0.3}, 1))
    made = jnp.stack([1 / values["length"] ** 2, values["depth"] ** 2])
    return with_parameters(bare, NAMES, made)


@pytest.fixture(scope="module")
def made():
    return made_models(model_of, INPUTS)


def named(model):
    values = parameter_values(model)
    return np.array([values[name] for name in NAMES])


def exact(z):
    length, depth = LENGTH + STD[0] * z[..., 0], DEPTH + STD[1] * z[..., 1]
    return np.stack([1 / length**2, depth**2], axis=-1)


def test_near_the_nominal_inputs_the_series_is_right_to_second_order(made):
    z = np.array([0.01, -0.02])
    expected = np.array(
        [
            (1 - 2 * STD[0] / LENGTH * z[0] + 3 * (STD[0] / LENGTH * z[0]) ** 2) / LENGTH**2,
            exact(z)[1],  # a square is its own series
        ]
    )
    np.testing.assert_allclose(named(made.series.model(jnp.asarray(z))), expected, rtol=1e-13)
    # What the third order leaves: -4 (0.1 · 0.01/1.5)³.
    np.testing.assert_allclose(expected, exact(z), rtol=5 * (0.1 * 0.01 / 1.5) ** 3)


def test_every_member_has_its_own_model(made):
    z = np.array([[0.0, 0.0], [2.0, -1.0], [-3.0, 2.0]])
    numbers = made.numbers(z)
    models = [with_numbers(made.series.template, row) for row in numbers]
    np.testing.assert_allclose([named(m) for m in models], exact(z), rtol=1e-13)
    assert parameter_values(models[1])["potential.1111"] == 0.3
    # The way to a member ends at its own model and begins at the nominal one.
    rest = made.rest(z)
    for share, end in ((1.0, exact(z[2])), (0.0, exact(z[0]))):
        way = made.series.toward(rest[2], jnp.asarray(share))
        np.testing.assert_allclose(named(way.model(share * jnp.asarray(z[2]))), end, rtol=1e-12)


@pytest.mark.long
def test_peaks_are_those_of_every_members_own_model():
    """|V| is largest at Ω = ω, exactly, and there F φ b/(2ζω) = F φ b length²/(2 depth²)."""

    def linear(values):
        modes = linear_modes([OMEGA], [0.02], [[1.2]], [1.5])
        made = jnp.stack([1 / values["length"] ** 2, values["depth"] ** 2])
        return with_parameters(structure(modes), NAMES, made)

    z = np.array([[1.0, -1.5], [-2.0, 1.0], [0.5, 2.0]])
    settings = {"force": 0.1, "kinds": ("peak",), "harmonic_order": 1, "model_of": linear}
    found = response_quantities(linear({"length": 1.5, "depth": 0.2}), INPUTS, 0.2, 1.2, **settings)
    length, depth = (np.array([LENGTH, DEPTH]) + STD * z).T
    peak = 0.1 * 1.2 * 1.5 * length**2 / (2 * depth**2)
    expected = np.stack([1 / length**2 / (2 * np.pi), peak], axis=1)
    np.testing.assert_allclose(found.members(z).values, expected, rtol=1e-9)
    whole, traced = found.traced(z)
    assert traced.all()
    np.testing.assert_allclose(whole, expected, rtol=1e-7)
