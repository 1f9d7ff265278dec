"""What the doctor finds in tables, models and records, and what mends it."""

from collections.abc import Callable, Sequence

from snrmjax.report.sentences import Wording, enumerated

_Unit = tuple[str, str, str]  # column, unit of its numbers, what it was taken for

_ROWS = 6  # that are listed
_SIGN = "import again with the other phase sign, or negate `velocity_im_m_s`."
_RESPONSES = {
    "opposite": "of turned sign: the shape, the sensor or the force has the other one",
    "conjugated": "complex conjugates",
    "conjugated_opposite": "complex conjugates of turned sign",
    "acceleration": "accelerations (m/s²)",
    "displacement": "displacements (m)",
    "radians_as_degrees": "phases in radians that were read as degrees",
    "degrees_as_radians": "phases in degrees that were read as radians",
    "base_left_in": "absolute: the motion of the base was not taken away",
    "base_taken_away_twice": "relative to the base already: its motion was taken away once more",
    "sizes_of_acceleration": "amplitudes of accelerations (m/s²) with the phases of velocities",
    "sizes_of_displacement": "amplitudes of displacements (m) with the phases of velocities",
}
_ADVICE_ON_RESPONSES = {
    "opposite": "negate this sensor's entry of `shape` in the model, or both velocity columns.",
    "conjugated": _SIGN,
    "conjugated_opposite": "negate `velocity_re_m_s`; or import again with the other phase sign, "
    "and turn the sensor's.",
    "acceleration": "divide by iΩ: import again as accelerations.",
    "displacement": "multiply by iΩ: import again as displacements.",
    "radians_as_degrees": "import again with phases in radians.",
    "degrees_as_radians": "import again with phases in degrees.",
    "base_left_in": 'say `motion = "absolute"` in the [base] of the model.',
    "base_taken_away_twice": 'say `motion = "relative"` in the [base] of the model.',
    "sizes_of_acceleration": "divide the amplitudes by Ω = 2πf, not the phases, in the "
    "laboratory's file.",
    "sizes_of_displacement": "multiply the amplitudes by Ω = 2πf, not the phases, in the "
    "laboratory's file.",
}


def _percent(fraction: float) -> str:
    return f"{100 * fraction:.2g} %" if fraction < 0.995 else "100 % or more"


def _rows(rows: Sequence[int]) -> str:
    """Rows as a table's reader counts them, from 1 below the header."""
    shown = ", ".join(str(k + 1) for k in rows[:_ROWS])
    return f"rows {shown}{' and others' if len(rows) > _ROWS else ''}"


def _read_so(said: Callable[..., str]) -> Callable[..., str]:
    """What is undone, and by how much one mode then misses a state."""

    def both(*, misfit: float, misfit_before: float, **values: object) -> str:
        left = f"a state is missed by {_percent(misfit)}, not {_percent(misfit_before)}"
        return f"{said(**values)}; so read {left}."

    return both


def _misread(*, reading: str, misfit: float, misfit_as_recorded: float | None) -> str:
    as_they_are = "as recorded the mode would gain energy"
    if misfit_as_recorded is not None:
        as_they_are = f"{_percent(misfit_as_recorded)} as recorded"
    return (
        f"the responses are {_RESPONSES[reading]}: so read one mode misses a state by "
        f"{_percent(misfit)}, {as_they_are}."
    )


def _scale(*, ratio: float, ratio_std: float, misfit: float, misfit_as_modelled: float) -> str:
    return (
        f"{_asked(ratio, ratio_std)} (a state is missed by {_percent(misfit)} so, with the "
        f"model's by {_percent(misfit_as_modelled)})"
    )


def _asked(ratio: float, ratio_std: float) -> str:
    return f"the states ask for {ratio:.4g} ± {ratio_std:.1g} times the model's modal mass"


def _rms(*, scale: object, column: str) -> str:
    factor, whose = ("√2", "responses") if column == "response" else ("1/√2", "forces")
    return f"{scale}, {factor}: {whose} are rms, not peak."


def _units(*, ratio: float, ratio_std: float, factor: float, units: Sequence[_Unit]) -> str:
    words = [f"the {column} in {unit}, taken for {taken_for}" for column, unit, taken_for in units]
    return f"{_asked(ratio, ratio_std)}: the factor {factor:.4g} of {', or '.join(words)}."


def _import_units(*, units: Sequence[_Unit]) -> str:
    return f"import again, {', or '.join(f'{column}s in {unit}' for column, unit, _ in units)}."


def _level_gains(*, gains: Sequence[tuple[int, int | None, float]]) -> str:
    named = [
        f"the force of level {level}{f' (file {file})' if file else ''} is {gain:.3g} times"
        for level, file, gain in gains
    ]
    return f"{' and '.join(named)} what the other levels ask for"


def _advice_on_level_gains(*, gains: Sequence[tuple[int, int | None, float]]) -> str:
    numbers = [f"level {level} by {gain:.3g}" for level, _, gain in gains]
    return (
        "if the column is a voltage, measure the force; else another range or calibration was set "
        f"there: divide the force of {' and of '.join(numbers)} in the file that it comes from."
    )


def _clipped_states(*, column: str, limit: float, rows: Sequence[int]) -> str:
    unit = "N" if column == "force" else "m/s"
    return (
        f"the {column} is cut off at about {limit:.4g} {unit} in {len(rows)} states ({_rows(rows)})"
    )


def _far(*, quantities: Sequence[str], lowest: Sequence[float], linear: Sequence[float]) -> str:
    found, own = (f"{hz:.5g} Hz and {100 * ratio:.3g} %" for hz, ratio in (lowest, linear))
    return (
        f"{' and '.join(quantities)} at small amplitude {'are' if len(quantities) > 1 else 'is'} "
        f"not the linear mode's: the lowest level has {found}, the model {own}. Name the mode by "
        "`mode_of_interest`, or find the linear modes of this assembly by `snrmjax modes`."
    )


SENTENCES: dict[str, Wording] = {
    # What could not be looked at.
    "no_table": "no table of steady states: columns and scales were not looked at.",
    "no_model": "no model: the scale of force, response and shape was not looked at.",
    "too_few_states": (
        "{n_states} states with force and phase at {sensor} are too few to look at: {needed} are "
        "needed."
    ),
    "drive_not_scaled": "the force is declared as a drive voltage: its scale was not looked at.",
    "record_cut": "{record}: only the first {n_samples} samples were looked at.",
    "record_without_force": ("{record}: no channel is a force or a voltage: steps were not found."),
    "record_without_tone": "{record}: {error}",
    "record_without_steps": "{record}: no step of four cycles was recognised.",
    # Columns that mean something else, and a modal mass that is none.
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
    "if_units_are_right": "if the units are right",
    "voltage_for_force": (
        "{scale}: the force column may be a drive voltage of {gain:.3g} V per N."
    ),
    "advice_voltage": (
        "if it is a voltage, call the column `drive_v` and leave its gain to the identification."
    ),
    "shape_scale": "{scale}: the shape of the model may not be mass-normalised.",
    "advice_shape": (
        "if so, divide `shape` and `participation` of the model by {factor:.4g} each, or find the "
        "modes anew, scaled by the sensor at the force."
    ),
    "shaker_damping": lambda *, ratio, frequency_off: (
        f"the damping is {ratio:.3g} times the model's and more at all amplitudes, at the model's "
        f"natural frequency within {_percent(frequency_off)}: a shaker damps so where its drive is "
        "taken for the force."
    ),
    "advice_shaker_damping": (
        "measure the force at the structure, or call a voltage `drive_v`; if it is that force, "
        "repeat the linear test on this assembly."
    ),
    # What went wrong with a test.
    "drift": _read_so(
        lambda *, change: (
            "from the first to the last state the natural frequency changes by "
            f"{100 * change:.3g} %"
        )
    ),
    "advice_drift": (
        "repeat a level at the end of the test, let the temperature settle, or correct along "
        "`order`."
    ),
    "structures_differ": _read_so(
        lambda *, file, change, n_files: (
            f"at equal amplitude the natural frequency of file {file} is {100 * change:.3g} % from "
            f"{'file 1' if n_files == 2 else 'the others'}'s"
        )
    ),
    "advice_structures": (
        "identify them apart: one call and one model for each structure or assembly."
    ),
    "force_gains_differ": _read_so(
        lambda *, gains: (
            "the force over that of the first level is off by the factors "
            f"{', '.join(f'{gain:.3g}' for gain in gains)} at levels 2 and on"
        )
    ),
    "advice_force_gains": "measure the force, or calibrate the drive at each level.",
    "level_gains": _read_so(_level_gains),
    "advice_level_gains": _advice_on_level_gains,
    "levels_on_another_scale": lambda *, levels: (
        f"force on another scale at level {enumerated(levels)}"
    ),
    "force_in_noise": lambda *, fall, floor, smallest: (
        f"at resonance the force falls by {_percent(fall)} into the noise of its cell, about "
        f"{floor:.2g} N, {_percent(floor / smallest)} of the smallest."
    ),
    "advice_force_in_noise": (
        "drive harder at resonance, average longer or use a more sensitive cell."
    ),
    "states_unsettled": _read_so(
        lambda *, fraction: f"about {_percent(fraction)} of a change is left at the end of a step"
    ),
    "advice_unsettled": (
        "dwell longer, 5/(ζω) a step; or import the time record, whose unsettled steps are left "
        "out."
    ),
    "states_clipped": _read_so(_clipped_states),
    "advice_clipped_states": (
        "lower the channel's gain or range and measure these states again; leave them out until "
        "then."
    ),
    "force_falls": lambda *, fall, n_levels, of_levels, rows: (
        f"at resonance the force falls by up to {_percent(fall)} of what it is beside it, on "
        f"{n_levels} of {of_levels} levels ({_rows(rows)}): the structure moves the shaker."
    ),
    "advice_force_falls": (
        "keep the measured force of every state (`force_n`), as here, never a nominal one; or "
        "control the force."
    ),
    "response_harmonics_of_force": lambda *, harmonics: (
        "the force has harmonics, "
        + ", ".join(
            f"{100 * ratio:.3g} ± {100 * std:.1g} % of order {order}"
            for order, ratio, std in harmonics
        )
        + " of its fundamental: that part of the response's harmonics keeps its phase to the force."
    ),
    "advice_harmonics": (
        "control the harmonics of the force, or put their sizes into the model as an effect on "
        "the force's spectrum."
    ),
    # What a record shows.
    "channel_full_scale": lambda *, fraction, n_samples, low, high: (
        (
            f"{_percent(fraction)} of the samples stand in a row"
            if n_samples is None
            else f"{n_samples} samples, more than at any other value, stand"
        )
        + f" at {low:.4g} or {high:.4g}: the channel is at the end of its range."
    ),
    "cycle_flat": (
        "{share:%.3g} of a mean cycle lies within 3 % of its extremes, of a sine 16 %: the channel "
        "is at the end of its range."
    ),
    "advice_range": "widen the channel's range (or lower the gain) and record again.",
    "record_force_harmonic": lambda *, order, ratio: (
        f"harmonic {order} of the force is {_percent(ratio)} of its fundamental."
    ),
    "advice_amplifier": (
        "lower the amplifier's distortion or control the harmonics; else put them into the model "
        "as an effect on the force's spectrum."
    ),
    "steps_move": lambda *, n_moving, n_steps, change, time_s: (
        f"in {n_moving} of {n_steps} steps the response over the force still moves at the end, by "
        f"up to {_percent(change)} (from {time_s:.4g} s on)."
    ),
    "record_force_falls": lambda *, force, fall: (
        f"the force falls from {force:.4g} N by {_percent(fall)} where the response is strongest."
    ),
    "advice_record_force": "keep the measured force of every step, as here, or control the force.",
    "line_folded": lambda *, frequency_hz, ratio, rate_hz, order: (
        f"a line at {frequency_hz:.5g} Hz, {100 * ratio:.2g} % of the fundamental, is "
        + (
            f"no harmonic of the drive but the image of harmonic {order} folded about half the "
            f"rate of {rate_hz:.6g} Hz."
            if order
            else "neither a harmonic of the drive nor mains: the likely image of "
            f"{rate_hz - frequency_hz:.6g} Hz or more at a rate of {rate_hz:.6g} Hz."
        )
    ),
    "advice_folded": (
        "switch on the recorder's anti-alias filter, or sample faster and filter before thinning."
    ),
    # Of what was identified.
    "column_misread": lambda *, evidence, advice, importable: (
        f"{evidence} To mend it: {str(advice).rstrip('.')}"
        + ("; `snrmjax check` writes the import." if importable else ".")
    ),
    "far_from_linear_mode": _far,
    "damping_at_rest": lambda *, fitted, fitted_std, linear, linear_std, apart: (
        f"at zero amplitude the fit has {100 * fitted:.4g} ± {100 * fitted_std:.2g} % of critical "
        f"damping, the model's linear test {100 * linear:.4g} ± {100 * linear_std:.2g} % (1σ): "
        f"{apart:.2g} combined standard deviations apart. Measure a level below the lowest, or "
        "find the modes of the lowest level by `snrmjax modes`."
    ),
}
