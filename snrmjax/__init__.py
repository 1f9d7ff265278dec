"""snrmjax: nonlinear normal mode backbones and damping from near-resonant steady states.

The ten verbs to start with are here (`snrmjax.identify_backbone`, …); the rest is in namespaces:
`model` structures and effects, `measure` data of a test, `simulate` responses and nonlinear modes,
`condense` models from finite elements, `identify` backbone and damping from a test, `methods` other
identification methods, `diagnose` missing effects of a model, `doctor` errors of a test, `study`
sweeps, `io` files, `plot` figures, `pipelines` the commands. Arguments run: the object the verb
works on, data, method, then settings by keyword.

Glossary

- Steady state: one settled vibration, measured at one frequency and force.
- Level: the steady states under one nominal force or response.
- Phasor: complex amplitude of a harmonic in the convention e^{+iΩt}, relative to the force.
- Phase resonance: the velocity is in phase with the force, which then balances the damping alone.
- Appropriation indicator: for the fundamental of one sensor cos² of the velocity phase, averaged
  over harmonics; 1 at phase resonance.
- Force drop-out: fall of the force at resonance, because the structure reacts on the shaker.
- Backbone: natural frequency ω̃ of one nonlinear mode against amplitude.
- Damping curve: damping ratio ζ̃ of that mode against amplitude, relative to ω̃.
- SNRM (single nonlinear resonant mode): ω̃ and ζ̃ of the mode of interest depend on amplitude, all
  other modes are linear. Its inverse converts one steady state into ω̃ and ζ̃.
- Participation: mass-normalised mode shape times the force pattern, per newton of the force.
- Modal mass: 1 over the product of mode shape at the sensor and participation. Identified damping
  ratios refer to it.
- Residual modes: the response of all modes but the one of interest, subtracted from the data.
- Influence vector: weights of the degrees of freedom in the displacement that an element sees; the
  same weights distribute its force.
- Attachment point: degree of freedom, or pair of them, at which an element acts.
- Nonlinear normal mode: periodic motion of the structure without damping and force; its frequency
  depends on the energy.
- Internal resonance: energy exchange between modes whose frequencies are near a ratio such as 1:3.
- Harmonic balance: a periodic motion as a Fourier series whose residual vanishes in each harmonic.
- Alternating frequency-time: nonlinear forces are evaluated at time samples of the motion and
  transformed back to harmonics.
- Inverse harmonic balance: the measured fundamental is prescribed and the required force computed.
  It is single-valued through folds, where a response curve has three values.
- Force balance: that required force against the measured one, as complex numbers.
- Branch: a connected curve of solutions, traced by arclength continuation.
- Fold: a turning point of a response curve in frequency, where a stepped test jumps.
- Isolated response: a branch that no sweep from rest reaches.
- Floquet multipliers: factors by which small disturbances grow over a period; a motion is stable
  while all of them lie inside the unit circle.
- Pointwise: every steady state is inverted by itself.
- Joint fit: smooth curves, instrument errors and level errors fitted to all steady states at once.
- Roughness: second differences of a smooth curve, whose scale is estimated from the data.
- Band: 95 % interval of a curve. Coverage is the fraction of tests in which it contains the truth.
- Level-to-level variance: errors common to all states of a level (gain, phase, natural frequency,
  damping), stated or estimated. Run-to-run variability is the same between assemblies and days.
- Cross-validation: levels are withheld from the fit, predicted, and compared with the measurement.
- Optimal design: the next steady states, chosen to make a band narrowest.
- Discriminating test: the cheapest measurement expected to reject the competing hypotheses.
- Effect: a hypothesis of a diagnosis, such as friction, a gap or an instrument error. The library
  is `snrmjax.model.effects.EFFECTS`; `register_effect` adds yours.
- Law: the force of an element as a function of displacement, velocity or their history.
- Evidence: probability of the data under a hypothesis, averaged over its uncertain parameters.
- Confounder: an effect that changes the data in nearly the same way as another one.
- Drawn law: a force estimated as a curve with its band, where no law in the library explains it.
- Remainder: the part of a change that the identified laws leave, as a curve with its band.
- Detection limit: the strength from which an effect would have been detected in the data.
- Condensation: a potential of few modes fitted to static load cases of a finite-element model.
- Load scale: linear displacement of the load cases of a condensation, in thicknesses.
- Member: one of many structures or forces in a batch or study.
- Main effect: the fraction of an output's variance due to one varied quantity alone.
- Model discrepancy: difference between model and data beyond all stated errors.
"""

import os
import sys

import lazy_loader

# Before any array is created: earlier ones would be float32. JAX reads the variable on import;
# importing it here would take two thirds of the time of `snrmjax --help`.
os.environ["JAX_ENABLE_X64"] = "1"
# Up to jaxlib 0.9, XLA reports each program that is read back from disk as an error, because of
# compiler preferences that it mistakes for processor features.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
if "jax" in sys.modules:
    import jax

    jax.config.update("jax_enable_x64", True)

import snrmjax.report  # noqa: F401  # registers how facts and results are shown

__version__ = "0.1.0"

# The names are in `__init__.pyi`. A simulation does not wait for the imports of an identification.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
