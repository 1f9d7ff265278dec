"""Force calibration against the paper's lines, numpy, scipy and statistics."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.stats

import snrmjax  # noqa: F401
from snrmjax.measure.force_calibration import apply_calibration, calibrate_force
from snrmjax.measure.force_on_mode import ForceStatus, equivalent_force
from snrmjax.measure.states import steady_states
from snrmjax.model.modes import LinearModesStd, RigidBodyModes, linear_modes

# The paper's section 4.1: drives in V, forces in N, gain in N/V, offset in N.
CURVED = ([0.01, 0.02, 0.03], [1.9138e-4, 4.6678e-4, 7.3752e-4], 2.730673e-2, -8.090884e-5)
FLAT = (
    [0.02, 0.03, 0.04, 0.05, 0.06],
    [2.5507e-4, 4.5867e-4, 6.6454e-4, 8.5029e-4, 10.8047e-4],
    2.042420e-2,
    -1.551595e-4,
)

# The paper's curved printed beam (Tab. 6), seen at two points, on a moving backing.
OMEGA_J, ZETA_J = 2 * np.pi * 153.2144, 0.0138
SHAPE = np.array([[30.0, -25.0], [20.0, 12.0]])
PARTICIPATION = np.array([9.0, -4.0])
MODES = linear_modes(
    [OMEGA_J, 2 * np.pi * 592.602],
    [ZETA_J, 0.0195],
    SHAPE,
    PARTICIPATION,
    sensors=("center", "quarter"),
    rigid_body=RigidBodyModes([[2.7], [2.7]], [2.7]),
    std=LinearModesStd(damping_ratio=[2e-4, 1e-3]),
)
SWEEP = 2 * np.pi * np.linspace(145.0, 160.0, 21)


def response(force, omega, natural=OMEGA_J, damping=ZETA_J, turn=0.0):
    """Eq. (23) in plain numpy, turned to a cosine force: velocity (state, sensor)."""
    total = -1j * 2.7 * 2.7 / omega[:, None] * np.ones(2)
    for k, (w, z) in enumerate(((natural, damping), (2 * np.pi * 592.602, 0.0195))):
        modal = 1j * omega * PARTICIPATION[k] / (w**2 - omega**2 + 2j * z * w * omega)
        total = total + modal[:, None] * SHAPE[:, k]
    return force * np.exp(1j * turn) * total


def low_level_test(forces=CURVED[1], drives=CURVED[0], shifts=(0.0, -3.0, -7.0), noise=None, **kw):
    """Sweeps at several levels, each with its own shift of the natural frequency in rad/s."""
    velocity = np.concatenate(
        [response(f, SWEEP, OMEGA_J + s, **kw) for f, s in zip(forces, shifts, strict=True)]
    )
    level = np.repeat(np.arange(1, len(forces) + 1), SWEEP.size)
    stated = {}
    if noise is not None:
        rng, gain_std, phase_std = noise
        shape = (2, *velocity.shape)
        gain, phase = np.array([gain_std, phase_std])[:, None, None] * rng.standard_normal(shape)
        stated = {
            "velocity_std": gain_std * np.abs(velocity),
            "phase_std": np.full(velocity.shape, phase_std),
        }
        velocity = velocity * (1 + gain) * np.exp(1j * phase)
    return steady_states(
        level,
        np.tile(SWEEP, len(forces)),
        np.full(level.size, np.nan),
        velocity,
        drive=np.asarray(drives)[level - 1],
        sensors=("center", "quarter"),
        **stated,
    )


def select(data, rows):
    """Some of the states of a table."""
    return jax.tree.map(lambda leaf: leaf[np.asarray(rows)], data)


class TestEquivalentForce:
    def test_recovers_the_papers_forces_and_line(self):
        found = equivalent_force(low_level_test(), MODES)
        assert not found.status.any()
        # The solver's tolerance, 1e-8 of the force and of the half-power band.
        np.testing.assert_allclose(found.force, CURVED[1], rtol=1e-8)
        np.testing.assert_allclose(
            found.natural_frequency, OMEGA_J - np.array([0, 3, 7]), rtol=1e-9
        )
        np.testing.assert_allclose(found.drive, CURVED[0])
        assert found.level.tolist() == [1, 2, 3]
        assert not found.damping_ratio_std.any()
        line = calibrate_force(found.drive, found.force)
        np.testing.assert_allclose(line.gain, CURVED[2], rtol=2e-5)  # printed digits, see below
        np.testing.assert_allclose(line.offset, CURVED[3], rtol=2e-4)

    def test_adjusts_damping_and_phase(self):
        data = low_level_test(damping=0.02, turn=0.3)
        found = equivalent_force(
            data, MODES, adjust=("natural_frequency", "damping_ratio", "phase")
        )
        assert not found.status.any()
        np.testing.assert_allclose(found.force, CURVED[1], rtol=1e-8)  # the solver's tolerance
        np.testing.assert_allclose(found.damping_ratio, 0.02, rtol=1e-8)
        np.testing.assert_allclose(found.phase, 0.3, atol=1e-8)
        held = equivalent_force(data, MODES)
        assert np.all(held.misfit > 1e3 * found.misfit)

    def test_nothing_adjusted_is_linear_regression(self):
        rng = np.random.default_rng(0)
        data = low_level_test()
        noisy = data.velocity + 1e-5 * (
            rng.standard_normal((63, 2)) + 1j * rng.standard_normal((63, 2))
        )
        data = dataclasses.replace(data, velocity=noisy)
        modes = dataclasses.replace(MODES, damping_ratio_std=jnp.zeros(2))
        found = equivalent_force(data, modes, adjust=())
        for k in range(3):
            measured = np.asarray(noisy[21 * k : 21 * k + 21]).ravel()
            unit = response(1.0, SWEEP).ravel()
            design = np.concatenate([unit.real, unit.imag])[:, None]
            values = np.concatenate([measured.real, measured.imag])
            force, squares, _, _ = np.linalg.lstsq(design, values, rcond=None)
            np.testing.assert_allclose(found.force[k], force[0], rtol=1e-8)
            variance = squares[0] / (values.size - 1)
            np.testing.assert_allclose(found.misfit[k], np.sqrt(variance), rtol=1e-6)
            np.testing.assert_allclose(
                found.force_std[k], np.sqrt(variance / (design[:, 0] @ design[:, 0])), rtol=1e-6
            )

    def test_agrees_with_scipy(self):
        data = low_level_test(noise=(np.random.default_rng(1), 0.02, 0.02))
        found = equivalent_force(
            data, MODES, adjust=("natural_frequency", "damping_ratio", "phase")
        )
        velocity = np.asarray(data.velocity)[21:42]
        along = np.asarray(data.velocity_std)[21:42]
        across = 0.02 * np.abs(velocity)

        def residual(x):
            error = response(1e-4 * x[0], SWEEP, OMEGA_J * x[1], 0.01 * x[2], x[3]) - velocity
            error = error * np.exp(-1j * np.angle(velocity))
            return np.concatenate([(error.real / along).ravel(), (error.imag / across).ravel()])

        best = scipy.optimize.least_squares(
            residual, [4.0, 1.0, 1.4, 0.0], x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14
        )
        misfit = np.sqrt(2 * best.cost / (2 * velocity.size - 4))
        std = np.sqrt(np.diag(np.linalg.inv(best.jac.T @ best.jac))) * max(misfit, 1.0)
        # The solver stops at steps of 1e-6; it converges faster than linearly, which leaves less.
        # scipy's Jacobian is a finite difference, good to 1e-7.
        np.testing.assert_allclose(found.force[1], 1e-4 * best.x[0], rtol=1e-6)
        np.testing.assert_allclose(found.natural_frequency[1], OMEGA_J * best.x[1], rtol=1e-8)
        np.testing.assert_allclose(found.damping_ratio[1], 0.01 * best.x[2], rtol=1e-6)
        np.testing.assert_allclose(found.phase[1], best.x[3], atol=1e-6)
        np.testing.assert_allclose(found.force_std[1], 1e-4 * std[0], rtol=1e-5)
        np.testing.assert_allclose(found.natural_frequency_std[1], OMEGA_J * std[1], rtol=1e-5)
        np.testing.assert_allclose(found.damping_ratio_std[1], 0.01 * std[2], rtol=1e-5)
        np.testing.assert_allclose(found.phase_std[1], std[3], rtol=1e-5)
        np.testing.assert_allclose(found.misfit[1], misfit, rtol=1e-8)

    def test_stated_errors_that_are_too_small_are_enlarged(self):
        data = low_level_test(noise=(np.random.default_rng(6), 0.02, 0.02))
        modes = dataclasses.replace(MODES, damping_ratio_std=jnp.zeros(2))
        honest = equivalent_force(data, modes)
        bold = dataclasses.replace(
            data, velocity_std=0.01 * data.velocity_std, phase_std=0.01 * data.phase_std
        )
        found = equivalent_force(bold, modes)
        np.testing.assert_allclose(found.misfit, 100 * honest.misfit, rtol=1e-6)
        expected = honest.force_std * honest.misfit / np.maximum(honest.misfit, 1.0)
        np.testing.assert_allclose(found.force_std, expected, rtol=1e-5)

    @pytest.mark.parametrize("stated", [True, pytest.param(False, marks=pytest.mark.long)])
    def test_stated_standard_deviations_cover(self, stated):
        # 134 tests of three levels: 402 scores scatter by 3.5 %.
        rng, scores = np.random.default_rng(2), []
        modes = dataclasses.replace(MODES, damping_ratio_std=jnp.zeros(2))
        for _ in range(134):
            if stated:
                data = low_level_test(noise=(rng, 0.03, 0.03))
            else:
                data = low_level_test()
                noise = rng.standard_normal((2, *data.velocity.shape))
                data = dataclasses.replace(
                    data, velocity=data.velocity + 2e-4 * (noise[0] + 1j * noise[1])
                )
            found = equivalent_force(data, modes)
            scores.append((found.force - np.array(CURVED[1])) / found.force_std)
            scores.append(
                (found.natural_frequency - OMEGA_J + np.array([0, 3, 7]))
                / found.natural_frequency_std
            )
        spread = np.std(np.array(scores).reshape(-1, 2, 3), axis=(0, 2))
        np.testing.assert_allclose(spread, 1.0, rtol=0.1)

    def test_damping_of_the_linear_test_is_a_shared_error(self):
        data = low_level_test()
        found = equivalent_force(data, MODES)
        step = 1e-5
        ahead, behind = (
            equivalent_force(
                data,
                dataclasses.replace(MODES, damping_ratio=MODES.damping_ratio.at[0].add(s)),
            ).force
            for s in (step, -step)
        )
        shared = np.asarray(ahead - behind) / (2 * step) * 2e-4
        # The first-order sensitivity leaves out the residual's curvature, none without noise;
        # central differences: the solver's 1e-8 over the step's 1e-3.
        np.testing.assert_allclose(found.force_covariance, np.outer(shared, shared), rtol=1e-3)
        # F is proportional to the damping at the peak and does not feel it on the flanks: a gain
        # error, the same at all levels (their shifts move the sweep by 5 % of its width).
        ratio = shared / np.array(CURVED[1]) / (2e-4 / ZETA_J)
        np.testing.assert_allclose(ratio, ratio[0], rtol=0.05)
        assert 0 < ratio[0] < 1

    def test_invariance_to_order_of_rows_and_sensors(self):
        data = low_level_test(noise=(np.random.default_rng(3), 0.02, 0.02))
        found = equivalent_force(data, MODES)
        shuffled = select(data, np.random.default_rng(4).permutation(63))
        other = equivalent_force(shuffled, MODES)
        np.testing.assert_allclose(other.force, found.force, rtol=1e-8)  # the solver's tolerance
        np.testing.assert_allclose(other.force_std, found.force_std, rtol=1e-6)
        turned = jax.tree.map(lambda leaf: leaf[:, ::-1] if leaf.shape[1:] == (2,) else leaf, data)
        turned = dataclasses.replace(turned, sensors=("quarter", "center"))
        np.testing.assert_allclose(
            equivalent_force(turned, MODES, adjust=()).force,
            equivalent_force(data, MODES, adjust=()).force,
            rtol=1e-12,
        )

    def test_unmeasured_sensor_is_left_out(self):
        data = low_level_test()
        measured = np.ones((63, 2), dtype=bool)
        measured[::3, 1] = False
        blind = dataclasses.replace(
            data,
            measured=jnp.asarray(measured),
            velocity=jnp.where(measured, data.velocity, 0.0),
        )
        np.testing.assert_allclose(equivalent_force(blind, MODES).force, CURVED[1], rtol=1e-8)

    def test_failures_have_a_status_and_leave_the_others_alone(self):
        data = low_level_test()
        # Level 1 keeps no measured sensor, level 2 is upside down, level 3 is as it should be.
        level = np.asarray(data.level)
        bad = dataclasses.replace(
            data,
            measured=jnp.asarray((level != 1)[:, None] & np.ones((1, 2), dtype=bool)),
            velocity=jnp.where(jnp.asarray(level == 2)[:, None], -data.velocity, data.velocity),
        )
        found = equivalent_force(bad, MODES)
        assert found.status.tolist() == [ForceStatus.TOO_FEW, ForceStatus.NEGATIVE, 0]
        assert np.isnan(found.force[:2]).all()
        assert np.isnan(found.natural_frequency_std[:2]).all()
        assert np.isnan(found.force_covariance[:2]).all()
        np.testing.assert_allclose(found.force[2], CURVED[1][2], rtol=1e-8)

    def test_as_many_numbers_as_unknowns_and_fewer(self):
        data = low_level_test()
        measured = np.zeros((63, 2), dtype=bool)
        measured[5, 0] = measured[26] = True  # one state: one sensor in level 1, two in level 2
        single = dataclasses.replace(data, measured=jnp.asarray(measured))
        found = equivalent_force(single, MODES)
        assert found.status.tolist() == [0, 0, ForceStatus.TOO_FEW]
        # Two numbers give two unknowns, but no error.
        assert np.isnan(found.force_std[0])
        np.testing.assert_allclose(found.force[:2], CURVED[1][:2], rtol=1e-6)
        all_free = ("natural_frequency", "damping_ratio", "phase")
        few = equivalent_force(single, MODES, adjust=all_free)
        assert few.status[0] == ForceStatus.TOO_FEW

    def test_a_response_that_does_not_fit_is_refused(self):
        # A velocity that grows with Ω² over three decades: no resonance of the model in sight.
        omega = np.tile(np.geomspace(1.0, 1e3, 21), 3)
        velocity = 1j * omega[:, None] ** 2 * np.ones((63, 2))
        data = dataclasses.replace(
            low_level_test(), frequency=jnp.asarray(omega), velocity=jnp.asarray(velocity)
        )
        found = equivalent_force(data, MODES)
        refused = (ForceStatus.NOT_CONVERGED, ForceStatus.NEGATIVE)
        assert np.isin(found.status, refused).all()
        assert np.isnan(found.force).all()

    def test_wrong_arguments(self):
        data = low_level_test()
        with pytest.raises(ValueError, match=r"`adjust` must name some of .* but names 'mass'"):
            equivalent_force(data, MODES, adjust=("mass",))
        with pytest.raises(ValueError, match=r"`data` has sensor 'tip', but `modes` has only"):
            equivalent_force(dataclasses.replace(data, sensors=("center", "tip")), MODES)
        wrong = dataclasses.replace(data, drive=data.drive.at[25].set(0.5))
        with pytest.raises(ValueError, match=r"level 2 has 0.02 V and 0.5 V"):
            equivalent_force(wrong, MODES)


class TestCalibrateForce:
    @pytest.mark.parametrize("beam", [CURVED, FLAT], ids=["curved", "flat"])
    def test_the_papers_lines(self, beam):
        drive, force, gain, offset = beam
        line = calibrate_force(drive, force)
        # The forces are printed to 5e-9 N; that moves gain and offset by at most Σ|weight| · 5e-9.
        design = np.stack([drive, np.ones(len(drive))], axis=1)
        gain_error, offset_error = 5e-9 * np.abs(np.linalg.pinv(design)).sum(axis=1)
        np.testing.assert_allclose(line.gain, gain, rtol=0, atol=gain_error + 5e-9)
        np.testing.assert_allclose(line.offset, offset, rtol=0, atol=offset_error + 5e-12)

    def test_agrees_with_scipy_linregress(self):
        drive, force = FLAT[:2]
        line = calibrate_force(drive, force)
        reference = scipy.stats.linregress(drive, force)
        # Rounding times the condition number of about 5.
        np.testing.assert_allclose(line.gain, reference.slope, rtol=1e-12)
        np.testing.assert_allclose(line.offset, reference.intercept, rtol=1e-12)
        np.testing.assert_allclose(np.sqrt(line.covariance[0, 0]), reference.stderr, rtol=1e-10)
        np.testing.assert_allclose(
            np.sqrt(line.covariance[1, 1]), reference.intercept_stderr, rtol=1e-10
        )
        residual = np.asarray(force) - line.force(np.asarray(drive))
        np.testing.assert_allclose(line.residual_std, np.sqrt(np.sum(residual**2) / 3), rtol=1e-12)
        assert np.isnan(line.misfit)

    def test_stated_errors_agree_with_numpy(self):
        drive, force = (np.asarray(x) for x in FLAT[:2])
        std = force * np.array([0.05, 0.02, 0.03, 0.01, 0.04])
        line = calibrate_force(drive, force, std)
        expected, covariance = np.polyfit(drive, force, 1, w=1 / std, cov="unscaled")
        np.testing.assert_allclose([line.gain, line.offset], expected, rtol=1e-11)
        np.testing.assert_allclose(line.covariance, covariance, rtol=1e-10)
        chi_square = np.sum(((force - np.polyval(expected, drive)) / std) ** 2)
        np.testing.assert_allclose(line.misfit, np.sqrt(chi_square / 3), rtol=1e-10)
        at = np.array([0.01, 0.1])
        row = np.stack([at, np.ones(2)], axis=1)
        np.testing.assert_allclose(line.force(at), np.polyval(expected, at), rtol=1e-11)
        np.testing.assert_allclose(line.force_covariance(at), row @ covariance @ row.T, rtol=1e-9)
        np.testing.assert_allclose(
            line.force_std(at) ** 2, np.diag(line.force_covariance(at)), rtol=1e-12
        )

    def test_shared_errors(self):
        # An error common to all forces in proportion moves gain and offset in proportion.
        drive, force = (np.asarray(x) for x in FLAT[:2])
        force = 0.02 * drive - 1e-4
        std = np.full(5, 1e-6)
        plain = calibrate_force(drive, force, std)
        shared = calibrate_force(
            drive, force, force_covariance=np.diag(std**2) + 0.1**2 * np.outer(force, force)
        )
        line = np.array([0.02, -1e-4])
        np.testing.assert_allclose([shared.gain, shared.offset], line, rtol=1e-9)
        np.testing.assert_allclose(
            shared.covariance, plain.covariance + 0.1**2 * np.outer(line, line), rtol=1e-7
        )

    @pytest.mark.parametrize("stated", [True, False])
    def test_stated_standard_deviations_cover(self, stated):
        n, std = 400, 1e-5
        drive = np.array(FLAT[0] if stated else np.linspace(0.02, 0.06, 40))
        exact = FLAT[2] * drive + FLAT[3]
        force = exact + std * np.random.default_rng(5).standard_normal((n, drive.size))
        given = np.full(drive.size, std) if stated else None
        lines = jax.vmap(lambda f: calibrate_force(drive, f, given))(force)
        scores = [
            (lines.gain - FLAT[2]) / np.sqrt(lines.covariance[:, 0, 0]),
            (lines.offset - FLAT[3]) / np.sqrt(lines.covariance[:, 1, 1]),
        ]
        forces = jax.vmap(lambda line: line.force(0.03))(lines) - (FLAT[2] * 0.03 + FLAT[3])
        scores.append(forces / jax.vmap(lambda line: line.force_std(0.03))(lines))
        # 400 scores scatter by 3.5 %; Student's t with 38 degrees of freedom adds 2.7 %.
        np.testing.assert_allclose(np.std(scores, axis=1), 1.0, rtol=0.1)

    def test_two_points(self):
        line = calibrate_force([0.01, 0.03], [1e-4, 5e-4])
        np.testing.assert_allclose([line.gain, line.offset], [0.02, -1e-4], rtol=1e-12)
        assert np.isnan(line.residual_std)
        assert np.isnan(line.covariance).all()
        assert np.isnan(line.force_std(0.02))
        stated = calibrate_force([0.01, 0.03], [1e-4, 5e-4], [1e-6, 1e-6])
        np.testing.assert_allclose(stated.force_std(0.01), 1e-6, rtol=1e-10)
        assert np.isnan(stated.residual_std)

    def test_units_order_gradient_and_jit(self):
        drive, force = (np.asarray(x) for x in FLAT[:2])
        line = calibrate_force(drive, force)
        millis = calibrate_force(1e3 * drive[::-1], 1e3 * force[::-1])
        np.testing.assert_allclose(millis.gain, line.gain, rtol=1e-12)
        np.testing.assert_allclose(millis.offset, 1e3 * line.offset, rtol=1e-12)
        np.testing.assert_allclose(millis.force_std(30.0), 1e3 * line.force_std(0.03), rtol=1e-10)
        compiled = jax.jit(calibrate_force)(drive, force)
        np.testing.assert_allclose(compiled.covariance, line.covariance, rtol=1e-12)
        slope = jax.grad(lambda f: calibrate_force(drive, f).force(0.1))(force)
        step = 1e-6
        expected = [
            (calibrate_force(drive, force + e).force(0.1) - line.force(0.1)) / step
            for e in np.eye(5) * step
        ]
        # The line is linear in the forces: rounding of 1e-3 N over the step.
        np.testing.assert_allclose(slope, expected, atol=1e-11)

    @pytest.mark.parametrize(
        ("given", "message"),
        [
            (([0.1], [1.0]), r"`drive` must contain two different voltages"),
            (([0.1, 0.1], [1.0, 2.0]), r"`drive` must contain two different voltages"),
            (([], []), r"`drive` must contain two different voltages"),
            (([0.1, 0.2], [1.0]), r"`force` must have shape \(2,\)"),
            (([0.1, np.nan], [1.0, 2.0]), r"`drive` must be finite, but entry 1 is nan"),
            (([0.1, 0.2], [np.inf, 2.0]), r"`force` must be finite, but entry 0 is inf"),
            (([0.1, 0.2], [1.0, 2.0], [0.1, 0.0]), r"`force_std` must be positive"),
            (([0.1, 0.2], [1.0, 2.0], [0.1]), r"`force_std` must have shape \(2,\)"),
        ],
    )
    def test_wrong_arguments(self, given, message):
        with pytest.raises(ValueError, match=message):
            calibrate_force(*given)

    def test_wrong_covariance(self):
        drive, force = [0.1, 0.2], [1.0, 2.0]
        with pytest.raises(ValueError, match=r"`force_covariance` must be positive definite"):
            calibrate_force(drive, force, force_covariance=-np.eye(2))
        with pytest.raises(ValueError, match=r"both given"):
            calibrate_force(drive, force, [1.0, 1.0], force_covariance=np.eye(2))


class TestApplyCalibration:
    line = calibrate_force([0.01, 0.02, 0.03], [1.0, 2.0, 3.0], [0.1, 0.1, 0.2])

    def data(self, drive=(0.05, np.nan, 0.02), force=(np.nan, 7.0, np.nan)):
        return steady_states(
            [1, 2, 3], [500.0] * 3, force, [0.1 + 0j] * 3, drive=drive, force_std=[np.nan, 0.3, 0.2]
        )

    def test_fills_in_what_is_driven(self):
        data = apply_calibration(self.data(), self.line)
        np.testing.assert_allclose(data.force, [5.0, 7.0, 2.0], rtol=1e-12)
        expected = [self.line.force_std(0.05), 0.3, self.line.force_std(0.02)]
        np.testing.assert_allclose(data.force_std, expected, rtol=1e-12)
        np.testing.assert_array_equal(data.drive, self.data().drive)
        np.testing.assert_array_equal(data.velocity, self.data().velocity)

    def test_refuses_drives_below_the_line(self):
        with pytest.raises(ValueError, match=r"drive -0.01 V in state 2, for which the line gives"):
            apply_calibration(self.data(drive=(0.05, np.nan, -0.01)), self.line)
        with pytest.raises(ValueError, match=r"`data` must have a drive voltage"):
            apply_calibration(self.data(drive=(np.nan,) * 3), self.line)
        below = self.data(drive=(0.05, np.nan, -0.01))
        traced = jax.jit(lambda line: apply_calibration(below, line))(self.line)
        np.testing.assert_allclose(traced.force[:2], [5.0, 7.0], rtol=1e-12)
        assert np.isnan(traced.force[2])

    def test_gradient_reaches_the_forces(self):
        def total(gain):
            return jnp.sum(
                apply_calibration(self.data(), dataclasses.replace(self.line, gain=gain)).force
            )

        np.testing.assert_allclose(jax.grad(total)(self.line.gain), 0.07, rtol=1e-12)
