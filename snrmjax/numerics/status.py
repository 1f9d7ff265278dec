"""How a computation ended: statuses, each with a message and advice on what to try."""

from enum import IntEnum


class Status(IntEnum):
    """Base of statuses: a member is an integer, as arrays hold it, with a `message`.

    >>> class SolverStatus(Status):
    ...     CONVERGED = 0, "converged"
    ...     STEP_LIMIT = 1, "not converged: raise `max_steps`"
    >>> SolverStatus(1).message
    'not converged: raise `max_steps`'
    """

    message: str

    def __new__(cls, value: int, message: str = "") -> "Status":
        """A member from its number and its message."""
        member = int.__new__(cls, value)
        member._value_ = value
        member.message = message
        return member
