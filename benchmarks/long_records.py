"""Time records larger than memory: what each verb needs, on records that are computed when read.

Run: python benchmarks/long_records.py [--gigabytes 4] [--small 0.25]

Two channels of int16 at 10 kHz, a force and a displacement, of the size that is asked for; each
sample is computed when it is read, so that no disk is needed. Stepped sine (500 steps), slow sweep,
multisine and bursts with free decays. Each verb runs in a process of its own, on a small record and
on the large one: the difference of the peaks of resident memory says what grows with the record.

One JSON line a verb and size: GB, samples a channel, seconds, peak resident memory in MB, how much
of it was there before the verb began, what was found, and its largest error.
"""

import argparse
import json
import multiprocessing
import resource
import time

import numpy as np

import snrmjax as sj
from snrmjax.measure import Channel, time_recording
from snrmjax.measure.recordings.time_recording import AbstractSamples

HERTZ, RATE = 2 * np.pi, 10_000.0
FULL = 30_000  # counts of the converter
STEPS, LOW, HIGH = 500, 20.0, 25.0
REST, RATIO = HERTZ * 22.5, 0.005
PERIOD = 2**17  # samples of the multisine
BURST, CYCLE = 20.0, 60.0  # s of drive and between bursts


def gain(omega):
    """Displacement over force of a lightly damped mode, so scaled that 1 is its largest."""
    return 0.01 / (1 - (omega / REST) ** 2 + 2j * RATIO * omega / REST)


class Computed(AbstractSamples):
    """Samples of a test, computed when read."""

    def __init__(self, kind, samples):
        self.kind, self.samples = kind, samples
        lines = np.arange(200, 400)
        turn = np.random.default_rng(0).uniform(0, HERTZ, len(lines))
        spectrum = np.zeros(PERIOD // 2 + 1, dtype=complex)
        spectrum[lines] = np.exp(1j * turn)
        answer = spectrum * gain(HERTZ * np.arange(PERIOD // 2 + 1) * RATE / PERIOD)
        signals = np.fft.irfft([spectrum, answer], PERIOD)
        self.lines, self.period = lines, signals / np.abs(signals[0]).max()

    @property
    def shape(self):
        """Channels and samples."""
        return 2, self.samples

    def read(self, channels, start, stop):
        """Counts of some channels."""
        n = np.arange(start, stop)
        both = getattr(self, self.kind)(n)
        noise = np.random.default_rng(start).integers(-30, 31, (len(channels), len(n)))
        return (np.stack([both(k) for k in channels]) * FULL + noise).astype(np.int16)

    def stepped(self, n):
        """Steady from step to step (a settled structure)."""
        dwell = self.samples // STEPS
        step = np.minimum(n // dwell, STEPS - 1)
        hertz = np.linspace(LOW, HIGH, STEPS)
        # A step begins with the phase at which the last one ended.
        begin = np.concatenate([[0.0], np.cumsum(hertz[:-1] * dwell / RATE)]) % 1.0
        turn = HERTZ * (begin[step] + hertz[step] * ((n - step * dwell) / RATE) % 1.0)
        answer = gain(HERTZ * hertz)[step]
        return lambda k: (
            np.cos(turn) if k == 0 else np.abs(answer) * np.cos(turn + np.angle(answer))
        )

    def swept(self, n):
        """So slow that the motion is steady."""
        span = self.samples / RATE
        t = n / RATE
        turn = HERTZ * ((LOW * t + (HIGH - LOW) / (2 * span) * t**2) % 1.0)
        answer = gain(HERTZ * (LOW + (HIGH - LOW) * t / span))
        return lambda k: (
            np.cos(turn) if k == 0 else np.abs(answer) * np.cos(turn + np.angle(answer))
        )

    def multisine(self, n):
        """One period again and again."""
        return lambda k: self.period[k, n % PERIOD]

    def decaying(self, n):
        """Bursts at resonance and free decays."""
        since = (n / RATE) % CYCLE
        turn = REST * since
        size = np.exp(-RATIO * REST * np.maximum(since - BURST, 0.0))
        return lambda k: np.cos(turn) * ((since < BURST) if k == 0 else 0.9 * size)


def stepped_sine(record, _):
    """Largest relative error of a step's mobility."""
    found = sj.measure.stepped_sine_states(record, "force", ["motion"], harmonic_order=(1,))
    states = found.states
    hertz = np.asarray(states.frequency) / HERTZ
    wanted = np.linspace(LOW, HIGH, STEPS)
    ratio = np.asarray(states.velocity)[:, 0] / np.asarray(states.force)
    near = wanted[np.abs(hertz[:, None] - wanted).argmin(axis=1)]
    error = ratio / (1j * HERTZ * near * gain(HERTZ * near)) - 1
    return f"{states.n_states} steps", float(np.abs(error).max())


def slow_sweep(record, _):
    """Median relative error of a state's mobility."""
    found = sj.measure.sweep_states(record, "force", ["motion"], harmonic_order=(1,))
    omega = np.asarray(found.states.frequency)
    ratio = np.asarray(found.states.velocity)[:, 0] / np.asarray(found.states.force)
    error = np.abs(ratio / (1j * omega * gain(omega)) - 1)
    return f"{found.states.n_states} states", float(np.median(error))


def multisine(record, samples):
    """Largest relative error of a line."""
    found = sj.measure.multisine_responses(record, "force", ["motion"])
    true = gain(found.responses.frequency)
    error = np.abs(found.responses.values[0, 0] / true - 1)
    return f"{len(true)} lines of {found.periods} periods", float(error.max())


def ring_downs(record, _):
    """Largest relative error of a decay's median damping."""
    found = [
        sj.methods.resonant_decay(
            record.time(free.start, free.stop),
            record.values(["motion"], free.start, free.stop)[0],
            band=(15.0, 30.0),
            least_amplitude=0.1,
        )
        for free in sj.measure.find_ring_downs(record, "force", "motion")
    ]
    ratios = [np.median(one.damping_ratio) for one in found]
    return f"{len(found)} decays", float(np.max(np.abs(np.array(ratios) / RATIO - 1)))


VERBS = {
    "stepped_sine_states": ("stepped", stepped_sine),
    "sweep_states": ("swept", slow_sweep),
    "multisine_responses": ("multisine", multisine),
    "resonant_decay": ("decaying", ring_downs),
}


def resident():
    """Peak resident memory of this process, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(verb, gigabytes):
    """Runs one verb on one record and prints its line."""
    kind, run = VERBS[verb]
    samples = int(gigabytes * 1e9 / 4)
    channels = [
        Channel("force", "force", calibration=1 / FULL),
        Channel("motion", "displacement", calibration=1 / FULL),
    ]
    source = Computed(kind, samples)
    record = time_recording(source, channels, RATE)
    before, begin = resident(), time.perf_counter()
    found, error = run(record, source)
    seconds = time.perf_counter() - begin
    line = {
        "verb": verb,
        "gigabytes": gigabytes,
        "samples": samples,
        "seconds": round(seconds, 1),
        "peak_mb": round(resident()),
        "before_mb": round(before),
        "found": found,
        "error": error,
    }
    print(json.dumps(line), flush=True)


def main():
    """Every verb, on a small record and on a large one."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gigabytes", type=float, default=4.0)
    parser.add_argument("--small", type=float, default=0.25)
    parser.add_argument("--verb", choices=VERBS, action="append")
    options = parser.parse_args()
    context = multiprocessing.get_context("spawn")
    for verb in options.verb or VERBS:
        for size in (options.small, options.gigabytes):
            child = context.Process(target=measure, args=(verb, size))
            child.start()
            child.join()


if __name__ == "__main__":
    main()
