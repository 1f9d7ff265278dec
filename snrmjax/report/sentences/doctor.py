"""Sentences of the doctor: findings in tables, models and records, and their remedies."""

from collections.abc import Callable, Sequence

from snrmjax.report.sentences import Wording, enumerated

_Unit = tuple[str, str, str]  # column, unit of its numbers, unit they were read as

_ROWS = 6  # that are listed
_SIGN = "import again with the other phase sign, or negate `velocity_im_m_s`."
_RESPONSES = {
    "opposite": "of opposite sign: the shape, the sensor or the force is reversed",
    "conjugated": "complex conjugates",
    "conjugated_opposite": "complex conjugates of opposite sign",
    "acceleration": "accelerations (m/s²)",
    "displacement": "displacements (m)",
    "radians_as_degrees": "phases in radians read as degrees",
    "degrees_as_radians": "phases in degrees read as radians",
    "base_left_in": "absolute: the motion of the base was not subtracted",
    "base_taken_away_twice": "already relative to the base: its motion was subtracted twice",
    "sizes_of_acceleration": "amplitudes of accelerations (m/s²) with the phases of velocities",
    "sizes_of_displacement": "amplitudes of displacements (m) with the phases of velocities",
}
_ADVICE_ON_RESPONSES = {
    "opposite": "negate this sensor's entry of `shape` in the model, or both velocity columns.",
    "conjugated": _SIGN,
    "conjugated_opposite": "negate `velocity_re_m_s`; or import again with the other phase sign, "
    "and reverse the sensor's.",
    "acceleration": "divide by iΩ: import again as accelerations.",
    "displacement": "multiply by iΩ: import again as displacements.",
    "radians_as_degrees": "import again with phases in radians.",
    "degrees_as_radians": "import again with phases in degrees.",
    "base_left_in": 'set `motion = "absolute"` in the [base] of the model.',
    "base_taken_away_twice": 'set `motion = "relative"` in the [base] of the model.',
    "sizes_of_acceleration": "divide the amplitudes by Ω = 2πf in the laboratory's "
    "file; the phases are right.",
    "sizes_of_displacement": "multiply the amplitudes by Ω = 2πf in the laboratory's "
    "file; the phases are right.",
}


def _percent(fraction: float) -> str:
    return f"{100 * fraction:.2g} %" if fraction < 0.995 else "100 % or more"


def _rows(rows: Sequence[int]) -> str:
    """Rows as the user counts them, from 1 below the header."""
    shown = ", ".join(str(k + 1) for k in rows[:_ROWS])
    return f"rows {shown}{' and others' if len(rows) > _ROWS else ''}"


def _with_residuals(evidence: Callable[..., str]) -> Callable[..., str]:
    """The evidence, and the residual of a single mode with the error corrected and as recorded."""

    def both(*, misfit: float, misfit_before: float, **values: object) -> str:
        fit = f"fits a state to {_percent(misfit)}, as recorded to {_percent(misfit_before)}"
        return f"{evidence(**values)}; with this corrected a single mode {fit}."

    return both


def _misread(*, reading: str, misfit: float, misfit_as_recorded: float | None) -> str:
    as_recorded = "as recorded the mode would gain energy"
    if misfit_as_recorded is not None:
        as_recorded = f"as recorded to {_percent(misfit_as_recorded)}"
    return (
        f"the responses appear to be {_RESPONSES[reading]}; with this corrected a single mode fits "
        f"a state to {_percent(misfit)}, {as_recorded}."
    )


def _scale(*, ratio: float, ratio_std: float, misfit: float, misfit_as_modelled: float) -> str:
    return (
        f"{_mass_ratio(ratio, ratio_std)} (residual {_percent(misfit)}, with the model's own "
        f"{_percent(misfit_as_modelled)})"
    )


def _mass_ratio(ratio: float, ratio_std: float) -> str:
    return f"the states give {ratio:.4g} ± {ratio_std:.1g} times the model's modal mass"


def _rms(*, scale: object, column: str) -> str:
    factor, whose = ("√2", "responses") if column == "response" else ("1/√2", "forces")
    return f"{scale}, a factor of {factor}: {whose} are rms, not peak."


def _units(*, ratio: float, ratio_std: float, factor: float, units: Sequence[_Unit]) -> str:
    words = [f"the {column} in {unit} read as {read_as}" for column, unit, read_as in units]
    return (
        f"{_mass_ratio(ratio, ratio_std)}, close to the factor {factor:.4g} of "
        f"{', or '.join(words)}."
    )


def _import_units(*, units: Sequence[_Unit]) -> str:
    return f"import again with {', or '.join(f'{column}s in {unit}' for column, unit, _ in units)}."


def _level_gains(*, gains: Sequence[tuple[int, int | None, float]]) -> str:
    named = [
        f"the force of level {level}{f' (file {file})' if file else ''} is {gain:.3g} times"
        for level, file, gain in gains
    ]
    return f"{' and '.join(named)} the value consistent with the other levels"


def _advice_on_level_gains(*, gains: Sequence[tuple[int, int | None, float]]) -> str:
    numbers = [f"level {level} by {gain:.3g}" for level, _, gain in gains]
    return (
        "if the column is a voltage, measure the force; else the range or calibration was changed "
        f"there: divide the force of {' and of '.join(numbers)} in the source file."
    )


def _clipped_states(*, column: str, limit: float, rows: Sequence[int]) -> str:
    unit = "N" if column == "force" else "m/s"
    return (
        f"the {column} is clipped at about {limit:.4g} {unit} in {len(rows)} states ({_rows(rows)})"
    )


def _far(*, quantities: Sequence[str], lowest: Sequence[float], linear: Sequence[float]) -> str:
    measured, model = (f"{hz:.5g} Hz and {100 * ratio:.3g} %" for hz, ratio in (lowest, linear))
    return (
        f"{' and '.join(quantities)} at small amplitude "
        f"{'differ' if len(quantities) > 1 else 'differs'} from the linear mode: the lowest level "
        f"has {measured}, the model {model}. Select the mode by `mode_of_interest`, or identify "
        "the linear modes of this assembly by `snrmjax modes`."
    )


SENTENCES: dict[str, Wording] = {
    # What could not be checked.
    "no_table": "no table of steady states: columns and scales were not checked.",
    "no_model": "no model: the scale of force, response and shape was not checked.",
    "too_few_states": (
        "{n_states} states with force and phase at {sensor} are too few to check: {needed} are "
        "needed."
    ),
    "drive_not_scaled": "the force is declared as a drive voltage: its scale was not checked.",
    "record_cut": "{record}: only the first {n_samples} samples were checked.",
    "record_without_force": (
        "{record}: no channel is a force or a voltage: no steps were identified."
    ),
    "record_without_tone": "{record}: {error}",
    "record_without_steps": "{record}: no step of four cycles was recognised.",
    # Columns with another quantity or unit, and a wrong modal mass.
    "misread": _misread,
    "advice_reading": lambda *, reading: _ADVICE_ON_RESPONSES[reading],
    "other_scale": _scale,
    "rms": _rms,
    "advice_rms": lambda *, column: (
        f"multiply the {'velocity columns' if column == 'response' else '`force_n`'} by √2 = "
        "1.41421."
    ),
    "mixed_units": _units,
    "advice_units": _import_units,
    "if_units_are_right": "if the units are correct",
    "voltage_for_force": (
        "{scale}: the force column may be a drive voltage of {gain:.3g} V per N."
    ),
    "advice_voltage": (
        "if it is a voltage, name the column `drive_v` and let the identification estimate its "
        "gain."
    ),
    "shape_scale": "{scale}: the shape of the model may not be mass-normalised.",
    "advice_shape": (
        "if so, divide `shape` and `participation` of the model by {factor:.4g} each, or identify "
        "the modes again, scaled by the drive-point sensor."
    ),
    "shaker_damping": lambda *, ratio, frequency_off: (
        f"the damping is {ratio:.3g} times the model's or more at all amplitudes, while the "
        f"natural frequency agrees within {_percent(frequency_off)}: typical of shaker damping "
        "where the drive is used as the force."
    ),
    "advice_shaker_damping": (
        "measure the force at the structure, or name a voltage `drive_v`; if the force was "
        "measured there, repeat the linear test on this assembly."
    ),
    # Errors of a test.
    "drift": _with_residuals(
        lambda *, change: (
            f"the natural frequency drifts from the first to the last state by {100 * change:.3g} %"
        )
    ),
    "advice_drift": (
        "repeat a level at the end of the test, let the temperature settle, or correct for "
        "the drift along `order`."
    ),
    "structures_differ": _with_residuals(
        lambda *, file, change, n_files: (
            f"at equal amplitude the natural frequency of file {file} is {100 * change:.3g} % from "
            f"that of {'file 1' if n_files == 2 else 'the others'}"
        )
    ),
    "advice_structures": (
        "identify them separately: one call and one model for each structure or assembly."
    ),
    "force_gains_differ": _with_residuals(
        lambda *, gains: (
            "relative to the first level the force is off by the factors "
            f"{', '.join(f'{gain:.3g}' for gain in gains)} at the following levels"
        )
    ),
    "advice_force_gains": "measure the force, or calibrate the drive at each level.",
    "level_gains": _with_residuals(_level_gains),
    "advice_level_gains": _advice_on_level_gains,
    "levels_on_another_scale": lambda *, levels: (
        f"different force scale at level {enumerated(levels)}"
    ),
    "force_in_noise": lambda *, fall, floor, smallest: (
        f"at resonance the force drops by {_percent(fall)} into the noise of the load cell, about "
        f"{floor:.2g} N or {_percent(floor / smallest)} of the smallest force."
    ),
    "advice_force_in_noise": (
        "drive harder at resonance, average longer or use a more sensitive cell."
    ),
    "states_unsettled": _with_residuals(
        lambda *, fraction: (
            f"about {_percent(fraction)} of a step change remains at the end of the step"
        )
    ),
    "advice_unsettled": (
        "dwell longer, 5/(ζω) per step; or import the time record, whose unsettled steps are left "
        "out."
    ),
    "states_clipped": _with_residuals(_clipped_states),
    "advice_clipped_states": (
        "lower the channel's gain or widen its range and measure these states again; leave them "
        "out until then."
    ),
    "force_falls": lambda *, fall, n_levels, of_levels, rows: (
        f"force drop-out: at resonance the force falls by up to {_percent(fall)}, on {n_levels} of "
        f"{of_levels} levels ({_rows(rows)}), because the structure reacts on the shaker."
    ),
    "advice_force_falls": (
        "use the measured force of every state (`force_n`), as here, never the nominal one; or "
        "control the force."
    ),
    "response_harmonics_of_force": lambda *, harmonics: (
        "the force has harmonics, "
        + ", ".join(
            f"{100 * ratio:.3g} ± {100 * std:.1g} % of order {order}"
            for order, ratio, std in harmonics
        )
        + " of its fundamental: this part of the response harmonics is phase-locked to the force."
    ),
    "advice_harmonics": (
        "control the harmonics of the force, or add their amplitudes to the model as an effect "
        "on the spectrum of the force."
    ),
    # Time records.
    "channel_full_scale": lambda *, fraction, n_samples, low, high: (
        (
            f"{_percent(fraction)} of the samples lie in uninterrupted runs"
            if n_samples is None
            else f"{n_samples} samples, more than at any other value, lie"
        )
        + f" at {low:.4g} or {high:.4g}: the channel is at full scale."
    ),
    "cycle_flat": (
        "{fraction:%.3g} of the mean cycle lies within 3 % of its extremes (16 % for a sine): the "
        "channel is at full scale."
    ),
    "advice_range": "widen the channel's range or lower its gain, and record again.",
    "record_force_harmonic": lambda *, order, ratio: (
        f"harmonic {order} of the force is {_percent(ratio)} of its fundamental."
    ),
    "advice_amplifier": (
        "reduce the amplifier's distortion or control the harmonics; else add them to the model as "
        "an effect on the spectrum of the force."
    ),
    "steps_move": lambda *, n_moving, n_steps, change, time_s: (
        f"in {n_moving} of {n_steps} steps the response per force has not settled: it changes by "
        f"up to {_percent(change)} at the end of the step (from {time_s:.4g} s on)."
    ),
    "record_force_falls": lambda *, force, fall: (
        f"the force drops from {force:.4g} N by {_percent(fall)} where the response is largest."
    ),
    "advice_record_force": "use the measured force of every step, as here, or control the force.",
    "line_folded": lambda *, frequency_hz, ratio, rate_hz, order: (
        f"a line at {frequency_hz:.5g} Hz, {100 * ratio:.2g} % of the fundamental, is "
        + (
            f"not a harmonic of the drive but harmonic {order} aliased at the sampling rate of "
            f"{rate_hz:.6g} Hz."
            if order
            else "neither a harmonic of the drive nor mains: probably an alias of "
            f"{rate_hz - frequency_hz:.6g} Hz or more at the sampling rate of {rate_hz:.6g} Hz."
        )
    ),
    "advice_folded": (
        "switch on the recorder's anti-aliasing filter, or sample faster and filter before "
        "decimating."
    ),
    # Identified results.
    "column_misread": lambda *, evidence, advice, importable: (
        f"{evidence} Remedy: {str(advice).rstrip('.')}"
        + ("; `snrmjax check` gives the import command." if importable else ".")
    ),
    "far_from_linear_mode": _far,
    "damping_at_rest": lambda *, fitted, fitted_std, linear, linear_std, apart: (
        f"at zero amplitude the fit gives {100 * fitted:.4g} ± {100 * fitted_std:.2g} % of "
        f"critical damping, the model's linear test {100 * linear:.4g} ± {100 * linear_std:.2g} % "
        f"(1σ): {apart:.2g} combined standard deviations apart. Measure a level below the lowest, "
        "or identify the modes at the lowest level by `snrmjax modes`."
    ),
}
