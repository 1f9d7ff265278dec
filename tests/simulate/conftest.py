"""Truth from outside: time integration of equations of motion that are written here again."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import linear_sum_assignment

from snrmjax.model.beams import CURVED_BEAM_FORCES, FLAT_BEAM_FORCES, curved_beam, flat_beam
from snrmjax.simulate.forced_response import forced_response


class TimeDomain:
    """q̈ + 2ζωq̇ + ω²q + ∂V/∂q + extra(q, q̇) = participation · F cos Ωt, many states at once.

    Takes numbers from a model (frequencies, coefficients), none of its methods. `extra` acts on
    the mode of interest. A state is (q, q̇) in one row; the error control is relative to `scale`.
    """

    def __init__(self, model, force, frequency, extra=None):
        modes = model.modes
        self.n, self.j = modes.n_modes, modes.mode_of_interest
        self.squared = np.asarray(modes.natural_frequency) ** 2
        self.viscous = 2 * np.asarray(modes.damping_ratio) * np.sqrt(self.squared)
        self.load = force * np.asarray(modes.participation)
        self.frequency, self.extra = float(frequency), extra
        power = np.zeros((len(model.potential.monomials), self.n), dtype=int)
        for row, monomial in enumerate(model.potential.monomials):
            for mode in monomial:
                power[row, mode] += 1
        value = np.asarray(model.potential.coefficient)
        self.terms = []
        for m in range(self.n):
            rows = np.flatnonzero(power[:, m])
            lowered = power[rows] - np.eye(self.n, dtype=int)[m]
            self.terms.append((lowered, value[rows] * power[rows, m]))
        self.highest = int(power.max(initial=0))

    def acceleration(self, t, q, v):
        """q̈ of states in rows."""
        powers = q[:, None, :] ** np.arange(self.highest + 1)[:, None]  # (state, power, mode)
        modes = np.arange(self.n)
        a = self.load * np.cos(self.frequency * t) - self.squared * q - self.viscous * v
        for m, (lowered, value) in enumerate(self.terms):
            a[:, m] -= powers[:, lowered, modes].prod(axis=2) @ value
        if self.extra is not None:
            a[:, self.j] -= self.extra(q[:, self.j], v[:, self.j])
        return a

    def size(self, states):
        """Largest displacement and velocity of the states, the latter at least ΩQ."""
        q, v = np.abs(states).reshape(-1, 2, self.n).max(axis=(0, 2))
        return np.repeat([q, max(v, self.frequency * q)], self.n)

    def integrate(self, states, duration, rtol=1e-12, **options):
        """States (rows) after `duration`, by the eighth-order Dormand-Prince method."""
        states = np.atleast_2d(states)
        scale = self.size(states)

        def slope(t, flat):
            y = flat.reshape(states.shape) * scale
            q, v = y[:, : self.n], y[:, self.n :]
            return (np.concatenate([v, self.acceleration(t, q, v)], axis=1) / scale).ravel()

        solved = solve_ivp(
            slope,
            (0.0, duration),
            (states / scale).ravel(),
            method="DOP853",
            rtol=rtol,
            atol=rtol,
            **options,
        )
        assert solved.success
        return solved.y.T.reshape(-1, *states.shape) * scale

    def period_map(self, states):
        """States (rows) after one period of the force."""
        return self.integrate(states, 2 * np.pi / self.frequency)[-1]

    def closure(self, state):
        """How far the map over one period misses its start, relative to the state's size."""
        end = self.period_map(state)[0]
        size = self.size(state)
        return float(np.max(np.abs(end - state) / size))

    def multipliers(self, state, relative=1e-5):
        """Eigenvalues of the period map's slope, by central differences of the map.

        Their error is about `relative`² (truncation) + 1e-12/`relative` (integration).
        """
        size = self.size(state)
        shift = relative * np.diag(size)
        ends = self.period_map(np.concatenate([state + shift, state - shift]))
        half = len(state)
        slope = (ends[:half] - ends[half:]).T / (2 * relative)
        return np.linalg.eigvals(slope / size[:, None])


def initial_state(coefficients, frequency):
    """(q, q̇) at t = 0 of q = X₀ + Σ a_h cos hΩt + b_h sin hΩt."""
    orders = np.arange(1, (len(coefficients) - 1) // 2 + 1)
    q = coefficients[0] + coefficients[1::2].sum(axis=0)
    return np.concatenate([q, frequency * (orders @ coefficients[2::2])])


def spectrum_distance(first, second):
    """Largest distance between two sets of eigenvalues, paired as well as possible."""
    distance = np.abs(np.asarray(first)[:, None] - np.asarray(second)[None])
    return float(distance[linear_sum_assignment(distance)].max())


@pytest.fixture(scope="session")
def time_domain():
    return TimeDomain


@pytest.fixture(scope="session")
def state_of():
    return initial_state


@pytest.fixture(scope="session")
def distance_between():
    return spectrum_distance


@pytest.fixture(scope="session")
def flat_curve():
    """The flat beam's response at the paper's largest force, 9 harmonics."""
    model = flat_beam()
    hz = 2 * np.pi
    return model, forced_response(model, [FLAT_BEAM_FORCES[-1]], 60 * hz, 110 * hz)[0]


@pytest.fixture(scope="session")
def curved_curves():
    """The curved beam's responses at the paper's two lower forces, 9 harmonics."""
    model = curved_beam()
    hz = 2 * np.pi
    return model, forced_response(model, CURVED_BEAM_FORCES[:2], 30 * hz, 110 * hz)
