"""What levels differ by, where nobody says anything of errors."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from snrmjax.identify.force_balance import LEVEL_ERRORS
from snrmjax.measure.steady_states import SteadyStates
from snrmjax.model.structure import Structure

_MOST = 0.2  # 1σ of a deviation, beyond which smooth curves were not those of the structure


def says_of_levels(model: Structure) -> bool:
    """Whether a model states any error that the states of a level share."""
    levels = (model.level_gain_std, model.level_phase_std, model.level_frequency_std)
    return any(float(std) > 0 for std in (*levels, model.level_damping_std))


def with_levels_as_found(model: Structure, data: SteadyStates) -> tuple[Structure, str]:
    """The model with the errors of levels that a joint fit of smooth curves finds, and a sentence.

    Curves of amplitude of any shape know nothing of the physics: what differs from level to level
    beside them is no law of amplitude. Restricted likelihood says whether there is any. The model
    as it is, and nothing, where there is none, where levels differ by more than those of one
    structure can, or where no smooth curves are found.
    """
    # Few diagnoses need it, and it takes long to import.
    from snrmjax.identify.fitted_curves import values_at_displacement
    from snrmjax.identify.joint_fit import fit_jointly

    fit = fit_jointly(data, model.modes)
    std = dict(zip(LEVEL_ERRORS, np.asarray(fit.level_std).tolist(), strict=True))
    if not fit.converged or not 0 < max(std.values()) < _MOST:
        return model, ""
    values = values_at_displacement(fit, np.asarray(fit.motion().displacement))[0]
    squared, damping = np.median(values, axis=0)
    widened = dataclasses.replace(
        model,
        level_gain_std=jnp.asarray(std["gain"]),
        level_phase_std=jnp.asarray(std["phase"]),
        level_frequency_std=jnp.asarray(0.5 * std["stiffness"] * np.sqrt(squared)),
        level_damping_std=jnp.asarray(std["damping"] * damping / (2 * np.sqrt(squared))),
    )
    units = {
        "gain": (100, " % in gain"),
        "phase": (180 / np.pi, "° in phase"),
        "stiffness": (50, " % in natural frequency"),
        "damping": (100, " % in damping"),
    }
    said = [f"{units[k][0] * one:.2g}{units[k][1]}" for k, one in std.items() if one > 0]
    listed = ", ".join(said)
    return widened, (
        f"no error of levels is stated: smooth curves leave them different by {listed} (1σ), which "
        "is taken for errors that the states of a level share."
    )
