"""snrmjax: nonlinear normal mode backbones and damping from near-resonant steady states.

The ten verbs to start with are here (`snrmjax.identify_backbone`, …); the rest is in namespaces:
`model` what a structure is, `measure` what a test gives, `simulate` what a structure does,
`condense` models from finite elements, `identify` backbone and damping from a test, `methods` the
field's other methods, `diagnose` what a model lacks, `doctor` errors of a test, `study` sweeps,
`io` files, `plot` figures, `pipelines` what the commands do. Arguments run: what the verb works on,
data, method, then settings by keyword.

Glossary

- Backbone: natural frequency ω̃ of one nonlinear mode against amplitude. Damping curve: its
  damping ratio ζ̃ against amplitude, relative to that frequency.
- SNRM (single nonlinear resonant mode): the mode of interest with ω̃ and ζ̃ that depend on
  amplitude, all other modes linear. Its inverse turns one steady state into ω̃ and ζ̃.
- Steady state: one settled vibration, measured at one frequency and force. Level: the steady
  states under one nominal force or response. Member: one of many structures or forces in a batch.
- Phase resonance: the force is in phase with velocity; there the structure's own damping alone
  holds the force.
- Harmonic balance: a periodic motion as a Fourier series whose residual vanishes. Inverse harmonic
  balance: the measured fundamental is prescribed and the force that it needs is computed;
  single-valued through folds, where a response curve has three.
- Force balance: that computed force against the measured one, as complex numbers.
- Fold: a turning point of a response curve in frequency, where a stepped test jumps. Branch: a
  connected curve of solutions. Isolated response: a branch that no sweep from rest reaches.
- Pointwise: every steady state by itself. Joint fit: smooth curves, instruments and levels fitted
  to all steady states at once.
- Band: 95 % interval of a curve. Calibrated coverage: such bands hold the truth in about 95 % of
  tests, as measured on simulated tests.
- Level-to-level variance: errors that all states of a level share (gain, phase, natural frequency,
  damping), stated or estimated. Run-to-run variability: the same between assemblies and days.
- Cross-validation: levels are left out, predicted, and compared with what was measured.
- Optimal design: the next steady states, chosen to make a band narrowest. Discriminating test: the
  cheapest measurement expected to reject the competing models.
- Effect: physics beside the polynomial potential (friction, a gap, an instrument's error). The
  library is `snrmjax.model.effects.EFFECTS`; `register_effect` adds yours.
- Model discrepancy: what is left between model and data after every stated error has had its part.
"""

import os
import sys

import lazy_loader

from snrmjax.numerics.rendering import shown_by

# Before any array is made: earlier ones would be float32. JAX reads the variable as it is imported;
# to import it here would cost `snrmjax --help` two thirds of its time.
os.environ["JAX_ENABLE_X64"] = "1"
# Up to jaxlib 0.9, XLA reports each program that is read back from disk as an error, because of
# preferences of its compiler that it takes for features of the processor.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
if "jax" in sys.modules:
    import jax

    jax.config.update("jax_enable_x64", True)

shown_by(
    sentences="snrmjax.report.sentences",
    printed="snrmjax.report.printed",
    figures="snrmjax.report.plots",
)

__version__ = "0.1.0"

# The names are in `__init__.pyi`. Who simulates does not wait for the imports of who identifies.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
