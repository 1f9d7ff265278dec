"""Access to the cache of compiled programs on disk, implemented by `snrmjax.io.programs`."""

from collections.abc import Callable
from typing import Any, Protocol

import jax


class NotKept(Exception):
    """A program depends on code outside this package and is not cached."""


class ProgramKeeper(Protocol):
    """A cache of compiled programs: looks them up, or has them compiled and stores them."""

    def in_use(self) -> bool:
        """Whether programs are cached under the current settings of JAX."""

    def program(
        self,
        function: Callable[..., Any],
        arguments: Any,
        settings: tuple,
        build: Callable[[], tuple[jax.stages.Lowered, Any]],
    ) -> tuple[Callable[..., list[jax.Array]], Any]:
        """The program of flat arrays for a function's arguments, and the structure of its results.

        Arguments: `settings` of the compiler; `build` lowers the program, under a unique name,
        if it is not in the cache.
        Raises `NotKept` if no unique key can be made for it.
        """


class _Registered:
    keeper: ProgramKeeper | None = None
    closed = False


def keep_programs_with(keeper: ProgramKeeper) -> None:
    """Cache programs from here on, unless code from outside is registered in the package."""
    _Registered.keeper = None if _Registered.closed else keeper


def keep_no_programs() -> None:
    """Stop caching for good: code from outside is registered in the package."""
    _Registered.closed, _Registered.keeper = True, None


def program_keeper() -> ProgramKeeper | None:
    """The cache of programs, if it is in use now."""
    keeper = _Registered.keeper
    return keeper if keeper is not None and keeper.in_use() else None
