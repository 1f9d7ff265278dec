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
# # Four thousand curved beams: how tolerances become scatter of a nonlinear response
#
# A batch of clamped curved beams is made to one drawing. Thickness and rise have tolerances, and
# damping is known to ten per cent. How far do the responses of the batch scatter, which tolerance
# causes it, and can it be computed from derivatives at the nominal beam?
#
# 1. The beam from its dimensions: the drawing becomes modes and a potential.
# 2. A study of 4 000 beams on all cores, as one data set, which can be interrupted and continued.
# 3. Bands of the response, and the effect of each tolerance by itself.
# 4. Sobol' indices: the effect of each tolerance alone, and together with others.
# 5. First and second order against the members: the scatter from which linearisation fails, and
#    what derivatives at the nominal beam do not show.
#
# Conventions: frequencies in rad/s in the code and in Hz in print and figures; amplitudes are those
# of the velocity's fundamental harmonic at midspan; "scatter" is one standard deviation.
#
# To run a smaller study set `STUDY_MEMBERS`; with `STUDY_FOLDER` the members are kept, and the same
# call continues a study that was stopped, or opens one that is finished.

# %%
# %matplotlib inline
import dataclasses
import os
import tempfile
from pathlib import Path

import numpy as np

import snrmjax as sj
from snrmjax import plot
from snrmjax.plot import style as drawing
from snrmjax.study.uncertainty.sensitivity import main_effect

HERTZ = 2 * np.pi
MEMBERS = int(os.environ.get("STUDY_MEMBERS", "4000"))
SCALED_DOWN = MEMBERS < 1000  # for a quick look; bands and indices are coarse then
FOLDER = Path(os.environ.get("STUDY_FOLDER") or tempfile.mkdtemp())
BLUE, ORANGE, GREEN = drawing.MEASURED, drawing.IDENTIFIED, drawing.SERIES[2]
HZ, VELOCITY = "Frequency (Hz)", "Velocity amplitude (m/s)"
headline = {}


# %% [markdown]
# ## 1. The beam from its drawing
#
# The curved beam of Kwarta and Allen: 304.8 mm long, 12.7 mm wide, 0.508 mm thick, of steel, a
# radius of 11.43 m. The rise at midspan is twice the thickness. Finite elements are condensed to
# two modes, as by `snrmjax rom`; `read_beam_models` does this for any dimensions. The damping
# ratio is 2 % here; the force is distributed uniformly.

# %%
LENGTH = 0.3048
MEAN = {"thickness_m": 0.508e-3, "rise_m": LENGTH**2 / (8 * 11.43), "damping_ratio": 0.02}
STD = {"thickness_m": 0.01, "rise_m": 0.05, "damping_ratio": 0.1}  # relative
FORCE, ENDS = 0.04, (30 * HERTZ, 90 * HERTZ)
DRAWING = f"""name = "curved beam"
[material]
young_pa = 204e9
density_kg_m3 = 7860.0
[section]
width_m = 0.0127
thickness_m = {MEAN["thickness_m"]}
[geometry]
length_m = {LENGTH}
rise_m = {MEAN["rise_m"]}
elements = 16
[supports]
left = "clamped"
right = "clamped"
[condense]
modes = [1, 3]
[sensors]
midspan = 0.5
[force]
distribution = "uniform"
"""
FOLDER.mkdir(parents=True, exist_ok=True)
(FOLDER / "beam.toml").write_text(DRAWING)
models = sj.io.read_beam_models(FOLDER / "beam.toml")


def beam_of(values):
    """The beam with these dimensions and this damping."""
    damping = {f"mode_{k}.damping_ratio": values["damping_ratio"] for k in (1, 2)}
    size = {
        "section.thickness_m": values["thickness_m"],
        "geometry.rise_m": values["rise_m"],
    }
    return models({**size, **damping})


nominal = beam_of(MEAN)
std = {name: fraction * MEAN[name] for name, fraction in STD.items()}
print(nominal)
printed = float(sj.model.curved_beam().modes.natural_frequency[0]) / HERTZ
own = float(nominal.modes.natural_frequency[0]) / HERTZ
print(
    f"first natural frequency {own:.2f} Hz, printed {printed:.2f} Hz; rise {MEAN['rise_m']:.3g} m"
)
headline["first natural frequency within 0.5 % of the published beam"] = (
    abs(own / printed - 1) < 5e-3
)

# %% [markdown]
# At 0.04 N the nominal beam softens: its response leans over to lower frequencies, with a fold
# where a rising sweep jumps and one, near the peak, where a falling sweep does. Its second mode
# lies at 157 Hz, three times 52.4 Hz: where the leaning peak comes near that frequency, the third
# harmonic of the motion drives the second mode (a 1:3 internal resonance) and takes energy from
# the first. The nominal beam's peak stops short of it. A beam with 0.1 mm less rise gets past:

# %% tags=["hide-input"]
# Two responses against frequency: the nominal beam peaks near 55 Hz, above a third of its second
# frequency; a beam with 0.1 mm less rise peaks far below it.
figure, panels = drawing.panels(drawing.COLUMN, 3.2, 1, 1)
highest = {}
for less, colour in ((0.0, BLUE), (0.1e-3, ORANGE)):
    rise = MEAN["rise_m"] - less
    (curve,) = sj.forced_response(
        beam_of({**MEAN, "rise_m": rise}), [FORCE], *ENDS, harmonic_order=7, stability=False
    )
    speed = np.abs(curve.velocity[:, 1, 0])
    highest[less] = float(curve.frequency[np.argmax(speed)]) / HERTZ
    panels[0, 0].plot(
        *(np.asarray(curve.frequency) / HERTZ, speed),
        **{"color": colour, "linewidth": 1.2, "label": f"rise {1e3 * rise:.2f} mm"},
    )
third = float(nominal.modes.natural_frequency[1]) / HERTZ / 3
panels[0, 0].axvline(third, color="0.5", linestyle=":", linewidth=1.0, label="second mode / 3")
drawing.name_axes(panels[0, 0], "", HZ, VELOCITY)
panels[0, 0].set(xlim=(38, 75), ylim=(0, 0.2))
drawing.legend(figure)
figure

# %%
print({f"{1e3 * less:.1f} mm less": f"peak at {at:.2f} Hz" for less, at in highest.items()})
headline["0.1 mm less rise moves the peak past the internal resonance, by more than 10 Hz"] = (
    highest[0.0] > third and highest[0.1e-3] < third and highest[0.0] - highest[0.1e-3] > 10
)

# %% [markdown]
# ## 2. The study
#
# Thickness scatters by 1 %, rise by 5 % (51 µm), damping by 10 %. Members are drawn by a Latin
# hypercube. `model_of` makes the beam of a member from its parameters; of every response the
# study keeps the peak, the folds, and the highest and lowest velocity at 241 frequencies.

# %%
study = sj.study.Study(
    "curved beam of uncertain dimensions",
    nominal,
    sj.study.Peaks(
        sj.study.ResponseRange(*ENDS, harmonic_order=7, stability=False),
        [FORCE],
        grid_points=241,
    ),
    (
        sj.study.Normal("thickness_m", MEAN["thickness_m"], std["thickness_m"]),
        sj.study.Normal("rise_m", MEAN["rise_m"], std["rise_m"]),
        sj.study.LogNormal("damping_ratio", MEAN["damping_ratio"], std["damping_ratio"]),
    ),
    sj.study.Sampling("latin_hypercube", MEMBERS),
    model_of=beam_of,
)
done = sj.study.run_study(study, FOLDER / "curved_beam.zarr")
members = done.open().load()
ended = members.status.values == "upper_end"
peak_hz, peak = members.peak_frequency_hz.values, members.peak_velocity_m_s.values
n_folds = members.n_folds.values
print(f"{done.members} members, {np.sum(~ended)} without a complete response")
for n in np.unique(n_folds):
    print(f"  {n} folds: {np.sum(n_folds == n)} members")
spread = {"frequency": np.std(peak_hz) / np.mean(peak_hz), "velocity": np.std(peak) / np.mean(peak)}
print({name: f"{100 * value:.1f} % scatter of the peak's" for name, value in spread.items()})
past = np.mean(peak_hz < third - 4)
print(f"{100 * past:.1f} % of the beams have their peak past the internal resonance")
headline["one beam in twenty to one in five peaks past the internal resonance"] = 0.05 < past < 0.2
headline["every member has its whole response"] = bool(np.all(ended))

# %% [markdown]
# ## 3. Bands, and the effect of each tolerance
#
# Between the folds a response has two stable motions at one frequency. The bands are therefore of
# the highest motion and of the lowest; where they differ, the history of the test decides which of
# the two it meets.

# %% tags=["hide-input"]
# Bands of the highest and of the lowest motion against frequency: 95 % and half of all beams, and
# the median.
grid = members.frequency_hz.values
figure, panels = drawing.panels(drawing.PAGE, 3.3, 1, 2)
for axes, name, title, colour in zip(
    *(panels[0], ("upper", "lower"), ("highest motion", "lowest motion"), (BLUE, ORANGE)),
    strict=True,
):
    values = members[f"{name}_velocity_m_s"].values
    low, quarter, middle, upper_quarter, high = np.nanquantile(
        values, [0.025, 0.25, 0.5, 0.75, 0.975], axis=0
    )
    axes.fill_between(grid, low, high, color=colour, alpha=0.2, linewidth=0, label="95 % of beams")
    axes.fill_between(
        *(grid, quarter, upper_quarter),
        **{"color": colour, "alpha": 0.45, "linewidth": 0, "label": "half of the beams"},
    )
    axes.plot(grid, middle, color="black", linewidth=0.9, label="median")
    drawing.name_axes(axes, title, HZ, VELOCITY if name == "upper" else "")
    axes.set(xlim=(40, 75), ylim=(0, 0.25))
drawing.legend(figure)
figure

# %% [markdown]
# The effect of one quantity by itself: the mean over the others (line, with its 95 % band) among
# some of the members, and the fraction of the variance that it explains. Over the rise the peak is
# not a curve but a step, at about 0.95 mm, which the mean (a spline) rounds off.

# %% tags=["hide-input"]
# Peak frequency and peak velocity of every beam against thickness, rise and damping, with the
# mean over the others.
LABEL = {"thickness_m": "Thickness (mm)", "rise_m": "Rise (mm)", "damping_ratio": "Damping (%)"}
UNIT = {"thickness_m": 1e3, "rise_m": 1e3, "damping_ratio": 1e2}
OUTPUTS = (("Peak frequency (Hz)", peak_hz), ("Peak velocity (m/s)", peak))
figure, panels = drawing.panels(drawing.PAGE, 4.6, 2, 3)
fractions = {}
for row, (text, output) in zip(panels, OUTPUTS, strict=True):
    for column, (axes, name) in enumerate(zip(row, MEAN, strict=True)):
        x = members[name].values
        effect, some = main_effect(x, output), slice(0, 1000)
        fractions[text, name] = effect.fraction
        axes.plot(UNIT[name] * x[some], output[some], ".", ms=1.5, color="0.75", label="beams")
        at = UNIT[name] * effect.at
        axes.fill_between(
            *(at, effect.mean - effect.error, effect.mean + effect.error),
            **{"color": BLUE, "alpha": 0.4, "linewidth": 0},
        )
        axes.plot(at, effect.mean, color=BLUE, label="mean over the others")
        title = f"{100 * effect.fraction:.0f} % of the variance"
        drawing.name_axes(axes, title, LABEL[name], text if column == 0 else "")
drawing.legend(figure)
figure

# %%
print({f"{text}, {name}": f"{fraction:.3f}" for (text, name), fraction in fractions.items()})

# %% [markdown]
# ## 4. Sobol' indices
#
# The first-order index is the fraction of variance due to one input alone, the total index
# includes interactions with others. Both come from the members of Saltelli's scheme, another study:

# %%
# Bars: first-order and total indices of thickness, rise and damping for every output.
rows = 16 if SCALED_DOWN else 512
paired = dataclasses.replace(
    study,
    computation=sj.study.Peaks(study.computation.within, study.computation.forces),
    sampling=sj.study.Sampling("saltelli", rows * (len(MEAN) + 2)),
)
indices = sj.study.sobol_indices(sj.study.run_study(paired, FOLDER / "indices.zarr").open())
print(indices)
plot.sensitivity_figure(indices)

# %% [markdown]
# The rise dominates: it makes the beam stiff, and makes the stiffness fall with amplitude.
# Thickness and damping hardly affect the frequencies.
#
# ## 5. Where linearisation fails
#
# First order takes the peak as linear in the inputs: a normal distribution. Second order adds
# the curvature. Both need one beam: `response_quantities` finds its peak and folds, and through
# `model_of` their derivatives reach the dimensions.

# %%
# Means and 95 % ranges of frequency and velocity at the peak and at both folds, by first and by
# second order: the second order moves them up, most at the peak and the lower fold.
quantities = sj.study.response_quantities(
    *(nominal, study.variations, *ENDS),
    **{"force": FORCE, "kinds": ("peak", "fold"), "harmonic_order": 7, "model_of": beam_of},
)
propagated = sj.study.propagate_uncertainty(quantities)
print(propagated)
propagated.plot()

# %% [markdown]
# From which scatter on is first order off by 10 % (of its standard deviation or of its 95 % range)?
# The curvature at the nominal beam gives the answer, as a factor on all tolerances together:

# %%
limit = dict(zip(quantities.names, propagated.scatter_limit.min(axis=0).tolist(), strict=True))
print({name: f"{value:.3g}" for name, value in limit.items()})

# %% [markdown]
# The answer depends on the quantity. The fold at which a rising sweep jumps lies low, where the
# beam is nearly linear: there first order is accurate at every scatter here. Peak and lower fold
# lie at the internal resonance: there first order fails at a fraction of the stated tolerances.
#
# And neither includes the beams that get past the internal resonance. Against the *highest* peak of
# all members of the study:

# %% tags=["hide-input"]
# Histogram of the peak frequency: a large hump at 55 Hz, on which the bell of first order lies,
# and a small one at 43 Hz, which it does not show.
at = list(quantities.names).index("peak_frequency_hz")
nominal_peak, by_first = quantities.value[at], propagated.statistics[0, 1, at]
figure, panels = drawing.panels(drawing.COLUMN, 3.2, 1, 1)
panels[0, 0].hist(peak_hz, bins=60, density=True, color="0.75", label="highest peak of each beam")
x = np.linspace(nominal_peak - 4 * by_first, nominal_peak + 4 * by_first, 200)
bell = np.exp(-0.5 * ((x - nominal_peak) / by_first) ** 2) / (by_first * np.sqrt(2 * np.pi))
panels[0, 0].plot(x, bell, color=BLUE, label="first order")
drawing.name_axes(panels[0, 0], "", "Peak frequency (Hz)", "Density (1/Hz)")
drawing.legend(figure)
figure

# %%
print(
    f"1σ of the peak's frequency: first order {by_first:.2f} Hz, highest peaks"
    f" {np.std(peak_hz):.2f} Hz"
)
headline["highest peaks scatter more than twice as much as first order says"] = bool(
    np.std(peak_hz) > 2 * by_first
)

# %% [markdown]
# The rule: linearise below the limits printed above and only where no internal resonance or second
# peak is in reach; otherwise solve members.
#
# ## The headline, checked

# %% tags=["hide-input"]
rise = list(indices.input_names).index("rise_m")
first = propagated.first_order_error[:, at]
print("error of first order for the peak's frequency:", first)
headline["the rise makes most of the peak frequency's variance"] = (
    fractions["Peak frequency (Hz)", "rise_m"] > 0.5
    and indices.total[list(indices.names).index("peak_frequency_hz"), rise] > 0.5
)
headline["first order errs by 10 % at less than half of the stated scatter"] = (
    limit["peak_frequency_hz"] < 0.5
)
headline["but not for the upper fold's frequency"] = limit["fold_1_frequency_hz"] > 1.0
headline["at the stated scatter first order errs by more than a quarter"] = bool(first.max() > 0.25)
print("\n".join(f"{'yes' if holds else 'NO '}  {claim}" for claim, holds in headline.items()))
assert all(headline.values())
