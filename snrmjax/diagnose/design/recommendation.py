"""What to measure next so that an open diagnosis is decided, in words."""

from collections.abc import Sequence

from snrmjax.diagnose.design.discriminating_test import DiscriminatingTest, discriminating_test
from snrmjax.diagnose.misfit.candidates import decide_by, only_by_calibration
from snrmjax.diagnose.search.model_search import FoundEffects


def recommended_test(found: FoundEffects) -> DiscriminatingTest | None:
    """The test that is expected to separate the effects that fit equally well.

    A calibration where nothing else separates them; None where nothing is open.
    """
    open_places = [k for k, group in enumerate(found.classes) if len(group) > 1]
    places = tuple(
        k for k in open_places if set(found.classes[k]) - only_by_calibration(found.classes[k])
    )
    if not open_places:
        return None
    unclear = {kind for k in open_places for kind in found.classes[k]}
    too = any(only_by_calibration(found.classes[k]) for k in open_places)
    test = discriminating_test(found, places) if places else None
    if test is not None:
        return test._replace(calibration_too=too)
    return DiscriminatingTest("calibration", decide_by(unclear, harmonics=True)) if too else None


def recommendation(
    found: FoundEffects,
    test: DiscriminatingTest | None,
    open_questions: Sequence[str],
    *,
    phases: bool,
) -> str | None:
    """What would decide, each measurement in one sentence and said once; None if nothing is open.

    Arguments: `open_questions` are the measurements that would resolve doubts; `phases` says
    whether any phase of the velocity is known.
    """
    groups = [set(group) for group in found.classes if len(group) > 1]
    harmonics = bool(found.misfit.predictions.chosen.orders)
    sentences = []
    if groups and not phases:
        sentences.append("Record the phase of the velocity relative to the force.")
    if test is None or test.kind == "calibration":
        sentences += [decide_by(set().union(*groups), harmonics=harmonics)] if groups else []
    else:
        static = [only_by_calibration(group) for group in groups]
        sentences += [decide_by(group, harmonics=True) for group in static if group]
        if not test.settles:
            sentences.append(
                "No single test that was compared is expected to decide; the most informative one:"
            )
        sentences.append(test.sentence)
    sentences += [f"{text[0].upper()}{text[1:]}." for text in open_questions]
    return " ".join(_once(sentences)) or None


def _once(sentences: Sequence[str]) -> list[str]:
    """Every measurement once: the most specific sentence of those that begin alike."""
    every = list(dict.fromkeys(sentences))
    asked = [one.rstrip(".").lower() for one in every]
    return [
        one
        for k, one in enumerate(every)
        if not any(asked[k] in other for j, other in enumerate(asked) if j != k)
    ]
