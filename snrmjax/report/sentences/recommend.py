"""Sentences on what to measure next to decide a diagnosis."""

from collections.abc import Sequence

from snrmjax.report.sentences import Wording, enumerated
from snrmjax.report.sentences.diagnose import effect_names

_UNITS = {"velocity": "m/s", "frequency": "Hz"}


def _recommended(*, measurements: Sequence[object]) -> str:
    """Each measurement once, without those whose text is part of another."""
    texts = [str(measurement).rstrip(".") for measurement in measurements]
    texts = list(dict.fromkeys(f"{text[0].upper()}{text[1:]}" for text in texts))
    return " ".join(
        f"{text}."
        for k, text in enumerate(texts)
        if not any(text.lower() in other.lower() for j, other in enumerate(texts) if j != k)
    )


def _measure(
    *,
    kind: str,
    level: int,
    force: float,
    frequency: float,
    scale: float,
    states: int,
    harmonics: Sequence[int],
    harmonic_std: float | None,
    largest: float,
    difference: object,
) -> str:
    at, named = f"near {frequency:.4g} Hz", f"level {level} ({force:.3g} N)"
    closely = ""
    if harmonic_std is not None:
        closely = (
            f"harmonic{'s' if len(harmonics) > 1 else ''} {enumerated(harmonics)} to better than "
            f"{100 * harmonic_std / largest:.2g} % of the fundamental ({harmonic_std:.2g} m/s)"
        )
    if kind == "harmonics":
        return f"measure {closely} at {named} {at}: {difference}."
    if kind == "off_resonance":
        return (
            f"measure {states} states 30° to 60° off resonance, on both sides, at {named} {at}: "
            f"{difference}."
        )
    in_addition = f", with {closely}" if closely else ""
    return (
        f"add a level of {force:.3g} N, {scale:g} times the velocities of level {level}, with "
        f"{states} states within 55° of resonance {at}{in_addition}: {difference}."
    )


def _harmonics_apart(
    *,
    models: Sequence[Sequence[str]],
    harmonic: int,
    fractions: Sequence[float],
    turned_deg: float | None,
) -> str:
    one, other = (f"{round(100 * fraction, 6):.2g} %" for fraction in fractions)
    shift = "" if turned_deg is None else f" (phase shifted by {turned_deg:.0f}°)"
    return (
        f"harmonic {harmonic} is {one} of the fundamental with {effect_names(models[0])}, "
        f"{other}{shift} with {effect_names(models[1])}"
    )


def _resonances_apart(
    *, models: Sequence[Sequence[str]], quantity: str, values: Sequence[float]
) -> str:
    one, other = map(effect_names, models)
    return (
        f"{quantity} at resonance {values[0]:.4g} {_UNITS[quantity]} with {one}, {values[1]:.4g} "
        f"with {other}"
    )


SENTENCES: dict[str, Wording] = {
    "recommendation": _recommended,
    "record_phase": "record the phase of the velocity relative to the force.",
    "no_test_settles": (
        "none of the tests compared is expected to decide; the most informative one follows."
    ),
    "measure_test": _measure,
    "motion_of_one": lambda *, models: (
        f"such a motion exists with {effect_names(models[0])}, but not with "
        f"{effect_names(models[1])}"
    ),
    "harmonics_apart": _harmonics_apart,
    "velocities_apart": lambda *, models, fraction: (
        f"with {effect_names(models[0])} and {effect_names(models[1])} velocities differ by up to "
        f"{100 * fraction:.2g} %"
    ),
    "resonances_apart": _resonances_apart,
    "widen_range": ("widen the range of levels and measure farther off resonance on both sides"),
    "record_harmonics": (
        "record the second and third harmonics of the velocity (with their noise floor) at the "
        "largest level"
    ),
}
