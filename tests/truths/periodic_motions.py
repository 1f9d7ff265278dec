"""Truth from outside: equations of motion written here again, integrated in time or balanced."""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, linear_sum_assignment


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
        """Largest displacement Q and velocity V of the states, at least V/Ω and ΩQ."""
        q, v = np.abs(states).reshape(-1, 2, self.n).max(axis=(0, 2))
        return np.repeat([max(q, v / self.frequency), max(v, self.frequency * q)], self.n)

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


class NumpyBalance:
    """Harmonic balance by sampling, in NumPy, of a structure with a polynomial potential.

    Takes numbers from a model, none of its methods. Unknowns are the coefficients
    (mean, cosine, sine, …) × mode over `scale`, flattened, and the motion's frequency over the
    first natural one. The force acts on harmonic `driven` of the motion.
    """

    def __init__(self, model, force, order, scale, driven=1):
        modes = model.modes
        self.n, self.order, self.scale, self.driven = modes.n_modes, order, scale, driven
        self.natural = np.asarray(modes.natural_frequency)
        self.viscous = 2 * np.asarray(modes.damping_ratio) * self.natural
        self.load = force * np.asarray(modes.participation)
        self.shape = np.asarray(modes.mode_shape)[0]
        self.unit = self.natural[0]
        self.power = np.zeros((len(model.potential.monomials), self.n), dtype=int)
        for row, monomial in enumerate(model.potential.monomials):
            for mode in monomial:
                self.power[row, mode] += 1
        self.value = np.asarray(model.potential.coefficient)
        samples = 2 ** int(np.ceil(np.log2((self.power.sum(axis=1).max(initial=1)) * order + 2)))
        angle = 2 * np.pi * np.outer(np.arange(samples) / samples, np.arange(1, order + 1))
        self.basis = np.ones((samples, 2 * order + 1))
        self.basis[:, 1::2], self.basis[:, 2::2] = np.cos(angle), np.sin(angle)
        self.inverse = np.linalg.pinv(self.basis)
        self.orders = np.concatenate([[0], np.repeat(np.arange(1, order + 1), 2)])

    def derivative(self, q, *by):
        """∂V/∂q_m or ∂²V/∂q_m∂q_n at samples in rows."""
        power, value = self.power.copy(), self.value.copy()
        for mode in by:
            value = value * power[:, mode]
            power[:, mode] = np.maximum(power[:, mode] - 1, 0)
        return np.prod(q[:, None, :] ** power, axis=2) @ value

    def linearised(self, y):
        """Residual (m/s² over scale·ω₁²) and Jacobian of a point (x, λ)."""
        x, omega = y[:-1].reshape(-1, self.n) * self.scale, y[-1] * self.unit
        size, n = len(x), self.n
        q = self.basis @ x
        force = self.inverse @ np.stack([self.derivative(q, m) for m in range(n)], axis=1)
        turned = np.zeros_like(x)  # d/dτ
        h = np.arange(1, self.order + 1)[:, None]
        turned[1::2], turned[2::2] = h * x[2::2], -h * x[1::2]
        inertia = self.natural**2 - (self.orders[:, None] * omega) ** 2
        residual = inertia * x + omega * self.viscous * turned + force
        residual[2 * self.driven - 1] -= self.load
        jacobian = np.zeros((size, n, size, n))
        swap = np.zeros((size, size))
        for k in range(1, self.order + 1):
            swap[2 * k - 1, 2 * k], swap[2 * k, 2 * k - 1] = k, -k
        for a in range(n):
            for b in range(n):
                tangent = self.derivative(q, a, b)[:, None] * self.basis
                jacobian[:, a, :, b] = self.inverse @ tangent
            jacobian[:, a, :, a] += np.diag(inertia[:, a]) + omega * self.viscous[a] * swap
        by_omega = -2 * self.orders[:, None] ** 2 * omega * x + self.viscous * turned
        unit = self.scale * self.unit**2
        matrix = jacobian.reshape(size * n, size * n) * self.scale
        matrix = np.column_stack([matrix, by_omega.ravel() * self.unit]) / unit
        return residual.ravel() / unit, matrix

    def solved(self, y, fixed):
        """Newton's method with one unknown held, to rounding."""
        y = np.array(y)
        free = np.arange(len(y)) != fixed
        for _ in range(30):
            residual, matrix = self.linearised(y)
            step = np.linalg.solve(matrix[:, free], residual)
            y[free] -= step
            if np.abs(step).max() < 1e-8 * np.abs(y).max():  # what is left is its square
                return y
        raise AssertionError("Newton's method of the reference did not converge")

    def tangent(self, y, along):
        """Unit tangent of the curve, in the direction `along`."""
        tangent = np.linalg.svd(self.linearised(y)[1])[2][-1]
        return tangent * np.sign(tangent @ along)

    def height(self, y):
        """|V₁|² of the first sensor, scaled, and its gradient."""
        x = y[:-1].reshape(-1, self.n) @ self.shape
        gradient = np.zeros((2 * self.order + 1, self.n))
        gradient[1:3] = 2 * y[-1] ** 2 * x[1:3, None] * self.shape
        square = x[1] ** 2 + x[2] ** 2
        return y[-1] ** 2 * square, np.append(gradient.ravel(), 2 * y[-1] * square)

    def test(self, kind, y, along):
        """What vanishes at an event."""
        if kind == "phase_resonance":  # V₁ ∝ i(a − ib): its imaginary part is that of i·a
            return y[self.n]
        tangent = self.tangent(y, along)
        return tangent[-1] if kind == "fold" else self.height(y)[1] @ tangent

    def event(self, kind, coefficients, frequency):
        """Ω (rad/s) and the velocity amplitude (m/s) of the event near a point.

        Along the unknown that changes fastest there, by brentq between points that bracket it.
        """
        start = np.append(coefficients.ravel() / self.scale, frequency / self.unit)
        along = np.linalg.svd(self.linearised(start)[1])[2][-1]
        fixed = int(np.argmax(np.abs(along)))

        def at(parameter):
            guess = start + along * (parameter - start[fixed]) / along[fixed]
            return self.solved(guess, fixed)

        def value(parameter):
            return self.test(kind, at(parameter), along)

        width = 1e-6
        while value(start[fixed] - width) * value(start[fixed] + width) > 0:
            width *= 2
            assert width < 1e-2, "there is no such event near the point"
        ends = start[fixed] - width, start[fixed] + width
        y = at(brentq(value, *ends, xtol=1e-14, rtol=1e-14))
        omega = y[-1] * self.unit
        return omega, np.sqrt(self.height(y)[0]) * self.scale * self.unit


def initial_state(coefficients, frequency):
    """(q, q̇) at t = 0 of q = X₀ + Σ a_h cos hΩt + b_h sin hΩt."""
    orders = np.arange(1, (len(coefficients) - 1) // 2 + 1)
    q = coefficients[0] + coefficients[1::2].sum(axis=0)
    return np.concatenate([q, frequency * (orders @ coefficients[2::2])])


def spectrum_distance(first, second):
    """Largest distance between two sets of eigenvalues, paired as well as possible."""
    distance = np.abs(np.asarray(first)[:, None] - np.asarray(second)[None])
    return float(distance[linear_sum_assignment(distance)].max())
