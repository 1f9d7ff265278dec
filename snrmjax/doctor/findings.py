"""What the doctor finds, and how it says it."""

from collections.abc import Sequence
from typing import ClassVar, Literal, NamedTuple, get_args

import equinox as eqx
import numpy as np

from snrmjax.numerics.result import AbstractResult, Variable

Severity = Literal["error", "warning", "info"]

Kind = Literal[
    "conjugated_response",
    "acceleration_as_velocity",
    "displacement_as_velocity",
    "volts_as_force",
    "rms_for_peak",
    "degrees_for_radians",
    "clipped_channel",
    "unsettled_steps",
    "force_dropout",
    "force_harmonics",
    "drift",
    "different_structures",
    "shape_not_mass_normalised",
    "missing_anti_alias",
    "wrong_unit",
]

KINDS: tuple[str, ...] = get_args(Kind)
"""Everything that a finding may be called."""

FORCE_HARMONICS: Kind = "force_harmonics"
"""Of the force that was measured; an effect of the model has this name, too."""


_MEANINGS = {
    "kind": "what is wrong",
    "severity": "error, warning or info",
    "where": "file, level, rows or channel",
    "evidence": "in numbers",
    "mend": "what mends it",
}


class Repair(NamedTuple):
    """How a table is read again, relative to how it was read: what options of an import say."""

    response: float = 1.0  # factor of the velocities
    force: float = 1.0  # likewise
    unit: str = ""  # of the responses, where a number of that unit was taken for one of another
    force_unit: str = ""  # likewise; V makes the force a drive voltage
    quantity: str = ""  # "acceleration" or "displacement" that was taken for a velocity
    conjugate: bool = False
    phase_unit: str = ""  # "deg" or "rad"


class Finding(NamedTuple):
    """One thing that is wrong with a test, or may be.

    `severity`: an "error" makes results wrong, a "warning" widens or bends them, an "info" is to
    be known. `rows` are states of the table (from 0) that show it, none where a record does.
    """

    kind: Kind
    severity: Severity
    where: str  # file, level, rows or channel
    evidence: str  # one fact in numbers
    mend: str  # the line or option that mends it
    rows: tuple[int, ...] = ()
    repairs: tuple[Repair, ...] = ()  # that an import can do, the likeliest first
    title: str = ""  # where the kind is wider than what was found

    @property
    def name(self) -> str:
        """What a reader is told first."""
        return self.title or self.kind.replace("_", " ")

    def as_dict(self) -> dict[str, str]:
        """What `check.json` has of it."""
        return {name: getattr(self, name) for name in _MEANINGS}


class Checkup(AbstractResult):
    """The findings of `check_test`, the gravest first; none where all is well.

    `notes` say what could not be looked at, and why.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("finding",)

    findings: tuple[Finding, ...] = eqx.field(static=True, default=())
    notes: tuple[str, ...] = eqx.field(static=True, default=())

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`."""
        n = len(self.findings)
        return (
            f"Checkup: {n} finding{'s' if n != 1 else ''}" if n else "Checkup: nothing found",
            *(line(one) for one in self.findings),
            *(f"note: {note}" for note in self.notes),
        )

    def variables(self) -> dict[str, Variable]:
        """See `AbstractResult`; a row a finding."""
        at = ("finding",)
        found = {"finding": Variable(at, np.arange(len(self.findings)), "1", "number")}
        for name, meaning in _MEANINGS.items():
            values = np.array([getattr(one, name) for one in self.findings], dtype=str)
            found[name] = Variable(at, values, "", meaning)
        return found

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of the findings."""
        return tuple(one.kind for one in self.findings)


def line(one: Finding) -> str:
    """A finding in one line."""
    return f"{one.severity}: {one.kind} in {one.where}: {one.evidence} Mend: {one.mend}"


def gravest_first(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Findings by severity, otherwise in their order."""
    ranks = get_args(Severity)
    return tuple(sorted(findings, key=lambda one: ranks.index(one.severity)))


def percent(share: float) -> str:
    """A share in per cent."""
    return f"{100 * share:.2g} %" if share < 0.995 else "100 % or more"


def rows_in_words(rows: Sequence[int], most: int = 6) -> str:
    """Rows as a table's reader counts them, from 1 below the header."""
    shown = ", ".join(str(k + 1) for k in rows[:most])
    return f"rows {shown}{' and others' if len(rows) > most else ''}"
