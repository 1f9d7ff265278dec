"""What a single mode says of a table: readings of phasors, corrections of states, modal mass."""

import numpy as np

from snrmjax.doctor.balance_fit import BalanceFit, ModeStates
from snrmjax.doctor.corrections import Remedy, corrections
from snrmjax.doctor.findings import Finding, Kind, Repair, rows_in_words
from snrmjax.doctor.force_checks import deepest_fall, shaker_damping
from snrmjax.doctor.modal_mass import mass_findings
from snrmjax.doctor.readings import Reading, best_reading, wild_phases
from snrmjax.model.structures import Structure

_AT_THE_NOISE = 1.12  # times the stated errors: nothing is left to be explained
_MOST_SCALE, _MOST_MISFIT = 4.0, 0.25  # beyond which a fit says nothing of the modal mass
_SMALL_MISFIT = 0.04  # relative: whatever errors are stated, it says the modal mass well enough
_NO_MODE = 0.35  # relative misfit, from which on the phasors are those of no mode
_EXPLAINED = 2.0  # times the stated errors that a correction may leave
_EXPLAINED_SHARE = 0.4  # of the misfit as recorded that it may leave otherwise
_LEAST_GAIN = {"drift": 18.0, "different_structures": 25.0, "clipped_channel": 40.0}
_LEAST_GAIN_ELSE = 25.0  # of the criterion, for independent states
_LEAST_FREQUENCY = 0.002  # relative change of natural frequency that is spoken of
_OF_BANDWIDTH = 0.25  # of the damping ratio: likewise
_MOST_FREQUENCY = 0.4  # relative: a larger one is an extrapolated curve
_OVERLAP = 0.2  # of the states of levels apart, whose amplitudes the others have, too
_LEAST_GAIN_CHANGE = 0.07  # relative: of gain or force along a test or between files
_SAME_MASS = 0.2  # logarithm of the force's change, beyond which levels are not one assembly's
_OTHER_GAIN = 0.03  # logarithm of a level's force that the others do not share
_ALIKE = 0.25  # of that, which the others differ among themselves at most
_LEAST_RIGHT = 1e-3  # share of a recorded force that acted: none or less has no logarithm
_LEAST_FLOOR = 0.05  # of the smallest force, that its noise must have to be spoken of

_SCALES = ("rms_for_peak", "shape_not_mass_normalised")
_OTHER_SIGN = "import again with the other phase sign"
_REPAIRS = {
    "conjugated": Repair(conjugate=True),
    "acceleration": Repair(quantity="acceleration"),
    "displacement": Repair(quantity="displacement"),
    "radians_read_as_degrees": Repair(phase_unit="rad"),
    "degrees_read_as_radians": Repair(phase_unit="deg"),
}
_MEANINGS: dict[str, tuple[Kind, str, str]] = {
    "conjugated": (
        "conjugated_response",
        "complex conjugates (phasors e^{-iωt}, or response over force upside down)",
        f"{_OTHER_SIGN} (where the sensor is no velocity sensor turn its sign, too), or "
        "negate `velocity_im_m_s`",
    ),
    "conjugated_opposite": (
        "conjugated_response",
        "complex conjugates of turned sign",
        f"{_OTHER_SIGN} (where the sensor is a velocity sensor turn its sign, too), or "
        "negate `velocity_re_m_s`",
    ),
    "opposite": (
        "shape_not_mass_normalised",
        "of turned sign, as against a shape, a sensor or a force of the other sign",
        "negate this sensor's entry of `shape` in the model, or both velocity columns",
    ),
    "acceleration": (
        "acceleration_as_velocity",
        "accelerations (m/s²)",
        "divide by iΩ: import again as accelerations",
    ),
    "displacement": (
        "displacement_as_velocity",
        "displacements (m)",
        "multiply by iΩ: import again as displacements",
    ),
    "acceleration_size": (
        "acceleration_as_velocity",
        "amplitudes of accelerations (m/s²) with the phases of velocities",
        "divide the amplitudes by Ω = 2πf, not the phases, in the laboratory's file",
    ),
    "displacement_size": (
        "displacement_as_velocity",
        "amplitudes of displacements (m) with the phases of velocities",
        "multiply the amplitudes by Ω = 2πf, not the phases, in the laboratory's file",
    ),
    "radians_read_as_degrees": (
        "degrees_for_radians",
        "phases in radians that were read as degrees",
        "multiply the phases by 180/π = 57.296 before they are turned into real and imaginary part",
    ),
    "degrees_read_as_radians": (
        "degrees_for_radians",
        "phases in degrees that were read as radians",
        "multiply the phases in degrees by π/180 = 0.0174533 before the real and imaginary part",
    ),
}


def mode_findings(
    states: ModeStates,
    model: Structure | None,
    where: str,
    groups: tuple[tuple[int, ...], ...],
    drive: bool,
) -> list[Finding]:
    """Findings of one sensor's states; `drive` says that forces are declared to be volts."""
    natural_frequency = None
    if model is not None:
        modes = model.modes
        natural_frequency = float(modes.natural_frequency[modes.mode_of_interest])
    recorded, best = best_reading(states, natural_frequency)
    if best.name != recorded.name and not drive:
        found = [misread(recorded, best, where)]
        if best.name.startswith(("radians", "degrees")):
            return found
    elif best.fit.misfit > _NO_MODE and wild_phases(states):
        return [_wild(best.fit, where)]
    else:
        found = []
    quiet = states.stated and best.fit.scale < _AT_THE_NOISE
    remedies = [] if quiet else corrections(states, best.corrected, best.fit, groups)
    remedy = _believed(states, best.fit, remedies, groups)
    if remedy is not None:
        found.append(_mended(states, best.fit, remedy, where, groups))
    fit = best.fit if remedy is None else remedy.fit
    told = fit.misfit < _MOST_MISFIT
    if states.stated:
        told = fit.scale < _MOST_SCALE or fit.misfit < _SMALL_MISFIT
    if model is not None and not drive and told:
        found += mass_findings(states, fit, model, where)
        # An rms or another shape leaves the damping as it is.
        if all(one.severity == "info" or one.kind in _SCALES for one in found):
            found += shaker_damping(states, fit, model, where)
    return found


def misread(recorded: Reading, best: Reading, where: str) -> Finding:
    """That phasors are something else than what they are taken for."""
    kind, meaning, mend = _MEANINGS[best.name]
    old, new = recorded.fit, best.fit
    signs = " A"
    if best.name.startswith("conjugated") or best.name == "opposite":
        size = abs(new.mass) or 1.0
        ratio = np.median(old.damping[old.used] * old.mass) / size
        signs = (
            f" As recorded the modal mass is {old.mass:.3g} ± {old.mass_std:.1g} of the model's and"
            f" the damping {ratio:.3g} 1/s times it; a"
        )
    return Finding(
        kind,
        "error",
        where,
        f"the responses are {meaning}.{signs} single mode is missed by {100 * old.misfit:.3g} % "
        f"as recorded and by {100 * new.misfit:.3g} % so read (criterion smaller by "
        f"{recorded.criterion - best.criterion:.4g}).",
        mend + ".",
        repairs=(_REPAIRS[best.name],) if best.name in _REPAIRS else (),
    )


def _wild(fit: BalanceFit, where: str) -> Finding:
    return Finding(
        "degrees_for_radians",
        "error",
        where,
        f"phases jump at random from state to state while amplitudes are smooth: no mode is nearer "
        f"than {100 * fit.misfit:.3g} %, as where phases in degrees were read as radians.",
        "convert phases by π/180 (or 180/π) before the real and imaginary part are made.",
        repairs=(_REPAIRS["degrees_read_as_radians"],),
    )


def _believed(
    states: ModeStates,
    base: BalanceFit,
    remedies: list[Remedy],
    groups: tuple[tuple[int, ...], ...],
) -> Remedy | None:
    """The remedy that explains what the states as recorded do not; None where none does."""
    for one in remedies:
        fit = one.fit
        enough = one.gain > _LEAST_GAIN.get(one.kind, _LEAST_GAIN_ELSE)
        left = fit.scale < _EXPLAINED if states.stated else fit.misfit < 0.08
        left = left or fit.scale < _EXPLAINED_SHARE * base.scale
        if enough and left and _matters(states, one, groups):
            return one
        if enough and not _matters(states, one, groups):
            continue
        if not enough:
            return None
    return None


def _matters(states: ModeStates, one: Remedy, groups: tuple[tuple[int, ...], ...]) -> bool:
    """Whether a correction is large enough to be spoken of."""
    fit = one.fit
    used = fit.used
    ratio = np.median(np.abs(fit.damping[used])) / np.sqrt(
        np.median(np.abs(fit.stiffness[used])) + 1e-300
    )
    least = max(_LEAST_FREQUENCY, _OF_BANDWIDTH * float(ratio) / 2)
    if one.kind == "drift":
        bound = least if one.name.startswith("frequency") else _LEAST_GAIN_CHANGE
        return bool(abs(fit.extra[0]) > max(bound, 4 * fit.extra_std[0]))
    if one.kind == "different_structures":
        # Of one file a level of its own is rarely another structure: a misfitting curve looks so.
        strict = 1.0 if one.levels in groups else 2.0
        if _overlap(states, one.levels) < _OVERLAP or (
            strict > 1 and abs(fit.extra[0]) > _MOST_FREQUENCY
        ):
            return False
        # Bolts that loosen between levels change stiffness and damping, not the modal mass.
        if strict > 1 and len(fit.extra) > 1 and abs(fit.extra[2]) > _SAME_MASS:
            return False
        return bool(abs(fit.extra[0]) > max(strict * least, 4 * strict * fit.extra_std[0]))
    if one.kind == "force_dropout":
        return noise_floor(one) > _LEAST_FLOOR * float(states.force.min())
    if one.name == "gain_of_level":
        return bool(np.ptp(np.append(fit.extra, 0.0)) > 2 * _LEAST_GAIN_CHANGE)
    return True


def noise_floor(one: Remedy) -> float:
    """Noise of the force's cell in N: as tried, times what is left of the errors' scale."""
    return one.value * one.fit.scale


def _overlap(states: ModeStates, levels: tuple[int, ...]) -> float:
    """Share of the states of some levels at amplitudes of the others; of the others if larger.

    Without equal amplitudes a curve's own change and another structure look alike.
    """
    amplitude = np.log(np.abs(states.velocity) / states.frequency)
    some = np.isin(states.level, levels)
    one, other = amplitude[some], amplitude[~some]

    def within(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.mean((a >= b.min()) & (a <= b.max())))

    return max(within(one, other), within(other, one))


def _mended(
    states: ModeStates,
    base: BalanceFit,
    one: Remedy,
    where: str,
    groups: tuple[tuple[int, ...], ...],
) -> Finding:
    fit = one.fit
    left = (
        f"; the misfit of a single mode falls from {100 * base.misfit:.3g} % to "
        f"{100 * fit.misfit:.3g} % (criterion smaller by {one.gain:.3g})."
    )
    value, std = (
        (float(fit.extra[0]), float(fit.extra_std[0])) if len(fit.extra) else (one.value, np.nan)
    )
    if one.kind == "drift":
        what = {
            "frequency_trend": "natural frequency",
            "gain_trend": "gain of the response",
            "force_trend": "gain of the force",
        }[one.name]
        return Finding(
            *("drift", "warning", where),
            f"from the first to the last state the {what} changes by {100 * value:.3g} ± "
            f"{100 * std:.2g} %{left}",
            "repeat a level at the end of the test, let the temperature settle, or correct along "
            "`order`; an effect of the model can take a drifting frequency along.",
        )
    if one.kind == "different_structures":
        listed = ", ".join(str(k + 1) for k in one.levels)
        file = f" (file {groups.index(one.levels) + 1})" if one.levels in groups else ""
        damping = ""
        if len(fit.extra) > 1:
            damping = (
                f" and the damping by {100 * fit.extra[1]:.3g} ± {100 * fit.extra_std[1]:.2g} %"
            )
        return Finding(
            *("different_structures", "error", where),
            f"at equal amplitude the natural frequency of level {listed}{file}, counted from "
            f"the first, differs from the others' by {100 * value:.3g} ± {100 * std:.2g} %"
            f"{damping}{left}",
            "identify them apart: one call and one model for each structure or assembly.",
            repairs=(Repair(apart=True),) if one.levels in groups else (),
        )
    if one.kind == "volts_as_force":
        return _of_gains(one, where, left, groups)
    if one.kind == "force_dropout":
        floor = noise_floor(one)
        share = 100 * floor / float(states.force.min())
        return Finding(
            *("force_dropout", "warning", where),
            f"at resonance the force falls by up to {100 * deepest_fall(states):.3g} %, into the "
            f"noise of its cell: states miss a single mode the more the smaller the force, as by "
            f"about {floor:.2g} N whatever its size, {share:.2g} % of the smallest (criterion "
            f"smaller by {one.gain:.3g}).",
            "drive harder at resonance, average longer or use a more sensitive cell; damping is "
            "no better known than the force there.",
        )
    if one.kind == "unsettled_steps":
        return Finding(
            *("unsettled_steps", "error", where),
            f"about {100 * one.value:.2g} % of the motion of the state before is left at the end "
            f"of a step{left}",
            "dwell longer, 5/(ζω) a step; or import the time record, whose unsettled steps are "
            "left out.",
            repairs=(Repair(read_record=True),),
        )
    return _clipping(states, one, where, left)


def _of_gains(one: Remedy, where: str, left: str, groups: tuple[tuple[int, ...], ...]) -> Finding:
    """Forces whose scale is not the same at all levels; by name where a few of them are off."""
    right = 1 - np.append(0.0, one.fit.extra)  # share of the recorded force, over the first level's
    gains = -np.log(np.maximum(right, _LEAST_RIGHT))
    common = float(np.median(gains))
    away = np.abs(gains - common)
    few = np.flatnonzero(away > _OTHER_GAIN)
    rest = np.delete(away, few)
    if not len(few) or 2 * len(few) >= len(gains) or rest.max() > _ALIKE * away[few].min():
        listed = ", ".join(f"{np.exp(gain):.3g}" for gain in gains[1:])
        return Finding(
            *("volts_as_force", "error", where),
            f"the force over that of the first level is off by the factors {listed} at levels 2 "
            f"and on: a drive voltage or an amplifier's range{left}",
            "measure the force, or calibrate the drive at each level and divide `force_n` by what "
            "it gives.",
        )
    said, numbers = [], []
    for k in few:
        file = f" (file {groups.index((k,)) + 1})" if (k,) in groups else ""
        said.append(f"the force of level {k + 1}{file} is {np.exp(gains[k] - common):.3g} times")
        numbers.append(f"level {k + 1} by {np.exp(gains[k] - common):.3g}")
    return Finding(
        *("volts_as_force", "error", where),
        f"{' and '.join(said)} what the other levels ask for: the range or the calibration of the "
        f"cell or of its amplifier was another there, or the column is a drive voltage{left}",
        "if the column is a voltage, measure the force; else measure again, or divide the force of "
        f"{' and of '.join(numbers)} in the file that it comes from.",
        repairs=tuple(
            Repair(force=float(np.exp(common - gains[k])), levels=(int(k) + 1,)) for k in few
        ),
        title=f"force on another scale at level {' and '.join(str(k + 1) for k in few)}",
    )


def _clipping(states: ModeStates, one: Remedy, where: str, left: str) -> Finding:
    force = one.name == "force"
    size = states.force if force else np.abs(states.velocity)
    rows = tuple(int(states.row[k]) for k in np.flatnonzero(size > one.value * 0.999))
    unit = "N" if force else "m/s"
    return Finding(
        *("clipped_channel", "error", where),
        f"the {'force' if force else 'response'} is cut off at about {one.value:.4g} {unit} in "
        f"{len(rows)} states ({rows_in_words(rows)}){left}",
        "lower the channel's gain or range and measure these states again; leave them out until "
        "then.",
        rows,
    )
