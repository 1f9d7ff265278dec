"""Motions that repeat after several periods of the force: period doublings, 1/3 subharmonics."""

import numpy as np
import pytest

import snrmjax as sj
from snrmjax.numerics.rules import InputError
from snrmjax.pipelines.simulate import simulate_responses
from snrmjax.report.pages import simulation
from snrmjax.simulate import forced_response

FORCE = 3.0


def oscillator(damping_ratio, cubic, quadratic=0.0):
    """ẍ + 2ζẋ + x + κx² + εx³ = F cos Ωt."""
    modes = sj.model.linear_modes([1.0], [damping_ratio], [[1.0]], [1.0])
    potential = sj.model.polynomial_potential({"111": quadratic / 3, "1111": cubic / 4}, 1)
    return sj.model.structure(modes, potential)


def settled(time_domain, model, force, state, frequency, duration):
    """The state after a whole number of force periods of at least this duration."""
    period = 2 * np.pi / frequency
    n = int(np.ceil(duration / period / 6)) * 6  # whole motions of 2 and of 3 periods
    return time_domain(model, force, frequency).integrate(state, n * period, rtol=1e-9)[-1][0]


@pytest.fixture(scope="module")
def third():
    """Duffing's oscillator with ε = 1, and its branch of order 1/3."""
    model = oscillator(0.02, 1.0)
    _, branch = forced_response(model, [FORCE], 2.9, 4.0, harmonic_order=3, subharmonic=3)
    return model, branch


def test_the_fold_of_an_isolated_third_is_that_of_an_independent_balance(third, numpy_balance):
    model, branch = third
    (k,) = branch.at_events("fold")
    motion, frequency = branch.point(k)
    assert branch.subharmonic == 3
    assert frequency == branch.frequency[k] / 3
    reference = numpy_balance(model, FORCE, 9, np.abs(motion).max(), driven=3)
    exact, speed = reference.event("fold", motion, frequency)
    # To the rounding of either.
    np.testing.assert_allclose(frequency, exact, rtol=1e-10)
    np.testing.assert_allclose(np.abs(branch.velocity[k, 1, 0]), speed, rtol=1e-6)


def test_stable_thirds_are_where_time_integration_settles(third, time_domain, state_of):
    model, branch = third
    stable = np.flatnonzero(branch.is_stable)
    k = stable[len(stable) // 2]
    state = state_of(*branch.point(k))
    end = settled(time_domain, model, FORCE, 1.02 * state, branch.frequency[k], 350.0)
    # A disturbance of 2 % falls by e^(−0.02·350) = 1e-3; nine harmonics leave out about 2e-5.
    np.testing.assert_allclose(end, state, atol=1e-4 * np.abs(state).max())


def test_stability_is_that_over_three_periods(third, time_domain, state_of, distance_between):
    model, branch = third

    class Thrice(time_domain):
        def period_map(self, states):
            return self.integrate(states, 6 * np.pi / self.frequency)[-1]

    for stable in (False, True):
        alike = np.flatnonzero(branch.is_stable == stable)
        k = alike[len(alike) // 2]
        exact = Thrice(model, FORCE, branch.frequency[k]).multipliers(state_of(*branch.point(k)))
        assert distance_between(branch.multipliers[k], exact) < 1e-4  # of the truncated motion
        assert stable == (np.abs(exact).max() < 1)


@pytest.mark.parametrize(("cubic", "damping_ratio"), [(0.1, 0.005), (0.02, 0.001)])
def test_thirds_begin_where_the_method_of_multiple_scales_has_them(cubic, damping_ratio):
    # Nayfeh & Mook, Nonlinear Oscillations (1979), section 4.1.4: with Λ = F/2(1 − Ω²) and
    # σ = Ω − 3 the amplitude is a² = p ± √(p² − q).
    model = oscillator(damping_ratio, cubic)
    _, branch = forced_response(model, [FORCE], 2.9, 4.0, harmonic_order=3, subharmonic=3)
    sigma = np.linspace(0, 0.1, 100001)
    square = (FORCE / 2 / (1 - 9)) ** 2
    p = 8 * sigma / (9 * cubic) - 6 * square
    q = 64 / 81 / cubic**2 * (9 * damping_ratio**2 + (sigma - 9 * cubic * square) ** 2)
    begin = sigma[(p > 0) & (p**2 >= q)].min()
    (k,) = branch.at_events("fold")
    # Of first order in the cubic stiffness: the error is of the order of σ itself.
    np.testing.assert_allclose(branch.frequency[k] - 3, begin, rtol=begin)


@pytest.fixture(scope="module")
def doubled():
    """A quadratic spring under a force near twice the natural frequency: response, branch."""
    model, force = oscillator(0.02, 1.0, quadratic=0.6), 0.5
    curve, *branches = forced_response(model, [force], 1.8, 2.2, harmonic_order=3, subharmonic=2)
    return model, force, curve, branches


def test_a_branch_leaves_where_a_multiplier_passes_minus_one(doubled, time_domain, state_of):
    model, force, curve, branches = doubled
    for k, branch in zip(curve.at_events("period_doubling"), branches, strict=True):
        motion = state_of(*curve.point(k))
        exact = time_domain(model, force, curve.frequency[k]).multipliers(motion)
        assert np.abs(exact + 1).min() < 1e-5  # three harmonics leave out 8e-6 of the motion
        assert branch.subharmonic == 2
        assert list(branch.at_events("period_doubling")) == [0]
        assert not branch.at_events("branch_point").size
        np.testing.assert_allclose(branch.frequency[0], curve.frequency[k], rtol=1e-6)
        assert np.abs(branch.velocity[0, 1, 0]) < 1e-2 * np.abs(branch.velocity[0, 2, 0])


def test_doubled_motions_are_where_time_integration_settles(doubled, time_domain, state_of):
    model, force, _, (branch, *_) = doubled
    k = int(np.argmin(np.abs(branch.multipliers).max(axis=1)))
    state, omega = state_of(*branch.point(k)), branch.frequency[k]
    end = settled(time_domain, model, force, 1.02 * state, omega, 350.0)
    np.testing.assert_allclose(end, state, atol=1e-4 * np.abs(state).max())
    # After one period of the force the motion is elsewhere.
    once = time_domain(model, force, omega).period_map(state)[0]
    assert np.abs(once - state).max() > 0.5 * np.abs(state).max()


def test_branches_are_written_and_named(third, tmp_path):
    model, branch = third
    hertz = 2 * np.pi
    found = simulate_responses(
        model, [FORCE], 2.9 / hertz, 4.0 / hertz, harmonics=3, subharmonic=[3]
    )
    (note,) = (note for note in found.notes if note.kind == "subharmonic_searched")
    (limits,) = note["branches"]
    np.testing.assert_allclose(np.array(limits[:2]) * hertz, [branch.frequency.min(), 4.0])
    assert limits[2]
    assert "repeat after 3 periods of the force: 0.5" in str(note)
    simulation.write(tmp_path, found)
    rows = (tmp_path / "response.csv").read_text(encoding="utf-8").splitlines()
    assert rows[0].split(",")[:3] == ["force_n", "point", "frequency_hz"]
    events = [row.split(",")[-1] for row in rows[1:]]
    assert sum("subharmonic_3" in event for event in events) == len(branch.frequency)
    assert events.count("fold+subharmonic_3") == 1
    assert any("velocity at 1/3 of the frequency" in line for line in simulation.headline(found))


def test_a_search_that_finds_nothing_says_so(third):
    model, _ = third
    found = simulate_responses(model, [0.01], 0.46, 0.5, harmonics=3, subharmonic=[3])
    assert len(found.curves) == 1
    (note,) = (note for note in found.notes if note.kind == "subharmonic_searched")
    assert "no motions that repeat after 3 periods of the force were found" in str(note)


def test_a_superharmonic_resonance_is_named(third):
    # Harmonic 3 resonates where 3Ω passes the frequency of the mode, which rises with the force.
    model, _ = third
    found = simulate_responses(model, [0.5], 0.25 / 2 / np.pi, 0.5 / 2 / np.pi, harmonics=3)
    (note,) = (note for note in found.notes if note.kind == "superharmonic_resonance")
    assert note["harmonic"] == 3
    assert note["mode"] == 1
    assert 1.0 < 3 * note["frequency_hz"] * 2 * np.pi < 1.2


def test_an_order_below_two_is_refused(third):
    with pytest.raises(InputError, match="`subharmonic` must be an integer of 2 or more, but is 1"):
        forced_response(third[0], [FORCE], 2.9, 4.0, harmonic_order=3, subharmonic=1)
