"""Sentences of linear modal fits, of the scaling of mode shapes and of model calibrations."""

import numpy as np

from snrmjax.report.sentences import Wording, enumerated


def _amplitude_dependence(
    mode: int,
    frequency_hz: float,
    of_damping: bool,
    change: float,
    allowed: float,
    left: float,
    velocities: tuple[float, float],
) -> str:
    name, unit, factor = "frequency", "Hz", 0.5 / np.pi
    if of_damping:
        name, unit, factor = "damping", "%", 100.0
    low, high = velocities
    return (
        f"the {name} of mode {mode} ({frequency_hz:.6g} Hz) depends on the amplitude: "
        f"{factor * change:+.3g} {unit} from {low:.3g} to {high:.3g} m/s, where the errors allow "
        f"{factor * allowed:.2g} {unit}; at the lowest level about {factor * left:.2g} {unit} may "
        "remain, which is added to its error (1σ)"
    )


def _dependent_mode(
    mode: int,
    frequency_hz: float,
    power: int,
    shift_hz: float,
    shift_std_hz: float,
    bandwidths: float,
    damping_change: float | None,
    levels: tuple[int, ...],
    velocity: float,
) -> str:
    grows = "the amplitude" if power == 1 else "the square of the amplitude"
    damping = ""
    if damping_change is not None:
        damping = f" and its damping by {100 * damping_change:+.2g} % of critical"
    of = f"level {levels[0]}" if len(levels) == 1 else f"levels {enumerated(levels)} together"
    return (
        f"mode {mode} depends on the amplitude: in proportion to {grows} its frequency changes by "
        f"{shift_hz:+.3g} ± {1.96 * shift_std_hz:.2g} Hz (95 %){damping} from zero to "
        f"{velocity:.3g} m/s, {bandwidths:.2g} times its half-power bandwidth; its frequency "
        f"({frequency_hz:.6g} Hz) and damping are the limits at zero amplitude, fitted to {of}"
    )


def _low_residual(mass_kg: float, ratio: float, off: bool) -> str:
    more = ""
    if off:
        more = (
            f", {ratio:.2g} times the stated mass: the force acts off the centre of mass, or the "
            "residual includes suspension modes or missed modes"
        )
    return f"the lower residual at the drive point corresponds to {mass_kg:.4g} kg{more}"


SENTENCES: dict[str, Wording] = {
    # Linear modes.
    "leakage": lambda mode, frequency_hz, lines, bias: (
        f"the half-power band of mode {mode} ({frequency_hz:.6g} Hz) has {lines:.1f} lines: if "
        "these are averages of random excitation with a Hann window, leakage makes its damping "
        f"about {100 * bias:.2g} % too high, which is not in the error; model it (window hann), or "
        "measure with finer lines"
    ),
    "residues_turned": lambda mode, frequency_hz, phase_deg, std_deg, phase_was_free: (
        f"the residues of mode {mode} ({frequency_hz:.6g} Hz) are rotated by {phase_deg:.2g}° ± "
        f"{1.96 * std_deg:.2g}° from real values: "
        + ("" if phase_was_free else "a phase error of the instruments (free it), ")
        + "a missed neighbouring mode, or complex modes"
    ),
    "complex_mode": (
        "mode {mode} ({frequency_hz:.6g} Hz) is complex: modal phase collinearity "
        "{collinearity:.2f}; its real shape is an approximation"
    ),
    "misfit_of_sensor": (
        "the residuals of {sensor} are {times:.2g} times its stated errors: the errors of the "
        "modes are scaled by this factor"
    ),
    "modal_fit_not_settled": "the least-squares fit had not converged after its last step",
    "leakage_modelled": (
        "leakage of the Hann window is modelled: averages of stationary random excitation, windows "
        "of {window_s:.4g} s"
    ),
    "decay_residuals_correlated": (
        "residuals of neighbouring samples are correlated (a missed mode, or a nonlinear decay): "
        "errors are widened accordingly"
    ),
    "decay_moves_with_amplitude": lambda frequency_hz, begin, from_hz, powers: (
        f"frequency and damping of the mode at {frequency_hz:.6g} Hz change with its amplitude "
        f"({from_hz:.5g} Hz {begin:.4g} s after the largest value): given are the small-amplitude "
        "limits, from a fit of the decay from there on with "
        + (
            f"rates that depend on {', '.join(f'A^{power}'.removesuffix('^1') for power in powers)}"
            if powers
            else "constant rates"
        )
    ),
    "coherence_in_part": "the coherence is incomplete and not used",
    "coherence_is_one": "the coherence is 1 at most lines: it contains no information on errors",
    "one_level_for_modes": (
        "only one level: it is not known whether it was low enough to be linear"
    ),
    "levels_not_compared": "level {other} cannot be compared with level {level}: {reason}",
    "levels_agree": (
        "the two lowest levels agree within their errors: no amplitude dependence is visible"
    ),
    "amplitude_dependence": _amplitude_dependence,
    "amplitude_dependent_mode": _dependent_mode,
    # Scales of shapes.
    "scaled_by_drive_point": "scaled by the drive point {sensor}",
    "scaled_by_added_mass": "scaled by an added mass of {mass_kg:.4g} kg at {sensor}",
    "scaled_by_sensor_masses": "scaled by the masses at the sensors",
    "scaled_by_known_shape": "scaled by the shape stated at {sensor}",
    "not_scaled": "not scaled",
    "shapes_not_scaled": lambda residues_known: (
        "shapes and participations are not mass-normalised: "
        + (
            "frequencies, damping ratios, shape ratios and the product of shape and participation "
            "are valid, but no modal mass or coefficient of a potential by itself"
            if residues_known
            else "only frequencies, damping ratios and shape ratios are valid; the force gain must "
            "be free in later steps"
        )
    ),
    "participations_per_volt": (
        "participations are per volt: this model is for states with `drive_v`, with the force gain "
        "in newtons per volt free or fixed to one"
    ),
    "mode_not_scaled": lambda frequency_hz, residue, std: (
        f"mode at {frequency_hz:.6g} Hz left out: its drive-point residue is {residue:.3g} "
        f"± {1.96 * std:.2g} 1/kg (95 %), which determines no shape"
    ),
    "forced_fixture": (
        "the motion of the forced fixture of {mass_kg:.4g} kg balances the masses at the sensors"
    ),
    "effective_masses": lambda masses_kg, at_sensors_kg: (
        f"effective modal masses: {', '.join(f'{one:.4g}' for one in masses_kg)} kg, of "
        f"{at_sensors_kg:.4g} kg at the sensors"
    ),
    "shape_for_all_modes": "the shape {value:.6g} at {sensor} was used for every mode",
    "added_mass_shift": lambda mode, mass_kg, shift_hz, std_hz, first_order: (
        f"mode {mode}: the mass of {mass_kg:.4g} kg lowers the frequency by {shift_hz:.4g} ± "
        f"{1.96 * std_hz:.2g} Hz; by the first-order formula the squared shape would be "
        f"{100 * first_order:+.2g} % off"
    ),
    "added_mass_large": (
        "the added mass is large enough to change the mode shapes: use a smaller one"
    ),
    "low_residual_of_free_mass": (
        "the lower residual at the drive point corresponds to a free mass of {mass_kg:.4g} kg or "
        "to modes below the band: it is written as a rigid-body mode if the structure is stated to "
        "be free"
    ),
    "rigid_body_of_stated_mass": "the rigid-body mode is that of the stated mass only",
    "low_residual_of_mass": _low_residual,
    "rigid_body_of_residuals": lambda mass_kg, std_kg, scaled_by: (
        f"rigid-body mode from the lower residuals ({scaled_by}): apparent mass {mass_kg:.4g} ± "
        f"{1.96 * std_kg:.2g} kg"
    ),
    # Calibrations.
    "equal_errors_assumed": lambda some_stated: (
        "every point is given the same relative error, as "
        f"{'not all are' if some_stated else 'none is'} stated."
    ),
    "harmonics_without_error": "harmonics are left out: no error is stated for them.",
    "no_motion_for_calibration": (
        "no periodic solution was found for any state: nothing was fitted."
    ),
    "no_mode_at_start": "the starting model has no such mode at some velocities: start closer.",
    "calibration_not_converged": (
        "the fit did not converge: values and standard deviations are not those of a minimum; "
        "start closer, or fit fewer parameters."
    ),
    "states_without_motion": (
        "no periodic solution was found for the states {states}: they have no weight."
    ),
    "calibration_noise": lambda scale: (
        f"residuals are {scale:.2g} times the stated noise: it is understated or the model lacks "
        "something; the standard deviations are widened."
        if not scale < 1
        else f"residuals are only {scale:.2g} times the stated noise: it is overstated."
    ),
    "parameters_without_data": "the data contain no information on {names}.",
    "parameters_hardly_known": lambda names, prior_stated: (
        f"the backbone contains next to no information on {enumerated(names)}: "
        f"{'fit fewer parameters' if prior_stated else 'state `prior_std`'}."
    ),
    "parameters_at_limit": lambda names, prior_stated: (
        f"{enumerated(names)} ended a factor of ten from the start: start closer"
        f"{'' if prior_stated else ', or state `prior_std`'}."
    ),
}
