"""Steady states from time records: exact, as well known as they say, and refused with a reason."""

import numpy as np
import pytest

import snrmjax  # noqa: F401
from snrmjax.measure.harmonic_fit import HarmonicFitStatus, fit_harmonics
from snrmjax.measure.records import fit_records, steady_state_from_records

OMEGA = 2 * np.pi * 80.0
PERIOD = 2 * np.pi / OMEGA
ORDERS = (1, 2, 3)
# One length of record for most tests: they then share one compilation.
N_SAMPLES = 120
# Force with its own second and third harmonic, at 40° of the time axis; two velocities.
FORCE = np.array([0.0, 2.0 * np.exp(0.7j), 0.02j, 0.04 + 0j])
VELOCITY = np.array([[0.0, 0.3 - 0.1j, 0.01j, 0.02 + 0j], [0.1, -0.05j, 0.002 + 0j, 0.001j]])


def signal(time, harmonics):
    return sum((x * np.exp(1j * k * OMEGA * time)).real for k, x in enumerate(harmonics))


def noisy_records(time, rng, n, force_noise=0.02, velocity_noise=0.005):
    force = signal(time, FORCE) + force_noise * rng.standard_normal((n, time.size))
    velocity = np.stack([signal(time, v) for v in VELOCITY])
    return force, velocity + velocity_noise * rng.standard_normal((n, 2, time.size))


class TestRecords:
    time = 1.0 + np.sort(np.random.default_rng(0).uniform(0.0, 7.4 * PERIOD, N_SAMPLES))

    def relative(self, amplitudes):
        return amplitudes * np.exp(-0.7j * np.arange(4))

    def test_exact_state(self):
        force = signal(self.time, FORCE)
        velocity = np.stack([signal(self.time, v) for v in VELOCITY])
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

    def test_stated_standard_deviations_cover(self, z_spread):
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

    def test_shared_frequency_covers(self, z_spread):
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
        assert fit.force.status == HarmonicFitStatus.FREQUENCY_NOT_FOUND
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
