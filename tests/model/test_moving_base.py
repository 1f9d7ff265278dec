"""Structures whose base moves: their own formula, a time integration of their own, their files."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import snrmjax as sj
from snrmjax.io.results import write_response

HERTZ = 2 * np.pi
MASS = np.diag([1.0, 0.5])
STIFFNESS = np.array([[30000.0, -10000.0], [-10000.0, 10000.0]])
DAMPING = 3e-4 * STIFFNESS
CUBIC = 2e7

MODEL = """
name = "pair on a table"
[structure]
points = ["root", "tip"]
mass = [[1.0, 0.0], [0.0, 0.5]]
stiffness = [[30000.0, -10000.0], [-10000.0, 10000.0]]
damping = [[9.0, -3.0], [-3.0, 3.0]]
[base]
motion = "absolute"
[[effect]]
kind = "cubic_stiffness"
between = ["tip", "root"]
coefficient = 2e7
"""


def pair(motion="absolute", effects=(), **along):
    base = sj.model.base_motion(motion, along)
    return sj.model.from_matrices(
        MASS, DAMPING, STIFFNESS, ["root", "tip"], base=base, effects=effects
    )


def test_a_linear_structure_follows_its_matrices():
    omega, size = HERTZ * np.array([10.0, 15.9, 30.0]), 2.0
    result = sj.model.linear_response(pair().modes, omega, size)
    for w, velocity in zip(omega, np.asarray(result), strict=True):
        dynamic = STIFFNESS - w**2 * MASS + 1j * w * DAMPING
        relative = np.linalg.solve(dynamic, -MASS @ np.ones(2) * size)
        np.testing.assert_allclose(velocity, 1j * w * relative, rtol=1e-9)
        # What a sensor fixed to the room sees: ẍ = z̈ + a.
        absolute = velocity + pair().modes.base.own_velocity(["root", "tip"], w, size)
        np.testing.assert_allclose(1j * w * absolute, -(w**2) * relative + size, rtol=1e-9)


def test_points_that_turn_away_from_the_base_go_with_their_cosine():
    omega = 15.0 * HERTZ
    result = sj.model.linear_response(pair(tip=-0.5).modes, omega, 1.0)
    dynamic = STIFFNESS - omega**2 * MASS + 1j * omega * DAMPING
    relative = np.linalg.solve(dynamic, -MASS @ [1.0, -0.5])
    np.testing.assert_allclose(result, 1j * omega * relative, rtol=1e-9)


def test_a_nonlinear_response_closes_in_time():
    spring = sj.model.make_effect(
        "cubic_stiffness", {"coefficient": CUBIC}, at=sj.model.between("tip", "root")
    )
    model, size = pair(effects=spring), 3.0
    curve = sj.forced_response(model, size, 14 * HERTZ, 19 * HERTZ, harmonic_order=7)[0]
    peak = int(np.argmax(np.abs(curve.velocity[:, 1, 1])))
    omega, shape = curve.frequency[peak], np.asarray(model.modes.mode_shape)
    cosines, sines = curve.coefficients[peak, 1::2], curve.coefficients[peak, 2::2]
    orders = np.arange(1, 8)[:, None]
    start = np.concatenate(
        [
            shape @ (curve.coefficients[peak, 0] + cosines.sum(axis=0)),
            shape @ (orders * omega * sines).sum(axis=0),
        ]
    )

    def slope(t, y):
        x, v = y[:2], y[2:]
        spring = CUBIC * (x[1] - x[0]) ** 3 * np.array([-1.0, 1.0])
        inertia = np.linalg.solve(MASS, -STIFFNESS @ x - DAMPING @ v - spring)
        return np.concatenate([v, inertia - size * np.cos(omega * t)])

    end = solve_ivp(slope, (0, 2 * np.pi / omega), start, rtol=1e-10, atol=1e-13).y[:, -1]
    np.testing.assert_allclose(end[:2], start[:2], atol=1e-5 * np.abs(start[:2]).max())
    np.testing.assert_allclose(end[2:], start[2:], atol=2e-4 * np.abs(curve.velocity).max())
    nonlinear = CUBIC * np.abs(curve.velocity[peak, 1, 1] / omega) ** 2
    assert nonlinear > 0.1 * STIFFNESS[1, 1]


def test_a_file_holds_a_base_and_the_tables_say_so(tmp_path):
    (tmp_path / "pair.toml").write_text(MODEL)
    model = sj.read_model(tmp_path / "pair.toml")
    assert model.modes.base == sj.model.BaseMotion("absolute")
    assert model.modes.force_unit == "m/s²"
    sj.io.write_model(tmp_path / "modes.toml", model)
    again = sj.read_model(tmp_path / "modes.toml")
    assert again.modes.base == model.modes.base
    np.testing.assert_allclose(again.modes.participation, model.modes.participation, rtol=1e-12)
    curves = sj.forced_response(model, 0.5, 14 * HERTZ, 17 * HERTZ, harmonic_order=3)
    write_response(tmp_path / "response.csv", curves, sensor="tip")
    header, first = (tmp_path / "response.csv").read_text().splitlines()[:2]
    row = dict(zip(header.split(","), first.split(","), strict=True))
    assert float(row["base_acceleration_m_s2"]) == 0.5
    assert "force_n" not in row
    seen = curves[0].velocity[0, 1, 1] + 0.5 / (1j * curves[0].frequency[0])
    written = float(row["velocity_h1_re_m_s"]) + 1j * float(row["velocity_h1_im_m_s"])
    assert written == pytest.approx(seen, rel=1e-9)


def test_a_virtual_test_on_a_table_goes_through_its_file(tmp_path):
    model = dataclasses.replace(pair(), name="pair")
    test = sj.simulate.phase_resonance_test(model, [0.2, 0.4], 12 * HERTZ, 20 * HERTZ)
    states = test.steady_states
    assert states.base == model.modes.base
    sj.io.write_steady_states(tmp_path / "measured.csv", states)
    text = (tmp_path / "measured.csv").read_text()
    assert "base_acceleration_re_m_s2" in text.splitlines()[0]
    back = sj.read_steady_states(tmp_path / "measured.csv", model)
    np.testing.assert_allclose(back.velocity, states.velocity, rtol=1e-10)
    np.testing.assert_allclose(back.force, states.force, rtol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace('"absolute"', '"sideways"'), "absolute or relative"),
        (lambda text: text.replace("[base]", '[force]\nat = "tip"\n[base]'), r"both \[force\]"),
        (lambda text: text.replace('motion = "absolute"', "along = { tip = 1.0 }"), "motion"),
        (
            lambda text: text.replace('"absolute"', '"absolute"\nalong = { top = 1.0 }'),
            "names the point 'top', which does not exist",
        ),
        (
            lambda text: text.replace('"absolute"', '"absolute"\nalong = { tip = 0, root = 0 }'),
            "excites no mode",
        ),
        (lambda text: text.replace('"absolute"', '"absolute"\nspeed = 1'), "speed"),
    ],
)
def test_what_a_base_cannot_be_is_said(tmp_path, change, message):
    (tmp_path / "pair.toml").write_text(change(MODEL))
    with pytest.raises(ValueError, match=message):
        sj.read_model(tmp_path / "pair.toml")


def test_a_force_and_a_base_exclude_each_other():
    with pytest.raises(ValueError, match="either a `force` or a moving `base`"):
        sj.model.from_matrices(MASS, None, STIFFNESS)
    with pytest.raises(ValueError, match="no scale in newtons"):
        pair().modes.forced_at("tip")
    with pytest.raises(ValueError, match="must be 'absolute' or 'relative'"):
        sj.model.base_motion("absolut")
