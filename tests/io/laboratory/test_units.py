"""Units: our table against Pint's, and the messages of a base install without Pint."""

import sys
from decimal import Decimal

import numpy as np
import pint
import pytest

from snrmjax.io.laboratory import physical_units
from snrmjax.io.laboratory.physical_units import unit_meaning

GRAVITY, POUND = 9.80665, 4.4482216152605


@pytest.mark.parametrize(
    ("text", "dimension", "factor"),
    [
        ("N", "force", 1.0),
        ("lbf", "force", POUND),
        ("g", "acceleration", GRAVITY),
        ("kg", "mass", 1.0),
        ("mg", "mass", 1e-6),
        ("m·s⁻²", "acceleration", 1.0),
        ("in/s²", "acceleration", 0.0254),
        ("(mm/s)/lbf", "velocity", 1e-3 / POUND),
        ("rpm", "frequency", 2 * np.pi / 60),
        ("kHz", "frequency", 2e3 * np.pi),
        ("rad/s", "frequency", 1.0),
        ("°", "angle", np.pi / 180),
    ],
)
def test_units_of_the_table(text, dimension, factor):
    meaning = unit_meaning(text)
    assert meaning.dimension == dimension
    assert meaning.factor == pytest.approx(factor, rel=1e-15)


def test_sensitivities_and_suffixes():
    assert unit_meaning("100 mV/g") == (
        "acceleration",
        pytest.approx(GRAVITY / 0.1),
        "",
        True,
        False,
    )
    assert unit_meaning("50 N/V") == ("force", 50.0, "", True, False)
    assert unit_meaning("mm/s rms") == ("velocity", 1e-3, "rms", False, False)
    for text in ("pC/N", "m^12", "2*m", "qq", "0 N", "m(", "import"):
        with pytest.raises(ValueError, match="not understood"):
            unit_meaning(text)


def test_the_table_has_the_factors_of_pint():
    registry = pint.UnitRegistry(non_int_type=Decimal, cache_folder=None)
    named = "m in ft mm µm micron N kN lbf kgf V mV A s ms min h kg Hz kHz rpm rad deg Pa meters"
    for name in named.split():
        base = registry.Quantity(Decimal(1), registry.parse_units(name)).to_base_units()
        to_radians = 2 * np.pi if name.endswith("Hz") else 1
        assert unit_meaning(name).factor == pytest.approx(
            float(base.magnitude) * to_radians, rel=1e-15
        )


def test_a_base_install_knows_common_units_and_names_the_package_for_others(monkeypatch):
    unit_meaning.cache_clear()
    physical_units._registry.cache_clear()
    monkeypatch.setitem(sys.modules, "pint", None)
    assert unit_meaning("10.2 mV/(m/s)").dimension == "velocity"
    with pytest.raises(ValueError, match=r"without the package pint .*snrmjax\[lab\]"):
        unit_meaning("furlong/s")
    monkeypatch.undo()
    assert unit_meaning("furlong/s").dimension == "velocity"
