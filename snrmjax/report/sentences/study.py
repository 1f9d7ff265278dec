"""What studies and propagated uncertainties have to tell."""

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
    stem, at, place = name.partition("_at_")
    for unit in ("_m_s", "_hz", "_n", "_j"):
        stem = stem.removesuffix(unit)
    words = (f"number_of_{stem[2:]}" if stem.startswith("n_") else stem) + at + place
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
        "there, shares of variance are of the others alone"
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
    return f"what is said is of the members with a value; without one are: {_some(each)}"


def _together(pairs: Sequence[tuple[str, str]]) -> str:
    return (
        f"{_some([f'{one} and {other}' for one, other in pairs])} vary together: their shares of "
        "variance overlap and may add up to more than the whole"
    )


SENTENCES: dict[str, Wording] = {
    "members_chosen": (
        "the members are a {method} of chosen values: means, ranges and shares describe these "
        "members, not a probability"
    ),
    "too_few_for_fractions": lambda fewest, outputs: (
        f"fewer than {number_of(fewest, 'member')}: no shares of variance for {_outputs(outputs)}"
    ),
    "fractions_uncertain": lambda limit, outputs: (
        f"shares of variance are uncertain by more than {100 * limit:.0f} % of the variance for "
        f"{_outputs(outputs)}: take more members"
    ),
    "varied_together": _together,
    "fractions_above_one": "shares of variance add up to more than one by their errors",
    "values_missing": _missing,
    "events_not_located": (
        "in some responses a fold, peak or resonance is there but was not located: see "
        "n_not_located"
    ),
    "values_outside": _outside,
    "no_peak_in_range": _without_peak,
    "highest_at_range_end": (
        "{n_members:#member} with a response that is higher at an end of the range than at its "
        "highest peak (status highest_at_range_end): widen the range, or narrow it to leave the "
        "other resonance out"
    ),
    "peak_not_located": (
        "{n_members:#member} with a response whose peak is there but was not located (status "
        "peak_not_located), and which have no peak: take more harmonics"
    ),
    "rows_without_value": (
        "{output} has no value in {share:%.2g} of the rows: its indices are of the others alone"
    ),
    "first_order_wrong": (
        "first order is wrong for {quantity} by {error:%.0f}: its 95 % range is {first[0]:.6g} to "
        "{first[1]:.6g}, by second order {second[0]:.6g} to {second[1]:.6g}; it errs by 10 % from "
        "{limit:.2g} times this scatter on"
    ),
    "no_event_in_response": lambda event, low_hz, high_hz: (
        f"the nominal response has no {event.replace('_', ' ')} from {low_hz:.5g} to "
        f"{high_hz:.5g} Hz"
    ),
    "event_not_found_again": "{event} was not found again from the curve and is left out",
}
