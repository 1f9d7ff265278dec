"""Figures of uncertainty show the numbers of their results."""

import json

import numpy as np
import pytest
import xarray as xr

import snrmjax as sj


def indices(output):
    varied = [sj.study.normal("a", 1.0, 0.2), sj.study.normal("b", 2.0, 0.1)]
    sampling = {"method": "saltelli"}
    described = {"variations": [{"names": one.names} for one in varied], "sampling": sampling}
    model = sj.model.structure(sj.model.linear_modes([1.0], [0.1], [[1.0]], [1.0]))
    study = sj.study.Study(
        *("both", model, sj.study.NormalModes(2.0), tuple(varied)),
        sj.study.Sampling("saltelli", 4 * 64),
        model_of=lambda values: model,
    )
    table = sj.study.planned(study).table
    outputs = {"fold_1_frequency_hz": table.prod(axis=1), "peak_velocity_m_s": table[:, 0] ** 2}
    data = {name: (("member",), output * values) for name, values in outputs.items()}
    return sj.study.sobol_indices(
        xr.Dataset(data, attrs={"study": json.dumps({"study": described})})
    )


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
