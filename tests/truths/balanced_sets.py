"""Sets whose truth is known: files that time integration made, and states of a changed balance."""

import json
from pathlib import Path

import numpy as np

import snrmjax as sj
from snrmjax.io.models import read_model
from snrmjax.io.tables import read_steady_states

HERE = Path(__file__).resolve().parents[1] / "diagnose"


KEYS = json.loads((HERE / "keys.json").read_text())


SHAPE, PARTICIPATION, OMEGA, ZETA = 2.0, 3.0, 300.0, 0.01


NOISE = {"velocity": 0.01, "phase": 0.012, "force": 0.003}


def files(name, folder="blind"):
    """Model and data of a set."""
    model = read_model(HERE / folder / f"{name}.toml")
    return model, read_steady_states(HERE / folder / f"{name}.csv", model)


def balanced(change_of_damping, seed=0, levels=5, per_level=9, shift=0.0):
    """States of a linear mode whose damping changes with velocity, and their noise.

    `shift` is the relative 1σ by which the natural frequency differs from level to level.

    For a displacement and a frequency the force that holds them is known: nothing is solved.
    """
    rng = np.random.default_rng(seed)
    rows = []
    shifts = shift * np.random.default_rng([seed, 1]).normal(size=levels)
    for level, tip in enumerate(np.geomspace(1e-4, 1e-3, levels)):
        for phase in np.radians(np.linspace(-55, 55, per_level)):
            x = tip * np.cos(phase)
            omega = OMEGA * (1 - ZETA * np.tan(phase))
            damping = 2 * ZETA * OMEGA + change_of_damping(omega * x)
            needed = (OMEGA * (1 + shifts[level])) ** 2 - omega**2 + 1j * omega * damping
            rows.append((level, omega, abs(needed) * x / (SHAPE * PARTICIPATION), needed, x))
    level, omega, force, needed, x = (np.array(column) for column in zip(*rows, strict=True))
    velocity = 1j * omega * x * np.exp(-1j * np.angle(needed))
    n = len(level)
    own = NOISE["velocity"] * rng.normal(size=n) + 1j * NOISE["phase"] * rng.normal(size=n)
    velocity = velocity * np.exp(own)
    force = force * np.exp(NOISE["force"] * rng.normal(size=n))
    return sj.measure.steady_states(
        level,
        omega.real,
        force.real,
        velocity,
        velocity_std=NOISE["velocity"] * np.abs(velocity),
        phase_std=np.full((n, 1), NOISE["phase"]),
        force_std=NOISE["force"] * force.real,
    )


def linear_model(frequency=OMEGA, damping=ZETA, damping_std=0.01, **settings):
    modes = sj.model.linear_modes(
        [frequency],
        [damping],
        [[SHAPE]],
        [PARTICIPATION],
        std=sj.model.LinearModesStd([1e-4 * OMEGA], [damping_std * ZETA]),
    )
    return sj.model.structure(modes, **settings)


def beside(frequency, damping, constant, stiffening=0.0, seed=0):
    """States of the mode, perhaps with a cubic stiffness, beside a linear one that is seen too.

    The motion's force is known, and with it what the other mode does: nothing is solved.
    """
    rng = np.random.default_rng(seed)
    rows = []
    for level, tip in enumerate(np.geomspace(1e-4, 1e-3, 5)):
        for phase in np.radians(np.linspace(-60, 60, 11)):
            x = tip * np.cos(phase)
            squared = OMEGA**2 * (1 + stiffening * (x / 1e-3) ** 2)
            omega = np.sqrt(squared) * (1 - ZETA * np.tan(phase))
            force = (squared - omega**2 + 2j * ZETA * OMEGA * omega) * x / (SHAPE * PARTICIPATION)
            other = constant * force / (frequency**2 - omega**2 + 2j * damping * frequency * omega)
            rows.append((level, omega, force, 1j * omega * (x + other)))
    level, omega, force, velocity = (np.array(column) for column in zip(*rows, strict=True))
    velocity = velocity * np.exp(-1j * np.angle(force))
    n = len(level)
    own = NOISE["velocity"] * rng.normal(size=n) + 1j * NOISE["phase"] * rng.normal(size=n)
    return sj.measure.steady_states(
        level.real.astype(int),
        omega.real,
        np.abs(force) * np.exp(NOISE["force"] * rng.normal(size=n)),
        velocity * np.exp(own),
        velocity_std=NOISE["velocity"] * np.abs(velocity),
        phase_std=np.full((n, 1), NOISE["phase"]),
        force_std=NOISE["force"] * np.abs(force),
    )


def quadratic(velocity):
    """The change of damping that quadratic damping makes, 18 kg^-1/2 at these shapes."""
    return 8.0 * velocity
