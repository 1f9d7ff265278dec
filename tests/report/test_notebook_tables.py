"""What a notebook shows of results: well-formed, escaped, and with the numbers that are printed."""

from html.parser import HTMLParser

import equinox as eqx
import numpy as np
import pytest

import snrmjax as sj
from snrmjax.numerics.units import HERTZ

SENSOR = "tip & <b>"


class Read(HTMLParser):
    """The texts of lists and of the rows of tables; refuses tags that do not close in order."""

    def __init__(self, text):
        super().__init__()
        self.open, self.texts, self.rows, self.styles = [], [], [], set()
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        assert tag in {
            *("div", "strong", "ul", "li", "details", "summary"),
            *("table", "thead", "tbody", "tr", "th", "td"),
        }
        self.open.append(tag)
        self.styles |= {value for _, value in attrs if value}
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1] in ("td", "th"):
            self.rows[-1][-1] += data
        elif self.open[-1] in ("strong", "li"):
            self.texts.append(data)


@pytest.fixture(scope="module")
def results():
    modes = sj.model.linear_modes([79.02 * HERTZ], [0.05], [[11.8]], [247.8], sensors=[SENSOR])
    force = np.repeat([1e-3, 2e-3, 4e-3], 8)
    frequency = HERTZ * np.tile(np.linspace(70.0, 88.0, 8), 3)
    noise = np.random.default_rng(0).normal(size=(24, 1, 2)) @ [0.005, 0.005j]
    velocity = sj.model.linear_response(modes, frequency, force) * (1 + noise)
    level = np.repeat([1, 2, 3], 8)
    data = sj.measure.steady_states(level, frequency, force, velocity, sensors=[SENSOR])
    found = sj.identify_backbone(data, modes)
    fit = sj.fit_jointly(data, modes, backbone="polynomial:2", damping="constant")
    made = (modes, sj.model.structure(modes), data, found, found.points, found.backbone, fit)
    return {type(one).__name__: one for one in made}


NAMES = (
    *("LinearModes", "Structure", "SteadyStates", "Identification", "BackbonePoints"),
    *("Backbone", "JointFit"),
)


@pytest.mark.parametrize("name", NAMES)
def test_the_lines_and_numbers_are_those_that_are_printed(results, name):
    shown, printed = Read(results[name]._repr_html_()), repr(results[name]).splitlines()
    texts, lines = ([one.strip() for one in of] for of in (shown.texts, printed))
    assert texts == [line for line in lines if line in texts]
    # What is printed and no line of the list is a row of the table.
    rows = {f"{row[0]} {row[1]}" for row in shown.rows} | {f"{row[0]}: none" for row in shown.rows}
    left = [line for line in lines if line not in texts and not line.endswith(": none")]
    assert {*left} <= rows
    assert shown.styles <= {"text-align: left"}  # of the page are the colours, light or dark


def test_errors_stand_beside_their_values_in_units(results):
    curve = results["Backbone"]
    (row,) = [row for row in Read(curve._repr_html_()).rows if row[0] == "natural frequency"]
    std = curve.to_xarray().natural_frequency_std_hz.values
    assert row[1].endswith(" Hz")
    assert row[2] == f"{std.min():.2g} to {std.max():.2g} Hz"


def test_the_parameters_of_a_fit_have_their_values_and_errors(results):
    fit = results["JointFit"]
    table = fit.to_xarray()
    rows = {row[0]: row for row in Read(fit._repr_html_()).rows}
    assert table.parameter.size >= 4
    for k, name in enumerate(table.parameter.values):
        value, error = (float(text.split()[0]) for text in rows[name][1:])
        np.testing.assert_allclose(value, table.value[k], rtol=1e-5)
        np.testing.assert_allclose(error, table["std"][k], rtol=0.05)  # to two digits


def test_within_jit_there_is_nothing_to_show(results):
    seen = []
    eqx.filter_jit(lambda one: seen.append((one._repr_html_(), repr(one))))(results["LinearModes"])
    ((table, text),) = seen
    assert table is None
    assert "f64[1]" in text


def test_what_is_counted_is_no_unit_with_an_s(results):
    first = repr(results["Backbone"]).splitlines()[0]
    n = results["Backbone"].to_xarray().sizes["velocity_m_s"]
    assert first == f"Backbone: {n} values of velocity_m_s"
    assert repr(results["SteadyStates"]).startswith("SteadyStates: 24 states")
