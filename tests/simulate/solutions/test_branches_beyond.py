"""Branches that a window hides, against one-term balance of Duffing's oscillator in closed form."""

import numpy as np
import pytest

import snrmjax as sj
from snrmjax.pipelines.simulate import simulate_responses
from snrmjax.simulate.solutions.branches_beyond import hidden_branches

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
    [(1e9, 60.0, (1.1, 1.5), 0), (1e9, 60.0, (1.1, 1.16), 0), (-4e9, 10.0, (0.8, 0.93), 1)],
    ids=["hardening", "hardening that ends between the folds", "softening"],
)
def test_the_stable_branch_beyond_the_folds_is_found(coefficient, force, ends, at):
    model, window = oscillator(coefficient), [OMEGA * r for r in ends]
    curves = sj.forced_response(model, [force], *window, harmonic_order=1)
    (found,) = hidden_branches(
        model, curves, *window, settings=sj.simulate.ResponseSettings(harmonic_order=1)
    )
    assert found.at_frequency == pytest.approx(window[at])
    exact = amplitudes(coefficient, force, window[at])
    assert len(exact) == 3
    # The state is the first point of the trace inside the window, half a step at most away.
    assert found.amplitude[0] == pytest.approx(exact[2], rel=0.05)
    assert found.amplitude[0] > 1.1 * exact[1]
    shown = [np.abs(c.velocity[-at, 1, 0]) for c in curves]
    assert shown == pytest.approx([exact[0]], rel=1e-6)
    wide = sorted([found.found_from, window[1 - at]])
    whole = sj.forced_response(model, [force], *wide, harmonic_order=1)
    assert not hidden_branches(
        model, whole, *wide, settings=sj.simulate.ResponseSettings(harmonic_order=1)
    )


def test_the_small_motion_of_a_softening_mode_is_found_where_the_large_one_is_shown():
    model, window = oscillator(-4e9), [0.94 * OMEGA, 1.1 * OMEGA]
    (curve,) = sj.forced_response(model, [10.0], *window, harmonic_order=1)
    settings = sj.simulate.ResponseSettings(harmonic_order=1)
    (found,) = hidden_branches(model, [curve], *window, settings=settings)
    small, _, large = amplitudes(-4e9, 10.0, window[0])
    assert np.abs(curve.velocity[0, 1, 0]) == pytest.approx(large, rel=1e-6)
    assert found.amplitude[0] == pytest.approx(small, rel=0.05)


@pytest.mark.parametrize("ends", [(0.8, 1.5), (0.8, 1.16), (1.45, 1.6)])
def test_a_window_that_shows_all_is_not_doubted(ends):
    """Up to beyond the folds, into them (where both branches are traced), and above them."""
    model, window = oscillator(1e9), [OMEGA * r for r in ends]
    curves = sj.forced_response(model, [60.0], *window, harmonic_order=3)
    settings = sj.simulate.ResponseSettings(harmonic_order=3)
    assert hidden_branches(model, curves, *window, settings=settings) == []


@pytest.mark.parametrize("slides", [True, pytest.param(False, marks=pytest.mark.long)])
def test_a_simulation_says_which_elements_do_nothing(slides):
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
            assert notes[0]["share"] == pytest.approx(0.8, rel=2e-3)
            assert "more force" in str(notes[0])


def test_friction_that_holds_asks_for_more_force():
    """Two masses: the held one feels k F/(k₁ + k − Ω²m) through the spring between them."""
    structure = sj.model.from_matrices(
        *(np.eye(2), np.eye(2), np.array([[2e5, -1e5], [-1e5, 2e5]])),
        points=("a", "b"),
        force="a",
        effects=[sj.model.make_effect("coulomb_friction", {"force": 1.0}, at="b")],
    )
    low, high = 20.0, 40.0
    with pytest.raises(ValueError, match="raise the force") as told:
        simulate_responses(structure, [0.1], low, high, harmonics=3)
    held = abs(2e5 - (high * HERTZ) ** 2 + 1j * high * HERTZ) / 1e5
    assert f"slides from about {held:.3g} N on" in str(told.value)
    assert "lower the force" not in str(told.value)
