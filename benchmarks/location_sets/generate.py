"""Blind tests of chains with one nonlinear element at a hidden place: by time integration.

Run: python benchmarks/location_sets/generate.py --out DIR [--sets 80] [--seed 1] [--strong]

Writes DIR/sets/NAME.csv and NAME.toml (the matrices without the element) and, apart from them,
DIR/keys/NAME.json (the truth). No code is shared with the package that is tested: M ẍ + C ẋ + K x
+ b f(b·x, b·ẋ) = force, by Runge and Kutta's fourth-order method with 256 steps a period, all sets
side by side, until nothing changes from period to period. `--strong` elements change the frequency
by 6 to 25 % and the damping by up to three times; "harmonics" of a key is the largest second or
third harmonic of an element's own motion over its fundamental. One JSON line at the end.
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
KINDS = (
    *("cubic_stiffness", "one_sided_stop", "gap_stiffness", "quadratic_damping"),
    *("coulomb_friction", "everywhere"),
)
N = 5  # masses
LEVELS = (0.4, 0.7, 1.0)
STATES, STEPS, ORDERS = 9, 256, 5
SETTLED, STRETCH, LONGEST = 3e-5, 61, 25  # odd: a motion of two periods never settles
SMOOTH = 2e-3  # of the largest velocity: width of the jump of friction


def drawn(rng, kind, strong=False):
    """A chain, its element and its test."""
    mass = rng.uniform(0.5, 2.0, N)
    spring = 1e4 * 10 ** rng.uniform(-0.4, 0.4, N + 1)
    spring[-1] *= rng.choice([0.0, 1.0])  # free or held at its end
    stiffness = (
        np.diag(spring[:-1] + spring[1:]) - np.diag(spring[1:-1], 1) - np.diag(spring[1:-1], -1)
    )
    root = 1 / np.sqrt(mass)
    squared, vectors = np.linalg.eigh(stiffness * root * root[:, None])
    shapes, omega = vectors * root[:, None], np.sqrt(squared)
    zeta = rng.uniform(0.004, 0.012)
    damping = np.linalg.inv(shapes).T @ np.diag(2 * zeta * omega) @ np.linalg.inv(shapes)
    places = [{k: 1.0} for k in range(N)] + [{k: 1.0, k - 1: -1.0} for k in range(1, N)]
    # Five candidates at which the first mode moves.
    moved = [abs(sum(w * shapes[k, 0] for k, w in p.items())) for p in places]
    good = [k for k in range(len(places)) if moved[k] > 0.15 * max(moved)]
    candidates = [places[k] for k in rng.permutation(good)[:5]]
    true = int(rng.integers(len(candidates)))
    row = np.zeros(N)
    for k, w in candidates[true].items():
        row[k] = w
    if kind == "everywhere":  # on the modal coordinate of the first mode: b = M φ
        row = mass * shapes[:, 0]
    at = int(rng.integers(N))
    push = shapes[at, 0]
    size = 10 ** rng.uniform(-4, -2)  # of the modal displacement, kg^1/2 m
    force = size * omega[0] ** 2 * 2 * zeta / abs(push)
    s = float(row @ shapes[:, 0])  # how far the element moves with the mode
    x = abs(s) * size
    # Of the frequency, or of what damping is added.
    shift = rng.uniform(0.06, 0.25) if strong else rng.uniform(0.01, 0.03)
    law = {"stiffness": 2 * shift * omega[0] ** 2 / s**2, "x": x, "v": x * omega[0]}
    law["damping"] = (
        2 * zeta * omega[0] / s**2 * rng.uniform(0.3, 0.8) * (rng.uniform(1.5, 3) if strong else 1)
    )
    law["gap"] = x * rng.uniform(0.2, 0.5)
    low, high = omega[0] * (1 - 3 * zeta), omega[0] * (1 + 1.2 * shift + 3 * zeta)
    return {
        **{"kind": kind, "mass": mass, "stiffness": stiffness, "damping": damping, "row": row},
        **{"shapes": shapes, "omega": omega, "zeta": zeta, "at": at, "force": force, "law": law},
        **{"candidates": candidates, "true": true, "band": (low, high)},
        **{"noise": 10 ** rng.uniform(np.log10(0.002), -2), "floor": rng.uniform(0.02, 0.1)},
    }


def element(kind, x, v, law):
    """The force of every lane; `kind` counts in `KINDS`."""
    k, d, gap = law["stiffness"], law["damping"], law["gap"]
    cubic = 4 / 3 * k / law["x"] ** 2 * x**3
    forces = [
        cubic,
        6 * k * jnp.maximum(x - gap, 0.0),
        3 * k * (jnp.maximum(x - gap, 0.0) - jnp.maximum(-x - gap, 0.0)),
        d * 3 * np.pi / 8 / law["v"] * jnp.abs(v) * v,
        0.3 * d * law["v"] * np.pi / 4 * jnp.tanh(v / (SMOOTH * law["v"])),
        cubic,
    ]
    return jnp.select([kind == n for n in range(len(forces))], forces)


@jax.jit
def stretch(state, h, force, lanes):
    """The state after some periods of every lane, and the samples of the last period."""
    load = jnp.cos(np.pi * np.arange(2 * STEPS + 1) / STEPS)

    def rate(state, at):
        x, v = state
        row = lanes["row"]
        f = element(lanes["kind"], jnp.sum(row * x, 1), jnp.sum(row * v, 1), lanes["law"])
        inside = jnp.einsum("lij,lj->li", lanes["stiffness"], x)
        inside = inside + jnp.einsum("lij,lj->li", lanes["damping"], v) + row * f[:, None]
        return jnp.stack([v, (force * load[at] - inside) / lanes["mass"]])

    def step(k, state):
        k1 = rate(state, 2 * k)
        k2 = rate(state + 0.5 * h * k1, 2 * k + 1)
        k3 = rate(state + 0.5 * h * k2, 2 * k + 1)
        k4 = rate(state + h * k3, 2 * k + 2)
        return state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    def period(_, state):
        return jax.lax.fori_loop(0, STEPS, step, state)

    state = jax.lax.fori_loop(0, STRETCH - 1, period, state)
    return jax.lax.scan(lambda s, k: (step(k, s), s[0]), state, jnp.arange(STEPS))


def integrated(cases):
    """Displacement phasors (lane, state, point, order); NaN where none settled."""
    lanes = [(case, level) for case in cases for level in LEVELS]
    given = {k: np.array([c[k] for c, _ in lanes]) for k in ("mass", "stiffness", "damping", "row")}
    given["kind"] = np.array([KINDS.index(c["kind"]) for c, _ in lanes])
    given["law"] = {k: np.array([c["law"][k] for c, _ in lanes]) for k in lanes[0][0]["law"]}
    force = np.zeros((len(lanes), N))
    for n, (case, level) in enumerate(lanes):
        force[n, case["at"]] = case["force"] * level
    bands = np.array([case["band"] for case, _ in lanes])
    frequencies = bands[:, :1] + (bands[:, 1:] - bands[:, :1]) * np.linspace(0, 1, STATES)
    state = np.zeros((2, len(lanes), N))
    answers = np.full((len(lanes), STATES, N, ORDERS + 1), np.nan, dtype=complex)
    for place, frequency in enumerate(frequencies.T):
        before, change = 0.0, np.full(len(lanes), np.inf)
        for _ in range(LONGEST):
            h = (2 * np.pi / frequency / STEPS)[:, None]
            state, samples = stretch(state, h, force, given)
            spectrum = np.fft.rfft(np.asarray(samples), axis=0)[: ORDERS + 1] * 2 / STEPS
            size = np.abs(spectrum[1]).sum(axis=1)
            change = np.abs(spectrum - before).sum(axis=(0, 2)) / size
            before = spectrum
            if np.all(change < SETTLED):
                break
        good = change < SETTLED
        answers[good, place] = spectrum.transpose(1, 2, 0)[good]
    return frequencies, answers


def named(place):
    """A place as a model file has it."""
    ordered = sorted(place, key=lambda k: -place[k])
    return "-".join(f"x{k + 1}" for k in ordered)


def written(name, case, frequency, motion, rng, out):
    """One set and its key."""
    orders = np.arange(1, ORDERS + 1)
    sensors = sorted(rng.permutation(N)[: rng.integers(2, 5)].tolist())
    rows = []
    for level in range(len(LEVELS)):
        for omega, x in zip(frequency[level], motion[level], strict=True):
            if np.all(np.isfinite(x)):
                seen = 1j * orders * omega * x[sensors][:, 1:]
                rows.append((level + 1, omega, LEVELS[level] * case["force"], seen))
    largest = max(np.abs(seen[:, 0]).max() for *_, seen in rows)
    noise, floor = case["noise"], case["floor"] * case["noise"] * largest
    header = "level,frequency_hz,force_n,sensor,velocity_re_m_s,velocity_im_m_s,velocity_std_m_s,"
    header += "phase_std_deg,harmonic_std_m_s"
    header += "".join(f",velocity_h{h}_{p}_m_s" for h in orders[1:] for p in ("re", "im"))
    lines = [header]
    for level, omega, force, seen in rows:
        for sensor, values in zip(sensors, seen, strict=True):
            gain, turn = noise * rng.normal(size=2)
            values = values * np.exp(gain + 1j * orders * turn)
            white = rng.normal(size=(2, ORDERS)) * floor / np.sqrt(2)
            values = values + np.where(orders > 1, white[0] + 1j * white[1], 0)
            numbers = [omega / 2 / np.pi, force]
            text = [f"{number:.10g}" for number in numbers]
            numbers = [values[0].real, values[0].imag, noise * abs(values[0]), np.degrees(noise)]
            numbers += [floor, *[part for v in values[1:] for part in (v.real, v.imag)]]
            parts = [str(level), *text, f"x{sensor + 1}", *(f"{number:.10g}" for number in numbers)]
            lines.append(",".join(parts))
    (out / "sets" / f"{name}.csv").write_text("\n".join(lines) + "\n")

    def matrix(values):
        return (
            "[" + ", ".join("[" + ", ".join(f"{v:.12g}" for v in row) + "]" for row in values) + "]"
        )

    points = ", ".join(f'"x{k + 1}"' for k in range(N))
    watched = ", ".join(f'"x{k + 1}"' for k in sensors)
    model = [
        *(f'name = "{name}"', "[structure]", f"points = [{points}]"),
        f"mass = {matrix(np.diag(case['mass']))}",
        f"stiffness = {matrix(case['stiffness'])}",
        f"damping = {matrix(case['damping'])}",
        *("[force]", f"at = {{ x{case['at'] + 1} = 1.0 }}", "[sensors]"),
        f"points = [{watched}]",
    ]
    (out / "sets" / f"{name}.toml").write_text("\n".join(model) + "\n")
    key = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in case.items()}
    along = np.abs(np.concatenate(motion).transpose(0, 2, 1) @ case["row"])
    key["harmonics"] = float(np.nanmax(along[:, 2:4] / along[:, 1:2]))
    key["candidates"] = [named(place) for place in case["candidates"]]
    key["true"] = (
        "everywhere" if case["kind"] == "everywhere" else named(case["candidates"][case["true"]])
    )
    (out / "keys" / f"{name}.json").write_text(json.dumps(key))
    return len(rows)


def main() -> None:
    """Draw, integrate and write all sets."""
    chosen = options(__doc__, out=Path, sets=80, seed=1, strong=False)
    begin = time.perf_counter()
    for part in ("sets", "keys"):
        (chosen.out / part).mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng([chosen.seed, 47])
    cases = [drawn(rng, KINDS[k % len(KINDS)], chosen.strong) for k in range(chosen.sets)]
    order = rng.permutation(chosen.sets)
    frequencies, answers = integrated(cases)
    n, rows = len(LEVELS), 0
    for number, k in enumerate(order):
        own = slice(n * k, n * k + n)
        name = f"place_{number + 1:03d}"
        rows += written(name, cases[k], frequencies[own], answers[own], rng, chosen.out)
    lost = int(np.sum(~np.isfinite(answers[..., 0, 0])))
    seconds = round(time.perf_counter() - begin, 1)
    print(json.dumps({"sets": chosen.sets, "rows": rows, "unsettled": lost, "seconds": seconds}))


if __name__ == "__main__":
    main()
