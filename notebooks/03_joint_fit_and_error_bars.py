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
# # Curves with error bars: the joint fit, on two computed tests
#
# Notebook 01 computes one point of the backbone from every measured state. Here all states together
# give two smooth curves, natural frequency and damping against amplitude, with 95 % bands:
#
# 1. 32 near-resonant states of eight force levels against 85 states along one response: what each
#    test determines, and how well;
# 2. the contributions to a band, whether its width is right, and which state to measure next.
#
# Notebook 11 does the same with a measured beam. The residual of a state is that of its force
# balance, at the motion as it was measured,
#
# $$\left(\tilde\omega^2 - \Omega^2 + 2i\tilde\zeta\tilde\omega\Omega\right) X / A - F ,$$
#
# with the displacement $X$, the modal constant $A$ and the force $F$. No response is computed, so
# folds and unstable parts do not matter. Residuals are divided by their noise and made independent
# ("whitened"). Errors that all states of a level have in common are unknowns too.
#
# The first call of a kind compiles its program, which takes seconds. With
# `JAX_COMPILATION_CACHE_DIR` set to a folder, programs are kept for the next run.

# %%
# %matplotlib inline
import numpy as np

import snrmjax as sj
from snrmjax import plot
from snrmjax.plot import style as drawing

HERTZ = 2 * np.pi
headline = {}


# %% [markdown]
# ## 1. Few states near resonance, or many along one response
#
# Kwarta and Allen compare the 31 near-resonant states of their curved beam with the 85 that they
# needed to measure *one* response. Here both tests are simulated with the flat beam, with nine
# harmonics and the same noise: 1 % of amplitude, 0.7° of phase, 0.3 % of force. The first has eight
# levels of four states each, 33° to 45° off resonance. The second has 85 states along the response
# to the largest force, from 82° off resonance to as near as a stepped sine gets before it jumps.

# %%
flat = sj.model.flat_beam()
truth = sj.simulate.damped_normal_mode(flat, 0.85, steps=sj.simulate.StepControl(largest=0.02))
errors = sj.simulate.MeasurementErrors(amplitude=0.01, phase=np.radians(0.7), force=0.003)
ends = (60 * HERTZ, 120 * HERTZ)
forces = np.geomspace(6e-4, 1.334e-2, 8).tolist()
near = sj.phase_resonance_test(
    *(flat, forces, *ends),
    points_per_level=4,
    recording=sj.simulate.Recording(errors, seed=3),
)
along = sj.phase_resonance_test(
    *(flat, forces[-1:], *ends),
    appropriation=(0.02, 0.999),
    points_per_level=85,
    recording=sj.simulate.Recording(errors, seed=4),
)
tests = {"32 near resonance": near, "85 along one response": along}
fits = {name: sj.fit_jointly(t.steady_states, flat.modes) for name, t in tests.items()}
for name, fit in fits.items():
    print(f"{name}:", fit)

# %% [markdown]
# The truth is the damped normal mode. (The undamped one has a tongue between 87.5 and 90.2 Hz, see
# notebook 01; with damping little of it remains.)

# %%
# Natural frequency and damping against amplitude from both tests, on the true curves, with the
# results of single states; the band of the one response is wide.
single = {
    name: sj.identify.identify_points(t.steady_states, flat.modes) for name, t in tests.items()
}
plot.fitted_curves_figure(
    [plot.FitSeries(name, fit, single[name]) for name, fit in fits.items()], truth=truth
)


# %%
def at_velocities(fit, velocity):
    """Curves in Hz and %, with half the width of their 95 % bands."""
    values = sj.identify.fitted_values(fit, velocity)
    frequency, damping = values.natural_frequency / HERTZ, 100 * values.damping_ratio
    bands = values.natural_frequency_std / HERTZ, 100 * values.damping_ratio_std
    return np.array([frequency, damping]), 1.96 * np.array(bands)


velocity = np.linspace(0.03, 0.63, 25)
speed = np.abs(truth.velocity[:, 1, 0])
true = np.array(
    [
        np.interp(velocity, speed, truth.frequency / HERTZ),
        np.interp(velocity, speed, 100 * truth.damping_ratio),
    ]
)
width, inside = {}, {}
print("   v in m/s   true Hz, %    then Hz and % with 95 % of either test")
rows = {name: at_velocities(fit, velocity) for name, fit in fits.items()}
for k in (0, 7, 14, 20, 24):
    columns = "".join(
        f"   {v[0, k]:.2f} ± {b[0, k]:.2f}, {v[1, k]:.3f} ± {b[1, k]:.3f}" for v, b in rows.values()
    )
    print(f"   {velocity[k]:.3f}      {true[0, k]:.2f}, {true[1, k]:.3f}{columns}")
for name, (values, bands) in rows.items():
    width[name] = bands.mean(axis=1)
    inside[name] = np.mean(np.abs(values - true) < bands, axis=1)
    print(
        f"{name}: mean half band {width[name][0]:.3f} Hz and {width[name][1]:.4f} %, the truth in "
        f"{100 * inside[name][0]:.0f} and {100 * inside[name][1]:.0f} % of the bands"
    )

# %% [markdown]
# The curves are too close to compare. Their differences from the truth show more.

# %% tags=["hide-input"]
# Fitted less true natural frequency and damping against amplitude, with 95 % bands: both curves
# lie near zero; the band of eight levels is a tenth as wide as that of one response.
figure, ((left, right),) = drawing.panels(drawing.PAGE, 3.2, 1, 2)
colours = drawing.SERIES[:2]
for (name, (values, bands)), colour in zip(rows.items(), colours, strict=True):
    for axes, value, band, exact in zip((left, right), values, bands, true, strict=True):
        axes.plot(velocity, value - exact, color=colour, label=name)
        ends_of_band = value - exact - band, value - exact + band
        axes.fill_between(velocity, *ends_of_band, **drawing.FILL, color=colour, label="95 % band")
for axes in (left, right):
    axes.axhline(0.0, color="black", linestyle="--", linewidth=1.2, label="true")
amplitude = "Velocity amplitude (m/s)"
drawing.name_axes(left, "(a) natural frequency", amplitude, "Fitted less true (Hz)")
drawing.name_axes(right, "(b) damping ratio", amplitude, "Fitted less true (% of critical)")
drawing.legend(figure)
figure

# %%
few, many = fits.values()
for exact in sj.forced_response(flat, [2.669e-3, 1.334e-2], *ends):
    tip = exact.at_events("phase_resonance")[-1]
    print(
        f"{1e3 * exact.force:.2f} mN: true resonance {exact.frequency[tip] / HERTZ:.2f} Hz, "
        f"{abs(exact.velocity[tip, 1, 0]):.4f} m/s"
    )
    for name, fit in fits.items():
        point = sj.identify.fitted_response(fit, exact.force)[0].resonances[0]
        print(
            f"   {name}: {point.frequency / HERTZ:.2f} ± "
            f"{1.96 * point.frequency_std / HERTZ:.2f} Hz, {point.velocity:.4f} ± "
            f"{1.96 * point.velocity_std:.4f} m/s"
            f"{', beyond the data' if point.continued else ''}"
        )

# %% [markdown]
# Both curves lie on the true one, that of the 85 states within 0.12 Hz. But the bands differ
# tenfold. Eight levels show by how much levels differ; one level cannot, so that its band has to
# allow for an error common to the whole level. More states along one response do not help.
# Its resonances, too, are predicted accurately but with wide bands.
#
# Random noise is not the only error. Let the gain of every level be known to 1 % only:

# %%
fraction = {}
for name, fit in fits.items():
    with_gain = sj.fit_jointly(
        tests[name].steady_states,
        flat.modes,
        backbone=fit.unknowns.squared_frequency.label,  # the same curves
        damping=fit.unknowns.modal_damping.label,
        level_gain_std=0.01,
    )
    fraction[name] = at_velocities(with_gain, velocity)[1].mean(axis=1) / width[name]
    print(
        f"{name}: with 1 % of gain a level the bands are {fraction[name][0]:.2f} (frequency) and "
        f"{fraction[name][1]:.2f} (damping) times as wide"
    )
    if fit is few:
        with_levels = with_gain

# %% [markdown]
# Eight levels have eight unknown gains, which widen the bands by a sixth and a tenth. Those of
# the one response already allow for more than that.
#
# ## 2. Contributions to the band, whether its width is right, and what to measure next
#
# The width of a band follows from derivatives of the fit by every single measured number. Their
# squares, times the variances, add up to that of the band: the fractions below.

# %%
# Bars: the fraction of every kind of measured number in the variance of both curves.
fractions = sj.identify.contributions(with_levels)
for row in fractions.by_kind():
    print(
        f"{row.source:26s} {100 * row.frequency_fraction:5.1f} % "
        f"{100 * row.damping_fraction:5.1f} %"
    )
fractions.plot()

# %% [markdown]
# Are these widths right? Refits to states drawn with replacement within their levels (bootstrap)
# include the noise of the states and how far the states determine their level, but not how much
# levels differ: their spread is smaller by that part. Below is the 1σ of the curves at some of
# their knots by both methods.

# %%
drawn = np.nanstd(sj.identify.bootstrap(few, 100), axis=0)
named = dict(
    zip(few.names(), zip(np.sqrt(np.diag(few.covariance)), drawn, strict=True), strict=True)
)
knots = [name for name in named if "knot" in name]
for name in knots[3::4]:
    print(f"{name}: covariance {named[name][0]:.4g}, bootstrap {named[name][1]:.4g}")

# %% [markdown]
# What to measure next? Every stable state of the fitted responses is a candidate. They are
# ranked by how much narrower they make the bands of both curves, each given the ones before it
# (optimal design).

# %%
# The five advised states among the candidates, in frequency and force.
advice = sj.next_measurements(with_levels, 5)
for one in advice:
    print(
        f"{one.rank}. {1e3 * one.force:.2f} mN at {one.frequency / HERTZ:.2f} Hz, bands at "
        f"{100 * one.expected_band_ratio:.1f} %: {one.reason}"
    )
advice.plot()

# %% tags=["hide-input"]
headline |= {
    "bands of 32 states near resonance less than a fifth as wide as of 85 along one response": all(
        width["32 near resonance"] < width["85 along one response"] / 5
    ),
    "the truth inside the bands of both": all(min(fraction) > 0.9 for fraction in inside.values()),
    "shares sum to the whole variance": abs(sum(s.frequency_fraction for s in fractions) - 1) < 1e-9
    and abs(sum(s.damping_fraction for s in fractions) - 1) < 1e-9,
}

# %% tags=["hide-input"]
print("\n".join(f"{'yes' if holds else 'NO '}  {claim}" for claim, holds in headline.items()))
assert all(headline.values())
