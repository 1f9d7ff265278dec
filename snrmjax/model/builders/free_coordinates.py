"""Rigid-body motions that only nonlinear elements constrain."""

import numpy as np
from jaxtyping import Float

_COUPLED = 1e-9  # of a rigid-body motion's largest value, below which an element is uncoupled


def coupled_first(
    motion: Float[np.ndarray, "attachment rigid"], largest: Float[np.ndarray, " rigid"]
) -> tuple[Float[np.ndarray, "rigid rigid"], int]:
    """An orthogonal rotation of rigid-body modes, and how many of the new ones couple to elements.

    The coupled ones come first. The modes are only reordered if that suffices.

    Arguments: `motion` is the displacement of every element in each mode, `largest` the modes'
    largest value at any point.
    """
    coupled = np.abs(motion) > _COUPLED * largest
    rank = int(np.linalg.matrix_rank(np.where(coupled, motion, 0.0) / np.maximum(largest, 1e-300)))
    any_coupled = np.any(coupled, axis=0)
    if rank == np.count_nonzero(any_coupled):
        order = np.argsort(~any_coupled, kind="stable")
        return np.eye(len(largest))[:, order], rank
    return np.linalg.svd(np.where(coupled, motion, 0.0))[2].T, rank
