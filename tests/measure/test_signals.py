"""The harmonic fit against numpy, scipy and statistics; peaks, loops and records."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st

import snrmjax  # noqa: F401
from snrmjax.measure.signals import (
    FitStatus,
    fit_harmonics,
    fit_records,
    force_velocity_loop,
    peak_amplitude,
    phasor_relative_to_force,
    steady_state_from_records,
    synthesise,
)

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


def z_spread(z):
    """Sample standard deviation of z-scores along the first axis."""
    return np.std(np.asarray(z), axis=0, ddof=1)


class TestFit:
    @pytest.mark.parametrize("periods", [0.8, 1.0, 3.37, 40.0])
    def test_recovers_exact_harmonics(self, periods):
        time = uneven_times(periods, 120)
        fit = fit_harmonics(time, signal(time), OMEGA, ORDERS)
        assert fit.status == FitStatus.SUCCESSFUL
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
        np.testing.assert_allclose(other.harmonic(3), fit.harmonic(3), atol=1e-13)
        np.testing.assert_allclose(other.real_std[2], fit.real_std[1], rtol=1e-11)
        assert other.harmonic_order == (0, 3, 1, 2)

    def test_stated_standard_deviations_cover(self):
        # 1.2 periods: the harmonics are correlated, so that a careless covariance would fail.
        n = 400
        time = uneven_times(1.2, start=0.02)
        noise = 0.05 * np.random.default_rng(5).standard_normal((n, N_SAMPLES))
        fit = fit_harmonics(time, signal(time) + noise, OMEGA, ORDERS)
        error = np.asarray(fit.amplitude) - TRUTH
        # 400 scores scatter by 1/√800 = 3.5 %; Student's t with 113 degrees of freedom adds 0.9 %.
        np.testing.assert_allclose(z_spread(error.real / fit.real_std), 1.0, rtol=0.1)
        np.testing.assert_allclose(z_spread(error.imag[:, 1:] / fit.imag_std[:, 1:]), 1.0, rtol=0.1)
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
        assert fit.status == FitStatus.SUCCESSFUL
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
        for refine in (False, True)[: 2 if time.size == N_SAMPLES else 1]:
            fit = fit_harmonics(time, signal(time), OMEGA, ORDERS, refine_frequency=refine)
            # A refined frequency leaves the aliased one, which parts the harmonics a little.
            assert fit.status in (FitStatus.RANK_DEFICIENT, FitStatus.FREQUENCY_NOT_FOUND)
            assert refine or (fit.status == FitStatus.RANK_DEFICIENT and fit.condition > 1e6)
            for value in (fit.amplitude, fit.covariance, fit.residual_rms, fit.noise_std):
                assert np.isnan(value).all()

    def test_a_bad_record_leaves_the_others_alone(self):
        time = uneven_times(3.0)
        records = np.stack([signal(time)] * 3)
        records[1, 7] = np.nan
        fit = fit_harmonics(time, records, OMEGA, ORDERS)
        assert fit.status.tolist() == [0, FitStatus.NOT_FINITE, 0]
        assert np.isnan(fit.amplitude[1]).all()
        np.testing.assert_allclose(fit.amplitude[::2], [TRUTH, TRUTH], atol=1e-13)  # rounding

    def test_jit_vmap_and_rows_agree(self):
        time = uneven_times(2.3)
        noise = 0.1 * np.random.default_rng(6).standard_normal((3, N_SAMPLES))
        records = signal(time) + noise
        batch = fit_harmonics(time, records, OMEGA, ORDERS)
        own = fit_harmonics(time, records, np.full(3, OMEGA), ORDERS)
        mapped = jax.vmap(lambda y: fit_harmonics(time, y, OMEGA, ORDERS))(records)
        compiled = jax.jit(lambda y: fit_harmonics(time, y, OMEGA, ORDERS))(records)
        rows = [fit_harmonics(time, row, OMEGA, ORDERS).amplitude for row in records]
        for other in (own.amplitude, mapped.amplitude, compiled.amplitude, np.stack(rows)):
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

        assert compiled(signal(time), OMEGA)[0] == FitStatus.SUCCESSFUL
        status, amplitude = compiled(2.0 * signal(time), -1.0)
        assert status == FitStatus.NOT_FINITE
        assert np.isnan(amplitude).all()
        assert len(traces) == 1

    @pytest.mark.parametrize("refine", [False, True])
    def test_gradients_against_finite_differences(self, refine):
        time = uneven_times(2.3)
        values = signal(time) + 0.1 * np.random.default_rng(7).standard_normal(N_SAMPLES)

        def quantity(y, omega):
            fit = fit_harmonics(time, y, omega, ORDERS, refine_frequency=refine)
            amplitudes = jnp.abs(fit.amplitude[1]) + fit.amplitude[3].imag
            return amplitudes + fit.complex_std[2] + fit.phase_std[1] + 1e-3 * fit.frequency

        direction = np.random.default_rng(8).standard_normal(N_SAMPLES)
        step = 1e-4
        ahead, behind = (quantity(values + s * direction, OMEGA) for s in (step, -step))
        difference = (ahead - behind) / (2 * step)
        # Central differences: step² truncation, and the solver's 1e-9 over the step.
        if refine:
            slope = jax.jvp(lambda y: quantity(y, OMEGA), (values,), (direction,))[1]
            np.testing.assert_allclose(slope, difference, rtol=1e-4, atol=1e-5)
            return
        gradient, slope = jax.grad(quantity, argnums=(0, 1))(values, OMEGA)
        np.testing.assert_allclose(gradient @ direction, difference, rtol=1e-4)
        step = 1e-2
        ahead, behind = (quantity(values, OMEGA + s) for s in (step, -step))
        np.testing.assert_allclose(slope, (ahead - behind) / (2 * step), rtol=1e-5)  # step²

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"time": np.zeros((2, 3))}, r"`time` must be a vector"),
            ({"signal": np.zeros(4)}, r"`signal` must end in an axis of 120 samples"),
            ({"frequency": -3.0}, r"`frequency` must be positive, but is -3.0"),
            ({"frequency": np.nan}, r"`frequency` must be positive"),
            ({"frequency": np.ones(3)}, r"`frequency` must have shape \(\), but has \(3,\)"),
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

    def test_unknown_harmonic(self):
        time = uneven_times(2.0)
        with pytest.raises(ValueError, match=r"`order` must be one of \(0, 1, 2, 3\), but is 4"):
            fit_harmonics(time, signal(time), OMEGA, ORDERS).harmonic(4)


class TestRefinedFrequency:
    time = uneven_times(9.0)
    duration = time.max() - time.min()

    def test_agrees_with_scipy(self):
        values = signal(self.time) + 0.05 * np.random.default_rng(9).standard_normal(N_SAMPLES)

        def model(t, *x):
            return signal(t, [x[0], x[1] + 1j * x[4], x[2] + 1j * x[5], x[3] + 1j * x[6]], x[7])

        start = [0.3, 1.0, 0.0, 0.0, -0.4, 0.0, -0.08, OMEGA]
        best, pcov = scipy.optimize.curve_fit(
            model, self.time, values, p0=start, xtol=1e-14, ftol=1e-14, gtol=1e-14
        )
        fit = fit_harmonics(self.time, values, 1.01 * OMEGA, ORDERS, refine_frequency=True)
        # The solver's tolerance, 1e-8 of 4π/duration; scipy differentiates numerically (1e-8).
        np.testing.assert_allclose(fit.frequency, best[7], rtol=1e-8)
        np.testing.assert_allclose(fit.frequency_std, np.sqrt(pcov[7, 7]), rtol=1e-5)
        np.testing.assert_allclose(fit.amplitude.real, best[:4], atol=1e-6)
        np.testing.assert_allclose(fit.amplitude.imag[1:], best[4:7], atol=1e-6)
        keep = [0, 1, 2, 3, 5, 6, 7]
        np.testing.assert_allclose(
            fit.covariance[np.ix_(keep, keep)], pcov[:7, :7], atol=1e-5 * pcov[:7, :7].max()
        )
        assert fit.degrees_of_freedom == N_SAMPLES - 8

    @pytest.mark.parametrize("lobes", [-1.2, -0.5, -0.01, 0.3, 0.9, 1.2])
    def test_finds_the_tone_from_a_lobe_away(self, lobes):
        near = OMEGA + 2 * np.pi * lobes / self.duration
        fit = fit_harmonics(self.time, signal(self.time), near, ORDERS, refine_frequency=True)
        assert fit.status == FitStatus.SUCCESSFUL
        # The solver's tolerance, 1e-8 of 4π/duration = 0.2 Ω.
        np.testing.assert_allclose(fit.frequency, OMEGA, rtol=2e-9)

    def test_says_when_there_is_no_tone(self):
        far = OMEGA + 2 * np.pi * 2.6 / self.duration
        noise = np.random.default_rng(10).standard_normal(N_SAMPLES)
        for values, expected in (
            (signal(self.time), FitStatus.FREQUENCY_NOT_FOUND),
            (noise, FitStatus.FREQUENCY_NOT_FOUND),
            (np.zeros(N_SAMPLES), FitStatus.RANK_DEFICIENT),
        ):
            fit = fit_harmonics(self.time, values, far, ORDERS, refine_frequency=True)
            assert fit.status == expected
            assert np.isnan(fit.frequency)
            assert np.isnan(fit.amplitude).all()

    def test_stated_standard_deviations_cover(self):
        # The record starts two durations after the reference: the clock's error turns the phase.
        n = 400
        time = uneven_times(9.0, start=0.2)
        noise = 0.1 * np.random.default_rng(11).standard_normal((n, N_SAMPLES))

        def fits(reference_time):
            single = [
                fit_harmonics(
                    time,
                    record,
                    1.002 * OMEGA,
                    ORDERS,
                    refine_frequency=True,
                    reference_time=reference_time,
                )
                for record in signal(time) + noise
            ]
            return jax.tree.map(lambda *leaves: np.stack(leaves), *single)

        fit = fits(0.0)
        assert not fit.status.any()
        # As above: 3.5 % sampling error of the spread of 400 scores.
        np.testing.assert_allclose(
            z_spread((fit.frequency - OMEGA) / fit.frequency_std), 1.0, rtol=0.1
        )
        phase_z = np.angle(fit.harmonic(1) / TRUTH[1]) / fit.phase_std[:, 1]
        np.testing.assert_allclose(z_spread(phase_z), 1.0, rtol=0.1)
        amplitude_z = (np.abs(fit.harmonic(3)) - 0.08) / fit.amplitude_std[:, 3]
        np.testing.assert_allclose(z_spread(amplitude_z), 1.0, rtol=0.1)
        # Counted from the middle of the record the phase is much better known, and known how well.
        middle = fits(time.mean())
        assert np.all(middle.phase_std[:, 1] < 0.3 * fit.phase_std[:, 1])
        exact = TRUTH[1] * np.exp(1j * OMEGA * time.mean())
        phase_z = np.angle(middle.harmonic(1) / exact) / middle.phase_std[:, 1]
        np.testing.assert_allclose(z_spread(phase_z), 1.0, rtol=0.1)


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

    def test_synthesise(self):
        time = uneven_times(2.0)
        values = synthesise(np.stack([TRUTH, 2 * TRUTH]), (0, 1, 2, 3), OMEGA, time)
        np.testing.assert_allclose(values, [signal(time), 2 * signal(time)], atol=1e-13)

    def test_fit_undoes_synthesis(self):
        time = uneven_times(3.0)
        fit = fit_harmonics(time, synthesise(TRUTH, (0, 1, 2, 3), OMEGA, time), OMEGA, ORDERS)
        np.testing.assert_allclose(fit.amplitude, TRUTH, atol=1e-13)  # rounding

    @pytest.mark.parametrize("verb", [synthesise, phasor_relative_to_force, peak_amplitude])
    def test_wrong_orders(self, verb):
        rest = {
            synthesise: (1.0, np.zeros(2)),
            phasor_relative_to_force: (),
            peak_amplitude: (),
        }[verb]
        first = (TRUTH, 1.0 + 0j) if verb is phasor_relative_to_force else (TRUTH,)
        with pytest.raises(ValueError, match=r"must end in an axis of 2 harmonics"):
            verb(*first, (1, 2), *rest)
        with pytest.raises(ValueError, match=r"`orders` must be distinct whole numbers"):
            verb(*first, (1, 2, 3, 3), *rest)


def brute_peak(amplitudes, orders):
    """Largest magnitude by scipy, bracketed by a fine grid."""

    def negative(angle):
        return -abs(
            sum((x * np.exp(1j * k * angle)).real for k, x in zip(orders, amplitudes, strict=True))
        )

    grid = np.linspace(0, 2 * np.pi, 4001)
    best = grid[np.argmin([negative(angle) for angle in grid])]
    found = scipy.optimize.minimize_scalar(
        negative, bounds=(best - 2e-3, best + 2e-3), method="bounded", options={"xatol": 1e-10}
    )
    return -found.fun


class TestPeak:
    @pytest.mark.parametrize("seed", range(6))
    def test_against_scipy(self, seed):
        rng = np.random.default_rng(seed)
        orders = ((0, 1, 2, 3), (1, 5, 9))[seed % 2]
        amplitudes = rng.standard_normal(len(orders)) + 1j * rng.standard_normal(len(orders))
        if orders[0] == 0:
            amplitudes[0] = amplitudes[0].real
        # A peak is flat: scipy's 1e-10 rad costs 1e-18, so both are exact to rounding.
        np.testing.assert_allclose(
            peak_amplitude(amplitudes, orders), brute_peak(amplitudes, orders), rtol=1e-12
        )

    def test_exact_peaks(self):
        for amplitudes, peak, tolerance in (
            ([0, 3 - 4j, 0, 0], 5.0, 1e-14),
            ([0, 1.0, 0.25, 0], 1.25, 1e-14),  # cos τ + ¼ cos 2τ at τ = 0
            ([-0.5, 1.0, 0, 0], 1.5, 1e-14),  # the mean counts, and so does the trough
            # cos τ − ⅑ cos 3τ has a quartic peak at τ = 0, where Newton's method is slow.
            ([0, 1.0, 0, -1 / 9], 8 / 9, 1e-12),
            ([0, 0, 0, 0], 0.0, 0.0),
        ):
            found = peak_amplitude(np.array(amplitudes, dtype=complex), (0, 1, 2, 3))
            np.testing.assert_allclose(found, peak, rtol=tolerance)

    def test_time_shift_and_units(self):
        turned = TRUTH * np.exp(0.77j * np.arange(4))
        peak = peak_amplitude(TRUTH, (0, 1, 2, 3))
        np.testing.assert_allclose(peak_amplitude(turned, (0, 1, 2, 3)), peak, rtol=1e-13)
        np.testing.assert_allclose(peak_amplitude(1e-9 * TRUTH, (0, 1, 2, 3)), 1e-9 * peak)

    def test_derivatives(self):
        def peak(parts):
            return peak_amplitude(jax.lax.complex(*jnp.split(parts, 2)), ORDERS)

        parts = np.array([1.0, 0.2, -0.1, -0.4, 0.1, 0.15])
        step = 1e-5
        ahead, behind = parts + step * np.eye(6), parts - step * np.eye(6)
        peaks, gradients = (jax.jit(jax.vmap(f)) for f in (peak, jax.grad(peak)))
        slopes = (peaks(ahead) - peaks(behind)) / (2 * step)
        # Central differences: rounding 1e-16 / step, truncation step².
        np.testing.assert_allclose(gradients(parts[None])[0], slopes, atol=1e-9)
        curvature = (gradients(ahead) - gradients(behind)) / (2 * step)
        np.testing.assert_allclose(jax.jit(jax.hessian(peak))(parts), curvature, atol=1e-8)
        assert np.isfinite(gradients(np.zeros((1, 6)))).all()

    def test_jit_and_vmap_agree(self):
        batch = np.random.default_rng(0).standard_normal((2, 3, 4)) + 0j
        orders = (0, 1, 2, 3)
        plain = peak_amplitude(batch, orders)
        assert plain.shape == (2, 3)
        mapped = jax.vmap(jax.vmap(lambda x: peak_amplitude(x, orders)))(batch)
        compiled = jax.jit(lambda x: peak_amplitude(x, orders))(batch)
        np.testing.assert_allclose(mapped, plain, rtol=1e-14)
        np.testing.assert_allclose(compiled, plain, rtol=1e-14)


class TestLoop:
    def test_area_is_the_power(self):
        force, velocity = 2.5, np.array([0.3 + 0.2j, 0.05 - 0.1j, 0.02j])
        loop = force_velocity_loop(force, velocity, ORDERS, 1001)
        # Displacement over one period by its own integral; the area of the loop, over the period.
        displacement = [v / (1j * k * OMEGA) for k, v in zip(ORDERS, velocity, strict=True)]
        x = sum(
            (d * np.exp(1j * k * loop.phase)).real
            for k, d in zip(ORDERS, displacement, strict=True)
        )
        area = 0.5 * np.sum((loop.force[1:] + loop.force[:-1]) * np.diff(x))
        # The trapezoidal rule on a periodic curve, step 2π/1000: error of order (2π/1000)².
        np.testing.assert_allclose(area * OMEGA / (2 * np.pi), loop.mean_power, rtol=1e-4)
        np.testing.assert_allclose(loop.mean_power, 0.5 * 2.5 * 0.3, rtol=1e-15)

    def test_is_closed_and_straight_at_resonance(self):
        loop = force_velocity_loop(2.0, np.array([0.4 + 0j]), (1,), 64)
        np.testing.assert_allclose(loop.velocity, 0.2 * loop.force, atol=1e-15)
        np.testing.assert_allclose(loop.force[0], loop.force[-1], atol=1e-14)
        lagging = force_velocity_loop(2.0, np.array([-0.4j]), (1,))
        np.testing.assert_allclose(
            (lagging.force / 2.0) ** 2 + (lagging.velocity / 0.4) ** 2, 1.0, rtol=1e-14
        )
        assert lagging.mean_power == 0.0

    def test_batch(self):
        forces = np.array([1.0, 2.0])
        loop = force_velocity_loop(forces, np.array([[0.1j], [0.2 + 0j]]), (1,), 11)
        assert loop.force.shape == loop.velocity.shape == (2, 11)
        np.testing.assert_allclose(loop.mean_power, [0.0, 0.2], atol=1e-16)

    def test_needs_the_fundamental(self):
        with pytest.raises(ValueError, match=r"`orders` must contain the fundamental, 1"):
            force_velocity_loop(1.0, np.array([0.1 + 0j]), (2,))


# Force with its own second and third harmonic, at 40° of the time axis; two velocities.
FORCE = np.array([0.0, 2.0 * np.exp(0.7j), 0.02j, 0.04 + 0j])
VELOCITY = np.array([[0.0, 0.3 - 0.1j, 0.01j, 0.02 + 0j], [0.1, -0.05j, 0.002 + 0j, 0.001j]])


def noisy_records(time, rng, n, force_noise=0.02, velocity_noise=0.005):
    force = signal(time, FORCE) + force_noise * rng.standard_normal((n, time.size))
    velocity = np.stack([signal(time, v) for v in VELOCITY])
    return force, velocity + velocity_noise * rng.standard_normal((n, 2, time.size))


class TestRecords:
    time = uneven_times(7.4, start=1.0)

    def relative(self, amplitudes):
        return amplitudes * np.exp(-0.7j * np.arange(4))

    def test_exact_state(self):
        force, velocity = (
            signal(self.time, FORCE),
            np.stack([signal(self.time, v) for v in VELOCITY]),
        )
        data = steady_state_from_records(
            self.time,
            force,
            velocity,
            1.003 * OMEGA,
            level=4,
            harmonic_order=(0, 1, 2, 3),
            sensors=("a", "b"),
            refine_frequency=True,
        )
        # The solver's tolerance on the frequency, 1e-9 of 4π/duration.
        np.testing.assert_allclose(data.frequency, [OMEGA], rtol=1e-9)
        np.testing.assert_allclose(data.force, [2.0], rtol=1e-9)
        np.testing.assert_allclose(data.velocity[0], self.relative(VELOCITY)[:, 1], atol=1e-9)
        assert data.harmonic_order == (0, 2, 3)
        np.testing.assert_allclose(
            data.harmonics[0], self.relative(VELOCITY)[:, [0, 2, 3]], atol=1e-9
        )
        assert data.level.tolist() == [4]
        assert data.sensors == ("a", "b")
        assert data.measured.all()
        fit = fit_records(self.time, force, velocity, OMEGA, ORDERS)
        np.testing.assert_allclose(fit.force_harmonics, self.relative(FORCE), atol=1e-12)
        np.testing.assert_allclose(fit.velocity_harmonics, self.relative(VELOCITY), atol=1e-12)
        np.testing.assert_allclose(fit.force_distortion, np.hypot(0.01, 0.02), rtol=1e-11)

    def test_fundamental_only(self):
        data = steady_state_from_records(
            self.time,
            np.cos(OMEGA * self.time),
            np.sin(OMEGA * self.time),
            OMEGA,
            harmonic_order=(1,),
        )
        np.testing.assert_allclose(data.velocity, [[-1j]], atol=1e-11)  # rounding of Ωt
        assert data.harmonics.shape == (1, 1, 0)
        assert np.isnan(data.harmonic_std).all()

    def test_stated_standard_deviations_cover(self):
        n = 400
        force, velocity = noisy_records(self.time, np.random.default_rng(12), n)
        states = [
            steady_state_from_records(self.time, f, v, OMEGA)
            for f, v in zip(force, velocity, strict=True)
        ]

        def gathered(name):
            return np.concatenate([getattr(state, name) for state in states])

        exact = self.relative(VELOCITY)
        velocity_error = gathered("velocity") / exact[:, 1]
        harmonic_error = np.sqrt(2) * (gathered("harmonics") - exact[:, 2:])
        for score in (
            (gathered("force") - 2.0) / gathered("force_std"),
            (np.abs(velocity_error) - 1) * np.abs(exact[:, 1]) / gathered("velocity_std"),
            np.angle(velocity_error) / gathered("phase_std"),
            harmonic_error.real / gathered("harmonic_std")[..., None],
            harmonic_error.imag / gathered("harmonic_std")[..., None],
        ):
            # 400 scores scatter by 3.5 %; the largest of the 15 spreads here stays below 10 %.
            np.testing.assert_allclose(z_spread(score), 1.0, rtol=0.1)

    def test_shared_frequency_covers(self):
        force, velocity = noisy_records(self.time, np.random.default_rng(16), 200)
        fits = [
            fit_records(self.time, f, v, 1.002 * OMEGA, ORDERS, refine_frequency=True).force
            for f, v in zip(force, velocity, strict=True)
        ]
        scores = [float((fit.frequency - OMEGA) / fit.frequency_std) for fit in fits]
        # 200 scores scatter by 5 %.
        np.testing.assert_allclose(z_spread(scores), 1.0, rtol=0.15)

    def test_shared_frequency_is_better_than_its_parts(self):
        force, velocity = noisy_records(self.time, np.random.default_rng(13), 1)
        fit = fit_records(self.time, force[0], velocity[0], OMEGA, ORDERS, refine_frequency=True)
        alone = [
            fit_harmonics(self.time, record, OMEGA, ORDERS, refine_frequency=True)
            for record in (force[0], *velocity[0])
        ]
        weight = np.array([float(one.frequency_std) ** -2 for one in alone])
        expected = np.sum(weight * [float(one.frequency) for one in alone]) / np.sum(weight)
        # The solver's tolerance, 1e-9 of 4π/duration, is reached along different roundings.
        np.testing.assert_allclose(fit.force.frequency, expected, rtol=1e-9)
        np.testing.assert_allclose(fit.velocity.frequency, [expected] * 2, rtol=1e-9)
        np.testing.assert_allclose(fit.force.frequency_std, np.sum(weight) ** -0.5, rtol=1e-6)

    def test_a_dead_sensor_is_not_measured(self):
        force, velocity = noisy_records(self.time, np.random.default_rng(14), 1)
        velocity[0, 0, 3] = np.nan
        for refine in (False, True):
            data = steady_state_from_records(
                self.time, force[0], velocity[0], OMEGA, refine_frequency=refine
            )
            assert data.measured.tolist() == [[False, True]]
            assert data.velocity[0, 0] == 0
            assert np.isnan(data.velocity_std[0, 0])
            assert np.isnan(data.harmonics[0, 0]).all()
            assert np.isfinite(data.velocity_std[0, 1])

    def test_what_cannot_be_fitted_is_refused(self):
        force, velocity = noisy_records(self.time, np.random.default_rng(15), 1)
        force, velocity = force[0], velocity[0]
        with pytest.raises(ValueError, match=r"`force_record` cannot be fitted: a sample is not"):
            steady_state_from_records(self.time, np.nan * force, velocity, OMEGA)
        with pytest.raises(ValueError, match=r"`velocity_records` cannot be fitted: a sample is"):
            steady_state_from_records(self.time, force, np.nan * velocity, OMEGA)
        with pytest.raises(ValueError, match=r"record longer"):
            steady_state_from_records(1e-3 * self.time, force, velocity, OMEGA)
        noise = np.random.default_rng(17).standard_normal((3, N_SAMPLES))
        fit = fit_records(self.time, noise[0], noise[1:], OMEGA, ORDERS, refine_frequency=True)
        assert fit.force.status == FitStatus.FREQUENCY_NOT_FOUND
        assert np.isnan(fit.force.frequency_std)
        assert np.isnan(fit.velocity.amplitude).all()

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"force_record": np.zeros(3)}, r"`force_record` must have samples of shape \(120,\)"),
            ({"velocity_records": np.zeros((2, 5))}, r"`velocity_records` must have samples"),
            ({"harmonic_order": (2, 3)}, r"`harmonic_order` must contain the fundamental, 1"),
        ],
    )
    def test_wrong_arguments(self, change, message):
        given = {
            "time": self.time,
            "force_record": signal(self.time, FORCE),
            "velocity_records": signal(self.time, VELOCITY[0]),
            "frequency": OMEGA,
            "harmonic_order": ORDERS,
        }
        with pytest.raises(ValueError, match=message):
            fit_records(**(given | change))
