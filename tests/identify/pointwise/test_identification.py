"""The whole inverse method: a measured bolted beam, a linear mode, and the notes."""

from pathlib import Path

import numpy as np
import pytest

import snrmjax as sj
from snrmjax.io.models import read_model
from snrmjax.io.tables import read_steady_states

HERTZ = 2 * np.pi
MEASURED = Path(__file__).resolve().parents[4] / "shared" / "data" / "brake_reuss_beam"

W0, ZETA, SHAPE, PARTICIPATION = 500.0, 0.01, 2.0, 1.5
MODES = sj.model.linear_modes([W0], [ZETA], [[SHAPE]], [PARTICIPATION])


def linear_test(seed, noise, *, stated=False, more_off_it=0.0, levels=6):
    """States of a linear mode by its own formula, with a relative error of the phasor.

    `more_off_it` makes the error grow with the distance from resonance.
    """
    rng = np.random.default_rng(seed)
    level = np.repeat(np.arange(levels), 5)
    force = np.linspace(0.2, 1.0, levels)[level]
    frequency = W0 * (1 + ZETA * np.tile([-1.2, -0.5, 0.1, 0.6, 1.1], levels))
    dynamic = W0**2 - frequency**2 + 2j * ZETA * W0 * frequency
    exact = 1j * frequency * SHAPE * PARTICIPATION * force / dynamic
    error = noise * (rng.normal(size=exact.size) + 1j * rng.normal(size=exact.size))
    error *= np.sqrt(1 + (more_off_it * np.sin(np.angle(exact))) ** 2)
    velocity = exact * (1 + error)
    spread = {"velocity_std": noise * np.abs(velocity), "phase_std": np.full(level.size, noise)}
    return sj.measure.steady_states(level, frequency, force, velocity, **(spread if stated else {}))


@pytest.fixture(scope="module")
def data(model):
    table = MEASURED / "response_controlled.csv"
    return read_steady_states(table, model)


@pytest.fixture(scope="module")
def model():
    if not MEASURED.is_dir():
        pytest.skip(f"the measured beam is not beside the project: {MEASURED} is missing")
    return read_model(MEASURED / "model.toml")


@pytest.fixture(scope="module")
def identification(data, model):
    return sj.identify_backbone(data, model.modes)


@pytest.fixture(scope="module")
def crossings(data, model):
    """Resonance of every level from its phase alone: frequency, velocity and damping there.

    Where the velocity is in phase with the force, Ω = ω̃ and 2ζ̃ω̃ = |A|F/v.
    """
    constant = float(model.modes.mode_shape[0, 0] * model.modes.participation[0])
    rows = []
    for level in np.unique(data.level):
        here = np.asarray(data.level) == level
        phase = np.angle(np.asarray(data.velocity)[here, 0])
        # Points are in order of frequency, and the phase falls with it.
        order = np.argsort(phase)
        frequency, force, speed = (
            np.interp(0.0, phase[order], np.asarray(values)[here][order])
            for values in (data.frequency, data.force, np.abs(data.velocity[:, 0]))
        )
        rows.append((frequency, speed, constant * force / speed / (2 * frequency)))
    return np.array(rows).T


class TestMeasuredBeam:
    def test_bands_and_what_levels_differ_by_cover_where_every_level_is_in_phase(
        self, identification, crossings
    ):
        backbone = identification.backbone
        frequency, speed, damping = crossings
        values = backbone.values(np.clip(speed / frequency, backbone.smallest, backbone.largest))
        # What levels may differ by, if curves do not bend for it: runs repeat to 0.1 to 0.15 Hz, as
        # those who measured them say.
        apart = 0.5 * float(identification.fit.prior.new_level[2]) * frequency
        assert apart.max() / HERTZ < 0.15
        std = np.hypot(values.natural_frequency_std, apart)
        assert np.abs((values.natural_frequency - frequency) / std).max() < 1.96
        # Damping of the levels repeats to about 10 %, as those who measured it say.
        of_level = float(identification.fit.prior.new_level[3])
        assert of_level < 0.1
        std = np.hypot(values.damping_ratio_std, of_level * damping)
        assert np.abs((values.damping_ratio - damping) / std).max() < 1.96
        assert np.max(std / damping) < 0.06

    @pytest.mark.long
    def test_a_joint_fit_settles_where_every_level_is_in_phase(self, data, model, crossings):
        """Near folds a state of exact force would be exact in one direction, and fits wandered."""
        families = {"backbone": "spline:6@displacement", "damping": "spline:5@displacement"}
        fit = sj.fit_jointly(data, model.modes, **families)
        frequency, speed, damping = crossings
        values = sj.identify.fitted_values(fit, speed)
        assert fit.converged
        # Levels cross within 0.05 Hz of a curve; an error of phase of 7°, which the fit finds at
        # the highest, is worth tan(7°)·0.7 % of 80 Hz there.
        np.testing.assert_allclose(values.natural_frequency, frequency, atol=0.1 * HERTZ)
        np.testing.assert_allclose(values.damping_ratio, damping, rtol=0.1)
        stiffness = fit.noise.level_std[2]
        assert 0.5 * stiffness * 80.4 < 0.1  # Hz

    def test_the_backbone_softens_and_stiffens(self, identification):
        backbone = identification.backbone
        amplitude = np.linspace(float(backbone.smallest), float(backbone.largest), 400)
        values = backbone.values(amplitude)
        hertz = np.asarray(values.natural_frequency) / HERTZ
        lowest = int(np.argmin(hertz))
        # The beam's published course is that of single levels, which repeat to 0.1 to 0.15 Hz.
        published = (80.37, 80.11, 80.45)
        np.testing.assert_allclose(hertz[[0, lowest, -1]], published, rtol=0, atol=0.15)
        std = np.asarray(values.natural_frequency_std)[[0, lowest, -1]] / HERTZ
        assert np.max(np.abs(hertz[[0, lowest, -1]] - published) / std) < 1.96
        acceleration = values.velocity[lowest] * hertz[lowest] * HERTZ
        # Published: 40 m/s². Levels between 20 and 50 lie within 0.1 Hz of one another.
        assert 20 < acceleration < 50
        assert values.damping_ratio[0] == pytest.approx(0.0015, rel=0.1)

    def test_scatter_is_reported(self, identification):
        # From 0.54 to 0.97 % inside the highest level, least where the velocity lags most.
        assert any(
            n.kind == "damping_changes_with_phase" and n["change"] > 0 for n in identification.notes
        )


class TestLinearMode:
    def test_exact_states_give_the_linear_mode(self):
        identification = sj.identify_backbone(linear_test(0, 0.0), MODES)
        backbone = identification.backbone
        at = np.linspace(float(backbone.smallest), float(backbone.largest), 7)
        # Noise is taken to be 1e-5 at least, and a level's errors as much.
        np.testing.assert_allclose(backbone.natural_frequency(at), W0, rtol=1e-7)
        np.testing.assert_allclose(backbone.damping_ratio(at), ZETA, rtol=1e-5)

    @pytest.mark.long
    def test_point_errors_that_were_not_stated_come_from_the_scatter(self):
        scores = []
        for seed in range(20):
            points = sj.identify_backbone(linear_test(seed, 0.005, more_off_it=4.0), MODES).points
            scores.append((points.natural_frequency - W0) / points.natural_frequency_std)
            scores.append((points.damping_ratio - ZETA) / points.damping_ratio_std)
        # Twenty seeds of 24 degrees of freedom know their rms to 3 %, but every fit bends with
        # its points: smaller residuals, too small a scale.
        assert 0.9 < np.sqrt(np.mean(np.square(scores))) < 1.2

    def test_stated_errors_are_left_as_stated(self):
        data = linear_test(0, 0.01, stated=True)
        identification = sj.identify_backbone(data, MODES)
        points = sj.identify.identify_points(data, MODES)
        np.testing.assert_array_equal(
            identification.points.natural_frequency_std, points.natural_frequency_std
        )
        assert identification.fit.noise.stated

    def test_noise_larger_than_stated_is_noted(self):
        data = linear_test(0, 0.03)
        little = np.full(data.force.shape[0], 0.01)
        stated = sj.measure.steady_states(
            data.level,
            data.frequency,
            data.force,
            data.velocity[:, 0],
            velocity_std=0.01 * np.abs(data.velocity[:, 0]),
            phase_std=little,
        )
        notes = sj.identify_backbone(stated, MODES).notes
        assert "noise_exceeded" in {note.kind for note in notes}

    @pytest.mark.parametrize(("phase", "sign"), [(0.0, []), (0.2, [-1]), (-0.2, [1])])
    def test_a_phase_that_is_off_shows_in_the_damping(self, phase, sign):
        data = linear_test(0, 0.003)
        velocity = data.velocity[:, 0] * np.exp(1j * phase)
        shifted = sj.measure.steady_states(data.level, data.frequency, data.force, velocity)
        notes = sj.identify_backbone(shifted, MODES).notes
        changes = [n["change"] for n in notes if n.kind == "damping_changes_with_phase"]
        # 2ζ̃ω̃ is |A|F cos φ/v: a phase that reads too high makes it fall towards the lead side.
        assert np.sign(changes).tolist() == sign

    def test_points_without_a_solution_are_counted(self):
        data = linear_test(0, 0.0)
        velocity = np.asarray(data.velocity[:, 0]).copy()
        velocity[3] = np.nan
        spoilt = sj.measure.steady_states(data.level, data.frequency, data.force, velocity)
        identification = sj.identify_backbone(spoilt, MODES)
        (note,) = (note for note in identification.notes if note.kind == "states_without_point")
        assert (note["n_states"], note["of"]) == (1, 30)
