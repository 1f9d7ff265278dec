"""The flat beam's four-mode reduced-order model: its published numbers, read from the project.

Only numbers are taken; the equations are integrated by this benchmark's own code.
"""

import ast
from pathlib import Path
from typing import NamedTuple

NUMBERS = Path(__file__).resolve().parents[2] / "snrmjax" / "model" / "builders" / "beams.py"


class Beam(NamedTuple):
    """Linear modes, potential by the modes of the monomial, and the backbone's cubic stiffness."""

    frequency_hz: tuple[float, ...]
    damping_ratio: tuple[float, ...]
    shape: tuple[float, ...]  # midspan, kg^-1/2
    participation: tuple[float, ...]  # kg^-1/2
    potential: dict[str, float]
    condensed_cubic: float  # of mode 1 with the others following, 1/(kg m² s²)


def _literal(name: str) -> dict[str, float]:
    for node in ast.parse(NUMBERS.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and any(
            isinstance(target, ast.Name) and target.id == name for target in node.targets
        ):
            return ast.literal_eval(node.value)
    raise ValueError(f"{NUMBERS.name} has no `{name}`.")


FLAT_BEAM = Beam(
    frequency_hz=(79.02, 427.46, 1057.30, 1970.70),
    damping_ratio=(0.05, 0.0009, 0.0008, 0.0006),
    shape=(11.84338, -10.48504, 10.54894, 10.54619),
    participation=(247.841, 108.510, 69.055, -50.640),
    potential=_literal("_FLAT_POTENTIAL"),
    # The published response peaks at 0.762 m/s near 96.65 Hz.
    condensed_cubic=1.45e13,
)
