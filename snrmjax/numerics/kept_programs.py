"""The one door to programs that are kept on disk; `snrmjax.io.programs` stands behind it."""

from collections.abc import Callable
from typing import Any, Protocol

import jax


class NotKept(Exception):
    """A program depends on code that is not this package's."""


class ProgramKeeper(Protocol):
    """Finds whole programs, or has them compiled and keeps them."""

    def in_use(self) -> bool:
        """Whether programs are kept under the settings of JAX that rule now."""

    def program(
        self,
        function: Callable[..., Any],
        arguments: Any,
        settings: tuple,
        build: Callable[[], tuple[jax.stages.Lowered, Any]],
    ) -> tuple[Callable[..., list[jax.Array]], Any]:
        """The program of flat arrays for a function's arguments, and a tree like its results.

        Arguments: `settings` of the compiler; `build` lowers the program where none is kept,
        under a name that no other has.
        Raises `NotKept` where it could not be told from another.
        """


class _Door:
    keeper: ProgramKeeper | None = None
    closed = False


def keep_programs_with(keeper: ProgramKeeper) -> None:
    """Have programs kept from here on, unless the package has code of others in it."""
    _Door.keeper = None if _Door.closed else keeper


def keep_no_programs() -> None:
    """From here on the package does what it does with code of others in it."""
    _Door.closed, _Door.keeper = True, None


def program_keeper() -> ProgramKeeper | None:
    """Who keeps programs, if they are kept now."""
    keeper = _Door.keeper
    return keeper if keeper is not None and keeper.in_use() else None
