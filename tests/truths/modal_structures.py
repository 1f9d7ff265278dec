"""Linear structures of springs and masses: modes by eigenvalues, responses by matrices, motion by
scipy's time integration. Nothing of the package is used."""

from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.signal

HERTZ = 2 * np.pi


class Chain(NamedTuple):
    """Mass, damping (modal) and stiffness with modes (mass-normalised columns)."""

    mass: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    natural_frequency: np.ndarray  # rad/s
    damping_ratio: np.ndarray
    shapes: np.ndarray


def chain(masses, springs, ratios, *, walls=(True, False)):
    """Masses in a row; springs between them, and to a wall at either end where there is one."""
    n = len(masses)
    stiffness = np.zeros((n, n))
    ends = [-1] * walls[0] + list(range(n)) + [n] * walls[1]
    for value, a, b in zip(springs, ends[:-1], ends[1:], strict=True):
        for i in (a, b):
            if 0 <= i < n:
                stiffness[i, i] += value
        if a >= 0 and b < n:
            stiffness[a, b] -= value
            stiffness[b, a] -= value
    mass = np.diag(masses).astype(float)
    square, shapes = scipy.linalg.eigh(stiffness, mass)
    natural = np.sqrt(np.maximum(square, 0.0))
    natural[np.abs(square) < 1e-9 * square.max()] = 0.0
    modal = np.diag(2 * np.asarray(ratios) * natural)
    damping = mass @ shapes @ modal @ shapes.T @ mass
    return Chain(mass, damping, stiffness, natural, np.asarray(ratios, float), shapes)


def receptance(structure, omega, driven):
    """Displacements over a force at one mass, by solving the dynamic stiffness."""
    force = np.eye(len(structure.mass))[driven]
    return np.stack(
        [
            np.linalg.solve(
                structure.stiffness - w**2 * structure.mass + 1j * w * structure.damping, force
            )
            for w in omega
        ],
        axis=1,
    )


def base_response(structure, omega):
    """Displacements relative to a base over its acceleration: the force is −m a."""
    force = -np.diag(structure.mass)
    return np.stack(
        [
            np.linalg.solve(
                structure.stiffness - w**2 * structure.mass + 1j * w * structure.damping, force
            )
            for w in omega
        ],
        axis=1,
    )


def integrated(structure, force, rate, *, start=None):
    """Displacement, velocity and acceleration of all masses under a force vector in time."""
    n = len(structure.mass)
    inverse = np.linalg.inv(structure.mass)
    a = np.block(
        [
            [np.zeros((n, n)), np.eye(n)],
            [-inverse @ structure.stiffness, -inverse @ structure.damping],
        ]
    )
    b = np.concatenate([np.zeros((n, n)), inverse])
    time = np.arange(len(force)) / rate
    system = (a, b, np.eye(2 * n), np.zeros((2 * n, n)))
    _, _, state = scipy.signal.lsim(system, force, time, X0=start)
    acceleration = state @ a[n:].T + force @ inverse.T
    return state[:, :n], state[:, n:], acceleration


def accelerations(structure, force, rate, driven=0):
    """Accelerations of all masses under a force on one, mode by mode as digital filters.

    Each mode is sampled with the force linear between samples (scipy's first-order hold): take a
    rate far above the force's band.
    """
    found = np.zeros((len(structure.mass), len(force)))
    for omega, ratio, shape in zip(
        structure.natural_frequency, structure.damping_ratio, structure.shapes.T, strict=True
    ):
        mode = ([1.0, 0.0, 0.0], [1.0, 2 * ratio * omega, omega**2])
        top, bottom, _ = scipy.signal.cont2discrete(mode, 1 / rate, method="foh")
        modal = scipy.signal.lfilter(np.ravel(top), bottom, force * shape[driven])
        found += shape[:, None] * modal
    return found


def held_linear(force):
    """A force as it is between samples when it is linear there: its spectrum times sinc²."""
    fraction = np.fft.rfftfreq(len(force))
    return np.fft.irfft(np.fft.rfft(force) * np.sinc(fraction) ** 2, len(force))


def random_force(rng, samples, rate, top):
    """Random noise without content above `top` (Hz), of unit rms."""
    sections = scipy.signal.butter(8, top, fs=rate, output="sos")
    noise = scipy.signal.sosfilt(sections, rng.normal(size=samples))
    return noise / noise.std()


def welch(force, motions, rate, length):
    """H1 estimates, coherence and the number of windows, Hann, half overlapped."""
    settings = {"fs": rate, "nperseg": length, "window": "hann", "detrend": False}
    hertz, power = scipy.signal.welch(force, **settings)
    rows, seen = [], []
    for motion in motions:
        _, cross = scipy.signal.csd(force, motion, **settings)
        _, own = scipy.signal.welch(motion, **settings)
        rows.append(cross / power)
        seen.append(np.abs(cross) ** 2 / power / own)
    count = 2 * len(force) // length - 1
    return hertz * HERTZ, np.array(rows), np.array(seen), count
