"""Base of the computations for every member of a study, and their outputs."""

import abc
from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from snrmjax.model.modes import LinearModes
from snrmjax.model.structures import Structure
from snrmjax.numerics.rules import InputError

MEMBER = "member"
FORCE = "force_n"
TEXT = "text"
PEAK_SIDE = "peak_side"


class MemberStatus(StrEnum):
    """Status of a member, in addition to the names of `CurveStatus` in small letters."""

    SOLVED = "solved"
    ANSWERED = "answered"
    LARGEST_VELOCITY = "largest_velocity"  # was reached, as requested
    NO_PEAK = "no_peak_in_range"  # the response was computed; likewise for the next two
    HIGHEST_AT_END = "highest_at_range_end"
    PEAK_NOT_LOCATED = "peak_not_located"
    REFUSED = "refused"
    LOST = "lost"


COMPLETE = (
    *(MemberStatus.SOLVED, MemberStatus.ANSWERED, MemberStatus.LARGEST_VELOCITY),
    *("upper_end", "lower_end", "closed"),
)
"""Statuses of members with a complete result."""


class Failure(NamedTuple):
    """Why a member has no result; the store has both fields as one text."""

    status: MemberStatus
    reason: str

    def __str__(self) -> str:
        return f"{self.status}: {self.reason}"


def refusal(error: ValueError) -> Failure:
    """The failure of a refused member, with the first line of the error."""
    return Failure(MemberStatus.REFUSED, str(error).splitlines()[0])


class Output(NamedTuple):
    """One quantity of the store: its dimensions, kind, unit and meaning.

    The first dimension is `member`, or one of the ragged dimensions, along which every member has
    its own number of rows.
    """

    dimensions: tuple[str, ...]
    kind: str  # "f8", "i4", "i1" or "text"
    unit: str
    meaning: str
    at_sensor: bool = False  # whether it refers to one sensor


class Axis(NamedTuple):
    """A dimension whose values are the same for every member."""

    values: np.ndarray
    unit: str
    meaning: str


class Members(NamedTuple):
    """Some members of a study, in order."""

    models: Sequence[Structure]
    forces: Float[np.ndarray, "member force"] | None  # N, where `force_n` varies or is given
    seeds: Sequence[int]  # of each member's noise


class AbstractComputation(eqx.Module):
    """A kind of computation; `kind` is its name in study files."""

    kind: ClassVar[str]
    members_a_chunk: ClassVar[int]  # small enough to recompute, large enough for a file

    @abc.abstractmethod
    def outputs(self) -> dict[str, Output]:
        """The outputs of every member by name; `status` is how its computation ended."""

    @abc.abstractmethod
    def rows(self, members: Members) -> dict[str, np.ndarray]:
        """The outputs of some members, in order; a member that fails has its status and NaN."""

    def axes(self) -> dict[str, Axis]:
        """Dimensions other than `member` and `force_n`, with values common to all members."""
        return {}

    def sensor(self, modes: LinearModes) -> str | None:
        """The sensor of outputs at one sensor, the first one; None without such outputs."""
        at_sensor = any(output.at_sensor for output in self.outputs().values())
        return modes.sensors[0] if at_sensor else None


class OfForces(eqx.Module):
    """The forces of a study; every member is computed for all of them."""

    values: Float[np.ndarray, " force"] | None = None  # N; None: `force_n` varies

    @property
    def dimensions(self) -> tuple[str, ...]:
        """Dimensions of outputs with one value for every member and force."""
        several = self.values is not None and len(self.values) > 1
        return (MEMBER, FORCE) if several else (MEMBER,)

    def axes(self) -> dict[str, Axis]:
        """The forces, where there are several."""
        if self.values is None or len(self.values) < 2:
            return {}
        return {FORCE: Axis(self.values, "N", "force amplitude")}

    def of(self, members: Members) -> Float[np.ndarray, "member force"]:
        """The forces of each member."""
        if members.forces is not None:
            return members.forces
        return np.tile(np.asarray(self.values), (len(members.models), 1))

    def shaped(self, values: np.ndarray) -> np.ndarray:
        """Values of all members and forces, in the order of members, reshaped to `dimensions`."""
        if len(self.dimensions) == 1:
            return values
        return values.reshape(-1, len(np.asarray(self.values)), *values.shape[1:])


def of_forces(values: OfForces | Sequence[float] | np.ndarray | None) -> OfForces:
    """The forces of a study from their values in N."""
    if isinstance(values, OfForces):
        return values
    return OfForces(None if values is None else np.asarray(values, dtype=np.float64))


def blank_rows(outputs: dict[str, Output], sizes: dict[str, int], why: Failure) -> dict[str, Any]:
    """Rows of members without a result: status and NaN."""
    rows = {}
    for name, output in outputs.items():
        shape = tuple(sizes.get(dimension, 0) for dimension in output.dimensions)
        if output.kind == TEXT:
            rows[name] = np.full(shape, str(why) if name == "status" else "")
        else:
            rows[name] = np.full(shape, np.nan if output.kind == "f8" else 0, output.kind)
    return rows


def with_refused(
    computation: AbstractComputation,
    rows: dict[str, np.ndarray] | None,
    refused: Mapping[int, Failure],
) -> dict[str, np.ndarray]:
    """Rows of all members, including those without a result.

    Arguments: `rows` of the members with a result, in order, or None; `refused` are the others
    by their index among all.
    """
    outputs = computation.outputs()
    sizes = {name: len(axis.values) for name, axis in computation.axes().items()}
    blanks = [blank_rows(outputs, {MEMBER: 1, **sizes}, why) for why in refused.values()]
    whole = joined([*([] if rows is None else [rows]), *blanks])
    n = len(whole["status"])
    indices = [*(k for k in range(n) if k not in refused), *refused]
    order = np.argsort(indices)
    # Ragged outputs are already in order: refused members have no rows in them.
    of_members = {name for name, one in outputs.items() if one.dimensions[0] == MEMBER}
    return {name: v[order] if name in of_members else v for name, v in whole.items()}


def joined(parts: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Concatenated rows of members."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


class AbstractSingly(AbstractComputation):
    """Computation member by member; a refusal becomes the member's status."""

    @abc.abstractmethod
    def member(self, model: Structure, force: np.ndarray | None, seed: int) -> dict:
        """The rows of one member."""

    def rows(self, members: Members) -> dict[str, np.ndarray]:
        """The rows of all of them."""
        parts = []
        for k, model in enumerate(members.models):
            force = None if members.forces is None else members.forces[k]
            try:
                parts.append(self.member(jax.device_put(model), force, members.seeds[k]))
            except InputError as error:
                parts.append(with_refused(self, None, {0: refusal(error)}))
        return joined(parts)
