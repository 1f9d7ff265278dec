"""States of a mode whose damping grows as Q²: by cubic damping, or by van der Pol's.

Cubic damping c q̇³ and van der Pol's c q²q̇ with one Δδ = ¾cΩ²Q² = cQ²/4 do the same to a
fundamental. Their forces have third harmonics of ¼cΩ³Q³ and ¼cΩQ³, of opposite sign: to first order
|V₃/V₁| = Δδ/8Ω and 3Δδ/8Ω, ahead and behind by a quarter of the phase of V₁ thrice.
"""

import numpy as np

import snrmjax as sj

SHAPE, PARTICIPATION, OMEGA, ZETA = 2.0, 3.0, 300.0, 0.01
NOISE = {"velocity": 0.01, "phase": 0.012, "force": 0.003}
GROWTH = 6e6  # Δδ over Q², 1/s and kg^1/2 m
THIRD = {"cubic_damping": 1j / 8, "van_der_pol_damping": -3j / 8}  # V₃/V₁ over Δδ/Ω
PHASES = np.radians(np.linspace(-55, 55, 9))
TIPS = np.geomspace(1e-4, 1e-3, 5)  # Q at resonance


def linear_model():
    modes = sj.model.linear_modes(
        [OMEGA],
        [ZETA],
        [[SHAPE]],
        [PARTICIPATION],
        std=sj.model.LinearModesStd([1e-4 * OMEGA], [0.01 * ZETA]),
    )
    return sj.model.structure(modes)


def measured(kind=None, harmonic_std=np.nan, harmonics_at=(), seed=0):
    """States of a linear mode with δ = 2ζω₀ + GROWTH·Q², harmonic 3 at some levels, and noise."""
    rng = np.random.default_rng(seed)
    level, phase = (a.ravel() for a in np.meshgrid(np.arange(5), PHASES, indexing="ij"))
    x = TIPS[level] * np.cos(phase)
    omega = OMEGA * (1 - ZETA * np.tan(phase))
    growth = GROWTH * x**2
    needed = OMEGA**2 - omega**2 + 1j * omega * (2 * ZETA * OMEGA + growth)
    force = np.abs(needed) * x / PARTICIPATION
    exact = 1j * omega * x * np.exp(-1j * np.angle(needed)) * SHAPE
    n = len(level)
    own = np.exp(NOISE["velocity"] * rng.normal(size=n) + 1j * NOISE["phase"] * rng.normal(size=n))
    velocity = exact * own
    third = np.zeros(n, dtype=complex)
    if kind is not None:
        turn = np.exp(3j * np.angle(exact))
        third = THIRD[kind] * growth / omega * np.abs(exact) * turn * own**3 / np.abs(own) ** 2
        third = third + harmonic_std / np.sqrt(2) * (rng.normal(size=n) + 1j * rng.normal(size=n))
    seen = np.isin(level, harmonics_at)
    second = harmonic_std / np.sqrt(2) * (rng.normal(size=n) + 1j * rng.normal(size=n))
    return sj.measure.steady_states(
        level,
        omega,
        force * np.exp(NOISE["force"] * rng.normal(size=n)),
        velocity,
        velocity_std=NOISE["velocity"] * np.abs(velocity),
        phase_std=np.full(n, NOISE["phase"]),
        force_std=NOISE["force"] * force,
        harmonics=np.stack([second, third], axis=1)[:, None] if kind else None,
        harmonic_std=np.where(seen, harmonic_std, np.nan),
        harmonic_order=(2, 3) if kind else (),
    )
