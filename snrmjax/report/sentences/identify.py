"""Sentences of identifications, joint fits, predictions and advice."""

from collections.abc import Sequence

import numpy as np

from snrmjax.identify.checks.instruments import Determination
from snrmjax.identify.test_model.states import LEVEL_ERRORS
from snrmjax.report.sentences import Wording, enumerated, number_of

_MEASURE_GAIN = (
    "Measure the force, or calibrate the drive (a force transducer at one state, or a known added "
    "mass); or add states 30° to 70° from resonance on both sides, where the inertia of the modal "
    "mass is known"
)
_LISTED = 8  # levels by name
_UNITS = {
    "gain": (100, " % in gain"),
    "phase": (180 / np.pi, "° in phase"),
    "stiffness": (50, " % in natural frequency"),
    "damping": (100, " % in damping"),
}
_COMMON = {
    "gain": "a common error of velocities, force or modal mass",
    "phase": "a common phase error of the instruments (free `instrument_phase`)",
    "stiffness": "a natural frequency that differs between this test and the others",
    "damping": "an error of force or modal mass",
}
_CORRECTIONS = {
    "velocities": ("scaled the velocities", 100, " %"),
    "forces": ("scaled the forces", 100, " %"),
    "phases": ("rotated the velocity phases", 180 / np.pi, "°"),
}
_REMEDIES = {
    "force_offset": "Add levels of smaller force, and states 30° to 70° from resonance",
    "instrument_phase": "Add states on both sides of resonance",
}


def in_words(level_std: Sequence[float] | np.ndarray) -> str:
    """By how much levels differ, and in what (`LEVEL_ERRORS`); nothing where they do not."""
    pairs = [(_UNITS[k], one) for k, one in zip(LEVEL_ERRORS, level_std, strict=True) if one > 0]
    return ", ".join(f"{factor * one:.2g}{name}" for (factor, name), one in pairs)


def _of_kind(error: str, value: float) -> str:
    factor, name = _UNITS[error]
    return f"{factor * value:.2g}{name}"


def _undetermined_gain(std: float, how: str) -> str:
    if how == Determination.HARDLY:
        return (
            f"these data poorly determine the force gain: its 1σ is {100 * std:.2g} %, and so is "
            "that of every damping value; natural frequencies rest on the states near resonance. "
            f"{_MEASURE_GAIN}."
        )
    wide = "any value fits them about equally well"
    if std < np.log(100):
        wide = f"its 1σ is a factor of {np.exp(std):.2g}, and damping is proportional to it"
    return f"the force gain cannot be determined from these data ({wide}). {_MEASURE_GAIN}."


def _undetermined(name: str, std: float, how: str) -> str:
    is_phase = name == "instrument_phase"
    one_sigma = (
        f"{np.degrees(std):.2g}°" if is_phase else f"{100 * std:.2g} % of the smallest force"
    )
    verb = "poorly determine" if how == Determination.HARDLY else "cannot determine"
    return f"these data {verb} `{name}` (1σ {one_sigma}). {_REMEDIES[name]}, or do not free it."


def _not_passive(what: str, free: Sequence[str]) -> str:
    if "force_gain" in free:
        return (
            "the force gain cannot be determined from these data (the fit gives a negative "
            f"{what}, which no passive structure has). {_MEASURE_GAIN}."
        )
    if free:
        return (
            f"these data cannot determine `{free[0]}` (the fit gives a negative {what}, which no "
            f"passive structure has). {_REMEDIES[free[0]]}, or do not free it."
        )
    if what != "damping":
        return (
            f"these states are not those of a passive structure: the fit gives a negative {what}."
        )
    return (
        "the damping is negative at every state: the model's `participation`, its shape at the "
        "sensor, the sensor or the force has the wrong sign, or the phases are not those of a "
        "velocity relative to the force."
    )


def _frequency_scatters(std: float, noise_stated: bool) -> str:
    more = "which the stated noise does not explain"
    if not noise_stated:
        more = "more than random noise of force and velocity explains"
    return (
        f"the natural frequency varies by {100 * std:.2g} % from state to state (1σ), {more}; the "
        "bands include it."
    )


def _levels_differ(std: Sequence[float], beyond_stated: bool) -> str:
    more = ", which no stated error explains" if beyond_stated else ""
    differ = f"levels differ from one another by {in_words(std)} (1σ, estimated)"
    return f"{differ}{more}; the bands include this level-to-level variance."


def _few_levels(n_levels: int, assumed: Sequence[float]) -> str:
    if n_levels > 1:
        return (
            "only 2 levels: the level-to-level variance rests on a single difference, and the "
            "bands may be too narrow."
        )
    if not any(assumed):
        return (
            "only 1 level: its stated errors cannot be verified; the bands include them as stated."
        )
    return (
        "only 1 level: these data do not show how much levels differ from one another. The bands "
        f"include an assumed {in_words(assumed)} (1σ): measure further levels, or state it in the "
        "model's [measurement]."
    )


def _beyond_stated(
    error: str, stated: float, rms: float, largest: float, mean: float | None
) -> str:
    common = (
        ""
        if mean is None
        else f"; their mean is {mean:+.2g} times it, which suggests {_COMMON[error]}"
    )
    return (
        f"levels deviate by {rms:.2g} times the stated 1σ of {_of_kind(error, stated)} (rms; "
        f"largest {largest:.2g} times): the data need at least {_of_kind(error, rms * stated)}, or "
        f"the bands are too narrow{common}."
    )


def _mass_moved(
    found_kg: float,
    std_kg: float,
    model_kg: float,
    model_std: float,
    std_stated: bool,
    beyond_std: bool,
) -> str:
    away, source = found_kg / model_kg - 1, "stated" if std_stated else "assumed"
    more = (
        f"Damping ratios refer to it: with the model's they are {100 * abs(away):.2g} % "
        f"{'larger' if away > 0 else 'smaller'}."
    )
    if beyond_std:
        more = "Check the linear test, the force calibration and the mode shape at the sensor."
    return (
        f"states away from resonance give a modal mass of {found_kg:.4g} ± {std_kg:.2g} kg, "
        f"{100 * away:+.2g} % from the model's {model_kg:.4g} kg ({source} 1σ "
        f"{100 * model_std:.2g} %). {more}"
    )


def _correlated(in_phase: float, quadrature: float, states_as_one: float) -> str:
    parts = {
        "in phase with the force": in_phase,
        "in quadrature with it": quadrature,
    }
    correlations = ", ".join(f"{value:.2g} {part}" for part, value in parts.items() if value > 0)
    return (
        f"residuals of neighbouring points are correlated ({correlations}): a systematic error, "
        "not noise; the curves do not follow the data there, or the motion was not steady. About "
        f"{states_as_one:.0f} points count as one in the bands."
    )


def _levels_corrected(of: str, levels: Sequence[int], change: Sequence[float], trend: int) -> str:
    done, factor, unit = _CORRECTIONS[of]
    change = [factor * one for one in change]
    if len(levels) > _LISTED:
        low, high = int(np.argmin(change)), int(np.argmax(change))
        which = (
            f"{len(levels)} levels by {change[low]:+.2g}{unit} (level {levels[low]}) to "
            f"{change[high]:+.2g}{unit} (level {levels[high]})"
        )
    else:
        run = list(levels) == list(range(levels[0], levels[0] + len(levels)))
        named = f"{levels[0]} to {levels[-1]}" if run and len(levels) > 2 else enumerated(levels)
        which = f"levels {named} by {enumerated([f'{one:+.2g}' for one in change])}{unit}"
    more = ""
    if trend:
        verb = "grow" if trend > 0 else "fall"
        more = f"; these corrections {verb} with the force and are probably not random"
    return f"the fit {done} of {which}, so that all levels lie on one pair of curves{more}."


def _without_point(n_states: int, of: int, reason: str) -> str:
    return (
        f"{n_states} of {of} steady states give no point of their own (the curves use them): "
        f"{reason}."
    )


def _damping_and_phase(change: float, phase_was_free: bool) -> str:
    sides = ["45° below resonance (velocity leads)", "45° above it (velocity lags)"]
    if change < 0:
        sides = ["45° above resonance (velocity lags)", "45° below it (velocity leads)"]
    advice = (
        "let a joint fit estimate it (`--free instrument_phase`; in Python "
        '`fit_jointly(…, free=["instrument_phase"])`)'
    )
    if phase_was_free:
        advice = (
            "since this fit has already estimated it, check the force calibration and trust points "
            "near resonance"
        )
    return (
        f"damping is {100 * abs(change):.0f} % higher at points {sides[0]} than at points "
        f"{sides[1]}, which is not an amplitude dependence but the signature of an instrument "
        f"phase error: {advice}."
    )


def _trend(error: str, change: float, there: float, p_value: float, load: object) -> str:
    def signed(value: float) -> str:
        return f"{'-' if value < 0 else '+'}{_of_kind(error, abs(value))}"

    return (
        f"level errors have a trend with the force, {signed(change)} from the smallest to the "
        f"largest (p = {p_value:.1g}): the curves lack a term, or the drive is nonlinear. "
        f"The trend is {signed(there)} at {load}: the bands there are wider by it (1σ)."
    )


def _errors_of_a_level(another_day: bool) -> str:
    day = " and another day's" if another_day else ""
    return f"a further level's errors{day}"


def _resonance_range(
    probability: float,
    ratio: float,
    frequency_hz: tuple[float, float],
    velocity: tuple[float, float],
    another_day: bool,
    sure: bool,
) -> str:
    (low, high), (slow, fast) = frequency_hz, velocity
    reach = f"within {ratio:g} times the largest measured amplitude"
    beyond = "else it lies beyond (a larger `--extrapolate` searches farther)"
    where = (
        f"with 95 % probability it lies between {low:.6g} and {high:.6g} Hz, its velocity "
        f"between {slow:.3g} and {fast:.3g} m/s ({_errors_of_a_level(another_day)} included)"
    )
    if sure:
        return where
    if not (np.isfinite(low) and np.isfinite(high)):
        return f"it lies {reach} with probability {probability:.2g}, {beyond}"
    return f"if it lies {reach}, which has probability {probability:.2g}, {where}; {beyond}"


def _not_located(points: Sequence[tuple[str, float]], force: float) -> str:
    listed = ", ".join(f"{kind} near {hertz:.5g} Hz" for kind, hertz in points)
    return (
        f"{len(points)} resonances or folds under {force:g} N could not be located ({listed}) and "
        "have no band."
    )


def _coupled(mode: int, other: int, ratio: int, probability: float, fraction: float) -> str:
    moved = "" if np.isnan(fraction) else f", which has up to {100 * fraction:.2g} % of the energy"
    return (
        f"mode {mode} exchanges energy with mode {other} (1:{ratio}, probability "
        f"{_probable(probability)}){moved}: a single-mode backbone holds only where this exchange "
        "is small."
    )


def _probable(probability: float) -> str:
    return "above 0.999" if probability > 0.999 else f"{probability:.3g}"


def _not_coupled(looked: Sequence[tuple[int, int]]) -> str:
    if not looked:
        return "no other mode lies near the first three harmonics of the measured frequencies."
    pairs = enumerated([f"mode {other} (1:{ratio})" for other, ratio in looked])
    return f"the states show no exchange of energy with {pairs}."


def _biased(velocity: float, frequency: float, damping: float, clear: bool) -> str:
    bias = (
        f"at {velocity:.3g} m/s the single-mode backbone differs from the coupled modes by "
        f"{100 * frequency:+.2g} % in natural frequency and {100 * damping:+.2g} % in damping ratio"
    )
    return f"{bias}." if clear else f"{bias}: within its error."


def _outlying(*, states: Sequence[tuple[int, float]], farthest: float, robust: bool) -> str:
    """States far from the curves, and how they are or can be treated."""
    named = [f"level {level} at {hertz:.5g} Hz" for level, hertz in states[:_LISTED]]
    further = f" and {len(states) - _LISTED} further" if len(states) > _LISTED else ""
    lie = "lies" if len(states) == 1 else "lie up to"
    done = (
        "given little weight here"
        if robust
        else "leave them out of the table, or give them little weight by `--robust`"
    )
    return (
        f"{enumerated(named)}{further} {lie} {farthest:.2g} times the noise from the curves, as "
        f"unsettled states next to a jump do: {done}."
    )


def _fit_not_converged(reason: str, named: bool, noise_stated: bool, levels_stated: bool) -> str:
    unstated = (
        [] if noise_stated else ["the noise of the states (`velocity_std_m_s`, `phase_std_deg`)"]
    )
    unstated += [] if levels_stated else ["the errors of the levels ([measurement] in the model)"]
    remedy = f"state {' or '.join(unstated)}, which the fit otherwise estimates"
    if named:
        remedy = "try a simpler family"
    elif not unstated:
        remedy = "name a family in place of smooth curves, such as `polynomial:2`"
    return f"the fit has {reason}; {remedy}."


SENTENCES: dict[str, Wording] = {
    "states_outlying": _outlying,
    # Coupled modes.
    "modes_coupled": _coupled,
    "modes_not_coupled": _not_coupled,
    "single_mode_biased": _biased,
    # Joint fits.
    "as_in_file": "{text}",
    "fit_not_converged": _fit_not_converged,
    "family_leaves": lambda curve, family, largest: (
        f"{family} does not describe the {curve} within the noise: the remainder, up to "
        f"{max(100 * largest, 0.01):.2g} % of the {curve}, is fitted by a smooth curve, which "
        "bands and predictions include."
    ),
    "noise_exceeded": (
        "the residuals are {scale:.2g} ± {scale_std:.1g} times the stated noise: either that noise "
        "is too small or the model is wrong; the bands are widened by the factor {scale:.2g}."
    ),
    "noise_overstated": (
        "states scatter about the curves by only {scale:.2g} ± {scale_std:.1g} times the stated "
        "noise (errors of whole levels excluded): it is overstated."
    ),
    "frequency_wanders": _frequency_scatters,
    "levels_differ": _levels_differ,
    "few_levels": _few_levels,
    "level_beyond_stated": _beyond_stated,
    "modal_mass_moved": _mass_moved,
    "residuals_correlated": _correlated,
    "levels_corrected": _levels_corrected,
    "one_side_of_resonance": lambda near_deg, far_deg, below: (
        f"all states lie on one side of resonance ({near_deg:.0f}° to {far_deg:.0f}° "
        f"{'below' if below else 'above'} it): a common phase error looks like a change "
        "of natural frequency and damping, and the bands include it only if it is stated."
    ),
    "levels_of_one_amplitude": lambda apart: (
        f"the levels' largest amplitudes lie within {max(100 * apart, 0.1):.2g} % of each other: "
        "the amplitude dependence rests only on the smaller states of the same levels."
    ),
    "force_gain_near_resonance": (
        "these data poorly determine the force gain: all states lie within {farthest_deg:.0f}° of "
        "resonance, where a velocity error that depends on amplitude looks like a gain; the 1σ of "
        f"gain and damping exclude such errors. {_MEASURE_GAIN}."
    ),
    "force_gain_undetermined": _undetermined_gain,
    "fit_not_passive": _not_passive,
    "instrument_undetermined": _undetermined,
    # Points.
    "states_without_point": _without_point,
    "second_solutions": lambda n_states: (
        f"{number_of(n_states, 'steady state')} {'has' if n_states == 1 else 'have'} a second "
        "solution that amplitude and phase alone would also allow."
    ),
    "shape_not_followed": (
        "the sensors do not move in the stated mode shape (residual up to {residual:%.0f}): check "
        "the shape, or the mode's shape changes with amplitude."
    ),
    "damping_changes_with_phase": _damping_and_phase,
    # Predictions.
    "beyond_measured_amplitudes": (
        "{n_points} of {of} points lie beyond the largest measured amplitude, up to {ratio:.3g} "
        "times it: there the backbone is extrapolated, which no measurement supports."
    ),
    "points_not_located": _not_located,
    "negative_damping_left_out": (
        "damping extrapolates to zero at {load}: {fraction:%.2g} of the sampled curves have none "
        "left before a resonance. No passive structure has that: they are left out "
        "(`--self-excited` keeps them)."
    ),
    "levels_follow_force": _trend,
    "damping_below_zero": lambda velocity, ratio, ratio_std, probability: (
        f"damping at {velocity:.3g} m/s is {100 * ratio:.2g} ± {100 * ratio_std:.2g} % of "
        f"critical, below zero with probability {probability:.2g}: no passive structure has that, "
        "so only the part of the band above zero applies."
    ),
    "resonance_of_a_level": _resonance_range,
    "errors_of_a_level": _errors_of_a_level,
    # Advice.
    "advice_complete": "as many states as requested",
    "fewer_candidates": "fewer candidate states than requested",
    "no_state_to_measure": (
        "no stable state of the fitted responses within 70° of resonance can be measured in this "
        "range of forces, frequencies and measured amplitudes"
    ),
    "advice_of_unconverged_fit": (
        "the fit behind this advice has not converged: a converged fit may advise other states"
    ),
    "band_narrower": "the {curve} band becomes {fraction:%.2g} narrower",
}
