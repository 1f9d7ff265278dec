# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     name: python3
# ---

# %% [markdown]
# # Other identification methods on the same data
#
# Many methods identify a nonlinear structure on a shaker. Here several of them are applied to the
# same structures, the same noise and, where possible, the same states:
#
# 1. one table of steady states, six methods: the flat beam with measurement noise;
# 2. control loops that stabilise what an open loop loses: a one-sided stop on a shaker;
# 3. free decays evaluated in three ways, and a stepped sine of the same structure;
# 4. the whole comparison (seven structures, three noises, 20 seeds), and what it shows about ours.
#
# All methods return a `MethodResult`: natural frequency and damping ratio against the
# velocity amplitude at resonance, 1σ where the method has one, a status at every point.

# %%
# %matplotlib inline
import json
from pathlib import Path

import numpy as np

import snrmjax as sj
from snrmjax.plot import style as drawing

HERTZ = 2 * np.pi
BENCHMARKS = Path("../benchmarks")  # notebooks run in their own folder
NAMES = {
    "snrm": "inverse SNRM",
    "concerto": "CONCERTO",
    "arslan_ozguven": "describing function",
    "rct": "response-controlled fit",
    "harmonic_force_surface": "force surface",
    "phase_resonance": "phase resonance",
}
headline = {}


# %% [markdown]
# ## 1. One table of steady states, six methods
#
# The flat clamped beam of the method's paper, simulated with its four modes and nine harmonics:
# four levels of force, twelve states each within 75° of resonance, errors of 0.5 % of amplitude
# and 0.5° of phase. The truth is the resonance (velocity in phase with the force) of exact
# responses, unknown to the methods. The methods:
#
# - *inverse SNRM*: Kwarta & Allen, this package's own;
# - *CONCERTO* (Carrella & Ewins 2011): pairs of frequencies of equal amplitude on both sides;
# - *describing functions* (Arslan & Özgüven 2008), the location of the nonlinear element known;
# - *response-controlled tests* (Karaağaçlı & Özgüven 2020): modal fits at constant amplitude, and
#   the *harmonic force surface*. Its authors control amplitudes in the test; here surfaces are
#   interpolated from levels of constant force, unlike their tests;
# - *phase resonance* (Peeters, Kerschen & Golinval 2011): each level's crossing of 0°.

# %% tags=["hide-input"]
# Error of frequency and of damping against velocity by six methods: inverse SNRM, describing
# functions and phase resonance scatter about zero, the others are biased.
beam = sj.model.flat_beam()
ends = (60 * HERTZ, 120 * HERTZ)
forces = (2.669e-3, 4.448e-3, 8.896e-3, 1.334e-2)
errors = sj.simulate.MeasurementErrors(amplitude=0.005, phase=np.radians(0.5))
test = sj.phase_resonance_test(
    *(beam, forces, *ends),
    appropriation=(np.cos(np.radians(75)) ** 2, 1.0),
    points_per_level=12,
    recording=sj.simulate.Recording(errors, seed=7),
)
compared = sj.methods.compare_methods(test.steady_states, beam.modes)
exact = sj.forced_response(beam, np.geomspace(1e-3, 1.6e-2, 14), *ends, stability=False)
tops = [(curve, curve.at_events("phase_resonance")[0]) for curve in exact]
true_speed = np.array([abs(curve.velocity[k, 1, 0]) for curve, k in tops])
true_omega = np.array([curve.frequency[k] for curve, k in tops])
per_force = float(beam.modes.mode_shape[0, 0] * beam.modes.participation[0])
true_ratio = (
    per_force * np.array([curve.force for curve, _ in tops]) / true_speed / (2 * true_omega)
)


def errors_of(one):
    """Velocity, error of frequency (%) and of damping (%) at a method's own points."""
    kept = one.has_result & (one.velocity > true_speed[0]) & (one.velocity < true_speed[-1])
    speed = np.asarray(one.velocity)[kept]
    exactly = [np.interp(speed, true_speed, law) for law in (true_omega, true_ratio)]
    found = (np.asarray(one.natural_frequency)[kept], np.asarray(one.damping_ratio)[kept])
    return speed, *(100 * (a / b - 1) for a, b in zip(found, exactly, strict=True))


figure, grid = drawing.panels(drawing.PAGE, 3.4, 1, 2)
misses = {}
print("median and largest error:         frequency (%)      damping (%)     points")
for k, one in enumerate(compared.results):
    speed, off, off_damping = errors_of(one)
    misses[one.method] = np.median(np.abs(off)), np.median(np.abs(off_damping))
    print(
        f"{NAMES[one.method]:26s}   {misses[one.method][0]:8.4f} {np.abs(off).max():8.4f}   "
        f"{misses[one.method][1]:8.3f} {np.abs(off_damping).max():8.2f}   {len(speed):6d}"
    )
    style = {"color": drawing.SERIES[k % 6], "label": NAMES[one.method]}
    mark = "-" if one.method == "snrm" else "o"
    for axes, value in zip(grid[0], (off, off_damping), strict=True):
        axes.plot(speed, value, mark, markersize=3, **style)
for axes, what, limit in zip(
    grid[0], ("natural frequency", "damping ratio"), (0.8, 12), strict=True
):
    axes.axhline(0, color="black", linestyle="--", linewidth=1, label="true")
    axes.set_ylim(-limit, limit)
    drawing.name_axes(axes, what, "Velocity amplitude (m/s)", "Found less true (%)")
drawing.legend(figure)
figure

# %% [markdown]
# Methods that use the force balance of each state (ours, describing functions) and phase
# resonance have only the errors of noise. CONCERTO and the modal fits assume a linear mode of
# constant amplitude between two states: where the modal mass of the beam's deflected shape
# differs, and where levels are few, they are biased by a few tenths of a percent. Far outliers lie
# beyond the figure.

# %% tags=["hide-input"]
headline |= {
    "flat beam: inverse SNRM within 0.05 % of frequency, 0.5 % of damping in the median": (
        misses["snrm"][0] < 0.05 and misses["snrm"][1] < 0.5
    ),
    "all six methods ran": len(compared.results) == 6,
}

# %% [markdown]
# ## 2. Unstable states: open loop and control
#
# One mode at 50 Hz meets a stop of twice its stiffness, on a shaker with back-EMF and a moving
# armature, with noise on both channels. A stepped sine of one voltage jumps, at different
# frequencies upwards and downwards. A phase-locked loop (Peter & Leine 2017) follows the
# backbone, and the response phase by phase around the fold. Control-based continuation (Barton &
# Sieber) stabilises the unstable part of the S-curve at one frequency by non-invasive velocity
# feedback.

# %%
modes = sj.model.linear_modes([50 * HERTZ], [0.01], [[1.0]], [1.0])
contact = sj.model.EFFECTS["one_sided_stop"](stiffness=2 * (50 * HERTZ) ** 2, gap=1e-4)
stop = sj.model.structure(modes, effects=[contact])
bench = sj.simulate.Laboratory(
    stop,
    sj.simulate.Shaker(300.0, 8.0, mass=0.02, damping=0.2, stiffness=300.0),
    sj.simulate.Instruments(force_noise=1e-3, velocity_noise=1e-4),
    4000.0,
    substeps=4,
)
steps = HERTZ * np.linspace(49, 63, 29)
sines = {}
for way, at in (("up", steps), ("down", steps[::-1])):
    swept = sj.simulate.stepped_sine_test(bench, 30.0, at, settle_cycles=400)
    states = sj.simulate.steady_states_of(bench, swept)
    sines[way] = at / HERTZ, np.abs(np.asarray(states.velocity)[:, 0]), swept.seconds
loop = sj.methods.phase_locked_loop(
    bench,
    np.array([6.0, 10.0, 15.0, 20.0, 25.0, 30.0, 40.0]),
    gains=sj.simulate.LoopGains(120.0, 16.0),
    settle_cycles=400,
)
phases = np.radians([55, 40, 25, 10, 0, -15, -30, -40, -50, -60, -70, -78])
around = sj.simulate.phase_sweep(
    bench, 30.0, phases, gains=sj.simulate.LoopGains(120.0, 16.0), settle_cycles=400
)
curve = sj.simulate.s_curve(
    bench,
    56 * HERTZ,
    np.linspace(0.01, 0.12, 14),
    sj.simulate.FeedbackSettings(3000.0, filter_rate=200.0),
)
resonances = sj.simulate.phase_controlled(stop, 1.5)
print(
    f"seconds of test: open loop {sum(one[2] for one in sines.values()):.0f}, phase-locked loop "
    f"{loop.test_seconds:.0f}, phase by phase {around.test_seconds:.0f}, S-curve "
    f"{curve.test_seconds:.0f}"
)

# %% tags=["hide-input"]
# Left: an open loop jumps at different frequencies up and down, the loops follow the exact
# resonances and go around the fold. Right: force against velocity at 56 Hz, with a falling part.
figure, ((left, right),) = drawing.panels(drawing.PAGE, 3.6, 1, 2)
left.plot(
    resonances.frequency / HERTZ,
    np.abs(resonances.velocity[:, 1, 0]),
    *("k--",),
    linewidth=1,
    label="resonances, exact",
)
for (way, (hertz, speed, _)), mark in zip(sines.items(), "><", strict=True):
    left.plot(hertz, speed, mark, color="0.55", markersize=3, label=f"open loop, {way}")
left.plot(
    loop.natural_frequency / HERTZ,
    loop.velocity,
    *("s",),
    color=drawing.SERIES[1],
    markerfacecolor="none",
    label="phase-locked loop",
)
left.plot(
    around.frequency / HERTZ,
    np.abs(around.velocity),
    *("o-",),
    color=drawing.SERIES[0],
    markersize=3,
    linewidth=0.8,
    label="phase by phase",
)
right.plot(curve.velocity, curve.force, "o-", color=drawing.SERIES[2], label="held at 56 Hz")
drawing.name_axes(left, "stop on a shaker", "Frequency (Hz)", "Velocity amplitude (m/s)")
drawing.name_axes(right, "S-curve", "Velocity amplitude (m/s)", "Force (N)")
drawing.legend(figure)
figure

# %%
speed_up, speed_down = sines["up"][1], sines["down"][1][::-1]
exact_speed = np.abs(resonances.velocity[:, 1, 0])
rising = np.argsort(exact_speed)
misses_loop = np.abs(
    loop.natural_frequency
    / np.interp(loop.velocity, exact_speed[rising], resonances.frequency[rising])
    - 1
)
falling = int(np.sum(np.diff(curve.force) < 0))
print(
    f"largest error of the loop's frequency {100 * misses_loop.max():.3f} %; points of the S-curve "
    f"where the force falls (unstable without control): {falling}"
)
headline |= {
    "open loop: two answers at some frequency": bool(np.max(speed_up / speed_down) > 1.5),
    "phase-locked loop within 0.05 % of the exact resonances": bool(misses_loop.max() < 5e-4),
    "every phase around the fold is held": bool(around.on_target.all()),
    "the S-curve's falling part is held": falling >= 1,
}

# %% [markdown]
# ## 3. A decay and a stepped sine of one structure
#
# One mode at 50 Hz with a cubic stiffness and quadratic damping, in the same laboratory. A loop
# keeps resonance, the shaker is removed, and the decay is evaluated by its peaks and by
# the analytic signal (resonant decay), by a force surface of acceleration over displacement and
# velocity (Masri & Caughey 1979), and by the normal form on its spectral submanifold. A stepped
# sine of the same structure goes to the inverse SNRM.

# %% tags=["hide-input"]
# Error of frequency and damping against velocity by three evaluations of a decay, a submanifold and
# a stepped sine: all within 0.02 % and 3 %.
duffing = sj.model.structure(
    modes,
    sj.model.polynomial_potential({"1111": 2.5e8}, 1),
    effects=[sj.model.EFFECTS["quadratic_damping"](coefficient=10.0)],
)
bench = sj.simulate.Laboratory(
    duffing,
    sj.simulate.Shaker(3.0, 15.0, mass=0.01, damping=0.1, stiffness=10.0),
    sj.simulate.Instruments(force_noise=2e-3, velocity_noise=2e-4, filter_corner_hz=1500.0),
    6000.0,
    substeps=2,
)
decay = sj.simulate.decay_test(bench, 10.0, 4.0)
time, velocity = np.asarray(decay.record.time), np.asarray(decay.record.velocity)
least = 0.02  # m/s, above the noise
read = {
    "decay, peaks": sj.methods.resonant_decay(
        time, velocity, band=(20, 110), least_amplitude=least
    ),
    "decay, analytic signal": sj.methods.resonant_decay(
        time, velocity, reading="hilbert", band=(20, 110), least_amplitude=least
    ),
    "force surface": sj.methods.restoring_force(time, velocity, least_amplitude=least),
    "submanifold": sj.methods.ssm(time, velocity, least_amplitude=least),
}
found = []
for level, volts in enumerate((1.0, 2.5, 5.0, 10.0), start=1):
    at = HERTZ * np.linspace(47.5, 54.5, 15)
    one = sj.simulate.stepped_sine_test(bench, volts, at, settle_cycles=150)
    found.append(sj.simulate.steady_states_of(bench, one, level=level))
states = sj.measure.join_steady_states(found)
near = np.abs(np.angle(np.asarray(states.velocity)[:, 0], deg=True)) < 75
read["stepped sine, inverse SNRM"] = sj.methods.snrm(states.select(near), modes)
truth = sj.simulate.damped_normal_mode(duffing, 1.0)
speed = np.abs(truth.velocity[:, 1, 0])

figure, grid = drawing.panels(drawing.PAGE, 3.4, 1, 2)
exactly = truth.frequency, truth.damping_ratio
print("largest error between 0.05 and 0.5 m/s:  frequency (%)   damping (%)")
worst = {}
for k, (name, one) in enumerate(read.items()):
    kept = one.has_result & (one.velocity > 0.05) & (one.velocity < 0.5)
    at = np.asarray(one.velocity)[kept]
    values = np.asarray(one.natural_frequency)[kept], np.asarray(one.damping_ratio)[kept]
    off = [
        100 * (value / np.interp(at, speed, law) - 1)
        for value, law in zip(values, exactly, strict=True)
    ]
    worst[name] = [float(np.abs(part).max()) for part in off]
    print(f"{name:38s} {worst[name][0]:12.3f} {worst[name][1]:12.2f}")
    for axes, part in zip(grid[0], off, strict=True):
        axes.plot(at, part, "." if "decay" in name else "-", color=drawing.SERIES[k], label=name)
for axes, what, limit in zip(
    grid[0], ("natural frequency", "damping ratio"), (0.02, 3), strict=True
):
    axes.axhline(0, color="black", linestyle="--", linewidth=1, label="true")
    axes.set_ylim(-limit, limit)
    drawing.name_axes(axes, what, "Velocity amplitude (m/s)", "Found less true (%)")
drawing.legend(figure)
figure

# %% tags=["hide-input"]
headline |= {
    f"{name}: within 0.02 % of frequency and 3 % of damping": off[0] < 0.02 and off[1] < 3
    for name, off in worst.items()
}

# %% [markdown]
# One mode alone, and little noise: a decay of two seconds gives the curves as accurately as a
# stepped sine of minutes, damping even better. With an interfering mode, or at amplitudes near the
# noise, it would not.

# %% [markdown]
# ## 4. The complete comparison
#
# Seven structures, three noise levels, 20 seeds (`benchmarks/methods_table.py`): the median
# error of frequency at the middle level, and the coverage of the 95 % band of frequency over all
# levels.

# %% tags=["hide-input"]
# Median errors of frequency and damping of six methods on seven structures.
table = (BENCHMARKS / "methods_table.jsonl").read_text(encoding="utf-8")
rows = [row for row in map(json.loads, table.splitlines()) if row["method"] in NAMES]
structures = list(dict.fromkeys(row["structure"] for row in rows))
figure, grid = drawing.panels(drawing.PAGE, 3.6, 1, 2)
for k, method in enumerate(NAMES):
    mine = [row for row in rows if row["method"] == method]
    middle = {row["structure"]: row for row in mine if row["noise"] == "middle"}
    for axes, key in zip(grid[0], ("frequency", "damping"), strict=True):
        axes.plot(
            [100 * middle[s].get(f"{key}_error_median", np.nan) for s in structures],
            range(len(structures)),
            *("os^Dv<"[k],),
            color=drawing.SERIES[k],
            markersize=5,
            label=NAMES[method],
        )
for axes, what in zip(grid[0], ("natural frequency", "damping ratio"), strict=True):
    axes.set_xscale("log")
    axes.set_yticks(range(len(structures)), [s.replace("_", " ") for s in structures])
    drawing.name_axes(axes, what, "Median error (%)", "")
drawing.legend(figure)
figure

# %%

print("share of 95 % bands that hold the truth, frequency and damping:")
for method in ("snrm", "arslan_ozguven", "rct", "concerto"):
    mine = [row for row in rows if row["method"] == method]
    held = [
        [row[f"{key}_coverage"] for row in mine if row.get(f"{key}_coverage") is not None]
        for key in ("frequency", "damping")
    ]
    print(
        f"   {NAMES[method]:24s}", *(f"{100 * min(x):3.0f} to {100 * max(x):3.0f} %" for x in held)
    )
best = {
    s: min(
        (row for row in rows if row["structure"] == s and row["noise"] == "middle"),
        key=lambda row: row.get("frequency_error_median", np.inf),
    )["method"]
    for s in structures
}
print("smallest median error of frequency:", {s: NAMES[m] for s, m in best.items()})
headline["ours has the smallest error of frequency for at least five of the seven"] = (
    sum(method == "snrm" for method in best.values()) >= 5
)

# %% [markdown]
# Conclusions:
#
# - The inverse SNRM needs neither a resonance nor a pair of states, and uses every state: its
#   median errors are the smallest for most structures.
# - **It is not the best everywhere.** At the stop, phase resonance has as small an error of
#   frequency, needs no linear model for it, and takes a minute from four levels. With
#   quadratic damping and little noise the force surface is more accurate in damping.
# - **Its bands are not the same everywhere**: those of frequency have lower coverage on the
#   curved beam at the largest noise, those of damping with a bolted joint. Bands of CONCERTO and
#   of the modal fits, which exclude the bias of their own model, cover far less.
# - Where an open loop jumps before resonance, only control loops measure the rest. They cost more
#   test time per state, and a controller. **Their results are closer to the truth than ours on six
#   structures of seven** (`benchmarks/methods_loops_and_decays.jsonl`), although the noise is not
#   the same: there it is on samples, of which a loop averages many periods. Only near a second
#   mode is ours better, which subtracts the contribution of that mode.
# - Decays and multisines need seconds of test, but their bands are too narrow where their
#   polynomials are not the law, and an interfering mode spoils a decay.

# %% tags=["hide-input"]
print("\n".join(f"{'yes' if holds else 'NO '}  {claim}" for claim, holds in headline.items()))
assert all(headline.values())
