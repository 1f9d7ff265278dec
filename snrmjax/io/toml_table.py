"""Tables of a TOML file, with errors that name file, table, key, value and expectation."""

import tomllib
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from snrmjax.io.files import shown
from snrmjax.numerics.names import suggestion
from snrmjax.numerics.rules import InputError, Rule


def parsed_toml(text: str, file: str) -> "TomlTable":
    """The top-level table of a TOML file. Raises `ValueError` that names an invalid file."""
    try:
        return TomlTable(tomllib.loads(text), file)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{file} is not valid TOML: {error}.") from error
    except ValueError as error:  # Python's limit on the digits of an integer
        raise InputError(f"{file} has a number of too many digits.") from error
    except RecursionError as error:
        raise InputError(f"{file} is not valid TOML: it nests too deeply.") from error


_MOST_LISTED = 8  # keys in a message


class TomlTable(NamedTuple):
    """A table of a file, with its location for messages."""

    entries: Mapping[str, object]
    location: str

    def refusal(self, key: str, expected: str, value: object) -> InputError:
        """The error for one value."""
        return InputError(f"`{key}` must be {expected}, but {self.location} has {shown(value)}.")

    def check_keys(self, required: Iterable[str], optional: Iterable[str] = ()) -> None:
        """Refuse unknown keys and missing required ones."""
        required = tuple(required)
        missing = [key for key in required if key not in self.entries]
        known = (*required, *optional)
        for key in self.entries:
            if key not in known:
                near = suggestion(key, missing) or suggestion(key, known)
                if not near and known and len(known) <= _MOST_LISTED:
                    near = f": it may have {', '.join(known)}"
                raise InputError(f"{self.location} has the unknown key {shown(key)}{near}.")
        if missing:
            raise InputError(f"{self.location} lacks the key `{missing[0]}`.")

    def number(self, key: str, *rules: Rule, default: float | None = None) -> float:
        """A finite number that satisfies the rules."""
        if default is not None and key not in self.entries:
            return default
        value = self.entries[key]
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.refusal(key, "a number", value)
        if not abs(value) < float("inf") or (isinstance(value, int) and abs(value) > 10**300):
            raise self.refusal(key, "a finite number", value)
        for rule in rules:
            if not rule.good(value):
                raise self.refusal(key, rule.expected, value)
        return float(value)

    def numbers(
        self, key: str, *rules: Rule, each: str = "knot", count: int | None = None
    ) -> list[float]:
        """A list of finite numbers that satisfy the rules; messages call one of them `each`."""
        value = self.entries[key]
        if not isinstance(value, list):
            raise self.refusal(key, "a list of numbers", value)
        if count is not None and len(value) != count:
            raise self.refusal(key, f"{count} numbers, one a {each}", value)
        return [
            TomlTable({key: number}, f"{self.location}, {each} {k},").number(key, *rules)
            for k, number in enumerate(value, 1)
        ]

    def mode_numbers(self, key: str) -> tuple[int, ...]:
        """A list of different mode numbers, counted from one."""
        value = self.entries[key]
        if not isinstance(value, list) or not value:
            raise self.refusal(key, "a list of mode numbers, at least one", value)
        entries = (
            TomlTable({key: number}, f"{self.location}, entry {k},")
            for k, number in enumerate(value, 1)
        )
        numbers = tuple(entry.whole(key, 1) for entry in entries)
        if len(set(numbers)) < len(numbers):
            raise self.refusal(key, "different mode numbers", value)
        return numbers

    def numbers_of_modes(self, key: str, count: int, *rules: Rule) -> list[float] | None:
        """A number for each mode, or one for all; None where not stated."""
        if key not in self.entries:
            return None
        if isinstance(self.entries[key], list):
            return self.numbers(key, *rules, each="mode", count=count)
        return [self.number(key, *rules)] * count

    def text(self, key: str, default: str | None = None) -> str:
        """A text."""
        value = self.entries.get(key, default)
        if not isinstance(value, str):
            raise self.refusal(key, "a text", value)
        return value

    def whole(self, key: str, at_least: int, default: int | None = None) -> int:
        """A whole number that is not below `at_least`."""
        value = self.entries.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int) or value < at_least:
            raise self.refusal(key, f"a whole number from {at_least} on", value)
        return value

    def choice(self, key: str, known: Iterable[str], default: str | None = None) -> str:
        """One of the known texts."""
        known, value = tuple(known), self.text(key, default)
        if value not in known:
            near = suggestion(value, known)
            if near:
                raise InputError(f"{self.location} has the unknown `{key}` {shown(value)}{near}.")
            raise self.refusal(key, f"one of {', '.join(known)}", value)
        return value

    def table(self, key: str, location: str) -> "TomlTable":
        """A table inside this one."""
        value = self.entries.get(key, {})
        if not isinstance(value, dict):
            raise self.refusal(key, "a table", value)
        return TomlTable(value, location)

    def tables(self, key: str, file: str) -> list["TomlTable"]:
        """A list of tables at the top of a file."""
        value = self.entries.get(key, [])
        if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
            given = f"[{key}]" if isinstance(value, dict) else shown(value)
            raise InputError(f"`{key}` must be tables under [[{key}]], but {file} has {given}.")
        return [TomlTable(entry, f"{key} {k + 1} of {file}") for k, entry in enumerate(value)]
