"""Calibration through harmonic balance: truth from virtual tests, independent of the fit."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.stats import chi2

import snrmjax as sj
from snrmjax.identify.calibrate.calibration import calibrate_model
from snrmjax.identify.calibrate.inverse_force import inverse_force
from snrmjax.model.effects import make_effect
from snrmjax.model.modes import linear_response
from snrmjax.model.parameters import (
    parameter_names,
    parameter_value,
    with_parameters,
)

HERTZ = 2 * np.pi
ORDER = 5  # of tests and fits alike: both have the same truncation
DRAG = "quadratic_damping.coefficient"


def curved(*effects, **changes):
    model = sj.model.curved_beam()
    modes = dataclasses.replace(model.modes, **changes)
    return dataclasses.replace(model, modes=modes, effects=tuple(effects))


def curved_test(model, **settings):
    """Three levels, the response folds at the highest."""
    return sj.phase_resonance_test(
        model, (5e-5, 1.334e-4, 6.672e-4), 20 * HERTZ, 140 * HERTZ,
        appropriation=(0.5, 1.0), points_per_level=6, harmonic_order=ORDER, **settings,
    ).steady_states  # fmt: skip


@pytest.fixture(scope="module")
def exact():
    data = curved_test(curved())
    # Around the primary resonance: at superharmonic ones a fit from 30 % off finds other minima.
    assert data.n_states == 18
    assert float(data.frequency.min()) > 50 * HERTZ
    return data


def scaled(model, names, factor):
    start = np.array([float(parameter_value(model, name)) for name in names])
    return with_parameters(model, names, jnp.asarray(start * factor)), start


def noisy(data, seed, amplitude=0.01, phase=0.012, force=0.003):
    random = np.random.default_rng(seed)
    velocity = np.asarray(data.velocity)
    factor = 1 + amplitude * random.normal(size=velocity.shape)
    recorded = velocity * factor * np.exp(1j * phase * random.normal(size=velocity.shape))
    load = np.asarray(data.force)
    return dataclasses.replace(
        data,
        velocity=jnp.asarray(recorded),
        force=jnp.asarray(load * (1 + force * random.normal(size=load.shape))),
        velocity_std=jnp.asarray(amplitude * np.abs(recorded)),
        phase_std=jnp.full(velocity.shape, phase),
        force_std=jnp.asarray(force * load),
    )


def rows(data, index):
    return jax.tree.map(lambda a: a[jnp.asarray(index)], data)


# The force that a motion needs


def test_a_linear_structure_needs_the_force_of_its_closed_form():
    modes = sj.model.linear_modes(
        [500.0, 1300.0], [0.01, 0.02], [[2.0, 1.0], [0.5, -1.0]], [3.0, 1.0],
        rigid_body=sj.model.RigidBodyModes([[1.0], [0.7]], [2.0]),
    )  # fmt: skip
    omega = np.array([470.0, 500.0, 510.0])
    velocity = np.outer([0.3, 0.5j, 0.2 - 0.1j], [1.0, 1.0])
    data = sj.measure.steady_states([1] * 3, omega, [0.4] * 3, velocity, sensors=modes.sensors)
    fit = inverse_force(sj.model.structure(modes), data, harmonic_order=2)
    response = np.asarray(linear_response(modes, jnp.asarray(omega), jnp.ones(3)))
    # 1e-10: rounding of a system whose condition number is about 1e4.
    np.testing.assert_allclose(fit.force, velocity[:, 0] / response[:, 0], rtol=1e-10)
    other = response[:, 1] / response[:, 0] * velocity[:, 0]
    np.testing.assert_allclose(fit.velocity[:, 1, 1], other, rtol=1e-10)


@pytest.mark.long
def test_the_inverse_force_includes_the_instrument_errors():
    model = curved(
        make_effect("sensor_gain_error", {"gain": 0.05}),
        make_effect("sensor_phase_error", {"phase_deg": 3.0}),
        make_effect("force_offset_error", {"offset": 1e-5}),
        make_effect("force_harmonics", {"second": 0.05, "third": -0.03}),
        make_effect("frequency_drift", {"relative_drift": 0.01}),
        rigid_body_shape=jnp.array([[2.0]]),
        rigid_body_participation=jnp.array([30.0]),
    )
    data = curved_test(model, recording=sj.simulate.Recording(keep_harmonics=(2, 3)))
    fit = inverse_force(model, data, harmonic_order=ORDER)
    assert bool(fit.converged.all())
    # 1e-7: the tests' states are solved to 1e-10 of the displacement, of which the force at
    # resonance is a tenth or less.
    np.testing.assert_allclose(fit.force, data.force, rtol=1e-7)
    np.testing.assert_allclose(fit.velocity[:, 2:4, 0], data.harmonics[:, 0], rtol=1e-6)


@pytest.mark.long
def test_derivatives_of_the_inverse_force_are_those_of_central_differences(exact):
    model, names = curved(make_effect("quadratic_damping", {"coefficient": 0.5})), ("111", "1111")
    names = (*(f"potential.{key}" for key in names), "mode_1.damping_ratio", DRAG)
    _, start = scaled(model, names, 1.0)

    def parts(relative):
        changed = with_parameters(model, names, jnp.asarray(start) * (1 + relative))
        force = inverse_force(changed, exact, harmonic_order=ORDER).force / exact.force
        return jnp.stack([force.real, force.imag])

    zero, step = jnp.zeros(len(names)), 3e-5
    forward, backward = jax.jacfwd(parts)(zero), jax.jacrev(parts)(zero)
    differences = [(parts(step * row) - parts(-step * row)) / (2 * step) for row in np.eye(4)]
    # Third derivatives (of order 1e4 at the superharmonic) times 1e-9/6; rounding 1e-11/3e-5.
    np.testing.assert_allclose(forward, np.stack(differences, axis=-1), rtol=1e-6, atol=1e-5)
    np.testing.assert_allclose(forward, backward, rtol=1e-9, atol=1e-9)


def test_the_inverse_force_has_a_repr_a_table_and_a_plot(exact):
    fit = inverse_force(curved(), exact, harmonic_order=ORDER)
    n = exact.n_states
    assert repr(fit).startswith(f"InverseForce: {n} states")
    assert fit.to_xarray().force_re_n.attrs["units"] == "N"
    assert isinstance(fit.plot(), Figure)


@pytest.mark.long
def test_the_inverse_force_has_slopes_by_the_mode_shape():
    modes = sj.model.linear_modes([300.0], [0.01], [[2.0]], [3.0])
    data = sj.measure.steady_states([1, 1], [295.0, 305.0], [1.0, 1.0], [0.1 + 0.05j, 0.1 - 0.05j])

    def force(shape):
        changed = dataclasses.replace(modes, mode_shape=shape)
        return jnp.sum(inverse_force(sj.model.structure(changed), data).force.real)

    # A linear mode of half the shape has to move twice as far.
    slope = jax.grad(force)(modes.mode_shape)
    np.testing.assert_allclose(slope, -force(modes.mode_shape) / 2.0, rtol=1e-9)


# Parameters


def test_exact_data_of_the_flat_beam_give_its_dominant_coefficients():
    beam, forces = sj.model.flat_beam(), (4.448e-3, 1.334e-2)
    data = sj.phase_resonance_test(
        beam, forces, 60 * HERTZ, 120 * HERTZ, appropriation=(0.5, 1.0), points_per_level=6,
        harmonic_order=ORDER,
    ).steady_states  # fmt: skip
    names = ("potential.1111", "potential.1112", "mode_1.natural_frequency", "mode_1.damping_ratio")
    start, truth = scaled(beam, names, np.array([1.3, 0.7, 1.02, 0.8]))
    fit = calibrate_model(start, data, names, harmonic_order=ORDER)
    assert fit.converged
    assert fit.state_converged.all()
    # The states are exact to 1e-10; 1112 is a hundred times less certain than the noise.
    np.testing.assert_allclose(fit.values, truth, rtol=1e-6)
    assert fit.noise_scale < 1e-6
    assert fit.model.potential.coefficient_std[20] == fit.std[0]
    assert repr(fit).startswith("CalibratedModel: 4 parameters from 12 of 12 steady states")
    assert "potential.1111 = " in repr(fit)
    np.testing.assert_array_equal(fit.to_xarray().parameter, names)
    assert isinstance(fit.plot(), Figure)


@pytest.mark.long
def test_drag_is_fitted_from_zero_along_with_the_damping_of_the_mode():
    model = curved(make_effect("quadratic_damping", {"coefficient": 0.8}))
    names = (DRAG, "mode_1.damping_ratio", "potential.1111")
    start, truth = scaled(model, names, np.array([0.0, 1.2, 1.1]))
    fit = calibrate_model(start, curved_test(model), names, harmonic_order=ORDER)
    assert fit.converged
    np.testing.assert_allclose(fit.values, truth, rtol=1e-6)  # of states exact to 1e-10


NAMES = ("potential.1111", "mode_1.damping_ratio")


@pytest.mark.long
def test_errors_are_as_large_as_stated(exact):
    start, truth = scaled(curved(), NAMES, np.array([1.3, 0.7]))
    fits = [
        calibrate_model(start, noisy(exact, seed), NAMES, harmonic_order=ORDER)
        for seed in range(30)
    ]
    distance = sum(
        (f.values - truth) @ np.linalg.solve(f.covariance, f.values - truth) for f in fits
    )
    low, high = chi2.ppf([0.001, 0.999], 30 * len(NAMES))
    assert low < distance < high
    freedom = 2 * exact.n_states - len(NAMES)
    low, high = chi2.ppf([0.001, 0.999], 30 * freedom)
    assert low < freedom * sum(f.reduced_chi_square for f in fits) < high


@pytest.mark.long
def test_the_order_of_rows_does_not_matter(exact):
    start, _ = scaled(curved(), NAMES, np.array([1.1, 0.9]))
    data = noisy(exact, 3)
    permutation = np.random.default_rng(0).permutation(data.n_states)
    first = calibrate_model(start, data, NAMES, harmonic_order=ORDER)
    second = calibrate_model(start, rows(data, permutation), NAMES, harmonic_order=ORDER)
    # The solver stops within 1e-8 of 1σ, which is 1 % of the values.
    np.testing.assert_allclose(second.values, first.values, rtol=1e-8)
    np.testing.assert_allclose(second.covariance, first.covariance, rtol=1e-6)
    np.testing.assert_allclose(second.residuals, first.residuals[permutation], atol=1e-6)


@pytest.mark.long
def test_errors_common_to_a_level_are_fitted(exact):
    gain = np.array([0.03, -0.02, 0.01])
    phase = np.array([-0.02, 0.01, 0.03])
    level = np.unique(np.asarray(exact.level), return_inverse=True)[1]
    factor = (np.exp(gain) * np.exp(1j * phase))[level, None]
    data = noisy(exact, 0, 0.0, 0.0, 0.0)
    data = dataclasses.replace(
        data,
        velocity=data.velocity * factor,
        velocity_std=1e-4 * jnp.abs(data.velocity),
        phase_std=jnp.full(data.velocity.shape, 1e-4),
    )
    fit = calibrate_model(
        scaled(curved(), NAMES[1:], 1.2)[0], data, NAMES[1:], harmonic_order=ORDER,
        level_gain_std=0.03, level_phase_std=0.03,
    )  # fmt: skip
    # Bias by the prior: (error over 1σ)², 1e-5, times ten for what damping leaves undetermined.
    np.testing.assert_allclose(fit.level_gain, gain, atol=1e-5)
    np.testing.assert_allclose(fit.level_phase, phase, atol=1e-5)
    without = calibrate_model(curved(), data, NAMES[1:], harmonic_order=ORDER)
    assert without.noise_scale > 10
    assert without.notes[-1].kind == "calibration_noise"


@pytest.mark.long
def test_a_prior_weighs_by_its_std(exact):
    start, _ = scaled(curved(), NAMES[1:], 0.998)
    data = noisy(exact, 1)
    free = calibrate_model(start, data, NAMES[1:], harmonic_order=ORDER)
    std = jnp.asarray(free.std)
    with_prior = dataclasses.replace(
        start, modes=dataclasses.replace(start.modes, damping_ratio_std=std)
    )
    fit = calibrate_model(with_prior, data, NAMES[1:], harmonic_order=ORDER, priors=True)
    middle = 0.5 * (free.values[0] + 0.998 * 0.05)
    # The force is nearly linear in damping: the rest is whitening at other parameters.
    np.testing.assert_allclose(fit.values[0], middle, atol=0.02 * free.std[0])
    np.testing.assert_allclose(fit.std[0], free.std[0] / np.sqrt(2), rtol=0.01)


@pytest.mark.long
def test_other_sensors_and_harmonics_are_weighted_by_their_errors():
    modes = sj.model.linear_modes(
        [400.0, 2500.0], [0.03, 0.01], [[2.0, 1.0], [5.0, -3.0]], [100.0, 20.0]
    )
    potential = sj.model.polynomial_potential({"1111": 5e9, "1112": 4e9, "111": 1e6}, 2)
    model = sj.model.structure(modes, potential)
    errors = sj.simulate.MeasurementErrors(amplitude=0.01, phase=0.01, force=0.003, harmonic=2e-4)
    names = ("potential.1111", "potential.111")
    chi, distance, freedom = 0.0, 0.0, 0
    for seed in range(4):
        data = sj.phase_resonance_test(
            model, (0.02, 0.1), 250.0, 700.0, harmonic_order=ORDER, points_per_level=6,
            appropriation=(0.5, 1.0), recording=sj.simulate.Recording(errors, seed, (2, 3)),
        ).steady_states  # fmt: skip
        start, truth = scaled(model, names, np.array([1.2, 0.8]))
        fit = calibrate_model(start, data, names, harmonic_order=ORDER)
        columns = int(np.isfinite(fit.residuals).sum())
        assert columns == data.n_states * 2 * (1 + 1 + 4)
        chi += fit.reduced_chi_square * (columns - 2)
        freedom += columns - 2
        error = fit.values - truth
        distance += error @ np.linalg.solve(fit.covariance, error)
    low, high = chi2.ppf([0.001, 0.999], freedom)
    assert low < chi < high
    assert distance < chi2.ppf(0.999, 8)


@pytest.mark.long
def test_a_state_without_a_balanced_motion_has_no_weight(exact):
    # At 1e150 m/s the restoring force overflows.
    velocity = exact.velocity.at[4].set(1e150)
    data = dataclasses.replace(exact, velocity=velocity)
    start, truth = scaled(curved(), NAMES, 1.1)
    fit = calibrate_model(start, data, NAMES, harmonic_order=ORDER)
    assert np.flatnonzero(~fit.state_converged).tolist() == [4]
    assert any(note.get("states") == (4,) for note in fit.notes)
    assert np.isnan(fit.residuals[4]).all()
    np.testing.assert_allclose(fit.values, truth, rtol=1e-6)  # as above


def test_names_of_all_parameters_of_a_model():
    twice = make_effect("quadratic_damping", {"coefficient": 0.8})
    names = parameter_names(curved(twice, twice))
    assert names == (
        *("potential.111", "potential.1111", "mode_1.natural_frequency"),
        *("mode_1.damping_ratio", "mode_1.participation"),
        *(DRAG, "quadratic_damping_2.coefficient"),
    )
    changed = with_parameters(curved(twice, twice), names, jnp.arange(7.0))
    assert [float(parameter_value(changed, name)) for name in names] == [*range(7)]


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["potential.112"], "similar ones are.*potential.1111"),
        (["mode_1.damping"], "similar ones are mode_1.damping_ratio"),
        (["quadratic_damping.coefficient"], "does not have"),
        (["potential.111", "potential.111"], "twice"),
        ([], "sequence of names"),
        ("potential.111", "sequence of names"),
    ],
)
def test_wrong_names_are_refused(exact, names, message):
    with pytest.raises(ValueError, match=message):
        calibrate_model(curved(), exact, names)


def test_insufficient_data_are_refused(exact):
    with pytest.raises(ValueError, match="2 parameters need more than 2 data"):
        calibrate_model(curved(), rows(exact, [0]), NAMES)
    with pytest.raises(ValueError, match="sensors"):
        calibrate_model(sj.model.flat_beam(), dataclasses.replace(exact, sensors=("a",)), NAMES)
    nothing = jnp.full(exact.n_states, jnp.nan)
    unknown = dataclasses.replace(exact, force=nothing, drive=jnp.ones(exact.n_states))
    with pytest.raises(ValueError, match="needs the force in newtons"):
        calibrate_model(curved(), unknown, NAMES)
    with pytest.raises(ValueError, match="level_gain_std"):
        calibrate_model(curved(), exact, NAMES, level_gain_std=-0.1)
