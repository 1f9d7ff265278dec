"""Where a fit with families of its own choice does not converge: the next best that does."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, ParamSpec, Protocol, TypeVar, cast

_TRIES = 4  # fits with other families
_CURVES = ("backbone", "damping")

Arguments = ParamSpec("Arguments")
Found = TypeVar("Found")


class _Candidate(Protocol):
    """A family that a selection compared, as `FamilyCandidate` has it."""

    @property
    def curve(self) -> str: ...
    @property
    def family(self) -> str: ...
    @property
    def size(self) -> int: ...
    @property
    def argument(self) -> str: ...
    @property
    def score(self) -> float: ...
    @property
    def chosen(self) -> bool: ...
    @property
    def converged(self) -> bool: ...


class _Pair(NamedTuple):
    """Families of both curves, and how much worse than the best they predict left-out levels."""

    names: dict[str, str]
    loss: float


def next_pairs(candidates: Sequence[_Candidate], left_open: Sequence[str]) -> list[_Pair]:
    """Pairs of families to try in place of the chosen ones, the best predicting first.

    Another family of one curve, or of both where both are open; of every family the best size and
    amplitude.
    """
    chosen = {one.curve: one for one in candidates if one.chosen}
    others: dict[str, list[_Candidate]] = {}
    for curve in left_open:
        mine = [one for one in candidates if one.curve == curve and one.converged]
        best: dict[str, _Candidate] = {}
        for one in sorted(mine, key=lambda one: -one.score):
            best.setdefault(one.family, one)
        best.pop(chosen[curve].family, None)
        others[curve] = list(best.values())
    own = {curve: one for curve, one in chosen.items() if curve in left_open}
    pairs = [{**own, curve: one} for curve in left_open for one in others[curve]]
    if len(left_open) == len(_CURVES):
        pairs += [
            {_CURVES[0]: a, _CURVES[1]: b}
            for a in others[_CURVES[0]][:2]
            for b in others[_CURVES[1]][:2]
        ]
    found = [
        _Pair(
            {curve: f"{one.family}:{one.size}@{one.argument}" for curve, one in pair.items()},
            -sum(one.score for one in pair.values()),
        )
        for pair in pairs
    ]
    return sorted(found, key=lambda pair: pair.loss)


def trying_the_next_family(verb: Callable[Arguments, Found]) -> Callable[Arguments, Found]:
    """For a verb that chooses families: where its fit does not converge, it tries the next best.

    What was asked for by name stays. The first fit that converges is returned and its `notes` say
    so; where none does, the fit that was chosen, with its status.
    """

    @functools.wraps(verb)
    def trying(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Found:
        first: Any = verb(*args, **kwargs)
        given: dict[str, Any] = dict(kwargs)
        left_open = [c for c in _CURVES if str(given.get(c, "auto")).startswith("auto")]
        if first.converged or not left_open:
            return cast(Found, first)
        tried = []
        call = cast(Callable[..., Any], verb)
        for pair in next_pairs(first.families.candidates, left_open)[:_TRIES]:
            try:
                found = call(*args, **(given | pair.names))
            except ValueError as error:
                tried.append(f"{' and '.join(pair.names.values())} ({error})")
                continue
            if found.converged:
                return cast(Found, _said(found, first, pair))
            tried.append(" and ".join(pair.names.values()))
        if not tried:
            return cast(Found, first)
        note = f"none of the next best families converged either: {'; '.join(tried)}."
        return cast(Found, dataclasses.replace(first, notes=(*first.notes, note)))

    return trying


def _said(found: Any, first: Any, pair: _Pair) -> Any:
    """The fit with a note, and with all families that were compared."""
    names = {
        curve: (one.family, one.size, one.argument)
        for curve in pair.names
        for one in found.families.candidates
        if one.curve == curve and one.chosen
    }
    candidates = tuple(
        one._replace(chosen=(one.family, one.size, one.argument) == names[one.curve])
        if one.curve in names
        else one
        for one in first.families.candidates
    )
    was = " and ".join(
        f"{one.family}:{one.size}@{one.argument}"
        for one in first.families.candidates
        if one.chosen and one.curve in pair.names
    )
    note = (
        f"with the families chosen first ({was}) the fit did not converge; these are the next best "
        f"that did ({' and '.join(pair.names.values())}), whose predictions of left-out levels are "
        f"worse by {pair.loss:.2g} in log density. The bands do not include other families."
    )
    families = dataclasses.replace(found.families, candidates=candidates)
    return dataclasses.replace(found, families=families, notes=(note, *found.notes))
