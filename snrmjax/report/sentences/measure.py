"""Sentences of measured states and records."""

from collections.abc import Iterable

from snrmjax.report.sentences import Wording, number_of

_SHIFTS = {1: "shifted by +90°", -1: "shifted by -90°", 2: "shifted by 180°"}
_CONJUGATED = (
    "the phases rise through resonance, where those of a velocity relative to the force fall: the "
    "phasors seem to be conjugated (time dependence e^(-iΩt)); change the sign of "
    "`velocity_im_m_s`, or import again with the other `--phase-sign`"
)
_QUARTERS = {
    (1, ""): "shift the phases by +90°, or multiply the phasors by iΩ if they are displacements",
    (1, "displacement"): "displacements seem to be given as velocities; multiply the phasors by iΩ",
    (-1, ""): "shift the phases by -90°, or divide the phasors by iΩ if they are accelerations",
    (-1, "acceleration"): "accelerations seem to be given as velocities; divide the phasors by iΩ",
}


def _misread(
    conjugated: bool,
    quarter_turns: int,
    instead: str,
    same_sign: bool,
    as_given: float,
    read_so: float,
) -> str:
    clauses = [_CONJUGATED] if conjugated else []
    if quarter_turns == 2:
        motion, sign = ("against", "positive") if same_sign else ("with", "negative")
        clauses.append(
            f"at resonance the velocity is {motion} the force where the model's `shape` times "
            f"`participation` is {sign}: the sensor, the force or the model seems to have the "
            "wrong sign; shift the phases by 180°, or change that sign"
        )
    elif quarter_turns:
        side = "behind" if quarter_turns == 1 else "ahead of"
        clauses.append(
            f"the phases are 90° {side} those of a velocity: {_QUARTERS[quarter_turns, instead]}"
        )
    return "; after that, ".join(clauses) + "." + _misses(as_given, read_so)


def _alike(readings: Iterable[tuple[bool, int]], as_given: float, read_so: float) -> str:
    changes = " or ".join(
        " and then ".join(["conjugated"] * conjugated + [_SHIFTS[quarters]] * bool(quarters))
        for conjugated, quarters in readings
    )
    return (
        f"the phases are not those of a velocity relative to the force, but would be if {changes}, "
        "which states at resonance or on one side of it cannot distinguish."
        + _misses(as_given, read_so)
    )


def _misses(as_given: float, read_so: float) -> str:
    return (
        f" (Residual of a single mode: {100 * as_given:.0f} % as recorded, {100 * read_so:.2g} % "
        "with this corrected.)"
    )


_LEVELS_BY = {
    "drive": "by amplitude of the drive",
    "force": "by amplitude of the force",
    "runs": "by frequency runs: the force within a run is not constant",
}


def _steps_used(used: int, left_out: Iterable[tuple[str, int]]) -> str:
    reasons = ", ".join(f"{count} {reason}" for reason, count in left_out)
    steps = f"{used} of {used + sum(count for _, count in left_out)} steps used"
    return f"{steps}; left out: {reasons}" if reasons else steps


def _sweep_bias(sweeps: int, shift_hz: float, lowest: float, removed: bool) -> str:
    return (
        f"each of {sweeps} sweeps shifts the peak by up to {shift_hz:.2g} Hz and lowers "
        f"it to {100 * lowest:.4g} %: {'' if removed else 'not '}corrected"
    )


SENTENCES: dict[str, Wording] = {
    "phases_misread": _misread,
    "phases_misread_alike": _alike,
    "velocity_over_force_off": (
        "velocity over force is {ratio:.3g} times that of a mode with the model's `shape` times "
        "`participation`: the force is probably not in newtons (a drive voltage belongs in "
        "`drive_v`), the velocity not in m/s, or the modal mass is wrong. Correct that or free the "
        "force gain; until then the damping is meaningless. (Residual of a single mode: "
        "{as_given:%.0f} with the model's modal mass, {with_own_mass:%.2g} with a fitted one.)"
    ),
    "levels_numbered": lambda by: f"levels {_LEVELS_BY[by]}",
    "levels_counted": lambda n, by: f"{number_of(n, 'level')} {_LEVELS_BY[by]}",
    "steps_used": _steps_used,
    "sweep_bias": _sweep_bias,
    "sweep_bias_unknown": (
        "too few states near resonance: the bias of the sweep is not corrected, but is within the "
        "stated errors"
    ),
    "moments_left_out": "{count} left out: {status.message}",
}
