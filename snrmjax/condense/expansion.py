"""Displacements beyond the modes kept: what follows them statically, such as stretching."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.condense.load_cases import ReductionBasis, StaticCases
from snrmjax.condense.potential_fit import monomials_of
from snrmjax.model.potential import Monomial


class MembraneExpansion(eqx.Module):
    """u(q) = Φq + Σ_k s_k p_k(q), with products p_k of modal displacements as coordinates.

    The shapes s_k are fitted to what static load cases left of u − Φq: the quadratic ones are the
    membrane basis of a flat structure, the cubic ones the bending that the modes kept do not have.
    """

    shapes: Float[Array, "dof mode"]  # Φ, kg^-1/2
    static_shapes: Float[Array, "dof product"]  # s_k, kg^-1 m^-1 and kg^-3/2 m^-2
    misfit: float  # rms of what is left of u − Φq, over its rms
    products: tuple[Monomial, ...] = eqx.field(static=True)

    def expand(self, displacement: Float[Array, "*batch mode"]) -> Float[Array, "*batch dof"]:
        """The displacement of all degrees of freedom (m, rad) at modal displacements."""
        q = jnp.asarray(displacement)
        return q @ self.shapes.T + products_of(q, self.products) @ self.static_shapes.T


def products_of(
    displacement: Float[Array, "*batch mode"], products: tuple[Monomial, ...]
) -> Float[Array, "*batch product"]:
    """Products of modal displacements, one column each.

    >>> products_of(jnp.array([2.0, 3.0]), ((0, 0), (0, 1)))
    Array([4., 6.], dtype=float64)
    """
    return jnp.stack([jnp.prod(displacement[..., list(m)], axis=-1) for m in products], axis=-1)


def fit_expansion(
    basis: ReductionBasis, cases: StaticCases, *, degree: int = 3
) -> MembraneExpansion:
    """Fit the static part of the displacement to load cases that have displacements.

    Arguments: `degree` of the products, 2 for the membrane alone. Fewer products are taken where
    there are not twice as many load cases.
    Raises `ValueError` where the cases have no displacements.
    Reference: Hollkamp & Gordon, J. Sound Vib. 318 (2008) 1139, doi:10.1016/j.jsv.2008.04.035
    (expansion by quadratic products).
    """
    if cases.displacement is None:
        raise ValueError("these load cases have no displacements (`displacement` is None).")
    used = cases.usable
    q = np.asarray(cases.modal_displacement)[used]
    while degree > 2 and 2 * len(monomials_of(q.shape[1], degree - 1, 1)) > len(q):
        degree -= 1
    products = monomials_of(q.shape[1], degree - 1, 1)
    scale = np.sqrt(np.mean(q**2, axis=0))
    left = np.asarray(cases.displacement)[used] - q @ np.asarray(basis.shapes).T
    columns = np.stack([np.prod(q[:, list(m)] / scale[list(m)], axis=1) for m in products], axis=1)
    # The smallest shapes that fit, where the cases do not tell all products apart.
    found = np.linalg.pinv(columns, rcond=1e-10) @ left
    unit = np.array([np.prod(scale[list(m)]) for m in products])
    size = float(np.sum(left**2))
    misfit = float(np.sqrt(np.sum((left - columns @ found) ** 2) / size)) if size else 0.0
    return MembraneExpansion(
        jnp.asarray(basis.shapes), jnp.asarray((found / unit[:, None]).T), misfit, products
    )
