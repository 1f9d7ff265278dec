"""Sentences of studies and propagated uncertainties."""

from collections.abc import Sequence

from snrmjax.report.sentences import Wording, enumerated, number_of

_MOST = 4  # outputs that a sentence lists


def readable(name: str, force: float | None = None) -> str:
    """A variable's name as words.

    >>> readable("peak_velocity_m_s", 0.002)
    'Peak velocity at 0.002 N'
    >>> readable("n_folds"), readable("natural_frequency_hz_at_largest_amplitude")
    ('Number of folds', 'Natural frequency at largest amplitude')
    """
    stem, at, location = name.partition("_at_")
    for unit in ("_m_s", "_hz", "_n", "_j"):
        stem = stem.removesuffix(unit)
    words = (f"number_of_{stem[2:]}" if stem.startswith("n_") else stem) + at + location
    text = words.replace("_", " ")
    return text[:1].upper() + text[1:] + ("" if force is None else f" at {force:.4g} N")


def _some(words: Sequence[str]) -> str:
    further = f" and {len(words) - _MOST} more" if len(words) > _MOST else ""
    return ", ".join(words[:_MOST]) + further


def _outputs(outputs: Sequence[tuple[str, float | None]]) -> str:
    return _some([readable(*output) for output in outputs])


def _outside(
    output: tuple[str, float | None],
    ends: tuple[float, float],
    below: int,
    above: int,
    members: int,
) -> str:
    sides = ((below, f"below {ends[0]:.4g} Hz"), (above, f"above {ends[1]:.4g} Hz"))
    where = enumerated([f"{side} in {n}" for n, side in sides if n])
    return (
        f"{readable(*output)} lies {where} of {members} members: medians and ranges count them "
        "there, fractions of variance refer to the others only"
    )


def _without_peak(n_members: int, below: int, above: int) -> str:
    sides = (
        (above, f"above the range in {above}: raise `to_hz`"),
        (below, f"below the range in {below}: lower `from_hz`"),
    )
    where = [text for n, text in sides if n] or ["widen the range"]
    return (
        f"{number_of(n_members, 'member')} without a peak between `from_hz` and `to_hz` (status "
        f"no_peak_in_range); {'the peak lies ' if below or above else ''}{', '.join(where)}"
    )


def _missing(outputs: Sequence[tuple[str, float | None, int, int]]) -> str:
    each = [f"{readable(name, force)} ({k} of {n})" for name, force, k, n in outputs]
    return f"results refer to the members with a value; without one are: {_some(each)}"


def _together(pairs: Sequence[tuple[str, str]]) -> str:
    return (
        f"{_some([f'{one} and {other}' for one, other in pairs])} vary together: their "
        "fractions of variance overlap and may add up to more than the whole"
    )


SENTENCES: dict[str, Wording] = {
    "members_chosen": (
        "the members are a {method} of chosen values: means, ranges and fractions of variance "
        "describe these members, not a probability distribution"
    ),
    "too_few_for_fractions": lambda fewest, outputs: (
        f"fewer than {number_of(fewest, 'member')}: no fractions of variance for "
        f"{_outputs(outputs)}"
    ),
    "fractions_uncertain": lambda limit, outputs: (
        f"fractions of variance are uncertain by more than {100 * limit:.0f} % of the variance for "
        f"{_outputs(outputs)}: use more members"
    ),
    "varied_together": _together,
    "fractions_above_one": "fractions of variance add up to more than one within their errors",
    "values_missing": _missing,
    "events_not_located": (
        "in some responses a fold, peak or resonance exists but was not located: see n_not_located"
    ),
    "values_outside": _outside,
    "no_peak_in_range": _without_peak,
    "highest_at_range_end": (
        "{n_members:#member} with a response that is larger at an end of the range than at its "
        "highest peak (status highest_at_range_end): widen the range, or narrow it to "
        "exclude the other resonance"
    ),
    "peak_not_located": (
        "{n_members:#member} whose largest computed point is not a located peak (status "
        "peak_not_located), so that the peak is reported as missing: use more harmonics"
    ),
    "rows_without_value": (
        "{output} has no value in {fraction:%.2g} of the rows: its indices refer to the others only"
    ),
    "first_order_wrong": (
        "first order is wrong for {quantity} by {error:%.0f}: its 95 % range is {first[0]:.6g} to "
        "{first[1]:.6g}, by second order {second[0]:.6g} to {second[1]:.6g}; its error reaches "
        "10 % at {limit:.2g} times this scatter"
    ),
    "no_event_in_response": lambda event, low_hz, high_hz: (
        f"the nominal response has no {event.replace('_', ' ')} from {low_hz:.5g} to "
        f"{high_hz:.5g} Hz"
    ),
    "event_not_found_again": "{event} could not be located again from the curve and is left out",
}
