"""Answers that a law outside the library could imitate are marked."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

import snrmjax as sj
from snrmjax.diagnose.checks.alternative_laws import doubts, wider_than_measured
from snrmjax.diagnose.misfit.candidates import decide_by
from snrmjax.diagnose.search.locating import Located
from snrmjax.model.effects import EFFECTS
from snrmjax.model.library.confusions import (
    ONE_SIDED_OR_TWO_SIDED,
    SIZE_OF_RESPONSE,
    TOLD_BY_THIRD_HARMONIC,
)
from snrmjax.numerics.facts import Fact


def grows(part, exponent, std=0.05):
    return (Located(part, (0.1, 1.0), 1e-9, exponent, std),)


def test_a_law_of_the_located_power_is_not_doubted():
    assert doubts(("coulomb_friction",), grows("damping", -1.05)) == []
    assert doubts(("cubic_stiffness",), grows("stiffness", 2.1, 0.1)) == []
    both_ways = frozenset({"quadratic_damping"})
    two = ("quadratic_damping", "cubic_stiffness")
    assert doubts(two, grows("damping", 1.0), (2, 3), both_ways) == []


def test_a_law_of_another_power_is_refuted():
    # Damping by the square root of the velocity goes with the power −1/2.
    (doubt,) = doubts(("coulomb_friction",), grows("damping", -0.5))
    assert doubt.refutes
    assert (doubt.reason["exponent"], doubt.reason["part"]) == (-0.5, "damping")


def test_a_power_that_is_hardly_known_refutes_nothing_but_leaves_the_rival():
    (doubt,) = doubts(("coulomb_friction",), grows("damping", -0.8, 0.3))
    assert not doubt.refutes
    assert "decay" in doubt.decide_by


@pytest.mark.parametrize(
    "effects",
    [
        ("gap_stiffness", "quintic_stiffness"),
        ("quadratic_damping", "cubic_stiffness", "cubic_damping"),
        ("iwan_microslip", "jenkins_slider"),
        ("coulomb_friction", "linear_damping_change"),
        ("internal_resonance_1_3", "quintic_stiffness"),
        ("iwan_microslip",),
    ],
)
def test_imitations_are_marked_with_what_would_decide(effects):
    found = doubts(effects, ())
    assert found
    assert not any(doubt.refutes for doubt in found)
    assert all(str(doubt.decide_by) for doubt in found)


def test_a_mode_close_by_is_a_twin_of_much():
    (doubt,) = doubts(("close_mode",), ())
    assert doubt.identical
    assert "second sensor" in doubt.decide_by


def test_an_internal_resonance_wider_than_the_frequencies_measured_was_never_seen():
    kind, stepped = "internal_resonance_1_3", 2 * np.pi * np.array([49.0, 50.0, 51.0])
    # Half-power points of a mode of 150 Hz and 1 %: 3 Hz apart, passed by the force within 1 Hz.
    assert not wider_than_measured(kind, (150.0, 0.01), stepped)
    assert wider_than_measured(kind, (150.0, 0.021), stepped)
    assert wider_than_measured("internal_resonance_1_2", (150.0, 0.015), stepped)
    assert not wider_than_measured("gap_stiffness", (0.1,), stepped)
    assert doubts((kind,), ()) == []
    (doubt,) = doubts((kind,), (), wide=frozenset({kind}))
    assert not doubt.identical
    assert not doubt.refutes
    assert doubt.decide_by.kind == "step_wider"


@pytest.mark.parametrize("orders", [(), (2, 3)])
def test_damping_of_one_direction_is_a_twin_until_harmonic_2_excludes_it(orders):
    (doubt,) = doubts(("quadratic_damping",), grows("damping", 1.0), orders)
    assert doubt.identical
    assert doubt.reason.kind == "one_direction_alike"
    assert doubt.decide_by["closer"] == bool(orders)


def test_damping_that_feeds_the_motion_may_be_a_loop():
    """A loop with the force cos³(θ − 90°) = sin³θ has the fundamental of a cubic damping."""
    angle = np.linspace(0.0, 2 * np.pi, 65)[:-1]
    lagging, speed = np.cos(angle - np.pi / 2) ** 3, -np.sin(angle)
    fed = -np.mean(lagging * speed) / np.mean(speed**4)
    assert fed == pytest.approx(1.0)  # q̇³ with the coefficient −1
    feeding = frozenset({"van_der_pol_damping"})
    (doubt,) = doubts(("van_der_pol_damping",), (), (2, 3), feeding=feeding)
    assert doubt.identical
    assert doubt.reason.kind == "adds_energy"
    assert doubts(("van_der_pol_damping",), (), (2, 3)) == []


def test_a_sensor_that_saturates_is_told_by_harmonic_3():
    (doubt,) = doubts(("mode_shape_change",), (), ())
    assert not doubt.identical
    assert doubts(("mode_shape_change",), (), (2, 3)) == []


def test_three_effects_are_doubted():
    (doubt,) = doubts(("coulomb_friction", "frequency_drift", "cubic_stiffness"), (), (2, 3))
    assert doubt.reason.kind == "three_effects"


def test_a_located_power_of_the_other_part_says_nothing():
    assert doubts(("coulomb_friction",), grows("stiffness", -0.5)) == []


def test_what_would_decide_is_asked_for_and_nothing_beside_it():
    gains = decide_by({"force_gain_error", "sensor_gain_error"}, harmonics=False)
    assert gains == [SIZE_OF_RESPONSE.separated_by]
    contacts = decide_by({"gap_stiffness", "one_sided_stop"}, harmonics=False)
    assert contacts == [ONE_SIDED_OR_TWO_SIDED.separated_by]
    others = {"jenkins_slider", "mode_shape_change"}
    assert decide_by(others, harmonics=False) == [Fact("record_harmonics")]
    assert decide_by(others, harmonics=True) == [Fact("widen_range")]


class Valve(sj.model.AbstractMemoryless):
    """f = c |q̇|^¾ q̇, which states what it may be confused with, and no shape."""

    kind: ClassVar[str] = "valve"
    confusions: ClassVar = (
        TOLD_BY_THIRD_HARMONIC,
        sj.model.Confusion("close the valve", by_itself=True),
    )
    imitations: ClassVar = (sj.model.Imitation("a leak does the same.", "seal it"),)
    coefficient: Array

    def force(self, displacement, velocity):
        """See `AbstractMemoryless.force`."""
        speed = jnp.abs(velocity)
        root = jnp.where(speed > 0, jnp.where(speed > 0, speed, 1.0) ** 1.75, 0.0)
        return self.coefficient * jnp.sign(velocity) * root


def test_a_users_effect_is_doubted_and_told_as_those_of_the_library(monkeypatch):
    monkeypatch.setitem(EFFECTS, "valve", Valve)
    asked = decide_by({"valve", "cubic_damping"}, harmonics=True)
    assert asked == [TOLD_BY_THIRD_HARMONIC.separated_by, "close the valve"]
    both_ways = frozenset({"valve"})
    (leak,) = doubts(("valve",), grows("damping", 0.75), (2, 3), both_ways)
    assert leak.reason == "a leak does the same."
    # The power of its law follows from its force: so does what it acts like, and its direction.
    power, _ = doubts(("valve",), grows("damping", 2.0), (2, 3), both_ways)
    assert power.refutes
    assert power.reason["expected"] == pytest.approx(0.75, abs=1e-3)
    one_way, *_ = doubts(("valve",), grows("damping", 0.75), (2, 3))
    assert one_way.reason.kind == "one_direction_alike"
    reasons = [d.reason for d in doubts(("valve", "coulomb_friction"), (), (2, 3), both_ways)]
    assert Fact("same_part_twice", effects=("valve", "coulomb_friction")) in reasons
