"""Steady states of one nonlinear mode that obey given curves exactly, made without a solver."""

import numpy as np

import snrmjax as sj

SHAPE, PARTICIPATION = 2.0, 3.0
CONSTANT = SHAPE * PARTICIPATION
OMEGA, LEVELS = 500.0, 5
TRUE = {"backbone": "polynomial:1@displacement", "damping": "viscous_quadratic@velocity"}


def squared(x):
    """ω̃² against displacement (m)."""
    return OMEGA**2 * (1 + 0.3 * (x / 2e-3) ** 2)


def damping(v):
    """2ζ̃ω̃ against velocity (m/s)."""
    return 12.0 + 6.0 * v


def truth_at(speeds):
    """ω̃² and 2ζ̃ω̃ where X ω̃(X) is the velocity, by bisection."""
    low, high = np.zeros(len(speeds)), np.full(len(speeds), 1e-2)
    for _ in range(100):
        middle = 0.5 * (low + high)
        below = middle * np.sqrt(squared(middle)) < speeds
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return squared(low), damping(speeds)


def modes():
    """The one mode."""
    return sj.model.linear_modes([OMEGA], [0.012], [[SHAPE]], [PARTICIPATION])


def exact(per_level=9, widest=60):
    """Level, Ω, force and velocity of states within some degrees of resonance.

    For a displacement X and a frequency Ω the force that holds them is |(ω̃² − Ω²) + iΩδ| X/A, and
    the velocity's phase follows: nothing is solved.
    """
    rows = []
    for level, tip in enumerate(np.linspace(3e-4, 2e-3, LEVELS)):
        for phase in np.radians(np.linspace(-widest, widest, per_level)):
            x = tip * np.cos(phase)
            omega = np.sqrt(squared(x))
            for _ in range(200):  # Ω at which the phase is wanted: (ω̃² − Ω²) = Ωδ tan φ
                omega = np.sqrt(squared(x) - omega * damping(x * omega) * np.tan(phase))
            needed = squared(x) - omega**2 + 1j * omega * damping(x * omega)
            force = abs(needed) * x / CONSTANT
            velocity = 1j * omega * CONSTANT * force / needed
            rows.append((level, omega, force, velocity))
    level, omega, force, velocity = (np.array(column) for column in zip(*rows, strict=True))
    return level, omega.real, force.real, velocity


NOISE = {"velocity": 0.01, "phase": 0.012, "force": 0.003}


def noisy(seed=None, gain=0.0, scale=1.0, per_level=9, widest=60):
    """The states with stated noise, which seed None leaves out."""
    level, omega, force, velocity = exact(per_level, widest)
    n = len(level)
    if seed is not None:
        rng = np.random.default_rng(seed)
        shared = gain * rng.normal(size=LEVELS)[level]
        own = NOISE["velocity"] * rng.normal(size=n) + 1j * NOISE["phase"] * rng.normal(size=n)
        velocity = velocity * np.exp(shared + scale * own)
        force = force * np.exp(scale * NOISE["force"] * rng.normal(size=n))
    return stated(level, omega, force, velocity)


def stated(level, omega, force, velocity, **others):
    """`SteadyStates` with the noise stated."""
    return sj.measure.steady_states(
        level,
        omega,
        force,
        velocity,
        velocity_std=NOISE["velocity"] * np.abs(velocity),
        phase_std=np.full((len(level), 1), NOISE["phase"]),
        force_std=NOISE["force"] * force if force is not None else None,
        **others,
    )


GAIN = 2.5  # N/V


def driven(widest, per_level=7, *, drift=0.0, noise=0.003):
    """A test whose force is known in volts; `drift` scales the velocities level by level."""
    level, omega, force, velocity = exact(per_level, widest)
    rng = np.random.default_rng(4)
    wrong = 1 + drift * (level / (LEVELS - 1) - 0.5)
    noisy = velocity * wrong * np.exp(noise * (rng.normal(size=(2, len(level))).T @ [1, 1j]))
    unknown = np.full(len(level), np.nan)
    stds = {"velocity_std": noise * np.abs(noisy), "phase_std": np.full((len(level), 1), noise)}
    return sj.measure.steady_states(level, omega, unknown, noisy, drive=force / GAIN, **stds)
