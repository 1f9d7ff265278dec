"""What a diagnosis says as a whole, and the sentence for it."""

from collections.abc import Sequence
from enum import StrEnum


class Verdict(StrEnum):
    """What a diagnosis says as a whole."""

    NOTHING_MISSING = "none"
    NAMED = "named"
    AMBIGUOUS = "ambiguous"
    DRAWN = "drawn"
    UNKNOWN = "unknown"
    NOISE_REJECTED = "noise_rejected"

    @property
    def is_answer(self) -> bool:
        """Whether effects are given as an answer."""
        return self in (Verdict.NAMED, Verdict.AMBIGUOUS, Verdict.DRAWN)


def verdict_sentence(
    verdict: Verdict, classes: Sequence[Sequence[str]], before: float, after: float
) -> str:
    """A verdict in one plain sentence.

    Arguments: `classes` has every effect of the answer with those that fit as well, or drawn laws
    in words; misfits before and after it in units of noise.
    """
    found = _listed([group[0] for group in classes], "and")
    falls = f"the misfit falls from {_times(before)} to {_times(after)} times the noise"
    with_it = "with them" if len(classes) > 1 else "with it"
    if verdict is Verdict.NOTHING_MISSING:
        return (
            "Nothing is missing that these data could show: the model as given fits them to "
            f"{_times(after)} times the noise."
        )
    if verdict is Verdict.NOISE_REJECTED:
        return (
            "The stated noise does not fit the scatter of these data, so no effect is named: state "
            "the noise of a repeated test, or none, and diagnose again."
        )
    if verdict is Verdict.UNKNOWN:
        start = "Something is missing that no effect of the library explains reliably"
        return f"{start}; the best attempt is {found}: {falls}." if found else f"{start}."
    if verdict is Verdict.DRAWN:
        names = "; beside it ".join(group[0] for group in classes)
        return (
            f"The model lacks a force that no effect of the library explains, drawn from the data: "
            f"{names}. With it {falls}."
        )
    if verdict is Verdict.NAMED:
        return f"The model lacks {found}: {with_it} {falls}, and nothing else explains as much."
    if any(len(group) > 1 for group in classes):
        rivals = " and ".join(_listed(group, "or") for group in classes)
        return f"The model lacks {rivals}, and these data cannot tell which: {with_it} {falls}."
    return (
        f"The model probably lacks {found}: {with_it} {falls}, but something else could have the "
        "same effect (see the notes)."
    )


def _times(misfit: float) -> str:
    return f"{misfit:.1f}" if misfit < 10 else f"{misfit:.0f}"


def _listed(names: Sequence[str], word: str) -> str:
    """Names as in a sentence: "a, b and c"."""
    *others, last = names or [""]
    return f"{', '.join(others)} {word} {last}" if others else last
