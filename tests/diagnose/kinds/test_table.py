"""What a diagnosis knows of every kind of effect: complete, stated or computed from the force."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
import pytest
from truths.own_effects import OwnAsymmetry, OwnDrag

import snrmjax as sj
from snrmjax.diagnose.kinds.confounders import CONFOUNDERS
from snrmjax.diagnose.kinds.hypothesis import Confounder, Hypothesis
from snrmjax.diagnose.kinds.registry import (
    hypothesis_of,
    idle_effect,
    register_hypothesis,
    starts_of,
    without_strength,
)
from snrmjax.diagnose.kinds.table import HYPOTHESES
from snrmjax.diagnose.misfit.candidates import candidate
from snrmjax.model.effect_base import AbstractForce
from snrmjax.model.effect_metadata import MotionScales
from snrmjax.model.effect_shape import averaged_effect
from snrmjax.model.effects import EFFECTS, effect_parameters, make_effect

SCALES = MotionScales(
    amplitude=2e-4, largest=7e-4, frequency=300.0, stiffness=2000.0, receptance=1e-4,
    smallest_force=0.3, damping_ratio=0.01,
)  # fmt: skip
ROWS = "snrmjax/diagnose/kinds/table.py"


def test_every_effect_of_the_library_has_a_row():
    missing, unknown = {*EFFECTS} - {*HYPOTHESES}, {*HYPOTHESES} - {*EFFECTS}
    assert not missing, f"a diagnosis would not look for {missing}: add rows to {ROWS}."
    assert not unknown, f"{ROWS} has rows of no effect of EFFECTS: {unknown}."


@pytest.mark.parametrize("kind", [k for k, one in HYPOTHESES.items() if one.searched])
def test_what_is_searched_has_a_change_and_parameters(kind):
    row = HYPOTHESES[kind]
    stated = row.change is not None and row.parameters is not None
    assert stated, f"{kind} is searched but not found: {ROWS} needs its change and parameters."


def test_a_kind_without_a_row_is_no_silent_miss(monkeypatch):
    monkeypatch.delitem(HYPOTHESES, "cubic_damping")
    with pytest.raises(KeyError, match=ROWS):
        hypothesis_of("cubic_damping")


@pytest.mark.parametrize("kind", [k for k, e in EFFECTS.items() if e.shape and e.shape.factor])
def test_a_start_changes_the_dynamic_stiffness_plainly(kind):
    """Five per cent of it, by the cycle's own integrals."""
    (start,) = starts_of(kind, SCALES)
    effect = make_effect(kind, dict(zip(effect_parameters(kind), start, strict=True)))
    average = averaged_effect(effect, jnp.array(SCALES.amplitude), jnp.array(SCALES.frequency))
    change = np.hypot(average.stiffness, SCALES.frequency * average.damping)
    # Coulomb's jump is smoothed: 5.1e-4 of its first harmonic.
    assert change == pytest.approx(0.05 * SCALES.stiffness, rel=1e-3)


@pytest.mark.parametrize("kind", EFFECTS)
def test_starts_lie_inside_the_priors_and_priors_inside_the_rules(kind):
    one, parameters = candidate(kind, SCALES), EFFECTS[kind].parameters()
    assert tuple(parameters) == effect_parameters(kind)
    assert min(one.unit) > 0
    for start in one.starts:
        assert len(start) == len(one.unit) == len(parameters)
        for value, lower, upper, of in zip(
            start, one.lower, one.upper, parameters.values(), strict=True
        ):
            assert lower <= value <= upper
            for bound in (max(lower, -1e200), min(upper, 1e200)):
                assert all(rule.good(bound) for rule in of.rules)
    make_effect(kind, dict(zip(parameters, one.starts[0], strict=True)))


def test_every_confounder_has_effects():
    assert len(set(CONFOUNDERS)) == len(CONFOUNDERS)
    for one in CONFOUNDERS:
        members = [kind for kind in EFFECTS if one in hypothesis_of(kind).confounders]
        assert len(members) > 1 or one.by_itself
    assert {one for kind in EFFECTS for one in hypothesis_of(kind).confounders} == set(CONFOUNDERS)


@pytest.mark.parametrize("kind", EFFECTS)
def test_without_strength_an_effect_does_nothing(kind):
    effect = without_strength(kind, 300.0, 0.01)
    if isinstance(effect, AbstractForce):
        q = jnp.cos(2 * jnp.pi * jnp.arange(64) / 64)
        np.testing.assert_array_equal(effect.cycle_force(q, -300.0 * jnp.roll(q, 16)), 0.0)
    for name, one in effect.parameters().items():
        assert all(rule.good(float(getattr(effect, name))) for rule in one.rules)


def test_an_idle_effect_stays_at_its_place():
    stop = make_effect("one_sided_stop", {"stiffness": 3.0, "gap": 0.4}, at="tip")
    idle = idle_effect(stop, 100.0, 0.01)
    assert (type(idle), idle.at) == (type(stop), stop.at)
    assert float(idle.force(jnp.asarray(2.0), jnp.asarray(0.0))) == 0.0


FORMER = Confounder("record harmonic 3")


class FormerDrag(OwnDrag):
    """An effect whose class states what a diagnosis wants of it, as until the last release."""

    kind: ClassVar[str] = "former_drag"
    confounders: ClassVar[tuple[Confounder, ...]] = (FORMER,)
    searched: ClassVar[bool] = False

    @classmethod
    def starts(cls, scales):
        return [(0.5, 2.0)]


@pytest.fixture
def own():
    classes = (OwnDrag, OwnAsymmetry, FormerDrag)
    for one in classes:
        sj.model.register_effect(one)
    yield
    for one in classes:
        del EFFECTS[one.kind]
        HYPOTHESES.pop(one.kind, None)


def test_starts_that_a_user_does_not_state_follow_from_the_force(own):
    # The drag of the visible change has 1.1128 … of its first harmonic: see Γ functions.
    ((coefficient, exponent),) = starts_of("own_drag", SCALES)
    speed = SCALES.amplitude * SCALES.frequency
    harmonic = 2 * np.mean(np.abs(np.cos(np.linspace(0, 2 * np.pi, 4097)[:-1])) ** 2.5)
    assert exponent == 1.5
    change = coefficient * harmonic * speed**1.5 / SCALES.amplitude
    assert change == pytest.approx(SCALES.change, rel=1e-4)
    # Even forces change the fundamental by their square, with either sign: Δ(ω̃²) of a q² is
    # −(5/6) a²Q²/ω₀² (Nayfeh & Mook 1979, eq. 4.1.19).
    plus, minus = starts_of("own_asymmetry", SCALES)
    assert plus[0] == -minus[0] > 0
    ((square,), _) = starts_of("quadratic_stiffness", SCALES)
    softening = 5 / 6 * (square * SCALES.amplitude / SCALES.frequency) ** 2
    assert softening == pytest.approx(SCALES.change, rel=1e-9)
    at = SCALES.amplitude
    assert plus[0] * at**4 == pytest.approx(square * at**2, rel=1e-9)


def test_a_user_states_a_hypothesis(own):
    assert hypothesis_of("own_drag") == Hypothesis()
    stated = Hypothesis(starts=lambda scales: [(scales.change, 2.0)], confounders=(FORMER,))
    sj.diagnose.register_hypothesis("own_drag", stated)
    assert hypothesis_of("own_drag").confounders == (FORMER,)
    assert candidate("own_drag", SCALES).starts == ((SCALES.change, 2.0),)
    with pytest.raises(ValueError, match="unknown effect kind 'drag'"):
        register_hypothesis("drag", stated)
    with pytest.raises(ValueError, match="an effect of the library"):
        register_hypothesis("cubic_damping", stated)


def test_what_a_class_states_as_formerly_counts_with_a_warning(own):
    with pytest.warns(DeprecationWarning, match="FormerDrag states confounders, searched, starts"):
        one = hypothesis_of("former_drag")
    assert (one.confounders, one.searched) == ((FORMER,), False)
    assert starts_of("former_drag", SCALES) == [(0.5, 2.0)]
