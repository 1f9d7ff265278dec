"""The generator of blind sets against exact answers and first-order formulas."""

import numpy as np
import pytest

STEPS = 128  # a period: enough for the tolerances here


@pytest.fixture(scope="module")
def blind(of_benchmark):
    """The benchmark's modules, which stand beside each other and not in a package."""
    names = ("drawn", "effects", "forces", "integration", "laws", "sweep", "truth")
    return type("Blind", (), {name: of_benchmark(f"blind_sets/{name}") for name in names})


def lanes(blind, rows, *, start, direction):
    """Lanes from dictionaries of what differs from a plain mode of 1 % damping."""
    plain = dict.fromkeys(blind.truth.ZEROS, 0.0)
    plain |= {"lane.damping": 0.01, "lane.force": 0.02, "lane.speed": 1.0}
    plain |= {"baseline.cubic": 0.0, **dict.fromkeys(SMALL, 0.0), **SHAPES}
    # All forces without memory in every call: one compiled program serves them all.
    names = sorted({name for row in rows for name in row} | set(plain))
    table = {n: np.array([row.get(n, plain.get(n, 0.0)) for row in rows]) for n in names}
    n = len(rows)
    return blind.sweep.Lanes(
        table, np.full(n, start), np.full(n, direction), np.full(n, 18.0), np.zeros(n),
        np.full(n, 1 / 60),
    )  # fmt: skip


def swept(blind, rows, *, start=0.975, direction=1, system=None):
    """Frequency, displacement and velocity phasors of each lane."""
    system = system or blind.integration.System(steps=STEPS)
    found = blind.sweep.run_sweeps(system, lanes(blind, rows, start=start, direction=direction))
    for sweep in found:
        assert sweep.left_out == 0
        assert len(sweep.points) > 4
    return [
        (
            np.array([p.frequency for p in s.points]),
            np.array([p.displacement for p in s.points]),
            np.array([p.velocity for p in s.points]).T,
        )
        for s in found
    ]


def test_a_linear_oscillator_gives_the_transfer_function(blind):
    rows = [
        {"lane.damping": z, "lane.force": 2 * z, "lane.second": 0.1} for z in (0.002, 0.01, 0.03)
    ]
    # 2e-6: what a residual of 2e-8 a period leaves at the smallest damping, 2e-8/(2π 0.002).
    for row, (w, y, v) in zip(rows, swept(blind, rows), strict=True):
        for h, load in ((1, 1.0), (2, 0.1)):
            damping = 2j * row["lane.damping"] * h * w
            exact = row["lane.force"] * load / (1 - (h * w) ** 2 + damping)
            assert np.allclose(v[h], 1j * h * w * exact, rtol=5e-6, atol=1e-8)
        assert np.allclose(v[1], 1j * w * y, rtol=5e-6)


def first_order(kind, size, q, w):
    """Δ(ω̃²) + iΩ Δδ as the table of effects has it, for ω₀ = 1."""
    half = 0.5 / q  # g/Q
    inside = (
        2 / np.pi * (np.arcsin(np.minimum(half, 1)) + half * np.sqrt(1 - np.minimum(half, 1) ** 2))
    )
    gap = np.where(half < 1, 1 - inside, 0.0)
    theta = np.arccos(1 - 2 * np.minimum(half, 1))
    slipping = np.where(half < 1, 4 * half * (1 - half), 0.0)
    return (
        size
        * {
            "cubic_stiffness.coefficient": 0.75 * q**2,
            "quintic_stiffness.coefficient": 0.625 * q**4,
            "gap_stiffness.stiffness": gap,
            "one_sided_stop.stiffness": 0.5 * gap,
            "coulomb_friction.force": 4j / (np.pi * q),
            "quadratic_damping.coefficient": 8j * w**2 * q / (3 * np.pi),
            "cubic_damping.coefficient": 0.75j * w**3 * q**2,
            "van_der_pol_damping.coefficient": 0.25j * w * q**2,
            "quadratic_stiffness.coefficient": -5 / 6 * size * q**2,
            "jenkins_slider.stiffness": (theta - np.sin(theta) * np.cos(theta)) / np.pi
            - 1
            + 1j * slipping / np.pi,
            "iwan_microslip.coefficient": q**0.5 * (-1 + 4j * 0.5 / (np.pi * 2.5)),
            "lane.mass": -(w**2),
        }[kind]
    )


SMALL = {
    "cubic_stiffness.coefficient": 2e-3,
    "quintic_stiffness.coefficient": 2e-3,
    "gap_stiffness.stiffness": 5e-3,
    "one_sided_stop.stiffness": 5e-3,
    "coulomb_friction.force": 5e-4,
    "quadratic_damping.coefficient": 1e-3,
    "cubic_damping.coefficient": 1e-3,
    "van_der_pol_damping.coefficient": 2e-3,
    "quadratic_stiffness.coefficient": 0.04,
    "lane.mass": 1e-3,
}
SHAPES = {"gap_stiffness.gap": 0.5, "one_sided_stop.gap": 0.5}


def check_first_order(found, sizes):
    for (kind, size), (w, y, _) in zip(sizes.items(), found, strict=True):
        change = 0.02 / y - (1 - w**2 + 0.02j * w)
        wanted = first_order(kind, size, np.abs(y), w)
        # Beside the first order: the square of an effect of at most 5e-3, friction's rounded sign.
        assert np.max(np.abs(change - wanted)) < 0.02 * np.max(np.abs(wanted)) + 2e-7, kind


def test_small_effects_follow_the_first_order_formulas(blind):
    rows = [{kind: size, **SHAPES} for kind, size in SMALL.items()]
    check_first_order(swept(blind, rows), SMALL)


def test_a_slider_follows_the_first_order_formula(blind):
    sizes = {"jenkins_slider.stiffness": 2e-3}
    row = {**sizes, "jenkins_slider.slip_displacement": 0.5}
    system = blind.integration.System(sliders="jenkins_slider", steps=STEPS)
    check_first_order(swept(blind, [row], system=system), sizes)


def test_sliders_side_by_side_are_an_iwan_element(blind):
    p = {"iwan_microslip.coefficient": np.ones(3), "iwan_microslip.exponent": np.full(3, 1.5)}
    stiffness, slip = (np.asarray(part) for part in blind.forces.sliders("iwan_microslip", p))
    q, blocks, beta = np.array([0.3, 0.6, 1.0]), np.zeros(slip.shape), np.arange(1200) * np.pi / 300
    force = []
    for angle in beta:
        y = q * np.cos(angle)
        blocks = np.clip(blocks, y - slip, y + slip)
        force.append(-np.sum(stiffness * blocks, axis=0))
    cycle, turn = np.array(force[-600:]), np.exp(-1j * beta[-600:])
    found = 2 * np.mean(cycle * turn[:, None], axis=0) / q
    wanted = first_order("iwan_microslip.coefficient", 1.0, q, 1.0)
    # The damping is exact for a continuum of sliders, the stiffness' formula a rule of thumb.
    assert np.allclose(found.imag, wanted.imag, rtol=0.02)
    assert np.allclose(found.real, wanted.real, rtol=0.1)


def test_the_generator_sizes_effects_by_the_same_formulas(blind):
    at = blind.effects.Points(
        np.zeros(3, int), np.array([0.6, 0.8, 1.0]), np.array([0.99, 1.0, 1.01]), np.zeros(3)
    )
    base = blind.effects.Baseline(0.01, 0.0, (1.0,))
    for name, size in SMALL.items():
        kind, parameter = name.split(".")
        kind = {"lane": "added_mass"}.get(kind, kind)
        values = {f"{kind}.{parameter}": size, f"{kind}.gap": 0.5}
        effect = blind.effects.Effect(kind, values, ())
        found = blind.effects.first_order_change(effect, at, base)
        wanted = first_order(name, size, at.amplitude, at.frequency)
        # 0.02: the quadratic stiffness' formula is that at resonance.
        assert np.allclose(found, wanted, rtol=0.02, atol=1e-7), name


def test_sweeps_up_and_down_jump_at_different_frequencies(blind):
    cubic = {"baseline.cubic": 0.25}
    ((up, y_up, _),) = swept(blind, [cubic], start=0.975)
    ((down, y_down, _),) = swept(blind, [cubic], start=1.15, direction=-1)
    # Both stay on Duffing's curve; 3/128 (a₃Q²)² is what one term leaves out.
    for w, y in ((up, y_up), (down, y_down)):
        residual = 0.02 / y - (1 - w**2 + 0.02j * w + 0.1875 * np.abs(y) ** 2)
        assert np.max(np.abs(residual)) < 2e-3
    top = up[np.argmax(np.abs(y_up))]
    both = (down < top) & (y_down.real < 0)
    assert np.abs(y_up).max() > 0.8
    assert both.any(), "the lower branch reaches below the upper one's end"
    assert np.abs(np.interp(down[both], up, np.abs(y_up))).min() > 0.7


def test_instruments_falsify_as_their_first_order_says(blind):
    base = blind.effects.Baseline(0.01, 0.0, (1.0,))
    w = np.array([0.99, 1.0, 1.01])
    k = 1 - w**2 + 0.02j * w
    force = np.full(3, 0.02)
    x = force / k
    at = blind.effects.Points(np.zeros(3, int), np.abs(x), w, np.zeros(3))
    small = {
        "force_gain_error": {"gain": 1e-4},
        "force_offset_error": {"offset": 1e-6},
        "sensor_gain_error": {"gain": 1e-4},
        "sensor_phase_error": {"phase_deg": 0.01},
        "residual_mode": {"receptance": 1e-3},
        "mode_shape_change": {"coefficient": 1e-4},
        "close_mode": {"constant": 1e-5, "frequency": 1.05, "damping_ratio": 0.01},
    }
    velocity = np.stack([0 * x, 1j * w * x, 0.01 * x, 0.01 * x])
    for kind, values in small.items():
        effect = blind.effects.Effect(kind, {f"{kind}.{n}": v for n, v in values.items()}, ())
        f, v = blind.effects.recorded(effect, w, force, velocity, np.abs(x))
        change = f / (v[1] / (1j * w)) - k
        wanted = blind.effects.first_order_change(effect, at, base)
        # 2e-3: the square of errors of up to 1e-3.
        assert np.abs(change - wanted).max() < 2e-3 * np.abs(wanted).max(), kind
        assert np.abs(wanted).max() > 1e-8
    # Signs and sizes as the model file defines them.
    phase = blind.effects.Effect("sensor_phase_error", {"sensor_phase_error.phase_deg": 90.0}, ())
    _, turned = blind.effects.recorded(phase, w, force, velocity, np.abs(x))
    assert np.allclose(turned, velocity * np.array([[1], [1j], [-1], [-1j]]))
    gain = blind.effects.Effect("force_gain_error", {"force_gain_error.gain": 0.25}, ())
    assert np.allclose(blind.effects.recorded(gain, w, force, velocity, np.abs(x))[0], 0.016)


@pytest.mark.parametrize("order", [2, 3])
def test_a_coupled_mode_acts_back_as_the_formula_says(blind, order):
    kind, near = f"internal_resonance_1_{order}", 1.1 * order
    values = {"coefficient": 0.02, "frequency": near, "damping_ratio": 0.01}
    effect = blind.effects.Effect(kind, {f"{kind}.{n}": v for n, v in values.items()}, ())
    system = blind.integration.System(2, coupling=order, steps=STEPS)
    ((w, y, _),) = swept(blind, [blind.effects.lane_values(effect)], system=system)
    q, b = np.abs(y), 0.02
    # V = b q^n q₂: the further mode's harmonics that q^n drives, times n b q^(n−1).
    far = [near**2 - (h * w) ** 2 + 2j * 0.01 * near * h * w for h in range(4)]
    if order == 3:
        wanted = -(b**2) * q**4 * (3 / 16 / far[3] + 27 / 16 / far[1])
    else:
        wanted = -(b**2) * q**2 * (0.5 / far[2] + 1 / far[0])
    change = 0.02 / y - (1 - w**2 + 0.02j * w)
    # 0.01: the change is itself up to 0.4 % of the stiffness.
    assert np.abs(change - wanted).max() < 0.01 * np.abs(wanted).max()
    at = blind.effects.Points(np.zeros(len(w), int), q, w, w)
    formula = blind.effects.first_order_change(effect, at, blind.effects.Baseline(0.01, 0, (1,)))
    # The imaginary part of the term that is far from resonance is left out there.
    assert np.allclose(formula, wanted, atol=0.01 * np.abs(wanted).max())


def test_laws_outside_the_library_have_the_curves_that_are_scored(blind):
    laws, x = blind.laws, np.array([0.1, 0.3, 0.6])
    dahl = {"dahl.stiffness": 0.2, "dahl.slip_displacement": 0.25}
    # dz/dx = 1 − z/s from rest: z = s(1 − e^(−x/s)), beside the stuck spring.
    first = 0.2 * (0.25 * (1 - np.exp(-x / 0.25)) - x)
    np.testing.assert_allclose(laws.true_curve("dahl", dahl, x), first, rtol=1e-5)
    lap = {"weibull_lap.stiffness": 0.2, "weibull_lap.slip_displacement": 0.25}
    lap["weibull_lap.exponent"] = 1.0
    # ∫ (x − s)⁺ over exponential slip limits: x − 0.25(1 − e^(−x/0.25)); 48 quantiles.
    lost = 0.2 * (x - 0.25 * (1 - np.exp(-x / 0.25)))
    np.testing.assert_allclose(laws.true_curve("weibull_lap", lap, x), -lost, rtol=0.01)
    rng, base = np.random.default_rng(1), blind.effects.Baseline(0.01, 0.0, (0.2, 1.0))
    for kind in (kind for kind, of in laws.OF.items() if of == "displacement"):
        drawn = blind.effects.draw_effect(kind, rng, base).parameters
        force = laws.true_curve(kind, drawn, np.array([-1e-4, 0.0, 1e-4]))
        # The slope at rest is taken out: what is left there is x^1.5 at most.
        assert force[1] == 0.0
        assert np.abs(force).max() < 2e-6


SHAPE, FREQUENCY, SIZE = 2.0, 30.0, 1e-3  # kg^-1/2, Hz, kg^1/2 m
LARGEST, FASTEST = 2e-3, 0.4  # m and m/s at the sensor: twice the scales above
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
}  # fmt: skip


@pytest.mark.parametrize("name", TRUE)
def test_a_drawn_law_is_held_against_the_force_of_the_effects_own_formula(blind, name):
    kind, given, force = TRUE[name]
    outside = given.get("outside")
    key = {
        "effects": list(given.get("effects", ())), "outside": outside, "harmonics": True,
        "parameters": {f"{name}.{k}": v for k, v in given.items() if isinstance(v, float)},
        "parameters_scaled": outside is not None,
        "baseline": {"shape": SHAPE, "frequency_hz": FREQUENCY, "displacement_scale": SIZE},
    }  # fmt: skip
    at = np.linspace(0.0, FASTEST if kind == "damping_law" else LARGEST, 201)
    found = blind.drawn.true_force(key, at, {"at_velocity_m_s": FASTEST})
    # Friction's sign is rounded over a thousand-millionth of the largest speed.
    np.testing.assert_allclose(found, force(at), rtol=1e-6, atol=1e-9 * np.abs(force(at)).max())
