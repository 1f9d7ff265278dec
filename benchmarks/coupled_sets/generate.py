"""Blind tests of two modes that exchange energy: steady states by time integration.

Run: python benchmarks/coupled_sets/generate.py --out DIR [--sets 65] [--seed 1] [--noise 0.001]

Writes DIR/sets/NAME.csv and NAME.toml (linear modes with their 1σ, no potential) and, apart from
them, DIR/keys/NAME.json (the truth, and a level that was left out). No code is shared with the
package that is tested: both equations are integrated by Runge and Kutta's fourth-order method with
128 steps a period, all sets side by side, until nothing changes from period to period.
Noise is 0.2 to 1 % and as many rad, or what `--noise` says.
One JSON line at the end.
"""

import json
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
from harness import options

jax.config.update("jax_enable_x64", True)

KINDS = ("1:1", "1:2", "1:3", "1:1", "1:2", "1:3", "1:1", "1:2", "1:3", "1:1", "1:2", "1:3", "none")
LEVELS = (0.3, 0.6, 1.0, 0.8)  # of the largest force; the last is left out
UP, DOWN = 10, 5  # states of a sweep
STEPS, ORDERS = 128, 5
SETTLED = 2e-5  # relative change from one stretch of periods to the next
STRETCH, LONGEST = 100, 20  # periods, and how many stretches


def drawn(rng, kind):
    """A structure and its test."""
    ratio = {"1:1": 1, "1:2": 2, "1:3": 3, "none": int(rng.integers(2, 4))}[kind]
    off = rng.uniform(0.015, 0.06) * rng.choice([-1, 1]) if ratio == 1 else rng.uniform(-0.04, 0.05)
    omega = 2 * np.pi * rng.uniform(20, 200) * np.array([1.0, ratio * (1 + off)])
    zeta = rng.uniform(0.002, 0.01, 2)
    angle = rng.uniform(0.5, 1.1)
    shape = rng.uniform(0.5, 3) * np.array([[1.0, np.tan(angle)], [np.tan(angle), -1.0]])
    shape = shape * rng.choice([-1, 1], 2)
    push = rng.uniform(0.5, 2) * np.array([1.0, rng.uniform(0.1, 1.0) * rng.choice([-1, 1])])
    size, shift = 10 ** rng.uniform(-4, -2), rng.uniform(0.004, 0.025)  # kg^1/2 m; of frequency
    own = shift * omega[0] ** 2 / (1.5 * size**2)
    terms = {"1111": own}
    sign = rng.choice([-1, 1])
    if kind == "1:1":
        terms |= {"1122": own * rng.uniform(0.5, 3), "1112": own * rng.uniform(-1, 1)}
        terms |= {"1222": own * rng.uniform(-1, 1), "2222": own * rng.uniform(0.3, 1.5)}
    if kind == "1:2":
        terms |= {"112": sign * rng.uniform(0.004, 0.03) * omega[0] ** 2 / size}
        terms |= {"1122": own * rng.uniform(0.0, 3)}
    if kind == "1:3":
        terms |= {"1112": sign * own * rng.uniform(0.3, 2), "1122": own * rng.uniform(0.5, 3)}
    force = size * omega[0] ** 2 * 2 * zeta[0] / push[0]
    low, high = 1 - 3 * zeta[0] - 0.002, 1 + shift + 3 * zeta[0]
    return {
        **{"kind": kind, "ratio": ratio, "omega": omega, "zeta": zeta, "shape": shape},
        **{"push": push, "terms": terms, "force": force, "band": (low * omega[0], high * omega[0])},
        **{"noise": 10 ** rng.uniform(np.log10(0.002), -2), "floor": rng.uniform(0.02, 0.1)},
    }


def gradient(q, terms):
    """∂V/∂q of every lane."""
    g1, g2 = jnp.zeros_like(q[0]), jnp.zeros_like(q[1])
    for key, value in terms.items():
        a, b = key.count("1"), key.count("2")
        if a:
            g1 = g1 + value * a * q[0] ** (a - 1) * q[1] ** b
        if b:
            g2 = g2 + value * b * q[0] ** a * q[1] ** (b - 1)
    return jnp.stack([g1, g2])


@jax.jit
def stretch(state, h, force, lanes):
    """The state after some periods of every lane, and the samples of the last period."""
    omega, zeta, push, terms = lanes
    load = jnp.cos(np.pi * np.arange(2 * STEPS + 1) / STEPS)

    def rate(state, at):
        q, v = state[:2], state[2:]
        pull = 2 * zeta * omega * v + omega**2 * q + gradient(q, terms)
        return jnp.concatenate([v, push * force * load[at] - pull])

    def step(k, state):
        k1 = rate(state, 2 * k)
        k2 = rate(state + 0.5 * h * k1, 2 * k + 1)
        k3 = rate(state + 0.5 * h * k2, 2 * k + 1)
        k4 = rate(state + h * k3, 2 * k + 2)
        return state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    def period(_, state):
        return jax.lax.fori_loop(0, STEPS, step, state)

    state = jax.lax.fori_loop(0, STRETCH - 1, period, state)
    return jax.lax.scan(lambda s, k: (step(k, s), s[:2]), state, jnp.arange(STEPS))


def integrated(cases):
    """Modal phasors (lane, state, mode, order) of all sets and levels; NaN where none settled."""
    lanes = [(case, level) for case in cases for level in LEVELS]
    keys = sorted({key for case in cases for key in case["terms"]})
    terms = {key: np.array([case["terms"].get(key, 0.0) for case, _ in lanes]) for key in keys}
    given = [np.array([c[k] for c, _ in lanes]).T for k in ("omega", "zeta", "push")]
    force = np.array([case["force"] * level for case, level in lanes])
    bands = np.array([case["band"] for case, _ in lanes])
    fraction = np.concatenate([np.linspace(0, 1, UP), np.linspace(0.93, 0.1, DOWN)])
    frequencies = bands[:, :1] + (bands[:, 1:] - bands[:, :1]) * fraction
    state = np.zeros((4, len(lanes)))
    answers = np.full((len(lanes), len(fraction), 2, ORDERS + 1), np.nan, dtype=complex)
    for place, frequency in enumerate(frequencies.T):
        before, change = np.zeros((ORDERS + 1, 2, len(lanes))), np.full(len(lanes), np.inf)
        for _ in range(LONGEST):
            h = 2 * np.pi / frequency / STEPS
            state, samples = stretch(state, h, force, (*given, terms))
            spectrum = np.fft.rfft(np.asarray(samples), axis=0)[: ORDERS + 1] * 2 / STEPS
            size = np.abs(spectrum[1]).sum(axis=0)
            change = np.abs(spectrum - before).sum(axis=(0, 1)) / size
            before = spectrum
            if np.all(change < SETTLED):
                break
        good = change < SETTLED
        answers[good, place] = spectrum.transpose(2, 1, 0)[good]
    return frequencies, answers


def written(name, case, frequency, motion, rng, out):
    """One set and its key."""
    orders = np.arange(1, ORDERS + 1)
    rows, left_out = [], []
    for level in range(len(LEVELS)):
        for omega, q in zip(frequency[level], motion[level], strict=True):
            if not np.all(np.isfinite(q)):
                continue
            seen = 1j * orders * omega * (case["shape"] @ q[:, 1:])
            record = (level + 1, omega, LEVELS[level] * case["force"], seen)
            (left_out if level == len(LEVELS) - 1 else rows).append(record)
    largest = max(np.abs(seen[:, 0]).max() for *_, seen in rows)
    floor, noise = case["floor"] * case["noise"] * largest, case["noise"]
    header = "level,frequency_hz,force_n,sensor,velocity_re_m_s,velocity_im_m_s,velocity_std_m_s,"
    header += "phase_std_deg,force_std_n,harmonic_std_m_s"
    header += "".join(f",velocity_h{h}_{p}_m_s" for h in orders[1:] for p in ("re", "im"))
    lines = [header]
    for level, omega, force, seen in rows:
        said = force * (1 + 1e-3 * rng.normal())
        for sensor, values in zip("ab", seen, strict=True):
            gain, turn = noise * rng.normal(size=2)
            values = values * np.exp(gain + 1j * orders * turn)
            white = rng.normal(size=(2, ORDERS)) * floor / np.sqrt(2)
            values = values + np.where(orders > 1, white[0] + 1j * white[1], 0)
            first = values[0]
            numbers = [omega / 2 / np.pi, said, first.real, first.imag, noise * abs(first)]
            numbers += [np.degrees(noise), 1e-3 * force, floor]
            numbers += [part for v in values[1:] for part in (v.real, v.imag)]
            text = [f"{number:.10g}" for number in numbers]
            lines.append(",".join([str(level), *text[:2], sensor, *text[2:]]))
    (out / "sets" / f"{name}.csv").write_text("\n".join(lines) + "\n")
    told = case["omega"] * (1 + 2e-4 * rng.normal(size=2))
    damped = case["zeta"] * (1 + 0.02 * rng.normal(size=2))
    model = [f'name = "{name}"']
    for k in range(2):
        model += [
            "[[mode]]",
            f"frequency_hz = {told[k] / 2 / np.pi:.10g}",
            f"frequency_std_hz = {2e-4 * told[k] / 2 / np.pi:.6g}",
            f"damping_ratio = {damped[k]:.10g}",
            f"damping_ratio_std = {0.02 * damped[k]:.6g}",
            f"shape = {{ a = {case['shape'][0, k]:.10g}, b = {case['shape'][1, k]:.10g} }}",
            f"participation = {case['push'][k]:.10g}",
        ]
    (out / "sets" / f"{name}.toml").write_text("\n".join(model) + "\n")
    key = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in case.items()}
    key["left_out"] = [
        {"omega": o, "force": f, "re": s[:, 0].real.tolist(), "im": s[:, 0].imag.tolist()}
        for _, o, f, s in left_out
    ]
    (out / "keys" / f"{name}.json").write_text(json.dumps(key))
    return len(rows)


def main() -> None:
    """Draw, integrate and write all sets."""
    chosen = options(__doc__, out=Path, sets=65, seed=1, noise=0.0)
    begin = time.perf_counter()
    for part in ("sets", "keys"):
        (chosen.out / part).mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng([chosen.seed, 31])
    cases = [drawn(rng, KINDS[k % len(KINDS)]) for k in range(chosen.sets)]
    if chosen.noise:
        cases = [case | {"noise": chosen.noise} for case in cases]
    order = rng.permutation(chosen.sets)
    frequencies, answers = integrated(cases)
    n, rows = len(LEVELS), 0
    for number, k in enumerate(order):
        own = slice(n * k, n * k + n)
        name = f"coupled_{number + 1:03d}"
        rows += written(name, cases[k], frequencies[own], answers[own], rng, chosen.out)
    lost = int(np.sum(~np.isfinite(answers[..., 0, 0])))
    seconds = round(time.perf_counter() - begin, 1)
    print(json.dumps({"sets": chosen.sets, "rows": rows, "unsettled": lost, "seconds": seconds}))


if __name__ == "__main__":
    main()
