"""Recommended measurements, in words."""

from types import SimpleNamespace

from snrmjax.diagnose.design.discriminating_test import DiscriminatingTest, recommendation


def fitted_with(*classes, orders=()):
    """Fitted effects, as far as a recommendation uses them."""
    chosen = SimpleNamespace(orders=orders)
    predictions = SimpleNamespace(chosen=chosen)
    return SimpleNamespace(classes=classes, misfit=SimpleNamespace(predictions=predictions))


def recommended(*args, **settings):
    return str(recommendation(*args, **settings))


def test_two_classes_with_the_same_calibration_ask_for_it_once():
    gains = ("force_gain_error", "sensor_gain_error")
    test = DiscriminatingTest("off_resonance", "Measure off resonance.", expected_gain=9.0)
    test = test._replace(needed_gain=5.0)
    text = recommended(fitted_with(gains, gains[::-1]), test, phases=True)
    assert text.lower().count("calibrate") == 1
    assert text.endswith("Measure off resonance.")


def test_a_test_of_harmonics_is_asked_for_in_one_sentence():
    test = DiscriminatingTest("harmonics", "Measure harmonic 2.", expected_gain=9.0)
    test = test._replace(needed_gain=5.0)
    contacts = ("gap_stiffness", "one_sided_stop")
    assert recommended(fitted_with(contacts), test, phases=True) == "Measure harmonic 2."


def test_two_classes_with_the_same_question_ask_it_once():
    contacts, laws = ("gap_stiffness", "one_sided_stop"), ("cubic_damping", "van_der_pol_damping")
    text = recommended(fitted_with(contacts, laws, contacts[::-1]), None, phases=True)
    sentences = [one.rstrip(".").lower() for one in text.split(". ") if one]
    assert len(sentences) == len(set(sentences)) > 0


def test_unknown_phases_are_asked_for_first():
    text = recommendation(fitted_with(("gap_stiffness", "one_sided_stop")), None, phases=False)
    assert text["measurements"][0].kind == "record_phase"


def test_nothing_open_needs_no_measurement():
    assert recommendation(fitted_with(("cubic_stiffness",)), None, phases=True) is None
