"""What an identification costs in a fresh process and in a second call, by the number of states.

Run: python benchmarks/identification_cost.py [--states 150 1000 3000 12288] [--levels 8]
     [--method pointwise joint] [--stated]

States of one hardening, quadratically damped mode under forces of constant amplitude, in closed
form: within 60° of resonance, 0.5 % noise of the velocity and as much of the phase, 0.5 % of gain
for a whole level. `--levels 0` has 41 states in every level instead, so that levels grow with
states. "cold" is a fresh process with an empty folder of compiled programs, import included; "warm"
is the second call in that process. One JSON line a method and size: seconds of wall and processor,
compiled programs and what they took, warm milliseconds a state and their ratio to the smallest
size's, and the largest memory.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time

from harness import options, teller

tell = teller(__file__)

SIZES = (150, 1000, 3000, 12288)
PER_LEVEL = 41


def test_of(n_states: int, n_levels: int, *, stated: bool):
    """A noisy test and the linear mode of its structure."""
    import numpy as np
    from closed_form import CONSTANT, OMEGA, damping, needed, squared

    import snrmjax as sj

    rng = np.random.default_rng(0)
    levels = n_levels or max(round(n_states / PER_LEVEL), 4)
    level = np.sort(np.arange(n_states) % levels)
    tip = np.geomspace(2e-4, 2e-3, levels)[level]  # m, at resonance
    place = np.arange(n_states) - np.searchsorted(level, level)
    phase = np.radians(60) * (2 * place / np.bincount(level)[level] - 1)

    speed = tip * squared(tip) ** 0.5
    force = speed * damping(speed) / CONSTANT
    x, omega = tip * np.cos(phase), np.sqrt(squared(tip))
    for _ in range(100):
        loss = damping(x * omega)
        omega = np.sqrt(squared(x) - omega * loss * np.tan(phase))
        x = 0.5 * (x + CONSTANT * force * np.cos(phase) / (omega * loss))
    velocity = 1j * omega * CONSTANT * force / needed(x, omega)
    gain = 0.005 * rng.normal(size=levels)[level]
    noise = 0.005 * (rng.normal(size=n_states) + 1j * rng.normal(size=n_states))
    velocity = velocity * np.exp(gain + noise)
    errors = {}
    if stated:
        errors = {
            "velocity_std": 0.005 * np.abs(velocity),
            "phase_std": np.full(n_states, 0.005),
            "force_std": 0.001 * force,
        }
    modes = sj.model.linear_modes([OMEGA], [0.012], [[2.0]], [3.0])
    return sj.measure.steady_states(level, omega, force, velocity, **errors), modes


def measured(method: str, n_states: int, n_levels: int, *, stated: bool) -> dict:
    """Both calls, in this process."""
    begin, compiling, programs = time.perf_counter(), [], []
    import jax

    def heard(event: str, seconds: float, **_: object) -> None:
        if "/compile/" in event:
            compiling.append(seconds)
        if event.endswith("backend_compile_duration"):
            programs.append(seconds)

    jax.monitoring.register_event_duration_secs_listener(heard)
    import snrmjax as sj

    data, modes = test_of(n_states, n_levels, stated=stated)
    call = {"pointwise": sj.identify_backbone, "joint": sj.fit_jointly}[method]
    call(data, modes)
    line = {
        "cold_s": time.perf_counter() - begin,
        "cold_cpu_s": time.process_time(),
        "compiling_s": sum(compiling),
        "programs": len(programs),
    }
    del programs[:]
    begin, own = time.perf_counter(), time.process_time()
    call(data, modes)
    line |= {"warm_s": time.perf_counter() - begin, "warm_cpu_s": time.process_time() - own}
    line["programs_warm"] = len(programs)
    line["memory_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {name: round(value, 3) for name, value in line.items()}


def main() -> None:
    """One fresh process a line."""
    chosen = options(
        __doc__, states=SIZES, levels=8, method=["pointwise", "joint"], stated=False, here=False
    )
    if chosen.here:
        own = (chosen.method[0], chosen.states[0], chosen.levels)
        print(json.dumps(measured(*own, stated=chosen.stated)))
        return
    for method in chosen.method:
        first = None
        for states in chosen.states:
            command = [sys.executable, __file__, "--here", "--method", method]
            command += ["--states", str(states), "--levels", str(chosen.levels)]
            command += ["--stated"] * chosen.stated
            with tempfile.TemporaryDirectory() as programs:
                settings = os.environ | {"JAX_COMPILATION_CACHE_DIR": programs}
                answer = subprocess.run(
                    command, env=settings, capture_output=True, text=True, check=True
                ).stdout
            line = {"method": method, "states": states}
            line |= json.loads(answer.splitlines()[-1])
            per_state = 1e3 * line["warm_s"] / states
            first = first or per_state
            line |= {"ms_per_state": round(per_state, 3), "ratio": round(per_state / first, 2)}
            tell(**line)


if __name__ == "__main__":
    main()
