"""Methods that read steady states, against oscillators with known backbone and damping.

States at displacement X are those of Z(X, Ω) X = F with Z = ω̃²(X)(1 + iη(X)) − Ω² (unit modal
mass): Ω is chosen, F follows, or F is chosen and Ω² = ω̃² ± √(F²/X² − η²ω̃⁴). Nothing is solved.
"""

import numpy as np
import pytest

import snrmjax as sj
from snrmjax.methods import MethodStatus
from snrmjax.methods.one_sensor import sensor_states
from snrmjax.methods.steady.arslan_ozguven import describing_function

REST = 2 * np.pi * 50.0
HARDENING, LOSS, MORE_LOSS = 4e9, 0.006, 3.0  # ω̃² per m², η at rest, η per m
METHODS = ("concerto", "arslan_ozguven", "rct", "harmonic_force_surface", "phase_resonance")


def square_of(x):
    """ω̃² at a displacement."""
    return REST**2 + HARDENING * x**2


def loss_of(x):
    """η at a displacement."""
    return LOSS + MORE_LOSS * x


def modes_of(shape=1.0, participation=1.0):
    return sj.model.linear_modes([REST], [1e-9], [[shape]], [participation])


def table(level, frequency, stiffness, displacement):
    """Steady states from F = Z X, displacement real: phases are then referred to the force."""
    force = stiffness * displacement
    velocity = 1j * frequency * displacement * np.abs(force) / force
    return sj.measure.steady_states(
        np.asarray(level, dtype=int), frequency, np.abs(force), velocity[:, None]
    )


def constant_force(forces=(0.05, 0.1, 0.2), fractions=(0.3, 0.5, 0.7, 0.9, 0.98), sides=(-1, 1)):
    """Levels of constant force, states of equal displacement on both sides."""
    rows = []
    for level, force in enumerate(forces, 1):
        grid = np.linspace(1e-9, 1e-2, 200_001)
        peak = grid[np.argmax(grid * loss_of(grid) * square_of(grid) > force)]
        for x in peak * np.array(fractions):
            half = np.sqrt((force / x) ** 2 - (loss_of(x) * square_of(x)) ** 2)
            for side in sides:
                rows.append((level, np.sqrt(square_of(x) + side * half), x))
    level, frequency, x = np.array(rows).T
    stiffness = square_of(x) * (1 + 1j * loss_of(x)) - frequency**2
    return table(level, frequency, stiffness, x)


def constant_response(sizes=(1e-4, 3e-4, 6e-4, 1e-3), points=21):
    """Levels of constant displacement."""
    x = np.repeat(sizes, points)
    steps = np.tile(np.linspace(-2.3, 2.4, points), len(sizes))
    frequency = np.sqrt(square_of(x)) * (1 + steps * loss_of(x) / 2)
    stiffness = square_of(x) * (1 + 1j * loss_of(x)) - frequency**2
    return table(np.repeat(np.arange(len(sizes)) + 1, points), frequency, stiffness, x)


def errors(result):
    """Relative errors of frequency and damping against the exact curves."""
    found = result.has_result
    velocity = np.asarray(result.velocity)[found]
    natural = np.asarray(result.natural_frequency)[found]
    x = velocity / natural
    true = np.sqrt(square_of(x))
    ratio = np.asarray(result.damping_ratio)[found]
    return np.abs(natural / true - 1).max(), np.abs(ratio / (loss_of(x) / 2) - 1).max()


def test_concerto_finds_the_mode_of_two_states_of_equal_displacement():
    result = sj.methods.concerto(constant_force(), modes_of())
    assert result.has_result.all()
    assert len(result.has_result) == 30
    assert max(errors(result)) < 1e-7


def test_concerto_needs_no_modal_constant():
    """Gain and phase errors of the sensor do not affect λ where nothing is interpolated."""
    data = constant_force()
    rotated = table(
        data.level,
        np.asarray(data.frequency),
        0.7 * np.asarray(data.force / (data.velocity[:, 0] / (1j * data.frequency))),
        np.abs(np.asarray(data.velocity[:, 0]) / np.asarray(data.frequency)),
    )
    assert max(errors(sj.methods.concerto(rotated, modes_of()))) < 1e-7


def test_response_control_is_a_linear_mode_at_each_level():
    for method in (sj.methods.rct, sj.methods.harmonic_force_surface):
        result = method(constant_response(), modes_of())
        assert result.has_result.all()
        assert list(result.level) == [1, 2, 3, 4]
        assert max(errors(result)) < 1e-6


def test_controlled_displacements_are_not_pairs():
    result = sj.methods.concerto(constant_response(), modes_of())
    assert list(result.status) == 4 * [int(MethodStatus.AMPLITUDE_CONTROLLED)]


def test_levels_of_constant_force_are_cut_at_equal_displacement():
    data = constant_force(forces=(0.05, 0.07, 0.1, 0.14), fractions=np.linspace(0.3, 0.999, 60))
    result = sj.methods.rct(data, modes_of())
    assert result.has_result.sum() > 5
    assert [note.kind for note in result.notes] == ["sections_between_levels"]
    frequency, damping = errors(result)
    assert frequency < 1e-5
    assert damping < 5e-3


def test_a_cut_of_the_force_surface_has_the_branch_that_a_sweep_jumps_over():
    sizes = np.linspace(5e-5, 1.5e-3, 60)
    frequency = np.linspace(REST, np.sqrt(square_of(sizes[-1])), 80)
    x, omega = (one.ravel() for one in np.meshgrid(sizes, frequency, indexing="ij"))
    stiffness = square_of(x) * (1 + 1j * loss_of(x)) - omega**2
    level = np.repeat(np.arange(len(sizes)), len(frequency))
    surface = sj.methods.force_surface(table(level, omega, stiffness, x), modes_of())
    force = 1.0
    at, amplitude = surface.cut(force)
    required = np.abs(square_of(amplitude) * (1 + 1j * loss_of(amplitude)) - at**2) * amplitude
    assert np.abs(required / force - 1).max() < 0.02
    assert np.bincount(np.unique(at, return_inverse=True)[1]).max() == 3


def test_phase_resonance_reads_frequency_and_damping_where_the_phase_is_zero():
    steps = np.linspace(-0.3, 0.34, 4)
    x = np.repeat([2e-4, 5e-4], len(steps))
    frequency = np.sqrt(square_of(x)) * (1 + np.tile(steps, 2) * loss_of(x) / 2)
    stiffness = square_of(x) * (1 + 1j * loss_of(x)) - frequency**2
    shape, participation = -0.5, 2.0  # modal mass 1 at the sensor, which looks the other way
    data = table(np.repeat([1, 2], len(steps)), frequency, -stiffness, x)
    result = sj.methods.phase_resonance(data, modes_of(shape, participation))
    assert result.has_result.all()
    frequency_error, damping_error = errors(result)
    assert frequency_error < 1e-6
    assert damping_error < 5e-3


def test_describing_function_of_a_spring_in_a_chain():
    """Two masses by springs, a spring and damper of known v on the second: solved densely."""
    stiffness = np.array([[5e4, -2e4], [-2e4, 4e4]])
    squares, shapes = np.linalg.eigh(stiffness)  # unit masses
    modes = sj.model.linear_modes(
        np.sqrt(squares), [1e-12, 1e-12], shapes[[1]], shapes[0], mode_of_interest=0
    )
    x = np.array([1e-3, 2e-3, 3e-3])
    v = 3e9 * x**2 + 1j * (40 + 2e4 * x)
    frequency = np.sqrt(squares[0]) * np.array([0.97, 1.01, 1.04])
    forces = []
    for one, omega in zip(v, frequency, strict=True):
        dynamic = stiffness - omega**2 * np.eye(2) + np.diag([0.0, one])
        forces.append(1 / np.linalg.inv(dynamic)[1, 0])  # N on the first mass per m of the second
    data = table([1, 2, 3], frequency, np.array(forces), x)
    found = describing_function(sensor_states(data, modes), modes)
    np.testing.assert_allclose(found, v, rtol=1e-9)
    result = sj.methods.arslan_ozguven(data, modes)
    true = [np.linalg.eigvalsh(stiffness + np.diag([0.0, one.real]))[0] for one in v]
    np.testing.assert_allclose(np.sort(result.natural_frequency), np.sqrt(true), rtol=1e-9)


@pytest.mark.parametrize("method", [sj.methods.concerto, sj.methods.arslan_ozguven])
def test_stated_errors_are_propagated(method):
    """1σ against the scatter of noisy repeats, at the level's own amplitudes."""
    clean = constant_force(forces=(0.1,), fractions=(0.45, 0.55, 0.65, 0.75))
    rng = np.random.default_rng(4)
    velocity = np.asarray(clean.velocity)
    own = {"velocity_std": 0.003 * np.abs(velocity), "phase_std": np.full(velocity.shape, 0.006)}
    score = []
    for _ in range(200):
        amplitude, phase = rng.standard_normal((2, *velocity.shape))
        noisy = velocity * (1 + 0.003 * amplitude) * np.exp(0.006j * phase)
        data = sj.measure.steady_states(
            *(np.asarray(clean.level), np.asarray(clean.frequency), np.asarray(clean.force)),
            noisy,
            **own,
        )
        result = method(data, modes_of())
        x = result.velocity / result.natural_frequency
        score += [
            (result.natural_frequency - np.sqrt(square_of(x))) / result.natural_frequency_std,
            (result.damping_ratio - loss_of(x) / 2) / result.damping_ratio_std,
        ]
    frequency, damping = np.concatenate(score[::2]), np.concatenate(score[1::2])
    for one in (frequency, damping):
        assert 0.7 < np.sqrt(np.nanmean(one**2)) < 1.4


def test_a_level_that_jumps_before_resonance_has_no_point():
    data = constant_force(forces=(0.1,), sides=(-1,))
    result = sj.methods.phase_resonance(data, modes_of())
    assert list(result.status) == [int(MethodStatus.NO_RESONANCE)]
    result = sj.methods.concerto(data, modes_of())
    assert list(result.status) == [int(MethodStatus.ONE_SIDE)]
    assert np.isnan(result.natural_frequency).all()


def test_methods_that_cannot_run_give_a_reason_and_the_others_run():
    data = constant_force()
    volts = sj.measure.steady_states(
        np.asarray(data.level),
        np.asarray(data.frequency),
        np.full(data.n_states, np.nan),
        np.asarray(data.velocity),
        drive=3.0 * np.asarray(data.force),
    )
    with pytest.raises(ValueError, match="no method could run; phase_resonance: forces in N"):
        sj.methods.compare_methods(volts, modes_of(), ["phase_resonance"])
    found = sj.methods.compare_methods(volts, modes_of(), ["arslan_ozguven", "concerto"])
    assert list(found.stopped) == ["arslan_ozguven"]
    assert max(errors(found.results[0])) < 1e-7
    with pytest.raises(ValueError, match=r"must be among snrm, concerto.*but has hilbert"):
        sj.methods.compare_methods(data, modes_of(), ["hilbert"])
    found = sj.methods.compare_methods(data, modes_of())
    assert {one.method for one in found.results} == {"snrm", *METHODS}
    # A table only: methods for records state what they need.
    assert set(found.stopped) == {"resonant_decay", "restoring_force", "ssm", "pnlss"}
    assert all("a time record" in why for why in found.stopped.values())
