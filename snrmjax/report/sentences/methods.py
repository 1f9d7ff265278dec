"""Sentences of the other methods."""

from snrmjax.numerics.facts import Fact
from snrmjax.report.sentences import Wording, number_of


def _record_sorted(name: str, kind: str, why: Fact, states: Fact | None) -> str:
    return f"{name}: {kind} ({why}{'' if states is None else f'; {states}'})"


def _state_space_fitted(
    n_monomials: int, misfit: float, linear_misfit: float, validation: float | None
) -> str:
    checked = (
        "no realisation was left for validation"
        if validation is None
        else f"{100 * validation:.2g} % for a validation realisation"
    )
    return (
        f"{number_of(n_monomials, 'monomial')} per state; residual {100 * misfit:.2g} % (rms) of "
        f"the velocity, {100 * linear_misfit:.2g} % for the linear model; {checked}"
    )


SENTENCES: dict[str, Wording] = {
    "sections_between_levels": (
        "no level keeps its displacement within ±{spread:%.0f}: sections of equal displacement "
        "are interpolated between levels"
    ),
    "normal_form_fitted": (
        "normal form of degree {degree}, fitted to the trajectory (sample noise "
        "{noise_std:.2g} m/s)"
    ),
    "off_the_manifold": "the record is {misfit:%.2g} (rms) away from a two-dimensional manifold",
    "decay_read_by": "evaluated by {reading}",
    "bias_of_filter": (
        "estimated filter bias: up to {frequency:%.2g} of the frequency and {damping:%.2g} of the "
        "damping"
    ),
    "mode_isolated": (
        "the mode, {fraction:%.3g} of the decay's energy, was isolated by a tracking filter from "
        "{low_hz:.4g} to {high_hz:.4g} Hz, from {begin:.3g} s on"
    ),
    "interfering_modes_of_decay": (
        "{fraction:%.2g} of the decay's energy is other motion, {line_fraction:%.2g} of it near "
        "{frequency_hz:.4g} Hz"
    ),
    "bias_of_mode_filter": (
        "estimated bias of the mode filter, removed: typically {frequency:%.2g} of the frequency "
        "and {damping:%.2g} of the damping, more near the ends"
    ),
    "hum_taken_away": "mains hum was removed: {amplitude:.2g} m/s at {frequency_hz:.5g} Hz",
    "decay_left_out": "a decay was left out: {why}",
    "decrement_apart": (
        "damping is computed from the power lost: the logarithmic decrement alone, which counts a "
        "change of frequency as loss or gain, would differ by up to {fraction:%.2g}"
    ),
    "note_of_decay": "{name}: {note}",
    "record_sorted": _record_sorted,
    "data_left_out": "left out: {why}",
    "steps_settled": "{n} of {n_steps} settled",
    "states_read": "{n:#state} read",
    "drive_stops": "{channel} stops for {n:#interval} of 12 cycles",
    "motion_decays_under_noise": "the motion decays while {channel} is noise",
    "drive_is_no_tone": "{channel} is not one tone: it covers {low_hz:.4g} to {high_hz:.4g} Hz",
    "motion_falls_undriven": "no force or drive acts, and the motion decays",
    "tone_in_steps": "{channel} is a stepped tone of {n:#step}",
    "tone_that_moves": "{channel} is a swept tone, {n:#time}",
    "velocity_by_spline": "velocity from {quantity} by a spline",
    "one_model_of_records": "one model for {n:#record}",
    "records_apart": "each record by itself: {why}",
    "record_left_out": "a record was left out: {why}",
    "left_by_two_forces": "residual of the two forces: {misfit:%.2g} of the acceleration (rms)",
    "state_space_fitted": _state_space_fitted,
    "misfit_beyond_noise": (
        "the residual at the fitted lines is {times:.2g} times the noise between periods: forces "
        "are not polynomials of these degrees, or the record is not periodic, and the bands do not "
        "include the resulting error"
    ),
}
