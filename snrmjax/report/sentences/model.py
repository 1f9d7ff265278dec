"""Sentences of models and their effects."""

from snrmjax.model.effect_metadata import Part
from snrmjax.report.sentences import Wording


def _shape_of_effect(part: Part, power: float | None, harmonic: int | None) -> str:
    if part is Part.INSTRUMENTS:
        return "It changes what is recorded, not the motion."
    if part is Part.TIME:
        return "It changes during the test, not with the amplitude."
    changes = {None: "", 0.0: " equally at all amplitudes"}.get(
        power, f" with the power {power:g} of the amplitude" if power else ""
    )
    shows = "" if harmonic is None else f" and shows in harmonic {harmonic}"
    return f"It changes the {part}{changes}{shows}."


SENTENCES: dict[str, Wording] = {"shape_of_effect": _shape_of_effect}
