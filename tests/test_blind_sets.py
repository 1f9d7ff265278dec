"""The generator of blind sets: exact answers, first-order formulas, jumps, files and keys."""

import csv
import importlib
import json
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "tests" / "diagnose"
STEPS = 128  # a period: enough for the tolerances here
GROUPS = {"none", "one_effect", "two_effects", "outside", "beam", "noise_wrong"}


@pytest.fixture(scope="module")
def blind():
    """The benchmark's modules, which stand beside each other and not in a package."""
    folder = str(ROOT / "benchmarks" / "blind_sets")
    sys.path.insert(0, folder)
    names = (
        "effects",
        "forces",
        "further",
        "integration",
        "laws",
        "plans",
        "records",
        "reliability",
        "score",
        "strength",
        "sweep",
        "truth",
    )
    modules = {name: importlib.import_module(name) for name in names}
    yield type("Blind", (), modules)
    sys.path.remove(folder)


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


def test_an_unstable_motion_is_found_and_not_recorded(blind):
    w, load, found = 1.06, 0.02, lanes(blind, [{"baseline.cubic": 0.25}], start=1.06, direction=1)
    q = np.sort(np.roots([(0.1875) ** 2, 0, 2 * 0.1875 * (1 - w**2), 0, (1 - w**2) ** 2
                          + (0.02 * w) ** 2, 0, -(load**2)]).real)[-2]  # fmt: skip
    y = load / (1 - w**2 + 0.02j * w + 0.1875 * q**2)
    run = blind.sweep._Run(blind.integration.System(steps=STEPS), found)
    run.x = np.array([[y.real], [-y.imag]])
    lost = np.array([], dtype=int)
    for _ in range(6):
        lost = run.newton(np.array([0]))
        if len(lost):
            break
    assert lost.tolist() == [0]
    assert run.points[0] == []
    assert abs(np.hypot(*run.x[:, 0]) - q) < 0.05, "Newton stayed on the middle branch"
    result = blind.integration.period_map(
        run.system, run.parameters(np.zeros(16, int)), np.full(16, w),
        np.tile(run.x, 16), np.zeros((0, 16)),
    )  # fmt: skip
    multipliers = np.linalg.eigvals(result.derivative[0])
    assert np.abs(multipliers).max() > 1
    # Liouville: their product is that of damping alone; 1e-3 for the derivative's nudge.
    assert np.isclose(np.prod(multipliers).real, np.exp(-2 * np.pi * 0.02 / w), rtol=1e-3)


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


def rows_of(path):
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def drawn(blind, kinds, half="development", index=7):
    """A case of two levels, quick to simulate."""
    group = "one_effect" if kinds else "none"
    plan = blind.plans.Plan(group, kinds, float(bool(kinds)))
    case = blind.plans.draw_case(plan, index, half, 3)
    case.name = f"set_{index:04d}"
    ends = (case.base.peaks[0], 1.0)
    base = blind.effects.Baseline(max(case.base.damping, 0.01), case.base.cubic, ends)
    return replace(case, base=base, sequence=(0, 1), n_points=24, step_deg=case.step_deg[:4])


@pytest.fixture(scope="module")
def small_sets(blind):
    """A few small sets of the development half, calibrated."""
    kinds = ((), ("coulomb_friction",), ("sensor_gain_error",), ("frequency_drift",))
    cases = [drawn(blind, kind, index=7 + n) for n, kind in enumerate(kinds)]
    return cases, blind.truth.calibrated(cases, rounds=1, steps=STEPS)


def test_strengths_are_as_wanted_and_no_effect_is_none(blind, small_sets):
    cases, truths = small_sets
    for case, truth in zip(cases, truths, strict=True):
        found = max(truth.units["bottom"], truth.units["top"])
        if case.effects:
            assert 0.8 < found / case.wanted[0] < 1.25
        else:
            assert max(truth.units.values()) < 0.05
        assert truth.residual < 1e-7
        phase = np.degrees(np.angle(truth.velocity[1]))
        assert np.abs(phase).max() <= 60
        assert len(truth.level) >= 15


def test_files_hold_what_the_key_says(blind, small_sets, tmp_path):
    for case, truth in zip(*small_sets, strict=True):
        blind.records.write_set(case, truth, tmp_path, tmp_path)
        key = json.loads((tmp_path / f"{case.name}.json").read_text())
        rows = rows_of(tmp_path / f"{case.name}.csv")
        model = tomllib.loads((tmp_path / f"{case.name}.toml").read_text())
        assert key["effects"] == [e.kind for e in case.effects]
        assert len(rows) == key["rows"]
        assert ("velocity_h3_re_m_s" in rows[0]) == key["harmonics"]
        assert ("measurement" in model) == key["level_errors"]
        assert "effect" not in model
        mode = model["mode"][0]
        off = (mode["frequency_hz"] - key["baseline"]["frequency_hz"]) / mode["frequency_std_hz"]
        assert 0 < abs(off) < 4
        # The noise is the stated one: the table against the truth, 1σ and generously 5σ.
        speed = 2 * np.pi * case.natural_frequency_hz * case.displacement * case.shape
        v = np.array([float(r["velocity_re_m_s"]) + 1j * float(r["velocity_im_m_s"]) for r in rows])
        error = v / (truth.velocity[1] * speed) - 1
        if not case.plan.level_errors:
            assert 0.006 < np.std(error.real) < 0.015
        assert np.abs(error).max() < 0.09


def asked(kind, **settings):
    """What a diagnosis asks for."""
    nothing = {"harmonics": [], "harmonic_std_m_s": None}
    return {"kind": kind, "level": 2, "states": 6, "phase_deg": [10.0, 50.0], **nothing, **settings}


def test_harmonics_are_added_where_they_were_asked_for_and_nothing_else_moves(blind, small_sets):
    case, truth = small_sets[0][1], small_sets[1][1]
    silent = replace(case, plan=replace(case.plan, harmonics=False))
    before, loud = blind.records.table(silent, truth), blind.records.table(case, truth)
    floor = loud["harmonic_std_m_s"][0] / 5
    request = asked("harmonics", harmonics=[2, 3], harmonic_std_m_s=floor)
    columns, whole = blind.further.answered(silent, truth, request)
    assert whole is truth
    for name, values in before.items():
        np.testing.assert_array_equal(columns[name], values)
    here = before["level"] == 2
    third = columns["velocity_h3_re_m_s"]
    assert np.isfinite(third[here]).all()
    assert np.isnan(third[~here]).all()
    speed = 2 * np.pi * case.natural_frequency_hz * case.displacement * case.shape
    own = truth.velocity[3].real * speed
    # The noise is what was asked for; 4σ, and gain and phase errors of the harmonic itself.
    assert np.abs(third - own)[here].max() < 4 * floor + 0.1 * np.abs(own).max()
    np.testing.assert_allclose(columns["harmonic_std_m_s"][here], floor)


@pytest.mark.parametrize("kind", ["higher_level", "off_resonance"])
def test_further_states_are_of_the_same_structure_after_the_test(blind, small_sets, kind):
    case, truth = small_sets[0][0], small_sets[1][0]  # nothing is hidden
    before = blind.records.table(case, truth)
    force = 1.5 * np.median(before["force_n"][before["level"] == 2])
    request = asked(kind, force_n=force)
    columns, whole = blind.further.answered(case, truth, request, steps=STEPS)
    n = len(truth.level)
    for name in set(before) - {"order"}:
        np.testing.assert_array_equal(columns[name][:n], before[name])
    assert len(columns["level"]) - n == request["states"]
    assert set(columns["level"][n:]) == {3}
    wanted = force if kind == "higher_level" else force / 1.5
    np.testing.assert_allclose(columns["force_n"][n:], wanted, rtol=0.02)
    phase = np.degrees(np.angle(columns["velocity_re_m_s"] + 1j * columns["velocity_im_m_s"]))[n:]
    assert sorted(np.sign(phase)) == [-1, -1, -1, 1, 1, 1]
    assert np.abs(phase).min() > 3
    assert np.abs(phase).max() < 60
    assert np.all(np.diff(whole.order) > 0)
    assert (whole.order[0], whole.order[-1]) == (0, 1)
    # The baseline's own balance holds for them as for the others.
    assert max(blind.truth.measured_units(case, whole).values()) < 0.05
    with pytest.raises(ValueError, match="calibration"):
        blind.further.answered(case, truth, asked("calibration"))


def test_one_seed_gives_one_set_and_halves_differ(blind, small_sets):
    cases, truths = small_sets
    case = drawn(blind, ())
    truth = blind.truth.simulate([case], steps=STEPS)[0]
    first, second = blind.records.table(cases[0], truths[0]), blind.records.table(case, truth)
    for name in first:
        size = np.abs(first["velocity_re_m_s"]).max() if "velocity" in name else 0.0
        assert np.allclose(first[name], second[name], rtol=1e-6, atol=1e-6 * size), name
    other = drawn(blind, (), half="scoring")
    assert other.natural_frequency_hz != case.natural_frequency_hz
    assert other.base != case.base
    assert not np.allclose(
        np.random.default_rng(other.noise_seed).normal(size=3),
        np.random.default_rng(case.noise_seed).normal(size=3),
    )


def test_each_half_has_enough_of_every_kind(blind):
    plans = blind.plans.all_plans()
    assert len(plans) >= 200
    assert {plan.group for plan in plans} == GROUPS
    for kind in blind.effects.SHAPES:
        strengths = {p.strength for p in plans if p.kinds == (kind,) and p.group == "one_effect"}
        assert strengths == {1.0, 0.5, 0.25}, kind
    assert len({p.kinds for p in plans if p.group == "outside"}) >= 10


def answer(key, verdict=None, effects=None):
    """A diagnosis that says what the key says, or something else."""
    effects = key["effects"] if effects is None else effects
    found = verdict or ("named" if effects else "none")
    if verdict is None and key["outside"]:
        found = "unknown"
    if verdict is None and key["noise_stated"] != "right":
        found = "noise_rejected"
    gap = {"before": 6, "after": 1, "held_out_before": 6, "held_out_after": 1, "noise_floor": 1}
    parameters = {n: {"value": v, "std": abs(v) * 0.1} for n, v in key["parameters"].items()}
    return {
        "verdict": found,
        "effects": effects,
        "candidates": [[kind] for kind in effects],
        "gap": gap,
        "parameters": parameters,
    }


def test_the_scorer_finds_no_miss_in_true_answers_and_every_miss_in_wrong_ones(
    blind, capsys, tmp_path
):
    keys = json.loads((EXAMPLES / "keys.json").read_text())
    results = [blind.score.Result(key, answer(key)) for key in keys.values()]
    blind.score.print_table(results)
    table = capsys.readouterr().out
    assert "one strong effect, harmonics 1-3" in table
    blind.score.print_misses(results)
    assert capsys.readouterr().out == ""
    blind.score.draw_confusion(results, tmp_path / "confusion.png")
    assert (tmp_path / "confusion.png").stat().st_size > 1000
    wrong = [blind.score.Result(key, answer(key, "named", ["added_mass"])) for key in keys.values()]
    blind.score.print_misses(wrong)
    assert len(capsys.readouterr().out.splitlines()) == len(keys)
    assert all(r.confidently_wrong for r in wrong)


def test_chance_allows_what_a_binomial_distribution_does(blind):
    for n, p in ((20, 0.7), (103, 0.99), (4, 0.5), (0, 0.5)):
        fewest, most = blind.reliability.limits([p] * n)
        assert (fewest, most) == tuple(int(k) for k in binom.ppf((0.025, 0.975), n, p))
    mixed = blind.reliability.limits([0.2, 0.9, 0.9, 0.2])
    assert mixed == blind.reliability.limits([0.9, 0.2, 0.2, 0.9])


def test_reliability_counts_true_answers_as_right_and_others_as_wrong(blind, tmp_path):
    keys = json.loads((EXAMPLES / "keys.json").read_text())
    said = 0.97
    for folder, told in (("true", answer), ("wrong", lambda k: answer(k, "named", ["added_mass"]))):
        for name, key in keys.items():
            place = tmp_path / folder / name
            place.mkdir(parents=True)
            (place / "diagnosis.json").write_text(json.dumps(told(key) | {"probability": said}))
    (tmp_path / "keys").mkdir()
    for name, key in keys.items():
        (tmp_path / "keys" / f"{name}.json").write_text(json.dumps(key))
    true, wrong = (
        blind.reliability.read_stated(tmp_path / "keys", tmp_path / folder)
        for folder in ("true", "wrong")
    )
    assert len(true) == len(wrong) == len(keys)
    assert all(one.right for one in true)
    assert not any(one.right for one in wrong)
    *low, last = blind.reliability.binned(true)
    assert [len(one.members) for one in low] == [0, 0, 0, 0]
    assert (last.right, last.holds) == (len(keys), True)
    assert not blind.reliability.binned(wrong)[-1].holds
    blind.reliability.draw(blind.reliability.binned(true), tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 1000


def test_the_examples_are_sets_with_their_keys(blind):
    keys = json.loads((EXAMPLES / "keys.json").read_text())
    tables = sorted((EXAMPLES / "blind").glob("*.csv"))
    assert {path.stem for path in tables} == set(keys)
    for path in tables:
        rows = rows_of(path)
        model = tomllib.loads(path.with_suffix(".toml").read_text())
        assert len(rows) == keys[path.stem]["rows"]
        assert ("velocity_h2_re_m_s" in rows[0]) == keys[path.stem]["harmonics"]
        assert model["mode"][0]["participation"] > 0


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
    plans = blind.plans.law_plans()
    assert {plan.kinds[0] for plan in plans if plan.kinds} == set(laws.OF)
    assert len(laws.OF) == 16
    assert sum(plan.group == "none" for plan in plans) == 20
