"""Amplitude-dependent modes of low-level tests, against one-term balance in closed form."""

import numpy as np
import pytest

import snrmjax as sj
from snrmjax.identify.modal.linear_fit import fit_linear_modes
from snrmjax.identify.modal.modal_bases import AmplitudeDependence, BasisSettings, receptance_bases
from snrmjax.identify.modal.modes_of_tests import find_modes, responses_of_states

HERTZ = 2 * np.pi
OWN, RATIO, RESIDUE = 30 * HERTZ, 0.005, np.array([-2.0, 0.7])


def states(shift, loss, *, levels=(0.3, 0.6, 1.0), noise=1e-3, seed=0, stated=True):
    """Two sensors on a mode with D q = F, D growing with |q|² by `shift` bandwidths at the top."""
    rng, rows = np.random.default_rng(seed), []
    top = 1 / (2 * RATIO * OWN**2)
    for number, force in enumerate(levels, start=1):
        omega = OWN * np.linspace(1 - 6 * RATIO, 1 + 8 * RATIO, 41)
        square = np.zeros_like(omega)
        for _ in range(400):
            change = 2 * shift * 2 * RATIO * OWN**2 + 1j * omega * loss * 2 * RATIO * OWN
            q = force / (OWN**2 - omega**2 + 2j * RATIO * OWN * omega + change * square / top**2)
            square = 0.7 * square + 0.3 * np.abs(q) ** 2
        rows += [(number, w, force, *(1j * w * z * RESIDUE)) for w, z in zip(omega, q, strict=True)]
    level, omega, force, *both = (np.array(column) for column in zip(*rows, strict=True))
    velocity = np.stack(both, axis=1)
    std = np.hypot(noise * np.abs(velocity), 0.2 * noise * np.abs(velocity).max(axis=0)) / 2**0.5
    error = std * (rng.normal(size=std.shape) + 1j * rng.normal(size=std.shape))
    errors = {"velocity_std": std, "phase_std": std / np.abs(velocity)} if stated else {}
    return sj.measure.steady_states(
        level, omega, force, velocity + error, sensors=("a", "b"), **errors
    )


@pytest.mark.parametrize("loss", [0.0, 0.5])
@pytest.mark.parametrize("stated", [True, False])
def test_the_values_at_zero_amplitude_are_identified(loss, stated):
    modes, (note,) = find_modes(states(0.5, loss, stated=stated))
    assert note.kind == "amplitude_dependent_mode"
    assert (note["power"], note["levels"]) == (2, (1, 2, 3))
    assert (note["damping_change"] is not None) == bool(loss)
    assert modes.n_modes == 1
    exact = np.array([OWN, RATIO, *RESIDUE])
    values = np.array([modes.natural_frequency[0], modes.damping_ratio[0], *modes.residue[:, 0]])
    std = np.sqrt(np.diag(modes.mode_covariance[0]))
    assert np.all(np.abs(values - exact) < 3.5 * std)
    assert np.all(std < 0.01 * np.abs(exact))
    if loss:
        # At the resonance r = |q|/top solves r + loss r³ = 1, and the damping is 1 + loss r² times.
        (r,) = (z.real for z in np.roots([loss, 0, 1, -1]) if abs(z.imag) < 1e-9)
        assert note["damping_change"] == pytest.approx(loss * r**2 * RATIO, rel=0.03)


def test_a_linear_mode_is_unchanged():
    data = states(0.0, 0.0)
    modes, notes = find_modes(data)
    lowest = responses_of_states(data, 1)
    alone = fit_linear_modes(lowest.responses, std=lowest.std)
    assert [note.kind for note in notes] == ["levels_agree"]
    np.testing.assert_array_equal(modes.natural_frequency, alone.natural_frequency)
    np.testing.assert_array_equal(modes.mode_covariance, alone.mode_covariance)


def test_derivatives_of_a_dependent_mode():
    """Against central differences; two rows have a separate mode."""
    omega, load = OWN * np.array([0.99, 1.0, 1.002, 1.01]), np.array([0.5, 1.0, 1.0, 0.7])
    near = load / np.abs(OWN**2 - omega**2 + 2j * RATIO * OWN * omega)
    for power in (1, 2):
        dependence = AmplitudeDependence(
            0, power, True, OWN, load, near, apart=np.array([0.0, 1.0, 0.0, 1.0])
        )
        settings = BasisSettings(upper=True, phase=True, dependence=dependence)
        at = np.array([OWN, RATIO, 0.004, 0.003, 1e-3, -1e-3, 0.1])

        def columns(point, settings=settings):
            return receptance_bases(omega, point, settings)[0].columns

        slopes = receptance_bases(omega, at, settings)[0].derivatives
        for k, step in enumerate([1e-4, 1e-7, 1e-7, 1e-7, 1e-7, 1e-7, 1e-6]):
            move = step * np.eye(len(at))[k]
            by_difference = (columns(at + move) - columns(at - move)) / (2 * step)
            scale = np.abs(by_difference).max()
            np.testing.assert_allclose(slopes[k], by_difference, atol=1e-6 * scale)


@pytest.mark.parametrize("shift", [0.0, 0.9])
def test_few_states_about_a_lone_resonance_give_its_mode(shift):
    """Fourteen states a level, too few for poles of many orders."""
    data = states(shift, 0.0, levels=(0.5, 1.0), noise=5e-3, stated=False)
    k = np.flatnonzero(np.tile(np.arange(41) % 3 == 0, 2))
    columns = (np.asarray(getattr(data, name))[k] for name in ("level", "frequency", "force"))
    few = sj.measure.steady_states(*columns, np.asarray(data.velocity)[k], sensors=data.sensors)
    with pytest.raises(ValueError, match="no pole is stable"):
        fit_linear_modes(responses_of_states(few, 1).responses)
    modes, notes = find_modes(few)
    assert (notes[0].kind == "amplitude_dependent_mode") == bool(shift)
    off = [(modes.natural_frequency - OWN) / modes.natural_frequency_std]
    off.append((modes.damping_ratio - RATIO) / modes.damping_ratio_std)
    assert np.all(np.abs(off) < 3)
