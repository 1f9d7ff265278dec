"""Tables with base excitation: phase reference, subtraction of the base motion, refusals."""

import numpy as np
import pytest

import snrmjax as sj
from snrmjax.model.modes import OptionalModalData

HERTZ = 2 * np.pi
OWN, RATIO, MASS = 50 * HERTZ, 0.01, 0.4
HEADER = (
    "level,frequency_hz,base_acceleration_re_m_s2,base_acceleration_im_m_s2,"
    "velocity_re_m_s,velocity_im_m_s"
)


def model(motion):
    base = None if motion is None else sj.model.base_motion(motion)
    modes = sj.model.linear_modes(
        *([OWN], [RATIO], [[MASS**-0.5]], [-(MASS**0.5)]),
        sensors=("tip",),
        optional=OptionalModalData(base=base),
    )
    return sj.model.structure(modes)


def table(tmp_path, *, absolute=True, header=HEADER, extra=""):
    rows = [header]
    for k, hertz in enumerate((49.5, 50.0, 50.4)):
        w, a = hertz * HERTZ, 2.0 * np.exp(1.3j * k)
        v = -1j * w * a / (OWN**2 - w**2 + 2j * RATIO * OWN * w)
        v += a / (1j * w) if absolute else 0
        numbers = (hertz, a.real, a.imag, v.real, v.imag)
        rows.append(",".join(["1", *(repr(float(x)) for x in numbers)]) + extra)
    path = tmp_path / "measured.csv"
    path.write_text("\n".join(rows) + "\n")
    return path


@pytest.mark.parametrize("motion", ["absolute", "relative"])
def test_the_motion_of_the_base_is_subtracted_for_absolute_sensors(tmp_path, motion):
    path = table(tmp_path, absolute=motion == "absolute")
    data = sj.read_steady_states(path, model(motion))
    np.testing.assert_allclose(data.force, 2.0, rtol=1e-12)
    points = sj.identify.identify_points(data, model(motion).modes)
    np.testing.assert_allclose(points.natural_frequency, OWN, rtol=1e-10)
    np.testing.assert_allclose(points.damping_ratio, RATIO, rtol=1e-7)
    assert "base_acceleration_m_s2" in data.to_xarray()
    assert "acceleration of the base 2 to 2 m/s²" in repr(data)


def test_errors_are_rotated_with_the_velocity(tmp_path):
    header = f"{HEADER},velocity_std_m_s,phase_std_deg,base_acceleration_std_m_s2"
    path = table(tmp_path, header=header, extra=",0.001,0,0.02")
    data = sj.read_steady_states(path, model("absolute"))
    recorded = sj.read_steady_states(path)
    across = np.angle(np.asarray(data.velocity) / np.asarray(recorded.velocity))
    # An error of 1 mm/s along the recorded phasor, resolved along and across the relative one.
    np.testing.assert_allclose(data.velocity_std, 1e-3 * np.abs(np.cos(across)), rtol=1e-9)
    expected = 1e-3 * np.abs(np.sin(across) / np.asarray(data.velocity))
    np.testing.assert_allclose(data.phase_std, expected, rtol=1e-9)
    np.testing.assert_allclose(data.force_std, 0.02)


@pytest.mark.parametrize(
    ("motion", "old", "new", "message"),
    [
        (None, "", "", r"the model has no \[base\]"),
        ("absolute", "base_acceleration_im_m_s2", "further", "lacks `base_acceleration_im_m_s2`"),
        ("absolute", "level,", "force_n,", "either a force or the acceleration"),
        (
            "absolute",
            "base_acceleration_re_m_s2",
            "base_acceleration_re_g",
            "not one of the format",
        ),
        ("absolute", "velocity_re_m_s,velocity_im_m_s", "velocity_m_s,order", "without phases"),
    ],
)
def test_invalid_base_tables_are_refused(tmp_path, motion, old, new, message):
    path = table(tmp_path, header=HEADER.replace(old, new) if old else HEADER)
    if new == "force_n,":
        text = path.read_text().splitlines()
        path.write_text("\n".join([f"force_n,{HEADER}", *(f"1.0,{row}" for row in text[1:])]))
    if "order" in new:
        rows = [row.split(",") for row in path.read_text().splitlines()[1:]]
        lines = [",".join([*row[:4], str(abs(float(row[4]))), "0.5"]) for row in rows]
        path.write_text("\n".join([HEADER.replace(old, new), *lines]))
    with pytest.raises(ValueError, match=message):
        sj.read_steady_states(path, model(motion))


def test_a_force_where_the_model_has_a_base_is_refused(tmp_path):
    path = tmp_path / "measured.csv"
    path.write_text("level,frequency_hz,force_n,velocity_re_m_s,velocity_im_m_s\n1,50,1,0.1,0\n")
    with pytest.raises(ValueError, match=r"has `force_n`, but the model has base excitation"):
        sj.read_steady_states(path, model("absolute"))
