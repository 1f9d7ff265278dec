"""Modal damping from a damping matrix, without loss of digits on fine meshes."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import scipy.sparse
from jaxtyping import Float

_OVERDAMPED = 0.99  # largest damping ratio; the rest counts as coupling
_NO_COUPLING = 1e-12  # of the damping of both modes
_ROUNDED = (4e-16, 2e-15)  # relative rounding error of a damping with one and with two parts
_ENTRIES, _TRIALS = 100_000, 200  # entries sampled, and pairs of them solved for a and b
_NOTED = 1e-6  # of a modal damping: rounding error above which it is stated as 1σ
_LOWEST, _CAUTION = 10, 0.5  # modes most affected; 1σ over the sum of all rounding errors
_CANCELLED = 1e-8  # of a modal damping: permitted rounding error
_SLICES = 3  # of the digits in products without rounding


def modal_damping(
    damping: Any, mass: Any, stiffness: Any, shapes: np.ndarray, omega: np.ndarray
) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
    """Damping ratios, the remaining coupling of the modal damping matrix, and 1σ of the ratios.

    Arguments: the symmetric matrices, dense or sparse, mass-normalised `shapes` and their
    frequencies in rad/s, zero for those without stiffness.
    """
    # The proportional part follows exactly from the frequencies: Φᵀ(aM + bK)Φ = a + bω². As a
    # product with the shapes it is a small difference of large numbers on a fine mesh.
    by_mass, by_stiffness, rest = _proportional(damping, mass, stiffness)
    modal = np.diag(by_mass + by_stiffness * omega**2) + _modal(rest, shapes)
    own = np.diag(modal)
    twice = np.where(omega > 0, 2 * omega, np.inf)
    ratio = np.minimum(own / twice, _OVERDAMPED)
    std, lowest = np.zeros(len(own)), slice(_LOWEST)
    error = (
        _rounding(damping if by_mass and by_stiffness else rest, shapes[:, lowest]) / twice[lowest]
    )
    std[lowest] = np.where(error > _NOTED * ratio[lowest], error, 0.0)
    rest = modal - np.diag(2 * ratio * omega)
    threshold = _NO_COUPLING * np.sqrt(np.abs(np.outer(own, own)))
    return ratio, rest if np.any(np.abs(rest) > threshold) else None, std


def _rounding(matrix: Any, shapes: np.ndarray) -> np.ndarray:
    """1σ of modal dampings, 1/s, from the rounding of the matrix entries.

    A stored sum of mass and stiffness of a fine mesh has few digits of the modal damping.
    """
    terms = np.sum(np.abs(shapes) * (abs(matrix) @ np.abs(shapes)), axis=0)
    return _CAUTION * np.finfo(float).eps * terms


def _proportional(damping: Any, mass: Any, stiffness: Any) -> tuple[float, float, Any]:
    """a and b of the part a M + b K of a damping matrix, and the rest above rounding errors.

    The simplest pair that agrees with nine of ten entries, to rounding: b alone, a alone, both. If
    there is none, both are zero.
    """
    row, column = (abs(damping) + abs(mass) + abs(stiffness)).nonzero()
    rng = np.random.default_rng(0)
    if len(row) > _ENTRIES:
        sampled = rng.choice(len(row), _ENTRIES, replace=False)
        sampled = np.append(sampled, np.flatnonzero(row == column))
        row, column = row[sampled], column[sampled]
    c, m, k = (np.asarray(part[row, column]).ravel() for part in (damping, mass, stiffness))
    for a, b in _candidates(c, m, k, rng):
        rest = damping - a * mass - b * stiffness
        scale = abs(damping.diagonal()) + abs(a * mass.diagonal()) + abs(b * stiffness.diagonal())
        rounding = _ROUNDED[bool(a and b)] * np.sqrt(scale)
        sampled_rest = np.asarray(rest[row, column]).ravel()
        if np.count_nonzero(
            np.abs(sampled_rest) > rounding[row] * np.sqrt(scale[column])
        ) < 0.1 * len(c):
            if scipy.sparse.issparse(rest):
                rest = rest.tocoo()
                kept = np.abs(rest.data) > rounding[rest.row] * np.sqrt(scale[rest.col])
                at = (rest.row[kept], rest.col[kept])
                return a, b, scipy.sparse.csr_array((rest.data[kept], at), rest.shape)
            return a, b, np.where(np.abs(rest) > rounding[:, None] * np.sqrt(scale), rest, 0.0)
    return 0.0, 0.0, damping


def _candidates(
    c: np.ndarray, m: np.ndarray, k: np.ndarray, rng: np.random.Generator
) -> Iterator[tuple[float, float]]:
    """Pairs a, b of c = a m + b k: by b alone, by a alone, by the pair most entries agree on."""
    yield 0.0, float(np.median(c[k != 0] / k[k != 0])) if np.any(k) else 0.0
    yield float(np.median(c[m != 0] / m[m != 0])), 0.0
    best, agreed = None, 0
    for one, two in rng.integers(0, len(c), (_TRIALS, 2)):
        determinant = m[one] * k[two] - m[two] * k[one]
        if abs(determinant) <= 1e-6 * (abs(m[one] * k[two]) + abs(m[two] * k[one])):
            continue
        a = (c[one] * k[two] - c[two] * k[one]) / determinant
        b = (m[one] * c[two] - m[two] * c[one]) / determinant
        scale = np.abs(c) + np.abs(a * m) + np.abs(b * k)
        same = (np.abs(c - a * m - b * k) <= 1e-8 * scale) & (scale > 0)
        if np.count_nonzero(same) > agreed:
            best, agreed = (same, scale), int(np.count_nonzero(same))
    if best is not None:
        same, scale = best
        rows = np.stack([m[same], k[same]], axis=1) / scale[same, None]
        norm = np.linalg.norm(rows, axis=0)
        pair = np.zeros(2)
        for _ in range(2):  # again for what rounding of the first solution leaves
            left = _remaining(c[same], m[same], k[same], *pair) / scale[same]
            pair = pair + np.linalg.lstsq(rows / norm, left, rcond=1e-15)[0] / norm
        yield float(pair[0]), float(pair[1])


def _remaining(
    c: Float[np.ndarray, " entry"],
    m: Float[np.ndarray, " entry"],
    k: Float[np.ndarray, " entry"],
    a: float,
    b: float,
) -> Float[np.ndarray, " entry"]:
    """c − a m − b k without rounding: on a fine mesh a m is of the size of the last digits of c."""
    unit = [2.0 ** np.round(np.log2(abs(one))) if one else 1.0 for one in (a, b)]
    entries = np.stack([c, unit[0] * m, unit[1] * k], axis=1)
    return _exact_product(entries, np.array([[1.0], [-a / unit[0]], [-b / unit[1]]]))[:, 0]


def _modal(matrix: Any, shapes: np.ndarray) -> np.ndarray:
    """ΦᵀAΦ, with AΦ in more than double precision if large terms cancel."""
    if not (matrix.nnz if scipy.sparse.issparse(matrix) else np.any(matrix)):
        return np.zeros((shapes.shape[1],) * 2)
    product = matrix @ shapes
    terms = np.sum(np.abs(shapes) * (abs(matrix) @ np.abs(shapes)), axis=0)
    cancel = np.finfo(float).eps * terms > _CANCELLED * np.abs(np.sum(shapes * product, axis=0))
    if np.any(cancel):
        product[:, cancel] = _exact_product(matrix, shapes[:, cancel])
    return shapes.T @ product


def _exact_product(matrix: Any, columns: np.ndarray) -> np.ndarray:
    """A matrix times columns, as sums of exact products.

    Both are split into slices of so few binary digits that sums of their products are exact.
    Reference: Ozaki et al., Numer. Algorithms 59 (2012) 95, doi:10.1007/s11075-011-9478-1.
    """
    sparse = scipy.sparse.issparse(matrix)
    terms = int((matrix != 0).sum(axis=1).max())
    digits = (53 - int(np.ceil(np.log2(terms + 1)))) // 2

    def slices(values: np.ndarray, largest: np.ndarray) -> list[np.ndarray]:
        """The values as slices of `digits` bits below the power of two above the largest."""
        unit = 2.0 ** np.ceil(np.log2(np.where(largest > 0, largest, 1.0)))
        parts = []
        for number in range(1, _SLICES + 1):
            step = unit * 2.0 ** (-digits * number)
            parts.append(np.round(values / step) * step)
            values = values - parts[-1]
        return parts

    if sparse:
        rows = matrix.tocsr()
        largest = abs(rows).max(axis=1).toarray().ravel()
        of_entry = np.repeat(largest, np.diff(rows.indptr))
        left = [
            scipy.sparse.csr_array((data, rows.indices, rows.indptr), rows.shape)
            for data in slices(rows.data, of_entry)
        ]
    else:
        left = slices(matrix, np.abs(matrix).max(axis=1, keepdims=True))
    right = slices(columns, np.abs(columns).max(axis=0))
    pairs = [(i, j) for i in range(_SLICES) for j in range(_SLICES - i)]
    return sum(left[i] @ right[j] for i, j in sorted(pairs, key=sum, reverse=True))
