"""The options of an import as a map, over that of a file."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from snrmjax.io.exchange.import_map import (
    KEYS,
    RESPONSE_KEYS,
    ImportMap,
    read_import_map,
    response_word,
)
from snrmjax.io.files import shown, suggestion


def map_of_options(map_file: Path | None, given: Mapping[str, Any]) -> ImportMap:
    """The map that options and a file state; options win.

    Arguments: `given` has the options by the keys of a map, `response` as for `response_word`;
    what is empty was not given.
    Raises `ValueError` that names the option for words that are none of its choices, and for
    sensors and phases of another number than responses.
    """
    words = {key: given[key] for key in KEYS if given.get(key)}
    for key, word in words.items():
        choices = KEYS[key].choices
        if choices and word not in choices:
            raise ValueError(
                f"{_option(key)} must be one of {', '.join(choices)}, but is {shown(word)}"
                f"{suggestion(word, choices)}."
            )
    if "force_amplitude" in words:
        words["force_amplitude"] = _amplitudes(words["force_amplitude"])
    base = ImportMap() if map_file is None else read_import_map(map_file)
    unit, response = words.pop("unit", ""), given.get("response") or ()
    responses = tuple(response_word(word, unit) for word in response) or base.responses
    stated = [word for word in response if response_word(word).unit]
    if unit and stated:
        raise ValueError(
            f"--unit {unit} is of responses whose unit is not stated, but --response {stated[0]} "
            "states one: leave one of the two out."
        )
    if unit and not response:
        responses = tuple(one._replace(unit=unit) for one in responses)
    for key in RESPONSE_KEYS:
        each = given.get(key) or ()
        if each and len(each) != len(responses):
            raise ValueError(
                f"{_option(key)} must be given once for each of the {len(responses)} responses, "
                f"but is given {len(each)} times."
            )
        if each:
            pairs = zip(responses, each, strict=True)
            responses = tuple(one._replace(**{key: word}) for one, word in pairs)
    names = [one.sensor for one in responses if one.sensor]
    for what, listed in (("--sensor", names), ("--response", [one.channel for one in responses])):
        doubled = [name for name in listed if listed.count(name) > 1]
        if doubled:
            raise ValueError(f"{what} names {doubled[0]!r} twice.")
    if unit and not responses:  # of our own table, which has no responses to be named
        words["unit"] = unit
    return base._replace(**words, responses=responses)


def _option(key: str) -> str:
    return f"--{key.replace('_', '-')}"


def _amplitudes(words: Sequence[str]) -> tuple[str, ...]:
    if list(words) == ["z"]:
        return ("z",)
    found = []
    for word in words:
        try:
            number = float(word)
        except ValueError:
            number = 0.0
        if not 0 < number < float("inf"):
            raise ValueError(
                f"--force-amplitude must be a positive number in N, or z alone, but is "
                f"{shown(word)}."
            )
        found.append(repr(number))
    return tuple(found)
