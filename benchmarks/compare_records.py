"""All methods from time records of one virtual laboratory, by the command `compare`.

Run: python benchmarks/compare_records.py [--out DIR] [--noise 0.002]

A clamped oscillator of 0.8 kg at 40 Hz with 1 % damping and a cubic spring hangs on a shaker with
its own mass, spring and back-EMF, so that the force drops at resonance and carries harmonics. Four
tests are recorded as CSV: a stepped sine under constant voltage at two levels, upwards; a free
decay from a locked resonance; and a multisine. `snrmjax compare` then reads the four files.

JSON lines: one a record with its seconds of test; `command` with the wall time of the command; one
a method with median and largest error of frequency and damping against harmonic balance of one
term (of a cubic spring within 1e-3 of the exact frequency here), over velocities above 5 % of the
largest, and the points found.
"""

import csv
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from harness import options, teller

import snrmjax as sj

tell = teller(__file__)

HERTZ = 2 * np.pi
REST, RATIO, CUBIC, MASS = 40 * HERTZ, 0.01, 3e9, 0.8
RATE = 2000.0


def laboratory(noise):
    """The structure on its shaker; noise as a share of 1 N and 0.2 m/s."""
    shape = 1 / np.sqrt(MASS)
    modes = sj.model.linear_modes([REST], [RATIO], [[shape]], [shape], sensors=("tip",))
    beam = sj.model.structure(
        modes, sj.model.polynomial_potential({"1111": CUBIC * shape**2 / 4}, 1)
    )
    shaker = sj.simulate.Shaker(30.0, 8.0, mass=0.05, damping=1.0, stiffness=500.0)
    instruments = sj.simulate.Instruments(force_noise=noise, velocity_noise=0.2 * noise)
    return sj.simulate.Laboratory(beam, shaker, instruments, RATE)


def recorded(path, record, *, forced=True):
    """Write a record and print its line."""
    columns = {"time_s": record.time, "tip.velocity_m_s": record.velocity}
    if forced:
        columns |= {"force_n": record.force, "drive_v": record.voltage}
    values = np.stack([np.asarray(one) for one in columns.values()], axis=1)
    np.savetxt(path, values, delimiter=",", header=",".join(columns), comments="", fmt="%.9g")
    seconds = float(values[-1, 0] - values[0, 0])
    tell(record=path.stem, test_s=seconds)


def main() -> None:
    """Record, compare, score."""
    given = options(__doc__, out=Path, noise=0.002)
    folder = given.out or Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    bench = laboratory(given.noise)
    shape = 1 / np.sqrt(MASS)
    (folder / "model.toml").write_text(
        f'name = "oscillator on a shaker"\n[[mode]]\nfrequency_hz = 40.0\ndamping_ratio = {RATIO}\n'
        f"shape = {{ tip = {shape} }}\nparticipation = {shape}\n"
    )
    omega = HERTZ * np.linspace(36.5, 43.0, 24)
    for name, voltage in (("stepped_low", 1.5), ("stepped_high", 5.0)):
        test = sj.simulate.stepped_sine_test(bench, voltage, omega, settle_cycles=90)
        recorded(folder / f"{name}.csv", test.record)
    test = sj.simulate.decay_test(bench, 8.0, 3.0)
    recorded(folder / "decay.csv", test.record, forced=False)
    lines = np.arange(20, 80)
    test = sj.simulate.multisine_test(bench, 8.0, lines, 2000, 6, seed=1)
    recorded(folder / "multisine.csv", test.record)
    names = ("stepped_low", "stepped_high", "decay", "multisine")
    begin = time.perf_counter()
    subprocess.run(
        [sys.executable, "-m", "snrmjax", "compare"]
        + [str(folder / f"{name}.csv") for name in names]
        + ["--model", str(folder / "model.toml"), "--out", str(folder / "compared")],
        check=True,
    )
    wall = time.perf_counter() - begin
    tell(command_s=wall)
    with (folder / "compared" / "compare.csv").open() as file:
        rows = list(csv.DictReader(file))
    for method in dict.fromkeys(row["method"] for row in rows):
        found = [row for row in rows if row["method"] == method and row["status"] == "found"]
        columns = ("velocity_m_s", "frequency_hz", "damping_ratio")
        speed, hertz, ratio = (np.array([float(row[name]) for row in found]) for name in columns)
        kept = speed > 0.05 * speed.max(initial=0.0)
        line = {"method": method, "points": len(found)}
        if kept.any():
            half = REST**2 / 2
            true = np.sqrt(half + np.sqrt(half**2 + 0.75 * CUBIC * speed**2))
            off = np.abs(hertz * HERTZ / true - 1)[kept]
            away = np.abs(ratio * hertz * HERTZ / (RATIO * REST) - 1)[kept]
            line |= {
                "frequency_error_median": float(np.median(off)),
                "frequency_error_largest": float(off.max()),
                "damping_error_median": float(np.median(away)),
                "damping_error_largest": float(away.max()),
            }
        tell(**line)


if __name__ == "__main__":
    main()
