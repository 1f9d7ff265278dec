"""The answer of a former diagnosis, from which one of more states continues."""

from collections.abc import Mapping
from typing import NamedTuple

_LIKELY = 0.05  # probability from which on an answer is mentioned


class FormerAnswer(NamedTuple):
    """What a diagnosis of fewer states said."""

    verdict: str
    effects: tuple[str, ...]
    probabilities: Mapping[str, float]  # of the answers considered
    starts: Mapping[str, tuple[float, ...]]  # parameters of every effect that was compared


def what_changed(former: FormerAnswer, probabilities: Mapping[str, float]) -> str:
    """What further states did to the answers that were likely before, in one sentence."""
    likely = [name for name, p in former.probabilities.items() if p >= _LIKELY]
    both = [
        f"{name} {100 * former.probabilities[name]:.0f} % → "
        f"{100 * probabilities.get(name, 0):.0f} %"
        for name in dict.fromkeys([*likely, *list(probabilities)[:1]])
        if name in former.probabilities
    ]
    new = [
        f"{name} now {100 * p:.0f} %"
        for name, p in probabilities.items()
        if p >= _LIKELY and name not in former.probabilities
    ]
    before = " and ".join(former.effects) or "no effect"
    return (
        f"before the further states the verdict was {former.verdict} ({before}). Probabilities: "
        f"{', '.join([*both, *new])}."
    )
