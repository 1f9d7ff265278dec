"""Curves of events over a parameter: closed forms, published numbers, multipliers, other curves."""

import itertools
import math

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

import snrmjax as sj
from snrmjax.model.builders.beams import (
    CURVED_BEAM_FORCES,
    FLAT_BEAM_FORCES,
    curved_beam,
    flat_beam,
)
from snrmjax.model.effects import make_effect
from snrmjax.simulate.solutions.event_curves import (
    EventCurveEnd,
    follow_event,
)

HZ = 2 * np.pi
# Points are corrected until an error of 1e-9 is left, in unknowns of order one.
CORRECTED = 3e-8
SINGLE = sj.simulate.ResponseSettings(harmonic_order=1, stability=False)


def event_of(model, force, ends, kind, number=0, order=1, **settings):
    """One event of a forced response, as a start."""
    settings = {"harmonic_order": order, "stability": False} | settings
    curves = sj.forced_response(model, [force], *ends, **settings)
    return [c.point(k) for c in curves for k in c.at_events(kind)][number]


def displacement(curve):
    """Amplitude of the fundamental of the only mode."""
    return np.hypot(curve.coefficients[:, 1, 0], curve.coefficients[:, 2, 0])


# ------------------------------------------------------------ Duffing's oscillator, one harmonic

C, GAMMA, P = 0.05, 0.1, 0.18


def duffing():
    """x'' + 0.05x' + x + 0.1x³ = 0.18 cos Ωt, as NLvib's first example."""
    modes = sj.model.linear_modes([1.0], [C / 2], [[1.0]], [1.0])
    return sj.model.structure(modes, sj.model.polynomial_potential({"1111": GAMMA / 4}, 1))


# With d = 1 − Ω² and s = ¾γa² the balance of one harmonic is ((d + s)² + c²Ω²)a² = P²
# (Nayfeh & Mook, Nonlinear Oscillations (1979), section 4.1, without its small terms left out).
CONDITIONS = {
    "fold": lambda d, s, damped: (d + s) * (d + 3 * s) + damped**2,
    "phase_resonance": lambda d, s, damped: d + s,
}


def cusp(c):
    """Frequency and force where both folds meet: Ω² − 1 = √3 cΩ."""
    omega = (np.sqrt(3) * c + np.sqrt(3 * c**2 + 4)) / 2
    s = 2 * c * omega / np.sqrt(3)
    a = np.sqrt(s / (0.75 * GAMMA))
    return omega, a * np.sqrt((1 - omega**2 + s) ** 2 + (c * omega) ** 2)


@pytest.mark.parametrize("kind", ["fold", "phase_resonance"])
@pytest.mark.parametrize(
    ("parameter", "to"), [("force", (0.01, 0.4)), ("mode_1.damping_ratio", (0.005, 0.2))]
)
def test_curves_of_duffings_oscillator_are_exact(kind, parameter, to):
    start = event_of(duffing(), P, (0.5, 1.6), kind)
    curve = follow_event(duffing(), P, start, kind=kind, parameter=parameter, to=to)
    c = 2 * curve.value if parameter != "force" else C
    omega, a = curve.frequency, displacement(curve)
    d, s = 1 - omega**2, 0.75 * GAMMA * a**2
    balance = ((d + s) ** 2 + (c * omega) ** 2) * a**2
    # Relative to what the terms are: a² is up to 100 at light damping.
    np.testing.assert_allclose(balance / curve.force**2, 1.0, rtol=1e-6)
    condition = CONDITIONS[kind](d, s, c * omega)
    condition /= (np.abs(d) + s) ** 2 if kind == "fold" else 1.0
    np.testing.assert_allclose(condition, 0.0, atol=CORRECTED)
    cusps = curve.at_events("cusp")
    assert not any(name not in ("", "cusp") for name in curve.event)
    if kind == "phase_resonance":
        assert not cusps.size
        assert curve.ends == (EventCurveEnd.LOWER_END, EventCurveEnd.UPPER_END)
        return
    (k,) = cusps
    if parameter == "force":
        np.testing.assert_allclose((omega[k], curve.value[k]), cusp(C), rtol=1e-9)
        assert curve.ends == (EventCurveEnd.UPPER_END,) * 2
    else:
        at = scipy.optimize.brentq(lambda z: cusp(2 * z)[1] - P, 0.01, 0.3, xtol=1e-14)
        np.testing.assert_allclose(curve.value[k], at, rtol=1e-9)
        np.testing.assert_allclose(omega[k], cusp(2 * at)[0], rtol=1e-9)
        assert curve.ends == (EventCurveEnd.LOWER_END,) * 2
    # Where the published example has its folds.
    if parameter == "force":
        at = [
            float(sj.simulate.periodic_motion(duffing(), P, near, condition="fold").frequency)
            for near in curve.near(P)
        ]
        np.testing.assert_allclose(np.sort(at), (1.11559, 1.26754), atol=6e-6)


def test_both_folds_give_one_curve():
    folds = [
        follow_event(
            duffing(),
            P,
            event_of(duffing(), P, (0.5, 1.6), "fold", number),
            kind="fold",
            to=(0.01, 0.4),
        )
        for number in (0, 1)
    ]
    ends = [sorted(f.frequency[[0, -1]]) for f in folds]
    np.testing.assert_allclose(ends[0], ends[1], rtol=CORRECTED)


# ------------------------------------------------------------------- isolated responses

TIP = 2 / np.sqrt(1780e-9 * 100 * 2700)  # of a uniform cantilever's first mode, by its mass
OMEGA, RATIO = 7.000497, 8.840e-4


def cantilever():
    """First mode of SSMTool's cantilever with 6x³ − 0.02ẋ³ at its tip (arXiv 2310.14850)."""
    modes = sj.model.linear_modes([OMEGA], [RATIO], [[TIP]], [TIP])
    potential = sj.model.polynomial_potential({"1111": 6 / 4 * TIP**4}, 1)
    damping = make_effect("cubic_damping", {"coefficient": -0.02 * TIP**4})
    return sj.model.structure(modes, potential, effects=damping)


def falling_damping():
    """2ζ̃ = 0.02(1 − 1.8a + a²) at Ω = 1: force at resonance rises, falls and rises again."""
    modes = sj.model.linear_modes([1.0], [0.01], [[1.0]], [1.0])
    drag = make_effect("quadratic_damping", {"coefficient": -1.8 * 0.02 * 3 * np.pi / 8})
    cubic = make_effect("cubic_damping", {"coefficient": 0.02 / 0.75})
    potential = sj.model.polynomial_potential({"1111": 0.01}, 1)
    return sj.model.structure(modes, potential, effects=(drag, cubic))


def cantilever_load(a, omega):
    """Square of the force that a motion of one harmonic needs."""
    stiffness = OMEGA**2 - omega**2 + 0.75 * 6 * TIP**4 * a**2
    damping = omega * (2 * RATIO * OMEGA - 0.75 * 0.02 * TIP**4 * omega**2 * a**2)
    return (stiffness**2 + damping**2) * a**2 / TIP**2


def falling_load(a, omega):
    stiffness = 1 - omega**2 + 0.75 * 0.04 * a**2
    damping = 0.02 * omega * (1 - 1.8 * omega * a + omega**2 * a**2)
    return (stiffness**2 + damping**2) * a**2


def singular(load, near):
    """Amplitude, frequency and force where both derivatives of the load vanish, and whether the
    load has a minimum or a saddle there."""

    def slopes(v):
        h = 1e-4 * np.asarray(v)
        pairs = [[load(*(v + k * h * e)) for k in (-2, -1, 1, 2)] for e in np.eye(2)]
        each = zip(pairs, h, strict=True)
        return np.array([(a - 8 * b + 8 * c - d) / (12 * s) for (a, b, c, d), s in each])

    scale = np.array([load(*near) / near[0], load(*near)])
    solved = scipy.optimize.root(lambda v: slopes(v) / scale, near, tol=1e-12)
    a, omega = solved.x
    h = 1e-4 * np.array([a, 1e-2 * omega])
    hessian = [(slopes(solved.x + e * h) - slopes(solved.x - e * h)) for e in np.eye(2)]
    return a, omega, np.sqrt(load(a, omega)), np.linalg.det(np.array(hessian)) > 0


@pytest.mark.long
def test_isola_and_main_response_merge_where_the_closed_form_has_it():
    model, unit = cantilever(), 0.1  # of ε, as the source has it
    exact = singular(cantilever_load, (0.026 / TIP, 7.0023))
    assert not exact[3]
    np.testing.assert_allclose(exact[2] / unit, 1.802e-3, atol=5e-7)
    np.testing.assert_allclose(TIP * exact[0], 0.0260, atol=5e-5)
    # From the fold inside the joined response down to its turning point.
    start = event_of(model, 1.9e-3 * unit, (6.95, 7.05), "fold", number=1)
    folds = follow_event(model, 1.9e-3 * unit, start, kind="fold", to=(1e-5, 3e-4))
    (k,) = folds.at_events("isola_merging")
    found = displacement(folds)[k], folds.frequency[k], folds.value[k]
    np.testing.assert_allclose(found, exact[:3], rtol=1e-7)
    assert len(folds.at_events("cusp")) == 1
    # The resonance has its turning point there too, the limit of the response from rest.
    for kind in ("phase_resonance", "peak"):
        start = event_of(model, 1e-4, (6.95, 7.05), kind)
        tips = follow_event(model, 1e-4, start, kind=kind, to=(1e-5, 3e-4))
        (k,) = tips.at_events("turn")
        found = displacement(tips)[k], tips.frequency[k], tips.value[k]
        # At the saddle |V| and a have their extremes in common.
        np.testing.assert_allclose(found, exact[:3], rtol=1e-7)


@pytest.mark.long
def test_resonances_lead_to_the_isolated_response():
    model, load = cantilever(), 1e-4
    start = event_of(model, load, (6.95, 7.05), "phase_resonance")
    tips = follow_event(model, load, start, kind="phase_resonance", to=(1e-5, 3e-4))
    starts = tips.near(load)
    assert len(starts) == 2  # on the response from rest, and on the isolated one
    found = sj.simulate.isolated_responses(
        *(model, load, 6.9, 7.1),
        search=sj.simulate.IsolatedSearch(starts=starts, n_starts=0),
        settings=SINGLE,
    )
    assert [loop.branch.name for loop in found] == ["GIVEN_START"]


@pytest.mark.long
def test_an_isolated_response_begins_where_the_closed_form_has_it():
    model, ends, fine = falling_damping(), (0.9, 1.2), 512
    birth = singular(falling_load, (0.757, 1.0086))
    merging = singular(falling_load, (0.435, 1.0028))
    assert birth[3]
    assert not merging[3]
    load = 1.3 * birth[2]
    start = event_of(model, load, ends, "fold", n_samples=fine)
    folds = follow_event(model, load, start, kind="fold", to=(1e-4, 0.01), n_samples=fine)
    for name, exact in (("isola_birth", birth), ("isola_merging", merging)):
        (k,) = folds.at_events(name)
        found = displacement(folds)[k], folds.frequency[k], folds.value[k]
        # |sin|sin of the drag by 512 samples: its harmonics fall with the third power.
        np.testing.assert_allclose(found, exact[:3], rtol=3e-7)


def test_the_coefficient_of_an_effect_is_followed():
    model, load, name = cantilever(), 1e-4, "cubic_damping.coefficient"
    start = event_of(model, load, (6.95, 7.05), "phase_resonance")
    to = (-0.2 * TIP**4, 0.2 * TIP**4)
    tips = follow_event(model, load, start, kind="phase_resonance", parameter=name, to=to)
    a, omega = displacement(tips), tips.frequency
    needed = a * omega * (2 * RATIO * OMEGA + 0.75 * tips.value * omega**2 * a**2) / TIP
    np.testing.assert_allclose(needed, load, rtol=1e-6)
    assert tips.unit == "s/(kg m²)"
    # Where ∂(needed)/∂a = 0 at one frequency, which hardly changes.
    (k,) = tips.at_events("turn")
    exact = -16 / 81 * (2 * RATIO * OMEGA) ** 3 / (load * TIP) ** 2
    np.testing.assert_allclose(tips.value[k], exact, rtol=1e-3)


# --------------------------------------------------------------- resonances of many modes


@pytest.mark.long
def test_phase_resonances_are_the_damped_backbone_and_lie_where_responses_have_them():
    model, load = flat_beam(), FLAT_BEAM_FORCES[-1]
    ends, order = (60 * HZ, 115 * HZ), 5
    start = event_of(model, load, ends, "phase_resonance", order=order)
    tips = follow_event(model, load, start, kind="phase_resonance", to=(1e-4, 0.02))
    for force in (2e-3, 5e-3, 0.018):
        ((_, frequency),) = tips.near(force)
        _, located = event_of(model, force, ends, "phase_resonance", order=order)
        # By a line between neighbouring points.
        assert frequency == pytest.approx(located, rel=1e-3)
        again = follow_event(
            *(model, force, tips.near(force)[0]),
            kind="phase_resonance",
            to=(force, 2 * force),
        )
        assert again.value[0] == pytest.approx(force, rel=1e-12)
        assert again.frequency[0] == pytest.approx(located, rel=1e-8)
    controlled = sj.simulate.phase_controlled(model, 0.02, harmonic_order=order)
    at = np.interp(tips.force, controlled.force, controlled.frequency)
    # By lines between points of a curve that was traced for itself.
    np.testing.assert_allclose(tips.frequency, at, rtol=2e-4)
    mode = sj.nonlinear_normal_mode(model, 110 * HZ, harmonic_order=order, tongues="skip")
    at = np.interp(tips.amplitude, np.abs(mode.velocity[:, 1, 0]), mode.frequency)
    clear = (tips.frequency < 86 * HZ) | (tips.frequency > 92 * HZ)  # of the tongue with mode 3
    # The beam has 4 % of damping, of which the backbone sees the square.
    np.testing.assert_allclose(tips.frequency[clear], at[clear], rtol=3e-3)


RATIO_NAME, SLIP_NAME = "mode_1.damping_ratio", "jenkins_slider.slip_displacement"
LIGHT = {RATIO_NAME: 0.02, SLIP_NAME: 0.1}


def with_slider():
    """Hardening, softening, drag and a slider that slips."""
    modes = sj.model.linear_modes([2.0], [0.02], [[1.0]], [1.5])
    potential = sj.model.polynomial_potential({"111": 0.05, "1111": 0.3}, 1)
    settings = {"stiffness": 0.005, "slip_displacement": 0.1}
    drag = make_effect("quadratic_damping", {"coefficient": 0.002})
    return sj.model.structure(
        modes, potential, effects=(drag, make_effect("jenkins_slider", settings))
    )


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        *((k, RATIO_NAME) for k in ("fold", "peak")),
        ("fold", SLIP_NAME),
    ],
)
@pytest.mark.long
def test_curves_pass_what_single_motions_are(kind, name):
    model, load, value = with_slider(), 0.12, LIGHT[name]
    start = event_of(model, load, (1.5, 3.5), kind, order=3)
    curve = follow_event(model, load, start, kind=kind, parameter=name, to=(value, 1.2 * value))
    assert curve.ends[1] is EventCurveEnd.UPPER_END
    k = len(curve.value) - 1
    changed = sj.model.with_parameters(model, [name], curve.value[[k]])
    x, omega = curve.point(k)
    found = sj.simulate.periodic_motion(changed, load, (1.0001 * x, omega), condition=kind)
    assert float(found.frequency) == pytest.approx(curve.frequency[k], rel=CORRECTED)
    assert float(found.amplitude) == pytest.approx(curve.amplitude[k], rel=1e-6)
    assert curve.frequency[k] != pytest.approx(curve.frequency[0], rel=1e-6)


@pytest.mark.long
def test_further_modes_of_an_effect_are_followed():
    modes = sj.model.linear_modes([2.0], [0.01], [[1.0]], [1.0])
    effect = make_effect(
        "internal_resonance_1_2",
        {"frequency_hz": 4.0 / HZ, "damping_ratio": 0.01, "coefficient": 0.5},
    )
    model = sj.model.structure(modes, effects=effect)
    start = event_of(model, 0.1, (1.7, 2.3), "peak", order=3)
    name = "internal_resonance_1_2.damping_ratio"
    curve = follow_event(model, 0.1, start, kind="peak", parameter=name, to=(0.01, 0.02))
    k = len(curve.value) - 1
    changed = sj.model.with_parameters(model, [name], curve.value[[k]])
    found = sj.simulate.periodic_motion(changed, 0.1, curve.point(k), condition="peak")
    assert float(found.frequency) == pytest.approx(curve.frequency[k], rel=CORRECTED)


# ---------------------------------------------------------------------------- bifurcations


def coupled(*effects):
    """A second mode at twice the first one's frequency: they exchange energy."""
    modes = sj.model.linear_modes([2.0, 4.0], [0.01, 0.01], [[1.0, 0.0]], [1.0, 0.0])
    potential = sj.model.polynomial_potential({"112": 0.5}, 2)
    return sj.model.structure(modes, potential, effects=effects)


@pytest.fixture(scope="module")
def tori():
    """Neimark-Sacker points of the pair, from one of them."""
    start = event_of(coupled(), 0.4, (1.7, 2.3), "neimark_sacker", order=5, stability=True)
    return start, follow_event(coupled(), 0.4, start, kind="neimark_sacker", to=(0.01, 1.0))


def test_a_pair_of_multipliers_stays_on_the_circle(tori, time_domain, state_of):
    _, curve = tori
    for k in range(0, len(curve.value), 15):
        omega = curve.frequency[k]
        motion = time_domain(coupled(), curve.value[k], omega)
        multipliers = motion.multipliers(state_of(curve.coefficients[k], omega))
        pairs = multipliers[multipliers.imag > 1e-3]
        nearest = pairs[np.argmin(np.abs(np.abs(pairs) - 1))]
        # The map's slope by differences is good to 1e-7, the motion of five harmonics to 1e-5.
        assert abs(nearest) == pytest.approx(1.0, abs=2e-5)
        second = np.angle(nearest) / HZ * omega
        assert second == pytest.approx(curve.second_frequency[k], rel=1e-4)


def test_neimark_sacker_points_lie_where_responses_have_them(tori):
    _, curve = tori
    assert [name for name in curve.event if name] == ["turn"]
    for force in (0.3, 0.6):
        (response, *_) = sj.forced_response(coupled(), [force], 1.7, 2.3, harmonic_order=5)
        located = response.frequency[response.at_events("neimark_sacker")]
        found = []
        for near in curve.near(force):
            again = follow_event(
                *(coupled(), force, near), kind="neimark_sacker", to=(force, 1.01 * force)
            )
            found.append(again.frequency[np.argmin(np.abs(again.value - force))])
        # The response's multiplier is 1e-6 beyond the circle.
        np.testing.assert_allclose(np.sort(found), np.sort(located), rtol=1e-6)
    # None below the turning point of the curve.
    least = curve.value[curve.at_events("turn")[0]]
    for force, number in ((0.995 * least, 0), (1.005 * least, 2)):
        (response, *_) = sj.forced_response(coupled(), [force], 1.7, 2.3, harmonic_order=5)
        assert response.at_events("neimark_sacker").size == number


@pytest.mark.long
def test_neimark_sacker_points_depend_on_damping_that_depends_on_the_velocity():
    name, ends = "cubic_damping.coefficient", (1.7, 2.3)
    model = coupled(make_effect("cubic_damping", {"coefficient": 1e-3}))
    start = event_of(model, 0.4, ends, "neimark_sacker", order=5, stability=True)
    settings = {"kind": "neimark_sacker", "parameter": name}
    curve = follow_event(model, 0.4, start, to=(1e-3, 1.0), **settings)
    ((k, _),) = [(k, e) for k, e in enumerate(curve.event) if e]  # the strongest with tori
    for fraction, number in ((0.9, 2), (1.01, 0)):
        value = 1e-3 + fraction * (curve.value[k] - 1e-3)
        changed = sj.model.with_parameters(model, [name], np.array([value]))
        (response,) = sj.forced_response(changed, [0.4], *ends, harmonic_order=5)
        located = response.frequency[response.at_events("neimark_sacker")]
        assert len(located) == number
        found = []
        for near in curve.near(value):
            again = follow_event(changed, 0.4, near, to=(value, 1.01 * value), **settings)
            found.append(again.frequency[np.argmin(np.abs(again.value - value))])
        # The response's multiplier is 1e-6 beyond the circle.
        np.testing.assert_allclose(np.sort(found), np.sort(located), rtol=2e-6)


@pytest.mark.long
def test_neimark_sacker_curves_close_and_end_in_a_strong_resonance(tori):
    start, _ = tori
    settings = {"kind": "neimark_sacker", "parameter": "mode_2.natural_frequency"}
    loop = follow_event(coupled(), 0.4, start, to=(3.0, 5.0), **settings)
    assert loop.ends == (EventCurveEnd.CLOSED,) * 2
    assert loop.unit == "rad/s"
    assert [name for name in loop.event if name] == ["turn"] * 2
    np.testing.assert_allclose(loop.coefficients[0], loop.coefficients[-1], rtol=1e-9)
    far = follow_event(coupled(), 0.4, start, kind="neimark_sacker", to=(0.01, 50.0))
    assert EventCurveEnd.STRONG_RESONANCE in far.ends
    ratio = far.second_frequency / far.frequency
    assert np.all(ratio <= 0.5)
    assert max(ratio[0], ratio[-1]) > 0.4


def published_cantilever(n_modes):
    """SSMTool's BernoulliBeamIRs: 40 elements, a linear and a cubic spring at the tip.

    Li & Haller, Nonlinear Dyn. (2022), doi:10.1007/s11071-022-07476-6; mm, kg, s.
    """
    n, length, stiff, mass = 40, 2700 / 40, 45e6 * 1e4 / 12, 1780e-9 * 100
    h, size = length, 2 * (n + 1)
    bending = np.array(
        [
            [12, 6 * h, -12, 6 * h],
            [6 * h, 4 * h**2, -6 * h, 2 * h**2],
            [-12, -6 * h, 12, -6 * h],
            [6 * h, 2 * h**2, -6 * h, 4 * h**2],
        ]
    )
    inertia = np.array(
        [
            [156, 22 * h, 54, -13 * h],
            [22 * h, 4 * h**2, 13 * h, -3 * h**2],
            [54, 13 * h, 156, -22 * h],
            [-13 * h, -3 * h**2, -22 * h, 4 * h**2],
        ]
    )
    stiffness, masses = np.zeros((size, size)), np.zeros((size, size))
    for e in range(n):
        rows = slice(2 * e, 2 * e + 4)
        stiffness[rows, rows] += stiff / h**3 * bending
        masses[rows, rows] += mass * h / 420 * inertia
    stiffness, masses = stiffness[2:, 2:], masses[2:, 2:]
    damping = 1.25e-4 * masses + 2.5e-5 * stiffness
    stiffness[-2, -2] += 27.0
    square, shapes = scipy.linalg.eigh(stiffness, masses, subset_by_index=(0, n_modes - 1))
    omega, tip = np.sqrt(square), shapes[-2]
    ratio = np.diag(shapes.T @ damping @ shapes) / (2 * omega)
    potential = {}
    for monomial in itertools.combinations_with_replacement(range(n_modes), 4):
        ways = math.factorial(4) / math.prod(math.factorial(monomial.count(i)) for i in range(4))
        potential[monomial] = 60.0 / 4 * ways * np.prod(tip[list(monomial)])
    force = shapes.T @ masses @ shapes[:, 0] * 2e-3 * square[0]
    modes = sj.model.linear_modes(list(omega), list(ratio), [list(tip)], list(force))
    return sj.model.structure(modes, sj.model.polynomial_potential(potential, n_modes))


@pytest.mark.long
def test_published_neimark_sacker_points_belong_to_two_curves():
    model = published_cantilever(2)
    published = np.array([15.587, 15.590, 15.665, 15.863])
    response = sj.forced_response(model, [1.0], 15.4, 16.2, harmonic_order=5)[0]
    where = response.at_events("neimark_sacker")
    # Two modes of all, and spectral submanifolds of order 7, printed to 1e-3.
    np.testing.assert_allclose(response.frequency[where], published, atol=3e-3)
    curves = [
        follow_event(model, 1.0, response.point(k), kind="neimark_sacker", to=(0.1, 2.0))
        for k in where[[0, 2]]
    ]
    for curve, pair in zip(curves, (where[:2], where[2:]), strict=True):
        passed = sorted(frequency for _, frequency in curve.near(1.0 - 1e-9))
        np.testing.assert_allclose(passed, response.frequency[pair], rtol=1e-5)
        assert [name for name in curve.event if name] == ["turn"]
    # The published slow periods of the torus from 15.665 and where it ends.
    periods = np.interp([15.665, 15.863], *_sorted(curves[1], 1.0))
    np.testing.assert_allclose(periods, (19.12, 15.34), rtol=2e-2)


def _sorted(curve, force):
    """Frequency and slow period where a curve crosses a force."""
    ahead = curve.value > force - 1e-9
    k = np.flatnonzero(ahead[1:] != ahead[:-1])
    slow = HZ / curve.second_frequency[k]
    order = np.argsort(curve.frequency[k])
    return curve.frequency[k][order], slow[order]


@pytest.mark.long
def test_period_doublings_lie_where_responses_have_them():
    model, load, ends, order = curved_beam(), CURVED_BEAM_FORCES[1], (20 * HZ, 80 * HZ), 15
    start = event_of(model, load, ends, "period_doubling", order=order, stability=True)
    curve = follow_event(model, load, start, kind="period_doubling", to=(0.5 * load, 1.5 * load))
    assert {"turn"} == set(curve.event) - {""}
    less = 0.9 * load
    (response,) = sj.forced_response(model, [less], *ends, harmonic_order=order)
    located = response.frequency[response.at_events("period_doubling")]
    inside = [near for near in curve.near(less) if near[1] > ends[0]]
    assert inside
    for near in inside:
        again = follow_event(*(model, less, near), kind="period_doubling", to=(less, 1.001 * less))
        found = again.frequency[np.argmin(np.abs(again.value - less))]
        # Fifteen harmonics by Hill's method, and by the map over a period.
        assert np.min(np.abs(located / found - 1)) < 2e-6


# ------------------------------------------------------------------------------ what fails


def test_wrong_arguments_are_refused():
    model, start = duffing(), (np.ones((3, 1)), 1.2)
    wrong = (
        ({"kind": "branch_point", "to": (0.1, 0.2)}, "`kind` must be one of"),
        ({"kind": "fold", "to": (0.2, 0.1)}, "`to` must be two numbers that rise"),
        ({"kind": "fold", "to": (0.2, 0.3)}, "`to` must hold force, which is 0.18"),
        ({"kind": "fold", "to": (-0.1, 0.3)}, "must be positive for the force"),
        ({"kind": "fold", "to": (0, 1), "parameter": "mode_2.damping_ratio"}, "does not have"),
        ({"kind": "neimark_sacker", "to": (0.1, 0.2)}, "no pair of complex multipliers"),
    )
    strong = sj.model.with_parameters(model, ["potential.1111"], np.array([10.0]))
    for settings, message in wrong:
        unstable = strong if settings["kind"] == "neimark_sacker" else model
        with pytest.raises(ValueError, match=message):
            follow_event(unstable, P, start, **settings)
    with pytest.raises(ValueError, match="`force` must be positive"):
        follow_event(model, -1.0, start, kind="fold", to=(0.1, 0.2))
    with pytest.raises(ValueError, match="not followed with friction"):
        follow_event(with_slider(), 0.12, start, kind="neimark_sacker", to=(0.1, 0.2))


@pytest.mark.long
def test_a_curve_reports_where_it_stopped():
    model = duffing()
    start = event_of(model, P, (0.5, 1.6), "fold")
    steps = sj.simulate.StepControl(max_points=5)
    short = follow_event(model, P, start, kind="fold", to=(0.01, 0.4), steps=steps)
    assert EventCurveEnd.POINT_LIMIT in short.ends
    assert 5 <= len(short.frequency) <= 10
    # A linear structure has no folds.
    linear = sj.model.with_parameters(model, ["potential.1111"], np.zeros(1))
    none = follow_event(linear, P, start, kind="fold", to=(0.01, 0.4))
    assert none.ends == (EventCurveEnd.NO_START,) * 2
    assert not len(none.frequency)
    assert "start at a point with this event" in repr(none)
    with pytest.raises(ValueError, match="no curve has a point"):
        none.plot()
