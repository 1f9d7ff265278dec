"""Responses predicted by models for a test, against closed forms of a linear mode."""

import dataclasses

import equinox as eqx
import numpy as np
import pytest
from truths import one_mode

import snrmjax as sj
from snrmjax.diagnose import response_prediction
from snrmjax.diagnose.misfit.predictions import with_idle_effects
from snrmjax.diagnose.response_prediction import (
    LevelResponse,
    PhaseResonance,
    is_response_controlled,
    level_forces,
    measured_resonance,
    predicted_levels,
    responses,
    simulated_resonance,
)
from snrmjax.model.effects import EFFECTS, make_effect
from snrmjax.report.pages.resonance_table import resonance_in_words
from snrmjax.report.style import unit_for

OMEGA, ZETA, SHAPE = 2 * np.pi * 50.0, 0.01, 2.0
FORCES = (1.0, 4.0)
FEW = ("one_sided_stop", "quadratic_damping", "force_gain_error", "residual_mode")


def linear():
    """One mode with collocated force and sensor."""
    modes = sj.model.linear_modes([OMEGA], [ZETA], [[SHAPE]], [SHAPE])
    return sj.model.structure(modes)


def states(model, phases=(-40.0, -15.0, 20.0, 45.0)):
    """Exact states of the linear mode: V = iΩ·φ²F/(ω² − Ω² + 2iζωΩ)."""
    rows = []
    for level, force in enumerate(FORCES):
        for phase in np.radians(phases):
            # tan φ = (ω² − Ω²)/(2ζωΩ), solved for Ω.
            b = ZETA * OMEGA * np.tan(phase)
            frequency = -b + np.sqrt(b**2 + OMEGA**2)
            stiffness = OMEGA**2 - frequency**2 + 2j * ZETA * OMEGA * frequency
            rows.append((level, frequency, force, 1j * frequency * SHAPE**2 * force / stiffness))
    return sj.measure.steady_states(*(np.array(column) for column in zip(*rows, strict=True)))


def test_resonances_of_a_linear_mode_are_its_own():
    model = linear()
    data = states(model)
    curves = responses(model, data, FORCES)
    for level, force in enumerate(FORCES):
        exact = SHAPE**2 * force / (2 * ZETA * OMEGA)
        for found in (measured_resonance(data, level, 0), simulated_resonance(curves[level], 0)):
            # Ω is not quite straight against tan φ: ζ² tan φ₁ tan φ₂/2 is 5e-6 here.
            assert found.frequency == pytest.approx(50.0, rel=1e-5)
            assert found.velocity == pytest.approx(exact, rel=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("kinds", [FEW, tuple(EFFECTS)])
def test_without_strength_no_kind_has_an_effect(kinds):
    model, data = linear(), states(linear())
    same = with_idle_effects(model, kinds)
    assert [effect.kind for effect in same.effects] == list(kinds)
    for force, curves in zip(FORCES, responses(same, data, FORCES), strict=True):
        found = simulated_resonance(curves, 0)
        assert found.frequency == pytest.approx(50.0, rel=1e-9)
        assert found.velocity == pytest.approx(SHAPE**2 * force / (2 * ZETA * OMEGA), rel=1e-9)


def test_one_program_simulates_before_after_and_withheld_levels():
    model, data = linear(), states(linear())
    # ζ + Δ: at resonance the velocity is ζ/(ζ + Δ) of what it was.
    doubled, tripled = (
        dataclasses.replace(
            model, effects=(make_effect("linear_damping_change", {"damping_ratio_change": more}),)
        )
        for more in (ZETA, 2 * ZETA)
    )
    found = predicted_levels(model, doubled, data, 0, {1: tripled})
    assert len(found.before) == len(found.after) == 2
    rows = found.levels
    assert [row.withheld for row in rows] == [False, True]
    for row, factor in zip(rows, (2.0, 3.0), strict=True):
        tip = SHAPE**2 * row.force / (2 * ZETA * OMEGA)
        assert row.before.velocity == pytest.approx(tip, rel=1e-9)
        assert row.after.velocity == pytest.approx(tip / factor, rel=1e-9)
        assert row.completed.velocity == pytest.approx(tip / 2.0, rel=1e-9)  # withheld or not
    louder = predicted_levels(model, doubled, data, 0, force_gain=1.5).levels
    for row, same in zip(louder, rows, strict=True):
        assert row.before.velocity == pytest.approx(same.before.velocity, rel=1e-9)
        tip = SHAPE**2 * row.force / (2 * ZETA * OMEGA)
        assert row.after.velocity == pytest.approx(1.5 * tip / 2.0, rel=1e-9)


def test_responses_are_those_that_instruments_record():
    """Instrument errors change force and velocity, and shift the phase resonance."""
    chain = (
        make_effect("force_gain_error", {"gain": 0.2}),
        make_effect("force_offset_error", {"offset": 0.3}),
        make_effect("sensor_gain_error", {"gain": 0.1}),
        make_effect("sensor_phase_error", {"phase_deg": 5.0}),
        make_effect("mode_shape_change", {"coefficient": 1e4}),
    )
    model = dataclasses.replace(linear(), effects=chain)
    for force, curves in zip(FORCES, responses(model, states(linear()), FORCES), strict=True):
        seen = simulated_resonance(curves, 0)
        acting = 1.2 * (force + 0.3)  # the gain stands first: it acts first
        assert curves[0].force == pytest.approx(force, rel=1e-12)
        at = 2 * np.pi * seen.frequency
        q = SHAPE * acting / (OMEGA**2 - at**2 + 2j * ZETA * OMEGA * at)
        own = 1j * at * SHAPE * q
        assert np.degrees(np.angle(own)) == pytest.approx(-5.0, abs=0.02)
        speed = abs(own) * (1 + 1e4 * abs(q) ** 2) * 1.1
        assert seen.velocity == pytest.approx(speed, rel=1e-3)


def test_a_level_on_one_side_of_resonance_has_no_measured_one():
    assert np.isnan(measured_resonance(states(linear(), (10.0, 30.0)), 0, 0).frequency)


def jumped(n, early):
    w, force, v = one_mode.swept_up(n, early)
    return sj.measure.steady_states(np.zeros(n), w, force, v)


@pytest.mark.parametrize("n", [16, 30, 100])
def test_across_a_jump_no_resonance_was_measured(n):
    """A sweep that jumps down 1 % below the phase resonance, well before the fold."""
    data = jumped(n, 0.01)
    found = measured_resonance(data, 0, 0)
    assert np.isnan(found.frequency)
    low, high = found.jump
    resonance = np.sqrt(one_mode.OMEGA**2 + 0.75 * one_mode.STEEP) / (2 * np.pi)
    assert low < resonance * (1 - 0.01) < high
    # The force is that of the last state before it.
    falling = eqx.tree_at(lambda d: d.force, data, data.force * np.linspace(1, 0.5, n))
    last = int(np.argmin(np.abs(np.asarray(data.frequency) / (2 * np.pi) - low)))
    assert level_forces(falling)[0] == pytest.approx(float(falling.force[last]), rel=1e-12)


@pytest.mark.parametrize("n", [40, 80, 160])
def test_where_the_states_reach_resonance_before_they_fall_it_is_measured(n):
    """It jumps at the fold, 0.05 % above the resonance: bracketed by few states or none."""
    found = measured_resonance(jumped(n, 0.0), 0, 0)
    resonance = np.sqrt(one_mode.OMEGA**2 + 0.75 * one_mode.STEEP) / (2 * np.pi)
    spacing = 0.3 * 60 / (n - 1)  # Hz
    assert found.jump is not None or abs(found.frequency - resonance) < spacing


def test_coarse_states_of_one_branch_are_no_jump():
    found = measured_resonance(states(linear(), (-70.0, -50.0, 50.0, 70.0)), 0, 0)
    assert found.jump is None
    # ζ² tan φ₁ tan φ₂/2 is 7e-5: Ω is not quite straight against tan φ.
    assert found.frequency == pytest.approx(50.0, rel=1e-4)


def test_a_jump_past_a_resonance_is_reported_instead():
    nothing = PhaseResonance(np.nan, np.nan, jump=(61.8, 62.1))
    assert "jump over it, 61.8" in resonance_in_words(nothing, unit_for([1.0], "m/s"))


def test_a_force_that_drops_at_resonance_is_no_response_control():
    data = states(linear(), (-60.0, -40.0, -15.0, 15.0, 40.0, 60.0))
    row = LevelResponse(0, FORCES[0], *(3 * [PhaseResonance(50.0, 1.0)]), False)
    rows = [row, row._replace(level=1, force=FORCES[1])]
    assert not is_response_controlled(data, rows)
    cosine, force = np.cos(np.angle(np.asarray(data.velocity)[:, 0])), np.asarray(data.force)
    drops = eqx.tree_at(lambda d: d.force, data, data.force * (1 - 0.3 * cosine))
    assert not is_response_controlled(drops, rows)
    controlled = eqx.tree_at(
        lambda d: (d.force, d.velocity),
        data,
        (data.force / cosine, data.velocity / cosine[:, None]),
    )
    assert is_response_controlled(controlled, rows)
    # At phase resonance, with a damping that grows with the amplitude, both change.
    speed = np.geomspace(1.0, 30.0, len(force))
    ladder = eqx.tree_at(lambda d: (d.force, d.velocity), data, (speed**1.2, speed[:, None] + 0j))
    assert not is_response_controlled(ladder, rows)


def test_of_many_levels_some_are_simulated_from_the_smallest_to_the_largest_force():
    forces = {level: float((7 * level) % 71 + 1) for level in range(71)}
    some = response_prediction._spread(forces, {3})
    assert {min(forces, key=forces.get), max(forces, key=forces.get), 3} <= {*some}
    assert 12 <= len(some) <= 13
    gaps = np.diff(sorted(some[level] for level in some if level != 3))
    assert gaps.max() <= 7
    assert response_prediction._spread({1: 2.0, 2: 1.0}, set()) == {1: 2.0, 2: 1.0}


def test_the_force_of_a_level_is_that_at_its_resonance():
    data = states(linear(), (-40.0, -10.0, 10.0, 40.0))
    # Response control requires more force off resonance.
    controlled = data.force * np.tile([1.4, 1.1, 1.1, 1.4], len(FORCES))
    found = level_forces(eqx.tree_at(lambda d: d.force, data, controlled))
    assert found == pytest.approx({0: 1.1 * FORCES[0], 1: 1.1 * FORCES[1]})
    aside = states(linear(), (10.0, 40.0))
    assert level_forces(aside) == pytest.approx(dict(enumerate(FORCES)))


def test_without_phases_a_resonance_is_the_largest_velocity_over_force():
    model = linear()
    known = states(model, phases=(-40.0, -15.0, 5.0, 45.0))
    blind = dataclasses.replace(
        known,
        velocity=np.abs(known.velocity) + 0j,
        phase_std=np.full(known.velocity.shape, np.pi),
    )
    assert level_forces(blind) == dict(enumerate(FORCES))
    for level, force in enumerate(FORCES):
        found = measured_resonance(blind, level, 0)
        # The state 5° off resonance: |V| is that at resonance times cos 5°.
        tip = SHAPE**2 * force / (2 * ZETA * OMEGA)
        assert found.velocity == pytest.approx(tip * np.cos(np.radians(5)), rel=1e-9)
        assert found.frequency == pytest.approx(OMEGA / (2 * np.pi), rel=1e-3)
    # States on one side do not determine the resonance.
    side = states(model, phases=(10.0, 30.0, 50.0))
    side = dataclasses.replace(side, phase_std=np.full(side.velocity.shape, np.pi))
    assert np.isnan(measured_resonance(side, 0, 0).frequency)


def test_a_response_that_ends_early_is_reported(monkeypatch):
    model, data = linear(), states(linear())
    damped = make_effect("linear_damping_change", {"damping_ratio_change": ZETA})
    doubled = dataclasses.replace(model, effects=(damped,))
    assert all(row.complete for row in predicted_levels(model, doubled, data, 0).levels)

    def ended(*asked):
        found = responses(*asked)
        early = sj.simulate.CurveStatus.POINT_LIMIT
        found[3] = [dataclasses.replace(curve, status=early) for curve in found[3]]
        return found

    monkeypatch.setattr(response_prediction, "responses", ended)
    rows = predicted_levels(model, doubled, data, 0).levels
    assert [row.complete for row in rows] == [True, False]
