"""All curves of a range, against one-term balance of Duffing's oscillator in closed form."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import snrmjax as sj
from snrmjax.pipelines.simulate import simulate_responses

OMEGA, RATIO, HERTZ = 500.0, 0.01, 2 * np.pi


def oscillator(coefficient):
    """q̈ + 2ζωq̇ + ω²q + 4 c q³ = F cos Ωt."""
    modes = sj.model.linear_modes([OMEGA], [RATIO], [[1.0]], [1.0])
    return sj.model.structure(modes, sj.model.polynomial_potential({(0,) * 4: coefficient}, 1))


def amplitudes(coefficient, force, omega):
    """Velocity amplitudes of all solutions with one harmonic, the smallest first.

    (ω² − Ω² + 3cQ²)²Q² + (2ζωΩQ)² = F², a cubic in Q².
    """
    a, b = 3 * coefficient, OMEGA**2 - omega**2
    roots = np.roots([a**2, 2 * a * b, b**2 + (2 * RATIO * OMEGA * omega) ** 2, -(force**2)])
    real = roots[np.abs(roots.imag) < 1e-9 * np.abs(roots)].real
    return omega * np.sqrt(np.sort(real[real > 0]))


@pytest.mark.parametrize(
    ("coefficient", "force", "ends", "at"),
    [
        (1e9, 60.0, (1.1, 1.5), 0),
        (1e9, 60.0, (1.1, 1.16), 0),
        (1e9, 60.0, (0.8, 1.16), 1),
        (-4e9, 10.0, (0.8, 0.93), 1),
        (-4e9, 10.0, (0.94, 1.1), 0),
    ],
    ids=[
        "hardening from within the hysteresis",
        "hardening between the folds",
        "hardening to within the hysteresis",
        "softening to within the hysteresis",
        "softening from within the hysteresis",
    ],
)
def test_all_responses_at_an_end_between_the_folds_are_there(coefficient, force, ends, at):
    model, window = oscillator(coefficient), [OMEGA * r for r in ends]
    exact = amplitudes(coefficient, force, window[at])
    assert len(exact) == 3
    (curves,) = sj.simulate.forced_response_batch(
        *(model, [force], *window), settings=sj.simulate.ResponseSettings(harmonic_order=1)
    ).curves
    found = [
        np.abs(curve.velocity[k, 1, 0])
        for curve in curves
        for k in (0, -1)
        if curve.frequency[k] == pytest.approx(window[at], rel=1e-12)
    ]
    # The unstable one ends at the other end where no fold lies between.
    assert exact[0] == pytest.approx(min(found), rel=1e-6)
    assert exact[2] == pytest.approx(max(found), rel=1e-6)
    stable = [exact[0], exact[2]]
    between = [one for one in found if not np.isclose(one, stable, rtol=1e-6).any()]
    assert np.allclose(between, exact[1], rtol=1e-6)
    assert len(found) == len(set(np.round(found, 6)))


@pytest.mark.parametrize("ends", [(0.8, 1.5), (1.45, 1.6)])
def test_a_range_around_a_response_or_beyond_it_has_one_curve(ends):
    model, window = oscillator(1e9), [OMEGA * r for r in ends]
    assert len(sj.forced_response(model, [60.0], *window, harmonic_order=3)) == 1


def escaping():
    """ÿ + 0.1 ẏ + y + y² = F cos Ωt, which escapes beyond y = −1."""
    modes = sj.model.linear_modes([1.0], [0.05], [[1.0]], [1.0])
    return sj.model.structure(modes, sj.model.polynomial_potential({(0, 0, 0): 1 / 3}, 1))


def test_an_escaping_oscillator_keeps_its_response_from_rest():
    """Time integration of the equation escapes at 0.1268 Hz as the frequency rises slowly."""
    found = simulate_responses(escaping(), [0.1], 0.05, 0.2, harmonics=9)
    (first,) = [curve for curve in found.curves if curve.at_events("fold").size]
    (fold,) = first.at_events("fold")
    assert first.frequency[fold] / HERTZ == pytest.approx(0.1268, abs=1e-4)
    assert np.all(first.stability[:fold] == 1)
    assert np.abs(first.velocity[0, 1, 0]) == pytest.approx(0.03585, rel=1e-3)
    (left,) = [note for note in found.notes if note.kind == "no_stable_response"]
    assert left["from_hz"] == pytest.approx(0.1268, abs=1e-4)
    batch = sj.simulate.forced_response_batch(escaping(), [0.08, 0.1], 0.05 * HERTZ, 0.2 * HERTZ)
    assert batch.n_folds.tolist() == [1, 1]


def test_each_stable_rest_has_its_response():
    """ÿ + 2ζẏ − y/2 + y³/2 about y = 1: the other well is the mirror image."""
    modes = sj.model.linear_modes([1.0], [0.02], [[1.0]], [1.0])
    wells = sj.model.polynomial_potential({(0, 0, 0): 0.5, (0, 0, 0, 0): 0.125}, 1)
    curves = sj.forced_response(sj.model.structure(modes, wells), [0.01], 0.6, 1.3)
    here, there = curves[0], next(c for c in curves if c.branch == "from another equilibrium")
    assert here.coefficients[0, 0, 0] == pytest.approx(0.0, abs=0.01)
    assert there.coefficients[0, 0, 0] == pytest.approx(-2.0, abs=0.01)
    # Under the force reversed in time by half a period the wells are exchanged.
    peaks = [np.abs(c.velocity[:, 1, 0]).max() for c in (here, there)]
    assert peaks[0] == pytest.approx(peaks[1], rel=1e-4)


def test_period_doubling_and_motions_across_wells_are_named_where_no_motion_is_stable():
    """ÿ + 0.1ẏ − y/2 + y³/2 = 0.3 cos Ωt about y = 1, whose settled motion at 0.1 Hz is ±1.8."""
    modes = sj.model.linear_modes([1.0], [0.05], [[1.0]], [1.0])
    wells = sj.model.polynomial_potential({(0, 0, 0): 0.5, (0, 0, 0, 0): 0.125}, 1)
    found = simulate_responses(sj.model.structure(modes, wells), [0.3], 0.1, 0.25, harmonics=5)
    (left,) = [note for note in found.notes if note.kind == "no_stable_response"]
    (doubling,) = left["doublings_hz"]
    assert doubling == left["to_hz"]
    assert left["wells"] == 2

    def rate(at, y):
        force = 0.3 * np.cos(HERTZ * at / period)
        return [y[1], force - 0.1 * y[1] + 0.5 * y[0] - 0.5 * y[0] ** 3]

    # Just below it the motion repeats after two periods and not after one.
    period = 1 / (doubling * 0.995)
    at = (300 + np.arange(3)) * period
    settled = solve_ivp(rate, (0, at[-1]), [1.0, 0.0], t_eval=at, rtol=1e-8, atol=1e-8).y[0]
    assert abs(settled[2] - settled[0]) < 1e-3 < 0.02 < abs(settled[1] - settled[0])


def settled_velocity(force, hertz, cycles=20, steps=64):
    """|V₁| and the mean of q̈ + 2ζq̇ + q − q³ = F cos Ωt after a slow sweep; Runge–Kutta."""

    def rate(y, load):
        return np.array([y[1], force * load - 0.04 * y[1] - y[0] + y[0] ** 3])

    y, wave = np.array([0.0, 0.0]), np.cos(np.pi * np.arange(2 * steps + 1) / steps)
    for omega in hertz * HERTZ:
        h = 2 * np.pi / omega / steps
        for _ in range(cycles):
            y[0] += 1e-6  # off the symmetric motion
            rows = []
            for k in range(steps):
                rows.append(y)
                one = rate(y, wave[2 * k])
                two = rate(y + h / 2 * one, wave[2 * k + 1])
                three = rate(y + h / 2 * two, wave[2 * k + 1])
                four = rate(y + h * three, wave[2 * k + 2])
                y = y + h / 6 * (one + 2 * two + 2 * three + four)
    q, v = np.array(rows).T
    return 2 * abs(np.mean(v * np.exp(-2j * np.pi * np.arange(steps) / steps))), np.mean(q)


def test_a_sweep_goes_on_where_the_symmetry_breaks():
    """Softening Duffing at F = 0.2: below 0.1243 Hz the mean of the stable motion is not zero."""
    modes = sj.model.linear_modes([1.0], [0.02], [[1.0]], [1.0])
    model = sj.model.structure(modes, sj.model.polynomial_potential({(0,) * 4: -0.25}, 1))
    found = simulate_responses(model, [0.2026], 0.118, 0.14, harmonics=7)
    at = 0.1234
    velocity, mean = settled_velocity(0.2026, np.append(np.linspace(0.2, at, 60), [at] * 9))
    assert abs(mean) > 0.05
    (left,) = [note for note in found.notes if note.kind == "no_stable_response"]
    assert left["to_hz"] < at
    branches = [curve for curve in found.curves if curve.branch == "from a branch point"]
    means = []
    for branch in branches:
        assert branch.event[0] == "branch_point"
        assert not branch.at_events("fold").size
        assert branch.not_located == ()
        order = np.argsort(branch.frequency)
        hertz = branch.frequency[order] / HERTZ
        assert branch.is_stable[order][np.searchsorted(hertz, at)]
        seen = np.interp(at, hertz, np.abs(branch.velocity[order, 1, 0]))
        assert seen == pytest.approx(velocity, rel=2e-3)  # interpolated between two points
        means.append(np.interp(at, hertz, branch.coefficients[order, 0, 0]))
    assert sorted(means) == pytest.approx([-abs(mean), abs(mean)], rel=2e-2)


def test_the_branch_of_a_mode_without_force_ends_at_its_other_branch_point():
    """The force drives q₁ alone; q₂ moves between two branch points of the motion with q₂ = 0."""
    modes = sj.model.linear_modes([1.0, 1.05], [0.01, 0.01], [[1.0, 0.3]], [1.0, 0.0])
    coupled = {(0,) * 4: 0.25, (0, 0, 1, 1): 0.8, (1,) * 4: 0.25}
    model = sj.model.structure(modes, sj.model.polynomial_potential(coupled, 2))
    main, *branches = sj.forced_response(model, [0.02], 0.8, 1.4, harmonic_order=3)
    ends = main.frequency[main.at_events("branch_point")]
    assert len(ends) == len(branches) == 2
    for branch in branches:
        assert branch.status.name == "BRANCH_POINT"
        ends_of_branch = branch.frequency[[0, -1]]
        assert np.sort(ends_of_branch) == pytest.approx(np.sort(ends), rel=1e-4)
        assert np.abs(branch.coefficients[:, 1, 1]).max() > 0.1
    # The two are each other's image under q₂ → −q₂.
    heights = [np.abs(b.coefficients[:, 1:3, 1]).max() for b in branches]
    assert heights[0] == pytest.approx(heights[1], rel=2e-2)


def test_a_far_well_has_its_response_too():
    """V = ω²(½q₁² + ½ 2.02² q₂² + q₁²q₂ + 0.02 q₁⁴ + 0.1 q₂⁴): far wells at q₁ = ±12.661."""
    omega = 0.2 * np.pi
    modes = sj.model.linear_modes([omega, 2.02 * omega], [0.02, 0.02], [[1.0, 0.5]], [1.0, 0.5])
    terms = {(0, 0, 1): 1.0, (0,) * 4: 0.02, (1,) * 4: 0.1}
    potential = sj.model.polynomial_potential({k: c * omega**2 for k, c in terms.items()}, 2)
    q1, q2 = 12.66112355, -6.91216198
    assert q1 + 2 * q1 * q2 + 0.08 * q1**3 == pytest.approx(0.0, abs=1e-5)
    assert 2.02**2 * q2 + q1**2 + 0.4 * q2**3 == pytest.approx(0.0, abs=1e-5)
    curves = sj.forced_response(
        sj.model.structure(modes, potential), [0.01], 1.5 * omega, 1.7 * omega, harmonic_order=3
    )
    means = [c.coefficients[0, 0] for c in curves if c.branch == "from another equilibrium"]
    assert sorted(row[0] for row in means) == pytest.approx([-q1, q1], rel=1e-3)


@pytest.mark.parametrize("slides", [True, pytest.param(False, marks=pytest.mark.long)])
def test_a_simulation_reports_inactive_elements(slides):
    kind, parameters = (
        ("jenkins_slider", {"stiffness": 0.1 * OMEGA**2, "slip_displacement": 1e-3})
        if slides
        else ("one_sided_stop", {"stiffness": OMEGA**2, "gap": 1e-3})
    )
    modes = sj.model.linear_modes([OMEGA], [RATIO], [[1.0]], [1.0])
    window = 0.8 * OMEGA / HERTZ, 1.2 * OMEGA / HERTZ
    # Before any slip or contact the mode is linear: Q = F/(2ζω²) = 1e-3 at F = 5.
    model = sj.model.structure(modes, effects=[sj.model.make_effect(kind, parameters)])
    for force, idle in ((4.0, True), (6.0, False)):
        found = simulate_responses(model, [force], *window, harmonics=3)
        notes = [n for n in found.notes if n.kind == "element_idle"]
        assert len(notes) == idle
        if idle:
            assert notes[0]["slides"] == slides
            assert notes[0]["fraction"] == pytest.approx(0.8, rel=2e-3)
            assert "more force" in str(notes[0])


def test_stuck_friction_asks_for_more_force():
    """Two masses: the stuck one carries k F/(k₁ + k − Ω²m) through the spring between them."""
    structure = sj.model.from_matrices(
        *(np.eye(2), np.eye(2), np.array([[2e5, -1e5], [-1e5, 2e5]])),
        points=("a", "b"),
        force="a",
        effects=[sj.model.make_effect("coulomb_friction", {"force": 1.0}, at="b")],
    )
    low, high = 20.0, 40.0
    with pytest.raises(ValueError, match="raise the force") as refusal:
        simulate_responses(structure, [0.1], low, high, harmonics=3)
    reaction = abs(2e5 - (high * HERTZ) ** 2 + 1j * high * HERTZ) / 1e5
    assert f"slides only above about {reaction:.3g} N" in str(refusal.value)
    assert "lower the force" not in str(refusal.value)
