"""Beams with friction in a joint, driven by a shaker, integrated in time: plain NumPy and SciPy.

A pinned beam of three modes with some dozens of friction sliders spread over a joint. A slider is
a spring k in series with friction: its force is k·(u − z), where u is the bending that it sees, as
a combination of all modes, and z its slip, which follows u at the distance of its slip limit. The
springs of stuck sliders are part of the linear beam, whose motion is exact from step to step
(matrix exponential); slip and drive are straight lines between steps. Many beams at many levels
run side by side, each with its own frequency and the same number of steps a cycle.

The shaker's coil gives the force F·b(x)·cos(Ωt) − c·b(x)²·ẋ with b = 1 − β·x² at the drive point
x: its own velocity takes force away where the beam resonates, and an uneven field (β) makes
harmonics. What a test records is the force between shaker and beam: less the moving mass's inertia.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh, expm

STEPS = 96  # a cycle
RECORDED = 4  # cycles at the end of a state from which it is read
N_MODES = 3


class Beams(NamedTuple):
    """Rows of beams, one a row of what is integrated: modes of the beam whose joint is open."""

    own: np.ndarray  # (row, mode) natural frequencies without any slider, rad/s
    damping: np.ndarray  # (row,) ratio of every mode without slip
    bending: np.ndarray  # (row, slider, mode) that a slider sees, per modal displacement
    stiffness: np.ndarray  # (row, slider) N/m
    limit: np.ndarray  # (row, slider) bending in m at which a slider slips
    drive: np.ndarray  # (row, mode) mass-normalised shape at the drive point, kg^-1/2
    moving_mass: np.ndarray  # (row,) of the shaker, kg
    back: np.ndarray  # (row,) N s/m: what the coil's velocity takes from its force
    uneven: np.ndarray  # (row,) 1/m², of the shaker's field

    def rows(self, index: np.ndarray) -> "Beams":
        """Some of the rows, or some of them several times."""
        return Beams(*(part[index] for part in self))

    def stuck(self, drift: np.ndarray | float = 0.0) -> np.ndarray:
        """(row, mode, mode) stiffness where nothing slips, of a frequency that drifted."""
        springs = np.einsum("rs,rsi,rsj->rij", self.stiffness, self.bending, self.bending)
        whole = springs + self.own[:, :, None] ** 2 * np.eye(N_MODES)
        return whole * (1 + np.broadcast_to(drift, len(self.own)))[:, None, None] ** 2

    def viscous(self) -> np.ndarray:
        """(row, mode, mode) viscous damping of the beam."""
        return 2 * (self.damping[:, None] * self.own)[:, :, None] * np.eye(N_MODES)


class State(NamedTuple):
    """Where the rows are: modal displacements and velocities, slip, and the force's part of p."""

    motion: np.ndarray  # (row, 6)
    slip: np.ndarray  # (row, slider)
    load: np.ndarray  # (row, mode) at the present step


class Reading(NamedTuple):
    """What is read of the last cycles: phasors of e^{+iΩt}, and power."""

    force: np.ndarray  # (row,) N, recorded between shaker and beam
    velocity: np.ndarray  # (row,) m/s at the drive point
    dissipated: np.ndarray  # (row,) W by the beam alone: sliders and viscous damping


def linear_modes(beams: Beams) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Natural frequencies (rad/s), damping ratios and shapes at the drive point, nothing slipping.

    Rows by modes, without the shaker.
    """
    found = [eigh(matrix) for matrix in beams.stuck()]
    frequency = np.sqrt([values for values, _ in found])
    vectors = np.array([columns for _, columns in found])
    viscous = np.einsum("rij,ril,rlj->rj", vectors, beams.viscous(), vectors)
    return frequency, viscous / (2 * frequency), np.einsum("ri,rij->rj", beams.drive, vectors)


def at_rest(beams: Beams) -> State:
    """Nothing moves and nothing has slipped."""
    n, sliders = beams.stiffness.shape
    return State(np.zeros((n, 2 * N_MODES)), np.zeros((n, sliders)), np.zeros((n, N_MODES)))


def _propagators(beams: Beams, omega: np.ndarray, drift: np.ndarray) -> tuple:
    """Φ, Γ₀, Γ₁ of x⁺ = Φx + Γ₀p + Γ₁p⁺ over a step, of loads p that are straight between steps."""
    n, m = len(omega), N_MODES
    both = beams.drive[:, :, None] * beams.drive[:, None, :]
    inverse = np.linalg.inv(np.eye(m) + beams.moving_mass[:, None, None] * both)
    damping = beams.viscous() + beams.back[:, None, None] * both
    block = np.zeros((n, 4 * m, 4 * m))
    block[:, :m, m : 2 * m] = np.eye(m)
    block[:, m : 2 * m, :m] = -inverse @ beams.stuck(drift)
    block[:, m : 2 * m, m : 2 * m] = -inverse @ damping
    block[:, m : 2 * m, 2 * m : 3 * m] = inverse
    step = 2 * np.pi / (STEPS * omega)
    scaled = block * step[:, None, None]
    scaled[:, 2 * m : 3 * m, 3 * m :] = np.eye(m)  # the load's change over the step
    whole = expm(scaled)
    first, second = whole[:, : 2 * m, 2 * m : 3 * m], whole[:, : 2 * m, 3 * m :]
    return whole[:, : 2 * m, : 2 * m], first - second, second


def held(
    beams: Beams,
    drive: np.ndarray,
    omega: np.ndarray,
    state: State,
    cycles: int,
    drift: np.ndarray | float = 0.0,
) -> tuple[State, Reading]:
    """Hold every row's frequency (rad/s) and drive force (N) for some cycles, and read the last.

    `drift` is the relative change of the beam's natural frequencies meanwhile.
    """
    m, n = N_MODES, len(omega)
    transition, before, after = _propagators(beams, omega, np.broadcast_to(drift, n))
    carried = np.concatenate([transition, before], axis=2)
    # Slip pushes the modes by k·b·z; the sliders see b·q.
    push = beams.stiffness[:, :, None] * beams.bending
    see, push_of = np.ascontiguousarray(beams.bending), np.ascontiguousarray(push.swapaxes(1, 2))
    motion, slip, load = state
    limit, shape, back = beams.limit, beams.drive, beams.back
    viscous = beams.viscous()
    uneven = bool(np.any(beams.uneven))
    sums = np.zeros((3, n), dtype=complex)  # of velocity, displacement and the coil's force
    work = np.zeros(n)
    angle = 2 * np.pi * np.arange(1, STEPS + 1) / STEPS
    for cycle in range(cycles):
        reading = cycle >= cycles - RECORDED
        for phase in angle:
            present = np.matmul(carried, np.concatenate([motion, load], axis=1)[:, :, None])
            present = present[:, :, 0]
            new, moved = load, motion
            swung = drive * np.cos(phase)
            for _ in range(2):  # slip as predicted, then as corrected
                moved = present + np.matmul(after, new[:, :, None])[:, :, 0]
                seen = np.matmul(see, moved[:, :m, None])[:, :, 0]
                slipped = np.clip(slip, seen - limit, seen + limit)
                coil = swung
                if uneven:
                    field = 1 - beams.uneven * np.einsum("rm,rm->r", shape, moved[:, :m]) ** 2
                    speed = np.einsum("rm,rm->r", shape, moved[:, m:])
                    coil = swung * field + back * speed * (1 - field**2)
                new = np.matmul(push_of, slipped[:, :, None])[:, :, 0] + coil[:, None] * shape
            if reading:
                turned = np.exp(-1j * phase)
                sums[0] += turned * np.einsum("rm,rm->r", shape, moved[:, m:])
                sums[1] += turned * np.einsum("rm,rm->r", shape, moved[:, :m])
                sums[2] += turned * coil
                tension = beams.stiffness * (seen - slipped)
                work += np.einsum("rs,rs->r", tension, slipped - slip)
                rate = np.einsum("ri,rij,rj->r", moved[:, m:], viscous, moved[:, m:])
                work += rate * 2 * np.pi / (STEPS * omega)
            motion, slip, load = moved, slipped, new
    velocity, displacement, coil_force = 2 * sums / (STEPS * RECORDED)
    # Straight lines between samples of a cosine have this share of its fundamental.
    coil_force *= np.sinc(1 / STEPS) ** 2
    force = coil_force - back * velocity + beams.moving_mass * omega**2 * displacement
    return State(motion, slip, load), Reading(
        force, velocity, work * omega / (2 * np.pi * RECORDED)
    )


def phase_resonance(
    beams: Beams,
    drive: np.ndarray,
    guess: np.ndarray,
    drift: np.ndarray | float = 0.0,
    cycles: int = 400,
    turns: int = 7,
) -> tuple[np.ndarray, Reading]:
    """Frequencies (rad/s) at which the velocity is in phase with the recorded force.

    By secants in frequency, each held until it is steady, as a phase-locked loop would.
    """

    def phase_of(reading: Reading) -> np.ndarray:
        return np.angle(reading.velocity / reading.force)

    state = at_rest(beams)
    omega = guess.copy()
    state, reading = held(beams, drive, omega, state, cycles, drift)
    mobility = np.abs(reading.velocity / reading.force)
    # Of one mode: the phase falls by 2·m·(velocity over force) for every rad/s.
    _, _, shape = linear_modes(beams)
    slope = -2 * mobility / shape[:, 0] ** 2
    for _ in range(turns):
        phase = phase_of(reading)
        step = np.clip(-phase / slope, -0.01 * omega, 0.01 * omega)
        omega = omega + step
        state, reading = held(beams, drive, omega, state, cycles, drift)
        change = phase_of(reading) - phase
        trusted = (np.abs(step) > 1e-7 * omega) & (change * step < 0)
        slope = np.where(trusted, change / np.where(step == 0, 1.0, step), slope)
    return omega, reading
