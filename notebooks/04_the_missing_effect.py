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
# # The missing effect: where model and data disagree, what is missing, and how to validate it
#
# A model from a linear test disagrees with measurements at larger amplitudes. `diagnose_model` (on
# the command line `snrmjax diagnose`) locates the disagreement, names the missing effect, adds it,
# and validates the completed model on a level withheld from the fit:
#
# 1. an effect that the model lacks, from the first disagreement to the completed model;
# 2. two effects that the fundamental cannot distinguish, and the measurement that does.
#
# Notebook 11 does this with a measured beam.
#
# Forces are compared, not responses: the measured motion is prescribed to the model, and the force
# that it needs is compared with the one that acted (inverse harmonic balance). This force is
# unique, also where the response folds.

# %%
# %matplotlib inline
import numpy as np

import snrmjax as sj
from snrmjax import plot

HERTZ = 2 * np.pi
headline = {}


def report(found):
    """A diagnosis, and where the model disagrees."""
    print(found)
    for part in found.located:
        low, high = part.velocity_range
        print(f"  located: {part.part.replace('_', ' ')}, {low:.3g} to {high:.3g} m/s")


# %% [markdown]
# ## 1. From the first disagreement to the completed model
#
# The structure has a mode at 79 Hz with half a per cent of damping, and a stop 0.3 mm away on one
# side, which the model lacks. The model has the results of a linear test, with their errors. The
# test: five levels, eight states each, errors of 1 % in amplitude, 0.7° in phase and 0.3 % in
# force, and the second and third harmonics with their noise floor. (These data come from the same
# simulator as the predictions below; `benchmarks/blind_sets` makes sets with an independent
# integrator.)

# %%
OMEGA, ZETA, SHAPE = 79.0 * HERTZ, 0.005, 2.0
modes = sj.model.linear_modes(
    [1.0005 * OMEGA],
    [0.97 * ZETA],
    [[SHAPE]],
    [SHAPE],
    std=sj.model.LinearModesStd([0.001 * OMEGA], [0.05 * ZETA]),
)
model = sj.model.structure(modes)
hidden = sj.model.make_effect("one_sided_stop", {"stiffness": 0.12 * OMEGA**2, "gap": 3e-4 / SHAPE})
truth = sj.model.structure(
    sj.model.linear_modes([OMEGA], [ZETA], [[SHAPE]], [SHAPE]), effects=(hidden,)
)
largest = 2 * ZETA * OMEGA**2 * 6e-4 / SHAPE**2  # N, for twice the gap
errors = sj.simulate.MeasurementErrors(
    amplitude=0.01, phase=np.radians(0.7), force=0.003, harmonic=2e-4
)
test = sj.phase_resonance_test(
    truth,
    (largest * np.geomspace(0.3, 1.0, 5)).tolist(),
    *(74 * HERTZ, 86 * HERTZ),
    appropriation=(0.02, 0.99),
    points_per_level=8,
    recording=sj.simulate.Recording(errors, seed=1, keep_harmonics=(2, 3)),
)
found = sj.diagnose_model(model, test.steady_states)
report(found)
headline["the stop is named, alone"] = found.candidates == (("one_sided_stop",),)
for name, true in (("stiffness", 0.12 * OMEGA**2), ("gap", 3e-4 / SHAPE)):
    value, std = found.parameters[f"one_sided_stop.{name}"]
    print(f"  true {name}: {true:.4g}, {abs(value - true) / std:.1f} standard deviations off")
    headline[f"its {name} within three standard deviations"] = abs(value - true) < 3 * std
headline["the level left out is predicted to within its noise"] = found.gap.interpolated.after < 1.4

# %% [markdown]
# Every measured state, with the model as given and with the completed one: the misfit of the force
# in units of its noise. Then the responses of both models over the measured states, and how much
# each effect would explain by itself.

# %%
# The misfit of every state in units of its noise, before and after the stop is added: from tens
# to about one.
found.plot()

# %%
# Responses of the model as given and as completed over the measured states of five levels: only
# the completed one follows them.
predicted = sj.diagnose.predict_levels(found, model)
plot.comparison_figure(predicted.before, predicted.after, test.steady_states)

# %%
print("velocity at resonance (m/s): measured, before, completed")
for row in predicted.levels:
    values = (row.measured.velocity, row.before.velocity, row.after.velocity)
    print(f"level {row.level}:", *(f"{v:.4f}" for v in values), "left out" * row.withheld)
left_out = [row for row in predicted.levels if row.withheld]
headline["resonances of levels left out predicted within 0.1 Hz and 2 %"] = all(
    abs(row.after.frequency - row.measured.frequency) < 0.1
    and abs(row.after.velocity / row.measured.velocity - 1) < 0.02
    for row in left_out
)

# %%
# What changes with the amplitude, and how much of it the one-sided stop explains.
plot.parts_figure(found)

# %% [markdown]
# The completed model is a model like any other. Its resonance at the largest force, compared with
# those of the true structure and of the model as given:

# %%
peaks = {}
for name, one in (("truth", truth), ("as given", model), ("completed", found.completed)):
    curve = sj.forced_response(one, [largest], 74 * HERTZ, 86 * HERTZ, harmonic_order=7)[0]
    at = int(np.argmax(np.abs(curve.velocity[:, 1, 0])))
    peaks[name] = curve.frequency[at] / HERTZ, float(np.abs(curve.velocity[at, 1, 0]))
    print(f"{name:>10}: {peaks[name][0]:.3f} Hz, {peaks[name][1]:.4f} m/s")
headline["the completed model's peak within 0.1 Hz and 2 %"] = (
    abs(peaks["completed"][0] - peaks["truth"][0]) < 0.1
    and abs(peaks["completed"][1] / peaks["truth"][1] - 1) < 0.02
)

# %% [markdown]
# ## 2. An ambiguous case, decided by the measurement that the diagnosis requests
#
# The same states, but only their fundamentals were recorded. A stop on one side and a gap on both
# sides change the fundamental alike. The diagnosis reports this, and which measurement decides.

# %%
states = test.steady_states
bare = sj.measure.steady_states(
    *(np.asarray(states.level), np.asarray(states.frequency), np.asarray(states.force)),
    np.asarray(states.velocity),
    sensors=states.sensors,
    velocity_std=np.asarray(states.velocity_std),
    phase_std=np.asarray(states.phase_std),
    force_std=np.asarray(states.force_std),
)
blurred = sj.diagnose_model(model, bare)
report(blurred)
(rivals,) = blurred.candidates
headline["without harmonics it is ambiguous, the truth in the class"] = (
    blurred.verdict == "ambiguous" and "one_sided_stop" in rivals and "gap_stiffness" in rivals
)
headline["the diagnosis asks for harmonics"] = "harmonic" in (blurred.decide_by or "")

# %% tags=["hide-input"]
print("\n".join(f"{'yes' if holds else 'NO '}  {claim}" for claim, holds in headline.items()))
assert all(headline.values())
