"""Which monomials of a potential couple two modes, and which of them the data ask for.

Near its fit a potential is linear in its coefficients, and their posterior is Gaussian: what any
choice of terms would find follows from the fit with all of them in closed form.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from snrmjax.model.potential import monomial_key

RATIOS = (1, 2, 3)
"""Harmonics of the mode of interest at which another mode may be excited."""

# Terms of both modes by how often the second stands in them: what resonates comes first.
_RESONANT = {1: ((3, 1), (2, 2), (1, 3)), 2: ((2, 1),), 3: ((3, 1),)}
_BESIDE = {1: ((0, 4),), 2: ((2, 2), (1, 2), (0, 4)), 3: ((2, 2), (0, 4))}
_OWN = ((4, 0), (3, 0))
_FURTHER = 0.2  # prior probability of a term that does not resonate


class CouplingTerm(NamedTuple):
    """A monomial q_j^a q_k^b of a potential."""

    key: str  # as a model file has it
    powers: tuple[int, int]  # a and b
    couples: bool  # whether it carries energy between the modes at the ratio

    @property
    def kept(self) -> bool:
        """Whether it stays where modes are coupled: of terms that act alike none can be left out.

        q_j²q_k² moves both frequencies at every ratio, and with them what a resonant term does.
        """
        return self.couples or self.powers == (2, 2)


def coupling_terms(mode: int, other: int, ratio: int) -> tuple[CouplingTerm, ...]:
    """The terms of two modes at a ratio: those that resonate, others of both, the mode's own."""
    resonant = _RESONANT[ratio]
    return tuple(
        CouplingTerm(
            monomial_key(tuple(sorted((mode,) * a + (other,) * b))), (a, b), (a, b) in resonant
        )
        for a, b in (*resonant, *_BESIDE[ratio], *_OWN)
    )


class ChosenTerms(NamedTuple):
    """How probable choices of terms are."""

    best: Bool[np.ndarray, " term"]
    included: Float[np.ndarray, " term"]  # probability of each
    coupled: float  # that one that resonates is there


def chosen_terms(
    terms: Sequence[CouplingTerm],
    values: Float[np.ndarray, " term"],
    information: Float[np.ndarray, "term term"],
    prior_std: Float[np.ndarray, " term"],
) -> ChosenTerms:
    """Posterior probabilities over all choices of terms, by their evidence.

    With χ² quadratic about `values`, of `information` H, and coefficients N(0, σ²) a choice A has
    ln Z = ½ bᵀP⁻¹b − ½ ln det P − Σ ln σ, P = H_AA + diag(1/σ²), b = (H c)_A. Whether the modes
    are coupled has probability ½ beforehand, each further term less.
    """
    pull, resonant = information @ values, np.array([term.couples for term in terms])
    choices = np.array(list(itertools.product([False, True], repeat=len(terms))))
    evidence = np.zeros(len(choices))
    for row, choice in enumerate(choices):
        at = np.flatnonzero(choice)
        if not at.size:
            continue
        size = prior_std[at]
        # In units of the prior, where the matrix is near one.
        matrix = information[np.ix_(at, at)] * np.outer(size, size) + np.eye(len(at))
        b = pull[at] * size
        evidence[row] = 0.5 * (b @ np.linalg.solve(matrix, b) - np.linalg.slogdet(matrix)[1])
    couples = choices[:, resonant].any(axis=1)
    further = choices[:, ~resonant].sum(axis=1)
    prior = _FURTHER**further * (1 - _FURTHER) ** ((~resonant).sum() - further)
    prior = prior * np.where(couples, 0.5 / (2 ** resonant.sum() - 1), 0.5)
    weight = prior * np.exp(evidence - evidence.max())
    weight /= weight.sum()
    return ChosenTerms(
        best=choices[np.argmax(weight)],
        included=weight @ choices,
        coupled=float(weight[couples].sum()),
    )
