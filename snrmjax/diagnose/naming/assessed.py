"""Hypotheses assessed part by part, and which laws may stand for one another."""

from collections.abc import Callable
from typing import NamedTuple

from snrmjax.diagnose import priors
from snrmjax.diagnose.naming.rows import Cell, Solved
from snrmjax.model.library.free_laws import DisplacementDampingLaw, StiffnessLaw

DRAWN = {"stiffness": StiffnessLaw.kind, "damping": DisplacementDampingLaw.kind}
"""Effect kinds of the remainder of each part."""

Laws = tuple[str, ...]
_ALTERNATIVE = 0.02  # probability, from which on a law or an error counts as an alternative


class Assessed(NamedTuple):
    """One hypothesis, assessed part by part."""

    weight: float
    cell: Cell
    solved: Solved
    laws: dict[str, Laws]  # significant ones, by part
    left: dict[str, bool]  # whether the remainder is significant, by part

    @property
    def changes_nothing(self) -> bool:
        """Whether no part has a significant law or remainder."""
        return not (any(self.laws.values()) or any(self.left.values()))

    def instead(self, part: str) -> Laws:
        """Instrument errors with which a part needs neither a law nor a remainder."""
        return () if self.laws[part] or self.left[part] else self.laws["instrument"]


def classes_of(assessed: list[Assessed], part: str) -> tuple[Laws, tuple[Laws, ...], float]:
    """Effects of a part with their alternatives, and their joint probability."""
    inclusion = _inclusion(assessed, lambda one: one.laws[part])
    most = max(inclusion.values(), default=0.0)
    if part in DRAWN and 1 - priors.NAMED < most < priors.NAMED:
        law = max(inclusion, key=lambda law: inclusion[law])
        assessed = _with_instrument_errors(assessed, part, law)
        inclusion = _inclusion(assessed, lambda one: one.laws[part])
    ranked = sorted(inclusion, key=lambda law: -inclusion[law])
    if not ranked or sum(one.weight for one in assessed if one.laws[part]) < 0.5:
        return (), (), 0.0
    first, left = ranked[0], ranked[1:]
    group = [first]
    for law in left:
        if sum(inclusion[one] for one in group) >= priors.NAMED:
            break
        both = sum(
            one.weight for one in assessed if law in one.laws[part] and first in one.laws[part]
        )
        if inclusion[law] >= _ALTERNATIVE and both < 0.5 * inclusion[law]:
            group.append(law)
    groups = [tuple(group)]
    for law in left:
        if law not in group and inclusion[law] >= 0.5:
            groups.append((law,))
    probability = sum(
        one.weight
        for one in assessed
        if all(any(law in one.laws[part] for law in group) for group in groups)
    )
    return tuple(group[0] for group in groups), tuple(groups), float(probability)


def _inclusion(assessed: list[Assessed], laws: Callable[[Assessed], Laws]) -> dict[str, float]:
    """Inclusion probability of every law."""
    inclusion: dict[str, float] = {}
    for one in assessed:
        for law in laws(one):
            inclusion[law] = inclusion.get(law, 0.0) + one.weight
    return inclusion


def _with_instrument_errors(assessed: list[Assessed], part: str, law: str) -> list[Assessed]:
    """Instrument errors that are alternatives of a part's law count as one of its laws.

    At resonance an offset of the force has the same effect as friction: neither of them is
    certain, but one or the other is.
    """
    anywhere = _inclusion(assessed, lambda one: one.laws["instrument"])
    instead = _inclusion(assessed, lambda one: one.instead(part))
    both = _inclusion(assessed, lambda one: one.laws["instrument"] if law in one.laws[part] else ())
    alternatives = {
        kind
        for kind, p in instead.items()
        if p >= _ALTERNATIVE and anywhere[kind] < priors.NAMED and both.get(kind, 0.0) < 0.5 * p
    }
    laws = ({*one.laws[part], *(alternatives & {*one.instead(part)})} for one in assessed)
    return [
        one._replace(laws={**one.laws, part: tuple(sorted(some))})
        for one, some in zip(assessed, laws, strict=True)
    ]
