"""Figures of uncertainty show the numbers of their results."""

import jax.numpy as jnp
import numpy as np
import pytest

import snrmjax as sj


def quantities(function=None):
    inputs = sj.study.correlated_inputs(["a", "b"], [1.0, 2.0], np.diag([0.04, 0.01]))
    function = function or (lambda x: jnp.stack([x[0] * x[1], x[0] ** 2]))
    names, units = ("fold_1_frequency_hz", "peak_velocity_m_s"), ("Hz", "m/s")
    return sj.study.FunctionQuantities(function, inputs, names, units)


SETTINGS = sj.study.PropagationSettings(members=128)


def test_every_range_of_a_propagation_is_drawn_where_it_is():
    result = sj.study.propagate_uncertainty(quantities(), SETTINGS)
    figure = result.plot()
    for q, axes in enumerate(figure.axes):
        drawn = [line.get_xdata() for line in axes.lines if len(line.get_xdata()) == 2]
        assert np.array(drawn) == pytest.approx(result.statistics[:, 2:, q])
        assert sum(bar.get_height() * bar.get_width() for bar in axes.patches) == pytest.approx(1)
    assert [axes.get_xlabel() for axes in figure.axes] == [
        "Fold 1 frequency (Hz)",
        "Peak velocity (m/s)",
    ]
    nothing = quantities(lambda x: jnp.full(2, jnp.nan) * x)
    with pytest.raises(ValueError, match="no quantity of any member was found"):
        sj.study.propagate_uncertainty(nothing, SETTINGS).plot()


def test_indices_are_drawn_as_bars():
    indices = sj.study.sobol_indices(quantities(), base_rows=64)
    for q, axes in enumerate(indices.plot().axes):
        widths = [bar.get_width() for bar in axes.patches]
        assert widths == pytest.approx([*indices.first[q], *indices.total[q]])
    still = quantities(lambda x: 0.0 * x)
    with pytest.raises(ValueError, match="no quantity has indices"):
        sj.study.sobol_indices(still, base_rows=64).plot()
