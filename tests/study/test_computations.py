"""Every kind of computation for members whose results are known in closed form."""

import dataclasses

import numpy as np
import pytest

import snrmjax as sj
from snrmjax.numerics.facts import Fact
from snrmjax.report.study.study_report import members_ended
from snrmjax.simulate.solutions.forced_response import _summary
from snrmjax.study.analysis.digest import digest
from snrmjax.study.computations.base import MemberStatus
from snrmjax.study.computations.responses import peak_status, velocity_bounds

from .conftest import OMEGA, PARTICIPATION, SHAPE, InThisProcess

CUBIC = 1e6  # of q⁴ in the potential
HERTZ = 2 * np.pi


@pytest.fixture(scope="module")
def cubic_model(linear_model):
    potential = sj.model.polynomial_potential({(0, 0, 0, 0): CUBIC}, 1)
    return sj.model.structure(linear_model.modes, potential)


def computed(model, computation, varied, tmp_path):
    study = sj.study.Study("one", model, computation, varied)
    return sj.study.run_study(study, tmp_path / "s.zarr", workers=InThisProcess().workers).open()


def rows_of(data, member):
    begin = int(data.first_point[member])
    return slice(begin, begin + int(data.n_points[member]))


def test_normal_modes_are_those_of_the_duffing_oscillator(cubic_model, tmp_path):
    varied = (sj.study.Discrete("potential.1111", [CUBIC, 4 * CUBIC]),)
    computation = sj.study.NormalModes(1.2 * OMEGA, harmonic_order=1)
    data = computed(cubic_model, computation, varied, tmp_path)
    assert data.status.values.tolist() == ["upper_end"] * 2
    for member, cubic in enumerate((CUBIC, 4 * CUBIC)):
        omega = HERTZ * data.point_frequency_hz.values[rows_of(data, member)]
        amplitude = data.point_velocity_m_s.values[rows_of(data, member)] / (SHAPE * omega)
        # One harmonic of q̈ + ω₀²q + 4 b q³ = 0: Ω² = ω₀² + 3 b Q².
        np.testing.assert_allclose(omega**2, OMEGA**2 + 3 * cubic * amplitude**2, rtol=1e-7)
        assert np.max(omega) >= 1.2 * OMEGA


def test_damped_modes_have_the_damping_of_the_member(cubic_model, tmp_path):
    varied = (sj.study.Discrete("mode_1.damping_ratio", [0.01, 0.04]),)
    computation = sj.study.DampedModes(0.5, harmonic_order=1)
    data = computed(cubic_model, computation, varied, tmp_path)
    for member, damping in enumerate((0.01, 0.04)):
        omega = HERTZ * data.point_frequency_hz.values[rows_of(data, member)]
        ratio = data.point_damping_ratio.values[rows_of(data, member)]
        # ξ = 2 ζ ω₀ makes up for what is dissipated, over 2Ω.
        np.testing.assert_allclose(ratio, damping * OMEGA / omega, rtol=1e-6)


def test_a_virtual_test_finds_the_mode_that_was_tested(linear_model, tmp_path):
    within = sj.study.ResponseRange(0.8 * OMEGA, 1.2 * OMEGA, harmonic_order=1)
    computation = sj.study.VirtualTests(within, np.array([0.2, 0.5, 1.0]))
    varied = (sj.study.Discrete("mode_1.damping_ratio", [0.01, 0.03]),)
    data = computed(linear_model, computation, varied, tmp_path)
    assert data.status.values.tolist() == ["solved"] * 2
    # Of the states that a curve passes (`StepControl.tolerance`), read at their phases.
    np.testing.assert_allclose(data.natural_frequency_hz, OMEGA / HERTZ, rtol=1e-5)
    expected = np.repeat([[0.01], [0.03]], data.sizes["relative_amplitude"], axis=1)
    np.testing.assert_allclose(data.damping_ratio, expected, rtol=1e-3)


def test_noise_belongs_to_the_member(linear_model):
    within = sj.study.ResponseRange(0.8 * OMEGA, 1.2 * OMEGA, harmonic_order=1)
    errors = sj.simulate.MeasurementErrors(amplitude=0.01, phase=0.01)
    computation = sj.study.VirtualTests(within, np.array([0.2, 0.5, 1.0]), errors)
    sampling = sj.study.Sampling("random", 3)
    study = sj.study.Study("noise", linear_model, computation, (), sampling, seed=2)
    plan = study.ensemble()
    together = plan.rows(range(3))["damping_ratio"]
    alone = plan.rows([2])["damping_ratio"]
    np.testing.assert_array_equal(together[2], alone[0])
    assert len({float(row[0]) for row in together}) == 3


def test_every_member_identifies_with_its_own_model(linear_model, tmp_path):
    omega = np.tile(OMEGA * np.linspace(0.98, 1.02, 6), 3)
    force = np.repeat([0.2, 0.5, 1.0], 6)
    receptance = SHAPE * PARTICIPATION / (OMEGA**2 - omega**2 + 2j * 0.02 * OMEGA * omega)
    data = sj.measure.steady_states(
        np.repeat([1, 2, 3], 6), omega, force, 1j * omega * receptance * force
    )
    varied = (sj.study.Discrete("mode_1.participation", [PARTICIPATION, 1.1 * PARTICIPATION]),)
    found = computed(linear_model, sj.study.Identifications(data), varied, tmp_path)
    # Exact states on both sides of resonance determine the modal mass, and with it the damping that
    # made them, however wrong the member's is.
    np.testing.assert_allclose(found.damping_ratio, 0.02, rtol=1e-3)
    assert found.n_solved.values.tolist() == [18, 18]


def test_bounds_on_a_grid_are_those_of_the_curve(linear_model, tmp_path):
    within = sj.study.ResponseRange(0.8 * OMEGA, 1.2 * OMEGA, harmonic_order=1)
    computation = sj.study.Peaks(within, [0.5], grid_points=9)
    varied = (sj.study.Discrete("mode_1.damping_ratio", [0.02]),)
    data = computed(linear_model, computation, varied, tmp_path)
    omega = HERTZ * data.frequency_hz.values
    linear = omega * 0.5 * SHAPE * PARTICIPATION
    linear /= np.abs(OMEGA**2 - omega**2 + 2j * 0.02 * OMEGA * omega)
    # Straight lines between points of a curve whose steps rotate by less than 0.1 rad.
    np.testing.assert_allclose(data.upper_velocity_m_s[0], linear, rtol=0.01)
    np.testing.assert_array_equal(data.upper_velocity_m_s, data.lower_velocity_m_s)


def test_bounds_of_a_folded_curve_are_its_outer_branches():
    """A curve with two folds: between them three velocities, of which two count."""

    class Folded:
        frequency = np.array([1.0, 3.0, 2.0, 4.0])
        velocity = np.zeros((4, 2, 1), complex)

    Folded.velocity[:, 1, 0] = [1.0, 3.0, 2.0, 0.0]
    low, high = velocity_bounds([Folded], np.array([0.5, 1.0, 2.5, 3.5, 4.0]))
    np.testing.assert_allclose(high, [np.nan, 1.0, 2.5, 0.5, 0.0])
    np.testing.assert_allclose(low, [np.nan, 1.0, 1.5, 0.5, 0.0])


def test_a_member_that_cannot_be_computed_gives_a_reason_and_the_others_are_untouched(
    linear_model, tmp_path
):
    within = sj.study.ResponseRange(0.9 * OMEGA, 1.1 * OMEGA, harmonic_order=1)
    computation = sj.study.VirtualTests(within, np.array([0.2, 0.5]))
    # The second member's resonance is far outside the range: no state is near resonance there.
    varied = (sj.study.Discrete("mode_1.natural_frequency", [OMEGA, 2 * OMEGA]),)
    data = computed(linear_model, computation, varied, tmp_path)
    assert data.status.values[0] == "solved"
    assert data.status.values[1].startswith("refused: ")
    assert np.all(np.isnan(data.damping_ratio[1]))
    np.testing.assert_allclose(data.damping_ratio[0], 0.02, rtol=1e-3)


def test_a_range_without_the_resonance_has_a_status_of_its_own(linear_model, tmp_path):
    """Linear modes: the velocity is highest at the natural frequency exactly."""
    within = sj.study.ResponseRange(0.8 * OMEGA, 1.2 * OMEGA, harmonic_order=1, stability=False)
    computation = sj.study.Peaks(within, [0.5])
    varied = (sj.study.Discrete("mode_1.natural_frequency", [OMEGA, 0.5 * OMEGA, 1.5 * OMEGA]),)
    data = computed(linear_model, computation, varied, tmp_path)
    assert data.status.values.tolist() == ["upper_end", *2 * [MemberStatus.NO_PEAK]]
    np.testing.assert_array_equal(np.isnan(data.peak_frequency_hz), [False, True, True])
    found = digest(data)
    assert data.peak_side.values.tolist() == [0, -1, 1]
    assert found.failures.n_failed == 2
    ended = "3 members, of which 2 have no complete result: 2 no_peak_in_range."
    assert members_ended(found) == ended
    assert Fact("no_peak_in_range", n_members=2, below=1, above=1) in found.facts
    row = next(s for s in found.summaries if s.scalar.name == "peak_frequency_hz")
    assert (row.members, row.missing, row.below, row.above) == (3, 0, 1, 1)
    assert row.quantiles[[0, 2, 4]].tolist() == [-np.inf, data.peak_frequency_hz[0], np.inf]


def test_a_largest_point_that_is_not_a_located_peak_is_not_reported_as_peak(linear_model):
    """A resonance curve whose peak event was removed: its largest point is not a located peak."""
    (whole,) = sj.forced_response(linear_model, 0.5, 0.8 * OMEGA, 1.2 * OMEGA, harmonic_order=1)
    assert peak_status([whole], "upper_end") == "upper_end"
    events = tuple("" if kind == "peak" else kind for kind in whole.event)
    forgotten = dataclasses.replace(whole, event=events)
    assert peak_status([forgotten], "upper_end") == MemberStatus.PEAK_NOT_LOCATED
    for curve, missed in ((whole, 0), (forgotten, 1)):
        row = _summary((curve,))
        assert row["n_not_located"] == missed
        assert bool(np.isnan(row["peak_velocity"])) == bool(missed)


def test_a_peak_below_the_response_at_the_end_of_the_range_is_not_the_highest(tmp_path):
    """A weak mode in the range below a strong one, whose flank is higher."""
    modes = sj.model.linear_modes([OMEGA, 1.25 * OMEGA], [0.01, 0.01], [[1.0, 1.0]], [0.1, 3.0])
    omega = OMEGA * np.array([1.0, 1.2])
    own = np.array([[OMEGA], [1.25 * OMEGA]])
    receptance = np.array([[0.1], [3.0]]) / (own**2 - omega**2 + 0.02j * own * omega)
    inside, at_end = np.abs(omega * receptance.sum(axis=0))
    assert at_end > 2 * inside  # of the two modes in closed form
    within = sj.study.ResponseRange(0.8 * OMEGA, 1.2 * OMEGA, harmonic_order=1, stability=False)
    varied = (sj.study.Discrete("mode_2.participation", [3.0, 0.0003]),)
    computation = sj.study.Peaks(within, [0.5])
    data = computed(sj.model.structure(modes), computation, varied, tmp_path)
    assert data.status.values.tolist() == [MemberStatus.HIGHEST_AT_END, "upper_end"]
    assert np.all(np.abs(data.peak_frequency_hz * HERTZ / OMEGA - 1) < 0.01)
