"""A structure with a hidden stretching part, whose condensed potential is known in closed form.

E = ½Σω²q² + ½Σ k w² + Σ w_j b_j(q) + c(q), with b_j a quadratic form: w_j = −b_j/k_j at rest, and
so V(q) = c(q) − ½ Σ b_j(q)²/k_j. Displacements are u = T (q, w). Plain NumPy, Newton's method.
"""

import itertools
from collections import defaultdict
from typing import NamedTuple

import numpy as np


class HiddenMembrane(NamedTuple):
    frequency: np.ndarray  # of the modes, rad/s
    stiffness: np.ndarray  # of the membrane, k_j
    forms: np.ndarray  # (membrane, mode, mode): b_j = q·B_j q
    cubic: np.ndarray  # (mode, mode, mode) of c(q), symmetric
    quartic: np.ndarray  # symmetric
    map: np.ndarray  # T, (dof, dof)

    @property
    def shapes(self):
        return self.map[:, : len(self.frequency)]

    @property
    def filter(self):
        return np.linalg.inv(self.map)[: len(self.frequency)]

    def coefficients(self):
        """Of the condensed potential, by sorted monomial of modes counted from zero."""
        n, found = len(self.frequency), defaultdict(float)
        for modes in itertools.product(range(n), repeat=3):
            found[tuple(sorted(modes))] += self.cubic[modes]
        for modes in itertools.product(range(n), repeat=4):
            i, j, k, m = modes
            condensed = -0.5 * np.sum(self.forms[:, i, j] * self.forms[:, k, m] / self.stiffness)
            found[tuple(sorted(modes))] += self.quartic[modes] + condensed
        return dict(found)

    def solved(self, force, *, digits=None):
        """(q, u, energy) of one load case, by Newton's method in (q, w)."""
        n, hidden = len(self.frequency), len(self.stiffness)
        x = np.zeros(n + hidden)
        squared = self.frequency**2
        for _ in range(60):
            q, w = x[:n], x[n:]
            slope = 2 * np.einsum("jmn,n->jm", self.forms, q)
            c3 = np.einsum("ijk,j,k->i", self.cubic, q, q)
            c4 = np.einsum("ijkl,j,k,l->i", self.quartic, q, q, q)
            rest = np.concatenate(
                [
                    squared * q + w @ slope + 3 * c3 + 4 * c4 - force,
                    self.stiffness * w + np.einsum("jmn,m,n->j", self.forms, q, q),
                ]
            )
            tangent = np.diag(np.concatenate([squared, self.stiffness]))
            tangent[:n, :n] += 2 * np.einsum("j,jmn->mn", w, self.forms)
            tangent[:n, :n] += 6 * np.einsum("ijk,k->ij", self.cubic, q)
            tangent[:n, :n] += 12 * np.einsum("ijkl,k,l->ij", self.quartic, q, q)
            tangent[n:, :n], tangent[:n, n:] = slope, slope.T
            step = np.linalg.solve(tangent, rest)
            x, near = x - step, np.abs(step).max() < 1e-9 * np.abs(x).max()
            if near:  # to rounding, as each step squares the error
                break
        q, w = x[:n], x[n:]
        energy = 0.5 * squared @ q**2 + 0.5 * self.stiffness @ w**2
        energy += w @ np.einsum("jmn,m,n->j", self.forms, q, q)
        energy += np.einsum("ijk,i,j,k", self.cubic, q, q, q)
        energy += np.einsum("ijkl,i,j,k,l", self.quartic, q, q, q, q)
        u = self.map @ x
        if digits is not None:
            u = np.array([float(f"{value:.{digits - 1}e}") for value in u])
        return self.filter @ u, u, energy


def hidden_membrane(n_modes=3, n_hidden=2, *, curved=0.0, seed=0):
    """A structure that hardens; `curved` is the size of its quadratic force, 0 none."""
    random = np.random.default_rng(seed)
    frequency = 100.0 * (1.0 + np.arange(n_modes)) ** 1.5
    forms = random.normal(size=(n_hidden, n_modes, n_modes))
    relative = frequency / frequency[0]  # stiffer modes have stiffer terms
    forms = 25 * (forms + forms.transpose(0, 2, 1)) * relative[:, None] * relative
    stiffness = 1e4 * (1.0 + np.arange(n_hidden))
    # ½ (b + k w)²/k is never negative: what the membrane takes away, this gives back twice.
    both = np.einsum("jab,jcd,j->abcd", forms, forms, 1 / stiffness)
    orders = list(itertools.permutations(range(4)))
    quartic = sum(both.transpose(order) for order in orders) / len(orders)
    cubic = random.normal(size=(n_modes,) * 3) * relative[:, None, None] * relative[:, None]
    cubic = cubic * relative
    orders = list(itertools.permutations(range(3)))
    cubic = curved * sum(cubic.transpose(order) for order in orders) / len(orders)
    turn = random.normal(size=(n_modes + n_hidden,) * 2)
    return HiddenMembrane(frequency, stiffness, forms, cubic, quartic, turn)
