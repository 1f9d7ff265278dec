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
# # The paper's two beams, recomputed from finite elements
#
# Kwarta and Allen test their method on reduced models of two clamped beams: a flat one with four
# modes (Tabs. 1, 2 and A.1) and a curved one with one mode (Tabs. 3 and 4). Both were condensed
# from finite elements, and the paper prints tables of polynomial coefficients. Are these
# the coefficients of the beams whose dimensions are printed with them?
#
# 1. The flat beam: linear modes, static load cases, one potential fitted to them.
# 2. Every printed coefficient against the new one.
# 3. The curved beam: coefficients at small loads, and the path to its limit point.
# 4. The same by CalculiX, where it is installed.
# 5. A beam with uncertain dimensions: the band of its backbone, and what a measured backbone
#    determines about them.
#
# Implicit condensation loads the nonlinear finite elements with combinations of mode shapes, F =
# M Φ f, reads the modal displacements q and fits ω²q + ∂V/∂q = f by one potential V. Conventions:
# mass-normalised shapes, q in kg^1/2 m; the force's coefficients of mode 1 are α of q² and β of q³.

# %%
# %matplotlib inline
import shutil
import tempfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import snrmjax as sj
from snrmjax import condense as fe
from snrmjax.plot import style as drawing

HERTZ = 2 * np.pi
BLUE, ORANGE, GREEN = drawing.MEASURED, drawing.IDENTIFIED, drawing.SERIES[2]
headline = {}


# %% [markdown]
# ## 1. The flat beam
#
# Forty elements, as in the paper. The frequencies come out within 0.6 % of the print, which were
# computed with another beam element.

# %%
flat = fe.Beam(0.2286, 0.0127, 0.787e-3, young=204.8e9, density=7870.0, elements=40)
basis = fe.beam_modes(flat, (1, 3, 5, 7))
printed = sj.model.flat_beam()
frequency = np.asarray(basis.frequency)
for new, old in zip(frequency, np.asarray(printed.modes.natural_frequency), strict=True):
    print(f"{new / HERTZ:8.2f} Hz, printed {old / HERTZ:8.2f} Hz, ratio {new / old:.4f}")
worst = np.max(np.abs(frequency / np.asarray(printed.modes.natural_frequency) - 1))
headline["linear frequencies are the printed ones within 0.7 %"] = bool(worst < 7e-3)

# %% [markdown]
# Load cases of single modes, pairs and triples with all signs, each moving the beam by a quarter of
# its thickness. One potential serves all four equations, so that its coefficients are
# consistent.

# %%
loads = fe.modal_loads(basis, 0.25 * 0.787e-3)
condensed = fe.reduced_model(basis, fe.static_cases(flat, basis, loads.force))
print(condensed)

# %% [markdown]
# ## 2. Every printed coefficient
#
# The sign of a mode is arbitrary: it is set to that of the printed midspan shape. The flat beam
# is symmetric, so that its quadratic coefficients are zero; those printed are small residuals of a
# fit. All quartic coefficients of the potential:

# %%
turn = np.sign(np.asarray(fe.shape_at(flat, basis, 0.5)))
turn *= np.sign(np.asarray(printed.modes.mode_shape)[0])
new = dict(zip(condensed.potential.monomials, condensed.potential.coefficient, strict=True))
quartic = [m for m in printed.potential.monomials if len(m) == 4]
old_values = np.array(
    [
        float(c)
        for m, c in zip(printed.potential.monomials, printed.potential.coefficient, strict=True)
        if len(m) == 4
    ]
)
new_values = np.array([float(new[m]) * np.prod(turn[list(m)]) for m in quartic])
ratio = new_values / old_values
print(f"median ratio {np.median(ratio):.3f}")

# %% tags=["hide-input"]
# Every coefficient of the finite elements against the printed one: the points lie on the line of
# three times the print.
figure, panels = drawing.panels(drawing.COLUMN, 3.2, 1, 1)
axes = panels[0, 0]
axes.loglog(np.abs(old_values), np.abs(new_values), "o", ms=3.5, color=BLUE, label="coefficients")
ends = np.array([2e12, 1e16])
axes.loglog(ends, ends, ":", color="0.4", label="as printed")
axes.loglog(ends, 3 * ends, "-", color=ORANGE, label="three times the print")
drawing.name_axes(axes, "", "Printed (kg⁻² m⁻² s⁻²)", "Finite elements (kg⁻² m⁻² s⁻²)")
drawing.legend(figure)
figure

# %% [markdown]
# They lie on one line, three times the print, but for one (1134, small, of the wrong sign). So the
# table contains the right polynomial of this beam with its cubic forces divided by about three. The
# closed form of the first mode alone (von Kármán, β = E·12.3026² / (2 ρ² A L⁵)) agrees.

# %%
closed = 204.8e9 * 12.3026**2 / (2 * 7870.0**2 * 0.0127 * 0.787e-3 * 0.2286**5)
first = 4 * float(new[0, 0, 0, 0])
printed_first = 4 * old_values[quartic.index((0, 0, 0, 0))]
print(f"β: closed form {closed:.4g}, finite elements {first:.4g}, printed {printed_first:.4g}")
headline["β of mode 1 is the closed form's within 1 %"] = bool(abs(first / closed - 1) < 0.01)
headline["and 2.8 to 3.0 times the print"] = bool(2.8 < first / printed_first < 3.0)
headline["half of all 35 ratios lie between 2.7 and 3.1"] = bool(
    np.mean((ratio > 2.7) & (ratio < 3.1)) > 0.5
)

# %% [markdown]
# For section 3.1 this is a change of scale: dividing every cubic term by three multiplies all
# amplitudes by √3 at the same frequency. The paper's results on its method do not depend on it.
#
# ## 3. The curved beam
#
# A rise of twice the thickness. At loads that move it by a twentieth of its thickness:

# %%
THICKNESS = 0.508e-3
rise = fe.rise_of_radius(0.3048, 11.43)
curved = fe.Beam(0.3048, 0.0127, THICKNESS, rise=rise, young=204e9, density=7860.0, elements=40)
arch = fe.beam_modes(curved, (1,))
small = fe.modal_loads(arch, 0.05 * THICKNESS)
arch_model = fe.reduced_model(arch, fe.static_cases(curved, arch, small.force))
alpha, beta = np.asarray(arch_model.potential.coefficient) * np.array([3.0, 4.0])
ALPHA, BETA = -3.4380e9, 6.2183e12  # Tab. 4; the positive direction there is inwards
hertz = float(arch.frequency[0]) / HERTZ
print(f"{hertz:.2f} Hz, printed 64.78 Hz")
print(f"|α| over the print {alpha / abs(ALPHA):.3f}, β over the print {beta / BETA:.3f}")
headline["curved beam: frequency within 0.5 % of the print"] = abs(hertz / 64.78 - 1) < 5e-3
headline["curved beam: α within 3 % of the print"] = bool(abs(alpha / abs(ALPHA) - 1) < 0.03)
headline["curved beam: β is about twice the print"] = bool(1.9 < beta / BETA < 2.1)

# %% [markdown]
# Frequency and quadratic coefficient are those of the print; the cubic one is twice, not three
# times. What does that mean for the text, in which the beam softens and then hardens? The
# finite elements are loaded along mode 1, inwards and outwards, as far as they go.

# %% tags=["hide-input"]
# Load against inward displacement: finite elements, and three cubic polynomials of which two come
# back below zero.
squared = float(arch.frequency[0]) ** 2
one = THICKNESS / float(arch.largest[0])  # q at one thickness
levels = np.array([-0.37, -0.35, -0.32, -0.28, -0.2, -0.1, 0.1, 0.3, 0.6, 1.0, 1.6])
modal = jnp.asarray(levels[:, None] * squared * one)
path = fe.static_cases(curved, arch, modal)
beyond = fe.static_cases(curved, arch, jnp.asarray([[-0.4 * squared * one]]))
moved = -np.asarray(path.modal_displacement)[:, 0] / one  # inwards positive
print("inward load of 0.4 reached on the path from rest:", bool(beyond.converged[0]))

q = np.linspace(-1.2, 4.0, 300)
readings = {
    "Tab. 4 as printed": (ALPHA, BETA, GREEN, ":"),
    "its cubic term times 3": (ALPHA, 3 * BETA, ORANGE, "--"),
    "condensed at small loads": (-abs(alpha), beta, BLUE, "-"),
}
figure, panels = drawing.panels(drawing.COLUMN, 3.4, 1, 1)
axes = panels[0, 0]
for name, (a, b, colour, line) in readings.items():
    f = q + a * one / squared * q**2 + b * one**2 / squared * q**3
    axes.plot(q, f, line, color=colour, linewidth=drawing.LINE, label=name)
axes.plot(moved, -levels, "o", ms=4, color="black", label="finite elements")
axes.axhline(0.0, color="0.8", linewidth=0.8, zorder=0)
axes.set(ylim=(-1.8, 1.2))
drawing.name_axes(axes, "", "Inward displacement (thicknesses)", "Load f/ω² (thicknesses)")
drawing.legend(figure)
figure

# %% [markdown]
# The finite elements lose their stability at an inward load of about 0.38 and jump. All three
# polynomials have a limit point there, too. They differ in whether the force comes back through
# zero, that is whether the unloaded beam can rest in a second shape: a cubic force has a second
# equilibrium where α² > 4 β ω².

# %%
second = {name: a**2 / (4 * b * squared) for name, (a, b, *_) in readings.items()}
for name, size in second.items():
    print(f"{name}: α²/(4βω²) = {size:.3f}")
headline["as printed the curved beam is bistable"] = second["Tab. 4 as printed"] > 1
headline["with three times the cubic term it is not"] = second["its cubic term times 3"] < 1
headline["the finite elements lose stability below an inward load of 0.4"] = not bool(
    beyond.converged[0]
)

# %% [markdown]
# The cubic polynomial that is right at small loads is bistable as well, while the beam itself is
# not. CalculiX's shells jump at the limit point (`benchmarks/paper_models.py`): loads of 0.6 and
# 0.8 rest at 3.39 and 3.69 thicknesses, and a force of degree nine through all its points has a
# valley of 0.23 near two thicknesses, above zero. Three times the printed cubic term gives 0.63 at
# 3.39 and 1.07 at 3.69 thicknesses, where the other two curves are far below zero. So it is the
# interpretation closest to the beam over the whole path: softening, then hardening, with one
# equilibrium, as in section 3.2. It is not the expansion of the force at small displacements; one
# mode with a cubic force cannot be both.
#
# ## 4. The same by CalculiX
#
# A deck of the flat beam with CalculiX's own beam elements, which are solids inside. Poisson's
# ratio is zero, since the built-in beams are free to contract across their width.

# %%
COUNT = 40
nodes = "\n".join(f"{i + 1}, {0.2286 * i / (2 * COUNT):.10g}, 0., 0." for i in range(2 * COUNT + 1))
elements = "\n".join(f"{e + 1}, {2 * e + 1}, {2 * e + 2}, {2 * e + 3}" for e in range(COUNT))
DECK = f"""*NODE
{nodes}
*ELEMENT, TYPE=B32R, ELSET=BEAM
{elements}
*MATERIAL, NAME=STEEL
*ELASTIC
204.8e9, 0.
*DENSITY
7870.
*BEAM SECTION, ELSET=BEAM, MATERIAL=STEEL, SECTION=RECT
0.000787, 0.0127
0., 0., 1.
*BOUNDARY
1, 1, 6
{2 * COUNT + 1}, 1, 6
"""
if shutil.which("ccx") is None:
    print("CalculiX is not installed here; its numbers stand in the next paragraph.")
else:
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "flat.inp").write_text(DECK, encoding="utf-8")
        deck = sj.io.calculix.read_deck(Path(folder) / "flat.inp")
        modes = sj.io.calculix.modes_of_deck(deck, (1,), folder)
        single = fe.modal_loads(modes.basis, 0.25 * 0.787e-3)
        run = sj.io.calculix.run_static_cases(modes, single.force, folder)
        by_calculix = fe.reduced_model(modes.basis, run.cases)
    there = 4 * float(by_calculix.potential.coefficient[1])
    print(f"{modes.basis.frequency[0] / HERTZ:.2f} Hz, β {there:.4g}, {there / first:.4f} of ours")
    print(f"{np.sum(run.seconds):.1f} s for {len(run.status)} load cases")
    headline["CalculiX has the same β within 1 %"] = bool(abs(there / first - 1) < 0.01)

# %% [markdown]
# All modes of both beams by beams and shells of CalculiX, with every printed coefficient, come
# from `python benchmarks/paper_models.py --table table.md`. Over the print, median of the flat
# beam's cubic coefficients of one or two modes: 2.93 by beams without Poisson's effect, 3.00 with
# it, 2.99 by shells. Curved beam by 400 shell elements, the paper's own mesh: α 0.986, β 2.03.
#
# ## 5. Uncertain dimensions
#
# A drawing says 0.787 mm, but sheet is rolled to ± 2 %, and no clamp is rigid. A beam file as a
# function of its numbers: each call makes new elements, modes, load cases and coefficients, and all
# of it can be differentiated.

# %%
BEAM = """name = "flat beam in springs"
[material]
young_pa = 204.8e9
density_kg_m3 = 7870.0
[section]
width_m = 0.0127
thickness_m = 0.787e-3
[geometry]
length_m = 0.2286
elements = 12
[supports]
left = { axial_n_m = inf, transverse_n_m = inf, rotation_nm_rad = 30 }
right = "clamped"
[condense]
modes = [1]
load_scale = 0.3
"""
with tempfile.TemporaryDirectory() as folder:
    (Path(folder) / "beam.toml").write_text(BEAM, encoding="utf-8")
    models = sj.io.read_beam_models(Path(folder) / "beam.toml")
THICKNESS_OF, SPRING_OF = "section.thickness_m", "supports.left.rotation_nm_rad"
velocity = np.linspace(0.03, 0.6, 10)


def mode_of(values):
    """Frequencies (Hz) of the nonlinear mode at the velocities."""
    found = sj.simulate.normal_mode_at_velocities(models(values), velocity, harmonic_order=3)
    return np.asarray(found.frequency) / HERTZ


random = np.random.default_rng(7)
members = np.array(
    [mode_of({THICKNESS_OF: h}) for h in 0.787e-3 * (1 + 0.02 * random.normal(size=40))]
)
before = np.quantile(members, [0.025, 0.975], axis=0)

# %% [markdown]
# Such a beam is measured: ten points of its backbone, each frequency to 0.03 %. Its thickness is
# 0.775 mm and its spring 45 N m/rad, unknown to the fit. Thickness and spring both raise the
# linear frequency; only the thickness lowers the hardening. So the backbone determines both.

# %%
HIDDEN = {THICKNESS_OF: 0.775e-3, SPRING_OF: 45.0}
clean = mode_of(HIDDEN)
noisy = clean * (1 + 3e-4 * random.normal(size=clean.size))
measured = sj.identify.MeasuredBackbone(velocity, noisy * HERTZ, 3e-4 * noisy * HERTZ)
start = {name: models.parameters[name] for name in HIDDEN}
calibrated = sj.identify.calibrate_to_backbone(models, start, measured, harmonic_order=3)
print(calibrated)
off = (calibrated.values - list(HIDDEN.values())) / calibrated.std
headline["hidden thickness and spring come back within 3σ"] = bool(np.max(np.abs(off)) < 3)
headline["the thickness to better than 0.5 %"] = bool(
    calibrated.std[0] / calibrated.values[0] < 5e-3
)

# %% tags=["hide-input"]
# Velocity against natural frequency: the wide band of a thickness known to 2 %, and inside it the
# measured points with the narrow band of the calibrated beam.
figure, panels = drawing.panels(drawing.COLUMN, 3.2, 1, 1)
axes = panels[0, 0]
axes.fill_betweenx(
    velocity, *before, color="0.85", linewidth=0, label="thickness ± 2 %: 95 % of beams"
)
fitted, std = calibrated.fitted / HERTZ, calibrated.fitted_std / HERTZ
axes.fill_betweenx(
    velocity, fitted - 1.96 * std, fitted + 1.96 * std, color=ORANGE, alpha=0.4, linewidth=0
)
axes.plot(fitted, velocity, "-", color=ORANGE, linewidth=drawing.LINE, label="calibrated, 95 %")
axes.plot(noisy, velocity, "o", ms=3.5, color=BLUE, label="measured points")
drawing.name_axes(axes, "", "Natural frequency (Hz)", "Velocity at midspan (m/s)")
drawing.legend(figure)
figure

# %% [markdown]
# The same numbers vary in a study: `snrmjax study run study.toml` with `model = "beam.toml"` and
# `parameter = "section.thickness_m"`.
#
# ## The headline, checked

# %% tags=["hide-input"]
print("\n".join(f"{'yes' if holds else 'NO '}  {claim}" for claim, holds in headline.items()))
assert all(headline.values())
