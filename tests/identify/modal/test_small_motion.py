"""Free decays whose frequency or damping changes as the motion falls, integrated by scipy."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from snrmjax.identify.modal.decay_fit import WaveForm, decaying_columns
from snrmjax.identify.modal.free_decay import fit_free_decay
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.time_recording import time_recording

HERTZ = 2 * np.pi
HZ, RATIO, RATE = 60.0, 0.008, 1200.0


def decay(seconds, *, noise=1e-3, **forces):
    """One mode from rest at q = 1 under forces in units of ω²: cubic, by v|v|, dry friction."""
    omega = HERTZ * HZ

    def slope(_, state):
        q, v = state
        more = forces.get("cubic", 0.0) * q**3 + forces.get("drag", 0.0) * v * abs(v) / omega**2
        more += forces.get("friction", 0.0) * np.tanh(v / (1e-3 * omega))
        return v, -2 * RATIO * omega * v - omega**2 * (q + more)

    time = np.arange(round(seconds * RATE)) / RATE
    exact = solve_ivp(slope, (0, seconds), (1.0, 0.0), t_eval=time, rtol=1e-8, atol=1e-10)
    velocity = exact.y[1]
    rng = np.random.default_rng(3)
    velocity = velocity + noise * np.abs(velocity).max() * rng.normal(size=velocity.shape)
    return time_recording(velocity[None], [Channel("v", "velocity")], RATE)


@pytest.mark.parametrize(
    ("force", "to_hz"),
    [
        ({"cubic": 0.3}, None),
        ({"cubic": -0.2}, 100.0),
        ({"cubic": 0.01}, None),  # indistinguishable from two close linear modes within noise
        ({"drag": 0.04}, None),
    ],
)
def test_the_limit_of_small_motion_lies_in_its_band(force, to_hz):
    done = []
    modes = fit_free_decay(
        decay(1.5, **force),
        to_frequency=to_hz and to_hz * HERTZ,
        progress=lambda *part: done.append(part),
    )
    assert modes.n_modes == 1
    assert [note.kind for note in modes.notes] == ["decay_moves_with_amplitude"]
    off = (modes.natural_frequency[0] - HERTZ * HZ) / modes.natural_frequency_std[0]
    apart = (modes.damping_ratio[0] - RATIO) / modes.damping_ratio_std[0]
    assert abs(off) < 3.5
    assert abs(apart) < 3.5
    # Bands that a motion of a thousand times the noise allows.
    assert modes.natural_frequency_std[0] < 2e-4 * HERTZ * HZ
    assert modes.damping_ratio_std[0] < 0.02 * RATIO
    assert done[-1][0] <= done[-1][1]


@pytest.mark.parametrize(
    ("seconds", "force", "why"),
    [(0.25, {"cubic": 0.6}, "still changing"), (1.0, {"friction": 0.02}, "dry friction")],
)
def test_a_decay_without_a_linear_part_is_refused(seconds, force, why):
    with pytest.raises(ValueError, match=f"not that of linear modes: .*{why}.* linear"):
        fit_free_decay(decay(seconds, **force))


def test_waves_of_an_amplitude_dependent_mode_and_their_slopes():
    """Against its slow flow integrated in time; slopes against central differences."""
    time = np.arange(800) / 400.0
    form = WaveForm(2, 0, (1, 2), ((0, 2), (3, 3), (1, 3)))
    at = np.array([300.0, 500.0, 0.005, 0.01, 0.3, 0.2, 5.0, 20.0])

    def flow(_, state):
        amplitude = np.exp(state[0])
        decay_rate = 1.5 + 0.3 * amplitude + 0.2 * amplitude**2
        return -decay_rate, 300 * np.sqrt(1 - 0.005**2) + 5 * amplitude + 20 * amplitude**2

    exact = solve_ivp(flow, (0, 2), (0, 0), t_eval=time, rtol=1e-10, atol=1e-10).y
    made = decaying_columns(time, at, form)
    # Of 401 nodes of the quadrature.
    assert np.allclose(made.columns[:, 0], np.exp(exact[0]) * np.cos(exact[1]), atol=1e-6)
    for k, step in enumerate(1e-6 * np.diag(at)):
        ahead, behind = (decaying_columns(time, at + s * step, form).columns for s in (1, -1))
        by = (ahead - behind) / (2 * step[k])
        assert np.allclose(made.derivatives[k], by, atol=1e-5 * np.abs(by).max())
