"""What the other methods have to tell."""

from snrmjax.numerics.facts import Fact
from snrmjax.report.sentences import Wording, number_of


def _record_sorted(name: str, kind: str, why: Fact, states: Fact | None) -> str:
    return f"{name}: {kind} ({why}{'' if states is None else f'; {states}'})"


def _drive_stops(channel: str, n: int) -> str:
    return f"{channel} stops for {n} stretch{'es' if n > 1 else ''} of 12 cycles"


def _state_space_fitted(
    n_monomials: int, misfit: float, linear_misfit: float, validation: float | None
) -> str:
    checked = (
        "no realisation was left to validate it"
        if validation is None
        else f"{100 * validation:.2g} % of a realisation that was not fitted"
    )
    return (
        f"{number_of(n_monomials, 'monomial')} a state; the model leaves {100 * misfit:.2g} % (rms)"
        f" of the velocity, the linear one {100 * linear_misfit:.2g} %; {checked}"
    )


SENTENCES: dict[str, Wording] = {
    "sections_between_levels": (
        "no level holds its displacement within ±{spread:%.0f}: sections of equal displacement "
        "are interpolated between levels"
    ),
    "normal_form_fitted": (
        "normal form of degree {degree}, fitted to the trajectory (noise of a sample "
        "{noise_std:.2g} m/s)"
    ),
    "off_the_manifold": "the record is {misfit:%.2g} (rms) off a two-dimensional manifold",
    "decay_read_by": "read by {reading}",
    "bias_of_filter": (
        "bias of the filter, estimated: up to {frequency:%.2g} of the frequency and {damping:%.2g} "
        "of the damping"
    ),
    "mode_isolated": (
        "the mode, {share:%.3g} of the decay's energy, was isolated by a filter that moves with "
        "it within {low_hz:.4g} to {high_hz:.4g} Hz, from {begin:.3g} s on"
    ),
    "interfering_modes_of_decay": (
        "{share:%.2g} of the decay's energy is other motion, {line_fraction:%.2g} of it near "
        "{frequency_hz:.4g} Hz"
    ),
    "bias_of_mode_filter": (
        "bias of the mode filter, estimated and taken away: typically {frequency:%.2g} of the "
        "frequency and {damping:%.2g} of the damping, more near the ends"
    ),
    "hum_taken_away": "mains hum was taken away: {amplitude:.2g} m/s at {frequency_hz:.5g} Hz",
    "decay_left_out": "a decay was left out: {why}",
    "decrement_apart": (
        "damping is the power lost: the logarithmic decrement alone, which takes the change of "
        "frequency for a loss or a gain, would differ by up to {share:%.2g} of itself"
    ),
    "note_of_decay": "{name}: {note}",
    "record_sorted": _record_sorted,
    "data_left_out": "left out: {why}",
    "steps_settled": "{n} of {n_steps} settled",
    "states_read": "{n:#state} read",
    "drive_stops": _drive_stops,
    "motion_decays_under_noise": "the motion decays, and {channel} is noise",
    "drive_is_no_tone": "{channel} is no tone: it holds {low_hz:.4g} to {high_hz:.4g} Hz",
    "motion_falls_undriven": "no force or drive acts, and the motion falls",
    "tone_in_steps": "{channel} is a tone of {n:#step}",
    "tone_that_moves": "{channel} is a tone whose frequency moves, {n:#time}",
    "velocity_by_spline": "velocity of {quantity} by a spline",
    "one_model_of_records": "one model of {n:#record}",
    "records_apart": "each record alone: {why}",
    "record_left_out": "a record was left out: {why}",
    "left_by_two_forces": "the two forces leave {misfit:%.2g} of the acceleration (rms)",
    "state_space_fitted": _state_space_fitted,
    "misfit_beyond_noise": (
        "what is left of the fitted lines is {times:.2g} times the noise by which periods scatter: "
        "forces are no polynomials of these degrees, or the record is not periodic, and the bands "
        "do not hold the error that this makes"
    ),
}
