"""`diagnosis.json`: the results of a diagnosis for other programs."""

import math
from collections.abc import Sequence

from snrmjax.diagnose.design.discriminating_test import DiscriminatingTest
from snrmjax.diagnose.diagnosis_result import Diagnosis, DrawnLaw
from snrmjax.diagnose.location.where import Localisation
from snrmjax.diagnose.misfit.locating import Located
from snrmjax.diagnose.naming.parts import PartAnswer
from snrmjax.diagnose.response_prediction import LevelResponse
from snrmjax.diagnose.verdict import Verdict

_ALIKE = 0.05  # laws above this fraction of the best law's probability count as indistinguishable


def summarise_diagnosis(diagnosis: Diagnosis, predicted: Sequence[LevelResponse] = ()) -> dict:
    """A diagnosis as plain numbers and texts, in SI units; `predicted` are simulated resonances.

    `request` is the test of `decide_by` for programs: its `kind` (`harmonics` of the states of
    `level`, states `off_resonance` at it, a `lower_level` or `higher_level` whose velocities are
    those of `level` scaled, or a `calibration`), the force and frequency at resonance, how many
    `states` and how far off resonance in phase, the `harmonics` with the noise that they need, the
    `quantity` in which the models differ most, the expected gain of χ² over the
    closest rival and the gain needed; `calibration_too` if only a calibration separates some of
    the effects. With the verdict `drawn` there is a `law`: see `DrawnLaw`; of a
    damping that depends on the displacement `force_n` is the force at `at_velocity_m_s`, beyond
    `measured_up_to` (m) it is extrapolated, and `further` laws that are needed in addition
    have their own tables. `probability` is that of the answer given (of its verdict, or of the
    members of its classes), `probabilities` those of all answers considered. `tried` lists every
    fit compared, with its `status`.
    """
    gap = diagnosis.gap
    inner, outer = gap.interpolated, gap.extrapolated
    laws = [_law(law) for law in diagnosis.answer.laws]
    if laws[1:]:
        laws[0]["further"] = laws[1:]
    return {
        "verdict": diagnosis.verdict.value,
        "effects": list(diagnosis.effects),
        "candidates": [list(group) for group in diagnosis.candidates],
        "probabilities": diagnosis.probabilities,
        "probability": diagnosis.probability,
        **({"law": laws[0]} if laws else {}),
        "decide_by": diagnosis.decide_by,
        "request": _test(diagnosis.discriminating_test),
        "parts": [_by_part(part) for part in diagnosis.parts],
        "located": [_part(part) for part in diagnosis.located],
        "parameters": {
            name: {"value": value, "std": std}
            for name, (value, std) in diagnosis.parameters.items()
        },
        "gap": {
            "before": gap.before,
            "after": gap.after,
            "held_out_before": inner.before if inner else None,
            "held_out_after": inner.after if inner else None,
            "held_out_level": inner.level if inner else None,
            "noise_floor": 1.0,
            "top_level": outer.level if outer else None,
            "top_level_before": outer.before if outer else None,
            "top_level_after": outer.after if outer else None,
        },
        "detection_limits": diagnosis.detection_limits,
        "p_value": diagnosis.checks.p_value,
        "noise_scale": diagnosis.checks.noise_scale,
        "notes": list(diagnosis.notes),
        "resonances": [
            {
                "level": row.level,
                "force_n": row.force,
                "held_out": row.withheld,
                **{
                    f"{name}_{quantity}": value if math.isfinite(value) else None
                    for name in ("measured", "before", "after")
                    for quantity, value in zip(
                        ("frequency_hz", "velocity_m_s", "fold_hz"),
                        getattr(row, name)[:3],
                        strict=True,
                    )
                    if (name, quantity) != ("measured", "fold_hz")
                },
                "measured_jump_hz": row.measured.jump,
            }
            for row in predicted
        ],
        "tried": [
            {
                "effect": row.kind,
                "gain": row.gain if math.isfinite(row.gain) else None,
                "chi_square": row.chi_square if math.isfinite(row.chi_square) else None,
                "parameters": row.parameters,
                "status": row.status.value,
            }
            for row in diagnosis.table
        ],
    }


def _test(test: DiscriminatingTest | None) -> dict | None:
    if test is None:
        return None
    operating_point = test.operating_point
    return {
        "kind": test.kind,
        "level": operating_point.level if operating_point else None,
        "force_n": operating_point.force if operating_point else None,
        "frequency_hz": operating_point.frequency if operating_point else None,
        "quantity": test.quantity,
        "states": test.states,
        "phase_deg": list(test.phase) if test.phase else None,
        "harmonics": list(test.harmonics),
        "harmonic_std_m_s": test.harmonic_std,
        "expected_gain": test.expected_gain,
        "needed_gain": test.needed_gain,
        "settles": test.settles,
        "calibration_too": test.calibration_too,
    }


def _law(law: DrawnLaw) -> dict:
    table: dict = {
        "class": law.name,
        "displacement_m": law.at.tolist(),
        "force_n": law.force.tolist(),
        "force_std_n": law.force_std.tolist(),
        "measured_up_to": law.largest,
    }
    return table if law.passing is None else table | {"at_velocity_m_s": law.passing}


def remainder_columns(parts: Sequence[PartAnswer]) -> dict[str, list]:
    """The remainders of all parts as columns of a table: relative, with their 1σ."""
    columns: dict[str, list] = {"part": [], "velocity_m_s": [], "value": [], "std": []}
    for part in parts:
        if part.remainder is not None:
            remainder = part.remainder
            columns["part"] += [part.part] * len(remainder.velocity)
            columns["velocity_m_s"] += remainder.velocity.tolist()
            columns["value"] += remainder.value.tolist()
            columns["std"] += remainder.std.tolist()
    return columns


def _by_part(part: PartAnswer) -> dict:
    explained, remainder = part.explained, part.remainder
    return {
        "part": part.part,
        "verdict": part.verdict,
        "effects": list(part.effects),
        "candidates": [list(group) for group in part.candidates],
        "probability": part.probability,
        "explained": None if explained is None else explained._asdict(),
        "remainder": None
        if remainder is None
        else {"rms": remainder.rms, "significant": remainder.significant},
    }


def _part(part: Located) -> dict:
    return {
        "part": part.part,
        "velocity_range_m_s": list(part.velocity_range),
        "p_value": part.p_value,
    }


def summarise_localisation(localisation: Localisation) -> dict:
    """Where a force acts: locations with their probabilities, and the law at the most probable."""
    law = localisation.candidates[0].law
    return {
        "where": localisation.probabilities,
        "where_misfit": localisation.misfit,
        "where_fits": localisation.fits,
        "where_law": None if law is None else {"kind": law.kind, "parameters": law.parameters},
        "where_settled_by_sensor": None
        if localisation.is_determined
        else localisation.separating_sensor,
    }


def placed_answer(localisation: Localisation) -> dict:
    """The answer of a one-mode diagnosis that a law at an attachment point explains.

    Parameters are physical (N, m, kg), like those of an effect with `at`.
    """
    most_probable = localisation.candidates[0]
    law = most_probable.law
    if law is None:
        return {}
    fractions = {
        kind: most_probable.probability * fraction for kind, fraction in most_probable.laws.items()
    }
    alike = [
        kind for kind, fraction in fractions.items() if fraction > _ALIKE * fractions[law.kind]
    ]
    return {
        "verdict": Verdict.NAMED.value if len(alike) == 1 else Verdict.AMBIGUOUS.value,
        "effects": [law.kind],
        "candidates": [sorted(alike, key=lambda kind: -fractions[kind])],
        "probabilities": {**fractions, "elsewhere": 1 - most_probable.probability},
        "probability": sum(fractions[kind] for kind in alike),
        "decide_by": None,
        "parameters": {
            f"{law.kind}.{name}": {"value": value, "std": law.std[name]}
            for name, value in law.parameters.items()
        },
    }
