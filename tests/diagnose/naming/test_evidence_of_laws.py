"""Evidences and fractions of a small test whose truth is known, against dense linear algebra."""

import numpy as np
import pytest
from truths.phased_states import (
    OMEGA,
    RATIO,
    SHAPE,
    dynamic,
    linear_motion,
    named,
    nothing,
    readings,
    states_of,
)

from snrmjax.diagnose import priors
from snrmjax.diagnose.naming import hypotheses, parts
from snrmjax.diagnose.naming.columns import hypothesis_columns
from snrmjax.diagnose.naming.evidence import remainder_stds
from snrmjax.diagnose.naming.hypotheses import hypotheses_of
from snrmjax.diagnose.naming.parts import Remainder
from snrmjax.diagnose.naming.remainder_law import remainder_laws
from snrmjax.diagnose.naming.rows import Cell, problem_of, solved
from snrmjax.diagnose.readings import ModelMotion, readings_of
from snrmjax.model.effects import EFFECTS

LAWS = ("cubic_stiffness", "quintic_stiffness", "quadratic_damping", "coulomb_friction")


def test_an_evidence_is_that_of_the_dense_gaussian():
    read = readings(lambda x: 0.02 * x**2, nothing)
    problem = problem_of(read, hypothesis_columns(read, LAWS), 1.0)
    stds = (float(priors.REMAINDERS[4]), 0.0)
    cells = {
        c.columns: c for c in hypotheses._compared(problem, reach=1e6)[0] if c.remainder_std == stds
    }
    (block,) = problem.blocks
    base = block.design * np.sqrt(block.variances(stds))
    noise = np.eye(len(read.rows)) + base @ base.T

    def log_density(covariance):
        factor = np.linalg.cholesky(covariance)
        white = np.linalg.solve(factor, read.rows)
        return -0.5 * white @ white - np.sum(np.log(np.diag(factor)))

    # Cubic stiffness against none: the mixture over strengths, one by one.
    column = block.laws[:, [0]]
    each = [log_density(noise + s**2 * column @ column.T) for s in priors.STRENGTHS]
    alone = log_density(noise)
    wanted = np.logaddexp.reduce(each) - np.log(len(each)) - alone
    wanted += np.log(priors.EFFECT_COUNTS[1] / len(LAWS)) - np.log(priors.EFFECT_COUNTS[0])
    found = cells[0,].log_evidence - cells[()].log_evidence
    assert found == pytest.approx(wanted, abs=1e-4)


def test_an_evidence_counts_strengths_between_limits():
    """Against quadrature of the dense density over the strength, for each interval of a gain."""
    read = readings(lambda x: 3e-4 * x**2, nothing)
    problem = problem_of(read, hypothesis_columns(read, ["sensor_gain_error"]), 1.0)
    stds = (0.0, 0.0)
    cells = {
        c.columns: c for c in hypotheses._compared(problem, reach=1e6)[0] if c.remainder_std == stds
    }
    (block,) = problem.blocks
    base = block.design * np.sqrt(block.variances(stds))
    factor = np.linalg.cholesky(np.eye(len(read.rows)) + base @ base.T)
    for k, column in enumerate(problem.columns):
        low, high = np.clip(column.limits, -12, 12)  # of 1σ each
        near = np.geomspace(1e-9, high - low, 20001)  # where the density may be steep
        strength = np.unique([*np.linspace(low, high, 20001), *(low + near), *(high - near)])
        left = read.rows[:, None] - block.laws[:, [k]] * strength
        density = -0.5 * np.sum(np.linalg.solve(factor, left) ** 2, axis=0) - 0.5 * strength**2
        width = np.diff(strength) / np.sqrt(2 * np.pi)
        each = np.logaddexp(density[1:], density[:-1]) + np.log(width / 2)  # the trapezoidal rule
        wanted = np.logaddexp.reduce(each)
        wanted += 0.5 * np.sum(np.linalg.solve(factor, read.rows) ** 2)
        wanted += np.log(priors.EFFECT_COUNTS[1]) - np.log(priors.EFFECT_COUNTS[0])
        found = cells[k,].log_evidence - cells[()].log_evidence
        assert found == pytest.approx(wanted, abs=2e-3)


def test_strengths_are_those_of_least_squares_where_nothing_else_is_unknown():
    read = readings(lambda x: 0.02 * x**2, nothing, noise=1e-5)
    problem = problem_of(read, hypothesis_columns(read, LAWS), 1.0)
    found = solved(problem, Cell(0.0, (0,), (0.0, 0.0)))
    assert found.mean[0] == pytest.approx(0.02, rel=0.02)


@pytest.mark.parametrize(
    ("stiffness", "damping", "effects"),
    [
        (lambda x: 0.02 * x**2, nothing, ("cubic_stiffness",)),
        (lambda x: 0.02 * x**4, nothing, ("quintic_stiffness",)),
        (nothing, lambda x, om: 0.01 * x * om, ("quadratic_damping",)),
        (lambda x: -0.01 * x**2, lambda x, om: 0.003 / (x * om), ("coulomb_friction",)),
        (nothing, nothing, ()),
    ],
)
def test_an_exact_law_is_named_and_explains_all(stiffness, damping, effects):
    _, found = named(stiffness, damping)
    for part in found.parts[:2]:
        if part.verdict != "none":
            assert part.explained is not None
            assert part.explained.high > 0.98
    assert set(effects) <= {kind for group in found.candidates for kind in group}
    assert effects != () or all(part.verdict == "none" for part in found.parts)
    assert sum(found.answers.values()) == pytest.approx(1.0)


def test_a_law_with_a_fifth_from_elsewhere_is_listed_with_its_fraction_and_the_rest_is_drawn():
    def bump(x):
        return 0.03 * x**2 + 0.006 * np.exp(-0.5 * ((x - 0.35) / 0.1) ** 2)

    problem, found = named(bump, nothing, noise=5e-4, levels=15)
    part = found.parts[0]
    assert "cubic_stiffness" in part.effects
    x = problem.readings.relative_amplitude
    true = 1 - np.std(bump(x) - 0.03 * x**2) / np.std(bump(x))
    assert part.explained.low - 0.05 < true < part.explained.high + 0.05
    assert part.remainder.significant


def test_a_change_that_no_law_follows_is_drawn():
    def waves(x):
        return 0.02 * np.sin(5 * np.log(x))

    _, found = named(waves, nothing, noise=5e-4, levels=10)
    assert found.parts[0].verdict == "drawn"
    assert found.parts[0].remainder.significant


def test_the_force_of_a_remainder_has_its_describing_function():
    def waves(x):
        return 0.02 * np.sin(3 * np.log(x))

    problem, found = named(waves, nothing, noise=2e-4, levels=10)
    part = found.parts[0]
    (law,) = remainder_laws(problem, {"stiffness": part.remainder})
    t = (np.arange(2000) + 0.5) * 2 * np.pi / 2000
    left = part.remainder
    for k in (0, 20, 40, 55, -1):
        a = problem.readings.largest * left.velocity[k] / left.velocity[-1]
        force = np.array(law.cycle_force(a * np.cos(t), -a * OMEGA * np.sin(t)))
        stiffness = 2 * np.mean(force * np.cos(t)) / a / OMEGA**2
        assert stiffness == pytest.approx(left.value[k], abs=0.05 * np.ptp(left.value))


def test_the_force_of_an_uncertain_remainder_is_smooth_and_right_at_the_top():
    """A cubic spring, 0.02 x² on average, ± 5 % of its largest value, with errors of half that."""
    problem, _ = named(nothing, nothing, noise=2e-4, levels=10)
    x = np.geomspace(0.02, 1.0, 60)
    errors = 5e-4 * np.cos(5 * np.arange(60))
    curves = {"laws": 0 * x, "state_velocity": x, "state_change": x}
    part = Remainder(
        x, 0.02 * x**2 + errors, std=1e-3 + 0 * x, rms=0.01, significant=True, **curves
    )
    (law,) = remainder_laws(problem, {"stiffness": part})
    t = (np.arange(2000) + 0.5) * 2 * np.pi / 2000
    largest = problem.readings.largest
    force = np.array(law.cycle_force(largest * np.cos(t), -largest * OMEGA * np.sin(t)))
    top = 2 * np.mean(force * np.cos(t)) / largest / OMEGA**2
    assert top == pytest.approx(0.02, abs=6e-4)
    secant = np.asarray(law.restoring_force / law.displacement) / OMEGA**2
    knots = np.asarray(law.displacement) / largest
    # Least squares that follow the errors are off by 7e-4.
    assert np.max(np.abs(secant - 0.02 * 4 / 3 * knots**2)) < 5e-4


def test_pairs_left_out_are_irrelevant():
    """With and without the bound on pairs the probable hypotheses are the same."""
    read = readings(lambda x: 0.02 * x**2, lambda x, om: 0.004 * x * om)
    problem = problem_of(read, hypothesis_columns(read, LAWS), 1.0)
    first = hypotheses_of(problem)
    few = remainder_stds(2)
    for one in [c for c in first if len(c.columns) == 2][:5]:
        assert set(one.remainder_std) <= set(few)
    top = first[0]
    assert {problem.columns[k].kind for k in top.columns} == {
        "cubic_stiffness",
        "quadratic_damping",
    }


@pytest.mark.parametrize("seed", [0, 1])
def test_friction_is_found_where_errors_of_levels_are_unknown(seed):
    """Near resonance friction changes the damping steeply, which level errors must not absorb.

    An offset of the force has the same effect there: either of them may be the answer.
    """
    test = {"phases": (-4.0, -2.5, -1, 1, 2.5, 4), "level_std": (0.0,) * 4, "noise": 1e-2}
    friction = (lambda x: 0.1 * x**2), (lambda x, om: 2 * RATIO * 0.01 / (x * om))
    _, found = named(*friction, levels=6, seed=seed, **test)
    assert found.answers.get(("cubic_stiffness",), 0.0) < 0.02
    damping = next(one for one in found.parts if one.part == "damping")
    assert damping.verdict in ("named", "ambiguous")
    (group,) = damping.candidates
    assert "coulomb_friction" in group
    assert {*group} <= {"coulomb_friction", "force_offset_error"}


def test_states_are_drawn_without_the_error_of_an_instrument():
    """With a phase error of 3° corrected, the states lie on the curve of the cubic spring."""
    read = readings(lambda x: 0.1 * x**2, nothing)
    beyond = read.beyond - 1j * np.radians(3) * read.dynamic_stiffness
    recorded = read._replace(rows=read.whitened(beyond), beyond=beyond)
    problem, cells = hypotheses.best_hypotheses(recorded, EFFECTS)
    found = parts.naming_of(problem, cells)
    assert "sensor_phase_error" in found.effects
    part = next(one for one in found.parts if one.part == "stiffness")
    wanted = 0.1 * read.relative_amplitude**2
    np.testing.assert_allclose(part.remainder.state_change, wanted, atol=1e-3)
    x = part.remainder.velocity / part.remainder.velocity[-1]
    at_states = np.interp(read.relative_amplitude, x, part.remainder.laws)
    np.testing.assert_allclose(at_states, wanted, atol=2e-3)


@pytest.mark.parametrize(
    ("kind", "power", "gain"),
    [
        ("sensor_gain_error", 0, 0.13),
        ("sensor_gain_error", 0, -0.13),
        ("sensor_gain_error", 0, 0.4),
        ("mode_shape_change", 2, 0.15),
        ("mode_shape_change", 2, -0.12),
    ],
)
def test_a_large_gain_of_motions_is_found_by_the_known_stiffness(kind, power, gain):
    """Recorded amplitudes are (1 + g xᵖ) times true ones; the model is an exact cubic spring."""
    states = states_of(lambda x: 0.3 * x**2, nothing)
    amplitude = np.abs(states.velocity) / states.frequency
    largest = np.max(amplitude)

    def motion(velocity, omega):
        x = np.abs(velocity) / omega / largest
        z = dynamic(omega) + 0.3 * x**2 * OMEGA**2
        return ModelMotion(z[None], np.zeros((1, len(omega), 2), complex))

    factor = 1 + gain * (amplitude / largest) ** power
    recorded = states._replace(velocity=states.velocity * factor)
    linear = readings(nothing, nothing).linear
    read = readings_of(recorded, np.zeros(len(factor)), motion, linear)
    found = parts.naming_of(*hypotheses.best_hypotheses(read, EFFECTS))
    assert found.candidates == ((kind,),)
    strength = next(iter(found.parameters.values()))
    wanted = gain if power == 0 else gain / (largest / SHAPE) ** 2
    # The model's stiffness is interpolated between amplitudes: half a per cent of a large gain.
    within = max(3 * strength.std, 5e-3 * abs(wanted) * (abs(gain) > 0.2))
    assert strength.value == pytest.approx(wanted, abs=within)
    assert strength.std < 0.1 * abs(wanted)


@pytest.mark.parametrize("gain", [0.1, 0.4])
def test_one_linear_mode_does_not_tell_the_gain_of_the_sensor_from_that_of_the_force(gain):
    """X (1 + g) and F/(1 + g) are the same receptance."""
    states = states_of(nothing, nothing)
    recorded = states._replace(velocity=states.velocity * (1 + gain))
    linear = readings(nothing, nothing).linear
    read = readings_of(recorded, np.zeros(len(states.level)), linear_motion, linear)
    found = parts.naming_of(*hypotheses.best_hypotheses(read, EFFECTS))
    assert {*found.candidates[0]} == {"sensor_gain_error", "force_gain_error"}


@pytest.mark.parametrize(
    ("kind", "strength", "exact"),
    [
        ("linear_frequency_shift", 1.01**2 - 1, lambda om: (1.01**2 - 1, 1.01 - 1, 0.0)),
        ("added_mass", 0.01 / priors.ADDED_MASS, lambda om: (-(om**2) * 0.01, 0.0, 0.0)),
        ("linear_damping_change", 0.002, lambda om: (0.0, 0.0, 0.002)),
    ],
)
def test_a_change_of_the_linear_mode_is_that_of_its_equation_of_motion(kind, strength, exact):
    """Z/ω₀² = (1 + s)² − Ω²(1 + m) + 2iζ(1 + s)Ω + icΩ."""
    read = readings(nothing, nothing)
    (column,) = hypothesis_columns(read, [kind])
    omega = read.relative_frequency
    stiffness, damping, further = exact(omega)
    wanted = stiffness + 1j * omega * (2 * RATIO * damping + further)
    np.testing.assert_allclose(strength * column.change * column.scale, wanted, rtol=6e-3)


def test_readings_do_not_change_with_units_of_force():
    """A force in other units with the modal constant in theirs is the same test."""
    states = states_of(lambda x: 0.02 * x**2, nothing)
    other = states._replace(force=10 * states.force, constant=0.1 * states.constant)
    linear = readings(lambda x: 0.02 * x**2, nothing).linear
    rows = [
        readings_of(one, np.zeros(len(one.level)), linear_motion, linear).rows
        for one in (states, other)
    ]
    np.testing.assert_allclose(rows[0], rows[1], rtol=1e-6, atol=1e-6)


def test_harmonics_respond_at_the_natural_frequency_of_their_level():
    """Levels are recorded at 1 % more and less in turn, as in a warm and a cold room."""
    states = states_of(
        lambda x: 0.02 * x**2, nothing, levels=12, level_std=(1e-3, 1e-3, 2e-2, 1e-3)
    )
    factor = 1 + 0.01 * (-1.0) ** states.level
    linear = readings(lambda x: 0.02 * x**2, nothing).linear
    # All frequencies of a level scale together, and the force with their square.
    recorded = states._replace(
        frequency=states.frequency * factor,
        velocity=states.velocity * factor,
        force=states.force * factor**2,
    )
    read = readings_of(recorded, np.zeros(len(factor)), linear_motion, linear)
    true = states.frequency / linear.natural_frequency
    assert np.std(read.relative_frequency / true) > 9e-3
    assert np.std(read.frequency_over_level / true) < 4e-3


def test_three_laws_together_are_found():
    """The third extends the best pair; a shift of the linear mode is no remainder."""
    read = readings(lambda x: 0.02 + 0.02 * x**2, lambda x, om: 0.01 * x * om, levels=8)
    kinds = ("cubic_stiffness", "quintic_stiffness", "quadratic_damping", "linear_frequency_shift")
    problem, cells = hypotheses.best_hypotheses(read, kinds)
    laws = {problem.columns[k].kind for k in cells[0].columns}
    assert laws == {"cubic_stiffness", "quadratic_damping", "linear_frequency_shift"}


@pytest.mark.parametrize("power", [0.6, 1.0])
def test_the_fraction_of_a_law_is_right_with_another_power_of_the_amplitude(power):
    """The fraction is one less the standard deviation of the rest over that of the change."""
    law, other = 0.02, 0.005

    def stiffness(x):
        return law * x**2 + other * x**power

    problem, found = named(stiffness, nothing)
    part, x = found.parts[0], problem.readings.relative_amplitude
    true = 1 - np.std(other * x**power) / np.std(stiffness(x))
    assert part.effects == ("cubic_stiffness",)
    assert part.explained.low < true < part.explained.high
    assert part.explained.high - part.explained.low < 0.55


def test_a_drift_of_the_test_is_no_part_of_what_a_law_explains():
    """A drift as large as the law's own change is an error of the instrument."""
    read = readings(lambda x: 0.02 * x**2, nothing)
    drifted = read.whitened(0.02 * read.order * read.natural_frequency**2 + 0j)
    read = read._replace(rows=read.rows + drifted)
    kinds = ("cubic_stiffness", "quintic_stiffness", "frequency_drift")
    found = parts.naming_of(*hypotheses.best_hypotheses(read, kinds))
    stiffness, *_, instrument = found.parts
    assert (stiffness.effects, instrument.effects) == (("cubic_stiffness",), ("frequency_drift",))
    assert stiffness.verdict == "named"
    assert stiffness.explained.value > 0.95


def test_laws_of_many_shapes_keep_their_probability():
    """300 gaps with half of the probability together, and a spring with the other half."""
    read = readings(lambda x: 0.02 * x**2, nothing)
    columns = hypothesis_columns(read, ["gap_stiffness", "cubic_stiffness"])
    problem = problem_of(read, columns, 1.0)
    (spring,) = (k for k, column in enumerate(columns) if column.kind == "cubic_stiffness")
    gaps = [k for k in range(len(columns)) if k != spring]
    cells = [Cell(np.log(300.0), (spring,), (0.0, 0.0))]
    cells += [Cell(0.0, (gaps[k % len(gaps)],), (0.0, 0.0)) for k in range(300)]
    chosen = parts._representative(problem, cells)
    assert len(chosen) < 150
    assert sum(w for cell, w in chosen if cell.columns == (spring,)) == pytest.approx(0.5)
    assert sum(w for cell, w in chosen if cell.columns != (spring,)) == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("fraction", "with_a_rest", "with_noise"),
    [
        ((0.43, 0.0, 0.81), False, False),  # a wire's quintic spring, measured
        ((0.6, 0.2, 0.9), False, True),
        ((0.6, 0.5, 0.7), False, False),
        ((0.9, 0.4, 1.0), False, True),
        ((0.9, 0.7, 1.0), True, True),
    ],
)
def test_a_law_is_named_where_it_explains_most(fraction, with_a_rest, with_noise):
    """80 % and at least half; over noise at least half and possibly 80 %."""
    explained = parts.Explained(*fraction)
    assert explained.is_most(rest_is_noise=False) is with_a_rest
    assert explained.is_most(rest_is_noise=True) is with_noise


def test_odds_of_a_remainder_are_those_of_the_dense_gaussian():
    read = readings(lambda x: 0.02 * x**2 + 0.004 * np.sin(4 * x), nothing)
    problem = problem_of(read, hypothesis_columns(read, LAWS), 1.0)
    (block,) = problem.blocks

    def log_density(stds):
        base = block.design * np.sqrt(block.variances(stds))
        law = block.laws[:, [0]]
        root = np.linalg.cholesky(np.eye(len(read.rows)) + base @ base.T + law @ law.T)
        white = np.linalg.solve(root, read.rows)
        return -0.5 * white @ white - np.sum(np.log(np.diag(root)))

    stds = (float(priors.REMAINDERS[5]), 0.0)
    cell = Cell(0.0, (0,), stds)
    odds = parts.log_odds_of_remainder(problem, cell, solved(problem, cell), "stiffness")
    assert odds == pytest.approx(log_density(stds) - log_density((0.0, 0.0)), rel=1e-6)
