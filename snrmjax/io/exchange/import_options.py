"""The options of an import as a map, over that of a file."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from snrmjax.io.exchange.import_map import CHOICES, ImportMap, read_import_map, response_word
from snrmjax.io.files import shown, suggestion


def map_of_options(
    map_file: Path | None,
    response: Sequence[str],
    *,
    unit: str,
    sensor: Sequence[str],
    phase: Sequence[str],
    imaginary: Sequence[str],
    amplitude_std: Sequence[str] = (),
    phase_std: Sequence[str] = (),
    force_amplitude: Sequence[str],
    words: Mapping[str, str],
    over_force: bool,
    header_row: int,
) -> ImportMap:
    """The map that options and a file state; options win.

    Raises `ValueError` that names the option for words that are none of its choices, and for
    sensors and phases of another number than responses.
    """
    for key, word in words.items():
        if key in CHOICES and word not in CHOICES[key]:
            option, known = f"--{key.replace('_', '-')}", [one for one in CHOICES[key] if one]
            raise ValueError(
                f"{option} must be one of {', '.join(known)}, but is {shown(word)}"
                f"{suggestion(word, known)}."
            )
    base = ImportMap() if map_file is None else read_import_map(map_file)
    responses = tuple(response_word(word, unit) for word in response) or base.responses
    stated = [word for word in response if response_word(word).unit]
    if unit and stated:
        raise ValueError(
            f"--unit {unit} is of responses whose unit is not stated, but --response {stated[0]} "
            "states one: leave one of the two out."
        )
    if unit and not response:
        responses = tuple(one._replace(unit=unit) for one in responses)
    for option, key, given in (
        ("--sensor", "sensor", sensor),
        ("--phase", "phase", phase),
        ("--imaginary", "imaginary", imaginary),
        ("--amplitude-std", "amplitude_std", amplitude_std),
        ("--phase-std", "phase_std", phase_std),
    ):
        if given and len(given) != len(responses):
            raise ValueError(
                f"{option} must be given once for each of the {len(responses)} responses, but is "
                f"given {len(given)} times."
            )
        responses = (
            tuple(one._replace(**{key: word}) for one, word in zip(responses, given, strict=True))
            if given
            else responses
        )
    names = [one.sensor for one in responses if one.sensor]
    channels = [one.channel for one in responses]
    for what, listed in (("--sensor", names), ("--response", channels)):
        doubled = [name for name in listed if listed.count(name) > 1]
        if doubled:
            raise ValueError(f"{what} names {doubled[0]!r} twice.")
    options = ImportMap(
        force_amplitude=_amplitudes(force_amplitude), over_force=over_force, header_row=header_row
    )
    given_words: dict[str, Any] = dict(words)
    options = options._replace(**given_words)
    own = unit if not responses else ""  # of our own table, which has no responses to be named
    return options._replace(unit=own).over(base)._replace(responses=responses)


def _amplitudes(words: Sequence[str]) -> tuple[str, ...]:
    if list(words) == ["z"]:
        return ("z",)
    found = []
    for word in words:
        try:
            number = float(word)
        except ValueError:
            number = np.nan
        if not (np.isfinite(number) and number > 0):
            raise ValueError(
                f"--force-amplitude must be a positive number in N, or z alone, but is "
                f"{shown(word)}."
            )
        found.append(repr(number))
    return tuple(found)
