"""Levels that differ where nobody stated any error, against the differences that were put in."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from truths.balanced_sets import (
    OMEGA,
    PARTICIPATION,
    SHAPE,
    ZETA,
    balanced,
    linear_model,
    quadratic,
)

import snrmjax as sj
from snrmjax.diagnose import diagnosis
from snrmjax.diagnose.checks.level_variance import beyond_random_noise, with_level_variance

LEVELS, SHIFT, SEED = 6, 4e-3, 3


def silent(data):
    """The states without any word of their noise."""
    nothing = np.full((data.n_states, 1), np.nan)
    return dataclasses.replace(
        data, velocity_std=nothing, phase_std=nothing, force_std=nothing[:, 0]
    )


@pytest.fixture(scope="module")
def data():
    """Quadratic damping in a mode whose frequency differs from level to level."""
    return silent(balanced(quadratic, seed=SEED, levels=LEVELS, shift=SHIFT))


@pytest.fixture(scope="module")
def found(data):
    """What is said of it."""
    return sj.diagnose_model(linear_model(), data)


@pytest.mark.long
def test_levels_that_differ_hide_no_effect_and_make_none(found):
    assert found.effects == ("quadratic_damping",)
    value, std = found.parameters["quadratic_damping.coefficient"]
    # 8 v of a velocity 2 q̇ is 16 q̇: c |q̇| q̇ has the equivalent damping 8/(3π) c q̇.
    assert abs(value - 16 * 3 * np.pi / 8) < 3 * std
    assert found.gap.interpolated.after < 1.3


@pytest.mark.long
def test_the_differences_are_those_that_were_put_in(data):
    model, note = with_level_variance(linear_model(), data)
    assert note.startswith("no errors of levels")
    assert "natural frequency" in note
    put_in = SHIFT * np.random.default_rng([SEED, 1]).normal(size=LEVELS)
    size = float(model.level_frequency_std) / OMEGA
    # Restricted likelihood knows them but for their mean and a smooth change with amplitude.
    assert size == pytest.approx(np.std(put_in, ddof=1), rel=0.3)
    assert f"{100 * size:.2g} % in natural frequency" in note


@pytest.mark.long
def test_levels_that_agree_are_not_said_to_differ():
    model = linear_model()
    same, note = with_level_variance(model, silent(balanced(quadratic, seed=SEED)))
    assert note == ""
    assert same is model


class Reached(Exception):
    """The diagnosis has decided whether to look for errors of levels."""


@pytest.mark.parametrize(
    ("model", "stated", "gain_std", "looks"),
    [
        (linear_model(), False, 0.0, True),
        (linear_model(), True, 0.0, False),  # stated noise is all the noise there is
        (linear_model(), False, 1.0, False),  # beside an unknown gain nobody can tell
        (linear_model(level_phase_std=1e-3), False, 0.0, False),
    ],
)
def test_errors_of_levels_are_looked_for_where_nothing_is_said(
    monkeypatch, data, model, stated, gain_std, looks
):
    looked = []

    def seen(model, data):
        looked.append(model)
        return model, ""

    def stop(predictions):
        raise Reached

    monkeypatch.setattr(diagnosis, "with_level_variance", seen)
    monkeypatch.setattr(diagnosis, "weighted_misfit", stop)
    given = balanced(quadratic, seed=SEED, levels=LEVELS, shift=SHIFT) if stated else data
    with pytest.raises(Reached):
        sj.diagnose_model(model, given, force_gain_std=gain_std)
    assert bool(looked) == looks


def test_errors_of_levels_need_the_phases_of_every_sensor(monkeypatch, data):
    """A joint fit would refuse the data for a sensor that the diagnosis does not look at."""

    def stop(predictions):
        raise Reached

    monkeypatch.setattr(diagnosis, "weighted_misfit", stop)
    velocity = np.asarray(data.velocity)
    modes = sj.model.linear_modes(
        *([OMEGA], [ZETA], [[SHAPE], [0.5 * SHAPE]], [PARTICIPATION]), sensors=("one", "other")
    )
    two = sj.measure.steady_states(
        *(np.asarray(data.level), np.asarray(data.frequency), np.asarray(data.force)),
        np.concatenate([velocity, 0.5 * velocity], axis=1),
        phase_std=np.tile([np.nan, np.pi], (data.n_states, 1)),
        sensors=("one", "other"),
    )
    with pytest.raises(Reached):
        sj.diagnose_model(sj.model.structure(modes), two)


def test_what_levels_share_is_told_from_random_noise():
    """A joint fit says 0.38, the diagnosis 1.2 times the stated noise: both are right."""
    said = beyond_random_noise(linear_model(), 1.2, 0.38, 3)
    assert "1.2 times the stated noise" in said
    assert "0.38 times that noise only" in said
    assert "level_gain_std" in said
    stated = dataclasses.replace(linear_model(), level_gain_std=jnp.asarray(0.01))
    assert beyond_random_noise(stated, 1.2, 0.38, 3) == ""
    assert beyond_random_noise(linear_model(), 1.2, 0.38, 1) == ""
    assert beyond_random_noise(linear_model(), 1.0, 0.9, 3) == ""
    assert beyond_random_noise(linear_model(), 0.35, 0.36, 3) == ""
