"""Time records: clipping, transients, harmonics and drop-outs of the force, aliases."""

import itertools

import numpy as np
from jaxtyping import Float

from snrmjax.doctor.findings import FORCE_HARMONICS, Finding
from snrmjax.doctor.force_checks import fall
from snrmjax.doctor.priors import (
    CERTAIN,
    FEW_BLOCKS,
    FEWEST_CYCLES,
    FLAT_TOP,
    FOLDED_LINE,
    FORCE_FALLS,
    FORCE_HARMONIC,
    PILED_UP,
    STEPS_MOVE,
    STILL_MOVING,
)
from snrmjax.measure.recordings.steps import Step, recognise_steps
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.measure.recordings.tone_track import track_tone
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

_HIGHEST = 12  # harmonic of the force


def record_findings(recording: TimeRecording) -> tuple[list[Finding], list[Fact]]:
    """Findings of one record, and notes on what could not be checked."""
    name, rate = recording.name or "record", recording.sampling_rate
    forces = [c.name for c in recording.channels if c.quantity in ("force", "voltage")]
    motions = [
        c.name
        for c in recording.channels
        if c.quantity in ("velocity", "acceleration", "displacement")
    ]
    stop = min(recording.n_samples, 2**23)
    values = {c: recording.values([c], 0, stop)[0] for c in (*forces, *motions)}
    where = {c: f"{name}, channel {c}" for c in values}
    clipped = {c: one for c, x in values.items() if (one := _flat_runs(x, where[c]))}
    notes: list[Fact] = []
    if stop < recording.n_samples:
        notes.append(Fact("record_cut", record=name, n_samples=stop))
    if not forces:
        return [*clipped.values()], [*notes, Fact("record_without_force", record=name)]
    force = forces[0]
    try:
        track = track_tone(recording, force)
        steps = recognise_steps(track, rate, least_amplitude_step=0.05, least_step=0.0)
    except InputError as error:
        no_tone = Fact("record_without_tone", record=name, error=str(error))
        return [*clipped.values()], [*notes, no_tone]
    steps = [
        one
        for one in _joined(steps, rate)
        if one.stop <= stop and _cycles(one, rate) >= FEWEST_CYCLES
    ]
    if not steps:
        return [*clipped.values()], [*notes, Fact("record_without_steps", record=name)]
    for c in values.keys() - clipped.keys():
        if flat := _flat_cycles(values[c], steps, rate, where[c]):
            clipped[c] = flat
    findings = [clipped[c] for c in values if c in clipped]
    findings += _harmonics(values[force], steps, rate, where[force])
    for c in motions:
        findings += _unsettled(values[force], values[c], steps, rate, where[c])
        findings += _dropped(values[force], values[c], steps, where[c])
    for c in (force, *motions):
        if c not in clipped:
            findings += _folded(values[c], steps, rate, where[c])
    return findings, notes


def _cycles(step: Step, rate: float) -> float:
    return (step.stop - step.start) * step.frequency / HERTZ / rate


def _joined(steps: list[Step], rate: float) -> list[Step]:
    """Steps, with those rejoined that a transient of the force has split."""
    whole: list[Step] = []
    for one in steps:
        if whole:
            last = whole[-1]
            shorter = min(one.stop - one.start, last.stop - last.start) / rate
            near = abs(one.frequency - last.frequency) < np.pi / shorter
            longer = max(one, last, key=lambda step: step.stop - step.start)
            settling = shorter * rate < 0.6 * (longer.stop - longer.start)
            if near and settling and one.stop - one.start > last.stop - last.start:
                whole[-1] = one._replace(start=last.start)
                continue
        whole.append(one)
    return whole


def _flat_runs(x: Float[np.ndarray, " sample"], where: str) -> Finding | None:
    """Neighbouring samples at exactly the extreme of the channel."""
    top, bottom = float(x.max()), float(x.min())
    largest = max(abs(top), abs(bottom))
    if largest == 0:
        return None
    fraction, piled = 0.0, 0
    for limit, sign in ((top, 1.0), (bottom, -1.0)):
        at = sign * (limit - x) <= 1e-6 * largest
        three = at[2:] & at[1:-1] & at[:-2]
        fraction += float(three.mean()) if len(three) else 0.0
        piled += _piled_up(sign * x, at, 2e-6 * largest)
    if fraction < PILED_UP and not piled:
        return None
    crowd = piled if fraction < PILED_UP else None
    return _clipping(
        where, Fact("channel_full_scale", fraction=fraction, n_samples=crowd, low=bottom, high=top)
    )


def _piled_up(x: Float[np.ndarray, " sample"], at: np.ndarray, width: float) -> int:
    """Number of samples at the top of a channel (`at`) if more than for a sine; else zero.

    For a digitised sine the n-th count below the top holds √n − √(n − 1) of the samples of the top
    one, so that the top has at most 2.4 times as many as the next; a sine sampled synchronously or
    without noise has every value equally often. Neighbours at the top are no single peaks.
    """
    number = int(at.sum())
    upper = x[(x > 0.5 * x.max()) & ~at]
    if number < CERTAIN or not np.any(at[1:] & at[:-1]) or not len(upper):
        return 0
    elsewhere = np.unique(np.round(upper / width), return_counts=True)[1].max()
    return number if number > 0.5 * CERTAIN * elsewhere else 0


def _clipping(where: str, evidence: Fact) -> Finding:
    return Finding("clipped_channel", where, evidence, Fact("advice_range"))


def _middle(step: Step, fraction: float = 0.5) -> slice:
    """The last part of a step, without its end."""
    length = step.stop - step.start
    return slice(int(step.stop - fraction * length), int(step.stop - 0.02 * length))


def _demodulated(x: np.ndarray, rows: slice, frequency: float, rate: float) -> np.ndarray:
    """Phasors of neighbouring blocks of cycles, with phases relative to the record's time axis."""
    cycle, n = HERTZ * rate / frequency, rows.stop - rows.start
    blocks = max(1, min(int(n / cycle), 32))
    edges = np.round(np.arange(blocks + 1) * int(n / cycle / blocks) * cycle).astype(int)
    part = x[rows.start : rows.start + edges[-1]]
    rotation = np.exp(-1j * frequency * (rows.start + np.arange(len(part))) / rate)
    ends = itertools.pairwise(edges)
    return np.array([2 * np.mean((part[a:b] - part[a:b].mean()) * rotation[a:b]) for a, b in ends])


def _flat_cycles(x: np.ndarray, steps: list[Step], rate: float, where: str) -> Finding | None:
    """A mean cycle with flat tops, for clipping hidden by noise in single samples."""
    levels = [float(np.std(x[_middle(step)])) for step in steps]
    best = None
    for k in np.argsort(levels)[-3:]:
        one = steps[int(k)]
        rows = _middle(one)
        phase = (one.frequency * np.arange(rows.start, rows.stop) / rate) % (2 * np.pi)
        bins = 64
        index = np.minimum((phase / (2 * np.pi) * bins).astype(int), bins - 1)
        counts = np.bincount(index, minlength=bins)
        if counts.min() < 3:
            continue
        mean = np.bincount(index, x[rows], minlength=bins) / counts
        mean = mean - 0.5 * (mean.max() + mean.min())
        flat = float(np.mean(np.abs(mean) > 0.97 * np.abs(mean).max()))
        if best is None or flat > best:
            best = flat
    if best is None or best < FLAT_TOP:
        return None
    return _clipping(where, Fact("cycle_flat", fraction=best))


def _harmonics(x: np.ndarray, steps: list[Step], rate: float, where: str) -> list[Finding]:
    """The largest harmonic of the force."""
    spectra = [_lines(x, _middle(step), step.frequency, rate) for step in steps]
    worst = np.max([lines[1:] / max(lines[0], 1e-300) for lines in spectra], axis=0)
    order = int(np.argmax(worst))
    if not worst[order] > FORCE_HARMONIC:
        return []
    evidence = Fact("record_force_harmonic", order=order + 2, ratio=float(worst[order]))
    return [Finding(FORCE_HARMONICS, where, evidence, Fact("advice_amplifier"))]


def _lines(x: np.ndarray, rows: slice, frequency: float, rate: float) -> np.ndarray:
    """Amplitudes of the fundamental and its harmonics below half the rate, by least squares."""
    time = np.arange(rows.start, rows.stop) / rate
    most = min(_HIGHEST, int(0.95 * np.pi * rate / frequency))
    if most < 2 or len(time) < 4 * most + 4:
        return np.append(1.0, np.zeros(_HIGHEST - 1))  # too short to separate harmonics
    phases = np.outer(time, frequency * np.arange(1, most + 1))
    design = np.concatenate([np.ones((len(time), 1)), np.cos(phases), np.sin(phases)], axis=1)
    theta = np.linalg.lstsq(design, x[rows], rcond=None)[0]
    amplitude = np.hypot(theta[1 : 1 + most], theta[1 + most :])
    return np.concatenate([amplitude, np.zeros(_HIGHEST - most)])


def _unsettled(
    force: np.ndarray, x: np.ndarray, steps: list[Step], rate: float, where: str
) -> list[Finding]:
    """Steps whose response still changes at their end by more than the scatter of its blocks."""
    moving, over_noise = [], []
    for one in steps:
        rows = _middle(one, min(1.0, max(0.3, 5 / _cycles(one, rate))))
        v, f = (_demodulated(c, rows, one.frequency, rate) for c in (x, force))
        if len(v) < 3 or not np.all(np.abs(f) > 0):
            continue
        z = v / f
        position = np.linspace(-0.5, 0.5, len(z))
        slope = np.sum(position * (z - z.mean())) / np.sum(position**2)
        rest = z - z.mean() - slope * position
        # A transient is curved: noise is estimated from second differences (variance 6σ²).
        jumps = np.diff(rest, 2) if len(rest) > 4 else rest
        noise = float(np.sqrt(np.mean(np.abs(jumps) ** 2) / 6 / np.sum(position**2)))
        change = float(abs(slope) / abs(z[-1]))
        few = len(v) <= FEW_BLOCKS
        # Without an estimate of its scatter a step must change by more.
        believed = change > 2.5 * STILL_MOVING if few else abs(slope) > CERTAIN * noise
        if change > STILL_MOVING:
            moving.append((change, one, believed))
        if not few:
            over_noise.append(abs(slope) / max(noise, 1e-300))
    # In five blocks the rotation of a transient resembles scatter, but not in many steps.
    together = len(over_noise) >= CERTAIN and np.median(over_noise) > CERTAIN / 3
    if not (together and 2 * len(moving) > len(steps)):
        moving = [one for one in moving if one[2]]
    if len(moving) < max(1, STEPS_MOVE * len(steps)):
        return []
    worst, one, _ = max(moving, key=lambda step: step[0])
    evidence = Fact(
        "steps_move",
        n_moving=len(moving),
        n_steps=len(steps),
        change=worst,
        time_s=one.start / rate,
    )
    return [Finding("unsettled_steps", where, evidence, Fact("advice_unsettled"))]


def _dropped(force: np.ndarray, x: np.ndarray, steps: list[Step], where: str) -> list[Finding]:
    """Force that drops where the mobility is largest and recovers on both sides.

    Without recovery it is the start of another level.
    """
    if len(steps) < 5:
        return []
    f, v = (np.array([np.std(c[_middle(step)]) for step in steps]) * 2**0.5 for c in (force, x))
    drop, nominal = fall(f, v / f)
    least = int(np.argmin(f))
    around = min(f[:least].max(initial=0.0), f[least + 1 :].max(initial=0.0))
    back = around > nominal * (1 - 0.5 * drop)
    if drop < FORCE_FALLS or not back or np.ptp(np.log(v)) < 0.25:
        return []
    evidence = Fact("record_force_falls", force=nominal, fall=drop)
    return [Finding("force_dropout", where, evidence, Fact("advice_record_force"))]


def _folded(x: np.ndarray, steps: list[Step], rate: float, where: str) -> list[Finding]:
    """Lines between the harmonics of the drive, and the harmonics of which they are aliases."""
    images: list[tuple[float, float, int]] = []
    others: list[tuple[float, float]] = []
    for one in sorted(steps, key=lambda one: one.start - one.stop)[:12]:
        rows = _middle(one)
        n = rows.stop - rows.start
        if n < 256:
            continue
        part = x[rows] - x[rows].mean()
        window = np.blackman(n)
        spectrum = np.abs(np.fft.rfft(part * window)) * 2 / window.sum()
        hertz = np.arange(len(spectrum)) * rate / n
        f0 = one.frequency / HERTZ
        fundamental = float(_lines(x, rows, one.frequency, rate)[0])
        guard = 4.5 * rate / n
        away = np.abs(hertz - f0 * np.round(hertz / f0)) > guard
        width = max(16, len(spectrum) // 64)
        for k in np.flatnonzero(away[1:-1]) + 1:
            line = float(spectrum[k])
            if line < FOLDED_LINE * fundamental or line < max(spectrum[k - 1], spectrum[k + 1]):
                continue
            around = spectrum[max(0, k - width) : k + width][away[max(0, k - width) : k + width]]
            if line < 2 * CERTAIN * float(np.median(around)):
                continue
            f = float(hertz[k])
            if any(abs(f - m * round(f / m)) < 1.0 and f < 8.5 * m for m in (50.0, 60.0)):
                continue
            orders = np.arange(int(rate / 2 / f0) + 1, 60)
            alias = np.abs(orders * f0 - rate * np.round(orders * f0 / rate))
            off = np.abs(alias - f)
            if len(orders) and off.min() < 1.5 * rate / n + 1e-4 * f0 * orders[off.argmin()]:
                images.append((line / fundamental, f, int(orders[off.argmin()])))
            else:
                others.append((line / fundamental, f))
    if not (images or others):
        return []
    ratio, line, order = max(images) if images else (*max(others), None)
    evidence = Fact("line_folded", frequency_hz=line, ratio=ratio, rate_hz=rate, order=order)
    return [Finding("missing_anti_alias", where, evidence, Fact("advice_folded"))]
