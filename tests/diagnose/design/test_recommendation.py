"""What to measure next, in words."""

from types import SimpleNamespace

from snrmjax.diagnose.checks.alternative_laws import doubts
from snrmjax.diagnose.design.discriminating_test import DiscriminatingTest, recommendation


def found_with(*classes, orders=()):
    """What a search found, as far as a recommendation looks at it."""
    chosen = SimpleNamespace(orders=orders)
    predictions = SimpleNamespace(chosen=chosen)
    return SimpleNamespace(classes=classes, misfit=SimpleNamespace(predictions=predictions))


def recommended(*args, **settings):
    return str(recommendation(*args, **settings))


def test_each_measurement_is_recommended_once():
    """Three effects, two of them damping: both doubts ask for a wider range of levels."""
    effects = ("cubic_damping", "coulomb_friction", "cubic_stiffness")
    open_questions = [doubt.decide_by for doubt in doubts(effects, (), (2, 3))]
    assert len(open_questions) > len(set(open_questions))
    said = recommended(found_with(*((e,) for e in effects)), None, open_questions, phases=True)
    sentences = [one for one in said.split(". ") if one]
    assert len(sentences) == len(set(sentences))
    for question in open_questions:
        assert said.lower().count(str(question).rstrip(".").lower()) == 1


def test_two_classes_with_the_same_calibration_ask_for_it_once():
    gains = ("force_gain_error", "sensor_gain_error")
    test = DiscriminatingTest("off_resonance", "Measure off resonance.", expected_gain=9.0)
    test = test._replace(needed_gain=5.0)
    said = recommended(found_with(gains, gains[::-1]), test, [], phases=True)
    assert said.lower().count("calibrate") == 1
    assert said.endswith("Measure off resonance.")


def test_a_measurement_that_says_more_stands_for_one_that_says_less():
    """A gap or a stop and a damping of one side: both are told by harmonic 2."""
    contacts = ("gap_stiffness", "one_sided_stop")
    asked = ["record harmonic 2 at the largest level"]
    said = recommended(found_with(contacts, orders=(3,)), None, asked, phases=True)
    assert said == "Record harmonic 2 at the largest level: only a one-sided contact makes it."


def test_a_test_of_harmonics_is_asked_for_in_one_sentence():
    test = DiscriminatingTest("harmonics", "Measure harmonic 2.", expected_gain=9.0)
    test = test._replace(needed_gain=5.0)
    contacts = ("gap_stiffness", "one_sided_stop")
    assert recommended(found_with(contacts), test, [], phases=True) == "Measure harmonic 2."


def test_nothing_open_needs_no_measurement():
    assert recommendation(found_with(("cubic_stiffness",)), None, [], phases=True) is None
