"""Ring-down, stepped sine and slow sweeps of one structure: do their time records agree?

Run: python benchmarks/time_records.py [--noise 0.002] [--seeds 50] [--figure FILE.png]

An oscillator of 1 kg at 10 Hz with 1 % damping and nothing, a cubic spring, quadratic damping or
friction (a steep tanh), integrated by SciPy's DOP853, which knows nothing of this package. Noise on
force and motion, as a share of each channel's largest value.

JSON lines:
- `decay_and_steps`, one a law: backbone and damping from a record of stepped sines (three levels)
  against those of a free decay at equal velocity: largest and median difference of frequency,
  median of damping, share of differences within the 95 % bands of both (states within 60° of
  resonance, velocities that both records hold).
- `sweep`, one a law, rate and direction: the normalised rate; median and largest error of mobility
  over states above 0.3 of the peak, before and after the correction, against steady motion
  integrated under each state's own force; predicted and measured shift of the apparent resonance
  (where a peak is passed without a jump).
- `coverage`, one a verb: share of 95 % intervals that hold the truth over seeds of white noise and
  of noise of first order (0.9), exact linear records.
"""

import argparse
import json

import numpy as np
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

import snrmjax as sj
from snrmjax.measure import Channel, time_recording

HERTZ, RATE = 2 * np.pi, 400.0
REST, RATIO = HERTZ * 10.0, 0.01
LAWS = {
    "linear": (lambda q, v: 0.0, (5.0, 10.0, 20.0)),
    "hardening": (lambda q, v: 4e4 * q**3, (5.0, 10.0, 20.0)),
    "quadratic damping": (lambda q, v: 0.15 * v * np.abs(v), (10.0, 20.0, 40.0)),
    "friction": (lambda q, v: 2.0 * np.tanh(v / 0.05), (10.0, 20.0, 40.0)),
}
CHANNELS = [Channel("force", "force"), Channel("motion", "velocity"), Channel("drive", "voltage")]


def integrated(law, force, turn, time, start=(0.0, 0.0)):
    """Displacement and velocity under force(t) cos(turn(t))."""

    def rate(t, state):
        q, v = state
        return v, force(t) * np.cos(turn(t)) - 2 * RATIO * REST * v - REST**2 * q - law(q, v)

    found = solve_ivp(
        rate, (time[0], time[-1]), start, t_eval=time, rtol=1e-8, atol=1e-10, method="DOP853"
    )
    return found.y


def recorded(push, velocity, noise, seed=0):
    """The record of a test: force, velocity, drive."""
    rng = np.random.default_rng(seed)
    values = np.stack([push, velocity, push])
    values[:2] += (
        noise * np.abs(values[:2]).max(axis=1, keepdims=True) * rng.standard_normal((2, len(push)))
    )
    return time_recording(values, CHANNELS, RATE)


def stepped_test(law, forces, noise, dwell=14.0):
    """Three levels of stepped sine, upwards, the phase going on."""
    centre = 10.0
    hertz, size = [], []
    for force in forces:
        # From below to above, closer near resonance.
        hertz += list(centre + np.sinh(np.linspace(-2.0, 2.4, 17)) * 0.14)
        size += [force] * 17
    hertz, size = np.array(hertz), np.array(size)
    begin = np.concatenate([[0.0], np.cumsum(HERTZ * hertz[:-1] * dwell)])

    def at(t):
        return np.minimum((np.asarray(t) / dwell).astype(int), len(hertz) - 1)

    def turn(t):
        return begin[at(t)] + HERTZ * hertz[at(t)] * (t - at(t) * dwell)

    time = np.arange(round(len(hertz) * dwell * RATE)) / RATE
    state, velocity = (0.0, 0.0), []
    for k in range(len(hertz)):
        own = slice(round(k * dwell * RATE), round((k + 1) * dwell * RATE))
        t = np.append(time[own], (k + 1) * dwell)
        q, v = integrated(
            law,
            lambda _, k=k: size[k],
            lambda s, k=k: begin[k] + HERTZ * hertz[k] * (s - k * dwell),
            t,
            state,
        )
        state = (q[-1], v[-1])
        velocity.append(v[:-1])
    return recorded(size[at(time)] * np.cos(turn(time)), np.concatenate(velocity), noise)


def decay_test(law, velocity, noise):
    """A second of drive near resonance, then free from this velocity."""
    time = np.arange(round(20 * RATE)) / RATE
    free = time >= 1.0
    _, v = integrated(law, lambda _: 0.0, lambda t: 0.0 * t, time[free] - 1.0, (0.0, velocity))
    before = velocity * np.cos(REST * (time[~free] - 1.0))
    push = np.where(free, 0.0, np.cos(REST * time))
    return recorded(push, np.concatenate([before, v]), noise, 1)


def decay_against_steps(name, noise):
    """Backbones of one law by both records, and the line that compares them."""
    law, forces = LAWS[name]
    states = sj.measure.stepped_sine_states(
        stepped_test(law, forces, noise), "force", ["motion"], drive="drive"
    ).states
    modes = sj.model.linear_modes([REST], [RATIO], [[1.0]], [1.0], sensors=("motion",))
    points = sj.identify.identify_points(states, modes)
    near = np.abs(np.angle(np.asarray(states.velocity)[:, 0])) < np.pi / 3
    steps = [
        np.asarray(one)[near]
        for one in (
            points.backbone_velocity,
            points.natural_frequency,
            points.natural_frequency_std,
            points.damping_ratio,
            points.damping_ratio_std,
        )
    ]
    record = decay_test(law, 3.0 * float(steps[0].max()), noise)
    decay = sj.methods.ring_down_decays(record, "drive", ["motion"], band=(6.0, 16.0))[0]
    good = decay.found
    order = np.argsort(decay.velocity[good])
    read = [
        np.asarray(one)[good][order]
        for one in (
            decay.velocity,
            decay.natural_frequency,
            decay.natural_frequency_std,
            decay.damping_ratio,
            decay.damping_ratio_std,
        )
    ]
    inside = (steps[0] > read[0][0]) & (steps[0] < read[0][-1])
    ours = [one[inside] for one in steps]
    theirs = [np.interp(ours[0], read[0], one) for one in read]
    frequency = theirs[1] / ours[1] - 1
    damping = theirs[3] / ours[3] - 1
    score = [np.abs(theirs[k] - ours[k]) / np.hypot(theirs[k + 1], ours[k + 1]) for k in (1, 3)]
    line = {
        "benchmark": "decay_and_steps",
        "law": name,
        "noise": noise,
        "settled": int(states.n_states),
        "compared": int(inside.sum()),
        "frequency_range_percent": round(100 * float(np.ptp(ours[1]) / ours[1].min()), 3),
        "frequency_difference_largest_percent": round(100 * float(np.abs(frequency).max()), 4),
        "frequency_difference_median_percent": round(100 * float(np.median(np.abs(frequency))), 4),
        "damping_difference_median_percent": round(100 * float(np.median(np.abs(damping))), 3),
        "frequency_within_95": round(float(np.mean(score[0] < 1.96)), 3),
        "damping_within_95": round(float(np.mean(score[1] < 1.96)), 3),
    }
    print(json.dumps(line), flush=True)
    return steps, read


def steady(law, states, k):
    """Velocity phasor under a state's own force, integrated from that state on."""
    omega, force = float(states.frequency[k]), float(states.force[k])
    velocity = complex(states.velocity[k, 0])
    time = np.arange(80 * 32 + 1) / 32 * HERTZ / omega
    start = ((velocity / (1j * omega)).real, velocity.real)
    _, v = integrated(law, lambda _: force, lambda t: omega * t, time, start)
    last = slice(-10 * 32 - 1, -1)
    return 2 * np.mean(v[last] * np.exp(-1j * omega * time[last]))


def apparent(states):
    """Frequency and height of the largest mobility over frequency (a displacement's peak)."""
    order = np.argsort(np.asarray(states.frequency))
    omega = np.asarray(states.frequency)[order]
    size = np.abs(np.asarray(states.velocity)[order, 0]) / omega
    top = int(np.argmax(size))
    if not 2 <= top < len(size) - 2:
        return np.nan, np.nan
    part = slice(top - 2, top + 3)
    a, b, c = np.polyfit(omega[part] - omega[top], size[part], 2)
    return (omega[top] - b / (2 * a), c - b**2 / (4 * a)) if a < 0 else (np.nan, np.nan)


def sweep_against_steady(name, seconds, upwards, noise):
    """States of one sweep as swept and corrected, and the line that compares them."""
    law, forces = LAWS[name]
    first, last = (9.0, 11.2) if upwards else (11.2, 9.0)
    time = np.arange(round(seconds * RATE)) / RATE

    def turn(t):
        return HERTZ * (first * t + (last - first) / (2 * seconds) * t**2)

    force = forces[1]
    _, v = integrated(law, lambda _: force, turn, time)
    record = recorded(force * np.cos(turn(time)), v, noise)
    both = {}
    for correct in (False, True):
        found = sj.measure.sweep_states(record, "force", ["motion"], correct=correct)
        states = found.states
        size = np.abs(np.asarray(states.velocity)[:, 0])
        slow = np.abs(found.moving) < (0.08 if name == "hardening" else 1.0)
        loud = np.flatnonzero((size > 0.3 * size.max()) & slow)
        loud = loud[:: max(1, len(loud) // 24)]
        error = [abs(complex(states.velocity[k, 0]) / steady(law, states, k) - 1) for k in loud]
        both[correct] = found, np.array(error)
    plain, found = both[False][0], both[True][0]
    bias = found.bias[0]
    shift = np.nan
    if name != "hardening":
        # The resonance of small steps: that of the corrected states' mobility.
        shift = apparent(plain.states)[0] - REST * np.sqrt(1 - 2 * RATIO**2)
    line = {
        "benchmark": "sweep",
        "law": name,
        "seconds": seconds,
        "upwards": upwards,
        "noise": noise,
        "normalised_rate": None if bias is None else round(bias.normalised_rate, 4),
        "states": int(found.states.n_states),
        "error_before_median": float(np.median(both[False][1])),
        "error_before_largest": float(both[False][1].max()),
        "error_after_median": float(np.median(both[True][1])),
        "error_after_largest": float(both[True][1].max()),
        "shift_predicted_hz": None if bias is None else round(bias.frequency_shift / HERTZ, 4),
        "shift_measured_hz": None if np.isnan(shift) else round(shift / HERTZ, 4),
        "modal_constant": round(found.balance.constant, 5),
        "modal_constant_std": round(found.balance.constant_std, 5),
    }
    print(json.dumps(line), flush=True)
    return plain.states, found.states


def coverage(seeds):
    """Stated errors of steps and sweeps on linear records with noise, white and coloured."""
    hertz = np.array([9.9, 10.05])
    time = np.arange(round(240 * RATE)) / RATE
    first, last = 9.0, 11.2
    turn = HERTZ * (first * time + (last - first) / 480.0 * time**2)
    _, swept = integrated(
        LAWS["linear"][0],
        lambda _: 10.0,
        lambda t: HERTZ * (first * t + (last - first) / 480.0 * t**2),
        time,
    )
    steady_part = np.arange(round(30 * RATE)) / RATE
    records = {
        "sweep_states": np.stack([10 * np.cos(turn), swept]),
        "stepped_sine_states": np.concatenate(
            [
                np.stack(
                    [
                        10 * np.exp(1j * HERTZ * one * steady_part),
                        10 * mobility(HERTZ * one) * np.exp(1j * HERTZ * one * steady_part),
                    ]
                ).real
                for one in hertz
            ],
            axis=1,
        ),
    }
    for verb, clean in records.items():
        for colour in (0.0, 0.9):
            inside = []
            for seed in range(seeds):
                noise = np.random.default_rng(seed).standard_normal(clean.shape)
                noise = lfilter([np.sqrt(1 - colour**2)], [1, -colour], noise, axis=1)
                values = clean + 0.01 * np.abs(clean).max(axis=1, keepdims=True) * noise
                record = time_recording(values, CHANNELS[:2], RATE)
                if verb == "sweep_states":
                    states = sj.measure.sweep_states(
                        record, "force", ["motion"], frequencies=HERTZ * hertz
                    ).states
                else:
                    states = sj.measure.stepped_sine_states(record, "force", ["motion"]).states
                velocity, force = np.asarray(states.velocity)[:, 0], np.asarray(states.force)
                near = hertz[
                    np.abs(np.asarray(states.frequency)[:, None] / HERTZ - hertz).argmin(1)
                ]
                ratio = velocity / force / mobility(HERTZ * near)
                spread = np.hypot(
                    np.asarray(states.velocity_std)[:, 0] / np.abs(velocity),
                    np.asarray(states.force_std) / force,
                )
                inside += [*(np.abs(np.abs(ratio) - 1) < 1.96 * spread)]
                inside += [*(np.abs(np.angle(ratio)) < 1.96 * np.asarray(states.phase_std)[:, 0])]
            line = {"benchmark": "coverage", "verb": verb, "colour": colour, "seeds": seeds}
            line |= {"intervals": len(inside), "inside_95": round(float(np.mean(inside)), 4)}
            print(json.dumps(line), flush=True)


def mobility(omega):
    """Velocity over force of the linear oscillator."""
    return 1j * omega / (REST**2 - omega**2 + 2j * RATIO * REST * omega)


def drawn(compared, swept, path):
    """Frequency and damping by both records, and a sweep before and after."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(3, len(compared), squeeze=False, figsize=(3.2 * len(compared), 8.0))
    for column, (name, (steps, read)) in enumerate(compared.items()):
        for row, (at, unit) in enumerate(((1, HERTZ), (3, 0.01))):
            axis = axes[row, column]
            axis.errorbar(
                read[0],
                read[at] / unit,
                1.96 * read[at + 1] / unit,
                color="#D55E00",
                lw=1.2,
                elinewidth=0.7,
                label="free decay",
            )
            axis.errorbar(
                steps[0],
                steps[at] / unit,
                1.96 * steps[at + 1] / unit,
                ls="none",
                marker="o",
                ms=3,
                color="#0072B2",
                elinewidth=0.7,
                label="stepped sine",
            )
            axis.set_xlabel("velocity, m/s")
            axis.set_ylabel("frequency, Hz" if row == 0 else "damping, %")
        axes[0, column].set_title(name)
        axes[0, column].ticklabel_format(useOffset=False)
        low, high = steps[3].min() / 0.01, steps[3].max() / 0.01
        axes[1, column].set_ylim(low - 0.2 * (high - low) - 0.05, high + 0.2 * (high - low) + 0.05)
        axis = axes[2, column]
        for states, colour, label in zip(
            swept[name], ("0.6", "#009E73"), ("as swept", "corrected"), strict=True
        ):
            hertz = np.asarray(states.frequency) / HERTZ
            size = np.abs(np.asarray(states.velocity)[:, 0]) / np.asarray(states.force)
            axis.plot(hertz, size, ".", ms=4, color=colour, label=label)
        if name == "linear":
            grid = np.linspace(9.0, 11.2, 400)
            axis.plot(grid, np.abs(mobility(HERTZ * grid)), "k-", lw=0.8, label="exact")
        axis.set_xlim(9.3, 11.2)
        axis.set_xlabel("frequency, Hz")
        axis.set_ylabel("velocity over force, m/s/N")
        axis.legend(fontsize=8)
    axes[0, 0].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main():
    """All laws, then coverage, then the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--noise", type=float, default=0.002)
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--laws", nargs="*", choices=LAWS, default=list(LAWS))
    parser.add_argument("--figure")
    options = parser.parse_args()
    compared = {name: decay_against_steps(name, options.noise) for name in options.laws}
    swept = {}
    for name in options.laws:
        for seconds in (240.0, 60.0):
            for upwards in (True, False):
                pair = sweep_against_steady(name, seconds, upwards, options.noise)
                if upwards and (seconds == 60.0 or name == "hardening"):
                    swept.setdefault(name, pair)
    coverage(options.seeds)
    if options.figure:
        drawn(compared, swept, options.figure)


if __name__ == "__main__":
    main()
