"""Compiled programs trace floating-point numbers: other values do not recompile."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import snrmjax as sj
from snrmjax.numerics.compiled import compiled, numbers_as_arrays


@compiled
def scaled(numbers, *, power, offset=None, name="plain"):
    """A function of a tree of numbers, an integer, None and text."""
    total = sum(jnp.sin(value) ** power for value in numbers.values())
    return total if offset is None or name == "bare" else total + offset


def test_other_floats_do_not_compile_anew(compilations):
    first = scaled({"a": 0.3, "b": 0.5 + 1j}, power=2, offset=1.0)
    assert len(compilations) > 0  # the counter works
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


class Line(eqx.Module):
    """A straight line, evaluated by a method that is compiled."""

    slope: float
    name: str = eqx.field(static=True, default="line")

    @compiled
    def at(self, x, *, offset=0.0):
        """The ordinate at x."""
        return self.slope * x + offset


def test_methods_take_floats_as_arguments(compilations):
    first = Line(2.0).at(3.0, offset=1.0)
    assert len(compilations) > 0
    assert float(first) == 7.0
    del compilations[:]
    for k in (0.5, 1.5, -2.5):
        assert float(Line(k).at(2 * k, offset=k)) == pytest.approx(2 * k**2 + k, rel=1e-14)
    assert len(compilations) == 0


@pytest.mark.long
def test_a_backbone_at_other_amplitudes_compiles_nothing(compilations):
    beam, hertz = sj.model.flat_beam(), 2 * np.pi
    test = sj.phase_resonance_test(
        *(beam, np.linspace(1e-3, 6e-3, 4), 60 * hertz, 110 * hertz),
        points_per_level=4,
        harmonic_order=3,
    )
    backbone = sj.identify_backbone(test.steady_states, beam.modes).backbone
    methods = (backbone.natural_frequency, backbone.damping_ratio, backbone.velocity)
    for method in methods:
        method(2e-4)
    del compilations[:]
    for amplitude in (2.1e-4, 2.3e-4, 2.6e-4):
        for method in methods:
            assert np.isfinite(method(amplitude))
    assert len(compilations) == 0


def test_single_precision_is_refused_by_name():
    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.raises(ValueError, match="`jax_enable_x64`, which `import snrmjax` switches"):
            sj.forced_response(sj.model.flat_beam(), [2e-4], 480.0, 520.0, harmonic_order=1)
    finally:
        jax.config.update("jax_enable_x64", True)
