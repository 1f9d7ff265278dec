"""The figure and the table of a drawn law."""

import numpy as np
import pytest

from snrmjax.diagnose.diagnosis_result import DrawnLaw
from snrmjax.report.figures.parts import drawn_laws_figure, law_tables

AT = np.array([0.0, 1e-3, 2e-3, 4e-3])
SPRING = DrawnLaw(
    "spring",
    AT,
    np.array([0.0, 0.1, 0.4, 1.6]),
    np.array([0.0, 0.05, 0.05, 0.2]),
    2e-3,
)
BY_DISPLACEMENT = SPRING._replace(law="displacement_damping", passing=0.25)


def test_the_figure_has_the_curve_its_band_and_marks_what_is_extrapolated():
    figure = drawn_laws_figure([SPRING])
    (axes,) = figure.axes
    whole, inside = axes.lines[:2]
    np.testing.assert_allclose(whole.get_xdata(), 1e3 * AT)  # mm
    assert whole.get_linestyle() == "--"
    np.testing.assert_allclose(inside.get_xdata(), 1e3 * AT[:3])
    scale = whole.get_ydata()[-1] / 1.6
    (band,) = axes.collections
    edges = band.get_paths()[0].vertices[:, 1]
    assert edges.max() == pytest.approx(scale * (1.6 + 1.96 * 0.2))
    assert "mm" in axes.get_xlabel()
    with pytest.raises(ValueError, match="no drawn law"):
        drawn_laws_figure([])


def test_two_laws_have_a_panel_each_and_a_table_each():
    figure = drawn_laws_figure([SPRING, BY_DISPLACEMENT])
    assert len(figure.axes) == 2
    assert "0.25 m/s" in figure.axes[1].get_title(loc="left") + figure.axes[1].get_title()
    first, second = law_tables([SPRING, BY_DISPLACEMENT])
    assert len(first.rows) == len(second.rows) == 4
    assert "odd stiffness" in first.folded
    number, shown = first.rows[2]
    assert float(number) == pytest.approx(2.0)  # mm
    assert "mm" in first.header[0]
    value, error = (float(part) for part in shown.split("±"))
    size = 1e3 if "(mN)" in first.header[1] else 1.0
    assert (value, error) == pytest.approx((0.4 * size, 0.05 * size))
