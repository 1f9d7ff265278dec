"""Names: suggestions for misspelt ones in error messages, and aliases of former public ones."""

import difflib
import functools
import importlib
import sys
import warnings
from collections.abc import Callable, Iterable, Mapping
from types import FrameType
from typing import Any, TypeVar, cast

C = TypeVar("C", bound=type)
F = TypeVar("F", bound=Callable[..., Any])

_WITHIN = ("snrmjax", "equinox", "abc")


def near_miss(name: str, known: Iterable[str], cutoff: float = 0.6) -> str | None:
    """The known name most similar to a given one, ignoring case, or None.

    Arguments: `cutoff` is the least similarity of difflib, from 0 to 1.

    >>> near_miss("Freq_hz", ["level", "frequency_hz"])
    'frequency_hz'
    """
    folded = {other.casefold(): other for other in known}
    near = difflib.get_close_matches(name.casefold(), folded, n=1, cutoff=cutoff)
    return folded[near[0]] if near else None


def suggestion(name: str, known: Iterable[str], cutoff: float = 0.6) -> str:
    """The most similar known name as the end of an error message, or an empty string.

    >>> suggestion("dampin_ratio", ["damping_ratio", "shape"])
    ' (did you mean `damping_ratio`?)'
    """
    near = near_miss(name, known, cutoff)
    return "" if near is None else f" (did you mean `{near}`?)"


def with_retired_names(
    package: str, current: Callable[[str], Any], names: Mapping[str, str]
) -> Callable[[str], Any]:
    """The `__getattr__` of a package, with `names` from former to present ones.

    A former name gives the present object with a `DeprecationWarning`. A present name with dots is
    in another package.
    """

    def attribute(name: str) -> Any:
        if name not in names:
            return current(name)
        elsewhere, _, present = names[name].rpartition(".")
        _warn(f"{package}.{name}", f"{elsewhere or package}.{present}")
        if elsewhere:
            return getattr(importlib.import_module(elsewhere), present)
        return current(present)

    return attribute


def with_former_attributes(names: Mapping[str, str]) -> Callable[[C], C]:
    """A decorator of classes, with `names` from former to present attributes."""

    def decorate(cls: C) -> C:
        for former, present in names.items():

            def value(self: Any, former: str = former, present: str = present) -> Any:
                _warn(f"{cls.__name__}.{former}", f"{cls.__name__}.{present}")
                return getattr(self, present)

            setattr(cls, former, property(value))
        return cls

    return decorate


def with_former_arguments(names: Mapping[str, str]) -> Callable[[F], F]:
    """A decorator of functions, with `names` from former to present keyword arguments."""

    def decorate(function: F) -> F:
        @functools.wraps(function)
        def called(*arguments: Any, **settings: Any) -> Any:
            for former in names.keys() & settings.keys():
                _warn(f"`{former}` of {function.__name__}", f"`{names[former]}`")
                settings[names[former]] = settings.pop(former)
            return function(*arguments, **settings)

        return cast(F, called)

    return decorate


def take_former(cls: type, names: Mapping[str, str]) -> None:
    """Class attributes of a user's class under their present names, from `names` of former ones."""
    for former in names.keys() & vars(cls).keys():
        _warn(f"{cls.__name__}.{former}", f"{cls.__name__}.{names[former]}")
        setattr(cls, names[former], vars(cls)[former])


def _warn(former: str, present: str) -> None:
    """Warn the user's line, outside of this package and of Equinox, that a name is a former one."""
    frame: FrameType | None = sys._getframe(1)
    level = 2
    while frame is not None and frame.f_globals.get("__name__", "").split(".")[0] in _WITHIN:
        frame, level = frame.f_back, level + 1
    warnings.warn(
        f"{former} is now {present}: the former name goes in the next release.",
        DeprecationWarning,
        stacklevel=level - 1,
    )
