"""Figures of uncertainty show the numbers of their results."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import snrmjax as sj


def indices(output):
    varied = [sj.study.Normal("a", 1.0, 0.2), sj.study.Normal("b", 2.0, 0.1)]
    sampling = {"method": "saltelli"}
    described = {"variations": [{"names": one.names} for one in varied], "sampling": sampling}
    model = sj.model.structure(sj.model.linear_modes([1.0], [0.1], [[1.0]], [1.0]))
    study = sj.study.Study(
        *("both", model, sj.study.NormalModes(2.0), tuple(varied)),
        sj.study.Sampling("saltelli", 4 * 64),
        model_of=lambda values: model,
    )
    table = study.ensemble().table
    outputs = {"fold_1_frequency_hz": table.prod(axis=1), "peak_velocity_m_s": table[:, 0] ** 2}
    data = {name: (("member",), output * values) for name, values in outputs.items()}
    return sj.study.sobol_indices(
        xr.Dataset(data, attrs={"study": json.dumps({"study": described})})
    )


def test_every_range_of_a_propagation_is_drawn_where_it_is():
    varied = [sj.study.Normal("a", 1.0, 0.2), sj.study.Normal("b", 2.0, 0.1)]
    found = sj.study.propagate_uncertainty(
        sj.study.function_quantities(
            lambda x: jnp.stack([x[0] * x[1], x[0] ** 2]),
            varied,
            ["fold_1_frequency_hz", "peak_velocity_m_s"],
        )
    )
    figure = found.plot()
    for q, axes in enumerate(figure.axes):
        drawn = [line.get_xdata() for line in axes.lines if len(line.get_xdata()) == 2]
        assert np.array(drawn) == pytest.approx(found.statistics[:, 2:, q])
    assert [axes.get_xlabel() for axes in figure.axes] == [
        "Fold 1 frequency (Hz)",
        "Peak velocity (m/s)",
    ]


def test_indices_are_drawn_as_bars():
    found = indices(1.0)
    figure = found.plot()
    for q, axes in enumerate(figure.axes):
        widths = [bar.get_width() for bar in axes.patches]
        assert widths == pytest.approx([*found.first[q], *found.total[q]])
    assert [axes.get_title(loc="left") for axes in figure.axes] == [
        "Fold 1 frequency (Hz)",
        "Peak velocity (m/s)",
    ]
    with pytest.raises(ValueError, match="no quantity has indices"):
        indices(np.zeros(4 * 64)).plot()
