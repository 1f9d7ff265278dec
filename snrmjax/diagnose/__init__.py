"""What a model lacks: from a row of a table to a verdict.

1. `io.read_steady_states` makes a row a steady state: frequency, force, velocity phasors, errors.
2. `misfit.predictions.predictions_of` prescribes each state's measured fundamental, and harmonic
   balance finds the other harmonics and the force that this motion needs: one value for any model,
   however a response folds. A column is what is compared: the force over the measured one, other
   sensors, harmonics.
3. `identify.test_model.posterior.fit_test` draws smooth curves through the same states, without any
   law. They say how an error of amplitude moves the force, by how much levels differ, and the noise
   where none is stated (`misfit.reference`). Every hypothesis is weighed by these alike
   (`misfit.weighted_misfit`); errors of levels and of the model's own parameters are shared rows.
   Fits begin at the records without the errors that these curves find (`misfit.effect_fit`).
4. `search.model_search.find_effects` fits effects alone, in pairs and in threes. `answers` compares
   the likeliest, and nothing at all, each with the records that are corrected for the errors that
   it finds in them itself, until nothing moves; with many harmonics for kinks and slip; and with
   and without errors of levels that nobody stated, where an answer leaves more than noise or does
   what such levels do.
5. `evidence.weights_of` weighs every answer that was fitted, each with its own sizes of noise and
   levels' errors, beside smooth misfits of unknown size (`unknown`) and noise stated wrong.
6. `decide.decide` reads these probabilities and the checks that can refute them: levels left out of
   the fit, powers of amplitude, gains that the data do not determine. It is the only place where a
   verdict is made; all numbers that decide stand in `priors` and `identify.test_model.priors`.
7. Where nothing of the library explains the data, `laws` draws a law from them.
"""

import lazy_loader

# The public names are in `__init__.pyi`; each module is imported with its first name.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
