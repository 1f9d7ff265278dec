"""Laws named by recorded harmonics, and detection limits."""

import functools

import numpy as np
import pytest
from truths.phased_states import OMEGA, SHAPE, dynamic, named, nothing

from snrmjax.diagnose.naming.detection import detection_limits
from snrmjax.diagnose.readings import RecordedHarmonics

ORDERS = (2, 3)
NOISE = 4e-6  # m/s of each part, where velocities go up to 0.5


def recorded(second=nothing, third=nothing, exciter=(0.0, 0.0), seed=1):
    """Velocities of harmonics 2 and 3 where the force on the mode has these.

    Arguments: harmonics of the internal force over ω₀² and the amplitude, as functions of the
    amplitude over the largest, of a motion x cos t; `exciter`: the force's own, over its first.
    """

    def made(states):
        rng, omega = np.random.default_rng(seed), states.frequency
        motion = states.velocity / (1j * omega * SHAPE)
        amplitude, rotation = np.abs(motion), motion / np.abs(motion)
        x = states.amplitude / states.amplitude.max()
        velocity, forced = [], []
        for order, fraction, own in zip(ORDERS, (second, third), exciter, strict=True):
            answer = 1j * order * omega * SHAPE / dynamic(order * omega)
            forced.append(answer * SHAPE * states.force)
            internal = OMEGA**2 * fraction(x) * amplitude * rotation**order
            noise = NOISE * (rng.normal(size=(2, len(x))).T @ [1.0, 1j])
            velocity.append(-answer * internal + own * forced[-1] + noise)
        std = np.full((len(x), 2), NOISE)
        return RecordedHarmonics(ORDERS, np.array(velocity).T, std, np.array(forced).T)

    return made


def by_part(found):
    """The answers by the names of their parts."""
    return {one.part: one for one in found.parts}


def test_a_cubic_spring_is_named_by_its_third_harmonic_too():
    """¾ c a² of the stiffness is ¼ c a² of the third harmonic, over the amplitude."""
    _, found = named(lambda x: 0.02 * x**2, nothing, recorded(third=lambda x: 0.02 / 3 * x**2))
    parts = by_part(found)
    assert parts["stiffness"].verdict == parts["harmonic_3"].verdict == "named"
    assert found.effects == ("cubic_stiffness",)
    assert parts["harmonic_3"].explained.low > 0.9
    assert parts["damping"].verdict == parts["harmonic_2"].verdict == "none"
    coefficient = found.parameters["cubic_stiffness.coefficient"]
    exact = 0.02 * OMEGA**2 / 0.75 / (1e-3 / SHAPE) ** 2
    assert abs(coefficient.value - exact) < 3 * coefficient.std


def test_a_stiffness_that_grows_as_the_square_without_a_third_harmonic_is_no_cubic_spring():
    _, found = named(lambda x: 0.02 * x**2, nothing, recorded())
    assert "cubic_stiffness" not in {kind for group in found.candidates for kind in group}


@pytest.mark.parametrize("exciter", [(0.01, 0.0), (0.0, -0.02), (0.02, 0.01)])
def test_harmonics_of_the_exciter_are_found_with_their_amplitudes(exciter):
    _, found = named(nothing, nothing, recorded(exciter=exciter))
    parts = by_part(found)
    assert parts["stiffness"].verdict == parts["damping"].verdict == "none"
    for name, amplitude in zip(("second", "third"), exciter, strict=True):
        order = ORDERS[name == "third"]
        assert parts[f"harmonic_{order}"].effects == (("force_harmonics",) if amplitude else ())
        if amplitude:
            value, std = found.parameters[f"force_harmonics.{name}"]
            assert value == pytest.approx(amplitude, rel=0.05)
            assert abs(value - amplitude) < 4 * std


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_second_harmonic_shows_the_side_of_a_quadratic_spring(side):
    """s q² of −(5/6) s² a² and, over the amplitude, a second harmonic of ½ s a."""
    s = 0.15
    _, found = named(
        lambda x: -5 / 6 * (s * x) ** 2,
        nothing,
        recorded(second=lambda x: 0.5 * side * s * x * (1 - 5 / 6 * (s * x) ** 2)),
    )
    assert by_part(found)["harmonic_2"].verdict == "named"
    assert found.effects == ("quadratic_stiffness",)
    value = found.parameters["quadratic_stiffness.coefficient"].value
    assert value == pytest.approx(side * s * OMEGA**2 / (1e-3 / SHAPE), rel=0.05)


@functools.cache
def limits(noise):
    """Of a test where nothing is missing."""
    problem, found = named(nothing, nothing, noise=noise)
    assert all(part.verdict == "none" for part in found.parts)
    return detection_limits(problem, found, ())


@pytest.mark.parametrize(("times", "seen"), [(3.0, True), (0.1, False)])
@pytest.mark.parametrize("noise", [2e-3, 1e-2])
@pytest.mark.parametrize(
    ("label", "change"),
    [
        # ¾ c a² over ω₀²
        ("cubic_stiffness.coefficient", lambda c: 0.75 * c * (1e-3 / SHAPE / OMEGA) ** 2),
        # 8/(3π) c Ω² a over ω₀ and Ω, at the largest amplitude
        ("quadratic_damping.coefficient", lambda c: 8 / (3 * np.pi) * c * 1e-3 / SHAPE),
    ],
)
def test_three_times_the_limit_is_found_and_a_tenth_of_it_is_not(label, change, noise, times, seen):
    strength, kind = change(times * limits(noise)[label]), label.partition(".")[0]
    spring = kind == "cubic_stiffness"
    _, found = named(
        (lambda x: strength * x**2) if spring else nothing,
        nothing if spring else (lambda x, omega: strength * x * omega),
        **{"noise": noise, "seed": 3},
    )
    candidates = {one for group in found.candidates for one in group}
    assert (kind in candidates) == seen
    assert seen or candidates == set()
