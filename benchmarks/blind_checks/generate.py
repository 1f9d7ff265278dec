"""Blind tests for `snrmjax check`: each with one hidden error of the laboratory, or with none.

    python benchmarks/blind_checks/generate.py --out DIR [--wrong 200] [--good 100] [--seed 1]

Writes DIR/sets/NAME/ (measured.csv, sometimes a second file other.csv; model.toml; record.npz with
the time record of some tests) and, apart from them, DIR/keys/NAME.json. Nothing is shared with the
package that is tested. One JSON line at the end.
"""

import collections
import json
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tomli_w
from oscillators import Lane, stepped, sweep_up

sys.path.append(str(Path(__file__).resolve().parents[1]))
from harness import options

IN_TABLES = (
    "conjugated_response",
    "acceleration_as_velocity",
    "displacement_as_velocity",
    "volts_as_force",
    "rms_for_peak",
    "degrees_for_radians",
    "force_dropout",
    "drift",
    "different_structures",
    "shape_not_mass_normalised",
)
IN_RECORDS = ("clipped_channel", "unsettled_steps", "force_harmonics", "missing_anti_alias")
_FINE, _LEVELS = 90, 5
_INTEGRATED = 64  # samples a cycle
_STEPS, _STEP_CYCLES = 12, 150


class Test(NamedTuple):
    """One test: structure, instruments and plan."""

    name: str
    kind: str  # of the hidden error, or "none"
    seed: tuple[int, ...]
    record: bool
    frequency_hz: float
    damping: float
    size: float  # displacement of the mode at the top level
    shape: float
    participation: float
    lane: dict[str, float]
    peaks: np.ndarray  # size of each level's linear resonance over that of the top level
    points: int
    noise: tuple[float, float, float]  # relative amplitude, phase (rad), relative force
    stated: bool
    level_errors: tuple[float, float]  # gain, phase (rad)
    with_order: bool


def draw_test(name: str, kind: str, seed: tuple[int, ...], record: bool) -> Test:
    """A structure and a plan, whatever the error."""
    rng = np.random.default_rng(seed)
    damping = float(np.exp(rng.uniform(*np.log([0.004, 0.03] if record else [0.0015, 0.03]))))
    law = rng.choice(["linear", "hardening", "softening", "damping", "friction", "mixed"])
    shift = float(rng.uniform(0.3, 6.0)) * damping  # of the frequency at the top level
    lane = dict.fromkeys(Lane._fields, 0.0) | {"damping": damping, "stiffness": 1.0}
    if law in ("hardening", "mixed"):
        lane["cubic"] = 8 / 3 * shift
    if law == "softening":
        lane["cubic"] = -8 / 3 * min(shift, 0.02)
        lane["quadratic"] = float(rng.uniform(0, 0.05))
    if law in ("damping", "mixed"):
        lane["quadratic_damping"] = float(rng.uniform(0.5, 4.0)) * damping
    if law == "friction":
        lane["friction"] = float(rng.uniform(0.05, 0.3)) * damping
    lane["feedback"] = 2 * damping * float(rng.choice([0.0, rng.uniform(0.05, 0.7)]))
    peaks = np.geomspace(float(rng.uniform(0.12, 0.4)), 1.0, int(rng.integers(3, _LEVELS + 1)))
    return Test(
        name, kind, seed, record,
        frequency_hz=float(np.exp(rng.uniform(*np.log([8.0, 400.0])))),
        damping=damping,
        size=float(np.exp(rng.uniform(*np.log([1e-5, 1e-3])))),
        shape=float(np.exp(rng.uniform(*np.log([0.3, 15.0])))) * float(rng.choice([1, -1])),
        participation=float(np.exp(rng.uniform(*np.log([0.3, 15.0])))) * float(rng.choice([1, -1])),
        lane=lane, peaks=peaks, points=int(rng.integers(9, 28)),
        noise=(float(rng.uniform(1e-3, 8e-3)), float(np.radians(rng.uniform(0.05, 0.5))),
               float(rng.uniform(5e-4, 4e-3))),
        stated=bool(rng.random() < 0.7),
        level_errors=(
            (float(rng.uniform(0, 0.01)), float(np.radians(rng.uniform(0, 0.6))))
            if rng.random() < 0.5 else (0.0, 0.0)
        ),
        with_order=bool(rng.random() < 0.6) or kind == "drift",
    )  # fmt: skip


class States(NamedTuple):
    """Recorded states in SI: phasors relative to the drive's clock."""

    level: np.ndarray
    w: np.ndarray  # over ω₀
    force: np.ndarray  # phasor, N
    velocity: np.ndarray  # state, harmonic 0…3, m/s
    order: np.ndarray
    voltage: np.ndarray  # of the level, force that the shaker would give to a held armature, N


def table_states(test: Test, rng, drift: float) -> States:
    """Settled states of stepped sines at constant voltage, up in frequency, level after level."""
    repeated = test.kind == "drift" and rng.random() < 0.5
    peaks = np.append(test.peaks, test.peaks[0]) if repeated else test.peaks
    n = len(peaks)
    lane = Lane(*(np.full(n, test.lane[f]) for f in Lane._fields))
    total = 2 * test.lane["damping"] + test.lane["feedback"]
    extra = test.lane["quadratic_damping"] * 8 / (3 * np.pi) * peaks + (
        test.lane["friction"] * 4 / np.pi / peaks
    )
    voltage = (total + extra) * peaks
    middle = 1 + 3 / 8 * test.lane["cubic"] * peaks**2
    middle -= 5 / 12 * test.lane["quadratic"] ** 2 * peaks**2
    middle = middle + drift * (np.arange(n) + 0.5) / n
    # To ±72° of phase relative to the force on the structure.
    width = 1.6 * (2 * test.lane["damping"] + extra)
    low, high = np.minimum(1.0, middle) - width, np.maximum(1.0, middle) + width
    w = np.linspace(low, high, _FINE, axis=1)
    order = (np.arange(n)[:, None] + np.linspace(0, 1, _FINE)) / n
    found = sweep_up(lane, w, voltage, (1 + drift * order) ** 2)
    rows = []
    for k in range(n):
        turned = found.velocity[k, :, 1] * np.conj(found.force[k, :, 0])
        near = np.flatnonzero(found.good[k] & (np.abs(np.angle(turned)) < np.radians(72)))
        if near.size < 4:
            continue
        keep = near[np.unique(np.linspace(0, near.size - 1, test.points).round().astype(int))]
        rows += [(k, i) for i in keep]
    at = tuple(np.array(rows).T)
    return _in_si(test, at[0] + 1, w[at], found.force[at][:, 0], found.velocity[at], order[at],
                  voltage[at[0]])  # fmt: skip


def _in_si(test: Test, level, w, force, velocity, order, voltage) -> States:
    omega = 2 * np.pi * test.frequency_hz
    newton = omega**2 * test.size / abs(test.participation)
    # With shape and participation of one sign velocity is in phase with the force at resonance.
    sign = np.sign(test.participation)
    return States(
        level, w, newton * force, sign * test.shape * omega * test.size * velocity, order,
        newton * voltage,
    )  # fmt: skip


def write_table(path: Path, test: Test, states: States, rng, noisy: bool = True) -> None:
    """A CSV of the contract with the errors of the instruments."""
    n = len(states.w)
    amplitude, phase, force_error = test.noise if noisy else (0.0, 0.0, 0.0)
    levels = np.unique(states.level, return_inverse=True)[1]
    gain = test.level_errors[0] * rng.normal(size=levels.max() + 1)[levels] * noisy
    turn = test.level_errors[1] * rng.normal(size=levels.max() + 1)[levels] * noisy
    gain = (1 + gain) * (1 + amplitude * rng.normal(size=n))
    turn = turn + phase * rng.normal(size=n)
    orders = np.arange(4)
    back = np.exp(-1j * np.angle(states.force)[:, None] * orders)
    velocity = states.velocity * back * gain[:, None] * np.exp(1j * turn[:, None] * orders)
    force = np.abs(states.force) * (1 + force_error * rng.normal(size=n))
    columns = {
        "level": states.level,
        "frequency_hz": states.w * test.frequency_hz,
        "force_n": force,
        "velocity_re_m_s": velocity[:, 1].real,
        "velocity_im_m_s": velocity[:, 1].imag,
    }
    columns |= dict(WRONG.get(test.kind, lambda *a: {})(test, states, velocity, force, rng))
    if test.stated:
        size = np.hypot(columns["velocity_re_m_s"], columns["velocity_im_m_s"])
        columns["velocity_std_m_s"] = test.noise[0] * size
        columns["phase_std_deg"] = np.full(n, np.degrees(test.noise[1]))
        columns["force_std_n"] = test.noise[2] * columns["force_n"]
    if test.with_order:
        columns["order"] = states.order
    lines = [",".join(columns)]
    for row in zip(*columns.values(), strict=True):
        lines.append(",".join(f"{value:.9g}" for value in row))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _phasor(value: np.ndarray) -> dict[str, np.ndarray]:
    return {"velocity_re_m_s": value.real, "velocity_im_m_s": value.imag}


def _conjugated(test, states, velocity, force, rng):
    return _phasor(np.conj(velocity[:, 1]))


def _rate(test, states):
    return 1j * 2 * np.pi * test.frequency_hz * states.w


def _acceleration(test, states, velocity, force, rng):
    rate = _rate(test, states)
    # One in three: a program that turned the phase right and forgot the size.
    return _phasor(velocity[:, 1] * (np.abs(rate) if rng.random() < 1 / 3 else rate))


def _displacement(test, states, velocity, force, rng):
    rate = _rate(test, states)
    return _phasor(velocity[:, 1] / (np.abs(rate) if rng.random() < 1 / 3 else rate))


def _volts(test, states, velocity, force, rng):
    per_volt = float(np.exp(rng.uniform(*np.log([0.3, 30.0]))))
    volts = states.voltage / per_volt * (1 + test.noise[2] * rng.normal(size=len(force)))
    # The phase is relative to the voltage.
    return {"force_n": volts} | _phasor(velocity[:, 1] * np.exp(1j * np.angle(states.force)))


def _rms(test, states, velocity, force, rng):
    if rng.random() < 0.5:
        return {"force_n": force / np.sqrt(2)}
    return _phasor(velocity[:, 1] / np.sqrt(2))


def _degrees(test, states, velocity, force, rng):
    wrong = np.degrees(np.angle(velocity[:, 1]))  # read as radians
    return _phasor(np.abs(velocity[:, 1]) * np.exp(1j * wrong))


def _dropout(test, states, velocity, force, rng):
    # The floor of the cell, of which the error that is stated knows nothing.
    floor = float(rng.uniform(0.08, 0.25)) * np.abs(force).min()
    noise = floor * (rng.normal(size=len(force)) + 1j * rng.normal(size=len(force)))
    read = force + noise
    return {"force_n": np.abs(read)} | _phasor(velocity[:, 1] * np.exp(-1j * np.angle(read)))


WRONG = {
    "conjugated_response": _conjugated,
    "acceleration_as_velocity": _acceleration,
    "displacement_as_velocity": _displacement,
    "volts_as_force": _volts,
    "rms_for_peak": _rms,
    "degrees_for_radians": _degrees,
    "force_dropout": _dropout,
}


def write_model(path: Path, test: Test, rng) -> None:
    """The linear model with the errors of a linear test."""
    shape = test.shape
    if test.kind == "shape_not_mass_normalised":
        factor = float(np.exp(rng.uniform(*np.log([1.7, 12.0]))))
        shape = np.sign(shape) if rng.random() < 0.4 else shape * factor ** rng.choice([-1, 1])
        if abs(np.log(abs(shape / test.shape))) < 0.2 or 1.3 < abs(shape / test.shape) < 1.55:
            shape = 3 * test.shape
    mode = {
        "frequency_hz": test.frequency_hz * (1 + 2e-4 * rng.normal()),
        "damping_ratio": test.damping * (1 + 0.03 * rng.normal()),
        "shape": {"tip": float(shape * (1 + 0.01 * rng.normal()))},
        "participation": test.participation,
        "frequency_std_hz": 2e-4 * test.frequency_hz,
        "damping_ratio_std": 0.03 * test.damping,
    }
    model: dict = {"name": test.name.replace("_", " "), "mode": [mode]}
    if any(test.level_errors):
        model["measurement"] = {
            "level_gain_std": test.level_errors[0],
            "level_phase_std_deg": float(np.degrees(test.level_errors[1])),
        }
    path.write_text(tomli_w.dumps(model), encoding="utf-8")


def write_tables(folder: Path, test: Test) -> dict:
    """One test without a record; returns what is hidden."""
    rng = np.random.default_rng((*test.seed, 7))
    hidden: dict = {}
    drift = 0.0
    if test.kind == "drift":
        drift = float(rng.uniform(1.5, 5.0) * test.damping * rng.choice([-1, 1]))
        hidden["relative_drift"] = drift
    if test.kind in ("force_dropout", "volts_as_force"):
        times = rng.uniform(8, 30) if test.kind == "force_dropout" else rng.uniform(0.3, 3.0)
        test = test._replace(lane=test.lane | {"feedback": 2 * test.damping * float(times)})
        hidden["undisturbed_over_resonance"] = float(times) + 1
    states = table_states(test, rng, drift)
    write_table(folder / "measured.csv", test, states, rng)
    if test.kind == "different_structures" or (test.kind == "none" and rng.random() < 0.25):
        other = test._replace(seed=(*test.seed, 5))
        if test.kind == "different_structures":
            sign = float(rng.choice([-1, 1]))
            factor = 1 + sign * float(rng.uniform(4, 25)) * test.damping
            other = other._replace(frequency_hz=test.frequency_hz * factor)
            hidden["frequency_ratio"] = factor
        states = table_states(other, rng, 0.0)
        write_table(folder / "other.csv", other, states, rng)
    write_model(folder / "model.toml", test, rng)
    return hidden


def write_records(root: Path, tests: list[Test]) -> dict[str, dict]:
    """Tests with a record, all integrated together; returns what is hidden by name."""
    n = len(tests)
    lane = Lane(*(np.array([test.lane[f] for test in tests]) for f in Lane._fields))
    top = (2 * lane.damping + lane.feedback + lane.quadratic_damping * 8 / (3 * np.pi)
           + lane.friction * 4 / np.pi)  # fmt: skip
    rngs = [np.random.default_rng((*test.seed, 11)) for test in tests]
    dwell = np.full(n, _STEP_CYCLES * _INTEGRATED)
    harmonics = np.zeros((n, 2))
    hidden: dict[str, dict] = {test.name: {} for test in tests}
    for k, (test, rng) in enumerate(zip(tests, rngs, strict=True)):
        decay = 1 / (np.pi * (2 * lane.damping[k] + lane.feedback[k]))  # cycles of a factor e
        cycles = min(9 * decay, _STEP_CYCLES) if rng.random() < 0.5 else _STEP_CYCLES
        if test.kind == "unsettled_steps":
            cycles = max(6, float(rng.uniform(0.4, 1.2)) * decay)
        dwell[k] = round(cycles) * _INTEGRATED
        if test.kind == "force_harmonics":
            harmonics[k] = rng.uniform(0.12, 0.4, size=2) * rng.permutation([1.0, rng.random()])
            hidden[test.name]["harmonics"] = harmonics[k].tolist()
        else:
            harmonics[k] = rng.uniform(0, 0.008, size=2)
    levels = np.array([0.35, 1.0])
    spread = np.linspace(-0.8, 0.8, _STEPS // 2)
    w = 1 + np.tile(spread * 1.0, 2)[None] * top[:, None]
    w = w + 3 / 8 * lane.cubic[:, None] * np.repeat(levels**2, _STEPS // 2)
    voltage = np.repeat(levels, _STEPS // 2)[None] * top[:, None]
    samples = int(dwell.max()) * _STEPS
    run = stepped(lane, w, voltage, dwell, samples, _INTEGRATED, harmonics)
    for k, (test, rng) in enumerate(zip(tests, rngs, strict=True)):
        folder = root / "sets" / test.name
        hidden[test.name] |= _one_record(folder, test, rng, run, k, w[k], int(dwell[k]))
    return hidden


def _one_record(folder: Path, test: Test, rng, run, k: int, w, dwell: int) -> dict:
    from scipy.signal import decimate

    hidden: dict = {}
    end = dwell * _STEPS
    omega = 2 * np.pi * test.frequency_hz
    force, velocity = run.force[k, :end], run.velocity[k, :end]
    keep = int(rng.choice([2, 4]))
    if test.kind == "missing_anti_alias":
        # A higher mode answers a high harmonic of the drive, above half the recorder's rate.
        keep = 4
        order = int(rng.integers(10, 15))
        fraction = float(rng.uniform(0.03, 0.15))
        velocity = velocity + fraction * np.abs(velocity).max() * np.cos(
            order * run.angle[k, :end] + rng.uniform(0, 6)
        )
        hidden |= {"order": order, "share": fraction}
        force, velocity = force[::keep], velocity[::keep]
    else:
        force, velocity = (decimate(x, keep, ftype="fir") for x in (force, velocity))
    n = len(force)
    newton = omega**2 * test.size / abs(test.participation)
    force = force * newton + 2e-3 * newton * np.abs(force).max() * rng.normal(size=n)
    speed = velocity * test.shape * np.sign(test.participation) * omega * test.size
    speed = speed + 2e-3 * np.abs(speed).max() * rng.normal(size=n)
    if test.kind == "clipped_channel":
        which = rng.random() < 0.7
        channel = speed if which else force
        limit = float(rng.uniform(0.6, 0.95)) * np.abs(channel).max()
        np.clip(channel, -limit, limit, out=channel)
        hidden |= {"channel": "velocity" if which else "force", "limit": limit}
    rate = _INTEGRATED / keep * test.frequency_hz
    np.savez(
        folder / "record.npz",
        force=force.astype(np.float32), velocity=speed.astype(np.float32), rate=rate,
    )  # fmt: skip
    _table_of_record(folder, test, run, k, w, dwell, keep, force, speed)
    write_model(folder / "model.toml", test, rng)
    return hidden


def _table_of_record(folder, test, run, k, w, dwell, keep, force, speed) -> None:
    """Least squares of the second half of every step, with the fundamental and two harmonics."""
    rows = []
    for step in range(_STEPS):
        # Sample numbers of the recorder, and the drive's angle there.
        part = slice((step * dwell + dwell // 2) // keep + 1, ((step + 1) * dwell) // keep - 8)
        angle = run.angle[k, : dwell * _STEPS][::keep][part]
        basis = np.stack([np.ones_like(angle)] + [
            f(h * angle) for h in (1, 2, 3) for f in (np.cos, lambda a: -np.sin(a))
        ], axis=1)  # fmt: skip
        fitted = np.linalg.lstsq(basis, np.stack([force[part], speed[part]], 1), rcond=None)[0]
        one = fitted[1] + 1j * fitted[2]
        v = one[1] * np.exp(-1j * np.angle(one[0]))
        level = 1 + step // (_STEPS // 2)
        rows.append((level, w[step] * test.frequency_hz, abs(one[0]), v.real, v.imag,
                     step / (_STEPS - 1)))  # fmt: skip
    header = "level,frequency_hz,force_n,velocity_re_m_s,velocity_im_m_s,order"
    lines = [header, *(",".join(f"{value:.9g}" for value in row) for row in rows)]
    (folder / "measured.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


def main() -> None:
    """Draw, simulate and write all tests."""
    chosen = options(__doc__, out=Path, wrong=200, good=100, seed=1)
    begin = time.perf_counter()
    kinds = [*IN_TABLES, *IN_RECORDS]
    wanted = [kinds[k % len(kinds)] for k in range(chosen.wrong)] + ["none"] * chosen.good
    tests = []
    for number, kind in enumerate(wanted):
        record = kind in IN_RECORDS or (kind == "none" and number % 3 == 0)
        tests.append(draw_test(f"test_{number:03d}", kind, (chosen.seed, number), record))
    # Names that tell nothing.
    shuffled = np.random.default_rng(chosen.seed).permutation(len(tests))
    tests = [
        test._replace(name=f"test_{new:03d}") for test, new in zip(tests, shuffled, strict=True)
    ]
    keys = chosen.out / "keys"
    keys.mkdir(parents=True, exist_ok=True)
    for test in tests:
        (chosen.out / "sets" / test.name).mkdir(parents=True, exist_ok=True)
    hidden = {
        test.name: write_tables(chosen.out / "sets" / test.name, test)
        for test in tests if not test.record
    }  # fmt: skip
    with_record = [test for test in tests if test.record]
    if with_record:
        hidden |= write_records(chosen.out, with_record)
    for test in tests:
        key = {"kind": test.kind, "record": test.record, "damping": test.damping,
               "hidden": hidden[test.name],
               "law": {k: v for k, v in test.lane.items() if v}}  # fmt: skip
        (keys / f"{test.name}.json").write_text(json.dumps(key, indent=1), encoding="utf-8")
    counts = collections.Counter(test.kind for test in tests)
    print(json.dumps({"tests": len(tests), "kinds": counts,
                      "seconds": round(time.perf_counter() - begin, 1)}))  # fmt: skip


if __name__ == "__main__":
    main()
