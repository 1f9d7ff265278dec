"""How the blind sets' scorer counts drawn laws: by formulas that are written down here again."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

FOLDER = str(Path(__file__).resolve().parents[1] / "benchmarks" / "blind_sets")
SHAPE, FREQUENCY, SIZE = 2.0, 30.0, 1e-3  # kg^-1/2, Hz, kg^1/2 m
LARGEST, FASTEST = 2e-3, 0.4  # m and m/s at the sensor: twice the scales above


@pytest.fixture(scope="module")
def blind():
    sys.path.insert(0, FOLDER)
    names = ("drawn", "effects", "fresh_laws", "plans", "reliability", "score")
    yield type("Blind", (), {name: importlib.import_module(name) for name in names})
    sys.path.remove(FOLDER)


def key(effects=(), outside=None, group="one_effect", harmonics=True, **parameters):
    """A key as the generator writes it; only effects of the library have physical parameters."""
    kind = outside or (effects[0] if effects else "")
    return {
        "name": "one", "group": group, "effects": list(effects), "outside": outside,
        "parameters": {f"{kind}.{name}": value for name, value in parameters.items()},
        "parameters_scaled": outside is not None, "strength": 1.0, "harmonics": harmonics,
        "level_errors": False, "noise_units": {"bottom": 5.0, "top": 5.0},
        "baseline": {"shape": SHAPE, "frequency_hz": FREQUENCY, "displacement_scale": SIZE},
    }  # fmt: skip


def drawing(kind, force, *, moved=0.0, rivals=()):
    """A drawn answer: a force of x or v with a band of 1 %, moved by so many of its 1σ."""
    of_speed = kind == "damping_law"
    top = FASTEST if of_speed else LARGEST
    at = np.linspace(-top if kind == "uneven_stiffness_law" else 0.0, top, 201)
    true = force(at)
    std = 0.01 * np.abs(true).max() * np.ones_like(at)
    law = {"displacement_m": at} if not of_speed else {"velocity_m_s": at}
    law |= {"force_n": true + moved * std, "force_std_n": std, "measured_up_to": top}
    law |= {"at_velocity_m_s": FASTEST} if kind == "displacement_damping_law" else {}
    gap = {"held_out_before": 6.0, "held_out_after": 1.0, "noise_floor": 1.0}
    candidates = [[kind, *rivals]]
    return {
        "verdict": "drawn", "effects": [kind], "candidates": candidates, "law": law, "gap": gap,
        "parameters": {}, "probability": 0.97,
    }  # fmt: skip


W = 2 * np.pi * FREQUENCY
# Kind drawn, key, and the force at the sensor: f(q = x/φ)/φ, f as the table of effects has it.
TRUE = {
    "quadratic_damping": (
        "damping_law", {"effects": ("quadratic_damping",), "coefficient": 7.0},
        lambda v: 7.0 * v**2 / SHAPE**3,
    ),
    "coulomb_friction": (
        "damping_law", {"effects": ("coulomb_friction",), "force": 0.3},
        lambda v: 0.3 / SHAPE * (v > 0),
    ),
    "cubic_stiffness": (
        "stiffness_law", {"effects": ("cubic_stiffness",), "coefficient": 4e9},
        lambda x: 4e9 * x**3 / SHAPE**4,
    ),
    "one_sided_stop": (
        "uneven_stiffness_law", {"effects": ("one_sided_stop",), "stiffness": 5e3, "gap": 4e-4},
        lambda x: 5e3 * np.maximum(x / SHAPE - 4e-4, 0) / SHAPE,
    ),
    "van_der_pol_damping": (
        "displacement_damping_law", {"effects": ("van_der_pol_damping",), "coefficient": 9e6},
        lambda x: 9e6 * (x / SHAPE) ** 2 * FASTEST / SHAPE**2,
    ),
    "jenkins_slider": (
        "slip_law",
        {"effects": ("jenkins_slider",), "stiffness": 3e3, "slip_displacement": 3e-4},
        lambda x: -3e3 * np.maximum(x / SHAPE - 3e-4, 0) / SHAPE,
    ),
    "iwan_microslip": (
        "slip_law", {"effects": ("iwan_microslip",), "coefficient": 2e4, "exponent": 1.4},
        lambda x: -2e4 * (x / SHAPE) ** 1.4 / SHAPE,
    ),
    "asymmetric_damping": (
        "damping_law", {"outside": "asymmetric_damping", "coefficient": 0.02},
        lambda v: 0.02 * (v / SHAPE / W / SIZE) ** 2 * W**2 * SIZE / SHAPE,
    ),
    "steep_damper": (
        "damping_law", {"outside": "steep_damper", "coefficient": 0.02},
        lambda v: 0.02 * (v / SHAPE / W / SIZE) ** 2.5 * W**2 * SIZE / SHAPE,
    ),
    "stroke_damping": (
        "displacement_damping_law", {"outside": "stroke_damping", "coefficient": 0.03},
        lambda x: 0.03 * (x / SHAPE / SIZE) * W * FASTEST / SHAPE**2,
    ),
    "uniform_lap": (
        "slip_law", {"outside": "uniform_lap", "stiffness": 0.2, "slip_displacement": 2.0},
        # Slip limits equally likely up to 2: the mean of (x − s)⁺ is x²/4 over two Q_s.
        lambda x: -0.2 * (x / SHAPE / SIZE) ** 2 / 4 * W**2 * SIZE / SHAPE,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", TRUE)
def test_the_true_force_is_right_and_one_beside_the_band_confidently_wrong(blind, name):
    kind, parameters, force = TRUE[name]
    truth = key(**parameters, group="law" if "outside" in parameters else "one_effect")
    right = blind.score.Result(truth, drawing(kind, force, moved=1.5))
    assert (right.drawing, right.confidently_wrong) == ("drawn right", False)
    assert blind.reliability.is_right(right)
    wrong = blind.score.Result(truth, drawing(kind, force, moved=3.0))
    assert (wrong.drawing, wrong.confidently_wrong) == ("drawn wrong", True)
    assert not blind.reliability.is_right(wrong)
    if truth["outside"]:
        assert right.honest_outside
        assert not wrong.honest_outside


def test_without_harmonics_the_odd_part_is_what_can_be_drawn(blind):
    _, parameters, force = TRUE["one_sided_stop"]
    answer = drawing("stiffness_law", lambda x: 0.5 * (force(x) - force(-x)))
    found = {seen: blind.score.Result(key(**parameters, harmonics=seen), answer).drawing
             for seen in (False, True)}  # fmt: skip
    assert found == {False: "drawn right", True: "drawn wrong"}


def test_a_law_of_another_class_is_wrong_unless_the_true_class_is_named_beside_it(blind):
    _, parameters, force = TRUE["van_der_pol_damping"]
    truth, velocity = key(**parameters), lambda v: force(v * LARGEST / FASTEST)
    alone = blind.score.Result(truth, drawing("damping_law", velocity))
    beside = drawing("damping_law", velocity, rivals=("displacement_damping_law",))
    assert (alone.drawing, alone.confidently_wrong) == ("drawn wrong", True)
    both = blind.score.Result(truth, beside)
    assert (both.drawing, both.confidently_wrong) == ("class open", False)
    assert not blind.reliability.is_right(both)


@pytest.mark.parametrize(
    "truth",
    [
        key(group="none"),
        key(("frequency_drift",), relative_drift=0.01),
        key(("sensor_phase_error",), phase_deg=5.0),
        key(outside="sensor_saturation", group="outside", inverse_range=0.1),
    ],
)
def test_a_force_drawn_where_none_acts_is_confidently_wrong(blind, truth, capsys):
    found = blind.score.Result(truth, drawing("stiffness_law", lambda x: 4e9 * x**3))
    assert (found.drawing, found.confidently_wrong) == ("drawn wrong", True)
    assert not blind.reliability.is_right(found)
    blind.score.print_misses([found])
    assert "drawn wrong" in capsys.readouterr().out
    rows, columns, counts = blind.score.confusion([found])
    assert counts[rows.index((truth["effects"] or [truth["outside"] or "none"])[0])][
        columns.index("drawn")
    ]


def test_the_fresh_laws_are_no_line_at_rest_and_were_in_no_earlier_set(blind):
    of = blind.fresh_laws.OF
    assert len(of) == 16
    assert not set(of) & {*blind.effects.LAWS, *blind.effects.OUTSIDE, *blind.effects.SHAPES}
    plans = blind.plans.law_plans("fresh")
    assert {plan.kinds[0] for plan in plans if plan.kinds} == set(of)
    rng, base = np.random.default_rng(3), blind.effects.Baseline(0.01, 0.0, (0.2, 1.0))
    for kind in (kind for kind, argument in of.items() if argument == "displacement"):
        drawn = blind.effects.draw_effect(kind, rng, base).parameters
        force = blind.drawn.curve_of(kind, drawn, np.array([-1e-4, 0.0, 1e-4]))
        # The slope at rest is that of the linear frequency: x² is what is left of it.
        assert force[1] == 0.0
        assert np.abs(force).max() < 1e-7
    joint = {"stiffness": 0.4, "slip_displacement": 0.2, "ratio": 3.0, "share": 0.25}
    joint = {f"two_stage_joint.{name}": value for name, value in joint.items()}
    # A quarter of the stiffness slips beyond 0.2, the rest beyond 0.6.
    force = blind.drawn.curve_of("two_stage_joint", joint, np.array([0.1, 0.5, 1.0]))
    np.testing.assert_allclose(force, [0.0, -0.03, -0.08 - 0.12], rtol=1e-6, atol=1e-9)
