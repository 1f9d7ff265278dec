"""Findings of a check: check.json and the printed lines."""

from pathlib import Path

from snrmjax.doctor.findings import Checkup
from snrmjax.io.laboratory.checkups import write_checkup


def write(folder: Path, found: Checkup) -> None:
    """Write check.json, a list that is empty when all is well."""
    write_checkup(folder / "check.json", found)


def headline(found: Checkup) -> list[str]:
    """Each finding with its evidence and remedy."""
    lines = []
    for finding in found.findings:
        lines.append(f"{finding.severity}: {finding.kind} in {finding.where}: {finding.evidence}")
        lines.append(f"  remedy: {finding.advice}")
    return lines or ["nothing found"]
