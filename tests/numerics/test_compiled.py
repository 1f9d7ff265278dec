"""Programs take floating-point numbers as arguments: other values do not compile anew."""

import jax.numpy as jnp
import numpy as np
import pytest

from snrmjax.numerics.compiled import compiled, numbers_as_arrays


@compiled
def scaled(numbers, *, power, offset=None, name="plain"):
    """A function of numbers in a tree, of a whole number, of None and of text."""
    total = sum(jnp.sin(value) ** power for value in numbers.values())
    return total if offset is None or name == "bare" else total + offset


def test_other_floats_do_not_compile_anew(compilations):
    first = scaled({"a": 0.3, "b": 0.5 + 1j}, power=2, offset=1.0)
    assert len(compilations) > 0  # and the count does count
    del compilations[:]
    for value in (0.1, -0.7, 2.0, np.float64(0.4), np.array(0.3)):
        found = scaled({"a": value, "b": 0.5 + 1j}, power=2, offset=2.0 * value)
        exact = np.sin(value) ** 2 + np.sin(0.5 + 1j) ** 2 + 2.0 * value
        assert complex(found) == pytest.approx(complex(exact), rel=1e-14)
    assert len(compilations) == 0
    assert complex(first) == pytest.approx(np.sin(0.3) ** 2 + np.sin(0.5 + 1j) ** 2 + 1, rel=1e-14)


def test_whole_numbers_text_and_none_are_compiled_in(compilations):
    for settings in ({"power": 3}, {"power": 4}, {"power": 3, "offset": 1.0, "name": "bare"}):
        before = len(compilations)
        scaled({"a": 0.3}, **settings)
        assert len(compilations) > before


def test_numbers_as_arrays_leaves_everything_else():
    tree = {"a": 0.5, "b": (1, True, None, "text"), "c": jnp.ones(2), "d": 1j}
    found = numbers_as_arrays(tree)
    assert isinstance(found["a"], np.float64)
    assert isinstance(found["d"], np.complex128)
    assert found["b"] == (1, True, None, "text")
    assert found["c"] is tree["c"]
