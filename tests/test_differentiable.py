"""Docstrings state what is differentiable; what is not refuses tracers of JAX in a sentence."""

import inspect

import jax
import pytest

import snrmjax as sj

ROOMS = ("simulate", "identify", "diagnose", "doctor", "methods", "study")
VERBS = {
    f"sj.{room}.{name}": verb
    for room in ROOMS
    for name in getattr(sj, room).__all__
    if inspect.isfunction(verb := getattr(getattr(sj, room), name))
}


def test_docstrings_of_simulate_say_whether_a_verb_is_differentiable():
    silent = [
        name
        for name, verb in VERBS.items()
        if name.startswith("sj.simulate.") and "differentiable" not in verb.__doc__
    ]
    assert silent == []


def test_what_is_not_differentiable_says_what_to_use_instead():
    refusing = [name for name, verb in VERBS.items() if "Not differentiable" in verb.__doc__]
    assert {"sj.simulate.forced_response", "sj.identify.fit_jointly"} < set(refusing)
    for name in refusing:
        kinds = inspect.signature(VERBS[name]).parameters.values()
        n = sum(k.kind != k.KEYWORD_ONLY and k.default is k.empty for k in kinds)

        def called(number, verb=VERBS[name], n=n):
            return verb(*[number] * n)

        for transformed in (jax.grad, jax.jit):
            with pytest.raises(ValueError, match="works on numbers, and cannot be called inside"):
                transformed(called)(1.0)
