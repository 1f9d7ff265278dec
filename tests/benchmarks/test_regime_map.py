"""The steady states of the regime's map against time integration of the same law."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

DAMPING = 0.01


@pytest.fixture(scope="module")
def oscillator(of_benchmark):
    return of_benchmark("regime_map/oscillator")


@pytest.mark.parametrize(
    ("name", "strength", "shape"),
    [
        ("cubic_hardening", 0.2, 0.0),
        ("quadratic", 0.1, 0.0),
        ("quintic", 0.1, 0.0),
        ("gap", 0.1, 0.4),
        ("stop", 0.1, 0.4),
        ("quadratic_damping", 0.01, 0.0),
    ],
)
def test_a_cycle_that_begins_in_a_state_ends_there(oscillator, name, strength, shape):
    law = oscillator.Law(name, strength, shape)
    state = oscillator.backbone(law, DAMPING, [1.0])
    x, w, force = state.coefficients[0], state.w[0], state.force[0]
    n = (len(x) - 1) // 2
    start = [x[: n + 1].sum(), np.arange(1, n + 1) @ x[n + 1 :] * w]

    def rate(tau, z):
        push = force * np.cos(tau + np.pi / 2) - z[0] - law.force(*np.array(z))[0]
        return [z[1] / w, (push - 2 * DAMPING * z[1]) / w]

    end = solve_ivp(rate, (0, 2 * np.pi), start, "DOP853", rtol=1e-10, atol=1e-12, max_step=0.02)
    # 31 harmonics leave of a kink 31^-2 of its force; what a cycle dissipates is 2πζ of the state.
    assert np.hypot(*(end.y[:, -1] - start)) < 2e-3 * 2 * np.pi * DAMPING
