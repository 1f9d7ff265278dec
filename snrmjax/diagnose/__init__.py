"""What a model lacks: from a table of steady states to a verdict.

1. `io.read_steady_states` reads the steady states: frequency, force, velocity phasors, errors.
2. `identify.test_model.posterior.fit_test` fits smooth curves to the states, without any law. They
   give the sensitivity to amplitude errors and, where not stated, the noise and the level errors.
   `naming.phases` gives states without phases those of such curves.
3. `readings` computes the residual of each state's dynamic stiffness, and of each other
   harmonic of the force, whitened by all errors. `explained_parts` combines both.
4. `kinds.table` has the change of these by every kind of effect, to first order, and all else that
   a diagnosis knows of it: columns (`naming.columns`), one for each grid value of a nonlinear
   parameter.
5. `naming.rows` sets up the linear problem, `naming.evidence` has the evidence of laws in closed
   form, and `naming.hypotheses` compares single laws, pairs, and larger sets grown from the best
   of these, over a grid of remainder standard deviations; it refines the shapes that matter.
   `explained_parts` replaces strong laws by their harmonic balance and compares them again.
   `naming.parts` turns these hypotheses into an answer by parts: laws with their probability, the
   fraction of the change that they explain, and the remainder.
6. `answer_by_parts` fits the named laws together by harmonic balance at the measured motions
   (`misfit`, `fitted_effects`), gives the verdict, and completes the model with laws and remainder.

All thresholds are in `priors` and `identify.test_model.priors`, each with its reason.
"""

import lazy_loader

from snrmjax.numerics.names import with_retired_names

# The public names are in `__init__.pyi`; each module is imported with its first name.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__ = with_retired_names(
    __name__,
    __getattr__,
    {
        "Whereabouts": "Localisation",
        "EVERYWHERE": "snrmjax.diagnose.location.where.EVERYWHERE",
    },
)
