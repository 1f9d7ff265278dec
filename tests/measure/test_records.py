"""Steady states from time records: exact, as well known as they say, and refused with a reason."""

import numpy as np
import pytest

import snrmjax  # noqa: F401
from snrmjax.measure.records import steady_state_from_records

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
            OMEGA,
            level=4,
            harmonic_order=(0, 1, 2, 3),
            sensors=("a", "b"),
        )
        assert data.frequency.tolist() == [OMEGA]
        np.testing.assert_allclose(data.force, [2.0], rtol=1e-12)  # rounding, as below
        np.testing.assert_allclose(data.velocity[0], self.relative(VELOCITY)[:, 1], atol=1e-12)
        assert data.harmonic_order == (0, 2, 3)
        np.testing.assert_allclose(
            data.harmonics[0], self.relative(VELOCITY)[:, [0, 2, 3]], atol=1e-12
        )
        assert data.level.tolist() == [4]
        assert data.sensors == ("a", "b")
        assert data.measured.all()

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

    def test_a_dead_sensor_is_not_measured(self):
        force, velocity = noisy_records(self.time, np.random.default_rng(14), 1)
        velocity[0, 0, 3] = np.nan
        data = steady_state_from_records(self.time, force[0], velocity[0], OMEGA)
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
            steady_state_from_records(**(given | change))
