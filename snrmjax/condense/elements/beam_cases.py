"""Static load cases of a beam under modal forces, as a condensation takes them."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.condense.elements.beam import Beam
from snrmjax.condense.elements.statics import static_solutions
from snrmjax.condense.load_cases import ReductionBasis, StaticCases
from snrmjax.numerics.compiled import compiled


@compiled
def static_cases(
    beam: Beam, basis: ReductionBasis, force: Float[Array | np.ndarray, "case mode"]
) -> StaticCases:
    """Run load cases F = M Φ f with all displacements and the strain energy.

    Cases that diverge or snap through are marked as not converged; `static_solutions` says which.
    Differentiable by `beam`, by `basis` (as `beam_modes(beam, …)` gives it) and by `force`.

    Arguments: `force` f in kg^1/2 m/s², one row a case, such as from `modal_loads`.
    """
    loads = jnp.asarray(force)
    # The filter is ΦᵀM.
    found = static_solutions(beam, loads @ basis.filter)
    return StaticCases(
        force=loads,
        modal_displacement=found.displacement @ basis.filter.T,
        converged=found.converged,
        energy=found.energy,
        displacement=found.displacement,
    )
