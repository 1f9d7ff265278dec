"""Mass-normalised shapes by each method, against the mass matrix of a chain."""

import numpy as np
import pytest
from truths.modal_structures import HERTZ, base_response, chain, receptance

from snrmjax.identify.modal.linear_fit import fit_linear_modes
from snrmjax.identify.modal.modes_of_tests import (
    find_modes,
    levels_by_velocity,
    relative_to_base,
    responses_of_states,
)
from snrmjax.identify.scaling.scale import (
    AddedMassTest,
    Calibration,
    DrivePoint,
    Free,
    KnownShape,
    SensorMasses,
    scale_modes,
)
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.frequency_responses import frequency_responses
from snrmjax.measure.states import steady_states
from snrmjax.model.modes import linear_response
from snrmjax.pipelines.modes import _requested_scale
from snrmjax.pipelines.options import ModesOptions

MASSES = [1.0, 1.2, 0.8]
RATIOS = [0.01, 0.008, 0.006]
STRUCTURE = chain(MASSES, [8e4, 9e4, 1.1e5], RATIOS)
LINES = np.arange(8, 130, 0.25) * HERTZ
SHAPES = STRUCTURE.shapes * np.sign(STRUCTURE.shapes[0])


def channels(count=3, quantity="displacement"):
    return [Channel(f"s{k + 1}", quantity, point=str(k + 1), direction="+z") for k in range(count)]


def over_force(structure=STRUCTURE, driven=0, omega=LINES, gain=1.0, reference=None):
    force = reference or Channel("F", "force", point=str(driven + 1), direction="+z")
    values = gain * receptance(structure, omega, driven)
    return frequency_responses(omega, values[:, None], channels(len(values)), [force])


FIT = fit_linear_modes(over_force())


def agrees(scaled, driven=0, rtol=1e-5):
    exact = STRUCTURE.shapes * np.sign(STRUCTURE.shapes[driven])
    assert np.allclose(scaled.shape, exact, rtol=rtol, atol=1e-6)
    assert np.allclose(scaled.participation, exact[driven], rtol=rtol)


def test_the_drive_point_is_recognised_by_point_and_axis():
    agrees(scale_modes(FIT, DrivePoint()))
    agrees(scale_modes(fit_linear_modes(over_force(driven=2)), DrivePoint("s3")), driven=2)


def test_a_reversed_drive_point():
    reversed_ = over_force()
    values = reversed_.values * np.array([-1.0, 1.0, 1.0])[:, None, None]
    against = [channels()[0]._replace(direction="-z"), *channels()[1:]]
    fit = fit_linear_modes(frequency_responses(LINES, values, against, reversed_.references))
    scaled = scale_modes(fit, DrivePoint())
    assert np.allclose(scaled.shape[1:], SHAPES[1:], rtol=1e-5)
    assert np.allclose(scaled.shape[0], -SHAPES[0], rtol=1e-5)
    with pytest.raises(ValueError, match=r"negative.*; state that the sensor is turned, or"):
        scale_modes(fit, DrivePoint("s1"))
    with pytest.raises(ValueError, match=r"negative.*; leave out that the sensor is turned, or"):
        scale_modes(FIT, DrivePoint("s1", turned=True))


def test_the_model_responds_as_the_structure():
    modes = scale_modes(FIT, DrivePoint()).linear_modes()
    omega = np.array([30.0, 60.0, 90.0]) * HERTZ
    velocity = np.asarray(linear_response(modes, omega, np.full(3, 2.0)))
    exact = 2.0 * 1j * omega * receptance(STRUCTURE, omega, 0)
    assert np.allclose(velocity.T, exact, rtol=1e-5)


@pytest.mark.parametrize("mass", [0.002, 0.05])
def test_an_added_mass(mass):
    heavier = chain([MASSES[0], MASSES[1] + mass, MASSES[2]], [8e4, 9e4, 1.1e5], RATIOS)
    # Scale without a drive point: the force is at the third mass, its sensor is not used.
    fit = fit_linear_modes(over_force(driven=2))
    second = fit_linear_modes(over_force(heavier, driven=2))
    scaled = scale_modes(fit, AddedMassTest(second, "s2", mass))
    sign = np.sign(scaled.shape[0] * SHAPES[0])
    assert np.allclose(scaled.shape * sign, SHAPES, rtol=1e-4)
    assert np.allclose(scaled.participation * sign, SHAPES[2], rtol=1e-4)
    # The first-order formula errs by 3/2 of the relative shift: the note states it.
    shift = 1 - heavier.natural_frequency / STRUCTURE.natural_frequency
    first = 2 * shift / mass / SHAPES[1] ** 2 - 1
    stated = [note["first_order"] for note in scaled.notes if note.kind == "added_mass_shift"]
    assert np.allclose(stated, first, atol=0.02 * np.abs(first).max() + 1e-4)


@pytest.mark.long
def test_an_added_mass_with_noise_has_an_error_that_holds():
    mass, z = 0.05, []
    heavier = chain([MASSES[0], MASSES[1] + mass, MASSES[2]], [8e4, 9e4, 1.1e5], RATIOS)
    rng = np.random.default_rng(0)
    for _ in range(8):
        fits = []
        for one in (STRUCTURE, heavier):
            clean = over_force(one)
            noise = 1e-6 * (rng.normal(size=clean.values.shape) * (1 + 0j))
            noise = noise + 1e-6j * rng.normal(size=clean.values.shape)
            noisy = frequency_responses(
                LINES, clean.values + noise, clean.responses, clean.references
            )
            fits.append(fit_linear_modes(noisy, to_frequency=120 * HERTZ))
        scaled = scale_modes(fits[0], AddedMassTest(fits[1], "s2", mass))
        sign = np.sign(scaled.shape[0] * SHAPES[0])
        z.append((scaled.shape * sign - SHAPES) / scaled.shape_std)
    # The modes' scales, 24 of them, each shared by three sensors.
    assert 0.5 < np.sqrt(np.mean(np.square(z))) < 1.6


def test_base_motion_by_the_masses_at_the_sensors():
    omega = LINES
    relative = base_response(STRUCTURE, omega)
    absolute = relative - omega**-2.0
    # Displacement over the base's displacement: -Ω² times that over its acceleration.
    over = -(omega**2) * absolute
    raw = frequency_responses(omega, over[:, None], channels(), [Channel("table", "displacement")])
    receptance = relative_to_base(raw, "absolute").responses.receptance()
    assert np.allclose(receptance[:, 0], relative, rtol=1e-9)
    gamma = STRUCTURE.shapes.T @ np.diag(STRUCTURE.mass)
    exact = STRUCTURE.shapes * np.sign(gamma)
    for motion, values, quantity in (
        ("relative", relative, "displacement"),
        ("absolute", -(omega**2) * absolute, "acceleration"),
    ):
        raw = frequency_responses(
            omega, values[:, None], channels(3, quantity), [Channel("table", "acceleration")]
        )
        fit = fit_linear_modes(relative_to_base(raw, motion).responses)
        scaled = scale_modes(fit, SensorMasses(dict(zip(("s1", "s2", "s3"), MASSES, strict=True))))
        assert scaled.per == "m/s²"
        assert np.allclose(scaled.shape, exact, rtol=1e-5)
        assert np.allclose(scaled.participation, -np.abs(gamma), rtol=1e-5)
    with pytest.raises(ValueError, match="the motion must be"):
        relative_to_base(raw, "both")
    with pytest.raises(ValueError, match="a drive point needs a force"):
        scale_modes(fit, DrivePoint())


def test_a_forced_free_fixture():
    # A rigid fixture of 3 kg carries a chain and is driven through a stinger; no sensor on it.
    whole = chain([3.0, *MASSES], [8e4, 9e4, 1.1e5], [0.0, *RATIOS], walls=(False, False))
    omega = np.arange(15, 150, 0.25) * HERTZ
    values = receptance(whole, omega, 0)[1:]
    force = Channel("stinger", "force", point="fixture")
    raw = frequency_responses(omega, values[:, None], channels(), [force])
    fit = fit_linear_modes(raw)
    masses = dict(zip(("s1", "s2", "s3"), MASSES, strict=True))
    scaled = scale_modes(fit, SensorMasses(masses, 3.0), free=Free(6.0))
    exact = whole.shapes[:, 1:] * np.sign(whole.shapes[0, 1:])
    assert np.allclose(scaled.shape, exact[1:], rtol=1e-5)
    assert np.allclose(scaled.participation, exact[0], rtol=1e-5)
    assert scaled.rigid_participation == pytest.approx(6.0**-0.5)
    with pytest.raises(ValueError, match="no fixture mass is stated"):
        scale_modes(fit, SensorMasses(masses))
    with pytest.raises(ValueError, match="no sensor is known to be where the force acts"):
        scale_modes(fit, DrivePoint())


def test_a_drive_voltage_with_and_without_calibration():
    volts = Channel("amplifier", "voltage", "V", point="1", direction="+z")
    fit = fit_linear_modes(over_force(gain=4.0 * np.exp(-0.05j), reference=volts))
    assert fit.phase == pytest.approx(-0.05, abs=1e-5)
    with pytest.raises(ValueError, match="newtons per volt are not stated"):
        scale_modes(fit, DrivePoint())
    agrees(scale_modes(fit, DrivePoint(), calibration=Calibration(4.0)))
    spread = scale_modes(fit, DrivePoint(), calibration=Calibration(4.0, 0.08))
    assert np.allclose(spread.shape_std / np.abs(spread.shape), 0.01, rtol=1e-3)
    assert np.allclose(spread.modal_mass_std, 0.02, rtol=1e-3)
    per_volt = scale_modes(fit, KnownShape("s1", float(SHAPES[0, 0])))
    assert per_volt.per == "V"
    assert per_volt.participation[0] == pytest.approx(4.0 * SHAPES[0, 0], rel=1e-5)
    relative = scale_modes(fit, None)
    assert not relative.mass_normalised
    assert np.allclose(np.abs(relative.shape).max(axis=0), 1.0)
    # Modes that move against their force keep their sign, although their scale is unknown.
    products = STRUCTURE.shapes * STRUCTURE.shapes[0]
    assert np.allclose(relative.shape * relative.participation, 4.0 * products, rtol=1e-4)
    assert np.all(relative.participation > 0)


def test_a_free_structure_has_its_rigid_body_mode():
    free = chain(MASSES, [9e4, 1.1e5], [0.0, 0.01, 0.01], walls=(False, False))
    fit = fit_linear_modes(over_force(free, omega=np.arange(5, 130, 0.25) * HERTZ))
    for given in (Free(), Free(3.0)):
        scaled = scale_modes(fit, DrivePoint(), free=given)
        assert np.allclose(scaled.rigid_shape, 3.0**-0.5, rtol=1e-4)
        assert scaled.rigid_participation == pytest.approx(3.0**-0.5, rel=1e-4)
    notes = scale_modes(fit, DrivePoint()).notes
    (note,) = (note for note in notes if note.kind == "low_residual_of_free_mass")
    assert note["mass_kg"] == pytest.approx(3, rel=1e-3)
    omega = np.array([20.0, 60.0]) * HERTZ
    modes = scale_modes(fit, DrivePoint(), free=Free()).linear_modes()
    velocity = np.asarray(linear_response(modes, omega, np.ones(2)))
    assert np.allclose(velocity.T, 1j * omega * receptance(free, omega, 0), rtol=1e-4)
    with pytest.raises(ValueError, match="low residual"):
        scale_modes(FIT, DrivePoint(), free=Free())


def states(curve, levels=(1.0, 3.0), rng=None):
    """Stepped sines whose stiffness follows curve × amplitude, and noise of 0.1 %."""
    omega = np.linspace(20, 22, 41) * HERTZ
    own = STRUCTURE.natural_frequency[0]
    rows = []
    for number, force in enumerate(levels, start=1):
        for w in omega:
            velocity = 0j
            for _ in range(80):
                shifted = own * (1 + curve * abs(velocity))
                velocity = 0.5 * velocity + 0.5 * (
                    1j * w * SHAPES[0, 0] ** 2 * force / (shifted**2 - w**2 + 0.02j * own * w)
                )
            rows.append((number, w, force, velocity))
    level, frequency, force, velocity = (np.array(column) for column in zip(*rows, strict=True))
    rng = np.random.default_rng(0)
    noise = rng.normal(size=velocity.shape) + 1j * rng.normal(size=velocity.shape)
    velocity = velocity * (1 + 1e-3 * noise)
    return steady_states(
        level=level,
        frequency=frequency,
        force=force,
        velocity=velocity[:, None],
        sensors=("tip",),
        velocity_std=1e-3 * np.abs(velocity)[:, None],
        phase_std=np.full((len(level), 1), 1e-3),
    )


def test_the_lowest_level_of_steady_states():
    data = states(0.0)
    assert levels_by_velocity(data) == [1, 2]
    modes, notes = find_modes(data)
    assert modes.source == "stated"
    assert modes.n_modes == 1
    assert abs(modes.natural_frequency[0] - STRUCTURE.natural_frequency[0]) < (
        4 * modes.natural_frequency_std[0]
    )
    assert notes[0].kind == "levels_agree"
    scaled = scale_modes(modes, DrivePoint("tip"))
    assert scaled.shape[0, 0] == pytest.approx(SHAPES[0, 0], rel=5e-3)


def test_an_amplitude_dependence_is_fitted_with_both_levels():
    # Hardening with the amplitude: 2 % of the frequency for each m/s.
    own, data = STRUCTURE.natural_frequency[0], states(0.02)
    modes, notes = find_modes(data)
    (note,) = notes
    assert (note.kind, note["mode"], note["power"]) == ("amplitude_dependent_mode", 1, 1)
    assert note["levels"] == (1, 2)
    largest = np.abs(np.asarray(data.velocity)).max()
    assert note["shift_hz"] == pytest.approx(own * 0.02 * largest / HERTZ, rel=0.03)
    assert note["bandwidths"] == pytest.approx(0.02 * largest / 0.02, rel=0.03)
    assert abs(modes.natural_frequency[0] - own) < 3 * modes.natural_frequency_std[0]
    alone = fit_linear_modes(responses_of_states(data, 1).responses)
    assert abs(alone.natural_frequency[0] - own) > 3 * alone.natural_frequency_std[0]


BAD = [
    ("negative", lambda: scale_modes(FIT, DrivePoint("s1", turned=True))),
    ("no sensor 'x'", lambda: scale_modes(FIT, DrivePoint("x"))),
    ("must be positive", lambda: scale_modes(FIT, AddedMassTest(FIT, "s1", 0.0))),
    ("must lower the frequency", lambda: scale_modes(FIT, AddedMassTest(FIT, "s1", 0.1))),
    ("must not be below zero", lambda: scale_modes(FIT, SensorMasses({"s1": -1.0}, 1.0))),
    ("must not all be zero", lambda: scale_modes(FIT, SensorMasses({"s1": 0.0}, 1.0))),
    ("must be positive", lambda: scale_modes(FIT, SensorMasses({"s1": 1.0}, 0.0))),
    ("must be negative", lambda: scale_modes(FIT, SensorMasses({"s1": 1.0}, 1.0))),
    ("finite and not zero", lambda: scale_modes(FIT, KnownShape("s1", 0.0))),
    (
        "are for a drive voltage",
        lambda: scale_modes(FIT, DrivePoint(), calibration=Calibration(2.0)),
    ),
    (
        "must not be below zero",
        lambda: scale_modes(FIT, DrivePoint(), calibration=Calibration(relative_std=-1.0)),
    ),
    ("free structure must be positive", lambda: scale_modes(FIT, DrivePoint(), free=Free(-2.0))),
    ("from 1 to 3", lambda: scale_modes(FIT, DrivePoint()).linear_modes(3)),
    (
        "one scale of the shapes",
        lambda: _requested_scale(ModesOptions(drive_point="s1", unscaled=True), None),
    ),
    ("needs its mass in kg", lambda: _requested_scale(ModesOptions(second_mass=0.1), None)),
    ("needs the masses at the sensors", lambda: scale_modes(FIT, SensorMasses({}, 1.0))),
    ("no level 7", lambda: responses_of_states(states(0.0), 7)),
]


@pytest.mark.parametrize(("message", "wrong"), BAD, ids=[f"{k} {b[0]}" for k, b in enumerate(BAD)])
def test_wrong_input_is_named(message, wrong):
    with pytest.raises(ValueError, match=message) as error:
        wrong()
    assert str(error.value).rstrip().endswith(".")
