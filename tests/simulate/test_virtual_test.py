"""The virtual test: which states it records, that they are true, and what errors it adds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from snrmjax.model.beams import CURVED_BEAM_FORCES, curved_beam
from snrmjax.model.modes import linear_response
from snrmjax.simulate.virtual_test import MeasurementErrors, phase_resonance_test

HZ = 2 * np.pi
RANGE = (30 * HZ, 110 * HZ)
FORCES = CURVED_BEAM_FORCES[:2]
TINY = (1e-9, 2e-9)  # N: nonlinear terms change the response by 1e-6 and less


def run(forces=FORCES, **options):
    """The curved beam's test with what is compiled already: two levels of eight states."""
    options = {"points_per_level": 8} | options
    return phase_resonance_test(curved_beam(), forces, *RANGE, **options)


@pytest.fixture(scope="module")
def exact():
    return run(keep_harmonics=(2, 3))


def phases(states):
    return np.angle(np.asarray(states.velocity)[:, 0])


def distinct(states):
    """How many different states there are."""
    rows = np.stack([states.level, states.frequency, np.abs(states.velocity[:, 0])], axis=1)
    return len(np.unique(np.round(rows, 6), axis=0))


# ------------------------------------------------------------------------------ which and how true


@pytest.mark.parametrize("appropriation", [(0.5, 0.7), (0.0, 1.0), (0.7, 0.99)])
def test_states_lie_inside_the_range_and_are_different(appropriation):
    states = run(appropriation=appropriation).steady_states
    # One sensor and one mode: the sensor's phase is the mode's. The states are the middles of
    # equal parts of the range: inside by half a part, less what interpolation misses (1e-3).
    indicator = np.cos(phases(states)) ** 2
    assert np.all((indicator >= appropriation[0]) & (indicator <= appropriation[1]))
    assert np.all(np.cos(phases(states)) > 0)  # near resonance, not opposite to it
    assert states.level.tolist() == [1] * 8 + [2] * 8
    assert distinct(states) == 16
    np.testing.assert_array_equal(states.force, np.repeat(FORCES, 8))


def test_a_superharmonic_resonance_is_passed_over():
    # At 1.8 mN the phase comes back to 42° at 27.6 Hz, a quarter of the resonance's frequency,
    # on a branch that a sweep from 8 Hz visits.
    test = phase_resonance_test(curved_beam(), [1.8e-3], 8 * HZ, 140 * HZ)
    (curve,) = test.curves
    phase = np.angle(curve.velocity[:, 1, 0])
    below = curve.stable & (curve.frequency < 40 * HZ)
    assert np.any(below & (np.cos(phase) ** 2 > 0.5)), "there is nothing to pass over"
    assert np.all(test.steady_states.frequency > 80 * HZ)
    assert len(test.steady_states.frequency) == 5


def test_a_linear_structure_is_recorded_evenly_and_exactly():
    states = run(TINY).steady_states
    model = curved_beam()
    wanted = linear_response(model.modes, states.frequency, states.force)
    # The nonlinear terms: αQ/ω² = 3.4e9·1e-9·3342/(0.1·4e5²)… ≈ 1e-4, in second order 1e-7.
    np.testing.assert_allclose(states.velocity, wanted, rtol=1e-5)
    # 0.5 ≤ cos² ≤ 0.7 is 0.5796 ≤ |phase| ≤ π/4, of which four states take the middles.
    ends = np.arccos(np.sqrt([0.7, 0.5]))
    middles = ends[0] + (ends[1] - ends[0]) * (np.arange(4) + 0.5) / 4
    for level in (1, 2):
        found = np.sort(phases(states)[np.asarray(states.level) == level])
        # Linear interpolation along a step of 0.08 rad misses by 0.08²/8.
        np.testing.assert_allclose(found, np.concatenate([-middles[::-1], middles]), atol=1e-3)


def test_recorded_states_are_settled_motions(exact, time_domain, state_of):
    """Integrated from the nearest point of the curve, the motion settles to what was recorded."""
    model, states = curved_beam(), exact.steady_states
    shape = float(model.modes.mode_shape[0, 0])
    for row in (0, 6, 9, 13):
        omega, force = float(states.frequency[row]), float(states.force[row])
        curve = exact.curves[int(states.level[row]) - 1]
        recorded = complex(states.velocity[row, 0])
        distance = np.abs(curve.frequency / omega - 1) + np.abs(
            curve.velocity[:, 1, 0] / recorded - 1
        )
        near = int(np.argmin(distance))
        truth = time_domain(model, force, omega)
        period = 2 * np.pi / omega
        # 30 periods of ζ = 0.05 leave e^{−9} of a distance of 2 %.
        start = state_of(curve.coefficients[near], curve.frequency[near])
        settled = truth.integrate(start, 30 * period, rtol=1e-8)[-1][0]
        times = np.arange(64) * period / 64
        orbit = truth.integrate(settled, times[-1], rtol=1e-10, t_eval=times)[:, 0, 1] * shape
        spectrum = np.fft.rfft(orbit) / 32
        # Nine harmonics of this strong motion leave up to 3e-4 (see the closed orbits).
        assert spectrum[1] == pytest.approx(recorded, rel=1e-3)
        for place, order in enumerate((2, 3)):
            got = complex(states.harmonics[row, 0, place])
            assert abs(spectrum[order] - got) < 1e-3 * abs(recorded)


def test_states_between_two_branches_are_not_reached(exact):
    # Where a test jumps, it leaves at a fold of the curve, within one step of it.
    for level, frequency in exact.jumps:
        curve = exact.curves[level - 1]
        folds = curve.frequency[curve.at_events("fold")]
        unstable = curve.frequency[~curve.stable]
        ends = np.concatenate([folds, unstable])
        assert np.abs(ends / frequency - 1).min() < 0.03
    assert {level for level, _ in exact.jumps} == {1, 2}
    # All phases: the unstable middle part of both curves stays empty.
    everywhere = run(appropriation=(0.0, 1.0))
    for level, curve in enumerate(everywhere.curves, start=1):
        chosen = np.asarray(everywhere.steady_states.level) == level
        found = phases(everywhere.steady_states)[chosen]
        frequency = np.asarray(everywhere.steady_states.frequency)[chosen]
        phase = np.angle(curve.velocity[:, 1, 0])
        for p, f in zip(found, frequency, strict=True):
            # The two neighbours on the curve that enclose the state are both stable.
            between = (phase[:-1] - p) * (phase[1:] - p) <= 1e-12
            between &= (curve.frequency[:-1] - f) * (curve.frequency[1:] - f) <= 1e-6
            assert np.any(between & curve.stable[:-1] & curve.stable[1:])


# ------------------------------------------------------------------------------------- errors


def test_without_errors_nothing_is_stated(exact):
    states = exact.steady_states
    assert np.all(np.isnan(states.velocity_std))
    assert np.all(np.isnan(states.phase_std))
    assert np.all(np.isnan(states.force_std))
    assert np.all(np.isnan(states.harmonic_std))
    assert np.all(states.measured)
    assert states.harmonic_order == (2, 3)
    assert states.sensors == ("midspan",)


def test_errors_are_drawn_from_the_seed():
    errors = MeasurementErrors(amplitude=0.01, phase=0.01, force=0.01, level_gain=0.01)
    first, again, other = (run(errors=errors, seed=seed).steady_states for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.velocity, again.velocity)
    np.testing.assert_array_equal(first.force, again.force)
    assert not np.any(first.velocity == other.velocity)
    assert not np.any(first.force == other.force)
    np.testing.assert_array_equal(first.frequency, other.frequency)  # known exactly


def test_errors_have_the_stated_sizes():
    many = {"points_per_level": 40, "keep_harmonics": (2, 3)}
    errors = MeasurementErrors(amplitude=0.02, phase=0.03, force=0.015, harmonic=1e-4)
    truth = run(TINY, **many).steady_states
    tests = [run(TINY, errors=errors, seed=seed, **many).steady_states for seed in range(10)]
    noisy = jax.tree.map(lambda *parts: np.concatenate(parts), *tests)
    truth = jax.tree.map(lambda part: np.concatenate([part] * 10), truth)
    ratio = (noisy.velocity / truth.velocity)[:, 0]
    n = len(ratio)
    assert n == 800
    drawn = {
        "amplitude": np.abs(ratio) - 1,
        "phase": np.angle(ratio),
        "force": noisy.force / truth.force - 1,
    }
    # 800 draws: the standard deviation is known to 1/√1600 = 2.5 %, the mean to σ/28; four of each.
    for name, values in drawn.items():
        sigma = getattr(errors, name)
        assert np.std(values) == pytest.approx(sigma, rel=0.1), name
        assert abs(np.mean(values)) < 4 * sigma / np.sqrt(n), name
    # Independent of each other and from row to row: correlations below 4/√800.
    table = np.stack([*drawn.values(), np.roll(drawn["amplitude"], 1)])
    correlation = np.corrcoef(table) - np.eye(4)
    assert np.abs(correlation).max() < 4 / np.sqrt(n)
    # The harmonics of so small a motion vanish: what is recorded is the error, rms as stated.
    harmonics = noisy.harmonics[:, 0]
    assert np.abs(truth.harmonics).max() < 1e-6 * errors.harmonic
    for part in harmonics.T:
        assert np.sqrt(np.mean(np.abs(part) ** 2)) == pytest.approx(errors.harmonic, rel=0.1)
        assert np.std(part.real) == pytest.approx(errors.harmonic / np.sqrt(2), rel=0.12)
    # And the table says so.
    np.testing.assert_allclose(noisy.velocity_std, 0.02 * np.abs(noisy.velocity), rtol=1e-14)
    np.testing.assert_array_equal(noisy.phase_std, 0.03)
    np.testing.assert_allclose(noisy.force_std, 0.015 * truth.force, rtol=1e-14)
    np.testing.assert_array_equal(noisy.harmonic_std, 1e-4)


def test_level_errors_are_shared_within_a_level():
    forces = tuple(np.linspace(1e-9, 5e-9, 20))
    errors = MeasurementErrors(level_gain=0.1, level_phase=0.2)
    options = {"points_per_level": 4, "keep_harmonics": (2,)}
    truth = run(forces, **options).steady_states
    noisy = run(forces, errors=errors, seed=5, **options).steady_states
    ratio = np.asarray(noisy.velocity / truth.velocity)[:, 0].reshape(20, 4)
    np.testing.assert_allclose(ratio, ratio[:, :1] * np.ones(4), rtol=1e-12)  # rounding
    assert len(np.unique(np.abs(ratio[:, 0]).round(9))) == 20
    # 20 draws: 1/√40 = 16 % of the standard deviation, three of them.
    assert np.std(np.abs(ratio[:, 0])) == pytest.approx(0.1, rel=0.5)
    assert np.std(np.angle(ratio[:, 0])) == pytest.approx(0.2, rel=0.5)
    # The same gain and turn for the harmonics of a state; nothing is stated for single rows.
    own = np.asarray(noisy.harmonics / truth.harmonics)[:, 0, 0].reshape(20, 4)
    np.testing.assert_allclose(own, ratio, rtol=1e-12)
    assert np.all(np.isnan(noisy.velocity_std))
    np.testing.assert_array_equal(noisy.force, truth.force)


# -------------------------------------------------------------------------------- failing well


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"appropriation": (0.7, 0.5)}, "`appropriation` must be a range inside 0…1"),
        ({"appropriation": (0.5, 0.5)}, "`appropriation`"),
        ({"appropriation": (-0.1, 0.5)}, "`appropriation`"),
        ({"appropriation": (0.5, 1.1)}, "`appropriation`"),
        ({"appropriation": (np.nan, 0.5)}, "`appropriation`"),
        ({"points_per_level": 0}, "`points_per_level` must be 1 or more, but is 0"),
        ({"keep_harmonics": (10,)}, "`keep_harmonics` must lie between 2 and `harmonic_order` = 9"),
        ({"keep_harmonics": (1,)}, "`keep_harmonics`"),
        ({"errors": MeasurementErrors(phase=-0.1)}, "the error `phase` must be zero or positive"),
        ({"errors": MeasurementErrors(force=np.nan)}, "the error `force`"),
        ({"forces": [0.0]}, "every force must be positive"),
    ],
)
def test_wrong_settings_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        run(**options)


def test_a_range_without_resonance_has_no_states():
    with pytest.raises(ValueError, match="no stable state has an appropriation indicator"):
        phase_resonance_test(curved_beam(), TINY, 30 * HZ, 40 * HZ)


def test_one_state_and_odd_numbers_are_shared_among_the_sides():
    forces = tuple(np.linspace(1e-9, 2e-9, 16))
    states = run(forces, points_per_level=1).steady_states
    assert states.level.tolist() == list(range(1, 17))
    states = run(forces, points_per_level=5).steady_states
    assert states.n_states == 80
    assert int(jnp.sum(jnp.angle(states.velocity) > 0)) == 48
