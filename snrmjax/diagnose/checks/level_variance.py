"""What levels differ by, where nobody says anything of errors."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from snrmjax.measure.states import SteadyStates
from snrmjax.model.structures import Structure

_MOST = 0.2  # 1σ of a deviation, beyond which smooth curves were not those of the structure


def says_of_levels(model: Structure) -> bool:
    """Whether a model states any error that the states of a level share."""
    return any(std > 0 for std in model.level_stds)


def with_levels_as_found(model: Structure, data: SteadyStates) -> tuple[Structure, str]:
    """The model with the errors of levels that a joint fit of smooth curves finds, and a sentence.

    Curves of amplitude of any shape know nothing of the physics: what differs from level to level
    beside them is no law of amplitude. Restricted likelihood says whether there is any. The model
    as it is, and nothing, where there is none, where levels differ by more than those of one
    structure can, or where no smooth curves are found.
    """
    # Few diagnoses need it, and it takes long to import.
    from snrmjax.identify.inference.fitted_curves import values_at_displacement
    from snrmjax.identify.joint.joint_fit import fit_jointly
    from snrmjax.identify.joint.notes import in_words

    fit = fit_jointly(data, model.modes)
    gain, phase, stiffness, damping = np.asarray(fit.level_std)
    if not fit.converged or not 0 < np.max(fit.level_std) < _MOST:
        return model, ""
    values = values_at_displacement(fit, np.asarray(fit.motion().displacement))[0]
    squared, modal_damping = np.median(values, axis=0)
    omega = np.sqrt(squared)
    widened = dataclasses.replace(
        model,
        level_gain_std=jnp.asarray(gain),
        level_phase_std=jnp.asarray(phase),
        level_frequency_std=jnp.asarray(0.5 * stiffness * omega),
        level_damping_std=jnp.asarray(damping * modal_damping / (2 * omega)),
    )
    return widened, (
        f"no error of levels is stated: smooth curves leave them different by "
        f"{in_words(fit.level_std)} (1σ), which is taken for errors that the states of a level "
        "share."
    )
