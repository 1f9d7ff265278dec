"""Integration in time of many oscillators at once: diffrax's Tsit5 with a fixed step.

A lane is one oscillator at one frequency. Time is τ = Ωt, so that a period is 2π for every lane;
rows of the state are displacements y, rates dy/dτ and internal states with a rate of their own.
"""

from functools import partial, reduce
from operator import mul
from typing import NamedTuple

import diffrax
import forces
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

jax.config.update("jax_enable_x64", True)
N_HARMONICS = 4  # 0 to 3


class System(NamedTuple):
    """What lanes that are integrated together have in common (hashable, for compilation)."""

    n_modes: int = 1
    fast: str = ""  # kind with internal states
    sliders: str = ""  # kind with sliders
    coupling: int = 0  # n of the potential b yⁿ y₂ to a second mode
    potential: tuple[tuple[tuple[int, ...], float], ...] = ()  # (modes of the monomial, over ω₁²)
    modal: tuple[tuple[float, ...], ...] = ()  # ω/ω₁, ζ, shape and participation over mode 1's
    steps: int = 384  # per period

    @property
    def n_slow(self) -> int:
        """States that a period map does not settle within a period."""
        return 2 * self.n_modes

    @property
    def n_states(self) -> int:
        """All states with a rate."""
        return self.n_slow + forces.N_FAST.get(self.fast, 0)

    @property
    def n_blocks(self) -> int:
        """Number of sliders."""
        return forces.SLIDERS.get(self.sliders, 0)

    @property
    def periods(self) -> int:
        """Periods of the period map: two where the first must settle internal states."""
        return 2 if self.fast or self.sliders else 1


def _potential_force(system: System, y: Array, scale: Array) -> Array:
    """∂V/∂q over ω₁²Q_s: a matrix of coefficients times the distinct products of q."""
    products: dict[tuple[int, ...], int] = {}
    entries = []
    for monomial, coefficient in system.potential:
        for mode in set(monomial):
            rest = list(monomial)
            rest.remove(mode)
            column = products.setdefault(tuple(sorted(rest)), len(products))
            entries.append((mode, column, coefficient * monomial.count(mode)))
    matrix = np.zeros((system.n_modes, len(products)))
    for mode, column, value in entries:
        matrix[mode, column] += value
    q = scale * y
    rows = [reduce(mul, (q[mode] for mode in product)) for product in products]
    return jnp.asarray(matrix) @ jnp.stack(rows) / scale


def rate(
    system: System, tau: Array, x: Array, args: tuple[dict[str, Array], Array, Array]
) -> Array:
    """dx/dτ of all lanes."""
    p, w, blocks = args
    m = system.n_modes
    y, slope, fast = x[:m], x[m : 2 * m], x[2 * m :]
    u = w * slope
    known = forces.kinds_in(p)
    own = sum(f(y[0], u[0], p) for k, f in forces.MEMORYLESS.items() if k in known)
    if system.fast:
        own = own + forces.fast_force(system.fast, y[0], fast, p)
    if system.sliders:
        stiffness, slip = forces.sliders(system.sliders, p)
        own = own - jnp.sum(stiffness * forces.dragged(y[0], blocks, slip), axis=0)
    r = 1 + p["lane.shift"]
    load = jnp.cos(tau) + p["lane.second"] * jnp.cos(2 * tau) + p["lane.third"] * jnp.cos(3 * tau)
    load = p["lane.force"] * load
    first = load - own - r**2 * y[0] - 2 * p["lane.damping"] * r * u[0]
    if system.potential:
        inner = _potential_force(system, y, p["beam.scale"])
        rest = [
            load * part - f - ratio**2 * yk - 2 * z * ratio * uk
            for (ratio, z, _, part), f, yk, uk in zip(
                system.modal[1:], inner[1:], y[1:], u[1:], strict=True
            )
        ]
        total = jnp.stack([first - inner[0], *rest])
    elif system.coupling:
        n, b, w2 = system.coupling, p["second.coupling"], p["second.frequency"]
        first = first - n * b * y[0] ** (n - 1) * y[1]
        second = -b * y[0] ** n - w2**2 * y[1] - 2 * p["second.damping"] * w2 * u[1]
        total = jnp.stack([first, second])
    else:
        total = first[None]
    acceleration = total.at[0].divide(1 + p["lane.mass"]) / w**2
    parts = [slope, acceleration]
    if system.fast:
        parts.append(forces.fast_rate(system.fast, y[0], u[0], fast, p) / w)
    return jnp.concatenate(parts)


def _sensor(system: System, p: dict[str, Array], w: Array, x: Array) -> Array:
    """Velocity at the sensor over the shape of mode 1, with the saturation of the sensor."""
    m = system.n_modes
    slopes = x[m : 2 * m]
    seen = slopes[0]
    if system.modal:
        seen = sum(shape * row for (_, _, shape, _), row in zip(system.modal, slopes, strict=True))
    velocity = w * seen
    return velocity / jnp.sqrt(1 + (p["lane.saturation"] * velocity) ** 2)


@partial(jax.jit, static_argnames=("system",))
def advance(
    system: System, p: dict[str, Array], w: Array, x: Array, blocks: Array, periods: Array
) -> tuple[Array, Array, Array, Array]:
    """Integrate over whole periods.

    Returns the states, the blocks' positions, and of the last period the phasors of the sensor's
    velocity, harmonics 0 to 3 (harmonic, lane), and of the fundamental of y.
    """
    solver, term = diffrax.Tsit5(), diffrax.ODETerm(partial(rate, system))
    h, n = 2 * np.pi / system.steps, system.steps
    orders = jnp.arange(N_HARMONICS)
    weight = jnp.where(orders == 0, 1.0, 2.0)[:, None] / n
    slip = forces.sliders(system.sliders, p)[1] if system.sliders else None

    def step(i: Array, carry: tuple) -> tuple:
        x, blocks, solver_state, velocity, displacement = carry
        at = (i % n) * h
        args = (p, w, blocks)
        x, _, _, solver_state, _ = solver.step(
            term, at, at + h, x, args, solver_state, made_jump=False
        )
        if slip is not None:
            blocks = forces.dragged(x[0], blocks, slip)
        turn = jnp.exp(-1j * orders * (at + h))[:, None] * weight
        fresh = i % n == 0
        velocity = jnp.where(fresh, 0.0, velocity) + turn * _sensor(system, p, w, x)
        displacement = jnp.where(fresh, 0.0, displacement) + turn[1] * x[0]
        return x, blocks, solver_state, velocity, displacement

    start = solver.init(term, 0.0, h, x, (p, w, blocks))
    empty = jnp.zeros((N_HARMONICS, x.shape[1]), dtype=complex)
    begin = (x, blocks, start, empty, empty[1])
    x, blocks, _, velocity, displacement = jax.lax.fori_loop(0, periods * n, step, begin)
    return x, blocks, velocity, displacement


class PeriodMap(NamedTuple):
    """What whole periods make of the states, with the derivative for the slow states."""

    state: np.ndarray  # state, lane
    blocks: np.ndarray  # slider, lane
    derivative: np.ndarray  # lane, slow state, slow state
    velocity: np.ndarray  # harmonic, lane
    displacement: np.ndarray  # lane


NUDGE = 1e-4  # of the displacement scale, for the derivative


def period_map(
    system: System, p: dict[str, np.ndarray], w: np.ndarray, x: np.ndarray, blocks: np.ndarray
) -> PeriodMap:
    """One period map of each lane, the derivative by integrating neighbours."""
    n, lanes = system.n_slow, len(w)
    nudges = np.zeros((n + 1, system.n_states, lanes))
    size = NUDGE * p["lane.speed"]
    for k in range(n):
        nudges[k + 1, k] = size
    many = np.concatenate([x + nudge for nudge in nudges], axis=1)
    again = {name: np.tile(value, n + 1) for name, value in p.items()}
    end, moved, velocity, displacement = map(
        np.asarray,
        advance(system, again, np.tile(w, n + 1), many, np.tile(blocks, n + 1), system.periods),
    )
    split = end.reshape(system.n_states, n + 1, lanes)
    derivative = (split[:n, 1:] - split[:n, :1]) / size
    return PeriodMap(
        state=split[:, 0],
        blocks=moved[:, :lanes],
        derivative=np.moveaxis(derivative, -1, 0),
        velocity=velocity[:, :lanes],
        displacement=displacement[:lanes],
    )
