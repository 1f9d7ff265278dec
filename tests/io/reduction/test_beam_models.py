"""Geometry → modes → load cases → model → backbone and response: derivatives and calibration."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import snrmjax as sj
from snrmjax.numerics.units import HERTZ

pytestmark = pytest.mark.long

ARCH = """name = "arch"
[material]
young_pa = 204.8e9
density_kg_m3 = 7870.0
[section]
width_m = 0.0127
thickness_m = 0.000508
[geometry]
length_m = 0.2286
rise_m = 0.0004
elements = 20
[supports]
left = "clamped"
right = { axial_n_m = 1e7, transverse_n_m = inf, rotation_nm_rad = 5.0 }
[condense]
modes = [1, 3]
load_scale = 0.3
damping_ratio = 0.01
[[point_mass]]
at = 0.3
mass_kg = 1e-3
"""
STEP = 1e-3  # relative, of the differences
VARIED = (
    *("section.thickness_m", "material.young_pa", "geometry.length_m"),
    *("supports.right.axial_n_m", "supports.right.rotation_nm_rad", "point_mass_1.mass_kg"),
)


def models_in(folder, text):
    (folder / "beam.toml").write_text(text)
    return sj.io.read_beam_models(folder / "beam.toml")


def differences(outputs, n_parameters):
    """Central differences of the whole chain by relative changes, of sixth order."""
    weights = {1: 45 / 60, 2: -9 / 60, 3: 1 / 60}
    each = []
    for one in np.eye(n_parameters):
        parts = [
            w * (np.asarray(outputs(k * STEP * one)) - np.asarray(outputs(-k * STEP * one)))
            for k, w in weights.items()
        ]
        each.append(sum(parts) / STEP)
    return np.array(each).T


@pytest.mark.parametrize("shape", ["geometry.rise_m", "geometry.radius_m"])
def test_derivatives_of_mode_and_peak_are_differences_of_the_whole_chain(tmp_path, shape):
    text = ARCH if shape.endswith("rise_m") else ARCH.replace("rise_m = 0.0004", "radius_m = 16.3")
    models = models_in(tmp_path, text)
    names = (*VARIED, shape)
    middle = np.array([models.parameters[name] for name in names])

    def peak_of(model):
        curve = sj.forced_response(model, [0.02], 30 * HERTZ, 120 * HERTZ, harmonic_order=5)[0]
        height = np.abs(curve.velocity[:, 1, 0])
        return curve.point(max(curve.at_events("peak"), key=lambda k: height[k]))

    nominal = peak_of(models({}))

    def outputs(change):
        traced = isinstance(change, jax.core.Tracer)
        values = middle * (1 + change)
        model = models(dict(zip(names, values if traced else values.tolist(), strict=True)))
        mode = sj.simulate.normal_mode_at_velocities(model, [0.05, 0.2], harmonic_order=5)
        # Start from the model's own curve, since Newton's method may converge to another peak.
        start = nominal if traced else peak_of(model)
        peak = sj.simulate.periodic_motion(model, 0.02, start, condition="peak")
        return jnp.stack([*mode.frequency, peak.frequency, peak.amplitude])

    forward = np.asarray(jax.jit(jax.jacfwd(outputs))(jnp.zeros(len(names))))
    backward = np.asarray(jax.jit(jax.jacrev(outputs))(jnp.zeros(len(names))))
    expected = differences(outputs, len(names))
    error = np.abs(forward - expected) / np.abs(expected)
    np.testing.assert_allclose(backward, forward, rtol=1e-6)
    # Rounding of load cases (1e-10 of a coefficient) over steps of 1e-3; the order of the
    # differences leaves less.
    assert np.max(error) < 1e-6, error


SPRUNG = """name = "flat beam"
[material]
young_pa = 204.8e9
density_kg_m3 = 7870.0
[section]
width_m = 0.0127
thickness_m = 0.000787
[geometry]
length_m = 0.2286
elements = 20
[supports]
left = { axial_n_m = inf, transverse_n_m = inf, rotation_nm_rad = 20 }
right = { axial_n_m = inf, transverse_n_m = inf, rotation_nm_rad = 20 }
[condense]
modes = [1]
load_scale = 0.3
degree = 5
"""
TRUTH = {"thickness_m": 0.8e-3, "rotation_nm_rad": 30.0}
START = {"thickness_m": 0.75e-3, "rotation_nm_rad": 20.0}
VELOCITY = np.linspace(0.05, 0.8, 12)


def test_thickness_and_supports_of_a_beam_come_back_from_its_backbone(tmp_path):
    """From the true beam's computed backbone with noise: values and coverage of their bands."""
    models = models_in(tmp_path, SPRUNG)

    def model_of(values):
        both = {f"supports.{side}.rotation_nm_rad": values["rotation_nm_rad"] for side in SIDES}
        return models({"section.thickness_m": values["thickness_m"], **both})

    # The truth by continuation of the mode, which the fit does not use.
    mode = sj.nonlinear_normal_mode(model_of(TRUTH), 130 * HERTZ, harmonic_order=5)
    speed = np.abs(mode.velocity[:, 1, 0])
    clean = np.array([np.interp(v, speed, mode.frequency) for v in VELOCITY])
    std, noise = 2e-4 * clean, np.random.default_rng(0)
    inside, scores = np.zeros(2), []
    truth = np.array(list(TRUTH.values()))
    for _ in range(SEEDS):
        points = sj.identify.MeasuredBackbone(VELOCITY, clean + noise.normal(size=12) * std, std)
        fit = sj.identify.calibrate_to_backbone(model_of, START, points)
        assert fit.converged
        scores.append((fit.values - truth) / fit.std)
        inside += np.abs(scores[-1]) < 1.959964
    # Binomial 95 % ± 3σ of 120 seeds: 0.89 to 1; the mean is within 3/√120 of zero.
    assert np.all(inside / SEEDS > 0.89)
    assert np.all(np.abs(np.mean(scores, axis=0)) < 3 / np.sqrt(SEEDS))
    np.testing.assert_allclose(fit.values, truth, rtol=0.05)


SIDES, SEEDS = ("left", "right"), 120


def test_a_softening_backbone_identifies_the_rise_too(tmp_path):
    models = models_in(tmp_path, ARCH.replace("[1, 3]", "[1]\ndegree = 5"))
    truth = {
        "material.young_pa": 195e9,
        "geometry.rise_m": 5e-4,
        "supports.right.rotation_nm_rad": 8.0,
    }
    velocity = np.linspace(0.005, 0.6, 24)  # softening to 57 Hz, then hardening to 74 Hz
    clean = sj.simulate.normal_mode_at_velocities(models(truth), velocity, harmonic_order=5)
    assert clean.converged.all()
    std = 1e-4 * np.asarray(clean.frequency)
    noise = np.random.default_rng(1).normal(size=24) * std
    points = sj.identify.MeasuredBackbone(velocity, np.asarray(clean.frequency) + noise, std)
    start = {name: models.parameters[name] for name in truth}
    fit = sj.identify.calibrate_to_backbone(models, start, points)
    assert fit.converged
    assert np.all(np.abs(fit.values - list(truth.values())) < 4 * fit.std)
