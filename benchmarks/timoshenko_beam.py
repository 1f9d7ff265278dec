"""The cantilever of Timoshenko elements with large axial strains that published problem 11 has.

Strains u′ + w′²/2 along the axis, φ + w′ + u′ φ in shear, and φ′ and φ φ′ over the height, of cubic
axial displacements u, quadratic deflections w and linear rotations φ: a potential of degree 4.
Units mm, mN and kg. Reference: Ponsioen, Pedergnana & Haller, J. Sound Vib. 420 (2018) 269,
doi:10.1016/j.jsv.2018.01.048.
"""

import dataclasses
from collections import Counter
from itertools import product
from typing import Any

import numpy as np

import snrmjax as sj

HEIGHT, LENGTH, YOUNG, DENSITY, RATIO = 40.0, 1200.0, 9e4, 7850e-9, 0.2
SHEAR = YOUNG / 2.6
Strains = list[tuple[float, dict[str, np.ndarray]]]  # weights, and rows over the unknowns


def _strains(n_elements: int) -> Strains:
    """The weight of every Gauss point, and what the unknowns move and strain there."""
    h, size = LENGTH / n_elements, 5 * n_elements + 4
    found = []
    points, weights = np.polynomial.legendre.leggauss(5)
    for element, (s, weight) in product(
        range(n_elements), zip(0.5 * (points + 1), 0.5 * weights, strict=True)
    ):
        first = 5 * element
        axial, across, turning = first + np.array([0, 1, 5, 6]), [3, 4, 8], [2, 7]
        rows = {
            "u": (axial, [1 - 3 * s**2 + 2 * s**3, h * (s - 2 * s**2 + s**3), 0.0, 0.0]),
            "u'": (axial, [-6 * s + 6 * s**2, h * (1 - 4 * s + 3 * s**2), 0.0, 0.0]),
            "w": (first + np.array(across), [1 - 3 * s + 2 * s**2, 4 * s - 4 * s**2, 2 * s**2 - s]),
            "w'": (first + np.array(across), [-3 + 4 * s, 4 - 8 * s, 4 * s - 1]),
            "p": (first + np.array(turning), [1 - s, s]),
            "p'": (first + np.array(turning), [-1.0, 1.0]),
        }
        rows["u"][1][2:] = [3 * s**2 - 2 * s**3, h * (s**3 - s**2)]
        rows["u'"][1][2:] = [6 * s - 6 * s**2, h * (3 * s**2 - 2 * s)]
        whole = {}
        for name, (places, values) in rows.items():
            whole[name] = np.zeros(size)
            whole[name][places] = np.array(values) / (h if name.endswith("'") else 1.0)
        clamped = [0, 2, 3]
        found.append((weight * h, {k: np.delete(v, clamped) for k, v in whole.items()}))
    return found


def timoshenko_beam(n_elements: int = 4, mass: float = 0.0) -> sj.model.Structure:
    """The beam under a moment at its tip, with a `mass` (kg) a quarter of its length from the wall.

    The mass turns as one of 250 mm radius of gyration does.
    """
    area, second = HEIGHT**2, HEIGHT**4 / 12
    strains = _strains(n_elements)
    size = 5 * n_elements + 1
    inertia, by_young, by_shear = (np.zeros((size, size)) for _ in range(3))
    for weight, row in strains:
        for part, scale, matrix in (
            ("u", DENSITY * area, inertia),
            ("w", DENSITY * area, inertia),
            ("p", DENSITY * second, inertia),
            ("u'", YOUNG * area, by_young),
            ("p'", YOUNG * second, by_young),
        ):
            matrix += weight * scale * np.outer(row[part], row[part])
        angle = row["p"] + row["w'"]
        by_shear += weight * SHEAR * area * np.outer(angle, angle)
    node = 5 * (n_elements // 4) - 3  # its axial unknown
    inertia[[node, node + 3], [node, node + 3]] += mass
    inertia[node + 2, node + 2] += mass * 250.0**2
    viscous = [2 * RATIO * np.sqrt(DENSITY * area / modulus) for modulus in (YOUNG, SHEAR)]
    names = [f"{kind}{k}" for k in range(n_elements + 1) for kind in ("u", "s", "p", "w", "m")]
    points = [name for name in names[:-1] if name not in ("u0", "p0", "w0")]
    model = sj.model.from_matrices(
        *(inertia, viscous[0] * by_young + viscous[1] * by_shear, by_young + by_shear, points),
        force=f"p{n_elements}",
    )
    shapes = np.asarray(model.modes.mode_shape)
    third, fourth = np.zeros((size,) * 3), np.zeros((size,) * 4)
    for weight, row in strains:
        u, w, p, bend = (row[part] @ shapes for part in ("u'", "w'", "p", "p'"))
        third += weight * (0.5 * YOUNG * area) * np.einsum("i,j,k", u, w, w)
        third += weight * (SHEAR * area) * np.einsum("i,j,k", p + w, u, p)
        fourth += weight * (YOUNG * area / 8) * np.einsum("i,j,k,l", w, w, w, w)
        fourth += weight * (0.5 * SHEAR * area) * np.einsum("i,j,k,l", u, u, p, p)
        fourth += weight * (0.5 * SHEAR * second) * np.einsum("i,j,k,l", p, p, bend, bend)
    terms: Counter[tuple[Any, ...]] = Counter()
    for tensor in (third, fourth):
        index = np.sort(np.indices(tensor.shape).reshape(tensor.ndim, -1), axis=0)
        monomials, place = np.unique(index, axis=1, return_inverse=True)
        sums = np.bincount(place.ravel(), tensor.ravel())
        terms.update({tuple(m): float(c) for m, c in zip(monomials.T.tolist(), sums, strict=True)})
    potential = sj.model.polynomial_potential(dict(terms), size)
    return dataclasses.replace(model, potential=potential)
