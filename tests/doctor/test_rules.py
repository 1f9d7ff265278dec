"""The doctor's finer rules: borderline cases of one mode and its records, by exact responses."""

import numpy as np
import pytest
from scipy.signal import lsim
from truths.one_mode import CUBIC, OMEGA, SHAPE, ZETA, model, noisy, states, table

import snrmjax as sj
from snrmjax.doctor.column_misreadings import is_other_scale
from snrmjax.doctor.findings import KINDS, SEVERITIES, Finding
from snrmjax.doctor.fitted_hypothesis import Scale, checked_states, fit_hypothesis, with_mass
from snrmjax.measure import Channel, time_recording


def raised(data, structure=None, recordings=()):
    checkup = sj.doctor.check_test(data, structure, recordings)
    return [one.kind for one in checkup.findings if one.severity != "info"]


def test_a_finding_has_the_severity_of_its_kind_without_another_explanation():
    assert set(SEVERITIES) == set(KINDS)
    sure = Finding("volts_as_force", "", "", "")
    assert (sure.severity, sure._replace(unsure=True).severity) == ("error", "warning")


@pytest.mark.parametrize(
    ("power", "kind"), [(-1, "displacement_as_velocity"), (1, "acceleration_as_velocity")]
)
def test_amplitudes_of_another_quantity_over_a_wide_band(power, kind):
    """The band is 16 % wide: a constant factor in place of Ω leaves several per cent."""
    level, w, force, v = states()
    assert np.ptp(w) > 0.15 * OMEGA
    checkup = sj.doctor.check_test(table(level, w, force, noisy(v) * w**power), model())
    assert [one.kind for one in checkup.findings] == [kind]
    assert checkup.findings[0].evidence["reading"].startswith("sizes_of_")


@pytest.mark.parametrize("factor", [0.96, pytest.param(1.04, marks=pytest.mark.long)])
def test_an_rms_within_the_error_of_the_modal_mass(factor):
    """4 % of the modal mass are less than the 5 % (1σ) that a linear test leaves."""
    level, w, force, v = states()
    assert raised(table(level, w, force, noisy(v) * factor / 2**0.5), model()) == ["rms_for_peak"]
    assert raised(table(level, w, factor * force / 2**0.5, noisy(v)), model()) == ["rms_for_peak"]


def test_errors_stated_too_small_do_not_hide_a_wrong_scale():
    """Noise of 0.3 % stated as 0.03 %: the modal mass is known to 1 % all the same."""
    level, w, force, v = states()
    stated = {"velocity_std": 3e-4 * np.abs(v), "phase_std": np.full(len(v), 3e-4)}
    data = table(level, w, force, noisy(v), **stated)
    assert "shape_not_mass_normalised" in raised(data, model(1.0))
    assert raised(data, model()) == []


def test_an_uncertain_modal_mass_is_no_wrong_scale():
    level, w, force, v = states()
    recorded = checked_states(table(level, w, force, v), model(), 0, np.ones(len(v), dtype=bool))
    right, wrong = fit_hypothesis(recorded.test), fit_hypothesis(with_mass(recorded.test, 1.5))
    assert is_other_scale(Scale(right, 1.5, 0.01), wrong)
    assert not is_other_scale(Scale(right, 1.5, 0.2), wrong)  # its 95 % band has 1.01 in it
    # Volts of 4.5 V/N need not be known to 5 % for it.
    assert is_other_scale(Scale(right, 4.5, 0.1), wrong)
    assert not is_other_scale(Scale(right, 1.1, 0.01), wrong)


def test_a_sensor_against_the_force_is_wrong_only_if_a_model_states_otherwise():
    level, w, force, v = states()
    data = table(level, w, force, -noisy(v))
    assert raised(data) == []
    assert raised(data, model()) == ["shape_not_mass_normalised"]


@pytest.mark.parametrize("off", [2, *(pytest.param(k, marks=pytest.mark.long) for k in (1, 3))])
def test_a_level_whose_force_is_off_is_named(off):
    level, w, force, v = states()
    force = force * np.where(level + 1 == off, 1.25, 1.0)
    findings = sj.doctor.check_test(table(level, w, force, noisy(v)), model()).findings
    (own,) = (one for one in findings if one.kind == "volts_as_force")
    ((level, file, gain),) = own.evidence["gains"]
    assert (level, file) == (off, None)
    assert gain == pytest.approx(1.25, rel=0.02)  # 0.3 % of noise, curves that bend
    assert own.advice["gains"] == own.evidence["gains"]
    assert (own.name, own.as_dict()["kind"]) == (
        f"different force scale at level {off}",
        "volts_as_force",
    )


def test_forces_of_which_no_two_levels_agree_are_listed():
    level, w, force, v = states()
    recorded = table(level, w, force * np.array([1.0, 0.7, 0.5])[level], noisy(v))
    own = next(
        one
        for one in sj.doctor.check_test(recorded, model()).findings
        if one.kind == "volts_as_force"
    )
    np.testing.assert_allclose(own.evidence["gains"], [0.7, 0.5], rtol=0.03)
    assert own.name == "volts as force"


def with_damping_std():
    std = sj.model.LinearModesStd([3e-4 * OMEGA], [0.03 * ZETA])
    shape = [[SHAPE]], [SHAPE]
    modes = sj.model.linear_modes([OMEGA], [ZETA], *shape, sensors=("tip",), std=std)
    return sj.model.structure(modes)


def test_shaker_damping_reveals_a_voltage_taken_for_the_force():
    """U = F + cV: a coil of (Bl)²/R = c, in units of force, that doubles the damping."""
    level, w, force, v = states()
    drive = force + 2 * ZETA * OMEGA / SHAPE**2 * v
    recorded = noisy(np.abs(v) * np.exp(1j * np.angle(v / drive)))
    assert raised(table(level, w, np.abs(drive), recorded), with_damping_std()) == [
        "volts_as_force"
    ]
    assert raised(table(level, w, force, noisy(v)), with_damping_std()) == []
    # Damping that grows with the amplitude is the structure's own.
    grows = force + 4 * ZETA * OMEGA / SHAPE**2 * v * np.sqrt(np.abs(v) / np.abs(v).max())
    recorded = noisy(np.abs(v) * np.exp(1j * np.angle(v / grows)))
    assert raised(table(level, w, np.abs(grows), recorded), with_damping_std()) == []


def controlled_response(floor, seed=0):
    """Controlled velocities, the force needed, and its reading by a noisy cell."""
    level, w, _, _ = states()
    w = OMEGA * (1 + 0.05 * np.linspace(-1, 1, 15))[np.arange(45) % 15]
    a = np.array([0.3, 0.6, 1.0])[level] * OMEGA / w
    needed = a * (OMEGA**2 + 0.75 * CUBIC * a**2 - w**2 + 2j * ZETA * OMEGA * w) / SHAPE
    rng = np.random.default_rng(seed)
    noise = floor * np.abs(needed).min() * (rng.normal(size=45) + 1j * rng.normal(size=45))
    read = needed + noise
    return table(level, w, np.abs(read), noisy(1j * w * a * SHAPE / np.exp(1j * np.angle(read))))


def test_a_force_that_falls_into_the_noise_of_its_cell():
    findings = sj.doctor.check_test(controlled_response(0.15), model()).findings
    assert [one.kind for one in findings] == ["force_dropout"]
    assert findings[0].evidence.kind == "force_in_noise"


def test_a_controlled_response_with_a_good_cell_has_no_finding():
    assert raised(controlled_response(0.0), model()) == []


FALLEN = (
    (1, 42.7442, 0.05098, 0.00713, 0.01351),
    (1, 42.9107, 0.04713, 0.01356, 0.01495),
    (1, 43.0773, 0.04206, 0.02313, 0.00879),
    (1, 43.2439, 0.04249, 0.02223, -0.01055),
    (1, 43.4105, 0.05014, 0.00845, -0.01413),
    (1, 43.5771, 0.05273, 0.00435, -0.01122),
    (2, 43.4859, 0.12995, 0.04701, 0.04216),
    (2, 43.6525, 0.12342, 0.05954, 0.03346),
    (2, 43.8191, 0.11718, 0.07213, 0.01217),
    (2, 43.9857, 0.15415, 0.00660, -0.03073),
    (2, 44.1522, 0.15672, 0.00327, -0.01770),
    (2, 44.3188, 0.15733, 0.00240, -0.01532),
)
"""Level, Hz, N, m/s: an integrated stepped test up in frequency whose response fell in a step."""


def test_a_response_that_fell_is_no_other_assembly_and_no_other_scale():
    """The other assembly would have 0.6 of the modal mass; κ is off by as much as the misfit."""
    level, hertz, force, re, im = np.array(FALLEN).T
    data = sj.measure.steady_states(
        level.astype(int), 2 * np.pi * hertz, force, re + 1j * im, sensors=("tip",)
    )
    std = sj.model.LinearModesStd([2 * np.pi * 0.0086114], [0.00013282])
    modes = sj.model.linear_modes(
        [2 * np.pi * 43.053], [0.004445], [[2.6485]], [0.57176], sensors=("tip",), std=std
    )
    assert raised(data, sj.model.structure(modes)) == []


def stepped_record(cycles, zeta, per_cycle=16, frequencies=12):
    """Steps over the resonance of one mode, by scipy's exact step between samples."""
    rate = per_cycle * OMEGA / (2 * np.pi)
    w = OMEGA * (1 + 1.5 * zeta * np.linspace(-1, 1, frequencies))
    turn = np.cumsum(np.repeat(w, cycles * per_cycle)) / rate
    force = np.cos(turn)
    system = ([1, 0], [1, 2 * zeta * OMEGA, OMEGA**2])
    v = lsim(system, force, np.arange(len(turn)) / rate)[1]
    rng = np.random.default_rng(0)
    return np.stack([force, v / np.abs(v).max()]) + 2e-3 * rng.normal(size=(2, len(v))), rate


def recording(samples, rate):
    return time_recording(
        samples, [Channel("cell", "force", "N"), Channel("tip", "velocity", "m/s")], rate
    )


def test_a_limit_reached_by_few_samples():
    """17 samples a cycle and a limit of 97 %: one or two at it, never three in a row."""
    samples, rate = stepped_record(150, 0.02, 17, frequencies=5)
    samples[1] = np.clip(samples[1], -0.97, 0.97)
    assert raised([], None, [recording(samples, rate)]) == ["clipped_channel"]


def test_counts_of_a_digitiser_are_no_limit():
    """100 counts: the last one of a peak is crowded, and so are those next to it."""
    samples, rate = stepped_record(150, 0.02, 40, frequencies=5)
    samples[1] = np.round(50 * samples[1]) / 50
    assert raised([], None, [recording(samples, rate)]) == []


def test_transients_that_rotate_within_a_few_cycles():
    """22 cycles at ζ = 0.7 %: e^{−2πζ·22} = 38 % of a change is left at the end."""
    assert raised([], None, [recording(*stepped_record(22, 0.007))]) == ["unsettled_steps"]


def test_noise_in_short_steps_is_no_transient():
    """20 cycles at ζ = 8 %, settled to 4e-5, under noise of 10 %."""
    samples, rate = stepped_record(20, 0.08)
    samples[1] += 0.1 * np.random.default_rng(1).normal(size=samples.shape[1])
    assert raised([], None, [recording(samples, rate)]) == []


@pytest.mark.parametrize("levels", [(1.0, 0.35), (0.35, 1.0)])
def test_another_level_of_less_force_is_no_drop_of_it(levels):
    """Two sweeps of six steps; the mode loses three times as much at the larger force."""
    parts = [stepped_record(150, {1.0: 0.03, 0.35: 0.01}[one], frequencies=6) for one in levels]
    rate = parts[0][1]
    scale = {1.0: 1.0, 0.35: 0.35 * 3.0}  # |V|/F over the other level's, at resonance
    samples = [
        np.stack([force * one, v * one * (scale[one] / one)])
        for one, ((force, v), _) in zip(levels, parts, strict=True)
    ]
    assert raised([], None, [recording(np.concatenate(samples, axis=1), rate)]) == []
