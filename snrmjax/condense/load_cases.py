"""Input of a condensation: the linear modes to keep, and static load cases in these modes."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from snrmjax.numerics.rules import InputError


class ReductionBasis(eqx.Module):
    """The linear modes that a reduced model keeps, of a model with mass M and stiffness K.

    `shapes` are mass-normalised (ΦᵀMΦ = I, kg^-1/2). `filter` is the modal filter, q = filter @ u:
    ΦᵀM if the mass matrix is known, otherwise the pseudo-inverse of the shapes at the exported
    degrees of freedom. `numbers` are the mode numbers in the finite-element model, counted from
    one, for texts and tables. `translations` marks the rows that are translations (m) rather than
    rotations (rad), to which load scales refer. None: all are.
    """

    frequency: Float[Array, " mode"]  # rad/s
    shapes: Float[Array, "dof mode"]
    filter: Float[Array, "mode dof"]
    numbers: tuple[int, ...] = eqx.field(static=True)
    translations: Bool[Array, " dof"] | None = None

    @property
    def largest(self) -> Float[Array, " mode"]:
        """Largest translation of each shape, kg^-1/2: metres per unit of modal displacement."""
        magnitude = jnp.abs(self.shapes)
        if self.translations is not None:
            magnitude = jnp.where(jnp.asarray(self.translations)[:, None], magnitude, 0.0)
        return jnp.max(magnitude, axis=0)


class StaticCases(eqx.Module):
    """Static solutions under modal loads, from any solver; one row per case.

    Case c has the external force F = M Φ f_c, so that ΦᵀF = f_c; its displacement u_c is
    q_c = filter @ u_c in modal coordinates. Cases that did not converge are marked and excluded
    from fits. `energy` is the strain energy (J) if the finite-element code exports it, an
    independent check of the potential; `displacement` is u if known.
    """

    force: Float[Array, "case mode"]  # f, kg^1/2 m/s²
    modal_displacement: Float[Array, "case mode"]  # q, kg^1/2 m
    converged: Bool[Array, " case"]
    energy: Float[Array, " case"] | None = None  # J
    displacement: Float[Array, "case dof"] | None = None
    names: tuple[str, ...] = eqx.field(static=True, default=())  # as the user named them

    def __check_init__(self) -> None:
        """Raises `ValueError` for inconsistent numbers of rows or modes."""
        if self.force.shape != self.modal_displacement.shape:
            raise InputError(
                f"`force` has the shape {self.force.shape}, `modal_displacement` "
                f"{self.modal_displacement.shape}: both are (case, mode)."
            )
        cases = len(self.force)
        for name in ("converged", "energy", "displacement"):
            rows = getattr(self, name)
            if rows is not None and len(rows) != cases:
                raise InputError(f"`{name}` has {len(rows)} rows for {cases} cases.")
        if self.names and len(self.names) != cases:
            raise InputError(f"`names` has {len(self.names)} entries for {cases} cases.")

    @property
    def usable(self) -> np.ndarray:
        """Whether each case converged to finite numbers."""
        rows = np.concatenate([self.force, self.modal_displacement], axis=1)
        return np.asarray(self.converged) & np.isfinite(rows).all(axis=1)
