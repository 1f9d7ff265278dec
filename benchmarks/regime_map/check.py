"""Checks of the generator: its states against time integration, and against its own backbone.

    python benchmarks/regime_map/check.py

For each law one test with a large and one with a small shift. "closes": how far an integrated
cycle that starts in the state misses its start, over the state and 2πζ (what a cycle dissipates).
The others compare Re Z + Ω² and Im Z/Ω of noise-free states, Z = F/X, with the backbone at their
amplitudes: frequency in half-power bandwidths, damping relative, each the largest and the median.
"""

import contextlib

import numpy as np
from generate import Errors, drawn_test
from oscillator import LAWS, Law, States, backbone
from scipy.integrate import solve_ivp


def missed(law: Law, damping: float, state: States, k: int) -> float:
    """How far a cycle from a reversal of y misses its start, relative, over 2πζ."""
    x, w, f, theta = (np.asarray(part)[k] for part in state[:4])
    n = (len(x) - 1) // 2
    order = np.arange(1, n + 1)

    def motion(tau, rate=0):
        a, b = x[1 : n + 1], x[n + 1 :]
        if rate:
            return np.sum(order * (b * np.cos(order * tau) - a * np.sin(order * tau)))
        return x[0] + np.sum(a * np.cos(order * tau) + b * np.sin(order * tau))

    tau = 0.0
    for _ in range(50):  # the largest y
        slope = (motion(tau + 1e-5, 1) - motion(tau - 1e-5, 1)) / 2e-5
        tau -= motion(tau, 1) / slope
    start = np.array([motion(tau), 0.0])
    y, now, ends, turn = start, tau, tau + 2 * np.pi, start[0]
    held = -law.strength * abs(turn) ** law.shape  # Iwan's force at the reversal
    for direction in (-1.0, 1.0):

        def nonlinear(y, v, direction=direction, turn=turn, held=held):
            if law.name == "coulomb":
                return law.strength * direction
            if law.name == "iwan":
                gone = np.maximum(abs(y - turn), 0) / 2
                return held - direction * 2 * law.strength * gone**law.shape
            return float(law.force(np.float64(y), np.float64(v))[0])

        def rate(t, z, nonlinear=nonlinear):
            push = f * np.cos(t + np.pi / 2 - theta) - z[0] - nonlinear(z[0], z[1])
            return [z[1] / w, (push - 2 * damping * z[1]) / w]

        def reversed_(t, z, begun=now, direction=direction):
            return z[1] if t > begun + 1.0 else direction

        reversed_.terminal = direction < 0
        given = solve_ivp(rate, (now, ends), y, "DOP853", rtol=1e-11, atol=1e-13, max_step=0.01,
                          events=reversed_)  # fmt: skip
        now, y = given.t[-1], given.y[:, -1]
        held, turn = nonlinear(y[0], y[1]), y[0]
    return float(np.hypot(*(y - start)) / abs(start[0]) / (2 * np.pi * damping))


def main() -> None:
    """Print the table."""
    quiet = Errors({"frequency": 0.0, "gain": 0.0, "phase": 0.0})
    print("law                share  damping  closes | frequency/bandwidth  damping")
    for number, name in enumerate(LAWS):
        for share in (0.5, 100.0 if number in range(1, 7) else 5.0):
            rng, test = np.random.default_rng([7, number]), None
            sign = -1 if name in ("cubic_softening", "quadratic", "iwan") else 1
            while test is None:
                with contextlib.suppress(ArithmeticError):
                    test = drawn_test(rng, name, sign * share if name != "none" else 0.0, quiet)
            states = test.states
            middle = int(np.argmax(states.amplitude))
            closes = missed(test.law, test.damping, states, middle)
            curve = backbone(test.law, test.damping, states.amplitude)
            z = states.force / states.amplitude * np.exp(1j * (np.pi / 2 - states.phase))
            natural = np.sqrt(z.real + states.w**2)
            bandwidth = curve.force / curve.amplitude / curve.w
            off = np.abs(natural - curve.w) / bandwidth
            of_damping = np.abs(z.imag / states.w / bandwidth - 1)
            print(f"{name:18s} {share:5g} {test.damping:8.2g} {closes:7.1e} | "
                  f"{off.max():8.1e} {np.median(off):8.1e} {of_damping.max():8.1e} "
                  f"{np.median(of_damping):8.1e}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
