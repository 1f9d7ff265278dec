"""Exact responses of one mode with a cubic spring, by its balance of the first harmonic."""

import numpy as np

import snrmjax as sj
from snrmjax.measure import steady_states

OMEGA, ZETA, SHAPE = 2 * np.pi * 60.0, 0.02, 2.5
CUBIC = 0.1 * OMEGA**2  # of the displacement over its largest: frequencies rise by 3.7 %
STEEP = 4 * CUBIC  # by 14 %, seven bandwidths


def states(n=15, ratio=1.0):
    """Level, Ω, F, V of ω² + ¾γa², exactly: |F| gives two frequencies at every amplitude.

    `ratio` of both frequencies, ω and √γ, to these at the same damping 2ζω of motions alike.
    """
    rows = []
    for level, top in enumerate((0.3, 0.6, 1.0)):
        a = top * np.sin(np.linspace(0.25, np.pi - 0.25, n))
        side = np.sign(np.linspace(-1, 1, n) + 1e-9)
        k = ratio**2 * (OMEGA**2 + 0.75 * CUBIC * a**2)
        peak = ratio * np.sqrt(OMEGA**2 + 0.75 * CUBIC * top**2)
        force = 2 * ZETA * OMEGA * peak * top
        w = np.sqrt(k)
        for _ in range(40):
            w = np.sqrt(
                k + side * np.sqrt(np.maximum((force / a) ** 2 - (2 * ZETA * OMEGA * w) ** 2, 0))
            )
        v = 1j * w * force * np.ones(n) / (k - w**2 + 2j * ZETA * OMEGA * w)
        rows.append((np.full(n, level), w, np.full(n, force), v))
    level, w, force, v = (np.concatenate(one) for one in zip(*rows, strict=True))
    return level, w, force / SHAPE, SHAPE * v


def noisy(v, seed=0):
    """0.3 % and 0.17° of noise."""
    rng = np.random.default_rng(seed)
    return v * np.exp(0.003 * (rng.normal(size=len(v)) + 1j * rng.normal(size=len(v))))


def table(level, w, force, v, **more):
    """A table that states that noise."""
    stated = {"velocity_std": 0.003 * np.abs(v), "phase_std": np.full(len(v), 0.003)}
    return steady_states(level + 1, w, force, v, sensors=("tip",), **(stated | more))


def model(shape=SHAPE):
    """The linear mode."""
    modes = sj.model.linear_modes([OMEGA], [ZETA], [[shape]], [shape], sensors=("tip",))
    return sj.model.structure(modes)


def swept_up(n, early=0.0):
    """Ω, F, V of the largest level in a sweep upwards that falls to the lower branch.

    It falls at the fold, or `early` (relative to the resonance) below that of phase. The roots of
    a²((ω² + ¾γa² − Ω²)² + (2ζωΩ)²) = F² are exact.
    """
    force = 2 * ZETA * OMEGA * np.sqrt(OMEGA**2 + 0.75 * STEEP)
    top = np.sqrt(OMEGA**2 + 0.75 * STEEP)  # of the phase resonance, at a = 1
    w = np.linspace(0.95 * OMEGA, 1.25 * OMEGA, n)
    amplitude = []
    for one in w:
        k, g = OMEGA**2 - one**2, 0.75 * STEEP
        found = np.roots([g**2, 2 * k * g, k**2 + (2 * ZETA * OMEGA * one) ** 2, -(force**2)])
        real = np.sort(found.real[np.abs(found.imag) < 1e-9 * np.abs(found)])
        fallen = early and one > (1 - early) * top
        amplitude.append(np.sqrt(real[0] if fallen else real[-1]))
    k = OMEGA**2 + 0.75 * STEEP * np.array(amplitude) ** 2
    v = 1j * w * force / (k - w**2 + 2j * ZETA * OMEGA * w)
    return w, np.full(n, force / SHAPE), SHAPE * v


RUBBING_MASS, RUBBING_OMEGA, RUBBING_ZETA = 1.8, 2 * np.pi * 47.0, 0.004
RUBBING_CUBIC, RUBBING_SQUARE, RUBBING_SLIP = 4e9, 4.0, 0.02  # N/m³, N s²/m², N


def rubbing_test(seed):
    """States of m ẍ + c ẋ + q |ẋ| ẋ + R sign ẋ + k x + k₃ x³ = F by its balance of one harmonic.

    0.4 % of noise in force and velocity, 0.23° in phase; none is stated.
    """
    rng, rows = np.random.default_rng(seed), []
    mass, natural = RUBBING_MASS, RUBBING_OMEGA
    viscous, square = 2 * RUBBING_ZETA * natural * mass, 8 * RUBBING_SQUARE / (3 * np.pi)
    for level, force in enumerate((0.05, 0.2, 0.8, 2.0, 4.0)):
        phase = np.radians(np.linspace(-70, 70, 17))
        # F cos φ = c v + (8/3π) q v² + 4R/π: in phase with v.
        part = np.maximum(force * np.cos(phase) - 4 * RUBBING_SLIP / np.pi, 0)
        v = (np.sqrt(viscous**2 + 4 * square * part) - viscous) / (2 * square)
        phase, v = phase[v > 1e-4], v[v > 1e-4]
        w = np.full(len(v), natural)
        for _ in range(200):  # F sin φ = (k(a) − m w²) v/w
            stiffness = mass * natural**2 + 0.75 * RUBBING_CUBIC * (v / w) ** 2
            s = -force * np.sin(phase) / v
            w = (s + np.sqrt(s**2 + 4 * mass * stiffness)) / (2 * mass)
        rows.append((np.full(len(v), level), w, np.full(len(v), force), v * np.exp(1j * phase)))
    level, w, force, v = (np.concatenate(one) for one in zip(*rows, strict=True))
    force = force * np.exp(0.004 * rng.normal(size=len(v)))
    v = v * np.exp(0.004 * (rng.normal(size=len(v)) + 1j * rng.normal(size=len(v))))
    return steady_states(level + 1, w, force, v, sensors=("tip",))
