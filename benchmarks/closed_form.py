"""A mode in closed form: steady states of given curves, solved with nothing of the package.

A x = (ω̃² − Ω² + iΩ·2ζ̃ω̃) x = c F, with ω̃² of the displacement and 2ζ̃ω̃ of the velocity.
"""

import numpy as np

OMEGA, CONSTANT = 500.0, 6.0  # rad/s at rest; c, 1/kg


def squared(x: np.ndarray) -> np.ndarray:
    """ω̃² against displacement (m)."""
    return OMEGA**2 * (1 + 0.3 * (x / 2e-3) ** 2)


def damping(v: np.ndarray) -> np.ndarray:
    """2ζ̃ω̃ against velocity (m/s)."""
    return 12.0 + 6.0 * v


def needed(x: np.ndarray, omega: np.ndarray) -> np.ndarray:
    """Complex force over displacement times A."""
    return squared(x) - omega**2 + 1j * omega * damping(x * omega)


def at_phase(force: float, phase: float) -> tuple[float, complex]:
    """Frequency and velocity under a force where the velocity has a phase, by bisection."""
    low, high, omega = 1e-6, 1e-2, OMEGA
    for _ in range(200):
        x = 0.5 * (low + high)
        omega = np.sqrt(squared(x))
        for _ in range(60):
            omega = np.sqrt(squared(x) - omega * damping(x * omega) * np.tan(phase))
        below = abs(needed(x, omega)) * x < CONSTANT * force
        low, high = (x, high) if below else (low, x)
    return float(omega), 1j * omega * CONSTANT * force / needed(x, omega)


def at_frequency(force: float, omega: float, expected: float) -> complex:
    """The motion under a force at a frequency whose velocity is nearest to the expected one."""
    x = np.linspace(1e-6, 4e-3, 40001)
    excess = np.abs(needed(x, omega)) * x - CONSTANT * force
    at = np.flatnonzero(np.signbit(excess[:-1]) != np.signbit(excess[1:]))
    roots = x[at] - excess[at] * (x[1] - x[0]) / (excess[at + 1] - excess[at])
    best = roots[np.argmin(np.abs(roots * omega - expected))]
    return 1j * omega * CONSTANT * force / needed(best, omega)
