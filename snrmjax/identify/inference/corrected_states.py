"""Measured states with the errors of their instruments that a joint fit found."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.measure.states import SteadyStates


def corrected_states(data: SteadyStates, fit: JointFit) -> SteadyStates:
    """The states with the force and the phase that a joint fit found for their instruments.

    Where only a drive voltage is known, the force in N is that voltage times the fitted gain.
    """
    unknowns = fit.unknowns
    nominal = data.drive if fit.drive_known_only else data.force
    offset = unknowns.force_offset * jnp.min(fit.data.force)
    return eqx.tree_at(
        lambda d: (d.force, d.velocity),
        data,
        (
            nominal * jnp.exp(unknowns.log_force_gain) + offset,
            data.velocity * jnp.exp(-1j * unknowns.instrument_phase),
        ),
    )


def with_level_errors_removed(data: SteadyStates, fit: JointFit) -> SteadyStates:
    """The states with every level's gain and phase as a joint fit found them.

    Where a gain of the force is free, a level's gain is the force's.
    """
    errors = np.asarray(fit.unknowns.level * fit.prior.level)
    row = {number: k for k, number in enumerate(fit.level_numbers)}
    # Levels of which no state entered the fit have no error that it could have found.
    every = np.vstack([errors, np.zeros(errors.shape[1])])
    place = [row.get(int(one), len(errors)) for one in np.asarray(data.level)]
    gain, phase = every[place, 0], every[place, 1]
    of_force = gain * float(fit.prior.gain_of_force)
    return eqx.tree_at(
        lambda d: (d.force, d.velocity),
        data,
        (
            data.force * np.exp(of_force),
            data.velocity * np.exp(of_force - gain - 1j * phase)[:, None],
        ),
    )
