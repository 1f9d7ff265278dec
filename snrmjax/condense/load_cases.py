"""What a condensation starts from: linear modes to keep, and static load cases run with them."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float


class ReductionBasis(eqx.Module):
    """The linear modes that a reduced model keeps, of a model with mass M and stiffness K.

    `shapes` are mass-normalised (ΦᵀMΦ = I, kg^-1/2). `filter` turns displacements into modal
    coordinates, q = filter @ u: it is ΦᵀM where the mass matrix is known, else the pseudo-inverse
    of the shapes at the degrees of freedom that were written. `numbers` are the modes' numbers in
    the finite-element model, counted from one, for texts and tables. `translations` marks the
    rows that are translations (m), where others are rotations (rad): a wanted displacement is one
    of those. None: all are.
    """

    frequency: Float[Array, " mode"]  # rad/s
    shapes: Float[Array, "dof mode"]
    filter: Float[Array, "mode dof"]
    numbers: tuple[int, ...] = eqx.field(static=True)
    translations: Bool[Array, " dof"] | None = None

    @property
    def largest(self) -> Float[Array, " mode"]:
        """Largest translation of each shape, kg^-1/2: metres per unit of modal displacement."""
        size = jnp.abs(self.shapes)
        if self.translations is not None:
            size = jnp.where(jnp.asarray(self.translations)[:, None], size, 0.0)
        return jnp.max(size, axis=0)


class StaticCases(eqx.Module):
    """Static solutions under modal loads, however they were computed; one row a case.

    Case c has the external force F = M Φ f_c, so that ΦᵀF = f_c; its displacement u_c is
    q_c = filter @ u_c in modal coordinates. Rows that did not converge are kept, marked, and
    left out of fits. `energy` is the strain energy (J) where the finite-element code gave it:
    a free check of the potential; `displacement` u where it is known.
    """

    force: Float[Array, "case mode"]  # f, kg^1/2 m/s²
    modal_displacement: Float[Array, "case mode"]  # q, kg^1/2 m
    converged: Bool[Array, " case"]
    energy: Float[Array, " case"] | None = None  # J
    displacement: Float[Array, "case dof"] | None = None
    names: tuple[str, ...] = eqx.field(static=True, default=())  # as the user named them

    def __check_init__(self) -> None:
        """Raises `ValueError` where numbers of rows or modes do not fit together."""
        if self.force.shape != self.modal_displacement.shape:
            raise ValueError(
                f"`force` has the shape {self.force.shape}, `modal_displacement` "
                f"{self.modal_displacement.shape}: both are (case, mode)."
            )
        cases = len(self.force)
        for name in ("converged", "energy", "displacement"):
            rows = getattr(self, name)
            if rows is not None and len(rows) != cases:
                raise ValueError(f"`{name}` has {len(rows)} rows for {cases} cases.")
        if self.names and len(self.names) != cases:
            raise ValueError(f"`names` has {len(self.names)} entries for {cases} cases.")

    @property
    def usable(self) -> np.ndarray:
        """Whether a case converged to finite numbers, one for each."""
        rows = np.concatenate([self.force, self.modal_displacement], axis=1)
        return np.asarray(self.converged) & np.isfinite(rows).all(axis=1)
