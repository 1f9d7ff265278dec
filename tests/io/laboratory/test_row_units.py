"""Units after each number of a text, and in a column of their own."""

import numpy as np
import pytest

from snrmjax.io.laboratory.reading import read_laboratory_file

HERTZ = np.linspace(30.0, 34.0, 21)
VELOCITY = 0.01 + 0.1 * np.exp(-((HERTZ - 32) ** 2))


def mixed(number):
    """Small velocities in mm/s, others in m/s."""
    return (f"{1e3 * number:.6f}", "mm/s") if number < 0.05 else (f"{number:.6f}", "m/s")


def read(folder, lines):
    """The only table of a text."""
    path = folder / "a.csv"
    path.write_text("\n".join(lines), encoding="utf-8")
    (table,) = read_laboratory_file(path).tables
    return table


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_units_after_numbers_are_units_of_columns(tmp_path, separator):
    rows = [
        separator.join([f"{f:.1f} Hz", "400 mN" if k else "0.4 N", " ".join(mixed(v)), "-3.5°"])
        for k, (f, v) in enumerate(zip(HERTZ, VELOCITY, strict=True))
    ]
    table = read(tmp_path, [separator.join(["f", "F", "v", "phase"]), *rows])
    assert dict(table.units) == {"f": "Hz", "F": "N", "v": "mm/s", "phase": "°"}
    np.testing.assert_allclose(table.columns["v"], 1e3 * VELOCITY, rtol=1e-4)
    np.testing.assert_allclose(table.columns["F"], 0.4, rtol=1e-15)


def test_units_after_numbers_with_decimal_commas(tmp_path):
    rows = [
        f"{f:.1f} Hz;0,4 N;{v:.6f} m/s".replace(".", ",")
        for f, v in zip(HERTZ, VELOCITY, strict=True)
    ]
    table = read(tmp_path, ["Frequenz;Kraft;Geschwindigkeit", *rows])
    np.testing.assert_allclose(table.columns["Geschwindigkeit"], VELOCITY, atol=5e-7)
    assert table.units["Geschwindigkeit"] == "m/s"


def test_a_column_of_units_is_that_of_the_numbers_before_it(tmp_path):
    rows = [f"{f:.1f},{','.join(mixed(v))},0.4" for f, v in zip(HERTZ, VELOCITY, strict=True)]
    table = read(tmp_path, ["f [Hz],v,unit,F [N]", *rows])
    assert table.units["v"] == "mm/s"
    np.testing.assert_allclose(table.columns["v"], 1e3 * VELOCITY, rtol=1e-4)


@pytest.mark.parametrize("other", ["g", "N"])
def test_units_of_other_quantities_are_refused_by_row(tmp_path, other):
    rows = [f"{f:.1f},0.1,{'m/s' if k < 3 else other},0.4" for k, f in enumerate(HERTZ)]
    with pytest.raises(ValueError, match=r"v of a\.csv must have units of one .* row 5"):
        read(tmp_path, ["f [Hz],v,unit,F [N]", *rows])


def test_names_after_a_leading_separator(tmp_path):
    rows = [f"{f:.1f}\t0.4\t{v:.6f}" for f, v in zip(HERTZ, VELOCITY, strict=True)]
    table = read(tmp_path, ["\tf [Hz]\tF [N]\tv [m/s]", *rows])
    assert dict(table.units) == {"f": "Hz", "F": "N", "v": "m/s"}
