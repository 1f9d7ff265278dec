"""Linear modes from measurements: errors against exact modes, and coverage of their bands.

Run: python benchmarks/linear_modes.py [--seeds 200] [--case coherence|close|random|light|decay|
measured]

The truth is a chain of masses and springs: modes by its eigenvalues, shapes mass-normalised by its
mass matrix.
- coherence: exact accelerances over a force, noise by a stated coherence of 20 averages.
- close: two modes 0.4 % apart, half-power bands that overlap, 40 averages.
- random: random force integrated in time (digital filters, eight steps a sample), noise on every
  accelerometer, H1 and coherence by Welch's method with Hann's window; 27 to 110 lines in a
  half-power band.
- light: the same with some 3 lines in the half-power band: with the window's leakage modelled, and
  without it.
- decay: free decays from an impulse in time, noise added, eigensystem realisation and fit.
- measured: the beams whose linear baselines their sources state, lowest level (needs
  ../shared/data).

One JSON line a case: largest median error over the modes of frequency, damping and shape, the worst
90th percentile, share of errors inside their bands of 95 %, seconds a fit, share of tests in which
another number of modes was found.
"""

import sys
import time
from pathlib import Path

import numpy as np
from harness import options, teller

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from truths.modal_structures import (
    HERTZ,
    accelerations,
    chain,
    held_linear,
    integrated,
    random_force,
    receptance,
    welch,
)

import snrmjax as sj
from snrmjax import identify
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.frequency_responses import frequency_responses
from snrmjax.measure.recordings.time_recording import time_recording

tell = teller(__file__)

FINER = 8  # integration steps a sample
FORCE = [Channel("hammer", "force", "N", point="1", direction="+z")]


def accelerometers(count):
    """Accelerometers at the first masses."""
    return [
        Channel(f"a{k + 1}", "acceleration", "m/s^2", point=str(k + 1), direction="+z")
        for k in range(count)
    ]


def usual(ratios):
    """Three masses, modes at 21, 63.4 and 86.9 Hz."""
    return chain([1.0, 1.2, 0.8], [8e4, 9e4, 1.1e5], ratios)


def responses(omega, values, coherence=None, averages=None):
    """As a reader gives them."""
    return frequency_responses(
        omega,
        values[:, None],
        accelerometers(len(values)),
        FORCE,
        coherence=None if coherence is None else coherence[:, None],
        averages=averages,
    )


def noisy(rng, structure, hertz, noise, averages):
    """Exact accelerances with noise and the coherence that states it."""
    omega = hertz * HERTZ
    exact = -(omega**2) * receptance(structure, omega, 0)
    coherence = np.abs(exact) ** 2 / (np.abs(exact) ** 2 + noise**2)
    std = np.abs(exact) * np.sqrt((1 - coherence) / coherence / 2 / averages)
    error = rng.normal(size=exact.shape) + 1j * rng.normal(size=exact.shape)
    return responses(omega, exact + std * error, coherence, averages)


def tested(rng, structure, seconds, rate, length, noise):
    """A random test in time, as averages."""
    force = random_force(rng, int(seconds * rate * FINER), rate * FINER, 150.0)
    motion = accelerations(structure, force, rate * FINER)[:, ::FINER]
    force = held_linear(force)[::FINER]
    motion = motion + noise * motion.std() * rng.normal(size=motion.shape)
    omega, values, coherence, count = welch(force, motion, rate, length)
    keep = (omega > 10 * HERTZ) & (omega < 130 * HERTZ)
    return responses(omega[keep], values[:, keep], coherence[:, keep], count)


def decayed(rng, structure, seconds, rate, noise):
    """A free decay after an impulse on the first mass."""
    n = len(structure.mass)
    start = np.concatenate([np.zeros(n), np.linalg.inv(structure.mass)[0]])
    velocity = integrated(structure, np.zeros((int(seconds * rate), n)), rate, start=start)[1].T
    values = velocity + noise * np.abs(velocity).max() * rng.normal(size=velocity.shape)
    channels = [Channel(f"v{k + 1}", "velocity", "m/s") for k in range(n)]
    return time_recording(values, channels, rate)


def scored(structure, found):
    """Relative errors and errors over 1σ of frequency, damping and shapes, or None."""
    n = len(structure.mass)
    if found.n_modes != n:
        return None
    exact = structure.shapes * np.sign(structure.shapes[0])
    frequency = found.natural_frequency / structure.natural_frequency - 1
    damping = found.damping_ratio / structure.damping_ratio - 1
    z = [
        (found.natural_frequency - structure.natural_frequency) / found.natural_frequency_std,
        (found.damping_ratio - structure.damping_ratio) / found.damping_ratio_std,
    ]
    if getattr(found, "mass_normalised", False):
        shape = np.linalg.norm(found.shape, axis=0) / np.linalg.norm(exact, axis=0) - 1
        z.append(((found.shape - exact) / found.shape_std).ravel())
    else:
        top = np.argmax(np.abs(exact), axis=0)
        relative = exact / exact[top, np.arange(n)]
        shape = np.abs(found.shape - relative).max(axis=0)
        z.append((found.shape - relative) / np.where(found.shape_std > 0, found.shape_std, 1))
        z[-1] = z[-1][found.shape_std > 0]
    return np.abs([frequency, damping, shape]), [np.abs(part) for part in z]


def coverage(name, structure, make, fit, seeds, **more):
    """One JSON line."""
    errors, inside, seconds, missed = [], [[], [], []], 0.0, 0
    for seed in range(seeds):
        data = make(np.random.default_rng(seed))
        begun = time.perf_counter()
        found = fit(data)
        seconds += time.perf_counter() - begun
        one = scored(structure, found)
        if one is None:
            missed += 1
            continue
        errors.append(one[0])
        for kept, part in zip(inside, one[1], strict=True):
            kept.append(part < 1.96)
    every = np.array(errors)
    median, tail = np.median(every, axis=0).max(axis=1), np.quantile(every, 0.9, axis=0).max(axis=1)
    line = {"case": name, "seeds": seeds, **more}
    for k, what in enumerate(("frequency", "damping", "shape")):
        line[f"{what}_error_median_%"] = 100 * float(median[k])
        line[f"{what}_error_90_%"] = 100 * float(tail[k])
        line[f"{what}_coverage_%"] = 100 * float(np.mean(inside[k]))
    line |= {"seconds_a_fit": seconds / seeds, "other_number_of_modes": missed}
    tell(**line)


def scaled(data, **settings):
    """Fit and scale by the drive point."""
    return identify.scale_modes(identify.fit_linear_modes(data, **settings), identify.DrivePoint())


def run_coherence(seeds):
    """Noise by a stated coherence."""
    structure = usual([0.01, 0.008, 0.006])
    hertz = np.arange(8, 140, 0.1)
    coverage(
        "coherence", structure, lambda rng: noisy(rng, structure, hertz, 0.3, 20), scaled, seeds
    )


def run_close(seeds):
    """Two modes whose half-power bands overlap."""
    structure = chain([1.0, 1.0], [1e5, 4e2, 1e5], [0.003, 0.0035], walls=(True, True))
    hertz = np.arange(45, 56, 0.01)
    apart = structure.natural_frequency[1] / structure.natural_frequency[0] - 1
    coverage(
        "close",
        structure,
        lambda rng: noisy(rng, structure, hertz, 1.0, 40),
        scaled,
        seeds,
        **{"apart_%": 100 * float(apart)},
    )


def run_random(seeds):
    """Random excitation in time."""
    structure = usual([0.02, 0.02, 0.02])

    def make(rng):
        return tested(rng, structure, 800.0, 1024.0, 32768, 0.05)

    coverage("random", structure, make, lambda data: scaled(data, window="hann"), seeds)


def run_light(seeds):
    """Few lines in the half-power band."""
    structure = usual([0.003, 0.002, 0.002])

    def make(rng):
        return tested(rng, structure, 800.0, 1024.0, 8192, 0.02)

    for window in ("hann", None):
        coverage(
            "light",
            structure,
            make,
            lambda data, window=window: scaled(data, window=window),
            seeds,
            leakage_modelled=window is not None,
        )


def run_decay(seeds):
    """Free decays."""
    structure = usual([0.01, 0.008, 0.006])

    def make(rng):
        return decayed(rng, structure, 3.0, 1024.0, 0.02)

    def fit(data):
        return identify.scale_modes(identify.fit_free_decay(data), None)

    coverage("decay", structure, make, fit, seeds)


def run_measured(_):
    """Beams of other laboratories beside what their sources state."""
    data = Path(__file__).resolve().parents[2] / "shared" / "data"
    for beam, table in (
        ("brake_reuss_beam", "response_controlled"),
        ("brake_reuss_beam", "force_controlled"),
        ("suspended_beam", "lock_in_stepped_sine"),
    ):
        stated = sj.read_model(data / beam / "model.toml").modes
        states = sj.read_steady_states(data / beam / f"{table}.csv")
        volts = beam == "suspended_beam"
        scale = None if volts else identify.DrivePoint(states.sensors[0])
        found, notes = identify.find_modes(states)
        modes = identify.scale_modes(found, scale)
        mass = {} if volts else {
            "modal_mass_kg": 1 / modes.shape[0, 0] / modes.participation[0],
            "stated_modal_mass_kg": 1 / stated.mode_shape[0, 0] / stated.participation[0],
        }  # fmt: skip
        tell(
            case=f"{beam}, {table}",
            modes=modes.n_modes,
            frequency_hz=modes.natural_frequency[0] / HERTZ,
            frequency_std_hz=modes.natural_frequency_std[0] / HERTZ,
            stated_hz=stated.natural_frequency[0] / HERTZ,
            damping_ratio=modes.damping_ratio[0],
            damping_ratio_std=modes.damping_ratio_std[0],
            stated_damping_ratio=stated.damping_ratio[0],
            notes=list(map(str, notes)),
            **mass,
        )


CASES = {
    "coherence": run_coherence,
    "close": run_close,
    "random": run_random,
    "light": run_light,
    "decay": run_decay,
    "measured": run_measured,
}


def main() -> None:
    """All cases, or some."""
    chosen = options(__doc__, seeds=200, case=list(CASES))
    for case in chosen.case:
        CASES[case](chosen.seeds)


if __name__ == "__main__":
    main()
