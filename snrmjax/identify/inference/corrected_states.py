"""Measured states with the errors of their instruments that a joint fit found."""

import equinox as eqx
import jax.numpy as jnp

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
