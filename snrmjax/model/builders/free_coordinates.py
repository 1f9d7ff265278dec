"""Rigid-body motions that only elements hold: coordinates without a linear spring."""

import numpy as np
from jaxtyping import Float

_FELT = 1e-9  # of a rigid-body motion's largest value, what an element may feel of it by rounding


def felt_first(
    rows: Float[np.ndarray, "place rigid"], largest: Float[np.ndarray, " rigid"]
) -> tuple[Float[np.ndarray, "rigid rigid"], int]:
    """An orthogonal matrix that turns rigid-body modes, and how many of the new ones elements feel.

    These come first. The modes are as they are where each is felt or not.

    Arguments: `rows` have what every element feels of each mode, `largest` the modes' largest
    value at any point.
    """
    felt = np.abs(rows) > _FELT * largest
    rank = int(np.linalg.matrix_rank(np.where(felt, rows, 0.0) / np.maximum(largest, 1e-300)))
    some = np.any(felt, axis=0)
    if rank == np.count_nonzero(some):
        order = np.argsort(~some, kind="stable")
        return np.eye(len(largest))[:, order], rank
    return np.linalg.svd(np.where(felt, rows, 0.0))[2].T, rank
