"""Findings of the doctor: kinds, severities, and corrections by an import."""

from collections.abc import Sequence
from typing import ClassVar, Literal, NamedTuple, get_args

import equinox as eqx
import numpy as np

from snrmjax.numerics.facts import Fact
from snrmjax.numerics.result import AbstractResult, Variable, setting

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
    "motion_of_base",
]

KINDS: tuple[str, ...] = get_args(Kind)
"""All kinds of findings."""

FORCE_HARMONICS: Kind = "force_harmonics"
"""Harmonics of the measured force; an effect of the model has the same name."""

SEVERITIES: dict[str, Severity] = {
    **dict.fromkeys(KINDS, "error"),
    **dict.fromkeys((FORCE_HARMONICS, "force_dropout", "drift", "missing_anti_alias"), "warning"),
}
"""Severity of each kind: an "error" makes results wrong, a "warning" widens or biases them, an
"info" is for information."""

_MEANINGS = {
    "kind": "what is wrong",
    "severity": "error, warning or info",
    "where": "file, level, rows or channel",
    "evidence": "in numbers",
    "mend": "the remedy",
}


class ImportCorrection(NamedTuple):
    """Corrections of an import, relative to the present table, as options of an import."""

    response: float = 1.0  # factor of the velocities
    force: float = 1.0  # likewise
    unit: str = ""  # true unit of the responses, where it was mistaken
    force_unit: str = ""  # likewise; V makes the force a drive voltage
    quantity: str = ""  # "acceleration" or "displacement" imported as a velocity
    conjugate: bool = False
    phase_unit: str = ""  # "deg" or "rad"


class Finding(NamedTuple):
    """One definite or possible error of a test.

    `rows` are the affected states of the table (from 0), none for a record.
    """

    kind: Kind
    where: str  # file, level, rows or channel
    evidence: Fact | str
    advice: Fact | str  # the line or option that corrects it
    rows: tuple[int, ...] = ()
    corrections: tuple[ImportCorrection, ...] = ()  # possible at import, the most likely first
    title: Fact | None = None  # where the kind is more general than the finding
    unsure: bool = False  # another explanation exists: a warning then

    @property
    def severity(self) -> Severity:
        """That of its kind, see `SEVERITIES`."""
        return "warning" if self.unsure else SEVERITIES[self.kind]

    @property
    def name(self) -> str:
        """Title in a report."""
        return str(self.title or self.kind.replace("_", " "))

    def as_dict(self) -> dict[str, str]:
        """Entry in `check.json`."""
        columns = (self.kind, self.severity, self.where, str(self.evidence), str(self.advice))
        return dict(zip(_MEANINGS, columns, strict=True))


class Checkup(AbstractResult):
    """The findings of `check_test`, the most severe first; none where all is well.

    `notes` state what could not be checked, and why.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("finding",)

    findings: tuple[Finding, ...] = eqx.field(static=True, default=())
    notes: tuple[Fact, ...] = setting(default=())

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`."""
        n, line = len(self.findings), "{severity}: {kind} in {where}: {evidence} Mend: {mend}"
        return (
            f"Checkup: {n} finding{'s' if n != 1 else ''}" if n else "Checkup: nothing found",
            *(line.format(**finding.as_dict()) for finding in self.findings),
            *(f"note: {note}" for note in self.notes),
        )

    def variables(self) -> dict[str, Variable]:
        """See `AbstractResult`; one row per finding."""
        at, rows = ("finding",), [finding.as_dict() for finding in self.findings]
        number = Variable(at, np.arange(len(rows)), "1", "number")
        return {"finding": number} | {
            name: Variable(at, np.array([one[name] for one in rows], dtype=str), "", meaning)
            for name, meaning in _MEANINGS.items()
        }

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of the findings."""
        return tuple(finding.kind for finding in self.findings)


def gravest_first(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Findings by severity, otherwise in their order; one of each kind and location."""
    ranks = get_args(Severity)
    once: dict[tuple[str, str], Finding] = {}
    for one in findings:
        once.setdefault((one.kind, one.where), one)
    return tuple(sorted(once.values(), key=lambda one: ranks.index(one.severity)))
