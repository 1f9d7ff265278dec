"""Stepped sweeps of many lanes at once: the state is carried from one frequency to the next.

At a new frequency each lane looks for the periodic motion next to the one it comes from, by
Newton's method on the period map (shooting). It is recorded only if it is stable (all multipliers
inside the unit circle) and near. Otherwise the lane is integrated on from where it was until it
settles, wherever that is: a jump, as in the laboratory. A frequency at which nothing settles is
left out and counted.
"""

import dataclasses

import numpy as np
from integration import System, advance, period_map

CHUNKS = (16, 64, 256)  # lanes integrated together: the smallest that holds those at hand
SETTLING_CHUNKS = (16, 64)
LIMIT_DEG = 66.0  # sweeps end beyond this phase
MAX_POINTS = 60
MAX_NEWTON = 10
MAX_SETTLING = 5


@dataclasses.dataclass
class Lanes:
    """Sweeps to run: one entry a lane in each array."""

    parameters: dict[str, np.ndarray]
    start: np.ndarray  # Ω/ω₀
    direction: np.ndarray  # +1 up, −1 down
    step_deg: np.ndarray  # change of phase aimed at from point to point
    clock: np.ndarray  # time of the test at the lane's start, 0…1
    tick: np.ndarray  # and from point to point

    @property
    def n(self) -> int:
        """Number of lanes."""
        return len(self.start)


@dataclasses.dataclass
class Point:
    """One steady state."""

    frequency: float  # Ω/ω₀
    clock: float
    velocity: np.ndarray  # phasors of harmonics 0 to 3
    displacement: complex  # fundamental of y
    jumped: bool
    residual: float  # of periodicity, over the amplitude


@dataclasses.dataclass
class Sweep:
    """What one lane recorded."""

    points: list[Point]
    left_out: int  # frequencies at which nothing settled


def _linear_state(lanes: Lanes, system: System) -> np.ndarray:
    p, w = lanes.parameters, lanes.start
    y = p["lane.force"] / (1 - w**2 + 2j * p["lane.damping"] * w)
    # Beside resonance the backbone has moved: keep the amplitude of the phase that is aimed at.
    size = p["lane.force"] / (2 * p["lane.damping"]) * np.cos(np.radians(72.0))
    y = y / np.abs(y) * np.minimum(size, np.abs(y))
    state = np.zeros((system.n_states, lanes.n))
    state[0], state[system.n_modes] = y.real, -y.imag
    return state


def _padded(index: np.ndarray, sizes: tuple[int, ...]) -> np.ndarray:
    size = next(size for size in sizes if size >= len(index))
    return np.concatenate([index, np.full(size - len(index), index[0])])


class _Run:
    """The sweeps in progress."""

    def __init__(self, system: System, lanes: Lanes) -> None:
        n = lanes.n
        self.system, self.lanes = system, lanes
        self.w = lanes.start.copy()
        self.x = _linear_state(lanes, system)
        self.blocks = np.zeros((system.n_blocks, n))
        self.kept_x, self.kept_blocks = np.zeros_like(self.x), np.zeros_like(self.blocks)
        self.clock, self.warmth = lanes.clock.copy(), np.zeros(n)
        self.iteration, self.settlings = np.zeros(n, dtype=int), np.zeros(n, dtype=int)
        self.failures, self.skipped = np.zeros(n, dtype=int), np.zeros(n, dtype=int)
        self.step = 0.4 * lanes.parameters["lane.damping"]
        self.active = np.ones(n, dtype=bool)
        self.points: list[list[Point]] = [[] for _ in range(n)]
        self.tolerance = 1e-7 if system.periods > 1 else 2e-8

    def parameters(self, index: np.ndarray) -> dict[str, np.ndarray]:
        """Parameters of some lanes at this time of their test."""
        p = {name: value[index] for name, value in self.lanes.parameters.items()}
        p["lane.shift"] = (
            p["lane.shift"]
            + p.pop("test.drift") * self.clock[index]
            + p.pop("test.jump") * (self.clock[index] > p.pop("test.jump_at"))
            - self.warmth[index]
        )
        p.pop("test.warming")
        p.pop("test.warming_rate")
        return p

    def newton(self, index: np.ndarray) -> np.ndarray:
        """One Newton step of some lanes; returns those that must be settled."""
        size = len(index)
        padded = _padded(index, CHUNKS)
        result = period_map(
            self.system, self.parameters(padded), self.w[padded], self.x[:, padded],
            self.blocks[:, padded],
        )  # fmt: skip
        scale = self.lanes.parameters["lane.speed"][index]
        x, n = self.x[:, index], self.system.n_slow
        change = result.state[:, :size] - x
        moved = np.abs(result.blocks[:, :size] - self.blocks[:, index]).max(axis=0, initial=0.0)
        residual = np.maximum(np.abs(change).max(axis=0), moved) / scale
        bad = ~np.isfinite(residual) | (np.abs(x).max(axis=0) > 30 * scale)
        derivative = np.where(bad[:, None, None], 0.0, result.derivative[:size])
        multiplier = np.abs(np.linalg.eigvals(derivative)).max(axis=1)
        done = ~bad & (residual < self.tolerance)
        lost = bad | (~done & (self.iteration[index] >= MAX_NEWTON)) | (done & (multiplier >= 1))
        for k in np.flatnonzero(done & ~lost):
            velocity, displacement = result.velocity[:, k], complex(result.displacement[k])
            lost[k] = not self._accept(int(index[k]), velocity, displacement, residual[k])
        going = ~done & ~lost
        # Internal states and blocks go on from where the period left them.
        leap = np.linalg.solve(np.eye(n) - derivative[going], change[:n, going].T[..., None])
        leap = leap[..., 0].T
        longest = np.abs(leap).max(axis=0) / scale[going]
        ahead = result.state[:, :size][:, going]
        ahead[:n] = x[:n, going] + leap * np.minimum(1.0, 0.3 / np.maximum(longest, 1e-300))
        at = index[going]
        self.x[:, at], self.blocks[:, at] = ahead, result.blocks[:, :size][:, going]
        self.iteration[at] += 1
        return index[lost]

    def settle(self, index: np.ndarray) -> None:
        """Integrate some lanes for long, from where the last motion left them."""
        padded = _padded(index, SETTLING_CHUNKS)
        p = self.parameters(padded)
        # Longer from try to try: passing a fold that is just over takes its time.
        longest = np.max((1 + self.settlings[padded]) / p["lane.damping"])
        x, blocks, _, _ = advance(
            self.system, p, self.w[padded], self.kept_x[:, padded], self.kept_blocks[:, padded],
            int(np.ceil(0.6 * longest)),
        )  # fmt: skip
        self.x[:, index] = np.asarray(x)[:, : len(index)]
        self.blocks[:, index] = np.asarray(blocks)[:, : len(index)]
        self.kept_x[:, index], self.kept_blocks[:, index] = self.x[:, index], self.blocks[:, index]
        self.settlings[index] += 1
        self.iteration[index] = 0
        for k in index[self.settlings[index] > MAX_SETTLING]:
            self.failures[k] += 1
            self.skipped[k] += 1
            if self.failures[k] > 2:
                self.active[k] = False
            self._move_on(int(k))

    def _accept(self, k: int, velocity: np.ndarray, displacement: complex, residual: float) -> bool:
        """Record a stable periodic motion and step on; False if it is suspiciously far away."""
        before = self.points[k][-1] if self.points[k] else None
        turn, fresh = 0.0, self.settlings[k] == 0
        if before is not None:
            ratio = velocity[1] / before.velocity[1]
            turn = abs(np.degrees(np.angle(ratio)))
            far = turn > 40 or not 0.5 < abs(ratio) < 2.0
            if fresh and far:
                return False
        jumped = bool(not fresh and before is not None and turn > 20)
        point = Point(
            float(self.w[k]), float(self.clock[k]), velocity.copy(), displacement, jumped,
            float(residual),
        )  # fmt: skip
        self.points[k].append(point)
        self.kept_x[:, k], self.kept_blocks[:, k] = self.x[:, k], self.blocks[:, k]
        self.failures[k] = 0
        phase = np.degrees(np.angle(velocity[1])) * self.lanes.direction[k]
        if phase < -LIMIT_DEG or len(self.points[k]) >= MAX_POINTS:
            self.active[k] = False
        p = self.lanes.parameters
        pull = p["test.warming_rate"][k]
        self.warmth[k] += pull * (p["test.warming"][k] * abs(displacement) ** 2 - self.warmth[k])
        aim = self.lanes.step_deg[k] * (2.0 if abs(phase) > LIMIT_DEG else 1.0)
        wanted = 0.5 if turn == 0.0 else aim / max(turn, 1e-6)
        if jumped:
            wanted = 0.5
        damping = p["lane.damping"][k]
        grown = self.step[k] * np.clip(wanted, 0.4, 2.0) if before is not None else self.step[k]
        self.step[k] = np.clip(grown, 0.03 * damping, 2.5 * damping)
        self._move_on(k)
        return True

    def _move_on(self, k: int) -> None:
        self.w[k] += self.lanes.direction[k] * self.step[k]
        self.clock[k] += self.lanes.tick[k]
        self.iteration[k] = self.settlings[k] = 0
        if self.skipped[k] + len(self.points[k]) >= MAX_POINTS or self.w[k] <= 0.3:
            self.active[k] = False


def run_sweeps(system: System, lanes: Lanes) -> list[Sweep]:
    """Run all sweeps to their ends."""
    run = _Run(system, lanes)
    waiting: list[int] = []
    while run.active.any():
        at = np.setdiff1d(np.flatnonzero(run.active), waiting)
        for begin in range(0, len(at), CHUNKS[-1]):
            waiting.extend(run.newton(at[begin : begin + CHUNKS[-1]]).tolist())
        # Settling takes long: wait for company.
        if waiting and (len(waiting) >= SETTLING_CHUNKS[-1] or len(at) == 0):
            # The least damped settle together.
            waiting.sort(key=lambda k: lanes.parameters["lane.damping"][k])
            run.settle(np.array(waiting[: SETTLING_CHUNKS[-1]]))
            waiting = waiting[SETTLING_CHUNKS[-1] :]
    return [Sweep(p, int(s)) for p, s in zip(run.points, run.skipped, strict=True)]
