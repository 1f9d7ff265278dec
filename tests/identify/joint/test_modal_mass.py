"""A wrong modal mass in the model, on states of known modal mass."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from truths.exact_states import (
    CONSTANT,
    OMEGA,
    PARTICIPATION,
    SHAPE,
    TRUE,
    noisy,
    squared,
    truth_at,
)

import snrmjax as sj
from snrmjax.identify.inference.fitted_curves import as_backbone
from snrmjax.identify.inference.identification import identification_of_fit
from snrmjax.io.joint_results import read_joint_fit, summarise_fit, write_joint_fit

MEASURED = Path(__file__).resolve().parents[4] / "shared" / "data" / "brake_reuss_beam"
WRONG = 1.06  # the model's modal mass over the true one
SPEEDS = np.linspace(0.2, 0.9, 5)


def wrong_modes(std=None):
    """The true mode but for its participation: a modal mass of 1.06 times the true one."""
    return sj.model.linear_modes(
        *([OMEGA], [0.012], [[SHAPE]], [PARTICIPATION / WRONG]),
        std=sj.model.LinearModesStd(modal_mass=None if std is None else [std]),
    )


@pytest.fixture(scope="module")
def fit():
    return sj.fit_jointly(noisy(3, gain=0.003), wrong_modes(), level_gain_std=0.003, **TRUE)


def test_states_off_resonance_determine_it(fit):
    summary = summarise_fit(fit, ())["modal_mass"]
    assert summary["found"]
    assert summary["model_kg"] == pytest.approx(WRONG / CONSTANT, rel=1e-12)
    assert abs(summary["value_kg"] - 1 / CONSTANT) < 2.5 * summary["std_kg"]
    assert summary["std_kg"] < 0.02 / CONSTANT
    (note,) = (note for note in fit.notes if note.kind == "modal_mass_moved")
    assert note["model_std"] == 0.05


def test_curves_are_relative_to_it(fit):
    values, want = sj.identify.fitted_values(fit, SPEEDS), truth_at(SPEEDS)
    z = [
        (values.natural_frequency - np.sqrt(want[0])) / values.natural_frequency_std,
        (values.modal_damping - want[1]) / values.modal_damping_std,
    ]
    assert np.max(np.abs(z)) < 3
    # With the model's mass the damping would be off by its full error of 6 %.
    assert np.max(np.abs(values.modal_damping / want[1] - 1)) < 0.03


def test_predictions_and_points_use_it(fit):
    (resonance,) = sj.identify.fitted_response(fit, 2.0)[0].resonances
    # At phase resonance the damping balances the force: A F = 2ζ̃ω̃ v.
    damping = truth_at(np.array([resonance.velocity]))[1]
    assert damping[0] * resonance.velocity == pytest.approx(2.0 * CONSTANT, rel=0.03)
    assert as_backbone(fit).modal_constant == pytest.approx(CONSTANT, rel=0.02)
    ratio = damping[0] / (2 * resonance.frequency)
    assert resonance.damping_ratio == pytest.approx(ratio, rel=0.03)
    points = identification_of_fit(noisy(3, gain=0.003), fit).points
    x = np.abs(np.asarray(points.mode_velocity)) / np.asarray(noisy(3, gain=0.003).frequency)
    ratio = np.asarray(points.natural_frequency) / np.sqrt(squared(x))
    # A wrong mass shifts points below and above resonance in opposite directions.
    phase = np.angle(np.asarray(points.mode_velocity))
    assert abs(np.mean(ratio[phase > 0.5]) - np.mean(ratio[phase < -0.5])) < 3e-4


def test_it_round_trips_through_its_file(fit, tmp_path):
    write_joint_fit(tmp_path / "fit.json", fit)
    again = read_joint_fit(tmp_path / "fit.json")
    assert summarise_fit(again, ())["modal_mass"] == summarise_fit(fit, ())["modal_mass"]


@pytest.mark.parametrize(
    "case",
    ["stated to be exact", "near resonance", pytest.param("gain free", marks=pytest.mark.long)],
)
def test_where_nothing_determines_it_the_models_is_used(case):
    data = noisy(3, gain=0.003)
    std = 0.0 if case == "stated to be exact" else None
    free = ["force_gain"] if case == "gain free" else []
    if case == "near resonance":
        near = np.abs(np.angle(np.asarray(data.velocity)[:, 0])) < np.radians(3)
        data = data.select(near)
    found = sj.fit_jointly(data, wrong_modes(std), free=free, level_gain_std=0.003, **TRUE)
    summary = summarise_fit(found, ())["modal_mass"]
    assert not summary["found"]
    assert summary["value_kg"] == summary["model_kg"]
    assert not any(note.kind == "modal_mass_moved" for note in found.notes)


def test_a_stated_error_is_respected_and_its_violation_noted():
    data = noisy(3, gain=0.003)
    wide = sj.fit_jointly(data, wrong_modes(0.04), level_gain_std=0.003, **TRUE)
    assert summarise_fit(wide, ())["modal_mass"]["found"]
    tight = sj.fit_jointly(data, wrong_modes(0.01), level_gain_std=0.003, **TRUE)
    (note,) = (note for note in tight.notes if note.kind == "modal_mass_moved")
    assert note["model_std"] == 0.01
    assert note["std_stated"]
    assert note["beyond_std"]


def test_a_model_file_states_it(tmp_path):
    model = sj.model.structure(wrong_modes(0.03))
    sj.io.write_model(tmp_path / "model.toml", model)
    assert "modal_mass_std = 0.03" in (tmp_path / "model.toml").read_text()
    again = sj.read_model(tmp_path / "model.toml").modes
    assert again.modal_mass_std.tolist() == [0.03]
    silent = dataclasses.replace(model, modes=wrong_modes())
    sj.io.write_model(tmp_path / "model.toml", silent)
    assert sj.read_model(tmp_path / "model.toml").modes.modal_mass_std is None


@pytest.mark.long
@pytest.mark.skipif(not MEASURED.exists(), reason="measured data are not there: ../shared/data")
@pytest.mark.parametrize("free", [(), ("force_gain", "instrument_phase")])
def test_no_gain_moves_the_measured_velocities_of_a_bolted_beam(free):
    """Four levels of constant force, whose phase resonances are interpolated directly."""
    model = sj.read_model(MEASURED / "model.toml")
    data = sj.read_steady_states(MEASURED / "force_controlled.csv", model)
    fit = sj.fit_jointly(data, model, free=free)
    speed = np.abs(np.asarray(data.velocity)[:, 0])
    assert fit.largest[1] == pytest.approx(speed.max(), rel=0.01)
    resonances = []
    for level in np.unique(np.asarray(data.level)):
        own = np.asarray(data.level) == level
        order = np.flatnonzero(own)[np.argsort(np.angle(np.asarray(data.velocity)[own, 0]))]
        phase = np.angle(np.asarray(data.velocity)[order, 0])
        columns = (speed[order], np.asarray(data.frequency)[order])
        resonances.append([np.interp(0.0, phase, column) for column in columns])
    at, frequency = np.array(resonances).T
    found = sj.identify.fitted_values(fit, at).natural_frequency
    # Runs repeat to 0.1 Hz; the largest difference was 0.02 Hz.
    np.testing.assert_allclose(found, frequency, atol=2 * np.pi * 0.03)
