"""Diagnoses without phases: of time-integrated sets without their phases."""

import csv
import dataclasses
import functools
import json

import jax.numpy as jnp
import numpy as np
import pytest
from truths.balanced_sets import HERE, KEYS, balanced, files, linear_model, quadratic
from typer.testing import CliRunner

import snrmjax as sj
from snrmjax.cli import app
from snrmjax.diagnose.misfit.candidates import candidate, parameter_labels
from snrmjax.diagnose.misfit.effect_fit import at_phases_of, fit_effect
from snrmjax.diagnose.misfit.noise_model import Magnitudes, magnitudes_of
from snrmjax.diagnose.misfit.predictions import predictions_of, scales_of
from snrmjax.diagnose.misfit.weighted_misfit import weighted_misfit
from snrmjax.identify.calibrate.calibration import calibrate_model
from snrmjax.identify.calibrate.inverse_force import inverse_force
from snrmjax.model.effects import EFFECTS
from snrmjax.numerics.facts import Fact


def without_phases(data, rows=slice(None), seed=0):
    """The data with random phases in some rows, stated as unknown."""
    rotation = np.exp(2j * np.pi * np.random.default_rng(seed).uniform(size=data.n_states))
    mine = np.zeros(data.n_states, dtype=bool)
    mine[rows] = True
    rotation = np.where(mine, rotation, 1.0)[:, None]
    order = np.array(data.harmonic_order)
    return dataclasses.replace(
        data,
        velocity=data.velocity * rotation,
        harmonics=data.harmonics * rotation[..., None] ** order,
        phase_std=jnp.where(mine[:, None], np.radians(90.0), data.phase_std),
    )


@functools.cache
def stripped(name):
    """A set without its phases, diagnosed, and its key."""
    model, data = files(name)
    return sj.diagnose_model(model, without_phases(data)), KEYS[name]


def at_starts(predictions, kind):
    """Predictions at the first start of a kind, with derivatives by its first parameter."""
    one = candidate(kind, scales_of(predictions))
    labels = parameter_labels(kind)
    values = predictions.group.at(labels, np.array(one.starts[0]))
    found = predictions.of(values[None], labels[:1])
    return found._replace(slopes=one.unit[0] * found.slopes)


def test_magnitudes_of_every_effect_do_not_depend_on_the_phases():
    """The force of a motion does not depend on the origin of time."""
    model, data = files("blind_03")
    measured, none = predictions_of(model, data), predictions_of(model, without_phases(data))
    base = alone(none).columns
    for kind in EFFECTS:
        known, unknown = at_starts(measured, kind), at_starts(none, kind)
        # Friction is sampled at other instants of the cycle.
        np.testing.assert_allclose(
            np.abs(unknown.phasors), np.abs(known.phasors), rtol=0, atol=2e-4, err_msg=kind
        )
        force = known.phasors[:, :, 0]
        magnitude, change = np.abs(force), known.slopes[:, :, 0, 0] + 1j * known.slopes[:, :, 1, 0]
        np.testing.assert_allclose(
            unknown.columns[:, :, 0], magnitude - 1, rtol=0, atol=2e-4, err_msg=kind
        )
        slope = np.real(force.conj() * change) / magnitude
        np.testing.assert_allclose(
            unknown.slopes[:, :, 0, 0], slope, rtol=0, atol=2e-4, err_msg=kind
        )
        assert not np.any(unknown.columns[:, :, 1])
        # Every effect changes them but for one of phases alone.
        change = np.abs(unknown.columns - base)
        assert (np.max(change) < 1e-6) == (kind == "sensor_phase_error"), kind


def alone(predictions):
    """The baseline by itself."""
    group = predictions.group
    return predictions.of(group.values[None])


def test_phases_stated_as_unknown_are_not_used():
    model, data = files("blind_03")
    one, other = (predictions_of(model, without_phases(data, seed=k)).chosen.states for k in (0, 1))
    for name, a, b in zip(one._fields, one, other, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, err_msg=name)


def magnitudes(noise):
    """One part of every state, a harmonic."""
    n = len(noise)
    nowhere = np.zeros((1, 3), dtype=complex)
    return Magnitudes(np.ones((n, 1), complex), nowhere, noise[:, None], np.ones((n, 1), bool))


def test_small_harmonics_are_expected_as_noise_makes_them():
    true = np.array([0.0, 0.5, 1.0, 3.0, 8.0])
    rng, n, noise = np.random.default_rng(0), 400_000, 1.3
    errors = (rng.normal(size=(n, 1)) + 1j * rng.normal(size=(n, 1))) * noise / np.sqrt(2)
    measured = np.abs(true + errors)
    found = magnitudes(np.full(5, noise))
    columns = np.zeros((1, 5, 2))
    columns[0, :, 0] = true - 1
    slopes = np.zeros((1, 5, 2, 1))
    slopes[0, :, 0, 0] = 1.0
    expected, slope = found.compared(columns, slopes)
    # Five standard errors of the mean, and of the standard deviation.
    np.testing.assert_allclose(expected[0, :, 0] + 1, measured.mean(axis=0), atol=5 * noise / 632)
    std = found.own_std(np.zeros((5, 2)), found.phasors(columns)[0])[:, 0]
    np.testing.assert_allclose(std, measured.std(axis=0), rtol=0.01)
    step = 1e-6
    further = found.compared(columns + step, slopes)[0][0, :, 0]
    # A step in both parts: that normal to the phasor changes no magnitude to first order.
    np.testing.assert_allclose((further - expected[0, :, 0]) / step, slope[0, :, 0, 0], atol=1e-5)


def test_errors_are_propagated_to_magnitudes():
    model, data = files("blind_03")
    predictions = predictions_of(model, without_phases(data))
    group = predictions.group
    slopes, _ = predictions.by_error(group.values)
    data, step = without_phases(data), 1e-3
    louder, softer = (
        predictions_of(
            model, dataclasses.replace(data, velocity=np.exp(sign * step) * data.velocity)
        )
        for sign in (1, -1)
    )
    ends = [alone(p).columns[0, :, 0] for p in (louder, softer)]
    slope = (ends[0] - ends[1]) / (2 * step)
    # The force grows with the velocity, and more where the stiffness is cubic.
    # Central differences are off by the square of the step.
    np.testing.assert_allclose(slopes[:, 0, 1], slope, rtol=1e-4, atol=1e-4)
    # Differences over a step of 2.5e-5 are off by as much.
    np.testing.assert_allclose(slopes[:, 0, 0], -1.0, atol=4e-5)
    # Rotation by ε shortens parts by ε²/2; harmonic 3 rotates by 3ε.
    np.testing.assert_allclose(slopes[:, :2, 2], 0.0, atol=4e-5)
    np.testing.assert_allclose(slopes[:, 2:, 2], 0.0, atol=9 * 4e-5)


def test_the_hidden_damping_is_the_first_law_without_phases():
    """Magnitudes determine less: the law may be uncertain, or drawn."""
    found, key = stripped("blind_12")
    (truth,) = key["effects"]
    assert found.verdict.is_answer
    assert max(found.probabilities, key=found.probabilities.get) == truth
    assert truth in found.candidates[0]
    assert set(found.candidates[1:]) <= {("displacement_damping_law",)}
    value, std = found.parameters[f"{truth}.coefficient"]
    expected = key["parameters"][f"{truth}.coefficient"]
    assert abs(value - expected) < 4 * std
    assert value == pytest.approx(expected, rel=0.1)
    assert [part.part for part in found.located] == ["damping"]
    out = found.gap.interpolated
    assert found.gap.before > 1.5
    assert out.after - 1 < 0.25 * max(out.before - 1, 1.0)
    assert Fact("phases_unknown", n_states=36, of_states=36) in found.notes
    assert found.force_misfit.after.shape == (36, 2)
    assert np.isfinite(found.force_misfit.after[:, 0]).all()
    assert np.isnan(found.force_misfit.after[:, 1]).all()
    # The phases set to those of the answer are the measured ones.
    measured = np.angle(np.asarray(files("blind_12")[1].velocity)[:, 0])
    model, data = files("blind_12")
    misfit = weighted_misfit(predictions_of(model, without_phases(data)))
    one = candidate(truth, scales_of(misfit.predictions))
    fit = fit_effect(misfit, one._replace(starts=((value,),)))
    phase = np.angle(np.asarray(at_phases_of(misfit, fit).predictions.chosen.states.velocity)[:, 0])
    assert np.degrees(np.abs(phase - measured)).max() < 4  # 0.7° of noise, and the model's own


@pytest.mark.long
def test_an_error_of_the_phase_cannot_be_seen_without_phases():
    found, key = stripped("blind_09")
    assert key["effects"] == ["sensor_phase_error"]
    assert found.verdict == "none"
    assert Fact("sensor_phase_unseen") in found.notes


@pytest.mark.long
@pytest.mark.parametrize("name", ["blind_08", "blind_10"])
def test_a_hidden_gap_or_friction_is_in_the_answer_without_phases(name):
    found, key = stripped(name)
    assert found.verdict in ("named", "ambiguous")
    assert key["effects"][0] in found.candidates[0]
    assert found.gap.after == pytest.approx(1.0, abs=0.25)


def test_a_table_of_amplitudes_is_diagnosed(tmp_path):
    """No effect, with harmonics: nothing is found, and limits are given for what can be seen."""
    with (HERE / "blind" / "blind_03.csv").open() as file:
        rows = list(csv.DictReader(file))
    table = tmp_path / "amplitudes.csv"
    with table.open("w", newline="") as file:
        kept = [c for c in rows[0] if c not in ("velocity_re_m_s", "velocity_im_m_s")]
        writer = csv.DictWriter(file, [*kept, "velocity_m_s"], extrasaction="ignore")
        writer.writeheader()
        for row in rows:
            speed = np.hypot(float(row["velocity_re_m_s"]), float(row["velocity_im_m_s"]))
            writer.writerow(row | {"velocity_m_s": repr(float(speed))})
    out = tmp_path / "out"
    words = ["diagnose", table, "--model", HERE / "blind" / "blind_03.toml", "--out", out]
    done = CliRunner().invoke(app, [str(word) for word in words])
    assert done.exit_code == 0, done.output
    written = json.loads((out / "diagnosis.json").read_text())
    assert written["verdict"] == "none"
    assert written["effects"] == []
    assert written["gap"]["after"] == pytest.approx(1.0, abs=0.2)
    limits = written["detection_limits"]
    # Without phases, phase errors are invisible, and so are effects that only show in harmonics,
    # whose phases are relative to the fundamental.
    unlimited = {
        *("sensor_phase_error", "close_mode", "internal_resonance_1_2", "internal_resonance_1_3"),
        *("force_harmonics", "mode_shape_change"),
    }
    assert {name.split(".")[0] for name in limits} == set(EFFECTS) - unlimited
    assert all(0 < limit < np.inf for limit in limits.values())
    wanted = Fact("phases_unknown", n_states=50, of_states=50), Fact("harmonics_without_phase")
    assert set(map(str, wanted)) <= set(written["notes"])
    assert (out / "residuals.png").stat().st_size > 10_000
    # An effect at its limit changes χ² by the detection threshold to 2.5 times as much: in the
    # readings phases and the modal mass are free, in χ² they are not.
    model, data = files("blind_03")
    misfit = weighted_misfit(predictions_of(model, without_phases(data)))
    for kind in ("linear_damping_change", "linear_frequency_shift", "cubic_stiffness"):
        labels = parameter_labels(kind)
        (rows,), _ = misfit.evaluated(labels, np.array([[limits[labels[0]]]]))
        need = 10.0 + np.log(misfit.n_rows)
        assert need < misfit.chi_square(rows - misfit.base) < 2.5 * need, kind


@pytest.mark.long
def test_states_with_and_without_phases_stand_side_by_side():
    model = linear_model()
    found = sj.diagnose_model(model, without_phases(balanced(quadratic), slice(0, None, 2)))
    assert "quadratic_damping" in found.candidates[0]
    assert Fact("phases_unknown", n_states=23, of_states=45) in found.notes
    assert "sensor_phase_error.phase_deg" in found.detection_limits
    assert np.isnan(found.force_misfit.after[::2, 1]).all()
    assert np.isfinite(found.force_misfit.after[1::2]).all()
    assert np.isfinite(found.checks.p_value)


def test_amplitudes_count_once():
    model, data = linear_model(), without_phases(balanced(quadratic))
    misfit = weighted_misfit(predictions_of(model, data))
    assert misfit.n_rows == data.n_states
    assert magnitudes_of(misfit.predictions.chosen).alone.all()
    few = balanced(quadratic, levels=1, per_level=11)
    sj.diagnose_model(model, few)
    with pytest.raises(ValueError, match="or 12 where phases are unknown, not 11"):
        sj.diagnose_model(model, without_phases(few))


@pytest.mark.parametrize(
    "verb",
    [
        lambda model, data: sj.identify.identify_points(data, model.modes),
        lambda model, data: sj.fit_jointly(data, model.modes),
        lambda model, data: calibrate_model(model, data, ["mode_1.damping_ratio"]),
        inverse_force,
    ],
)
def test_functions_that_need_phases_refuse_data_without(verb):
    data = without_phases(balanced(quadratic), slice(0, 2))
    with pytest.raises(
        ValueError, match=r"needs the phases .* 2 of 45 .*`velocity_m_s`.*`snrmjax diagnose`"
    ):
        verb(linear_model(), data)
