"""The harmonic fit against numpy, scipy and statistics; phasors relative to the force."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import snrmjax  # noqa: F401
from snrmjax.measure.harmonic_fit import HarmonicFitStatus, fit_harmonics, phasor_relative_to_force
from snrmjax.measure.signals import synthesise

OMEGA = 2 * np.pi * 80.0
ORDERS = (1, 2, 3)
# One length of record for most tests: they then share one compilation.
N_SAMPLES = 120
# Mean, then harmonics 1 to 3.
TRUTH = np.array([0.3, 1.0 - 0.4j, 0.05 + 0.02j, -0.08j])


def signal(time, truth=TRUTH, omega=OMEGA):
    return sum((x * np.exp(1j * k * omega * time)).real for k, x in enumerate(truth))


def uneven_times(periods, n=N_SAMPLES, start=0.0):
    times = np.random.default_rng(0).uniform(0.0, periods * 2 * np.pi / OMEGA, n)
    return start + np.sort(times)


def numpy_fit(time, values, orders=ORDERS, omega=OMEGA):
    """Least squares by numpy: amplitudes (mean first), covariance of (mean, real, imaginary)."""
    columns = [np.ones_like(time)]
    columns += [np.cos(k * omega * time) for k in orders]
    columns += [-np.sin(k * omega * time) for k in orders]
    design = np.stack(columns, axis=1)
    x, squares, _, _ = np.linalg.lstsq(design, values, rcond=None)
    n = len(orders)
    variance = squares[0] / (time.size - x.size)
    amplitude = np.concatenate([x[:1], x[1 : n + 1] + 1j * x[n + 1 :]])
    return amplitude, variance * np.linalg.inv(design.T @ design)


class TestFit:
    @pytest.mark.parametrize("periods", [0.8, 1.0, 3.37, 40.0])
    def test_recovers_exact_harmonics(self, periods):
        time = uneven_times(periods, 120)
        fit = fit_harmonics(time, signal(time), OMEGA, ORDERS)
        assert fit.status == HarmonicFitStatus.SUCCESSFUL
        assert fit.harmonic_order == (0, 1, 2, 3)
        # Rounding times the condition number of the fit, below 10.
        np.testing.assert_allclose(fit.amplitude, TRUTH, atol=1e-13)
        assert fit.residual_rms < 1e-14
        assert fit.amplitude[0].imag == 0.0

    def test_agrees_with_numpy_lstsq(self):
        time = uneven_times(2.3, start=0.7)
        values = signal(time) + 0.1 * np.random.default_rng(1).standard_normal(N_SAMPLES)
        fit = fit_harmonics(time, values, OMEGA, ORDERS)
        amplitude, covariance = numpy_fit(time, values)
        # Ωt at 0.7 s has 350 rad: rounding 1e-13 in the phases of the reference itself.
        np.testing.assert_allclose(fit.amplitude, amplitude, atol=1e-12)
        keep = [0, 1, 2, 3, 5, 6, 7]  # without the imaginary part of the mean
        np.testing.assert_allclose(
            fit.covariance[np.ix_(keep, keep)], covariance, atol=1e-12 * covariance.max()
        )
        assert not fit.covariance[4].any()
        assert fit.degrees_of_freedom == N_SAMPLES - 7
        residual = values - signal(time, amplitude)
        np.testing.assert_allclose(fit.residual_rms, np.sqrt(np.mean(residual**2)), rtol=1e-10)
        np.testing.assert_allclose(
            fit.noise_std, np.sqrt(np.sum(residual**2) / (N_SAMPLES - 7)), rtol=1e-10
        )

    def test_late_clock_keeps_its_digits(self):
        # Half a million seconds: 2.5e8 rad, whose rounding is 3e-8 rad, turns only the reference.
        late = 2.0**19
        offset = np.arange(N_SAMPLES) / 2.0**12
        fit = fit_harmonics(late + offset, signal(offset), OMEGA, ORDERS, reference_time=late)
        # The time stamps are exact; rounding is that of the unshifted fit.
        np.testing.assert_allclose(fit.amplitude, TRUTH, atol=1e-12)

    def test_time_shift_turns_harmonics(self):
        time = uneven_times(3.4)
        values = signal(time) + 0.1 * np.random.default_rng(2).standard_normal(N_SAMPLES)
        fit = fit_harmonics(time, values, OMEGA, ORDERS)
        shift = 0.0123
        moved = fit_harmonics(time + shift, values, OMEGA, ORDERS)
        turn = np.exp(-1j * np.arange(4) * OMEGA * shift)
        np.testing.assert_allclose(moved.amplitude, fit.amplitude * turn, atol=1e-12)  # rounding
        back = fit_harmonics(time + shift, values, OMEGA, ORDERS, reference_time=shift)
        np.testing.assert_allclose(back.amplitude, fit.amplitude, atol=1e-12)
        np.testing.assert_allclose(back.covariance, fit.covariance, atol=1e-14)
        # Magnitudes do not know where time starts.
        np.testing.assert_allclose(moved.amplitude_std[1:], fit.amplitude_std[1:], rtol=1e-9)
        np.testing.assert_allclose(moved.phase_std[1:], fit.phase_std[1:], rtol=1e-9)

    def test_units_and_order_of_samples(self):
        time = uneven_times(3.4)
        values = signal(time) + 0.1 * np.random.default_rng(3).standard_normal(N_SAMPLES)
        fit = fit_harmonics(time, values, OMEGA, ORDERS)
        scaled = fit_harmonics(1e3 * time, 1e-6 * values, 1e-3 * OMEGA, ORDERS)
        np.testing.assert_allclose(scaled.amplitude, 1e-6 * fit.amplitude, rtol=1e-11)
        np.testing.assert_allclose(scaled.complex_std, 1e-6 * fit.complex_std, rtol=1e-11)
        shuffled = np.random.default_rng(4).permutation(N_SAMPLES)
        other = fit_harmonics(time[shuffled], values[shuffled], OMEGA, (3, 1, 2))
        np.testing.assert_allclose(other.amplitude[1], fit.amplitude[3], atol=1e-13)
        np.testing.assert_allclose(other.complex_std[2], fit.complex_std[1], rtol=1e-11)
        assert other.harmonic_order == (0, 3, 1, 2)

    def test_stated_standard_deviations_cover(self, z_spread):
        # 1.2 periods: the harmonics are correlated, so that a careless covariance would fail.
        n = 400
        time = uneven_times(1.2, start=0.02)
        noise = 0.05 * np.random.default_rng(5).standard_normal((n, N_SAMPLES))
        fit = fit_harmonics(time, signal(time) + noise, OMEGA, ORDERS)
        error = np.asarray(fit.amplitude) - TRUTH
        # 400 scores scatter by 1/√800 = 3.5 %; Student's t with 113 degrees of freedom adds 0.9 %.
        real, imag = np.split(np.sqrt(np.diagonal(fit.covariance, axis1=1, axis2=2)), 2, axis=1)
        np.testing.assert_allclose(z_spread(error.real / real), 1.0, rtol=0.1)
        np.testing.assert_allclose(z_spread(error.imag[:, 1:] / imag[:, 1:]), 1.0, rtol=0.1)
        rms = np.sqrt(np.mean(np.abs(error) ** 2 / np.asarray(fit.complex_std) ** 2, axis=0))
        np.testing.assert_allclose(rms, 1.0, rtol=0.1)
        amplitude_z = (np.abs(fit.amplitude) - np.abs(TRUTH)) / fit.amplitude_std
        phase_z = np.angle(fit.amplitude[:, 1] / TRUTH[1]) / fit.phase_std[:, 1]
        np.testing.assert_allclose(z_spread(amplitude_z)[1], 1.0, rtol=0.1)
        np.testing.assert_allclose(z_spread(phase_z), 1.0, rtol=0.1)

    def test_no_degree_of_freedom_states_no_error(self):
        time = uneven_times(1.0, 7)
        fit = fit_harmonics(time, signal(time), OMEGA, ORDERS)
        assert fit.degrees_of_freedom == 0
        assert fit.status == HarmonicFitStatus.SUCCESSFUL
        # Seven random samples: the condition number is in the hundreds.
        np.testing.assert_allclose(fit.amplitude, TRUTH, atol=1e-11)
        assert np.isnan(fit.noise_std)
        assert np.isnan(fit.covariance).all()

    @pytest.mark.parametrize(
        "time",
        [
            uneven_times(0.05),  # too short
            np.arange(N_SAMPLES) * 2 * np.pi / OMEGA / 4,  # four samples a period: 3 looks like 1
            np.zeros(N_SAMPLES),
            uneven_times(3.0, 6),  # fewer samples than unknowns
        ],
        ids=["short", "aliased", "one instant", "few"],
    )
    def test_inseparable_harmonics_are_refused(self, time):
        fit = fit_harmonics(time, signal(time), OMEGA, ORDERS)
        assert fit.status == HarmonicFitStatus.RANK_DEFICIENT
        assert fit.condition > 1e6
        for value in (fit.amplitude, fit.covariance, fit.residual_rms, fit.noise_std):
            assert np.isnan(value).all()

    def test_a_bad_record_leaves_the_others_alone(self):
        time = uneven_times(3.0)
        records = np.stack([signal(time)] * 3)
        records[1, 7] = np.nan
        fit = fit_harmonics(time, records, OMEGA, ORDERS)
        assert fit.status.tolist() == [0, HarmonicFitStatus.NOT_FINITE, 0]
        assert np.isnan(fit.amplitude[1]).all()
        np.testing.assert_allclose(fit.amplitude[::2], [TRUTH, TRUTH], atol=1e-13)  # rounding

    def test_jit_vmap_and_rows_agree(self):
        time = uneven_times(2.3)
        noise = 0.1 * np.random.default_rng(6).standard_normal((3, N_SAMPLES))
        records = signal(time) + noise
        batch = fit_harmonics(time, records, OMEGA, ORDERS)
        mapped = jax.vmap(lambda y: fit_harmonics(time, y, OMEGA, ORDERS))(records)
        compiled = jax.jit(lambda y: fit_harmonics(time, y, OMEGA, ORDERS))(records)
        rows = [fit_harmonics(time, row, OMEGA, ORDERS).amplitude for row in records]
        for other in (mapped.amplitude, compiled.amplitude, np.stack(rows)):
            np.testing.assert_allclose(other, batch.amplitude, atol=1e-13)  # order of summation
        assert batch.amplitude.shape == (3, 4)
        assert batch.covariance.shape == (3, 8, 8)
        assert batch.status.shape == (3,)

    def test_traces_once_and_masks_a_traced_frequency(self):
        time, traces = uneven_times(2.3), []

        @jax.jit
        def compiled(y, omega):
            traces.append(1)
            fit = fit_harmonics(time, y, omega, ORDERS)
            return fit.status, fit.amplitude

        assert compiled(signal(time), OMEGA)[0] == HarmonicFitStatus.SUCCESSFUL
        status, amplitude = compiled(2.0 * signal(time), -1.0)
        assert status == HarmonicFitStatus.NOT_FINITE
        assert np.isnan(amplitude).all()
        assert len(traces) == 1

    def test_gradients_against_finite_differences(self):
        time = uneven_times(2.3)
        values = signal(time) + 0.1 * np.random.default_rng(7).standard_normal(N_SAMPLES)

        def quantity(y, omega):
            fit = fit_harmonics(time, y, omega, ORDERS)
            amplitudes = jnp.abs(fit.amplitude[1]) + fit.amplitude[3].imag
            return amplitudes + fit.complex_std[2] + fit.phase_std[1]

        direction = np.random.default_rng(8).standard_normal(N_SAMPLES)
        step = 1e-4
        ahead, behind = (quantity(values + s * direction, OMEGA) for s in (step, -step))
        # Central differences: step² truncation, and the solver's 1e-9 over the step.
        gradient, slope = jax.grad(quantity, argnums=(0, 1))(values, OMEGA)
        np.testing.assert_allclose(gradient @ direction, (ahead - behind) / (2 * step), rtol=1e-4)
        step = 1e-2
        ahead, behind = (quantity(values, OMEGA + s) for s in (step, -step))
        np.testing.assert_allclose(slope, (ahead - behind) / (2 * step), rtol=1e-5)  # step²

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"time": np.zeros((2, 3))}, r"`time` must be a vector"),
            ({"signal": np.zeros(4)}, r"`signal` must end in an axis of 120 samples"),
            ({"frequency": -3.0}, r"`frequency` must be positive, but is -3"),
            ({"frequency": np.nan}, r"`frequency` must be finite"),
            ({"frequency": np.ones(3)}, r"`frequency` must be one number, but has shape \(3,\)"),
            ({"harmonic_order": (1, 1)}, r"`harmonic_order` must be distinct whole numbers"),
            ({"harmonic_order": (1, -2)}, r"`harmonic_order` must be distinct whole numbers"),
            ({"harmonic_order": (1.5,)}, r"`harmonic_order` must be distinct whole numbers"),
            ({"harmonic_order": (0,)}, r"`harmonic_order` must contain a harmonic above 0"),
        ],
    )
    def test_wrong_arguments(self, change, message):
        time = uneven_times(2.0)
        given = {"time": time, "signal": signal(time), "frequency": OMEGA, "harmonic_order": (1,)}
        with pytest.raises(ValueError, match=message):
            fit_harmonics(**(given | change))


class TestPhasors:
    @given(
        shift=st.floats(-10.0, 10.0),
        phase=st.floats(-np.pi, np.pi),
        magnitude=st.floats(1e-6, 1e6),
    )
    @settings(max_examples=50, deadline=None, derandomize=True)
    def test_relative_to_force_forgets_the_time_origin(self, shift, phase, magnitude):
        orders = np.arange(4)
        force = magnitude * np.exp(1j * phase)
        turn = np.exp(1j * orders * shift)
        reference = phasor_relative_to_force(TRUTH, force, (0, 1, 2, 3))
        moved = phasor_relative_to_force(TRUTH * turn, force * turn[1], (0, 1, 2, 3))
        np.testing.assert_allclose(moved, reference, atol=1e-13)  # rounding of 3 · 10 rad
        np.testing.assert_allclose(np.abs(reference), np.abs(TRUTH), atol=1e-15)

    def test_relative_to_force_on_a_time_axis(self):
        # cos(τ + 0.3) for the force: in τ' = τ + 0.3 the response is the plain Σ Re X_k e^{ikτ'}.
        force = np.exp(0.3j)
        response = TRUTH * np.exp(1j * 0.3 * np.arange(4))
        np.testing.assert_allclose(
            phasor_relative_to_force(response, force, (0, 1, 2, 3)), TRUTH, atol=1e-15
        )
        assert np.isnan(phasor_relative_to_force(TRUTH, 0.0 + 0.0j, (0, 1, 2, 3))).all()
        batch = phasor_relative_to_force(
            np.stack([response] * 2), np.stack([force] * 2), (0, 1, 2, 3)
        )
        np.testing.assert_allclose(batch, [TRUTH, TRUTH], atol=1e-15)

    def test_fit_undoes_synthesis(self):
        time = uneven_times(3.0)
        fit = fit_harmonics(time, synthesise(TRUTH, (0, 1, 2, 3), OMEGA, time), OMEGA, ORDERS)
        np.testing.assert_allclose(fit.amplitude, TRUTH, atol=1e-13)  # rounding

    def test_wrong_orders(self):
        with pytest.raises(ValueError, match=r"must end in an axis of 2 harmonics"):
            phasor_relative_to_force(TRUTH, 1.0 + 0j, (1, 2))
        with pytest.raises(ValueError, match=r"`orders` must be distinct whole numbers"):
            phasor_relative_to_force(TRUTH, 1.0 + 0j, (1, 2, 3, 3))
