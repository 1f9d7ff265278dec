"""Coupled modes identified and fitted; truth from an independent harmonic balance."""

import dataclasses

import numpy as np
import pytest
from truths.two_modes import OMEGA, steady_states, structure

import snrmjax as sj
from snrmjax.identify.coupled.coupled_modes import chosen_terms, coupling_terms, other_mode_moves
from snrmjax.identify.coupled.coupled_test import single_mode_bias
from snrmjax.pipelines.identify import identify_test

THREE = {(4, 0): 2e4, (3, 1): 1.5e4, (2, 2): 3e4}
ALONE = {(4, 0): 2e4}
CLOSE = np.array([100.0, 104.0])
ONE = {(4, 0): 2e4, (3, 1): 1e4, (2, 2): 5e4, (0, 4): 1e4}


@pytest.mark.parametrize(
    ("terms", "modes", "ratio"),
    [
        pytest.param(THREE, OMEGA, 3, id="1:3"),
        pytest.param(ALONE, OMEGA, None, id="none"),
        pytest.param(ONE, CLOSE, 1, id="1:1", marks=pytest.mark.long),
    ],
)
def test_the_interaction_is_recognised(terms, modes, ratio):
    data = steady_states(terms, noise=3e-3, seed=1, modes=modes)
    model = structure(modes=modes)
    result = sj.identify.coupled_modes(data, model, harmonic_order=5)
    assert result.coupled == (ratio is not None)
    assert other_mode_moves(data, model) == (ratio is not None)
    names = dict(zip(result.calibration.names, range(20), strict=False))
    for (a, b), value in terms.items():
        k = names.get(f"potential.{'1' * a}{'2' * b}")
        if k is not None:
            assert abs(result.calibration.values[k] - value) < 3.3 * result.calibration.std[k]
    if ratio is not None:
        assert (result.interaction.other, result.interaction.ratio) == (1, ratio)


def test_fundamentals_of_two_sensors_suffice():
    data = steady_states(ONE, noise=3e-3, seed=1, modes=CLOSE)
    alone = sj.measure.steady_states(
        *(data.level, data.frequency, data.force, data.velocity),
        velocity_std=data.velocity_std,
        phase_std=data.phase_std,
        sensors=data.sensors,
    )
    result = sj.identify.coupled_modes(alone, structure(modes=CLOSE), harmonic_order=5)
    assert result.coupled
    assert result.calibration.state_converged.all()
    k = result.calibration.names.index("potential.1122")
    assert abs(result.calibration.values[k] - ONE[2, 2]) < 3.3 * result.calibration.std[k]


def test_evidence_of_terms_is_that_of_integrals():
    # Two terms, one measured as 3 ± 1, the other unknown: by quadrature over both coefficients.
    terms = coupling_terms(0, 1, 3)[:2]
    information, values = np.diag([1.0, 1e-12]), np.array([3.0, 0.0])
    chosen = chosen_terms(terms, values, information, np.array([10.0, 10.0]))
    grid = np.linspace(-80, 80, 160001)
    prior = np.exp(-0.5 * (grid / 10) ** 2) / np.sqrt(2 * np.pi) / 10
    with_first = np.sum(prior * np.exp(-0.5 * (grid - 3) ** 2)) * (grid[1] - grid[0])
    without = np.exp(-4.5)
    assert chosen.coupled == pytest.approx(with_first / (with_first + without), rel=1e-6)


@pytest.mark.long
def test_the_bias_of_one_mode_is_that_of_a_backbone_of_two():
    data, model = steady_states(ONE, modes=CLOSE), structure(modes=CLOSE)
    coupled = sj.identify.coupled_modes(data, model, harmonic_order=5)
    identification = sj.identify_backbone(data, model)
    bias = single_mode_bias(identification, coupled)
    velocity, frequency, _, _ = bias.at_largest
    # The conservative mode of the true potential, by one-harmonic balance: q cos.
    q = np.array([velocity / 100, 0.0])
    omega = 100.0
    for _ in range(200):
        a, b = q
        force = 0.75 * np.array(
            [
                4 * 2e4 * a**3 + 3 * 1e4 * a**2 * b + 2 * 5e4 * a * b**2,
                1e4 * a**3 + 2 * 5e4 * a**2 * b + 4 * 1e4 * b**3,
            ]
        )
        omega = np.sqrt(CLOSE[0] ** 2 + force[0] / a)
        b = -(force[1] - 0.75 * 2 * 5e4 * a**2 * b) / (
            CLOSE[1] ** 2 - omega**2 + 0.75 * 2 * 5e4 * a**2
        )
        seen = np.array([[1.0, 0.8], [0.7, -1.1]])[
            model.modes.sensors.index(identification.backbone.sensor)
        ]
        a = (velocity / omega - seen[1] * b) / seen[0]
        q = np.array([a, b])
    identified = float(identification.backbone.sampled(50).natural_frequency[-1])
    # Harmonics move the frequency by some 1e-6.
    assert frequency == pytest.approx(identified / omega - 1, abs=5e-6)
    assert abs(frequency) > 1e-4


def test_identify_reports_and_models_the_coupling(tmp_path):
    data, model = steady_states(ONE, noise=2e-3, seed=3, modes=CLOSE), structure(modes=CLOSE)
    result = identify_test(data, model, modes=2, predict_force=(0.8,))
    kinds = {note.kind for note in result.notes if not isinstance(note, str)}
    assert {"modes_coupled", "single_mode_biased"} <= kinds
    sj.write_results(result, tmp_path)
    written = {path.name for path in tmp_path.iterdir()}
    assert {"model.toml", "prediction.csv", "coupled_backbone.png", "report.html"} <= written
    completed = sj.read_model(tmp_path / "model.toml")
    assert "1112" in {"".join(str(m + 1) for m in k) for k in completed.potential.monomials}
    # Assessed by default: the sensors show the second mode.
    assert identify_test(data, model).coupled is not None
    assert identify_test(data, model, modes=1).coupled is None
    with pytest.raises(ValueError, match="`--modes` must be 1 or 2"):
        identify_test(data, model, modes=3)


def test_a_drive_voltage_has_the_gain_of_the_joint_fit():
    """Coupled modes use the force gain of the joint fit without a further option."""
    data, model = steady_states(ONE, noise=2e-3, seed=3, modes=CLOSE), structure(modes=CLOSE)
    of_volts = dataclasses.replace(data, force=data.force * np.nan, drive=data.force / 0.4)
    result = identify_test(of_volts, model, modes=2, fit="auto", free=("force_gain",))
    (gain,) = [note for note in result.notes if getattr(note, "kind", "") == "force_from_drive"]
    assert gain["newtons_per_volt"] == pytest.approx(0.4, rel=0.1)
    assert result.coupled.modes.coupled
