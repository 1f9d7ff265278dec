"""Notes and refusals of a joint fit whose data do not determine the instrument errors."""

import numpy as np
import pytest
from truths.exact_states import GAIN, driven, modes

import snrmjax as sj
from snrmjax.identify.checks.instruments import notes_on_instruments
from snrmjax.identify.inference.fitted_curves import as_backbone, values_to_the_largest


def on_the_gain(fit):
    return [note for note in fit.notes if note.kind.startswith("force_gain")]


@pytest.mark.long
def test_a_gain_determined_by_inertia_is_accepted_without_a_note():
    fit = sj.fit_jointly(driven(60), modes(), backbone="polynomial:1", damping="polynomial:1")
    assert float(np.exp(fit.unknowns.log_force_gain)) == pytest.approx(GAIN, rel=0.01)
    assert on_the_gain(fit) == []


@pytest.mark.parametrize(
    ("widest", "kind"),
    [
        (6, "force_gain_near_resonance"),
        (0.5, "force_gain_undetermined"),
        pytest.param(1e-3, None, marks=pytest.mark.long),
    ],
)
def test_states_near_resonance_hardly_determine_the_gain(widest, kind):
    """At resonance the force balances the damping: half of both fits equally well."""
    data = driven(widest, 2, noise=0.01) if widest < 1 else driven(widest)
    curves = {"backbone": "polynomial:1", "damping": "polynomial:1"}
    if kind is None:
        with pytest.raises(
            ValueError, match=r"force gain cannot be determined .* known added mass"
        ):
            sj.fit_jointly(data, modes(), **curves)
        return
    (note,) = on_the_gain(sj.fit_jointly(data, modes(), **curves))
    assert note.kind == kind


def test_few_states_of_one_level_are_fitted():
    """Smoothing splines through two knots have no roughness to estimate."""
    data = driven(8)
    data = data.select(np.asarray(data.level) == 4)
    fit = sj.fit_jointly(data, modes())
    assert len(on_the_gain(fit)) == 1


def test_the_velocity_axis_ends_at_the_measured_velocity():
    """Levels with drifting gains are brought onto one curve, but the axis is that of the record."""
    data = driven(60, drift=0.1)
    fit = sj.fit_jointly(data, modes(), backbone="polynomial:1", damping="polynomial:1")
    assert fit.noise.level_std[0] > 0.02
    measured = float(np.max(np.abs(np.asarray(data.velocity))))
    speed = np.asarray(values_to_the_largest(fit, 5).velocity)
    assert speed[-1] == pytest.approx(measured, rel=0.002)  # the level's noise is 0.1 %
    assert float(as_backbone(fit).largest) == pytest.approx(fit.largest[0], rel=1e-12)


def upper_branch(sign=1.0):
    """Exact states of a hardening mode with 0.1 % of damping, on one side of resonance only.

    By (ω̃² − Ω² + iΩδ) X = A F, solved for Ω at a given |X|.
    """
    level, omega, force, velocity, delta = [], [], [], [], 2 * 0.001 * 900.0
    for number, largest in enumerate([1.0, 1.6, 2.5]):
        load = delta * 900.0 * largest * np.sqrt(1 + 0.05 * largest**2)
        for a in np.linspace(0.4, 0.93, 12) * largest:
            natural = 900.0**2 * (1 + 0.05 * a**2)
            root = np.sqrt((load / a) ** 2 - delta**2 * natural + 0.25 * delta**4)
            squared = natural - 0.5 * delta**2 - root
            x = load / (natural - squared + 1j * np.sqrt(squared) * delta)
            level.append(number)
            omega.append(np.sqrt(squared))
            force.append(load)
            velocity.append(sign * 1j * np.sqrt(squared) * x)
    return sj.measure.steady_states(level, omega, force, velocity)


@pytest.mark.parametrize(
    ("free", "sign"),
    [(("instrument_phase",), 1.0), (("instrument_phase",), -1.0), (("force_gain",), 1.0)],
)
def test_a_free_instrument_error_never_gives_negative_damping(free, sign):
    """On one side of resonance a reversed force with negative damping fits too: truth is 0.1 %."""
    one = sj.model.linear_modes([900.0], [0.001], [[1.0]], [1.0])
    fit = sj.fit_jointly(upper_branch(sign), one, free=free)
    curve = fit.unknowns.modal_damping
    found = np.asarray(curve(fit.motion().amplitude(curve)))
    np.testing.assert_allclose(found, 1.8, rtol=0.05)  # 2ζω of the states, without noise
    expected = 0.0 if sign > 0 else np.pi
    error = float(fit.unknowns.instrument_phase) - expected if "force_gain" not in free else 0.0
    assert abs(np.angle(np.exp(1j * error))) < 0.005


def test_a_known_force_opposing_the_motion_is_refused():
    one = sj.model.linear_modes([900.0], [0.001], [[1.0]], [1.0])
    with pytest.raises(ValueError, match=r"against the force|negative at every state"):
        sj.fit_jointly(upper_branch(-1.0), one)


class _Fit:
    """Stand-in for a fit's instrument errors."""

    free = ("instrument_phase", "force_offset")
    notes = ()

    def __init__(self, *std):
        self.covariance = np.diag(np.square(std))

    def names(self):
        return self.free

    def motion(self):
        raise AssertionError  # only a gain needs phases


@pytest.mark.parametrize(
    ("std", "noted"),
    [
        ((0.01, 0.05), []),
        ((np.radians(8), 0.05), ["instrument_phase"]),
        ((0.01, 0.3), ["force_offset"]),
    ],
)
def test_offset_and_phase_have_bounds_too(std, noted):
    notes = notes_on_instruments(_Fit(*std))
    assert [note["name"] for note in notes] == noted


def test_an_undetermined_offset_is_refused():
    with pytest.raises(ValueError, match="cannot determine `force_offset`"):
        notes_on_instruments(_Fit(0.01, 1.5))
