"""Level-to-level variance, estimated where no uncertainty is stated."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from snrmjax.measure.states import SteadyStates
from snrmjax.model.structures import Structure

_QUIETER = 0.65  # times the misfit that is left, below which neighbours' scatter is no part of it
_MOST = 0.2  # 1σ of a deviation, beyond which the smooth curves do not describe the structure


def states_level_errors(model: Structure) -> bool:
    """Whether a model states any error that the states of one level share."""
    return any(std > 0 for std in model.level_stds)


def beyond_random_noise(model: Structure, left: float, neighbours: float, n_levels: int) -> str:
    """That what is left is no random noise, but may be errors of levels, of which none is stated.

    Arguments: the misfit that the answer leaves and the scatter of neighbouring states, both in
    units of the stated noise. The latter is what a joint fit calls noise; the former has errors of
    whole levels and of the laws in it, too.
    """
    if states_level_errors(model) or n_levels < 2 or not neighbours < _QUIETER * left:
        return ""
    return (
        f"the misfit that is left is {left:.2g} times the stated noise, but neighbouring states "
        f"scatter by {neighbours:.2g} times that noise only (which is what a joint fit calls "
        "noise): the rest is shared by whole levels, or no effect follows it. `snrmjax identify "
        "--fit auto` says by how much levels differ; stated in the model's [measurement] "
        "(`level_gain_std`, `level_phase_std_deg`) it counts as noise here, too."
    )


def with_level_variance(model: Structure, data: SteadyStates) -> tuple[Structure, str]:
    """The model with level-to-level errors by a joint fit of smooth curves, and a note.

    Smooth curves of amplitude follow any law: what differs from level to level beside them is no
    function of amplitude. Its variance is estimated by restricted maximum likelihood. Returns the
    model unchanged and no note where that is zero, where levels differ by more than those of one
    structure can, or where the joint fit fails or has curves that no structure can have.
    """
    # Few diagnoses need it, and it takes long to import.
    from snrmjax.identify.inference.fitted_curves import values_at_displacement
    from snrmjax.identify.joint.joint_fit import fit_jointly
    from snrmjax.identify.joint.notes import in_words

    fit = fit_jointly(data, model.modes)
    gain, phase, stiffness, damping = np.asarray(fit.noise.level_std)
    if not fit.converged or not 0 < np.max(fit.noise.level_std) < _MOST:
        return model, ""
    values = values_at_displacement(fit, np.asarray(fit.motion().displacement))[0]
    squared, modal_damping = np.median(values, axis=0)
    if not (squared > 0 and modal_damping > 0):
        return model, ""
    omega = np.sqrt(squared)
    widened = dataclasses.replace(
        model,
        level_gain_std=jnp.asarray(gain),
        level_phase_std=jnp.asarray(phase),
        level_frequency_std=jnp.asarray(0.5 * stiffness * omega),
        level_damping_std=jnp.asarray(damping * modal_damping / (2 * omega)),
    )
    return widened, (
        f"no errors of levels are stated: beside smooth curves of amplitude the levels differ by "
        f"{in_words(fit.noise.level_std)} (1σ), which is taken for errors that the states of a "
        "level share."
    )
