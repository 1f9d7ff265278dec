"""What a model lacks: from a row of a table to a verdict.

1. `io.read_steady_states` makes a row a steady state: frequency, force, velocity phasors, errors.
2. `identify.test_model.posterior.fit_test` draws smooth curves through the states, without any law:
   the slopes by which an error of amplitude acts, the noise and what levels differ by, where nobody
   stated them. `naming.phases` gives states without phases those of such curves.
3. `naming.readings` reads of every state what its dynamic stiffness, and each other harmonic of the
   force, has beyond the model, whitened by all errors. `explained_parts` puts both together.
4. `naming.laws` has what every kind of effect changes there, to first order: columns
   (`naming.columns`), one for each value of a parameter that is not linear.
5. `naming.rows` makes these a linear problem, `naming.evidence` has the probabilities of laws in
   closed form, and `naming.hypotheses` weighs all single laws and pairs, and more laws from the
   best of these, each with remainders of every size; it refines shapes that count. `naming.parts`
   makes these hypotheses an answer by parts: laws with their probability, the fraction of the
   change that they explain, what is left.
6. `answer_by_parts` fits the named laws together by harmonic balance at the measured motions
   (`misfit`, `fitted_effects`), makes the verdict, and completes the model with laws and remainder.

All numbers that decide stand in `priors` and `identify.test_model.priors`, each with its reason.
"""

import lazy_loader

# The public names are in `__init__.pyi`; each module is imported with its first name.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
